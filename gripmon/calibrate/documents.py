"""The files that the off-line methods write, and that a configuration names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.camera import LensSettings
from gripmon.model.geometry import invert, to_record
from gripmon.model.provenance import Digest, Provenance
from gripmon.model.records import Transform
from gripmon.model.records.values import Covariance
from gripmon.model.response import Response

if TYPE_CHECKING:
    from gripmon.calibrate.robot_world import RobotWorld

_Length = Annotated[float, Meta(ge=0.0)]


class CameraResiduals(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well a camera model fits the views that it was made from."""

    rms_px: Annotated[_Length, Meta(description="root mean square of the residuals, u and v each (px)")]
    views: Annotated[int, Meta(ge=1)]
    points: Annotated[int, Meta(ge=1, description="that were used")]
    outliers: Annotated[int, Meta(ge=0, description="that were left out")]
    cross_validated_rms_px: (
        Annotated[_Length, Meta(description="of views that had no part in the calibration (px)")] | None
    ) = None


class CameraCalibration(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="schema",
    tag="gripmon.camera_calibration/1",
):  # fmt: skip
    """A calibrated camera.

    ``covariance`` (n·n, row by row) is that of the n ``parameters``, which are keys of ``camera`` (``coefficients.0``
    is the first one); all others were held fixed.  A camera imported from another program's file has neither: its
    uncertainty is unknown.
    """

    camera: LensSettings
    parameters: tuple[str, ...]
    covariance: tuple[float, ...]
    residuals: CameraResiduals | None = None
    target: str | None = None
    warnings: tuple[str, ...] = ()
    provenance: Provenance


class CalibratedGripper(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    sha256: Digest


class HandEyeResiduals(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well the gripper's corners fit the plane that they stand on; for a gripper from images, the accuracy of its
    outline (``corners`` 0: round tips have none).
    """

    rms_m: Annotated[_Length, Meta(description="root mean square of the residuals on the plate, x and y each (m)")]
    rms_px: Annotated[_Length, Meta(description="the same in the images, u and v each (px)")]
    corners: Annotated[int, Meta(ge=0, description="in all images together")]
    images: Annotated[int, Meta(ge=1)]


class HandEyeCalibration(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="schema",
    tag="gripmon.hand_eye_calibration/1",
):  # fmt: skip
    """``cam_T_grip`` with the covariance of its error (position of the TCP, then rotation, camera axes; m, rad).

    ``with_gripper``: the gripper file was made of the same images, whose errors of size and tilt this has as well, and
    which show the camera's ``response``.
    """

    camera: LensSettings
    gripper: CalibratedGripper
    jaw_opening_m: float | None = None
    cam_T_grip: Transform
    covariance: Covariance
    residuals: HandEyeResiduals
    with_gripper: bool = False
    response: Response | None = None
    warnings: tuple[str, ...] = ()
    provenance: Provenance


class RobotWorldResiduals(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How well the poses fit, each axis."""

    rms_m: _Length
    rms_rad: _Length
    poses: Annotated[int, Meta(ge=3)]
    used: Annotated[int, Meta(ge=3)]
    outliers: Annotated[tuple[str, ...], Meta(description="poses that were left out")] = ()


class RobotWorldCalibration(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="schema",
    tag="gripmon.robot_world_calibration/1",
):  # fmt: skip
    """Result of a robot-world calibration.  ``transforms`` by name: ``cam_T_base`` and ``ee_T_target`` (for a camera on
    the hand ``cam_T_ee`` and ``base_T_target``), and the inverse of the first one.  ``covariance`` (12·12, row by row)
    of the ``parameters``: position then rotation of the first two, axes of the frame that each maps to.
    """

    transforms: dict[str, Transform]
    parameters: tuple[str, ...]
    sigmas: dict[str, float]
    covariance: tuple[float, ...]
    residuals: RobotWorldResiduals
    warnings: tuple[str, ...] = ()
    provenance: Provenance


def robot_world_document(
    found: RobotWorld, names: Sequence[str], provenance: Provenance, *, eye_in_hand: bool
) -> RobotWorldCalibration:
    """The contents of a result's file; ``names`` (n,) of the poses."""
    first, second, inverse = (
        ("cam_T_ee", "base_T_target", "ee_T_cam") if eye_in_hand else ("cam_T_base", "ee_T_target", "base_T_cam")
    )
    axes = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    parameters = tuple(f"{transform}.{axis}" for transform in (first, second) for axis in axes)
    return RobotWorldCalibration(
        transforms={
            first: to_record(found.cam_T_base),
            second: to_record(found.ee_T_target),
            inverse: to_record(invert(found.cam_T_base)),
        },
        parameters=parameters,
        sigmas=dict(zip(parameters, np.sqrt(found.covariance.diagonal()).tolist(), strict=True)),
        covariance=tuple(found.covariance.ravel().tolist()),
        residuals=RobotWorldResiduals(
            rms_m=found.rms_m,
            rms_rad=found.rms_rad,
            poses=len(names),
            used=int(found.used.sum()),
            outliers=tuple(name for name, used in zip(names, found.used, strict=True) if not used),
        ),
        warnings=found.warnings,
        provenance=provenance,
    )
