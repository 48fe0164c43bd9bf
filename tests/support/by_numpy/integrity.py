"""What ``track.integrity.kernel``, ``level_kernel`` and ``frame_kernel`` compile, by NumPy."""

from __future__ import annotations

import numpy as np

from gripmon.model.geometry import invert, perturb, perturbation_between, skew
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.records import Array
from gripmon.track.integrity.kernel import Ints
from gripmon.track.integrity.knocks import kinds_of, least_known
from gripmon.track.integrity.level_kernel import MOST_SIGMAS
from gripmon.track.integrity.separation import QUANTILES, Tails


def add_up(
    pull: Array,
    information: Array,
    middle: Array,
    model: Array,
    part: Ints,
    parts: int,
    keep: Array,
    known: Array,
    known_pull: Array,
) -> tuple[Array, Array, Array, Array]:
    (edges, m), own = pull.shape, part == np.arange(parts)[:, None, None]
    normal = (keep @ information.reshape(edges, -1)).reshape(-1, m, m) + known
    spread = (keep @ middle.reshape(edges, -1)).reshape(-1, m, m) + known
    return keep @ pull + known_pull, normal, spread, np.einsum("hv,fpv,pvi->hfi", keep, own, model)


def separate(sums: Array, normal: Array, spread: Array, of_model: Array, unknowns: int) -> tuple[Array, Array, Array]:
    inverse = np.linalg.inv(normal)[:, :unknowns]
    covariance = inverse @ spread @ inverse.transpose(0, 2, 1)
    return np.einsum("hij,hj->hi", inverse, sums), covariance, np.einsum("hij,hfj->hfi", inverse, of_model)


def with_pose(
    sums: Array, normal: Array, spread: Array, of_model: Array, at: Array, covariance: Array, off: Array
) -> tuple[Array, Array, Array, Array]:
    sums, normal, spread, of_model = sums.copy(), normal.copy(), spread.copy(), of_model.copy()
    information = np.linalg.inv(covariance)
    sums[:, :6] += information @ at
    normal[:, :6, :6] += information
    spread[:, :6, :6] += information
    of_model[:, :, :6] += off @ information
    return sums, normal, spread, of_model


def squares(shift: Array, at: Array, covariance: Array, off: Array, times: float, more: Array, other: Array) -> Array:
    away, both = shift - at, times * covariance + more + squared(off - other)
    return np.asarray(np.einsum("hi,hi->h", away, np.linalg.solve(both, away[:, :, None])[:, :, 0]))


def squared(off: Array) -> Array:
    return np.asarray(np.einsum("...fi,...fj->...ij", off, off))


def jumped(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    prior: Array,
    stays: Array,
    times: float,
    enough: Array,
) -> Array:
    every = np.concatenate([jumps, np.zeros((1, 6, 6))])
    share = np.column_stack([prior, np.where(stays, 1.0 - prior.sum(axis=1), 0.0)])
    spread = times * covariance + known + squared(off - known_off)
    unit = np.sqrt(known.diagonal())  # so that densities are numbers of everyday size
    both, away = (spread[:, None] + every) / np.outer(unit, unit), ((shift - at) / unit)[:, None, :, None]
    # Not SciPy's density: it leaves out directions a million times better known than another, as along a bare side.
    square = (away * np.linalg.solve(both, np.broadcast_to(away, (*both.shape[:3], 1)))).sum(axis=(2, 3))
    log_density = -0.5 * (square + np.linalg.slogdet(both)[1])
    weight = share * np.exp(log_density - np.max(log_density, axis=1, keepdims=True))
    with np.errstate(divide="ignore", over="ignore"):
        most = prior * (np.exp(0.5 * square[:, -1]) / (1.0 - prior.sum(axis=1)))[:, None]
    bounded = stays & (most.sum(axis=1) <= enough)
    return np.where(bounded[:, None], most, (weight / weight.sum(axis=1, keepdims=True))[:, :-1])


