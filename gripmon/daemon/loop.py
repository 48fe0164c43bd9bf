"""The loop: a frame in, a transform out; every fault is reported and survived."""

from __future__ import annotations

import dataclasses
import gc
import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import msgspec

from gripmon.daemon.mount import mount_of, to_stand_at
from gripmon.daemon.neighbours import Asked
from gripmon.daemon.snapshots import Newest, Snapshots
from gripmon.daemon.telling import Parts, Telling
from gripmon.io.sources import Waiting
from gripmon.model.coverage import too_few
from gripmon.model.errors import in_short
from gripmon.model.outputs import Output
from gripmon.model.priority import stand_beside
from gripmon.model.records import (
    Alert,
    AlertKind,
    Cause,
    Command,
    CommandError,
    CommandFault,
    CommandName,
    CommandReply,
    Frame,
    FrameRecord,
    Image,
    MonitorState,
    RecordedCommand,
    Severity,
    State,
    unmeasured_record,
    withheld,
)
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED
from gripmon.monitor import Monitor
from gripmon.record.write import ROOM_POLL_S

_log = logging.getLogger(__name__)

KEEP_LAST_EVERY_S = 60.0
"""How old the stored last transform may be; references and alerts are stored when they change."""

_COMMAND_PAUSE_RATIO = 3.0
"""The next command waits this many times the duration of the last: commands take at most a quarter of the time."""

_QUESTIONS = (CommandName.STATE, CommandName.SNAPSHOT)


