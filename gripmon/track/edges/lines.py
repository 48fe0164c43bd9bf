"""Step 5 of the corner measurement: a line for each edge through the points that agreed, corners where adjacent lines
meet.

Lines live in ideal coordinates, where a straight edge is straight: the offset ``e`` of a point from its predicted
line is fitted by ``e = a + b * along``.  Corners come with a 2x2 covariance each, and a reason when they are refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, CornerFault
from gripmon.track.edges.consensus import Consensus
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import Votes


class CornerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When an intersection counts as a corner."""

    smallest_angle_rad: Annotated[
        float, Meta(ge=0.02, le=1.5, description="smallest angle between two edges that make a corner (rad)")
    ] = 0.2
    largest_sigma_px: Annotated[
        float, Meta(ge=0.01, le=10.0, description="largest standard deviation of a corner that may be used (px)")
    ] = 1.0
    neighbourhood_px: Annotated[
        float,
        Meta(
            ge=2.0,
            le=100.0,
            description="stretch of each edge next to the corner that must show half as well as its rest (px)",
        ),
    ] = 16.0


SHOWN_BESIDE = 0.5
"""Share of agreeing profiles next to a corner, over that on the rest of the edge, from which the corner is seen."""

FEWEST_BESIDE = 4
"""Profiles next to a corner that are looked at, however far apart they are."""


@dataclass(frozen=True, slots=True)
class Corners:
    """Measured corners, arrays over all corners of the gripper: ``xy`` (c, 2) ideal coordinates, ``covariance_xy``
    (c, 2, 2) of each by itself, ``uv_px`` (c, 2), ``sigma_px`` (c,) the larger axis, ``fault`` one reason or None each,
    ``usable`` (c,) where there is none; NaN where a corner was not measured.  ``sides``: for each corner the edges on
    which it rests, with their lines.
    """

    xy: Array
    covariance_xy: Array
    uv_px: Array
    sigma_px: Array
    fault: tuple[CornerFault | None, ...]
    usable: NDArray[np.bool_]
    sides: tuple[list[tuple[_Spoke, _Line]], ...]

    def joint_covariance_xy(self, taken: NDArray[np.bool_]) -> Array:
        """(2k, 2k) covariance of the k usable corners ``taken`` (c,) together: x and y of the first, then of the next.

        Corners at the two ends of an edge err together, since one line carries both.
        """
        count = int(np.count_nonzero(taken))
        joint = np.zeros((count, 2, count, 2))
        on_line: dict[int, list[tuple[int, float, Array]]] = {}
        for k, corner in enumerate(np.flatnonzero(taken).tolist()):
            joint[k, :, k] = self.covariance_xy[corner]
            for spoke, line in self.sides[corner]:
                # Moved by a unit there, the line shifts the corner by its weighted normal.
                normal = np.array(line.normal(spoke)) / line.variance(spoke.along)
                others = on_line.setdefault(spoke.slot, [])
                pull = self.covariance_xy[corner] @ normal
                for other, along, other_pull in others:
                    block = line.covariance_between(spoke.along, along) * np.outer(pull, other_pull)
                    joint[k, :, other] += block
                    joint[other, :, k] += block.T
                others.append((k, spoke.along, pull))
        return joint.reshape(2 * count, 2 * count)


class _Spoke(NamedTuple):
    """One edge at one corner, for a prediction: ``slot`` among the sampled edges, ``edge`` of the gripper, ``along``
    the predicted corner on the edge's line, ``direction`` of the line, first and last + 1 of the profiles beside the
    corner, and of all on the edge.
    """

    slot: int
    edge: int
    along: float
    direction_x: float
    direction_y: float
    begin: int
    end: int
    first: int
    last: int

    def shows(self, agreed: list[int]) -> bool:
        """Whether the edge shows beside the corner half as well as elsewhere; ``agreed`` are running counts of the
        profiles that agree.
        """
        near, rest = self.end - self.begin, self.last - self.first - self.end + self.begin
        seen = agreed[self.end] - agreed[self.begin]
        elsewhere = agreed[self.last] - agreed[self.first] - seen
        return seen >= SHOWN_BESIDE * near * (elsewhere / rest if rest >= FEWEST_BESIDE else 1.0)


