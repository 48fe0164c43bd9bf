"""Steps 1 and 2 of the corner measurement: where the edges should be, and where to sample the image around them.

All quantities are taken at one linearisation pose and stay as they are until the prediction has moved by more than a
fraction of a pixel: in a standing scene they are computed once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.compiled import compiled
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.edges import prediction_kernel
from gripmon.track.edges.kernel import FEWEST_AGREEING
from gripmon.track.edges.settings import SamplingSettings
from gripmon.track.edges.taught import TaughtEdges

STRETCH = 16
"""Neighbouring search lines of an edge that form a stretch, with a common error."""

STEP_PX = 0.5
"""Distance of samples along a search line, px."""

ROWS = 3
"""Neighbouring rows of pixels along an edge that make one search line."""

FEWEST_SAMPLES = 4
"""With fewer search lines, an edge has no line of its own, a stretch of one is not seen, a corner has nothing beside
it.
"""

BORDER_PX = 2.0
"""What is closer than this to the image's border counts as outside: a search line reads the rows beside it, too."""

PLACES = 65
"""Places of an edge, evenly spaced, at which it is checked whether it lies in the image."""


@dataclass(frozen=True)
class EdgeLayout:
    """Which part of which edge is sampled how densely; holds while the view changes by some pixels only.

    ``edge`` (n,) ascending edge indices, ``fraction`` (n,) position between the edge's two ends, ``first`` (v,) index
    of each visible edge's first sample and ``edges`` (v,) the visible edges themselves.  ``as_taught`` (e,): the edge
    shows as it was taught.
    """

    edge: NDArray[np.intp]
    fraction: Array
    edges: NDArray[np.intp]
    first: NDArray[np.intp]
    visible: NDArray[np.bool_]
    as_taught: NDArray[np.bool_]

    @cached_property
    def stretch(self) -> NDArray[np.intp]:
        """(n,) number of the stretch that a search line belongs to: some :data:`STRETCH` neighbours on one edge."""
        starts = np.zeros(len(self.edge), dtype=np.intp)
        starts[self.first[1:]] = 1
        return np.arange(len(self.edge)) // STRETCH + np.cumsum(starts)

    def only(self, kept: NDArray[np.bool_]) -> EdgeLayout:
        """The samples ``kept`` (n,), without edges of which too few of them are left."""
        counts = np.bincount(self.edge[kept], minlength=len(self.visible))
        kept = kept & (counts[self.edge] >= FEWEST_SAMPLES)
        edges, first = np.unique(self.edge[kept], return_index=True)
        return replace(self, edge=self.edge[kept], fraction=self.fraction[kept], edges=edges, first=first)


@dataclass(frozen=True, slots=True)
class PredictedCorners:
    """The predicted corners, arrays over all corners of the gripper.

    ``cam_m`` (c, 3) in the camera frame, ``jaw_rate`` (c, 3) their motion by the jaw opening, m/m; ``xy`` (c, 2)
    ideal and ``uv_px`` (c, 2) distorted image coordinates, ``d_uv_d_xy`` (c, 2, 2) px between the two; ``facing``
    (c,) a face of the corner looks at the camera, ``inside`` (c,) it lies in the image.
    """

    cam_m: Array
    jaw_rate: Array
    xy: Array
    uv_px: Array
    d_uv_d_xy: Array
    facing: NDArray[np.bool_]
    inside: NDArray[np.bool_]

    @property
    def visible(self) -> NDArray[np.bool_]:
        return self.facing & self.inside


