"""What a running monitor tells: events to its outputs, alerts, the state message, and the log.  Every receiver may fail
without affecting another one.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

import msgspec

from gripmon import __version__
from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.neighbours import Commands, JawFeed, Reports
from gripmon.daemon.service import ServiceManager
from gripmon.daemon.snapshots import OutlinesOf, no_outlines
from gripmon.daemon.watch import DaemonSettings, Watch, kind_of
from gripmon.io.publish.presence import in_words
from gripmon.io.sources import Source
from gripmon.model.errors import in_short
from gripmon.model.outputs import Event, Output
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Image,
    OpenAlert,
    ReferenceRecord,
    Severity,
    State,
    StateRecord,
    Verdict,
    accepting,
)
from gripmon.model.stopping import StopRequest
from gripmon.monitor import Monitor
from gripmon.record.recorder import Recorder

_log = logging.getLogger(__name__)
_P = ParamSpec("_P")
_T = TypeVar("_T")

_LEVELS = {Severity.INFO: logging.INFO, Severity.WARNING: logging.WARNING, Severity.ERROR: logging.ERROR}


@dataclass
class Parts:
    """What one monitor runs with.

    ``outputs``: besides ``recorder``, the most urgent first.  ``jaw``, if given, replaces the frames' own jaw opening;
    ``keeper`` stores the monitor's state for a restart; ``reports``: additional values of the state message;
    ``notices``: alerts from the start-up; ``stop``: a stop request from there
    (:func:`gripmon.model.stopping.signals_exit`); ``outlines``: the gripper's for snapshots; ``odd_about``: what the
    log says of the first image, None for nothing.
    """

    source: Source
    outputs: Sequence[Output]
    recorder: Recorder
    settings: DaemonSettings
    robot: str
    camera: str
    jaw: JawFeed | None = None
    keeper: StateKeeper = field(default_factory=lambda: StateKeeper(None))
    commands: Commands | None = None
    reports: Reports = field(default_factory=Reports)
    notices: Sequence[Alert] = ()
    stop: StopRequest = field(default_factory=StopRequest)
    outlines: OutlinesOf = no_outlines
    odd_about: Callable[[Image], str | None] = lambda _: None


class Telling:
    """Everything that leaves the loop of one monitor, besides frames."""

    def __init__(self, monitor: Monitor, parts: Parts) -> None:
        self._parts = parts
        self._source, self._recorder, self._reports = parts.source, parts.recorder, parts.reports
        self._outputs: tuple[Output, ...] = (*parts.outputs, parts.recorder)
        self._settings, self._robot, self._camera = parts.settings, parts.robot, parts.camera
        self._reference: ReferenceRecord = monitor.reference  # that everybody knows of
        self._open_alerts: tuple[OpenAlert, ...] = ()  # of the monitor
        self._proposal_id = ""  # id of the new reference that waits for an operator
        self._seq = -1
        self._start_s = self._next_state_s = time.monotonic()
        self._watch = Watch(self._settings, self._start_s)
        self._last_state: StateRecord | None = None
        self._reasons_told: set[str] = set()  # by the log, since state and verdict changed last
        self._service = ServiceManager()
        self._faults: dict[str, str] = {}  # since the previous frame: what could not be delivered, and why
        self._logged_faults: dict[str, str] = {}  # in the log

    def _tell(self, event: Event, outputs: Sequence[Output] | None = None) -> list[Output]:
        """Pass an event to all outputs, or to some; returns those that failed."""
        told = self._outputs if outputs is None else outputs
        return [output for output in told if not self._deliver(output.name, output.event, event)]

    def _deliver(self, what: str, put: Callable[_P, None], *values: _P.args, **named: _P.kwargs) -> bool:
        """Pass something to one receiver, whose failure must not affect others; False if it failed, which is logged."""
        try:
            put(*values, **named)
        except Exception as error:  # noqa: BLE001  logged here, an alert at the end of the frame
            kind = f"{what} {put.__name__}"  # an output may take frames and no events
            self._faults[kind] = f"{what} fails: {in_short(error)}"
            self._log_once(kind, "", self._faults[kind], error)
            return False
        if self._logged_faults:
            self._logged_faults.pop(f"{what} {put.__name__}", None)
        return True

    def _log_once(self, what: str, where: str, text: str, error: Exception) -> None:
        """Log a fault, and again only when it changes or recurs."""
        if self._logged_faults.get(what) != text:
            self._logged_faults[what] = text
            _log.error("%s%s", where, text)
            _log.debug("%s%s", where, what, exc_info=error)

    def _alert(self, alert: Alert, state: State, stamp_ns: int | None = None) -> None:
        """Publish and log an alert; ``stamp_ns``: of its frame, if there is one."""
        about = alert.kind.value if alert.event is AlertEvent.NOTED else f"{alert.kind} {alert.event}"
        alert = self._with_command(alert)
        _log.log(_LEVELS[alert.severity], "%s: %s", about, alert.text)
        message = AlertRecord(
            robot=self._robot,
            camera=self._camera,
            seq=self._seq,
            stamp_ns=time.time_ns() if stamp_ns is None else stamp_ns,
            state=state,
            reference_id=self._reference.reference_id,
            revision=self._reference.revision,
            **msgspec.structs.asdict(alert),
        )
        self._tell(message)

    def _not_alone(self) -> str:
        """A message while other monitors have this name, else empty; no transform is published then, since readers
        can't know which one is right.
        """
        none: tuple[str, ...] = ()
        others = self._ask(self._reports.others, none)
        return f"{in_words(others)}; nothing is usable until it or this one is stopped" if others else ""

    def _pending_proposal(self) -> str:
        """What waits for an operator, with the command to type; empty if nothing."""
        if not self._proposal_id:
            return ""
        return f"a new reference waits for an operator: {accepting(self._proposal_id, self._robot, self._camera)}"

    def _with_command(self, alert: Alert) -> Alert:
        """Add the command to a proposal's alert, since the monitor, which wrote it, doesn't know the robot's name."""
        if alert.kind is not AlertKind.PROPOSED or not self._proposal_id or alert.event is AlertEvent.CLEARED:
            return alert
        typed = accepting(self._proposal_id, self._robot, self._camera)
        return msgspec.structs.replace(alert, text=f"{alert.text}; to accept it: {typed}")

    def _publish_state(self, now_s: float) -> bool:
        """Publish the state when it is due or has changed; returns whether it was due."""
        watch, last = self._watch, self._last_state
        self._service.alive(now_s)
        several, waits = self._not_alone(), self._pending_proposal()
        verdict = Verdict.UNKNOWN if several else watch.verdict
        reported = (self._ask(fault, None) for fault in self._reports.faults)
        message = "; ".join(fault for fault in (watch.message, several, waits, watch.undelivered, *reported) if fault)
        now = (watch.state, verdict, self._source.connected, message, self._reference.revision)
        due = now_s >= self._next_state_s
        if last and not due and now == (last.state, last.verdict, last.camera_connected, last.message, last.revision):
            return False
        if waits and (last is None or last.proposal_id != self._proposal_id):
            _log.warning("%s (or reject)", waits)
        if last is None or (watch.state, verdict) != (last.state, last.verdict):
            self._reasons_told.clear()
        if (reason := kind_of(watch.message)) not in self._reasons_told:
            self._reasons_told.add(reason)  # once: they may change with every frame
            because = f" ({message})" if message else ""
            line = f"state {watch.state}, transform {verdict}{because}"
            _log.info("%s", line)
            self._service.status(line)
        self._last_state = self._state_record(verdict, message, now_s, alone=not several)
        self._tell(self._last_state)
        if due:
            self._next_state_s = now_s + self._settings.state_period_s
        return due

    def _state_record(self, verdict: Verdict, message: str, now_s: float, *, alone: bool) -> StateRecord:
        watch, reports = self._watch, self._reports
        return StateRecord(
            robot=self._robot,
            camera=self._camera,
            state=watch.state,
            verdict=verdict,
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
            recording_images_dropped=self._recorder.images_dropped,
            message=message,
            version=__version__,
            tcp_shift_m=watch.last.tcp_shift_m if alone else None,
            sigma_m=watch.last.sigma_m if alone else None,
            protection_m=watch.last.protection_m if alone else None,
            alert_limit_m=reports.alert_limit_m,
            valid_by=watch.last.valid_by if alone else None,
            open_alerts=watch.standing(self._open_alerts),
            transforms_unsent=self._ask(reports.unsent, 0),
            malformed=self._ask(reports.malformed, 0),
            proposal_id=self._proposal_id,
        )

    def _ask(self, report: Callable[[], _T], otherwise: _T) -> _T:
        """The value of a report, or ``otherwise`` if it fails, which must not stop the loop."""
        try:
            return report()
        except Exception as error:  # noqa: BLE001  logged
            self._log_once("report", "", f"a report for the state message fails: {in_short(error)}", error)
            return otherwise
