"""Why spots and poses don't fit each other: other readings of the poses are tried, and the one that fits is named."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.pointer import common_plane
from gripmon.laser.pointer.refinement import refine
from gripmon.laser.pointer.spot_problem import SpotProblem
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.records import Array

SUSPECT_PX = 3.0
"""Noise of spots from which it is asked whether the poses are what they are taken for."""
LEAST_AGREEING = 0.7
"""Part of the spots that has to fit another reading before it is named."""
_OFFSETS = (1, -1, 2, -2)


def check_reading(camera: Camera, base_T_ee: Array, uv_px: Array, fault: CalibrationError | None) -> None:
    """Raise :class:`CalibrationError` with the reading of poses (n, 4, 4) that spots (n, 2) fit, if there is one;
    ``fault`` is what was wrong with the reading that was taken.
    """
    xy = camera.undistort(uv_px)
    for poses, part, said in _readings(base_T_ee):
        try:
            found = refine(SpotProblem(camera, poses, uv_px[part]), common_plane.solve(xy[part], poses))
        except CalibrationError:
            continue
        if found.used.mean() > LEAST_AGREEING and found.scale < SUSPECT_PX:
            agree = f"{int(found.used.sum())} of {len(poses)} agree, {found.scale:.2g} px"
            raise CalibrationError(said.format(agree=agree)) from fault


def _readings(base_T_ee: Array) -> Iterator[tuple[Array, slice, str]]:
    """Poses, the spots that belong to them, and what there is to say with how well they fit."""
    everything = slice(None)
    inverted = np.stack([invert(pose) for pose in base_T_ee])
    yield inverted, everything, "the poses are ee_T_base: inverted, the spots fit ({agree}); base_T_ee"
    quaternions = Rotation.from_matrix(base_T_ee[:, :3, :3]).as_quat()
    reordered = base_T_ee.copy()
    reordered[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    yield (
        reordered,
        everything,
        ("the quaternions have w first: read so, the spots fit ({agree}); qx, qy, qz, qw, in this order"),
    )
    transposed = base_T_ee.copy()
    transposed[:, :3, :3] = base_T_ee[:, :3, :3].transpose(0, 2, 1)
    yield (
        transposed,
        everything,
        ("the rotations are the other way round: inverted, the spots fit ({agree}); base_R_ee"),
    )
    for offset in _OFFSETS:
        count = len(base_T_ee) - abs(offset)
        own = slice(max(offset, 0), max(offset, 0) + count)
        other = slice(max(-offset, 0), max(-offset, 0) + count)
        which = "later" if offset > 0 else "earlier"
        yield (
            base_T_ee[own],
            other,
            (
                f"poses and images are out of step: spots fit the poses {abs(offset)} row(s) {which} ({{agree}}); each "
                "spot with its own pose"
            ),
        )