class Daemon(Telling):
    """Runs one monitor, in the thread that calls :meth:`run`."""

    def __init__(self, monitor: Monitor, parts: Parts, snapshots: Snapshots | None = None) -> None:
        super().__init__(monitor, parts)
        self._monitor = monitor
        if parts.source.live:
            monitor.run_live()
        self._odd_about: Callable[[Image], str | None] | None = parts.odd_about
        self._jaw, self._keeper = parts.jaw, parts.keeper
        self._snapshots = snapshots or Snapshots(parts.outlines)
        self._newest: Newest | None = None
        self._next_command_s = self._start_s
        self._source_broke = False
        self._kept_revision: int | None = None
        self._beside = ThreadPoolExecutor(1, "analysis", stand_beside)
        self._working: Future[None] | None = None
        self._untold: list[Output] = list(self._outputs)  # of the reference
        self._next_keeping_s = self._start_s + KEEP_LAST_EVERY_S

    def run(self, duration_s: float | None = None) -> int:
        """Handle frames until the source ends, ``duration_s`` is over, errors persist, or a stop is requested.

        Returns the exit code.  A stop request takes effect after the current frame, within half a second.
        """
        parts, known = self._parts, self._reference
        _log.info(
            "watching %s/%s against %s, revision %d", self._robot, self._camera, known.reference_id, known.revision
        )
        self._deliver("state's keeping", self._keep_now)
        self._make_reference_known()
        for notice in parts.notices:
            self._alert(notice, self._watch.state)
        end_s = self._start_s + duration_s if duration_s is not None else math.inf
        self._say_state()
        self._service.ready()
        while parts.stop.exit_code is None and time.monotonic() < end_s and self._next_item():
            pass
        watch = self._watch
        exit_code = parts.stop.exit_code if parts.stop.exit_code is not None else self._code_at_the_end()
        watch.stopped()
        self._service.stopping()
        self._beside.shutdown()
        self._deliver("state's keeping", lambda: self._keeper.soon(self._monitor.state()))
        self._say_state()
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
            self._say_state()
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
        self._say_state()
        return not self._watch.gives_up

    def _handle_command(self) -> None:
        """Carry out one pending command, if any, unless the last one was too recent: commands must not delay frames."""
        commands, begun_s = self._parts.commands, time.monotonic()
        asked = None if commands is None or begun_s < self._next_command_s else commands.poll()
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

    def _handle(self, frame: Frame) -> None:
        """Judge a frame and pass on the results."""
        arrived_ns = frame.arrived_ns if frame.arrived_ns is not None else time.monotonic_ns()
        self._seq = frame.seq
        if self._odd_about is not None and frame.image is not None:
            if odd := self._odd_about(frame.image):
                _log.warning("%s", odd)
            self._odd_about = None
        frame, record, failure = self._judge(frame)
        took_ns = time.monotonic_ns() - arrived_ns
        record = msgspec.structs.replace(record, latency_ns=took_ns, beside=self._monitor.beside)
        several = self._not_alone()
        told = withheld(record, several) if several else record
        trace, notes = self._monitor.trace, self._monitor.notes
        for output in self._outputs:
            self._deliver(output.name, output.frame, frame, told if output.public else record, trace, notes)
        self._newest = Newest(frame, record, time.monotonic())
        # Everything below is less urgent.
        self._deliver("state's keeping", self._keep_changes)
        for alert in record.alerts:
            self._alert(alert, record.state, frame.stamp_ns)
        for alert in self._watch.frame(record, time.monotonic()):
            self._alert(alert, record.state, frame.stamp_ns)
        self._deliver("learning", self._monitor.learn)
        self._work_beside_the_frames()
        undelivered = "; ".join(dict.fromkeys(self._faults.values()))
        self._faults.clear()
        for alert in self._watch.end_of_frame(failure, undelivered, time.monotonic(), frame.stamp_ns):
            self._alert(alert, record.state, frame.stamp_ns)

    def _work_beside_the_frames(self) -> None:
        """Run the search and the cause analysis in a separate thread."""
        if self._monitor.pending and (self._working is None or self._working.done()):
            self._working = self._beside.submit(self._monitor.run_pending)

    def _judge(self, frame: Frame) -> tuple[Frame, FrameRecord, str]:
        """The frame with its jaw opening, its record, and the monitor's failure (usually empty).

        A new reference is published first, since the messages that follow name it.
        """
        try:
            if self._jaw is not None:
                frame = dataclasses.replace(frame, jaw_opening_m=self._jaw.opening_m(frame.stamp_ns))
            record = self._monitor.process(frame)
        except Exception as error:  # noqa: BLE001  reported and counted
            failure = f"internal error: {in_short(error)}"
            self._log_once("monitor", f"frame {frame.seq}: ", failure, error)
            self._make_reference_known()
            return frame, unmeasured_record(frame, self._reference, failure), failure
        self._logged_faults.pop("monitor", None)
        self._make_reference_known()
        return frame, record, ""

    def _carry_out(self, command: Command, stamp_ns: int) -> CommandReply:
        """Carry out a command; may raise."""
        answer, reports = self._answered(command, stamp_ns), self._reports
        if answer.monitor is None or reports.alert_limit_m is None or reports.alert_limit_rad is None:
            return answer
        # A frame from before the camera fell silent says nothing about where somebody has moved it since.
        newest = None if self._watch.state is State.STALE or self._newest is None else self._newest.record
        limits = reports.alert_limit_m, reports.alert_limit_rad
        mount = mount_of(newest, to_stand_at(answer.monitor.references), *limits)
        return msgspec.structs.replace(answer, mount=mount)

    def _answered(self, command: Command, stamp_ns: int) -> CommandReply:
        """The monitor's answer, with what it doesn't know: that the camera is silent, and the alerts raised here."""
        answer, watch = self._monitor.command(command, stamp_ns), self._watch
        if command.name is CommandName.ACKNOWLEDGE and (seen := watch.acknowledge(command.argument)):
            for alert in seen:
                self._alert(alert, watch.state)
            before = f"{answer.text}, " if answer.done else "acknowledged: "
            return msgspec.structs.replace(answer, done=True, text=before + ", ".join(a.alert_id for a in seen))
        if answer.monitor is None:
            return answer
        of_both = msgspec.structs.replace(answer.monitor, alerts=(*answer.monitor.alerts, *watch.open))
        text = f"{watch.state}, {answer.text.partition(', ')[2]}"
        return msgspec.structs.replace(answer, text=text, monitor=of_both)

    def _settle(self, answer: CommandReply | None) -> CommandReply | None:
        """The answer to a command (None: it failed): what is reported as done must persist after a crash."""
        self._make_reference_known()
        self._deliver("state's keeping", self._keep_changes, at_once=True)
        if self._keeper.failure:  # also after a refusal for this reason: retry with the present state
            self._deliver("state's keeping", lambda: self._keeper.soon(self._monitor_state()))
            if answer and answer.done:
                text = f"{answer.text}; but {self._keeper.failure}"
                answer = msgspec.structs.replace(answer, text=text, durable=False)
        return answer

    def _keep_now(self) -> None:
        self._kept_revision = self._monitor.state_revision
        self._keeper.now(self._monitor_state())

    def _keep_changes(self, *, at_once: bool = False) -> None:
        """Write the monitor's state if it has changed."""
        if self._monitor.state_revision == self._kept_revision:
            return
        if at_once:
            self._keep_now()
        else:
            self._kept_revision = self._monitor.state_revision
            self._keeper.soon(self._monitor_state())

    def _monitor_state(self) -> MonitorState:
        state = self._monitor.state()
        self._open_alerts = state.alerts
        self._proposal_id = "" if state.proposal is None else state.proposal.reference_id
        return state

    def _make_reference_known(self) -> None:
        """Publish a new reference after writing it, since no other may ever get its revision."""
        newest, known = self._monitor.reference, self._reference
        if (newest.reference_id, newest.revision) != (known.reference_id, known.revision):
            self._deliver("state's keeping", self._keep_now)
            self._reference, self._untold = newest, list(self._outputs)
        if self._untold:
            self._untold = self._tell(self._reference, self._untold)

    def _say_state(self) -> None:
        """Publish the state if it is due, and then, when there is time before the next frame, do what can wait."""
        if not self._publish_state(time.monotonic()):
            return
        if (now_s := time.monotonic()) >= self._next_keeping_s:
            # Only for the last transform: where to search first after a restart.
            self._next_keeping_s = now_s + KEEP_LAST_EVERY_S
            self._deliver("state's keeping", lambda: self._keeper.soon(self._monitor.state()))
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
