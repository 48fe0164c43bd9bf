"""Camera, plane and laser line, each in the frame in which it is fixed; and three ways to compute a spot.

What moves alone changes only its own parameters.  A file's covariance has the plane in the camera's frame; here it is
in the base's, so that a motion of the camera doesn't change it.

The three ways are equations (7) to (14) of the laser-pointer method: beam and plane (7)-(9), camera ray and plane
(10)-(12), beam and ray (13)-(14).  Each omits one of the three: if the plane moved, beam and ray still meet.  All are
in the base frame, to first order in the calibration's 13 parameters, the spot's two coordinates and the arm's six.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.setup import NAMES, LaserCalibration, LaserSetup, basis, origin_axes, pose_slopes, spots_on_plane
from gripmon.laser.spots import Spot
from gripmon.model.camera import Camera, make_camera
from gripmon.model.geometry import from_record, left_jacobians, perturb, skew
from gripmon.model.records import Array

PARAMETERS = (
    "base_T_cam.x_m", "base_T_cam.y_m", "base_T_cam.z_m",
    "base_T_cam.rx_rad", "base_T_cam.ry_rad", "base_T_cam.rz_rad",
    "plane_base.tilt_a_rad", "plane_base.tilt_b_rad", "plane_base.distance_m",
    "laser.turn_a_rad", "laser.turn_b_rad", "laser.shift_a_m", "laser.shift_b_m",
)  # fmt: skip
"""The parameters that :meth:`World.moved` changes."""

COUNT = len(PARAMETERS)
CAMERA, PLANE, LASER = slice(0, 6), slice(6, 9), slice(9, 13)
LEAST_NOISE_PX = 0.02
"""Minimum noise of spots (px), however well a calibration's own fitted, and however much the arm's noise explains."""


@dataclass(frozen=True, slots=True)
class World:
    """``base_T_cam`` (4, 4); ``lit``: the plane and the laser line, as a set-up whose camera frame is the base."""

    base_T_cam: Array
    lit: LaserSetup

    def moved(self, change: Array) -> World:
        """The world changed by (13,), in the order of :data:`PARAMETERS`, also by large amounts."""
        rest = np.concatenate([np.zeros(6), change[6:]])
        return World(perturb(self.base_T_cam, change[CAMERA]), self.lit.moved(rest))


@dataclass(frozen=True, slots=True)
class Prediction:
    """A pulse's predicted spot: ``spot_base_m`` (3,), ``uv_px`` (2,), derivatives of the latter: ``rows`` (2, 13) by
    :data:`PARAMETERS`, and ``arm_rows`` (2, 6) by a perturbation of ``base_T_ee``, base axes.
    """

    spot_base_m: Array
    uv_px: Array
    rows: Array
    arm_rows: Array

    @property
    def finite(self) -> bool:
        """False if the beam runs along the plane, or the spot is behind the camera or outside the lens's domain."""
        return bool(np.isfinite(self.uv_px).all() and np.isfinite(self.rows).all() and np.isfinite(self.arm_rows).all())


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The contents of a file: the ``world``, ``covariance`` (13, 13) of :data:`PARAMETERS`, and the standard deviation
    of a spot's coordinate according to the residuals.
    """

    world: World
    camera: Camera
    covariance: Array
    sigma_px: float


def calibrated(calibration: LaserCalibration) -> Calibrated:
    """From a file.  Raises :class:`CalibrationError` for numbers that make no set-up."""
    base_T_cam = from_record(calibration.base_T_cam)
    plane, laser = calibration.plane, calibration.laser
    normal, direction = np.array(plane.normal_base), np.array(laser.direction_ee)
    for name, vector in (("plane.normal_base", normal), ("laser.direction_ee", direction)):
        if not abs(float(np.linalg.norm(vector)) - 1.0) < 1e-3:
            raise CalibrationError(f"{name}: has length {np.linalg.norm(vector):.4g}; 1")
    world = World(
        base_T_cam, LaserSetup(np.eye(4), normal, plane.distance_base_m, np.array(laser.point_ee_m), direction)
    )
    if calibration.parameters != NAMES or len(calibration.covariance) != COUNT**2:
        raise CalibrationError(f"covariance: not that of {', '.join(NAMES)}; a file of gripmon calibrate laser")
    change = _to_base(base_T_cam, np.array(plane.normal_cam), normal)
    covariance = change @ np.array(calibration.covariance).reshape(COUNT, COUNT) @ change.T
    scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    smallest = float(np.linalg.eigvalsh(covariance / np.outer(scale, scale))[0])
    if not (np.isfinite(covariance).all() and smallest > -1e-6):
        raise CalibrationError("covariance: is none (not positive definite); a file of gripmon calibrate laser")
    sigma_px = max(calibration.residuals.sigma_px, LEAST_NOISE_PX)
    return Calibrated(world, make_camera(calibration.camera), 0.5 * (covariance + covariance.T), sigma_px)


def _to_base(base_T_cam: Array, normal_cam: Array, normal_base: Array) -> Array:
    """(13, 13): derivatives of :data:`PARAMETERS` by a file's parameters."""
    out = np.eye(COUNT)
    a, b = basis(normal_cam)
    # Derivative of the normal in the base: it rotates with the camera, and tilts in the camera's frame.
    normal = np.zeros((3, COUNT))
    normal[:, 3:6] = -skew(normal_base)
    normal[:, 6], normal[:, 7] = base_T_cam[:3, :3] @ a, base_T_cam[:3, :3] @ b
    out[6:8] = np.stack(basis(normal_base)) @ normal
    out[8] = normal.T @ base_T_cam[:3, 3]
    out[8, :3] += normal_base
    out[8, 8] += 1.0
    return out


