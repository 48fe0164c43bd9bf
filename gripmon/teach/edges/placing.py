"""A rough pose from a few corners that a person has put on the image by hand.

Any number of corners will do: what they leave open a prior pose decides, the reference where there is one, else a
camera that looks at the gripper from its near side.  So a drawing of the gripper can follow from the first corner on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.recalibrate import RecalibrationRefused, solutions
from gripmon.model.camera import Camera
from gripmon.model.geometry import exp_rotation, from_record, make_transform, perturb, perturbation_between, skew
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, ReferenceRecord

ROUGH_SHARE = 0.006
"""How exactly corners are put by hand: standard deviation, as a part of the image's width."""

_TILT_RAD = 0.4  # a wrist camera looks at the fingertips from beside the gripper
_FILLS = 0.4  # part of the image that the gripper's corners then span
_ROUNDS = 40
_TURNS = 4
_SAME_RAD, _SAME_SHARE = 0.02, 0.01


@dataclass(frozen=True, slots=True)
class Prior:
    """A pose (4, 4) and the covariance (6, 6) of its error, before any corner is placed."""

    cam_T_grip: Array
    covariance: Array


@dataclass(frozen=True, slots=True)
class Placed:
    """A pose that hand-placed corners and the prior allow: ``covariance`` (6, 6), ``cost`` the weighted squares of what
    is left, ``left_px`` for each placed corner how far the pose leaves it from where it was put; infinite where the
    lens maps it nowhere.
    """

    cam_T_grip: Array
    covariance: Array
    cost: float
    left_px: dict[str, float]


def prior_of(reference: ReferenceRecord) -> Prior:
    """The reference as the prior."""
    return Prior(from_record(reference.cam_T_grip), np.reshape(reference.covariance, (6, 6)))


def usual_view(camera: Camera, gripper: Gripper, jaw_opening_m: float | None) -> Prior:
    """A camera that looks at the fingertips from the gripper's near side (-y), near enough for them to fill a good
    part of the image; it may be turned about its own axis in any way.
    """
    corners_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points]
    extent_m = float(np.ptp(corners_m, axis=0).max())
    depth_m = extent_m * camera.fx_px / (_FILLS * camera.width_px)
    cam_T_grip = make_transform(exp_rotation(np.array([_TILT_RAD, 0.0, 0.0])), np.array([0.0, 0.0, depth_m]))
    sigma = [0.3 * depth_m, 0.3 * depth_m, 0.4 * depth_m, 0.4, 0.4, 2.0]
    return Prior(cam_T_grip, np.diag(np.square(sigma)))


def rough_sigma_px(camera: Camera) -> float:
    """Standard deviation of a corner put by hand (px)."""
    return max(ROUGH_SHARE * camera.width_px, 2.0)


