"""From an edge's lines in the teaching images to its taught offset, depth and standard deviations; and checks that
refuse images that can't be taught from (:class:`TeachingRefused`, with numbers and what to do).

Noise (:func:`~gripmon.teach.lines.pool`): an edge's offset in the images has three parts: its share of what is common
to all edges (a small error of the reference or of the reported opening; bevels, which move every outline inside of the
sharp one), its own offset, and noise, which clutter behind an outline can make large.  The size of the edges' own
offsets is estimated from all of them, and the part of an offset that noise explains is removed: a gripper with sharp
edges doesn't learn the clutter of its images.

Depth (:func:`~gripmon.teach.lines.slopes`): images at one pose can't show it, but the shape of a bevel does.  A bevel
or a rounding cuts an edge off; what shows instead is its rim, which lies on one of the two faces that would have met in
the sharp edge.  So an offset across the line of sight comes with one along it, because the rim lies in the face.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from gripmon.judge.smoothing import GATE_SQUARE
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.records import Array
from gripmon.teach.inset import INSET_SIGMA_M, made_from_images
from gripmon.teach.lines import FEWEST_POINTS, SLOPE_SHARE, UNKNOWN_SLOPE, Line, PooledOffsets, pool, slopes
from gripmon.teach.views import TAKE_MEASURED, SampledEdge, TeachingRefused, View, Viewer
from gripmon.track.edges.roles import along_fingers
from gripmon.track.edges.taught import PoseOffset, TaughtEdge, sight_axes

SHAPE_M = 5e-4
"""Largest distance of a real edge from the sharp model's: a bevel of 0.7 mm, or a rounding of 1.2 mm radius."""

PLAUSIBLE_OWN_M = 0.1 * SHAPE_M
"""Standard deviation of the difference between the bevels of different edges."""

SINGLE_SIGMA_PX = 0.03
"""Standard deviation by which the background and the pixel grid move a whole edge in one image."""

GRID_SIGMA_PX = 0.01
"""The part of it from the pixel grid, which is the same in all images of a standing camera."""

BACKGROUND_SHARE = 0.3
"""Standard deviation, relative to its shift, by which a bevel's shift of an outline depends on the background's shade:
the bevel is blurred into the background (bevels of the simulator in front of grey levels of 60 to 230)."""

_SMALLEST_DEPTH_M = 1e-6
_UNSEEN_SIGMA_M = 1.0  # of the offset of an edge that isn't seen: only what all edges share remains

_SHRINKAGE = 2  # weight of the usual scatter of all edges, as a number of additional images of each


@dataclass(frozen=True, slots=True)
class EdgeLines:
    """One edge in all images: the ``line`` through all of them, ``ends_px`` (s, 2) its ends in the images that show it,
    their numbers ``images`` (s,), and ``within_px2`` (2,) the ends' mean variance from the scatter of the points.

    Without a line (``line`` None, no images) it is an outline in view of which too little is seen.
    """

    sampled: SampledEdge
    line: Line | None
    images: tuple[int, ...]
    ends_px: Array
    within_px2: Array

    @property
    def mean_px(self) -> Array:
        """Mean offsets (2,) over the images; zero without any."""
        return np.asarray(self.ends_px.mean(axis=0)) if self.images else np.zeros(2)


