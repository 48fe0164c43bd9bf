"""Step 5 of the corner measurement: a line for each edge through its inlier edgels, corners where adjacent lines meet.

Lines live in ideal coordinates, where a straight edge is straight: the offset ``e`` of a point from its predicted
line is fitted by ``e = a + b * along``.  Corners come with a 2x2 covariance each, and a reason when they are refused.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.compiled import compiled
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, CornerFault
from gripmon.track.edges.prediction import FEWEST_SAMPLES, Prediction
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import RobustFit
from gripmon.track.edges.settings import CornerSettings

SHOWN_BESIDE = 0.5
"""Share of agreeing search lines next to a corner, over that on the rest of the edge, from which the corner is seen; on
each stretch of a turn into a curve, from which that is seen; of probes beyond an end, from which the edge goes on.
"""


class _Fault(enum.IntEnum):
    """A :class:`~gripmon.model.records.CornerFault` in machine code, by its name; 0 for none."""

    OUTSIDE = 1
    SELF_HIDDEN = 2
    FEW_POINTS = 3
    HIDDEN = 4
    PARALLEL = 5
    UNCERTAIN = 6


_FAULTS = (None, *(CornerFault[fault.name] for fault in _Fault))


@dataclass(frozen=True, slots=True)
class CornerGeometry:
    """What of the intersections doesn't depend on the image, for one prediction; p spokes, which are one edge at one
    corner each, sorted by corner.

    ``corner``, ``slot`` among the sampled edges and ``edge`` of the gripper (p,); ``way`` (p, 3): the predicted corner
    on the edge's line, and the line's direction; ``part`` (p, 4): first and last + 1 of the search lines beside the
    corner, and of all on the edge.  ``fault`` (c,): why a corner can't be measured in this view whatever the image, or
    0.
    """

    corner: NDArray[np.intp]
    slot: NDArray[np.intp]
    edge: NDArray[np.intp]
    way: Array
    part: NDArray[np.intp]
    fault: NDArray[np.intp]

    @classmethod
    def of(cls, gripper: Gripper, prediction: Prediction, settings: CornerSettings) -> CornerGeometry:
        layout, corners = prediction.layout, prediction.corners
        bounds = [*layout.first.tolist(), len(layout.edge)]
        slots = {edge: slot for slot, edge in enumerate(layout.edges.tolist())}
        places, ways, faults = [], [], []
        for i in range(len(gripper.corner_ids)):
            edges = [edge for edge in gripper.edges_at_corner(i).tolist() if edge in slots]
            for edge in edges:
                first, last = bounds[slots[edge]], bounds[slots[edge] + 1]
                direction = prediction.line_direction[edge]
                along = float((corners.xy[i] - prediction.line_origin[edge]) @ direction)
                reach_px = float(np.linalg.norm(prediction.uv_px[last - 1] - prediction.uv_px[first]))
                near = round(settings.neighbourhood_px / max(reach_px, 1.0) * (last - first - 1))
                near = min(max(near, FEWEST_SAMPLES), last - first)
                at_start = gripper.edge_points[edge, 0] == gripper.corner_points[i]
                beside = (first, first + near) if at_start else (last - near, last)
                places.append((i, slots[edge], edge, *beside, first, last))
                ways.append((along, *direction.tolist()))
            faults.append(_fault_of_view(bool(corners.inside[i]), bool(corners.facing[i]), len(edges)))
        place = np.array(places, dtype=np.intp).reshape(-1, 7)
        corner, slot, edge = (np.ascontiguousarray(column) for column in place.T[:3])
        part = np.ascontiguousarray(place[:, 3:])
        way = np.array(ways, dtype=float).reshape(-1, 3)
        return cls(corner, slot, edge, way, part, np.array(faults, dtype=np.intp))


def _fault_of_view(inside: bool, facing: bool, edges: int) -> int:
    if not inside:
        return _Fault.OUTSIDE
    if not facing:
        return _Fault.SELF_HIDDEN
    return _Fault.FEW_POINTS if edges < 2 else 0


class Corners(NamedTuple):
    """Measured corners, arrays over all corners of the gripper: ``xy`` (c, 2) ideal coordinates, ``covariance_xy``
    (c, 2, 2) of each by itself, ``uv_px`` (c, 2), ``sigma_px`` (c,) the larger axis, ``fault`` one reason or None each,
    ``usable`` (c,) where there is none; NaN where a corner was not measured.  ``lines`` (v, 5) of the sampled edges,
    see :func:`_fit_lines`; ``rests`` (p,): on which spokes of ``geometry`` its corner rests.
    """

    xy: Array
    covariance_xy: Array
    uv_px: Array
    sigma_px: Array
    fault: tuple[CornerFault | None, ...]
    usable: NDArray[np.bool_]
    lines: Array
    rests: NDArray[np.bool_]
    geometry: CornerGeometry

    def joint_covariance_xy(self, taken: NDArray[np.bool_]) -> Array:
        """(2k, 2k) covariance of the k usable corners ``taken`` (c,) together: x and y of the first, then of the next.

        Corners at the two ends of an edge err together, since one line carries both.
        """
        count, geometry = int(np.count_nonzero(taken)), self.geometry
        joint = np.zeros((count, 2, count, 2))
        on_line: dict[int, list[tuple[int, float, Array]]] = {}
        for k, corner in enumerate(np.flatnonzero(taken).tolist()):
            joint[k, :, k] = self.covariance_xy[corner]
            for spoke in np.flatnonzero(self.rests & (geometry.corner == corner)).tolist():
                slot, line, along = int(geometry.slot[spoke]), self.lines[geometry.slot[spoke]], geometry.way[spoke, 0]
                # Moved by a unit there, the line shifts the corner by its weighted normal.
                normal = np.array(_normal(line, geometry.way[spoke])) / _covariance(line, along, along)
                others = on_line.setdefault(slot, [])
                pull = self.covariance_xy[corner] @ normal
                for other, other_along, other_pull in others:
                    block = _covariance(line, along, other_along) * np.outer(pull, other_pull)
                    joint[k, :, other] += block
                    joint[other, :, k] += block.T
                others.append((k, along, pull))
        return joint.reshape(2 * count, 2 * count)


def intersect_edges(
    edgels: Edgels,
    consensus: RobustFit,
    line_weight: Array,
    geometry: CornerGeometry,
    settings: CornerSettings,
) -> Corners:
    """Corners as intersections of the lines through the inlier edgels; weighted least squares where three edges
    meet.  ``line_weight`` (k,) is what each edgel hypothesis is worth for the line of its edge, 1/px².

    A predicted corner lies on its predicted lines, so the measured line ``offset + slope * along`` asks for a shift
    of the corner with ``(right - slope * direction) . shift = offset + slope * along``.
    """
    candidates, prediction = edgels.candidates, edgels.prediction
    layout, predicted = prediction.layout, prediction.corners
    lines = _fit_lines(
        candidates.sample,
        candidates.offset_px,
        line_weight,
        prediction.gain,
        prediction.along,
        layout.edges,
        layout.first,
        edgels.edge_spread_px,
        edgels.cut_off_px,
    )
    fault, rests, xy, uv_px, covariance_xy, sigma_px = _intersect(
        lines,
        consensus.edge_seen,
        consensus.supported,
        geometry.corner,
        geometry.slot,
        geometry.edge,
        geometry.way,
        geometry.part,
        geometry.fault,
        predicted.xy,
        predicted.uv_px,
        predicted.d_uv_d_xy,
        math.sin(settings.smallest_angle_rad),
        settings.largest_sigma_px,
    )
    faults = tuple(map(_FAULTS.__getitem__, fault.tolist()))
    return Corners(xy, covariance_xy, uv_px, sigma_px, faults, fault == 0, lines, rests, geometry)


@compiled
def _fit_lines(
    sample: Any, offset_px: Any, line_weight: Any, gain: Any, along: Any, edges: Any, first: Any, edge_spread_px: Any,
    cut_off_px: Any,
) -> Any:  # fmt: skip
    """Weighted straight lines ``e = offset + slope * along`` through the agreed points of every sampled edge: offset
    and slope, variance of the offset, covariance, variance of the slope (v, 5); NaN for fewer than four points.
    """
    count = len(edges)
    lines, sums, points = np.full((count, 5), np.nan), np.zeros((count, 5)), np.zeros(count, np.intp)
    slot = 0
    for k in range(len(sample)):
        n = sample[k]
        while slot + 1 < count and n >= first[slot + 1]:
            slot += 1
        if line_weight[k] != 0.0:
            weight = line_weight[k] / (gain[n] * gain[n])
            offset = gain[n] * offset_px[k]
            points[slot] += 1
            sums[slot, 0] += weight
            sums[slot, 1] += weight * along[n]
            sums[slot, 2] += weight * along[n] * along[n]
            sums[slot, 3] += weight * offset
            sums[slot, 4] += weight * offset * along[n]
    for v in range(count):
        s0, s1, s2, t0, t1 = sums[v, 0], sums[v, 1], sums[v, 2], sums[v, 3], sums[v, 4]
        determinant = s0 * s2 - s1 * s1
        if points[v] < FEWEST_SAMPLES or not determinant > 0.0:
            continue
        # The error that an edge's points share moves the whole line.
        common = (edge_spread_px[edges[v]] ** 2 + cut_off_px[edges[v]] ** 2) * gain[first[v]] ** 2
        lines[v, 0], lines[v, 1] = (s2 * t0 - s1 * t1) / determinant, (s0 * t1 - s1 * t0) / determinant
        lines[v, 2], lines[v, 3], lines[v, 4] = s2 / determinant + common, -s1 / determinant, s0 / determinant
    return lines


@compiled
def _intersect(
    lines: Any, seen: Any, supported: Any, corner: Any, slot: Any, edge: Any, way: Any, part: Any, view_fault: Any,
    predicted_xy: Any, predicted_uv_px: Any, lens: Any, smallest_sine: float, largest_sigma_px: float,
) -> Any:  # fmt: skip
    """Fault of each corner (0: none), the spokes that carry it, xy, uv, covariance of xy, sigma; NaN with a fault."""
    corners, spokes = len(view_fault), len(corner)
    fault, rests = view_fault.copy(), np.zeros(spokes, np.bool_)
    xy, uv_px = np.full((corners, 2), np.nan), np.full((corners, 2), np.nan)
    covariance, sigma_px = np.full((corners, 2, 2), np.nan), np.full(corners, np.nan)
    begin = 0
    for c in range(corners):
        end = begin
        while end < spokes and corner[end] == c:
            rests[end] = seen[edge[end]] and lines[slot[end], 0] == lines[slot[end], 0]
            end += 1
        beside, sine, ixx, ixy, iyy, bx, by = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(begin, end):
            if not rests[p]:
                continue
            line, along = lines[slot[p]], way[p, 0]
            x, y = _normal(line, way[p])
            beside += _shows(supported, part[p])
            weight = 1.0 / _covariance(line, along, along)
            wanted = weight * (line[0] + line[1] * along)
            ixx, ixy, iyy = ixx + weight * x * x, ixy + weight * x * y, iyy + weight * y * y
            bx, by = bx + wanted * x, by + wanted * y
            for q in range(begin, p):
                if rests[q]:
                    ax, ay = _normal(lines[slot[q]], way[q])
                    sine = max(sine, abs(ax * y - ay * x) / (math.hypot(ax, ay) * math.hypot(x, y)))
        begin = end
        if fault[c] == 0 and beside < 2:
            fault[c] = _Fault.HIDDEN
        if fault[c] == 0 and sine < smallest_sine:
            fault[c] = _Fault.PARALLEL
        if fault[c] != 0:
            continue
        determinant = ixx * iyy - ixy * ixy
        cxx, cxy, cyy = iyy / determinant, -ixy / determinant, ixx / determinant
        sigma = _larger_sigma(lens[c], cxx, cxy, cyy)
        if sigma > largest_sigma_px:
            fault[c] = _Fault.UNCERTAIN
            continue
        shift_x, shift_y = cxx * bx + cxy * by, cxy * bx + cyy * by
        sigma_px[c], covariance[c, 0, 0], covariance[c, 1, 1] = sigma, cxx, cyy
        covariance[c, 0, 1], covariance[c, 1, 0] = cxy, cxy
        xy[c, 0], xy[c, 1] = predicted_xy[c, 0] + shift_x, predicted_xy[c, 1] + shift_y
        for i in range(2):
            uv_px[c, i] = predicted_uv_px[c, i] + lens[c, i, 0] * shift_x + lens[c, i, 1] * shift_y
    return fault, rests, xy, uv_px, covariance, sigma_px


@compiled
def _shows(supported: Any, part: Any) -> bool:
    """Whether an edge shows beside the corner half as well as elsewhere.  Hidden if fewer than two edges do."""
    begin, end, first, last = part[0], part[1], part[2], part[3]
    seen, elsewhere = 0, 0
    for n in range(first, last):
        if begin <= n < end:
            seen += supported[n]
        else:
            elsewhere += supported[n]
    rest = last - first - end + begin
    usual = elsewhere / rest if rest >= FEWEST_SAMPLES else 1.0
    return bool(seen >= SHOWN_BESIDE * (end - begin) * usual)


@compiled
def _normal(line: Any, way: Any) -> tuple[float, float]:
    """By how much the line's place at the corner changes for a shift of it: its normal, turned by the slope."""
    return -way[2] - line[1] * way[1], way[1] - line[1] * way[2]


@compiled
def _covariance(line: Any, along: float, other: float) -> float:
    """Of the line's places at two points of it; at one twice, the variance."""
    return float(line[2] + (along + other) * line[3] + along * other * line[4])


@compiled
def _larger_sigma(lens: Any, cxx: float, cxy: float, cyy: float) -> float:
    """Standard deviation along the larger axis of a covariance in ideal coordinates, px."""
    a, b, c, d = lens[0, 0], lens[0, 1], lens[1, 0], lens[1, 1]
    uu = a * a * cxx + 2.0 * a * b * cxy + b * b * cyy
    uv = a * c * cxx + (a * d + b * c) * cxy + b * d * cyy
    vv = c * c * cxx + 2.0 * c * d * cxy + d * d * cyy
    return math.sqrt(0.5 * (uu + vv + math.hypot(uu - vv, 2.0 * uv)))


def warm_up_joint() -> None:
    """Compile what only :meth:`Corners.joint_covariance_xy` calls from Python."""
    line = np.ones(5)
    _normal(line, np.ones(4))
    _covariance(line, 1.0, 1.0)
