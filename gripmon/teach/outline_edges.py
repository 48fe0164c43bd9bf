"""Sub-pixel corners of a rough outline: a straight line for each of its edges, the intersections of adjacent lines, and
their covariance from the edge points.

Unlike :mod:`gripmon.teach.snapping`, which poses a known gripper, this knows no gripper.  Lines are straight in ideal
coordinates; search lines are placed along the edge as the lens bends it.  Each edge is searched for separately, as the
rough ends may be off by several pixels each in any direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.plane import FingerCorners
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import Camera
from gripmon.model.records import Array, Image
from gripmon.teach.lines import EdgePoints, Line, settle_line
from gripmon.teach.outlines import Outline
from gripmon.track.edges.kernel import FEWEST_FREE
from gripmon.track.edges.prediction import ROWS, STRETCH
from gripmon.track.edges.profiles import (
    estimate_noise,
    find_candidates,
    full_scale,
    profile_offsets_px,
    quantum,
    read_profiles,
)
from gripmon.track.edges.settings import EdgeSettings, RobustFitSettings

REACH_PX = 10.0
"""Search distance from the rough ends of an edge."""
LARGEST_REACH_SHARE = 0.25
"""Largest search distance over the edge's length: farther away it is more likely another edge."""
FINAL_REACH_PX = 5.0
END_MARGIN_PX = 4.0
SEEN_SHARE = 0.4
"""Least part of its search lines that must show an edge."""
SMALLEST_ANGLE_RAD = 0.06
SHORTEST_PX = 12.0
_GRID_PX = 0.5
_START_PX = 1.0
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class FoundOutline:
    """``points`` (p, 2) of the outline on its measured edges, px; ``covariance_px2`` (2c, 2c) of its c corners, u and v
    of the first, then of the next; ``seen`` (e,) part of each edge that shows it, ``rms_px`` (e,) of its points.
    """

    points: Array
    covariance_px2: Array
    seen: Array
    rms_px: Array


@dataclass(frozen=True, slots=True)
class _Base:
    """An edge between two rough ends as the lens shows it: ``uv_px`` (n, 2) and ``normal`` (n, 2), to the right when
    going from the first end; ``way`` (n,) from 0 to 1 between the ends of the sampled part.
    """

    uv_px: Array
    normal: Array
    way: Array


def find_outline(camera: Camera, image: Image, outline: Outline) -> FoundOutline:
    """The outline on the edges that the image shows.  Raises :class:`CalibrationError` with the name of the corner or
    edge that is outside of the image, not seen, or not a corner.
    """
    points = outline.points
    _check_inside(camera, outline)
    for turn in range(_ROUNDS):
        seen, bases = [], []
        for a, b in outline.edges:
            names = f"{outline.names[a]} to {outline.names[b]}"
            base, reach_px = _lay(camera, points[a], points[b], REACH_PX if turn == 0 else FINAL_REACH_PX, names)
            seen.append(_line(camera, image, base, reach_px, names, anywhere=turn == 0))
            bases.append(base)
        found = _meet(camera, outline, points, bases, [edge.line.ends_px for edge in seen])
        moved_px = float(np.linalg.norm(found - points, axis=1).max())
        points = found
        if turn and moved_px < 0.05:
            break
    covariance = _covariance(camera, outline, points, bases, seen)
    lines = [edge.line for edge in seen]
    return FoundOutline(points, covariance, np.array([n.seen for n in lines]), np.array([n.rms_px for n in lines]))


def _check_inside(camera: Camera, outline: Outline) -> None:
    for name, (u, v) in zip(outline.names, outline.points.tolist(), strict=True):
        if not (0.0 <= u <= camera.width_px - 1 and 0.0 <= v <= camera.height_px - 1):
            raise CalibrationError(
                f"corners.{name}: ({u:g}, {v:g}) lies outside of the image; u 0 to {camera.width_px - 1} and v 0 to "
                f"{camera.height_px - 1} px (of an edge that runs out of the image, a point inside)"
            )


