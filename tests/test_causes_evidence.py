"""The evidence for a cause: shares of a finger's profiles, pieces of edges, residuals, the integral over the prior."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.optimize import minimize
from scipy.stats import norm
from scipy.stats import t as student
from support.shown_edges import FRAMES, OPENING_M, REFERENCE_SIGMA, Shown, bend, beside, ill_seen, knocked, two_fingers
from support.simulated import PAPER_LENS, STRONG_LENS, sharp_gripper

from gripmon.judge.causes import CauseJudge, CauseSettings
from gripmon.judge.causes.kernel import FINGERS, FOCAL, JAW, POSE
from gripmon.judge.causes.models import MOST_FOREIGN_EDGES, STUDENT_FREEDOM, Errors, Model, something_else, weigh
from gripmon.judge.causes.state import EdgeView, State
from gripmon.model.camera import LensSettings
from gripmon.model.geometry import perturb
from gripmon.model.records import Cause, EdgeEvidence

ALL_OF_LEFT = ("L_tip_in", "L_tip_near", "L_in_far_along", "L_out_near_along")
"""The left finger's edges that the view shows."""


@pytest.mark.parametrize(
    ("well_seen", "cause"), [(FRAMES, Cause.FINGER_BENT), (3, Cause.FINGER_BENT), (2, Cause.UNKNOWN)]
)
def test_a_finger_that_most_of_its_profiles_contradict_is_not_called_bent(well_seen: int, cause: Cause):
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    bent = {"left": bend(shown.gripper, "left", (8e-4, 5e-4))}
    for k in range(FRAMES):
        judge.add(ill_seen(shown.evidence(bent=bent), 0.6 if k < well_seen else 0.4, 0.8))
    explanation = judge.explanation(shown.reference)
    assert explanation.probable.cause is cause
    assert sum(c.probability for c in explanation.causes) == pytest.approx(1.0)
    assert ("too little of the fingers is seen" in explanation.text) == (cause is Cause.UNKNOWN)


@pytest.mark.parametrize(("share", "cause"), [(0.7, Cause.JAW_OPENING), (0.4, Cause.UNKNOWN)])
def test_one_finger_alone_does_not_tell_of_the_opening(share: float, cause: Cause):
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    for _ in range(FRAMES):
        judge.add(ill_seen(shown.evidence(reported_m=OPENING_M + 5e-4), 0.8, share))
    assert judge.explanation(shown.reference).probable.cause is cause


@pytest.mark.parametrize(("share", "cause"), [(0.7, Cause.LENS), (0.4, Cause.UNKNOWN)])
def test_one_finger_alone_does_not_tell_of_the_lens(share: float, cause: Cause):
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    for _ in range(FRAMES):
        judge.add(ill_seen(shown.evidence(blur_px=1.8), 0.8, share))
    assert judge.explanation(shown.reference).probable.cause is cause


