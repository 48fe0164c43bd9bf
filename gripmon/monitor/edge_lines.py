"""The straight lines that an image has where a gripper's edges were searched, as the belief takes them.

All of them, not only those that agree with a fit: which is the gripper's own is asked of every hypothesis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gripmon.belief.state import LIGHT, LINES_APART_PX, MOST_LINES, MOTION, OPENING, Flags, Ints
from gripmon.model.records import Array
from gripmon.track.edges import Measurement
from gripmon.track.edges.prediction import EdgeLayout

FEWEST_POINTS = 6
"""Points of an edge from which it has an offset and a slope with a scatter."""
LEAST_WHITE_PX = 0.02
"""Standard deviation of an edge that no pixel noise explains: interpolation between pixels."""
WITHIN_PX = 0.5 * LINES_APART_PX
"""Distance from a line within which an edgel hypothesis is on it: three standard deviations of the least sure ones."""
PLACES_PX = np.array([(offset, slope) for offset in np.arange(-7.0, 7.01, 0.3) for slope in np.arange(-2.0, 2.01, 0.5)])
"""Where lines are looked for (offset, slope): as far as search lines reach."""


PARTS = 2
"""Parts of a curve: the fewest whose slopes tell whether it bends."""


class Parts:
    """The s edges that the belief knows of a gripper: a straight one is one, a ``curved`` (e,) one several, else what
    is straight would be taken for it.  ``edge`` (s,) is that of each.
    """

    def __init__(self, curved: Flags) -> None:
        self._count = np.where(curved, PARTS, 1)
        self._first = np.cumsum(self._count) - self._count
        self.edge = np.repeat(np.arange(len(curved)), self._count)

    def __len__(self) -> int:
        return len(self.edge)

    def of(self, layout: EdgeLayout) -> Ints:
        """(n,) on which each search line lies."""
        count = self._count[layout.edge]
        return self._first[layout.edge] + np.minimum((layout.fraction * count).astype(np.int64), count - 1)


class Line(NamedTuple):
    """``rows`` (2, 23): how its two numbers change with g, offset at the middle of what is seen of the edge and slope
    times half of that; ``place_px`` (2,), by which it is off from where the reference has the edge; its ``white_px2``
    (2,), the variance of what is new in every frame; ``searched_px`` (2,), where it was looked for; ``image_px`` (2,),
    both numbers in a frame that is fixed in the image, with variances ``image_px2`` (2,); how many independent
    ``points`` it has; the ``step`` in grey levels across it; whether the fit ``agrees``.
    """

    rows: Array
    place_px: Array
    white_px2: Array
    searched_px: Array
    image_px: Array
    image_px2: Array
    points: float
    step: float
    agrees: bool


class Frame2d(NamedTuple):
    """Of an edge where it was first seen: its ``middle`` (2,) and ``way`` (2,), px, half as long as what was seen."""

    middle: Array
    way: Array

    def line(self, points_px: Array, weight: Array) -> tuple[Array, Array]:
        """(2,) offset and slope of the line through points (n, 2), weighted; and their variances (2,), for points with
        one by themselves.
        """
        square = float(self.way @ self.way)
        away = points_px - self.middle
        basis = np.column_stack([np.ones(len(away)), away @ self.way / square])
        across = away @ np.array([-self.way[1], self.way[0]]) / np.sqrt(square)
        return _line(basis, weight) @ across, np.diag(np.linalg.inv(basis.T @ basis))


def found_at(
    look: Measurement, columns: Array, away: Array, reported_m: float, frames: dict[int, Frame2d], parts: Parts
) -> list[list[Line]]:
    """The lines of each part in a look at an image that starts ``away`` (6,) from the reference, whose search lines
    change by ``columns`` (n, 23) with g; ``reported_m``: the opening that was reported.  ``frames`` get those of
    parts that are seen for the first time.
    """
    p, c, fit = look.prediction, look.candidates, look.consensus
    from_reference = columns[:, MOTION] @ away + columns[:, OPENING] * (p.jaw_opening_m - reported_m)
    out: list[list[Line]] = [[] for _ in range(len(parts))]
    lies_on = parts.of(p.layout)
    for part in np.unique(lies_on[c.sample]).tolist():
        own, edge = np.flatnonzero(lies_on[c.sample] == part), int(parts.edge[part])
        agree = fit.weight[own] > 0.0 if fit.edge_seen[edge] else np.zeros(len(own), bool)
        search_lines = int(np.count_nonzero(lies_on == part))
        found = lines_of(c.offset_px[own], c.sample[own], p.layout.fraction[c.sample[own]], agree, search_lines)
        if not found:
            continue
        first = own[found[0]]
        sample, fraction = c.sample[first], p.layout.fraction[c.sample[first]]
        line = _line(_basis(fraction, fraction), 1.0 / np.square(c.sigma_px[first]))
        both = line @ np.column_stack([from_reference[sample], columns[sample]])
        if part not in frames:
            ends_px = p.uv_px[sample[[int(np.argmin(fraction)), int(np.argmax(fraction))]]]
            frames[part] = Frame2d(ends_px.mean(axis=0), 0.5 * (ends_px[1] - ends_px[0]))
        for on in found:
            points = own[on]
            at_px = p.uv_px[c.sample[points]] + c.offset_px[points, None] * p.normal[c.sample[points]]
            image, loose = frames[part].line(at_px, 1.0 / np.square(c.sigma_px[points]))
            basis = _basis(p.layout.fraction[c.sample[points]], fraction)
            place = _line(basis, 1.0 / np.square(c.sigma_px[points])) @ c.offset_px[points]
            left = c.offset_px[points] - basis @ place
            spread = float(left @ left) / max(len(points) - 2, 1)
            single = np.diag(np.linalg.inv(basis.T @ basis)) / float(p.independence[edge])
            step = float(np.median(c.step[points]))
            rows = both[:, 1:].copy()
            rows[0, LIGHT], rows[1, LIGHT] = -np.sign(step), 0.0
            independent = max(float(p.independence[edge]) * len(points), 2.0)
            white, unsure = (LEAST_WHITE_PX**2 + spread * of for of in (single, loose / float(p.independence[edge])))
            away_px, searched_px = place + both[:, 0], both[:, 0]
            out[part].append(Line(rows, away_px, white, searched_px, image, unsure, independent, step, on is agree))
    return out


def merged(looks: list[list[Line]], by: int) -> tuple[list[Line], int]:
    """An edge's lines in several looks, each once; and which of them agrees with the fit of look ``by``, -1 for
    none.
    """
    out: list[Line] = []
    fitted = -1
    for k, found in enumerate(looks):
        for line in found:
            twin = [q for q, other in enumerate(out) if abs(other.place_px[0] - line.place_px[0]) < WITHIN_PX]
            if not twin:
                out.append(line)
            if k == by and line.agrees:
                fitted = twin[0] if twin else len(out) - 1
    return out, fitted


def lines_of(offset_px: Array, sample: Ints, fraction: Array, agree: Flags, search_lines: int) -> list[Flags]:
    """Which of an edge's edgel hypotheses (n,), at ``offset_px`` on ``sample``, the search line at ``fraction`` of the
    edge, are on each of the lines there, at most MOST_LINES: first that of those which ``agree`` with the fit, if there
    are enough, then what at least half of the ``search_lines`` support.
    """
    out: list[Flags] = []
    left, basis = np.ones(len(offset_px), bool), _basis(fraction, fraction)

    def take(on: Flags) -> None:
        nonlocal left
        place = np.linalg.lstsq(basis[on], offset_px[on], rcond=None)[0]
        left = left & (np.abs(offset_px - basis @ place) > LINES_APART_PX)
        out.append(on)

    if len(np.unique(sample[agree])) >= FEWEST_POINTS:
        take(agree)
    least = max(FEWEST_POINTS, 0.5 * search_lines)
    while len(out) < MOST_LINES and len(np.unique(sample[left])) >= least:
        among = np.flatnonzero(left)
        hit = np.abs(offset_px[among, None] - basis[among] @ PLACES_PX.T) < WITHIN_PX
        first = np.concatenate([[0], np.flatnonzero(np.diff(sample[among])) + 1])
        votes = np.logical_or.reduceat(hit, first, axis=0).sum(axis=0)
        place = PLACES_PX[int(np.argmax(votes))]
        if votes.max() < least:
            break
        for _ in range(2):
            on = left & (np.abs(offset_px - basis @ place) < WITHIN_PX)
            if np.ptp(fraction[on]) == 0.0:
                return out
            place = np.linalg.lstsq(basis[on], offset_px[on], rcond=None)[0]
        if len(np.unique(sample[on])) < FEWEST_POINTS:
            break
        take(on)
    return out


def _basis(fraction: Array, along: Array) -> Array:
    """(n, 2): one, and the way along an edge, -1 to 1 from the first to the last of ``along`` (s,)."""
    middle, half = 0.5 * (along.min() + along.max()), 0.5 * (along.max() - along.min())
    return np.column_stack([np.ones(len(fraction)), (fraction - middle) / max(half, 1e-9)])


def _line(basis: Array, weight: Array) -> Array:
    """(2, n): from values along an edge to their offset at its middle and slope times half its length, weighted."""
    weighted = basis.T * weight
    return np.asarray(np.linalg.solve(weighted @ basis, weighted))
