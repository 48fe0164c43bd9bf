"""The simulator's truth and scripts against their equations; determinism; the files it writes."""

from __future__ import annotations

import csv
import json

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.simulated import PAPER_LENS, nominal_cam_T_grip, plain_scenario, simulator

from gripmon.simulate import SCENARIO_NAMES, Hidden, Scenario, make_scenario, write_sequence
from gripmon.simulate.disturbance import exposure, jaw_opening_m, law
from gripmon.simulate.scenario import (
    BentFinger,
    Bump,
    Creep,
    JawScript,
    Light,
    LightStep,
    Tilt,
    Vibration,
)

TCP = nominal_cam_T_grip()[:3, 3]


def paper_projection(points_cam_m: np.ndarray) -> np.ndarray:
    """Equations (3) and (4) solved by iteration, without the project's camera."""
    lens = PAPER_LENS
    ideal = points_cam_m[:, :2] / points_cam_m[:, 2:] * lens.fx_px
    distorted = ideal.copy()
    for _ in range(200):
        distorted = ideal / (1.0 + lens.kappa_per_px2 * (distorted**2).sum(axis=1, keepdims=True))
    return distorted + np.array([lens.cx_px, lens.cy_px])


# --- truth


def test_true_corner_pixels_are_the_projected_corners() -> None:
    sim = simulator(make_scenario("creep"))
    truth = sim.truth(400)
    corners = np.array([sim.gripper.model.points[name].xyz_m for name in truth.corner_ids])
    cam = corners @ truth.cam_T_grip[:3, :3].T + truth.cam_T_grip[:3, 3]
    np.testing.assert_allclose(truth.corner_uv_px, paper_projection(cam), atol=1e-6)


def test_reported_opening_has_the_offset_and_the_noise_asked_for() -> None:
    jaw = JawScript(reported_offset_m=0.0007, reported_noise_m=0.0002)
    sim = simulator(plain_scenario(jaw=jaw))
    errors = np.array([t.jaw_reported_m - t.jaw_opening_m for t in map(sim.truth, range(600))])
    assert errors.mean() == pytest.approx(0.0007, abs=3e-5)
    assert errors.std() == pytest.approx(0.0002, rel=0.1)
    assert simulator(plain_scenario(jaw=JawScript(reported=False))).truth(0).jaw_reported_m is None


def test_every_event_has_its_label() -> None:
    sim = simulator(make_scenario("demo", duration_s=20.0))
    events = [sim.truth(i).events for i in range(sim.frame_count)]
    assert events[0] == ()
    assert (
        "creep" in events[100] and "bumped" in events[310] and "ringing" in events[301] and "bumped" not in events[299]
    )
    assert any("hand" in e for e in events) and any("shadow" in e for e in events)


# --- scripts


@pytest.mark.parametrize("t_s", [0.0, 0.7, 1.0, 1.2, 3.3, 50.0])
def test_laws_follow_their_equations(t_s: float) -> None:
    since = t_s - 1.0
    after = since >= 0.0
    expected = 1.0 - np.exp(-since / 2.0) if after else 0.0
    assert law(Creep(start_s=1.0, time_s=2.0), t_s) == pytest.approx(expected)
    assert law(Creep(start_s=1.0, time_s=2.0, law="linear"), t_s) == pytest.approx(np.clip(since / 2.0, 0.0, 1.0))
    ringing = 1.0 - 0.3 * np.exp(-since / 0.2) * np.cos(2.0 * np.pi * 8.0 * since) if after else 0.0
    assert law(Bump(at_s=1.0, ring_fraction=0.3, ring_hz=8.0, ring_decay_s=0.2), t_s) == pytest.approx(ringing)
    shaking = np.sin(2.0 * np.pi * 13.0 * since) if 1.0 <= t_s < 4.0 else 0.0
    assert law(Vibration(start_s=1.0, end_s=4.0, frequency_hz=13.0), t_s) == pytest.approx(shaking, abs=1e-9)
    assert law(Tilt(start_s=1.0, time_s=0.4), t_s) == pytest.approx(np.sin(np.pi / 2 * np.clip(since / 0.4, 0, 1)) ** 2)


def test_a_bump_moves_the_tcp_by_its_shift_and_leaves_the_pivot() -> None:
    sim = simulator(plain_scenario(mount=(Bump(at_s=0.05, tcp_shift_m=(0.0002, 0.0045)),), duration_s=5.0))
    truth = sim.truth(149)
    np.testing.assert_allclose(truth.tcp_shift_m[:2], (0.0002, 0.0045), rtol=1e-9)
    motion = truth.cam_T_grip @ np.linalg.inv(truth.reference_cam_T_grip)
    pivot = np.array([*sim.scenario.pivot_cam_m, 1.0])
    np.testing.assert_allclose(motion @ pivot, pivot, atol=1e-12)
    assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)


