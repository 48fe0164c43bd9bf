"""Retroactive correction against simulated truth: steps to the frame, false ones counted, gross errors, gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from gripmon.analyse.correction import SOURCES, correct, sample

PERIOD_NS = 16_666_667
START_NS = 1_700_000_000_000_000_000
SIGMA = np.array([4e-6, 5e-6, 2e-5, 5e-4, 2.5e-4, 2e-4])
TRUE = np.eye(4)
TRUE[:3, :3] = Rotation.from_rotvec([0.4, -2.0, 0.9]).as_matrix()
TRUE[:3, 3] = [0.001, -0.002, 0.115]
STEP = np.array([2e-5, 8e-5, 0.0, -1e-3, 0.0, 3e-4])


def reported() -> np.ndarray:
    """A covariance (6, 6) with correlations."""
    mixing = np.random.default_rng(2).normal(size=(6, 12))
    correlation = mixing @ mixing.T
    scale = np.sqrt(np.diag(correlation))
    return correlation / np.outer(scale, scale) * np.outer(SIGMA, SIGMA)


def moved(poses: np.ndarray, xi: np.ndarray) -> np.ndarray:
    out = poses.copy()
    out[:, :3, :3] = Rotation.from_rotvec(xi[:, 3:]).as_matrix() @ poses[:, :3, :3]
    out[:, :3, 3] += xi[:, :3]
    return out


def difference(true: np.ndarray, poses: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(true[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([true[:, :3, 3] - poses[:, :3, 3], turn], axis=1)


class Stream:
    """Frames whose errors are half new and half the background's, which another one follows after 20 s on average."""

    def __init__(self, frames: int, seed: int, way: np.ndarray | None = None, lasting: float = 0.5):
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(reported())
        background = np.cumsum(rng.random(frames) < 1.0 / 1200.0)
        levels = rng.normal(size=(background[-1] + 1, 6))
        # A background passes to the next one in 0.8 s.
        passing = np.apply_along_axis(
            np.convolve, 0, np.pad(levels[background], ((48, 0), (0, 0)), "edge"), np.ones(49) / 49, "valid"
        )
        white = rng.normal(size=(frames, 6))
        self.error = (np.sqrt(1.0 - lasting) * white + np.sqrt(lasting) * passing) @ root.T
        self.stamp_ns = START_NS + PERIOD_NS * np.arange(frames)
        self.true = moved(np.repeat(TRUE[None], frames, axis=0), np.zeros((frames, 6)) if way is None else way)
        self.seen = moved(self.true, self.error)
        self.covariance = np.repeat(reported()[None], frames, axis=0)
        self.measured = np.ones(frames, bool)

    def correct(self):
        return correct(self.stamp_ns, self.seen, self.covariance, self.measured)


def step_at(frames: int, index: int, size: np.ndarray = STEP) -> np.ndarray:
    return (np.arange(frames) >= index)[:, None] * size


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(2))
def test_a_step_is_placed_in_its_frame_and_stays_one(seed: int):
    stream = Stream(1800, seed, step_at(1800, 907, 3.0 * STEP))
    correction = stream.correct()
    (point,) = correction.change_points
    assert abs(point.index - 907) <= 1
    assert point.earliest_ns < stream.stamp_ns[907] <= point.latest_ns
    deviation = np.abs(point.size - 3.0 * STEP) / np.sqrt(np.diag(point.size_covariance))
    assert deviation.max() < 4.0
    # Not smeared: the whole step between two neighbours.
    jump = difference(
        correction.cam_T_grip[point.index : point.index + 1], correction.cam_T_grip[point.index - 1 :][:1]
    )
    np.testing.assert_allclose(jump[0], point.size, atol=0.2 * np.abs(point.size).max())
    # There may be one background only, whose error stays: what is new in each frame goes.
    assert rms(difference(stream.true, correction.cam_T_grip)[:, :3]) < rms(stream.error[:, :3])


def test_places_lie_within_what_is_stated():
    """A step near the noise: 95 of 100 intervals hold it; as few as chance leaves in 10 000 trials will do."""
    held = found = 0
    for seed in range(16):
        stream = Stream(600, 100 + seed, step_at(600, 300, STEP))
        for point in stream.correct().change_points:
            if abs(point.index - 300) < 20:
                found += 1
                held += point.earliest_ns < stream.stamp_ns[300] <= point.latest_ns
    assert found >= 13
    assert stats.binom.cdf(held, found, 0.95) > 1e-4, f"{held} of {found}"


