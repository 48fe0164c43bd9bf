"""What fingers show along themselves, against poses slid along them: simulated images with exact truth."""

from __future__ import annotations

from functools import cache

import cv2
import msgspec
import numpy as np
import pytest
from support.meters import box_gripper
from support.simulated import PAPER_LENS, nominal_cam_T_grip, simulator

from gripmon.model.camera import make_camera
from gripmon.model.geometry import to_record
from gripmon.model.records import Image, StripsRecord
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import Background, Cover, FingerLook, FingerMark, JawScript
from gripmon.track.edges.roles import along_fingers
from gripmon.track.look import FingerStrips, StripsRefused, StripsSeen
from gripmon.track.look.strips import FIRST_FRAMES, MOST_FRAMES, RELEARN_S

RISK = 1e-3
SLIDES_M = (1.5e-3, -3.3e-3, 6e-3)
LINED = FingerLook(
    level_dn=83.0, texture=0.1, marks=(FingerMark(from_tip_m=(3.5e-3, 3.8e-3), across=(-2.0, 2.0), gain=2.5),)
)
"""A thin bright line round each finger."""

OTHER_MARK = FingerMark(from_tip_m=(5.2e-3, 5.6e-3), across=(-2.0, 2.0), gain=2.5)
"""The same elsewhere."""

PLAIN = FingerLook(texture=0.0, carriers=False)
DARK = Background(kind="stripes", level_dn=51.0, contrast=0.4)
LAST = 9
"""A frame that isn't learnt."""


def filmed(fingers: FingerLook, **sections: object) -> Simulator:
    sections = {"background": DARK, "fingers": fingers, **sections}
    return simulator(Scenario(duration_s=5.0, fps=2.0, **sections), sharp=False)  # type: ignore[arg-type]


def new_strips() -> FingerStrips:
    gripper = box_gripper(sharp=False)
    return FingerStrips(make_camera(PAPER_LENS), gripper, along_fingers(gripper)[1])


def taught(simulation: Simulator, frames: int = FIRST_FRAMES) -> FingerStrips:
    strips = new_strips()
    for i in range(frames):
        truth = simulation.truth(i)
        strips.learn(simulation.render(i), truth.cam_T_grip, truth.jaw_opening_m, truth.time_s)
    return strips


@cache
def lined() -> tuple[Simulator, FingerStrips, Image]:
    simulation = filmed(LINED)
    return simulation, taught(simulation), simulation.render(LAST)


def slid(cam_T_grip: np.ndarray, way_m: float) -> np.ndarray:
    """The gripper moved along its fingers, outwards."""
    out = cam_T_grip.copy()
    out[:3, 3] += way_m * cam_T_grip[:3, 2]
    return out


def told_m(simulation: Simulator, strips: FingerStrips, image: Image, way_m: float) -> float | None:
    """The slide that the strips tell of a pose ``way_m`` beside the true one, along the fingers."""
    truth = simulation.truth(LAST)
    seen = strips.compare(image, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK)
    slide_m = seen.slide_m
    if slide_m is None:
        return None
    assert not seen.here
    assert np.abs(slide_m[:2]).max() < 1e-9, "these fingers run along z"
    return float(slide_m[2])


@pytest.mark.parametrize("way_m", SLIDES_M)
def test_of_a_pose_slid_along_lined_fingers_they_tell_the_way_back(way_m: float):
    assert told_m(*lined(), way_m) == pytest.approx(-way_m, abs=3e-4)


def test_of_the_true_pose_and_of_a_pixel_beside_it_nothing_is_told():
    for way_m in (0.0, 2e-4, -2e-4):
        assert told_m(*lined(), way_m) is None


def test_a_pose_at_which_nothing_of_them_shows_is_forgotten():
    """They aren't followed from there: afterwards they are seen in their place as before."""
    simulation, strips, image = lined()
    truth = simulation.truth(LAST)
    true_T, opening_m = truth.cam_T_grip, truth.jaw_opening_m
    behind_T = true_T.copy()
    behind_T[2, 3] = -0.2
    assert strips.compare(image, true_T, opening_m, RISK).here
    strips.compare(image, behind_T, opening_m, RISK)
    assert strips.compare(image, true_T, opening_m, RISK).here


def test_they_move_with_the_jaws():
    knots = ((0.0, 0.034), (1.5, 0.034), (4.0, 0.024))
    simulation = filmed(LINED, jaw=JawScript(knots=knots))
    assert abs(simulation.truth(LAST).jaw_opening_m - 0.034) > 5e-3
    seen = simulation, taught(simulation), simulation.render(LAST)
    assert told_m(*seen, 0.0) is None
    assert told_m(*seen, -3.3e-3) == pytest.approx(3.3e-3, abs=3e-4)


