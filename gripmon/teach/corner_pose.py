"""``cam_T_grip`` from the corners of one image, without a hand/eye calibration.

It is the pose of on-line recalibration; its covariance includes everything that one image can't average out: the
corners, the jaw opening, the camera's calibration, and the gripper's manufacturing tolerance.  A plate under the
fingertips (``gripmon calibrate plane``) gives the distance far better than the small extent of the fingertips does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.bundle import GivenCamera, independent_errors
from gripmon.calibrate.lens_models import lens_vector
from gripmon.judge.recalibrate import Recalibration, RecalibrationRefused, recalibrate, refusal, rivals, solutions
from gripmon.model.camera import Camera
from gripmon.model.geometry import exp_rotation, from_record, make_transform, perturb, perturbation_between, seen_from
from gripmon.model.gripper import Gripper
from gripmon.model.least_squares import Equations, minimise, normal_equations
from gripmon.model.records import Array, ReferenceRecord
from gripmon.teach.inset import inset_corners_px, inset_motion, unstated_inset_m
from gripmon.track.edges import Measurement

BY_HAND_PX = 1.0
"""Standard deviation of a corner set by hand that replaces a measured one, or one that couldn't be measured."""

MADE_TO_M = 2e-5
"""Manufacturing tolerance of a fingertip's corners against the gripper file (each coordinate, standard deviation)."""

_LARGEST_PX = 100_000.0  # of a coordinate: corners may be set in the image, or beside it
_STEP = 0.3  # of a standard deviation, for central differences


class SnappedCorner(msgspec.Struct, frozen=True):
    """One corner: ``model_px`` (2,) where the pose projects it, None beyond the lens; ``uv_px`` (2,) where its edges
    meet, with ``covariance_px`` (2, 2) and ``sigma_px`` of its larger axis, None where it is refused for the
    ``reason``; ``inliers``: part of the search lines on its edges that agree, None without any.
    """

    name: str
    model_px: Array | None
    uv_px: Array | None
    covariance_px: Array | None
    sigma_px: float | None
    inliers: float | None
    reason: str | None


class Snapped(msgspec.Struct, frozen=True, kw_only=True):
    """What the image shows near corners set by hand; the page gets it as it is.

    ``refused``: why nothing was found, as a text; then ``cam_T_grip`` (4, 4) is the rough pose, otherwise the measured
    one.  ``outlines_px``: visible edges of the model at that pose, (k, 2) points each; ``edge_points_px`` (n, 2), the
    inliers; ``share``: their part of the search lines.  ``jaw_opening_m`` with ``jaw_sigma_m``: as given, else as
    measured.
    """

    cam_T_grip: Array
    corners: tuple[SnappedCorner, ...]
    outlines_px: dict[str, Array]
    edge_points_px: Array
    share: float
    jaw_opening_m: float | None
    jaw_sigma_m: float | None = None
    refused: str | None = None


class PoseRefused(ValueError):
    """These corners determine no pose; the text is ``what is wrong; what would be right``."""


@dataclass(frozen=True, slots=True)
class CornerPose:
    """``cam_T_grip`` (4, 4), the covariance (6, 6) of its error, the ``corners`` it is computed from, and the weighted
    root mean square of their residuals, 1 where their covariances hold.  ``rival``: another pose fits them as well.  An
    empty ``corners`` means the joint fit of the edges: too few corners are seen for a pose of their own.
    """

    cam_T_grip: Array
    covariance: Array
    corners: tuple[str, ...]
    weighted_rms: float
    rival: bool


