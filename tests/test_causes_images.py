"""Causes from simulated images: the fingers are measured one by one, and the judge names what moved."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from support.meters import JAW_SIGMA_M, NARROW, box_gripper, meter
from support.shown_edges import OPENING_M, REFERENCE_SIGMA
from support.simulated import PAPER_LENS, nominal_cam_T_grip
from support.watched import new_monitor

from gripmon.judge.causes import CauseJudge, CauseSettings
from gripmon.model.camera import make_camera
from gripmon.model.records import Cause, EdgeEvidence, Explanation, Image
from gripmon.monitor import MonitorSettings
from gripmon.simulate import Scenario, Simulator, paper_rig
from gripmon.simulate.scenario import Background, BentFinger, Cover, Defocus, ObjectLook, Prop, Tilt
from gripmon.track.edges import FingertipMeter

FPS, WELL, AFTER = 30.0, 6, 5
AT_S = (WELL - 0.5) / FPS
PLAIN = Background(kind="plain", boxes=0, cables=0)
CAMERA = make_camera(PAPER_LENS)


def simulated(**changes: Any) -> Simulator:
    scenario = Scenario(name="causes", fps=FPS, duration_s=1.0, **changes)
    return paper_rig(box_gripper()).simulator(scenario, 3)


class Watching:
    """A meter that follows the gripper, and a judge."""

    def __init__(self) -> None:
        self.meter: FingertipMeter = meter()
        self.judge = CauseJudge(CAMERA, box_gripper(), CauseSettings(), REFERENCE_SIGMA, JAW_SIGMA_M, 2e-4)
        self.pose = nominal_cam_T_grip()

    def look(self, image: Image, reported_m: float = OPENING_M) -> EdgeEvidence:
        measurement = self.meter.measure(image, self.pose, reported_m, 0.8, NARROW)
        if measurement.trusted:
            self.pose = measurement.cam_T_grip
        return self.meter.evidence(image, measurement, nominal_cam_T_grip())


def explained(before: Simulator, after: Simulator, wrong_m: float = 0.0) -> tuple[Explanation, EdgeEvidence]:
    """Six frames of one simulator, then five of another."""
    watching = Watching()
    for index in range(WELL):
        watching.judge.well(watching.look(before.render(index)))
    for index in range(WELL, WELL + AFTER):
        watching.judge.add(watching.look(after.render(index), OPENING_M + wrong_m))
    evidence = watching.look(after.render(WELL + AFTER), OPENING_M + wrong_m)
    return watching.judge.explanation(nominal_cam_T_grip()), evidence


def test_nothing_is_named_when_nothing_happens():
    scene = simulated()
    assert explained(scene, scene)[0].probable.cause is Cause.UNKNOWN


@pytest.mark.parametrize(
    ("finger", "tip_shift_m"),
    [("left", (2e-4, 2e-4, 0.0)), ("right", (-8e-4, 3e-4, 0.0))],
)
def test_a_finger_bent_by_tenths_of_a_millimetre_is_not_the_camera(finger: str, tip_shift_m: Any):
    scene = simulated(bent_fingers=(BentFinger(finger=finger, tip_shift_m=tip_shift_m, start_s=AT_S),))
    explanation, evidence = explained(scene, scene)
    assert (explanation.probable.cause, explanation.probable.part) == (Cause.FINGER_BENT, finger)
    # The evidence lies where the bent finger truly shows, and where the other one stayed.
    truth = scene.truth(WELL + AFTER)
    points = box_gripper().points_grip_m(None)
    ends = np.einsum("pij,pj->pi", truth.finger_bend[box_gripper().point_finger][:, :3, :3], points)
    ends += truth.finger_bend[box_gripper().point_finger][:, :3, 3]
    ends = ends @ truth.cam_T_grip[:3, :3].T + truth.cam_T_grip[:3, 3]
    a, b = (ends[box_gripper().edge_points[evidence.edge, k]] for k in (0, 1))
    line = np.cross(a, b)
    off = np.einsum("si,si->s", line, np.column_stack([evidence.xy, np.ones(len(a))]))
    off_px = off / np.hypot(line[:, 0], line[:, 1]) / evidence.per_px
    assert np.median(np.abs(off_px)) < 0.1
    assert set(box_gripper().edge_finger[evidence.edge]) == {0, 1}


def test_a_finger_behind_a_bar_is_hidden_not_bent():
    """The bar's border stands beside the finger's inner edge, and goes on beyond its tip."""
    left = box_gripper().points_grip_m(OPENING_M)[box_gripper().point_finger == 0]
    inner_m, near_m = float(left[:, 0].max()), float(left[:, 1].min())
    bar = Prop(
        size_m=(0.004, 0.004, 0.2),
        centre_m=(inner_m + 0.0025, near_m - 0.004, 0.0),
        look=ObjectLook(pattern="plain", level_dn=230.0),
    )
    explanation, _ = explained(simulated(), simulated(props=(bar,)))
    assert explanation.probable.cause is Cause.UNKNOWN


def test_a_bent_finger_is_named_before_a_plain_background():
    """Ten pixels farther than the gripper is measured."""
    bent = BentFinger(finger="left", tip_shift_m=(-1.4e-3, 0.0, 0.0), start_s=AT_S)
    explanation, _ = explained(simulated(background=PLAIN), simulated(background=PLAIN, bent_fingers=(bent,)))
    assert explanation.probable.cause is Cause.FINGER_BENT


@pytest.mark.parametrize(
    "motion",
    [
        Tilt(start_s=AT_S, time_s=0.0, tcp_shift_m=(3e-4, 0.0)),
        Tilt(start_s=AT_S, time_s=0.0, translation_m=(0, 3e-4, 0)),
    ],
)
def test_the_camera_is_named_when_it_moved(motion: Tilt):
    scene = simulated(mount=(motion,))
    assert explained(scene, scene)[0].probable.cause is Cause.CAMERA_MOUNT


@pytest.mark.parametrize("wrong_m", [4e-4, -1.5e-3])
def test_the_report_is_named_when_it_is_wrong(wrong_m: float):
    scene = simulated()
    assert explained(scene, scene, wrong_m)[0].probable.cause is Cause.JAW_OPENING


def test_the_lens_is_named_when_its_focal_length_or_focus_changed():
    scene = simulated(background=PLAIN)
    zoomed = msgspec.structs.replace(PAPER_LENS, fx_px=972.0, fy_px=972.0)
    later = paper_rig(box_gripper(), lens=zoomed).simulator(scene.scenario, 3)
    explanation, _ = explained(scene, later)
    assert explanation.probable.cause is Cause.LENS
    assert "+1.0" in explanation.text
    blurred = simulated(background=PLAIN, defocus=(Defocus(sigma_px=2.5, start_s=AT_S),))
    explanation, _ = explained(blurred, blurred)
    assert explanation.probable.cause is Cause.LENS
    assert "blur" in explanation.text


def test_a_covered_view_is_blocked():
    cover = Cover(kind="sheet", start_s=AT_S, end_s=1e3, move_s=0.01)
    scene = simulated(covers=(cover,))
    assert explained(scene, scene)[0].probable.cause is Cause.VIEW_BLOCKED


def test_one_covered_finger_is_not_called_bent():
    scene = simulated()
    left = scene.gripper.point_finger == 0
    uv = CAMERA.project(
        scene.gripper.points_grip_m(OPENING_M)[left] @ nominal_cam_T_grip()[:3, :3].T + nominal_cam_T_grip()[:3, 3]
    )
    edge = int(np.nanmax(uv[:, 0])) + 12
    watching = Watching()
    for index in range(WELL):
        watching.judge.well(watching.look(scene.render(index)))
    for index in range(WELL, WELL + AFTER):
        image = scene.render(index).copy()
        image[:, :edge] = 90
        watching.judge.add(watching.look(image))
    explanation = watching.judge.explanation(nominal_cam_T_grip())
    assert explanation.probable.cause is Cause.UNKNOWN
    assert "finger left is not seen" in explanation.text


@pytest.mark.slow("3 s: one rare case of a cause; each cause is in the default run")
def test_images_that_come_again_do_not_tell_that_the_jaw_is_elsewhere():
    """The robot goes on reporting openings that the old images don't show."""
    scenario = Scenario(name="frozen", fps=FPS, duration_s=1.0)
    scene = paper_rig(box_gripper()).simulator(scenario, 3)
    frames = [scene.frame(index) for index in range(22)]
    monitor = new_monitor(MonitorSettings(jaw_sigma_m=0.0))
    told = [monitor.process(frame) for frame in frames]
    for later in range(36):
        again = replace(
            frames[-1 - later % 2],
            seq=len(frames) + later,
            stamp_ns=frames[-1].stamp_ns + round((later + 1) * 1e9 / FPS),
            jaw_opening_m=OPENING_M + 2.5e-3 * min(later / 4.0, 1.0),
        )
        told.append(monitor.process(again))
    named = {alert.cause for record in told for alert in record.alerts} - {Cause.UNKNOWN}
    assert named == {Cause.CAMERA_FROZEN}


