"""Arrays, poses, and JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.floating[Any]]
    Image = NDArray[np.integer[Any] | np.floating[Any]]
else:  # these are for annotations alone: who only reads messages needn't load NumPy
    Array = Image = Any


class Transform(msgspec.Struct, frozen=True):
    translation_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]


class Drift(msgspec.Struct, frozen=True):
    """Motion against the reference: ``d`` and ``delta`` of equation (14) and the TCP's displacement in the camera
    frame.
    """

    translation_m: float
    rotation_rad: float
    tcp_shift_m: tuple[float, float, float]


class Smoothed(msgspec.Struct, frozen=True):
    translation_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]
    covariance: tuple[float, ...]


_encoder = msgspec.json.Encoder()


def to_json(record: msgspec.Struct) -> bytes:
    """One line of UTF-8 JSON without a line feed; NaN can't occur in records and would become null."""
    return _encoder.encode(record)
