"""The look in the monitor: finer, never less true, and without a trace where it is switched off."""

from __future__ import annotations

from functools import cache

import cv2
import msgspec
import numpy as np
import pytest
from support.meters import box_gripper
from support.simulated import PAPER_LENS, simulator
from support.watched import reference_of

from gripmon.judge.drift import DriftSettings
from gripmon.judge.policy import PolicySettings
from gripmon.judge.statefile import Calibration, Owner, pack, unpack
from gripmon.model.camera import make_camera
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import (
    AlertKind,
    Array,
    Command,
    CommandName,
    FinerLookRecord,
    Frame,
    FrameRecord,
    MonitorState,
    Severity,
    Verdict,
    to_json,
)
from gripmon.monitor import Monitor, MonitorSettings, finer
from gripmon.monitor.finer import RENEWED_AFTER_S
from gripmon.monitor.settings import LookSettings
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, Creep, FingerLook, Tilt
from gripmon.track.look import LookAlignment
from gripmon.track.look.layout import finger_depths_m

FPS = 5.0
CLUTTER = Background(boxes=45, cables=14, contrast=0.9, speed_m_per_s=0.1)
FINGERS = FingerLook(texture=0.15, carriers=False)
FRAMES = 60


def filmed(frames: int = FRAMES, fps: float = FPS, **settings: object) -> Simulator:
    scenario = Scenario(duration_s=frames / fps, fps=fps, background=CLUTTER, fingers=FINGERS, **settings)  # type: ignore[arg-type]
    return simulator(scenario, sharp=False)


