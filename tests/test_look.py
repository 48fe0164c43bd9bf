"""The gripper's learned look, held against true poses and poses slid along the fingers in simulated images."""

from __future__ import annotations

from functools import cache

import msgspec
import numpy as np
import pytest
from support.simulated import BOX_FINGERS, PAPER_LENS, PLAIN_FINGERS, nominal_cam_T_grip, simulator

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.gripper import Gripper
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import (
    Background,
    Cover,
    Defocus,
    FingerLook,
    FingerMark,
    GraspedObject,
    JawScript,
    Light,
    LightStep,
    Shadow,
)
from gripmon.track.look import GripperLook, LookAgreement
from gripmon.track.look.core import FEWEST_VIEWS, FORGET_S, LAY_OUT_AGAIN_S, MANY_VIEWS, RELEARN_S, SLIDES_M

RISK = 1e-5
LEARNT = 16
TELLING_SLIDES_M = (1e-3, -1e-3, 3e-3, -3e-3, 9e-3, -9e-3)
REAR_OUT_OF_VIEW = nominal_cam_T_grip(tcp_m=(0.0004, 0.0160, 0.115))
"""The box fingers' other end is a line across them, which tells of a slide."""
MARKS = FingerLook(
    texture=0.0,
    carriers=False,
    marks=(FingerMark(), FingerMark(shape="disc", from_tip_m=(0.018, 0.024), across=(0.0, 0.0), gain=1.6)),
)


def filmed(cam_T_grip: np.ndarray | None = None, **settings: object) -> Simulator:
    """Two frames a second, so that each has another background; what happens, happens after 9 s."""
    return simulator(Scenario(duration_s=20.0, fps=2.0, **settings), sharp=False, cam_T_grip=cam_T_grip)  # type: ignore[arg-type]


def new_look(gripper: Gripper | None = None) -> GripperLook:
    return GripperLook(make_camera(PAPER_LENS), gripper or read_gripper(BOX_FINGERS))


def taught(simulation: Simulator, frames: int = LEARNT, look: GripperLook | None = None) -> GripperLook:
    look = look or new_look()
    for i in range(frames):
        truth = simulation.truth(i)
        look.learn(simulation.render(i), truth.cam_T_grip, truth.jaw_opening_m, truth.time_s)
    return look


@cache
def ordinary() -> tuple[Simulator, GripperLook]:
    simulation = filmed()
    return simulation, taught(simulation)


def slid(cam_T_grip: np.ndarray, way_m: float) -> np.ndarray:
    """The gripper moved along its fingers, outwards."""
    out = cam_T_grip.copy()
    out[:3, 3] += way_m * cam_T_grip[:3, 2]
    return out


def held_against(simulation: Simulator, look: GripperLook, frame: int = 24) -> LookAgreement:
    """The true pose first, then slid ones."""
    truth = simulation.truth(frame)
    poses = np.stack([slid(truth.cam_T_grip, way_m) for way_m in (0.0, *TELLING_SLIDES_M)])
    return look.compare(simulation.render(frame), poses, truth.jaw_opening_m)


def test_a_textured_finger_is_recognised_where_it_is_and_nowhere_along_it():
    simulation, look = ordinary()
    assert look.ready and look.missing == ""
    agreement = held_against(simulation, look)
    assert agreement.seen[0].min() >= 10
    assert agreement.correlation[0].min() > 0.85
    assert np.abs(agreement.correlation[1:]).max() < 0.6
    assert agreement.supports(RISK) and not agreement.contradicts(RISK)
    for pose in range(1, 1 + len(TELLING_SLIDES_M)):
        assert agreement.contradicts(RISK, pose)


def test_a_look_that_is_seen_as_well_some_way_along_the_fingers_supports_no_place(monkeypatch: pytest.MonkeyPatch):
    """Streaks along a finger: many patches agree where it has slid by less than a patch is long."""
    simulation, look = ordinary()
    truth, image = simulation.truth(24), simulation.render(24)
    assert look.supports(image, truth.cam_T_grip, truth.jaw_opening_m, RISK)
    for way_m in SLIDES_M:
        assert not look.supports(image, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK)
    enough = -np.log(RISK)
    for best, seen in ((0.0, True), (1.0, True), (enough - 1.0, False), (2.0 * enough, False)):
        odds = np.zeros((1 + 2 * len(SLIDES_M), 2))
        odds[0], odds[3] = enough, best
        none = np.zeros(odds.shape, dtype=np.intp)
        monkeypatch.setattr(look, "compare", lambda *_, odds=odds, none=none: LookAgreement(odds, none, none, odds))
        assert look.supports(image, truth.cam_T_grip, truth.jaw_opening_m, RISK) == seen, best


