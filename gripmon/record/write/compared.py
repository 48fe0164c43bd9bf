"""A recorded run and its replay in one recording: what other limits would have done.

The replay is the recording, with all its entities; what was recorded lies beside it below ``recorded``, with the same
names.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from gripmon.model.records import AlertRecord, Frame, FrameRecord, Limits, RecordedCommand, ReferenceRecord, StateRecord
from gripmon.record.read.replayed import RecordedFrames
from gripmon.record.write import palette
from gripmon.record.write.columns import Picture, Row, Sender
from gripmon.record.write.curves import CurveWriter
from gripmon.record.write.events import EventWriter
from gripmon.record.write.files import APPLICATION_ID
from gripmon.record.write.layout import image_view, rig_view
from gripmon.record.write.recorder import Notes, Trace
from gripmon.record.write.rows import RowWriter
from gripmon.record.write.wire import Events, Scene, pack_trace
from gripmon.record.write.worker import measured_picture

RECORDED, REPLAYED = "recorded", "replayed"
_BATCH_ROWS = 32
_FLUSH_TIMEOUT_S = 30.0
_LEAST_FREE_BYTES = 64_000_000
"""rerun's files don't say that the disk is full, and whoever goes on writing may wait for ever: this must be free."""
_WIDE, _THIN = 5.0, 1.5


class _Beside(Sender):
    """Sends what was recorded, below its name."""

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        super().static(f"{RECORDED}/{path}", *archetypes)

    def columns(self, path: str, stamps_ns: list[int], seqs: list[int], columns: rr.ComponentColumnList) -> None:
        super().columns(f"{RECORDED}/{path}", stamps_ns, seqs, columns)


class ComparedRecorder:
    """A recorder for a replay: takes each frame with what ``source``, which gave it last, has recorded of it.

    It writes in the caller's thread: a replay can wait.
    """

    dropped = images_dropped = 0
    has_room = True

    def __init__(self, path: Path, scene: Scene, source: RecordedFrames, recorded_limits: Limits | None) -> None:
        """``recorded_limits`` are drawn beside the replay's; None where nobody knows them.  OSError as for a file."""
        path.open("wb").close()
        self._path, self._source, self._recorded_limits = path, source, recorded_limits
        self._stream = stream = rr.RecordingStream(APPLICATION_ID, recording_id=scene.recording_id)
        self.failure: str | None = None
        if self._has_room():
            stream.set_sinks(rr.FileSink(path))
        stream.send_recording_name(f"{scene.name}: {RECORDED} and {REPLAYED}")
        stream.send_blueprint(_layout(scene), make_active=True, make_default=True)
        self._writer = RowWriter(stream, scene, 1)
        beside = _Beside(stream)
        self._curves, self._status = CurveWriter(beside, scene), EventWriter(beside, RECORDED)
        _name_both(stream)
        self._rows: list[Row] = []
        self._rows_then: list[Row] = []
        self._events = Events.at_first(scene.reference)
        self._events_then = Events(commands=list(source.commands))

    def offer(self, frame: Frame, record: FrameRecord, trace: Trace, notes: Notes | None = None) -> None:
        """One frame, as it is judged now; what it was judged then comes from the source."""
        then, shot = self._source.record, self._source.shot
        assert then is not None, "every replayed frame has a record"
        picture: Picture | None = None
        if shot is not None and frame.image is not None:
            picture = measured_picture(shot.blob, shot.media_type, frame.image)
        newest, noted = trace(), None if notes is None else notes()
        opening_m = frame.jaw_opening_m
        share, limits = (None, None) if noted is None else (noted.statistic_share, noted.limits)
        packed = None if newest is None else pack_trace(newest)
        self._rows.append(Row(record, picture, packed, None, opening_m, share, limits))
        self._rows_then.append(Row(then, None, None, None, opening_m, None, self._recorded_limits))
        if len(self._rows) >= _BATCH_ROWS:
            self._write()

    def alert(self, alert: AlertRecord) -> None:
        """The daemon's own alerts are none of a replay's."""

    def state(self, state: StateRecord) -> None:
        """Nor are its state messages."""

    def reference(self, reference: ReferenceRecord) -> None:
        """A new reference of the replay."""
        self._events += Events(references=[reference])

    def command(self, command: RecordedCommand) -> None:
        """A command, and what became of it now."""
        self._events += Events(commands=[command])

    def close(self, timeout_s: float = 2.0) -> None:
        """Finish the file."""
        self._write()
        if self.failure is not None:
            return
        self._writer.finish()
        self._curves.finish()
        try:
            self._stream.flush(timeout_sec=max(timeout_s, _FLUSH_TIMEOUT_S))
        except Exception as error:  # noqa: BLE001 - rerun raises its own kinds
            self.failure = f"can't write {self._path}: {' '.join(str(error).split())}"
        self._stream.disconnect()

    def _has_room(self) -> bool:
        if self.failure is None and shutil.disk_usage(self._path.parent).free < _LEAST_FREE_BYTES:
            self.failure = f"can't write {self._path}: less than {1e-6 * _LEAST_FREE_BYTES:.0f} MB are free"
        return self.failure is None

    def _write(self) -> None:
        rows, then, events = self._rows, self._rows_then, self._events
        self._rows, self._rows_then, self._events = [], [], Events()
        if not rows or not self._has_room():
            return
        self._writer.write(rows, events)
        self._curves.write(then)
        newest = rows[-1].record.seq
        told = [command for command in self._events_then.commands if command.seq <= newest]
        self._events_then = Events(commands=[command for command in self._events_then.commands if command.seq > newest])
        self._status.write(then, Events(commands=told), [])


