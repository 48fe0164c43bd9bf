"""What a controller gets: a transform, its age, and whether it may be used."""

from __future__ import annotations

import enum
import math
from typing import TYPE_CHECKING

import msgspec

from gripmon.client.names import MonitorName
from gripmon.model.records import Origin, Protection, Smoothed, State, Transform, Verdict

if TYPE_CHECKING:
    from gripmon.model.records import Array


class Unusable(enum.StrEnum):
    """Why a reading may not be used."""

    CLOSED = "closed"
    NOT_CONNECTED = "not_connected"
    NOTHING_YET = "nothing_yet"
    SEVERAL = "several_monitors"
    UNREADABLE = "unreadable"
    GONE = "gone"
    RESTARTED = "restarted"
    UNKNOWN = "unknown"
    AGE_UNKNOWN = "age_unknown"
    CLOCKS = "clocks_disagree"
    STALE = "stale"
    SUSPECT = "suspect"
    UNCERTAIN = "uncertain"
    UNPROTECTED = "unprotected"


class NotUsable(Exception):
    """There is no transform that the policy allows; ``reading`` is what there is instead."""

    def __init__(self, reading: Reading) -> None:
        super().__init__(reading.reason)
        self.reading = reading


class Policy(msgspec.Struct, frozen=True, kw_only=True):
    """What a controller may use.

    ``max_age_s``: an older transform is refused.  The camera may have been knocked since, so give it the time that the
    controller may move on without knowing; it must span a few frames of the camera, or every late frame is a stop.
    ``accept_suspect``: allow what is held, uncertain or not confirmed, too; ``max_sigma_m``: allow a transform only
    while the standard deviation of the TCP along each camera axis is at most that; ``max_protection_m``: only while its
    protection level, the bound on the TCP's position error, is known and at most that (None: the verdict decides by the
    monitor's own alert limit).  ``clocks_agree``: the clocks of
    monitor and controller show the same time (the same machine, PTP): the age then counts from the capture by their
    stamps if that is more, and a stamp of the future is refused.
    """

    max_age_s: float = 0.2
    accept_suspect: bool = False
    max_sigma_m: float | None = None
    max_protection_m: float | None = None
    clocks_agree: bool = False

    def __post_init__(self) -> None:
        for name in ("max_age_s", "max_sigma_m", "max_protection_m"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"{name} is {value!r}; give a number above 0")


class Reading(msgspec.Struct, frozen=True, kw_only=True):
    """The newest transform as it stood when it was asked for; frozen, may be passed on and kept.

    ``transform`` (``cam_T_grip``), ``covariance`` (36 numbers, 6 x 6 row by row: m, rad, camera axes), ``protection``
    (bounds on the error of ``transform`` at a stated risk; None from an older monitor, too) and ``smoothed`` are
    None whenever ``verdict`` is ``unknown``.  The verdict is the monitor's, but ``unknown`` where the monitor can't
    be asked any more: it is gone, its last transform too old, or there is none.

    ``usable``: the policy allows it; else ``why`` says in a word and ``reason`` in a line why not.  ``age_s`` bounds
    the time since the monitor was handed the frame: what it needed for it, how long the message was on its way at most
    (:mod:`gripmon.client.age`), and the time since it arrived; the way of the image into the monitor is not in it.
    Infinite if no transform came yet, or nothing tells how long it was on its way.  ``stamp_ns`` is the capture time by
    the monitor's clock, ``monitor_id`` the start of the monitor that it is from.
    """

    monitor: MonitorName | None
    verdict: Verdict
    usable: bool
    why: Unusable | None
    reason: str
    age_s: float
    transform: Transform | None = None
    covariance: tuple[float, ...] | None = None
    smoothed: Smoothed | None = None
    protection: Protection | None = None
    state: State | None = None
    source: Origin | None = None
    stamp_ns: int = 0
    seq: int = -1
    reference_id: str = ""
    revision: int = -1
    monitor_id: str = ""

    def same_revision_as(self, other: Reading) -> bool:
        """Do both rest on the same reference of one start of the monitor?  Only then may one be subtracted from the
        other.  False without one.
        """
        return self.revision >= 0 and self._rests_on() == other._rests_on()

    def sigma_m(self) -> float:
        """Standard deviation of the TCP's position, m: the largest along a camera axis; infinite without one."""
        return largest_sigma_m(self.covariance)

    def matrix(self, *, smoothed: bool = False) -> Array:
        """``cam_T_grip`` as a NumPy array (4, 4), m; raises :class:`NotUsable` without a transform.  Loads NumPy.

        ``smoothed``: averaged over time, where there is an average; else this frame's.
        """
        pose = self.smoothed if smoothed and self.smoothed is not None else self.transform
        if pose is None:
            raise NotUsable(self)
        import numpy as np

        x, y, z, w = pose.rotation_xyzw
        matrix = np.eye(4)
        matrix[:3, :3] = (
            (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
            (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
            (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
        )
        matrix[:3, 3] = pose.translation_m
        return matrix

    def _rests_on(self) -> tuple[MonitorName | None, str, str, int]:
        return self.monitor, self.monitor_id, self.reference_id, self.revision


def largest_sigma_m(covariance: tuple[float, ...] | None) -> float:
    """The largest standard deviation of the position along an axis, m; infinite without a covariance."""
    return math.inf if covariance is None else math.sqrt(max(covariance[0], covariance[7], covariance[14]))