@dataclass(frozen=True, slots=True)
class _Measured:
    """Arrays of all edges with lines: ``indices`` (e,) in the gripper, ``outline`` (e,), ``ends_m`` one (s, 2) each,
    transferred to the mean jaw opening by the depths ``depth_m`` (e,) known so far; ``turned`` as in the viewer, one
    (s,) each; ``noise_m2`` (e, 2) variance of their means; ``rows`` (e, 2, 8) derivatives, metres by the unknowns of
    the measurement and by an inset of all outlines, of a standard deviation ``inset_m``.
    """

    indices: list[int]
    edges: list[EdgeLines]
    outline: NDArray[np.bool_]
    ends_m: list[Array]
    turned: list[Array]
    depth_m: Array
    noise_m2: Array
    rows: Array
    inset_m: float

    @classmethod
    def of(cls, viewer: Viewer, lines: Mapping[int, EdgeLines], before: Mapping[str, TaughtEdge] | None) -> _Measured:
        indices, edges = list(lines), list(lines.values())
        outline = ~viewer.crease[indices]
        turned = [viewer.turned[list(edge.images), index] for index, edge in lines.items()]
        ids = [viewer.gripper.edge_ids[index] for index in indices]
        depth_m = np.array([before[name].depth_m if before and name in before else 0.0 for name in ids])
        per_m = np.array([edge.sampled.per_m for edge in edges])
        ends_m = [
            edge.ends_px / scale - (angle * depth)[:, None]
            for edge, scale, angle, depth in zip(edges, per_m, turned, depth_m, strict=True)
        ]
        noise_m2 = _noise_m2(ends_m, np.array([edge.within_px2 for edge in edges]), per_m)
        # Bevels and roundings shift all outlines towards the finger: common to them, like a motion.
        inset = np.repeat((viewer.inside[indices] * outline)[:, None, None], 2, axis=1)
        rows = np.concatenate([np.array([edge.sampled.rows for edge in edges]), inset], axis=2)
        inset_m = _inset_sigma_m(viewer, float(np.median(per_m)))
        return cls(indices, edges, outline, ends_m, turned, depth_m, noise_m2, rows, inset_m)

    def pooled(self, motion_covariance: Array) -> PooledOffsets:
        """Pool all edges, with a prior (7, 7) of pose and opening."""
        prior = block_diag(motion_covariance, self.inset_m**2)
        return pool(
            self.means_m, self.noise_m2[:, :, None] * np.eye(2), self.rows, (~self.outline).astype(np.intp), prior
        )

    @property
    def means_m(self) -> Array:
        """Mean ends (e, 2) over the images."""
        return np.array([ends_m.mean(axis=0) if len(ends_m) else np.zeros(2) for ends_m in self.ends_m])


def _inset_sigma_m(viewer: Viewer, per_m: float) -> float:
    """Standard deviation of an inset of all outlines, of ``per_m`` px per metre: by bevels; a file made of images has
    its outlines where they show, but for what a whole edge's position is off by, as the response moves dark outlines.
    """
    if not made_from_images(viewer.gripper):
        return INSET_SIGMA_M
    off_px = viewer.rig.settings.corners.with_response(taught=False).consensus.edge_floor_px
    return max(off_px / per_m, 1e-9)


def motion_off(viewer: Viewer, lines: Mapping[int, EdgeLines], prior_covariance: Array) -> PooledOffsets:
    """Error of the reference and the opening (``common``, the first 7) from the outlines, with a prior (7, 7) about
    zero.

    Allows for a common shift of all outlines by bevels and for each outline's own offset, of at least
    :data:`PLAUSIBLE_OWN_M`, since an own offset that looks like a motion can't be seen.  Creases are left out: their
    own offsets are larger.
    """
    measured = _Measured.of(viewer, lines, None)
    seen = np.array([len(ends_m) > 0 for ends_m in measured.ends_m])
    which = np.flatnonzero(measured.outline & seen)
    return pool(
        measured.means_m[which],
        (measured.noise_m2[which][:, :, None] + PLAUSIBLE_OWN_M**2) * np.eye(2),
        measured.rows[which],
        np.zeros(len(which), dtype=np.intp),
        block_diag(prior_covariance, measured.inset_m**2),
    )


def found_off(viewer: Viewer, lines: Mapping[int, EdgeLines]) -> PooledOffsets:
    """The same whatever the reference's standard deviations are: the images alone show where the gripper is."""
    prior = viewer.prior_covariance
    prior[:6, :6] = np.diag(np.square([0.01] * 3 + [0.1] * 3))
    return motion_off(viewer, lines, prior)


