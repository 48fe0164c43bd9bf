"""The look as a measurement: its kernel against NumPy, its motions against simulated truth."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import numpy as np
import pytest
from support.by_numpy import look as by_numpy
from support.simulated import BOX_FINGERS, PAPER_LENS, PLAIN_FINGERS, simulator

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.scenario import FingerLook, JawScript, Light, LightStep, Shadow, Tilt
from gripmon.track.look import LookAlignment, LookFusion, LookMotion, alignment, kernel
from gripmon.track.look.alignment import FEWEST_VIEWS, LINEAR_PX
from gripmon.track.look.fusion import BIAS_BACKGROUNDS, PER_OPENING

LEARNT = 20
TEXTURED = FingerLook(texture=0.15, carriers=False)


def filmed(**settings: object) -> Simulator:
    """Two frames a second, so that each has another background; what happens, happens after 10.2 s."""
    return simulator(Scenario(duration_s=20.0, fps=2.0, **{"fingers": TEXTURED, **settings}), sharp=False)  # type: ignore[arg-type]


def learnt(simulation: Simulator, frames: int = LEARNT) -> LookAlignment:
    alignment = LookAlignment(make_camera(PAPER_LENS), read_gripper(BOX_FINGERS))
    for i in range(frames):
        truth = simulation.truth(i)
        alignment.learn(simulation.render(i), truth.cam_T_grip, truth.jaw_opening_m)
    return alignment


@cache
def standing() -> tuple[Simulator, LookAlignment]:
    simulation = filmed()
    return simulation, learnt(simulation)


def errors_um(simulation: Simulator, alignment: LookAlignment, frames: range) -> tuple[np.ndarray, np.ndarray]:
    """TCP errors (n, 3) and squared normalised errors (n,), each started some micrometres off the truth."""
    rng = np.random.default_rng(3)
    errors, squares = [], []
    for i in frames:
        truth = simulation.truth(i)
        start = perturb(truth.cam_T_grip, rng.normal(0.0, [3e-6, 3e-6, 1e-5, 1e-4, 1e-4, 1e-4]))
        found = alignment.measure(simulation.render(i), start, truth.jaw_opening_m, 0.0)
        assert found is not None
        error = perturbation_between(found.cam_T_grip, truth.cam_T_grip)
        errors.append(1e6 * error[:3])
        squares.append(error @ np.linalg.solve(found.covariance, error))
    return np.array(errors), np.array(squares)


def random_patches(rng: np.random.Generator, patches: int = 12, pixels: int = 36) -> tuple[np.ndarray, ...]:
    mean = rng.uniform(40.0, 200.0, (patches, pixels))
    jacobian = rng.normal(0.0, 30.0, (patches, 7, pixels))
    truth = rng.normal(0.0, 0.02, 7)
    gain, offset = rng.uniform(0.6, 1.6, (patches, 1)), rng.uniform(-20.0, 20.0, (patches, 1))
    values = gain * (mean + truth @ jacobian) + offset + rng.normal(0.0, 1.0, mean.shape)
    weight = rng.uniform(0.2, 1.0, mean.shape)
    values[1, :15] += 90.0  # something in front
    values[2] = rng.uniform(0.0, 255.0, pixels)
    values[3, 4] = np.nan  # partly outside the image
    weight[4] = 0.0
    known = np.array([0.0] * 6 + [0.05])
    return values, mean, weight, jacobian, np.array([0.0] * 6 + [1e2]), known


@pytest.mark.parametrize("seed", range(6))
def test_the_compiled_fit_is_that_of_numpy(seed: int):
    patches = random_patches(np.random.default_rng(seed))
    for one, other in zip(kernel.align(*patches), by_numpy.align(*patches), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("by", [kernel, by_numpy])
def test_from_where_the_fit_ended_it_goes_no_farther(by: ModuleType):
    """What is known of the opening counts once, however often the image is read."""
    rng = np.random.default_rng(12)
    mean, weight = rng.uniform(40.0, 200.0, (12, 36)), np.ones((12, 36))
    jacobian, motion = rng.normal(0.0, 30.0, (12, 7, 36)), rng.normal(0.0, 0.02, 7)
    jacobian -= jacobian.mean(axis=2, keepdims=True)
    prior, known = np.array([0.0] * 6 + [3e5]), np.zeros(7)
    step, information, *_ = by.align(mean + motion @ jacobian, mean, weight, jacobian, prior, known)
    assert 0.2 < prior[6] / information[6, 6] < 0.8  # both say something of it
    rest = mean + (motion - step) @ jacobian
    again, *_ = by.align(rest, mean, weight, jacobian, prior, known - step)
    assert abs(again[6]) < 0.05 * abs(step[6])


@pytest.mark.parametrize("shape", [(40, 50, 1), (40, 50, 3)])
def test_the_compiled_reading_is_that_of_numpy(shape: tuple[int, ...]):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, shape).astype(np.uint8)
    weights = np.full(shape[2], 1.0 / shape[2])
    base_px = rng.uniform(-3.0, 53.0, (9, 16, 2))
    flow, motion = rng.normal(0.0, 1.0, (9, 16, 2, 7)), rng.normal(0.0, 0.3, 7)
    one, other = (
        kernel.read(image, weights, base_px, flow, motion),
        by_numpy.read(image, weights, base_px, flow, motion),
    )
    assert np.isnan(one).any()
    np.testing.assert_allclose(one, other, rtol=1e-9)


def test_a_quadratic_image_is_read_exactly():
    v, u = np.mgrid[0:30, 0:40].astype(float)
    at = np.random.default_rng(1).uniform(2.0, 27.0, (4, 9, 2))
    image = 3.0 + 0.5 * u - 0.2 * v + 0.01 * u * u - 0.02 * u * v + 0.03 * v * v
    x, y = np.moveaxis(at, -1, 0)
    expected = 3.0 + 0.5 * x - 0.2 * y + 0.01 * x * x - 0.02 * x * y + 0.03 * y * y
    got = kernel.read(image[..., None], np.ones(1), at, np.zeros((4, 9, 2, 7)), np.zeros(7))
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_a_gripper_that_stands_still_stands_still_within_what_is_claimed():
    simulation, alignment = standing()
    errors, squares = errors_um(simulation, alignment, range(LEARNT, 40))
    assert (errors.std(axis=0) < [2.0, 4.0, 4.0]).all()
    assert 2.0 < squares.mean() < 10.0  # of 6


def test_a_motion_is_measured_whole():
    """0.2 mm and a tenth of a degree, through pixels that were projected again."""
    tilt = Tilt(start_s=10.2, time_s=0.0, tcp_shift_m=(2e-4, -1e-4), translation_m=(0.0, 0.0, 2e-4))
    simulation = filmed(mount=(tilt,))
    errors, _ = errors_um(simulation, learnt(simulation), range(24, 36))
    assert (np.abs(errors.mean(axis=0)) < [4.0, 6.0, 8.0]).all()


@pytest.mark.parametrize(
    ("settings", "most_um"),
    [
        ({"light": Light(steps=(LightStep(at_s=10.2, factor=1.3),))}, (4.0, 6.0, 8.0)),
        ({"light": Light(shadows=(Shadow(start_s=10.2, end_s=20.0, depth=0.5, softness=0.06),))}, (4.0, 6.0, 8.0)),
        # As much as the fusion allows for: 8 mm of the jaw.
        ({"jaw": JawScript(knots=((10.2, 0.05), (14.0, 0.042)))}, (8e3 * PER_OPENING,) * 3),
    ],
    ids=["brighter", "shadow", "jaw"],
)
def test_light_and_jaws_change_little(settings: dict[str, object], most_um: tuple[float, ...]):
    simulation = filmed(**settings)
    errors, _ = errors_um(simulation, learnt(simulation), range(24, 38))
    assert (np.abs(errors.mean(axis=0)) < most_um).all()


def test_reading_again_does_not_take_the_opening_farther_from_what_is_known(monkeypatch: pytest.MonkeyPatch):
    """A report 0.1 mm off: three times or twelve, the pixels and the report together say the same."""
    (simulation, learnt_before), off_m = standing(), []
    truth = simulation.truth(30)
    assert truth.jaw_opening_m is not None
    monkeypatch.setattr(alignment, "CLOSE_PX", 0.0)
    for readings in (3, 12):
        monkeypatch.setattr(alignment, "READINGS", readings)
        args = simulation.render(30), truth.cam_T_grip, truth.jaw_opening_m + 1e-4, 5e-6
        found = learnt_before.measure(*args)
        assert found is not None and found.jaw_opening_m is not None
        off_m.append(found.jaw_opening_m - truth.jaw_opening_m)
    assert 3e-5 < off_m[0] < 9e-5  # both say something of it
    assert off_m[1] == pytest.approx(off_m[0], abs=2e-6)


def test_what_hides_half_of_a_finger_is_left_out():
    simulation, alignment = standing()
    truth = simulation.truth(30)
    image = simulation.render(30).copy()
    image[:, :160] = 215
    found = alignment.measure(image, truth.cam_T_grip, truth.jaw_opening_m, 0.0)
    assert found is not None
    error = perturbation_between(found.cam_T_grip, truth.cam_T_grip)
    assert error @ np.linalg.solve(found.covariance, error) < 22.5


def test_a_view_that_is_covered_says_nothing():
    simulation, alignment = standing()
    truth = simulation.truth(30)
    covered = np.full_like(simulation.render(30), 90)
    assert alignment.measure(covered, truth.cam_T_grip, truth.jaw_opening_m, 0.0) is None


def test_a_finger_without_texture_says_nothing_rather_than_that_it_stands_still():
    simulation = filmed(fingers=PLAIN_FINGERS)
    alignment = learnt(simulation, 12)
    truth = simulation.truth(20)
    found = alignment.measure(simulation.render(20), truth.cam_T_grip, truth.jaw_opening_m, 0.0)
    if found is not None:  # creases between faces
        moved = perturb(truth.cam_T_grip, np.array([0.0, 0.0, 3e-5, 0.0, 0.0, 0.0]))
        again = alignment.measure(simulation.render(20), moved, truth.jaw_opening_m, 0.0)
        assert again is not None
        error = perturbation_between(again.cam_T_grip, truth.cam_T_grip)
        assert error @ np.linalg.solve(again.covariance, error) < 22.5


def test_nothing_is_measured_before_enough_views():
    simulation = filmed()
    alignment = learnt(simulation, FEWEST_VIEWS - 1)
    assert not alignment.ready
    truth = simulation.truth(FEWEST_VIEWS)
    alignment.learn(simulation.render(FEWEST_VIEWS), truth.cam_T_grip, truth.jaw_opening_m)
    assert alignment.ready


def test_colour_and_sixteen_bits_measure_the_same():
    simulation, alignment = standing()
    truth, image = simulation.truth(33), simulation.render(33)
    args = truth.cam_T_grip, truth.jaw_opening_m, 0.0
    poses = [alignment.measure(i, *args) for i in (image, np.stack([image] * 3, -1), image.astype(np.uint16) * 257)]
    for pose in poses[1:]:
        assert pose is not None and poses[0] is not None
        assert np.abs(perturbation_between(pose.cam_T_grip, poses[0].cam_T_grip)[:3]).max() < 5e-7


EDGES = np.diag(np.square([1.5e-6, 4e-6, 8e-6, 1e-4, 1e-4, 1e-4]))
LOOK = EDGES / 25.0


def fused_path(path: np.ndarray, rng: np.random.Generator, fusion: LookFusion) -> np.ndarray:
    """Fused TCP positions (n, 3) along true ones; the look has learnt with an error of its own."""
    bias, out = rng.multivariate_normal(np.zeros(6), EDGES), []
    for xyz in path:
        true_T = perturb(np.eye(4), np.concatenate([xyz, np.zeros(3)]))
        edges_T = perturb(true_T, rng.multivariate_normal(np.zeros(6), EDGES))
        look_T = perturb(true_T, bias + rng.multivariate_normal(np.zeros(6), LOOK))
        fused = fusion.fuse(edges_T, EDGES, LookMotion(look_T, LOOK, None))
        fusion.learn()
        out.append((edges_T if fused is None else fused[0])[:3, 3])
    return np.array(out)


def test_a_creep_of_a_micrometre_a_minute_is_no_bias():
    """Two hours, a background a second: what edges and look both see never becomes the look's bias."""
    rng, seconds = np.random.default_rng(2), np.arange(0.0, 7200.0)
    path = np.column_stack([1e-6 * seconds / 60.0, np.zeros_like(seconds), np.zeros_like(seconds)])
    fused = fused_path(path, rng, LookFusion(0.03))
    per_minute_um = 6e7 * np.polyfit(seconds, fused[:, 0], 1)[0]
    assert per_minute_um == pytest.approx(1.0, abs=0.02)