def pose_from_corners(
    camera: Camera,
    gripper: Gripper,
    snapped: Snapped,
    found: Measurement | None,
    by_hand_px: Mapping[str, Array],
    camera_error: GivenCamera | None = None,
    exact: bool = False,
) -> CornerPose:
    """Pose of the gripper from corners that were measured (``found``) or set by hand; ``exact``: its edges are as sharp
    as the file says.  Raises :class:`PoseRefused`.
    """
    if found is None:
        raise PoseRefused(f"no pose: {snapped.refused}")
    measured = [i for i, c in enumerate(snapped.corners) if c.uv_px is not None and c.name not in by_hand_px]
    hand = [i for i, c in enumerate(snapped.corners) if c.name in by_hand_px]
    for name in (snapped.corners[i].name for i in hand):
        if not np.isfinite(camera.undistort(np.reshape(by_hand_px[name], (1, 2)))).all():
            raise PoseRefused(f"{name} was placed outside the lens's view; inside it, or not by hand")
    every = [*measured, *hand]
    taken = np.isin(np.arange(len(snapped.corners)), measured)
    uv_px = np.array([snapped.corners[i].uv_px for i in measured] + [by_hand_px[snapped.corners[i].name] for i in hand])
    joint: Array = found.corners.joint_covariance_xy(taken)
    of_edges: Array = np.zeros((6, 6))
    by_edges = refusal(gripper.points_grip_m(snapped.jaw_opening_m)[gripper.corner_points[every]]) is not None
    if by_edges:
        # Take all corners where the edges' joint fit has them; their covariance is that of the measurement.
        every = [i for i, c in enumerate(snapped.corners) if c.model_px is not None]
        uv_px = np.array([snapped.corners[i].model_px for i in every]).reshape(-1, 2)
        joint, of_edges = np.zeros((2 * len(every),) * 2), found.covariance[:6, :6]
    inset_m = 0.0 if exact else unstated_inset_m(gripper)
    covariance_xy = _covariance(camera, uv_px, joint, found.cam_T_grip[2, 3])

    def solve(camera: Camera, jaw_opening_m: float | None, moved_px: Array | None = None) -> Recalibration:
        points_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points[every]]
        shown_px = uv_px if moved_px is None else uv_px + moved_px[every]
        return recalibrate(points_m, camera.undistort(shown_px), covariance_xy, found.cam_T_grip)

    try:
        pose = solve(camera, snapped.jaw_opening_m)
        slopes = [
            perturbation_between(solve(*low).cam_T_grip, solve(*high).cam_T_grip) / (2.0 * _STEP)
            for low, high in [
                *_error_sources(camera, gripper, snapped, camera_error),
                *_bevels(camera, gripper, found, snapped.jaw_opening_m, 0.0 if by_edges else inset_m),
            ]
        ]
        if by_edges and inset_m:
            slopes.append(inset_motion(gripper, found, inset_m)[:6])
    except (RecalibrationRefused, np.linalg.LinAlgError) as refused:
        raise PoseRefused(f"{refused}; more corners, or a calibration with a plate") from None
    # Corners that contradict each other have errors of at least their residuals.
    covariance = pose.covariance * max(pose.weighted_rms, 1.0) ** 2 + sum((np.outer(s, s) for s in slopes), of_edges)
    points_m = gripper.points_grip_m(snapped.jaw_opening_m)[gripper.corner_points[every]]
    alike = rivals(solutions(points_m, camera.undistort(uv_px), covariance_xy), len(every))
    names = () if by_edges else tuple(snapped.corners[i].name for i in every)
    symmetric = 0.5 * (covariance + covariance.T)
    return CornerPose(pose.cam_T_grip, symmetric, names, pose.weighted_rms, len(alike) > 1)