def joined(
    mean: Array, before: Array, off: Array, shift: Array, covariance: Array, of_model: Array
) -> tuple[Array, Array, Array]:
    """In the information form, as the product's isn't."""
    information, other = np.linalg.inv(before), np.linalg.inv(covariance)
    after = np.linalg.inv(information + other)
    kept, taken = after @ information, after @ other
    off, of_model = np.broadcast_arrays(off, of_model)
    return (
        np.einsum("rij,rj->ri", kept, mean) + np.einsum("rij,rj->ri", taken, shift),
        after,
        np.einsum("rij,rfj->rfi", kept, off) + np.einsum("rij,rfj->rfi", taken, of_model),
    )


def after_jumps(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    fit: Ints,
    jump: Ints,
    probability: Array,
    share: float,
) -> tuple[Array, Array, Array]:
    before, count, counts = known + jumps[jump], len(fit), probability > share
    made = joined(np.tile(at, (count, 1)), before, known_off, shift[fit], covariance[fit], off[fit])
    return made[0] * counts[:, None], made[1] * counts[:, None, None], made[2] * counts[:, None, None]


def knocked(
    shift: Array,
    covariance: Array,
    off: Array,
    at: Array,
    known: Array,
    known_off: Array,
    jumps: Array,
    share: Array,
    along: Array,
    prior: Array,
    seen: float,
    unseen: float,
    stays: Array,
    endless: Array,
    least: float,
    times: float,
) -> tuple[Ints, Ints, Array, float]:
    before = np.outer(np.where(endless, unseen, seen), share)
    enough = least / np.maximum(prior, 1e-300)
    given = jumped(shift, covariance, off, at, known, known_off, jumps, before, stays, times, enough)
    weight = prior[:, None] * np.where(np.outer(endless, along), np.maximum(given, before), given)
    counts = weight > least
    fit, jump = np.nonzero(counts)
    return fit, jump, weight[counts], float(weight[~counts].sum())


def tails(shift: Array, covariance: Array, of_model: Array, inflation: float) -> tuple[Array, Array, Array]:
    parts = shift.reshape(-1, 2, 3)
    covariance = inflation**2 * covariance + np.einsum("hfi,hfj->hij", of_model, of_model)
    blocks = np.stack([covariance[:, :3, :3], covariance[:, 3:, 3:]])
    return np.sqrt(np.einsum("hpi,hpi->ph", parts, parts)), *Tails.of(blocks)


def beyond(tails: Tails, radius: Array) -> Array:
    """Probabilities of lengths above ``radius``; 1 for a negative one."""
    square = np.square(np.maximum(radius, 0.0) / tails.sigma)
    one = np.interp(square, QUANTILES.squares[0], QUANTILES.log_risk) + tails.factor
    three = np.interp(square, QUANTILES.squares[1], QUANTILES.log_risk)
    return np.asarray(10.0 ** np.minimum(one, three))


def levels(table: Array, called: Ints, limits: tuple) -> tuple[float, float, int]:
    (prior, away, sigma, factor), (risk, _, near, *_) = (table[0], table[1:3], table[3:5], table[5:7]), limits
    share = risk / max(len(prior), 1)
    counted = np.flatnonzero(prior > share)
    if not len(counted):
        return 0.0, 0.0, -1
    left = risk - float(prior[prior <= share].sum())
    prior, away, tails = prior[counted], away[:, counted], Tails(sigma[:, counted], factor[:, counted])
    # Each needs as much as if it had the whole risk alone; an equal share is enough for all.
    # What is less probable than the risk may lie beyond the level altogether.
    alone = np.where(prior > left, away + tails.radius(np.broadcast_to(left / prior, away.shape)), 0.0)
    least = alone.max(axis=1)
    most = (away + tails.radius(np.broadcast_to(left / len(prior) / prior, away.shape))).max(axis=1)
    least = np.maximum(least, 1e-3 * most)
    while (most > near * least).any():
        middle = np.sqrt(least * most)
        enough = (prior * beyond(tails, middle[:, None] - away)).sum(axis=1) <= left
        least, most = np.where(enough, least, middle), np.where(enough, middle, most)
    owed = prior * beyond(tails, most[:, None] - away)[0]
    return float(most[0]), float(most[1]), int(called[counted[np.argmax(owed)]])


def follow(
    mean: Array, covariance: Array, off: Array, shift: Array, of_frame: Array, of_model: Array, creep: Array
) -> tuple[Array, Array, Array, Array]:
    before = covariance + np.diag(creep)
    gain = np.einsum("gii->g", before @ np.linalg.inv(before + of_frame))
    return *joined(mean, before, off, shift, of_frame, of_model), gain