def test_quiet_streams_show_no_changes():
    """0.02 an hour is promised for each place and length; a quarter of an hour, backgrounds changing 40 times."""
    hours, false = 0.0, 0
    for seed in range(14):
        stream = Stream(3600, 200 + seed)
        false += len(stream.correct().change_points)
        hours += 3600 * PERIOD_NS / 3.6e12
    # As many as this would come once in a thousand times at one in an hour.
    assert false <= stats.poisson.ppf(0.999, 1.0 * hours), false


def test_stated_covariances_are_honest():
    squares, sizes, raw = [], [], []
    for seed in range(12):
        stream = Stream(3600, 300 + seed)
        correction = stream.correct()
        error = difference(stream.true, correction.cam_T_grip)[::300]
        squares.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance[::300]), error))
        sizes.append(rms(error[:, :3]))
        raw.append(rms(stream.error[:, :3]))
    inside = np.mean(np.concatenate(squares) < stats.chi2.ppf(0.95, 6))
    # Twelve streams, each with few backgrounds: 95 % of one stream's errors are nearly one number.
    assert inside > 0.8
    # Nor is it merely large: errors fill at least a fourth of what is stated.
    assert np.mean(np.concatenate(squares)) > 1.5
    assert np.mean(sizes) < 0.6 * np.mean(raw)


def test_a_step_that_may_be_another_background_is_in_the_covariance():
    """Six reported deviations: far beyond what frames scatter, within what two backgrounds differ by (9.3)."""
    size = STEP * 6.0 / np.sqrt(STEP @ np.linalg.solve(reported(), STEP))
    for seed in (5, 14):
        stream = Stream(1800, seed, step_at(1800, 900, size), lasting=0.6)
        correction = stream.correct()
        assert not correction.change_points and correction.undecided_ns == (stream.stamp_ns[900],)
        assert correction.missable_m == pytest.approx(9.3 * SIGMA[2], rel=0.03), "along the axis that is known least"
        error = difference(stream.true, correction.cam_T_grip)
        squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance), error)
        assert squares.mean() < 6.0, "7 and 9 by a covariance for which the pose stood still"
        assert squares.mean() > 1.5, "nor is it merely large"


def test_gross_errors_are_disbelieved_and_named():
    stream = Stream(1800, 5)
    wrong = np.array([300, 301, 700, 1200, 1500])
    stream.seen[wrong] = moved(stream.seen[wrong], np.array([1e-3, 0.0, 2e-3, 0.0, 0.05, 0.0]) * np.ones((5, 1)))
    correction = stream.correct()
    assert {SOURCES[code] for code in correction.source[wrong]} == {"disbelieved"}
    assert not correction.change_points
    clean = Stream(1800, 5).correct()
    assert (np.abs(correction.cam_T_grip - clean.cam_T_grip)[:, :3, 3].max(axis=0) < 0.5 * SIGMA[:3]).all()


def test_a_burst_of_wrong_frames_is_no_motion_that_stays():
    """The most plausible wrong answer: eight frames in a row, all wrong alike, as when a cable crosses an edge."""
    stream = Stream(1800, 12)
    wrong = slice(900, 908)
    stream.seen[wrong] = moved(stream.seen[wrong], np.tile([0.0, 4e-4, 0.0, 0.0, 0.0, 0.0], (8, 1)))
    correction, clean = stream.correct(), Stream(1800, 12).correct()
    assert not correction.change_points
    assert {SOURCES[code] for code in correction.source[wrong]} == {"followed"}, "camera or not, it is told apart"
    beside = np.r_[0:880, 930:1800]
    away = np.abs(correction.cam_T_grip - clean.cam_T_grip)[beside, :3, 3]
    assert (away.max(axis=0) < 0.1 * SIGMA[:3]).all()


