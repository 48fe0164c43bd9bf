"""Rough corners become measured ones: images whose fingers are drawn ray by ray, on plates of every kind."""

from __future__ import annotations

from functools import lru_cache

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2
from support.plate_fingers import (
    CHARUCO,
    CHEQUERBOARD,
    DISCS,
    OPENING_M,
    outline_pixels,
    rough,
    standing,
    true_corners,
    true_name,
)
from support.plates import Look
from support.simulated import BOX_FINGERS, PAPER_LENS, STRONG_LENS, nominal_cam_T_grip, sharp_gripper

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.detection import detect
from gripmon.calibrate.plane import Coincidence
from gripmon.calibrate.plane_average import average
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import perturbation_between
from gripmon.model.gripper import contents_of
from gripmon.model.records import Image
from gripmon.model.targets import CircleGrid, Target, TargetError
from gripmon.simulate import make_scenario, paper_rig
from gripmon.simulate.background import _TILE_PX
from gripmon.teach.hand_eye import HandEyeOnPlate, KnownGripper, UnknownGripper, calibrate_plane
from gripmon.teach.outline_edges import measure_outlines
from gripmon.teach.outlines import inferred_model, measure_known, outlines_of

TRUE = nominal_cam_T_grip()
TARGETS: dict[str, Target] = {"discs": DISCS, "chequerboard": CHEQUERBOARD, "charuco": CHARUCO}
LENSES: dict[str, LensSettings] = {"paper": PAPER_LENS, "strong": STRONG_LENS}
NEAR = [name for name in true_corners(TRUE) if not name.endswith("out_far")]


@lru_cache(maxsize=4)
def image(target: str, lens: str = "paper") -> Image:
    out = standing(TARGETS[target], lens=LENSES[lens], look=Look(supersampling=3))
    out.flags.writeable = False
    return out


def sight(target: str, lens: str = "paper") -> Sighting:
    found = detect(image(target, lens), TARGETS[target], f"{target}.png")
    assert isinstance(found, Sighting), found
    return found


def true_of(found: Coincidence, lens: LensSettings) -> np.ndarray:
    true = true_corners(TRUE, lens)
    return np.array([true[name if name in true else true_name(name)] for name in found.corners.names])


@pytest.mark.parametrize(
    ("target", "known"),
    [
        ("discs", False),
        pytest.param("charuco", True, marks=pytest.mark.slow("2 s each; inferred by default")),
    ],
)
def test_the_tcp_from_one_image_and_rough_corners(target: str, known: bool):
    """To reach: 0.02 mm across the line of sight and 0.05 mm along it."""
    camera = GivenCamera(PAPER_LENS)
    for seed in range(2):
        if known:
            guess = rough({name: true_corners(TRUE)[name] for name in NEAR}, seed)
            found = (
                KnownGripper(camera, sharp_gripper(), OPENING_M)
                .measure(image(target), sight(target), guess)
                .coincidence
            )
        else:
            guess = rough(outline_pixels(TRUE), seed)
            found = UnknownGripper(camera).measure(image(target), sight(target), guess).coincidence
        off_px = np.linalg.norm(found.corners.uv_px - true_of(found, PAPER_LENS), axis=1)
        assert len(off_px) == 6 and off_px.max() < 0.5
        error = perturbation_between(found.cam_T_grip, TRUE)
        assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all(), (seed, 1e6 * error[:3])
        assert error @ np.linalg.solve(found.covariance, error) < chi2.ppf(1.0 - 1e-5, 6)
        assert average([found], not known).warnings == ()


@pytest.mark.parametrize("target", [CHEQUERBOARD, CHARUCO])
def test_an_unknown_gripper_before_squares_is_refused(target: Target):
    """Their edges look like a finger's: found on them, three of four TCPs were off, some without a warning."""
    with pytest.raises(TargetError, match=r"can't be told from the outlines of an unknown gripper; discs"):
        calibrate_plane([image("discs")], PAPER_LENS, None, target, corners=rough(outline_pixels(TRUE), 1))


