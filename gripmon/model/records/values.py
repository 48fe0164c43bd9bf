"""Arrays, poses, open enums, and JSON."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING, Annotated, Any, Self

import msgspec
from msgspec import Meta

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.floating[Any]]
    Image = NDArray[np.integer[Any] | np.floating[Any]]
else:  # for annotations only: programs that only read messages needn't load NumPy
    Array = Image = Any

NS_PER_S = 1_000_000_000

Translation = Annotated[tuple[float, float, float], Meta(description="x, y, z of the TCP in camera axes, m")]
Rotation = Annotated[
    tuple[float, float, float, float], Meta(description="unit quaternion x, y, z, w, gripper to camera")
]
Covariance = Annotated[
    tuple[float, ...],
    Meta(
        min_length=36,
        max_length=36,
        description="6 x 6, row by row: the TCP's position error in camera axes (m), then the rotation error vector in "
        "camera axes (rad); entries in m², m rad, rad²",
    ),
]


class OpenEnum(enum.StrEnum):
    """An enum that later versions may extend: an unknown name is kept as it came."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if not isinstance(value, str):
            return None
        unknown = str.__new__(cls, value)
        unknown._name_ = unknown._value_ = value
        return unknown


class Transform(msgspec.Struct, frozen=True, gc=False):
    """``cam_T_grip``: from gripper to camera coordinates, the gripper's origin at the TCP."""

    translation_m: Translation
    rotation_xyzw: Rotation


class Drift(msgspec.Struct, frozen=True, gc=False):
    """Motion against the reference: ``d`` and ``delta`` of equation (14), and the TCP's shift in the camera frame."""

    translation_m: Annotated[float, Meta(description="d: length of the camera's displacement, m")]
    rotation_rad: Annotated[float, Meta(description="delta: the camera's turn, rad")]
    tcp_shift_m: Annotated[
        tuple[float, float, float], Meta(description="displacement of the TCP along the camera's x, y, z, m")
    ]


class Smoothed(msgspec.Struct, frozen=True, gc=False):
    """The transform averaged over time."""

    translation_m: Translation
    rotation_xyzw: Rotation
    covariance: Covariance


NOTHING_WRONG = "nothing is wrong"
"""The ``hypothesis`` of a bound whose largest term is the fault-free one."""


class Protection(msgspec.Struct, frozen=True, gc=False):
    """Bounds on the error of a transform: it exceeds either with at most the stated probability."""

    position_m: Annotated[float, Meta(description="protection level: bound on the TCP's position error, m")]
    rotation_rad: Annotated[float, Meta(description="bound on the angle of the rotation error, rad")]
    risk: Annotated[float, Meta(description="integrity risk: probability a frame that the error exceeds a bound")]
    hypothesis: Annotated[str, Meta(description="what could be wrong that makes the position's bound as large")] = ""


class ValidBy(enum.StrEnum):
    """Which error has to be within the alert limits for a transform to be valid, and which transform that is: of the
    motion since the reference, applied to the reference, or of the pose as measured.
    """

    REFERENCE = "reference"
    ABSOLUTE = "absolute"


class Since(OpenEnum):
    """What the motion since the reference counts from."""

    REFERENCE = "reference"
    FIRST_PROVED = "first_proved"


class SinceReference(msgspec.Struct, frozen=True, gc=False):
    """Bounds on the error of the motion since the reference: what is the same then and now, as the reference's own
    error and the gripper file's, isn't in them.
    """

    position_m: Annotated[float, Meta(description="bound on the TCP's position error, m")]
    rotation_rad: Annotated[float, Meta(description="bound on the angle of the rotation error, rad")]
    since: Annotated[
        Since,
        Meta(
            description="reference: the frames that the reference was measured from; first_proved: the first frames "
            "that proved where the gripper is, so that a motion before them isn't in it"
        ),
    ]
    since_ns: Annotated[
        int,
        Meta(description="stamp of the newest of those frames, or of the middle one of the first proved ones, Unix ns"),
    ]


class Absolute(msgspec.Struct, frozen=True, gc=False):
    """The transform as measured, and bounds on its error, in which the gripper file's errors are."""

    position_m: Annotated[float, Meta(description="bound on the TCP's position error, m")]
    rotation_rad: Annotated[float, Meta(description="bound on the angle of the rotation error, rad")]
    translation_m: Translation
    rotation_xyzw: Rotation


_encoder = msgspec.json.Encoder()


def to_json(record: msgspec.Struct) -> bytes:
    """One line of UTF-8 JSON without a line feed; NaN doesn't occur in records and would become null."""
    return _encoder.encode(record)
