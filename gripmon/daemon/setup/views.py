"""Suitability of an image for a calibration: sharpness, motion, the target's place on the sensor and its tilt.

The limits are those of the calibrations and of their warnings; nothing here decides whether a calibration is good.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import msgspec
import numpy as np

from gripmon.calibrate.detection import BLURRED_PX, detect
from gripmon.calibrate.grey_levels import sharpest_blur_px, to_bytes, to_grey
from gripmon.calibrate.intrinsics import COVERED
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.model.records import Array, Image
from gripmon.model.targets import Target

CELLS = 12
"""Number of cells across the image, as in the page of ``gripmon calibrate intrinsics``."""
STILL_PX = 0.5
"""Largest motion between two frames (px): even an exposure over the whole time between them is then blurred by a
standard deviation of only 0.5 / sqrt(12) = 0.14 px, a twentieth of the limit for blurred images."""
MOVED_PX = 5.0
"""Smallest motion since the last image taken (px): ten times STILL_PX, so that it is another view."""
FEWEST_VIEWS = 10
"""Minimum number of images of the plate (docs/howto/calibrate_camera.md)."""
TILTED_RAD = math.radians(20.0)
"""Tilt from which the focal length is well determined (the warning of ``gripmon calibrate intrinsics``)."""
SIDES = ("right", "down", "left", "up")
FEWEST_SIDES = 3
"""Minimum number of the four sides: tilts about one axis alone determine only one of fx and fy."""
_FEATURES = 150
_MOTION_QUANTILE = 0.9
"""Quantile of the features' motions that counts: the background may move in a part of the image while the gripper
stands still."""


class Coverage(msgspec.Struct, frozen=True):
    """``cells``: rows of 0 and 1, 1 where points were seen; ``tilts``: of each view (x, y), rad, towards the side that
    is farther away; ``wants``: missing views, in words, empty if none.
    """

    cells: tuple[tuple[int, ...], ...]
    tilts: tuple[tuple[float, float], ...]
    wants: tuple[str, ...]


@dataclass(frozen=True)
class View:
    """One image: ``sighting`` of the target or why there is none; ``blur_px`` of its sharpest edges (standard
    deviation); ``moved_px`` since the previous image, None for the first one or if no features can be tracked.
    """

    sighting: Sighting | NotFound | None
    blur_px: float
    moved_px: float | None

    @property
    def fault(self) -> str:
        """Why the image can't be taken, empty if it can; motion doesn't count, because files can't be repeated."""
        if self.blur_px > BLURRED_PX:
            return (
                f"blurred: its sharpest edges are {self.blur_px:.1f} px wide; at most {BLURRED_PX:g} px: focus, light"
            )
        return self.sighting.reason if isinstance(self.sighting, NotFound) else ""

    @property
    def still(self) -> bool:
        return self.moved_px is not None and self.moved_px <= STILL_PX


class Viewer:
    """Looks at one image after another."""

    def __init__(self, target: Target | None) -> None:
        """``target`` None: images need no target."""
        self._target = target
        self._before: Image | None = None

    def look(self, image: Image) -> View:
        """Examine any image that a camera delivers."""
        grey = to_grey(image)
        shown = to_bytes(grey)
        moved_px = None if self._before is None else moved(self._before, shown)
        self._before = shown
        blur_px = sharpest_blur_px(grey)
        return View(None if self._target is None else detect(image, self._target), blur_px, moved_px)


def moved(before: Image, now: Image) -> float | None:
    """The 90 % quantile of the features' motions (px) between two images (h, w), 8 bits; None if there are no
    features, or too few are found again.

    Lucas and Kanade by pyramids (Bouguet, "Pyramidal implementation of the Lucas Kanade feature tracker", 2000).
    """
    if before.shape != now.shape:
        return None
    start = np.asarray(cv2.goodFeaturesToTrack(before, _FEATURES, 0.01, 10.0), np.float32)
    if start.ndim != 3:  # it found none
        return None
    end, status, _ = cv2.calcOpticalFlowPyrLK(before, now, start, np.zeros_like(start))
    good = np.ravel(status) > 0
    if 2 * np.count_nonzero(good) < len(good):
        return None
    steps = np.linalg.norm(np.asarray(end)[good] - start[good], axis=-1)
    return float(np.quantile(steps, _MOTION_QUANTILE))


