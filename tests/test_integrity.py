"""Bounds at a stated risk: quantiles against samples, refits against fits of kept rows, the promise against truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from support.by_numpy.integrity import beyond

from gripmon.track.integrity import Hypotheses, Separation, bounds, hypotheses_of, kernel
from gripmon.track.integrity.frame_kernel import absolute_level
from gripmon.track.integrity.hypotheses import WRONG_EDGE, WRONG_GRIPPER
from gripmon.track.integrity.separation import LEVEL_TOLERANCE_RATIO, Tails, limits_of

# --- quantiles ---

VARIANCES = [
    (1.0, 0.0, 0.0),
    (1.0, 1.0, 1.0),
    (1.0, 0.5, 0.1),
    (1.0, 0.3, 0.0),
    (1.0, 0.2, 0.2),
    (1.0, 0.5, 0.5),
    (1.0, 0.8, 0.7),
    (1.0, 1.0, 0.0),
    (1.0, 0.9, 0.01),
    (1.0, 0.03, 0.02),
]
NORMAL = np.random.default_rng(1).normal(size=(400_000, 3))


def turned(variances: tuple[float, ...], seed: int = 2) -> np.ndarray:
    """(3, 3) covariance with these variances along directions at random, of the size that a pose's has."""
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return 1e-10 * (axes * variances) @ axes.T


@pytest.mark.parametrize("risk", [1e-1, 1e-2, 1e-3])
@pytest.mark.parametrize("variances", VARIANCES)
def test_normal_errors_exceed_their_bound_as_often_as_stated(variances: tuple[float, ...], risk: float):
    """Up to 1.3 times as often, which is one per cent of the bound; as rarely as a third where two axes are as long."""
    axes, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    errors = 1e-5 * (NORMAL * np.sqrt(variances)) @ axes.T
    [radius] = bounds(turned(variances)[None], np.array([risk]))
    share = float((np.linalg.norm(errors, axis=1) > radius).mean())
    scatter = 4.0 * np.sqrt(risk / len(errors))
    assert 0.27 * risk - scatter < share < 1.3 * risk + scatter
    one_or_three = min(variances) == 1.0 or max(variances[1:]) == 0.0
    assert not one_or_three or abs(share - risk) < scatter, "there it is exact"


@pytest.mark.parametrize("directions", [1, 3])
def test_bounds_of_one_direction_and_of_three_equal_ones_are_those_of_chi_square(directions: int):
    risks = 10.0 ** np.array([-0.6, -1.0, -3.3, -5.0, -7.7, -9.0, -11.9])
    covariance = turned((1.0,) * directions + (0.0,) * (3 - directions))
    found = bounds(np.repeat(covariance[None], len(risks), axis=0), risks)
    np.testing.assert_allclose(found, 1e-5 * np.sqrt(stats.chi2.isf(risks, directions)), rtol=5e-3)


def test_far_out_a_bound_is_exceeded_hardly_more_often_than_stated():
    """Of all others the longest axis says at least, three as long as that at most."""
    risks = 10.0 ** np.array([-5.0, -7.0, -9.0, -12.0])
    for variances in VARIANCES:
        found = bounds(np.repeat(turned(variances)[None], len(risks), axis=0), risks)
        assert (found > 0.999e-5 * np.sqrt(stats.chi2.isf(risks, 1))).all()
        assert (found < 1.001e-5 * np.sqrt(stats.chi2.isf(risks, 3))).all()
    # Two directions beside one, equally long: by integrating over it, as chi-square of 2 is exponential.
    x = np.linspace(0.0, 12.0, 200_001)
    for two in (0.2, 0.5, 0.8, 0.95):
        radii = bounds(np.repeat(turned((1.0, two, two))[None], len(risks), axis=0), risks)
        for risk, radius in zip(risks, 1e5 * radii, strict=True):
            rest = np.exp(-np.maximum(radius**2 - x * x, 0.0) / (2.0 * two))
            beyond = 2.0 * np.trapezoid(stats.norm.pdf(x) * rest, x)
            assert 0.2 * risk < beyond < 1.35 * risk


