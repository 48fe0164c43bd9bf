"""The Plane Coincidence Constraint: ``cam_T_grip`` from one image of the gripper standing on a calibration plate.

The contact plane of the fingertips is the plate's x-y plane, so that ``cam_T_grip = cam_T_plate plate_T_grip`` with one
rotation and two translations left (self-viewing method, equations (5) to (7)):

    plate_T_grip = [[q1, -q2, 0, sx], [q2, q1, 0, sy], [0, 0, 1, 0], [0, 0, 0, 1]],   q1² + q2² = 1

Both z axes point into the plate, away from the camera.  The gripper's corners need not be known: the four innermost
ones of two fingertips form a rectangle about the TCP with sides along the gripper's axes, so that the same image gives
the gripper's coordinates, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from gripmon.calibration.bundle import Bundle
from gripmon.calibration.intrinsics import lens_vector, model_of, plate_pose
from gripmon.calibration.lens_models import LensModel, parameter_names
from gripmon.calibration.sighting import CalibrationError, Sighting
from gripmon.camera import Camera, LensSettings, make_camera
from gripmon.geometry import perturb, perturbation_between
from gripmon.records import Array

FEWEST_CORNERS = 2
INFERRED_FROM = 4
DOUBTED = 1e-3
"""Probability below which residuals, or the plane's coincidence, are said to contradict their uncertainty."""
_STEP = 0.05
"""Central differences reach so many standard deviations."""
_ITERATIONS = 6
_SIGNS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
"""Of x and y of the innermost corners."""


@dataclass(frozen=True, slots=True)
class FingerCorners:
    """Measured corners of the gripper in one image: ``names`` (c), ``uv_px`` (c, 2), ``covariance_px`` (c, 2, 2)."""

    names: tuple[str, ...]
    uv_px: Array
    covariance_px: Array


@dataclass(frozen=True, slots=True)
class Coincidence:
    """What one image on the plate tells.

    ``cam_T_grip`` (4, 4) with the ``covariance`` (6, 6) of its error: position of the TCP, then rotation, camera axes;
    corners, plate and, where given, the camera contribute.  ``corners_m`` (c, 3): the gripper's corners, given or
    inferred, with ``corners_covariance`` (3c, 3c), zero if given.  ``residuals_m`` (c, 2) on the plate, gripper axes;
    ``p_value`` of them, 1 where nothing is left over to test (two known corners leave one equation, four inferred
    ones three).
    ``tilt_rad`` (2,) about the gripper's x and y and ``gap_m`` by which the corners, taken alone, leave the plate, with
    ``apart_sigma`` (3,) and the probability ``apart_p`` of that by chance; None where fewer than four known corners
    can't tell.
    """

    cam_T_grip: Array
    covariance: Array
    corners_m: Array
    corners_covariance: Array
    residuals_m: Array
    p_value: float
    tilt_rad: Array | None
    gap_m: float | None
    apart_sigma: Array | None
    apart_p: float | None
    cam_T_plate: Array
    plate: Bundle


def back_project(cam_T_plate: Array, xy: Array, z_plate_m: Array) -> Array:
    """Points (c, 2) of the plate's frame at the heights ``z_plate_m`` (c,) that ideal image points ``xy`` (c, 2) show.

    Equation (8), with r the rotation and t the translation of ``cam_T_plate``, X/f = x, Y/f = y:

        [r11 r12 -x; r21 r22 -y; r31 r32 -1] [x_W y_W z_C]ᵀ = -[t1 + r13 z_W; t2 + r23 z_W; t3 + r33 z_W]

    Raises :class:`CalibrationError` where a line of sight runs along the plate.
    """
    count = len(xy)
    matrix = np.empty((count, 3, 3))
    matrix[:, :, 0], matrix[:, :, 1] = cam_T_plate[:3, 0], cam_T_plate[:3, 1]
    matrix[:, :2, 2], matrix[:, 2, 2] = -xy, -1.0
    side = -(cam_T_plate[:3, 3] + z_plate_m[:, None] * cam_T_plate[:3, 2])
    if (np.abs(np.linalg.det(matrix)) < 1e-6).any():
        raise CalibrationError("a line of sight runs along the plate; a camera that looks onto it")
    found = np.linalg.solve(matrix, side[:, :, None])[:, :, 0]
    if (found[:, 2] <= 0.0).any():
        raise CalibrationError("a corner lies beyond the plate's horizon; corners on the plate")
    return found[:, :2]


