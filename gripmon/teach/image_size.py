"""How large a gripper is that images show: its distance from the camera, from whatever tells a length.

An image doesn't tell a large gripper from a near one.  Where nothing does, all lengths are in units of the distance, of
which :data:`NOMINAL_DISTANCE_M` is written: a motion since the reference is as exact as ever, in that unit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gripmon.model.gripper import SIZE_UNKNOWN
from gripmon.model.records import Array
from gripmon.teach.finger_depth import PlacedOutlines
from gripmon.teach.image_model import tip_width
from gripmon.teach.motion_depth import Moved
from gripmon.teach.piece_lines import STRAIGHT_PX

Length = tuple[float, float]
"""A length and its standard deviation, m."""
Pose = tuple[Array, Array]
"""``cam_T_grip`` (4, 4) and the covariance (6, 6) of its error."""

NOMINAL_DISTANCE_M = 0.1
"""Distance of the fingertips that a file of unknown size has, by convention: 1 mm in it is 1 % of the distance, and
limits in millimetres mean about what they do on a wrist camera."""
OPENING_SIGMA_M = 1e-4
"""Standard deviation of a jaw opening that a gripper reports: backlash and rounding of a tenth of a millimetre."""
WORST_SHARE = 0.3
"""Largest standard deviation of a size, over it, that counts as known: three of them are the size itself."""
CONTRADICTS = 3.0
"""Standard deviations by which a given length and the openings contradict each other."""


@dataclass(frozen=True)
class Size:
    """``depth_m`` of the TCP with its standard deviation; ``known``: else both are :data:`NOMINAL_DISTANCE_M`."""

    depth_m: float
    sigma_m: float
    known: bool = True

    @property
    def scale_sigma(self) -> float:
        """Of a factor on all lengths, as a gripper file has it."""
        return float(f"{self.sigma_m / self.depth_m:.2g}") if self.known else SIZE_UNKNOWN


def size_of(
    placed: PlacedOutlines,
    fx_px: float,
    distance_m: Length | None,
    finger_width_m: Length | None,
    reference: Pose | None,
    by_openings: Length | None,
    notes: list[str],
) -> Size:
    """The size by a given length, else ``by_openings``, else unknown; adds to ``notes``.  Raises
    :class:`~gripmon.model.errors.NoResultError` where the images don't show the length that is given.
    """
    given: Length | None = None
    if distance_m is not None:
        given = distance_m
    elif finger_width_m is not None:
        width = tip_width(placed)
        measured = 2.0**0.5 * STRAIGHT_PX / (width * fx_px)
        depth = finger_width_m[0] / width
        given = depth, depth * float(np.hypot(finger_width_m[1] / finger_width_m[0], measured))
    elif reference is not None:
        given = float(reference[0][2, 3]), float(np.sqrt(reference[1][2, 2]))
    if given is not None and by_openings is not None:
        off = abs(given[0] - by_openings[0]) / float(np.hypot(given[1], by_openings[1]))
        if off > CONTRADICTS:
            notes.append(
                f"the openings contradict the given length: by them the fingertips are {_mm(by_openings)} from the "
                f"camera, by it {_mm(given)}, which is used; check both"
            )
    found = given or by_openings
    if found is None:
        return Size(NOMINAL_DISTANCE_M, NOMINAL_DISTANCE_M, known=False)
    return Size(*found)


def _mm(length: Length) -> str:
    return f"{1e3 * length[0]:.1f} +- {1e3 * length[1]:.2g} mm"


def travel_of(reference: Pose, openings_m: Iterable[float]) -> dict[float, Length]:
    """By opening, how far it is from the first one, over a reference's depth, with its standard deviation."""
    first, *others = openings_m
    depth, sigma = float(reference[0][2, 3]), float(np.sqrt(reference[1][2, 2]))
    out = {}
    for other in others:
        share = abs(other - first) / depth
        out[other] = share, float(np.hypot(2.0**0.5 * OPENING_SIGMA_M / depth, share * sigma / depth))
    return out


def depth_by_openings(moved: Moved, opening_m: float | None) -> tuple[Length | None, str]:
    """Depth of the TCP by how far fingers move in metres and in the images, with its standard deviation; or None and
    why it isn't known; neither without openings in metres.

    Generalised least squares over the openings, whose travels have the first one's error in common; if they scatter by
    more than their errors, the result's error is as much larger.
    """
    motion = moved.measured
    if opening_m is None or motion is None:
        return None, "" if opening_m is None else moved.why
    moved_m = np.abs(np.array([other - opening_m for other in motion.moved]))
    depths = moved_m / motion.travel
    relative = motion.covariance / np.outer(motion.travel, motion.travel)
    reported = OPENING_SIGMA_M**2 * (np.eye(len(depths)) + 1.0) / np.outer(moved_m, moved_m)
    covariance = (relative + reported) * np.outer(depths, depths)
    information = np.linalg.inv(covariance)
    depth = float(information.sum(axis=0) @ depths / information.sum())
    off = depths - depth
    excess = float(off @ information @ off) / max(len(depths) - 1, 1)
    sigma = float(np.sqrt(max(excess, 1.0) / information.sum()))
    if sigma > WORST_SHARE * depth:
        return None, f"they leave it uncertain by {100.0 * sigma / depth:.0f} %"
    return (depth, sigma), ""


def unit_notes(size: Size, why: str) -> list[str]:
    """What a person should know of it."""
    if size.known:
        text = (
            f"lengths are known to {100.0 * size.sigma_m / size.depth_m:.1f} %: the fingertips are "
            f"{1e3 * size.depth_m:.1f} +- {1e3 * size.sigma_m:.2g} mm from the camera, which is in the reference's "
            "covariance and in every protection level (scale_sigma)"
        )
        return [text]
    text = (
        f"the size is unknown: lengths are in units of the fingertips' distance, {1e3 * size.depth_m:g} mm by "
        "convention, so that 1 mm stands for 1 % of it. A motion since the reference is measured in that unit; "
        "configure monitor.policy.valid_by: reference. For true millimetres also --distance M:SIGMA, --finger-width "
        "M:SIGMA, --reference FILE, or images at several openings with a timestamps.csv"
    )
    return [*([f"the openings don't tell the size: {why}"] if why else []), text]