def coverage(sightings: Sequence[Sighting], size_px: tuple[int, int]) -> Coverage:
    """The coverage by views of a plate; ``size_px`` (width, height) of the images."""
    rows = max(1, round(CELLS * size_px[1] / size_px[0]))
    seen = np.zeros((rows, CELLS), np.int64)
    for sighting in sightings:
        column, row = (sighting.uv_px / np.array(size_px) * [CELLS, rows]).astype(int).T
        seen[np.clip(row, 0, rows - 1), np.clip(column, 0, CELLS - 1)] = 1
    tilts = tilts_of(sightings, size_px)
    return Coverage(
        tuple(tuple(line) for line in seen.tolist()),
        tuple((x, y) for x, y in tilts.tolist()),
        tuple(_wants(sightings, tilts, size_px)),
    )


def _wants(sightings: Sequence[Sighting], tilts: Array, size_px: tuple[int, int]) -> list[str]:
    out = []
    if len(sightings) < FEWEST_VIEWS:
        out.append(f"{FEWEST_VIEWS - len(sightings)} more images")
    # Towards right, down, left, up in the image; a tilt between two sides counts for both.
    towards = np.stack([tilts[:, 0], tilts[:, 1], -tilts[:, 0], -tilts[:, 1]]) if len(tilts) else np.zeros((4, 0))
    tilted = np.linalg.norm(tilts, axis=1) >= TILTED_RAD
    has = [bool(np.any(tilted & (side > 0.5 * np.linalg.norm(tilts, axis=1)))) for side in towards]
    if sum(has) < FEWEST_SIDES:
        missing = " or ".join(name for name, there in zip(SIDES, has, strict=True) if not there)
        out.append(f"the target tilted by {math.degrees(TILTED_RAD):.0f}° or more, farther away on the side {missing}")
    half_px = 0.5 * np.array(size_px)
    reach = max((float(np.linalg.norm(s.uv_px - half_px, axis=1).max()) for s in sightings), default=0.0)
    if reach < COVERED * float(np.linalg.norm(half_px)):
        out.append("the target nearer to the image's corners")
    return out


def tilts_of(sightings: Sequence[Sighting], size_px: tuple[int, int]) -> Array:
    """(n, 2) rad: the plate's tilt from the image plane, towards the side that is farther away (x right, y down); 0
    where the points span no area.

    An approximation for people: the camera isn't known yet.  One focal length for all views (OpenCV's start of a
    calibration: square pixels, principal point at the centre, no distortion); if fewer than three determine it, the
    image's width.
    """
    out, spans = np.zeros((len(sightings), 2)), [_spans_an_area(s) for s in sightings]
    seen = [s for s, spanning in zip(sightings, spans, strict=True) if spanning]
    centre = 0.5 * (np.array(size_px) - 1.0)
    camera = np.array([[size_px[0], 0.0, centre[0]], [0.0, size_px[0], centre[1]], [0.0, 0.0, 1.0]])
    if len(seen) >= 3:
        points = [[np.asarray(part, np.float32) for part in (s.plate_m, s.uv_px)] for s in seen]
        found = cv2.initCameraMatrix2D(*zip(*points, strict=True), size_px)  # type: ignore[call-overload]
        camera = found if np.isfinite(found).all() and found[0, 0] > 0.0 else camera
    for k, sighting in enumerate(sightings):
        if not spans[k]:
            continue
        _, turn, _ = cv2.solvePnP(sighting.plate_m, sighting.uv_px, camera, None, flags=cv2.SOLVEPNP_IPPE)
        normal = np.asarray(cv2.Rodrigues(turn)[0])[:, 2]
        normal = normal * np.sign(normal[2] or 1.0)  # away from the camera
        across = float(np.linalg.norm(normal[:2]))
        # Depth increases against the normal's component in the image.
        out[k] = -normal[:2] / max(across, 1e-9) * math.atan2(across, float(normal[2]))
    return out


def _spans_an_area(sighting: Sighting) -> bool:
    """Four points or more, not all on a line: one row of a plate has no tilt."""
    if len(sighting) < 4:
        return False
    return bool(np.linalg.matrix_rank(sighting.plate_m[:, :2] - sighting.plate_m[:, :2].mean(axis=0)) == 2)
