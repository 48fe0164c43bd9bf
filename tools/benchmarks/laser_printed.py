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
    beam_in_hand,
    check_spots,
    positions,
    usable_orientations,
)
from gripmon.laser.setup import LaserSetup, basis
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
    return LaserSetup.seen(make_transform(cam_R_base, shift), normal, distance, point, direction)


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
    for orientation, scale in zip(orientations, scales, strict=True):
        shifts = base_T_ee[orientation.members, :3, 3] - orientation.centre_m
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
