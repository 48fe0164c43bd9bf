"""The closed form for noisy spots: one plane for all orientations, so one scale, and no sign to guess.

:mod:`~gripmon.laser.pointer.planar_start` gives the plane's normal n and, with spots ``s = ray / (nᵀ ray)`` that
have the same scale 1 / distance everywhere, one matrix an orientation whose part in the plane is

    A_m = P G_m R / distance = (P R - (P v_m) (nᵀ R)) / distance,    R = C_R_B,  u_m ~ n + v_m,

P the two axes of the plane.  So differences between orientations have rank one with nᵀ R, the plane's normal in base
axes, as their row; what is left of all A_m across it is P R / distance.  Steps 4 and 5 become linear, over all
orientations at once; the print's have an unknown scale and an unknown sign each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer.closed_form import (
    FLAT,
    beam_in_hand,
    check_spots,
    positions,
    usable_orientations,
)
from gripmon.laser.pointer.planar_start import SUBSET, planar_start
from gripmon.laser.pointer.setup import LaserSetup, basis
from gripmon.model.geometry import make_transform
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class Turn:
    """``cam_R_base`` (3, 3), the beams (M, 3) in camera axes (unit, towards the plane's far side or back: no sign), and
    the plane's ``distance_m``.
    """

    cam_R_base: Array
    beams_cam: Array
    distance_m: float


def solve(
    xy: Array, base_T_ee: Array, groups: Sequence[NDArray[np.intp]] | None = None, *, robust: bool = True
) -> LaserSetup:
    """As :func:`gripmon.laser.pointer.closed_form.solve`; ``robust``: wrong spots are sought and left out."""
    check_spots(xy)
    usable = usable_orientations(base_T_ee, groups, SUBSET + 1)
    shifts = [base_T_ee[o.members, :3, 3] - o.centre_m for o in usable]
    start = planar_start(xy, shifts, [o.members for o in usable], robust=robust)
    usable = [replace(o, matrix=m) for o, m in zip(usable, start.matrices, strict=True)]
    turn = turn_from_motions([o.matrix[:, :3] for o in usable], start.normal)
    direction = beam_in_hand(list(turn.beams_cam), [o.base_R_ee for o in usable], turn.cam_R_base)
    point, shift, scales = positions(usable, base_T_ee, turn.cam_R_base, direction, one_plane=True)
    distance = float(scales[0])
    if distance <= 0.0:
        raise CalibrationError(
            "the spots put the plane behind the camera: poses and spots don't belong together (out of step, or "
            "ee_T_base for base_T_ee); each spot with the pose that it was seen at"
        )
    return LaserSetup(make_transform(turn.cam_R_base, shift), start.normal, distance, point, direction)


def turn_from_motions(motions: Sequence[Array], normal: Array) -> Turn:
    """Steps 4 and 5 together, from the matrices (3, 3) by which shifts in base axes move the spots of the plane
    ``normalᵀ s = 1`` (camera axes).
    """
    plane = np.stack(basis(normal))
    flat = np.stack([plane @ m for m in motions])
    apart = flat - flat.mean(axis=0)
    left, sizes, rows = np.linalg.svd(apart.reshape(-1, 3), full_matrices=False)
    if sizes[0] < FLAT * np.linalg.norm(flat):
        raise CalibrationError(
            "the beam meets the plane at the same angle at every orientation; orientations that tilt the beam"
        )
    across = rows[0]
    mean = flat.mean(axis=0) @ (np.eye(3) - np.outer(across, across))
    # P R / distance has two rows of equal length that stand on each other: the nearest such matrix.
    left, sizes, right = np.linalg.svd(mean, full_matrices=False)
    if sizes[1] < FLAT * sizes[0]:
        raise CalibrationError("the spots move along one line only; a beam that doesn't run along the plane")
    turned = left @ right
    scale = float(sizes.mean())
    third = np.cross(turned[0], turned[1])
    cam_R_base: Array = np.concatenate([plane, normal[None]]).T @ np.concatenate([turned, third[None]])
    # A_m third = -(P v_m) / distance
    leaning = -(flat @ third) / scale
    beams = normal + leaning @ plane
    return Turn(cam_R_base, beams / np.linalg.norm(beams, axis=1)[:, None], 1.0 / scale)
