"""The anchor: the average of proven poses under each thing that may have been wrong all along, against known truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.records import Since
from gripmon.monitor.anchor import CONFIRMING_FRAMES, NO_FIT, Anchor, Lasting, average_of
from gripmon.monitor.bounds import SIGMA_INFLATION
from gripmon.monitor.since import AtReference, Opened
from gripmon.track.integrity import bounds, hypotheses_of
from gripmon.track.integrity.frame_kernel import absolute_level
from gripmon.track.integrity.kernel import telling, with_known
from gripmon.track.integrity.separation import limits_of

NAMES = ("a_out", "a_in", "a_tip", "a_side", "b_out", "b_in", "b_tip", "b_side")
SAID = tuple(f"edge {name}" for name in NAMES)
FINGERS = ("finger a", "finger b")
FINGER = np.array([0, 0, 0, 0, 1, 1, 1, 1])
ALONG = np.array([True, True, False, False, True, True, False, False])
INNER = np.array(["_in" in name for name in NAMES])
EVERY = hypotheses_of(SAID, FINGER, FINGERS, ALONG, INNER, True)
LASTING = Lasting.of(EVERY)
ROWS = np.arange(len(LASTING.name))
BASE_T = perturb(np.eye(4), np.array([0.01, -0.02, 0.2, 0.1, 0.2, -0.1]))
STILL = np.zeros(6)
SIGMA = np.array([2e-5, 3e-5, 2e-4, 2e-3, 1e-3, 5e-4])
RNG_SEED = 3
NOWHERE = BASE_T, np.diag(np.square(1e5 * SIGMA))
"""Nothing was known of the pose before the frames."""
SURE = 0.0
"""Probability that what looks like the fingers' ends is something else."""


@dataclass
class Frame:
    """A frame's fits: ``away`` (g, 6) from :data:`BASE_T` and ``covariance`` (g, 6, 6); the first is published.

    ``longer``: by how many standard deviations of its own it is off where a finger is longer than the model says.
    """

    away: np.ndarray
    covariance: np.ndarray
    longer: float = 0.0

    @property
    def cam_T_grip(self) -> np.ndarray:
        return perturb(BASE_T, self.away[0])

    def shifts(self, base_T: np.ndarray) -> np.ndarray:
        return self.away + perturbation_between(base_T, BASE_T)

    @property
    def of_model(self) -> np.ndarray:
        return np.full((len(self.covariance), 2, 6), self.longer) * SIGMA


def shape_of(seed: int = 1) -> np.ndarray:
    """(g, 6, 6) covariances of all fits: those without some edges are larger, and their errors belong together."""
    rng = np.random.default_rng(seed)
    mix = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    whole = SIGMA[:, None] * (mix @ mix.T) * SIGMA
    return whole * np.linspace(1.0, 4.0, len(ROWS))[:, None, None]


def stream(
    rng: np.random.Generator, frames: int, common: float, truth: np.ndarray | None = None, bias: float = 0.0
) -> list[Frame]:
    """Frames whose errors have the share ``common`` of their variance in common; ``truth`` (n, 6) the way from
    :data:`BASE_T`; all fits but that without edge a_out are off by ``bias`` of their standard deviations.
    """
    covariance = shape_of()
    root = np.linalg.cholesky(covariance)
    shared = rng.normal(size=6)
    out = []
    for number in range(frames):
        own = rng.normal(size=6)
        error = root @ (np.sqrt(common) * shared + np.sqrt(1.0 - common) * own)
        error[np.arange(len(ROWS)) != 1] += bias * np.sqrt(covariance[0].diagonal())
        out.append(Frame(error + (0.0 if truth is None else truth[number]), covariance))
    return out


def averaged(frames: list[Frame], creep: np.ndarray = STILL) -> Anchor:
    anchor = Anchor(LASTING, BASE_T, frames[0], ROWS, 0.0, NOWHERE, SURE)
    for number, frame in enumerate(frames[1:]):
        anchor.add(frame, ROWS, creep, 0.1 * (number + 1), SURE)
    return anchor


def level_m(anchor: Anchor, frame: Frame, risk: float = 1e-5, wander: np.ndarray = STILL) -> float:
    average, from_T, origin_T, origin = anchor.known
    at, way = perturbation_between(from_T, frame.cam_T_grip), wander / SIGMA_INFLATION**2
    own = frame.shifts(frame.cam_T_grip), frame.covariance, frame.of_model
    told = telling(*average, at, way, *own, ROWS, CONTRADICTION_SQUARE)
    known = with_known(*told, perturbation_between(frame.cam_T_grip, origin_T), origin + np.diag(way))
    cases, exact = (*known, LASTING.priors(SURE), ROWS, ROWS), (np.zeros((0, 6)), np.zeros(2))
    return absolute_level(cases, len(ROWS), *exact, limits_of(risk, SIGMA_INFLATION))[0]