def test_bounds_grow_with_the_covariance_and_as_the_risk_falls_and_stay_finite():
    risks = np.concatenate([[0.0, 1e-300], np.geomspace(1e-14, 0.9, 200)])
    found = bounds(np.repeat(turned((1.0, 0.4, 0.1))[None], len(risks), axis=0), risks)
    assert np.isfinite(found).all() and (found > 0.0).all()
    assert (np.diff(found) < 1e-12).all()
    assert found[0] == found[1] == pytest.approx(found[2])
    larger = bounds(4.0 * np.repeat(turned((1.0, 0.4, 0.1))[None], len(risks), axis=0), risks)
    np.testing.assert_allclose(larger, 2.0 * found, rtol=1e-9)
    assert bounds(np.zeros((1, 3, 3)), np.array([1e-5])) < 1e-100
    assert np.isfinite(bounds(turned((1.0, 0.4, 0.1))[None], np.array([5.0]))).all(), "more than certain"


# --- refits ---


def separate(
    pull: np.ndarray,
    information: np.ndarray,
    middle: np.ndarray,
    keep: np.ndarray,
    known: np.ndarray,
    known_pull: np.ndarray,
) -> Separation:
    """The fits under all hypotheses, with a gripper model that is exact."""
    model = np.zeros((1, *pull.shape)), np.zeros((1, len(pull)), dtype=np.intp), 1
    sums = kernel.add_up(pull, information, middle, *model, keep, known, known_pull)
    return Separation(*kernel.separate(*sums, pull.shape[1]))


class Model:
    """A linear model of v edges with m unknowns: Jacobian rows with normal errors of known size, fitted at once."""

    def __init__(
        self,
        rng: np.random.Generator,
        edges: int = 9,
        unknowns: int = 6,
        rows: int = 7,
        tells: np.ndarray | float = 1.0,
    ) -> None:
        """``tells`` (v,): factor on what each edge tells of the third unknown."""
        self.jacobian = rng.normal(size=(edges, rows, unknowns))
        self.jacobian[:, :, 2] *= np.reshape(tells, (-1, 1))
        self.sigma = rng.uniform(0.5, 2.0, (edges, rows))
        weighted = self.jacobian / self.sigma[..., None] ** 2
        self.information = np.einsum("vri,vrj->vij", weighted, self.jacobian)
        self._weighted = weighted

    def pull(self, residual: np.ndarray) -> np.ndarray:
        """(v, m) of residuals (v, rows)."""
        return np.einsum("vri,vr->vi", self._weighted, residual)

    def fit(self, measured: np.ndarray, known: np.ndarray, mean: np.ndarray, keep: np.ndarray) -> np.ndarray:
        """(m,) by least squares on the rows of the kept edges and on what is known, by NumPy."""
        kept = keep > 0.0
        root = np.linalg.cholesky(known).T
        rows = np.concatenate([(self.jacobian / self.sigma[..., None])[kept].reshape(-1, len(mean)), root])
        values = np.concatenate([(measured / self.sigma)[kept].ravel(), root @ mean])
        return np.linalg.lstsq(rows, values, rcond=None)[0]


@pytest.mark.parametrize("unknowns", [6, 7])
def test_refits_are_the_fits_of_the_rows_that_are_kept(unknowns: int):
    rng = np.random.default_rng(3)
    model = Model(rng, unknowns=unknowns)
    keep = np.ones((11, 9))
    keep[1:10] -= np.eye(9)
    keep[10, :5] = 0.0
    square = rng.normal(size=(11, unknowns, unknowns))
    known = square @ square.transpose(0, 2, 1) + 0.1 * np.eye(unknowns)
    mean = rng.normal(size=(11, unknowns))
    measured = rng.normal(size=(9, 7))
    at = rng.normal(size=unknowns)  # anywhere: the sums need not be of a solution
    pull = model.pull(measured - model.jacobian @ at)
    known_pull = np.einsum("hij,hj->hi", known, mean - at)
    found = separate(pull, model.information, model.information, keep, known, known_pull)
    for k in range(11):
        expected = model.fit(measured, known[k], mean[k], keep[k])
        np.testing.assert_allclose(at + found.shift[k], expected, atol=1e-9)
        covariance = np.linalg.inv(np.einsum("v,vij->ij", keep[k], model.information) + known[k])
        np.testing.assert_allclose(found.covariance[k], covariance, atol=1e-9)