def test_a_report_that_is_only_roughly_known_is_named_when_it_is_wrong():
    """What the images tell of its error is soon believed: neither the drift nor the edges show anything then."""
    scenario = Scenario(name="jaw", fps=FPS, duration_s=2.0, background=PLAIN)
    scene = paper_rig(box_gripper()).simulator(scenario, 3)
    monitor, rng = new_monitor(MonitorSettings(jaw_sigma_m=3e-5)), np.random.default_rng(5)
    told = []
    for index in range(40):
        wrong_m = rng.normal(0.0, 3e-5) + (3e-4 if index >= 24 else 0.0)
        told.append(monitor.process(replace(scene.frame(index), jaw_opening_m=OPENING_M + wrong_m)))
    named = {alert.cause for record in told for alert in record.alerts} - {Cause.UNKNOWN}
    assert named == {Cause.JAW_OPENING}
    assert not any(record.alerts for record in told[:24])


@pytest.mark.parametrize("seed", [1, 2])
def test_a_knock_while_the_monitor_learns_what_is_normal_is_still_the_cameras(seed: int):
    """Frames from before and after it, taken together, look like a bent finger, and like nothing else."""
    knock = Tilt(start_s=9.5 / FPS, time_s=0.0, tcp_shift_m=(1e-3, 2e-4), translation_m=(-1e-3, 0.0, 2e-4))
    scenario = Scenario(name="early", fps=FPS, duration_s=1.5, mount=(knock,))
    scene = paper_rig(box_gripper()).simulator(scenario, seed)
    monitor = new_monitor()
    told = [monitor.process(scene.frame(index)) for index in range(44)]
    assert {alert.cause for record in told for alert in record.alerts} - {Cause.UNKNOWN} == {Cause.CAMERA_MOUNT}