def error_m(frame: Frame, truth: np.ndarray = STILL) -> float:
    return float(np.linalg.norm(perturbation_between(perturb(BASE_T, truth), frame.cam_T_grip)[:3]))


def test_what_lasts_is_all_that_may_have_been_wrong_from_the_first_frame_on():
    lasting = [name for name, sudden in zip(EVERY.name, EVERY.sudden, strict=True) if not sudden]
    assert list(LASTING.name) == [*lasting, EVERY.name[EVERY.ends]]
    assert not any("not where its model says" in name for name in LASTING.name)
    assert LASTING.name[0] == "nothing is wrong"


def test_with_hidden_edges_hypotheses_doubt_the_same_of_what_is_left():
    edges = np.array([0, 1, 3, 4, 5])  # a_tip, b_tip and b_side are hidden
    seen = hypotheses_of(tuple(SAID[e] for e in edges), FINGER[edges], FINGERS, ALONG[edges], INNER[edges], True)
    rows = LASTING.rows(seen, edges)
    told = {name: seen.name[row] for name, row in zip(LASTING.name, rows, strict=True)}
    assert told["edge a_out belongs to something else"] == "edge a_out belongs to something else"
    assert told["edge b_tip belongs to something else"] == "nothing is wrong"
    assert told["the ends of finger a belong to something else"] == "edge a_side belongs to something else"
    assert told["the ends of finger b belong to something else"] == "nothing is wrong"
    assert told["the jaw opening is wrong"] == "the jaw opening is wrong"


def test_a_place_after_a_knock_is_confirmed_by_some_more_frames():
    frames = stream(np.random.default_rng(RNG_SEED), 10, common=0.0)
    assert Anchor(LASTING, BASE_T, frames[0], ROWS, 0.0, NOWHERE, SURE).confirmed
    anchor = Anchor(LASTING, BASE_T, frames[0], ROWS, 0.0, NOWHERE, SURE, knocked=True)
    for number, frame in enumerate(frames[1 : 1 + CONFIRMING_FRAMES]):
        assert not anchor.confirmed
        anchor.add(frame, ROWS, STILL, 0.1 * number, SURE)
    assert anchor.confirmed


def test_independent_errors_average_out_as_far_as_is_known_of_slow_ones():
    frames = stream(np.random.default_rng(RNG_SEED), 60, common=0.0)
    anchor, one = averaged(frames), averaged(frames[:1])
    ratio = np.sqrt(anchor.covariance.diagonal() / one.covariance.diagonal())
    assert (ratio > 0.5).all() and (ratio < 0.85).all()
    off = np.abs(perturbation_between(BASE_T, anchor.cam_T_grip)) / SIGMA
    assert off.max() < 0.6, "the pose itself is the mean of 60"


def test_errors_that_stand_still_stay_in_the_covariance():
    """As before a background that doesn't move: averaging gains nothing, and it must not say so."""
    frames = stream(np.random.default_rng(RNG_SEED), 60, common=1.0)
    anchor, one = averaged(frames), averaged(frames[:1])
    np.testing.assert_allclose(anchor.covariance.diagonal(), one.covariance.diagonal(), rtol=0.02)


