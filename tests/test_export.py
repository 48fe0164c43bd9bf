"""Parquet files, asked by engines that know nothing of gripmon."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import duckdb
import msgspec
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from support import sample_messages
from support.loopback import frame_record, reference_record, state_record
from support.playback_runs import table_of

from gripmon.model.records import (
    AlertEvent,
    AlertRecord,
    Cause,
    CommandName,
    Drift,
    FrameRecord,
    ReferenceRecord,
    StateRecord,
    Verdict,
)
from gripmon.model.records.recorded import Meta, RecordedCommand
from gripmon.record.export import ROWS_A_GROUP, Exporter
from gripmon.record.parquet import SCHEMAS
from gripmon.record.table import FrameTable

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
DUCKDB, POLARS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
DAY_NS = 86_400_000_000_000
MIDNIGHT_NS = 20_526 * DAY_NS  # 2026-03-14
MILLISECOND_NS = 1_000_000


@dataclass
class Run:
    """One file of a recording, as it would be read."""

    records: list[FrameRecord]
    robot: str = "arm1"
    camera: str = "wrist"
    recording_id: str = "run-1"
    file_number: int = 0
    alerts: tuple[AlertRecord, ...] = ()
    states: tuple[StateRecord, ...] = ()
    commands: tuple[RecordedCommand, ...] = ()
    references: tuple[ReferenceRecord, ...] = ()
    path: Path = field(default=Path("run.rrd"))

    @property
    def frames(self) -> FrameTable:
        return table_of(self.records)

    @property
    def meta(self) -> Meta:
        return Meta(
            "run", self.recording_id, self.robot, self.camera, "two_box", "0", self.file_number, 0, "", has_truth=False
        )


def moving(
    count: int, start_ns: int = MIDNIGHT_NS + DAY_NS // 2, period_ns: int = 100 * MILLISECOND_NS
) -> list[FrameRecord]:
    """Frames in which no two are alike; every seventh knows nothing."""
    nothing = dict.fromkeys(("cam_T_grip", "covariance", "smoothed", "drift", "protection"))
    nothing |= {"verdict": Verdict.UNKNOWN}
    return [
        frame_record(
            seq,
            stamp_ns=start_ns + seq * period_ns,
            latency_ns=1_000_000 + 1000 * seq,
            **(nothing if seq % 7 == 6 else {"drift": Drift(1e-6 * seq, 2e-6 * seq, (3e-6 * seq, -4e-6 * seq, 0.0))}),
        )
        for seq in range(count)
    ]


def alert(stamp_ns: int, event: AlertEvent, **more: object) -> AlertRecord:
    sample = sample_messages.SAMPLES["alert"]
    assert isinstance(sample, AlertRecord)
    return msgspec.structs.replace(sample, stamp_ns=stamp_ns, event=event, **more)


def export(out: Path, *runs: Run) -> Exporter:
    exporter = Exporter(out)
    for run in runs:
        exporter.add(run, run.path)
    return exporter


def files(out: Path, table: str = "frames") -> list[str]:
    return sorted(str(path.relative_to(out / table)) for path in (out / table).rglob("*") if path.is_file())


def frames_of(out: Path) -> pa.Table:
    return ds.dataset(out / "frames", partitioning="hive").to_table().sort_by("seq")


def test_every_number_of_a_frame_arrives(tmp_path: Path):
    records = moving(20)
    export(tmp_path, Run(records))
    rows = frames_of(tmp_path)
    columns = {name: rows[name].to_pylist() for name in rows.column_names if name != "time"}
    for i, record in enumerate(records):
        row = {name: values[i] for name, values in columns.items()}
        assert (row["seq"], row["stamp_ns"], row["latency_ns"]) == (record.seq, record.stamp_ns, record.latency_ns)
        assert rows["time"][i].value == record.stamp_ns
        assert (row["verdict"], row["state"], row["source"]) == (record.verdict, record.state, record.source)
        assert (row["reference_id"], row["revision"]) == ("plate-2", 3)
        assert (row["rms_px"], row["jaw_opening_m"]) == (0.0625, 0.034)
        assert (row["corners_used"], row["corners_total"], row["refused"]) == (1, 1, record.cam_T_grip is None)
        assert (row["recording_id"], row["file_number"], row["robot"], row["camera"]) == ("run-1", 0, "arm1", "wrist")
        pose = [row[f"cam_T_grip_{part}"] for part in ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")]
        smoothed = [row[f"smoothed_{part}"] for part in ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")]
        shift = [row[f"tcp_shift_{axis}_m"] for axis in "xyz"]
        sigma = [row[f"sigma_{axis}_m"] for axis in "xyz"]
        if record.cam_T_grip is None:
            assert pose == smoothed == [None] * 7 and shift == sigma == [None] * 3
            assert row["protection_m"] is row["protection_rad"] is row["integrity_risk"] is None
            assert row["covariance"] is row["smoothed_covariance"] is row["d_m"] is row["delta_rad"] is None
            continue
        assert record.smoothed and record.drift and record.covariance
        assert pose == [*record.cam_T_grip.translation_m, *record.cam_T_grip.rotation_xyzw]
        assert smoothed == [*record.smoothed.translation_m, *record.smoothed.rotation_xyzw]
        assert [row["d_m"], row["delta_rad"], *shift] == [
            record.drift.translation_m, record.drift.rotation_rad, *record.drift.tcp_shift_m,
        ]  # fmt: skip
        assert [row["protection_m"], row["protection_rad"], row["integrity_risk"]] == [0.00045, 0.0055, 1e-5]
        assert sigma == pytest.approx([math.sqrt(record.covariance[7 * k]) for k in range(3)])
        for name, flat in (("covariance", record.covariance), ("smoothed_covariance", record.smoothed.covariance)):
            assert row[name] == [flat[6 * i + j] for i in range(6) for j in range(i, 6)]


def test_the_page_rebuilds_a_covariance():
    (recipe,) = re.findall(r"In NumPy: `([^`]+)`", PAGE)
    whole = np.array(sample_messages.covariance(1e-5, 1e-4)).reshape(6, 6)
    names = {"np": np, "row": [whole[i, j] for i in range(6) for j in range(i, 6)]}
    exec(recipe, names)
    np.testing.assert_array_equal(names["C"], whole)


def test_a_run_across_midnight_is_of_two_days_and_sorted_by_time(tmp_path: Path):
    records = moving(30, MIDNIGHT_NS - 10 * 1000 * MILLISECOND_NS, 1000 * MILLISECOND_NS)
    shuffled = [*records[20:], *records[:20]]  # a clock that was set back
    states = tuple(msgspec.structs.replace(state_record(r.seq), stamp_ns=r.stamp_ns) for r in shuffled[::5])
    export(tmp_path, Run(shuffled, states=states))
    first, second = (f"robot=arm1/camera=wrist/date=2026-03-{day}/run-1-0000.parquet" for day in (13, 14))
    assert files(tmp_path) == files(tmp_path, "states") == [first, second]
    assert pq.read_table(tmp_path / "frames" / first)["seq"].to_pylist() == list(range(10))
    assert pq.read_table(tmp_path / "frames" / second)["seq"].to_pylist() == list(range(10, 30))
    assert pq.read_table(tmp_path / "states" / second)["seq"].to_pylist() == [10, 15, 20, 25]
    assert not (tmp_path / "alerts").exists()  # nothing is no file


def test_again_is_the_same_bytes_and_a_longer_file_takes_the_place_of_the_shorter(tmp_path: Path):
    short, long = Run(moving(50)), Run(moving(80))
    export(tmp_path, short, Run(moving(30), file_number=1), Run(moving(7), recording_id="run-2"))
    name = tmp_path / "frames" / files(tmp_path)[0]
    before = name.read_bytes()
    export(tmp_path, short)
    assert name.read_bytes() == before
    export(tmp_path, long)
    assert len(files(tmp_path)) == 3
    assert frames_of(tmp_path).num_rows == 80 + 30 + 7


def test_a_copy_of_a_file_is_left_out_and_said(tmp_path: Path):
    exporter = export(tmp_path, Run(moving(50)), Run(moving(20), path=Path("copy.rrd")), Run(moving(50)))
    assert frames_of(tmp_path).num_rows == 50
    assert exporter.faults == ["copy.rrd: the same part of the same run as run.rrd; left out"]


@pytest.mark.parametrize("robot", ["Zelle ü=1%2F", "a&b=c", "räder", "__HIVE", "..", "x" * 60])
def test_names_come_back_as_they_are_in_three_readers(tmp_path: Path, robot: str):
    export(tmp_path / "fleet", Run(moving(3), robot=robot, camera="hand=left", recording_id=f"gripmon {robot}"))
    folder = tmp_path / "fleet" / "frames"
    (row,) = {(r["robot"], r["camera"], r["date"]) for r in ds.dataset(folder, partitioning="hive").to_table(
        columns=["robot", "camera", "date"]).to_pylist()}  # fmt: skip
    assert row == (robot, "hand=left", "2026-03-14")
    query = f"SELECT DISTINCT robot, camera, date FROM read_parquet('{folder}/**/*.parquet', hive_partitioning = true)"
    assert duckdb.sql(query).fetchall() == [(robot, "hand=left", date(2026, 3, 14))]
    seen = pl.scan_parquet(folder / "**/*.parquet", hive_partitioning=True).select("robot", "camera", "date").unique()
    assert seen.collect().rows() == [(robot, "hand=left", date(2026, 3, 14))]


def test_alerts_commands_states_and_references_arrive(tmp_path: Path):
    samples = sample_messages.SAMPLES
    commands = (
        RecordedCommand(MIDNIGHT_NS + 7, 3, CommandName.UNDO, "", done=True, text="back"),
        RecordedCommand(MIDNIGHT_NS + 5, 2, CommandName.ACCEPT, "x", done=False, text="no reference is proposed"),
    )
    references = (sample_messages.CONFIGURED, sample_messages.RECALIBRATED, sample_messages.UNDONE)
    alerts = tuple(samples[name] for name in ("alert", "alert_creep"))
    run = Run(moving(3), alerts=alerts, states=(samples["state"],), commands=commands, references=references)  # type: ignore[arg-type]
    exporter = export(tmp_path, run, Run(moving(3), recording_id="next", references=references))
    assert exporter.rows == {"frames": 6, "alerts": 2, "states": 1, "commands": 2, "references": 3}
    read = {table: ds.dataset(tmp_path / table, partitioning="hive").to_table() for table in SCHEMAS}
    step, creep = read["alerts"].sort_by("time").drop_columns("time").to_pylist()
    if step["kind"] != "step":
        step, creep = creep, step
    moved, creeps = sample_messages.MOVED, sample_messages.CREEPS
    for row, told in ((step, moved), (creep, creeps)):
        for name in ("kind", "cause", "severity", "text", "event", "alert_id", "rotation_rad", "rate_m_per_min",
                     "time_left_s", "since_ns", "acknowledged", "part"):  # fmt: skip
            assert row[name] == getattr(told, name), name
        assert tuple(row[f"tcp_shift_{axis}_m"] for axis in "xyz") == told.tcp_shift_m
        assert [tuple(cause.values()) for cause in row["causes"]] == [msgspec.structs.astuple(c) for c in told.causes]
    (state,) = read["states"].drop_columns("time").to_pylist()
    told_state = samples["state"]
    for name in set(SCHEMAS["states"].names) & set(told_state.__struct_fields__) - {"open_alerts"}:
        assert state[name] == getattr(told_state, name), name
    assert (state["protection_m"], state["alert_limit_m"]) == (3.5e-4, 5e-4)
    assert state["open_alerts"] == 1 and state["tcp_shift_y_m"] == -0.0002
    assert read["commands"]["name"].to_pylist() == ["accept", "undo"]  # by time
    assert read["commands"]["done"].to_pylist() == [False, True]
    rows = {row["reference_id"]: row for row in read["references"].drop_columns("time").to_pylist()}
    for told_reference in references:
        row = rows[told_reference.reference_id]
        for name in ("revision", "origin", "parent", "restores", "cause", "accepted_by"):
            assert row[name] == getattr(told_reference, name), name
        assert row["cam_T_grip_tx_m"] == told_reference.cam_T_grip.translation_m[0]
        assert row["stamp_ns"] == (told_reference.stamp_ns or None)
        assert row["covariance"] == [told_reference.covariance[6 * i + j] for i in range(6) for j in range(i, 6)]
    assert (rows["recalibration-3-1f0c9a2b"]["first_seq"], rows["recalibration-3-1f0c9a2b"]["frames_used"]) == (
        2900,
        20,
    )
    assert rows["config-5f2ac301"]["first_seq"] is None


def test_the_queries_of_the_page_say_what_the_records_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    start_ns = MIDNIGHT_NS - 3000 * MILLISECOND_NS
    records, others = moving(60, start_ns), moving(21, MIDNIGHT_NS)
    # Each alert was raised before its cause was known, and said it then.
    unknown = {"cause": Cause.UNKNOWN, "part": None}
    raised = [alert(start_ns + k * DAY_NS, AlertEvent.RAISED, alert_id=f"1-{k}", **unknown) for k in range(3)]
    known = [alert(start_ns + k * DAY_NS + 3, AlertEvent.UPDATED, alert_id=f"1-{k}") for k in range(3)]
    events = (*raised, *known, alert(start_ns + 5, AlertEvent.CLEARED, alert_id="1-0", **unknown))
    export(
        tmp_path / "fleet",
        Run(records, alerts=events, references=(sample_messages.CONFIGURED, sample_messages.RECALIBRATED)),
        Run(others, robot="arm2", recording_id="run-2", alerts=(raised[0],), references=(reference_record(3),)),
    )
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(DUCKDB, names)
    exec(POLARS, names)
    days = names["days"].fetchall()  # type: ignore[attr-defined]
    expected = []
    for robot, of_day in (("arm1", records[:30]), ("arm1", records[30:]), ("arm2", others)):
        valid = [r for r in of_day if r.verdict is Verdict.VALID]
        largest_m = max(math.hypot(*r.drift.tcp_shift_m) for r in valid if r.drift)
        latency_ms = float(np.quantile([1e-6 * r.latency_ns for r in of_day], 0.99))
        day = date(2026, 3, 13) if of_day[0].stamp_ns < MIDNIGHT_NS else date(2026, 3, 14)
        row = robot, "wrist", day, len(of_day), 100 * len(valid) / len(of_day), 1e3 * largest_m, latency_ms
        expected.append(row)
    assert [row[:4] for row in days] == [row[:4] for row in expected]
    np.testing.assert_allclose([row[4:] for row in days], [row[4:] for row in expected], rtol=1e-9)
    table = names["raised"]
    assert isinstance(table, pl.DataFrame)
    (row,) = table.drop("first", "last").rows()  # arm2's alert names a reference that arm2 has never had
    assert row == ("arm1", "wrist", "step", "camera_mount_moved", "recalibration-3-1f0c9a2b", "recalibration", 3)
    assert table["last"].to_physical().to_list() == [known[2].stamp_ns]
    assert "arm2" in capsys.readouterr().out


@pytest.mark.usefixtures("tools_importable")
def test_the_page_lists_every_column():
    from pages import fields

    _, *tables = fields.page().partition("## Metrics")[0].split("\n## Table ")
    listed = {table.partition("\n")[0]: re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) for table in tables}
    assert listed == {table: schema.names for table, schema in SCHEMAS.items()}
    assert "| `delta_rad` | rad | `drift/delta_deg` | turn of the camera against the reference |" in fields.page()


def test_the_schema_says_units_version_and_itself(tmp_path: Path):
    export(tmp_path, Run(moving(3)))
    schema = pq.read_schema(tmp_path / "frames" / files(tmp_path)[0])
    assert schema.metadata[b"gripmon.schema"] == b"gripmon.export.frames/1" and schema.metadata[b"gripmon.version"]
    units = json.loads(schema.metadata[b"gripmon.units"])
    for name in schema.names:
        for suffix in ("m", "rad", "px", "ns"):
            assert not name.endswith(f"_{suffix}") or units[name] == suffix, name
        assert schema.field(name).metadata[b"description"]


def test_row_groups_let_readers_skip_by_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert ROWS_A_GROUP >= 10_000
    monkeypatch.setattr("gripmon.record.export.ROWS_A_GROUP", 64)
    export(tmp_path, Run(moving(200)))
    about = pq.ParquetFile(tmp_path / "frames" / files(tmp_path)[0]).metadata
    assert [about.row_group(i).num_rows for i in range(about.num_row_groups)] == [64, 64, 64, 8]
    stamps = [about.row_group(i).column(SCHEMAS["frames"].names.index("stamp_ns")).statistics for i in range(4)]
    assert all(before.max < after.min for before, after in itertools.pairwise(stamps))
