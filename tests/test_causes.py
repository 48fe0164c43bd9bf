"""What moved, judged from pieces of edges whose places are known: every cause, outliers, and what can't be told."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from support.box_models import cube_model
from support.shown_edges import FRAMES, OPENING_M, REFERENCE_SIGMA, Shown, bend, ill_seen, knocked, told, two_fingers
from support.simulated import PAPER_LENS, STRONG_LENS, sharp_gripper

from gripmon.judge.causes import CauseSettings
from gripmon.model.camera import LensSettings, PaperLens, make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Cause, Explanation


def zoomed(factor: float) -> PaperLens:
    return msgspec.structs.replace(
        PAPER_LENS, fx_px=962.0 * factor, fy_px=962.0 * factor, kappa_per_px2=1.9e-7 / factor**2
    )


def stated(text: str) -> float:
    """The first number of a sentence."""
    return float(re.findall(r"[-+]?\d+\.\d+", text)[0])


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS])
@pytest.mark.parametrize("outliers", [0, 4])
@pytest.mark.parametrize("size_m", [1.5e-4, 1.5e-3])
def test_a_bent_finger_is_named_never_the_camera(size_m: float, outliers: int, lens: LensSettings):
    for seed, (finger, x, y) in enumerate([("left", 1.0, 0.0), ("right", 0.0, 1.0), ("left", -0.6, 0.8)]):
        shown = Shown(sharp_gripper(), lens, seed)
        bent = {finger: bend(shown.gripper, finger, (size_m * x, size_m * y))}
        cause, part, text = told(shown, shown.judge(), bent=bent, outliers=outliers)
        assert (cause, part) == (Cause.FINGER_BENT, finger)
        assert f"finger {finger} is bent" in text


@pytest.mark.parametrize("outliers", [0, 4])
@pytest.mark.parametrize(
    ("shift_m", "turn_deg"),
    [
        ((3e-4, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.0, 1e-4, 0.0), (0.05, -0.1, 0.0)),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.2)),
        ((-4e-3, 2e-3, 5e-3), (2.0, 1.0, -3.0)),
    ],
)
def test_a_camera_that_moved_is_named(shift_m: Any, turn_deg: Any, outliers: int):
    shown = Shown(two_fingers())
    cause, part, text = told(
        shown, shown.judge(opening_m=0.03, reported_m=0.03), opening_m=0.03, reported_m=0.03,
        cam_T_grip=knocked(shown.reference, shift_m, turn_deg), outliers=outliers,
    )  # fmt: skip
    assert (cause, part) == (Cause.CAMERA_MOUNT, None)
    assert stated(text) == pytest.approx(1e3 * np.linalg.norm(shift_m), abs=0.1)
    assert "would look the same" in text


@pytest.mark.parametrize("wrong_m", [2e-4, -5e-4])
@pytest.mark.parametrize("sigma_m", [0.0, 5e-5])
def test_a_wrong_report_of_the_opening_is_named(wrong_m: float, sigma_m: float):
    shown = Shown(sharp_gripper())
    judge = shown.judge(jaw_sigma_m=sigma_m)
    cause, _, text = told(shown, judge, opening_m=OPENING_M + wrong_m)
    assert cause is Cause.JAW_OPENING
    assert stated(text) == pytest.approx(1e3 * wrong_m, abs=0.03)


@pytest.mark.parametrize("change", [-0.01, 0.004, 0.03])
def test_another_focal_length_is_named(change: float):
    shown = Shown(sharp_gripper())
    cause, _, text = told(shown, shown.judge(), camera=make_camera(zoomed(1.0 + change)))
    assert cause is Cause.LENS
    assert stated(text) == pytest.approx(100.0 * change, abs=0.05)
    assert "along its axis" in text


def test_a_gripper_that_is_not_found_is_not_blamed_on_the_focal_length():
    """It would be measured at another scale, too; but a blur hides it."""
    shown = Shown(sharp_gripper())

    def lost(**scene: Any) -> Explanation:
        judge = shown.judge()
        for _ in range(FRAMES):
            judge.add(dataclasses.replace(shown.evidence(**scene), found=False))
        return judge.explanation(shown.reference)

    zoomed_in = lost(camera=make_camera(zoomed(1.03)))
    assert zoomed_in.probable.cause is Cause.UNKNOWN and "foc" not in zoomed_in.text
    assert Cause.LENS not in [weight.cause for weight in zoomed_in.causes]
    assert lost(blur_px=1.8).probable.cause is Cause.LENS


def test_another_focus_is_named_and_a_smear_is_not():
    shown = Shown(sharp_gripper())
    cause, _, text = told(shown, shown.judge(), blur_px=1.8)
    assert cause is Cause.LENS
    assert stated(text) == pytest.approx(1.1)
    # Smeared along one direction: edges along it stay sharp.
    judge = shown.judge()
    for _ in range(FRAMES):
        evidence = shown.evidence()
        smeared = 0.7**2 + (2.0 * evidence.across[:, 0]) ** 2
        judge.add(dataclasses.replace(evidence, blur_px2=smeared))
    assert judge.explanation(shown.reference).probable.cause is Cause.UNKNOWN


@pytest.mark.parametrize("outliers", [0, 5])
def test_nothing_is_named_when_nothing_moved(outliers: int):
    for seed in range(10):
        shown = Shown(sharp_gripper(), seed=seed)
        cause, part, text = told(shown, shown.judge(outliers=outliers), outliers=outliers)
        assert (cause, part) == (Cause.UNKNOWN, None)
        assert "show no motion" in text


def test_what_was_wrong_from_the_start_is_no_news():
    """Reference and report are off as far as they may be, and stay so."""
    shown = Shown(sharp_gripper())
    off = {"cam_T_grip": knocked(shown.reference, (1.5e-4, -1e-4, 2e-4), (0.1, 0.05, -0.1)), "opening_m": 0.0342}
    assert told(shown, shown.judge(**off), **off)[0] is Cause.UNKNOWN
    bent = {"right": bend(shown.gripper, "right", (2e-4, -2e-4))}
    assert told(shown, shown.judge(**off), **off, bent=bent)[:2] == (Cause.FINGER_BENT, "right")


def test_a_finger_that_was_bent_from_the_start_does_not_pass_for_normal():
    shown = Shown(sharp_gripper())
    bent = {"left": bend(shown.gripper, "left", (-8e-4, 5e-4))}
    assert told(shown, shown.judge(bent=bent), bent=bent)[:2] == (Cause.FINGER_BENT, "left")


def test_two_fingers_bent_differently_have_no_single_cause():
    shown = Shown(sharp_gripper())
    bent = {"left": bend(shown.gripper, "left", (-8e-4, 5e-4)), "right": bend(shown.gripper, "right", (3e-4, 1e-3))}
    cause, _, text = told(shown, shown.judge(), bent=bent)
    assert cause is Cause.UNKNOWN
    assert "no single cause" in text


def test_an_opening_that_nobody_reports_is_never_reported_wrong():
    shown = Shown(sharp_gripper())
    judge = shown.judge(reported_m=None)
    told(shown, judge, reported_m=None, opening_m=OPENING_M + 1e-3)
    causes = {c.cause for c in judge.explanation(shown.reference).causes}
    assert Cause.JAW_OPENING not in causes
    assert judge.explanation(shown.reference).probable.cause is Cause.UNKNOWN  # it may open as it likes
    bent = {"left": bend(shown.gripper, "left", (0.0, 6e-4))}  # across the way of the jaws
    assert told(shown, shown.judge(reported_m=None), reported_m=None, bent=bent)[:2] == (Cause.FINGER_BENT, "left")


def test_one_finger_without_a_jaw_leaves_camera_and_lens():
    shown = Shown(Gripper(msgspec.convert(cube_model(), GripperModel)))
    judge = shown.judge()
    assert told(shown, judge, cam_T_grip=knocked(shown.reference, (4e-4, 2e-4, 0.0)))[0] is Cause.CAMERA_MOUNT
    causes = {c.cause for c in judge.explanation(shown.reference).causes}
    assert causes == {Cause.CAMERA_MOUNT, Cause.LENS, Cause.UNKNOWN}


def test_a_finger_that_is_not_seen_is_hidden_or_bent_who_knows():
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    cause, part, text = told(shown, judge, hidden=("left",))
    assert (cause, part) == (Cause.UNKNOWN, None)
    assert "finger left is not seen" in text
    named = {c.cause for c in judge.explanation(shown.reference).causes if c.probability > 0.1}
    assert named == {Cause.VIEW_BLOCKED, Cause.FINGER_BENT}


def test_nothing_seen_at_all_is_a_blocked_view_or_a_noisy_image():
    shown = Shown(sharp_gripper())
    everything = ("left", "right")
    assert told(shown, shown.judge(), hidden=everything)[0] is Cause.VIEW_BLOCKED
    assert told(shown, shown.judge(), hidden=everything, noise=0.08)[0] is Cause.IMAGE_BAD
    cause, _, text = told(shown, shown.judge(), hidden=everything, brightest=0.05)
    assert cause is Cause.IMAGE_BAD
    assert "dark" in text
    cause, _, text = told(shown, shown.judge(), hidden=everything, grey=0.98)
    assert cause is Cause.UNKNOWN
    assert "too much light" in text


@pytest.mark.parametrize(
    ("steepest", "grey", "cause"),
    [(0.25, 0.4, Cause.VIEW_BLOCKED), (0.1, 0.7, Cause.VIEW_BLOCKED), (0.1, 0.4, Cause.UNKNOWN)],
)
def test_a_view_that_only_lost_its_edges_is_not_said_to_be_blocked(steepest: float, grey: float, cause: Cause):
    shown = Shown(sharp_gripper())
    everything = ("left", "right")
    told_cause, _, text = told(shown, shown.judge(), hidden=everything, steepest=steepest, grey=grey)
    assert told_cause is cause
    assert ("out of focus" in text) == (cause is Cause.UNKNOWN)


def test_noise_that_hides_the_fingers_is_the_cause_of_where_they_seem_to_be():
    shown = Shown(sharp_gripper())
    bent = {"left": bend(shown.gripper, "left", (8e-4, 5e-4))}
    assert told(shown, shown.judge(), bent=bent, noise=0.08)[0] is Cause.FINGER_BENT
    judge = shown.judge()
    for _ in range(FRAMES):
        judge.add(ill_seen(shown.evidence(bent=bent, noise=0.08), 0.3, 0.45))
    explanation = judge.explanation(shown.reference)
    assert explanation.probable.cause is Cause.IMAGE_BAD
    assert "noise of 8 %" in explanation.text
    # One of them too: a finger that is hidden in noise isn't hidden by a thing.
    assert told(shown, shown.judge(), hidden=("left",), noise=0.08)[0] is Cause.IMAGE_BAD


def test_another_camera_is_thought_of_only_after_an_interruption():
    shown = Shown(sharp_gripper())
    scene = {
        "camera": make_camera(zoomed(1.05)),
        "cam_T_grip": knocked(shown.reference, (1e-3, -5e-4, 1e-3), (0.5, -0.8, 0.3)),
        "sigma_px": 0.01,
    }
    judge = shown.judge(sigma_px=0.01)
    judge.interrupted()
    cause, _, text = told(shown, judge, **scene)
    assert cause is Cause.CAMERA_REPLACED
    assert stated(text) == pytest.approx(5.0, abs=0.3)
    judge = shown.judge(sigma_px=0.01)
    told(shown, judge, **scene)
    assert Cause.CAMERA_REPLACED not in {c.cause for c in judge.explanation(shown.reference).causes}


def test_without_evidence_the_cause_is_unknown_and_evidence_can_be_forgotten():
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    assert judge.explanation(shown.reference).probable.cause is Cause.UNKNOWN
    bent = {"left": bend(shown.gripper, "left", (8e-4, 5e-4))}
    assert told(shown, judge, bent=bent)[0] is Cause.FINGER_BENT
    judge.reset()
    assert told(shown, judge)[0] is Cause.UNKNOWN
    judge.rebase(REFERENCE_SIGMA)
    assert judge.wants_baseline
    assert told(shown, judge)[0] is Cause.UNKNOWN


def test_a_few_mistaken_frames_do_not_decide():
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    bent = {"left": bend(shown.gripper, "left", (1e-3, 1e-3))}
    for k in range(12):
        judge.add(shown.evidence(bent=bent) if k % 4 == 1 else shown.evidence())
    assert judge.explanation(shown.reference).probable.cause is Cause.UNKNOWN


def test_what_other_borders_can_imitate_is_confirmed_by_a_second_conclusion():
    shown = Shown(sharp_gripper())
    left, right = ({finger: bend(shown.gripper, finger, (8e-4, 5e-4))} for finger in ("left", "right"))
    judge, settings = shown.judge(), CauseSettings()

    def concluded(**scene: Any) -> tuple[Cause, str | None, bool]:
        for _ in range(settings.frames):  # none of the conclusion before
            judge.add(shown.evidence(**scene))
        found = judge.explanation(shown.reference)
        assert found.text.startswith("perhaps ") != found.confirmed
        return found.probable.cause, found.probable.part, found.confirmed

    assert concluded(bent=left) == (Cause.FINGER_BENT, "left", False)
    assert concluded(bent=left) == (Cause.FINGER_BENT, "left", True)
    assert concluded(bent=left) == (Cause.FINGER_BENT, "left", True)
    assert concluded(bent=right) == (Cause.FINGER_BENT, "right", False)
    assert concluded(opening_m=OPENING_M + 5e-4) == (Cause.JAW_OPENING, None, False)
    assert concluded(camera=make_camera(zoomed(1.01))) == (Cause.LENS, None, False)
    assert concluded() == (Cause.UNKNOWN, None, True)
    assert concluded(camera=make_camera(zoomed(1.01))) == (Cause.LENS, None, False)
    judge.reset()
    assert concluded(camera=make_camera(zoomed(1.01))) == (Cause.LENS, None, False)
    assert concluded(camera=make_camera(zoomed(1.01))) == (Cause.LENS, None, True)


def test_a_camera_that_moved_needs_no_second_conclusion():
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    for _ in range(FRAMES):
        judge.add(shown.evidence(knocked(shown.reference, (3e-4, 0.0, 0.0))))
    found = judge.explanation(shown.reference)
    assert found.confirmed and found.confirmed_cause.cause is Cause.CAMERA_MOUNT


def test_settings_refuse_a_probability_that_names_anything():
    with pytest.raises(msgspec.ValidationError, match="probable"):
        msgspec.convert({"probable": 0.4}, CauseSettings)


def test_edges_that_lie_anywhere_tell_nothing():
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    cause, _, text = told(shown, judge, sigma_px=3.0, cam_T_grip=knocked(shown.reference, (1e-3, 0.0, 0.0)))
    assert cause is Cause.UNKNOWN
    assert "scatter" in text
