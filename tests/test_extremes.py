"""Limits learnt from extremes, against the distributions that the statistics were drawn from."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from gripmon.judge.drift.statistics import BLOCK_FRAMES, FEWEST_BLOCKS, KEPT_BLOCKS, Extremes

ALIKE_ONE = np.ones((1, 1))
CHANCE = 1e-4


def shown(squares: np.ndarray, alike: np.ndarray = ALIKE_ONE) -> Extremes:
    """Block maxima (n, streams) as one kind of statistic, a block at a time."""
    extremes = Extremes(alike, squares.shape[1])
    for each in squares:
        extremes.add(each[None], np.ones((1, squares.shape[1]), dtype=bool), BLOCK_FRAMES)
    return extremes


def largest(quantile: stats.rv_continuous, rng: np.random.Generator, blocks: int, streams: int) -> np.ndarray:
    """Largest of the independent frames of each block (n, streams), by the inverse of its distribution."""
    return np.asarray(quantile.ppf(rng.random((blocks, streams)) ** (1.0 / BLOCK_FRAMES)))


@pytest.mark.parametrize("blocks", [FEWEST_BLOCKS, 140, KEPT_BLOCKS, 2 * KEPT_BLOCKS])
def test_of_exponential_tails_the_next_block_exceeds_the_limit_as_often_as_stated(blocks: int):
    """However few blocks it was learnt from: that is what predictive means."""
    rng, chance = np.random.default_rng(1), 0.01
    limits = shown(np.square(rng.exponential(size=(blocks, 2000)))).limits(chance)[0]
    exceeded = float(np.exp(-np.sqrt(limits)).mean())
    assert exceeded == pytest.approx(chance, rel=0.2)


def test_heavier_tails_raise_the_limit_to_where_theirs_lie():
    """T² of Student's errors with nine degrees of freedom, two decades beyond what was seen: at most twice as often."""
    rng, student = np.random.default_rng(3), stats.f(6, 9, scale=6.0)
    limits = shown(largest(student, rng, KEPT_BLOCKS, 200)).limits(1e-3)[0]
    exceeded = -np.expm1(BLOCK_FRAMES * student.logcdf(limits))
    assert 1e-4 < exceeded.mean() < 2e-3
    calm = shown(largest(stats.chi2(6), rng, KEPT_BLOCKS, 200)).limits(1e-3)[0]
    assert np.median(limits) > 2.0 * np.median(calm)


def test_fewer_blocks_make_a_higher_limit_and_too_few_none():
    rng, normal = np.random.default_rng(4), stats.chi2(6)
    squares = largest(normal, rng, 400, 200)
    assert np.isinf(shown(squares[: FEWEST_BLOCKS - 1]).limits(CHANCE)).all()
    medians = [float(np.median(shown(squares[:n]).limits(CHANCE))) for n in (FEWEST_BLOCKS, 100, 400)]
    assert medians == sorted(medians, reverse=True)
    assert medians[0] > 1.25 * medians[-1]


def test_blocks_that_are_alike_count_as_one():
    """Of a statistic that stays the same for four blocks, four times as many are asked for."""
    rng = np.random.default_rng(5)
    four = np.repeat(np.square(rng.exponential(size=(100, 500))), 4, axis=0)
    one = shown(four[::4]).limits(CHANCE)
    known = shown(four, np.full((1, 1), 4.0 * BLOCK_FRAMES)).limits(CHANCE)
    assert np.median(known) == pytest.approx(float(np.median(one)), rel=0.05)
    assert np.isinf(shown(four[: 4 * FEWEST_BLOCKS - 4], np.full((1, 1), 4.0 * BLOCK_FRAMES)).limits(CHANCE)).all()


def test_what_is_old_is_forgotten():
    rng = np.random.default_rng(6)
    loud, calm = (np.square(scale * rng.exponential(size=(KEPT_BLOCKS, 20))) for scale in (10.0, 1.0))
    np.testing.assert_array_equal(shown(np.concatenate([loud, calm])).limits(CHANCE), shown(calm).limits(CHANCE))
    assert (shown(np.concatenate([calm, loud[:100]])).limits(CHANCE) > 10.0 * shown(calm).limits(CHANCE)).all()


def test_frames_that_do_not_count_are_left_out_and_blocks_of_few_that_do():
    """Every other frame of the first stream is wild and doesn't count; the second one shows hardly any frame."""
    rng = np.random.default_rng(7)
    extremes = Extremes(ALIKE_ONE, 3)
    for frame in range(40 * BLOCK_FRAMES):
        squares = rng.chisquare(6, (1, 1)) * np.ones((1, 3))
        usable = np.array([[frame % 2 == 0, frame % 3 == 0, frame % 2 == 0]])
        squares[0, 0] = squares[0, 0] if usable[0, 0] else 1e6
        complete = extremes.add(squares, usable, 1)
        assert complete == (frame % BLOCK_FRAMES == BLOCK_FRAMES - 1)
    assert extremes.blocks.tolist() == [[40, 0, 40]]
    limits = extremes.limits(CHANCE)[0]
    assert limits[0] == limits[2]
    assert np.isinf(limits[1])