def test_the_fused_pose_scatters_less_than_either_and_about_the_edges_mean():
    rng = np.random.default_rng(4)
    fused = fused_path(np.zeros((1000, 3)), rng, LookFusion(0.03))[200:]
    edges_um = 1e6 * np.sqrt(EDGES.diagonal()[:3])
    assert (1e6 * fused.std(axis=0) < 0.45 * edges_um).all()
    assert (1e6 * np.abs(fused.mean(axis=0)) < 4.0 * edges_um / np.sqrt(BIAS_BACKGROUNDS)).all()


def test_no_direction_is_worse_than_the_edges_from_the_first_frame_that_is_measured():
    """Edges that err much alike from one background to the next; the look is learnt where they have the gripper."""
    rng, alike = np.random.default_rng(11), 0.8
    edges, fused = [], []
    for _ in range(400):
        fusion, errors = LookFusion(0.03), [rng.multivariate_normal(np.zeros(6), EDGES)]
        while len(errors) < FEWEST_VIEWS + 8:
            fresh = rng.multivariate_normal(np.zeros(6), (1.0 - alike**2) * EDGES)
            errors.append(alike * errors[-1] + fresh)
        for error in errors[:FEWEST_VIEWS]:
            fusion.place(perturb(np.eye(4), error), EDGES, None)
        bias = np.mean(errors[:FEWEST_VIEWS], axis=0)
        for error in errors[FEWEST_VIEWS:]:
            look_T = perturb(np.eye(4), bias + rng.multivariate_normal(np.zeros(6), LOOK))
            both = fusion.fuse(perturb(np.eye(4), error), EDGES, LookMotion(look_T, LOOK, None))
            fusion.learn()
            assert both is not None
            edges.append(error)
            fused.append(perturbation_between(np.eye(4), both.cam_T_grip))
    one, other = (np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (fused, edges))
    assert (one < 0.85 * other).all()


