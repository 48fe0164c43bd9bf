"""Eye, hand and workspace from laser spots in closed form: the eight steps of the laser-pointer method.

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
from gripmon.laser.pointer.setup import LaserSetup, basis, origin_axes
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array

FEWEST_SHIFTS = 6
"""Spots of an orientation: twelve equations for the eleven unknowns of its matrix."""
FEWEST_ORIENTATIONS = 3
"""Two differ by a turn about one axis."""
LEAST_TURN_RAD = 5e-3
"""How far a direction of the end-effector has to turn, root mean square over the orientations."""
ON_A_LINE = 3e-3
"""Second singular value over the first below which image points are said to lie on a line."""
FLAT = 1e-3
"""Third singular value over the first below which shifts are said to lie in a plane."""
SAME_ORIENTATION_RAD = 4e-3


@dataclass(frozen=True, slots=True)
class Orientation:
    """Samples of one orientation: ``members`` (k,) index them; ``matrix`` (3, 4) of step 2 for shifts from ``centre_m``
    (3,), base axes.
    """

    members: NDArray[np.intp]
    base_R_ee: Array
    centre_m: Array
    matrix: Array


def orientation_groups(base_T_ee: Array, tolerance_rad: float = SAME_ORIENTATION_RAD) -> list[NDArray[np.intp]]:
    """Indices of samples that share an orientation, in the order of their first ones."""
    groups: list[list[int]] = []
    firsts: list[Array] = []
    for index, rotation in enumerate(base_T_ee[:, :3, :3]):
        for group, first in zip(groups, firsts, strict=True):
            cosine = 0.5 * (float(np.einsum("ij,ij->", first, rotation)) - 1.0)
            if cosine > np.cos(tolerance_rad):
                group.append(index)
                break
        else:
            groups.append([index])
            firsts.append(rotation)
    return [np.array(group, dtype=np.intp) for group in groups]


def solve(xy: Array, base_T_ee: Array, groups: Sequence[NDArray[np.intp]] | None = None) -> LaserSetup:
    """All steps as printed: ideal image points (n, 2) (step 1 has undistorted them) and poses (n, 4, 4) -> the set-up.

    :func:`gripmon.laser.pointer.common_plane.solve` is the better one with noise.  Raises
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
    cam_R_base = mean_rotation([c.cam_R_base for c in chosen])
    direction = beam_in_hand([c.beam_cam for c in chosen], [o.base_R_ee for o in usable], cam_R_base)
    point, shift, scales = positions(usable, base_T_ee, cam_R_base, direction)
    distance = plane_distance(usable, scales, normal, base_T_ee)
    if distance < 0.0:
        normal, distance = -normal, -distance
    return LaserSetup(make_transform(cam_R_base, shift), normal, distance, point, direction)


def check_spots(xy: Array) -> None:
    """Refuse ideal image points (n, 2) that lie on one line."""
    if len(xy) < 3:
        raise CalibrationError(f"{len(xy)} spot(s); at least {2 * FEWEST_SHIFTS}, better 50")
    spread = np.linalg.svd(xy - np.median(xy, axis=0), compute_uv=False)
    if spread[1] < ON_A_LINE * spread[0] or spread[0] < 1e-12:
        raise CalibrationError(
            "all spots lie on one line in the image: the plane goes through the camera, or the shifts move the spot "
            "along one line only; a plane seen from above, and shifts that move the spot across the image, too"
        )


def usable_orientations(
    base_T_ee: Array, groups: Sequence[NDArray[np.intp]] | None, fewest: int = FEWEST_SHIFTS
) -> list[Orientation]:
    """Orientations with enough shifts that span space; their matrices are still empty.

    Raises :class:`CalibrationError` for too few of them, and for ones turned about a single axis.
    """
    groups = orientation_groups(base_T_ee) if groups is None else groups
    large = [members for members in groups if len(members) >= fewest]
    if len(large) < FEWEST_ORIENTATIONS:
        raise CalibrationError(
            f"{len(large)} orientation(s) with at least {fewest} spots each, of {len(groups)} in all; at least "
            f"{FEWEST_ORIENTATIONS}, better five, and at each of them the end-effector is shifted without being turned"
        )
    usable = []
    for members in large:
        shifts = base_T_ee[members, :3, 3]
        spread = np.linalg.svd(shifts - shifts.mean(axis=0), compute_uv=False)
        if spread[2] >= FLAT * spread[0] and spread[0] > 0.0:
            rotation = mean_rotation(list(base_T_ee[members, :3, :3]))
            usable.append(Orientation(members, rotation, shifts.mean(axis=0), np.empty((3, 4))))
    if len(usable) < FEWEST_ORIENTATIONS:
        raise CalibrationError(
            f"the shifts lie in a plane or on a line at {len(large) - len(usable)} of {len(large)} orientations; at "
            f"least {FEWEST_ORIENTATIONS} orientations with shifts along three directions, e.g. x, y and z"
        )
    _check_turns(np.stack([o.base_R_ee for o in usable]))
    return usable