@dataclass(frozen=True)
class Prediction:
    """The predicted edges at one pose; n samples, v visible edges, c corners.  All numbers of samples are finite.

    ``uv_px`` (n, 2) and ``normal`` (n, 2) in the distorted image; the normal points to the right of someone walking
    along the edge. ``jacobian`` (n, 6 or 7): px of motion along the normal by ``xi = (rho, omega)`` of the transform
    and, where the jaw opening is an unknown too, by the opening (px/m).  In ideal coordinates: ``xy`` (n, 2) the
    places, ``way_xy`` (n, 2) the edge's direction there, ``along`` (n,) the place along the edge's line, ``gain`` (n,)
    the distance from the edge for each px of offset along the normal. ``line_origin``, ``line_direction`` (e, 2): the
    edges' lines in ideal coordinates.  ``ok`` (n,): the search line lies in the image.  ``map_x``, ``map_y`` (r, n, s):
    where r neighbouring rows of each search line are read.

    With a taught model ``uv_px`` lies where the edge was taught to show, everything else is the sharp model's: what is
    measured from there is the model's own motion.  ``edge_spread_m`` (e,): standard deviation of what a bevel moves an
    edge by, or of what teaching left of that.  ``independence`` (e,): part of an edge's search lines that see pixels of
    their own, see :func:`independent_part`.
    """

    cam_T_grip: Array
    jaw_opening_m: float
    layout: EdgeLayout
    uv_px: Array
    normal: Array
    jacobian: Array
    xy: Array
    way_xy: Array
    along: Array
    gain: Array
    line_origin: Array
    line_direction: Array
    ok: NDArray[np.bool_]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    corners: PredictedCorners
    edge_spread_m: Array
    independence: Array

    @cached_property
    def pixels_per_m(self) -> float:
        """Scale of the image at the gripper: median over the edge points, across their edges (px/m); 0 without any."""
        if not len(self.uv_px):
            return 0.0
        square = np.einsum("ni,ni->n", self.jacobian[:, :3], self.jacobian[:, :3])
        below, above = (len(square) - 1) // 2, len(square) // 2
        middle = np.sqrt(np.partition(square, (below, above))[[below, above]])
        return 0.5 * float(middle[0] + middle[1])

    @cached_property
    def bevel_px(self) -> Array:
        """(e,) ``edge_spread_m`` at the gripper's scale, px."""
        return self.edge_spread_m * self.pixels_per_m

    @cached_property
    def jacobian_by_unknown(self) -> Array:
        """(6 or 7, n): the Jacobian by rows, for fits."""
        return np.ascontiguousarray(self.jacobian.T)

    @cached_property
    def profiles(self) -> NDArray[np.intp]:
        """(e,) search lines inside the image, for every edge of the gripper."""
        return np.bincount(self.layout.edge[self.ok], minlength=len(self.line_origin))

    def moved_px(self, xi: Array) -> float:
        """Largest motion of an edge point along its normal, px, for a perturbation ``xi`` (6 or 7,) of the
        linearisation pose.
        """
        return float(largest_motion(self.jacobian, xi))


@compiled
def largest_motion(jacobian: Any, xi: Any) -> float:
    """Largest of the motions |J xi| of n samples by their ``jacobian`` (n, 6 or 7), px; 0 of none."""
    largest = 0.0
    for n in range(len(jacobian)):
        moved = 0.0
        for i in range(len(xi)):
            moved += jacobian[n, i] * xi[i]
        largest = max(largest, abs(moved))
    return largest


