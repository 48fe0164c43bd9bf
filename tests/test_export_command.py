"""``gripmon export`` on recordings that the recorder wrote, whole and damaged, asked with DuckDB."""

from __future__ import annotations

import dataclasses
import random
import shutil
from pathlib import Path

import duckdb
import msgspec
import pytest
from support.loopback import WAIT_S, state_record
from support.recorded import INTERVAL_NS, frame, record, recorder, trace, wait_until

from gripmon.cli import main
from gripmon.model.records import Alert, AlertKind, Cause, FrameRecord, Severity, State, to_json
from gripmon.record.read import open_recordings

COUNT = 400
MIDNIGHT_NS = 20_526 * 86_400_000_000_000  # 2026-03-14
STEP = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.ERROR, "moved by 4.5 mm")


def told(i: int) -> FrameRecord:
    """Midnight is between 149 and 150; a step at 200."""
    stamp_ns = MIDNIGHT_NS + (i - 150) * INTERVAL_NS
    state = State.TRACKING if i < 200 else State.DRIFTING
    return record(i, state, alerts=(STEP,) if i == 200 else (), stamp_ns=stamp_ns)


def bytes_in(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*.rrd"))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in two files at least."""
    folder = tmp_path_factory.mktemp("recordings")
    opened = recorder(folder, patience_s=30.0, image_rate_hz=0.0, max_file_bytes=100_000)
    for i in range(COUNT):
        if i % 50 == 0:
            opened.event(msgspec.structs.replace(state_record(i), stamp_ns=told(i).stamp_ns))
        opened.frame(dataclasses.replace(frame(i), stamp_ns=told(i).stamp_ns), told(i), lambda i=i: trace(i))
        if i % 50 == 49:  # so that no file gets all of them at once
            size = bytes_in(folder)
            wait_until(lambda size=size: bytes_in(folder) > size, WAIT_S)
    opened.close(timeout_s=60.0)
    assert len(list(folder.glob("*.rrd"))) >= 2 and opened.dropped == 0
    return folder


def asked(out: Path, what: str, table: str = "frames") -> list[tuple[object, ...]]:
    return duckdb.sql(
        what.replace("FROM it", f"FROM read_parquet('{out}/{table}/**/*.parquet', hive_partitioning = true)")
    ).fetchall()


def contents(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def test_all_that_was_recorded_is_exported_once(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "deep" / "fleet"
    assert main(["export", str(recordings), "--out", str(out)]) == 0
    said = capsys.readouterr()
    assert said.err == "" and f": frames {COUNT}, alerts 1, " in said.out
    rows = asked(out, "SELECT seq, stamp_ns, tcp_shift_y_m, state, robot, camera, date::VARCHAR FROM it ORDER BY time")
    expected = []
    for i in range(COUNT):
        r = told(i)
        assert r.drift
        day = "2026-03-13" if i < 150 else "2026-03-14"
        expected.append((i, r.stamp_ns, r.drift.tcp_shift_m[1], r.state.value, "arm", "wrist", day))
    assert rows == expected
    assert asked(out, "SELECT kind, cause, seq, time = make_timestamp_ns(stamp_ns) FROM it", "alerts") == [
        ("step", "camera_mount_moved", 200, True)
    ]
    assert asked(out, "SELECT seq FROM it ORDER BY time", "states") == [(i,) for i in range(0, COUNT, 50)]
    assert asked(out, "SELECT reference_id, revision, time FROM it", "references") == [("first", 1, None)]

    before = contents(out)
    files = sorted(recordings.glob("*.rrd"))
    assert main(["export", *map(str, reversed(files)), str(recordings), "--out", str(out)]) == 0
    for file in files:  # the others' rows stay, no one misses them, and the newest may be empty yet
        assert main(["export", str(file), "--out", str(out)]) == 0
    assert capsys.readouterr().err == ""
    assert contents(out) == before


def test_a_recording_that_is_cut_short_gives_what_is_left(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for path in recordings.glob("*.rrd"):
        shutil.copy(path, tmp_path)
    cut = max(tmp_path.glob("*.rrd"), key=lambda path: path.stat().st_size)
    cut.write_bytes(cut.read_bytes()[: int(0.3 * cut.stat().st_size)])
    (tmp_path / "rubbish.rrd").write_bytes(random.Random(3).randbytes(5000))
    (tmp_path / "empty.rrd").touch()
    assert main(["export", str(tmp_path), "--out", str(tmp_path / "fleet")]) == 0
    seqs = {row[0] for row in asked(tmp_path / "fleet", "SELECT seq FROM it ORDER BY seq")}
    alone = open_recordings([cut]).recordings
    others = open_recordings([p for p in recordings.glob("*.rrd") if p.name != cut.name]).recordings
    assert seqs == {seq for each in (*alone, *others) for seq in each.frames.seq.tolist()} <= set(range(COUNT))
    lines = capsys.readouterr().err.splitlines()
    assert {line.split(":")[0] for line in lines} == {"export"}
    faulty = {line.split(":")[1].strip() for line in lines}
    assert faulty == {str(tmp_path / n) for n in (cut.name, "rubbish.rrd", "empty.rrd")}


def test_the_estimates_of_a_run_are_exported_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        lines = b"".join(to_json(told(i)) + b"\n" for i in range(20))
        (tmp_path / name / "estimates.jsonl").write_bytes(lines)
    paths = [str(tmp_path / name / "estimates.jsonl") for name in ("one", "two")]
    assert main(["export", *paths, "--out", str(tmp_path / "fleet")]) == 0
    assert asked(tmp_path / "fleet", "SELECT count(*), count(DISTINCT recording_id) FROM it") == [(40, 2)]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["nowhere.rrd", "--out", "fleet"], 2, "nowhere.rrd: there is no such file; recordings of gripmon run"),
        (["none", "--out", "fleet"], 2, "none: no .rrd file in it; recordings of gripmon run"),
        (["rubbish.rrd", "--out", "rubbish.rrd"], 2, "--out rubbish.rrd: can't be made (File exists)"),
        (["rubbish.rrd", "--out", "fleet"], 3, "export: rubbish.rrd: is not a rerun recording"),
    ],
)
def test_what_cannot_be_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    said: str,
):
    monkeypatch.chdir(tmp_path)
    Path("none").mkdir()
    Path("rubbish.rrd").write_bytes(b"no recording at all")
    assert main(["export", *arguments]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(said)
    assert not contents(tmp_path / "fleet")


def test_a_table_that_cannot_be_written_ends_it(recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "frames").write_text("not a folder")
    assert main(["export", str(recordings), "--out", str(tmp_path)]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{tmp_path}: can't be written (") and str(min(recordings.glob("*.rrd"))) in line


def test_nothing_is_left_beside_the_files(recordings: Path, tmp_path: Path):
    assert main(["export", str(recordings), "--out", str(tmp_path)]) == 0
    assert all(name.endswith(".parquet") for name in contents(tmp_path))
