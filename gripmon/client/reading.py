"""What a controller gets: a transform, its age, and whether the controller's policy allows it."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from gripmon.client.age import waited_s
from gripmon.client.inbox import Entry, Heard, several
from gripmon.client.network import MonitorName
from gripmon.model.records import (
    Absolute,
    FrameRecord,
    Origin,
    Protection,
    SinceReference,
    Smoothed,
    State,
    Transform,
    ValidBy,
    Verdict,
)

if TYPE_CHECKING:
    from gripmon.model.records import Array

CLOCK_AHEAD_LIMIT_S = 0.1
"""A stamp further in the future than this is from a clock that disagrees: with NTP, clocks agree within some tens of
milliseconds on any network."""


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
    """There is no transform that the policy allows; ``reading`` says why."""

    def __init__(self, reading: Reading) -> None:
        super().__init__(reading.reason)
        self.reading = reading


class Policy(msgspec.Struct, frozen=True, kw_only=True):
    """What a controller may use.

    ``max_age_s``: an older transform is refused.  The camera may have been knocked since, so set it to the time for
    which the controller may continue without knowing; it must span a few frames of the camera, or every late frame
    causes a stop.  ``accept_suspect``: also allow held, uncertain or unconfirmed transforms.  ``max_sigma_m``: allow a
    transform only while the standard deviation of the TCP along each camera axis is at most this.
    ``max_protection_m``: only while its protection level, the bound on the TCP's position error, is known and at most
    this (None: the verdict decides, by the monitor's own alert limit).  ``clocks_agree``: the clocks of monitor and
    controller are synchronised (same machine, PTP): the age then counts from the capture stamp if that is more, and a
    stamp in the future is refused.
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
    """The newest transform at the time of the call; immutable, may be passed on and kept.

    ``transform`` (``cam_T_grip``), ``covariance`` (36 numbers, 6 x 6 row by row: m, rad, camera axes), ``protection``
    (bounds on the error of ``transform`` at a stated risk; None from an older monitor, too) and ``smoothed`` are
    None whenever ``verdict`` is ``unknown``.  ``valid_by`` says which transform and error these four are of: the
    reference after the motion since it, or the transform as measured; ``since_reference`` and ``absolute`` have both
    bounds, and the latter the transform as measured.  The verdict is the monitor's, but ``unknown`` if the monitor is
    gone, its last transform is too old, or there is none.

    ``usable``: the policy allows it; otherwise ``why`` gives the reason in a word and ``reason`` in a line.  ``age_s``
    bounds the time since the monitor received the frame: its processing time, the largest possible delay of the message
    (:mod:`gripmon.client.age`), and the time since it arrived; the transfer of the image to the monitor is not
    included.  It is infinite if no transform came yet, or if the delay is unknown.  ``stamp_ns``: capture time by the
    monitor's clock; ``monitor_id``: the start of the monitor that sent it.
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
    valid_by: ValidBy = ValidBy.ABSOLUTE
    since_reference: SinceReference | None = None
    absolute: Absolute | None = None
    record: FrameRecord | None = None

    def same_revision_as(self, other: Reading) -> bool:
        """Whether both refer to the same reference of the same start of the monitor; only then may they be subtracted.
        False without a reference.
        """
        names = ("monitor", "monitor_id", "reference_id", "revision")
        return self.revision >= 0 and all(getattr(self, name) == getattr(other, name) for name in names)

    def sigma_m(self) -> float:
        """Largest standard deviation of the TCP's position along a camera axis, m; infinite if unknown."""
        return _largest_sigma_m(self.covariance)

    def matrix(self, *, smoothed: bool = False) -> Array:
        """``cam_T_grip`` as a NumPy array (4, 4), m; raises :class:`NotUsable` without a transform.  Loads NumPy.

        ``smoothed``: the transform averaged over time, if there is one; else this frame's.
        """
        pose = self.smoothed if smoothed and self.smoothed is not None else self.transform
        if pose is None:
            raise NotUsable(self)
        from gripmon.model.geometry import from_record

        return from_record(Transform(pose.translation_m, pose.rotation_xyzw))


def _largest_sigma_m(covariance: tuple[float, ...] | None) -> float:
    """The largest standard deviation of the position along an axis, m; infinite without a covariance."""
    return math.inf if covariance is None else math.sqrt(max(covariance[0], covariance[7], covariance[14]))


_Refusal = tuple[Unusable, str]
_FACTS = ("state", "source", "stamp_ns", "seq", "reference_id", "revision", "monitor_id", "valid_by")
_TO_MOVE_BY = ("covariance", "smoothed", "protection", "since_reference", "absolute")


def judge(
    heard: Heard, entry: Entry | None, policy: Policy, now_s: float, wall_ns: int, fault: Callable[[], str]
) -> Reading:
    """The reading of ``entry`` at ``now_s`` by our steady clock, ``wall_ns`` by the wall clock.

    ``heard`` says which monitors are present; ``fault``, called only if there is no entry, names a missing connection.
    """
    if entry is None:
        why, reason = _cut_off(heard, None, now_s) or _silence(heard, fault)
        return Reading(monitor=None, verdict=Verdict.UNKNOWN, usable=False, why=why, reason=reason, age_s=math.inf)
    record = entry.record
    age_s = _age_s(heard, entry, policy, now_s, wall_ns)
    lost = _cut_off(heard, entry, now_s) or _holds_no_longer(heard, entry, age_s, policy, wall_ns)
    refusal = lost or _against_policy(record, policy)
    return Reading(
        monitor=entry.monitor,
        verdict=Verdict.UNKNOWN if lost else record.verdict,
        usable=refusal is None,
        why=refusal[0] if refusal else None,
        reason=refusal[1] if refusal else "",
        age_s=age_s,
        transform=None if lost else record.cam_T_grip,
        record=record,
        **{name: getattr(record, name) for name in _FACTS},
        **{name: None if lost else getattr(record, name) for name in _TO_MOVE_BY},  # type: ignore[arg-type]
    )


def _age_s(heard: Heard, entry: Entry, policy: Policy, now_s: float, wall_ns: int) -> float:
    """Upper bound of the age, s; infinite if the message's delay is unknown."""
    age_s = max(0.0, now_s - entry.arrival_s) + 1e-9 * entry.record.latency_ns
    on_its_way_s = waited_s(heard.leads, entry.sent)
    if policy.clocks_agree:
        return max(age_s + (on_its_way_s or 0.0), 1e-9 * (wall_ns - entry.record.stamp_ns))
    return math.inf if on_its_way_s is None else age_s + on_its_way_s


def _cut_off(heard: Heard, entry: Entry | None, now_s: float) -> _Refusal | None:
    """Refuses if the client is closed, the monitor is gone, or several monitors have the name."""
    if heard.closed:
        return Unusable.CLOSED, heard.closed
    if text := several(heard, now_s):
        return Unusable.SEVERAL, text
    if entry is None or not heard.cut:
        return None
    if _is_back(heard, entry):
        return Unusable.RESTARTED, "the monitor was gone and is back, but has sent no transform yet"
    return Unusable.GONE, "the monitor is gone"


def _is_back(heard: Heard, entry: Entry) -> bool:
    """Whether the vanished monitor is present again; either of its two tokens may be the last to go."""
    if entry.monitor not in heard.present:
        return False
    return not entry.record.monitor_id or any(start.monitor == entry.monitor for start in heard.starts)


def _silence(heard: Heard, fault: Callable[[], str]) -> _Refusal:
    if heard.unreadable:
        return Unusable.UNREADABLE, f"no transform came that can be read: {heard.unreadable}"
    if text := fault():
        return Unusable.NOT_CONNECTED, text
    if heard.present:
        return Unusable.NOTHING_YET, "no transform came yet"
    others = f"; there are {', '.join(map(str, sorted(heard.elsewhere)))}" if heard.elsewhere else ""
    return Unusable.NOTHING_YET, f"no transform came yet, and no monitor of this name is seen{others}"


def _holds_no_longer(heard: Heard, entry: Entry, age_s: float, policy: Policy, wall_ns: int) -> _Refusal | None:
    """Refuses a transform that is unknown, too old, or of unknown age."""
    record = entry.record
    if record.verdict is Verdict.UNKNOWN:
        return Unusable.UNKNOWN, f"the monitor has no transform: {record.reason or record.state}"
    ahead_s = 1e-9 * (record.stamp_ns - wall_ns)
    if policy.clocks_agree and ahead_s > CLOCK_AHEAD_LIMIT_S:
        # Impossible if the clocks agree: one of them is wrong, and they give no age.
        text = f"the transform's stamp is {ahead_s:.3g} s ahead of this machine's clock: clocks_agree does not hold"
        return Unusable.CLOCKS, text
    if age_s == math.inf:
        why = "the monitor has not sent its clock yet"
        if entry.sent is None:
            why = "a monitor of an older version sends none; update it, or synchronise the clocks and set clocks_agree"
        return Unusable.AGE_UNKNOWN, f"the transform's delay is not known: {why}"
    if age_s > policy.max_age_s:
        since = f"; what came since can't be read: {heard.unreadable}" if heard.unreadable else ""
        text = f"the newest transform is {age_s:.3g} s old, at most {policy.max_age_s:g} s is allowed{since}"
        return Unusable.STALE, text
    return None


def _against_policy(record: FrameRecord, policy: Policy) -> _Refusal | None:
    """Refuses by verdict, standard deviation and protection level."""
    if record.verdict is Verdict.SUSPECT and not policy.accept_suspect:
        return Unusable.SUSPECT, f"the transform is suspect: {record.reason or record.state}"
    allowed_m = policy.max_sigma_m
    if allowed_m is not None and (sigma_m := _largest_sigma_m(record.covariance)) > allowed_m:
        sigma = f"the transform has a standard deviation of {1e3 * sigma_m:.3g} mm"
        text = f"{sigma}, at most {1e3 * allowed_m:g} mm is allowed"
        return Unusable.UNCERTAIN, text
    allowed_m = policy.max_protection_m
    if allowed_m is None:
        return None
    if record.protection is None:
        return Unusable.UNPROTECTED, "the monitor states no protection level; a newer version of it does"
    bound_m = record.protection.position_m
    if bound_m <= allowed_m:
        return None
    return Unusable.UNPROTECTED, f"the TCP may be {1e3 * bound_m:.3g} mm off, at most {1e3 * allowed_m:g} mm is allowed"
