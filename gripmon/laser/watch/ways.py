"""Three ways to the same spot, equations (7) to (14) of the laser-pointer method, and how surely they disagree.

Beam and plane (7)-(9), camera ray and plane (10)-(12), beam and ray (13)-(14).  Each leaves one of the three out: if
the plane moved, beam and ray still meet.  All in the base frame, to first order in the calibration's 13 parameters,
the spot's two coordinates and the arm's six.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.laser.pointer.setup import basis, origin_axes
from gripmon.laser.watch.judgement import Disagreement
from gripmon.laser.watch.world import COUNT, World
from gripmon.model.camera import Camera
from gripmon.model.geometry import skew
from gripmon.model.records import Array

BEAM_PLANE, RAY_PLANE, BEAM_RAY = "beam and plane", "ray and plane", "beam and ray"
BEAM, RAY = "beam", "ray"
INPUTS = COUNT + 2 + 6
"""Parameters of the world, the spot's pixels, the arm's pose (base axes)."""
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True)
class Ways:
    """``spots_base_m`` (3, 3) by beam and plane, by ray and plane, by beam and ray (the ray's point), with ``slopes``
    (3, 3, 21); ``gap_m`` (3,) from the ray's nearest point to the beam's, ``gap_slopes`` (3, 21).  NaN where there is
    none: beam or ray along the plane, both along each other.
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


def ways(world: World, camera: Camera, base_T_ee: Array, uv_px: Array) -> Ways:
    """Of a spot (2,) seen at a pose (4, 4)."""
    beam, ray = _beam(world, base_T_ee), _ray(world, camera, uv_px)
    first, first_slopes = _on_plane(world, beam)
    second, second_slopes = _on_plane(world, ray)
    third, third_slopes, gap, gap_slopes = _between(ray, beam)
    return Ways(
        np.stack([first, second, third]), np.stack([first_slopes, second_slopes, third_slopes]), gap, gap_slopes
    )


def disagreements(found: Ways, covariance: Array) -> tuple[Disagreement, ...]:
    """Those of ways that exist; ``covariance`` (21, 21) of the inputs."""
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


def _disagreement(names: tuple[str, str], gap: Array, covariance: Array, freedom: int) -> Disagreement:
    """A gap lies in the plane, or on a line: the directions that it has are those it is the least known in."""
    values, axes = np.linalg.eigh(covariance)
    along = axes.T @ gap
    square = float((along[-freedom:] ** 2 / values[-freedom:]).sum())
    size = float(np.linalg.norm(gap))
    direction = gap / size if size > 0.0 else axes[:, -1]
    return Disagreement(names, gap, float(np.sqrt(max(direction @ covariance @ direction, 0.0))), square, freedom)


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
    """Equations (7) to (12): the plane's normal n and distance d give n·(point + along direction) = d."""
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
    """Equations (13) and (14): the ray's point nearest to the beam, and the gap to the beam's; with derivatives, from
    those of the two conditions that the gap stands on both.
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
