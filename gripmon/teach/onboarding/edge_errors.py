"""How far the lines of an outline may be off: by what their points themselves show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.model.records import Array
from gripmon.teach.edges.lines import EdgePoints, Line
from gripmon.track.edges.consensus import ConsensusSettings
from gripmon.track.edges.prediction import STRETCH

_FEWEST_FREE = 3.0
_LEAST_PX = 0.01
"""Standard deviation of a point: no image gives it better than that."""


@dataclass(frozen=True, slots=True)
class SeenEdge:
    """A line with the ``points`` (k,) it was chosen from, their edges' ``width_px`` (k,), and what they know of the
    line (k,), on average 1; None: all the same.
    """

    line: Line
    points: EdgePoints
    width_px: Array
    worth: Array | None = None

    def design(self) -> tuple[Array, Array]:
        """Rows (m, 2) and values (m,) of the weighted least squares whose solution is the line."""
        inlier = self.line.inlier
        way = self.points.way[inlier]
        root = np.ones(len(way)) if self.worth is None else np.sqrt(self.worth[inlier])
        return np.column_stack([1.0 - way, way]) * root[:, None], self.points.offset_px[inlier] * root


def line_covariances(seen: Sequence[SeenEdge]) -> list[Array]:
    """(2, 2) of each line's offsets at both ends, px.

    Neighbouring points err together where there is texture, independently where there is only noise.  Which it is, the
    residuals' sums over stretches of an edge tell: divided by the root of their counts they have the variance v of a
    point if all are independent, and up to :data:`STRETCH` times that if those of a stretch are one.  Either way the
    line's covariance is ``v (A' A)^-1``, A being its design (Huber, "Robust statistics", 1981, section 6.3, for groups
    that err together).  v comes from all edges together, as one alone has few stretches, or from the edge itself where
    that shows more.

    On top comes what all points of an edge share, which no residual shows.
    """
    squares, freedom = np.array([_stretches(edge) for edge in seen]).T
    free = float(freedom.sum())
    # Known from few stretches itself: Student's distribution has this variance.
    student = free / (free - 2.0) if free >= _FEWEST_FREE else _FEWEST_FREE
    usual_px2 = student * float(squares.sum()) / max(free, 1.0)
    floor_px = ConsensusSettings().edge_floor_px
    out = []
    for edge, own, count in zip(seen, squares, freedom, strict=True):
        design = edge.design()[0]
        variance_px2 = max(usual_px2, own / max(count, 1.0), _LEAST_PX**2)
        shared_px = floor_px * max(float(np.median(edge.width_px[edge.line.inlier])), 1.0)
        out.append(variance_px2 * np.linalg.inv(design.T @ design) + shared_px**2)
    return out


def _stretches(edge: SeenEdge) -> tuple[float, float]:
    """Sum of squares of the stretches' residuals, and what it would be for independent points of unit variance."""
    inlier = edge.line.inlier
    design, values = edge.design()
    residual = values - design @ edge.line.ends_px
    member = edge.points.profile[inlier] // STRETCH
    stretch = (member[:, None] == np.unique(member)).astype(np.float64)
    stretch /= np.sqrt(stretch.sum(axis=0))
    # The line's two unknowns take their part: tr(S' (I - P) S).
    basis = np.linalg.qr(design)[0]
    return float(np.square(stretch.T @ residual).sum()), float(stretch.shape[1] - np.square(basis.T @ stretch).sum())