def test_a_strong_lens_bends_edges_and_they_are_still_lines():
    for method, guess in (
        (KnownGripper(GivenCamera(STRONG_LENS), sharp_gripper(), OPENING_M), true_corners(TRUE, STRONG_LENS)),
        (UnknownGripper(GivenCamera(STRONG_LENS)), outline_pixels(TRUE, STRONG_LENS)),
    ):
        taken = {name: uv for name, uv in guess.items() if not name.endswith("out_far")}
        found = method.measure(image("discs", "strong"), sight("discs", "strong"), rough(taken, 1)).coincidence
        error = perturbation_between(found.cam_T_grip, TRUE)
        assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all(), 1e6 * error[:3]


def test_the_simulators_parked_gripper():
    """Another renderer, a bevel and texture on the fingers, no rough corners but a rough calibration."""
    camera, true, gripper = make_camera(PAPER_LENS), nominal_cam_T_grip(), read_gripper(BOX_FINGERS)
    simulator = paper_rig(gripper, true).simulator(make_scenario("series1"), 5)
    period_m = _TILE_PX * float(true[2, 3]) / camera.fx_px
    plate = CircleGrid(60, 60, period_m / round(period_m / 8e-3), 0.004)  # whole discs in a tile
    for index in (0, 2, 4):
        frame, true = simulator.render(index), simulator.truth(index).cam_T_grip
        seen = detect(frame, plate, f"{index}.png")
        assert isinstance(seen, Sighting), seen
        method = KnownGripper(GivenCamera(PAPER_LENS), gripper, 0.034, nominal_cam_T_grip())
        found = method.measure(frame, seen, None).coincidence
        error = perturbation_between(found.cam_T_grip, true)
        assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all(), (index, 1e6 * error[:3])


@pytest.mark.slow("6 s: sampled; errors of the TCP are held against their covariance in the default run")
def test_corners_have_the_spread_that_their_covariance_states():
    """Snapped corners over images with noise of their own; correlations between corners count."""
    camera, outline = make_camera(PAPER_LENS), outlines_of(rough(outline_pixels(TRUE), 3))
    clean = image("discs").astype(np.float64)
    found = []
    for seed in range(40):
        noise = np.random.default_rng(seed).normal(0.0, 4.0, clean.shape)
        found.append(measure_outlines(camera, np.clip(np.rint(clean + noise), 0, 255).astype(np.uint8), outline)[0])
    scatter = np.cov(np.array([f.uv_px.ravel() for f in found]).T)
    stated = np.mean([f.covariance_px for f in found], axis=0)
    # What is stated holds what doesn't change from image to image, too: never less than the scatter.
    assert (scatter.diagonal() < 1.6 * stated.diagonal()).all()
    assert (stated.diagonal() < 60.0 * scatter.diagonal()).all()


def test_the_inferred_gripper_is_the_true_one_and_a_monitor_takes_it():
    camera, outline = make_camera(PAPER_LENS), outlines_of(rough(outline_pixels(TRUE), 4))
    method = UnknownGripper(GivenCamera(PAPER_LENS))
    seen = method.measure(image("discs"), sight("discs"), rough(outline_pixels(TRUE), 4))
    result = average([seen.coincidence], True)
    gripper = HandEyeOnPlate(result, method, (seen,), (), (), image("discs")).result("new", (0.0, 0.06)).gripper
    model, true = gripper.model, sharp_gripper()
    assert outline.names == tuple(model.points)
    for name in gripper.corner_ids:
        want = true.model.points[true_name(name)].xyz_m
        np.testing.assert_allclose(model.points[name].xyz_m, want, atol=8e-5)
    # Edges that rise lie along the fingers.
    for finger in ("left", "right"):
        for side, foot in (("far", "inner_far"), ("near", "outer_near")):
            high = np.array(model.points[f"{finger}_rise_{side}"].xyz_m)
            low = np.array(model.points[f"{finger}_{foot}"].xyz_m)
            np.testing.assert_allclose((high - low)[:2], 0.0, atol=2e-4)
            assert -0.032 < high[2] < -0.018
    assert model.jaw is not None and model.jaw.nominal_m == pytest.approx(OPENING_M, abs=5e-5)
    np.testing.assert_allclose(gripper.points_grip_m(0.04)[0, 0] - gripper.points_grip_m(None)[0, 0], -0.003, atol=3e-5)
    measured, missing = measure_known(camera, gripper, image("discs"), result.cam_T_grip, model.jaw.nominal_m)
    assert not missing and set(measured.names) == set(gripper.corner_ids)
    assert msgspec.convert(contents_of(model), type(model)) == model