def test_a_refits_covariance_is_honest_where_weights_are_wrong():
    """Rows err four times as much as their weights say, which ``middle`` knows."""
    rng = np.random.default_rng(4)
    model = Model(rng)
    keep, known = np.ones((2, 9)), np.repeat(0.3 * np.eye(6)[None], 2, axis=0)
    keep[1, 2:4] = 0.0
    shifts = []
    for _ in range(4000):
        error = 4.0 * model.sigma * rng.normal(size=model.sigma.shape)
        prior_error = np.sqrt(0.3) * rng.normal(size=(2, 6))  # information times an error of 1 / 0.3
        found = separate(model.pull(error), model.information, 16.0 * model.information, keep, known, prior_error)
        shifts.append(found.shift)
    for k in range(2):
        sampled = np.cov(np.array(shifts)[:, k].T)
        ratio = np.linalg.eigvals(np.linalg.solve(found.covariance[k], sampled)).real
        assert ratio.min() > 0.85 and ratio.max() < 1.15


def test_without_anything_that_determines_a_direction_there_is_no_refit():
    model = Model(np.random.default_rng(5))
    nothing = np.zeros((1, 6, 6))
    with pytest.raises(np.linalg.LinAlgError):
        separate(np.zeros((9, 6)), model.information, model.information, np.zeros((1, 9)), nothing, np.zeros((1, 6)))


def test_a_length_is_exceeded_as_probably_as_its_risk_was():
    risks = np.array([0.3, 1e-2, 1e-5, 1e-9])
    for variances in VARIANCES:
        tails = Tails.of(np.repeat(turned(variances)[None], len(risks), axis=0))
        np.testing.assert_allclose(beyond(tails, tails.radius(risks)), risks, rtol=0.02)
        assert (beyond(tails, np.array([-1.0, -1e-9, 0.0, 0.0])) == 1.0).all()


def exact_model(count: int) -> np.ndarray:
    return np.zeros((count, 1, 6))


def level(fits: Separation, prior: np.ndarray, risk: float, inflation: float = 1.0) -> tuple[float, float, int]:
    """Of position and rotation, and the number of the hypothesis that the position's owes most to."""
    called, alike = np.arange(len(prior)), np.zeros((0, 6))
    return absolute_level((*fits, prior, called, called), len(prior), alike, np.zeros(2), limits_of(risk, inflation))


def level_along_x(prior: list[float], away: list[float], sigma: list[float], risk: float) -> tuple[float, float, int]:
    """Of hypotheses whose fits are ``away`` along x, with errors along x alone."""
    shift, covariance = np.zeros((len(prior), 6)), np.zeros((len(prior), 6, 6))
    shift[:, 0], covariance[:, 0, 0] = away, np.square(sigma)
    covariance[:, range(3, 6), range(3, 6)] = 9.0
    return level(Separation(shift, covariance, exact_model(len(prior))), np.array(prior), risk)


def test_one_hypothesis_takes_all_of_the_risk():
    position, rotation, number = level_along_x([0.02], [3.0], [2.0], 1e-3)
    assert position == pytest.approx(3.0 + 2.0 * stats.chi2.isf(0.05, 1) ** 0.5, rel=LEVEL_TOLERANCE_RATIO - 1.0 + 5e-3)
    assert rotation == pytest.approx(3.0 * stats.chi2.isf(0.05, 3) ** 0.5, rel=LEVEL_TOLERANCE_RATIO - 1.0 + 3e-3)
    assert number == 0


@pytest.mark.parametrize("risk", [1e-2, 1e-3, 1e-5, 1e-7])
def test_all_hypotheses_together_exceed_a_level_with_the_stated_risk(risk: float):
    """By the normal distribution, each error along one line: the sum is the risk, or the level 2 % too long."""
    prior, away, sigma = [1.0, 1e-2, 1e-2, 1e-3], [0.0, 0.5, 0.1, 4.0], [0.2, 0.4, 1.0, 0.3]
    rows = list(zip(prior, away, sigma, strict=True))
    level_m, _, number = level_along_x(prior, away, sigma, risk)

    def beyond(length: float) -> float:
        each = [p * 2.0 * stats.norm.sf((length - a) / s) if length > a else p for p, a, s in rows]
        return float(sum(each))

    assert beyond(1.004 * level_m) <= risk * 1.02
    assert beyond(level_m / LEVEL_TOLERANCE_RATIO / 1.004) >= risk * 0.98
    owed = [p * stats.norm.sf((level_m - a) / s) for p, a, s in rows]
    assert number == int(np.argmax(owed))