@pytest.mark.parametrize("common", [0.0, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("bias", [0.0, 3.0])
def test_the_error_of_a_frame_is_beyond_its_level_no_more_often_than_stated(common: float, bias: float):
    """With a persistent bias in all fits but one, too: weighed with how probable that is."""
    trials, beyond, risk = 150, 0, 3e-4
    for seed in range(trials):
        frames = stream(np.random.default_rng(seed), 30, common, bias=bias)
        beyond += error_m(frames[-1]) > level_m(averaged(frames[:-1]), frames[-1], risk)
    allowed = risk / LASTING.prior[1] if bias else risk
    assert beyond / trials <= allowed + 3.0 * np.sqrt(allowed / trials)


def test_an_average_over_time_bounds_more_tightly_than_a_frame():
    ratio = []
    for seed in range(20):
        frames = stream(np.random.default_rng(seed), 60, common=0.2)
        ratio.append(level_m(averaged(frames[:-1]), frames[-1]) / level_m(averaged(frames[-1:]), frames[-1]))
    assert np.median(ratio) < 0.9


def test_a_frame_that_leaves_a_direction_open_neither_adds_nor_takes():
    frames = stream(np.random.default_rng(RNG_SEED), 40, common=0.2)
    anchor = averaged(frames)
    before = anchor.covariance.copy()
    wide = frames[-1].covariance + np.outer(np.ones(6), np.ones(6)) * SIGMA[2] ** 2 * 1e8
    for number in range(20):
        anchor.add(Frame(frames[-1].away + 1e4 * SIGMA[2], wide), ROWS, STILL, 4.0 + 0.1 * number, SURE)
    # What was known is worth less with time, but no longer than a frame's own.
    ratio = anchor.covariance.diagonal() / averaged(frames[-1:]).covariance.diagonal()
    assert (ratio < 1.6).all() and (anchor.covariance.diagonal() > 0.3 * before.diagonal()).all()


def test_the_average_follows_a_creep_that_is_allowed_for():
    rate = 0.3 * SIGMA  # between two frames
    truth = np.arange(200)[:, None] * rate
    frames = stream(np.random.default_rng(RNG_SEED), 200, common=0.0, truth=truth)
    anchor = averaged(frames, creep=rate**2)
    off = perturbation_between(perturb(BASE_T, truth[-1]), anchor.cam_T_grip)
    assert (np.abs(off) < 3.0 * np.sqrt(anchor.covariance.diagonal() + rate**2)).all()


def test_a_creep_that_is_not_allowed_for_does_not_make_levels_lie():
    """The frame tells then, or the scatter about an average that lags."""
    rate = 0.1 * SIGMA
    truth = np.arange(120)[:, None] * rate
    for seed in range(20):
        frames = stream(np.random.default_rng(seed), 120, common=0.0, truth=truth)
        anchor = Anchor(LASTING, BASE_T, frames[0], ROWS, 0.0, NOWHERE, SURE)
        for number, frame in enumerate(frames[1:]):
            assert error_m(frame, truth[number + 1]) <= level_m(anchor, frame)
            anchor.add(frame, ROWS, STILL, 0.1 * number, SURE)


def test_after_frames_that_disagree_the_bound_is_wider():
    frames = stream(np.random.default_rng(RNG_SEED), 40, common=0.0)
    anchor = averaged(frames)
    before = level_m(anchor, frames[-1])
    for number in range(15):
        bent = Frame(frames[number].away + 6.0 * SIGMA, frames[number].covariance)
        anchor.add(bent, ROWS, STILL, 4.0 + 0.1 * number, SURE)
    assert level_m(anchor, frames[-1]) > 1.2 * before


def test_what_may_have_happened_since_adds_to_the_bound():
    frames = stream(np.random.default_rng(RNG_SEED), 30, common=0.0)
    anchor = averaged(frames[:-1])
    levels = [level_m(anchor, frames[-1], wander=np.square(scale * SIGMA)) for scale in (0.0, 0.3, 1.0)]
    assert levels[0] < levels[1] and levels[1] <= levels[2]


def test_after_a_long_time_without_proof_the_average_is_the_newest_frame():
    """What may have crept meanwhile leaves nothing of what was known before."""
    frames = stream(np.random.default_rng(RNG_SEED), 40, common=0.0)
    moved = Frame(frames[-1].away + 30.0 * SIGMA, frames[-1].covariance)
    anchor = averaged(frames[:-1])
    anchor.add(moved, ROWS, np.square(100.0 * SIGMA), 60.0, SURE)
    off = np.abs(perturbation_between(anchor.cam_T_grip, moved.cam_T_grip))
    assert (off < SIGMA).all()


def test_an_average_that_differs_beyond_chance_bounds_nothing():
    """Under a hypothesis that tells them apart the frame is left, not the way between them."""
    frames = stream(np.random.default_rng(RNG_SEED), 40, common=0.0)
    anchor = averaged(frames[:-1])
    beside = Frame(frames[-1].away + 200.0 * SIGMA, frames[-1].covariance)
    by_frame = averaged([beside])
    assert level_m(anchor, beside) == pytest.approx(level_m(by_frame, beside), rel=0.05)
    assert level_m(anchor, beside) < 30.0 * np.linalg.norm(SIGMA[:3])


def test_what_the_model_is_wrong_by_does_not_average_out():
    frames = [Frame(f.away, f.covariance, longer=5.0) for f in stream(np.random.default_rng(RNG_SEED), 40, common=0.0)]
    right = [Frame(f.away, f.covariance) for f in frames]
    anchor = averaged(frames[:-1])
    np.testing.assert_allclose(anchor.of_model, frames[0].of_model[0])
    # Two fingers, each by itself: 5 standard deviations and more, of which none is known to be absent.
    assert level_m(anchor, frames[-1]) > 3.0 * level_m(averaged(right[:-1]), right[-1])
    # A model that proves right only now is believed as far as the newest frames count.
    newer = averaged(frames[:1])
    for number, frame in enumerate(right):
        newer.add(frame, ROWS, STILL, 0.1 * number, SURE)
    assert np.abs(newer.of_model).max() < 0.1 * np.abs(frames[0].of_model).max()


def test_an_image_without_a_fit_counts_nothing_in_the_average_of_images():
    """Also where the others leave a direction open: it had cost the digits of what they see."""
    frames, play = stream(np.random.default_rng(3), 3, 0.0), 0.3 * SIGMA
    without = ROWS.copy()
    without[-1] = NO_FIT
    average = average_of(BASE_T, [(frames[0], without), *((frame, ROWS) for frame in frames[1:])], play)
    of_others = average_of(BASE_T, [(frame, ROWS) for frame in frames[1:]], play)
    np.testing.assert_allclose(average.shift[-1], of_others.shift[-1], rtol=1e-9)
    np.testing.assert_allclose(average.covariance[-1], of_others.covariance[-1], rtol=1e-9)
    assert np.linalg.eigvalsh(average.covariance).min() > 0.0


@pytest.mark.parametrize("frames", [1, 2, 3, 12])
@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("times", [0.3, 3.0])
def test_an_average_of_images_claims_no_more_than_they_show(frames: int, common: float, times: float):
    """Of a mount with play, before backgrounds that differ, or one that stands still; its place is that in the images,
    or that about which they scatter.
    """
    rng, play, ratios, places = np.random.default_rng(frames), times * SIGMA, [], []
    for _ in range(300):
        truth = rng.normal(size=(frames, 6)) * play
        seen = stream(rng, frames, common, truth)
        average = average_of(BASE_T, [(frame, ROWS) for frame in seen], play)
        for found, true in ((ratios, truth.mean(axis=0)), (places, np.zeros(6))):
            error = average.shift[0] - true
            found.append(error @ np.linalg.solve(average.covariance[0], error) / 6.0)
    assert np.mean(ratios) < 1.1 and np.mean(places) < 1.2
    claimed = (average.covariance[0].diagonal() - np.square(play) / frames) / seen[0].covariance[0].diagonal()
    if common == 1.0:  # all of them have one error
        assert np.mean(claimed) > 0.85
    elif common == 0.0 and frames == 12 and times < 1.0:
        assert np.mean(claimed) < 0.85


def test_play_of_the_mount_is_in_what_a_motion_counts_from_once():
    """The scatter of averages over 1,500 teachings, each of images at places of its own, beside what they claim."""
    rng, play, frames = np.random.default_rng(5), 20.0 * SIGMA, 6
    seen = [stream(rng, frames, 0.0, rng.normal(size=(frames, 6)) * play) for _ in range(1500)]
    averages = [average_of(BASE_T, [(frame, ROWS) for frame in each], play) for each in seen]
    at = AtReference(BASE_T, averages[0], 0.03, frames, Since.REFERENCE, 0, SURE, True, of_images=True)
    counts = at.differences(BASE_T, BASE_T, Opened(0.03, np.zeros(6)), None, np.square(play))
    claimed = counts[0][1][0].diagonal()
    np.testing.assert_allclose(claimed, np.square([each.shift[0] for each in averages]).mean(axis=0), rtol=0.2)


@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
def test_where_a_mount_stood_that_crept_in_its_frames_is_in_what_a_motion_counts_from(common: float):
    """At any of 30 frames, within what bounds normal errors of that covariance at the usual risk: a mount that crept
    all the time, in the first half, or in the second.
    """
    rng, sigma = np.random.default_rng(17), np.sqrt(shape_of()[0].diagonal())
    for law in (np.linspace(0.0, 1.0, 30), np.linspace(0.0, 2.0, 30).clip(max=1.0), np.linspace(-1.0, 1.0, 30)):
        for way in (0.0, 0.5, 2.0, 8.0, 32.0) * 10:
            truth = way * law.clip(min=0.0)[:, None] * sigma * rng.normal(size=6) / np.sqrt(6.0)
            anchor = averaged(stream(rng, 30, common, truth))
            off_m = perturbation_between(BASE_T, anchor.cam_T_grip)[:3] - truth[:, :3]
            known_m = SIGMA_INFLATION * bounds(anchor.fits().covariance[:1, :3, :3], np.array([1e-5]))
            assert (np.linalg.norm(off_m, axis=1) < known_m).all()


def test_frames_of_a_mount_that_stood_still_do_not_show_a_creep():
    rng, more = np.random.default_rng(18), []
    for _ in range(40):
        anchor = averaged(stream(rng, 30, 0.5))
        one_m2 = np.trace(shape_of()[0, :3, :3])
        more.append(np.trace(anchor.fits().covariance[0, :3, :3] - anchor._claimed[0, :3, :3]) / one_m2)
    assert np.mean(more) < 0.02