def _lay(camera: Camera, start: Array, end: Array, reach_px: float, names: str) -> tuple[_Base, float]:
    """Sample points one pixel apart, leaving out a margin at both ends; and the search distance for this length."""
    length_px = float(np.linalg.norm(end - start))
    if not length_px >= SHORTEST_PX:
        raise CalibrationError(f"{names}: {length_px:.0f} px apart; at least {SHORTEST_PX:g} px, two different corners")
    reach_px = max(min(reach_px, LARGEST_REACH_SHARE * length_px), 4.0)
    xy = camera.undistort(np.stack([start, end]))
    if not np.isfinite(xy).all():
        raise CalibrationError(f"{names}: beyond what the lens maps; corners in the image")
    margin = min(END_MARGIN_PX, 0.2 * length_px) / length_px
    fraction = np.linspace(margin, 1.0 - margin, max(int(length_px * (1.0 - 2.0 * margin)), 8))
    uv_px = camera.distort(xy[0] + fraction[:, None] * (xy[1] - xy[0]))
    tangent = np.gradient(uv_px, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return _Base(uv_px, normal, np.linspace(0.0, 1.0, len(fraction))), reach_px


def _line(camera: Camera, image: Image, base: _Base, reach_px: float, names: str, *, anywhere: bool) -> SeenEdge:
    offsets = profile_offsets_px(reach_px + 3.0)
    row = np.arange(-(ROWS // 2), ROWS // 2 + 1)[:, None, None]
    along = np.column_stack([base.normal[:, 1], -base.normal[:, 0]])
    maps = [
        (base.uv_px[:, k, None] + base.normal[:, k, None] * offsets + row * along[:, k, None]).astype(np.float32)
        for k in (0, 1)
    ]
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    ok = np.all((base.uv_px >= 1.0) & (base.uv_px <= last_px - 1.0), axis=1)
    profiles = read_profiles(image, maps[0], maps[1])
    noise = estimate_noise(profiles, quantum(image))
    found = find_candidates(profiles, ok, noise, full_scale(image), EdgeSettings())
    near = np.abs(found.offset_px) <= reach_px + 1.0
    sample = found.sample[near]
    points = EdgePoints(
        base.way[sample],
        found.offset_px[near],
        found.step[near],
        sample,
        np.zeros(len(sample), np.intp),
        np.array([int(ok.sum())]),
    )
    worth = np.sqrt(np.abs(points.step))
    start = _start(points, worth, reach_px) if anywhere and len(sample) else np.zeros(2)
    line = settle_line(points, start) if len(sample) else None
    if line is None or line.seen < SEEN_SHARE:
        seen = 0.0 if line is None else 100.0 * line.seen
        raise CalibrationError(
            f"{names}: its edge is visible along {seen:.0f} % of it within {reach_px:.0f} px; at least "
            f"{100.0 * SEEN_SHARE:.0f} %: corners nearer to the real ones, an image in focus"
        )
    return SeenEdge(line, points, np.asarray(found.width_px[near]))


def _start(points: EdgePoints, worth: Array, reach_px: float) -> Array:
    """The line (2,), its offsets at both ends, that most points support, weighted by ``worth`` (k,); of similar ones
    the closest to the rough line.
    """
    steps = np.arange(-reach_px, reach_px + 0.5 * _GRID_PX, _GRID_PX)
    ends = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    support = np.zeros(len(ends))
    for k in range(0, len(ends), 256):
        part = ends[k : k + 256]
        lines = part[:, :1] * (1.0 - points.way) + part[:, 1:] * points.way
        nearness = np.maximum(1.0 - np.square((points.offset_px - lines) / _START_PX), 0.0)
        support[k : k + 256] = nearness @ worth
    away = np.square(ends).mean(axis=1) / reach_px**2
    best: Array = ends[int((support * (1.0 - 0.3 * away)).argmax())]
    return best


def _meet(camera: Camera, outline: Outline, points: Array, bases: list[_Base], ends_px: list[Array]) -> Array:
    """The outline's points moved to the intersections of their edges' lines; the end of a single edge to its foot on
    the line.
    """
    lines = [_ideal_line(camera, base, ends) for base, ends in zip(bases, ends_px, strict=True)]
    out = points.copy()
    for k, name in enumerate(outline.names):
        own = [lines[e] for e, edge in enumerate(outline.edges) if k in edge]
        if len(own) == 1:
            xy = camera.undistort(points[k : k + 1])[0]
            normal, distance = own[0]
            out[k] = camera.distort((xy - (normal @ xy - distance) * normal)[None])[0]
            continue
        normals = np.stack([normal for normal, _ in own])
        turned = abs(float(normals[0, 0] * normals[1, 1] - normals[0, 1] * normals[1, 0]))
        if turned < np.sin(SMALLEST_ANGLE_RAD):
            raise CalibrationError(f"corners.{name}: its two edges are nearly parallel; a corner where edges meet")
        out[k] = camera.distort(np.linalg.solve(normals, np.array([d for _, d in own]))[None])[0]
    return out


def _ideal_line(camera: Camera, base: _Base, ends_px: Array) -> tuple[Array, float]:
    """Unit normal (2,) and distance from the origin, in ideal coordinates."""
    where = base.uv_px[[0, -1]] + ends_px[:, None] * base.normal[[0, -1]]
    first, last = camera.undistort(where)
    along = (last - first) / np.linalg.norm(last - first)
    normal = np.array([-along[1], along[0]])
    return normal, float(normal @ first)


def _covariance(camera: Camera, outline: Outline, points: Array, bases: list[_Base], seen: list[SeenEdge]) -> Array:
    """Covariance (2c, 2c) of the corners, from those of their lines."""
    corners = list(outline.corners)
    out = np.zeros((2 * len(corners), 2 * len(corners)))
    ends_px = [edge.line.ends_px for edge in seen]
    for e, covariance in enumerate(line_covariances(seen)):
        for column in np.linalg.cholesky(covariance).T:
            shifted = [
                _meet(
                    camera, outline, points, bases, [x + (s * column if k == e else 0.0) for k, x in enumerate(ends_px)]
                )
                for s in (0.5, -0.5)
            ]
            slope = (shifted[0] - shifted[1])[corners].ravel()
            out += np.outer(slope, slope)
    return out


_LEAST_PX = 0.01
"""Least standard deviation of a point: no image gives it better."""


@dataclass(frozen=True, slots=True)
class SeenEdge:
    """A line with the ``points`` (k,) it was chosen from, and their edges' ``width_px`` (k,)."""

    line: Line
    points: EdgePoints
    width_px: Array

    def design(self) -> tuple[Array, Array]:
        """Rows (m, 2) and values (m,) of the least squares whose solution is the line."""
        inlier = self.line.inlier
        way = self.points.way[inlier]
        return np.column_stack([1.0 - way, way]), self.points.offset_px[inlier]


def line_covariances(seen: Sequence[SeenEdge]) -> list[Array]:
    """Covariance (2, 2) of each line's offsets at both ends, px.

    Errors of neighbouring points are correlated where there is texture, independent where there is only noise.  Sums of
    the residuals over stretches of an edge show which: divided by the square root of their counts, they have the
    variance v of a point if all points are independent, and up to :data:`STRETCH` times that if a stretch is fully
    correlated.  In both cases the line's covariance is ``v (A' A)^-1`` with its design A (Huber, "Robust statistics",
    1981, section 6.3, for correlated groups).  v is taken from all edges together, as a single edge has few stretches,
    or from the edge itself if that is larger.

    The error that all points of an edge share, which residuals don't show, is added.
    """
    squares, freedom = np.array([_stretches(edge) for edge in seen]).T
    free = float(freedom.sum())
    # v is known from few stretches only: Student's distribution has this variance.
    student = free / (free - 2.0) if free >= FEWEST_FREE else FEWEST_FREE
    usual_px2 = student * float(squares.sum()) / max(free, 1.0)
    floor_px = RobustFitSettings().edge_floor_px
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
    # The line's two unknowns reduce it: tr(S' (I - P) S).
    basis = np.linalg.qr(design)[0]
    return float(np.square(stretch.T @ residual).sum()), float(stretch.shape[1] - np.square(basis.T @ stretch).sum())


def measure_outlines(camera: Camera, image: Image, outline: Outline) -> tuple[FingerCorners, FoundOutline]:
    """Corners of an unknown gripper's fingertips, from their rough outlines; errors as in :func:`find_outline`."""
    snapped = find_outline(camera, image, outline)
    corners = list(outline.corners)
    names = tuple(outline.names[k] for k in corners)
    return FingerCorners(names, snapped.points[corners], snapped.covariance_px2), snapped