def _check_turns(base_R_ee: Array) -> None:
    """Rotations (M, 3, 3) that leave a direction of the end-effector where it is can't tell how far along it the laser
    sits: a shift of the base does the same.
    """
    turns = (base_R_ee - base_R_ee.mean(axis=0)).reshape(-1, 3)
    moved = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(base_R_ee))
    if moved[2] < LEAST_TURN_RAD:
        raise CalibrationError(
            f"{len(base_R_ee)} orientations, turned about one axis only: where the laser sits along it stays unknown; "
            "at least three orientations, turned about at least two axes"
        )


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
            mean = mean_rotation([c.cam_R_base for c in chosen])
            apart = sum(3.0 - float(np.trace(c.cam_R_base.T @ mean)) for c in chosen)
            if apart < least:
                best, least = chosen, apart
    return best


def mean_rotation(rotations: Sequence[Array]) -> Array:
    """Step 5, equations (26) to (29): the rotation nearest to several ones, by the largest eigenvector of their
    quaternions' products (the print seeks the smallest one of the negative).
    """
    quaternions = Rotation.from_matrix(np.stack(rotations)).as_quat()
    axes = np.linalg.eigh(quaternions.T @ quaternions)[1]
    out: Array = Rotation.from_quat(axes[:, -1]).as_matrix()
    return out


def beam_in_hand(beams_cam: Sequence[Array], base_R_ee: Sequence[Array], cam_R_base: Array) -> Array:
    """Step 6, equations (30), (31): the beam's direction (3,) in the end-effector, least squares over orientations."""
    total = np.sum([(cam_R_base @ R).T @ u for u, R in zip(beams_cam, base_R_ee, strict=True)], axis=0)
    out: Array = total / np.linalg.norm(total)
    return out


def positions(
    orientations: Sequence[Orientation],
    base_T_ee: Array,
    cam_R_base: Array,
    direction_ee: Array,
    *,
    one_plane: bool = False,
) -> tuple[Array, Array, Array]:
    """Step 7, equations (32) and (33): the laser's point (3,) in the end-effector, the base's place (3,) in the camera
    frame, and each orientation's scale (M,), all together:

        u_m x (C_R_B (B_R_E p + t) + C_t_B - s_m H_m [w 1]) = 0

    for every pose of each orientation, t its position and w its shift from the central one.  With ``one_plane`` all
    matrices have the same scale.  What the matrices say of a spot takes the spot's place, so that wrong spots that had
    no part in them have none here.
    """
    axes = list(origin_axes(direction_ee))
    count = 1 if one_plane else len(orientations)
    rows, sides = [], []
    for m, (orientation, shifts_m) in enumerate(zip(orientations, _shifts_of(orientations, base_T_ee), strict=True)):
        turned = cam_R_base @ orientation.base_R_ee
        across = np.cross(np.eye(3), turned @ direction_ee)  # u x ..., up to a sign that both sides share
        spots = np.concatenate([shifts_m, np.ones((len(shifts_m), 1))], axis=1) @ orientation.matrix.T
        block = np.zeros((len(shifts_m), 3, 5 + count))
        block[:, :, :2] = across @ turned[:, axes]
        block[:, :, 2:5] = across
        block[:, :, 5 + min(m, count - 1)] = -spots @ across.T
        rows.append(block.reshape(-1, 5 + count))
        sides.append((-(shifts_m + orientation.centre_m) @ (across @ cam_R_base).T).ravel())
    matrix = np.concatenate(rows)
    sizes = np.linalg.norm(matrix, axis=0)
    singular = np.linalg.svd(matrix / sizes, compute_uv=False)
    if singular[-1] < 1e-9 * singular[0]:
        raise CalibrationError(
            "the orientations don't determine where the laser sits (turned about one axis only?); orientations turned "
            "about at least two axes"
        )
    solution = np.linalg.lstsq(matrix / sizes, np.concatenate(sides), rcond=None)[0] / sizes
    point = np.zeros(3)
    point[axes] = solution[:2]
    scales: Array = np.broadcast_to(solution[5:], (len(orientations),)) if one_plane else solution[5:]
    return point, solution[2:5], scales


def plane_distance(orientations: Sequence[Orientation], scales: Array, normal: Array, base_T_ee: Array) -> float:
    """Step 8, equation (34): the mean of nᵀ p over all spots (m)."""
    distances = []
    for orientation, scale, shifts in zip(orientations, scales, _shifts_of(orientations, base_T_ee), strict=True):
        spots = scale * np.concatenate([shifts, np.ones((len(shifts), 1))], axis=1) @ orientation.matrix.T
        distances.append(spots @ normal)
    return float(np.mean(np.concatenate(distances)))


def _shifts_of(orientations: Sequence[Orientation], base_T_ee: Array) -> list[Array]:
    return [base_T_ee[o.members, :3, 3] - o.centre_m for o in orientations]


def _rotation_of(rows: Array, turned: Array) -> Array:
    """The rotation R with ``rows R = turned``, both (2, 3), nearest to it (Kabsch, 1976)."""
    before = np.concatenate([rows, np.cross(rows[0], rows[1])[None]])
    after = np.concatenate([turned, np.cross(turned[0], turned[1])[None]])
    left, _, right = np.linalg.svd(before.T @ after)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    out: Array = left @ flip @ right
    return out
