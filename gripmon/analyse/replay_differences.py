"""What a replay decides otherwise than was recorded: verdicts, states and alerts first, numbers after."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gripmon.model.records import Alert, FrameRecord

_MOST_SHOWN = 3


class Differences:
    """Counted frame by frame."""

    def __init__(self) -> None:
        self.frames = 0
        self._same = self._verdicts = self._states = 0
        self._first: dict[str, str] = {}
        self._largest_m = 0.0
        self._alerts_then, self._alerts_now = _AlertChanges(), _AlertChanges()

    def add(self, then: FrameRecord, now: FrameRecord) -> None:
        """The same frame, as it was recorded and as it is replayed."""
        import msgspec

        self.frames += 1
        self._same += msgspec.structs.replace(then, latency_ns=now.latency_ns) == now
        for what in ("verdict", "state"):
            before, after = getattr(then, what), getattr(now, what)
            if before is not after:
                self._first.setdefault(what, f"frame {now.seq}, {after} instead of {before}")
        self._verdicts += then.verdict is not now.verdict
        self._states += then.state is not now.state
        if then.cam_T_grip is not None and now.cam_T_grip is not None:
            self._largest_m = max(
                self._largest_m, math.dist(now.cam_T_grip.translation_m, then.cam_T_grip.translation_m)
            )
        self._alerts_then.add(then.seq, then.alerts)
        self._alerts_now.add(now.seq, now.alerts)

    def text(self, from_jpeg: bool) -> str:
        """``from_jpeg``: the images that were replayed had lost what a JPEG loses, which changes every number."""
        if self._same == self.frames:
            return f"all {self.frames} as they were recorded, every number the same"
        alerts = self._alerts_now.against(self._alerts_then)
        judged = [
            f"{_frames(count)} with another {what} (the first: {self._first[what]})"
            for what, count in (("verdict", self._verdicts), ("state", self._states))
            if count
        ]
        if alerts:
            judged = [*(judged or ["verdicts and states as recorded"]), f"alerts differ: {alerts}"]
        same = f"verdicts, states and alerts of all {self.frames} frames as recorded"
        numbers = f"numbers differ in {self.frames - self._same}, the TCP by up to {1e3 * self._largest_m:.2g} mm"
        why = " (the images were recorded as JPEG)" if from_jpeg else ""
        return f"{'; '.join(judged) or same}; {numbers}{why}"


class _AlertChanges:
    """When alerts began, ended, or came to another severity, by kind and what changed."""

    def __init__(self) -> None:
        self._severity: dict[str, str] = {}  # of what is open, by the alert's id
        self._at: defaultdict[str, list[int]] = defaultdict(list)

    def add(self, seq: int, alerts: tuple[Alert, ...]) -> None:
        for alert in alerts:
            known = self._severity.get(alert.alert_id)
            if alert.event == "cleared":
                self._severity.pop(alert.alert_id, None)
                self._at[f"{alert.kind} cleared"].append(seq)
            elif alert.event == "noted":
                self._at[f"{alert.kind} ({alert.severity})"].append(seq)
            elif known != alert.severity:
                self._severity[alert.alert_id] = alert.severity
                change = "raised as" if alert.event == "raised" else "becomes"
                self._at[f"{alert.kind} {change} {alert.severity}"].append(seq)

    def against(self, then: _AlertChanges) -> str:
        """What is more, less, or at another frame than then, in words; empty for nothing."""
        texts = []
        for what in sorted({*self._at, *then._at}, key=lambda w: ((self._at.get(w) or then._at[w])[0], w)):
            now_at, then_at = self._at.get(what, []), then._at.get(what, [])
            if len(now_at) > len(then_at):
                texts.append(f"{what} at frame {now_at[len(then_at)]}, not recorded")
            elif len(now_at) < len(then_at):
                texts.append(f"no {what}, recorded at frame {then_at[len(now_at)]}")
            elif now_at != then_at:
                now_seq, then_seq = next(pair for pair in zip(now_at, then_at, strict=True) if pair[0] != pair[1])
                texts.append(f"{what} at frame {now_seq}, recorded at {then_seq}")
        more = len(texts) - _MOST_SHOWN
        return ", ".join(texts[:_MOST_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"
