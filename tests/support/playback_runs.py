"""Recordings for the tests of reading: a run by the project's own recorder, and files that it never wrote."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import rerun as rr

from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    CommandName,
    FrameRecord,
    MeasurementTrace,
    RecordedCommand,
    RecordedConfiguration,
    RecordedFile,
    Severity,
    Smoothed,
    State,
    StateRecord,
    Verdict,
    to_json,
)
from gripmon.record.table import FrameTable, TableBuilder
from gripmon.record.write import ProcessRecorder, open_recorder
from support.recorded import (
    CAMERA,
    COVARIANCE,
    GRIPPER,
    REFERENCE,
    START_NS,
    Recorded,
    frame,
    record,
    settings,
    trace,
    wait_until,
)

FILES, FRAMES_A_BATCH = 3, 60
MESSAGE = struct.Struct("<QQ")
CONFIGURATION = RecordedConfiguration(
    main="cell.yaml", files={"cell.yaml": RecordedFile("robot: arm\n"), "edges.bin": RecordedFile.of(b"\xff\x00")}
)
MOVED = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.ERROR, "moved by 2 mm", AlertEvent.RAISED, "A1")
OWN_ALERT = AlertRecord(
    AlertKind.SOURCE,
    Cause.NO_CAMERA,
    Severity.ERROR,
    "the camera doesn't answer",
    robot="arm",
    camera="wrist",
    seq=100,
    stamp_ns=START_NS + 1_700_000_000,
    state=State.STALE,
    reference_id="first",
    revision=1,
)
SECOND = msgspec.structs.replace(REFERENCE, reference_id="second", revision=2, origin="recalibration", parent="first")
COMMAND = RecordedCommand(START_NS + 5, 100, CommandName.UNDO, "", done=True, text="back to first")


def table_of(records: Iterable[FrameRecord]) -> FrameTable:
    """One row per record, in order."""
    builder = TableBuilder()
    for each in records:
        builder.add(each)
    return TableBuilder.join([builder])


@dataclass(frozen=True)
class Run:
    """What was given to the recorder, and the files that it wrote with the frames in each, as rerun's reader has it."""

    files: tuple[Path, ...]
    seqs: tuple[list[int], ...]
    records: tuple[FrameRecord, ...]
    traces: dict[int, MeasurementTrace]


def records_of_a_run(first: int, count: int) -> list[FrameRecord]:
    """Every kind of frame: smoothed, refused, with an alert, against another reference, drifting."""
    made = []
    for i in range(first, first + count):
        changes: dict[str, object] = {}
        if i % 3 == 0:
            other = record(1000 + i).cam_T_grip
            assert other is not None
            changes["smoothed"] = Smoothed(other.translation_m, other.rotation_xyzw, tuple(2.0 * v for v in COVARIANCE))
        if i % 20 == 7:
            gone = dict.fromkeys(("cam_T_grip", "covariance", "drift", "rms_px", "jaw_opening_m", "protection"))
            changes |= {**gone, "corners": (), "reason": "black", "verdict": Verdict.UNKNOWN, "state": State.LOST}
        if i % 50 == 40:
            changes |= {"alerts": (MOVED,), "state": State.DRIFTING, "verdict": Verdict.SUSPECT}
        if i >= 100:
            changes |= {"reference_id": "second", "revision": 2}
        made.append(record(i, **changes))  # type: ignore[arg-type]
    return made


def state_record(seq: int) -> StateRecord:
    return StateRecord(
        robot="arm", camera="wrist", state=State.TRACKING, verdict=Verdict.VALID, stamp_ns=START_NS + seq, seq=seq,
        reference_id="first", revision=1, frames=seq, frames_refused=0, frames_dropped=0, frames_per_s=60.0,
        uptime_s=1.0, camera_connected=True, recording_dropped=0, message="", version="1",
    )  # fmt: skip


def new_recorder(
    directory: Path, name: str = "run", robot: str = "arm", max_file_bytes: int = 100_000
) -> ProcessRecorder:
    opened = open_recorder(
        settings(max_file_bytes=max_file_bytes, image_rate_hz=31.0, around_alert_s=0.1),
        robot=robot,
        camera_name="wrist",
        camera=CAMERA,
        gripper=GRIPPER,
        reference=REFERENCE,
        directory=directory,
        name=name,
        patience_s=30.0,
        configuration=CONFIGURATION,
    )
    assert isinstance(opened, ProcessRecorder)
    return opened


def write_run(directory: Path) -> Run:
    """Three files or more; an image with every second one, with all around alerts; one of everything else."""
    recorder = new_recorder(directory)
    records: list[FrameRecord] = []
    traces: dict[int, MeasurementTrace] = {}
    for number in range(FILES):
        for made in records_of_a_run(number * FRAMES_A_BATCH, FRAMES_A_BATCH):
            seen = frame(made.seq)
            object.__setattr__(seen, "jaw_opening_m", 0.02 + 1e-4 * made.seq)

            def traced(seq: int = made.seq) -> MeasurementTrace:
                traces[seq] = trace(seq % 50)
                return traces[seq]

            recorder.frame(seen, made, traced)
            records.append(made)
        if number == 1:
            recorder.event(OWN_ALERT)
            recorder.event(COMMAND)
            recorder.event(SECOND)
            recorder.event(state_record(70))
        wait_until(lambda: recorder.frames_written == len(records))
    recorder.close(30.0)
    assert recorder.dropped == 0 and recorder.images_dropped == 0
    written = sorted(directory.glob("*.rrd"))
    with_frames = [(path, seqs) for path in written if (seqs := Recorded(path).seqs())]
    assert len(with_frames) >= FILES
    files, seqs_of_files = zip(*with_frames, strict=True)
    return Run(files, seqs_of_files, tuple(records), traces)


def write_rrd(
    path: Path,
    texts: Sequence[str | bytes] = (),
    application: str = "gripmon",
    recording_id: str = "made",
    **static: str | bytes,
) -> Path:
    """A recording as another version might have written it: ``texts`` as the frames' records, static JSON by entity."""
    with rr.RecordingStream(application, recording_id=recording_id) as stream:
        stream.set_sinks(rr.FileSink(path))
        for entity, text in static.items():
            stream.log(entity, rr.AnyValues(json=_text(text)), static=True)
        if texts:
            index = rr.TimeColumn("frame", sequence=list(range(len(texts))))
            stream.send_columns("record", [index], rr.AnyValues.columns(json=[_text(t) for t in texts]))
        stream.log("elsewhere", rr.TextLog("something"))
        stream.flush()
        stream.disconnect()
    return path


def lines(*records: FrameRecord) -> list[bytes]:
    return [to_json(r) for r in records]


def altered(text: bytes, **fields: object) -> bytes:
    """A JSON object with other fields; those that are ``...`` are left out."""
    changed = {**msgspec.json.decode(text), **fields}
    return msgspec.json.encode({name: value for name, value in changed.items() if value is not ...})


def messages(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Kind, offset and whole size of each message in an .rrd file."""
    offset = 12
    while offset + MESSAGE.size <= len(data):
        kind, size = MESSAGE.unpack_from(data, offset)
        yield kind, offset, MESSAGE.size + size
        offset += MESSAGE.size + size
        if kind == 0:
            return


def _text(text: str | bytes) -> str:
    return text if isinstance(text, str) else text.decode()