def predict(world: World, camera: Camera, base_T_ee: Array) -> Prediction:
    """The spot at a pose (4, 4) from beam and plane, equations (7) to (9); NaN if there is none."""
    pose = base_T_ee[None]
    spots, slopes = spots_on_plane(world.lit, pose)
    cam_R_base = world.base_T_cam[:3, :3].T
    lever = spots[0] - world.base_T_cam[:3, 3]
    uv_px, by_cam = camera.project_with_jacobian((cam_R_base @ lever)[None])
    by_base = by_cam[0] @ cam_R_base
    rows = by_base @ slopes[0]
    rows[:, :3] = -by_base
    rows[:, 3:6] = by_base @ skew(lever)
    return Prediction(spots[0], uv_px[0], rows, by_base @ pose_slopes(world.lit, pose)[0])


def predict_moved(calibrated: Calibrated, change: Array, base_T_ee: Array) -> Prediction:
    """Like :func:`predict` for the world moved by ``change`` (13,); ``rows`` are derivatives by ``change`` there."""
    world = calibrated.world.moved(change)
    found = predict(world, calibrated.camera, base_T_ee)
    return Prediction(
        found.spot_base_m, found.uv_px, found.rows @ _chart(calibrated.world, world, change), found.arm_rows
    )


def _chart(origin: World, there: World, change: Array) -> Array:
    """(13, 13): a small addition to ``change``, as a perturbation by :data:`PARAMETERS` of the moved world."""
    out = np.eye(COUNT)
    out[3:6, 3:6] = left_jacobians(change[None, 3:6])[0]
    for first, before, after in (
        (6, origin.lit.normal_cam, there.lit.normal_cam), (9, origin.lit.direction_ee, there.lit.direction_ee),
    ):  # fmt: skip
        old, new = np.stack(basis(before)), np.stack(basis(after))
        out[first : first + 2, first : first + 2] = new @ old.T / np.hypot(1.0, np.hypot(*change[first : first + 2]))
    return _with_axes(out, origin.lit.direction_ee, there.lit.direction_ee)


def _with_axes(chart: Array, before: Array, after: Array) -> Array:
    """The laser's point moves in the plane of two axes, which may be different ones after a large rotation."""
    old, new = origin_axes(before), origin_axes(after)
    if old == new:
        return chart
    pierced = ({0, 1, 2} - set(new)).pop()
    for column, axis in zip((11, 12), old, strict=True):
        # A point may slide along the beam: project what leaves the new plane back onto it.
        shift = np.eye(3)[axis] - after / after[pierced] * (axis == pierced)
        chart[11:13, column] = shift[list(new)]
    return chart


def larger(a: Array, b: Array) -> Array:
    """The smallest covariance (k, k) that is nowhere below either of two; ``b`` positive definite."""
    root = np.linalg.cholesky(b)
    inverse = np.linalg.inv(root)
    values, axes = np.linalg.eigh(inverse @ a @ inverse.T)
    out: Array = root @ (axes * np.maximum(values, 1.0)) @ axes.T @ root.T
    return out


BEAM_PLANE, RAY_PLANE, BEAM_RAY = "beam and plane", "ray and plane", "beam and ray"
BEAM, RAY = "beam", "ray"
INPUTS = COUNT + 2 + 6
"""Number of inputs: parameters of the world, the spot's pixels, the arm's pose (base axes)."""
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True)
class Triangulation:
    """A spot computed in three ways: ``spots_base_m`` (3, 3) by beam and plane, by ray and plane, by beam and ray (the
    ray's point), with ``slopes`` (3, 3, 21); ``gap_m`` (3,) from the ray's nearest point to the beam's, with
    ``gap_slopes`` (3, 21).  NaN where undefined: beam or ray along the plane, or parallel to each other.
    """

    spots_base_m: Array
    slopes: Array
    gap_m: Array
    gap_slopes: Array