@pytest.mark.parametrize("period_s", [3.0, 8.0])
def test_a_wobble_in_step_with_the_jaw_is_no_change(period_s: float):
    """An error of the gripper's model that comes and goes with its opening: three standard deviations, in 0.4 s."""
    frames = 3600
    opening = np.clip(6.0 * np.sin(2.0 * np.pi * np.arange(frames) / 60.0 / period_s), -1.0, 1.0)
    stream = Stream(frames, 13)
    stream.seen = moved(stream.seen, opening[:, None] * np.array([0.0, 1.5 * SIGMA[1], 0.0, 0.0, 0.0, 0.0]))
    correction = stream.correct()
    assert not correction.change_points
    error = difference(stream.true, correction.cam_T_grip)
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance), error)
    assert (squares < stats.chi2.ppf(0.999, 6)).mean() > 0.95


def test_a_change_in_a_gap_may_have_happened_at_any_moment_of_it():
    stream = Stream(1500, 6, step_at(1500, 700, 10.0 * STEP))
    stream.measured[600:800] = False
    stream.seen[600:800] = np.nan
    correction = stream.correct()
    (point,) = correction.change_points
    assert point.index == 800
    assert (point.earliest_ns, point.latest_ns) == (stream.stamp_ns[599], stream.stamp_ns[800])
    assert {SOURCES[code] for code in correction.source[600:800]} == {"gap"}
    sigma = np.sqrt(correction.covariance[:, 1, 1])
    # A uniform moment: half of the step in the middle, with a standard deviation of half of it.
    assert sigma[700] == pytest.approx(0.5 * abs(point.size[1]), rel=0.1)
    assert sigma[700] > 20.0 * sigma[400]
    error = difference(stream.true, correction.cam_T_grip)[600:800]
    inside = np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance[600:800]), error)
    assert (inside < stats.chi2.ppf(0.999, 6)).mean() > 0.9


def test_vibration_is_not_smoothed_away():
    frames = 3600
    hum = np.sin(2.0 * np.pi * 14.0 * np.arange(frames) / 60.0)[:, None] * 2.0 * STEP
    stream = Stream(frames, 7, hum)
    error = difference(stream.true, stream.correct().cam_T_grip)
    assert rms(error[:, 1:2]) < 0.25 * rms(hum[:, 1:2])


def test_creep_is_followed_and_is_no_step():
    frames = 5400
    way = np.linspace(0.0, 1.0, frames)[:, None] * 20.0 * STEP
    stream = Stream(frames, 8, way)
    correction = stream.correct()
    assert not correction.change_points
    assert rms(difference(stream.true, correction.cam_T_grip)[:, :3]) < 0.9 * rms(stream.error[:, :3])


def test_time_that_runs_backwards_is_said_and_survived():
    stream = Stream(900, 9)
    stream.stamp_ns[450:] -= 3_600_000_000_000
    correction = stream.correct()
    assert any("backwards" in fault for fault in correction.faults)
    assert rms(difference(stream.true, correction.cam_T_grip)[:, :3]) < rms(stream.error[:, :3])
    with pytest.raises(ValueError, match="backwards"):
        sample(correction, stream.stamp_ns[:1])


def test_too_few_frames_are_refused():
    stream = Stream(50, 10)
    stream.measured[2:] = False
    with pytest.raises(ValueError, match="only 2 frames"):
        stream.correct()


@pytest.mark.parametrize("frames", [3, 10, 40])
def test_short_recordings_give_finite_transforms_no_worse_than_the_frames(frames: int):
    streams = [Stream(frames, 20 + seed) for seed in range(8)]
    corrections = [stream.correct() for stream in streams]
    for correction in corrections:
        assert np.isfinite(correction.cam_T_grip).all()
        assert (np.linalg.eigvalsh(correction.covariance / np.outer(SIGMA, SIGMA)) > 0.0).all()
    errors = [rms(difference(s.true, c.cam_T_grip)[:, :3]) for s, c in zip(streams, corrections, strict=True)]
    assert np.mean(errors) <= np.mean([rms(s.error[:, :3]) for s in streams])


