"""The look in the monitor: finer, never less true, and without a trace where it is switched off."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from support.meters import box_gripper
from support.simulated import PAPER_LENS, simulator
from support.watched import reference_of

from gripmon.judge.drift import DriftSettings
from gripmon.model.camera import make_camera
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import Array, Command, CommandName, Frame, FrameRecord, MonitorState, Verdict, to_json
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.monitor.finer import DIFFERENT_S
from gripmon.monitor.settings import LookSettings
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, Creep, FingerLook
from gripmon.track.look import LookAlignment
from gripmon.track.look.layout import finger_depths_m

FPS = 5.0
CLUTTER = Background(boxes=45, cables=14, contrast=0.9, speed_m_per_s=0.1)
FINGERS = FingerLook(texture=0.15, carriers=False)
FRAMES = 60


def filmed(frames: int = FRAMES, fps: float = FPS, **settings: object) -> Simulator:
    scenario = Scenario(duration_s=frames / fps, fps=fps, background=CLUTTER, fingers=FINGERS, **settings)  # type: ignore[arg-type]
    return simulator(scenario, sharp=False)


def new_monitor(simulation: Simulator, enabled: bool, state: MonitorState | None = None) -> Monitor:
    settings = MonitorSettings(
        jaw_sigma_m=0.0,
        drift=DriftSettings(frames_per_s=simulation.scenario.fps),
        look=LookSettings(enabled=enabled),
    )
    reference = reference_of(simulation.truth(0).cam_T_grip)
    return Monitor(make_camera(PAPER_LENS), box_gripper(sharp=False), settings, reference, state=state)


@cache
def frames_of_clutter() -> tuple[Simulator, tuple[Frame, ...]]:
    simulation = filmed()
    return simulation, tuple(simulation.frame(i) for i in range(FRAMES))


def watched(monitor: Monitor, frames: tuple[Frame, ...]) -> list[FrameRecord]:
    return [monitor.process(frame) for frame in frames]


@cache
def with_and_without() -> tuple[list[FrameRecord], list[FrameRecord]]:
    simulation, frames = frames_of_clutter()
    return watched(new_monitor(simulation, True), frames), watched(new_monitor(simulation, False), frames)


def errors_m(simulation: Simulator, records: list[FrameRecord]) -> Array:
    """(n, 6) from what is published to the truth."""
    out = []
    for i, record in enumerate(records):
        assert record.cam_T_grip is not None
        out.append(perturbation_between(from_record(record.cam_T_grip), simulation.truth(i).cam_T_grip))
    return np.array(out)


def test_switched_off_it_leaves_no_trace(monkeypatch: pytest.MonkeyPatch):
    simulation, frames = frames_of_clutter()
    before = [to_json(record) for record in with_and_without()[1][:5]]

    def refuse(*_: object) -> None:
        raise AssertionError("built although it is off")

    monkeypatch.setattr(LookAlignment, "__init__", refuse)
    without = watched(new_monitor(simulation, False), frames[:5])
    assert [to_json(record) for record in without] == before
    assert not MonitorSettings().look.enabled


def test_until_it_is_learnt_nothing_differs_and_then_it_is_finer():
    refined, plain = with_and_without()
    same = [to_json(one) == to_json(other) for one, other in zip(refined, plain, strict=True)]
    assert all(same[:12]) and not any(same[30:])
    simulation, _ = frames_of_clutter()
    late = slice(30, None)
    edges_m, fused_m = errors_m(simulation, plain)[late], errors_m(simulation, refined)[late]
    assert (fused_m[:, 1:3].std(axis=0) < 0.6 * edges_m[:, 1:3].std(axis=0)).all()
    assert fused_m[:, 0].std() < edges_m[:, 0].std()


def test_no_bound_is_smaller_for_it_and_every_one_holds():
    refined, plain = with_and_without()
    simulation, _ = frames_of_clutter()
    errors = errors_m(simulation, refined)
    for one, other, error in zip(refined, plain, errors, strict=True):
        assert one.protection is not None and other.protection is not None
        assert np.linalg.norm(error[:3]) < one.protection.position_m
        assert one.cam_T_grip is not None and other.cam_T_grip is not None
        way = perturbation_between(from_record(other.cam_T_grip), from_record(one.cam_T_grip))
        # The edges were measured from a pose that is some micrometres off the other's.
        assert one.protection.position_m > 0.95 * other.protection.position_m + 0.95 * np.linalg.norm(way[:3])
        assert one.covariance == pytest.approx(other.covariance, rel=0.5, abs=1e-11)
        assert other.verdict is Verdict.VALID or one.verdict is not Verdict.VALID


def test_the_same_frames_give_the_same_bytes():
    simulation, frames = frames_of_clutter()
    again = watched(new_monitor(simulation, True), frames)
    assert [to_json(r) for r in again] == [to_json(r) for r in with_and_without()[0]]


ORDERS = (20, CommandName.RECALIBRATE), (45, CommandName.ACCEPT), (FRAMES - 5, CommandName.UNDO)


def test_a_new_reference_and_its_undo_move_nothing():
    simulation, frames = frames_of_clutter()
    monitor, records, answered = new_monitor(simulation, True), [], []
    for i, frame in enumerate(frames):
        for at, name in ORDERS:
            if i == at:
                answered.append(monitor.command(Command(name), frame.stamp_ns))
        records.append(monitor.process(frame))
    assert all(reply.done for reply in answered), answered
    assert len({record.revision for record in records}) == 3
    commanded, alone = errors_m(simulation, records), errors_m(simulation, with_and_without()[0])
    assert np.abs(commanded - alone)[:, :3].max() < 5e-6


def test_after_a_restart_the_edges_count_until_it_is_learnt_again():
    simulation, frames = frames_of_clutter()
    monitor = new_monitor(simulation, True)
    watched(monitor, frames[:30])
    state = monitor.state()
    on, off = (new_monitor(simulation, enabled, state) for enabled in (True, False))
    assert to_json(on.process(frames[30])) == to_json(off.process(frames[30]))


def test_a_hand_for_a_minute_at_the_start_does_not_stay_part_of_the_gripper():
    """It covers the rear of one finger, stands still with the gripper, and is as rich in texture."""
    simulation = filmed(frames=200, fps=2.0)
    rng, hand_until = np.random.default_rng(8), 120
    hand = np.clip(rng.normal(120.0, 40.0, (140, 200)), 0, 255).astype(np.uint8)
    monitor = new_monitor(simulation, True)
    finer, records = monitor._trust._finer, []
    assert finer is not None
    for i in range(200):
        frame = simulation.frame(i)
        assert frame.image is not None
        if i < hand_until:
            frame.image[-140:, :200] = hand
        records.append(monitor.process(frame))
        if i == hand_until - 1:
            assert hand_blocks(finer._alignment, hand) > 3  # it was learnt
    assert hand_blocks(finer._alignment, hand) == 0
    errors = errors_m(simulation, records)[hand_until:]
    assert np.abs(errors[:, :3]).max() < 3e-5
    assert finer._alignment.ready


def hand_blocks(alignment: LookAlignment, hand: Array) -> int:
    """Measured blocks that were learnt to look like the hand in the image's lower left corner."""
    placed = alignment._measured
    assert placed is not None
    count = 0
    for uv_px, mean, weight in zip(placed.base_px, alignment._mean_in, alignment._weight_in, strict=True):
        u, v = np.rint(uv_px).astype(int).T
        if u.max() < 200 and v.min() >= 576 - 140 and weight.any():
            count += int(np.corrcoef(mean, hand[v - 576 + 140, u])[0, 1] > 0.5)
    return count