def test_roll_and_translation_of_a_mount_motion() -> None:
    rolling = simulator(plain_scenario(mount=(Tilt(start_s=0.0, time_s=0.0, roll_deg=2.0),))).truth(30)
    np.testing.assert_allclose(rolling.tcp_shift_m, 0.0, atol=1e-12)
    turn = Rotation.from_matrix(rolling.cam_T_grip[:3, :3] @ rolling.reference_cam_T_grip[:3, :3].T).as_rotvec()
    lever = TCP - np.array(Scenario().pivot_cam_m)
    np.testing.assert_allclose(turn, np.deg2rad(2.0) * lever / np.linalg.norm(lever), atol=1e-12)
    shift = (0.001, -0.002, 0.003)
    shifted = simulator(plain_scenario(mount=(Tilt(start_s=0.0, time_s=0.0, translation_m=shift),))).truth(30)
    np.testing.assert_allclose(shifted.tcp_shift_m, shift, atol=1e-15)
    np.testing.assert_allclose(shifted.cam_T_grip[:3, :3], shifted.reference_cam_T_grip[:3, :3])


def test_a_bent_finger_turns_about_its_root_and_only_it() -> None:
    bend = BentFinger(finger="left", tip_shift_m=(0.0008, 0.0012, 0.0), start_s=0.5)
    sim = simulator(plain_scenario(bent_fingers=(bend,)))
    state, rest = sim._scene.at(2.0), sim.gripper.points_grip_m(None)
    moved = state.points_grip_m - rest
    left = sim.gripper.point_finger == 0
    np.testing.assert_array_equal(moved[~left], 0.0)
    tip, root = left & (rest[:, 2] == 0.0), left & (rest[:, 2] < 0.0)
    np.testing.assert_allclose(moved[tip].mean(axis=0)[:2], (0.0008, 0.0012), rtol=2e-3)
    np.testing.assert_allclose(moved[root].mean(axis=0), 0.0, atol=1e-12)
    lengths = [np.linalg.norm(p[left][:, None] - p[left][None], axis=-1) for p in (state.points_grip_m, rest)]
    np.testing.assert_allclose(*lengths, atol=1e-12)
    np.testing.assert_array_equal(sim.truth(0).finger_bend, np.tile(np.eye(4), (2, 1, 1)))


def test_jaw_knots() -> None:
    knots = ((1.0, 0.03), (2.0, 0.04), (4.0, 0.02))
    straight = JawScript(knots=knots, smooth=False)
    times = np.linspace(0.0, 5.0, 51)
    opening = [jaw_opening_m(straight, 0.034, t) for t in times]
    np.testing.assert_allclose(opening, np.interp(times, [1.0, 2.0, 4.0], [0.03, 0.04, 0.02]))
    smooth = JawScript(knots=knots)
    assert jaw_opening_m(smooth, 0.034, 1.25) == pytest.approx(0.03 + 0.01 * np.sin(np.pi / 8.0) ** 2)
    assert jaw_opening_m(JawScript(), 0.034, 3.0) == 0.034


def test_automatic_exposure_forgets_a_light_step_with_its_time_constant() -> None:
    light = Light(steps=(LightStep(at_s=1.0, factor=0.25),), auto_exposure_s=0.5)
    assert exposure(light, 0.99) == 1.0
    assert exposure(light, 1.0) == pytest.approx(0.25)
    assert np.log(exposure(light, 1.5)) == pytest.approx(np.log(0.25) / np.e)
    assert exposure(Light(steps=light.steps), 9.0) == pytest.approx(0.25)
    assert exposure(Light(flicker=0.1, flicker_hz=100.0), 0.0025) == pytest.approx(1.1)


