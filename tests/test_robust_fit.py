"""The joint fit on edge candidates made from the linear model itself: exact truth, known noise, gross clutter."""

from __future__ import annotations

import numpy as np
import pytest
from support.meters import JAW_SIGMA_M, box_gripper
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.model.camera import make_camera
from gripmon.track.edges.prediction import Prediction, lay_out, predict
from gripmon.track.edges.profiles import Candidates, Edgels, profile_offsets_px, weigh
from gripmon.track.edges.robust_fit import (
    CONTRADICTION_RATIO,
    Prior,
    RobustFit,
    assess,
    fit_irls,
    fit_irls_from_grid,
    grid_of_starts,
    prior_information,
    without_one_edge,
)
from gripmon.track.edges.settings import RobustFitSettings, SamplingSettings

CAMERA, GRIPPER = make_camera(PAPER_LENS), box_gripper()
SETTINGS = RobustFitSettings()
NO_FLOORS = RobustFitSettings(point_floor_px=0.005, edge_floor_px=0.0)
PRIOR = prior_information(JAW_SIGMA_M)
REACH_PX = 4.25  # candidates are found this far along the profiles
EDGES = len(GRIPPER.edge_ids)
ANY = np.zeros(EDGES, dtype=np.int8)
REPORTED = Prior(np.zeros(7), PRIOR)


def predicted() -> Prediction:
    pose = nominal_cam_T_grip()
    layout = lay_out(CAMERA, GRIPPER, pose, 0.034, SamplingSettings())
    return predict(CAMERA, GRIPPER, layout, pose, 0.034, profile_offsets_px(7.0), jaw_unknown=True)


PREDICTION = predicted()
SAMPLES = len(PREDICTION.uv_px)
XI = np.array([6e-5, -8e-5, 1.2e-4, 3e-3, -2e-3, 2e-3, 2e-5])
"""A motion of a pixel or so."""


def candidates(sample: np.ndarray, offset_px: np.ndarray, sigma_px: float = 0.1, step: float = 50.0) -> Candidates:
    order = np.lexsort((offset_px, sample))  # as a detector would deliver them
    return Candidates(
        sample[order],
        offset_px[order],
        np.full(len(sample), step),
        np.full(len(sample), sigma_px),
        np.full(len(sample), 1.0),
        np.zeros(len(sample)),
        1.0,
        255.0,
    )


def true_candidates(rng: np.random.Generator, sigma_px: float = 0.1, xi: np.ndarray = XI) -> Candidates:
    offset_px = PREDICTION.jacobian @ xi + rng.normal(scale=sigma_px, size=SAMPLES)
    return candidates(np.arange(SAMPLES), offset_px, sigma_px)


def with_clutter(rng: np.random.Generator, missing: float, extra: float, sigma_px: float = 0.1) -> Candidates:
    """``missing``: share of profiles whose edge point is replaced by a random one; ``extra``: random ones a profile."""
    offset_px = PREDICTION.jacobian @ XI + rng.normal(scale=sigma_px, size=SAMPLES)
    lost = rng.random(SAMPLES) < missing
    offset_px[lost] = rng.uniform(-REACH_PX, REACH_PX, np.count_nonzero(lost))
    more = rng.integers(0, SAMPLES, round(extra * SAMPLES))
    return candidates(
        np.concatenate([np.arange(SAMPLES), more]),
        np.concatenate([offset_px, rng.uniform(-REACH_PX, REACH_PX, len(more))]),
        sigma_px,
    )


def votes_for(
    found: Candidates,
    settings: RobustFitSettings = SETTINGS,
    polarity: np.ndarray = ANY,
    edge_spread_px: np.ndarray | None = None,
) -> Edgels:
    spread_px = np.full(EDGES, settings.edge_floor_px) if edge_spread_px is None else edge_spread_px
    return Edgels(found, PREDICTION, weigh(found, PREDICTION, polarity, settings).weight, spread_px, np.zeros(EDGES))


def fit(found: Candidates, settings: RobustFitSettings = SETTINGS, start: np.ndarray | None = None) -> RobustFit:
    return fit_irls(votes_for(found, settings), REPORTED, np.zeros(7) if start is None else start, settings)


def miss_px(consensus: RobustFit, xi: np.ndarray = XI) -> float:
    """Largest distance between the fitted and the true edges."""
    return float(np.abs(PREDICTION.jacobian @ (consensus.xi - xi)).max())


@pytest.mark.parametrize(
    ("missing", "extra", "mean_px", "max_px"),
    [(0.3, 0.0, 0.1, 0.25), (0.0, 0.5, 0.1, 0.25), (0.3, 0.5, 0.15, 0.4), (0.3, 1.5, 0.35, 0.8)],
)
def test_gross_clutter_does_not_move_the_fit(missing: float, extra: float, mean_px: float, max_px: float):
    rng = np.random.default_rng(3)
    cluttered = [fit(with_clutter(rng, missing, extra)) for _ in range(40)]
    misses = [miss_px(consensus) for consensus in cluttered]
    assert np.mean(misses) < mean_px
    assert max(misses) < max_px
    assert min(c.share for c in cluttered) > (0.4 if missing else 0.8)


