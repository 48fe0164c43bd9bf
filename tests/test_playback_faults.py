"""Recordings in every bad state: what is whole is used, the rest is said in one line that names the file."""

from __future__ import annotations

import os
import shutil
import signal
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from support.playback_runs import (
    Run,
    altered,
    lines,
    messages,
    records_of_a_run,
    table_of,
    write_rrd,
    write_run,
)
from support.recorded import INTERVAL_NS, START_NS, record

from gripmon.model.records import FrameRecord, State, to_json
from gripmon.record import rrd
from gripmon.record.read import Collection, open_recordings
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return write_run(tmp_path_factory.mktemp("run"))


def opened(*paths: Path) -> Recording:
    collection = open_recordings(paths)
    assert collection.faults == ()
    (found,) = collection.recordings
    assert all("\n" not in fault for fault in found.faults)
    return found


def refused(*paths: Path) -> str:
    """The one fault of what can't be used at all."""
    collection = open_recordings(paths)
    assert collection.recordings == ()
    (fault,) = collection.faults
    assert "\n" not in fault
    return fault


def tampered(run: Run, tmp_path: Path, change: bytes | slice, name: str = "tampered.rrd", at: int = 0) -> Path:
    """The run's first file, cut or overwritten."""
    data = bytearray(run.files[0].read_bytes())
    if isinstance(change, slice):
        data = data[change]
    else:
        data[at : at + len(change)] = change
    path = tmp_path / name
    path.write_bytes(data)
    return path


def message_of(path: Path, entity: bytes, number: int) -> tuple[int, int]:
    """Offset and size of an entity's chunk, told by the footer."""
    from rerun.chunk import RrdReader

    batch = RrdReader(path).store()._chunk_index().to_arrow()
    rows = [i for i, name in enumerate(batch.column("chunk_entity_path").to_pylist()) if name == entity.decode()]
    offsets = sorted(batch.column("chunk_byte_offset")[i].as_py() - 16 for i in rows)
    return next((offset, size) for _, offset, size in messages(path.read_bytes()) if offset == offsets[number])


