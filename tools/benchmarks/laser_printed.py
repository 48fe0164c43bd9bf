"""The laser-pointer method's closed form step by step as printed, which the one that is used is measured against.

At each of M orientations the end-effector is shifted without turning; the spot then moves on the plane by

    p = T_m + G_m C_R_B w,    G_m = I - u_m nᵀ / (u_mᵀ n)

(w the shift in the base's axes, u_m the beam, n the plane's normal, camera axes).  Every step is a function of its own;
noise-free data give exact results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.closed_form import (
    FEWEST_SHIFTS,
    FLAT,
    Orientation,
    _shifts_of,
    beam_in_hand,
    check_spots,
    positions,
    usable_orientations,
)
from gripmon.laser.setup import LaserSetup, basis, laser_lines
from gripmon.model.geometry import make_transform

Array = NDArray[np.float64]


def solve(xy: Array, base_T_ee: Array, groups: Sequence[NDArray[np.intp]] | None = None) -> LaserSetup:
    """All steps as printed: ideal image points (n, 2) (step 1 has undistorted them) and poses (n, 4, 4) -> the set-up.

    :func:`gripmon.laser.closed_form.solve` is the better one with noise.  Raises
    :class:`CalibrationError` that names the degenerate case: too few orientations, shifts in a plane, turned about one
    axis, a plane through the camera, a beam along the plane.
    """
    check_spots(xy)
    usable = [
        replace(o, matrix=spot_matrix(xy[o.members], base_T_ee[o.members, :3, 3] - o.centre_m))
        for o in usable_orientations(base_T_ee, groups, FEWEST_SHIFTS)
    ]
    normal = plane_normal([o.matrix for o in usable])
    chosen = consistent_beams([beam_candidates(o.matrix, normal) for o in usable])
    cam_R_base = Rotation.from_matrix([c.cam_R_base for c in chosen]).mean().as_matrix()
    direction = beam_in_hand([c.beam_cam for c in chosen], [o.base_R_ee for o in usable], cam_R_base)
    point, shift, scales = positions(usable, base_T_ee, cam_R_base, direction)
    distance = plane_distance(usable, scales, normal, base_T_ee)
    if distance < 0.0:
        normal, distance = -normal, -distance
    return LaserSetup(make_transform(cam_R_base, shift), normal, distance, point, direction)


def spot_matrix(xy: Array, shifts_m: Array) -> Array:
    """Step 2, equations (15) to (17): the matrix (3, 4) with ``z [x y 1]ᵀ = H [w 1]ᵀ`` by direct linear transformation,
    of any scale, its sign such that depths are positive; shifts (k, 3) are scaled first, for the sake of rounding.
    """
    scale = float(np.linalg.norm(shifts_m, axis=1).mean())
    w = np.concatenate([shifts_m / scale, np.ones((len(xy), 1))], axis=1)
    middle, size = xy.mean(axis=0), float(np.linalg.norm(xy - xy.mean(axis=0), axis=1).mean())
    if size < 1e-9:
        raise CalibrationError("the spots of an orientation coincide; shifts that move the spot in the image")
    x, y = ((xy - middle) / size).T
    zero = np.zeros_like(w)
    rows = np.concatenate(
        [np.concatenate([w, zero, -x[:, None] * w], axis=1), np.concatenate([zero, w, -y[:, None] * w], axis=1)]
    )
    found = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    matrix = np.array([[size, 0.0, middle[0]], [0.0, size, middle[1]], [0.0, 0.0, 1.0]]) @ found
    matrix[:, :3] /= scale
    depth = matrix[2] @ np.concatenate([shifts_m, np.ones((len(xy), 1))], axis=1).T
    return matrix * (np.sign(np.median(depth)) / np.linalg.norm(matrix[:, 3]))


def plane_normal(matrices: Sequence[Array]) -> Array:
    """Step 3, equation (18): what stands on all motions of the spot, the smallest singular vector (3,); away from the
    camera.
    """
    motions = np.concatenate([m[:, :3].T / np.linalg.norm(m[:, :3]) for m in matrices])
    _, sizes, axes = np.linalg.svd(motions)
    if sizes[1] < FLAT * sizes[0]:
        raise CalibrationError("the spots move along one line only; orientations and shifts that move it across, too")
    normal = axes[2]
    towards = float(np.median([normal @ m[:, 3] for m in matrices]))
    if abs(towards) < 1e-4:
        raise CalibrationError("the plane goes through the camera; a plane that it sees from above")
    out: Array = normal * np.sign(towards)
    return out


@dataclass(frozen=True, slots=True)
class BeamCandidate:
    """A beam (3,) in camera axes, and the rotation between camera and base that it asks for."""

    beam_cam: Array
    cam_R_base: Array


def beam_candidates(matrix: Array, normal: Array) -> tuple[BeamCandidate, BeamCandidate]:
    """Step 4, equations (19) to (25), for one orientation: both beams that its matrix allows.

    With the beam written as ũ = u / (uᵀ n) = n + v, v in the plane, the left part A = lambda G C_R_B of the matrix has

        A Aᵀ = lambda² (I - ũ nᵀ - n ũᵀ + ũ ũᵀ) = lambda² (I - n nᵀ + v vᵀ):

    in the plane its eigenvalues are lambda² and lambda² (1 + |v|²), with v along the larger one's axis, of unknown
    sign.  (The print's equation (25) has lost its scale; this is the same with ũᵀ n = 1.)
    """
    a, b = basis(normal)
    plane = np.stack([a, b])
    motion = plane @ matrix[:, :3]
    values, axes = np.linalg.eigh(motion @ motion.T)
    if values[0] <= 1e-12 * values[1]:
        raise CalibrationError("the spot moves along one line only; a beam that doesn't run along the plane")
    slope = float(np.sqrt(max(values[1] / values[0] - 1.0, 0.0)))
    out = []
    for sign in (1.0, -1.0):
        v = plane.T @ (sign * slope * axes[:, 1])
        beam = normal + v
        # plane G = plane - (plane v) nᵀ; its rows, turned by C_R_B, are the measured motion's.
        rows = plane - np.outer(plane @ v, normal)
        out.append(BeamCandidate(beam / np.linalg.norm(beam), _rotation_of(rows, motion / np.sqrt(values[0]))))
    return out[0], out[1]


def consistent_beams(candidates: Sequence[tuple[BeamCandidate, BeamCandidate]]) -> list[BeamCandidate]:
    """One of each pair, such that all ask for the same rotation between camera and base."""
    best: list[BeamCandidate] = []
    least = np.inf
    for pair in candidates:
        for start in pair:
            chosen = [min(p, key=lambda c: -float(np.trace(c.cam_R_base.T @ start.cam_R_base))) for p in candidates]
            mean = Rotation.from_matrix([c.cam_R_base for c in chosen]).mean().as_matrix()
            apart = sum(3.0 - float(np.trace(c.cam_R_base.T @ mean)) for c in chosen)
            if apart < least:
                best, least = chosen, apart
    return best


def plane_distance(orientations: Sequence[Orientation], scales: Array, normal: Array, base_T_ee: Array) -> float:
    """Step 8, equation (34): the mean of nᵀ p over all spots (m)."""
    distances = []
    for orientation, scale, shifts in zip(orientations, scales, _shifts_of(orientations, base_T_ee), strict=True):
        spots = scale * np.concatenate([shifts, np.ones((len(shifts), 1))], axis=1) @ orientation.matrix.T
        distances.append(spots @ normal)
    return float(np.mean(np.concatenate(distances)))


def _rotation_of(rows: Array, turned: Array) -> Array:
    """The rotation R with ``rows R = turned``, both (2, 3), nearest to it (Kabsch, 1976)."""
    before = np.concatenate([rows, np.cross(rows[0], rows[1])[None]])
    after = np.concatenate([turned, np.cross(turned[0], turned[1])[None]])
    left, _, right = np.linalg.svd(before.T @ after)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    out: Array = left @ flip @ right
    return out


def spots_on_rays(setup: LaserSetup, xy: Array) -> tuple[Array, Array]:
    """Camera ray and plane, equations (10) to (12): spots (n, 3) in the camera frame of ideal image points (n, 2), and
    their derivatives (n, 3, 2) by these; NaN where a ray doesn't meet the plane before the camera.
    """
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    n = setup.normal_cam
    steep = rays @ n
    depth = setup.distance_m / np.where(np.abs(steep) > 1e-9, steep, np.nan)
    depth = np.where(depth > 0.0, depth, np.nan)
    spots = depth[:, None] * rays
    slopes = depth[:, None, None] * (np.eye(3)[None, :, :2] - rays[:, :, None] * n[:2] / steep[:, None, None])
    return spots, slopes


def spots_between(setup: LaserSetup, base_T_ee: Array, xy: Array) -> tuple[Array, Array, Array]:
    """Laser line and camera ray, equations (13) and (14): the points of the rays (n, 3) that the lines come nearest to,
    the distances (n,) that are left between them (m), and the depths' derivatives (n, 2) by the image points; NaN where
    both are parallel.  No plane is needed: it may have moved.
    """
    origin, u = laser_lines(setup, base_T_ee)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    # The depth z at which z ray is nearest to the line: (I - u uᵀ)(z ray - origin) has its least length.
    across = rays - u * np.einsum("ni,ni->n", rays, u)[:, None]
    size = np.einsum("ni,ni->n", across, across)
    size = np.where(size > 1e-12, size, np.nan)
    depth = np.einsum("ni,ni->n", across, origin) / size
    left = depth[:, None] * rays - origin
    left = left - u * np.einsum("ni,ni->n", left, u)[:, None]
    # d(depth) of d(xy): the quotient's derivative, the projection being its own square.
    flat = origin - u * np.einsum("ni,ni->n", origin, u)[:, None]
    slopes = (flat[:, :2] - 2.0 * depth[:, None] * across[:, :2]) / size[:, None]
    return depth[:, None] * rays, np.linalg.norm(left, axis=1), slopes
