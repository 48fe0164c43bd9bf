"""``tools/servo``: the closed loop, first with perfect information, then by a real monitor over Zenoh."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gripmon.model.geometry import exp_rotation, invert, make_transform
from gripmon.model.records import Verdict

pytest.importorskip("pinocchio")
FPS = 30.0

pytestmark = pytest.mark.usefixtures("tools_importable")


class World:
    """An arm before an object, seen without noise; ``told`` is what the controller gets for frame k."""

    def __init__(self, seed: int = 0) -> None:
        from servoing import stage
        from servoing.arm import Arm
        from servoing.controller import Servo

        self.arm = Arm()
        self.base_T_object, start = stage.placement(self.arm, np.random.default_rng(seed))
        self.servo = Servo(self.arm, start, FPS)
        self.frame = 0
        self.cam_T_grip = make_transform(exp_rotation(np.array([0.5, 0.0, 0.0])), np.array([0.001, 0.002, 0.119]))

    def grip_T_object(self) -> np.ndarray:
        return invert(self.arm.base_T_grip(self.servo.q)) @ self.base_T_object

    def step(self, given, *, seen: bool = True) -> bool:
        """A frame; whether the arm moved before it."""
        before = self.servo.q
        self.servo.advance(1.0 / FPS)
        cam_T_object = self.cam_T_grip @ self.grip_T_object()
        self.servo.decide(self.frame / FPS, 1.0 / FPS, given, cam_T_object if seen else None)
        self.frame += 1
        return bool((self.servo.q != before).any())

    def go(self, given, seconds: float, *, seen: bool = True) -> list[bool]:
        return [self.step(given, seen=seen) for _ in range(round(seconds * FPS))]


def given(pose, verdict=Verdict.VALID, sigma_m=1e-6, **more):
    from servoing.controller import Given

    return Given(pose, verdict, sigma_m, **more)


@pytest.mark.parametrize("seed", range(2))
def test_with_perfect_information_it_ends_at_the_object(seed: int):
    from servoing import stage

    world = World(seed)
    moved = world.go(given(world.cam_T_grip), stage.BEGIN_S)
    assert not any(moved)
    world.go(given(world.cam_T_grip), stage.APPROACH_S + stage.SETTLE_S)
    assert world.servo.grasped and not world.servo.stopped_by_range
    assert np.linalg.norm(world.grip_T_object()[:3, 3]) < 2e-5
    np.testing.assert_allclose(world.grip_T_object()[:3, :3], np.eye(3), atol=1e-3)


def test_with_a_wrong_transform_it_ends_off_by_just_that():
    """Where the controller sees no error, ``wrong^-1 cam_T_object`` is the identity: the object is off by the rest."""
    from servoing import stage

    world = World()
    wrong = (
        make_transform(exp_rotation(np.array([0.01, -0.02, 0.0])), np.array([0.003, -0.002, 0.001])) @ world.cam_T_grip
    )
    world.go(given(wrong), stage.BEGIN_S + stage.APPROACH_S + stage.SETTLE_S)
    assert world.servo.grasped
    expected = invert(world.cam_T_grip) @ wrong
    assert np.linalg.norm(expected[:3, 3]) > 3e-3
    np.testing.assert_allclose(world.grip_T_object(), expected, atol=1e-3)
    np.testing.assert_allclose(world.grip_T_object()[:3, 3], expected[:3, 3], atol=3e-5)


def test_it_stands_still_on_unknown_and_stale_and_goes_on_when_it_may():
    from servoing import stage

    world = World()
    good = given(world.cam_T_grip)
    world.go(good, stage.BEGIN_S)
    assert all(world.go(good, 1.0)[1:])
    for bad in (
        given(None, Verdict.UNKNOWN, None),
        given(world.cam_T_grip, Verdict.UNKNOWN, 1e-6),
        given(world.cam_T_grip, Verdict.VALID, 1e-6, age_s=1.0),
        given(None, Verdict.VALID, None),
    ):
        world.step(bad)  # by the command from before
        q = world.servo.q
        assert not any(world.go(bad, 0.5))
        # What is suspect begins no motion, what is valid does.
        assert not any(world.go(given(world.cam_T_grip, Verdict.SUSPECT), 0.2))
        np.testing.assert_array_equal(world.servo.q, q)
        assert world.go(good, 0.2)[-1]
    fast = np.linalg.norm(
        np.diff([world.arm.base_T_grip(world.servo.q)[:3, 3] for _ in range(4) if world.step(good)], axis=0), axis=1
    )
    slow_frames = given(world.cam_T_grip, Verdict.SUSPECT)
    world.step(slow_frames)
    slow = np.linalg.norm(
        np.diff([world.arm.base_T_grip(world.servo.q)[:3, 3] for _ in range(4) if world.step(slow_frames)], axis=0),
        axis=1,
    )
    assert len(slow) == 3 and slow.max() < 0.5 * fast.min()
    world.go(good, stage.APPROACH_S + stage.SETTLE_S)
    assert world.servo.grasped


def test_nothing_is_grasped_by_what_is_suspect():
    from servoing import stage

    world = World()
    good, unsure = given(world.cam_T_grip), given(world.cam_T_grip, Verdict.SUSPECT)
    world.go(good, stage.BEGIN_S + 0.5 * stage.APPROACH_S)
    world.go(unsure, 4.0 * (stage.APPROACH_S + stage.SETTLE_S))
    assert np.linalg.norm(world.grip_T_object()[:3, 3]) < 2e-5  # it is there, but doesn't close
    assert not world.servo.grasped
    world.go(good, 1.0)
    assert world.servo.grasped


def test_a_real_monitor_over_zenoh_brings_the_arm_to_the_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The whole loop once, with a hand in the view: half the usual frames, so that it doesn't take long."""
    from benchmarks.kit import Report
    from servoing import report, runs, stage
    from servoing.figures import conduct, figures, targets

    row, steps = stage.ROWS[3], []
    run = runs.run(row, 0, 3, 15.0, realtime=False, step=lambda: steps.append(1))
    assert run.missed == 0 and len(steps) == len(run.time_s) == round(15.0 * stage.duration_s(row))
    off_m = {source: float(track.distance_m[-1]) for source, track in run.tracks.items()}
    assert off_m["without"] > 3e-3 and off_m["truth"] < 3e-5
    for source in ("gripmon", "smoothed"):
        assert off_m[source] < off_m["truth"] + 5e-5, off_m
        own = conduct(run, run.tracks[source])
        assert own.unknown > 5 and own.breaches == 0
    # The rule is one that arms without it break in this very run.
    assert conduct(run, run.tracks["truth"]).moved_on_unknown > 5
    assert all(target.met for target in targets(figures([run])))
    said = Report("tools/servo")
    report.show([run], said)
    assert said.end(tmp_path / "servo.json", None) == 0
    text = capsys.readouterr().out
    assert "MISSED" not in text and text.count("| 4.5 mm, then a hand |") == 4
    # Past policy.limit_m the reference is measured again, and the arm is under way by both.
    assert set(run.revision) == {0, 1} and "before the fingers closed: 1 of 1" in text
    values = json.loads((tmp_path / "servo.json").read_text())
    assert [each["source"] for each in values["rows"]] == list(runs.SOURCES)
    assert values["rows"][1]["final_m"] == [off_m["gripmon"]]
