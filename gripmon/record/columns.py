"""What all recordings share: columns in a stream, colours, and events beside the frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import rerun as rr

from gripmon.model.camera import LensSettings
from gripmon.model.outputs import Event
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertRecord,
    RecordedCommand,
    Severity,
    State,
    StateRecord,
    Transform,
    Verdict,
    to_json,
)
from gripmon.record.recorder import Row, those

APPLICATION_ID = "gripmon"
RECORDED, REPLAYED = "recorded", "replayed"
"""What is drawn of a recorded run and of its replay, in one recording."""
_CLOCK_TOLERANCE_NS = 86_400_000_000_000  # one day, between a frame and an event that belongs to no frame
_LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}

Colour = tuple[int, int, int, int]


class Palette:
    """Colours (RGBA, 0..255) of the recording, with the same meaning everywhere."""

    GOOD: Colour = (70, 200, 110, 255)
    DOUBTFUL: Colour = (245, 175, 50, 255)
    BAD: Colour = (235, 75, 75, 255)
    IDLE: Colour = (140, 145, 155, 255)
    BUSY: Colour = (80, 150, 240, 255)
    REPAIR: Colour = (180, 110, 240, 255)

    PREDICTED: Colour = (60, 200, 255, 255)
    EDGE_USED: Colour = (70, 235, 120, 255)
    EDGE_REFUSED: Colour = (255, 70, 70, 255)
    CORNER_USED: Colour = (255, 225, 60, 255)
    CORNER_REFUSED: Colour = (255, 120, 60, 255)
    GRIPPER_FACE: Colour = (150, 160, 175, 110)
    REFERENCE: Colour = (255, 255, 255, 255)
    BACKGROUND: Colour = (16, 18, 22, 255)  # also in the viewer's light theme: the reference is white
    WHOLE: Colour = (225, 228, 235, 255)  # a length or a fraction, beside its components along the axes
    SHIFT: Colour = (255, 90, 200, 255)
    AXES: tuple[Colour, Colour, Colour] = ((240, 90, 90, 255), (90, 205, 105, 255), (95, 150, 255, 255))

    STATES: ClassVar[dict[State, Colour]] = {
        State.ACQUIRING: BUSY,
        State.TRACKING: GOOD,
        State.DRIFTING: DOUBTFUL,
        State.RECALIBRATING: REPAIR,
        State.OCCLUDED: (240, 130, 60, 255),
        State.LOST: BAD,
        State.STALE: IDLE,
    }
    VERDICTS: ClassVar[dict[Verdict, Colour]] = {
        Verdict.VALID: GOOD, Verdict.SUSPECT: DOUBTFUL, Verdict.UNKNOWN: IDLE,
    }  # fmt: skip


def faded(colour: Colour, alpha: int) -> Colour:
    return (*colour[:3], alpha)


class Sender:
    """Sends columns with both timelines, to entities below ``root`` ("recorded/")."""

    def __init__(self, stream: rr.RecordingStream, root: str = ""):
        self._stream, self._root = stream, root

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        for archetype in archetypes:
            self._stream.log(f"{self._root}{path}", archetype, static=True)

    def columns(self, path: str, stamps_ns: list[int], seqs: list[int], columns: rr.ComponentColumnList) -> None:
        """Send columns; without stamps on the frame timeline only."""
        indexes = [rr.TimeColumn("frame", sequence=seqs)]
        if stamps_ns:
            times = np.array(stamps_ns, np.int64).astype("datetime64[ns]")
            indexes.insert(0, rr.TimeColumn("capture_time", timestamp=times))
        self._stream.send_columns(f"{self._root}{path}", indexes, columns)

    def frames(self, path: str, rows: Sequence[Row], columns: rr.ComponentColumnList) -> None:
        self.columns(path, [r.record.stamp_ns for r in rows], [r.record.seq for r in rows], columns)

    def scalars(self, path: str, rows: Sequence[Row], values: Sequence[Sequence[float]]) -> None:
        """Several curves; a row without values leaves a gap in them."""
        flat = np.array([v for some in values for v in some], dtype=np.float64)
        self.frames(path, rows, rr.Scalars.columns(scalars=flat).partition([len(some) for some in values]))

    def lines(self, path: str, names: Sequence[str] | str, colours: Sequence[Colour] | Colour, width: float) -> None:
        """Set names, colours and width of an entity's curves."""
        count = 1 if isinstance(names, str) else len(names)
        self.static(path, rr.SeriesLines(names=names, colors=colours, widths=[width] * count))

    def images(self, path: str, rows: Sequence[Row]) -> None:
        """The pictures of rows that have one."""
        pictures = [row.picture for row in rows if row.picture is not None]
        if pictures:
            columns = rr.EncodedImage.columns(
                blob=[np.frombuffer(p.blob, np.uint8) for p in pictures], media_type=[p.media_type for p in pictures]
            )
            self.frames(path, rows, columns)


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the log."""

    stamp_ns: int
    seq: int
    level: str
    text: str


class EventWriter:
    """Writes ``status/…`` where it changes, the log ``events`` for people, and ``alert``, ``command``, ``state``."""

    def __init__(self, send: Sender, whose: str = ""):
        """``whose`` is the prefix of each line of the log, where two runs share it."""
        self._send = send
        self._whose = f"{whose}: " if whose else ""
        self._state = self._verdict = ""
        self._newest_stamp_ns: int | None = None
        send.static("status/state", _configuration(Palette.STATES))
        send.static("status/verdict", _configuration(Palette.VERDICTS))

    def repeat(self) -> None:
        """Write state and verdict again with the next frame, changed or not."""
        self._state = self._verdict = ""

    def write(self, rows: Sequence[Row], events: Sequence[Event], more: Sequence[Line] = ()) -> None:
        """``more``: further lines for the log."""
        if rows:
            self._newest_stamp_ns = rows[-1].record.stamp_ns
        lines = [*more, *self._status(rows)]
        lines += [_of_alert(self._on_frames_clock(a.stamp_ns), a.seq, a) for a in those(AlertRecord, events)]
        lines += [_of_command(self._on_frames_clock(c.stamp_ns), c) for c in those(RecordedCommand, events)]
        if lines:
            columns = rr.TextLog.columns(text=[f"{self._whose}{e.text}" for e in lines], level=[e.level for e in lines])
            self._send.columns("events", [e.stamp_ns for e in lines], [e.seq for e in lines], columns)
        self._whole("alert", those(AlertRecord, events))
        self._whole("command", those(RecordedCommand, events))
        self._whole("state", states := those(StateRecord, events))
        for state in states:
            # Without frames only the daemon knows the state.
            if state.state is State.STALE and self._newest_stamp_ns is not None:
                self._change(self._on_frames_clock(state.stamp_ns), state.seq, state.state, state.verdict)

    def _on_frames_clock(self, stamp_ns: int) -> int:
        """Frames of old files have old stamps: an alert of today that belongs to no frame would stretch the timeline
        over years.
        """
        if self._newest_stamp_ns is None or abs(stamp_ns - self._newest_stamp_ns) < _CLOCK_TOLERANCE_NS:
            return stamp_ns
        return self._newest_stamp_ns

    def _whole(self, path: str, messages: Sequence[AlertRecord | RecordedCommand | StateRecord]) -> None:
        """Messages as JSON; before the first frame they have no capture time."""
        if not messages:
            return
        known = self._newest_stamp_ns is not None
        stamps_ns = [self._on_frames_clock(message.stamp_ns) for message in messages] if known else []
        whole = rr.AnyValues.columns(json=[to_json(message).decode() for message in messages])
        self._send.columns(path, stamps_ns, [message.seq for message in messages], whole)

    def _status(self, rows: Sequence[Row]) -> list[Line]:
        """Write state and verdict where they change; returns the changes and alerts as log lines."""
        lines = []
        for record in (row.record for row in rows):
            if record.state != self._state or record.verdict != self._verdict:
                before = f"{self._state} ({self._verdict}) → " if self._state else ""
                reason = f": {record.reason}" if record.reason else ""
                text = f"{before}{record.state} ({record.verdict}){reason}"
                lines.append(Line(record.stamp_ns, record.seq, "INFO", text))
            self._change(record.stamp_ns, record.seq, record.state, record.verdict)
            lines += [_of_alert(record.stamp_ns, record.seq, alert) for alert in record.alerts]
        return lines

    def _change(self, stamp_ns: int, seq: int, state: State, verdict: Verdict) -> None:
        if state != self._state:
            self._send.columns("status/state", [stamp_ns], [seq], rr.StateChange.columns(state=[state]))
        if verdict != self._verdict:
            self._send.columns("status/verdict", [stamp_ns], [seq], rr.StateChange.columns(state=[verdict]))
        self._state, self._verdict = state, verdict


def _of_alert(stamp_ns: int, seq: int, alert: Alert | AlertRecord) -> Line:
    event = "" if alert.event is AlertEvent.NOTED else f" {alert.event}"
    text = f"{alert.kind}{event} [{alert.cause}] {alert.text}"
    return Line(stamp_ns, seq, _LEVELS[alert.severity], f"{text} ({alert.alert_id})" if alert.alert_id else text)


def _of_command(stamp_ns: int, command: RecordedCommand) -> Line:
    argument = f" {command.argument}" if command.argument else ""
    text = f"command {command.name}{argument} {'done' if command.done else 'refused'}: {command.text}"
    return Line(stamp_ns, command.seq, "INFO" if command.done else "WARN", text)


def _configuration(colours: dict[State, Colour] | dict[Verdict, Colour]) -> rr.StateConfiguration:
    return rr.StateConfiguration(values=[str(value) for value in colours], colors=list(colours.values()))


def pose_columns(poses: Sequence[Transform]) -> rr.ComponentColumnList:
    return rr.Transform3D.columns(
        translation=[pose.translation_m for pose in poses], quaternion=[pose.rotation_xyzw for pose in poses]
    )


def pinhole(lens: LensSettings, image_plane_m: float, **looks: Any) -> rr.Pinhole:
    """A camera without its distortion, with its image plane at a distance."""
    return rr.Pinhole(
        resolution=[lens.width_px, lens.height_px], focal_length=[lens.fx_px, lens.fy_px],
        principal_point=[lens.cx_px, lens.cy_px], camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=image_plane_m, **looks,
    )  # fmt: skip