def test_what_is_improbable_takes_its_part_of_the_risk_and_bounds_nothing():
    """A hypothesis that leaves everything open, half as probable as the risk: the others have the other half."""
    both, _, _ = level_along_x([1.0, 5e-6], [0.0, 0.0], [1.0, 1e4], 1e-5)
    assert both == pytest.approx(stats.norm.isf(0.25e-5), rel=LEVEL_TOLERANCE_RATIO - 1.0 + 5e-3)
    open_wide, _, number = level_along_x([1.0, 2e-5], [0.0, 0.0], [1.0, 1e4], 1e-5)
    assert open_wide > 5e3 and number == 1
    nothing = level_along_x([1e-7], [5.0], [1.0], 1e-5)
    assert nothing == (0.0, 0.0, -1)
    rare = level_along_x([1.0, 1e-7], [0.0, 5.0], [1.0, 1.0], 1e-5)
    assert rare[0] < 4.6, "too improbable to be reckoned with"


def test_levels_take_position_and_rotation_alone():
    covariance = np.zeros((1, 6, 6))
    covariance[:, range(6), range(6)] = [4.0, 0.0, 0.0, 9.0, 9.0, 9.0]
    covariance[:, 0, 3] = covariance[:, 3, 0] = 1.0  # errors that belong together change neither part
    shift = np.array([[3.0, 0.0, 4.0, 0.0, -2.0, 0.0]])
    fits = Separation(shift, covariance, exact_model(1))
    position, rotation, _ = level(fits, np.ones(1), 1e-3, 1.5)
    assert position == pytest.approx(5.0 + 1.5 * 2.0 * stats.chi2.isf(1e-3, 1) ** 0.5, rel=0.025)
    assert rotation == pytest.approx(2.0 + 1.5 * 3.0 * stats.chi2.isf(1e-3, 3) ** 0.5, rel=0.025)


# --- the promise ---

NAMES = ("a_out", "a_in", "a_tip", "a_side", "b_out", "b_in", "b_tip", "b_side", "b_back")
SAID = tuple(f"edge {name}" for name in NAMES)
FINGERS = ("finger a", "finger b")
FINGER_OF = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1])
ALONG = np.array([True, True, False, False, True, True, False, False, False])
INNER = np.array(["_in" in name for name in NAMES])
NO_EDGE = np.zeros(9, dtype=bool)


def of_two_fingers(has_opening: bool = False) -> Hypotheses:
    return hypotheses_of(SAID, FINGER_OF, FINGERS, ALONG, INNER, has_opening)


def promised(found: Separation, hypotheses: Hypotheses, risk: float) -> float:
    """The bound of the position: the first fit is published."""
    found = found._replace(shift=found.shift - found.shift[0])
    return level(found, hypotheses.prior, risk)[0]


def exceeded(model: Model, hypotheses: Hypotheses, risk: float, trials: int, bias: np.ndarray, seed: int) -> float:
    """Share of trials whose error is beyond the bound, with errors (v, rows) on top of the noise."""
    rng, count = np.random.default_rng(seed), len(hypotheses.prior)
    known = np.repeat(1e-6 * np.eye(6)[None], count, axis=0)
    noise = model.sigma * rng.normal(size=(trials, *model.sigma.shape))
    beyond = 0
    for error in noise:
        pull = model.pull(error + bias)
        found = separate(pull, model.information, model.information, hypotheses.keep, known, np.zeros((count, 6)))
        beyond += float(np.linalg.norm(found.shift[0, :3])) > promised(found, hypotheses, risk)
    return beyond / trials


LINEAR = Model(np.random.default_rng(6), rows=12)
DOUBTED = [k for k, name in enumerate(of_two_fingers().name) if "edge" in name]


@pytest.mark.parametrize("risk", [1e-1, 1e-2])
def test_with_nothing_wrong_errors_exceed_the_bound_no_more_often_than_stated(risk: float):
    trials = 5000
    hypotheses = of_two_fingers()
    share = exceeded(LINEAR, hypotheses, risk, trials, np.zeros((9, 12)), seed=7)
    assert share <= risk + 3.0 * np.sqrt(risk / trials)


