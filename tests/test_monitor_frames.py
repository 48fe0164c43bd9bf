"""What the monitor makes of single frames: rotations, what a frame brings, its trace, its time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.meters import moved
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import frames_of, new_monitor, replaced

from gripmon.judge.causes import CauseJudge
from gripmon.model.records import AlertKind, Cause, Verdict, to_json


def test_rotations_are_x_y_z_w_and_take_gripper_coordinates_to_the_camera():
    frames, truths = frames_of("static")
    turned = moved(nominal_cam_T_grip(), np.array([0.0, 0.0, 0.0, 0.004, -0.003, 0.005]))
    record = new_monitor(cam_T_grip=turned).process(frames[0])
    true = Rotation.from_matrix(truths[0].cam_T_grip[:3, :3]).as_quat()
    told = np.array(record.cam_T_grip.rotation_xyzw)
    assert abs(true[0]) > 0.2 and abs(true[3]) > 0.9, "a tilt about x: neither order nor direction can hide"
    np.testing.assert_allclose(told * np.sign(told[3]), true * np.sign(true[3]), atol=2e-3)
    np.testing.assert_allclose(record.cam_T_grip.translation_m, truths[0].cam_T_grip[:3, 3], atol=3e-4)


def test_what_the_frame_brings_is_in_the_record():
    frames, _ = frames_of("static")
    record = new_monitor().process(frames[3])
    assert (record.seq, record.stamp_ns, record.name) == (frames[3].seq, frames[3].stamp_ns, frames[3].name)
    assert record.jaw_opening_m == pytest.approx(0.034, abs=1e-4)
    assert record.latency_ns == 0
    assert (record.verdict, record.reason) == (Verdict.SUSPECT, "not yet confirmed by a second frame")


def test_the_trace_belongs_to_the_newest_frame():
    frames, truths = frames_of("static")
    monitor = new_monitor()
    assert monitor.trace() is None
    monitor.process(frames[0])
    trace = monitor.trace()
    visible = truths[0].visible
    np.testing.assert_allclose(trace.predicted_corners_uv_px[visible], truths[0].corner_uv_px[visible], atol=0.5)


def test_time_is_the_frames_own_and_never_runs_backwards():
    """Equal and earlier stamps count as no time: nothing raises and the average doesn't widen.  That the clock was set
    back is said.
    """
    frames, _ = frames_of("static")
    early, late = new_monitor(), new_monitor()
    for frame in frames[:10]:
        early.process(frame)
        late.process(frame)
    same = msgspec.structs.replace(early.process(replaced(frames[10], stamp_ns=frames[9].stamp_ns)), stamp_ns=0)
    earlier = msgspec.structs.replace(late.process(replaced(frames[10], stamp_ns=frames[2].stamp_ns)), stamp_ns=0)
    [alert] = earlier.alerts
    assert (alert.kind, alert.cause, earlier.verdict) == (AlertKind.STREAM, Cause.CLOCK, Verdict.SUSPECT)
    assert (same.alerts, same.verdict) == ((), Verdict.VALID)
    assert earlier.reason == "the stream of frames is at fault" and same.reason is None
    assert to_json(same) == to_json(msgspec.structs.replace(earlier, alerts=(), verdict=Verdict.VALID, reason=None))


def test_a_caller_may_read_every_image_into_the_same_memory():
    """What moved is worked out later, and must not be of the next image, or of nothing."""
    buffer = np.zeros((PAPER_LENS.height_px, PAPER_LENS.width_px), np.uint8)
    apart, reused, explained = new_monitor(), new_monitor(), 0
    for frame in frames_of("bent_finger")[0]:
        expected = apart.process(frame)
        buffer[:] = frame.image
        found = reused.process(replaced(frame, image=buffer))
        buffer[:] = 77
        assert to_json(found) == to_json(expected)
        explained += any("bent" in alert.text for alert in expected.alerts)
    assert explained


def test_an_explanation_that_fails_costs_no_frame(monkeypatch: pytest.MonkeyPatch):
    monitor = new_monitor()

    def fail(self: CauseJudge, evidence: object) -> None:
        raise RuntimeError("singular")

    monkeypatch.setattr(CauseJudge, "add", fail)
    texts = set()
    for frame in frames_of("bump")[0]:
        record = monitor.process(frame)
        assert record.seq == frame.seq and record.cam_T_grip is not None
        texts.add(monitor._analysis.causes.known.text)
    assert texts == {"", "cause analysis failed: RuntimeError: singular"}
