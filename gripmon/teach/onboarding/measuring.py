"""Measured corners of a gripper in an image of it on a plate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import block_diag

from gripmon.calibrate.plane import FingerCorners
from gripmon.calibrate.plane_equations import FEWEST_CORNERS, FreePose, stand
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.teach.onboarding.outline_edges import FoundOutline, find_outline
from gripmon.teach.onboarding.outlines import Outline
from gripmon.teach.onboarding.plate_print import PlatePrint
from gripmon.track.edges import FingertipMeter, MeasurementSettings, Patience

JAW_SIGMA_M = 2e-4
USUAL_SHARE = 0.6
"""Share of agreeing profiles that is expected before a plate's pattern."""
_PATIENCE = Patience(when_doubtful=True, when_lost=True)
_ROUGH_PX = 3.0


def measure_outlines(
    camera: Camera, image: Image, outline: Outline, printed: PlatePrint | None = None
) -> tuple[FingerCorners, FoundOutline]:
    """Corners of fingertips that aren't known, from their rough outlines; ``printed``: see :func:`snap`.  Raises
    :class:`CalibrationError`.
    """
    snapped = find_outline(camera, image, outline, printed)
    corners = list(outline.corners)
    names = tuple(outline.names[k] for k in corners)
    return FingerCorners(names, snapped.points[corners], snapped.covariance_px2), snapped


def rough_pose(
    camera: Camera,
    gripper: Gripper,
    cam_T_plate: Array,
    rough: Mapping[str, tuple[float, float]],
    jaw_opening_m: float | None,
    contact_m: float,
) -> Array:
    """``cam_T_grip`` (4, 4) from rough corners of a known gripper, good to some pixels.  :class:`CalibrationError`."""
    check_rough(gripper, rough)
    points_m = gripper.points_grip_m(jaw_opening_m)
    known = np.array([points_m[gripper.point_ids.index(name)] for name in rough])
    each = np.tile(np.eye(2) * _ROUGH_PX**2, (len(rough), 1, 1))
    return stand(camera, cam_T_plate, np.array(list(rough.values()), dtype=float), each, known, contact_m).cam_T_grip


def check_rough(gripper: Gripper, rough: Mapping[str, tuple[float, float]]) -> None:
    """Raise :class:`CalibrationError` for rough corners that the gripper doesn't have, or too few of them."""
    strange = [name for name in rough if name not in gripper.corner_ids]
    if strange:
        raise CalibrationError(
            f"corners.{strange[0]}: {gripper.name} has no such corner; one of {', '.join(gripper.corner_ids)}"
        )
    if len(rough) < FEWEST_CORNERS:
        raise CalibrationError(f"{len(rough)} corner ({', '.join(rough)}); at least {FEWEST_CORNERS}, which lie apart")


def measure_known(
    camera: Camera,
    gripper: Gripper,
    image: Image,
    expected_cam_T_grip: Array,
    jaw_opening_m: float | None,
    wanted: Mapping[str, object] | None = None,
) -> tuple[FingerCorners, dict[str, str]]:
    """The corners of a known gripper about an expected pose, all or the ``wanted`` ones, and why others are missing.

    Raises :class:`CalibrationError` where the gripper isn't seen.
    """
    opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
    meter = FingertipMeter(camera, gripper, MeasurementSettings(), JAW_SIGMA_M)
    found = meter.measure(image, expected_cam_T_grip, opening_m, USUAL_SHARE, _PATIENCE)
    if not found.trusted:
        raise CalibrationError(
            f"the gripper isn't seen where it should be ({100.0 * found.consensus.share:.0f} % of its edges' profiles "
            "agree); rough corners nearer to the real ones, the right gripper file and jaw opening, an image in focus"
        )
    corners = found.corners
    named = np.array([wanted is None or name in wanted for name in gripper.corner_ids])
    missing = {
        name: str(fault.value if fault is not None else "not measured")
        for name, fault, usable, want in zip(gripper.corner_ids, corners.fault, corners.usable, named, strict=True)
        if want and not usable
    }
    taken = corners.usable & named
    if np.count_nonzero(taken) < FEWEST_CORNERS:
        reasons = ", ".join(f"{name} {reason}" for name, reason in missing.items()) or "too few were asked for"
        raise CalibrationError(
            f"{np.count_nonzero(taken)} corner(s) of the gripper ({reasons}); at least {FEWEST_CORNERS}, that lie apart"
        )
    lens = block_diag(*found.prediction.corners.d_uv_d_xy[taken])
    covariance = lens @ corners.joint_covariance_xy(taken) @ lens.T
    names = tuple(name for name, use in zip(gripper.corner_ids, taken, strict=True) if use)
    free = FreePose(found.cam_T_grip, found.covariance[:6, :6], camera, gripper.points_grip_m(jaw_opening_m))
    return FingerCorners(names, corners.uv_px[taken], 0.5 * (covariance + covariance.T), free), missing


def contact_height_m(gripper: Gripper, jaw_opening_m: float | None) -> float:
    """Where along z the gripper touches a plate that it stands on: its outermost point."""
    return float(gripper.points_grip_m(jaw_opening_m)[:, 2].max())