@dataclass(frozen=True, slots=True)
class _Line:
    """Point and direction (3,), with their derivatives (3, 21)."""

    point: Array
    direction: Array
    point_slopes: Array
    direction_slopes: Array


def triangulate(world: World, camera: Camera, base_T_ee: Array, uv_px: Array) -> Triangulation:
    """Triangulate a spot (2,) seen at a pose (4, 4)."""
    beam, ray = _beam(world, base_T_ee), _ray(world, camera, uv_px)
    first, first_slopes = _on_plane(world, beam)
    second, second_slopes = _on_plane(world, ray)
    third, third_slopes, gap, gap_slopes = _between(ray, beam)
    return Triangulation(
        np.stack([first, second, third]), np.stack([first_slopes, second_slopes, third_slopes]), gap, gap_slopes
    )


class SpotGap(NamedTuple):
    """Two of the three ways to compute a spot, and how far apart they put it.

    ``gap_m``: from the first way's result to the second's, base frame; ``sigma_m``: standard deviation of the distance,
    along the gap; ``square``: normalised square of the gap (chi-square with ``freedom``): about that while nothing has
    moved.
    """

    ways: tuple[str, str]
    gap_m: tuple[float, float, float]
    sigma_m: float
    square: float
    freedom: int


def disagreements(found: Triangulation, covariance: Array) -> tuple[SpotGap, ...]:
    """Disagreements of the ways that are defined; ``covariance`` (21, 21) of the inputs."""
    spots, slopes = found.spots_base_m, found.slopes
    names = (BEAM_PLANE, RAY_PLANE, BEAM_RAY)
    pairs = [
        ((names[i], names[k]), spots[k] - spots[i], slopes[k] - slopes[i], freedom)
        for i, k, freedom in ((0, 1, 2), (0, 2, 2), (1, 2, 1))
    ]
    pairs.append(((BEAM, RAY), found.gap_m, found.gap_slopes, 1))
    return tuple(
        _disagreement(names, gap, rows @ covariance @ rows.T, freedom)
        for names, gap, rows, freedom in pairs
        if np.isfinite(gap).all() and np.isfinite(rows).all()
    )


def _disagreement(names: tuple[str, str], gap: Array, covariance: Array, freedom: int) -> SpotGap:
    """A gap lies in a plane or on a line: its ``freedom`` directions are those with the largest variance."""
    values, axes = np.linalg.eigh(covariance)
    along = axes.T @ gap
    square = float((along[-freedom:] ** 2 / values[-freedom:]).sum())
    size = float(np.linalg.norm(gap))
    direction = gap / size if size > 0.0 else axes[:, -1]
    sigma_m = float(np.sqrt(max(direction @ covariance @ direction, 0.0)))
    x, y, z = gap.tolist()
    return SpotGap(names, (x, y, z), sigma_m, square, freedom)


def _beam(world: World, base_T_ee: Array) -> _Line:
    lit, turn = world.lit, base_T_ee[:3, :3]
    point_arm, direction = turn @ lit.point_ee_m, turn @ lit.direction_ee
    point_slopes, direction_slopes = np.zeros((3, INPUTS)), np.zeros((3, INPUTS))
    for column, tilt in zip((9, 10), basis(lit.direction_ee), strict=True):
        direction_slopes[:, column] = turn @ tilt
    for column, axis in zip((11, 12), origin_axes(lit.direction_ee), strict=True):
        point_slopes[:, column] = turn[:, axis]
    point_slopes[:, 15:18] = np.eye(3)
    point_slopes[:, 18:] = -skew(point_arm)
    direction_slopes[:, 18:] = -skew(direction)
    return _Line(point_arm + base_T_ee[:3, 3], direction, point_slopes, direction_slopes)


def _ray(world: World, camera: Camera, uv_px: Array) -> _Line:
    turn = world.base_T_cam[:3, :3]
    xy, by_uv = camera.undistort_with_jacobian(uv_px[None])
    direction = turn @ np.array([*xy[0], 1.0])
    point_slopes, direction_slopes = np.zeros((3, INPUTS)), np.zeros((3, INPUTS))
    point_slopes[:, :3] = np.eye(3)
    direction_slopes[:, 3:6] = -skew(direction)
    direction_slopes[:, COUNT : COUNT + 2] = turn[:, :2] @ by_uv[0]
    return _Line(world.base_T_cam[:3, 3], direction, point_slopes, direction_slopes)