def test_colour_is_read_as_grey():
    simulation, strips, image = lined()
    grey = image if image.ndim == 2 else image[..., 0]
    assert told_m(simulation, strips, np.repeat(grey[..., None], 3, axis=2), 3.3e-3) == pytest.approx(-3.3e-3, abs=3e-4)


@pytest.mark.parametrize("way_m", [0.0, *SLIDES_M])
def test_before_a_background_like_them_fingers_of_one_shade_tell_of_no_slide_that_isnt_there(way_m: float):
    """Their outline may tell the way back, but nothing tells another one."""
    simulation = filmed(PLAIN)
    told = told_m(simulation, taught(simulation), simulation.render(LAST), way_m)
    assert told is None or told == pytest.approx(-way_m, abs=6e-4)


@pytest.mark.parametrize("way_m", [0.0, 3.3e-3])
def test_what_hides_the_fingers_tells_of_no_slide_that_isnt_there(way_m: float):
    simulation = filmed(LINED, covers=(Cover(start_s=2.0, end_s=5.0, move_s=0.5),))
    told = told_m(simulation, taught(simulation), simulation.render(LAST), way_m)
    assert told is None or told == pytest.approx(-way_m, abs=3e-4)


def test_the_true_place_is_seen_also_in_other_light_and_no_other_is():
    simulation, strips, image = lined()
    truth = simulation.truth(LAST)
    for lit, way_m, here in ((image, 0.0, True), (image // 2, 0.0, True), (image, 6e-4, False), (image, 3.3e-3, False)):
        seen = strips.compare(lit, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK)
        assert seen.here == here, way_m


def test_the_true_place_is_seen_where_a_third_of_what_is_seen_is_something_else():
    """Shading that changes with the pose, or dirt: alike by 0.86 and 0.75, and nothing along the fingers by as much."""
    simulation, strips, image = lined()
    truth = simulation.truth(LAST)
    spots = cv2.GaussianBlur(np.random.default_rng(36).normal(0.0, 1.0, image.shape), (0, 0), 1.0)
    for spots_dn in (4.0, 6.0):
        dirty = np.clip(image + spots_dn * spots / spots.std(), 0.0, 255.0).astype(np.uint8)
        for way_m, here in ((0.0, True), (6e-4, False), (-6e-4, False)):
            seen = strips.compare(dirty, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK)
            assert seen.here == here, (spots_dn, way_m)


def test_hidden_or_of_one_shade_they_are_seen_nowhere():
    covered = filmed(LINED, covers=(Cover(start_s=2.0, end_s=5.0, move_s=0.5),))
    for simulation in (covered, filmed(PLAIN)):
        truth = simulation.truth(LAST)
        seen = taught(simulation).compare(simulation.render(LAST), truth.cam_T_grip, truth.jaw_opening_m, RISK)
        assert not seen.here


@pytest.mark.parametrize("level_dn", [10.0, 240.0])
def test_what_lies_behind_the_fingers_ends_is_no_part_of_them(level_dn: float):
    """Learnt before one background, and seen before another."""
    fingers = FingerLook(level_dn=100.0, texture=0.05, marks=LINED.marks)
    strips = taught(filmed(fingers, background=Background(kind="plain", contrast=0.0, level_dn=100.0)))
    other = filmed(fingers, background=Background(kind="plain", contrast=0.0, level_dn=level_dn))
    truth = other.truth(LAST)
    assert strips.compare(other.render(LAST), truth.cam_T_grip, truth.jaw_opening_m, RISK) == StripsSeen(here=True)


@pytest.mark.parametrize("pitch_m", [1e-3, 4e-3])
def test_ribs_are_not_seen_where_they_look_alike_a_rib_farther_on(pitch_m: float):
    """At poses slid by a pitch or two: they are seen some pitches away, or nothing is decided.  Nor do they confirm
    where they are: light changes ribs by as much as one more or less does.
    """
    ribs = [
        FingerMark(from_tip_m=(k * pitch_m, (k + 0.5) * pitch_m), across=(-2.0, 2.0), gain=0.5)
        for k in range(1, round(0.03 / pitch_m))
    ]
    simulation = filmed(FingerLook(texture=0.05, marks=tuple(ribs)))
    strips, image, truth = taught(simulation), simulation.render(LAST), simulation.truth(LAST)
    for pitches in (-2, -1, 1, 2):
        way_m = pitches * pitch_m
        seen = strips.compare(image, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK)
        assert not seen.here and (seen.undecided or seen.slide_m is not None)
    at_home = strips.compare(image, truth.cam_T_grip, truth.jaw_opening_m, RISK)
    assert at_home.slide_m is None and not at_home.here


def test_they_go_on_after_a_restart():
    simulation, strips, image = lined()
    state = strips.state()
    assert state is not None and state.frames == FIRST_FRAMES
    again = new_strips()
    again.restore(msgspec.json.decode(msgspec.json.encode(state), type=StripsRecord))
    kept = again.state()
    assert kept is not None and (kept.mean, kept.usual, kept.frames) == (state.mean, state.usual, FIRST_FRAMES)
    assert not again.awaited
    truth = simulation.truth(LAST)
    for way_m in (0.0, *SLIDES_M):
        where = image, slid(truth.cam_T_grip, way_m), truth.jaw_opening_m, RISK
        before, after = strips.compare(*where), again.compare(*where)
        assert after.here == before.here and (after.slide_m is None) == (before.slide_m is None)
        if before.slide_m is not None:
            assert after.slide_m == pytest.approx(before.slide_m, rel=1e-9, abs=1e-12)
    for now_s in (0.0, 0.9 * RELEARN_S):
        again.learn(image, truth.cam_T_grip, truth.jaw_opening_m, now_s)
        assert again.frames == FIRST_FRAMES + 1, "enough were learnt before: one more a second"


@pytest.mark.parametrize("fault", ["another place", "cut", "not finite"])
def test_kept_strips_that_cant_be_this_grippers_are_refused_and_learnt_again(fault: str):
    simulation, strips, image = lined()
    state = strips.state()
    assert state is not None
    behind_T = np.diag([1.0, 1.0, 1.0, 1.0])
    behind_T[2, 3] = -1.0
    change = {
        "another place": {"cam_T_grip": to_record(behind_T)},
        "cut": {"mean": state.mean[:-4]},
        "not finite": {"mean": np.full(len(state.mean) // 4, np.nan, dtype="<f4").tobytes()},
    }[fault]
    again = new_strips()
    with pytest.raises(StripsRefused, match="learnt again"):
        again.restore(msgspec.structs.replace(state, **change))
    assert again.awaited and not again.ready
    truth = simulation.truth(LAST)
    again.learn(image, truth.cam_T_grip, truth.jaw_opening_m, 0.0)
    assert again.ready and again.frames == 1


def test_they_need_one_frame_and_after_some_learn_one_a_second():
    simulation, _, image = lined()
    assert not new_strips().ready and told_m(simulation, new_strips(), image, 3.3e-3) is None
    assert told_m(simulation, taught(simulation, 1), image, 3.3e-3) == pytest.approx(-3.3e-3, abs=3e-4)
    strips, truth = taught(simulation), simulation.truth(LAST)
    for now_s, frames in ((10.0, 1), (10.0 + 0.9 * RELEARN_S, 1), (10.0 + RELEARN_S, 2)):
        strips.learn(image, truth.cam_T_grip, truth.jaw_opening_m, now_s)
        assert strips.ready and strips.frames == FIRST_FRAMES + frames


def test_out_of_view_there_is_nothing_to_learn():
    strips, away_T = new_strips(), nominal_cam_T_grip()
    away_T[:3, 3] = (0.0, 0.0, -0.5)
    image = np.full((576, 768), 90, dtype=np.uint8)
    for i in range(FIRST_FRAMES):
        strips.learn(image, away_T, None, float(i))
    assert not strips.ready and not strips.awaited and strips.state() is None
    assert strips.compare(image, away_T, None, RISK) == StripsSeen()


def test_of_what_hides_them_for_a_while_nothing_is_learnt():
    simulation = filmed(LINED)
    strips, image = taught(simulation), simulation.render(LAST)
    covered = filmed(LINED, covers=(Cover(start_s=2.0, end_s=5.0, move_s=0.5),))
    truth, hidden = covered.truth(LAST), covered.render(LAST)
    for k in range(MOST_FRAMES - 1):  # as if the pose were proven
        strips.learn(hidden, truth.cam_T_grip, truth.jaw_opening_m, 10.0 + 2.0 * RELEARN_S * k)
    assert told_m(simulation, strips, image, 0.0) is None
    assert told_m(simulation, strips, image, 3.3e-3) == pytest.approx(-3.3e-3, abs=3e-4)


def test_fingers_that_look_otherwise_for_good_are_learnt_anew():
    """Taped or painted: at the same place, now without the line that they were learnt with."""
    taped = filmed(msgspec.structs.replace(LINED, marks=(OTHER_MARK,)))
    strips, truth, image = taught(filmed(LINED)), taped.truth(LAST), taped.render(LAST)
    for k in range(MOST_FRAMES):
        seen = strips.compare(image, truth.cam_T_grip, truth.jaw_opening_m, RISK)
        assert not seen.here
        strips.learn(taped.render(k % LAST), taped.truth(k % LAST).cam_T_grip, truth.jaw_opening_m, 10.0 + 2.0 * k)
    assert strips.compare(image, truth.cam_T_grip, truth.jaw_opening_m, RISK).here