def with_known(shift: Array, covariance: Array, off: Array, at: Array, known: Array) -> tuple[Array, Array, Array]:
    every = np.ones((len(shift), 1))
    return joined(shift, covariance, off, every * at, every[:, None] * known, np.zeros_like(off))


def doubted(
    shift: Array,
    covariance: Array,
    off: Array,
    prior: Array,
    alike: Array,
    farther: Array,
    inflation: float,
    share: float,
    table: Array,
) -> None:
    every = np.broadcast_to(alike, (len(prior), *alike.shape))
    fits = shift, covariance, np.concatenate([off, every], axis=1)
    enter(table, 0, prior, share, tails(*fits, inflation), farther)


def enter(
    table: Array, first: int, prior: Array, share: float, of: tuple[Array, Array, Array], farther: Array
) -> None:
    columns = table[:, first : first + len(prior)]
    made = np.concatenate([prior[None], of[0] + farther[:, None], *of[1:]])
    columns[:] = np.where(np.arange(7)[:, None] == 0, made, np.where(prior > share, made, np.nan))


def motion_since(cam_T_grip: Array, first_T: Array, reference_T: Array) -> tuple[Array, Array, Array, Array, Array]:
    motion, lever, turn = cam_T_grip @ invert(first_T), np.eye(6), np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = motion[:3, :3]
    lever[:3, 3:] = -skew(motion[:3, :3] @ (reference_T[:3, 3] - first_T[:3, 3]))
    at_T = motion @ reference_T
    return lever, turn, motion, at_T, perturbation_between(at_T, reference_T)


def begun(
    cam_T_grip: Array, first_T: Array, reference_T: Array, shift: Array, covariance: Array, off: Array, more: Array
) -> tuple[tuple[Array, Array, Array], Array, Array, Array, Array]:
    lever, turn, motion, at_T, unmoved = motion_since(cam_T_grip, first_T, reference_T)
    turned = lever @ turn
    fits = shift @ turned.T, lever @ (turn @ covariance @ turn.T + more) @ lever.T, off @ turned.T
    return fits, lever, motion[:3, 3], at_T[:3, 3], unmoved


def multivariate_density(way: Array, covariance: Array) -> Array:
    """(r,) normal densities of (r, 6) about zero, but for a factor that all have."""
    square = np.einsum("ri,ri->r", way, np.linalg.solve(covariance, way[..., None])[..., 0])
    return np.asarray(np.exp(-0.5 * square) / np.sqrt(np.linalg.det(covariance)))


def moved(
    shift: Array,
    covariance: Array,
    off: Array,
    prior: Array,
    which: Ints,
    from_shift: Array,
    from_covariance: Array,
    from_off: Array,
    lever: Array,
    by_motion: Array,
    travel: Array,
    origin: Array,
    tcp: Array,
    stays_at: Array,
    staying: Array,
    usual: Array,
    knock: Array,
    odds: float,
    inflation: float,
    share: float,
    table: Array,
    first: int,
) -> None:
    way = shift @ lever.T - from_shift[which]
    spread = lever @ covariance @ lever.T + from_covariance[which]
    errors = [off @ lever.T - from_off[which]]
    true_way = way
    if len(usual):
        whole = spread + np.einsum("rfi,rfj->rij", errors[0], errors[0])
        stayed, jumped = (multivariate_density(way - stays_at, whole + usual + more) for more in (0.0, knock))
        if odds > 0.0:
            probable = np.maximum(odds, odds * jumped / (odds * jumped + (1.0 - odds) * stayed))
            prior = np.where(prior > share, prior * probable, prior)
        else:
            true_way, unsure, _ = with_known(way, whole, np.zeros((len(way), 0, 6)), stays_at, usual)
            x, y, z = tcp
            lever_of_origin = np.hstack([np.eye(3), np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])])
            each = by_motion @ lever_of_origin
            spread = spread + np.einsum("kia,rab,kjb->rij", each, unsure, each)
    if len(by_motion):
        # Each by the motion that it has: a file's error does nothing where the mount stayed.
        ways = origin + true_way[:, :3] - np.cross(true_way[:, 3:], tcp)
        each = np.moveaxis(by_motion @ ways.T, 2, 0)
        # Such an error is in the motion as published, too, which they are reckoned from.
        at_origin = each[..., :3] - np.cross(each[..., 3:], tcp)
        second = MOST_SIGMAS * np.einsum("kij,hlj->hkli", by_motion, at_origin).reshape(len(each), -1, 6)
        each[:, 0] += travel
        errors += [second, each]
    fits = way, spread, np.concatenate(errors, axis=1)
    if len(staying):
        fits = with_known(*fits, stays_at, staying)
    enter(table, first, prior, share, tails(*fits, inflation), np.zeros(2))