def lay_out(
    camera: Camera,
    gripper: Gripper,
    cam_T_grip: Array,
    jaw_opening_m: float,
    settings: SamplingSettings,
    taught: TaughtEdges | None = None,
) -> EdgeLayout:
    """Choose the sampled part of each visible edge: inside the image, away from its ends; search lines by the root of
    its length.

    With a taught model creases that were taught are used, too.  An edge that shows otherwise than it was taught, as an
    outline or as a crease, counts as not taught: like is compared with like.
    """
    eye_grip_m = invert(cam_T_grip)[:3, 3]
    points_grip_m = gripper.points_grip_m(jaw_opening_m, eye_grip_m)
    view = gripper.edge_view(points_grip_m, eye_grip_m)
    points_cam_m = points_grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
    as_taught = np.zeros(len(gripper.edge_ids), dtype=bool)
    if taught is not None:
        as_taught = taught.known & (view.crease == taught.crease)
    wanted = view.visible & (settings.creases | ~view.crease | as_taught)
    along_m = gripper.outlines_m(points_cam_m, np.arange(len(gripper.edge_ids)), PLACES, cam_T_grip[:3, :3])
    uv = camera.project(along_m.reshape(-1, 3)).reshape(-1, PLACES, 2)
    margin_px = settings.end_margin_px
    # On a shorter edge the fewest inliers would be closer than a pixel.  The margin is zoomed, and so is what is left.
    shortest_px = max(margin_px, FEWEST_AGREEING - 1.0)
    ways = np.asarray(np.gradient(uv, axis=1))
    inside_px = _lines_inside_px(camera, uv, _unit(ways[..., ::-1] * (-1.0, 1.0)), settings.reach_px) - BORDER_PX
    ranges = prediction_kernel.sampled_ranges(uv, inside_px, wanted, margin_px, shortest_px)
    lengths = ranges[:, 2]
    counts = np.zeros(len(uv), dtype=int)
    if lengths.sum() > 0.0:
        # Short edges across the fingers show what long ones along them can't, so density falls with length.  At most
        # one search line a pixel: closer ones see the same pixels again.
        share = np.sqrt(lengths)
        wanted_counts = np.maximum(np.round(settings.samples * share / share.sum()), FEWEST_AGREEING)
        counts = np.where(lengths > 0.0, np.minimum(wanted_counts, np.floor(lengths) + 1.0), 0.0).astype(int)
    edges = np.flatnonzero(counts)
    fraction = [np.linspace(r[0], r[1], n) for r, n in zip(ranges.tolist(), counts.tolist(), strict=True) if n]
    first = np.concatenate([[0], np.cumsum(counts[edges])[:-1]]).astype(np.intp) if len(edges) else np.zeros(0, np.intp)
    return EdgeLayout(
        np.repeat(edges, counts[edges]),
        np.concatenate(fraction) if fraction else np.zeros(0),
        edges,
        first,
        view.visible,
        as_taught,
    )


def inside_px(camera: Camera, uv_px: Array) -> Array:
    """(...,) how far places (..., 2) lie inside the image's border, px; outside if negative, NaN where they are."""
    size = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    return np.asarray(np.minimum(uv_px, size - uv_px).min(axis=-1))


def _lines_inside_px(camera: Camera, uv_px: Array, normal: Array, reach_px: float) -> Array:
    """(...,) the same of the nearer end of search lines that reach so far to either side along the ``normal``."""
    to_px = reach_px * normal
    return np.minimum(inside_px(camera, uv_px - to_px), inside_px(camera, uv_px + to_px))


