"""The loop of a second camera: frames and laser pulses in, one judged spot per pulse out."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Sequence
from typing import Unpack

import msgspec

from gripmon.daemon.estimates import EstimatesFile
from gripmon.daemon.snapshots import Newest
from gripmon.daemon.supervised import Loop, Parts
from gripmon.daemon.watch import FrameOutcome
from gripmon.io.publish.inputs import ZenohPulses
from gripmon.judge.policy import AlertBook
from gripmon.laser.matching import ReportedPulse, Shown
from gripmon.laser.watching import Outcome, PulsedWatch
from gripmon.model.errors import in_short
from gripmon.model.records import (
    Alert,
    AlertKind,
    Cause,
    Command,
    CommandName,
    CommandReply,
    Frame,
    FrameRecord,
    MonitorState,
    Origin,
    PulseFault,
    Severity,
    State,
    Verdict,
)
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

_log = logging.getLogger(__name__)
_NO_SPOT = "no_spot"
_PULSES_A_TURN = 16
_NOT_HERE = (
    "this is a second camera, which measures no reference of its own; to calibrate it again: gripmon calibrate laser"
)


class SecondCamera(Loop):
    """Watches one calibration, in the thread that calls :meth:`run`."""

    verdict_of = "calibration"

    def __init__(
        self,
        pulsed: PulsedWatch,
        *,
        lines: EstimatesFile,
        table: Sequence[ReportedPulse] = (),
        feed: ZenohPulses | None = None,
        no_spot_alert_after_s: float | None = None,
        **parts: Unpack[Parts],
    ) -> None:
        """``table``: all pulses of recorded frames; ``feed``: the source of pulses otherwise.

        ``no_spot_alert_after_s``: time without an accepted spot after which there is an alert; None: never.
        """
        super().__init__(**parts)
        self._pulsed = pulsed
        self._lines = lines
        self._table, self._feed = table, feed
        self._no_spot_s = no_spot_alert_after_s
        self._alerts = AlertBook(update_s=math.inf, clear_s=0.0)
        self._accepted_s = self._start_s
        self._pulses = 0
        self._failure = ""  # internal error of the last pulse
        self._news = False  # a pulse was judged since the last frame, or judging failed
        self._unused = "no pulse yet"
        self._logged_unused: PulseFault | None = None  # in the log

    @property
    def _in_force(self) -> tuple[str, int]:
        return self._pulsed.reference_id, 0

    def _begin(self) -> None:
        self._pulsed.matcher.load(self._table)

    def _between(self) -> None:
        now_s = time.monotonic()
        for _ in range(_PULSES_A_TURN):  # so that many pulses can't delay frames
            report = None if self._feed is None else self._feed.poll()
            if report is None:
                break
            self._judge(self._pulsed.matcher.pulse(report, now_s))
        self._judge(self._pulsed.matcher.tick(now_s))
        self._look_for_silence(now_s)
        self._gather_alerts()

    def _handle(self, frame: Frame) -> None:
        self._seq = frame.seq
        failure, refused = "", ""
        alerts: tuple[Alert, ...] = ()
        shown: list[Shown] = []
        try:
            shown, alerts, refused = self._pulsed.frame(frame)
        except Exception as error:  # noqa: BLE001  reported and counted
            failure = self._failed(f"frame {frame.seq}: ", error)
        self._judge(shown)
        self._news = self._news or bool(failure)
        failure = failure or self._failure
        self._alert_all(alerts, self._pulsed.state, frame.stamp_ns)
        self._gather_alerts()
        judged = self._judged(refused, failure)
        self._newest = Newest(frame, self._frame_record(frame, judged), time.monotonic())
        for alert in self._watch.judged(judged, time.monotonic()):
            self._alert(alert, judged.state, frame.stamp_ns)
        self._end_of_frame(frame, failure, judged.state)

    def _end_of_frame(self, frame: Frame, failure: str, state: State) -> None:
        """Errors are counted per pulse: between pulses a failure neither ends nor counts again."""
        over = not failure and self._watch.errors_in_a_row > 0
        if self._news or self._faults or over:
            undelivered = "; ".join(self._faults.values())
            self._faults.clear()
            self._news = False
            for alert in self._watch.end_of_frame(failure, undelivered, time.monotonic(), frame.stamp_ns):
                self._alert(alert, state, frame.stamp_ns)

    def _judged(self, refused: str, failure: str) -> FrameOutcome:
        """The judgement of this frame."""
        if failure:
            return FrameOutcome(State.LOST, Verdict.UNKNOWN, usable=not refused, reason=failure)
        gap = self._pulsed.displacement
        return FrameOutcome(
            self._pulsed.state,
            self._pulsed.verdict,
            usable=not refused,
            refused=bool(refused),
            reason=refused or self._unused,
            tcp_shift_m=None if gap is None else gap.shift_m,
            sigma_m=None if gap is None else gap.sigma_m,
        )

    def _judge(self, shown: Iterable[Shown]) -> None:
        """Judge complete pulses and pass on the results."""
        for each in shown:
            began_ns = time.monotonic_ns()
            self._pulses += 1
            self._news = True
            try:
                outcome, self._failure = self._pulsed.judge(each), ""
            except Exception as error:  # noqa: BLE001  reported and counted
                self._failure = self._failed(f"pulse {each.pulse.number}: ", error)
                outcome = self._pulsed.unjudged(each, PulseFault.INTERNAL, self._failure)
            latency_ns = time.monotonic_ns() - began_ns
            self._pass_on(Outcome(msgspec.structs.replace(outcome.record, latency_ns=latency_ns), outcome.image))

    def _pass_on(self, outcome: Outcome) -> None:
        record = outcome.record
        several = self._not_alone()
        published = msgspec.structs.replace(record, verdict=Verdict.UNKNOWN, reason=several) if several else record
        self._deliver("spot", self._publisher.spot, published)
        self._alert_all(record.alerts, record.state, record.stamp_ns, recorded=True)
        if record.used:
            self._accepted_s, self._unused = time.monotonic(), ""
        else:
            self._unused = f"the last pulse is not used: {record.reason}"
            if record.fault is not self._logged_unused:
                _log.info("pulse %d is not used: %s", record.pulse, record.reason)
        self._logged_unused = record.fault
        self._deliver("recording", self._recorder.spot, record, outcome.image)
        self._deliver("lines", self._lines.write, record)

    def _failed(self, where: str, error: Exception) -> str:
        failure = f"internal error: {in_short(error)}"
        self._log_once("judgement", where, failure, error)
        return failure

    def _alert_all(
        self, alerts: Iterable[Alert], state: State, stamp_ns: int | None = None, *, recorded: bool = False
    ) -> None:
        for alert in alerts:
            self._alert(alert, state, stamp_ns, recorded=recorded)

    def _look_for_silence(self, now_s: float) -> None:
        """Alert if there are no spots, e.g. because the robot no longer switches its laser on."""
        if self._no_spot_s is None or not self._source.live:
            return
        silence_s = now_s - self._accepted_s
        if silence_s < self._no_spot_s:
            self._alert_all(self._alerts.absent(_NO_SPOT, "spots are seen again", now_s), self._pulsed.state)
            return
        text = f"no usable spot for {silence_s:.0f} s: {self._unused or 'no pulse was reported'}"
        alert = Alert(AlertKind.STREAM, Cause.UNKNOWN, Severity.WARNING, text)
        self._alert_all(self._alerts.present(_NO_SPOT, alert, now_s, time.time_ns()), self._pulsed.state)

    def _gather_alerts(self) -> None:
        self._open_alerts = (*self._pulsed.open_alerts, *self._alerts.open)

    def _carry_out(self, command: Command, stamp_ns: int) -> CommandReply:
        name, argument = command.name, command.argument
        if name in (CommandName.STATE, CommandName.SNAPSHOT):
            return self._reply(name, True, f"{self._pulsed.state}, {self._pulsed.reference_id} in force", whole=True)
        if name is CommandName.ACKNOWLEDGE:
            seen = (*self._pulsed.acknowledge(argument), *self._alerts.acknowledge(argument))
            self._alert_all(seen, self._pulsed.state)
            if not seen:
                which = f"no open alert {argument}" if argument else "no open alert"
                return self._reply(name, False, f"{which} that isn't acknowledged")
            return self._reply(name, True, "acknowledged: " + ", ".join(alert.alert_id for alert in seen))
        if name is CommandName.RESET:
            self._alert_all(self._pulsed.reset(), self._pulsed.state)
            return self._reply(name, True, f"{self._pulsed.reference_id} is trusted again; earlier spots are discarded")
        return self._reply(name, False, _NOT_HERE)

    def _reply(self, name: CommandName, done: bool, text: str, *, whole: bool = False) -> CommandReply:
        self._gather_alerts()
        state = MonitorState((), alerts=self._open_alerts) if whole else None
        return CommandReply(name, done, text, *self._in_force, state)

    def _frame_record(self, frame: Frame, judged: FrameOutcome) -> FrameRecord:
        """The record of a frame for a snapshot."""
        reference_id, revision = self._in_force
        return FrameRecord(
            seq=frame.seq, stamp_ns=frame.stamp_ns, verdict=judged.verdict, state=judged.state, source=Origin.HELD,
            cam_T_grip=None, covariance=None, smoothed=None, drift=None, reference_id=reference_id, revision=revision,
            rms_px=None, jaw_opening_m=None, corners=(), alerts=(),
            reason=judged.reason or "a second camera has no cam_T_grip", name=frame.name,
        )  # fmt: skip

    def _finish(self) -> None:
        self._judge(self._pulsed.matcher.finish())
        self._gather_alerts()

    def _housekeeping(self) -> None:
        self._lines.flush()
        super()._housekeeping()

    def _code_at_the_end(self) -> int:
        code = super()._code_at_the_end()
        if code == EXIT_DONE:
            self._judge(self._pulsed.matcher.finish())
            if self._pulses and not self._pulsed.usable:
                _log.error("no pulse showed its spot: %s", self._unused)
                return EXIT_FAILED
        return code