def estimate_edges(
    viewer: Viewer, lines: Mapping[int, EdgeLines], before: Mapping[str, TaughtEdge] | None
) -> dict[str, TaughtEdge]:
    """Means over the images with noise from the scatter between them, pooled over all edges.  An outline of which too
    little is seen is expected where the others predict it; its standard deviation is that of the edges' own offsets.

    ``before``: the edges as known so far; their depths transfer the lines of images with other jaw openings.
    """
    measured = _Measured.of(viewer, lines, before)
    pooled = measured.pooled(viewer.prior_covariance)
    # An edge's own offset, and the common shift by bevels; the rest is error of the reference and the opening.
    shape_m = pooled.own_m + pooled.common[-1] * measured.rows[:, :, -1]
    depth_m, depth_sigma_m = _depths(viewer, measured, pooled.ends_m.mean(axis=1), shape_m.mean(axis=1))
    sigma_m = np.sqrt(np.einsum("eii->ei", pooled.covariance_m2))
    sigma_m = np.hypot(sigma_m, _changing_m(measured, shape_m))
    return {
        viewer.gripper.edge_ids[index]: TaughtEdge(
            share=(round(edge.sampled.share[0], 6), round(edge.sampled.share[1], 6)),
            offset_m=_nanometres(pooled.ends_m[i]),
            sigma_m=_nanometres(sigma_m[i]),
            depth_m=round(float(depth_m[i]), 9),
            depth_sigma_m=round(float(depth_sigma_m[i]), 9),
            crease=not measured.outline[i],
            rms_px=round(edge.line.rms_px, 4) if edge.line else 0.0,
            seen=round(edge.line.seen, 4) if edge.line else 0.0,
        )
        for i, (index, edge) in enumerate(zip(measured.indices, measured.edges, strict=True))
    }


def _nanometres(ends_m: Array) -> tuple[float, float]:
    """Rounded to nanometres, so that people can read the file."""
    return round(float(ends_m[0]), 9), round(float(ends_m[1]), 9)


def _changing_m(measured: _Measured, shape_m: Array) -> Array:
    """Standard deviation (e, 2) by which an offset changes from image to image, beyond the scatter of its points: no
    average reduces it for a single frame.  With one image, of an outline: :data:`BACKGROUND_SHARE` of its own offset.
    """
    out = np.zeros_like(shape_m)
    for i, (edge, ends_m) in enumerate(zip(measured.edges, measured.ends_m, strict=True)):
        if len(ends_m) > 1:
            beyond_m2 = ends_m.var(axis=0, ddof=1) - edge.within_px2 / edge.sampled.per_m**2
            out[i] = np.sqrt(np.maximum(beyond_m2, 0.0))
        elif len(ends_m) and measured.outline[i]:
            out[i] = BACKGROUND_SHARE * np.abs(shape_m[i])
    return out


def _noise_m2(ends_m: Sequence[Array], within_px2: Array, per_m: Array) -> Array:
    """Variance (e, 2) of each edge's mean ends: from the scatter between its images, or within them if that is larger.

    The usual scatter of all edges counts as some additional images of each; with a single image it is
    :data:`SINGLE_SIGMA_PX`.
    """
    between_px2 = [np.var(m * ends, axis=0, ddof=1) for m, ends in zip(per_m, ends_m, strict=True) if len(ends) > 1]
    usual_px2 = np.median(between_px2, axis=0) if between_px2 else np.full(2, SINGLE_SIGMA_PX**2)
    noise = []
    for scale, ends, within in zip(per_m, ends_m, within_px2, strict=True):
        if not len(ends):
            noise.append(np.full(2, _UNSEEN_SIGMA_M**2))
            continue
        own_px2 = np.square(scale * (ends - ends.mean(axis=0))).sum(axis=0)
        scatter_px2 = (own_px2 + _SHRINKAGE * usual_px2) / (len(ends) - 1 + _SHRINKAGE)
        noise.append((np.maximum(scatter_px2, within) / len(ends) + GRID_SIGMA_PX**2) / scale**2)
    return np.array(noise)


