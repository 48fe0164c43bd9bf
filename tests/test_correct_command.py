"""``gripmon correct``: what it writes, read back by others, and what it says of input that is no use."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from gripmon.analyse.api import correct
from gripmon.cli import main
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.records import Drift, FrameRecord, Origin, Smoothed, State, Transform, Verdict, to_json

PERIOD_NS = 16_666_667
START_NS = 1_700_000_000_000_000_000
SIGMA = np.array([4e-6, 5e-6, 2e-5, 5e-4, 2.5e-4, 2e-4])
FRAMES, STEP_SEQ, STEP_M = 400, 220, 3e-4


def record(seq: int, xi: np.ndarray, measured: bool = True) -> FrameRecord:
    position = (np.array([0.001, -0.002, 0.115]) + xi[:3]).tolist()
    rotation = Rotation.from_rotvec(xi[3:]).as_quat(canonical=True).tolist()
    covariance = tuple(np.diag(SIGMA**2).ravel().tolist())
    return FrameRecord(
        seq=seq,
        stamp_ns=START_NS + seq * PERIOD_NS,
        verdict=Verdict.VALID,
        state=State.TRACKING,
        source=Origin.UPDATE if measured else Origin.HELD,
        cam_T_grip=Transform(tuple(position), tuple(rotation)),
        covariance=covariance,
        smoothed=Smoothed(tuple(position), tuple(rotation), covariance),
        drift=Drift(0.0, 0.0, (0.0, 0.0, 0.0)),
        reference_id="r",
        revision=0,
        rms_px=0.2,
        jaw_opening_m=None,
        corners=(),
        alerts=(),
        reason=None if measured else "hidden",
    )


@pytest.fixture
def estimates(tmp_path: Path) -> Path:
    """A step of 0.3 mm along y at frame 220, frames 100 to 109 held."""
    rng = np.random.default_rng(1)
    path = tmp_path / "estimates.jsonl"
    with path.open("wb") as file:
        for seq in range(FRAMES):
            xi = rng.normal(size=6) * SIGMA * 0.5
            xi[1] += STEP_M * (seq >= STEP_SEQ)
            file.write(to_json(record(seq, xi, not 100 <= seq < 110)) + b"\n")
    return path


def test_json_lines_have_a_line_a_frame_and_say_where_they_come_from(estimates: Path, tmp_path: Path, capsys):
    out = tmp_path / "new" / "corrected.jsonl"
    assert main(["correct", str(estimates), "--out", str(out)]) == 0
    about, *frames = [json.loads(line) for line in out.read_text().splitlines()]
    assert about["inputs"] == [[estimates.name, hashlib.sha256(estimates.read_bytes()).hexdigest()]]
    (run,) = about["runs"]
    (point,) = run["change_points"]
    assert point["seq"] == STEP_SEQ
    assert point["size"][1] == pytest.approx(STEP_M, abs=5e-6)
    assert [frame["seq"] for frame in frames] == list(range(FRAMES))
    assert {frame["source"] for frame in frames[100:110]} == {"gap"}
    y = np.array([frame["cam_T_grip"]["translation_m"][1] for frame in frames])
    assert np.abs(y + 0.002 - STEP_M * (np.arange(FRAMES) >= STEP_SEQ)).max() < 2.5e-6
    assert all(len(frame["covariance"]) == 36 for frame in frames)
    said = capsys.readouterr().out
    assert f"frame {STEP_SEQ}" in said
    # 9.3 deviations of the axis that is known least.
    assert run["missable_m"] == pytest.approx(9.3 * SIGMA[2], rel=0.02) and run["undecided_ns"] == []
    assert "steps of up to 0.187 mm may be missing" in said


def test_parquet_holds_the_same(estimates: Path, tmp_path: Path):
    lines, table = tmp_path / "c.jsonl", tmp_path / "c.parquet"
    assert main(["correct", str(estimates), "--out", str(lines)]) == 0
    assert main(["correct", str(estimates), "--out", str(table)]) == 0
    read = pq.read_table(table)
    about, *frames = [json.loads(line) for line in lines.read_text().splitlines()]
    assert json.loads(read.schema.metadata[b"gripmon"]) == about
    assert read["stamp_ns"].to_pylist() == [frame["stamp_ns"] for frame in frames]
    assert read["source"].to_pylist() == [frame["source"] for frame in frames]
    assert read["covariance"].to_pylist() == [frame["covariance"] for frame in frames]
    for k, axis in enumerate("xyz"):
        assert read[f"translation_{axis}_m"].to_pylist() == [f["cam_T_grip"]["translation_m"][k] for f in frames]


def test_the_track_lies_on_the_recordings_timelines(estimates: Path, tmp_path: Path):
    from rerun.chunk import RrdReader

    lines, track = tmp_path / "c.jsonl", tmp_path / "c.rrd"
    assert main(["correct", str(estimates), "--out", str(lines)]) == 0
    assert main(["correct", str(estimates), "--out", str(track)]) == 0
    frames = [json.loads(line) for line in lines.read_text().splitlines()[1:]]
    found: dict[str, list] = {}
    for chunk in RrdReader(track).stream().to_chunks():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    (batch,) = [b for b in found["/rig/corrected"] if "frame" in b.schema.names]
    assert batch.column("frame").to_pylist() == list(range(FRAMES))
    assert batch.column("capture_time").cast("int64").to_pylist() == [f["stamp_ns"] for f in frames]
    written = np.array([row[0] for row in batch.column("Transform3D:translation").to_pylist()])
    np.testing.assert_allclose(written, [f["cam_T_grip"]["translation_m"] for f in frames], atol=1e-7)
    assert any(STEP_SEQ in b.column("frame").to_pylist() for b in found["/corrected/events"])
    assert "/corrected/raw_shift_mm" in found and "/corrected/smoothed_shift_mm" in found


def test_several_runs_get_a_track_each_and_replace_nothing(estimates: Path, tmp_path: Path, capsys):
    from rerun.chunk import RrdReader

    again = tmp_path / "again.jsonl"
    again.write_bytes(b"".join(estimates.read_bytes().splitlines(keepends=True)[:300]))
    arguments = ["correct", str(estimates), str(again), "--out", str(tmp_path / "c.rrd")]
    assert main(arguments) == 0
    written = sorted(tmp_path.glob("*.rrd"))
    assert [path.name for path in written] == ["c-1.rrd", "c-2.rrd"]
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("written")] == [
        f"written: {path}" for path in written
    ]
    assert len({RrdReader(path).recordings()[0].recording_id for path in written}) == 2
    before = [path.read_bytes() for path in written]
    code, said = failed(arguments, capsys)
    assert code == 2 and said.count("\n") == 1 and str(written[0]) in said
    assert [path.read_bytes() for path in written] == before and sorted(tmp_path.glob("*.rrd")) == written


def test_a_full_disk_leaves_what_was_there(estimates: Path, tmp_path: Path):
    """A limit on a file's length, in a process of its own, stands for the disk's end."""
    out = tmp_path / "c.rrd"
    out.write_bytes(b"an earlier one")
    limited = (
        "import resource, signal, sys\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "from gripmon.cli import main\n"
        "sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", limited, "correct", str(estimates), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 3 and "Traceback" not in done.stderr
    assert f"--out {out}: writing failed" in done.stderr.splitlines()[-1]
    assert out.read_bytes() == b"an earlier one"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([out.name, estimates.name])


def test_given_instants(estimates: Path, tmp_path: Path, capsys):
    stamps = tmp_path / "shots.csv"
    wanted = [START_NS + 50 * PERIOD_NS, START_NS + 50 * PERIOD_NS + 1_000_000, START_NS - 5]
    stamps.write_text("shot,stamp_ns\n" + "".join(f"{k},{stamp}\n" for k, stamp in enumerate(wanted)))
    out = tmp_path / "c.jsonl"
    assert main(["correct", str(estimates), "--out", str(out), "--stamps", str(stamps)]) == 0
    frames = [json.loads(line) for line in out.read_text().splitlines()[1:]]
    assert [(f["seq"], f["stamp_ns"], f["source"]) for f in frames] == [
        (50, wanted[0], "smoothed"),
        (-1, wanted[1], "between"),
    ]
    assert "1 of 3 capture times lie in no recording" in capsys.readouterr().err


def test_as_a_function_it_gives_the_values_that_the_command_writes(estimates: Path, tmp_path: Path):
    done = correct([estimates])
    (run,) = done.runs
    assert (done.written, done.faults) == ((), ()) and list(tmp_path.iterdir()) == [estimates]
    out = tmp_path / "c.parquet"
    assert main(["correct", str(estimates), "--out", str(out)]) == 0
    table = pq.read_table(out)
    np.testing.assert_array_equal(run.correction.cam_T_grip[:, 1, 3], table["translation_y_m"].to_numpy())
    stamps = tmp_path / "shots.csv"
    stamps.write_text(f"stamp_ns\n{START_NS + 1}\n")
    (asked,) = correct([estimates], stamps=stamps).runs
    assert asked.wanted_ns is not None and asked.wanted_ns.tolist() == [START_NS + 1]
    with pytest.raises(InputError, match="there is no such file"):
        correct([tmp_path / "none.rrd"])
    stamps.write_text("stamp_ns\n5\n")
    with pytest.raises(NoResultError, match="none of the capture times"):
        correct([estimates], stamps=stamps)


def failed(arguments: list[str], capsys) -> tuple[int, str]:
    with pytest.raises(SystemExit) as stopped:
        raise SystemExit(main(arguments))
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return stopped.value.code, said


@pytest.mark.parametrize(
    ("out", "stamps", "says"),
    [
        ("c.txt", None, "one of .jsonl, .parquet, .rrd"),
        ("estimates.jsonl", None, "different files"),
        ("c.rrd", "stamp_ns\n1\n", "--stamps"),
        ("c.jsonl", "time\n1\n", "no column stamp_ns"),
        ("c.jsonl", "stamp_ns\n12.5\n", "line 2: '12.5'"),
        ("c.jsonl", "stamp_ns\n99999999999999999999\n", "line 2"),
        ("c.jsonl", "stamp_ns\n", "no capture times"),
        ("c.jsonl", "stamp_ns\n1,718,000\n", "line 2 has 3 values; 1"),
        ("c.jsonl", "stamp_ns,other\n1\n", "line 2 has 1 values; 2"),
        ("c.jsonl", "stamp_ns,stamp_ns\n1,2\n", "several columns stamp_ns"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(estimates: Path, tmp_path: Path, capsys, out, stamps, says):
    before = estimates.read_bytes()
    arguments = ["correct", str(estimates), "--out", str(tmp_path / out)]
    if stamps is not None:
        (tmp_path / "s.csv").write_text(stamps)
        arguments += ["--stamps", str(tmp_path / "s.csv")]
    code, said = failed(arguments, capsys)
    assert code == 2 and says in said and said.count("\n") == 1
    assert estimates.read_bytes() == before


def test_a_missing_recording_is_wrong_usage(tmp_path: Path, capsys):
    code, said = failed(["correct", str(tmp_path / "no.rrd"), "--out", str(tmp_path / "c.jsonl")], capsys)
    assert code == 2 and "there is no such file" in said


def test_nothing_measured_is_exit_code_3_and_leaves_no_file(tmp_path: Path, capsys):
    held, rubbish = tmp_path / "held.jsonl", tmp_path / "rubbish.rrd"
    held.write_bytes(b"".join(to_json(record(seq, np.zeros(6), False)) + b"\n" for seq in range(20)))
    rubbish.write_bytes(b"no recording at all" * 50)
    (tmp_path / "folder").mkdir()
    for path, expected, says in (
        (held, 3, "nothing was measured"),
        (rubbish, 3, "is not a rerun recording"),
        (tmp_path / "folder", 2, "holds no .rrd file"),
    ):
        out = tmp_path / "c.jsonl"
        code, said = failed(["correct", str(path), "--out", str(out)], capsys)
        assert code == expected and says in said and path.name in said
        assert said.count("\n") == 1 or path == held
        assert not out.exists()
