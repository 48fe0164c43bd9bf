"""Both bounds of one frame, compiled: what may be wrong with its pose, and with the motion since the reference.

It is gathered from the frame's fits, the knocks since the pose was last known, the anchor and the reference's frames,
as ``docs/integrity.md`` tells it; each part's arithmetic stands in :mod:`~gripmon.track.integrity.kernel` and
:mod:`~gripmon.track.integrity.level_kernel`.  h hypotheses about the frame, b where no end of a finger is what it seems
besides, g lasting ones, f parts of the gripper, r cases; lengths in m and rad.
"""

from __future__ import annotations

import numpy as np

from gripmon.model.compiled import compiled
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array
from gripmon.track.integrity.kernel import Bools, Ints, after_jumps, knocked, telling, with_known
from gripmon.track.integrity.knocks import kinds_of, least_known
from gripmon.track.integrity.level_kernel import Bound, Limits, doubted, levels, moved

Fits = tuple[Array, ...]
"""Shifts (h, 6), covariances (h, 6, 6) and errors by the model (h, f, 6)."""

Frame = tuple[Array, Fits, Fits, Array, Array]
"""Of a frame: the pose (4, 4) that its fits count from, these alone and with what is known from before, the former's
covariances (h, 6, 6) with the error that no averaging removes, and that one (6, 6).
"""

Doubted = tuple[Array, Bools, Bools]
"""Of hypotheses (h,): the prior, whether the pose may have stayed, and whether no end of a finger is left."""

Knocks = tuple[Array, int, float, float, float]
"""The fingers' direction (3,), camera frame; the number of the hypothesis that no end is what it seems, and the cosine
from which on the way that its fit knows least is meant by "along the fingers"; probabilities of a knock under those
that leave an end, and under the others.
"""

Lasting = tuple[Fits, Array, Array, Array, Array, Ints, Array]
"""The anchor under g hypotheses: the averages, from a pose (4, 4), their origin, a pose (4, 4) and its covariance
(6, 6), the variances (6,) of the motion since, and rows and priors (g,) of the hypotheses.
"""

First = tuple[Fits, Array, Array, Array, Array, Array, Array]
"""What makes fits of a pose those of the motion since the reference, as for :func:`moved`: the fits at the reference as
:func:`begun` has them, none while the frame is itself the first one, ``lever``, ``by_motion``, ``travel``, ``origin``,
``tcp`` and ``stays_at``.
"""

Mount = tuple[Array, bool, float, float]
"""How far a mount moves that stays (6, 6); whether the pose is elsewhere, or was since the reference; probabilities
that it was knocked between the reference's images and the first frame, and since then, where nobody noticed.
"""

Cases = tuple[Array, Array, Array, Array, Ints, Ints]
"""What may be wrong with a published pose: the fits under it as shifts (r, 6) from that pose, covariances (r, 6, 6) and
errors by the model (r, f, 6); ``prior`` (r,), numbers of names (r,) and of what goes with each at the reference (r,).
"""

What = tuple[Array, bool, Frame, Doubted, Array, tuple[Fits, Doubted], Fits, Knocks, Lasting, Array, float, float]
"""What :func:`gathered` is told of a frame, from the published pose on."""


@compiled
def _seen_from(covariance: Array, jacobian: Array, half: Array, out: Array) -> None:
    """``out`` += J C J', each (6, 6); ``half`` (6, 6) is overwritten."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += jacobian[i, k] * covariance[k, j]
            half[i, j] = total
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(6):
                total += half[i, k] * jacobian[j, k]
            out[i, j] += total
            if j < i:
                out[j, i] += total


@compiled
def motion_since(cam_T_grip: Array, first_T: Array, reference_T: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Of a pose x, ``cam_T_grip``, and the one ``first_T`` that it had at the reference, x_b: the Jacobians (6, 6)
    ``lever`` from the difference of their errors to that of exp(d) reference, which is as far from x_b as the reference
    is wrong, and ``turn`` of an error of x_b to camera axes as they are after d; the motion exp(d), exp(d) reference,
    (4, 4) each, and the perturbation (6,) from there back to the reference.
    """
    lever, turn, motion, at_T = np.eye(6), np.zeros((6, 6)), np.zeros((4, 4)), np.zeros((4, 4))
    arm = np.zeros(3)
    motion[3, 3] = at_T[3, 3] = 1.0
    for i in range(3):
        for j in range(3):
            for k in range(3):
                motion[i, j] += cam_T_grip[i, k] * first_T[j, k]
            turn[i, j] = turn[3 + i, 3 + j] = motion[i, j]
        motion[i, 3] = at_T[i, 3] = cam_T_grip[i, 3]
        for k in range(3):
            motion[i, 3] -= motion[i, k] * first_T[k, 3]
            arm[i] += motion[i, k] * (reference_T[k, 3] - first_T[k, 3])
            for j in range(3):
                at_T[i, j] += motion[i, k] * reference_T[k, j]
        at_T[i, 3] += arm[i]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        lever[a, 3 + b], lever[b, 3 + a] = arm[i], -arm[i]
    return lever, turn, motion, at_T, perturbation_between(at_T, reference_T)