@dataclass(frozen=True, slots=True)
class CornerGeometry:
    """What of the intersections doesn't depend on the image, for one prediction: for each corner its sampled edges, the
    reason why it can't be measured in this view whatever the image (or None), and the lens there, px by ideal units.

    Plain numbers, since a handful of corners is less work than the calls that arrays would take.
    """

    spokes: tuple[tuple[_Spoke, ...], ...]
    fault: tuple[CornerFault | None, ...]
    lens: tuple[tuple[float, float, float, float], ...]

    @classmethod
    def of(cls, gripper: Gripper, prediction: Prediction, settings: CornerSettings) -> CornerGeometry:
        layout, corners = prediction.layout, prediction.corners
        bounds = [*layout.first.tolist(), len(layout.edge)]
        slots = {edge: slot for slot, edge in enumerate(layout.edges.tolist())}
        spokes, faults = [], []
        for i in range(len(gripper.corner_ids)):
            at_corner = []
            for edge in gripper.edges_at_corner(i).tolist():
                if edge not in slots:
                    continue
                first, last = bounds[slots[edge]], bounds[slots[edge] + 1]
                direction = prediction.line_direction[edge]
                along = float((corners.xy[i] - prediction.line_origin[edge]) @ direction)
                x, y = direction.tolist()
                reach_px = float(np.linalg.norm(prediction.uv_px[last - 1] - prediction.uv_px[first]))
                near = round(settings.neighbourhood_px / max(reach_px, 1.0) * (last - first - 1))
                near = min(max(near, FEWEST_BESIDE), last - first)
                at_start = gripper.edge_points[edge, 0] == gripper.corner_points[i]
                beside = (first, first + near) if at_start else (last - near, last)
                at_corner.append(_Spoke(slots[edge], edge, along, x, y, *beside, first, last))
            spokes.append(tuple(at_corner))
            faults.append(_fault_of_view(bool(corners.inside[i]), bool(corners.facing[i]), len(at_corner)))
        lens = tuple((a, b, c, d) for a, b, c, d in corners.d_uv_d_xy.reshape(-1, 4).tolist())
        return cls(tuple(spokes), tuple(faults), lens)


def _fault_of_view(inside: bool, facing: bool, edges: int) -> CornerFault | None:
    if not inside:
        return CornerFault.OUTSIDE
    if not facing:
        return CornerFault.SELF_HIDDEN
    return CornerFault.FEW_POINTS if edges < 2 else None


def intersect_edges(
    votes: Votes,
    consensus: Consensus,
    line_weight: Array,
    geometry: CornerGeometry,
    settings: CornerSettings,
) -> Corners:
    """Corners as intersections of the lines through the agreed edge points; weighted least squares where three edges
    meet.  ``line_weight`` (k,) is what each candidate is worth for the line of its edge, 1/px².

    A predicted corner lies on its predicted lines, so the measured line ``offset + slope * along`` asks for a shift
    of the corner with ``(right - slope * direction) . shift = offset + slope * along``.
    """
    prediction = votes.prediction
    lines = _fit_lines(votes, line_weight)
    seen = consensus.edge_seen.tolist()
    agreed = [0, *np.cumsum(consensus.supported).tolist()]
    sides = tuple(_seen_sides(lines, seen, spokes) for spokes in geometry.spokes)
    measured = [
        fault or _intersect(rests_on, agreed, lens, settings)
        for fault, rests_on, lens in zip(geometry.fault, sides, geometry.lens, strict=True)
    ]
    faults = tuple(m if isinstance(m, CornerFault) else None for m in measured)
    numbers = np.array([_NOTHING if isinstance(m, CornerFault) else m for m in measured]).reshape(-1, 6)
    shift, sigma_px = numbers[:, :2], numbers[:, 2]
    return Corners(
        prediction.corners.xy + shift,
        numbers[:, [3, 4, 4, 5]].reshape(-1, 2, 2),
        prediction.corners.uv_px + (prediction.corners.d_uv_d_xy @ shift[..., None])[..., 0],
        sigma_px,
        faults,
        np.array([fault is None for fault in faults], dtype=bool),
        sides,
    )


_NOTHING = (math.nan,) * 6


def _seen_sides(lines: list[_Line | None], seen: list[bool], spokes: tuple[_Spoke, ...]) -> list[tuple[_Spoke, _Line]]:
    """The edges at a corner that were measured and count as seen."""
    return [(spoke, line) for spoke in spokes if (line := lines[spoke.slot]) is not None and seen[spoke.edge]]


