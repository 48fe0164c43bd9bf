"""The belief by definition: the sum over all paths of sets of doubts, dense Gaussians over all rows of all frames."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from gripmon.belief.doubts import Doubt
from gripmon.belief.state import Array, Priors, Seen

STILL = 0.99


class Told(NamedTuple):
    """A frame with the probability of each finger's answer where its ends are right and wrong, and of all of them
    ``together`` (2,) where all are.
    """

    seen: Seen
    right: Array
    wrong: Array
    repeats: Array
    memory: float
    together: Array


class Sum(NamedTuple):
    """Probability of each set at the end, mean and covariance of g."""

    weights: dict[int, float]
    mean: Array
    covariance: Array


def sum_of_paths(doubts: Sequence[Doubt], priors: Priors, frames: Sequence[Told], dt_s: float, paths: Iterable) -> Sum:
    cache: dict[bytes, tuple[float, Array, Array]] = {}
    logs, means, covariances, ends = [], [], [], []
    for path in paths:
        log = _chains(doubts, frames, dt_s, path) + _witnesses(doubts, frames, path)
        if log == -math.inf:
            continue
        on = [[d for i, d in enumerate(doubts) if s >> i & 1] for s in path]
        bad = np.array(
            [np.any([d.edges for d in o], axis=0) if o else np.zeros(len(doubts[0].edges), bool) for o in on]
        )
        held = np.array([np.any([d.edges & d.held for d in o] or [0 * doubts[0].edges], axis=0) for o in on]).astype(
            bool
        )
        key = bad.tobytes() + held.tobytes()
        if key not in cache:
            cache[key] = _gaussian(priors, frames, bad, held)
        rows, mean, covariance = cache[key]
        logs.append(log + rows)
        means.append(mean)
        covariances.append(covariance)
        ends.append(path[-1])
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    mean = weights @ np.array(means)
    spread = sum(w * (c + np.outer(m - mean, m - mean)) for w, m, c in zip(weights, means, covariances, strict=True))
    by_set = {s: float(weights[np.array(ends) == s].sum()) for s in set(ends)}
    return Sum(by_set, mean, spread)


def _chains(doubts: Sequence[Doubt], frames: Sequence[Told], dt_s: float, path: Sequence[int]) -> float:
    log = 0.0
    for i, d in enumerate(doubts):
        for t, frame in enumerate(frames):
            new = 0.0 if d.held else 1.0 - float(frame.seen.likeness[d.edges][0])
            r = d.rates
            # The exponential of the generator of a chain of two states.
            step = linalg.expm(dt_s * np.array([[-r.per_s, r.per_s], [r.leaves_per_s, -r.leaves_per_s]]))
            begins = r.first if t == 0 else 1.0 - (1.0 - r.per_background * new) * float(step[0, 0])
            leaves = 1.0 - (1.0 - r.leaves_per_background * new) * float(step[1, 1])
            was, now = (path[t - 1] >> i & 1 if t else 0), path[t] >> i & 1
            p = (1.0 - leaves if now else leaves) if was else (begins if now else 1.0 - begins)
            log += math.log(p) if p > 0.0 else -math.inf
    return log


def _witnesses(doubts: Sequence[Doubt], frames: Sequence[Told], path: Sequence[int]) -> float:
    log, fingers = 0.0, range(len(doubts[0].ends))
    states = []  # of each frame and finger: whether it is doubted, and whether its answer is as if it weren't
    for s in path:
        about = [[d for i, d in enumerate(doubts) if s >> i & 1 and d.ends[f]] for f in fingers]
        states.append([(bool(of), not of or any(d.fooled for d in of)) for of in about])
    for t, frame in enumerate(frames):
        kept = [t > 0 and states[t][f] == states[t - 1][f] for f in fingers]
        as_right = {right for _, right in states[t]}
        if len(as_right) == 1 and len(set(kept)) == 1:
            of = [(float(frame.together[0 if as_right == {True} else 1]), kept[0], bool(frame.repeats.all()))]
        else:
            of = [
                (float((frame.right if states[t][f][1] else frame.wrong)[f]), kept[f], bool(frame.repeats[f]))
                for f in fingers
            ]
        for p, same, again in of:
            log += math.log(frame.memory * again + (1.0 - frame.memory) * p if same else p)
    return log


def _normal(values: Array, covariance: Array) -> float:
    _, half = np.linalg.slogdet(covariance)
    return float(-0.5 * (values @ np.linalg.solve(covariance, values) + half + len(values) * math.log(2.0 * math.pi)))


def _faded(frames: Sequence[Told], edge: int, i: int, j: int, stays: Array | None = None) -> float:
    """Correlation between frames i and j of what fades by the likeness, or of what stays."""
    out = 1.0
    for q in range(min(i, j) + 1, max(i, j) + 1):
        if frames[q].seen.shown[edge]:
            like = float(frames[q].seen.likeness[edge])
            out *= like if stays is None else (1.0 if stays[q] or like >= STILL else like)
    return out


At = tuple[int, int, int]
"""Frame, edge and row."""


def _gaussian(priors: Priors, frames: Sequence[Told], bad: Array, held: Array) -> tuple[float, Array, Array]:
    edges, log = bad.shape[1], 0.0
    for e in range(edges):
        log += sum(_stretch(priors, frames, e, a, b, bad, held[:, e]) for a, b in _stretches(bad[:, e]))
    at = _own(frames, bad, len(frames))
    prior = priors.covariance()
    if not at:
        return log, np.zeros(len(prior)), prior
    rows, values = _rows(frames, at), np.array([frames[t].seen.lines[e, 0, r] for t, e, r in at])
    noise = _noise(priors, frames, at, at) + np.diag([float(frames[t].seen.white[e, 0, r]) for t, e, r in at])
    covariance = rows @ prior @ rows.T + noise
    gain = prior @ rows.T @ np.linalg.inv(covariance)
    left = np.eye(len(prior)) - gain @ rows
    return log + _normal(values, covariance), gain @ values, left @ prior @ left.T + gain @ noise @ gain.T


def _own(frames: Sequence[Told], bad: Array, end: int) -> list[At]:
    """Rows before a frame that are taken for the gripper's."""
    shown = [(t, e) for t in range(end) for e in range(bad.shape[1]) if frames[t].seen.shown[e] and not bad[t, e]]
    return [(t, e, r) for t, e in shown for r in (0, 1)]