@pytest.mark.parametrize("place", [0, FRAMES // 2, FRAMES - 1])
def test_a_frame_that_has_the_gripper_elsewhere_moves_no_edge(place: int):
    """A fit in which too little agreed may have ended anywhere; its edge points lie where they lie."""
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    astray = knocked(shown.reference, (0.02, -0.01, 0.01), (6.0, -4.0, 8.0))
    for k in range(FRAMES):
        evidence = shown.evidence(opening_m=OPENING_M - 2e-4 * k, reported_m=OPENING_M - 2e-4 * k)
        judge.add(dataclasses.replace(evidence, cam_T_grip=astray) if k == place else evidence)
    explanation = judge.explanation(shown.reference)
    assert explanation.probable.cause is Cause.UNKNOWN
    assert explanation.text == "the edges that are seen show no motion of the camera or a finger"


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS])
def test_residuals_are_distances_in_the_image_and_their_derivatives_hold(lens: LensSettings):
    """Against the camera's projection of the moved gripper, and central differences."""
    shown, gripper = Shown(two_fingers(), lens), two_fingers()
    evidence = shown.evidence(opening_m=0.032, sigma_px=0.0)
    view = EdgeView(shown.camera, gripper, evidence)
    state = State(shown.reference, 0.032, 0.0, np.zeros((2, 6)))
    assert np.abs(view.residual(state)[0]).max() < 2e-3
    # A small known motion of the left finger shows as the projection says.
    shift = np.array([2e-5, -3e-5, 4e-5])
    finger = np.zeros((2, 6))
    finger[0, :3] = shift
    residual = view.residual(State(shown.reference, 0.032, 0.0, finger))[0]
    points = gripper.points_grip_m(0.032) @ shown.reference[:3, :3].T + shown.reference[:3, 3]
    ends = points[gripper.edge_points[evidence.edge]]
    spot = ends[:, 0] + evidence.fraction[:, None] * (ends[:, 1] - ends[:, 0])
    own = gripper.edge_finger[evidence.edge] == 0
    way_px = shown.camera.project(spot + shift) - shown.camera.project(spot)
    expected = np.where(own, -np.einsum("si,si->s", way_px, evidence.across), 0.0)
    np.testing.assert_allclose(residual, expected, atol=4e-3)
    # Derivatives of the prediction, of which the residual has the negative; where the pieces lie on their edges.
    state = State(perturb(shown.reference, np.full(6, 2e-5)), 0.03201, 1e-4, np.zeros((2, 6)))
    jacobian = view.residual(state)[1]
    for unknown in range(FINGERS + 12):
        step = np.zeros(FINGERS + 12)
        step[unknown] = 1e-6
        after, before = view.residual(state.moved(step, gripper))[0], view.residual(state.moved(-step, gripper))[0]
        scale = max(float(np.abs(jacobian[:, unknown]).max()), 1.0)
        np.testing.assert_allclose(jacobian[:, unknown] / scale, (before - after) / 2e-6 / scale, atol=3e-3)


def test_a_step_that_leaves_the_view_is_not_taken(monkeypatch: pytest.MonkeyPatch):
    """Behind the camera nothing is projected: the fit stays where it was, and its evidence is a number."""
    shown = Shown(sharp_gripper(), seed=5)
    evidence = shown.evidence(opening_m=OPENING_M + 8e-5, sigma_px=0.2)
    view, gripper = EdgeView(shown.camera, shown.gripper, evidence), shown.gripper
    start, seen = State(shown.reference, OPENING_M, 0.0, np.zeros((2, 6))), view.residual

    def residual(state: State) -> tuple[np.ndarray, np.ndarray]:
        residual, jacobian = seen(state)
        return residual + (0.0 if state.jaw_opening_m == OPENING_M else np.nan), jacobian

    monkeypatch.setattr(view, "residual", residual)
    held, freed = np.zeros(FINGERS + 12), np.zeros(FINGERS + 12)
    freed[JAW] = 1.0
    edge = np.unique(evidence.edge, return_inverse=True)[1]
    errors = Errors(np.zeros(len(edge)), np.full(len(edge), 0.2), np.full(len(edge), 1e-6), edge)
    found = weigh(view, gripper, Model(held, freed, np.array([1e-3])), start, start, errors)
    assert np.isfinite(found.log_evidence) and found.state.jaw_opening_m == OPENING_M


def test_the_evidence_is_the_integral_over_the_prior():
    """One free unknown, the opening, and edges without an error of their own: quadrature does it, too."""
    shown = Shown(sharp_gripper(), seed=5)
    evidence = shown.evidence(opening_m=OPENING_M + 8e-5, sigma_px=0.2)
    view, gripper = EdgeView(shown.camera, shown.gripper, evidence), shown.gripper
    start = State(shown.reference, OPENING_M, 0.0, np.zeros((2, 6)))
    held, freed, sizes = np.zeros(FINGERS + 12), np.zeros(FINGERS + 12), np.array([1e-4, 1e-3])
    freed[JAW] = 1.0
    count = len(evidence.edge)
    edge = np.unique(evidence.edge, return_inverse=True)[1]
    errors = Errors(np.zeros(count), np.full(count, 0.2), np.full(count, 1e-6), edge)
    found = weigh(view, gripper, Model(held, freed, sizes), start, start, errors)
    residual, jacobian = view.residual(start)

    def density(way_m: float) -> float:
        error = (residual - jacobian[:, JAW] * way_m) / 0.2
        likelihood = np.exp(-0.5 * (STUDENT_FREEDOM + 1.0) * np.log1p(error**2 / STUDENT_FREEDOM).sum())
        return float(likelihood * np.mean(norm.pdf(way_m, scale=sizes)))

    integral = quad(density, -1e-3, 1e-3, points=(8e-5,), limit=200)[0]
    assert found.log_evidence == pytest.approx(math.log(integral), abs=0.25)
    assert found.motion[JAW] == pytest.approx(8e-5, abs=3e-5)
    assert not found.motion[POSE].any() and found.motion[FOCAL] == 0.0