def _name_both(stream: rr.RecordingStream) -> None:
    """The same colours, what was recorded wide and pale below what is replayed."""
    names, colours = ("x", "y", "z", "length"), (*palette.AXES, palette.WHOLE)
    pale = [palette.faded(colour, 110) for colour in colours]
    for path, whose, shown, width in (
        ("drift/tcp_shift_mm", REPLAYED, list(colours), _THIN),
        (f"{RECORDED}/drift/tcp_shift_mm", RECORDED, pale, _WIDE),
    ):
        lines = rr.SeriesLines(names=[f"{whose} {name}" for name in names], colors=shown, widths=[width] * 4)
        stream.log(path, lines, static=True)
    limits = (palette.DOUBTFUL, palette.BAD)
    for path, whose, alpha, width in (
        ("drift/limits_mm", REPLAYED, 255, _THIN),
        (f"{RECORDED}/drift/limits_mm", RECORDED, 110, _WIDE),
    ):
        lines = rr.SeriesLines(
            names=[f"{whose} warning", f"{whose} limit"],
            colors=[palette.faded(colour, alpha) for colour in limits],
            widths=[width] * 2,
        )
        stream.log(path, lines, static=True)
    for path, whose, alpha, width in (
        ("protection", REPLAYED, 255, _THIN),
        (f"{RECORDED}/protection", RECORDED, 110, _WIDE),
    ):
        for name, said, colour in (("level", "protection level", palette.WHOLE), ("limit", "alert limit", palette.BAD)):
            style = rr.SeriesLines(names=f"{whose} {said}", colors=palette.faded(colour, alpha), widths=width)
            stream.log(f"{path}/{name}_mm", style, static=True)


def _layout(scene: Scene) -> rrb.Blueprint:
    """Left the image with the replay's overlay, and what happened in both; right both drifts and both limits in one
    plot, the states of both.
    """
    axis = rrb.TimeAxis(link="LinkToGlobal")
    drift = rrb.TimeSeriesView(
        origin="/",
        contents=[
            f"{RECORDED}/drift/limits_mm", f"{RECORDED}/drift/tcp_shift_mm", "drift/limits_mm", "drift/tcp_shift_mm",
        ],
        name=f"TCP drift (mm): x red, y green, z blue, length white; wide, pale: {RECORDED}, thin: {REPLAYED}",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )  # fmt: skip
    turn = rrb.TimeSeriesView(
        origin="/",
        contents=[f"{RECORDED}/drift/delta_deg", f"{RECORDED}/drift/limits_deg", "drift/delta_deg", "drift/limits_deg"],
        name="δ (°) and its limits, of both",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )
    bounds = rrb.TimeSeriesView(
        origin="/",
        contents=[
            f"{RECORDED}/protection/level_mm", f"{RECORDED}/protection/limit_mm",
            "protection/level_mm", "protection/limit_mm",
        ],
        name="Protection level (mm) and alert limit, of both",
        axis_x=axis,
        plot_legend=rrb.PlotLegend(visible=False),
    )  # fmt: skip
    columns = rrb.TextLogColumns(timeline_columns=["frame"], text_log_columns=["LogLevel", "Body"])
    log = rrb.TextLogView(
        origin="/",
        contents=["events", f"{RECORDED}/events"],
        name=f"Alerts and changes, {REPLAYED} and {RECORDED}",
        columns=columns,
    )
    states = [
        rrb.StateTimelineView(origin=origin, name=f"State and verdict, {whose}", time_view=axis)
        for origin, whose in ((f"{RECORDED}/status", RECORDED), ("status", REPLAYED))
    ]
    details = rrb.Tabs(rig_view(scene), turn, bounds, active_tab=0)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(image_view(scene), log, row_shares=[6, 3]),
            rrb.Vertical(drift, *states, details, row_shares=[4.5, 2, 2, 3]),
            column_shares=[5, 4],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="capture_time"),
    )