@compiled
def begun(
    cam_T_grip: Array, first_T: Array, reference_T: Array, shift: Array, covariance: Array, off: Array, more: Array
) -> tuple[Fits, Array, Array, Array, Array]:
    """What g fits b at the reference, ``shift`` (g, 6), ``covariance`` C (g, 6, 6) and errors by the model ``off``
    (g, f, 6), take from a motion since: L T of the shifts and of the errors, and the covariances L (T C T' + M) L',
    with M = ``more`` (6, 6) and the Jacobians L and T of :func:`motion_since`; L, the camera's way (3,), the TCP (3,)
    at exp(d) reference, and the perturbation (6,) from there back.
    """
    lever, turn, motion, at_T, unmoved = motion_since(cam_T_grip, first_T, reference_T)
    count, turned = len(shift), lever @ turn
    half, besides = np.empty((6, 6)), np.zeros((6, 6))
    shifts, covariances, offs = np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros(off.shape)
    _seen_from(more, lever, half, besides)
    for g in range(count):
        _seen_from(covariance[g], turned, half, covariances[g])
        for i in range(6):
            for k in range(6):
                covariances[g, i, k] += besides[i, k]
                shifts[g, i] += turned[i, k] * shift[g, k]
        for f in range(off.shape[1]):
            if off[g, f].any():  # most edges of a gripper are seen in no frame
                for i in range(6):
                    for k in range(6):
                        offs[g, f, i] += turned[i, k] * off[g, f, k]
    return (shifts, covariances, offs), lever, motion[:3, 3].copy(), at_T[:3, 3].copy(), unmoved


@compiled
def _put(fits: Fits, rows: Ints, away: Array, more: Array, prior: Array, called: Ints, into: Cases, first: int) -> int:
    """The fits ``rows`` (r,), from ``away`` (6,) and with ``more`` (6, 6) on their covariances, of a ``prior`` (r,) and
    ``called`` (r,) so, into cases from the ``first`` on; the number of the next.
    """
    (shift, covariance, off), (shifts, covariances, offs, priors, numbers, _) = fits, into
    for r in range(len(rows)):
        h, n = rows[r], first + r
        priors[n], numbers[n] = prior[r], called[r]
        for i in range(6):
            shifts[n, i] = shift[h, i] - away[i]
            for k in range(6):
                covariances[n, i, k] = covariance[h, i, k] + more[i, k]
        for f in range(off.shape[1]):
            for i in range(6):
                offs[n, f, i] = off[h, f, i]
    return first + len(rows)