def place(
    camera: Camera, gripper: Gripper, jaw_opening_m: float | None, put_px: Mapping[str, Array], prior: Prior
) -> list[Placed]:
    """Poses that explain where corners were ``put_px`` (name: (2,)), the likeliest first; several where corners in one
    plane allow two.

    Corners that lie outside of what the lens maps count as not put.  Without any corner the prior itself.
    """
    names = [name for name in gripper.corner_ids if name in put_px]
    uv_px = np.array([put_px[name] for name in names], dtype=float).reshape(-1, 2)
    xy = camera.undistort(uv_px) if len(uv_px) else uv_px
    known: NDArray[np.bool_] = np.asarray(np.isfinite(xy).all(axis=1))
    names, xy = [name for name, inside in zip(names, known.tolist(), strict=True) if inside], xy[known]
    points = gripper.corner_points[np.array([gripper.corner_ids.index(name) for name in names], dtype=np.intp)]
    points_m = gripper.points_grip_m(jaw_opening_m)[points].reshape(-1, 3)
    weight = (0.5 * (camera.fx_px + camera.fy_px) / rough_sigma_px(camera)) ** 2
    found: list[Placed] = []
    for start in _starts(points_m, xy, prior, weight):
        settled = _settle(start, points_m, xy, weight, prior)
        if settled is None or any(_same(settled[0], other.cam_T_grip) for other in found):
            continue
        cam_T_grip, covariance, cost = settled
        seen_px = camera.project(points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
        away = np.nan_to_num(np.linalg.norm(seen_px - uv_px[known], axis=1), nan=np.inf).tolist()
        found.append(Placed(cam_T_grip, covariance, cost, dict(zip(names, away, strict=True))))
    found.sort(key=lambda pose: pose.cost)
    return found or [Placed(prior.cam_T_grip, prior.covariance, 0.0, {})]


def _starts(points_m: Array, xy: Array, prior: Prior, weight: float) -> Iterator[Array]:
    """The prior, the prior turned about the optical axis, and what closed forms give."""
    yield prior.cam_T_grip
    if len(xy) > 1 and math.sqrt(prior.covariance[5, 5]) > 1.0:
        for quarter in range(1, _TURNS):
            turned = prior.cam_T_grip.copy()
            turned[:3, :3] = exp_rotation(np.array([0.0, 0.0, 2.0 * math.pi * quarter / _TURNS])) @ turned[:3, :3]
            yield turned
    try:
        found = solutions(points_m, xy, np.broadcast_to(np.eye(2) / weight, (len(xy), 2, 2)))
    except (RecalibrationRefused, np.linalg.LinAlgError):
        return
    yield from (pose.cam_T_grip for pose in found)


def _settle(start: Array, points_m: Array, xy: Array, weight: float, prior: Prior) -> tuple[Array, Array, float] | None:
    """Levenberg-Marquardt on the weighted image error and the prior; None where it leads behind the camera.

    Its damping falls more slowly than :func:`gripmon.model.least_squares.minimise`'s: that one's longer steps take
    corners which lie anywhere to poses next to the camera's plane, where nothing is determined.
    """
    information = np.linalg.inv(prior.covariance)
    pose, damping = start, 1e-3
    current = _cost(pose, points_m, xy, weight, prior, information)
    if not math.isfinite(current):
        return None
    for _ in range(_ROUNDS):
        normal, side = _equations(pose, points_m, xy, weight, prior, information)
        tried = perturb(pose, np.linalg.solve(normal + damping * np.diag(normal.diagonal()), side))
        cost = _cost(tried, points_m, xy, weight, prior, information)
        if cost < current:
            settled = current - cost < 1e-6 * (1.0 + cost)
            pose, current, damping = tried, cost, 0.2 * damping
            if settled:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    normal, _ = _equations(pose, points_m, xy, weight, prior, information)
    return pose, np.linalg.inv(normal), current


def _cost(pose: Array, points_m: Array, xy: Array, weight: float, prior: Prior, information: Array) -> float:
    seen = points_m @ pose[:3, :3].T + pose[:3, 3]
    if not pose[2, 3] > 0.0 or (seen[:, 2] <= 0.0).any():
        return math.inf
    residual = xy - seen[:, :2] / seen[:, 2:]
    away = perturbation_between(prior.cam_T_grip, pose)
    return float(weight * (residual**2).sum() + away @ information @ away)


def _equations(
    pose: Array, points_m: Array, xy: Array, weight: float, prior: Prior, information: Array
) -> tuple[Array, Array]:
    """Normal matrix (6, 6) and right-hand side (6,)."""
    away = perturbation_between(prior.cam_T_grip, pose)
    normal, side = information.copy(), -information @ away
    if not len(xy):
        return normal, side
    levers = points_m @ pose[:3, :3].T
    seen = levers + pose[:3, 3]
    shown = seen[:, :2] / seen[:, 2:]
    slopes = np.zeros((len(seen), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0 / seen[:, 2]
    slopes[:, :, 2] = -shown / seen[:, 2:]
    jacobian = np.concatenate([slopes, -slopes @ skew(levers)], axis=2).reshape(-1, 6)
    return normal + weight * jacobian.T @ jacobian, side + weight * jacobian.T @ (xy - shown).ravel()


def _same(one: Array, other: Array) -> bool:
    xi = perturbation_between(one, other)
    return bool(np.linalg.norm(xi[3:]) < _SAME_RAD and np.linalg.norm(xi[:3]) < _SAME_SHARE * one[2, 3])