def test_the_state_that_fits_best_is_the_posteriors_mode():
    """The opening, and an offset of each edge, all with heavy tails: a general optimiser finds the same."""
    shown = Shown(sharp_gripper(), seed=5)
    evidence = shown.evidence(opening_m=OPENING_M + 8e-5, sigma_px=0.2)
    view = EdgeView(shown.camera, shown.gripper, evidence)
    start = State(shown.reference, OPENING_M, 0.0, np.zeros((2, 6)))
    held, freed = np.zeros(FINGERS + 12), np.zeros(FINGERS + 12)
    freed[JAW] = 1.0
    edge = np.unique(evidence.edge, return_inverse=True)[1]
    count, edges = len(edge), int(edge.max()) + 1
    bias_px = np.where(edge % 3 == 0, 0.4, 0.0)
    errors = Errors(bias_px, np.full(count, 0.2), np.full(count, 0.15), edge)
    found = weigh(view, shown.gripper, Model(held, freed, np.array([1e-3])), start, start, errors)
    residual, jacobian = view.residual(start)

    def unlikely(unknowns: np.ndarray) -> float:
        way_m, off_px = 1e-4 * unknowns[0], unknowns[1:]
        error = (residual - bias_px - jacobian[:, JAW] * way_m - off_px[edge]) / 0.2
        tails = np.log1p(error**2 / STUDENT_FREEDOM).sum() + np.log1p((off_px / 0.15) ** 2 / STUDENT_FREEDOM).sum()
        return float(0.5 * (STUDENT_FREEDOM + 1.0) * tails + 0.5 * (way_m / 1e-3) ** 2)

    best = minimize(unlikely, np.zeros(1 + edges), method="BFGS", options={"gtol": 1e-7})
    assert found.motion[JAW] == pytest.approx(1e-4 * best.x[0], abs=3e-7)


@pytest.mark.parametrize("off_px", [2.0, -4.0])
def test_a_finger_of_which_two_edges_stay_is_not_bent(off_px: float):
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    for _ in range(FRAMES):
        judge.add(beside(shown, shown.evidence(), ("L_tip_in", "L_in_far_along"), off_px))
    assert judge.explanation(shown.reference).probable.cause is not Cause.FINGER_BENT


@pytest.mark.parametrize(("moved", "named"), [(("L_tip_near",), False), (("L_tip_in", "L_tip_near"), True)])
def test_one_edge_alone_does_not_tell_a_bent_finger_from_a_border(moved: tuple[str, ...], named: bool):
    """Of the left finger nothing but the two edges of its end is seen."""
    shown = Shown(sharp_gripper())
    seen = [number for number, name in enumerate(shown.gripper.edge_ids) if name not in ALL_OF_LEFT[2:]]

    def end_only(evidence: EdgeEvidence) -> EdgeEvidence:
        own = np.isin(evidence.edge, seen)
        per_stretch = ("edge", "fraction", "xy", "per_px", "sigma_px", "spread_px", "blur_px2", "across")
        return dataclasses.replace(evidence, **{name: getattr(evidence, name)[own] for name in per_stretch})

    judge = CauseJudge(shown.camera, shown.gripper, CauseSettings(), REFERENCE_SIGMA, 0.0, 0.0)
    for _ in range(FRAMES):
        judge.well(end_only(shown.evidence()))
    for _ in range(FRAMES):
        judge.add(end_only(beside(shown, shown.evidence(), moved, 0.3)))
    explanation = judge.explanation(shown.reference)
    assert (explanation.probable.cause is Cause.FINGER_BENT) == named
    assert ("what is seen would fit if finger left is bent" in explanation.text) != named


