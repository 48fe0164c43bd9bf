"""What is reported besides the frame records: counts, silence, internal errors, dropped frames."""

from __future__ import annotations

import math
from collections import deque
from typing import Annotated, NamedTuple

import msgspec

from gripmon.io.wire.malformed import FIGURES
from gripmon.judge.policy import AlertBook
from gripmon.model.records import (
    Alert,
    AlertKind,
    Cause,
    CornerFault,
    FrameRecord,
    OpenAlert,
    Origin,
    Severity,
    StandingAlert,
    State,
    ValidBy,
    Verdict,
)
from gripmon.model.units import in_time

_RATE_OVER_FRAMES = 64
_UPDATE_S = 10.0
"""Pause between updates of a failure's text; another reason is reported at once, other figures are not."""
_SILENCE, _FAILURE, _RECORDING, _OUTPUT = "silence", "failure", "recording", "output"
_OTHERS, _DROPS = "others", "drops"
_TOPICS = {
    _OUTPUT: (AlertKind.OUTPUT, Cause.UNKNOWN, Severity.ERROR, "all outputs accept messages again"),
    _FAILURE: (AlertKind.LOST, Cause.UNKNOWN, Severity.ERROR, "frames are processed again"),
    _RECORDING: (AlertKind.RECORDING, Cause.UNKNOWN, Severity.WARNING, "recording continues"),
    _DROPS: (AlertKind.STREAM, Cause.TOO_SLOW, Severity.WARNING, "the monitor keeps up with the camera again"),
    _OTHERS: (AlertKind.SEVERAL, Cause.UNKNOWN, Severity.ERROR, "no other monitor has this name any more"),
}
"""By topic the alert while something is wrong, and what is said when nothing is any more."""

DROP_WINDOW_S = 10.0
"""Dropped frames are counted over this time; the first slow seconds after a start don't matter."""

_LOOK_EVERY_S = 1.0


class DaemonSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When the loop raises alerts, and when it gives up."""

    state_period_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="period of state messages while nothing changes (s)")
    ] = 1.0
    stale_after_s: Annotated[
        float,
        msgspec.Meta(
            gt=0.0, description="time without a frame after which the state is stale, to within half a second (s)"
        ),
    ] = 0.5
    no_camera_alert_after_s: Annotated[
        float, msgspec.Meta(gt=0.0, description="time without a frame after which there is an alert (s)")
    ] = 3.0
    dropped_alert_share: Annotated[
        float,
        msgspec.Meta(
            gt=0.0,
            le=1.0,
            description="fraction of 10 s of frames that may be dropped for lack of time without an alert",
        ),
    ] = 0.2
    give_up_after_errors: Annotated[
        int,
        msgspec.Meta(
            ge=1,
            description="number of successive frames with internal errors after which the daemon stops with "
            "exit code 3",
        ),
    ] = 50
    estimates_budget_bytes: Annotated[
        int,
        msgspec.Meta(
            ge=0,
            description="limit for estimates.jsonl of run --out together with the earlier ones "
            "kept beside it: each file is a tenth of this, and beyond it the oldest are deleted; "
            "0: one file without limit (bytes)",
        ),
    ] = 10_000_000_000
    real_time: Annotated[
        bool,
        msgspec.Meta(
            description="ask the system for real-time priority, so that other programs don't delay frames; the log "
            "says what it gave"
        ),
    ] = False
    stop_within_s: Annotated[
        float,
        msgspec.Meta(
            gt=0.0, description="time from a stop signal to the end of the process, with the recording completed (s)"
        ),
    ] = 1.8


class FrameOutcome(NamedTuple):
    """What is kept of a frame.  ``usable``: it was measured; ``refused``: its image could not be used; ``reason``: what
    is wrong, if anything.  ``tcp_shift_m``, ``sigma_m``, ``protection_m`` and ``valid_by`` as in the state message.
    """

    state: State
    verdict: Verdict
    usable: bool
    refused: bool = False
    reason: str = ""
    tcp_shift_m: tuple[float, float, float] | None = None
    sigma_m: float | None = None
    protection_m: float | None = None
    valid_by: ValidBy | None = None


_NOTHING = FrameOutcome(State.ACQUIRING, Verdict.UNKNOWN, usable=False)


class Watch:
    """Counts frames and raises alerts from records and times alone, without a clock.  All times are monotonic seconds.

    ``state``, ``verdict``, ``message`` and ``undelivered`` are those of the state message.  The monitor raises alerts
    about images; this raises those about missing images, when they have been missing for a while, and clears them.
    """

    def __init__(self, settings: DaemonSettings, now_s: float) -> None:
        self._settings = settings
        self.state = State.ACQUIRING
        self.verdict = Verdict.UNKNOWN
        self.message = "no frame yet"
        self.frames = 0
        self.frames_refused = 0
        self.frames_usable = 0
        self.undelivered = ""
        self.errors_in_a_row = 0
        self._alerts = AlertBook(update_s=_UPDATE_S, clear_s=0.0)
        self._drops = Drops(settings.dropped_alert_share)
        self._frame_times_s: deque[float] = deque(maxlen=_RATE_OVER_FRAMES)
        self._last_frame_s = now_s
        self._judged = _NOTHING

    def frame(self, record: FrameRecord, now_s: float) -> list[Alert]:
        """A frame was judged; returns the alerts that are due besides the record's own."""
        frame = _of_record(record)
        alerts = self._end_of_silence(now_s)
        self.frames += 1
        self.frames_usable += frame.usable
        self._frame_times_s.append(now_s)
        self._last_frame_s = now_s
        self.state, self.verdict = frame.state, frame.verdict
        self._judged = frame
        if frame.refused:
            self.frames_refused += 1
            self._keep_message(f"frames refused: {frame.reason}")
        else:
            self._keep_message(frame.reason)
        return alerts

    def no_frame(self, reason: str, now_s: float, stamp_ns: int) -> list[Alert]:
        """The source has no frame, for the given reason; ``stamp_ns``: Unix time."""
        silence_s = now_s - self._last_frame_s
        if silence_s >= self._settings.stale_after_s:
            self.state, self.verdict = State.STALE, Verdict.UNKNOWN
            self.message = f"no frames: {reason}"
        if silence_s < self._settings.no_camera_alert_after_s:
            return []
        since = in_time(stamp_ns - round(1e9 * silence_s))
        silent = Alert(AlertKind.SOURCE, Cause.NO_CAMERA, Severity.ERROR, f"no frame since {since}: {reason}")
        return list(self._alerts.present(_SILENCE, silent, now_s, stamp_ns))

    def end_of_frame(self, failure: str, undelivered: str, now_s: float, stamp_ns: int) -> list[Alert]:
        """What failed in the daemon, not in the camera: ``failure`` of the monitor, ``undelivered`` outputs.

        Only the first affects the transform and counts as an error: a failing output must not end the monitor and the
        other outputs.
        """
        self.undelivered = undelivered
        self.errors_in_a_row = self.errors_in_a_row + 1 if failure else 0
        if failure:
            self.state, self.verdict, self.message = State.LOST, Verdict.UNKNOWN, failure
        outputs = self._said(_OUTPUT, undelivered, now_s, stamp_ns, news=True)
        return [*outputs, *self._said(_FAILURE, failure, now_s, stamp_ns)]

    def recording(self, failure: str | None, now_s: float, stamp_ns: int) -> list[Alert]:
        """Recording has stopped or drops data, as ``failure`` says; the monitor continues."""
        return self._said(_RECORDING, failure or "", now_s, stamp_ns, news=True)

    def dropped(self, count: int, now_s: float, stamp_ns: int) -> list[Alert]:
        """``count``: frames dropped since the start because another one was being processed."""
        return self._said(_DROPS, self._drops.look(self.frames, count, now_s), now_s, stamp_ns)

    def others(self, text: str, now_s: float, stamp_ns: int) -> list[Alert]:
        """``text``: about other monitors with this name, empty while there are none."""
        return self._said(_OTHERS, text, now_s, stamp_ns)

    def _said(self, topic: str, text: str, now_s: float, stamp_ns: int, *, news: bool = False) -> list[Alert]:
        """The alert that is due while something is wrong, as ``text`` says, and once when nothing is any more (empty);
        ``news``: also when it now has another reason.
        """
        kind, cause, severity, over = _TOPICS[topic]
        if not text:
            return list(self._alerts.absent(topic, over, now_s))
        before = self._alerts.about(topic)
        news = news and before is not None and kind_of(before.text) != kind_of(text)
        return list(self._alerts.present(topic, Alert(kind, cause, severity, text), now_s, stamp_ns, news=news))

    def stopped(self) -> None:
        """The end: a reader of the last state message must not continue to trust the last transform."""
        self.state, self.verdict, self.message = State.STALE, Verdict.UNKNOWN, "stopped"

    @property
    def last(self) -> FrameOutcome:
        """What is kept of the last frame while its state and verdict still hold; otherwise one without values."""
        if (self.state, self.verdict) == (self._judged.state, self._judged.verdict):
            return self._judged
        return _NOTHING

    def standing(self, of_the_monitor: tuple[OpenAlert, ...]) -> tuple[StandingAlert, ...]:
        """All open alerts, the monitor's and those raised here, the oldest first."""
        alerts = [each.alert for each in (*of_the_monitor, *self._alerts.open)]
        return tuple(
            StandingAlert(a.alert_id, a.kind, a.severity, a.text, a.since_ns, a.acknowledged)
            for a in sorted(alerts, key=lambda alert: alert.since_ns or 0)
        )

    @property
    def open(self) -> tuple[OpenAlert, ...]:
        """The alerts raised here that are open."""
        return self._alerts.open

    def acknowledge(self, alert_id: str) -> tuple[Alert, ...]:
        """A person has seen those raised here: one, or all for an empty id.  What is told of it; empty: none."""
        return self._alerts.acknowledge(alert_id)

    @property
    def gives_up(self) -> bool:
        """Whether errors have persisted for as long as the settings allow."""
        return self.errors_in_a_row >= self._settings.give_up_after_errors

    def frames_per_s(self, now_s: float) -> float:
        """The rate of the last frames; 0 while there are none."""
        times_s = self._frame_times_s
        if len(times_s) < 2 or now_s - times_s[-1] >= self._settings.stale_after_s or times_s[-1] <= times_s[0]:
            return 0.0
        return (len(times_s) - 1) / (times_s[-1] - times_s[0])

    def _keep_message(self, text: str) -> None:
        """Update the message only if it changes in more than its figures, which may differ in every frame."""
        if kind_of(text) != kind_of(self.message):
            self.message = text

    def _end_of_silence(self, now_s: float) -> list[Alert]:
        if now_s - self._last_frame_s >= self._settings.stale_after_s:
            self._frame_times_s.clear()
        text = f"frames again after {now_s - self._last_frame_s:.1f} s"
        return list(self._alerts.absent(_SILENCE, text, now_s))