def refitted(
    predicted_T: Array,
    xi: Array,
    pull: Array,
    information: Array,
    middle: Array,
    lasting: Array,
    edge: Ints,
    finger: Ints,
    fingers: int,
    longer: Array,
    keep: Array,
    opening: Array,
    vague: Array,
    way_m: float,
    sigma_m: float,
    anchor_T: Array,
    known: Array,
    known_off: Array,
    times: float,
    together: bool,
) -> tuple[Array, Array, tuple[Array, ...], tuple[Array, ...], Array]:
    fit_T, (count, m) = perturb(predicted_T, xi[:6]), (len(keep), len(xi))
    held, held_pull = np.tile(np.diag(vague), (count, 1, 1)), np.zeros((count, m))
    if m == 7:
        held[~opening, 6, 6] = max(sigma_m, 1e-6) ** -2
        held_pull[:, 6] = held[:, 6, 6] * way_m
    model = np.stack([information[:, :, :3] @ (fit_T[:3, :3] @ longer), lasting])
    part, at = np.stack([finger[edge], fingers + edge]), perturbation_between(fit_T, anchor_T)
    of = pull, information, middle, model, part, fingers + len(finger), keep, held, held_pull
    sums = add_up(*of)
    alone = separate(*sums, 6)
    with_it = separate(*with_pose(*(each[: len(each) * together] for each in sums), at, known, known_off), 6)
    return fit_T, at, alone, with_it, squares(alone[0], at, alone[1], alone[2], times, known, known_off)


def telling(
    mean: Array,
    covariance: Array,
    off: Array,
    at: Array,
    wander: Array,
    shift: Array,
    of_frame: Array,
    of_model: Array,
    rows: Ints,
    limit: float,
) -> tuple[Array, Array, Array]:
    mean, covariance = mean - at, covariance + np.diag(wander)
    shift, of_frame, of_model = shift[rows], of_frame[rows], of_model[rows]
    none = np.zeros((1, 6))
    frame = squares(shift - mean, np.zeros(6), of_frame + covariance, 0.0 * off, 1.0, np.zeros((6, 6)), none) > limit
    frame |= np.einsum("gii->g", of_frame[:, :3, :3]) < np.einsum("gii->g", covariance[:, :3, :3])
    frame &= rows >= 0
    each = frame[:, None, None]
    return (
        np.where(frame[:, None], shift, mean),
        np.where(each, of_frame, covariance),
        np.where(each, of_model, off),
    )


