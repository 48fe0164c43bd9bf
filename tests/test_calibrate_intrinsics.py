"""What a calibration does with views that aren't the best: outliers, discs, one view, none that helps."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2
from support.sightings import CAMERAS, PLATE_M, part_of, poses, seen

from gripmon.calibrate import api, bundle
from gripmon.calibrate.cross_validation import cross_validate
from gripmon.calibrate.intrinsics import calibrate, calibrate_best, doubts_of
from gripmon.calibrate.lens_models import MODELS, lens_vector
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.sighting import CalibrationError, NotFound, Sighting
from gripmon.calibrate.single_view import calibrate_single_view
from gripmon.model.camera import PaperLens
from gripmon.model.geometry import exp_rotation, log_rotation
from gripmon.model.targets import TargetError

BROWN = CAMERAS["brown_conrady"]


def normalised(result, settings) -> float:
    error = lens_vector(result.camera) - lens_vector(settings)
    return float(error @ np.linalg.solve(result.covariance, error))


def test_gross_outliers_are_found_and_change_nothing():
    rng = np.random.default_rng(1)
    held = poses(rng, 8)
    clean = calibrate(seen(BROWN, held, np.random.default_rng(2)), "brown_conrady")
    views = seen(BROWN, held, np.random.default_rng(2))
    wrong = [rng.random(len(v)) < 0.08 for v in views]
    bad = []
    for view, mask in zip(views, wrong, strict=True):
        uv = view.uv_px.copy()
        uv[mask] += rng.uniform(2.0, 40.0, (mask.sum(), 2)) * rng.choice([-1.0, 1.0], (mask.sum(), 2))
        bad.append(replace(view, uv_px=uv))
    result = calibrate(bad, "brown_conrady")
    for used, mask in zip(result.used, wrong, strict=True):
        assert not (used & mask).any()
        assert (used | mask).mean() > 0.99
    moved = lens_vector(result.camera) - lens_vector(clean.camera)
    assert np.abs(moved / np.sqrt(clean.covariance.diagonal())).max() < 1.5


def test_the_offset_of_discs_centres_is_corrected():
    """With it the errors are what the covariance says; without it they are many times that."""
    rng, trials = np.random.default_rng(5), 5
    corrected, plain = [], []
    for _ in range(trials):
        views = seen(BROWN, poses(rng, 8), rng, noise_px=0.02, radius_m=0.007)
        corrected.append(normalised(calibrate(views, "brown_conrady"), BROWN))
        plain.append(normalised(calibrate([replace(v, disc_radius_m=0.0) for v in views], "brown_conrady"), BROWN))
    low, high = chi2.ppf([0.001, 0.999], 8 * trials) / trials
    assert low < np.mean(corrected) < high
    assert np.mean(plain) > 10.0 * high


def test_one_view_gives_focal_length_and_lens():
    """Cameras whose principal point and aspect are what is assumed only roughly: errors are as large as stated."""
    rng = np.random.default_rng(8)
    squares, poses_squares = [], []
    for turn in rng.uniform(0.0, 2.0 * np.pi, 40):
        cx, cy, aspect = rng.normal([383.5, 287.5, 1.0], [7.68, 7.68, 1e-3])
        truth = PaperLens(
            width_px=768, height_px=576, fx_px=962.0, fy_px=962.0 * aspect, cx_px=cx, cy_px=cy, kappa_per_px2=1.9e-7
        )
        T = np.eye(4)
        T[:3, :3] = exp_rotation(0.55 * np.array([np.cos(turn), np.sin(turn), 0.0]))
        T[:3, 3] = np.array([0.0, 0.0, 0.25]) - T[:3, :3] @ PLATE_M.mean(axis=0)
        result = calibrate_single_view(seen(truth, [T], rng, noise_px=0.05)[0])
        assert result.parameters == ("fx_px", "kappa_per_px2")
        assert result.camera.fx_px == result.camera.fy_px and result.camera.cx_px == 383.5
        error = np.array([result.camera.fx_px - 962.0, result.camera.kappa_per_px2 - 1.9e-7])
        squares.append(float(error @ np.linalg.solve(result.covariance, error)))
        found = result.cam_T_plate[0]
        moved = np.concatenate([T[:3, 3] - found[:3, 3], log_rotation(T[:3, :3] @ found[:3, :3].T)])
        poses_squares.append(float(moved @ np.linalg.solve(result.pose_covariance[0], moved)))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(squares)) / len(squares)
    assert low < np.mean(squares) < high
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(squares)) / len(squares)
    assert low < np.mean(poses_squares) < high


def flat_pose(x: float, y: float, z: float, roll: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = exp_rotation(np.array([0.0, 0.0, roll]))
    T[:3, 3] = np.array([x, y, z]) - T[:3, :3] @ PLATE_M.mean(axis=0)
    return T


def test_views_parallel_to_the_image_determine_no_camera():
    rng = np.random.default_rng(9)
    held = [flat_pose(0.01 * k - 0.03, 0.0, 0.25 + 0.02 * k, 0.2 * k) for k in range(6)]
    with pytest.raises(CalibrationError, match=r"don't determine the camera.*tilted by 20 to 45 degrees"):
        calibrate(seen(BROWN, held, rng), "brown_conrady")
    with pytest.raises(CalibrationError, match="tilted"):
        calibrate_single_view(seen(CAMERAS["paper"], held[:1], rng)[0])


def test_views_that_support_the_model_badly_are_warned_of():
    """Two hardly tilted views in the middle of the image: doubts about focal length, lens and reach, each in words."""
    rng = np.random.default_rng(10)
    weak = [flat_pose(0.0, 0.0, 0.6), flat_pose(0.01, 0.0, 0.5)]
    for k, T in enumerate(weak):
        tilt = exp_rotation(np.array([0.12, 0.1 * k, 0.0]))
        T[:3, :3] = tilt @ T[:3, :3]
        T[:3, 3] = np.array([0.0, 0.0, 0.55]) - T[:3, :3] @ PLATE_M.mean(axis=0)
    said = "\n".join(calibrate(seen(BROWN, weak, rng), "brown_conrady", fixed={"cx_px": None, "cy_px": None}).warnings)
    assert "the focal length is uncertain by" in said
    assert "can't be distinguished from 0" in said
    assert "the lens is extrapolated" in said
    good = calibrate(seen(BROWN, poses(rng, 14), rng, noise_px=0.03), "brown_conrady")
    assert good.warnings == ()


def test_a_view_by_another_camera_is_named():
    rng = np.random.default_rng(13)
    views = seen(BROWN, poses(rng, 9), rng)
    other = replace(seen(CAMERAS["fisheye"], poses(rng, 1, 0.12), rng)[0], name="stranger.png")
    with pytest.raises(CalibrationError, match=r"stranger\.png: \d+ of \d+ points contradict the other images"):
        calibrate([*views[:4], other, *views[4:]], "brown_conrady")


def test_views_that_contradict_the_others_are_left_out_and_named(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(13)
    views = [replace(view, name=f"{k}.png") for k, view in enumerate(seen(BROWN, poses(rng, 9), rng))]
    strange = seen(CAMERAS["fisheye"], poses(rng, 2, 0.12), rng)
    others = [replace(view, name=f"stranger{k}.png") for k, view in enumerate(strange)]
    monkeypatch.setattr(api, "_views", lambda *_: ([*views[:4], *others, *views[4:]], {"none.png": "no board"}))
    found = api.calibrate_intrinsics([], "chequerboard:9x7:0.02", model="brown_conrady")
    assert [sighting.name for sighting in found.sightings] == [f"{k}.png" for k in range(9)]
    assert set(found.not_found) == {"none.png", "stranger0.png", "stranger1.png"}
    assert "points contradict the other images" in found.not_found["stranger1.png"]
    assert "stranger0.png is left out: " in " ".join(found.fit.warnings)
    assert len(found.fit.residuals_px) == 9
    np.testing.assert_allclose(found.camera.fx_px, 700.0, atol=5.0 * found.sigmas["fx_px"])


def test_where_half_of_the_views_contradict_nobody_knows_which_half(monkeypatch: pytest.MonkeyPatch):
    views, tried = seen(BROWN, poses(np.random.default_rng(1), 6), np.random.default_rng(2)), []

    def contradicted(left: list[Sighting], *_: object) -> None:
        tried.append(len(left))
        raise bundle.ContradictionError(left[0], 40)

    monkeypatch.setattr(api, "_views", lambda *_: (views, {}))
    monkeypatch.setattr(api, "_fitted", contradicted)
    with pytest.raises(CalibrationError, match=r"40 of \d+ points contradict the other images; images of"):
        api.calibrate_intrinsics([], "chequerboard:9x7:0.02")
    assert tried == [6, 5, 4]  # of six, three left out are half


@pytest.mark.parametrize("shown", [6, 7])
def test_a_board_that_is_described_too_large_is_refused_unless_other_images_show_more(
    shown: int, monkeypatch: pytest.MonkeyPatch
):
    """Close-ups that show more than an image takes for the whole board say that it is another one, or misjudged."""
    rng = np.random.default_rng(5)
    views: list[object] = [part_of(v, 0.02 * (shown - 1), 0.06) for v in seen(BROWN, poses(rng, 5), rng)]
    views[2] = NotFound("the target shows 6 x 4 inner corners; it should have 9 x 7", whole=(6, 4))
    monkeypatch.setattr(api, "images_of_one_camera", lambda _: [(f"{k}.png", k) for k in range(5)])
    monkeypatch.setattr(api, "detect", lambda image, _target, _name: views[image])
    if shown == 7:
        found = api.calibrate_intrinsics(list("abcde"), "chequerboard:9x7:0.02")
        assert len(found.sightings) == 4 and "shows 6 x 4 inner corners" in found.not_found["2.png"]
        return
    said = r"1 of 5 images show a smaller one whole, none shows more \(2.png: the target shows 6 x 4 inner"
    with pytest.raises(TargetError, match=said):
        api.calibrate_intrinsics(list("abcde"), "chequerboard:9x7:0.02")


@pytest.mark.parametrize("model", ["brown_conrady", "brown_conrady_5"])
def test_views_that_determine_nothing_end_after_a_bounded_effort(model: str, monkeypatch: pytest.MonkeyPatch):
    """A set like this one was given up after 254 s."""
    rng = np.random.default_rng(3)
    held = [flat_pose(*rng.uniform(-0.02, 0.02, 2), rng.uniform(1.0, 1.2)) for _ in range(5)]
    views, count = seen(BROWN, held, rng, noise_px=0.3), 0
    plain = bundle.BundleProblem._cost

    def cost(*arguments: object) -> float:
        nonlocal count
        count += 1
        return plain(*arguments)

    monkeypatch.setattr(bundle, "MOST_EVALUATIONS", 150)
    monkeypatch.setattr(bundle.BundleProblem, "_cost", cost)
    with pytest.raises(CalibrationError, match=r"don't determine the camera|did not converge in 150 evaluations"):
        calibrate(views, model)
    assert 150 < count < 200  # and those that check a start
    monkeypatch.undo()
    assert bundle.MOST_EVALUATIONS >= 10 * 100  # what good views take: see the next lines
    monkeypatch.setattr(bundle, "MOST_EVALUATIONS", 100)
    assert calibrate(seen(BROWN, poses(rng, 9), rng), "brown_conrady").rms_px < 0.15


def test_views_of_two_sizes_are_refused():
    rng = np.random.default_rng(15)
    views = seen(BROWN, poses(rng, 4), rng)
    views[2] = replace(views[2], size_px=(1280, 960))
    with pytest.raises(CalibrationError, match="768 x 576 px and view 2 1280 x 960 px; images of one camera"):
        calibrate(views, "paper")


@pytest.mark.parametrize("name", MODELS)
def test_the_criterion_finds_the_model(name: str):
    rng = np.random.default_rng(16)
    distance_m = 0.11 if name == "fisheye" else 0.2
    views = seen(CAMERAS[name], poses(rng, 8, distance_m), rng, noise_px=0.05)
    best = calibrate_best(views, MODELS)
    assert best.model == name
    assert best.criterion is not None and min(best.criterion, key=best.criterion.__getitem__) == name
    assert len(best.criterion) >= 3


def test_cross_validation_measures_what_the_noise_is():
    rng = np.random.default_rng(17)
    views = seen(BROWN, poses(rng, 10), rng, noise_px=0.1)
    steps: list[int] = []
    crossed = cross_validate(calibrate(views, "brown_conrady"), step=lambda: steps.append(1)).rms_px
    # A pose of its own takes 6 of a view's some hundred coordinates.
    assert crossed == pytest.approx(0.1, rel=0.08) and len(steps) == 5
    assert crossed > 0.999 * calibrate(views, "brown_conrady").rms_px
    assert cross_validate(calibrate(views[:3], "brown_conrady")).rms_px is None


def test_what_is_fixed_stays():
    rng = np.random.default_rng(18)
    views = seen(BROWN, poses(rng, 6), rng)
    fixed = dict.fromkeys(("cx_px", "cy_px", "aspect", "coefficients.2", "coefficients.3"))
    result = calibrate(views, "brown_conrady", fixed=fixed)
    assert result.parameters == ("fx_px", "coefficients.0", "coefficients.1")
    camera = result.camera
    assert (camera.cx_px, camera.cy_px) == (383.5, 287.5) and camera.fx_px == camera.fy_px
    assert camera.coefficients[2:] == (0.0, 0.0)
    with pytest.raises(CalibrationError, match=r"focal is not a parameter of paper; one of fx_px.* or aspect"):
        calibrate(views, "paper", fixed={"focal": None})


def test_what_is_held_at_a_value_stays_there_and_helps_the_rest():
    rng = np.random.default_rng(18)
    views = seen(BROWN, poses(rng, 6), rng)
    held = calibrate(views, "brown_conrady", fixed={"fx_px": BROWN.fx_px, "coefficients.0": BROWN.coefficients[0]})
    assert (held.camera.fx_px, held.camera.coefficients[0]) == (BROWN.fx_px, BROWN.coefficients[0])
    assert held.parameters[0] == "fy_px" and held.camera.fy_px == pytest.approx(BROWN.fy_px, abs=0.2)
    # A view parallel to the image, which tells no focal length, tells the lens of a camera whose focal length is known.
    paper = CAMERAS["paper"]
    known = {name: getattr(paper, name) for name in ("fx_px", "cx_px", "cy_px")}
    one = calibrate_single_view(seen(paper, [flat_pose(0.0, 0.0, 0.25)], rng)[0], fixed=known)
    assert one.parameters == ("kappa_per_px2",)
    assert abs(one.camera.kappa_per_px2 - paper.kappa_per_px2) < 4.0 * np.sqrt(one.covariance[0, 0])


def test_terms_that_the_views_do_not_support_are_held_and_said():
    """Where no point lies the fisheye's highest terms fold the lens over; then they are held."""
    rng = np.random.default_rng(19)
    result = calibrate(seen(CAMERAS["fisheye"], poses(rng, 5, 0.3), rng, noise_px=0.3), "fisheye")
    assert "coefficients.3" not in result.parameters
    assert result.camera.coefficients[3] == 0.0
    assert any("held at 0" in w and "coefficients.3" in w for w in result.warnings)