@pytest.mark.parametrize("frames", [4, 8, 31])
def test_a_step_among_few_frames_is_not_smoothed_over(frames: int):
    """Nothing looked for it: what was on either side was mixed, far beyond the covariance."""
    stream = Stream(frames, 30, step_at(frames, frames // 2, 40.0 * STEP))
    correction = stream.correct()
    assert [point.index for point in correction.change_points] == [frames // 2]
    error = difference(stream.true, correction.cam_T_grip)
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance), error)
    assert (square < stats.chi2.isf(1e-4, 6)).all()


def test_a_smaller_step_among_few_frames_is_in_the_covariance():
    stream = Stream(8, 31, step_at(8, 4, 0.3 * STEP))
    correction = stream.correct()
    assert not correction.change_points and stream.stamp_ns[4] in correction.undecided_ns
    error = difference(stream.true, correction.cam_T_grip)
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(correction.covariance), error)
    assert (square < stats.chi2.isf(1e-4, 6)).all()


def test_instants_between_frames_lie_between_and_say_so():
    stream = Stream(600, 11, step_at(600, 300, 20.0 * STEP))
    correction = stream.correct()
    wanted = np.array(
        [stream.stamp_ns[100], stream.stamp_ns[100] + PERIOD_NS // 2, stream.stamp_ns[299] + PERIOD_NS // 2]
    )
    poses, covariances, segments = sample(correction, np.append(wanted, stream.stamp_ns[0] - 1))
    np.testing.assert_allclose(poses[0], correction.cam_T_grip[100], atol=1e-12)
    middle = 0.5 * (correction.cam_T_grip[100, :3, 3] + correction.cam_T_grip[101, :3, 3])
    np.testing.assert_allclose(poses[1, :3, 3], middle, atol=1e-12)
    # In the frame of the step it may be on either side.
    assert np.sqrt(covariances[2, 1, 1]) == pytest.approx(0.5 * 20.0 * STEP[1], rel=0.1)
    assert np.isnan(poses[3]).all() and segments[3] == -1


def odd_runs() -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Stamps, transforms and covariances that no estimator was made for, though recordings hold them."""
    count, rng = 300, np.random.default_rng(4)
    stamp_ns = START_NS + np.arange(count) * PERIOD_NS
    still = np.tile(np.eye(4), (count, 1, 1))
    still[:, 2, 3] = 0.11
    shaking = still.copy()
    shaking[:, :3, 3] += 1e-5 * rng.normal(size=(count, 3))
    moved = still.copy()
    moved[150:, 0, 3] += 1e-3
    frozen = shaking.copy()
    frozen[100:150] = frozen[100]
    usual = np.tile(np.diag([1e-10] * 3 + [1e-8] * 3), (count, 1, 1))
    some_singular = usual.copy()
    some_singular[100:103] = 1e-10
    return {
        "repeated to the bit": (stamp_ns, still, usual),
        "a step, without noise": (stamp_ns, moved, usual),
        "repeated for a while": (stamp_ns, frozen, usual),
        "no turn at all": (stamp_ns, shaking, usual),
        "all at one time": (np.full(count, START_NS), shaking, usual),
        "two frames a stamp": (START_NS + np.arange(count) // 2 * PERIOD_NS, shaking, usual),
        "time backwards": (stamp_ns[::-1].copy(), shaking, usual),
        "years between": (stamp_ns + np.where(np.arange(count) < 150, 0, 10**18), shaking, usual),
        "singular covariances": (stamp_ns, shaking, some_singular),
        "large covariances": (stamp_ns, shaking, 1e12 * usual),
    }


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", odd_runs())
def test_odd_recordings_are_corrected_without_a_fault(name: str):
    stamp_ns, poses, covariance = odd_runs()[name]
    made = correct(stamp_ns, poses, covariance, np.ones(len(poses), bool))
    assert np.abs(made.cam_T_grip[:, :3, 3] - poses[:, :3, 3]).max() < 6e-5, "no farther away than frames scatter"
    assert (np.linalg.eigvalsh(made.covariance)[:, 0] > 0.0).all()
    assert [point.index for point in made.change_points] == [150] * (name == "a step, without noise")
    said = {"time backwards": "backwards", "years between": "gaps", "singular covariances": "3 frames aren't positive"}
    assert bool(made.faults) == (name in said) and all(said[name] in fault for fault in made.faults)


def test_covariances_that_are_none_are_said():
    stamp_ns, poses, covariance = odd_runs()["no turn at all"]
    for wrong in (np.full_like(covariance, 1e-10), covariance * 1e-300, covariance - 3e-10 * np.eye(6)):
        with pytest.raises(ValueError, match="aren't positive definite"):
            correct(stamp_ns, poses, wrong, np.ones(len(poses), bool))
