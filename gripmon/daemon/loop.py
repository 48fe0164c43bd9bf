"""The loop: a frame in, a transform out; every fault is reported and survived."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Unpack

import msgspec

from gripmon.daemon.keeping import StateKeeper
from gripmon.daemon.mount import mount_of, to_stand_at
from gripmon.daemon.neighbours import JawFeed
from gripmon.daemon.snapshots import Newest
from gripmon.daemon.supervised import Loop, Parts
from gripmon.model.errors import in_short
from gripmon.model.outputs import Output
from gripmon.model.records import (
    Command,
    CommandReply,
    Frame,
    FrameRecord,
    Image,
    MonitorState,
    State,
    unmeasured_record,
    withheld,
)
from gripmon.monitor import Monitor

_log = logging.getLogger(__name__)

KEEP_LAST_EVERY_S = 60.0
"""How old the stored last transform may be; references and alerts are stored when they change."""


class Daemon(Loop):
    """Runs one monitor, in the thread that calls :meth:`run`."""

    def __init__(
        self,
        monitor: Monitor,
        *,
        jaw: JawFeed | None = None,
        keeper: StateKeeper | None = None,
        odd_about: Callable[[Image], str | None] = lambda _: None,
        **parts: Unpack[Parts],
    ) -> None:
        """``odd_about``: what the log says of the first image, None for nothing."""
        super().__init__(**parts)
        self._monitor = monitor
        self._odd_about: Callable[[Image], str | None] | None = odd_about
        self._jaw = jaw
        self._keeper = keeper or StateKeeper(None)
        self._kept_revision: int | None = None
        self._beside = ThreadPoolExecutor(1, "analysis")
        self._working: Future[None] | None = None
        self._reference = monitor.reference
        self._untold: list[Output] = list(self._outputs)  # of the reference
        self._next_keeping_s = self._start_s + KEEP_LAST_EVERY_S

    @property
    def _in_force(self) -> tuple[str, int]:
        return self._reference.reference_id, self._reference.revision

    def _begin(self) -> None:
        self._deliver("state's keeping", self._keep_now)
        self._make_reference_known()

    def _finish(self) -> None:
        self._beside.shutdown()
        self._deliver("state's keeping", lambda: self._keeper.soon(self._monitor.state()))

    def _handle(self, frame: Frame) -> None:
        arrived_ns = frame.arrived_ns if frame.arrived_ns is not None else time.monotonic_ns()
        self._seq = frame.seq
        if self._odd_about is not None and frame.image is not None:
            if odd := self._odd_about(frame.image):
                _log.warning("%s", odd)
            self._odd_about = None
        frame, record, failure = self._judge(frame)
        record = msgspec.structs.replace(record, latency_ns=time.monotonic_ns() - arrived_ns)
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
        answer, reports = self._monitor.command(command, stamp_ns), self._reports
        if answer.monitor is None or reports.alert_limit_m is None or reports.alert_limit_rad is None:
            return answer
        # A frame from before the camera fell silent says nothing about where somebody has moved it since.
        newest = None if self._watch.state is State.STALE or self._newest is None else self._newest.record
        limits = reports.alert_limit_m, reports.alert_limit_rad
        mount = mount_of(newest, to_stand_at(answer.monitor.references), *limits)
        return msgspec.structs.replace(answer, mount=mount)

    def _settle(self, answer: CommandReply | None) -> CommandReply | None:
        """What is reported as done must persist after a crash."""
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

    def _housekeeping(self) -> None:
        if (now_s := time.monotonic()) >= self._next_keeping_s:
            # Only for the last transform: where to search first after a restart.
            self._next_keeping_s = now_s + KEEP_LAST_EVERY_S
            self._deliver("state's keeping", lambda: self._keeper.soon(self._monitor.state()))
        super()._housekeeping()
