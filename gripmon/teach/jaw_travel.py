"""What is seen over the jaw's travel, and how certain a frame is there."""

from __future__ import annotations

import msgspec
import numpy as np

from gripmon.model.records import Array
from gripmon.teach.accuracy import Accuracy, forecast_frame
from gripmon.teach.visibility import LandmarkView, Rig, first_failing, see

OPENINGS, OPENINGS_MEASURED = 121, 13
"""Openings over the whole travel that are looked at, and those at which the accuracy is computed."""


class Gap(msgspec.Struct, frozen=True):
    """A range of openings in which the view doesn't suffice, and the reason (in its middle)."""

    from_m: float
    to_m: float
    reason: str


class OpeningCertainty(msgspec.Struct, frozen=True):
    """The TCP's uncertainty along its least certain direction over the openings, and the bounds that are compared with
    the alert limits; None where too little is visible.
    """

    opening_m: tuple[float, ...]
    worst_sigma_m: tuple[float | None, ...]
    protection_m: tuple[float | None, ...]
    protection_rad: tuple[float | None, ...]
    alert_limit_m: float
    alert_limit_rad: float

    @classmethod
    def of(cls, rig: Rig, openings_m: list[float], expected: list[Accuracy | None]) -> OpeningCertainty:
        policy = rig.settings.policy
        bounds = [None if each is None else each.by(policy.valid_by) for each in expected]
        return cls(
            opening_m=tuple(openings_m),
            worst_sigma_m=tuple(None if each is None else each.tcp_sigma_m for each in expected),
            protection_m=tuple(None if b is None else b.position_m for b in bounds),
            protection_rad=tuple(None if b is None else b.rotation_rad for b in bounds),
            alert_limit_m=policy.alert_limit_m,
            alert_limit_rad=policy.alert_limit_rad,
        )


class JawTravel(msgspec.Struct, frozen=True):
    """``share`` of the jaw's travel, ``from_m`` to ``to_m``, in which the monitor can measure, and the ``gaps`` in it;
    ``corners`` and ``edges`` in view: least and most.
    """

    share: float
    gaps: tuple[Gap, ...]
    corners: tuple[int, int]
    edges: tuple[int, int]
    from_m: float
    to_m: float
    certainty: OpeningCertainty


def over_jaw(rig: Rig, cam_T_grip: Array) -> JawTravel | None:
    """What is visible over the whole travel, with the ends of gaps refined; None for a gripper whose jaw doesn't move.
    A failure only between two openings is missed.
    """
    gripper = rig.gripper
    low_m, high_m = gripper.jaw_min_m, gripper.jaw_max_m
    if not high_m > low_m:
        return None
    openings_m = np.linspace(low_m, high_m, OPENINGS).tolist()
    sights = [see(rig, cam_T_grip, opening_m) for opening_m in openings_m]
    gaps = _gaps(rig, cam_T_grip, openings_m, sights)
    lost_m = sum(gap.to_m - gap.from_m for gap in gaps)
    corners, edges = [s.corners for s in sights], [s.edges for s in sights]
    few_m = np.linspace(low_m, high_m, OPENINGS_MEASURED).tolist()
    expected = [forecast_frame(rig, cam_T_grip, m) if see(rig, cam_T_grip, m).enough else None for m in few_m]
    return JawTravel(
        share=max(1.0 - lost_m / (high_m - low_m), 0.0),
        gaps=gaps,
        corners=(min(corners), max(corners)),
        edges=(min(edges), max(edges)),
        from_m=low_m,
        to_m=high_m,
        certainty=OpeningCertainty.of(rig, few_m, expected),
    )


def _gaps(rig: Rig, cam_T_grip: Array, openings_m: list[float], sights: list[LandmarkView]) -> tuple[Gap, ...]:
    """The runs of openings without a sufficient view, their ends found by bisection."""

    def view(opening_m: float) -> LandmarkView:
        return see(rig, cam_T_grip, opening_m)

    change = np.flatnonzero(np.diff([1, *(int(sight.enough) for sight in sights), 1]))
    gaps = []
    for first, beyond in change.reshape(-1, 2).tolist():
        low_m, high_m = openings_m[first], openings_m[beyond - 1]
        if first > 0:
            low_m, _ = first_failing(openings_m[first - 1], low_m, sights[first], view)
        if beyond < len(openings_m):
            high_m, _ = first_failing(openings_m[beyond], high_m, sights[beyond - 1], view)
        reason = sights[(first + beyond - 1) // 2].reason
        assert reason is not None
        gaps.append(Gap(low_m, high_m, reason))
    return tuple(gaps)
