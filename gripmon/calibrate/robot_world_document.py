"""The file of a robot-world calibration."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.provenance import Provenance
from gripmon.model.records import Transform

_Length = Annotated[float, Meta(ge=0.0)]


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
    """``transforms`` by name, two of them: ``cam_T_base`` and ``ee_T_target``, or of a camera on the hand ``cam_T_ee``
    and ``base_T_target``, and the inverse of the first one.  ``covariance`` (12·12, row by row) of the ``parameters``:
    position then rotation of the first two, axes of the frame that each maps to.
    """

    transforms: dict[str, Transform]
    parameters: tuple[str, ...]
    sigmas: dict[str, float]
    covariance: tuple[float, ...]
    residuals: RobotWorldResiduals
    provenance: Provenance
