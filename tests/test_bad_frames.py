"""Frames that can't be measured: a record with a reason, nothing raised, and then all as if they had not come."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from support.box_models import cube_model
from support.grippers import gripper_from_dict
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import frames_of, new_monitor, reference_of, replaced

from gripmon.model.camera import make_camera
from gripmon.model.records import (
    AlertEvent,
    AlertKind,
    CornerFault,
    Frame,
    FrameRecord,
    Origin,
    Refusal,
    State,
    Verdict,
    to_json,
)
from gripmon.monitor import Monitor, MonitorSettings

HEIGHT, WIDTH = PAPER_LENS.height_px, PAPER_LENS.width_px


def _float(frame: Frame) -> np.ndarray:
    return np.asarray(frame.image, dtype=np.float32) / np.float32(255.0)


def _some_nan(frame: Frame) -> np.ndarray:
    image = _float(frame)
    image[::3, ::5] = np.nan
    image[8::16, 8::16] = np.nan
    return image


BAD: dict[str, tuple[Callable[[Frame], Frame], str]] = {  # one of a kind; every kind in words: test_inspection.py
    "nothing, as the source could not read it": (
        lambda f: replaced(f, image=None, fault="truncated: 1200 of 442386 bytes"),
        "not_an_image: truncated: 1200 of 442386 bytes",
    ),
    "nothing, as it had another size": (
        lambda f: replaced(f, image=None, fault="64x48 pixels", refusal=Refusal.WRONG_SIZE),
        "wrong_size: 64x48 pixels",
    ),
    "a list": (lambda f: replaced(f, image=[[0, 1], [2, 3]]), "not_an_image"),
    "half the size": (lambda f: replaced(f, image=f.image[::2, ::2]), "wrong_size: 384x288"),
    "black": (lambda f: replaced(f, image=np.zeros_like(f.image)), "black"),
    "some NaN": (lambda f: replaced(f, image=_some_nan(f)), "not_finite"),
    "double precision": (lambda f: replaced(f, image=f.image / 255.0), "wrong_type: pixels of type float64"),
    "words": (lambda f: replaced(f, image=f.image.astype("U3")), "wrong_type"),
    "floats up to 255": (lambda f: replaced(f, image=f.image.astype(np.float32)), "wrong_type: float pixels"),
    "a jaw opening of NaN": (lambda f: replaced(f, jaw_opening_m=math.nan), "jaw_opening"),
}  # fmt: skip


def is_finite(value: object) -> bool:
    """Whether no number anywhere in a record is NaN or infinite."""
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(is_finite(v) for v in value.values())
    if isinstance(value, list | tuple):
        return all(is_finite(v) for v in value)
    return True


def assert_sound(record: FrameRecord) -> None:
    fields = msgspec.to_builtins(record)
    fields.pop("jaw_opening_m" if record.reason else "latency_ns")
    assert is_finite(fields)
    json.loads(to_json(record))
    if record.cam_T_grip is None:
        assert record.verdict is Verdict.UNKNOWN and record.reason
    else:
        scale = np.sqrt(np.diag(np.reshape(record.covariance, (6, 6))))
        assert (scale > 0.0).all()


@pytest.mark.parametrize(("spoil", "reason"), BAD.values(), ids=list(BAD))
def test_a_bad_frame_is_a_record_with_a_reason_and_leaves_nothing_behind(spoil: Callable[[Frame], Frame], reason: str):
    frames, _ = frames_of("static")
    monitor, undisturbed = new_monitor(), new_monitor()
    for frame in frames[:5]:
        before = monitor.process(frame)
        undisturbed.process(frame)
    bad = monitor.process(spoil(frames[5]))
    assert bad.reason is not None and bad.reason.startswith(reason), bad.reason
    assert (bad.seq, bad.stamp_ns, bad.source, bad.state) == (5, frames[5].stamp_ns, Origin.HELD, State.TRACKING)
    assert bad.verdict is Verdict.SUSPECT and bad.cam_T_grip == before.cam_T_grip
    assert {c.reason for c in bad.corners} == {CornerFault.FRAME_REFUSED}
    assert not any(c.used for c in bad.corners) and bad.rms_px is None
    assert_sound(bad)
    assert monitor.trace() is None
    after, expected = [], []
    for frame in frames[6:12]:
        after.append(monitor.process(frame))
        expected.append(undisturbed.process(frame))
    # It is where it was: no frame has to confirm that, and everything is as if the bad one had not come.
    assert [r.verdict for r in after] == [Verdict.VALID] * 6
    for seen, told in zip(after, expected, strict=True):
        # The average waited in two steps instead of one: equal to rounding.
        np.testing.assert_allclose(seen.smoothed.covariance, told.smoothed.covariance, rtol=1e-9)
        np.testing.assert_allclose(seen.smoothed.translation_m, told.smoothed.translation_m, atol=1e-15)
        assert msgspec.structs.replace(seen, verdict=told.verdict, smoothed=told.smoothed) == told


def test_bad_frames_that_last_give_one_alert_and_none_while_they_are_few():
    frames, _ = frames_of("static")
    monitor = new_monitor()
    for frame in frames[:5]:
        monitor.process(frame)
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    records = [
        monitor.process(replaced(frames[4], seq=5 + k, stamp_ns=frames[4].stamp_ns + (k + 1) * 50_000_000, image=black))
        for k in range(60)
    ]
    kinds = [alert.kind for record in records for alert in record.alerts]
    assert kinds.count(AlertKind.IMAGE) == 1 and kinds.count(AlertKind.LOST) == 1
    assert all(not record.alerts for record in records[:19]), "nothing in the first second"
    assert records[-1].state is State.LOST and records[-1].verdict is Verdict.UNKNOWN
    back = [
        monitor.process(replaced(frames[5 + k], seq=65 + k, stamp_ns=records[-1].stamp_ns + (k + 1) * 50_000_000))
        for k in range(25)
    ]
    told = [alert for record in records + back for alert in record.alerts]
    for kind in (AlertKind.IMAGE, AlertKind.LOST):
        assert [alert.event for alert in told if alert.kind is kind] == [AlertEvent.RAISED, AlertEvent.CLEARED]
        assert len({alert.alert_id for alert in told if alert.kind is kind}) == 1


@pytest.mark.parametrize("opening_m", [-0.0005, 0.0605, 0.06, 0.0])
def test_an_opening_a_little_beyond_the_jaw_as_encoders_report_it_does_not_raise(opening_m: float):
    frames, _ = frames_of("static")
    monitor = new_monitor()
    monitor.process(frames[0])
    assert_sound(monitor.process(replaced(frames[1], jaw_opening_m=opening_m)))
    assert monitor.process(frames[2]).verdict is not Verdict.UNKNOWN


@pytest.mark.parametrize("opening_m", [0.0, 0.034, 7.0, math.nan, math.inf])
def test_a_gripper_without_a_jaw_ignores_what_is_reported_about_one(opening_m: float):
    model = cube_model(0.03)
    pose = nominal_cam_T_grip()
    image = frames_of("static")[0][0].image
    monitor = Monitor(make_camera(PAPER_LENS), gripper_from_dict(model), MonitorSettings(), reference_of(pose))
    records = [monitor.process(Frame(i, i * 40_000_000, image, jaw_opening_m=opening_m)) for i in range(2)]
    for record in records:
        assert record.jaw_opening_m is None or record.reason
        assert_sound(record)


def _holes(frame: Frame, value: float) -> np.ndarray:
    """Pixels that the inspection's sparse look misses, some of them on the fingers' outlines."""
    image = _float(frame).copy()
    for v, u in ((241, 251), (241, 240), (230, 520), (300, 100), (301, 101), (240, 160)):
        image[v : v + 6, u : u + 6] = value
    image[8::16, 8::16] = _float(frame)[8::16, 8::16]
    return image


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -5.0])
def test_single_pixels_that_are_no_grey_levels_spoil_only_what_they_touch(value: float):
    frames, truths = frames_of("static")
    monitor, plain = new_monitor(), new_monitor()
    for frame in frames[:12]:
        with np.errstate(all="ignore"):
            record = monitor.process(replaced(frame, image=_holes(frame, value)))
        reference = plain.process(replaced(frame, image=_float(frame)))
        assert_sound(record)
        assert_sound(reference)
    # Huge values spoil whole neighbourhoods, so that what is left may be too uncertain to be called valid.
    assert record.source is Origin.UPDATE and (abs(value) == 1e30 or record.verdict is Verdict.VALID)
    for mine in (record, reference):
        error_m = np.array(mine.cam_T_grip.translation_m) - truths[11].cam_T_grip[:3, 3]
        assert np.abs(error_m[:2]).max() < 4e-5


def test_a_frame_cut_off_in_the_middle_is_measured_by_what_is_left_or_held():
    """A truncated file decodes to an image whose lower part is grey: the fingers' tips are in the upper one."""
    frames, truths = frames_of("static")
    monitor = new_monitor()
    for frame in frames[:5]:
        monitor.process(frame)
    for rows in (500, 400, 300, 200, 100):
        image = np.array(frames[5].image)
        image[rows:] = 128
        record = monitor.process(replaced(frames[5], image=image))
        assert_sound(record)
        if record.source is Origin.UPDATE:
            error_m = np.array(record.cam_T_grip.translation_m) - truths[5].cam_T_grip[:3, 3]
            sigma_m = np.sqrt(np.diag(np.reshape(record.covariance, (6, 6))))[:3]
            assert (np.abs(error_m) < 6.0 * sigma_m).all(), rows


