"""A run that the recorder wrote, read back: everything that was given to it, to the last digit."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.playback_runs import (
    COMMAND,
    CONFIGURATION,
    FILES,
    OWN_ALERT,
    SECOND,
    Run,
    lines,
    new_recorder,
    records_of_a_run,
    state_record,
    table_of,
    write_run,
)
from support.recorded import REFERENCE, frame, image, record, trace, wait_until

from gripmon.model.records import to_json
from gripmon.record.read import open_recordings, recordings_below
from gripmon.record.recordings import Recording, decode_image


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return write_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def recording(run: Run) -> Recording:
    collection = open_recordings(run.files)
    assert collection.faults == ()
    (found,) = collection.recordings
    return found


def test_every_record_comes_back_byte_for_byte(run: Run, recording: Recording):
    assert len(run.files) >= FILES
    assert [to_json(r) for r in recording.records()] == [to_json(r) for r in run.records]
    assert recording.faults == ()


def test_columns_are_those_of_the_records(run: Run, recording: Recording):
    expected = table_of(run.records)
    for name, column in vars(expected).items():
        assert np.array_equal(getattr(recording.frames, name), column, equal_nan=column_is_float(column)), name


def column_is_float(column: object) -> bool:
    return isinstance(column, np.ndarray) and column.dtype.kind == "f"


def test_the_run_says_what_it_is(recording: Recording):
    assert recording.meta is not None
    assert (recording.robot, recording.camera) == ("arm", "wrist") == (recording.meta.robot, recording.meta.camera)
    assert recording.meta.recording_id == recording.recording_id
    assert recording.configuration == CONFIGURATION


def test_what_belongs_to_no_frame_comes_back(run: Run, recording: Recording):
    assert recording.commands == (COMMAND,)
    assert recording.states == (state_record(70),)
    assert recording.references == (REFERENCE, SECOND)
    own = [alert for alert in recording.alerts if alert == OWN_ALERT]
    of_frames = [(a.seq, a.text, a.alert_id) for a in recording.alerts if a != OWN_ALERT]
    assert len(own) == 1
    assert of_frames == [(r.seq, a.text, a.alert_id) for r in run.records for a in r.alerts]
    assert [a.seq for a in recording.alerts] == sorted(a.seq for a in recording.alerts)


def test_an_image_has_its_own_overlay(run: Run, recording: Recording):
    """Pixels against the image that was recorded (JPEG: within a few grey values), the overlay against its trace."""
    assert set(run.traces) <= set(recording.image_seqs.tolist())
    for seq in (min(run.traces), 40, max(run.traces)):
        picture = recording.picture(seq)
        assert picture is not None
        assert picture.stamp_ns == run.records[seq].stamp_ns
        assert np.abs(picture.image.astype(float) - image(seq)).max() < 8.0
        traced = run.traces[seq]
        assert np.allclose(picture.edges_used, traced.edge_uv_px[traced.edge_used], atol=1e-3)
        assert np.allclose(picture.edges_refused, traced.edge_uv_px[~traced.edge_used], atol=1e-3)
        for got, drawn in zip(picture.predicted_edges, traced.predicted_edges_uv_px, strict=True):
            assert np.allclose(got, drawn, atol=1e-3)
        assert picture.corners == run.records[seq].corners


def test_images_that_an_alert_brought_in_later_are_found(run: Run, recording: Recording):
    later = sorted(set(recording.image_seqs.tolist()) - set(run.traces))
    assert later
    for seq in later:
        picture = recording.picture(seq)
        assert picture is not None
        assert np.abs(picture.image.astype(float) - image(seq)).max() < 8.0


def test_a_frame_without_an_image_has_no_picture(recording: Recording):
    without = np.setdiff1d(recording.frames.seq, recording.image_seqs)
    assert len(without) > 0
    assert recording.picture(int(without[0])) is None
    assert recording.picture(10**12) is None


def blobs(found: Recording) -> list[bytes | None]:
    return [None if shot is None else shot.blob for _, shot in found.with_shots(found.image_seqs)]


def test_every_image_comes_again_with_its_record(run: Run, recording: Recording):
    again = list(recording.with_shots(recording.frames.seq))
    assert [record for record, _ in again] == list(run.records)
    shots = {record.seq: shot for record, shot in again if shot is not None}
    assert list(shots) == recording.image_seqs.tolist() == sorted(recording.images())
    for seq, shot in shots.items():
        assert shot.seq == seq and shot.stamp_ns == run.records[seq].stamp_ns
        assert recording.jaw_reported_m(seq) == pytest.approx(0.02 + 1e-4 * seq, abs=1e-15)
        decoded = decode_image(shot.blob)
        assert decoded is not None and np.array_equal(decoded, cv2.imdecode(np.frombuffer(shot.blob, np.uint8), -1))


def test_only_some_records(run: Run, recording: Recording):
    wanted = np.array([3, 59, 60, 61, 179, 5000])
    assert [r.seq for r in recording.records(wanted)] == [3, 59, 60, 61, 179]


@pytest.mark.parametrize("order", [[2, 0, 1], [1, 2, 0]])
def test_the_order_of_the_files_does_not_matter(run: Run, recording: Recording, order: list[int]):
    (found,) = open_recordings([*[run.files[i] for i in order], *run.files[3:]]).recordings
    assert np.array_equal(found.frames.seq, recording.frames.seq)
    assert found.files == recording.files


def test_a_folder_with_two_robots(run: Run, tmp_path: Path):
    for path in run.files:
        shutil.copy(path, tmp_path)
    other = new_recorder(tmp_path, "second", robot="left")
    for i in range(5):
        other.frame(frame(i), record(i), lambda: trace(0))
    wait_until(lambda: other.frames_written == 5)
    other.close(30.0)
    seen: list[tuple[int, int]] = []
    collection = open_recordings([tmp_path], lambda done, total: seen.append((done, total)))
    assert sorted((r.robot, len(r.frames)) for r in collection.recordings) == [
        ("arm", len(run.records)), ("left", 5),
    ]  # fmt: skip
    assert collection.faults == ()
    total = sum(path.stat().st_size for path in tmp_path.glob("*.rrd"))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1] == (total, total) and {of for _, of in seen} == {total}


def test_json_lines_are_a_recording_without_images(tmp_path: Path):
    records = records_of_a_run(0, 130)
    path = tmp_path / "estimates.jsonl"
    path.write_bytes(b"\n".join(lines(*records)) + b"\n")
    (found,) = open_recordings([path]).recordings
    assert found.faults == () and len(found.image_seqs) == 0
    assert [to_json(r) for r in found.records()] == lines(*records)
    assert [a.seq for a in found.alerts] == [40, 90]
    assert found.picture(3) is None and found.images() == {}


def test_what_rerun_merged_reads_the_same(run: Run, recording: Recording, tmp_path: Path):
    """rerun's own tool writes other chunks, in another order, and one ``meta`` for all files."""
    merged = tmp_path / "merged.rrd"
    command = [sys.executable, "-m", "rerun", "rrd", "optimize", *map(str, run.files), "-o", str(merged)]
    subprocess.run(command, check=True, capture_output=True)
    (found,) = open_recordings([merged]).recordings
    assert [to_json(r) for r in found.records()] == [to_json(r) for r in run.records]
    assert np.array_equal(found.image_seqs, recording.image_seqs)
    assert blobs(found) == blobs(recording) and None not in blobs(found)
    assert (found.commands, found.references, found.alerts) == (
        recording.commands, recording.references, recording.alerts,
    )  # fmt: skip
    assert found.faults == ()


def test_files_put_one_behind_the_other(run: Run, recording: Recording, tmp_path: Path):
    joined = tmp_path / "joined.rrd"
    joined.write_bytes(b"".join(path.read_bytes() for path in run.files))
    (found,) = open_recordings([joined]).recordings
    assert [to_json(r) for r in found.records()] == [to_json(r) for r in run.records]
    assert np.array_equal(found.image_seqs, recording.image_seqs)
    (fault,) = found.faults
    assert "its messages were read one by one" in fault
    assert list(tmp_path.iterdir()) == [joined]


def test_a_folder_stands_for_all_below_but_what_is_being_made(run: Run, tmp_path: Path):
    for name in ("b/c/two.rrd", "one.rrd", ".scratch/hidden.rrd", "b/.part.rrd", "b/note.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(run.files["two" in name].read_bytes())
    assert recordings_below(tmp_path) == [tmp_path / "b/c/two.rrd", tmp_path / "one.rrd"]
    (found,) = open_recordings([tmp_path]).recordings
    assert found.frames.seq.tolist() == [*run.seqs[0], *run.seqs[1]]
