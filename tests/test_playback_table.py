"""Columns of frames: values, codes, joining, lines of JSON."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.playback_runs import lines, records_of_a_run, table_of
from support.recorded import record

from gripmon.model.geometry import from_record
from gripmon.model.records import FrameRecord, Origin, State, Verdict, to_json
from gripmon.record.read import open_recordings
from gripmon.record.table import FrameTable, TableBuilder, pose_matrices


@pytest.fixture(scope="module")
def records() -> list[FrameRecord]:
    return records_of_a_run(0, 130)


@pytest.fixture(scope="module")
def table(records: list[FrameRecord]) -> FrameTable:
    return table_of(records)


def test_every_number_stands_in_its_column(records: list[FrameRecord], table: FrameTable):
    assert len(table) == len(records)
    for i, r in enumerate(records):
        assert (table.seq[i], table.stamp_ns[i], table.latency_ns[i]) == (r.seq, r.stamp_ns, r.latency_ns)
        assert FrameTable.VERDICTS[table.verdict[i]] == r.verdict
        assert FrameTable.STATES[table.state[i]] == r.state
        assert FrameTable.ORIGINS[table.source[i]] == r.source
        assert (table.reference_ids[table.reference[i]], table.revision[i]) == (r.reference_id, r.revision)
        assert table.corners_used[i] == sum(corner.used for corner in r.corners)
        assert table.corners_total[i] == len(r.corners)
        assert table.refused[i] == (r.cam_T_grip is None)
        if r.protection is not None:
            bounds = table.protection_m[i], table.protection_rad[i], table.integrity_risk[i]
            assert bounds == (r.protection.position_m, r.protection.rotation_rad, r.protection.risk)
        assert FrameTable.VALID_BY[table.valid_by[i]] == r.valid_by
        if r.since_reference is not None:
            since = r.since_reference
            assert (table.since_reference_m[i], table.since_reference_rad[i]) == (since.position_m, since.rotation_rad)
            assert (FrameTable.SINCE[table.since[i]], table.since_ns[i]) == (since.since, since.since_ns)
        if r.absolute is not None:
            bound = r.absolute
            assert (table.absolute_m[i], table.absolute_rad[i]) == (bound.position_m, bound.rotation_rad)
            assert tuple(table.absolute[i]) == (*bound.translation_m, *bound.rotation_xyzw)
        if r.drift is not None:
            assert table.d_m[i] == r.drift.translation_m and table.delta_rad[i] == r.drift.rotation_rad
            assert tuple(table.tcp_shift_m[i]) == r.drift.tcp_shift_m
        if r.covariance is not None:
            assert np.array_equal(table.covariance[i], np.reshape(r.covariance, (6, 6)))
        if r.smoothed is not None:
            assert tuple(table.smoothed[i]) == (*r.smoothed.translation_m, *r.smoothed.rotation_xyzw)
            assert np.array_equal(table.smoothed_covariance[i], np.reshape(r.smoothed.covariance, (6, 6)))


def test_null_is_not_a_number(records: list[FrameRecord], table: FrameTable):
    for column, name in (
        (table.cam_T_grip[:, 0], "cam_T_grip"),
        (table.covariance[:, 0, 0], "covariance"),
        (table.smoothed[:, 0], "smoothed"),
        (table.smoothed_covariance[:, 0, 0], "smoothed"),
        (table.protection_m, "protection"),
        (table.protection_rad, "protection"),
        (table.integrity_risk, "protection"),
        (table.d_m, "drift"),
        (table.rms_px, "rms_px"),
        (table.jaw_opening_m, "jaw_opening_m"),
    ):
        null = [getattr(r, name) is None for r in records]
        assert any(null) and np.array_equal(np.isnan(column), null), name


def test_a_record_of_schema_1_is_absolute(tmp_path: Path):
    line = msgspec.json.decode(to_json(record(0))) | {"schema": "gripmon.transform/1"}
    for later in ("valid_by", "since_reference", "absolute"):
        line.pop(later)
    path = tmp_path / "earlier.jsonl"
    path.write_bytes(msgspec.json.encode(line) + b"\n")
    (run,) = open_recordings([path]).recordings
    table = run.frames
    assert FrameTable.VALID_BY[table.valid_by[0]] == "absolute" and (table.since[0], table.since_ns[0]) == (-1, -1)
    assert table.absolute_m[0] == table.protection_m[0] and np.array_equal(table.absolute, table.cam_T_grip)


def test_a_suspect_frame_was_measured_and_a_held_one_was_not():
    suspect = record(0, verdict=Verdict.SUSPECT, reason="the TCP may be 0.9 mm off")
    held = msgspec.structs.replace(suspect, source=Origin.HELD, reason="hidden")
    assert table_of([suspect, held]).refused.tolist() == [False, True]
    assert suspect.measured and not held.measured


def test_matrices_are_those_of_the_geometry(records: list[FrameRecord], table: FrameTable):
    matrices = table.matrices()
    for matrix, r in zip(matrices, records, strict=True):
        if r.cam_T_grip is None:
            assert np.isnan(matrix[:3]).all()
        else:
            assert np.allclose(matrix, from_record(r.cam_T_grip), atol=1e-14)
    assert np.isfinite(pose_matrices(table.smoothed)[0]).all() and np.isnan(pose_matrices(table.smoothed)[1, :3]).all()


def test_joining_keeps_each_frames_reference():
    one, two = TableBuilder(), TableBuilder()
    for builder, rows in (
        (one, [record(0, reference_id="a"), record(1, reference_id="b")]),
        (two, [record(2, reference_id="b"), record(3, reference_id="c"), record(4)]),
    ):
        for row in rows:
            builder.add(row)
    joined = TableBuilder.join([one, two])
    assert [joined.reference_ids[i] for i in joined.reference] == ["a", "b", "b", "c", "first"]
    assert joined.seq.tolist() == [0, 1, 2, 3, 4]
    taken = joined.take(np.array([4, 0]))
    assert taken.seq.tolist() == [4, 0] and [taken.reference_ids[i] for i in taken.reference] == ["first", "a"]


def test_no_frames_are_an_empty_table():
    for empty in (table_of([]), TableBuilder.join([])):
        assert len(empty) == 0 and empty.covariance.shape == (0, 6, 6) and empty.matrices().shape == (0, 4, 4)


def test_blocks_make_no_difference():
    """More rows than are gathered at once."""
    many = [record(i % 7, seq=i, reference_id=f"r{i // 3000}") for i in range(9000)]
    table = table_of(iter(many))
    assert table.seq.tolist() == list(range(9000))
    assert [table.reference_ids[i] for i in table.reference[[0, 2999, 3000, 8999]]] == ["r0", "r0", "r1", "r2"]


def test_json_lines_give_the_same_columns(table: FrameTable, records: list[FrameRecord], tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    path.write_bytes(b"\n".join(lines(*records)) + b"\n\n")
    (run,) = open_recordings([path]).recordings
    read = run.frames
    for name, column in vars(table).items():
        if isinstance(column, np.ndarray):
            assert np.array_equal(getattr(read, name), column, equal_nan=column.dtype.kind == "f"), name


def test_a_line_that_is_cut_off(records: list[FrameRecord], tmp_path: Path):
    path = tmp_path / "estimates.jsonl"
    path.write_bytes(b"\n".join(lines(*records[:5]))[:-30])
    (run,) = open_recordings([path]).recordings
    assert run.frames.seq.tolist() == [0, 1, 2, 3]
    (fault,) = run.faults
    assert fault.startswith(f"{path}: has 1 of record that can't be understood")


def test_names_of_every_version_have_a_code():
    newer = record(0, state=State("dreaming"), source=Origin("oracle"), verdict=Verdict.SUSPECT)
    table = table_of([newer])
    assert FrameTable.STATES[table.state[0]] == "other" == FrameTable.ORIGINS[table.source[0]]
    assert set(map(str, State)) < set(FrameTable.STATES) and set(map(str, Verdict)) == set(FrameTable.VERDICTS)
