"""The base of every daemon loop: a supervised source, faults that are reported and survived, a clean end."""

from __future__ import annotations

import gc
import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ParamSpec, Required, TypedDict, TypeVar, Unpack

import msgspec

from gripmon import __version__
from gripmon.daemon.neighbours import Asked, Commands, Reports
from gripmon.daemon.service import ServiceManager
from gripmon.daemon.snapshots import Newest, Snapshots
from gripmon.daemon.watch import DaemonSettings, Watch
from gripmon.io.publish.presence import in_words
from gripmon.io.sources import Source, Waiting
from gripmon.model.coverage import too_few
from gripmon.model.errors import in_short
from gripmon.model.outputs import Event, Output
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    Frame,
    OpenAlert,
    RecordedCommand,
    Severity,
    State,
    StateRecord,
    Verdict,
    accepting,
)
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED, StopRequest
from gripmon.record.recorder import Recorder
from gripmon.record.write import ROOM_POLL_S

_log = logging.getLogger(__name__)
_P = ParamSpec("_P")
_T = TypeVar("_T")

_COMMAND_PAUSE_RATIO = 3.0
"""The next command waits this many times the duration of the last: commands take at most a quarter of the time."""

_QUESTIONS = (CommandName.STATE, CommandName.SNAPSHOT)
_LEVELS = {Severity.INFO: logging.INFO, Severity.WARNING: logging.WARNING, Severity.ERROR: logging.ERROR}


class Parts(TypedDict, total=False):
    """Keyword arguments of every :class:`Loop`.  ``outputs``: besides ``recorder``, the most urgent first."""

    source: Required[Source]
    outputs: Required[Sequence[Output]]
    recorder: Required[Recorder]
    settings: Required[DaemonSettings]
    stop: StopRequest | None
    robot: Required[str]
    camera: Required[str]
    commands: Commands | None
    snapshots: Snapshots | None
    reports: Reports | None
    notices: Sequence[Alert]


