"""The closed form in the paper's eight steps: camera pose, plane and laser line from laser spots, without a start.

At each of M orientations the end-effector is shifted without rotation; the spot then moves on the plane by

    p = T_m + G_m C_R_B w,    G_m = I - u_m nᵀ / (u_mᵀ n)                                            (15), (20), (21)

(w the shift in base axes, u_m the beam, n the plane's normal, camera axes).  The paper takes each orientation by
itself, with an unknown scale and an unknown sign each.  Here all share one plane: with n known, spots are
``s = ray / (nᵀ ray)``, of the same scale 1 / distance everywhere, and an orientation's part in the plane is

    A_m = P G_m R / distance = (P R - (P v_m) (nᵀ R)) / distance,    R = C_R_B,  u_m ~ n + v_m,

P being the two axes of the plane.  Differences between orientations therefore have rank one, with the row nᵀ R, the
plane's normal in base axes; the component of all A_m orthogonal to it is P R / distance.  Steps 4 and 5 thus become
linear, over all orientations at once.  ``tools/benchmarks/laser_printed.py`` has the steps as printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.calibrate.robot_world import LEAST_TURN_RAD, least_turn_rad
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.plane_search import SUBSET, find_plane
from gripmon.laser.setup import LaserSetup, basis, origin_axes
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array

FEWEST_SHIFTS = 6
"""Minimum number of spots per orientation: twelve equations for the eleven unknowns of its matrix."""
FEWEST_ORIENTATIONS = 3
"""Two orientations differ by a rotation about a single axis."""
ON_A_LINE = 3e-3
"""Ratio of second to first singular value below which image points count as collinear."""
FLAT = 1e-3
"""Ratio of third to first singular value below which shifts count as coplanar."""
SAME_ORIENTATION_RAD = 4e-3


def solve(
    xy: Array, base_T_ee: Array, groups: Sequence[NDArray[np.intp]] | None = None, *, robust: bool = True
) -> LaserSetup:
    """The set-up from ideal image points ``xy`` (n, 2), which step 1 has undistorted, and poses (n, 4, 4); ``robust``:
    leave wrong spots out.  :class:`CalibrationError` if the data don't determine it.
    """
    check_spots(xy)
    usable = usable_orientations(base_T_ee, groups, SUBSET + 1)
    shifts = [base_T_ee[o.members, :3, 3] - o.centre_m for o in usable]
    normal, matrices = find_plane(xy, shifts, [o.members for o in usable], robust=robust)  # steps 2, 3
    usable = [replace(o, matrix=m) for o, m in zip(usable, matrices, strict=True)]
    cam_R_base, beams_cam, _ = rotation_and_beams([o.matrix[:, :3] for o in usable], normal)  # steps 4, 5
    direction = beam_in_hand(beams_cam, [o.base_R_ee for o in usable], cam_R_base)  # step 6
    point, shift, scales = positions(usable, base_T_ee, cam_R_base, direction, one_plane=True)  # step 7
    distance = float(scales[0])  # step 8, equation (34): nᵀ s = 1 for all spots, and their scale is the distance
    if distance <= 0.0:
        raise CalibrationError(
            "the spots put the plane behind the camera: poses and spots don't belong together (out of step, or "
            "ee_T_base for base_T_ee); each spot with the pose that it was seen at"
        )
    return LaserSetup.seen(make_transform(cam_R_base, shift), normal, distance, point, direction)


@dataclass(frozen=True, slots=True)
class Orientation:
    """Samples of one orientation: ``members`` (k,) are their indices; ``matrix`` (3, 4) is that of step 2, for shifts
    from ``centre_m`` (3,), base axes.
    """

    members: NDArray[np.intp]
    base_R_ee: Array
    centre_m: Array
    matrix: Array


def orientation_groups(base_T_ee: Array, tolerance_rad: float = SAME_ORIENTATION_RAD) -> list[NDArray[np.intp]]:
    """Indices of samples that share an orientation, ordered by first sample."""
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


def check_spots(xy: Array) -> None:
    """Reject ideal image points (n, 2) that are collinear."""
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

    Raises :class:`CalibrationError` if there are too few of them, or if they differ by rotations about a single axis.
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
            rotation = Rotation.from_matrix(base_T_ee[members, :3, :3]).mean().as_matrix()
            usable.append(Orientation(members, rotation, shifts.mean(axis=0), np.empty((3, 4))))
    if len(usable) < FEWEST_ORIENTATIONS:
        raise CalibrationError(
            f"the shifts lie in a plane or on a line at {len(large) - len(usable)} of {len(large)} orientations; at "
            f"least {FEWEST_ORIENTATIONS} orientations with shifts along three directions, e.g. x, y and z"
        )
    _check_turns(np.stack([o.base_R_ee for o in usable]))
    return usable


def _check_turns(base_R_ee: Array) -> None:
    """Reject rotations (M, 3, 3) that leave a direction of the end-effector fixed: the laser's position along it is
    then unobservable, because a shift of the base has the same effect.
    """
    if least_turn_rad(base_R_ee) < LEAST_TURN_RAD:
        raise CalibrationError(
            f"{len(base_R_ee)} orientations, turned about one axis only: where the laser sits along it stays unknown; "
            "at least three orientations, turned about at least two axes"
        )


def rotation_and_beams(motions: Sequence[Array], normal: Array) -> tuple[Array, Array, float]:
    """Steps 4 and 5, equations (19) to (29), from the matrices (3, 3) by which shifts in base axes move the spots of
    the plane ``normalᵀ s = 1`` (camera axes): ``cam_R_base`` (3, 3), the beams (M, 3) in camera axes (unit, oriented
    along the normal whichever way the laser points), and the plane's distance (m).
    """
    plane = np.stack(basis(normal))
    flat = np.stack([plane @ m for m in motions])  # A_m
    mean = flat.mean(axis=0)
    _, sizes, rows = np.linalg.svd((flat - mean).reshape(-1, 3), full_matrices=False)
    if sizes[0] < FLAT * np.linalg.norm(flat):
        raise CalibrationError(
            "the beam meets the plane at the same angle at every orientation; orientations that tilt the beam"
        )
    normal_base = rows[0]  # up to its sign
    # P R / distance has two orthogonal rows of equal length: take the nearest such matrix.
    left, sizes, right = np.linalg.svd(mean @ (np.eye(3) - np.outer(normal_base, normal_base)), full_matrices=False)
    if sizes[1] < FLAT * sizes[0]:
        raise CalibrationError("the spots move along one line only; a beam that doesn't run along the plane")
    turned = left @ right
    scale = float(sizes.mean())
    normal_base = np.cross(turned[0], turned[1])
    cam_R_base: Array = np.concatenate([plane, normal[None]]).T @ np.concatenate([turned, normal_base[None]])
    leaning = -(flat @ normal_base) / scale  # P v_m
    beams_cam = normal + leaning @ plane
    return cam_R_base, beams_cam / np.linalg.norm(beams_cam, axis=1)[:, None], 1.0 / scale


def beam_in_hand(beams_cam: Sequence[Array] | Array, base_R_ee: Sequence[Array], cam_R_base: Array) -> Array:
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
    """Step 7, equations (32) and (33): the laser's point (3,) in the end-effector, the base's position (3,) in the
    camera frame, and each orientation's scale (M,), solved jointly:

        u_m x (C_R_B (B_R_E p + t) + C_t_B - s_m H_m [w 1]) = 0

    for every pose of each orientation, with its position t and its shift w from the central one.  With ``one_plane``
    all matrices share one scale.  Spots are predicted by the matrices instead of measured, so that wrong spots, which
    had no part in the matrices, have none here.
    """
    axes = list(origin_axes(direction_ee))
    count = 1 if one_plane else len(orientations)
    rows, sides = [], []
    for m, orientation in enumerate(orientations):
        shifts_m = base_T_ee[orientation.members, :3, 3] - orientation.centre_m
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
    return point, solution[2:5], solution[5:]