@compiled
def gathered(
    risk: float,
    times: float,
    cam_T_grip: Array,
    displaced: bool,
    frame: Frame,
    doubts: Doubted,
    solved: Array,
    bare: tuple[Fits, Doubted],
    known: Fits,
    knocks: Knocks,
    lasting: Lasting,
    first_prior: Array,
    least: float,
    unsolved: float,
) -> tuple[Cases, tuple[int, int, int], Array, float]:
    """What may be wrong with a pose (4, 4): it is as known, but for one hypothesis, or was knocked away from there;
    something has been wrong all along, or was in the reference's frames alone, of the priors ``first_prior`` (g,).

    ``solved`` (h,): the priors as they count for knocks; ``bare``: fits and doubts where no end is what it seems
    besides; ``known``: the pose before, with its covariance and its errors by the model.  Knocks of less probability
    than ``least`` aren't solved, nor is something of the probability ``unsolved``; ``times``: factor on the fits'
    covariances for their tails.

    Returns the cases, in this order, and the numbers up to which the first, second and third are, these with the
    anchor's origin; the same without it come before the last.  Names count from those of the hypotheses over the same
    without the ends and the lasting ones to all but the first at the reference.  Then how far a knock moves a mount
    (6, 6), and the probability of what isn't solved.
    """
    (fit_T, alone, anchored, covariance, floor), (prior, stays, endless), (bare_fits, bare_doubts) = frame, doubts, bare
    average, from_T, origin_T, origin, wander, rows, lasting_prior = lasting
    (shift, own, off), (bare_shift, bare_own, bare_off), (place, before, known_off) = alone, bare_fits, known
    axis, ends, cosine, seen, unseen = knocks
    share, jumps, along, of_knock = kinds_of(least_known(covariance[ends], axis, cosine))
    fit, jump, weight, left_out = knocked(
        shift, own, off, place, before, known_off, jumps, share, along, solved, seen, unseen, stays, endless, least,
        times,
    )  # fmt: skip
    bare_fit, bare_jump, bare_weight, bare_left_out = knocked(
        bare_shift, bare_own, bare_off, place, before, known_off, jumps, share, along, bare_doubts[0], seen, unseen,
        bare_doubts[1], bare_doubts[2], least, times,
    )  # fmt: skip
    left_out += bare_left_out + unsolved
    here, g, h, b, many = np.flatnonzero(stays), len(rows), len(prior), len(bare_shift), len(first_prior)
    count = len(here) + len(fit) + len(bare_fit) + 2 * g + max(many - 1, 0)
    every, nowhere, nothing = np.arange(count), np.zeros(6), np.zeros((6, 6))
    # No more than an equal share of the risk: what is as improbable isn't bounded, whichever cases count how often.
    rare = (risk - left_out) / (count + len(here) + many + 1)
    after = after_jumps(shift, own, off, place, before, known_off, jumps, fit, jump, weight, rare)
    bare_after = after_jumps(
        bare_shift, bare_own, bare_off, place, before, known_off, jumps, bare_fit, bare_jump, bare_weight, rare
    )  # fmt: skip
    away = perturbation_between(fit_T, cam_T_grip)
    # By the average or the frame, whichever knows more; what neither shows is known as it was at the origin.
    away_too, around = shift.copy(), origin.copy()
    for i in range(6):
        around[i, i] += wander[i] / times
        for k in range(h):
            away_too[k, i] -= away[i]
    (mean, spread, mean_off), at = average, perturbation_between(from_T, cam_T_grip)
    told = telling(mean, spread, mean_off, at, wander / times, away_too, covariance, off, rows, CONTRADICTION_SQUARE)
    at = perturbation_between(cam_T_grip, origin_T)
    with_origin = with_known(told[0], told[1], told[2], at, around)
    into = (
        np.empty((count, 6)), np.empty((count, 6, 6)), np.empty((count, off.shape[1], 6)), np.empty(count),
        np.empty(count, np.intp), np.zeros(count, np.intp),
    )  # fmt: skip
    start = len(rows[:0])  # for a literal 0 numba compiles once more
    as_known = _put(anchored, here, away, floor, prior[here], here, into, start)
    knocked_too = _put(after, every[: len(fit)], away, floor, weight, fit, into, as_known)
    knocked_too = _put(bare_after, every[: len(bare_fit)], away, floor, bare_weight, h + bare_fit, into, knocked_too)
    names = h + b + every
    ever = _put(with_origin, every[:g], nowhere, nothing, lasting_prior, names, into, knocked_too)
    last = _put(told, every[:g], nowhere, nothing, lasting_prior, names, into, ever)
    if many:
        nothing_wrong = np.zeros(many - 1, np.intp)
        fits = alone if displaced else anchored
        _put(fits, nothing_wrong, away, floor, first_prior[1:], names + many, into, last)
    for k in range(g):
        into[5][ever + k] = k
    for k in range(1, many):
        into[5][last + k - 1] = k
    return into, (as_known, knocked_too, ever), of_knock, left_out


@compiled
def absolute_level(cases: Cases, count: int, alike: Array, farther: Array, limits: Limits) -> Bound:
    """The bound of a pose, by the first cases up to a number, and errors that they have alike, as for :func:`doubted`.
    """
    shift, covariance, off, prior, called, _ = cases
    table, share = np.empty((7, count)), limits[0] / max(count, 1)
    doubted(shift, covariance, off, prior[:count], alike, farther, limits[1], share, table)
    return levels(table, called, limits)