@pytest.mark.parametrize("risk", [1e-3, 3e-4])
def test_one_wrong_edge_exceeds_the_bound_as_seldom_as_its_prior_allows(risk: float):
    """Times its prior, its errors beyond the bound are within the risk, from a bias that hides in the noise to one that
    no one can miss.
    """
    hypotheses, trials = of_two_fingers(), 300
    allowed = risk / WRONG_EDGE
    for k in DOUBTED:
        edge = int(np.flatnonzero(hypotheses.keep[k] == 0.0)[0])
        for size in (0.3, 1.0, 2.0, 4.0, 30.0):
            bias = np.zeros((9, 12))
            bias[edge] = size
            share = exceeded(LINEAR, hypotheses, risk, trials, bias, seed=8 + k)
            assert share <= allowed + 4.0 * np.sqrt(allowed / trials)


@pytest.mark.parametrize("risk", [1e-2, 1e-3])
def test_where_edges_err_as_often_as_their_prior_says_the_bound_holds_as_stated(risk: float):
    """Over all that may happen: each edge is something else with the probability that is reckoned with."""
    hypotheses, trials, rng = of_two_fingers(), 6000, np.random.default_rng(12)
    count, beyond = len(hypotheses.prior), 0
    known = np.repeat(1e-6 * np.eye(6)[None], count, axis=0)
    for _ in range(trials):
        error = LINEAR.sigma * rng.normal(size=LINEAR.sigma.shape)
        wrong = rng.uniform(size=9) < WRONG_EDGE
        error[wrong] += rng.uniform(-6.0, 6.0, (int(wrong.sum()), 1))
        pull = LINEAR.pull(error)
        found = separate(pull, LINEAR.information, LINEAR.information, hypotheses.keep, known, np.zeros((count, 6)))
        beyond += float(np.linalg.norm(found.shift[0, :3])) > promised(found, hypotheses, risk)
    assert beyond / trials <= risk + 3.0 * np.sqrt(risk / trials)


def test_an_edge_that_errs_is_beyond_a_bound_that_reckons_with_nothing():
    """What the one before must be able to see."""
    blind = hypotheses_of(SAID, np.zeros(9, dtype=int), ("finger a",), np.ones(9, bool), NO_EDGE, False)
    hypotheses = of_two_fingers()
    blind = Hypotheses(blind.name[:1], blind.prior[:1], blind.keep[:1], blind.opening[:1], blind.sudden[:1], 0)
    bias = np.zeros((9, 12))
    bias[2] = 4.0
    assert exceeded(LINEAR, blind, 1e-2, 200, bias, seed=9) > 0.8
    assert exceeded(LINEAR, hypotheses, 1e-2, 200, bias, seed=9) < 0.1


# --- what may be wrong ---


def test_hypotheses_doubt_what_their_names_say():
    found = of_two_fingers(has_opening=True)
    doubted = {
        name: {NAMES[e] for e in np.flatnonzero(keep == 0.0)} for name, keep in zip(found.name, found.keep, strict=True)
    }
    a, b = set(NAMES[:4]), set(NAMES[4:])
    expected = {"nothing is wrong": set()}
    expected |= {f"edge {name} belongs to something else": {name} for name in NAMES}
    expected |= {
        "the ends of finger a belong to something else": {"a_tip", "a_side"},
        "the ends of finger b belong to something else": {"b_tip", "b_side", "b_back"},
        "finger a is not where its model says": a,
        "finger b is not where its model says": b,
        "the fingers' inner edges belong to what is grasped": {"a_in", "b_in"},
        "the fingers' outer edges belong to something beside them": {"a_out", "b_out"},
        "the jaw opening is wrong": set(),
        "what looks like the fingers' ends is something else": {
            n for n, along in zip(NAMES, ALONG, strict=True) if not along
        },
    }
    assert doubted == expected
    prior = dict(zip(found.name, found.prior.tolist(), strict=True))
    assert prior["nothing is wrong"] == prior["what looks like the fingers' ends is something else"] == 1.0
    assert {p for n, p in prior.items() if n.startswith("edge ")} == {WRONG_EDGE}
    assert {p for n, p in prior.items() if n.startswith("the ends of")} == {WRONG_EDGE}
    assert {p for n, p in prior.items() if n.startswith("finger ")} == {WRONG_GRIPPER}
    assert prior["the fingers' inner edges belong to what is grasped"] == WRONG_EDGE
    assert prior["the fingers' outer edges belong to something beside them"] == WRONG_EDGE
    assert prior["the jaw opening is wrong"] == WRONG_GRIPPER


