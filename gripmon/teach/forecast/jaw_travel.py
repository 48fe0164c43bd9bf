"""Over which part of the jaw's travel the view suffices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array
from gripmon.teach.forecast.expected import foresee_frame
from gripmon.teach.forecast.promise import Promise, promise
from gripmon.teach.forecast.visibility import Rig, Sight, see

OPENINGS = 121
"""Openings that are looked at; where the view fails between two that both suffice is not seen."""

CERTAINTY_AT = 13
"""Openings at which a frame's accuracy is reckoned."""

_HALVINGS = 14


class Gap(NamedTuple):
    """Openings at which the view doesn't suffice, and why (in its middle)."""

    from_m: float
    to_m: float
    reason: str


@dataclass(frozen=True, slots=True)
class JawTravel:
    """``share`` of the jaw's travel in which the monitor can measure, with the ``gaps`` that are left out; ``corners``
    and ``edges`` (n,) visible at the ``openings_m`` (n,).
    """

    share: float
    gaps: tuple[Gap, ...]
    openings_m: Array
    corners: NDArray[np.intp]
    edges: NDArray[np.intp]


def over_jaw(rig: Rig, cam_T_grip: Array, count: int = OPENINGS) -> JawTravel | None:
    """What is visible at ``count`` openings from end to end, the ends of gaps found between them; None for a gripper
    whose jaw doesn't move.
    """
    gripper = rig.gripper
    if not gripper.jaw_max_m > gripper.jaw_min_m:
        return None
    openings_m = np.linspace(gripper.jaw_min_m, gripper.jaw_max_m, count)
    sights = [see(rig, cam_T_grip, opening_m) for opening_m in openings_m.tolist()]

    def look(opening_m: float) -> Sight:
        return see(rig, cam_T_grip, opening_m)

    gaps = _gaps(openings_m, [s.enough for s in sights], look)
    lost_m = sum(gap.to_m - gap.from_m for gap in gaps)
    share = 1.0 - lost_m / (gripper.jaw_max_m - gripper.jaw_min_m)
    return JawTravel(
        max(share, 0.0),
        gaps,
        openings_m,
        np.array([s.corners for s in sights], dtype=np.intp),
        np.array([s.edges for s in sights], dtype=np.intp),
    )


class Certainty(NamedTuple):
    """At openings (n,) from end to end: ``sigma_m`` (n,) standard deviation of a frame's TCP along its least certain
    direction, NaN where too little is visible, and what the frame may ``promise``, None there.
    """

    openings_m: Array
    sigma_m: Array
    promises: tuple[Promise | None, ...]


def certainty(rig: Rig, cam_T_grip: Array, count: int = CERTAINTY_AT) -> Certainty:
    """How exact a frame is over the jaw's travel."""
    openings_m = np.linspace(rig.gripper.jaw_min_m, rig.gripper.jaw_max_m, count)
    sigma_m = np.full(count, np.nan)
    promises: list[Promise | None] = [None] * count
    for k, opening_m in enumerate(openings_m.tolist()):
        if see(rig, cam_T_grip, opening_m).enough:
            frame = foresee_frame(rig, cam_T_grip, opening_m)
            sigma_m[k] = np.sqrt(np.linalg.eigvalsh(frame.covariance[:3, :3])[-1])
            promises[k] = promise(frame.protection, rig.settings.policy)
    return Certainty(openings_m, sigma_m, tuple(promises))


def _gaps(openings_m: Array, enough: list[bool], look: Callable[[float], Sight]) -> tuple[Gap, ...]:
    """The runs without enough, their ends by bisection."""
    change = np.flatnonzero(np.diff(np.concatenate([[1], np.array(enough, dtype=np.int8), [1]])))
    gaps = []
    for first, beyond in change.reshape(-1, 2).tolist():
        low_m, high_m = float(openings_m[first]), float(openings_m[beyond - 1])
        if first > 0:
            low_m = _boundary(float(openings_m[first - 1]), low_m, look)
        if beyond < len(openings_m):
            high_m = _boundary(float(openings_m[beyond]), high_m, look)
        reason = look(float(openings_m[(first + beyond - 1) // 2])).reason
        assert reason is not None
        gaps.append(Gap(low_m, high_m, reason))
    return tuple(gaps)


def _boundary(good_m: float, bad_m: float, look: Callable[[float], Sight]) -> float:
    for _ in range(_HALVINGS):
        middle_m = 0.5 * (good_m + bad_m)
        if look(middle_m).enough:
            good_m = middle_m
        else:
            bad_m = middle_m
    return bad_m
