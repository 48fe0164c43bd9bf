"""What is learnt of the error of reported jaw openings, against simulated reports and estimates with known errors."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.track.jaw import SYSTEMATIC_M, UNREPORTED_MOTION_SIGMAS, Fused, JawKnowledge

SIGMA_M, OFFSET_SIGMA_M = 5e-5, 2e-4
Z_BY_JAW = -3.2  # what an error of the opening does to the distance, as with the box fingers
POSE_SIGMA = np.array([1e-6, 2e-6, 6e-6, 1e-4, 1e-4, 1e-4])
IMAGE_SIGMA_M = 8e-6


def estimate(rng: np.random.Generator, true_m: float, reported_m: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Error of the pose (6,), opening and covariance (7, 7) of a fit with the report's prior: the image gives the pose
    at a known opening, and the opening, independently.
    """
    prior = SIGMA_M**2 + OFFSET_SIGMA_M**2
    seen_m = true_m + rng.normal(scale=IMAGE_SIGMA_M)
    variance = 1.0 / (1.0 / IMAGE_SIGMA_M**2 + 1.0 / prior)
    opening_m = variance * (seen_m / IMAGE_SIGMA_M**2 + reported_m / prior)
    by_jaw = np.array([0.0, 0.3, Z_BY_JAW, 0.0, 0.0, 0.0])
    error = rng.normal(scale=POSE_SIGMA) + by_jaw * (opening_m - true_m)
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = np.diag(POSE_SIGMA**2) + variance * np.outer(by_jaw, by_jaw)
    covariance[:6, 6] = covariance[6, :6] = variance * by_jaw
    covariance[6, 6] = variance
    return error, opening_m, covariance


def run(
    knowledge: JawKnowledge, rng: np.random.Generator, true_m: list[float], reported_m: list[float]
) -> tuple[np.ndarray, list[Fused], np.ndarray]:
    """Errors (n, 6) of the fused poses, what came out, and errors of the fused openings (n,)."""
    errors, out = [], []
    for true, reported in zip(true_m, reported_m, strict=True):
        error, opening_m, covariance = estimate(rng, true, reported)
        out.append(knowledge.fuse(reported, opening_m, covariance))
        seen = out[-1].seen
        if seen is not None:
            knowledge.learn(seen)
        errors.append(error + out[-1].xi)
    return np.array(errors), out, np.array([f.jaw_opening_m for f in out]) - np.array(true_m)


def test_where_the_jaw_stands_the_distance_becomes_as_good_as_with_a_known_opening():
    rng, late = np.random.default_rng(1), []
    for _ in range(40):
        offset_m = rng.normal(scale=OFFSET_SIGMA_M) + rng.normal(scale=SIGMA_M)
        errors, out, _ = run(JawKnowledge(SIGMA_M, OFFSET_SIGMA_M), rng, [0.034] * 60, [0.034 + offset_m] * 60)
        late.append(errors[-1, 2] ** 2 / out[-1].covariance[2, 2])
        assert np.sqrt(out[0].covariance[2, 2]) > 3.0 * POSE_SIGMA[2]
        assert np.sqrt(out[-1].covariance[2, 2]) < 2.0 * POSE_SIGMA[2]
    assert 0.4 < np.mean(late) < 1.6, "and it claims what it has"


def test_the_offset_is_remembered_when_the_jaw_has_moved():
    rng, known, unknown = np.random.default_rng(2), [], []
    for _ in range(60):
        offset_m = rng.normal(scale=OFFSET_SIGMA_M)
        moves = [0.034 + 1e-3 * (k % 12) for k in range(80)]
        reported = [m + offset_m + rng.normal(scale=5e-6) for m in moves]
        _, out, errors_m = run(JawKnowledge(5e-6, OFFSET_SIGMA_M), rng, moves, reported)
        unknown.append(errors_m[0])
        known.append(errors_m[-1])
        assert out[-1].sigma_m < 0.7 * out[0].sigma_m
    assert np.std(known) < 0.7 * np.std(unknown)


def test_poses_have_the_spread_that_is_claimed_while_the_jaw_moves():
    rng, nees = np.random.default_rng(3), []
    for _ in range(40):
        true = [0.034 + 3e-4 * k for k in range(20)]
        reported = [m + rng.normal(scale=SIGMA_M) for m in true]
        errors, out, _ = run(JawKnowledge(SIGMA_M, OFFSET_SIGMA_M), rng, true, reported)
        nees += [e @ np.linalg.solve(f.covariance, e) for e, f in zip(errors, out, strict=True)]
    assert np.mean(nees) == pytest.approx(6.0, rel=0.25)