def test_random_frames_of_any_kind_never_raise():
    rng = np.random.default_rng(1)
    frames, _ = frames_of("static")
    monitor = new_monitor()
    for i in range(24):
        kind = i % 6
        shape = (HEIGHT, WIDTH) if kind % 2 else (HEIGHT, WIDTH, 3)
        image = {
            0: rng.integers(0, 256, shape, dtype=np.uint8),
            1: rng.integers(0, 65536, shape, dtype=np.uint16),
            2: rng.random(shape, dtype=np.float32),
            3: np.where(rng.random(shape) < 0.5, np.uint8(0), np.uint8(255)),
            4: np.repeat(rng.integers(0, 2, (HEIGHT, 1, 3), dtype=np.uint8) * np.uint8(200), WIDTH, axis=1),
            5: np.roll(np.array(frames[0].image), int(rng.integers(-300, 300)), axis=1),
        }[kind]
        record = monitor.process(Frame(i, frames[0].stamp_ns + i * 33_000_000, image, jaw_opening_m=0.034))
        assert_sound(record)
        if kind < 5:
            assert record.source is Origin.HELD, "noise is not a gripper"


def test_ten_bits_in_sixteen_are_measured_as_the_same_picture_in_eight():
    frames = frames_of("static")[0][:4]
    ten_bits = [replaced(f, image=np.asarray(f.image).astype(np.uint16) << 2) for f in frames]
    settings = MonitorSettings(bit_depth=10)
    eight, ten, unknown = new_monitor(), new_monitor(settings=settings), new_monitor()
    for plain, wide in zip(frames, ten_bits, strict=True):
        expected, found = eight.process(plain), ten.process(wide)
        assert expected.cam_T_grip is not None and found.cam_T_grip is not None
        apart_m = np.subtract(expected.cam_T_grip.translation_m, found.cam_T_grip.translation_m)
        assert np.abs(apart_m).max() < 1e-5 and found.verdict is expected.verdict
        assert "black" in unknown.process(wide).reason and "monitor.bit_depth" in unknown.process(wide).reason
    brighter = replaced(ten_bits[-1], image=ten_bits[-1].image + np.uint16(200))
    assert "at most 1023 with monitor.bit_depth 10" in ten.process(brighter).reason