def kind_of(message: str) -> str:
    """The message without figures, which differ in every frame, and without what follows a second colon."""
    return FIGURES.sub("", ":".join(message.split(":")[:2]))


def _of_record(record: FrameRecord) -> FrameOutcome:
    counts = record.verdict is not Verdict.UNKNOWN
    return FrameOutcome(
        record.state,
        record.verdict,
        usable=record.source is not Origin.HELD,
        refused=is_refused(record),
        reason=record.reason or "",
        tcp_shift_m=record.drift.tcp_shift_m if counts and record.drift is not None else None,
        sigma_m=None if not counts or record.covariance is None else math.sqrt(max(record.covariance[:15:7])),
        protection_m=None if not counts or record.protection is None else record.protection.position_m,
        valid_by=record.valid_by,
    )


def is_refused(record: FrameRecord) -> bool:
    """Whether the frame was refused: then every corner has that reason."""
    return bool(record.corners) and record.corners[0].reason is CornerFault.FRAME_REFUSED


class Drops:
    """Detects dropped frames over the last seconds; all times are monotonic seconds."""

    def __init__(self, allowed_share: float) -> None:
        """``allowed_share``: fraction of dropped frames that raises the alert; half of it clears the alert."""
        self._allowed = allowed_share
        self._counts: deque[tuple[float, int, int]] = deque()  # time, frames handled, frames dropped
        self._text = ""

    def look(self, handled: int, dropped: int, now_s: float) -> str:
        """What is wrong and what to change, from the counts since the start; empty if nothing."""
        counts = self._counts
        if counts and now_s - counts[-1][0] < _LOOK_EVERY_S:
            return self._text
        counts.append((now_s, handled, dropped))
        # Time without a frame says nothing about rates, such as that before the camera was there.
        while len(counts) > 1 and (now_s - counts[1][0] >= DROP_WINDOW_S or counts[1][1:] == counts[0][1:]):
            counts.popleft()
        since_s, handled_before, dropped_before = counts[0]
        elapsed_s = now_s - since_s
        few, lost = handled - handled_before, dropped - dropped_before
        if elapsed_s >= DROP_WINDOW_S:
            share = lost / max(1, few + lost)
            allowed = self._allowed / 2.0 if self._text else self._allowed
            self._text = _in_words(few / elapsed_s, (few + lost) / elapsed_s, share) if share > allowed else ""
        elif elapsed_s == 0.0:
            self._text = ""
        return self._text


def _in_words(handled_per_s: float, came_per_s: float, share: float) -> str:
    remedy = "lower the camera's rate (source.fps, or its driver's) to that, give smaller images, or free the processor"
    return (
        f"{100.0 * share:.0f} % of the frames were dropped in {DROP_WINDOW_S:g} s: {came_per_s:.3g} a second arrived, "
        f"the monitor had time for {handled_per_s:.3g}; {remedy} of other work"
    )