def test_a_finger_that_looks_different_for_minutes_is_told_once():
    """A finger is painted over while nothing moves; a frame every ten seconds."""
    simulation = filmed(frames=90, fps=0.1)
    paint = np.clip(np.random.default_rng(3).normal(0.0, 40.0, (576, 300)), -90, 90)
    monitor, told = new_monitor(simulation, True), []
    for i in range(90):
        frame = simulation.frame(i)
        assert frame.image is not None
        if i >= 20:
            depth_m = finger_depths_m(simulation.camera, simulation.gripper, simulation.truth(i).cam_T_grip, None)[0]
            left = frame.image[:, :300]
            inside = cv2.erode(np.isfinite(depth_m).astype(np.uint8), np.ones((5, 5), np.uint8))[:, :300] > 0
            left[inside] = np.clip(left + paint, 0, 255)[inside]
        told += [(i, alert.text) for alert in monitor.process(frame).alerts if "looks different" in alert.text]
    ((at, text),) = told
    assert f"finger {simulation.gripper.finger_ids[0]}, for" in text
    assert at >= 20 + DIFFERENT_S / 10.0


@pytest.mark.slow("half a minute; test_a_creep_of_a_micrometre_a_minute_is_no_bias guards the filter in less")
def test_a_creep_of_a_micrometre_a_minute_shows():
    minutes, fps = 10.0, 0.5
    frames = int(60 * minutes * fps)
    creep = Creep(law="linear", time_s=60.0 * minutes, tcp_shift_m=(1e-6 * minutes, 0.0))
    simulation = filmed(frames=frames, fps=fps, mount=(creep,))
    monitor = new_monitor(simulation, True)
    records = [monitor.process(simulation.frame(i)) for i in range(frames)]
    x_um = np.array([1e6 * from_record(r.cam_T_grip)[0, 3] for r in records if r.cam_T_grip is not None])
    assert len(x_um) == frames
    late = slice(60, None)  # learnt by then
    per_minute = np.polyfit(np.arange(frames)[late] / fps / 60.0, x_um[late], 1)[0]
    assert per_minute == pytest.approx(1.0, abs=0.15)
