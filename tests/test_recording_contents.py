"""What each file holds beside images and overlay: numbers with their limits, and what was said, read back."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.recorded import (
    GRIPPER,
    INTERVAL_NS,
    REFERENCE,
    START_NS,
    Recorded,
    frame,
    record,
    recorder,
    trace,
    wait_until,
)

from gripmon import __version__
from gripmon.model.records import (
    Alert,
    AlertEvent,
    AlertKind,
    AlertRecord,
    Cause,
    CommandName,
    FrameRecord,
    Limits,
    Meta,
    MonitorNotes,
    MonitorState,
    RecordedCommand,
    RecordedConfiguration,
    RecordedFile,
    Severity,
    Smoothed,
    State,
    StateRecord,
    Verdict,
)

COUNT = 20
LEARNT_FROM = 5
EARLY = Limits(
    1e-4, 3e-3, 2.5e-3, 0.02, (5e-6,) * 3 + (1e-4,) * 3, None, None, None, (0.5,) * 6, (1e-5,) * 6, 5e-4, 0.02
)
LATE = msgspec.structs.replace(
    EARLY,
    noticed=(1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03),
    offset=(1e-5, -2e-5, 3e-5, 1e-3, -2e-3, 3e-3),
    scatter=(4e-6, 5e-6, 6e-6, 1e-4, 2e-4, 3e-4),
)
RAISED = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.ERROR, "moved", AlertEvent.RAISED, "a-1")
UPDATED = msgspec.structs.replace(RAISED, event=AlertEvent.UPDATED, text="still so")
OTHER = msgspec.structs.replace(RAISED, event=AlertEvent.UPDATED, kind=AlertKind.CREEP, severity=Severity.WARNING)
CLEARED = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.INFO, "back", AlertEvent.CLEARED, "a-1")
CONFIGURATION = RecordedConfiguration(
    "arm.yaml",
    {"arm.yaml": RecordedFile("robot: arm\n# µ"), "taught.npz": RecordedFile.of(b"PK\x03\x04\xff\x00")},
    MonitorState((REFERENCE,), alerts_raised=3),
)


def told_of(i: int) -> FrameRecord:
    """Frame 7 was refused; 4 raises an alert, in 8 it becomes another, 9 clears it."""
    if i == 7:
        return record(i, cam_T_grip=None, covariance=None, drift=None, rms_px=None, protection=None, reason="black")
    pose = record(i + 1000).cam_T_grip
    assert pose is not None
    covariance = tuple((0.25 * np.array(record(i).covariance)).tolist())
    alerts = {4: (RAISED,), 5: (UPDATED,), 8: (OTHER,), 9: (CLEARED,)}.get(i, ())
    return record(i, alerts=alerts, smoothed=Smoothed(pose.translation_m, pose.rotation_xyzw, covariance))


def notes(i: int) -> MonitorNotes:
    return MonitorNotes(None if i == 7 else 0.1 * i, EARLY if i < LEARNT_FROM else LATE)


def state(i: int, said: State = State.TRACKING) -> StateRecord:
    verdict = Verdict.UNKNOWN if said is State.STALE else Verdict.VALID
    return StateRecord(
        robot="arm", camera="wrist", state=said, verdict=verdict, stamp_ns=START_NS + i * INTERVAL_NS + 1000, seq=i,
        reference_id="first", revision=1, frames=i + 1, frames_refused=0, frames_dropped=0, frames_per_s=60.0,
        uptime_s=1.0, camera_connected=True, recording_dropped=0, message="", version=__version__,
    )  # fmt: skip


COMMAND = RecordedCommand(
    START_NS + COUNT * INTERVAL_NS, COUNT - 1, CommandName.UNDO, "first", False, "it is in force already"
)
SILENT = AlertRecord(
    robot="arm", camera="wrist", seq=COUNT - 1, stamp_ns=START_NS + (COUNT + 5) * INTERVAL_NS, state=State.STALE,
    reference_id="first", revision=1, kind=AlertKind.SOURCE, cause=Cause.NO_CAMERA, severity=Severity.ERROR,
    text="unplugged", event=AlertEvent.RAISED, alert_id="d-1",
)  # fmt: skip


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    directory = tmp_path_factory.mktemp("told")
    writer = recorder(directory, configuration=CONFIGURATION, image_rate_hz=1000.0, queue_images=32)
    writer.event(state(-1, State.ACQUIRING))
    for i in range(COUNT):
        writer.frame(frame(i), told_of(i), partial(trace, i), partial(notes, i))
    wait_until(lambda: writer.frames_written == COUNT)
    writer.event(COMMAND)
    writer.event(state(COUNT - 1, State.STALE))
    writer.event(SILENT)
    writer.close(60.0)
    (path,) = directory.glob("*.rrd")
    return Recorded(path)


def json_of(told: Recorded, path: str, message: type) -> dict[int | None, object]:
    return {cell.seq: msgspec.json.decode(cell.values["json"][0], type=message) for cell in told.cells[path]}


def test_each_file_says_what_it_is_and_what_the_monitor_ran_with(told: Recorded) -> None:
    meta = json_of(told, "meta", Meta)[None]
    assert isinstance(meta, Meta)
    assert (meta.name, meta.robot, meta.camera, meta.gripper) == ("run", "arm", "wrist", GRIPPER.name)
    assert (meta.version, meta.file_number, meta.has_truth) == (__version__, 1, False)
    assert told.recording_ids == {meta.recording_id}
    configuration = json_of(told, "configuration", RecordedConfiguration)[None]
    assert configuration == CONFIGURATION
    assert CONFIGURATION.files["taught.npz"].data == b"PK\x03\x04\xff\x00"
    assert CONFIGURATION.files["arm.yaml"].data.decode() == "robot: arm\n# µ"


def test_what_belongs_to_no_frame_is_kept_whole_with_its_own_stamp(told: Recorded) -> None:
    assert json_of(told, "command", RecordedCommand) == {COUNT - 1: COMMAND}
    assert json_of(told, "alert", AlertRecord) == {COUNT - 1: SILENT}
    states = json_of(told, "state", StateRecord)
    assert states == {-1: state(-1, State.ACQUIRING), COUNT - 1: state(COUNT - 1, State.STALE)}
    (told_of_command,) = [c for c in told.timed("events") if "command undo first refused" in c.values["text"][0]]
    assert told_of_command.stamp_ns == COMMAND.stamp_ns and told_of_command.values["level"] == ["WARN"]


def test_a_state_from_before_the_first_frame_is_on_no_clock(told: Recorded) -> None:
    assert {cell.seq: cell.stamp_ns for cell in told.timed("state")}[-1] in (None, START_NS - INTERVAL_NS + 1000)


def test_silence_is_in_the_state_timeline(told: Recorded) -> None:
    (*_, last) = told.timed("status/state")
    assert (last.values["state"], last.stamp_ns) == (["stale"], state(COUNT - 1).stamp_ns)
    assert told.timed("status/verdict")[-1].values["state"] == ["unknown"]


def test_transforms_raw_and_smoothed_are_poses_and_numbers(told: Recorded) -> None:
    numbers = told.by_seq("transform", "scalars")
    poses = told.by_seq("rig/smoothed", "translation"), told.by_seq("rig/smoothed", "quaternion")
    shifts_mm = told.by_seq("drift/tcp_shift_smoothed_mm", "scalars")
    for i in range(COUNT):
        said = told_of(i)
        if said.cam_T_grip is None or said.smoothed is None:
            assert numbers[i] == [] and shifts_mm[i] == []
            continue
        assert numbers[i][:7] == [*said.cam_T_grip.translation_m, *said.cam_T_grip.rotation_xyzw]
        assert numbers[i][7:] == [*said.smoothed.translation_m, *said.smoothed.rotation_xyzw]
        np.testing.assert_allclose(poses[0][i][0], said.smoothed.translation_m, rtol=1e-6)
        np.testing.assert_allclose(poses[1][i][0], said.smoothed.rotation_xyzw, rtol=1e-6)
        way_m = np.array(said.smoothed.translation_m) - REFERENCE.cam_T_grip.translation_m
        np.testing.assert_allclose(shifts_mm[i], 1e3 * way_m, atol=1e-12)


def test_standard_deviations_are_those_of_the_covariances(told: Recorded) -> None:
    # COVARIANCE of the records: 10, 20, 30 µm and 1e-4 rad; the smoothed one is a quarter of it.
    tcp, rotation = (told.by_seq(f"sigma/{name}", "scalars") for name in ("tcp_um", "rotation_deg"))
    assert tcp[7] == [] and rotation[7] == []
    np.testing.assert_allclose(tcp[3], [10.0, 20.0, 30.0, 5.0, 10.0, 15.0], rtol=1e-9)
    np.testing.assert_allclose(rotation[3], np.degrees([1e-4] * 3 + [5e-5] * 3), rtol=1e-9)


def test_the_statistic_stands_beside_its_threshold(told: Recorded) -> None:
    share = told.by_seq("test/share", "scalars")
    assert share[7] == [] and {i: v[0] for i, v in share.items() if v} == {i: 0.1 * i for i in range(COUNT) if i != 7}
    alarm = told.by_seq("test/alarm", "scalars")
    assert {0, COUNT - 1} <= set(alarm) and all(value == [1.0] for value in alarm.values())


def test_the_protection_level_is_a_curve(told: Recorded) -> None:
    level_mm, level_deg = (told.by_seq(f"protection/level_{unit}", "scalars") for unit in ("mm", "deg"))
    assert level_mm[7] == level_deg[7] == []
    for i in set(range(COUNT)) - {7}:
        said = told_of(i).protection
        assert said is not None
        np.testing.assert_allclose(
            [*level_mm[i], *level_deg[i]], [1e3 * said.position_m, math.degrees(said.rotation_rad)]
        )
    assert any("protection/level_mm" in text for text in told.blueprint)


def test_limits_are_lines_from_the_first_frame_to_the_last(told: Recorded) -> None:
    for path, expected in (
        ("drift/limits_mm", [0.1, 2.5]),
        ("protection/limit_mm", [0.5]),
        ("protection/limit_deg", [0.02 * 180.0 / math.pi]),
        ("drift/limits_deg", [3e-3 * 180.0 / math.pi, 0.02 * 180.0 / math.pi]),
    ):
        values = told.by_seq(path, "scalars")
        assert {0, COUNT - 1} <= set(values)
        for value in values.values():
            np.testing.assert_allclose(value, expected, rtol=1e-12)


def test_what_would_be_noticed_is_drawn_about_the_reference_s_error(told: Recorded) -> None:
    noticed_mm, noticed_deg = (told.by_seq(f"drift/noticed_{unit}", "scalars") for unit in ("mm", "deg"))
    assert noticed_mm[0] == [], "the test rests on nothing yet"
    np.testing.assert_allclose(noticed_mm[COUNT - 1], [-0.09, -0.22, -0.27, 0.11, 0.18, 0.33], atol=1e-12)
    turns_rad = [-0.009, -0.022, -0.027, 0.011, 0.018, 0.033]
    np.testing.assert_allclose(noticed_deg[COUNT - 1], np.degrees(turns_rad), atol=1e-12)
    np.testing.assert_allclose(told.by_seq("noise/scatter_um", "scalars")[COUNT - 1], [4.0, 5.0, 6.0], rtol=1e-9)
    assert told.by_seq("noise/average_share", "scalars")[COUNT - 1] == [0.5] * 6


def test_an_alert_marks_the_drift_where_it_is_raised(told: Recorded) -> None:
    drift = told_of(4).drift
    assert drift is not None
    marks = told.by_seq("drift/alerts/error", "scalars")
    assert set(marks) == {4}
    np.testing.assert_allclose(marks[4], [1e3 * float(np.linalg.norm(drift.tcp_shift_m))], rtol=1e-12)
    assert set(told.by_seq("drift/alerts/warning", "scalars")) == {8}, "it became another one"
    assert not told.timed("drift/alerts/info"), "what is cleared is no news"


def test_residuals_are_distances_of_corners_and_edge_points(told: Recorded) -> None:
    corners = told.by_seq("residual/corners_px", "scalars")
    sides = [told.by_seq("residual/edge_points", f"{side}_px") for side in ("used", "refused")]
    shown = told.by_seq("rig/camera/image/edges/used", "positions")
    rms = told.by_seq("residual/rms_px", "scalars")
    for i in set(range(COUNT)) - {7}:
        seen, said = trace(i), told_of(i)
        measured = [(np.nan, np.nan) if c.uv_px is None else c.uv_px for c in said.corners]
        predicted = seen.predicted_corners_uv_px
        expected = [math.hypot(u - p, v - q) for (u, v), (p, q) in zip(measured, predicted, strict=True)]
        np.testing.assert_allclose(corners[i], expected, rtol=1e-5)
        assert math.isnan(corners[i][1]) and math.isnan(corners[i][2])  # hidden; not predicted
        for used, side in ((True, sides[0]), (False, sides[1])):
            np.testing.assert_allclose(side[i], seen.edge_residual_px[seen.edge_used == used], rtol=1e-6)
        assert len(sides[0][i]) == len(shown[i])
        of_edges_px = np.sqrt(np.mean(seen.edge_residual_px[seen.edge_used] ** 2))
        np.testing.assert_allclose(rms[i], [said.rms_px, of_edges_px], rtol=1e-6)


def test_a_later_file_stands_alone(tmp_path: Path) -> None:
    moved = msgspec.structs.replace(REFERENCE, reference_id="second", revision=2)
    writer = recorder(
        tmp_path, patience_s=5.0, configuration=CONFIGURATION, max_file_bytes=100_000, image_rate_hz=1000.0
    )
    writer.event(moved)
    i = 0
    while len(list(tmp_path.glob("*.rrd"))) < 3:
        assert i < 2000, "no third file"
        of_second = {"reference_id": "second", "revision": 2, "stamp_ns": START_NS + i * INTERVAL_NS}
        said = msgspec.structs.replace(told_of(i % 7), seq=i, **of_second)
        writer.frame(frame(i), said, partial(trace, 3), partial(notes, 9))
        i += 1
    writer.close(60.0)
    alone = Recorded(tmp_path / "run-0002.rrd")
    assert alone.recording_ids == Recorded(tmp_path / "run-0001.rrd").recording_ids
    meta = json_of(alone, "meta", Meta)[None]
    assert isinstance(meta, Meta) and meta.file_number == 2
    assert json_of(alone, "configuration", RecordedConfiguration) == {None: CONFIGURATION}
    first, (text,) = next(iter(alone.by_seq("reference", "json").items()))
    assert msgspec.json.decode(text, type=type(moved)) == moved and first == min(alone.seqs())
    assert any("'TimeSeries'" in text for text in alone.blueprint)
    for path, component in (("status/state", "state"), ("drift/limits_mm", "scalars"), ("drift/noticed_mm", "scalars")):
        assert min(alone.by_seq(path, component)) == min(alone.seqs()), path
    (style,) = [cell for cell in alone.cells["drift/tcp_shift_mm"] if cell.seq is None]
    assert style.values["names"] == ["x", "y", "z", "length"]