def _covariance(camera: Camera, uv_px: Array, measured: Array, depth_m: float) -> Array:
    """Covariance (2n, 2n) of ideal coordinates: of measured corners jointly, of corners set by hand one by one, and of
    the manufacturing tolerance.
    """
    count = len(uv_px)
    out = np.zeros((2 * count, 2 * count))
    out[: len(measured), : len(measured)] = measured
    _, slopes = camera.undistort_with_jacobian(uv_px)
    for i in range(len(measured) // 2, count):
        block = slice(2 * i, 2 * i + 2)
        out[block, block] = BY_HAND_PX**2 * slopes[i] @ slopes[i].T
    return np.asarray(out + (MADE_TO_M / depth_m) ** 2 * np.eye(2 * count))


_Seen = tuple[Camera, float | None] | tuple[Camera, float | None, Array]
"""A camera, a jaw opening, and by how much (c, 2) the corners appear elsewhere, px."""


def _error_sources(
    camera: Camera, gripper: Gripper, snapped: Snapped, error: GivenCamera | None
) -> list[tuple[_Seen, _Seen]]:
    """Other sources of error, independent of each other: each a pair of inputs, a part of a standard deviation below
    and above.
    """
    opening_m = snapped.jaw_opening_m
    sources: list[tuple[_Seen, _Seen]] = []
    if snapped.jaw_sigma_m and opening_m is not None:
        step_m = _STEP * snapped.jaw_sigma_m
        low_m, high_m = (float(np.clip(opening_m + s, gripper.jaw_min_m, gripper.jaw_max_m)) for s in (-step_m, step_m))
        sources.append(((camera, low_m), (camera, high_m)))
    if error is not None and error.covariance is not None and error.parameters:
        vector, model = lens_vector(error.lens), error.model
        for root in independent_errors(error.covariance):
            step = _STEP * error.free @ root
            sources.append(((model.camera(vector - step), opening_m), (model.camera(vector + step), opening_m)))
    return sources


def _bevels(
    camera: Camera, gripper: Gripper, found: Measurement, opening_m: float | None, inset_m: float
) -> list[tuple[_Seen, _Seen]]:
    """The same for bevels: the corners that show aren't the model's, and an opening measured with them is off, too."""
    if not inset_m:
        return []
    moved_px = _STEP * inset_corners_px(camera, gripper, found, inset_m)
    step_m = 0.0
    if opening_m == found.jaw_opening_m:  # measured, not reported
        step_m = _STEP * float(inset_motion(gripper, found, inset_m)[6:].sum())
    low_m, high_m = (None if opening_m is None else opening_m + sign * step_m for sign in (-1.0, 1.0))
    return [((camera, low_m, -moved_px), (camera, high_m, moved_px))]


ROUGH_SHARE = 0.006
"""Standard deviation of a corner set by hand, as a part of the image's width."""

_TILT_RAD = 0.4  # a wrist camera looks at the fingertips from beside the gripper
_GRIPPER_SPAN = 0.4  # part of the image that the gripper's corners span in that view
_ROUNDS = 40
_START_TURNS = 4
_SAME_RAD, _SAME_SHARE = 0.02, 0.01


@dataclass(frozen=True, slots=True)
class Prior:
    """A pose (4, 4) and the covariance (6, 6) of its error, before any corner is placed."""

    cam_T_grip: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class PlacedPose:
    """A pose that corners set by hand and the prior allow: ``covariance`` (6, 6); ``cost``, the weighted sum of squared
    residuals; ``left_px``, for each corner the distance from where it was set to where the pose projects it, infinite
    where the lens can't map it.
    """

    cam_T_grip: Array
    covariance: Array
    cost: float
    left_px: dict[str, float]


def prior_of(reference: ReferenceRecord) -> Prior:
    """The reference as the prior."""
    return Prior(from_record(reference.cam_T_grip), np.reshape(reference.covariance, (6, 6)))


def usual_view(
    camera: Camera, gripper: Gripper, jaw_opening_m: float | None, distance_m: tuple[float, float] | None = None
) -> Prior:
    """A camera that looks at the fingertips from the gripper's near side (-y), close enough for them to fill a good
    part of the image, or as far away as it is said to be; its turn about its own axis is free.
    """
    corners_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points]
    extent_m = float(np.ptp(corners_m, axis=0).max())
    depth_m = extent_m * camera.fx_px / (_GRIPPER_SPAN * camera.width_px)
    depth_m, depth_sigma_m = (depth_m, 0.4 * depth_m) if distance_m is None else distance_m
    cam_T_grip = make_transform(exp_rotation(np.array([_TILT_RAD, 0.0, 0.0])), np.array([0.0, 0.0, depth_m]))
    sigma = [0.3 * depth_m, 0.3 * depth_m, depth_sigma_m, 0.4, 0.4, 2.0]
    return Prior(cam_T_grip, np.diag(np.square(sigma)))


def rough_sigma_px(camera: Camera) -> float:
    """Standard deviation of a corner set by hand (px)."""
    return max(ROUGH_SHARE * camera.width_px, 2.0)


