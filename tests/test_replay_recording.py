"""``gripmon replay RECORDING``: what was recorded, decided again to the byte, or told where it can't be."""

from __future__ import annotations

import dataclasses
import json
import re
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from support import recorded
from support.configurations import with_sections
from support.replayed import EVERY_FRAME, replayed, without_latency

from gripmon.analyse.comparison import Differences
from gripmon.cli import main
from gripmon.daemon.api import Monitor
from gripmon.daemon.config import load_config
from gripmon.daemon.config.recorded import to_recorded
from gripmon.daemon.recorded_run import one_recording
from gripmon.daemon.replaying import replay
from gripmon.daemon.running import run
from gripmon.io.sources.files import FolderSettings, FolderSource
from gripmon.model.outputs import Output
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    Cause,
    Frame,
    Refusal,
    Severity,
    Verdict,
    to_json,
)
from gripmon.record.read import RecordedFrames
from gripmon.record.recorder import Recorder
from gripmon.record.write import open_recorder

WARNED = Alert(
    AlertKind.CREEP, Cause.UNKNOWN, Severity.WARNING, "a creep", event=AlertEvent.RAISED, alert_id="1-a", since_ns=1
)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of a camera that a cable pulls aside."""
    out = tmp_path_factory.mktemp("simulated") / "creep"
    assert main(["simulate", "creep", "--out", str(out), "--seconds", "3", "--fps", "10", "--seed", "6"]) == 0
    return out


def sequence_config(sequence: Path, recording: str = EVERY_FRAME, name: str = "every.yaml", more: str = "") -> Path:
    path = sequence / name
    path.write_text((sequence / "config.yaml").read_text() + f"recording: {recording}\n{more}")
    return path


class Given:
    """Frames from memory."""

    live, connected, dropped = False, True, 0

    def __init__(self, frames: list[Frame]) -> None:
        self._frames = iter(frames)

    def read(self) -> Frame | None:
        return next(self._frames, None)

    def close(self) -> None:
        self._frames = iter(())


def odd_frames(sequence: Path) -> list[Frame]:
    """All that may come from a camera: refused frames of every kind, other pixel types, odd stamps and names."""
    folder = FolderSource(FolderSettings(path="."), sequence)
    frames = [frame for frame in iter(folder.read, None) if isinstance(frame, Frame)]
    image = frames[0].image
    assert image is not None
    height, width = image.shape[:2]
    changes: dict[int, dict[str, Any]] = {
        4: {"image": np.zeros_like(image)},
        5: {"image": np.full_like(image, 255)},
        6: {"image": np.full_like(image, 90)},
        7: {"image": image[:100, :100].copy()},
        8: {"image": np.zeros((3 * height, 3 * width, 3), np.uint8)},
        9: {"image": None, "fault": "truncated: or worse"},
        10: {"image": None, "fault": "64x48 pixels", "refusal": Refusal.WRONG_SIZE},
        11: {"image": np.where(image > 0, np.float32(np.nan), np.float32(0.0))},
        12: {"image": image.astype(np.float64)},
        13: {"image": image[:, :, None]},
        14: {"jaw_opening_m": 0.4},
        15: {"jaw_opening_m": None},
        16: {"stamp_ns": frames[10].stamp_ns},
        17: {"name": "a stream: of ours"},
        18: {"image": np.stack([image] * 3, axis=2)},
        19: {"image": frames[19].image.astype(np.uint16) * 257},  # type: ignore[union-attr]
        22: {"image": frames[21].image},
        23: {"image": frames[21].image},
    }
    odd = [dataclasses.replace(frame, **changes.get(frame.seq, {})) for frame in frames]
    return [dataclasses.replace(frame, seq=frame.seq + 3 * (frame.seq > 25)) for frame in odd if frame.seq != 2]


def test_refused_and_odd_frames_are_given_again(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = load_config(sequence_config(sequence), check_source=False)
    with one_recording(tmp_path / "odd.rrd", config) as recorder:
        lines = [to_json(each) + b"\n" for each in replay(Given(odd_frames(sequence)), config, recorder)]
    reasons = {json.loads(line)["reason"].partition(":")[0] for line in lines if json.loads(line)["reason"]}
    assert reasons >= set(Refusal) - {Refusal.FROZEN}, "every kind of refusal"
    (tmp_path / "then.jsonl").write_bytes(b"".join(lines))
    again = replayed(tmp_path / "odd.rrd", tmp_path / "again.jsonl")
    assert again == without_latency(tmp_path / "then.jsonl")
    said = capsys.readouterr().err
    assert "5 refused frames have no image in the recording" in said and "every number the same" in said


class Camera(Given):
    """Of a live camera, none of whose frames waits."""

    live = True


class PassedOn(Output):
    """Into a recorder that the loop doesn't close: it gives a slow disk ten seconds."""

    def __init__(self, recorder: Recorder) -> None:
        self.frame, self.event = recorder.frame, recorder.event  # type: ignore[method-assign]


