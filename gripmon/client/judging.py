"""From what was heard to a reading: the rules for verdicts, and the controller's own policy."""

from __future__ import annotations

import math
from collections.abc import Callable

from gripmon.client.age import waited_s
from gripmon.client.inbox import Entry, Heard, several
from gripmon.client.reading import Policy, Reading, Unusable, largest_sigma_m
from gripmon.model.records import FrameRecord, Verdict

_Refusal = tuple[Unusable, str]

MOST_AHEAD_S = 0.1
"""A stamp further ahead than this is of a clock that doesn't agree: those that NTP keeps, on whatever network, are
within some tens of milliseconds."""


def judge(
    heard: Heard, entry: Entry | None, policy: Policy, now_s: float, wall_ns: int, fault: Callable[[], str]
) -> Reading:
    """The reading of ``entry`` at ``now_s`` by the monotonic clock, ``wall_ns`` by the wall clock.

    ``heard`` says who is there; ``fault`` is asked only where there is no entry: whom there is no connection to.
    """
    if entry is None:
        why, reason = _cut_off(heard, None, now_s) or _silence(heard, fault)
        return Reading(monitor=None, verdict=Verdict.UNKNOWN, usable=False, why=why, reason=reason, age_s=math.inf)
    record = entry.record
    age_s = _age_s(heard, entry, policy, now_s, wall_ns)
    lost = (
        _cut_off(heard, entry, now_s)
        or _unknown(record)
        or _from_the_future(record, policy, wall_ns)
        or _of_unknown_age(entry, age_s)
        or _too_old(heard, age_s, policy)
    )
    refusal = lost or _against_policy(record, policy)
    return Reading(
        monitor=entry.monitor,
        verdict=Verdict.UNKNOWN if lost else record.verdict,
        usable=refusal is None,
        why=refusal[0] if refusal else None,
        reason=refusal[1] if refusal else "",
        age_s=age_s,
        transform=None if lost else record.cam_T_grip,
        covariance=None if lost else record.covariance,
        smoothed=None if lost else record.smoothed,
        protection=None if lost else record.protection,
        state=record.state,
        source=record.source,
        stamp_ns=record.stamp_ns,
        seq=record.seq,
        reference_id=record.reference_id,
        revision=record.revision,
        monitor_id=record.monitor_id,
    )


def _age_s(heard: Heard, entry: Entry, policy: Policy, now_s: float, wall_ns: int) -> float:
    """It is not older, s; infinite if nothing tells how long it was on its way."""
    age_s = max(0.0, now_s - entry.arrival_s) + 1e-9 * entry.record.latency_ns
    on_its_way_s = waited_s(heard.leads, entry.sent)
    if policy.clocks_agree:
        return max(age_s + (on_its_way_s or 0.0), 1e-9 * (wall_ns - entry.record.stamp_ns))
    return math.inf if on_its_way_s is None else age_s + on_its_way_s


def _cut_off(heard: Heard, entry: Entry | None, now_s: float) -> _Refusal | None:
    """Is it unclear whether the monitor, and which one, still stands by what it said?"""
    if heard.closed:
        return Unusable.CLOSED, "the client is closed"
    if text := several(heard, now_s):
        return Unusable.SEVERAL, text
    if entry is None or not heard.cut:
        return None
    if _is_back(heard, entry):
        return Unusable.RESTARTED, "the monitor was gone and is back, but has sent no transform yet"
    return Unusable.GONE, "the monitor is gone"


def _is_back(heard: Heard, entry: Entry) -> bool:
    """Is the monitor that vanished there again?  Of its two tokens either may be the last to go."""
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


def _unknown(record: FrameRecord) -> _Refusal | None:
    if record.verdict is not Verdict.UNKNOWN:
        return None
    return Unusable.UNKNOWN, f"the monitor has no transform: {record.reason or record.state}"


def _from_the_future(record: FrameRecord, policy: Policy, wall_ns: int) -> _Refusal | None:
    """With clocks that agree there is no such thing: one of them is wrong, and no age can be told by them."""
    ahead_s = 1e-9 * (record.stamp_ns - wall_ns)
    if not policy.clocks_agree or ahead_s <= MOST_AHEAD_S:
        return None
    text = f"the transform's stamp is {ahead_s:.3g} s ahead of this machine's clock: clocks_agree does not hold"
    return Unusable.CLOCKS, text


def _of_unknown_age(entry: Entry, age_s: float) -> _Refusal | None:
    if age_s < math.inf:
        return None
    why = (
        "a monitor of an older version doesn't tell; update it, or let the clocks agree and set clocks_agree"
        if entry.sent is None
        else "the monitor has not answered yet what its clock shows"
    )
    return Unusable.AGE_UNKNOWN, f"how long the transform was on its way is not known: {why}"


def _too_old(heard: Heard, age_s: float, policy: Policy) -> _Refusal | None:
    if age_s <= policy.max_age_s:
        return None
    since = f"; what came since can't be read: {heard.unreadable}" if heard.unreadable else ""
    return Unusable.STALE, f"the newest transform is {age_s:.3g} s old, allowed are {policy.max_age_s:g} s{since}"


def _against_policy(record: FrameRecord, policy: Policy) -> _Refusal | None:
    if record.verdict is Verdict.SUSPECT and not policy.accept_suspect:
        return Unusable.SUSPECT, f"the transform is suspect: {record.reason or record.state}"
    if policy.max_sigma_m is not None and (sigma_m := largest_sigma_m(record.covariance)) > policy.max_sigma_m:
        return (
            Unusable.UNCERTAIN,
            f"the transform is certain to {1e3 * sigma_m:.3g} mm, allowed are {1e3 * policy.max_sigma_m:g} mm",
        )
    return _unprotected(record, policy.max_protection_m)


def _unprotected(record: FrameRecord, allowed_m: float | None) -> _Refusal | None:
    """The bound on the error, and not the covariance: what the monitor doesn't promise is not to be relied on."""
    if allowed_m is None:
        return None
    if record.protection is None:
        return Unusable.UNPROTECTED, "the monitor states no protection level; a newer version of it does"
    bound_m = record.protection.position_m
    if bound_m <= allowed_m:
        return None
    return Unusable.UNPROTECTED, f"the TCP may be {1e3 * bound_m:.3g} mm off, allowed are {1e3 * allowed_m:g} mm"