def place(
    camera: Camera, gripper: Gripper, jaw_opening_m: float | None, put_px: Mapping[str, Array], prior: Prior
) -> list[PlacedPose]:
    """Poses that explain where corners were set, ``put_px`` (name: (2,)), the most likely first; several where corners
    in one plane allow two.

    Corners outside of what the lens maps are ignored.  Without any corner the result is the prior itself.
    """
    names = [name for name in gripper.corner_ids if name in put_px]
    uv_px = np.array([put_px[name] for name in names], dtype=float).reshape(-1, 2)
    xy = camera.undistort(uv_px) if len(uv_px) else uv_px
    known: NDArray[np.bool_] = np.asarray(np.isfinite(xy).all(axis=1))
    names, xy = [name for name, inside in zip(names, known.tolist(), strict=True) if inside], xy[known]
    points = gripper.corner_points[np.array([gripper.corner_ids.index(name) for name in names], dtype=np.intp)]
    points_m = gripper.points_grip_m(jaw_opening_m)[points].reshape(-1, 3)
    weight = (0.5 * (camera.fx_px + camera.fy_px) / rough_sigma_px(camera)) ** 2
    found: list[PlacedPose] = []
    for start in _starts(points_m, xy, prior, weight):
        settled = _settle(start, points_m, xy, weight, prior)
        if settled is None or any(_same(settled[0], other.cam_T_grip) for other in found):
            continue
        cam_T_grip, covariance, cost = settled
        seen_px = camera.project(points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
        away = np.nan_to_num(np.linalg.norm(seen_px - uv_px[known], axis=1), nan=np.inf).tolist()
        found.append(PlacedPose(cam_T_grip, covariance, cost, dict(zip(names, away, strict=True))))
    found.sort(key=lambda pose: pose.cost)
    return found or [PlacedPose(prior.cam_T_grip, prior.covariance, 0.0, {})]


def _starts(points_m: Array, xy: Array, prior: Prior, weight: float) -> Iterator[Array]:
    """Starting poses: the prior, the prior turned about the optical axis, and OpenCV's closed forms."""
    yield prior.cam_T_grip
    if len(xy) > 1 and math.sqrt(prior.covariance[5, 5]) > 1.0:
        for quarter in range(1, _START_TURNS):
            turned = prior.cam_T_grip.copy()
            turned[:3, :3] = exp_rotation(np.array([0.0, 0.0, 2.0 * math.pi * quarter / _START_TURNS])) @ turned[:3, :3]
            yield turned
    try:
        found = solutions(points_m, xy, np.broadcast_to(np.eye(2) / weight, (len(xy), 2, 2)))
    except (RecalibrationRefused, np.linalg.LinAlgError):
        return
    yield from (pose.cam_T_grip for pose in found)


def _settle(start: Array, points_m: Array, xy: Array, weight: float, prior: Prior) -> tuple[Array, Array, float] | None:
    """The pose (4, 4) near a start with the least weighted image error and distance from the prior, its covariance
    (6, 6), and that cost; None where it starts behind the camera, or ends where nothing determines it: so far away that
    corners and prior together are singular.
    """
    information = np.linalg.inv(prior.covariance)

    def cost(pose: Array) -> float:
        if not pose[2, 3] > 0.0 or (points_m @ pose[2, :3] + pose[2, 3] <= 0.0).any():
            return math.inf
        off, away = xy - seen_from(pose, points_m)[0], perturbation_between(prior.cam_T_grip, pose)
        return float(weight * np.square(off).sum() + away @ information @ away)

    def equations(pose: Array) -> Equations:
        shown, slopes = seen_from(pose, points_m)
        normal, side = normal_equations(slopes, xy - shown)
        away = perturbation_between(prior.cam_T_grip, pose)
        return weight * normal + information, weight * side - information @ away

    if not math.isfinite(cost(start)):
        return None
    found = minimise(start, cost, equations, perturb, iterations=_ROUNDS, tolerance=1e-6, damping=1e-3)
    try:
        covariance = np.linalg.inv(equations(found.state)[0])
    except np.linalg.LinAlgError:
        return None
    return found.state, covariance, found.cost


def _same(one: Array, other: Array) -> bool:
    xi = perturbation_between(one, other)
    return bool(np.linalg.norm(xi[3:]) < _SAME_RAD and np.linalg.norm(xi[:3]) < _SAME_SHARE * one[2, 3])


def corners_fault(corners: Mapping[str, Sequence[float]], gripper: Gripper) -> tuple[str, str, str] | None:
    """The key, what is wrong and what would be right, for corners in a file or a request; None if nothing is wrong."""
    for name, uv_px in corners.items():
        if name not in gripper.corner_ids:
            return f"corners.{name}", "the gripper has no such corner", f"one of {', '.join(gripper.corner_ids)}"
        if not all(np.isfinite(v) and abs(v) <= _LARGEST_PX for v in uv_px):
            return f"corners.{name}", f"is {list(uv_px)}", "column and row in the image (px)"
    return None
