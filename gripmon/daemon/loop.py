"""The loop: a frame in, a transform out; everything that goes wrong is said and survived."""

from __future__ import annotations

import dataclasses
import gc
import logging
import math
import time
from typing import Protocol

import msgspec

from gripmon import __version__
from gripmon.daemon.estimates import EstimatesFile
from gripmon.daemon.settings import DaemonSettings
from gripmon.daemon.watch import Watch
from gripmon.publish import Publisher
from gripmon.recording import Recorder
from gripmon.records import (
    Alert,
    AlertKind,
    AlertRecord,
    Cause,
    Frame,
    FrameRecord,
    MeasurementTrace,
    Origin,
    ReferenceRecord,
    Severity,
    State,
    StateRecord,
    Verdict,
)
from gripmon.sources import Source, Waiting

_log = logging.getLogger(__name__)

EXIT_DONE, EXIT_FAILED = 0, 3
_LEVELS = {Severity.INFO: logging.INFO, Severity.WARNING: logging.WARNING, Severity.ERROR: logging.ERROR}


class MonitorLike(Protocol):
    """What the loop needs of :class:`gripmon.monitor.Monitor`."""

    @property
    def reference(self) -> ReferenceRecord: ...
    def process(self, frame: Frame) -> FrameRecord: ...
    def trace(self) -> MeasurementTrace | None: ...


class JawFeed(Protocol):
    """Where the jaw opening comes from when the frames don't bring it, e.g. :class:`gripmon.publish.ZenohJaw`."""

    def opening_m(self) -> float | None: ...
    def fault(self) -> str: ...


class StopRequest:
    """Asks the loop to end; a signal handler or any thread may do so.  The first request counts."""

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self.requested_s: float | None = None

    def request(self, exit_code: int) -> None:
        if self.exit_code is None:
            self.requested_s = time.monotonic()
            self.exit_code = exit_code