def test_the_fused_pose_changes_by_as_much_as_is_claimed_while_nothing_moves():
    """From frame to frame by what changes; over many backgrounds by that and the bias."""
    rng, fusion, poses, changes, biases = np.random.default_rng(8), LookFusion(0.03), [], [], []
    for _ in range(3000):
        edges_T = perturb(np.eye(4), rng.multivariate_normal(np.zeros(6), EDGES))
        look_T = perturb(np.eye(4), rng.multivariate_normal(np.zeros(6), LOOK))
        fused = fusion.fuse(edges_T, EDGES, LookMotion(look_T, LOOK, None))
        fusion.learn()
        if fused is not None:
            poses.append(perturbation_between(np.eye(4), fused.cam_T_grip))
            changes.append(fused.of_change)
            biases.append(fused.of_bias)
    at, change, bias = np.array(poses)[500:], np.array(changes)[500:], np.array(biases)[500:]
    for lag, with_bias, bounds in ((1, 0.0, (0.6, 1.1)), (300, 1.0, (0.5, 1.2))):
        way = at[lag:] - at[:-lag]
        claimed = 2.0 * (change[lag:] + with_bias * bias[lag:])
        squares = np.einsum("ni,ni->n", way, np.linalg.solve(claimed, way[..., None])[..., 0])
        assert bounds[0] < squares.mean() / 6.0 < bounds[1], lag