def test_how_many_edges_belong_to_something_else_is_averaged_over():
    """Where nothing is free: against quadrature over the share of edges, anything up to half of them."""
    shown = Shown(sharp_gripper(), seed=5)
    evidence = beside(shown, shown.evidence(sigma_px=0.2), ("L_tip_in", "L_in_far_along", "R_tip_in"), 1.5)
    view = EdgeView(shown.camera, shown.gripper, evidence)
    start = State(shown.reference, OPENING_M, 0.0, np.zeros((2, 6)))
    edge = np.unique(evidence.edge, return_inverse=True)[1]
    count, foreign = len(edge), np.linspace(-12.0, -4.0, int(edge.max()) + 1)
    errors = Errors(np.zeros(count), np.full(count, 0.2), np.full(count, 1e-6), edge, foreign)
    nothing = Model(np.zeros(FINGERS + 12), np.zeros(FINGERS + 12), np.zeros(0))
    found = weigh(view, shown.gripper, nothing, start, start, errors)
    error = view.residual(start)[0] / 0.2
    own = np.bincount(edge, -0.5 * (STUDENT_FREEDOM + 1.0) * np.log1p(error**2 / STUDENT_FREEDOM))

    def density(share: float) -> float:
        return float(np.prod((1.0 - share) * np.exp(own) + share * np.exp(foreign))) / MOST_FOREIGN_EDGES

    def is_own(share: float, k: int) -> float:
        mine = (1.0 - share) * np.exp(own[k])
        return density(share) * float(mine / (mine + share * np.exp(foreign[k])))

    total = quad(density, 0.0, MOST_FOREIGN_EDGES, epsabs=0.0)[0]
    shares = [quad(is_own, 0.0, MOST_FOREIGN_EDGES, args=(k,), epsabs=0.0)[0] / total for k in range(len(own))]
    assert found.log_evidence == pytest.approx(math.log(total), abs=1e-4)
    np.testing.assert_allclose(found.own, shares, atol=1e-4)
    assert 0 < (found.own < 0.5).sum() < len(own)


@pytest.mark.parametrize("seed", range(6))
def test_borders_of_other_things_are_no_bent_finger(seed: int):
    """Beside one or two of a finger's four edges, in each frame alike, up to 4 px off and askew; the rest stays."""
    shown, rng = Shown(sharp_gripper(), seed=seed), np.random.default_rng(seed)
    judge = shown.judge()
    seen = np.unique(shown.evidence().edge)
    left = seen[shown.gripper.edge_finger[seen] == 0]
    ends_px = {edge: rng.uniform(-4.0, 4.0, 2) for edge in rng.choice(left, int(rng.integers(1, 3)), replace=False)}
    for _ in range(FRAMES):
        evidence = shown.evidence(sigma_px=0.06)
        off_px = np.zeros(len(evidence.edge))
        for edge, ends in ends_px.items():
            own = evidence.edge == edge
            off_px[own] = np.interp(evidence.fraction[own], (0.0, 1.0), ends)
        judge.add(dataclasses.replace(evidence, xy=evidence.xy + (off_px * evidence.per_px)[:, None] * evidence.across))
    assert judge.explanation(shown.reference).probable.cause is Cause.UNKNOWN


@pytest.mark.parametrize("seed", [0, 1, 25])
def test_borders_of_other_things_hide_no_knock(seed: int):
    """Of half a millimetre and a third of a degree; borders beside two of a finger's edges, on the same side of them,
    far enough to drag a fit along that doubts no edge.
    """
    shown, rng = Shown(sharp_gripper(), seed=seed), np.random.default_rng(seed)
    edges = tuple(rng.choice(ALL_OF_LEFT, 2, replace=False).tolist())
    border_px = float(rng.choice([-1, 1]) * rng.uniform(3.0, 6.0))
    shift, turn = rng.normal(size=(2, 3))
    shift_m, turn_deg = 5e-4 * shift / np.linalg.norm(shift), 0.3 * turn / np.linalg.norm(turn)
    judge = shown.judge(sigma_px=0.05)
    for _ in range(FRAMES):
        evidence = shown.evidence(knocked(shown.reference, tuple(shift_m), tuple(turn_deg)), sigma_px=0.05)
        judge.add(beside(shown, evidence, edges, border_px))
    assert judge.explanation(shown.reference).probable.cause is Cause.CAMERA_MOUNT