def new_monitor(
    simulation: Simulator, enabled: bool, state: MonitorState | None = None, policy: PolicySettings | None = None
) -> Monitor:
    settings = MonitorSettings(
        policy=policy or PolicySettings(),
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
    return errors_m_of(simulation, records, 0)


def errors_m_of(simulation: Simulator, records: list[FrameRecord], first: int) -> Array:
    """The same of records from the frame ``first`` on."""
    out = []
    for i, record in enumerate(records, first):
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
        covariances = (np.reshape(each.covariance, (6, 6)) for each in (one, other))
        sigma = np.sqrt(np.diag(np.reshape(other.covariance, (6, 6))))
        finer, usual = (covariance / np.outer(sigma, sigma) for covariance in covariances)
        np.testing.assert_allclose(np.diag(finer), 1.0, atol=0.5)
        np.testing.assert_allclose(finer, usual, atol=0.25)
        assert other.verdict is Verdict.VALID or one.verdict is not Verdict.VALID


def test_the_same_frames_give_the_same_bytes():
    simulation, frames = frames_of_clutter()
    again = watched(new_monitor(simulation, True), frames)
    assert [to_json(r) for r in again] == [to_json(r) for r in with_and_without()[0]]


def test_it_is_the_same_whoever_learns():
    """In a stream a frame is learnt once its record is out, in a replay when the next one comes."""
    simulation, frames = frames_of_clutter()
    monitor, records = new_monitor(simulation, True), []
    for frame in frames:
        records.append(monitor.process(frame))
        monitor.learn()
    assert [to_json(r) for r in records] == [to_json(r) for r in with_and_without()[0]]


def test_no_frame_loses_its_validity_to_a_finer_pose():
    """With an alert limit in the midst of the bounds; where there is room, the look refines all the same."""
    simulation, frames = frames_of_clutter()
    bounds_m = [record.protection.position_m for record in with_and_without()[1][12:] if record.protection]
    policy = PolicySettings(alert_limit_m=float(np.median(bounds_m)))
    with_look, without = (watched(new_monitor(simulation, enabled, policy=policy), frames) for enabled in (True, False))
    kept = [one.verdict is Verdict.VALID for one, other in pairs(with_look, without) if other.verdict is Verdict.VALID]
    assert 10 < len(kept) < FRAMES - 10 and np.mean(kept) > 0.95
    assert sum(to_json(one) != to_json(other) for one, other in pairs(with_look, without)) > 30


def pairs(one: list[FrameRecord], other: list[FrameRecord]) -> list[tuple[FrameRecord, FrameRecord]]:
    return list(zip(one, other, strict=True))


@pytest.mark.parametrize("plain", [(0, 1), (0,)], ids=["all", "one"])
def test_fingers_without_texture_lose_nothing(plain: tuple[int, ...]):
    """Their inside is of one shade, and noise: nothing is valid less often, or farther off."""
    simulation = filmed()
    frames = tuple(without_texture(simulation, i, plain) for i in range(FRAMES))
    with_look, without = (watched(new_monitor(simulation, enabled), frames) for enabled in (True, False))
    assert all(one.verdict is other.verdict for one, other in pairs(with_look, without))
    rms_m = [
        np.sqrt(np.square(errors_m(simulation, records)[12:, :3]).mean(axis=0)) for records in (with_look, without)
    ]
    assert (rms_m[0] < 1.02 * rms_m[1]).all()


def without_texture(simulation: Simulator, i: int, fingers: tuple[int, ...]) -> Frame:
    frame, truth = simulation.frame(i), simulation.truth(i)
    assert frame.image is not None
    depths_m = finger_depths_m(simulation.camera, simulation.gripper, truth.cam_T_grip, truth.jaw_opening_m)
    noise = np.random.default_rng(i).normal(0.0, 1.5, frame.image.shape)
    for f in fingers:
        inside = cv2.erode(np.isfinite(depths_m[f]).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        frame.image[inside] = np.clip(np.median(frame.image[inside]) + noise[inside], 0, 255).astype(np.uint8)
    return frame


def test_a_finger_or_a_jaw_that_is_astray_is_left_to_the_edges(monkeypatch: pytest.MonkeyPatch):
    """They leave out what isn't where it should be; a look that takes the gripper for rigid doesn't."""
    simulation, frames = frames_of_clutter()
    monitor, edges = (new_monitor(simulation, enabled) for enabled in (True, False))
    for each in (monitor, edges):
        watched(each, frames[:20])
        each.learn()
    views = alignment_of(monitor).views
    monkeypatch.setattr(finer, "gripper_astray", lambda *_: True)
    for frame in frames[20:24]:
        one, other = (errors_m_of(simulation, [each.process(frame)], frame.seq)[0, :3] for each in (monitor, edges))
        assert np.abs(one - other).max() < 5e-8
    assert alignment_of(monitor).views == views


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


def kept(monitor: Monitor) -> MonitorState:
    """The state as it comes back from its file."""
    monitor.learn()
    data = pack(OWNER, monitor.state())
    return unpack(data).state


OWNER = Owner("arm1", "wrist", Calibration("c", "g", "r"))


def finer_of(state: MonitorState) -> FinerLookRecord:
    assert state.look is not None and state.look.finer is not msgspec.UNSET
    return state.look.finer


@cache
def state_of_thirty() -> MonitorState:
    simulation, frames = frames_of_clutter()
    monitor = new_monitor(simulation, True)
    watched(monitor, frames[:30])
    return kept(monitor)


def test_a_restart_goes_on_with_the_look():
    simulation, frames = frames_of_clutter()
    on, off = (watched(new_monitor(simulation, enabled, state_of_thirty()), frames[30:]) for enabled in (True, False))
    assert to_json(on[0]) != to_json(off[0])  # it refines from the first frame on
    never_stopped = errors_m(simulation, with_and_without()[0])[30:, :3]
    restarted = errors_m_of(simulation, on, 30)[:, :3]
    assert np.abs(restarted - never_stopped).max() < 4e-6
    edges = errors_m(simulation, with_and_without()[1])[30:, :3]
    assert (restarted[:, 1:].std(axis=0) < 0.7 * edges[:, 1:].std(axis=0)).all()


def test_what_is_kept_names_its_version_and_where_it_comes_from():
    _, frames = frames_of_clutter()
    version = finer_of(state_of_thirty()).version
    assert (version.number, version.origin) == (1, "start")
    assert (version.reference_id, version.revision) == ("factory-1", 1)
    assert version.first_stamp_ns == frames[0].stamp_ns and version.last_stamp_ns == frames[29].stamp_ns
    assert len(msgspec.json.encode(state_of_thirty())) < 250_000


def test_a_replay_from_the_kept_state_gives_the_same_bytes():
    simulation, frames = frames_of_clutter()
    once, again = (watched(new_monitor(simulation, True, state_of_thirty()), frames[30:40]) for _ in range(2))
    assert [to_json(one) for one in once] == [to_json(other) for other in again]


def test_switched_off_the_state_is_what_it_was():
    simulation, frames = frames_of_clutter()
    monitor = new_monitor(simulation, False)
    watched(monitor, frames[:5])
    monitor.learn()
    state = monitor.state()
    assert state.look is not None and b"finer" not in msgspec.json.encode(state)


def changed(state: MonitorState, **change: object) -> MonitorState:
    record = msgspec.structs.replace(finer_of(state), **change)
    return msgspec.structs.replace(state, look=msgspec.structs.replace(state.look, finer=record))


def spoilt(state: MonitorState, part: str) -> MonitorState:
    record = finer_of(state)
    pixels, bias = record.pixels, record.bias
    assert bias is not None
    damage = {
        "edges": {"edges": "taught"},
        "cut": {"pixels": msgspec.structs.replace(pixels, mean=pixels.mean[:-3])},
        "short": {"pixels": msgspec.structs.replace(pixels, mean=pixels.mean[: -4 * 64])},
        "nan": {"pixels": msgspec.structs.replace(pixels, variance=b"\xff" * len(pixels.variance))},
        "blocks": {"pixels": msgspec.structs.replace(pixels, blocks=b"\x01\x00" * (len(pixels.blocks) // 2))},
        "bias": {"bias": msgspec.structs.replace(bias, covariance=(0.0,) * 36)},
        "fingers": {"different_since_ns": (None,)},
    }
    return changed(state, **damage[part])


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        ("edges", "taught otherwise"),
        ("cut", "cut off"),
        ("short", "belong together"),
        ("nan", "can't be"),
        ("blocks", "other blocks"),
        ("bias", "bias can't be"),
        ("fingers", "number of fingers"),
    ],
)
def test_a_kept_look_that_does_not_fit_is_refused_and_the_edges_count_alone(part: str, reason: str):
    simulation, frames = frames_of_clutter()
    monitor = new_monitor(simulation, True, spoilt(state_of_thirty(), part))
    assert monitor.look_refused is not None and reason in monitor.look_refused
    edges = new_monitor(simulation, False, state_of_thirty())
    assert to_json(monitor.process(frames[30])) == to_json(edges.process(frames[30]))


def test_a_restart_after_a_new_reference_keeps_the_look_and_whose_it_is():
    simulation, frames = frames_of_clutter()
    monitor = new_monitor(simulation, True)
    for i, frame in enumerate(frames[:50]):
        for at, name in ORDERS[:2]:
            if i == at:
                assert monitor.command(Command(name), frame.stamp_ns).done
        monitor.process(frame)
    state = kept(monitor)
    assert state.references[-1].revision == 2 and finer_of(state).version.revision == 1
    again = new_monitor(simulation, True, state)
    assert again.look_refused is None
    on = watched(again, frames[50:])
    never_stopped = errors_m(simulation, with_and_without()[0])[50:, :3]
    assert np.abs(errors_m_of(simulation, on, 50)[:, :3] - never_stopped).max() < 6e-6
    undone = again.command(Command(CommandName.UNDO), frames[-1].stamp_ns)
    assert undone.done
    assert finer_of(kept(again)).pixels.views > finer_of(state).pixels.views


def test_a_hand_for_a_minute_at_the_start_does_not_stay_part_of_the_gripper():
    """It covers the rear of one finger, stands still with the gripper, and is as rich in texture."""
    simulation = filmed(frames=200, fps=2.0)
    rng, hand_until = np.random.default_rng(8), 120
    hand = np.clip(rng.normal(120.0, 40.0, (140, 200)), 0, 255).astype(np.uint8)
    monitor = new_monitor(simulation, True)
    watching, records = [monitor], []
    for i in range(200):
        frame = simulation.frame(i)
        assert frame.image is not None
        if i < hand_until:
            frame.image[-140:, :200] = hand
        records.append([each.process(frame) for each in watching])
        if i == hand_until - 1:
            assert hand_blocks(alignment_of(monitor), hand) > 3  # it was learnt
            watching.append(new_monitor(simulation, True, kept(monitor)))
        if i == hand_until:
            assert hand_blocks(alignment_of(watching[1]), hand) > 3  # and kept over a restart
    for number, each in enumerate(watching):
        assert hand_blocks(alignment_of(each), hand) == 0
        assert alignment_of(each).ready
        after = errors_m_of(simulation, [those[number] for those in records[hand_until:]], hand_until)
        assert np.abs(after[:, :3]).max() < 3e-5


def alignment_of(monitor: Monitor) -> LookAlignment:
    refining = monitor._trust._finer
    assert refining is not None
    return refining._alignment


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
        told += [(i, alert) for alert in monitor.process(frame).alerts if alert.kind is AlertKind.LOOK]
    (learnt_at, first), (at, alert), _ = told
    assert learnt_at < 20 and first.severity is Severity.INFO
    assert f"looks different: finger {simulation.gripper.finger_ids[0]}, since 20" in alert.text
    assert at >= 20 + RENEWED_AFTER_S / 10.0
    painted_ns, found_ns = (simulation.frame(i).stamp_ns for i in (20, at))
    assert alert.since_ns is not None and painted_ns <= alert.since_ns <= found_ns - 1e9 * RENEWED_AFTER_S
    notes = [each.look for _, each in told]
    assert [note.version.number for note in notes if note is not msgspec.UNSET] == [1, 1, 2]
    note = alert.look
    assert note is not msgspec.UNSET
    # The blocks that differ lie on the painted finger, and are most of it.
    painted = np.array(note.places_px)[:, 0] < 300
    assert painted[list(note.different)].all() and len(note.different) > 0.5 * painted.sum()
    assert notes[2] is not msgspec.UNSET and "looked different" in notes[2].version.origin


def test_a_creep_of_a_micrometre_a_minute_is_never_learnt_as_look():
    """An hour, a frame every 40 s, a restart after half of it: what is published follows the whole way."""
    minutes, every_s = 60.0, 40.0
    frames = int(60.0 * minutes / every_s)
    creep = Creep(law="linear", time_s=60.0 * minutes, tcp_shift_m=(1e-6 * minutes, 0.0))
    simulation = filmed(frames=frames, fps=1.0 / every_s, mount=(creep,))
    monitor, records = new_monitor(simulation, True), []
    for i in range(frames):
        records.append(monitor.process(simulation.frame(i)))
        if i == frames // 2:
            monitor = new_monitor(simulation, True, kept(monitor))
    late = slice(20, None)  # learnt by then
    at_min = np.arange(frames)[late] * every_s / 60.0
    off_um = 1e6 * errors_m(simulation, records)[late, 0]
    assert abs(np.polyfit(at_min, off_um, 1)[0]) < 0.05
    assert np.abs(off_um).max() < 5.0
    # The look itself was learnt where both had it: it still shows the whole motion.
    bias = finer_of(kept(monitor)).bias
    assert bias is not None and abs(bias.bias[0]) < 3e-6


@cache
def stepped() -> tuple[Simulator, tuple[Frame, ...]]:
    """Learning, then 0.05 mm across at once."""
    step = Tilt(start_s=STEP_FRAME / FPS - 0.5 / FPS, time_s=0.0, tcp_shift_m=(5e-5, 0.0))
    simulation = filmed(frames=STEP_FRAME + 10, mount=(step,))
    return simulation, tuple(simulation.frame(i) for i in range(STEP_FRAME + 10))


STEP_FRAME = 90


def test_a_step_of_a_twentieth_of_a_millimetre_is_told_in_its_third_frame_and_by_the_edges_alone_in_none():
    simulation, frames = stepped()
    told: list[list[int]] = [[], []]
    for enabled in (True, False):
        for record in watched(new_monitor(simulation, enabled), frames):
            kinds = {alert.kind for alert in record.alerts}
            told[enabled] += [record.seq] if kinds & {AlertKind.STEP, AlertKind.DRIFT} else []
    assert not told[False]
    assert told[True] and STEP_FRAME < told[True][0] <= STEP_FRAME + 2