def predict(
    camera: Camera,
    gripper: Gripper,
    layout: EdgeLayout,
    cam_T_grip: Array,
    jaw_opening_m: float,
    offsets_px: Array,
    jaw_unknown: bool = False,
    taught: TaughtEdges | None = None,
) -> Prediction:
    """Project the sample points of ``layout`` and set up the maps for ``offsets_px`` (s,) along the normals.

    Points outside of the image are marked in ``ok`` and never measured.  Points that the lens maps nowhere, as those
    behind the camera, have neither a place nor a normal: the prediction's own layout leaves them out.
    """
    rotation, translation = cam_T_grip[:3, :3], cam_T_grip[:3, 3]
    # An outline that wanders over what is round moves in the image as if it were fixed, to the first order.
    points_grip_m = gripper.points_grip_m(jaw_opening_m, -translation @ rotation)
    edge = layout.edge
    start, end = gripper.tangents_m(points_grip_m @ rotation.T, edge, layout.fraction, rotation)
    rate = gripper.point_motion(jaw_opening_m) @ rotation.T if jaw_unknown else np.zeros_like(points_grip_m)
    lever, points_cam_m = prediction_kernel.levers(start, end, layout.fraction, translation)
    uv, d_uv = camera.project_with_jacobian(points_cam_m)
    of_edge = rate[gripper.edge_points[:, 0]]
    normal, gradient, jacobian = prediction_kernel.across_edges(d_uv, start, end, lever, edge, of_edge, jaw_unknown)
    mapped = np.isfinite(gradient).all(axis=1)
    if not mapped.all():
        kept = layout.only(mapped)
        return predict(camera, gripper, kept, cam_T_grip, jaw_opening_m, offsets_px, jaw_unknown, taught)
    # A bevel moves its edge by anything up to its width.
    edge_spread_m: Array = gripper.edge_bevel_m / math.sqrt(12.0)
    if taught is not None:
        shift_px = np.einsum("ni,ni->n", gradient, taught.shift_at_m(edge, layout.fraction) @ rotation.T)
        uv = uv + (layout.as_taught[edge] * shift_px)[:, None] * normal
        spread_m = taught.spread_m(gripper, points_grip_m, cam_T_grip)
        edge_spread_m = np.where(layout.as_taught, spread_m, np.hypot(edge_spread_m, taught.usual_m))
    ok = _lines_inside_px(camera, uv, normal, float(np.abs(offsets_px[[0, -1]]).max())) >= 1.0
    xy, way_xy, along, origin, direction = prediction_kernel.ideal_lines(
        points_cam_m, edge, layout.edges, layout.first, len(gripper.edge_ids)
    )
    if gripper.has_curves:
        curved = gripper.edge_curved[edge]
        way_xy[curved] = _unit(((end - start)[:, :2] - xy * (end - start)[:, 2:])[curved])
    corners = _predict_corners(camera, gripper, cam_T_grip, points_grip_m, rate)
    # Rows as far apart as the search lines' pixels: noise and fine texture differ, the edge doesn't.
    spacing_px = (offsets_px[1] - offsets_px[0]) / STEP_PX if len(offsets_px) > 1 else 1.0
    rows_px = (spacing_px * np.arange(-(ROWS // 2), ROWS // 2 + 1, dtype=np.float32)).astype(np.float32)
    map_x, map_y = prediction_kernel.maps(uv, normal, offsets_px.astype(np.float32), rows_px)
    return Prediction(
        cam_T_grip=cam_T_grip,
        jaw_opening_m=jaw_opening_m,
        layout=layout,
        uv_px=uv,
        normal=normal,
        jacobian=jacobian,
        xy=xy,
        way_xy=way_xy,
        along=along,
        gain=prediction_kernel.gains(points_cam_m, normal, d_uv, way_xy),
        line_origin=origin,
        line_direction=direction,
        ok=ok,
        map_x=map_x,
        map_y=map_y,
        corners=corners,
        edge_spread_m=edge_spread_m,
        independence=independent_part(uv, edge, len(gripper.edge_ids), ROWS * spacing_px),
    )


def independent_part(uv_px: Array, edge: NDArray[np.intp], edges: int, width_px: float) -> Array:
    """(e,) by how much the mean of each edge's search lines, at ``uv_px`` (n, 2) of ``edge`` (n,), is less exact than
    that of as many independent ones, as a factor on their number; 1 for edges without any.

    Two that are ``width_px`` wide and less apart share pixels, and are correlated by the shared part of their width.
    """
    apart_px, same = np.sqrt(np.square(np.diff(uv_px, axis=0)).sum(axis=1)), edge[1:] == edge[:-1]
    count = np.bincount(edge, minlength=edges)
    spacing_px = np.bincount(edge[1:][same], apart_px[same], edges) / np.maximum(count - 1, 1)
    together = np.maximum(count, 1).astype(float)
    for apart in range(1, int(count.max(initial=1))):
        shared = np.maximum(1.0 - apart * spacing_px / width_px, 0.0) * np.maximum(count - apart, 0)
        if not shared.any():
            break
        together += 2.0 * shared
    return np.asarray(np.maximum(count, 1) / together)


def _predict_corners(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, points_grip_m: Array, rate: Array
) -> PredictedCorners:
    """``rate`` (p, 3): motion of all points in the camera frame by the jaw opening, m/m."""
    rotation, translation = cam_T_grip[:3, :3], cam_T_grip[:3, 3]
    cam_m = points_grip_m[gripper.corner_points] @ rotation.T + translation
    uv_px, d_uv = camera.project_with_jacobian(cam_m)
    with np.errstate(invalid="ignore"):
        inside = inside_px(camera, uv_px) >= BORDER_PX
    return PredictedCorners(
        cam_m=cam_m,
        jaw_rate=rate[gripper.corner_points],
        xy=cam_m[:, :2] / cam_m[:, 2:],
        uv_px=uv_px,
        d_uv_d_xy=d_uv[:, :, :2] * cam_m[:, 2][:, None, None],
        facing=gripper.corners_visible(points_grip_m, -rotation.T @ translation),
        inside=inside,
    )


def _unit(ways: Array) -> Array:
    """(..., 2) of length 1; NaN where there is no way."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(ways / np.sqrt(np.einsum("...i,...i->...", ways, ways))[..., None])