def _intersect(
    sides: list[tuple[_Spoke, _Line]],
    agreed: list[int],
    lens: tuple[float, float, float, float],
    settings: CornerSettings,
) -> tuple[float, float, float, float, float, float] | CornerFault:
    """One corner: shift x and y from the prediction (ideal coordinates), sigma (px), variance x, covariance, variance
    y.

    ``agreed`` are running counts of the profiles that agree.  Hidden if fewer than two edges show right beside it.
    """
    beside, rows = 0, []
    ixx = ixy = iyy = bx = by = 0.0
    for spoke, line in sides:
        beside += spoke.shows(agreed)
        x, y = line.normal(spoke)
        along = spoke.along
        weight = 1.0 / line.variance(along)
        wanted = weight * (line.offset + line.slope * along)
        ixx, ixy, iyy = ixx + weight * x * x, ixy + weight * x * y, iyy + weight * y * y
        bx, by = bx + wanted * x, by + wanted * y
        rows.append((x, y))
    if beside < 2:
        return CornerFault.HIDDEN
    if _largest_sine(rows) < math.sin(settings.smallest_angle_rad):
        return CornerFault.PARALLEL
    determinant = ixx * iyy - ixy * ixy
    cxx, cxy, cyy = iyy / determinant, -ixy / determinant, ixx / determinant
    sigma_px = _larger_sigma(lens, cxx, cxy, cyy)
    if sigma_px > settings.largest_sigma_px:
        return CornerFault.UNCERTAIN
    return cxx * bx + cxy * by, cxy * bx + cyy * by, sigma_px, cxx, cxy, cyy


def _largest_sine(rows: list[tuple[float, float]]) -> float:
    """Sine of the largest angle between any two lines with these normals."""
    return max(
        abs(ax * by - ay * bx) / (math.hypot(ax, ay) * math.hypot(bx, by))
        for i, (ax, ay) in enumerate(rows)
        for bx, by in rows[i + 1 :]
    )


def _larger_sigma(lens: tuple[float, float, float, float], cxx: float, cxy: float, cyy: float) -> float:
    """Standard deviation along the larger axis of a covariance in ideal coordinates, px."""
    a, b, c, d = lens
    uu = a * a * cxx + 2.0 * a * b * cxy + b * b * cyy
    uv = a * c * cxx + (a * d + b * c) * cxy + b * d * cyy
    vv = c * c * cxx + 2.0 * c * d * cxy + d * d * cyy
    return math.sqrt(0.5 * (uu + vv + math.hypot(uu - vv, 2.0 * uv)))


class _Line(NamedTuple):
    """``e = offset + slope * along`` with the variance of both and their covariance."""

    offset: float
    slope: float
    var_offset: float
    covariance: float
    var_slope: float

    def normal(self, spoke: _Spoke) -> tuple[float, float]:
        """By how much the line's place there changes for a shift of the corner: its normal, turned by the slope."""
        x, y = spoke.direction_x, spoke.direction_y
        return -y - self.slope * x, x - self.slope * y

    def variance(self, along: float) -> float:
        """Of the line's place at a point of it."""
        return self.var_offset + along * (2.0 * self.covariance + along * self.var_slope)

    def covariance_between(self, along: float, other: float) -> float:
        """Of its places at two points."""
        return self.var_offset + (along + other) * self.covariance + along * other * self.var_slope


def _fit_lines(votes: Votes, line_weight: Array) -> list[_Line | None]:
    """Weighted straight lines through the agreed points of every sampled edge; None for fewer than four points."""
    candidates, prediction = votes.candidates, votes.prediction
    layout = prediction.layout
    first = layout.first
    inlier = np.flatnonzero(line_weight)
    sample = candidates.sample[inlier]
    gain = prediction.gain[sample]
    along = prediction.along[sample]
    terms = np.zeros((5, len(inlier) + 1))
    weight, weighted_along, weighted_square, weighted_offset, weighted_both = terms[:, 1:]
    np.divide(line_weight[inlier], gain * gain, out=weight)
    np.multiply(weight, along, out=weighted_along)
    np.multiply(weighted_along, along, out=weighted_square)
    np.multiply(weight, gain * candidates.offset_px[inlier], out=weighted_offset)
    np.multiply(weighted_offset, along, out=weighted_both)
    # Points come sorted by edge: sums over edges are differences of running sums.
    bounds = np.append(np.searchsorted(sample, first), len(inlier))
    sums = np.cumsum(terms, axis=1)[:, bounds]
    # What an edge's points share moves the whole line.
    spread_px = np.hypot(votes.edge_spread_px, votes.cut_off_px)[layout.edges]
    shared = (spread_px * prediction.gain[first]) ** 2
    lines: list[_Line | None] = []
    for count, common, s0, s1, s2, t0, t1 in zip(
        np.diff(bounds).tolist(), shared.tolist(), *np.diff(sums, axis=1).tolist(), strict=True
    ):
        determinant = s0 * s2 - s1 * s1
        if count < 4 or not determinant > 0.0:
            lines.append(None)
            continue
        k = 1.0 / determinant
        lines.append(_Line((s2 * t0 - s1 * t1) * k, (s0 * t1 - s1 * t0) * k, s2 * k + common, -s1 * k, s0 * k))
    return lines