def gathered(
    _risk: float, times: float, cam_T_grip: Array, displaced: bool, frame: tuple, doubts: tuple, solved: Array,
    bare: tuple, known: tuple, of_knocks: tuple, lasting: tuple, first_prior: Array, least: float,
    unsolved: float,
) -> tuple[tuple, tuple[int, int, int], Array, float]:  # fmt: skip
    fit_T, alone, anchored, covariance, floor = frame
    axis, ends, cosine, *odds = of_knocks
    average, from_T, origin_T, origin, wander, rows, lasting_prior = lasting
    share, jumps, along, spread = kinds_of(least_known(covariance[ends], axis, cosine))
    away = perturbation_between(fit_T, cam_T_grip)
    h, b, g, many, nowhere, left_out = len(solved), len(bare[1][0]), len(rows), len(first_prior), np.zeros(6), unsolved
    here = np.flatnonzero(doubts[1])
    # The fits, which of them, the pose that they count from, what their covariances lack, priors, names.
    sets, counts = [(anchored, here, away, floor, doubts[0][here], here)], [len(here)]
    for fits, (prior, stays, endless), base in ((alone, (solved, *doubts[1:]), 0), (*bare, h)):
        if len(prior):
            of = jumps, share, along, prior, *odds, stays, endless, least, times
            fit, jump, weight, out = knocked(*fits, *known, *of)
            after = after_jumps(*fits, *known, jumps, fit, jump, weight, 0.0)
            sets.append((after, np.arange(len(fit)), away, floor, weight, base + fit))
            left_out += out
    counts.append(sum(len(each[1]) for each in sets))
    every, nothing = np.arange(g), np.zeros((6, 6))
    if g:
        way = wander / times
        at, own = perturbation_between(from_T, cam_T_grip), (alone[0] - away, covariance, alone[2])
        told = telling(*average, at, way, *own, rows, CONTRADICTION_SQUARE)
        with_origin = with_known(*told, perturbation_between(cam_T_grip, origin_T), origin + np.diag(way))
        sets += [(each, every, nowhere, nothing, lasting_prior, h + b + every) for each in (with_origin, told)]
    counts.append(counts[1] + g)
    numbers = np.arange(1, many)
    fits = alone if displaced else anchored
    sets.append((fits, 0 * numbers, away, floor, first_prior[1:], h + b + many + numbers - 1))
    cases = [
        np.concatenate(each)
        for each in zip(
            *(
                (fits[0][rows] - away, fits[1][rows] + more, fits[2][rows], prior, called)
                for fits, rows, away, more, prior, called in sets
            ),
            strict=True,
        )
    ]
    which = np.concatenate([np.zeros(counts[2], np.intp), every, numbers])
    return (*cases, which), tuple(counts), spread, left_out


def absolute_level(cases: tuple, count: int, alike: Array, farther: Array, limits: tuple) -> tuple[float, float, int]:
    *fits, called, _ = (each[:count] for each in cases)
    table = np.empty((7, count))
    doubted(*fits, alike, farther, limits[1], limits[0] / max(count, 1), table)
    return levels(table, called, limits)


def level_of_motion(
    cases: tuple, counts: tuple, spread: Array, first: tuple, mount: tuple, limits: tuple
) -> tuple[float, float, int]:
    """Set by set."""
    shift, covariance, off, prior, called, which = cases
    (usual, moves, unwatched, unnoticed), (here, now, ever), none = mount, counts, np.zeros((0, 6))
    if not len(first[0][0]):
        kept = ~np.isin(np.arange(len(prior)), range(now, ever))
        twice = shift[kept], 2.0 * covariance[kept], 0.0 * off[kept], prior[kept], called[kept], which[kept]
        return absolute_level(twice, int(kept.sum()), none, np.zeros(2), limits)
    by_truth, lasts, at_once = len(first[2]) > 1 and not moves, np.arange(ever, len(prior)), np.arange(here)
    true = usual if by_truth else none
    # Which cases, their priors, and of the motion: what is known of it, and what of the true one.
    sets = [(at_once, prior, none, true, 0.0), (np.arange(here, now), prior, none, none, 0.0)]
    if unwatched:
        sets.append((lasts, prior * unwatched * (which > 0), usual + spread, none, 0.0))
    if by_truth:
        sets.append((at_once, prior, none, usual, unnoticed))
    sets.append((lasts, prior, usual + spread if moves else usual, true, 0.0))
    names = np.concatenate([called[rows] for rows, *_ in sets])
    table, at = np.empty((7, len(names))), 0
    for rows, priors, *known, odds in sets:
        of = shift[rows], covariance[rows], off[rows], priors[rows], which[rows], *first[0], *first[1:], *known
        moved(*of, spread, odds, limits[1], limits[0] / max(len(names), 1), table, at)
        at += len(rows)
    return levels(table, names, limits)


def frame_bounds(what: tuple, alike: tuple, first: tuple, mount: tuple, limits: tuple) -> tuple:
    risk, inflation, *tables = limits
    cases, counts, knock, left_out = gathered(risk, inflation**2, *what)
    if left_out > 0.5 * risk:
        return (np.inf, np.inf, -1), (np.inf, np.inf, -1), knock
    left = risk - left_out, inflation, *tables
    absolute = absolute_level(cases, counts[2], *alike, left)
    return absolute, level_of_motion(cases, counts, knock, first, mount, left), knock