def coincide_linear(corners_m: Array, plate_xy_m: Array) -> tuple[Array, Array]:
    """``(q1, q2)`` of unit length and ``(sx, sy)`` by linear least squares over n >= 2 corners, equations (9), (10):

        [x_G -y_G 1 0; y_G x_G 0 1] [q1 q2 sx sy]ᵀ = [x_W y_W]ᵀ,   then (q1, q2) scaled to unit length

    :class:`CalibrationError` for fewer corners, or corners that coincide.
    """
    if len(corners_m) < FEWEST_CORNERS:
        raise CalibrationError(f"{len(corners_m)} corner; at least {FEWEST_CORNERS}, which lie apart")
    x, y = corners_m[:, 0], corners_m[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    matrix = np.concatenate([np.stack([x, -y, one, zero], axis=1), np.stack([y, x, zero, one], axis=1)])
    spread = np.linalg.svd(corners_m[:, :2] - corners_m[:, :2].mean(axis=0), compute_uv=False)[0]
    if spread < 1e-5:
        raise CalibrationError("the corners coincide; corners that lie apart")
    solution = np.linalg.lstsq(matrix, plate_xy_m.T.ravel(), rcond=None)[0]
    length = float(np.hypot(*solution[:2]))
    if length < 0.2:
        raise CalibrationError("the corners don't fit the gripper at all (mirrored, or named wrongly?)")
    q = solution[:2] / length
    # With unit length the best shift is another one: the centres coincide.
    turn = np.array([[q[0], -q[1]], [q[1], q[0]]])
    return q, (plate_xy_m - corners_m[:, :2] @ turn.T).mean(axis=0)


def calibrate_plane(
    camera: LensSettings,
    sighting: Sighting,
    corners: FingerCorners,
    corners_m: Array | None,
    camera_covariance: Array | None = None,
    camera_parameters: Sequence[str] = (),
) -> Coincidence:
    """``cam_T_grip`` from one image of the plate with the gripper on it.

    ``corners_m`` (c, 3) in the gripper's frame, at the jaw opening of the image; or None: the gripper is inferred, and
    the first four of ``corners`` are the innermost ones, in the order (first finger, y < 0), (first, y > 0), (second,
    y < 0), (second, y > 0), the second finger on the side of +x; all corners then are contact points.
    ``camera_covariance`` is that of ``camera_parameters``, named as in its file.  Raises :class:`CalibrationError`.
    """
    if corners_m is None and len(corners.names) < INFERRED_FROM:
        raise CalibrationError(
            f"{len(corners.names)} corner(s) of a gripper that isn't known; the {INFERRED_FROM} innermost ones"
        )
    if len(corners.names) < FEWEST_CORNERS:
        raise CalibrationError(
            f"{len(corners.names)} corner of the gripper; at least {FEWEST_CORNERS}, which lie apart"
        )
    cam_T_plate, plate_covariance, bundle = plate_pose(camera, sighting)
    made = make_camera(camera)
    given = _Given(made, cam_T_plate, corners.uv_px)

    def solve(given: _Given) -> _Solved:
        return _solve(given, corners.covariance_px, corners_m)

    found = solve(given)
    directions = [*_plate_directions(given, plate_covariance), *_corner_directions(given, corners.covariance_px)]
    if camera_covariance is not None and len(camera_parameters):
        directions += _camera_directions(given, camera, sighting, camera_covariance, camera_parameters)
    slopes = [_slope(solve, direction) for direction in directions]
    motion, shape, left, apart = (np.stack(columns, axis=1) for columns in zip(*slopes, strict=True))
    knows_apart = found.apart is not None
    apart_covariance = apart @ apart.T if knows_apart else None
    return Coincidence(
        cam_T_grip=found.cam_T_grip,
        covariance=motion @ motion.T,
        corners_m=found.corners_m,
        corners_covariance=shape @ shape.T,
        residuals_m=found.residuals_m,
        p_value=_chance(found.residuals_m.ravel(), left @ left.T),
        tilt_rad=found.apart[:2] if found.apart is not None else None,
        gap_m=float(found.apart[2]) if found.apart is not None else None,
        apart_sigma=None if apart_covariance is None else np.sqrt(apart_covariance.diagonal()),
        apart_p=None if found.apart is None or apart_covariance is None else _chance(found.apart, apart_covariance),
        cam_T_plate=cam_T_plate,
        plate=bundle,
    )


@dataclass(frozen=True, slots=True)
class _Given:
    """What a solution rests on."""

    camera: Camera
    cam_T_plate: Array
    uv_px: Array


@dataclass(frozen=True, slots=True)
class _Solved:
    """``apart`` (3,): tilt about the gripper's x and y, and gap along z (rad, m); None where it can't be told."""

    cam_T_grip: Array
    corners_m: Array
    residuals_m: Array
    apart: Array | None


_Direction = Callable[[float], _Given]
"""What the solution rests on, changed by so many standard deviations of one independent error."""


def _solve(given: _Given, covariance_px: Array, corners_m: Array | None) -> _Solved:
    xy, slopes = given.camera.undistort_with_jacobian(given.uv_px)
    if not np.isfinite(xy).all():
        raise CalibrationError("a corner lies outside of what the lens maps; corners in the image")
    heights = np.zeros(len(xy)) if corners_m is None else corners_m[:, 2]
    plate_xy = back_project(given.cam_T_plate, xy, heights)
    variance = slopes @ covariance_px @ slopes.transpose(0, 2, 1)
    weight = _on_plate(given.cam_T_plate, xy, plate_xy, heights, variance)
    if corners_m is None:
        shape, start = infer_rectangle(plate_xy)
        q, shift, sides = _refine_rectangle(plate_xy, weight, shape, start)
        turn = _turn(q)
        known = np.concatenate([(plate_xy - shift) @ turn, np.zeros((len(xy), 1))], axis=1)
        rectangle = 0.5 * _SIGNS * sides
        residuals = known[:INFERRED_FROM, :2] - rectangle
        known[:INFERRED_FROM, :2] = rectangle
    else:
        known = corners_m
        q, shift = _refine(plate_xy, weight, corners_m, *coincide_linear(corners_m, plate_xy))
        residuals = (plate_xy - shift) @ _turn(q) - corners_m[:, :2]
    plate_T_grip = np.eye(4)
    plate_T_grip[:2, :2], plate_T_grip[:2, 3] = _turn(q), shift
    cam_T_grip = given.cam_T_plate @ plate_T_grip
    apart = None if corners_m is None else _apart(cam_T_grip, xy, variance, corners_m)
    return _Solved(cam_T_grip, known, residuals, apart)


def infer_rectangle(plate_xy_m: Array) -> tuple[Array, Array]:
    """Sides (2,) along x and y, and ``(q1, q2, sx, sy)``, of the rectangle whose corners the first four points are, in
    the order of :func:`calibrate_plane`; by means of opposite sides.  :class:`CalibrationError` for what is none.
    """
    a, b, c, d = plate_xy_m[:INFERRED_FROM]
    across, along = 0.5 * ((c - a) + (d - b)), 0.5 * ((b - a) + (d - c))
    sides = np.array([np.hypot(*across), np.hypot(*along)])
    if sides.min() < 1e-4:
        raise CalibrationError("the innermost corners coincide; two on each finger")
    # With z into the plate, y lies a quarter turn clockwise of x for who looks at it: x cross y is z.
    turning = float(across[0] * along[1] - across[1] * along[0]) / float(sides.prod())
    if turning < -0.5:
        raise CalibrationError(
            "the innermost corners are mirrored: fingers or corners have each other's names, or the image is mirrored"
        )
    if turning < 0.9:
        raise CalibrationError("the innermost corners are no rectangle; two corners on each of two parallel fingertips")
    direction = across / sides[0] + np.array([along[1], -along[0]]) / sides[1]
    q = direction / np.hypot(*direction)
    return sides, np.concatenate([q, plate_xy_m[:INFERRED_FROM].mean(axis=0)])


def _refine(plate_xy: Array, weight: Array, corners_m: Array, q: Array, shift: Array) -> tuple[Array, Array]:
    """The rotation and shift with the least weighted residuals (Gauss-Newton; ``weight`` (c, 2, 2) whitens)."""
    for _ in range(_ITERATIONS):
        turned = corners_m[:, :2] @ _turn(q).T
        rows = np.zeros((len(corners_m), 2, 3))
        rows[:, 0, 0], rows[:, 1, 0] = -turned[:, 1], turned[:, 0]
        rows[:, 0, 1] = rows[:, 1, 2] = 1.0
        step = _least_squares(weight, rows, plate_xy - turned - shift)
        q, shift = _turn(_unit(step[0])) @ q, shift + step[1:]
    return q, shift


def _refine_rectangle(plate_xy: Array, weight: Array, sides: Array, start: Array) -> tuple[Array, Array, Array]:
    """The same with the rectangle's sides unknown, from its four corners."""
    q: Array = start[:2]
    shift: Array = start[2:]
    points, weight = plate_xy[:INFERRED_FROM], weight[:INFERRED_FROM]
    for _ in range(_ITERATIONS):
        turned = (0.5 * _SIGNS * sides) @ _turn(q).T
        rows = np.zeros((INFERRED_FROM, 2, 5))
        rows[:, 0, 0], rows[:, 1, 0] = -turned[:, 1], turned[:, 0]
        rows[:, 0, 1] = rows[:, 1, 2] = 1.0
        rows[:, :, 3], rows[:, :, 4] = 0.5 * _SIGNS[:, :1] * q, 0.5 * _SIGNS[:, 1:] * np.array([-q[1], q[0]])
        step = _least_squares(weight, rows, points - turned - shift)
        q, shift, sides = _turn(_unit(step[0])) @ q, shift + step[1:3], sides + step[3:]
    return q, shift, sides


def _apart(cam_T_grip: Array, xy: Array, variance: Array, corners_m: Array) -> Array | None:
    """Tilt and gap with which the corners, no plate considered, are best explained; None where they don't tell."""
    if len(corners_m) < 4 or np.linalg.svd(corners_m - corners_m.mean(axis=0), compute_uv=False)[1] < 1e-4:
        return None
    whiten = np.linalg.inv(np.linalg.cholesky(variance))
    free: Array = np.zeros(6)
    for _ in range(_ITERATIONS):
        # Moved in its own axes: shift, then turn.
        moved = perturb(np.eye(4), free)
        points = (corners_m @ moved[:3, :3].T + moved[:3, 3]) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
        x, y, z = points.T
        by_point = np.zeros((len(xy), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
        by_point[:, 0, 2], by_point[:, 1, 2] = -x / z**2, -y / z**2
        turned = corners_m @ moved[:3, :3].T
        by_motion = np.concatenate([np.broadcast_to(np.eye(3), (len(xy), 3, 3)), -_skews(turned)], axis=2)
        rows = by_point @ cam_T_grip[:3, :3] @ by_motion
        free = perturbation_between(
            np.eye(4), perturb(moved, _least_squares(whiten, rows, xy - points[:, :2] / points[:, 2:]))
        )
    return np.array([free[3], free[4], -free[2]])


def _plate_directions(given: _Given, covariance: Array) -> list[_Direction]:
    roots = np.linalg.cholesky(covariance).T
    def changed(change: Array) -> _Given:
        return replace(given, cam_T_plate=perturb(given.cam_T_plate, change))

    return [_along(changed, root) for root in roots]


def _corner_directions(given: _Given, covariance_px: Array) -> list[_Direction]:
    out: list[_Direction] = []
    for k, root in enumerate(np.linalg.cholesky(covariance_px)):
        for column in root.T:
            change = np.zeros_like(given.uv_px)
            change[k] = column
            out.append(_along(lambda c: replace(given, uv_px=given.uv_px + c), change))
    return out


def _camera_directions(
    given: _Given, camera: LensSettings, sighting: Sighting, covariance: Array, names: Sequence[str]
) -> list[_Direction]:
    """The plate's pose follows: with another camera the same image shows the plate elsewhere."""
    model = LensModel(model_of(camera), camera.width_px, camera.height_px)
    vector, places = lens_vector(camera), [parameter_names(model.name).index(name) for name in names]
    tied = "fx_px" in names and "fy_px" not in names

    def changed(change: Array) -> _Given:
        moved = vector.copy()
        moved[places] += change
        if tied:
            moved[1] *= moved[0] / vector[0]
        return replace(given, camera=model.camera(moved), cam_T_plate=plate_pose(model.settings(moved), sighting)[0])

    return [_along(changed, root) for root in np.linalg.cholesky(covariance).T]


def _along(changed: Callable[[Array], _Given], root: Array) -> _Direction:
    return lambda sigmas: changed(sigmas * root)


def _slope(solve: Callable[[_Given], _Solved], direction: _Direction) -> tuple[Array, Array, Array, Array]:
    """Derivatives by one independent error, in its standard deviations: of pose (6,), corners, residuals, apart."""
    up, down = solve(direction(_STEP)), solve(direction(-_STEP))
    per = 1.0 / (2.0 * _STEP)
    none = np.zeros(3)
    return (
        perturbation_between(down.cam_T_grip, up.cam_T_grip) * per,
        (up.corners_m - down.corners_m).ravel() * per,
        (up.residuals_m - down.residuals_m).ravel() * per,
        none if up.apart is None or down.apart is None else (up.apart - down.apart) * per,
    )


def _on_plate(cam_T_plate: Array, xy: Array, plate_xy: Array, heights: Array, variance: Array) -> Array:
    """(c, 2, 2) that whiten errors on the plate which come from ``variance`` (c, 2, 2) of ideal coordinates."""
    points = np.concatenate([plate_xy, heights[:, None]], axis=1) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    z = points[:, 2, None, None]
    # d(xy)/d(plate x, y), inverted.
    by_plate = (cam_T_plate[:2, :2] - xy[:, :, None] * cam_T_plate[2, :2]) / z
    slope = np.linalg.inv(by_plate)
    return np.linalg.inv(np.linalg.cholesky(slope @ variance @ slope.transpose(0, 2, 1)))


def _least_squares(whiten: Array, rows: Array, values: Array) -> Array:
    a = (whiten @ rows).reshape(-1, rows.shape[2])
    b = np.einsum("nij,nj->ni", whiten, values).ravel()
    out: Array = np.linalg.lstsq(a, b, rcond=None)[0]
    return out


def _chance(values: Array, covariance: Array) -> float:
    """Probability of values as large by their (perhaps singular) covariance; 1 where nothing is free."""
    variances, axes = np.linalg.eigh(covariance)
    free = variances > 1e-6 * max(float(variances.max()), 1e-300)
    if not free.any():
        return 1.0
    size = np.square(axes.T[free] @ values) / variances[free]
    return float(chi2.sf(size.sum(), int(free.sum())))


def _turn(q: Array) -> Array:
    return np.array([[q[0], -q[1]], [q[1], q[0]]])


def _unit(angle_rad: float) -> Array:
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


def _skews(points: Array) -> Array:
    """(n, 3) -> (n, 3, 3), the matrices of the cross products."""
    return np.cross(points[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)