def _rows(frames: Sequence[Told], at: Sequence[At]) -> Array:
    return np.array([frames[t].seen.rows[e, 0, r] for t, e, r in at])


def _noise(priors: Priors, frames: Sequence[Told], at: Sequence[At], others: Sequence[At]) -> Array:
    """What the lasting errors and those of the backgrounds make of rows, two by two."""
    out = np.zeros((len(at), len(others)))
    for a, (i, e, r) in enumerate(at):
        for b, (j, other, row) in enumerate(others):
            if (e, r) == (other, row):
                out[a, b] = priors.lasting_px**2 + _strength(frames[i], e, r) * _faded(frames, e, i, j)
    return out


def _strength(frame: Told, edge: int, row: int) -> float:
    """Of white errors along -1 to 1, the slope's variance over the offset's."""
    return float(frame.seen.strength[edge]) * (1.0, 3.0)[row]


def _expected(priors: Priors, frames: Sequence[Told], bad: Array, at: At) -> tuple[float, float]:
    """Where a row of the gripper's would be by what was seen before, and its variance but for the white one."""
    before, prior = _own(frames, bad, at[0]), priors.covariance()
    row = _rows(frames, [at])
    alone = float((row @ prior @ row.T + _noise(priors, frames, [at], [at]))[0, 0])
    if not before:
        return 0.0, alone
    rows, values = _rows(frames, before), np.array([frames[t].seen.lines[e, 0, r] for t, e, r in before])
    noise = _noise(priors, frames, before, before)
    white = np.diag([float(frames[t].seen.white[e, 0, r]) for t, e, r in before])
    cross = (row @ prior @ rows.T + _noise(priors, frames, [at], before))[0]
    gain = np.linalg.solve(rows @ prior @ rows.T + noise + white, cross)
    return float(gain @ values), alone - float(gain @ cross)


def _stretches(bad: Array) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], bad.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _stretch(
    priors: Priors, frames: Sequence[Told], edge: int, start: int, end: int, bad: Array, held: Array
) -> float:  # fmt: skip
    shown = [t for t in range(start, end) if frames[t].seen.shown[edge]]
    if not shown:
        return 0.0
    first, parts = shown[0], []  # of a doubt that begins unseen the place is drawn when it is seen
    seen = frames[first].seen
    for near, size in ((True, priors.near_px), (False, priors.far_px)):
        part = math.log(0.5)
        for r in (0, 1):
            away, wide = 0.0, 0.0  # where it is drawn beside where it was searched
            if near:
                place, wide = _expected(priors, frames, bad, (first, edge, r))
                away = place - float(seen.searched[edge, 0, r])
            left = [_faded(frames, edge, first, t, held) for t in shown]
            values = [float(frames[t].seen.lines[edge, 0, r] - seen.searched[edge, 0, r]) for t in shown]
            covariance = np.array([[
                size**2 * _faded(frames, edge, i, j, held) + wide * left[a] * left[b]
                + _strength(frames[i], edge, r) * _faded(frames, edge, i, j)
                + (float(frames[i].seen.white[edge, 0, r]) if i == j else 0.0)
                for b, j in enumerate(shown)] for a, i in enumerate(shown)])  # fmt: skip
            part += _normal(np.array(values) - away * np.array(left), covariance)
        parts.append(part)
    return float(np.logaddexp(*parts))