def test_what_a_live_run_searched_beside_its_frames_counts_in_the_same_frames_again(sequence: Path, tmp_path: Path):
    """Frames come at once, and a search ends whenever it does."""
    config = load_config(sequence_config(sequence), check_source=False)
    noise = np.random.default_rng(3).integers(0, 256, (config.camera.height_px, config.camera.width_px), np.uint8)
    folder = FolderSource(FolderSettings(path="."), sequence)
    frames = [frame for frame in iter(folder.read, None) if isinstance(frame, Frame)]
    frames = [dataclasses.replace(f, image=np.roll(noise, f.seq) if 8 <= f.seq < 20 else f.image) for f in frames]
    with one_recording(tmp_path / "live.rrd", config) as recorder:
        run(
            Monitor(config), source=Camera(frames), outputs=(PassedOn(recorder),), recorder=Recorder(),
            estimates=tmp_path / "then.jsonl", settings=config.settings.daemon, robot="demo", camera="wrist",
        )  # fmt: skip
    then = without_latency(tmp_path / "then.jsonl")
    assert replayed(tmp_path / "live.rrd", tmp_path / "again.jsonl") == then
    beside = [json.loads(line)["beside"] for line in then]
    assert next(seq for seq, each in enumerate(beside) if each["searches"]) == 8
    # The frame in which a search's result counted may be one of those that are missing: then the frames' clock decides.
    thinned = RecordedFrames(tmp_path / "live.rrd")
    thinned.frames_without_image = 1
    again = list(replay(thinned, config))
    assert len(again) == len(then) and {record.beside for record in again} == {None}