def test_a_slightly_better_pose_contradicts_nothing():
    def agreement(here: int) -> LookAgreement:
        agree = np.array([[here], [32]])
        odds = 4.0 * agree - 21.0
        return LookAgreement(np.ones((2, 1)), agree, np.full((2, 1), 32), odds)

    assert not agreement(28).contradicts(RISK)
    assert not agreement(16).contradicts(RISK)
    assert agreement(15).contradicts(RISK) and not agreement(15).contradicts(RISK, 1)


def test_one_finger_is_enough_to_contradict():
    agree = np.array([[2, 12], [12, 12]])
    agreement = LookAgreement(np.ones((2, 2)), agree, np.full((2, 2), 12), 4.0 * agree - 8.0)
    assert agreement.contradicts(RISK) and not agreement.contradicts(RISK, 1)


def test_one_pose_says_what_it_says_among_several():
    simulation, look = ordinary()
    truth = simulation.truth(24)
    alone = look.compare(simulation.render(24), truth.cam_T_grip, truth.jaw_opening_m)
    among = held_against(simulation, look)
    assert alone.log_odds.shape == (1, 2)
    np.testing.assert_array_equal(alone.agree[0], among.agree[0])


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"light": Light(steps=(LightStep(at_s=9.0, factor=0.4),))}, id="darker"),
        pytest.param({"light": Light(shadows=(Shadow(start_s=8.0, end_s=14.0, still_at=0.4),))}, id="shadow"),
        pytest.param({"defocus": (Defocus(sigma_px=1.2, start_s=9.0),)}, id="blur"),
        pytest.param({"jaw": JawScript(knots=((8.0, 0.034), (9.0, 0.05)))}, id="opened"),
        pytest.param({"fingers": FingerLook(highlights=3.0)}, id="glossy"),
        pytest.param(
            {
                "jaw": JawScript(knots=((8.0, 0.034), (9.0, 0.026))),
                "grasped": GraspedObject(arrive_s=(8.0, 9.0), leave_s=(18.0, 19.0)),
            },
            id="half-hidden",
        ),
        pytest.param({"fingers": MARKS}, id="marks"),
    ],
)
def test_what_changes_every_day_takes_nothing_from_it(settings: dict[str, object]):
    simulation = filmed(**settings)
    agreement = held_against(simulation, taught(simulation))
    assert agreement.supports(RISK)
    assert not agreement.contradicts(RISK)
    assert all(agreement.contradicts(RISK, pose) for pose in range(1, 1 + len(TELLING_SLIDES_M)))


def test_a_finger_of_one_shade_says_that_it_says_nothing():
    simulation = filmed(REAR_OUT_OF_VIEW, fingers=PLAIN_FINGERS)
    look = taught(simulation)
    agreement = held_against(simulation, look)
    assert not any(agreement.contradicts(RISK, pose) for pose in range(1 + len(TELLING_SLIDES_M)))
    assert not look.ready and look.missing == "the fingers look the same all along, or never the same twice"


def test_a_marked_finger_beside_a_plain_one_tells_for_itself():
    mark = msgspec.structs.replace(MARKS.marks[0], finger="left")
    simulation = filmed(REAR_OUT_OF_VIEW, fingers=msgspec.structs.replace(MARKS, marks=(mark,)))
    agreement = held_against(simulation, taught(simulation))
    left, right = (agreement.log_odds[0] - agreement.log_odds[1:]).T
    assert (left > -np.log(RISK)).all() and (right < -np.log(RISK)).all()
    assert agreement.seen[0, 1] <= 2


def test_a_view_that_is_covered_contradicts_nothing():
    simulation = filmed(covers=(Cover(kind="sheet", start_s=9.0, end_s=19.0),))
    agreement = held_against(simulation, taught(simulation))
    assert not any(agreement.contradicts(RISK, pose) for pose in range(1 + len(TELLING_SLIDES_M)))
    assert not agreement.supports(RISK)


def test_nothing_is_learnt_before_a_background_that_stands_still():
    simulation = filmed(background=Background(motion="still"))
    look = taught(simulation)
    assert look.views == 1 and not look.ready
    assert look.missing == f"learnt before 1 backgrounds, of at least {FEWEST_VIEWS}"
    agreement = held_against(simulation, look)
    assert np.isnan(agreement.correlation).all() and not agreement.log_odds.any()


