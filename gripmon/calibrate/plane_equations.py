"""The equations of the Plane Coincidence Constraint: from ideal image points and the plate's pose to ``cam_T_grip``.

The contact plane of the fingertips is the plate's x-y plane (self-viewing method, equations (5) to (7)):

    cam_T_grip = cam_T_plate plate_T_grip                                          (5)
    plate_T_grip = [[q1, -q2, 0, sx], [q2, q1, 0, sy], [0, 0, 1, -h], [0, 0, 0, 1]]   (6)
    q1² + q2² = 1                                                                  (7)

with both z axes into the plate.  h is the height of the contact plane in the gripper's frame; it is 0 in the paper,
whose origin lies between the fingertips.

In addition: the gripper's pose from all its visible edges without the plate, and how far that pose leaves the plate.
Edges that rise from the contact plane determine tilts several times better than corners in it: a slightly tilted plane
looks nearly the same, a leaning finger doesn't.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.bundle import independent_errors
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, perturb, perturbation_between, seen_from
from gripmon.model.least_squares import fit, whitening
from gripmon.model.records import Array

FEWEST_CORNERS = 2
INFERRED_FROM = 4
LARGEST_MISFIT = 0.1
"""Residuals, over the corners' spread, above which they mean another gripper and not inaccuracy."""
SMALLEST_SPREAD_M = 1e-5
NO_RECTANGLE = (
    "the innermost corners aren't a rectangle; two corners on each of two parallel fingertips, by their names"
)
_SIGNS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
"""Signs of x and y of the innermost corners."""


@dataclass(frozen=True, slots=True)
class GripperOnPlate:
    """A gripper on a plate: ``corners_m`` (c, 3), given or inferred, ``residuals_m`` (c, 2) on the plate in the
    gripper's axes, ``apart`` (3,): tilt about the gripper's x and y (rad) and gap (m, positive if the gripper is nearer
    to the camera than the plate) of the pose that explains the corners best without the plate; None if undetermined.
    """

    cam_T_grip: Array
    corners_m: Array
    residuals_m: Array
    apart: Array | None


def stand(
    camera: Camera,
    cam_T_plate: Array,
    uv_px: Array,
    covariance_px: Array,
    corners_m: Array | None,
    contact_m: float = 0.0,
) -> GripperOnPlate:
    """All steps for one image: ``uv_px`` (c, 2) weighted by ``covariance_px`` (c, 2, 2); the gripper's ``corners_m``
    (c, 3), whose contact plane lies at z = ``contact_m``, or None to infer them (see :func:`infer_rectangle`; then all
    are contact points).  Raises :class:`CalibrationError`.
    """
    xy, slopes = camera.undistort_with_jacobian(uv_px)
    if not np.isfinite(xy).all():
        raise CalibrationError("a corner lies outside of what the lens maps; corners in the image")
    heights = np.zeros(len(xy)) if corners_m is None else corners_m[:, 2] - contact_m
    plate_xy = back_project(cam_T_plate, xy, heights)
    variance = slopes @ covariance_px @ slopes.transpose(0, 2, 1)
    weight = _on_plate(cam_T_plate, xy, plate_xy, heights, variance)
    if corners_m is None:
        sides, start = infer_rectangle(plate_xy)
        inner = plate_xy[:INFERRED_FROM], weight[:INFERRED_FROM], 0.5 * _SIGNS * sides
        q, shift, sides = _refine(*inner, start[:2], start[2:], sides)
        known = np.concatenate([(plate_xy - shift) @ _turn(q), np.zeros((len(xy), 1))], axis=1)
        rectangle = 0.5 * _SIGNS * sides
        residuals = np.zeros((len(xy), 2))  # corners outside the rectangle are taken as measured
        residuals[:INFERRED_FROM] = known[:INFERRED_FROM, :2] - rectangle
        known[:INFERRED_FROM, :2] = rectangle
        if _spread(residuals[:INFERRED_FROM]) > LARGEST_MISFIT * _spread(rectangle):
            raise CalibrationError(NO_RECTANGLE)
    else:
        known = corners_m
        q, shift = coincide_linear(corners_m, plate_xy)
        _check_shape(corners_m, plate_xy, q, shift)
        q, shift, _ = _refine(plate_xy, weight, corners_m[:, :2], q, shift)
        residuals = (plate_xy - shift) @ _turn(q) - corners_m[:, :2]
    plate_T_grip = np.eye(4)
    plate_T_grip[:2, :2], plate_T_grip[:2, 3], plate_T_grip[2, 3] = _turn(q), shift, -contact_m
    cam_T_grip = cam_T_plate @ plate_T_grip
    apart = None if corners_m is None else _apart(cam_T_grip, xy, variance, corners_m)
    return GripperOnPlate(cam_T_grip, known, residuals, apart)