def test_the_files_of_one_run_are_one_recording(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = load_config(sequence_config(sequence), check_source=False)
    settings = msgspec.structs.replace(config.settings.recording, max_file_bytes=1_500_000, flush_period_s=0.05)
    paths = {}
    for name in ("a", "b"):
        recorder = open_recorder(
            settings, robot="demo", camera_name="wrist", camera=config.camera, gripper=config.gripper,
            reference=config.reference, directory=tmp_path / name, name=name, patience_s=30.0,
            configuration=to_recorded(config),
        )  # fmt: skip
        source = FolderSource(FolderSettings(path="."), sequence)
        lines = b""
        for record in replay(source, config, recorder):
            lines += to_json(record) + b"\n"
            time.sleep(0.05)  # the files change at flushes
        recorder.close(timeout_s=60.0)
        paths[name] = sorted((tmp_path / name).glob("*.rrd"))
        assert len(paths[name]) >= 3
    (tmp_path / "then.jsonl").write_bytes(lines)
    then = without_latency(tmp_path / "then.jsonl")
    assert replayed(tmp_path / "b", tmp_path / "folder.jsonl") == then
    assert replayed(paths["b"][::-1], tmp_path / "files.jsonl") == then
    capsys.readouterr()
    assert main(["replay", str(tmp_path / "a"), str(tmp_path / "b"), "--out", "-"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("these are files of 2 runs (") and said.endswith("; the files of one")
    assert str(paths["a"][0]) in said and str(paths["b"][0]) in said
    with_frames = [path for path in paths["b"] if contents(path, "record", "json")]
    last = replayed(with_frames[-1:], tmp_path / "last.jsonl")
    assert 0 < len(last) < len(then), "each file brings what it takes"


@pytest.mark.slow("4 s: what is shown of a replay; that it decides the same is in the default run")
def test_a_thinned_recording_says_what_is_missing(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = sequence_config(sequence, "{image_rate_hz: 2.0, around_alert_s: 0.0, min_free_bytes: 0}", "thin.yaml")
    recording = tmp_path / "thin.rrd"
    replayed(sequence, tmp_path / "then.jsonl", "--config", str(config), "--recording", str(recording))
    capsys.readouterr()
    lines = replayed(recording, tmp_path / "again.jsonl")
    said = capsys.readouterr().err
    counted = re.search(r"holds images of (\d+) frames; (\d+) more were recorded without", said)
    assert counted and int(counted[1]) == len(lines) < 30 and int(counted[1]) + int(counted[2]) == 30
    assert re.search(r"numbers differ in \d+, the TCP by up to [\d.e-]+ mm \(the images were recorded as JPEG\)", said)


def test_a_damaged_recording_is_replayed_as_far_as_it_is_whole(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Cut anywhere, or damaged in the middle: the same lines, as many as are left; in words what was lost."""
    recording = tmp_path / "then.rrd"
    first = ["--config", str(sequence_config(sequence)), "--recording", str(recording)]
    then, whole = replayed(sequence, tmp_path / "then.jsonl", *first), recording.read_bytes()
    begin = whole.index(b"\x89PNG", len(whole) // 2) + 1000
    end = begin + 2000  # within that image: what lies behind it may be other frames' results
    damaged = whole[:begin] + bytes(end - begin) + whole[end:]
    for name, data in (("cut.rrd", whole[: 2 * len(whole) // 3]), ("damaged.rrd", damaged)):
        (tmp_path / name).write_bytes(data)
        capsys.readouterr()
        lines = replayed(tmp_path / name, tmp_path / "again.jsonl")
        said = capsys.readouterr().err
        records = [json.loads(line) for line in lines]
        lost = (i for i, r in enumerate(records) if r["seq"] != i or "damaged" in (r["reason"] or ""))
        whole_until = next(lost, len(lines))
        assert 0 < whole_until < len(then), "something was lost"
        assert lines[:whole_until] == then[:whole_until]
        if name == "cut.rrd":
            assert f"replay: {tmp_path / name}: is cut short" in said
        else:
            assert "; the recorded images of " in said and len(lines) == len(then)
    (tmp_path / "head.rrd").write_bytes(whole[:100])
    assert main(["replay", str(tmp_path / "head.rrd"), "--out", "-"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "is cut short before its recording begins" in line


def test_other_limits_are_tried_on_what_happened(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The camera is pulled aside by more than a millimetre: with a limit of half of that it is measured again."""
    recording = tmp_path / "then.rrd"
    first = ["--config", str(sequence_config(sequence)), "--recording", str(recording)]
    then = replayed(sequence, tmp_path / "then.jsonl", *first)
    tight = "{policy: {warn_m: 0.0001, limit_m: 0.0003}, recalibration: {mode: 'off'}}"
    text = with_sections((sequence / "config.yaml").read_text(), monitor=tight)
    (sequence / "tight.yaml").write_text(text)
    capsys.readouterr()
    now = replayed(recording, tmp_path / "now.jsonl", "--config", str(sequence / "tight.yaml"))
    said = capsys.readouterr().err
    severities = [{alert["severity"] for alert in json.loads(line)["alerts"]} for line in now]
    assert any("error" in some for some in severities), "past the limit"
    pairs = [(json.loads(a), json.loads(b)) for a, b in zip(then, now, strict=True)]
    states = sum(a["state"] != b["state"] for a, b in pairs)
    verdicts = sum(a["verdict"] != b["verdict"] for a, b in pairs)
    assert verdicts == states == 0 and "verdicts and states as recorded; alerts differ: " in said
    assert re.search(r"raised as error at frame \d+, not recorded", said), "what the other limit does is said first"


def contents(path: Path, entity: str, component: str) -> dict[int, Any]:
    """The values of an entity by frame."""
    values: dict[int, Any] = {}
    for chunk in RrdReader(path).stream().filter(content=[f"/{entity}"], has_timeline="frame").to_chunks():
        batch = chunk.to_record_batch()
        values |= zip(batch.column("frame").to_pylist(), batch.column(component).to_pylist(), strict=True)
    return values


@pytest.mark.slow("4 s: what is shown of a replay; that it decides the same is in the default run")
def test_both_runs_are_overlaid_in_a_new_recording(sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Drifts, limits, states and the log of both; what is replayed is a recording of its own, to be replayed again."""
    then, both = tmp_path / "then.rrd", tmp_path / "both.rrd"
    lines_then = replayed(
        sequence, tmp_path / "then.jsonl", "--config", str(sequence_config(sequence)), "--recording", str(then)
    )
    monitor = "{policy: {warn_m: 0.0001, limit_m: 0.0004, alert_limit_m: 0.001}, recalibration: {mode: 'off'}}"
    tight = sequence / "tight.yaml"
    tight.write_text(with_sections((sequence / "config.yaml").read_text(), monitor=monitor))
    lines_now = replayed(then, tmp_path / "now.jsonl", "--config", str(tight), "--recording", str(both))
    shifts, scalars = "drift/tcp_shift_mm", "Scalars:scalars"
    for entity, lines in ((f"recorded/{shifts}", lines_then), (shifts, lines_now)):
        expected = {line["seq"]: line["drift"]["tcp_shift_m"] for line in map(json.loads, lines) if line["drift"]}
        drawn = {seq: values for seq, values in contents(both, entity, scalars).items() if values}
        assert drawn.keys() == expected.keys()
        for seq, values in drawn.items():
            assert values[:3] == pytest.approx([1e3 * v for v in expected[seq]], abs=1e-12), "mm"
    policy = load_config(sequence / "config.yaml", check_source=False).settings.monitor.policy
    for entity, limits_mm in (
        ("drift/limits_mm", [0.1, 0.4]),
        ("recorded/drift/limits_mm", [1e3 * policy.warn_m, 1e3 * policy.limit_m]),
        ("recorded/protection/limit_mm", [1e3 * policy.alert_limit_m]),
        ("protection/limit_mm", [1.0]),
    ):
        drawn_mm = contents(both, entity, scalars)
        assert drawn_mm and all(values == pytest.approx(limits_mm) for values in drawn_mm.values()), entity
    for entity, lines in (("recorded/protection/level_mm", lines_then), ("protection/level_mm", lines_now)):
        bounds = {line["seq"]: line["protection"] for line in map(json.loads, lines) if line["protection"]}
        drawn = {seq: values[0] for seq, values in contents(both, entity, scalars).items() if values}
        assert drawn == pytest.approx({seq: 1e3 * bound["position_m"] for seq, bound in bounds.items()})
    log = [text for (text,) in contents(both, "recorded/events", "TextLog:text").values()]
    assert log and all(text.startswith("recorded: ") for text in log)
    assert contents(both, "recorded/status/state", "StateChange:state") and contents(
        both, "status/state", "StateChange:state"
    )
    assert replayed(both, tmp_path / "again.jsonl") == lines_now
    capsys.readouterr()
    replayed(then, tmp_path / "now.jsonl", "--recording", str(then), code=2)
    assert capsys.readouterr().err.splitlines() == [f"--recording {then}: is the replayed file; another file"]


@pytest.mark.slow("4 s; other limits on the same recording are in the default run")
def test_another_calibration_begins_with_its_own_reference(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    recording = tmp_path / "then.rrd"
    first = ["--config", str(sequence_config(sequence)), "--recording", str(recording)]
    replayed(sequence, tmp_path / "then.jsonl", *first)
    text = (sequence / "config.yaml").read_text()
    (sequence / "other.yaml").write_text(re.sub(r"(?m)^(reference:)$", r"\1\n  id: another", text))
    capsys.readouterr()
    lines = replayed(recording, tmp_path / "now.jsonl", "--config", str(sequence / "other.yaml"))
    assert {json.loads(line)["reference_id"] for line in lines} == {"another"}
    assert "the configuration has another calibration" in capsys.readouterr().err


def test_what_cannot_be_replayed_is_said_in_one_line(
    sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = load_config(sequence_config(sequence), check_source=False)
    old = open_recorder(
        config.settings.recording, robot="demo", camera_name="wrist", camera=config.camera, gripper=config.gripper,
        reference=config.reference, directory=tmp_path, name="old", patience_s=30.0,
    )  # fmt: skip
    for _ in replay(FolderSource(FolderSettings(path="."), sequence), config, old):
        pass
    old.close(timeout_s=60.0)
    other = rr.RecordingStream("somebody_else", recording_id="x")
    other.set_sinks(rr.FileSink(tmp_path / "other.rrd"))
    other.log("a", rr.Scalars(1.0))
    other.disconnect()
    (tmp_path / "empty").mkdir()
    cases = [
        ([tmp_path / "old-0001.rrd"], 2, "holds no configuration; the one to replay with"),
        ([tmp_path / "other.rrd"], 3, "is a recording of the application 'somebody_else'"),
        ([tmp_path / "picture.rrd"], 3, "is not a rerun recording, whatever its name says"),
        ([tmp_path / "nothing.rrd"], 3, "is empty"),
        ([tmp_path / "none.rrd"], 2, "there is no such file; recordings of gripmon run"),
        ([tmp_path / "old-0001.rrd", sequence], 2, "isn't an .rrd file; one input, or several .rrd files of one run"),
        ([tmp_path / "empty"], 2, "empty: no recordings and no images in it"),
        ([tmp_path / "old-0001.rrd", tmp_path / "empty"], 2, "empty: no recordings and no images in it"),
        ([sequence], 2, "isn't a recording, which alone brings its own configuration; name one"),
    ]
    (tmp_path / "picture.rrd").write_bytes(next(sequence.glob("*.png")).read_bytes())
    (tmp_path / "nothing.rrd").touch()
    capsys.readouterr()
    for inputs, code, expected in cases:
        assert main(["replay", *map(str, inputs), "--out", "-"]) == code
        (line,) = capsys.readouterr().err.splitlines()
        assert expected in line


def test_a_replay_says_first_what_it_judges_otherwise():
    differences = Differences()
    worse = msgspec.structs.replace(WARNED, event=AlertEvent.UPDATED, text="more")
    for seq in range(10):
        alerts = {3: (WARNED,), 6: (worse,)}.get(seq, ())
        then = recorded.record(seq, alerts=alerts)
        now = msgspec.structs.replace(then, verdict=Verdict.SUSPECT, reason="far off") if seq == 8 else then
        if seq == 6:
            now = msgspec.structs.replace(now, alerts=(msgspec.structs.replace(worse, severity=Severity.ERROR),))
        differences.add(then, now)
    assert differences.text(from_jpeg=False) == (
        "1 frame with another verdict (the first: frame 8, suspect instead of valid); alerts differ: creep becomes "
        "error at frame 6, not recorded; numbers differ in 2, the TCP by up to 0 mm"
    )