SAMPLED = np.unique(PREDICTION.layout.edge)


def with_background_edge(edge: int, beside_px: float, true_one_seen: bool) -> Candidates:
    """A complete straight edge of the background ``beside_px`` next to one of the gripper, or instead of it."""
    rng = np.random.default_rng(4)
    offset_px = PREDICTION.jacobian @ XI + rng.normal(scale=0.1, size=SAMPLES)
    mine = np.flatnonzero(PREDICTION.layout.edge == edge)
    trap_px = offset_px[mine] + beside_px
    kept = np.arange(SAMPLES) if true_one_seen else np.setdiff1d(np.arange(SAMPLES), mine)
    return candidates(np.concatenate([kept, mine]), np.concatenate([offset_px[kept], trap_px]))


AMBIGUOUS = {(f"{side}_{edge}_along", 1.5) for side in "LR" for edge in ("in_far", "out_near")}
"""Another motion explains all edges but a third one as well: nothing in this image could tell."""

INSTEAD = [
    (name, beside_px)
    for name in (GRIPPER.edge_ids[e] for e in SAMPLED)
    for beside_px in (-2.5, -1.5, 1.5, 2.5)
    if (name, beside_px) not in AMBIGUOUS
]


@pytest.mark.parametrize(("name", "beside_px"), INSTEAD)
def test_an_edge_of_the_background_instead_of_one_of_the_gripper_is_noticed(name: str, beside_px: float):
    """One edge has no contrast, and the background offers a parallel one.  The others tell: the fit leaves it alone,
    is repeated without it, or its covariance covers the error.
    """
    edgels = votes_for(with_background_edge(GRIPPER.edge_ids.index(name), beside_px, true_one_seen=False))
    consensus = fit_irls(edgels, REPORTED, np.zeros(7), SETTINGS)
    uncertainty = assess(edgels, consensus, PRIOR)
    if uncertainty.contradiction > CONTRADICTION_RATIO:
        rest = without_one_edge(edgels, REPORTED, np.zeros(7), SETTINGS, uncertainty.contradiction)
        if rest is not None:
            _, consensus, uncertainty = rest
            assert not consensus.edge_seen[GRIPPER.edge_ids.index(name)]
    error = consensus.xi - XI
    nees = float(error @ np.linalg.solve(uncertainty.covariance, error))
    assert miss_px(consensus) < 0.35 or nees < 25.0 or consensus.share < SETTINGS.trusted_share


def left_out(offset_px: np.ndarray) -> tuple[float, str | None]:
    """How much the edges contradict each other, and which one is left out for it."""
    edgels = votes_for(candidates(np.arange(SAMPLES), offset_px), NO_FLOORS)
    contradiction = assess(edgels, fit_irls(edgels, REPORTED, np.zeros(7), SETTINGS), PRIOR).contradiction
    found = without_one_edge(edgels, REPORTED, np.zeros(7), SETTINGS, contradiction)
    if found is None:
        return contradiction, None
    gone = [e for e in SAMPLED if not found[0].weight[PREDICTION.layout.edge == e].any()]
    assert len(gone) == 1 and found[2].contradiction < contradiction / 3.0
    return contradiction, GRIPPER.edge_ids[gone[0]]


def test_the_one_edge_that_contradicts_all_others_is_left_out():
    """A quarter of a px beside its place, with which the fit bends a little: less than a third of it stays then."""
    rng, right, wrong, trials = np.random.default_rng(11), 0, 0, 0
    for edge in [e for e in SAMPLED if not GRIPPER.edge_ids[e].endswith("tip_near")] * 4:
        offset_px = PREDICTION.jacobian @ XI + rng.normal(scale=0.1, size=SAMPLES)
        offset_px[PREDICTION.layout.edge == edge] += 0.25
        contradiction, name = left_out(offset_px)
        if contradiction > CONTRADICTION_RATIO:
            trials += 1
            right += name == GRIPPER.edge_ids[edge]
            wrong += name not in (None, GRIPPER.edge_ids[edge])
    assert trials > 12 and right > 0.8 * trials and wrong <= 0.1 * trials


def test_no_edge_is_left_out_where_all_of_them_contradict_each_other():
    """Stretches err together everywhere: some edge is the worst, but without it hardly less is left."""
    rng = np.random.default_rng(12)
    for _ in range(8):
        of_stretch = rng.normal(scale=0.2, size=PREDICTION.layout.stretch.max() + 1)
        noise = rng.normal(scale=0.1, size=SAMPLES) + of_stretch[PREDICTION.layout.stretch]
        contradiction, name = left_out(PREDICTION.jacobian @ XI + noise)
        assert contradiction > CONTRADICTION_RATIO and name is None


