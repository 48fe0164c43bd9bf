"""A calibration target as one image shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import NoResultError
from gripmon.model.records import Array


class CalibrationError(NoResultError, ValueError):
    """Why there is no calibration; one line for a person: what is wrong; what would be right.  ``details``: further
    lines, such as what is wrong with each of several images.
    """

    def __init__(self, text: str, details: Sequence[str] = ()):
        super().__init__(text)
        self.details = tuple(details)


@dataclass(frozen=True, slots=True)
class Sighting:
    """Points of a flat target found in an image: any part of it, in any order.

    ``uv_px`` (n, 2) where they are in the (distorted) image, with ``covariance_px`` (n, 2, 2); ``plate_m`` (n, 3) where
    they are on the target: right-handed frame, x along its columns, z *into* the plate, away from a camera that sees
    it; z = 0.  On a lattice without marks the origin is any point of it, and x any of its directions.
    ``disc_radius_m`` is 0 for corners; for discs ``uv_px`` is the centre of the visible blob, which under
    perspective is not where the disc's centre is.
    """

    uv_px: Array
    plate_m: Array
    covariance_px: Array
    ids: NDArray[np.intp]
    size_px: tuple[int, int]
    disc_radius_m: float = 0.0
    name: str = ""
    note: str = ""

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True, slots=True)
class NotFound:
    """Why no target was found; one line for a person.  ``larger``: one was, with more points than it should have."""

    reason: str
    larger: bool = False