@pytest.mark.parametrize("duration_s", [2.0, 20.0, 300.0])
def test_the_demo_shows_everything_at_any_length(duration_s: float) -> None:
    sim = simulator(make_scenario("demo", duration_s=duration_s, fps=60.0))
    count = sim.frame_count
    assert count == round(60.0 * duration_s)
    just_before, last = sim.truth(count // 2 - 1), sim.truth(count - 1)
    assert 0.0008 < just_before.tcp_shift_m[0] < 0.0013
    assert last.tcp_shift_m[1] - just_before.tcp_shift_m[1] == pytest.approx(0.0045, abs=1.5e-4)
    covered = [Hidden.COVER in sim.truth(i).hidden for i in range(0, count, max(count // 200, 1))]
    assert 0.05 < np.mean(covered) < 0.2
    assert not covered[0] and not covered[-1]


# --- refusals


@pytest.mark.parametrize(
    ("scenario", "text"),
    [
        (plain_scenario(jaw=JawScript(knots=((0.0, 0.09),))), "outside the gripper's jaw"),
        (plain_scenario(jaw=JawScript(knots=((1.0, 0.03), (1.0, 0.02)))), "times don't ascend"),
        (
            plain_scenario(bent_fingers=(BentFinger(finger="thumb", tip_shift_m=(0.0, 0.001, 0.0)),)),
            "no finger 'thumb'",
        ),
        (plain_scenario(mount=(Tilt(tcp_shift_m=(0.3, 0.0)),)), "a smaller shift"),
    ],
)
def test_scenarios_that_do_not_fit_are_refused(scenario: Scenario, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        simulator(scenario)


@pytest.mark.parametrize(
    "text",
    [
        "speed: 1",
        "duration_s: -1",
        "background: {kind: forest}",
        "mount: [{kind: creep, tme_s: 1}]",
        "sensor: {jpeg_quality: 101}",
    ],
)
def test_unknown_keys_and_absurd_values_are_refused(text: str) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.yaml.decode(text, type=Scenario)


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_scenarios_survive_yaml_and_can_be_simulated(name: str) -> None:
    scenario = make_scenario(name)
    assert msgspec.yaml.decode(msgspec.yaml.encode(scenario), type=Scenario) == scenario
    sim = simulator(scenario, sharp=False)
    first = sim.truth(0)
    assert first.visible.sum() == 6
    np.testing.assert_array_equal(first.cam_T_grip, first.reference_cam_T_grip)


def test_every_number_in_a_scenario_has_a_description() -> None:
    schema = msgspec.json.schema(Scenario)["$defs"]
    bare = [
        f"{struct}.{name}"
        for struct, definition in schema.items()
        for name, field in definition.get("properties", {}).items()
        if field.get("type") in ("number", "integer") and "description" not in field
    ]
    assert bare == []


# --- determinism and files


def test_frames_are_a_pure_function_of_their_index() -> None:
    scenario = make_scenario("demo", duration_s=8.0, fps=15.0)
    forwards, other = simulator(scenario, seed=4), simulator(scenario, seed=4)
    indices = (0, 1, 61, 7, 92, 60)
    images = {i: forwards.render(i) for i in indices}
    for i in reversed(indices):
        np.testing.assert_array_equal(other.render(i), images[i])
    assert not np.array_equal(simulator(scenario, seed=5).render(0), images[0])
    assert not np.array_equal(images[0], images[1])


def test_a_frame_carries_its_stamp_and_the_reported_opening() -> None:
    sim = simulator(make_scenario("static", fps=29.97), seed=2)
    frame, truth = sim.frame(100), sim.truth(100)
    assert frame.seq == 100
    assert frame.stamp_ns == truth.stamp_ns == sim.scenario.start_ns + round(100 / 29.97 * 1e9)
    assert frame.jaw_opening_m == truth.jaw_reported_m == 0.034
    assert frame.image is not None
    assert frame.image.shape == (576, 768) and frame.image.dtype == np.uint8
    with pytest.raises(IndexError):
        sim.truth(-1)


def test_a_written_sequence_reads_back(tmp_path) -> None:
    sim = simulator(make_scenario("bump", duration_s=0.4, fps=15.0))
    calls: list[tuple[int, int]] = []
    assert write_sequence(sim, tmp_path / "out", lambda done, total: calls.append((done, total))) == 6
    assert calls == [(k, 6) for k in range(1, 7)]
    with (tmp_path / "out" / "timestamps.csv").open() as file:
        rows = list(csv.DictReader(file))
    lines = [json.loads(line) for line in (tmp_path / "out" / "truth.jsonl").read_text().splitlines()]
    assert len(rows) == len(lines) == 6
    for index, (row, line) in enumerate(zip(rows, lines, strict=True)):
        truth = sim.truth(index)
        assert row["file"] == line["file"]
        assert int(row["stamp_ns"]) == line["stamp_ns"] == truth.stamp_ns
        assert float(row["jaw_opening_m"]) == line["jaw_reported_m"] == truth.jaw_reported_m
        np.testing.assert_array_equal(line["cam_T_grip"], truth.cam_T_grip)
        np.testing.assert_array_equal([c["uv_px"] for c in line["corners"]], truth.corner_uv_px)
        assert [c["hidden"] for c in line["corners"]] == list(truth.hidden)
        image = cv2.imread(str(tmp_path / "out" / row["file"]), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(image, sim.render(index))
    with pytest.raises(FileExistsError):
        write_sequence(sim, tmp_path / "out")
