"""The belief against what is true by definition: the sum over all paths, the order of edges, repeated pictures."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from support.belief_paths import Told as Frame
from support.belief_paths import sum_of_paths

from gripmon.belief.core import Belief
from gripmon.belief.doubts import Doubt, Rates, Told
from gripmon.belief.state import LATELY, MOTION, SIZE, Priors, Seen

DT_S = 1.0 / 15.0
STEADY = replace(Priors(), creep_m_s=0.0, creep_rad_s=0.0)
ALONG = np.array([0.0, 0.6, 0.8])


def rows_of(rng: np.random.Generator, edges: int) -> np.ndarray:
    """Slopes as a gripper 120 mm before a lens of 600 px has them."""
    rows = np.zeros((edges, 2, SIZE))
    scale = np.array([5000.0, 5000.0, 1500.0, 200.0, 200.0, 300.0])
    rows[:, :, MOTION] = rng.normal(size=(edges, 2, 6)) * scale
    rows[:, :, 12:18] = rows[:, :, MOTION]
    rows[:, :, 18] = rng.normal(size=(edges, 2)) * 2500.0
    rows[:, :, 19:21] = rng.normal(size=(edges, 2, 2)) * 3000.0
    rows[:, 0, 21] = 1.0
    rows[:, :, 22] = rng.normal(size=(edges, 2)) * 200.0
    return rows


def frames_of(rng: np.random.Generator, edges: int, count: int, like: float | None = None) -> list[Frame]:
    """Frames with errors as modelled, and edges now and then half a pixel off."""
    rows = rows_of(rng, edges)
    g = rng.normal(size=SIZE) * np.sqrt(np.diag(STEADY.covariance()))
    g[MOTION] = g[LATELY] = 0.0
    lasting, back, out = rng.normal(0.0, 0.05, (edges, 2)), np.zeros((edges, 2)), []
    for t in range(count):
        rho = np.zeros(edges) if t == 0 else (rng.uniform(0.0, 1.0, edges) if like is None else np.full(edges, like))
        back = rho[:, None] * back + np.sqrt(1.0 - rho[:, None] ** 2) * rng.normal(0.0, 0.1, (edges, 2))
        y = rows @ g + lasting + back + rng.normal(0.0, 0.02, (edges, 2))
        y += (rng.random(edges) < 0.3)[:, None] * rng.normal(0.0, 0.3, (edges, 2))
        seen = Seen(
            rows, y, np.full((edges, 2), 4e-4), np.ones(edges, bool), np.zeros(edges, np.int64), rho,
            np.full(edges, 1e-2), rows @ g,
        )  # fmt: skip
        answer = rng.integers(0, 3, 2)
        repeats = np.array([bool(out) and a == b for a, b in zip(answer, last, strict=True)]) if t else np.zeros(2, bool)
        last = answer
        right, wrong = np.array([0.05, 0.25, 0.70]), np.array([0.62, 0.36, 0.02])
        out.append(Frame(seen, right[answer], wrong[answer], repeats, 0.95))
    return out


def told(frame: Frame) -> Told:
    return Told(np.log(frame.right), np.log(frame.wrong), frame.repeats, frame.memory)


@pytest.mark.parametrize(("seed", "count", "leaving"), [(1, 5, True), (2, 5, True), (3, 15, False)])
def test_all_sets_weigh_what_the_sum_over_all_paths_says(seed: int, count: int, leaving: bool) -> None:
    """Nothing merged, nothing dropped: weights, mean and covariance as dense Gaussians over every path have them."""
    rng = np.random.default_rng(seed)
    e, yes = np.eye(3, dtype=bool), float(leaving)
    doubts = [
        Doubt(e[0], Rates(0.05, 0.01, 0.1, 0.0, 0.5 * yes), np.zeros(2, bool), held=False),
        Doubt(e[1] | e[2], Rates(0.1, 0.5, 0.0, 1.0 * yes), np.array([True, False])),
    ]
    frames = frames_of(rng, 3, count)
    for t in range(1, count, 3):
        frames[t].seen.shown[2] = False
    if leaving:
        paths = list(itertools.product(range(4), repeat=count))
    else:
        steps = range(count + 1)
        paths = [tuple((t >= a) * 1 | (t >= b) * 2 for t in range(count)) for a in steps for b in steps]
    truth = sum_of_paths(doubts, STEADY, frames, DT_S, paths)
    belief = Belief(doubts, ALONG, STEADY, everything=True)
    for frame in frames:
        belief.update(frame.seen, DT_S, told(frame))
    for doubted, weight in truth.weights.items():
        assert belief.weights.get(doubted, 0.0) == pytest.approx(weight, abs=1e-9)
    mean, covariance = belief.moments
    sigma = np.sqrt(np.diag(truth.covariance))
    keep = [i for i in range(SIZE) if i not in range(6, 12)]  # p: not in the sum, which has no creep
    assert np.abs((mean - truth.mean) / sigma)[keep].max() < 1e-9
    assert np.abs((covariance - truth.covariance) / np.outer(sigma, sigma))[np.ix_(keep, keep)].max() < 1e-9