def test_hypotheses_know_what_kind_they_are():
    found = of_two_fingers(has_opening=True)
    assert [found.name[k] for k in np.flatnonzero(found.opening)] == ["the jaw opening is wrong"]
    assert {found.name[k] for k in np.flatnonzero(found.sudden)} == {
        "finger a is not where its model says",
        "finger b is not where its model says",
        "the fingers' inner edges belong to what is grasped",
        "the fingers' outer edges belong to something beside them",
        "what looks like the fingers' ends is something else",
    }
    assert found.name[0] == "nothing is wrong"
    assert found.name[found.ends] == "what looks like the fingers' ends is something else"
    np.testing.assert_array_equal(found.keep[found.ends], ALONG)
    assert not of_two_fingers().opening.any()


def test_without_ends_each_hypothesis_doubts_them_besides():
    every = of_two_fingers(has_opening=True)
    without = every.without_ends()
    more = without.more_than_ends
    np.testing.assert_array_equal(without.keep, every.keep * ALONG)
    np.testing.assert_array_equal(without.prior, every.prior)
    on_the_sides = [f"edge {name} belongs to something else" for name in ("a_out", "a_in", "b_out", "b_in")]
    fingers = [f"finger {name} is not where its model says" for name in "ab"]
    grasped = "the fingers' inner edges belong to what is grasped"
    outer = "the fingers' outer edges belong to something beside them"
    wrong = {*on_the_sides, *fingers, grasped, outer, "the jaw opening is wrong"}
    assert {every.name[k] for k in np.flatnonzero(more)} == wrong


def test_where_the_ends_are_something_else_an_edge_may_be_wrong_besides():
    """Of the sides one alone tells much of a motion along z.  If that is something else as well, which has moved with
    what looks like the ends, what reckons with one thing at a time states far too little.
    """
    every, risk, trials = of_two_fingers(), 1e-3, 100
    without = every.without_ends()
    more = without.more_than_ends
    both = Hypotheses(
        every.name + tuple(without.name[k] for k in np.flatnonzero(more)),
        *(
            np.concatenate([getattr(every, part), getattr(without, part)[more]])
            for part in ("prior", "keep", "opening", "sudden")
        ),
        every.ends,
    )
    model = Model(np.random.default_rng(6), rows=12, tells=np.where(ALONG & (np.array(NAMES) != "a_out"), 0.02, 1.0))
    moved = ~ALONG | (np.array(NAMES) == "a_out")
    bias = np.where(moved[:, None], 3.0 * model.jacobian[:, :, 2], 0.0)
    assert exceeded(model, every, risk, trials, bias, seed=21) > 0.9
    assert exceeded(model, both, risk, trials, bias, seed=21) == 0.0


def test_what_a_gripper_cannot_be_wrong_about_is_no_hypothesis():
    one = hypotheses_of(SAID[:3], np.zeros(3, dtype=int), FINGERS, ALONG[:3], INNER[:3], False)
    assert not any(name.startswith(("finger", "the ends of")) for name in one.name), "one finger, one edge at its end"
    assert len(one.name) == 1 + 3 + 1 and one.keep.shape == (5, 3)
    every = hypotheses_of(SAID, FINGER_OF, FINGERS, np.ones(9, dtype=bool), NO_EDGE, False)
    np.testing.assert_array_equal(every.keep[every.ends], 1.0)


def test_that_a_lone_fingers_ends_are_something_else_is_one_hypothesis():
    """That of all ends, which isn't where their corners are seen and something is known of where it was."""
    hypotheses = hypotheses_of(SAID[:4], np.zeros(4, dtype=int), ("finger a",), ALONG[:4], INNER[:4], False)
    doubting_all = [k for k, keep in enumerate(hypotheses.keep) if not keep[~ALONG[:4]].any()]
    assert doubting_all == [hypotheses.ends] and hypotheses.sudden[hypotheses.ends]
    assert {f"edge {name} belongs to something else" for name in NAMES[:4]} <= set(hypotheses.name)
    tip = hypotheses_of(SAID[:3], np.zeros(3, dtype=int), ("finger a",), ALONG[:3], INNER[:3], False)
    doubting_all = [k for k, keep in enumerate(tip.keep) if not keep[~ALONG[:3]].any()]
    assert doubting_all == [tip.ends], "of one edge at its end, too"
