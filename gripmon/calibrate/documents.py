"""The files that the off-line methods write, and that a configuration names."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.camera import LensSettings
from gripmon.model.provenance import Digest, Provenance
from gripmon.model.records import Transform
from gripmon.model.records.values import Covariance

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

    ``covariance`` (n·n, row by row) is that of the n ``parameters``, which are keys of ``camera``
    (``coefficients.0`` is the first one); what isn't among them was held fixed.  A camera that was imported from
    another program's file has neither: how certain it is isn't known.
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
    """How well the gripper's corners fit the plane that they stand on."""

    rms_m: Annotated[_Length, Meta(description="root mean square of the residuals on the plate, x and y each (m)")]
    rms_px: Annotated[_Length, Meta(description="the same in the images, u and v each (px)")]
    corners: Annotated[int, Meta(ge=2, description="in all images together")]
    images: Annotated[int, Meta(ge=1)]


class HandEyeCalibration(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="schema",
    tag="gripmon.hand_eye_calibration/1",
):  # fmt: skip
    """``cam_T_grip`` with the covariance of its error (position of the TCP, then rotation, camera axes; m, rad)."""

    camera: LensSettings
    gripper: CalibratedGripper
    jaw_opening_m: float | None = None
    cam_T_grip: Transform
    covariance: Covariance
    residuals: HandEyeResiduals
    warnings: tuple[str, ...] = ()
    provenance: Provenance