def test_too_few_points():
    rng = np.random.default_rng(20)
    view = seen(BROWN, poses(rng, 1), rng)[0]
    few = replace(view, uv_px=view.uv_px[:3], plate_m=view.plate_m[:3], covariance_px=view.covariance_px[:3])
    with pytest.raises(CalibrationError, match="view 0 shows 3 points; at least 8"):
        calibrate([few], "paper")
    with pytest.raises(CalibrationError, match="3 points of the plate; at least 4"):
        plate_pose(BROWN, few)
    line = PLATE_M[:, 1] == 0.0
    flat = replace(view, uv_px=view.uv_px[:9], plate_m=PLATE_M[line], covariance_px=view.covariance_px[:9])
    with pytest.raises(CalibrationError, match="lie on a line"):
        plate_pose(BROWN, flat)
    with pytest.raises(CalibrationError, match="no view shows the target"):
        calibrate([], "paper")


@pytest.mark.parametrize(
    ("reach", "lost", "rms_share", "said"),
    [
        (0.62, 9, 0.0006, []),
        (0.58, 9, 0.0006, ["no point lies farther than 58 %"]),
        (0.62, 11, 0.0006, ["11 of 100 points don't fit"]),
        (0.62, 9, 0.0008, ["residuals of 0.51 px are large"]),
    ],
)
def test_views_are_doubted_from_stated_limits_on(reach: float, lost: int, rms_share: float, said: list[str]):
    """Reach in parts of the half diagonal, 400 px; residuals in parts of the width."""
    uv_px = np.array([320.0, 240.0]) + np.linspace(0.0, 400.0 * reach, 100)[:, None] * [0.8, 0.6]
    sighting = Sighting(uv_px, np.zeros((100, 3)), np.tile(np.eye(2), (100, 1, 1)), (640, 480))
    result = SimpleNamespace(
        target=None,
        camera=SimpleNamespace(width_px=640, height_px=480, fx_px=700.0),
        values={},
        parameters=(),
        covariance=np.zeros((0, 0)),
        used=[np.arange(100) >= lost],
        rms_px=640.0 * rms_share,
        view_rms_px=[0.05],
        sightings=(sighting,),
    )
    doubts = doubts_of(result)
    assert len(doubts) == len(said) and all(d.startswith(s) for d, s in zip(doubts, said, strict=True))
