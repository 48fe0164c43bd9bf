"""Sub-pixel corners of a rough outline: a straight line for each of its edges, the intersections of adjacent lines, and
their covariance from the edge points.

Unlike :mod:`gripmon.teach.snapping`, which poses a known gripper, this knows no gripper.  Lines are straight in ideal
coordinates; search lines are placed along the edge as the lens bends it.  Each edge is searched for separately, as the
rough ends may be off by several pixels each in any direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gripmon.calibrate.plane import FingerCorners
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import Camera
from gripmon.model.records import Array, Image
from gripmon.teach.lines import EdgePoints, Line, settle_line, support_of
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
_ROUNDS = 3


class SeenEdge(NamedTuple):
    """An edge between two rough ends: its ``line`` beside ``uv_px`` (n, 2), where it was looked for along ``normal``
    (n, 2), to the right when going from the first end; the ``points`` (k,) it was chosen from, and the median
    ``width_px`` of those on it.
    """

    line: Line
    points: EdgePoints
    uv_px: Array
    normal: Array
    width_px: float

    def at_px(self, offsets_px: Array) -> Array:
        """The places (2, 2) at these offsets (2,) from both ends of the part that was looked at."""
        return np.asarray(self.uv_px[[0, -1]] + offsets_px[:, None] * self.normal[[0, -1]])


def measure_outlines(camera: Camera, image: Image, outline: Outline) -> tuple[FingerCorners, Array]:
    """Corners of an unknown gripper's fingertips, from their rough outlines, and all of the outline's points (p, 2) on
    the edges that the image shows, px.  Raises :class:`CalibrationError` with the name of the corner or edge that is
    outside of the image, not seen, or not a corner.
    """
    points = outline.points
    _check_inside(camera, outline)
    for turn in range(_ROUNDS):
        seen = []
        for a, b in outline.edges:
            names = f"{outline.names[a]} to {outline.names[b]}"
            seen.append(_edge(camera, image, points[[a, b]], names, anywhere=turn == 0))
        found = _meet(camera, outline, points, [edge.at_px(edge.line.ends_px) for edge in seen])
        moved_px = float(np.linalg.norm(found - points, axis=1).max())
        points = found
        if turn and moved_px < 0.05:
            break
    corners = list(outline.corners)
    names_of = tuple(outline.names[k] for k in corners)
    return FingerCorners(names_of, points[corners], _covariance(camera, outline, points, seen)), points


def _check_inside(camera: Camera, outline: Outline) -> None:
    for name, (u, v) in zip(outline.names, outline.points.tolist(), strict=True):
        if not (0.0 <= u <= camera.width_px - 1 and 0.0 <= v <= camera.height_px - 1):
            raise CalibrationError(
                f"corners.{name}: ({u:g}, {v:g}) lies outside of the image; u 0 to {camera.width_px - 1} and v 0 to "
                f"{camera.height_px - 1} px (of an edge that runs out of the image, a point inside)"
            )


def _edge(camera: Camera, image: Image, ends_px: Array, names: str, *, anywhere: bool) -> SeenEdge:
    length_px = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    if not length_px >= SHORTEST_PX:
        raise CalibrationError(f"{names}: {length_px:.0f} px apart; at least {SHORTEST_PX:g} px, two different corners")
    if not np.isfinite(camera.undistort(ends_px)).all():
        raise CalibrationError(f"{names}: beyond what the lens maps; corners in the image")
    reach_px = max(min(REACH_PX if anywhere else FINAL_REACH_PX, LARGEST_REACH_SHARE * length_px), 4.0)
    found = edge_between(camera, image, ends_px, reach_px, END_MARGIN_PX, anywhere=anywhere)
    if found is None or found.line.seen < SEEN_SHARE:
        shown = 0.0 if found is None else 100.0 * found.line.seen
        raise CalibrationError(
            f"{names}: its edge is visible along {shown:.0f} % of it within {reach_px:.0f} px; at least "
            f"{100.0 * SEEN_SHARE:.0f} %: corners nearer to the real ones, an image in focus"
        )
    return found


def edge_between(
    camera: Camera, image: Image, ends_px: Array, reach_px: float, margin_px: float, *, anywhere: bool = False
) -> SeenEdge | None:
    """The edge between two rough ends (2, 2) on search lines of this reach, one pixel apart, leaving out a margin at
    both ends; ``anywhere``: in any direction within the reach, else near the ends.  None where none is seen.
    """
    length_px = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    margin = min(margin_px, 0.2 * length_px) / length_px
    fraction = np.linspace(margin, 1.0 - margin, max(int(length_px * (1.0 - 2.0 * margin)), 8))
    start, end = camera.undistort(ends_px)
    uv_px = camera.distort(start + fraction[:, None] * (end - start))
    along = np.gradient(uv_px, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    offsets = profile_offsets_px(reach_px + 3.0)
    row = np.arange(-(ROWS // 2), ROWS // 2 + 1)[:, None, None]
    maps = [(uv_px[:, k, None] + normal[:, k, None] * offsets + row * along[:, k, None]) for k in (0, 1)]
    last_px = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    ok = np.all((uv_px >= 1.0) & (uv_px <= last_px - 1.0), axis=1)
    profiles = read_profiles(image, *(one.astype(np.float32) for one in maps))
    noise = estimate_noise(profiles, quantum(image))
    found = find_candidates(profiles, ok, noise, full_scale(image), EdgeSettings())
    near = np.abs(found.offset_px) <= reach_px + 1.0
    sample = found.sample[near]
    way, of_one = np.linspace(0.0, 1.0, len(fraction)), np.zeros(len(sample), np.intp)
    points = EdgePoints(way[sample], found.offset_px[near], found.step[near], sample, of_one, np.array([int(ok.sum())]))
    line = settle_line(points, _start(points, reach_px) if anywhere and len(sample) else np.zeros(2))
    if line is None:
        return None
    return SeenEdge(line, points, uv_px, normal, float(np.median(found.width_px[near][line.inlier])))


def _start(points: EdgePoints, reach_px: float) -> Array:
    """The line (2,), its offsets at both ends, that most points support, those of a high step more; of similar ones
    the closest to the rough line.
    """
    steps = np.arange(-reach_px, reach_px + 0.5 * _GRID_PX, _GRID_PX)
    ends = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    support = support_of(points, ends, np.sqrt(np.abs(points.step)))
    away = np.square(ends).mean(axis=1) / reach_px**2
    best: Array = ends[int((support * (1.0 - 0.3 * away)).argmax())]
    return best


def _meet(camera: Camera, outline: Outline, points: Array, edges_px: Sequence[Array]) -> Array:
    """The outline's points moved to the intersections of their edges' lines, each through two places (2, 2); the end
    of a single edge to its foot on the line.
    """
    lines = [_ideal_line(camera, edge_px) for edge_px in edges_px]
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


def _ideal_line(camera: Camera, edge_px: Array) -> tuple[Array, float]:
    """Unit normal (2,) and distance from the origin, in ideal coordinates."""
    first, last = camera.undistort(edge_px)
    along = (last - first) / np.linalg.norm(last - first)
    normal = np.array([-along[1], along[0]])
    return normal, float(normal @ first)


def _covariance(camera: Camera, outline: Outline, points: Array, seen: Sequence[SeenEdge]) -> Array:
    """Covariance (2c, 2c) of the corners, from those of their lines."""
    corners = list(outline.corners)
    out = np.zeros((2 * len(corners), 2 * len(corners)))
    for e, covariance in enumerate(line_covariances(seen)):
        for column in np.linalg.cholesky(covariance).T:
            shifted = []
            for s in (0.5, -0.5):
                offsets = [n.line.ends_px + (s * column if k == e else 0.0) for k, n in enumerate(seen)]
                places = [n.at_px(own) for n, own in zip(seen, offsets, strict=True)]
                shifted.append(_meet(camera, outline, points, places))
            slope = (shifted[0] - shifted[1])[corners].ravel()
            out += np.outer(slope, slope)
    return out


_LEAST_PX = 0.01
"""Least standard deviation of a point: no image gives it better."""


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
    designs, squares, freedom = zip(*map(_stretches, seen), strict=True)
    free = float(sum(freedom))
    # v is known from few stretches only: Student's distribution has this variance.
    student = free / (free - 2.0) if free >= FEWEST_FREE else FEWEST_FREE
    usual_px2 = student * float(sum(squares)) / max(free, 1.0)
    floor_px = RobustFitSettings().edge_floor_px
    out = []
    for edge, design, own, count in zip(seen, designs, squares, freedom, strict=True):
        variance_px2 = max(usual_px2, own / max(count, 1.0), _LEAST_PX**2)
        out.append(variance_px2 * np.linalg.inv(design.T @ design) + (floor_px * max(edge.width_px, 1.0)) ** 2)
    return out


def _stretches(edge: SeenEdge) -> tuple[Array, float, float]:
    """The design (m, 2) of an edge's line, the sum of squares of its stretches' residuals, and what that would be for
    independent points of unit variance.
    """
    inlier = edge.line.inlier
    way = edge.points.way[inlier]
    design = np.column_stack([1.0 - way, way])
    residual = edge.points.offset_px[inlier] - design @ edge.line.ends_px
    member = edge.points.profile[inlier] // STRETCH
    stretch = (member[:, None] == np.unique(member)).astype(np.float64)
    stretch /= np.sqrt(stretch.sum(axis=0))
    # The line's two unknowns reduce it: tr(S' (I - P) S).
    basis = np.linalg.qr(design)[0]
    free = float(stretch.shape[1] - np.square(basis.T @ stretch).sum())
    return design, float(np.square(stretch.T @ residual).sum()), free