def _depths(viewer: Viewer, measured: _Measured, offset_m: Array, shape_m: Array) -> tuple[Array, Array]:
    """Depth (e,) and its standard deviation (e,): from the shape of a bevel, and from images with different jaw
    openings, between which the line of sight turns.
    """
    gripper, indices = viewer.gripper, measured.indices
    offset_of_all_m = np.zeros(len(gripper.edge_ids))
    offset_of_all_m[indices] = shape_m
    axes = sight_axes(gripper, viewer.points_grip_m, viewer.ref_cam_T_grip)
    slope = slopes(gripper, viewer.points_grip_m, viewer.crease, axes, offset_of_all_m)[indices]
    known = np.isfinite(slope)
    wished_m = np.where(known, slope, 0.0) * shape_m
    unsure_m = np.where(known, SLOPE_SHARE * np.abs(wished_m), UNKNOWN_SLOPE * np.abs(shape_m))
    information = 1.0 / (np.square(unsure_m) + np.square(offset_m) + _SMALLEST_DEPTH_M**2)
    moment = information * wished_m
    for i, (angle, ends_m) in enumerate(zip(measured.turned, measured.ends_m, strict=True)):
        if not len(ends_m):
            continue
        away, seen_m = angle - angle.mean(), ends_m.mean(axis=1) + angle * measured.depth_m[i]
        per_image_m2 = len(angle) * measured.noise_m2[i].mean()
        information[i] += np.square(away).sum() / per_image_m2
        moment[i] += float(away @ seen_m) / per_image_m2
    return moment / information, 1.0 / np.sqrt(information)


REFERENCE_SIGMAS = 3.0
"""Number of standard deviations of the reference and of the reported opening allowed in addition to a bevel."""

JAW_SIGMAS = 5.0
"""Standard deviations by which the measured opening may differ from the reported one, as in
:mod:`gripmon.track.jaw`."""

NOTED_PX = 1.0
"""Offset of the reference above which there is a note: in a view turned by 3° a twentieth of it becomes an error."""

TAUGHT_SHARE = 0.5
"""Least part of the straight outlines in view, by search lines, that must be seen: with less, something hides the
gripper."""

_NAMED = 3  # edges that a refusal names; more make no line that anybody reads

LOST_SHARE = 0.25
"""Part below which the gripper, or a finger, counts as absent."""


def is_absent(viewer: Viewer, view: View, lines: Mapping[int, EdgeLines]) -> bool:
    """Whether an image shows nothing of the gripper where it should be; ``lines``: of this image alone."""
    profiles, seen = _outlines(viewer, [view], lines)
    return bool(seen.sum() < LOST_SHARE * profiles.sum())