@compiled
def _moved(
    cases: Cases, low: int, high: int, prior: Array, first: First, staying: Array, true: Array, knock: Array,
    odds: float, limits: Limits, table: Array, names: Ints, at: int,
) -> int:  # fmt: skip
    """Cases from ``low`` to ``high``, of a ``prior`` (r,), into a table's columns from ``at`` on, with the numbers of
    their ``names`` (n,); the next column.  The rest as for :func:`moved`.
    """
    shift, covariance, off, _, called, which = cases
    (from_shift, from_covariance, from_off), lever, by_motion, travel, origin, tcp, stays_at = first
    moved(
        shift[low:high], covariance[low:high], off[low:high], prior[low:high], which[low:high], from_shift,
        from_covariance, from_off, lever, by_motion, travel, origin, tcp, stays_at, staying, true, knock, odds,
        limits[1], limits[0] / max(len(names), 1), table, at,
    )  # fmt: skip
    for r in range(low, high):
        names[at + r - low] = called[r]
    return at + high - low


@compiled
def level_of_motion(
    cases: Cases, counts: tuple[int, int, int], knock: Array, first: First, mount: Mount, limits: Limits
) -> Bound:
    """The bound of the motion since the reference, by what is wrong now and by what may have been in its frames."""
    (usual, moves, unwatched, unnoticed), (here, now, ever) = mount, counts
    shift, covariance, off, prior, called, which = cases
    if not len(first[0][0]):  # of the first frame its own errors count twice
        rows = np.append(np.arange(now), np.arange(ever, len(prior)))
        once_more = (shift[rows], 2.0 * covariance[rows], off[rows, :0].copy(), prior[rows], called[rows], which)
        return absolute_level(once_more, len(rows), np.zeros((0, 6)), np.zeros(2), limits)
    # A file's tilt is by the true motion, not by what noise in fits looks like: once as of a mount that moves as usual,
    # and by all that fits show as probably as it was knocked unnoticed since the reference's frames.
    by_truth, last, none = len(first[2]) > 1 and not moves, len(prior), np.zeros((0, 6))
    count = now + (here if by_truth else 0) + (2 if unwatched > 0.0 else 1) * (last - ever)
    table, names, start, true = np.empty((7, count)), np.empty(count, np.intp), len(none), usual if by_truth else none
    at = _moved(cases, start, here, prior, first, none, true, knock, 0.0, limits, table, names, start)
    at = _moved(cases, here, now, prior, first, none, none, knock, 0.0, limits, table, names, at)
    if unwatched > 0.0:
        # Nobody watched the mount from images to teach from until the first frame.  That nothing is wrong and it was
        # knocked then is among what is wrong now, which doesn't rest on its staying.
        then = prior * unwatched * (which > 0)
        at = _moved(cases, ever, last, then, first, usual + knock, none, knock, 0.0, limits, table, names, at)
    if by_truth:
        at = _moved(cases, start, here, prior, first, none, true, knock, unnoticed, limits, table, names, at)
    # Of a mount that creeps, vibrates and plays, and after a knock is where a knock moves it.
    staying = usual + knock if moves else usual
    _moved(cases, ever, last, prior, first, staying, true, knock, 0.0, limits, table, names, at)
    return levels(table, names, limits)


@compiled
def frame_bounds(
    what: What, alike: tuple[Array, Array], first: First, mount: Mount, limits: Limits
) -> tuple[Bound, Bound, Array]:
    """What :func:`absolute_level` and :func:`level_of_motion` make of what is :func:`gathered`, and the covariance
    (6, 6) of the motion by a knock.  Both bounds are infinite where too much may be wrong at once.
    """
    risk, inflation, near, squares, spacing, guide, step = limits
    cases, counts, knock, left_out = gathered(risk, inflation**2, *what)
    if left_out > 0.5 * risk:
        return (np.inf, np.inf, -1), (np.inf, np.inf, -1), knock
    left = risk - left_out, inflation, near, squares, spacing, guide, step
    absolute = absolute_level(cases, counts[2], alike[0], alike[1], left)
    return absolute, level_of_motion(cases, counts, knock, first, mount, left), knock
