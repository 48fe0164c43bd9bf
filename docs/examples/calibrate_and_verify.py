"""Calibrate a wrist camera and where its gripper is, from images of a calibration plate; then ask whether it holds.

    python calibrate_and_verify.py FOLDER

FOLDER holds ``plate/`` (images of the plate, tilted to all sides), ``standing/`` (the gripper stands on the plate, put
down again for each image) and ``rough.yaml`` (about where the fingertips' corners are in these, see ``gripmon calibrate
plane --help``).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from gripmon.calibrate.api import calibrate_intrinsics, verify
from gripmon.daemon.calibrations import read_rough_corners
from gripmon.model.images import image_paths
from gripmon.model.provenance import provenance_of
from gripmon.teach.hand_eye import calibrate_plane

TARGET = "circles:12x10:0.008:0.004"  # columns x rows, spacing and diameter of the discs in metres


def main(folder: Path) -> bool:
    """Whether two calibrations, from different images, are the same."""
    found = calibrate_intrinsics(image_paths([folder / "plate"]), TARGET, model="paper")
    print(f"focal length {found.camera.fx_px:.2f} ± {found.sigmas['fx_px']:.2f} px, rms {found.fit.rms_px:.3f} px")
    camera = found.document(provenance_of("docs/examples/calibrate_and_verify.py"))

    # The gripper isn't known: the four innermost corners of its fingertips are a rectangle about the TCP.
    rough = read_rough_corners(folder / "rough.yaml", gripper=None)
    first, second = (
        calibrate_plane([path], camera, None, TARGET, corners=rough) for path in image_paths([folder / "standing"])[:2]
    )
    x, y, z = (1e3 * first.cam_T_grip[:3, 3]).tolist()
    sigma_mm = 1e3 * np.sqrt(first.covariance.diagonal()[:3])
    print(f"TCP in the camera's frame ({x:.3f}, {y:.3f}, {z:.3f}) mm ± {np.round(sigma_mm, 4).tolist()}")

    verdict = verify(first.calibrated("first"), second.calibrated("second"))
    said = "the same" if verdict.same else "something else"
    print(f"the other image says {said}: p = {verdict.difference.p_value:.2g}")
    return verdict.same


if __name__ == "__main__":
    sys.exit(0 if main(Path(sys.argv[1])) else 3)