def test_different_backgrounds_are_counted_once_each_and_anew_elsewhere():
    """A robot that goes to and fro sees two, and light is none."""
    moving = filmed()
    here, there = moving.render(0), moving.render(40)
    truths = moving.truth(0), moving.truth(40)
    look = new_look()
    for k in range(10):
        image, truth = ((here, truths[0]), (there, truths[1]))[k % 2]
        dimmed = np.clip(image * (1.0 - 0.04 * k), 0, 255).astype(image.dtype)
        look.learn(dimmed, truth.cam_T_grip, truth.jaw_opening_m, 0.1 * k)
    assert look.backgrounds == 2 and look.views == 10
    look.count_again()
    assert look.backgrounds == 0
    assert taught(moving).backgrounds > 4 and taught(filmed(background=Background(motion="still"))).backgrounds == 1


def test_without_faces_depths_come_from_the_edges():
    model = read_gripper(BOX_FINGERS).model
    # Edges that don't show from here would count as if they did.
    seen = {name: edge for name, edge in model.edges.items() if "out_far" not in (edge.start[2:9], edge.end[2:9])}
    used = {
        name: msgspec.structs.replace(point, corner=point.corner and not name.endswith("out_far"))
        for name, point in model.points.items()
    }
    gripper = Gripper(msgspec.structs.replace(model, faces=(), edges=seen, points=used))
    simulation = filmed(jaw=JawScript(knots=((8.0, 0.034), (9.0, 0.045))))
    look = taught(simulation, look=new_look(gripper))
    agreement = held_against(simulation, look)
    assert agreement.supports(RISK) and not agreement.contradicts(RISK)
    assert agreement.contradicts(RISK, 5)


def test_a_gripper_out_of_view_is_looked_for_again_after_a_pause():
    simulation = filmed()
    look, away = new_look(), nominal_cam_T_grip(tcp_m=(0.5, 0.0, 0.115))
    image, truth = simulation.render(0), simulation.truth(0)
    assert not look.learn(image, away, truth.jaw_opening_m, 0.0)
    assert look.missing.startswith("no part of a finger")
    assert not look.learn(image, truth.cam_T_grip, truth.jaw_opening_m, 1.0)
    assert look.learn(image, truth.cam_T_grip, truth.jaw_opening_m, LAY_OUT_AGAIN_S + 1.0)


def test_poses_outside_the_image_or_behind_the_camera_are_not_seen():
    simulation, look = ordinary()
    truth = simulation.truth(24)
    poses = np.stack([nominal_cam_T_grip(tcp_m=(0.5, 0.0, 0.115)), nominal_cam_T_grip(tcp_m=(0.0, 0.0, -0.1))])
    agreement = look.compare(simulation.render(24), poses, truth.jaw_opening_m)
    assert not agreement.seen.any() and not agreement.log_odds.any()


def test_colour_and_other_grey_scales_make_no_difference():
    simulation, look = ordinary()
    truth, image = simulation.truth(24), simulation.render(24)
    grey = look.compare(image, truth.cam_T_grip, truth.jaw_opening_m)
    for other in (np.dstack([image] * 3), image.astype(np.uint16) * 257, image.astype(np.float32) / 255.0):
        same = look.compare(other, truth.cam_T_grip, truth.jaw_opening_m)
        assert abs(int(same.agree.sum()) - int(grey.agree.sum())) <= 1


def test_a_long_pause_leaves_what_was_learnt():
    simulation = filmed()
    look = taught(simulation)
    truth = simulation.truth(LEARNT)
    assert look.learn(simulation.render(LEARNT), truth.cam_T_grip, truth.jaw_opening_m, 50.0 * FORGET_S)
    agreement = held_against(simulation, look)
    assert agreement.supports(RISK) and not agreement.contradicts(RISK)


def test_of_a_fast_camera_not_every_frame_is_learnt():
    simulation = filmed()
    look = taught(simulation)
    truth, last_s = simulation.truth(LEARNT), simulation.truth(LEARNT - 1).time_s

    def learns(at_s: float) -> bool:
        return look.learn(simulation.render(LEARNT), truth.cam_T_grip, truth.jaw_opening_m, at_s)

    look.views = MANY_VIEWS
    assert not learns(last_s + 0.9 * RELEARN_S)
    assert learns(last_s + 1.1 * RELEARN_S)
    look.views = MANY_VIEWS
    look.learn(simulation.render(LEARNT + 1), truth.cam_T_grip, truth.jaw_opening_m, 0.0)
    assert look.views == MANY_VIEWS + 1, "also when time has jumped backwards"


def test_wrong_poses_now_and_then_spoil_nothing():
    simulation = filmed()
    look = taught(simulation)
    for i in range(LEARNT, LEARNT + 6):
        truth = simulation.truth(i)
        look.learn(simulation.render(i), slid(truth.cam_T_grip, 9e-3), truth.jaw_opening_m, truth.time_s)
    agreement = held_against(simulation, look)
    assert agreement.supports(RISK) and agreement.contradicts(RISK, 5)
