"""What was offered is in the file: values, units, times, images, layout; read back with rerun's own reader."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.recorded import (
    CAMERA,
    GRIPPER,
    HEIGHT_PX,
    INTERVAL_NS,
    OVERLAY,
    REFERENCE,
    START_NS,
    WIDTH_PX,
    Recorded,
    decoded,
    frame,
    image,
    record,
    recorder,
    trace,
    wait_until,
)

from gripmon.model.geometry import rotation_from_xyzw
from gripmon.model.records import (
    Alert,
    AlertKind,
    AlertRecord,
    Cause,
    FrameRecord,
    Severity,
    State,
    Verdict,
)
from gripmon.record.recorder import Recorder, RecordingSettings
from gripmon.record.write import open_recorder

COUNT = 24
JUMP = Alert(AlertKind.STEP, Cause.CAMERA_MOUNT, Severity.ERROR, "moved by 4.5 mm")


def story(i: int) -> FrameRecord:
    """Tracking; a jump at 10, drifting from there; lost without an estimate from 20 to 21."""
    if i in (20, 21):
        return record(
            i,
            State.LOST,
            Verdict.UNKNOWN,
            cam_T_grip=None,
            covariance=None,
            drift=None,
            rms_px=None,
            jaw_opening_m=None,
        )
    if i >= 10:
        return record(i, State.DRIFTING, Verdict.SUSPECT, (JUMP,) if i == 10 else ())
    return record(i)


def truth(i: int) -> tuple[float, float, float]:
    return (0.001 * i, 0.0, 0.11)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """The story with every image, lossless."""
    directory = tmp_path_factory.mktemp("story")
    writer = recorder(directory, truth, image_rate_hz=1000.0, image_format="png", queue_images=32)
    for i in range(COUNT):
        writer.frame(frame(i), story(i), partial(trace, i))
        for alert in story(i).alerts:  # which the daemon publishes with more words: not recorded a second time
            about = {**msgspec.structs.asdict(alert), "text": f"{alert.text}; to accept it: …"}
            names = {"robot": "arm", "camera": "wrist", "reference_id": "first", "revision": 1}
            writer.event(AlertRecord(seq=i, stamp_ns=story(i).stamp_ns, state=State.DRIFTING, **names, **about))
    writer.event(
        AlertRecord(
            robot="arm",
            camera="wrist",
            seq=COUNT,
            stamp_ns=START_NS + COUNT * INTERVAL_NS,
            state=State.STALE,
            reference_id="first",
            revision=1,
            kind=AlertKind.SOURCE,
            cause=Cause.NO_CAMERA,
            severity=Severity.WARNING,
            text="unplugged",
        )
    )
    writer.close(60.0)
    assert (writer.dropped, writer.images_dropped, writer.failure) == (0, 0, None)
    assert writer.frames_written == COUNT
    (path,) = directory.glob("*.rrd")
    assert path.name == "run-0001.rrd"
    return Recorded(path)


def test_every_frame_carries_its_capture_time_and_number(told: Recorded) -> None:
    cells = told.timed("record")
    assert [cell.seq for cell in cells] == list(range(COUNT))
    assert [cell.stamp_ns for cell in cells] == [START_NS + i * INTERVAL_NS for i in range(COUNT)]


def test_the_whole_record_is_kept_to_the_last_digit(told: Recorded) -> None:
    for i, (line,) in told.by_seq("record", "json").items():
        assert msgspec.json.decode(line, type=FrameRecord) == story(i)


def test_the_gripper_moves_as_estimated(told: Recorded) -> None:
    translations = told.by_seq("rig/gripper", "translation")
    quaternions = told.by_seq("rig/gripper", "quaternion")
    assert set(translations) == set(range(COUNT)) - {20, 21}
    for i in translations:
        transform = story(i).cam_T_grip
        assert transform is not None
        np.testing.assert_allclose(translations[i][0], transform.translation_m, rtol=1e-6)
        # Compared as rotation: a swapped order of the quaternion's components can't pass.
        np.testing.assert_allclose(
            rotation_from_xyzw(tuple(quaternions[i][0])), rotation_from_xyzw(transform.rotation_xyzw), atol=1e-6
        )


def test_the_reference_stands_where_it_was_calibrated(told: Recorded) -> None:
    (cell,) = told.timed("rig/reference")
    assert (cell.seq, cell.stamp_ns) == (0, START_NS)  # not at the reference's own stamp, which is none
    np.testing.assert_allclose(cell.values["translation"][0], REFERENCE.cam_T_grip.translation_m, rtol=1e-6)
    np.testing.assert_allclose(cell.values["quaternion"][0], REFERENCE.cam_T_grip.rotation_xyzw, rtol=1e-6)


def test_fingers_stand_at_the_reported_opening(told: Recorded) -> None:
    for cell in told.timed("rig/gripper/edges"):
        assert cell.seq is not None
        expected = story(cell.seq)
        strips = np.array(cell.values["strips"]).reshape(-1, 2, 3)
        if expected.cam_T_grip is None:
            assert len(strips) == 0
        else:
            points_m = GRIPPER.points_grip_m(expected.jaw_opening_m)
            np.testing.assert_allclose(strips, points_m[GRIPPER.edge_points], atol=1e-8)


def test_curves_have_people_s_units(told: Recorded) -> None:
    shift = told.by_seq("drift/tcp_shift_mm", "scalars")
    band = told.by_seq("drift/tcp_shift_sigma_mm", "scalars")
    d, delta = told.by_seq("drift/d_mm", "scalars"), told.by_seq("drift/delta_deg", "scalars")
    rms, latency = told.by_seq("residual/rms_px", "scalars"), told.by_seq("timing/latency_us", "scalars")
    for i in set(range(COUNT)) - {20, 21}:
        expected = story(i)
        assert expected.drift is not None
        shift_mm = 1e3 * np.array(expected.drift.tcp_shift_m)
        np.testing.assert_allclose(shift[i], [*shift_mm, np.linalg.norm(shift_mm)], rtol=1e-12)
        sigma_mm = np.array([0.01, 0.02, 0.03])
        np.testing.assert_allclose(band[i], np.concatenate([shift_mm - sigma_mm, shift_mm + sigma_mm]), atol=1e-12)
        np.testing.assert_allclose(d[i], [1e3 * expected.drift.translation_m])
        np.testing.assert_allclose(delta[i], [np.degrees(expected.drift.rotation_rad)])
        assert rms[i][0] == expected.rms_px
        np.testing.assert_allclose(latency[i], [1e-3 * expected.latency_ns])


def test_what_is_unknown_leaves_a_gap(told: Recorded) -> None:
    for path in ("drift/tcp_shift_mm", "drift/tcp_shift_sigma_mm", "drift/d_mm", "drift/delta_deg"):
        values = told.by_seq(path, "scalars")
        assert values[20] == [] and values[21] == [] and values[22] != []
    rms = told.by_seq("residual/rms_px", "scalars")
    assert np.isnan(rms[20][0]) and np.isnan(rms[21][0]) and not np.isnan(rms[22][0]), "edge points are known still"


def test_truth_is_drawn_against_the_reference(told: Recorded) -> None:
    for i, values in told.by_seq("drift/truth_mm", "scalars").items():
        expected = 1e3 * (np.array(truth(i)) - REFERENCE.cam_T_grip.translation_m)
        np.testing.assert_allclose(values, expected, rtol=1e-12)
    for i, values in told.by_seq("drift/error_mm", "scalars").items():
        drift = story(i).drift
        assert (values == []) == (drift is None)
        if drift is not None:
            estimated_tcp_m = np.array(REFERENCE.cam_T_grip.translation_m) + drift.tcp_shift_m
            np.testing.assert_allclose(values, 1e3 * (estimated_tcp_m - truth(i)), atol=1e-9)


def test_images_are_the_frames_images(told: Recorded) -> None:
    blobs = told.by_seq(OVERLAY, "blob")
    assert set(blobs) == set(range(COUNT))
    for i, blob in blobs.items():
        np.testing.assert_array_equal(decoded(blob), image(i))
    means = told.by_seq("image/mean_grey", "scalars")
    contrasts = told.by_seq("image/contrast_grey", "scalars")
    for i in means:
        np.testing.assert_allclose([means[i][0], contrasts[i][0]], [image(i).mean(), image(i).std()], rtol=1e-9)


def test_edge_points_are_sorted_by_belief(told: Recorded) -> None:
    used, refused = (told.by_seq(f"{OVERLAY}/edges/{kind}", "positions") for kind in ("used", "refused"))
    counts = told.by_seq("quality/edge_points", "scalars")
    for i in range(COUNT):
        expected = trace(i)
        np.testing.assert_allclose(used[i], expected.edge_uv_px[expected.edge_used], rtol=1e-6)
        np.testing.assert_allclose(refused[i], expected.edge_uv_px[~expected.edge_used], rtol=1e-6)
        assert counts[i] == [expected.edge_used.sum(), (~expected.edge_used).sum()]


def test_predictions_are_drawn(told: Recorded) -> None:
    strips = told.by_seq(f"{OVERLAY}/edges/predicted", "strips")
    corners = told.by_seq(f"{OVERLAY}/corners/predicted", "positions")
    for i in range(COUNT):
        expected = trace(i)
        assert [len(strip) for strip in strips[i]] == [5, 2, 9]
        for strip, edge in zip(strips[i], expected.predicted_edges_uv_px, strict=True):
            np.testing.assert_allclose(strip, edge, rtol=1e-6)
        seen = np.delete(expected.predicted_corners_uv_px, 2, axis=0)
        np.testing.assert_allclose(corners[i], seen, rtol=1e-6)


def test_corners_are_named_and_a_hidden_one_says_so_where_it_was_expected(told: Recorded) -> None:
    used = told.by_seq(f"{OVERLAY}/corners/used", "positions")
    refused = told.by_seq(f"{OVERLAY}/corners/refused", "positions")
    names, reasons = (told.by_seq(f"{OVERLAY}/labels/{kind}", "labels") for kind in ("used", "refused"))
    for i in range(COUNT):
        measured = [corner for corner in story(i).corners if corner.used]
        np.testing.assert_allclose(used[i], [corner.uv_px for corner in measured], rtol=1e-6)
        assert names[i] == [corner.id for corner in measured]
        np.testing.assert_allclose(refused[i], [trace(i).predicted_corners_uv_px[1]], rtol=1e-6)
        assert reasons[i] == [f"{GRIPPER.corner_ids[1]}: hidden"]


def test_states_are_recorded_where_they_change(told: Recorded) -> None:
    states = {i: value for i, (value,) in told.by_seq("status/state", "state").items()}
    verdicts = {i: value for i, (value,) in told.by_seq("status/verdict", "state").items()}
    assert states == {0: "tracking", 10: "drifting", 20: "lost", 22: "drifting"}
    assert verdicts == {0: "valid", 10: "suspect", 20: "unknown", 22: "suspect"}


def test_alerts_are_in_the_log_with_their_level_and_time(told: Recorded) -> None:
    events = [(c.seq, c.stamp_ns, c.values["level"][0], c.values["text"][0]) for c in told.timed("events")]
    jump = [e for e in events if "moved by 4.5 mm" in e[3]]
    assert jump == [(10, START_NS + 10 * INTERVAL_NS, "ERROR", "step [camera_mount_moved] moved by 4.5 mm")]
    assert (COUNT, START_NS + COUNT * INTERVAL_NS, "WARN", "source [no_camera] unplugged") in events
    assert any(e[0] == 20 and "drifting (suspect) → lost (unknown)" in e[3] for e in events)


def test_the_layout_is_embedded(told: Recorded) -> None:
    for view in ("2D", "3D", "TimeSeries", "StateTimeline", "TextLog"):
        assert any(f"'{view}'" in text for text in told.blueprint), view
    assert any("capture_time" in text for text in told.blueprint)
    paths = {*told.cells}
    for origin in ("rig/camera/image", "events", "drift/tcp_shift_mm", "drift/truth_mm", "status/state"):
        assert origin in paths


def test_camera_matches_the_configured_one(told: Recorded) -> None:
    (cell,) = [cell for cell in told.cells["rig/camera"] if "image_from_camera" in cell.values]
    matrix = np.array(cell.values["image_from_camera"][0]).reshape(3, 3).T
    np.testing.assert_allclose(matrix, [[CAMERA.fx_px, 0, CAMERA.cx_px], [0, CAMERA.fy_px, CAMERA.cy_px], [0, 0, 1]])
    assert cell.values["resolution"] == [[WIDTH_PX, HEIGHT_PX]]


def test_images_come_at_the_rate_and_at_events(tmp_path: Path) -> None:
    writer = recorder(tmp_path, image_rate_hz=10.0, queue_images=64, around_alert_s=0.0)
    for i in range(60):
        state = State.DRIFTING if i in (31, 32) else State.TRACKING
        writer.frame(frame(i), record(i, state, alerts=(JUMP,) if i == 43 else ()), partial(trace, i))
    writer.close(60.0)
    (path,) = tmp_path.glob("*.rrd")
    told = Recorded(path)
    assert told.seqs() == list(range(60))
    shown = set(told.by_seq(OVERLAY, "blob"))
    # Six frames to 100 ms; a change or an alert shows its frame and begins a new interval.
    assert shown == {0, 6, 12, 18, 24, 30, 31, 33, 39, 43, 49, 55}
    assert set(told.by_seq(f"{OVERLAY}/edges/used", "positions")) == shown


def test_a_new_reference_holds_from_the_frame_that_names_it(tmp_path: Path) -> None:
    moved = msgspec.structs.replace(REFERENCE, reference_id="second", revision=2)
    writer = recorder(tmp_path)
    writer.frame(frame(0), record(0), lambda: None)
    wait_until(lambda: writer.frames_written == 1)
    writer.event(moved)
    for i in range(1, 12):
        if i == 7:
            wait_until(lambda: writer.frames_written == 7)  # it is written with none of its own
        writer.frame(frame(i), record(i, **({"reference_id": "second", "revision": 2} if i >= 7 else {})), lambda: None)
    writer.close(60.0)
    (path,) = tmp_path.glob("*.rrd")
    told = Recorded(path)
    assert [cell.seq for cell in told.timed("rig/reference")] == [0, 7]
    lines = told.by_seq("reference", "json").items()
    whole = {seq: msgspec.json.decode(line, type=type(moved)) for seq, (line,) in lines}
    assert whole == {0: REFERENCE, 7: moved}, "with its provenance"
    assert [c.seq for c in told.timed("events") if c.values["text"] == ["reference second (configuration)"]] == [7]


def test_alerts_of_another_clock_don_t_stretch_the_timeline(tmp_path: Path) -> None:
    writer = recorder(tmp_path)
    for i in range(3):
        writer.frame(frame(i), record(i), lambda: None)
    wait_until(lambda: writer.frames_written == 3)
    writer.event(
        AlertRecord(
            robot="arm",
            camera="wrist",
            seq=2,
            stamp_ns=START_NS + 10**18,
            state=State.STALE,
            reference_id="first",
            revision=1,
            kind=AlertKind.SOURCE,
            cause=Cause.NO_CAMERA,
            severity=Severity.WARNING,
            text="years later",
        )
    )
    writer.close(60.0)
    (path,) = tmp_path.glob("*.rrd")
    stamps = {cell.stamp_ns for cells in Recorded(path).cells.values() for cell in cells if cell.stamp_ns is not None}
    assert stamps == {START_NS + i * INTERVAL_NS for i in range(3)}


def test_the_daemon_s_process_never_imports_rerun(tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from support.recorded import *; w = recorder(Path(sys.argv[1]));"
        "w.frame(frame(0), record(0), lambda: trace(0)); w.close(60.0);"
        "assert w.frames_written == 1, w.failure; assert 'rerun' not in sys.modules"
    )
    here = Path(__file__).parent
    subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = [{str(here)!r}, {str(here.parent)!r}]; {script}", tmp_path],
        check=True,
    )


def test_disabled_recording_touches_nothing(tmp_path: Path) -> None:
    writer = open_recorder(
        RecordingSettings(enabled=False),
        robot="arm",
        camera_name="wrist",
        camera=CAMERA,
        gripper=GRIPPER,
        reference=REFERENCE,
        directory=tmp_path / "none",
    )
    assert type(writer) is Recorder
    writer.frame(frame(0), record(0), lambda: None)
    writer.close()
    assert not (tmp_path / "none").exists()


def test_an_old_file_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "run-0001.rrd").write_bytes(b"precious")
    writer = recorder(tmp_path)
    wait_until(lambda: writer.path is not None)
    assert writer.path == tmp_path / "run-0002.rrd"
    writer.close(60.0)
    assert (tmp_path / "run-0001.rrd").read_bytes() == b"precious"