def _on_plane(world: World, line: _Line) -> tuple[Array, Array]:
    """Equations (7) to (12): with the plane's normal n and distance d, n·(point + along direction) = d."""
    normal = world.lit.normal_cam
    steep = float(normal @ line.direction) / float(np.linalg.norm(line.direction))
    if not abs(steep) > _PARALLEL:
        return np.full(3, np.nan), np.full((3, INPUTS), np.nan)
    steep = float(normal @ line.direction)
    along = (world.lit.distance_m - normal @ line.point) / steep
    spot = line.point + along * line.direction
    moved = line.point_slopes + along * line.direction_slopes
    along_slopes = -normal @ moved
    for column, tilt in zip((6, 7), basis(normal), strict=True):
        along_slopes[column] -= tilt @ spot
    along_slopes[8] += 1.0
    return spot, moved + np.outer(line.direction, along_slopes / steep)


def _between(ray: _Line, beam: _Line) -> tuple[Array, Array, Array, Array]:
    """Equations (13) and (14): the ray's point nearest to the beam, and the gap to the beam's; derivatives follow from
    the two conditions that the gap is orthogonal to both lines.
    """
    w, u = ray.direction, beam.direction
    normal = np.array([[w @ w, -(w @ u)], [w @ u, -(u @ u)]])
    if not abs(np.linalg.det(normal)) > _PARALLEL**2 * (w @ w) * (u @ u):
        return np.full(3, np.nan), np.full((3, INPUTS), np.nan), np.full(3, np.nan), np.full((3, INPUTS), np.nan)
    apart = ray.point - beam.point
    z, s = np.linalg.solve(normal, -np.array([w @ apart, u @ apart]))
    spot, end = ray.point + z * w, beam.point + s * u
    gap = spot - end
    moved = ray.point_slopes + z * ray.direction_slopes
    end_moved = beam.point_slopes + s * beam.direction_slopes
    sides = np.stack(
        [w @ (moved - end_moved) + gap @ ray.direction_slopes, u @ (moved - end_moved) + gap @ beam.direction_slopes]
    )
    z_slopes, s_slopes = -np.linalg.solve(normal, sides)
    spot_slopes = moved + np.outer(w, z_slopes)
    end_slopes = end_moved + np.outer(u, s_slopes)
    return spot, spot_slopes, end - spot, end_slopes - spot_slopes


MOST_UNCERTAIN = 0.1
"""Largest standard deviation of a predicted spot, over the image's diagonal; above it there is no prediction."""


class Single(NamedTuple):
    """A pulse judged by itself; fields as in :class:`~gripmon.laser.judgement.SpotJudgement`."""

    uv_px: Array
    off_px: Array
    covariance_px: Array
    square: float
    spots_base_m: Array
    disagreements: tuple[SpotGap, ...]


def visible(calibrated: Calibrated, predicted: Prediction, arm: Array) -> str | None:
    """Why no spot can be predicted at a pose, None if one can; ``arm`` (6, 6): covariance of the arm's poses."""
    if not predicted.finite:
        if not np.isfinite(predicted.spot_base_m).all():
            return "the beam runs along the plane"
        return "the beam meets the plane behind the camera or outside of its lens"
    spread = spread_px(calibrated, predicted, arm)
    largest = math.sqrt(float(np.linalg.eigvalsh(spread)[-1]))
    if largest > MOST_UNCERTAIN * math.hypot(calibrated.camera.width_px, calibrated.camera.height_px):
        return f"the beam nearly runs along the plane: the spot can't be predicted to better than {largest:.0f} px"
    return None


def spread_px(calibrated: Calibrated, predicted: Prediction, arm: Array) -> Array:
    """Covariance (2, 2) of a predicted spot, due to the calibration and the arm."""
    return predicted.rows @ calibrated.covariance @ predicted.rows.T + predicted.arm_rows @ arm @ predicted.arm_rows.T


def alone(calibrated: Calibrated, predicted: Prediction, base_T_ee: Array, spot: Spot, arm: Array) -> Single:
    """Judge a spot by itself.  The calibration's residuals include the arm's noise, so the noise is the larger of the
    residuals' and that of spot plus arm.
    """
    floor = calibrated.sigma_px**2 * np.eye(2)
    by_arm = predicted.arm_rows @ arm @ predicted.arm_rows.T
    noise = larger(spot.covariance_px + by_arm, floor)
    covariance = predicted.rows @ calibrated.covariance @ predicted.rows.T + noise
    off = spot.uv_px - predicted.uv_px
    inputs = np.zeros((INPUTS, INPUTS))
    inputs[:COUNT, :COUNT] = calibrated.covariance
    inputs[COUNT : COUNT + 2, COUNT : COUNT + 2] = noise  # the arm's noise is included as pixels, and only once
    found = triangulate(calibrated.world, calibrated.camera, base_T_ee, spot.uv_px)
    return Single(
        spot.uv_px,
        off,
        covariance,
        float(off @ np.linalg.solve(covariance, off)),
        found.spots_base_m,
        disagreements(found, inputs),
    )