def test_the_edges_count_where_the_look_contradicts_them():
    fusion = LookFusion(0.03)
    fused_path(np.zeros((50, 3)), np.random.default_rng(6), fusion)
    far = perturb(np.eye(4), np.array([0.0, 0.0, 1e-4, 0.0, 0.0, 0.0]))
    assert fusion.fuse(np.eye(4), EDGES, LookMotion(far, LOOK, None)) is None
    fusion.learn()
    assert fusion.contradicts


def test_after_a_motion_the_edges_decide_again_as_far_as_depths_may_be_wrong():
    """A look whose motions come out 1 % too large: 4 mm are 40 µm, and are gone after some backgrounds."""
    fusion, rng = LookFusion(0.03), np.random.default_rng(7)
    fused_path(np.zeros((100, 3)), rng, fusion)
    there = perturb(np.eye(4), np.array([0.0, 4e-3, 0.0, 0.0, 0.0, 0.0]))
    wrong = perturb(there, np.array([0.0, 4e-5, 0.0, 0.0, 0.0, 0.0]))
    errors = []
    for _ in range(20):
        edges_T = perturb(there, rng.multivariate_normal(np.zeros(6), EDGES))
        fused = fusion.fuse(edges_T, EDGES, LookMotion(wrong, LOOK, None))
        fusion.learn()
        assert fused is not None
        errors.append(fused[0][1, 3] - there[1, 3])
    assert np.abs(errors).max() < 1.2e-5 and np.abs(errors[5:]).max() < 6e-6


def test_pixels_move_linearly_as_far_as_they_are_taken_to():
    _, alignment = standing()
    placed = alignment._measured
    assert placed is not None and placed._at is not None
    base_T, opening_m = placed._at
    motion = np.array([1e-5, -2e-5, 3e-5, 4e-4, -3e-4, 5e-4, 0.0])
    motion *= LINEAR_PX / np.abs(placed.flow @ motion).max()
    there = perturb(base_T, np.concatenate([base_T[:3, :3] @ motion[:3], base_T[:3, :3] @ motion[3:6]]))
    linear = placed.base_px + placed.flow @ motion
    placed._project(there, opening_m)
    assert np.abs(placed.base_px - linear).max() < 2e-3
    placed._project(base_T, opening_m)