class Daemon:
    """Runs one monitor, in the thread that calls :meth:`run`."""

    def __init__(
        self,
        monitor: MonitorLike,
        source: Source,
        publisher: Publisher,
        recorder: Recorder,
        settings: DaemonSettings,
        stop: StopRequest,
        *,
        robot: str,
        camera: str,
        estimates: EstimatesFile,
        jaw: JawFeed | None = None,
    ) -> None:
        self._monitor = monitor
        self._source = source
        self._publisher = publisher
        self._recorder = recorder
        self._settings = settings
        self._robot, self._camera = robot, camera
        self._estimates = estimates
        self._jaw = jaw
        self._reference = monitor.reference
        self._seq = -1
        self._start_s = time.monotonic()
        self._watch = Watch(settings, self._start_s)
        self._said: StateRecord | None = None
        self._next_state_s = self._start_s
        self._stop = stop
        self._source_broke = False
        self._last_error = ""

    def run(self, duration_s: float | None = None) -> int:
        """Handle frames until the source ends, the time is over, errors persist, or a stop is requested.

        Returns the exit code.  A stop request takes effect after the frame in hand, or half a second at the latest.
        """
        _log.info(
            "watching %s/%s against %s, revision %d",
            self._robot, self._camera, self._reference.reference_id, self._reference.revision,
        )  # fmt: skip
        self._publisher.reference(self._reference)
        end_s = self._start_s + duration_s if duration_s is not None else math.inf
        self._say_state(time.monotonic())
        while self._stop.exit_code is None and time.monotonic() < end_s and self._next_item():
            pass
        watch = self._watch
        exit_code = self._stop.exit_code if self._stop.exit_code is not None else self._code_at_the_end()
        watch.stopped()
        self._say_state(time.monotonic())
        _log.info(
            "stopped after %d frames, %d refused, %d dropped", watch.frames, watch.frames_refused, self._source.dropped
        )
        return exit_code

    def _next_item(self) -> bool:
        """Wait for the source and handle what it gives; False if there is nothing more to do."""
        try:
            item = self._source.read()
        except Exception as error:  # noqa: BLE001  said below, and the end of the loop
            self._watch.message = f"the source failed: {_in_short(error)}"
            _log.debug("%s", self._watch.message, exc_info=error)
            self._alert(
                Alert(AlertKind.SOURCE, Cause.NO_CAMERA, Severity.ERROR, self._watch.message), self._watch.state
            )
            self._source_broke = True
            return False
        if item is None:
            return False
        if isinstance(item, Waiting):
            for alert in self._watch.no_frame(item.reason, time.monotonic()):
                self._alert(alert, self._watch.state)
        else:
            self._handle(item)
        self._say_state(time.monotonic())
        return not self._watch.gives_up

    def _handle(self, frame: Frame) -> None:
        handed_over_ns = time.monotonic_ns()
        self._seq = frame.seq
        fault: Exception | None = None
        try:
            if self._jaw is not None:
                frame = dataclasses.replace(frame, jaw_opening_m=self._jaw.opening_m())
            record = self._monitor.process(frame)
        except Exception as error:  # noqa: BLE001  said and counted below
            fault = error
            record = self._unjudged(frame, error)
        try:
            record = msgspec.structs.replace(record, latency_ns=time.monotonic_ns() - handed_over_ns)
            self._publisher.transform(record)
            self._hand_out(frame, record)
        except Exception as error:  # noqa: BLE001  said and counted below
            fault = fault or error
        if fault is not None:
            self._survive(fault)
        else:
            self._watch.errors_in_a_row = 0
            self._last_error = ""

    def _hand_out(self, frame: Frame, record: FrameRecord) -> None:
        """What is less urgent than the transform."""
        for alert in record.alerts:
            self._alert(alert, record.state, recorded=True)
        for alert in self._watch.frame(record, time.monotonic()):
            self._alert(alert, record.state)
        self._recorder.offer(frame, record, self._monitor.trace)
        if (record.reference_id, record.revision) != (self._reference.reference_id, self._reference.revision):
            self._reference = self._monitor.reference
            self._publisher.reference(self._reference)
            self._recorder.reference(self._reference)
        self._estimates.write(record)

    def _unjudged(self, frame: Frame, error: Exception) -> FrameRecord:
        """The record of a frame on which the monitor failed: nothing to stand by."""
        return FrameRecord(
            seq=frame.seq,
            stamp_ns=frame.stamp_ns,
            verdict=Verdict.UNKNOWN,
            state=State.LOST,
            source=Origin.HELD,
            cam_T_grip=None,
            covariance=None,
            smoothed=None,
            drift=None,
            reference_id=self._reference.reference_id,
            revision=self._reference.revision,
            rms_px=None,
            jaw_opening_m=frame.jaw_opening_m,
            corners=(),
            alerts=(),
            reason=f"internal error: {_in_short(error)}",
            name=frame.name,
        )

    def _survive(self, error: Exception) -> None:
        text = _in_short(error)
        alerts = self._watch.error(text)
        if text != self._last_error:
            self._last_error = text
            _log.error("frame %d: internal error: %s", self._seq, text)
            _log.debug("frame %d", self._seq, exc_info=error)
        try:
            for alert in alerts:
                self._alert(alert, State.LOST)
        except Exception as second:  # noqa: BLE001  the network may be what is broken
            _log.error("the alert could not be sent: %s", _in_short(second))

    def _alert(self, alert: Alert, state: State, *, recorded: bool = False) -> None:
        """Say it on the network and in the log; ``recorded`` if a frame's record carries it into the recording."""
        _log.log(_LEVELS[alert.severity], "%s: %s", alert.kind.value, alert.text)
        message = AlertRecord(
            robot=self._robot,
            camera=self._camera,
            seq=self._seq,
            stamp_ns=time.time_ns(),
            state=state,
            reference_id=self._reference.reference_id,
            revision=self._reference.revision,
            kind=alert.kind,
            cause=alert.cause,
            severity=alert.severity,
            text=alert.text,
        )
        self._publisher.alert(message)
        if not recorded:
            self._recorder.alert(message)

    def _say_state(self, now_s: float) -> None:
        """Publish the state when it is due or has changed."""
        watch, said = self._watch, self._said
        faults = (
            watch.message,
            self._jaw.fault() if self._jaw else "",
            self._recorder.failure,
            self._estimates.failure,
        )
        message = "; ".join(fault for fault in faults if fault)
        now = (watch.state, watch.verdict, self._source.connected, message, self._reference.revision)
        due = now_s >= self._next_state_s
        if said and not due and now == (said.state, said.verdict, said.camera_connected, said.message, said.revision):
            return
        if said is None or (watch.state, watch.verdict) != (said.state, said.verdict):
            _log.info("state %s, transform %s%s", watch.state, watch.verdict, f" ({message})" if message else "")
        self._said = StateRecord(
            robot=self._robot,
            camera=self._camera,
            state=watch.state,
            verdict=watch.verdict,
            stamp_ns=time.time_ns(),
            seq=self._seq,
            reference_id=self._reference.reference_id,
            revision=self._reference.revision,
            frames=watch.frames,
            frames_refused=watch.frames_refused,
            frames_dropped=self._source.dropped,
            frames_per_s=watch.frames_per_s(now_s),
            uptime_s=now_s - self._start_s,
            camera_connected=self._source.connected,
            recording_dropped=self._recorder.dropped,
            message=message,
            version=__version__,
        )
        self._publisher.state(self._said)
        if due:
            self._next_state_s = now_s + self._settings.state_period_s
            self._keep_house()

    def _keep_house(self) -> None:
        """Once a state period, right after a frame, when there is time until the next."""
        self._estimates.flush()
        if not gc.isenabled():
            gc.collect()

    def _code_at_the_end(self) -> int:
        if self._source_broke:
            return EXIT_FAILED
        if self._watch.gives_up:
            _log.error("giving up after internal errors in %d frames in a row", self._watch.errors_in_a_row)
            return EXIT_FAILED
        if self._watch.frames_usable == 0:
            _log.error("no usable frame came")
            return EXIT_FAILED
        return EXIT_DONE


def _in_short(error: Exception) -> str:
    """One line for a person."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