def _outlines(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> tuple[Array, Array]:
    """(e,) search lines of the straight outlines in view, long enough for one, and of those that are seen; else 0."""
    profiles = np.sum([view.prediction.profiles for view in views], axis=0) * ~viewer.crease
    profiles = np.where(viewer.bent | (profiles < FEWEST_POINTS * len(views)), 0, profiles)
    return profiles, profiles * np.array([e in lines and bool(lines[e].images) for e in range(len(profiles))])


def check_enough(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> None:
    """Refuse if too little of the gripper, or of one finger, is seen: of what can be seen as lines, outlines, straight
    or nearly so, that are long enough for one.
    """
    profiles, seen = _outlines(viewer, views, lines)
    if not profiles.any():
        raise TeachingRefused(
            "no outline in view is nearly straight, and only such edges are taught; the gripper file without teaching"
        )
    share = seen.sum() / max(profiles.sum(), 1)
    if share < TAUGHT_SHARE:
        found = "the gripper isn't found: " if share < LOST_SHARE else ""
        missing = [viewer.gripper.edge_ids[e] for e in np.flatnonzero((profiles > 0) & (seen == 0)).tolist()]
        more = f" and {len(missing) - _NAMED} more" if len(missing) > _NAMED else ""
        raise TeachingRefused(
            f"{found}only {100.0 * share:.0f} % of the straight outlines in view are seen as lines (not "
            f"{', '.join(missing[:_NAMED])}{more}); at least {100.0 * TAUGHT_SHARE:.0f} %: images in focus, at the "
            "reference and their jaw openings, the fingers free"
        )
    for finger, name in enumerate(viewer.gripper.finger_ids):
        own = viewer.gripper.edge_finger == finger
        if profiles[own].sum() and seen[own].sum() < LOST_SHARE * profiles[own].sum():
            raise TeachingRefused(f"finger {name} isn't seen; images in focus, all fingers free")


class ReferenceSeen(NamedTuple):
    """Where the images show the gripper: its ``offset`` (6,) from the reference, which bounds have to include, with the
    ``covariance`` (36,) of where the images alone show it, sharp edges but for plausible bevels, a file exact but for
    its fingers' lengths; ``doubt``: a text if the offset is above a pixel.
    """

    offset: PoseOffset
    covariance: tuple[float, ...]
    doubt: str | None


def check_reference(viewer: Viewer, name: str, lines: Mapping[int, EdgeLines]) -> ReferenceSeen:
    """Refuse a gripper whose pose or jaw opening differs by more than the stated standard deviations allow.

    Each is tested with the other one taken as stated, since both together can hardly be separated; the one that leaves
    smaller own offsets to the edges is named first.
    """
    stated = viewer.prior_covariance
    free_jaw = stated.copy()
    free_jaw[6, 6] = 0.01**2
    moved, opened = found_off(viewer, lines), motion_off(viewer, lines, free_jaw)
    pose, covariance = moved.common[:6], moved.common_covariance[:6, :6]
    pose_square = pose @ np.linalg.solve(covariance + stated[:6, :6], pose)
    jaw_m, jaw_sigma_m = float(opened.common[6]), float(np.sqrt(opened.common_covariance[6, 6] + stated[6, 6]))
    # Bevels on the inner sides alone look like a wider opening.
    allowed_m = JAW_SIGMAS * jaw_sigma_m + SHAPE_M
    faults, measured = [], []
    if pose_square > GATE_SQUARE:
        times = np.sqrt(pose_square / GATE_SQUARE)
        faults.append(
            f"the gripper is off the reference, {viewer.distance(pose)}, {times:.1f} times what "
            f"position_sigma_m and rotation_sigma_rad allow: {TAKE_MEASURED}"
        )
        measured = [viewer.measured_note(pose, covariance)]
    if viewer.gripper.has_jaw and abs(jaw_m) > allowed_m:
        faults.append(
            f"the image shows a jaw opening of {viewer.jaw_opening_m + jaw_m:.6f} m, {viewer.jaw_opening_m:.6f} m is "
            f"reported; at most {1e3 * allowed_m:.3f} mm apart: correct the opening "
            "(timestamps.csv, --jaw-opening), or a larger monitor.jaw_sigma_m"
        )
    if faults:
        likelier_first = faults if moved.usual_own_m[0] <= opened.usual_own_m[0] else faults[::-1]
        raise TeachingRefused(f"{name}: {'; or '.join(likelier_first)}", measured)
    away_px = max(float(np.abs(e.sampled.rows[:, :6] @ pose).max()) * e.sampled.per_m for e in lines.values())
    turn = pose[3:]
    if turn @ np.linalg.solve(covariance[3:, 3:], turn) <= chi_square_limit(0.05, 3):
        turn = np.zeros(3)  # a turn within its noise says nothing of the reference
    x, y, z, about_x, about_y, about_z = (round(v, 9) for v in (*pose[:3].tolist(), *turn.tolist()))
    offset = (x, y, z, about_x, about_y, about_z)
    longer = np.zeros(6)
    longer[:3] = viewer.rig.settings.model_sigma_m * viewer.ref_cam_T_grip[:3, :3] @ along_fingers(viewer.gripper)[0]
    shown = tuple(float(f"{v:.6e}") for v in (covariance + np.outer(longer, longer)).ravel().tolist())
    if away_px <= NOTED_PX:
        return ReferenceSeen(offset, shown, None)
    doubt = (
        f"the gripper appears up to {away_px:.1f} px off the reference, {viewer.distance(pose)}, and every bound is "
        f"larger by as much: calibrate again, or take the measured pose with its standard deviations as "
        f"{viewer.pose(pose, covariance)}"
    )
    return ReferenceSeen(offset, shown, doubt)


def check_edges(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> None:
    """Refuse edges that lie farther from the reference than a bevel and the stated standard deviations explain."""
    for index, edge in lines.items():
        if not edge.images:
            continue
        allowed_px = viewer.allowed_px(views[edge.images[0]], index, SHAPE_M, REFERENCE_SIGMAS)
        away_px = float(np.abs(edge.mean_px).max())
        if away_px > allowed_px:
            raise TeachingRefused(
                f"edge {viewer.gripper.edge_ids[index]} appears {away_px:.1f} px "
                f"({1e3 * away_px / edge.sampled.per_m:.2f} mm) from the reference; at most {allowed_px:.1f} px, which "
                "a bevel and the standard deviations of reference and jaw explain: correct the gripper file"
            )