def back_project(cam_T_plate: Array, xy: Array, z_plate_m: Array) -> Array:
    """Points (c, 2) of the plate's frame at the heights ``z_plate_m`` (c,) seen at ideal image points ``xy`` (c, 2).

    Equation (8), with r the rotation and t the translation of ``cam_T_plate``, X/f = x, Y/f = y:

        [r11 r12 -x; r21 r22 -y; r31 r32 -1] [x_W y_W z_C]ᵀ = -[t1 + r13 z_W; t2 + r23 z_W; t3 + r33 z_W]

    Raises :class:`CalibrationError` if a line of sight runs along the plate.
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

        [x_G -y_G 1 0] [q1 q2 sx sy]ᵀ = x_W                                        (9)
        [y_G  x_G 0 1] [q1 q2 sx sy]ᵀ = y_W                                        (10)

    then (q1, q2) scaled to unit length, (7).  :class:`CalibrationError` for fewer corners, or corners that coincide.
    """
    if len(corners_m) < FEWEST_CORNERS:
        raise CalibrationError(f"{len(corners_m)} corner; at least {FEWEST_CORNERS}, which lie apart")
    x, y = corners_m[:, 0], corners_m[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    matrix = np.concatenate([np.stack([x, -y, one, zero], axis=1), np.stack([y, x, zero, one], axis=1)])
    if min(_spread(corners_m[:, :2]), _spread(plate_xy_m)) < SMALLEST_SPREAD_M:
        raise CalibrationError("the corners coincide; corners that lie apart")
    solution = np.linalg.lstsq(matrix, plate_xy_m.T.ravel(), rcond=None)[0]
    length = float(np.hypot(*solution[:2]))
    if length < 1e-6:
        raise CalibrationError("the corners don't fit the gripper at all (mirrored, or named wrongly?)")
    q = solution[:2] / length
    # Normalising changes the best shift: it makes the centroids coincide.
    return q, (plate_xy_m - corners_m[:, :2] @ _turn(q).T).mean(axis=0)


def _check_shape(corners_m: Array, plate_xy: Array, q: Array, shift: Array) -> None:
    """Reject corners that aren't this gripper's, with what they may be instead."""
    spread = _spread(corners_m[:, :2])
    misfit = _spread(plate_xy - shift - corners_m[:, :2] @ _turn(q).T)
    if misfit <= LARGEST_MISFIT * spread:
        return
    mirrored = corners_m * np.array([1.0, -1.0, 1.0])
    other_q, other_shift = coincide_linear(mirrored, plate_xy)
    if _spread(plate_xy - other_shift - mirrored[:, :2] @ _turn(other_q).T) < 0.3 * misfit:
        raise CalibrationError(
            "the corners are mirrored; an image that isn't flipped, and corners by their right names"
        )
    raise CalibrationError(
        f"the corners don't fit the gripper: they lie {1e3 * misfit:.2g} mm from its own, which reach "
        f"{1e3 * spread:.3g} mm; the gripper, jaw opening and target as they were, corners by their right names"
    )


def infer_rectangle(plate_xy_m: Array) -> tuple[Array, Array]:
    """Sides (2,) along x and y, and ``(q1, q2, sx, sy)``, of the rectangle whose corners are the first four points, in
    the order of :func:`gripmon.calibrate_plane`; from means of opposite sides.  :class:`CalibrationError` if it isn't a
    rectangle.
    """
    a, b, c, d = plate_xy_m[:INFERRED_FROM]
    across, along = 0.5 * ((c - a) + (d - b)), 0.5 * ((b - a) + (d - c))
    sides = np.array([np.hypot(*across), np.hypot(*along)])
    if sides.min() < 1e-4:
        raise CalibrationError("the innermost corners coincide, or have each other's names; two on each finger")
    # With z into the plate, y is 90 degrees clockwise of x as seen by the camera: x cross y is z.
    turning = float(across[0] * along[1] - across[1] * along[0]) / float(sides.prod())
    if turning < -0.5:
        raise CalibrationError(
            "the innermost corners are mirrored: fingers or corners have each other's names, or the image is mirrored"
        )
    if turning < 0.9:
        raise CalibrationError(NO_RECTANGLE)
    direction = across / sides[0] + np.array([along[1], -along[0]]) / sides[1]
    q = direction / np.hypot(*direction)
    return sides, np.concatenate([q, plate_xy_m[:INFERRED_FROM].mean(axis=0)])


def _refine(
    plate_xy: Array, weight: Array, corners_xy: Array, q: Array, shift: Array, sides: Array | None = None
) -> tuple[Array, Array, Array]:
    """Rotation, shift, and with ``sides`` (2,) the rectangle's: least residuals, whitened by ``weight`` (c, 2, 2)."""
    start = np.concatenate([[0.0], shift, [] if sides is None else sides])

    def turned_by(unknown: Array) -> Array:
        return _turn(np.array([np.cos(unknown[0]), np.sin(unknown[0])])) @ q

    def linearised(unknown: Array) -> tuple[Array, Array]:
        now = turned_by(unknown)
        own = corners_xy if sides is None else 0.5 * _SIGNS * unknown[3:]
        turned = own @ _turn(now).T
        rows = np.zeros((len(own), 2, len(unknown)))
        rows[:, 0, 0], rows[:, 1, 0] = -turned[:, 1], turned[:, 0]
        rows[:, 0, 1] = rows[:, 1, 2] = 1.0
        if sides is not None:
            rows[:, :, 3], rows[:, :, 4] = 0.5 * _SIGNS[:, :1] * now, 0.5 * _SIGNS[:, 1:] * np.array([-now[1], now[0]])
        return weight @ rows, np.einsum("nij,nj->ni", weight, plate_xy - turned - unknown[1:3])

    found = fit(start, linearised, np.add).state
    return turned_by(found), found[1:3], found[3:]


def _apart(cam_T_grip: Array, xy: Array, variance: Array, corners_m: Array) -> Array | None:
    """Tilt and gap of the pose that explains the corners best without the plate; None if undetermined."""
    if len(corners_m) < 4 or np.linalg.svd(corners_m - corners_m.mean(axis=0), compute_uv=False)[1] < 1e-4:
        return None
    own = perturbation_between(
        np.eye(4), invert(cam_T_grip) @ pose_of_points(cam_T_grip, corners_m, xy, whitening(variance))
    )
    return np.array([own[3], own[4], -own[2]])


def _on_plate(cam_T_plate: Array, xy: Array, plate_xy: Array, heights: Array, variance: Array) -> Array:
    """(c, 2, 2) whitening of errors on the plate that come from ``variance`` (c, 2, 2) of ideal coordinates."""
    points = np.concatenate([plate_xy, heights[:, None]], axis=1) @ cam_T_plate[:3, :3].T + cam_T_plate[:3, 3]
    z = points[:, 2, None, None]
    # d(xy)/d(plate x, y), inverted.
    by_plate = (cam_T_plate[:2, :2] - xy[:, :, None] * cam_T_plate[2, :2]) / z
    slope = np.linalg.inv(by_plate)
    return whitening(slope @ variance @ slope.transpose(0, 2, 1))


def _turn(q: Array) -> Array:
    return np.array([[q[0], -q[1]], [q[1], q[0]]])


def _spread(xy_m: Array) -> float:
    """Root mean square distance from the centroid."""
    return float(np.sqrt(np.mean(np.sum(np.square(xy_m - xy_m.mean(axis=0)), axis=1))))


@dataclass(frozen=True, slots=True)
class FreePose:
    """``cam_T_grip`` (4, 4) with the ``covariance`` (6, 6) of its error (position then rotation, camera axes), measured
    with ``camera``; ``points_m`` (n, 3) of the gripper represent what was measured.
    """

    cam_T_grip: Array
    covariance: Array
    camera: Camera
    points_m: Array

    def through(self, camera: Camera) -> Array:
        """The ``cam_T_grip`` (4, 4) that the same image shows if ``camera`` took it: least squares over the points."""
        out = self.cam_T_grip
        if camera is self.camera:
            return out
        uv_px = self.camera.project(self.points_m @ out[:3, :3].T + out[:3, 3])
        xy = camera.undistort(uv_px)
        seen = np.isfinite(xy).all(axis=1)
        return pose_of_points(out, self.points_m[seen], xy[seen])

    def own_slopes(self, cam_T_plate: Array, contact_m: float) -> Array:
        """(3, 6): effect of the pose's own independent errors, per standard deviation, on :func:`off_plate`."""
        roots = independent_errors(self.covariance)
        up, down = (
            np.array([off_plate(perturb(self.cam_T_grip, s * r), cam_T_plate, contact_m) for r in roots])
            for s in (0.5, -0.5)
        )
        out: Array = (up - down).T
        return out


def pose_of_points(start: Array, points_m: Array, xy: Array, whiten: Array | None = None) -> Array:
    """The pose (4, 4) near ``start`` that projects points (n, 3) to ideal coordinates ``xy`` (n, 2) with the least
    residuals, whitened by ``whiten`` (n, 2, 2).
    """

    def linearised(pose: Array) -> tuple[Array, Array]:
        seen, rows = seen_from(pose, points_m)
        values = xy - seen
        return (rows, values) if whiten is None else (whiten @ rows, np.einsum("nij,nj->ni", whiten, values))

    return fit(start, linearised, perturb).state


def off_plate(cam_T_grip: Array, cam_T_plate: Array, contact_m: float) -> Array:
    """(3,): tilt about the gripper's x and y (rad) of its contact plane, z = ``contact_m``, against the plate, and the
    gap (m) at its centre, positive if the gripper is nearer to the camera than the plate.
    """
    rotation, normal = cam_T_grip[:3, :3], cam_T_plate[:3, 2]
    across = rotation.T @ np.cross(normal, rotation[:, 2])
    contact = cam_T_grip[:3, 3] + contact_m * rotation[:, 2]
    return np.array([across[0], across[1], -normal @ (contact - cam_T_plate[:3, 3])])