class Loop(ABC):
    """Runs in the thread that calls :meth:`run`.  Subclasses process and judge the frames."""

    def __init__(self, **parts: Unpack[Parts]) -> None:
        self._source = parts["source"]
        self._recorder = parts["recorder"]
        self._outputs: tuple[Output, ...] = (*parts["outputs"], self._recorder)
        self._settings = parts["settings"]
        self._robot, self._camera = parts["robot"], parts["camera"]
        self._commands = parts.get("commands")
        self._snapshots = parts.get("snapshots") or Snapshots()
        self._newest: Newest | None = None
        self._reports = parts.get("reports") or Reports()
        self._notices = parts.get("notices", ())
        self._open_alerts: tuple[OpenAlert, ...] = ()  # of the monitor
        self._proposal_id = ""  # id of the new reference that waits for an operator
        self._seq = -1
        self._start_s = time.monotonic()
        self._watch = Watch(self._settings, self._start_s)
        self._last_state: StateRecord | None = None
        self._next_state_s = self._next_command_s = self._start_s
        self._stop = parts.get("stop") or StopRequest()
        self._service = ServiceManager()
        self._source_broke = False
        self._faults: dict[str, str] = {}  # since the previous frame: what could not be delivered, and why
        self._logged_faults: dict[str, str] = {}  # in the log

    @property
    @abstractmethod
    def _in_force(self) -> tuple[str, int]:
        """Id and revision of the calibration in force."""

    @abstractmethod
    def _begin(self) -> None:
        """Before the first frame and the first state message."""

    @abstractmethod
    def _handle(self, frame: Frame) -> None:
        """Judge a frame and pass on the results."""

    @abstractmethod
    def _carry_out(self, command: Command, stamp_ns: int) -> CommandReply:
        """Carry out a command; may raise."""

    def _settle(self, answer: CommandReply | None) -> CommandReply | None:
        """Called before a command is answered (None: it failed); returns the answer, possibly extended."""
        return answer

    @abstractmethod
    def _finish(self) -> None:
        """After the last frame, before the last state message."""

    def run(self, duration_s: float | None = None) -> int:
        """Handle frames until the source ends, ``duration_s`` is over, errors persist, or a stop is requested.

        Returns the exit code.  A stop request takes effect after the current frame, within half a second.
        """
        _log.info("watching %s/%s against %s, revision %d", self._robot, self._camera, *self._in_force)
        self._begin()
        for notice in self._notices:
            self._alert(notice, self._watch.state)
        end_s = self._start_s + duration_s if duration_s is not None else math.inf
        self._publish_state(time.monotonic())
        self._service.ready()
        while self._stop.exit_code is None and time.monotonic() < end_s and self._next_item():
            pass
        watch = self._watch
        exit_code = self._stop.exit_code if self._stop.exit_code is not None else self._code_at_the_end()
        watch.stopped()
        self._service.stopping()
        self._finish()
        self._publish_state(time.monotonic())
        unseen = watch.frames - watch.frames_usable - watch.frames_refused
        few = too_few(watch.frames_usable, dropped=self._source.dropped, refused=watch.frames_refused, unseen=unseen)
        if few:
            _log.warning("%s", few)
        _log.info(
            "stopped after %d frames, %d refused, %d dropped", watch.frames, watch.frames_refused, self._source.dropped
        )
        return exit_code

    def _next_item(self) -> bool:
        """Wait for the source and handle its item; False if there is nothing more to do."""
        self._handle_command()
        if not self._source.live and not all(output.has_room for output in self._outputs):
            time.sleep(ROOM_POLL_S)
            self._publish_state(time.monotonic())
            return True
        try:
            item = self._source.read()
        except Exception as error:  # noqa: BLE001  reported below, and ends the loop
            self._watch.message = f"the source failed: {in_short(error)}"
            _log.debug("%s", self._watch.message, exc_info=error)
            self._alert(
                Alert(AlertKind.SOURCE, Cause.NO_CAMERA, Severity.ERROR, self._watch.message), self._watch.state
            )
            self._source_broke = True
            return False
        if item is None:
            return False
        if isinstance(item, Waiting):
            for alert in self._watch.no_frame(item.reason, time.monotonic(), time.time_ns()):
                self._alert(alert, self._watch.state)
        else:
            self._handle(item)
        watch, now_s, stamp_ns = self._watch, time.monotonic(), time.time_ns()
        alerts = watch.recording(self._recorder.failure, now_s, stamp_ns)
        alerts += watch.dropped(self._source.dropped, now_s, stamp_ns)
        alerts += watch.others(self._not_alone(), now_s, stamp_ns)
        for alert in alerts:
            self._alert(alert, watch.state)
        self._publish_state(time.monotonic())
        return not self._watch.gives_up

    def _handle_command(self) -> None:
        """Carry out one pending command, if any, unless the last one was too recent: commands must not delay frames."""
        begun_s = time.monotonic()
        asked = None if self._commands is None or begun_s < self._next_command_s else self._commands.poll()
        if asked is None:
            return
        self._carry_out_and_answer(asked)
        now_s = time.monotonic()
        self._next_command_s = now_s + _COMMAND_PAUSE_RATIO * (now_s - begun_s)

    def _carry_out_and_answer(self, asked: Asked) -> None:
        command, answer = asked.command, None
        stamp_ns = time.time_ns()
        try:
            answer = self._carry_out(command, stamp_ns)
            result = f"{'done' if answer.done else 'refused'}: {answer.text}"
        except Exception as error:  # noqa: BLE001  reported, also to the sender
            result = f"internal error: {in_short(error)}"
            _log.debug("command %s", command.name, exc_info=error)
        # Pages and watch --mount ask several times a second, and a question changes nothing.
        level = logging.DEBUG if answer is not None and command.name in _QUESTIONS else logging.INFO
        _log.log(level, "command %s%s%s: %s", command.name, " " * bool(command.argument), command.argument, result)
        text = result if answer is None else answer.text
        carried_out = answer is not None and answer.done
        recorded = RecordedCommand(stamp_ns, self._seq, command.name, command.argument, carried_out, text)
        self._tell(recorded)
        answer = self._settle(answer)
        if answer and answer.done and command.name is CommandName.SNAPSHOT:
            self._deliver("answer", self._snapshots.answer, asked, answer, self._newest)
        else:
            self._deliver("answer", asked.answer, answer or CommandError(CommandFault.INTERNAL, result))

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
            reference_id=self._in_force[0],
            revision=self._in_force[1],
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

    def _publish_state(self, now_s: float) -> None:
        """Publish the state when it is due or has changed."""
        watch, last = self._watch, self._last_state
        self._service.alive(now_s)
        several, waits = self._not_alone(), self._pending_proposal()
        verdict = Verdict.UNKNOWN if several else watch.verdict
        reported = (self._ask(fault, None) for fault in self._reports.faults)
        message = "; ".join(fault for fault in (watch.message, several, waits, watch.undelivered, *reported) if fault)
        now = (watch.state, verdict, self._source.connected, message, self._in_force[1])
        due = now_s >= self._next_state_s
        if last and not due and now == (last.state, last.verdict, last.camera_connected, last.message, last.revision):
            return
        if waits and (last is None or last.proposal_id != self._proposal_id):
            _log.warning("%s (or reject)", waits)
        if last is None or (watch.state, verdict) != (last.state, last.verdict):
            because = f" ({message})" if message else ""
            line = f"state {watch.state}, transform {verdict}{because}"
            _log.info("%s", line)
            self._service.status(line)
        self._last_state = self._state_record(verdict, message, now_s, alone=not several)
        self._tell(self._last_state)
        if due:
            self._next_state_s = now_s + self._settings.state_period_s
            self._housekeeping()

    def _state_record(self, verdict: Verdict, message: str, now_s: float, *, alone: bool) -> StateRecord:
        watch, reports = self._watch, self._reports
        return StateRecord(
            robot=self._robot,
            camera=self._camera,
            state=watch.state,
            verdict=verdict,
            stamp_ns=time.time_ns(),
            seq=self._seq,
            reference_id=self._in_force[0],
            revision=self._in_force[1],
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

    def _housekeeping(self) -> None:
        """Called once per state period, right after a frame, when there is time before the next."""
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