@pytest.mark.parametrize(("learnt", "named"), [(5, False), (6, True)])
def test_what_was_learnt_before_a_knock_stays_if_it_suffices(learnt: int, named: bool):
    """A reference that is off as far as it may be hides a knock of a tenth of a millimetre from who has learnt less."""
    shown = Shown(sharp_gripper())
    off = knocked(shown.reference, (1e-4, -1e-4, 1e-4), (0.05, 0.05, -0.05))
    judge = shown.judge(well=learnt, cam_T_grip=off)
    judge.knocked()
    assert judge.wants_baseline != named
    for _ in range(FRAMES):
        judge.add(shown.evidence(knocked(off, (1e-4, 0.0, 0.0))))
    assert (judge.explanation(shown.reference).probable.cause is Cause.CAMERA_MOUNT) == named


@pytest.mark.parametrize("count", [1, 2, 5])
def test_what_an_edge_shows_that_belongs_to_something_else_is_the_integral_over_all_borders(count: int):
    """Against the integral over the edge's own offset where it shows nothing odd, which all models share."""
    rng, sigma_px, spread_px, reach_px = np.random.default_rng(2), 0.05, 0.1, 8.0
    fraction = np.linspace(0.1, 0.9, count)
    residual = np.interp(fraction, (0.1, 0.9), (1.5, -0.7)) + rng.normal(0.0, 0.5 * sigma_px, count)
    errors = Errors(np.zeros(count), np.full(count, sigma_px), np.full(count, spread_px), np.zeros(count, dtype=int))
    found = something_else(residual, fraction, errors, reach_px)

    def height(error: np.ndarray, scale: float) -> float:
        return float(np.exp(-0.5 * (STUDENT_FREEDOM + 1.0) * np.log1p((error / scale) ** 2 / STUDENT_FREEDOM).sum()))

    def border(off_px: float, other_px: float) -> float:
        line = off_px + (other_px - off_px) * (fraction - 0.1) / 0.8
        return height(residual - line, sigma_px) / (2.0 * reach_px) ** (2 if count > 1 else 1)

    if count == 1:
        any_border = quad(lambda off_px: border(off_px, 0.0), residual[0] - 1.0, residual[0] + 1.0, limit=200)[0]
    else:
        any_border = dblquad(border, -1.7, 0.3, 0.5, 2.5, epsabs=1e-9)[0]
    own = quad(
        lambda off_px: student.pdf(off_px / spread_px, STUDENT_FREEDOM) / spread_px
        * height(np.full(count, off_px), sigma_px), -1.0, 1.0, limit=200,
    )[0]  # fmt: skip
    assert found[0] == pytest.approx(math.log(any_border / own), abs=0.5)


def test_a_cause_that_most_edges_contradict_is_not_named():
    """Four of eight edges show borders of other things, and what is left would fit a bent finger."""
    shown = Shown(sharp_gripper())
    judge = shown.judge()
    bent = {"right": bend(shown.gripper, "right", (1.6e-3, 1.6e-3))}
    others = ("L_tip_in", "L_tip_near", "L_in_far_along", "R_out_near_along")
    for _ in range(FRAMES):
        evidence = shown.evidence(bent=bent)
        for number, name in enumerate(others):
            evidence = beside(shown, evidence, (name,), (-1.0) ** number * (2.0 + number))
        judge.add(evidence)
    explanation = judge.explanation(shown.reference)
    assert explanation.probable.cause is Cause.UNKNOWN
    assert "what is seen would fit if finger right is bent" in explanation.text