def in_texture(rng: np.random.Generator, edge: int, true_share: float, texture: int) -> Candidates:
    """All edges where they are but one, of which a share of the profiles shows it, each among so many random ones."""
    mine = np.flatnonzero(PREDICTION.layout.edge == edge)
    offset_px = PREDICTION.jacobian @ XI + rng.normal(scale=0.1, size=SAMPLES)
    shown = np.setdiff1d(np.arange(SAMPLES), mine[rng.random(len(mine)) >= true_share])
    random = np.repeat(mine, texture)
    random_px = rng.uniform(-REACH_PX, REACH_PX, len(random))
    return candidates(np.concatenate([shown, random]), np.concatenate([offset_px[shown], random_px]))


def seen_in_texture(true_share: float, texture: int, trials: int = 40) -> float:
    """How often the edge in the texture counts as seen."""
    rng, seen = np.random.default_rng(5), 0
    for trial in range(trials):
        edge = int(SAMPLED[trial % len(SAMPLED)])
        seen += bool(fit(in_texture(rng, edge, true_share, texture)).edge_seen[edge])
    return seen / trials


@pytest.mark.parametrize(
    ("true_share", "texture", "least", "most"),
    [
        pytest.param(0.0, 1, 0.0, 0.0, id="sparse texture alone"),
        pytest.param(0.0, 4, 0.0, 0.0, id="texture alone"),
        pytest.param(0.0, 12, 0.0, 0.0, id="texture that supports four profiles of five by chance"),
        pytest.param(0.5, 1, 0.95, 1.0, id="half an edge among few"),
        pytest.param(0.9, 6, 0.95, 1.0, id="nearly all of it where chance supports half"),
        pytest.param(0.5, 6, 0.0, 0.5, id="half of it where chance supports half"),
        pytest.param(0.9, 12, 0.0, 0.2, id="nearly all of it where chance supports as much"),
    ],
)
def test_an_edge_counts_as_seen_by_what_exceeds_chance_and_its_scatter(
    true_share: float, texture: int, least: float, most: float
):
    """Four standard deviations of the number that chance supports, which is binomial: fewer where it supports most."""
    assert least <= seen_in_texture(true_share, texture) <= most


def test_clutter_alone_is_never_trusted():
    rng = np.random.default_rng(5)
    for density in (0.5, 1.0, 2.0, 3.0):
        for _ in range(15):
            count = round(density * SAMPLES)
            found = candidates(rng.integers(0, SAMPLES, count), rng.uniform(-REACH_PX, REACH_PX, count))
            starts = grid_of_starts(PREDICTION, REACH_PX, SETTINGS.start_width_px)
            best = fit_irls_from_grid(votes_for(found), REPORTED, starts, SETTINGS)
            assert fit(found).share < SETTINGS.trusted_share
            assert best.share < SETTINGS.found_share


@pytest.mark.parametrize("count", [0, 3, 6])
def test_hardly_any_candidates_leave_the_start_and_support_nothing(count: int):
    found = candidates(np.arange(count), np.full(count, 0.3))
    consensus = fit(found)
    assert consensus.share == 0.0 and not consensus.edge_seen.any()
    assert np.isfinite(consensus.xi).all()
    assert np.abs(PREDICTION.jacobian @ consensus.xi).max() < REACH_PX


def test_the_grid_finds_what_is_out_of_the_reach_of_the_start():
    rng = np.random.default_rng(6)
    far = XI + np.array([6.5 / PREDICTION.pixels_per_m, -6.0 / PREDICTION.pixels_per_m, 0.0, 0.0, 0.0, 0.0, 0.0])
    offset_px = PREDICTION.jacobian @ far + rng.normal(scale=0.1, size=SAMPLES)
    seen = np.abs(offset_px) < 9.0
    found = candidates(np.flatnonzero(seen), offset_px[seen])
    starts = grid_of_starts(PREDICTION, 7.0, SETTINGS.start_width_px)
    best = fit_irls_from_grid(votes_for(found), REPORTED, starts, SETTINGS)
    assert miss_px(best, far) < 0.4
    assert best.share > 0.8 > fit(found).share


def test_the_prior_holds_the_jaw_at_what_is_reported():
    """With a sharp report the seen opening is the reported one, with a vague one it is what the edges show."""
    opened = np.zeros(7)
    opened[6] = 4e-4
    found = true_candidates(np.random.default_rng(7), 0.05, opened)
    vague, sharp = (
        fit_irls(votes_for(found), Prior(np.zeros(7), prior_information(s)), np.zeros(7), SETTINGS)
        for s in (0.02, 1e-6)
    )
    assert vague.xi[6] == pytest.approx(4e-4, abs=5e-5)
    assert abs(sharp.xi[6]) < 1e-5
    assert prior_information(0.0)[6] == pytest.approx(1e12), "exact means a micrometre"
    assert len(prior_information(None)) == 6