@pytest.mark.parametrize("share", [0.1, 0.9])
def test_cut_in_the_middle_of_a_message(run: Run, tmp_path: Path, share: float):
    """What is there is exactly what lies in whole messages before the cut."""
    data = run.files[0].read_bytes()
    first, _ = message_of(run.files[0], b"/record", 0)
    whole = [m for m in messages(data) if m[0] == 2 and m[1] > first]
    _, offset, size = whole[int(share * len(whole))]
    path = tampered(run, tmp_path, slice(0, offset + size // 2))
    before = path.read_bytes()
    collection = open_recordings([path])
    (found,) = collection.recordings
    assert [to_json(r) for r in found.records()] == [to_json(r) for r in run.records[: len(found.frames)]]
    cut = [fault for fault in found.faults if "is cut short in the middle of a message" in fault]
    assert len(cut) == 1 and cut[0].startswith(str(path)) and f"byte {offset + size // 2}" in cut[0]
    for seq in found.image_seqs.tolist():
        picture = found.picture(seq)
        assert picture is not None and picture.stamp_ns == run.records[seq].stamp_ns
    assert path.read_bytes() == before


def test_cut_anywhere_never_raises(run: Run, tmp_path: Path):
    size = run.files[0].stat().st_size
    counts = []
    for end in [1, 5, 11, 12, 13, 27, 28, 100, 500, 5000, *np.linspace(6000, size - 1, 6).astype(int).tolist()]:
        collection = open_recordings([tampered(run, tmp_path, slice(0, end))])
        said = [*collection.faults, *(fault for r in collection.recordings for fault in r.faults)]
        assert said and all(fault.startswith(str(tmp_path)) and "\n" not in fault for fault in said)
        counts.append(sum(len(r.frames) for r in collection.recordings))
    assert counts == sorted(counts) and counts[-1] == len(run.seqs[0])


@pytest.mark.parametrize("footer", [True, False])
def test_a_damaged_message_costs_its_own_frames_only(run: Run, tmp_path: Path, footer: bool):
    offset, size = message_of(run.files[0], b"/record", -1)
    path = tampered(run, tmp_path, b"\x5a" * (size // 2), at=offset + size // 3)
    if not footer:
        data = path.read_bytes()
        end = next(offset for kind, offset, _ in messages(data) if kind == 0)
        path.write_bytes(data[:end])
    others = opened(run.files[0], *run.files[1:])
    found = opened(path, *run.files[1:])
    lost = set(others.frames.seq.tolist()) - set(found.frames.seq.tolist())
    assert lost and lost <= set(run.seqs[0])
    assert any(fault.startswith(str(path)) and "1 damaged message" in fault for fault in found.faults)
    assert [r.seq for r in found.records()] == found.frames.seq.tolist()


def test_random_damage_never_raises_and_loses_nothing_silently(run: Run, tmp_path: Path):
    """Bytes overwritten and cut out anywhere, in a process that native code would end if it were given them."""
    rng = np.random.default_rng(20)
    whole = run.files[0].read_bytes()
    for _ in range(16):
        data = bytearray(whole)
        at = int(rng.integers(0, len(data)))
        if rng.random() < 0.7:
            data[at : at + 2000] = rng.integers(0, 256, len(data[at : at + 2000]), np.uint8).tobytes()
        else:
            del data[at : at + int(rng.integers(1, 50_000))]
        path = tmp_path / "damaged.rrd"
        path.write_bytes(data)
        collection = open_recordings([path])
        frames = sum(len(list(r.records())) for r in collection.recordings)
        shots = [shot for r in collection.recordings for _, shot in r.with_shots(r.frames.seq) if shot is not None]
        said = [*collection.faults, *(fault for r in collection.recordings for fault in r.faults)]
        assert all(fault.startswith(str(path)) and "\n" not in fault for fault in said)
        assert frames <= len(run.seqs[0]) and len(shots) <= len(run.seqs[0])
        assert frames == len(run.seqs[0]) or said


def test_a_damaged_frame_around_messages_ends_the_reading_there(run: Run, tmp_path: Path):
    data = run.files[0].read_bytes()
    end = next(offset for kind, offset, _ in messages(data) if kind == 0)
    offset, _ = message_of(run.files[0], b"/rig/camera/image", -1)
    path = tampered(run, tmp_path, b"\xff" * 16, at=offset)
    path.write_bytes(path.read_bytes()[:end])
    assert any(f"is damaged at byte {offset}" in fault for fault in opened(path).faults)


def test_rerun_of_a_newer_version(run: Run, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    path = tampered(run, tmp_path, bytes([0, 99, 0, 0]), at=4)
    found = opened(path)
    assert found.frames.seq.tolist() == run.seqs[0]
    (fault,) = found.faults
    assert fault.startswith(f"{path}: was written by rerun 0.99.0, newer than")
    assert found.picture(int(found.image_seqs[0])) is not None
    assert capfd.readouterr().err == ""  # rerun's own reader would say so for every block


def test_names_that_a_later_version_adds(run: Run, tmp_path: Path):
    """More fields, a state and an origin that aren't known here: the same major version."""
    meta = altered(to_json(opened(*run.files).meta), colour="blue")
    newer = {"wind_m_s": 3.0, "state": "dreaming", "source": "oracle"}
    texts = [altered(text, **newer) for text in lines(*records_of_a_run(0, 50))]
    path = write_rrd(tmp_path / "newer.rrd", texts, meta=meta)
    found = opened(path)
    expected = table_of(records_of_a_run(0, 50))
    assert np.array_equal(found.frames.cam_T_grip, expected.cam_T_grip, equal_nan=True)
    assert {FrameTable.STATES[code] for code in found.frames.state} == {"other"}
    assert {str(r.state) for r in found.records()} == {"dreaming"} and [a.seq for a in found.alerts] == [40]
    assert found.faults == (f"{path}: has frames with a state or source that this version doesn't know",)


@pytest.mark.parametrize("changes", [{"schema": "gripmon.transform/3"}, {"verdict": "perhaps"}, {"revision": 2**64}])
def test_records_of_another_major_version_are_left_out(tmp_path: Path, changes: dict[str, object]):
    """What isn't known to mean the same isn't used."""
    texts = lines(*records_of_a_run(0, 6))
    found = opened(write_rrd(tmp_path / "newer.rrd", [*texts[:3], *[altered(text, **changes) for text in texts[3:]]]))
    assert found.frames.seq.tolist() == [0, 1, 2] == [r.seq for r in found.records()]
    (fault,) = found.faults
    assert "newer.rrd: has 3 of record that can't be understood (" in fault


def test_records_that_are_broken(tmp_path: Path):
    texts = [to_json(record(i)).decode() for i in range(10)]
    texts[3] = texts[3][:100]
    texts[5] = "[1, 2]"
    texts[7] = texts[7].replace('"stamp_ns":', '"stamp_ns":1e400,"x":')
    texts[8] = altered(texts[8].encode(), seq="eight").decode()
    found = opened(write_rrd(tmp_path / "broken.rrd", texts))
    assert found.frames.seq.tolist() == [0, 1, 2, 4, 6, 9] == [r.seq for r in found.records()]
    assert any("4 of record that can't be understood" in fault for fault in found.faults)
    assert any("4 frames of the run are missing in 3 places" in fault for fault in found.faults)


def test_time_that_runs_backwards(tmp_path: Path):
    records = [record(i, stamp_ns=START_NS + i * INTERVAL_NS - (5_000_000_000 if i >= 12 else 0)) for i in range(20)]
    path = write_rrd(tmp_path / "back.rrd", lines(*records))
    found = opened(path)
    assert found.frames.seq.tolist() == list(range(20))
    (fault,) = found.faults
    assert fault.startswith(f"{path}: time runs backwards by 4.98 s at frame 12;")


def test_a_missing_file_in_the_middle(run: Run):
    found = opened(run.files[0], *run.files[2:])
    assert found.frames.seq.tolist() == [seq for number, seqs in enumerate(run.seqs) if number != 1 for seq in seqs]
    first, second = found.faults
    assert first.startswith(f"{run.files[2]}: is file 3 of its run, and number 2 is not there")
    lost = f"{len(run.seqs[1])} frames of the run are missing in one place after frame {run.seqs[0][-1]}"
    assert second.startswith(f"{run.files[0]}: {lost}")


def test_files_that_overlap(run: Run, tmp_path: Path):
    """A merged file beside the ones it was made of: every frame once, with a word about it."""
    copy = Path(shutil.copy(run.files[0], tmp_path / "zz.rrd"))
    found = opened(copy, *run.files)
    assert [to_json(r) for r in found.records()] == [to_json(r) for r in run.records]
    (fault,) = found.faults
    assert (
        f"{len(run.seqs[0])} of its frames stand in" in fault
        and "each was used once" in fault
        and "differ" not in fault
    )
    assert len(found.references) == 2 and len(found.commands) == 1


def test_two_records_under_one_number(tmp_path: Path):
    one = write_rrd(tmp_path / "one.rrd", lines(*[record(i) for i in range(10)]))
    moved = [record(i, stamp_ns=START_NS + 9 * INTERVAL_NS + i) for i in range(9, 15)]
    other = write_rrd(tmp_path / "two.rrd", lines(*moved))
    found = opened(other, one)
    assert found.frames.seq.tolist() == list(range(15))
    assert found.frames.stamp_ns[9] == record(9).stamp_ns
    assert any("two.rrd: 1 of its frames stand in one.rrd, too" in f and "1 differ" in f for f in found.faults)


def test_the_same_file_under_two_names(run: Run, tmp_path: Path):
    link = tmp_path / "link.rrd"
    link.symlink_to(run.files[0])
    collection = open_recordings([run.files[0], link, run.files[0]])
    assert collection.recordings[0].frames.seq.tolist() == run.seqs[0]
    assert collection.faults == (
        f"{link}: is the same file as {run.files[0]}; read once",
        f"{run.files[0]}: is the same file as {run.files[0]}; read once",
    )


def test_what_is_no_recording_of_ours(tmp_path: Path):
    empty, picture, lone = tmp_path / "empty.rrd", tmp_path / "picture.rrd", tmp_path / "text.jsonl"
    empty.touch()
    picture.write_bytes(cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
    lone.write_text("hello\nworld\n")
    foreign = write_rrd(tmp_path / "foreign.rrd", application="arm_viewer")
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    assert refused(empty) == f"{empty}: is empty; not used"
    assert refused(picture) == f"{picture}: is not a rerun recording, whatever its name says; not used"
    assert refused(lone).startswith(f"{lone}: holds no frame records")
    assert "the application 'arm_viewer' that holds no frames of a monitor's; not used" in refused(foreign)
    assert refused(nothing).startswith(f"{nothing}: holds no .rrd file")
    assert refused(tmp_path / "gone.rrd") == f"{tmp_path / 'gone.rrd'}: No such file or directory; not used"
    assert open_recordings([]) == Collection((), ())


def test_a_file_that_may_not_be_read(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As root nothing is forbidden to open: the refusal itself is played."""
    locked = Path(shutil.copy(run.files[0], tmp_path / "locked.rrd"))
    locked.chmod(0)
    if os.access(locked, os.R_OK):
        really = Path.open

        def refusing(self: Path, *arguments: object, **named: object) -> object:
            if self == locked:
                raise PermissionError(13, "Permission denied", str(locked))
            return really(self, *arguments, **named)  # type: ignore[call-overload]

        monkeypatch.setattr(Path, "open", refusing)
    assert refused(locked) == f"{locked}: Permission denied; not used"


def test_one_bad_file_does_not_spoil_the_others(run: Run, tmp_path: Path):
    for path in run.files:
        shutil.copy(path, tmp_path)
    (tmp_path / "a.rrd").touch()
    write_rrd(tmp_path / "b.rrd", application="other")
    collection = open_recordings([tmp_path])
    assert [len(r.frames) for r in collection.recordings] == [len(run.records)]
    assert len(collection.faults) == 2


def test_a_file_that_vanishes_after_opening(run: Run, tmp_path: Path):
    copies = [Path(shutil.copy(path, tmp_path)) for path in run.files]
    found = opened(*copies)
    seqs = found.image_seqs.tolist()
    copies[0].unlink()
    assert found.picture(seqs[0]) is None
    assert [r.seq for r in found.records()] == [seq for seqs in run.seqs[1:] for seq in seqs]
    # An image from the ring may lie in the file after its frame's.
    assert sorted(found.images()) == opened(*copies[1:]).image_seqs.tolist()


def test_files_that_do_not_say_what_they_are(tmp_path: Path):
    """rerun's recording id keeps runs apart."""
    records = [record(i, state=State.TRACKING) for i in range(6)]
    write_rrd(tmp_path / "x-0001.rrd", lines(*records[:3]), recording_id="x")
    write_rrd(tmp_path / "x-0002.rrd", lines(*records[3:]), recording_id="x")
    write_rrd(tmp_path / "y-0001.rrd", lines(*records[:2]), recording_id="y")
    found = {r.recording_id: r for r in open_recordings([tmp_path]).recordings}
    assert {name: len(r.frames) for name, r in found.items()} == {"x": 6, "y": 2}
    assert found["x"].meta is None and (found["x"].robot, found["x"].camera) == ("unknown", "unknown")
    assert [msgspec.json.decode(to_json(r), type=FrameRecord) for r in found["x"].records()] == records


def test_bytes_that_end_the_process_which_reads_them_cost_nothing_else(run: Run):
    """As rerun's native code ends it on some damaged files: played by a signal, while records and images are read."""
    (found,) = open_recordings(run.files).recordings
    seqs = []
    for again, shot in found.with_shots(found.frames.seq):
        if again.seq == run.seqs[1][0]:
            pid = rrd.child_process().pid
            os.kill(pid, signal.SIGABRT)
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        seqs.append((again.seq, shot is not None))
    assert seqs == [(r.seq, r.seq in found.images()) for r in run.records]
    (fault,) = found.faults
    assert fault.startswith(f"{run.files[1]}: can't be read by its footer (rerun's reader ended with signal 6); its")