SQUARE = {
    f"{finger}_{kind}_{side}": (u, v)
    for finger, inner, outer in (("left", 240.0, 150.0), ("right", 540.0, 630.0))
    for kind, u in (("inner", inner), ("outer", outer))
    for side, v in (("near", 240.0), ("far", 350.0))
}


def without(*names: str) -> dict[str, tuple[float, float]]:
    return {name: uv for name, uv in SQUARE.items() if name not in names}


def test_outlines_are_chains_and_close_where_both_outer_corners_are():
    closed = outlines_of(SQUARE)
    assert len(closed.edges) == 8 and closed.corners == tuple(range(8))
    open_ = outlines_of({**without("left_outer_far"), "left_end_far": (150.0, 350.0)})
    assert len(open_.edges) == 7
    assert {open_.names[k] for k in range(len(open_.names)) if k not in open_.corners} == {
        "left_end_far",
        "left_outer_near",
    }
    longer = outlines_of({**SQUARE, "left_rise_near": (150.0, 300.0)})
    assert "left_outer_near" in {longer.names[k] for k in longer.corners}
    assert closed.names[:4] == ("left_inner_near", "left_inner_far", "right_inner_near", "right_inner_far")


def test_edges_of_an_inferred_gripper_have_names_of_their_own():
    full = outlines_of({**SQUARE, "left_rise_near": (150.0, 300.0), "right_end_far": (600.0, 400.0)})
    model = inferred_model(
        "g", full, np.column_stack([full.points * 1e-4, np.zeros(len(full.points))]), None, None, None
    )
    assert len(model.edges) == len(full.edges)
    assert {"left_inner", "left_near", "left_rise_near", "right_end_far"} <= set(model.edges)
    assert model.jaw is None and all(f.motion is None for f in model.fingers.values())


@pytest.mark.parametrize(
    ("name", "to", "reason"),
    [
        ("left_inner_near", (-5.0, 100.0), "corners.left_inner_near: .* lies outside of the image"),
        ("left_inner_near", (380.0, 60.0), "its edge is visible along"),
        ("left_inner_near", (250.0, 350.0), "px apart; at least"),
    ],
)
def test_corners_that_arent_there(name: str, to: tuple[float, float], reason: str):
    points = {**rough(outline_pixels(TRUE), 5), name: to}
    with pytest.raises(CalibrationError, match=reason):
        measure_outlines(make_camera(PAPER_LENS), image("discs"), outlines_of(points))


def test_a_known_gripper_that_isnt_there():
    method = KnownGripper(GivenCamera(PAPER_LENS), sharp_gripper(), OPENING_M)
    empty = np.full_like(image("discs"), 150)
    with pytest.raises(CalibrationError, match="the gripper isn't seen where it should be"):
        method.measure(empty, sight("discs"), rough({n: true_corners(TRUE)[n] for n in NEAR}, 6))


def test_only_the_corners_that_were_named_are_taken():
    method = KnownGripper(GivenCamera(PAPER_LENS), sharp_gripper(), OPENING_M)
    guess = rough({name: true_corners(TRUE)[name] for name in ("L_in_near", "R_in_far")}, 7)
    look = method.measure(image("discs"), sight("discs"), guess)
    assert look.coincidence.corners.names == ("L_in_near", "R_in_far")
    assert np.abs(perturbation_between(look.coincidence.cam_T_grip, TRUE)[:3]).max() < 5e-5
    hidden = method.measure(image("discs"), sight("discs"), rough(true_corners(TRUE), 8))
    assert set(hidden.missing) == {"L_out_far", "R_out_far"}


def test_a_gripper_the_other_way_round_is_refused_beside_a_rough_calibration():
    true = true_corners(TRUE)
    other = {"L_in_near": "R_in_far", "L_in_far": "R_in_near", "R_in_near": "L_in_far", "R_in_far": "L_in_near"}
    guess = {name: tuple(map(float, true[place])) for name, place in other.items()}
    method = KnownGripper(GivenCamera(PAPER_LENS), sharp_gripper(), OPENING_M, TRUE)
    with pytest.raises(CalibrationError, match=r"turned by 180 degrees"):
        method.measure(image("discs"), sight("discs"), guess)