def test_images_that_err_alike_are_not_counted_as_many():
    """The background stands still: each image has the same error."""
    rng = np.random.default_rng(4)
    knowledge = JawKnowledge(SIGMA_M, OFFSET_SIGMA_M)
    _, opening_m, covariance = estimate(rng, 0.034, 0.0341)
    for _ in range(60):
        out = knowledge.fuse(0.0341, opening_m, covariance)
    assert out.sigma_m > 0.5 * IMAGE_SIGMA_M


def test_a_jaw_that_moves_without_a_report_is_noticed_and_what_was_learnt_is_dropped():
    rng = np.random.default_rng(5)
    knowledge = JawKnowledge(SIGMA_M, OFFSET_SIGMA_M)
    _, out, errors_m = run(knowledge, rng, [0.034] * 40 + [0.0344] * 5, [0.034] * 45)
    assert max(abs(f.innovation) for f in out[:40]) < UNREPORTED_MOTION_SIGMAS < abs(out[40].innovation)
    assert np.abs(errors_m[40:]).max() < 5.0 * IMAGE_SIGMA_M


def test_what_an_object_between_the_fingers_looks_like_is_not_learnt():
    """It is held for 30 frames, and its border looks like another opening; then the fingers open again."""
    rng, knowledge = np.random.default_rng(6), JawKnowledge(SIGMA_M, OFFSET_SIGMA_M)
    run(knowledge, rng, [0.034] * 40, [0.0341] * 40)
    _, held, _ = run(knowledge, rng, [0.0346] * 30, [0.0341] * 30)
    assert min(f.known_sigma_m for f in held) == pytest.approx(knowledge.report_sigma_m), "and nothing is known of it"
    _, out, errors_m = run(knowledge, rng, [0.034] * 10, [0.0341] * 10)
    assert max(f.known_sigma_m for f in out) < IMAGE_SIGMA_M and np.abs(errors_m).max() < IMAGE_SIGMA_M


def test_what_goes_on_contradicting_where_the_jaw_is_elsewhere_replaces_what_was_learnt():
    """The encoder was set to zero elsewhere: the offset is another one from then on."""
    rng, knowledge = np.random.default_rng(7), JawKnowledge(SIGMA_M, OFFSET_SIGMA_M)
    run(knowledge, rng, [0.034] * 40, [0.0341] * 40)
    run(knowledge, rng, [0.034] * 10, [0.0346] * 10)
    _, out, _ = run(knowledge, rng, [0.030] * 40, [0.0306] * 40)
    assert out[-1].known_sigma_m < IMAGE_SIGMA_M and out[-1].known_m == pytest.approx(0.030, abs=2.0 * IMAGE_SIGMA_M)


def test_an_exact_report_leaves_everything_as_it_is():
    covariance = np.diag([1e-12] * 7)
    out = JawKnowledge(0.0, OFFSET_SIGMA_M).fuse(0.034, 0.0340001, covariance)
    assert out.jaw_opening_m == 0.0340001 and not out.xi.any() and out.innovation == 0.0
    np.testing.assert_array_equal(out.covariance, covariance[:6, :6])
    assert JawKnowledge(0.0, OFFSET_SIGMA_M).report_sigma_m == 0.0
    assert SYSTEMATIC_M > 0.0


def test_only_the_estimate_that_is_believed_is_learnt():
    """Of two places at which a frame was measured, the other one was looked at last."""
    rng, both = np.random.default_rng(4), [JawKnowledge(SIGMA_M, OFFSET_SIGMA_M) for _ in range(2)]
    for number in range(30):
        _, opening_m, covariance = estimate(rng, 0.034, 0.0341)
        believed = [knowledge.fuse(0.0341, opening_m, covariance) for knowledge in both]
        if number == 29:
            assert abs(both[0].fuse(0.0341, opening_m + 5e-4, covariance).innovation) > 5.0
        for knowledge, fused in zip(both, believed, strict=True):
            assert fused.seen is not None
            knowledge.learn(fused.seen)
    _, opening_m, covariance = estimate(rng, 0.034, 0.0341)
    one, other = (knowledge.fuse(0.0341, opening_m, covariance) for knowledge in both)
    assert one.jaw_opening_m == other.jaw_opening_m and one.sigma_m == other.sigma_m
