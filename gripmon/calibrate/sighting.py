"""A calibration target as seen in one image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gripmon.model.errors import NoResultError
from gripmon.model.records import Array


class CalibrationError(NoResultError, ValueError):
    """Why there is no calibration; one line for a person: what is wrong; what would be right.  ``details``: further
    lines, such as what is wrong with each of several images.
    """

    def __init__(self, text: str, details: Sequence[str] = ()):
        super().__init__(text, details)


@dataclass(frozen=True, slots=True)
class Sighting:
    """Points of a flat target found in an image: any part of it, in any order.

    ``uv_px`` (n, 2): positions in the (distorted) image, with ``covariance_px`` (n, 2, 2); ``plate_m`` (n, 3):
    positions on the target, in a right-handed frame with x along its columns and z *into* the plate, away from a camera
    that sees it; z = 0.  On a lattice without markers the origin may be any of its points, and x any of its directions.
    ``disc_radius_m`` is 0 for corners; for discs ``uv_px`` is the centroid of the visible blob, which under perspective
    isn't the image of the disc's centre.  ``turns``: in how many ways ``plate_m`` may lie on the target: one where its
    marks or colours tell, two or four where all of it looks the same after half a turn or a quarter, 0 (any) of a part.
    """

    uv_px: Array
    plate_m: Array
    covariance_px: Array
    size_px: tuple[int, int]
    disc_radius_m: float = 0.0
    name: str = ""
    note: str = ""
    turns: int = 0

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True, slots=True)
class NotFound:
    """Why no target was found; one line for a person.  ``larger``: one was found, but it has too many points;
    ``whole``: points along both sides, the longer first, of one that ends in the image all round, with too few.
    """

    reason: str
    larger: bool = False
    whole: tuple[int, int] | None = None
