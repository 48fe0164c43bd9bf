"""On-line recalibration: the full pose from measured corners, without the previous pose.

The starting poses come from OpenCV's closed forms: SQPNP, and for coplanar corners also IPPE.  IPPE gives both poses
that look alike, but fails where all corners but one lie on a line: that leaves the plane's homography undetermined, not
the pose.  The weighted refinement is our own: it uses the corners' covariances and gives that of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gripmon.model.geometry import make_transform, perturb, perturbation_between, seen_from
from gripmon.model.gripper import on_a_line
from gripmon.model.least_squares import joint_weight
from gripmon.model.records import Array

FEWEST_COPLANAR, FEWEST_GENERAL = 4, 6
"""Fewest corners that determine a pose: in one plane, and in general position."""

COPLANAR_RATIO = 1e-3
"""Thickness over extent below which corners count as coplanar."""

AMBIGUITY_SQUARED_ERROR = 16.0
"""Difference of the weighted squared errors below which the corners can't distinguish two poses: the worse one is less
likely by a factor of exp(8) at most.
"""


class RecalibrationRefused(ValueError):
    """The corners don't determine a pose; the text gives the reason."""


@dataclass(frozen=True, slots=True)
class Recalibration:
    """``cam_T_grip``, the covariance (6, 6) of its error, and the weighted rms of the residuals (1 if the corners'
    covariances hold).
    """

    cam_T_grip: Array
    covariance: Array
    weighted_rms: float


def recalibrate(
    points_grip_m: Array, measured_xy: Array, covariance_xy: Array, expected_cam_T_grip: Array, iterations: int = 40
) -> Recalibration:
    """Pose from n >= 4 coplanar or n >= 6 general corners.

    ``points_grip_m`` (n, 3), ``measured_xy`` (n, 2) ideal coordinates, ``covariance_xy`` (n, 2, 2) of each corner or
    (2n, 2n) of all together.  ``expected_cam_T_grip`` (4, 4) only decides between the two poses of a plane that the
    residuals don't distinguish.  Raises :class:`RecalibrationRefused` for too few or collinear corners.
    """
    every = solutions(points_grip_m, measured_xy, covariance_xy, iterations)
    return _choose(every, expected_cam_T_grip, len(points_grip_m))


def solutions(
    points_grip_m: Array, measured_xy: Array, covariance_xy: Array, iterations: int = 40
) -> list[Recalibration]:
    """All poses that the corners allow, each refined, the best fit first; many planes allow two.

    Arguments and exceptions as for :func:`recalibrate`.
    """
    why = refusal(points_grip_m)
    if why is not None:
        raise RecalibrationRefused(why)
    starts = _closed_forms(points_grip_m, measured_xy, coplanar(points_grip_m))
    weight_xy = joint_weight(covariance_xy)
    refined = [_refine(start, points_grip_m, measured_xy, weight_xy, iterations) for start in starts]
    sound = sorted((r for r in refined if r is not None), key=lambda r: r.weighted_rms)
    different: list[Recalibration] = []
    for pose in sound:
        if all(_apart(pose, other) for other in different):
            different.append(pose)
    if not different:
        raise RecalibrationRefused("the corners' images don't determine a pose with all of them in front of the camera")
    return different


def rivals(every: list[Recalibration], corners: int) -> list[Recalibration]:
    """Those of the :func:`solutions` that n ``corners`` can't distinguish from the best."""
    squares, freedom = 2 * corners * every[0].weighted_rms ** 2, 2 * corners - 6
    # If even the best pose fits badly, the corners' covariances are too small, and so are differences in their units.
    largest = squares + AMBIGUITY_SQUARED_ERROR * max(1.0, squares / freedom)
    return [pose for pose in every if 2 * corners * pose.weighted_rms**2 <= largest]


def _apart(one: Recalibration, other: Recalibration) -> bool:
    """Whether two refined poses are not the same minimum: farther apart than a standard deviation."""
    xi = perturbation_between(one.cam_T_grip, other.cam_T_grip)
    return bool(xi @ np.linalg.solve(one.covariance, xi) > 1.0)


def coplanar(points_grip_m: Array) -> bool:
    """Whether points (n, 3) lie in a plane, or nearly so."""
    spread = np.linalg.svd(points_grip_m - points_grip_m.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= COPLANAR_RATIO * spread[0])


def refusal(points_grip_m: Array) -> str | None:
    """Why corners (n, 3) at these positions can't determine a pose, however well they are seen; None if they can."""
    count = len(points_grip_m)
    if count < FEWEST_COPLANAR:
        return f"{count} corners; at least {FEWEST_COPLANAR} coplanar ones or {FEWEST_GENERAL} are needed"
    if count < FEWEST_GENERAL and not coplanar(points_grip_m):
        return f"{count} corners; at least {FEWEST_GENERAL} are needed"
    return "the corners lie on a line" if on_a_line(points_grip_m) else None


def _closed_forms(points_grip_m: Array, measured_xy: Array, flat: bool) -> list[Array]:
    """Poses (4, 4) that OpenCV's closed forms give; those behind the camera left out."""
    starts = []
    for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP) if flat else (cv2.SOLVEPNP_SQPNP,):
        try:
            _, turns, shifts, _ = cv2.solvePnPGeneric(points_grip_m, measured_xy, np.eye(3), None, flags=method)
        except cv2.error:
            continue
        starts += [
            make_transform(np.asarray(cv2.Rodrigues(r)[0], float), np.asarray(t, float).ravel())
            for r, t in zip(turns, shifts, strict=True)
        ]
    return [start for start in starts if _in_front(start, points_grip_m)]


def _in_front(cam_T_grip: Array, points_grip_m: Array) -> bool:
    return bool((points_grip_m @ cam_T_grip[2, :3] + cam_T_grip[2, 3] > 0.0).all())


def _refine(
    cam_T_grip: Array, points_grip_m: Array, measured_xy: Array, weight_xy: Array, iterations: int
) -> Recalibration | None:
    """Gauss-Newton on the weighted image error, on the manifold; None if it fails or ends behind the camera."""
    for _ in range(iterations):
        xy, rows = seen_from(cam_T_grip, points_grip_m)
        jacobian, residual = rows.reshape(-1, 6), (measured_xy - xy).ravel()
        weighted = weight_xy @ jacobian
        normal = jacobian.T @ weighted
        try:
            step = np.linalg.solve(normal, residual @ weighted)
        except np.linalg.LinAlgError:
            return None
        cam_T_grip = perturb(cam_T_grip, step)
        if not _in_front(cam_T_grip, points_grip_m):
            return None
        if np.abs(step[:3]).max() < 1e-10 and np.abs(step[3:]).max() < 1e-9:
            break
    error = float(residual @ weight_xy @ residual)
    return Recalibration(cam_T_grip, np.linalg.inv(normal), float(np.sqrt(error / residual.size)))


def _choose(every: list[Recalibration], expected_cam_T_grip: Array, corners: int) -> Recalibration:
    def turn(candidate: Recalibration) -> float:
        return float(np.linalg.norm(perturbation_between(expected_cam_T_grip, candidate.cam_T_grip)[3:]))

    return min(rivals(every, corners), key=turn)
