"""The compiled fit against the same in NumPy: same points, same decisions, numbers equal to rounding."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from support.box_models import cube_model
from support.by_numpy import fit as by_numpy
from support.by_numpy import prediction as by_numpy_prediction
from support.by_numpy import profiles as by_numpy_profiles
from support.grippers import gripper_from_dict
from support.meters import measure, meter, moved, picture
from support.simulated import plain_scenario
from test_golden import measured
from test_robust_fit import (
    CAMERA,
    EDGES,
    GRIPPER,
    PREDICTION,
    PRIOR,
    SAMPLED,
    SETTINGS,
    XI,
    candidates,
    true_candidates,
    votes_for,
    with_background_edge,
    with_clutter,
)

from gripmon.track.edges import (
    FingertipMeter,
    MeasurementSettings,
    agreeing_fingers,
    edge_residuals_px,
    evidence,
    kernel,
    lines,
    prediction,
    prediction_kernel,
    profile_kernel,
    robust_fit,
    settling,
    warm_up_fit,
    warm_up_geometry,
    warm_up_profiles,
)
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import RESTART_WIDTH_PX, Prior, assess, contradictions_without, fit_irls

CLOSE = 1e-9


def many_votes() -> list[Edgels]:
    """Edges alone, in clutter, behind an edge of the background; with polarity, spreads and cut-off edges."""
    rng = np.random.default_rng(21)
    found = [true_candidates(rng, sigma) for sigma in (0.0, 0.05, 0.3)]
    found += [with_clutter(rng, missing, extra) for missing in (0.0, 0.3, 0.8) for extra in (0.0, 0.5, 2.0)]
    found += [with_background_edge(int(edge), 1.5, seen) for edge in SAMPLED[:4] for seen in (False, True)]
    edgels = [votes_for(f) for f in found]
    polarity = np.where(np.arange(EDGES) % 3 == 0, 1, 0).astype(np.int8)
    for f in found:
        mixed = replace(
            f,
            sigma_px=rng.uniform(0.02, 0.4, len(f.sample)),
            step=rng.choice([-40.0, 40.0], len(f.sample), p=[0.2, 0.8]),
            zoom=int(rng.choice([1, 2, 4])),
        )
        spread_px, cut_off_px = rng.uniform(0.0, 0.1, EDGES), rng.uniform(0.0, 0.2, EDGES)
        edgels.append(replace(votes_for(mixed, polarity=polarity, edge_spread_px=spread_px), cut_off_px=cut_off_px))
    return edgels


VOTES = many_votes()
NOTHING = votes_for(candidates(np.arange(0), np.zeros(0)))
HARDLY = [votes_for(candidates(np.arange(count), np.full(count, 0.3))) for count in (3, 6)]
RIGID = replace(PREDICTION, jacobian=np.ascontiguousarray(PREDICTION.jacobian[:, :6]))
"""The same edges of a gripper without a jaw: six unknowns."""


def prior(unknowns: int, jaw_sigma_m: float = 1e-4, opened_m: float = 0.0) -> Prior:
    information = PRIOR[:unknowns].copy()
    information[6:] = jaw_sigma_m**-2
    return Prior(np.array([0.0] * 6 + [opened_m])[:unknowns], information)


def cases() -> Iterator[tuple[Edgels, Prior, np.ndarray]]:
    rng = np.random.default_rng(22)
    for edgels in (*VOTES, *HARDLY, NOTHING):
        for start in (np.zeros(7), 0.5 * XI, XI + rng.normal(size=7) * [2e-4, 2e-4, 2e-4, 2e-3, 2e-3, 2e-3, 1e-4]):
            yield edgels, prior(7), start
        yield edgels, prior(7, 1e-6, 2e-5), np.zeros(7)
        yield edgels, prior(7, 0.02), np.zeros(7)
        yield replace(edgels, prediction=RIGID), prior(6), np.zeros(6)


def assert_alike(one: object, other: object, unit: np.ndarray, condition: float) -> None:
    """Every field of two records: decisions equal, numbers within :data:`CLOSE` of the largest in their field.

    ``unit`` (m,) makes the unknowns comparable with each other: by how much they are uncertain.  ``condition`` of the
    normal matrix in these units: rounding grows with it where a handful of points hardly determines the motion.
    """
    close = CLOSE * max(1e-4 * condition, 1.0)
    scale = {
        "xi": 1.0 / unit,
        "pull": unit,
        "information": np.outer(unit, unit),
        "middle": np.outer(unit, unit),
        "covariance": 1.0 / np.outer(unit, unit),
    }
    for field in fields(one):  # type: ignore[arg-type]
        if field.name == "normal":
            assert_alike(one.normal, other.normal, unit, condition)  # type: ignore[attr-defined]
            continue
        left, right = np.asarray(getattr(one, field.name)), np.asarray(getattr(other, field.name))
        assert left.shape == right.shape and left.dtype == right.dtype, field.name
        if left.dtype.kind == "f":
            by = scale.get(field.name, 1.0)
            most = close * max(float(np.abs(right * by).max(initial=0.0)), 1e-3)
            np.testing.assert_allclose(left * by, right * by, rtol=0.0, atol=most, err_msg=field.name)
        else:
            np.testing.assert_array_equal(left, right, err_msg=field.name)


def test_the_compiled_fit_and_covariance_are_those_of_numpy():
    for edgels, known, start in cases():
        expected = by_numpy.fit_irls(edgels, known, start, SETTINGS)
        assert_same_fit(edgels, known, start, None)
        assert_same_fit(edgels, known, expected.xi, RESTART_WIDTH_PX)


def assert_same_fit(edgels: Edgels, known: Prior, start: np.ndarray, width_px: float | None) -> None:
    expected = by_numpy.fit_irls(edgels, known, start, SETTINGS, width_px)
    unit = 1.0 / np.sqrt(np.diag(expected.information) + known.information)
    normal = expected.information + np.diag(known.information)
    condition = float(np.linalg.cond(normal * np.outer(unit, unit)))
    assert_alike(fit_irls(edgels, known, start, SETTINGS, width_px), expected, unit, condition)
    for shared_px in (0.0, 0.2):
        one, other = (f(edgels, expected, known.information, shared_px) for f in (assess, by_numpy.assess))
        assert_alike(one, other, unit, condition)


def test_the_compiled_fits_without_one_edge_are_those_of_numpy():
    for edgels, known, start in list(cases())[::7]:
        stays = contradictions_without(edgels, known, start, SETTINGS)
        expected = by_numpy.contradictions_without(edgels, known, start, SETTINGS)
        assert len(stays) == len(SAMPLED)
        np.testing.assert_allclose(stays, expected, rtol=1e-8)


def test_what_can_not_be_solved_is_an_error():
    """No candidates and a prior that holds nothing: all of these have a normal matrix of zeros."""
    nothing = Prior(np.zeros(7), np.zeros(7))
    for fit in (fit_irls, by_numpy.fit_irls):
        with pytest.raises(FloatingPointError, match="not positive definite"):
            fit(NOTHING, nothing, np.zeros(7), SETTINGS)
    empty = fit_irls(NOTHING, prior(7), np.zeros(7), SETTINGS)
    for covariance in (assess, by_numpy.assess):
        with pytest.raises(FloatingPointError, match="not positive definite"):
            covariance(NOTHING, empty, np.zeros(7))
    for without in (contradictions_without, by_numpy.contradictions_without):
        with pytest.raises(FloatingPointError, match="not positive definite"):
            without(NOTHING, nothing, np.zeros(7), SETTINGS)


def test_what_is_read_off_a_measurement_is_what_numpy_reads():
    """Motion of the edges, blur, shares of the fingers, residuals of the edges and of the corners."""
    image = picture(plain_scenario()).copy()
    image[:, :250] = 90
    using = meter()
    found = measure(image, using=using)
    consensus, candidates, sampled = found.consensus, found.candidates, found.prediction
    for xi in (XI, XI[:6], -XI):
        assert sampled.moved_px(xi) == pytest.approx(np.abs(sampled.jacobian[:, : len(xi)] @ xi).max(), rel=CLOSE)
    widths_px = np.sort(candidates.width_px[consensus.weight > 0.0])
    kernel_px = candidates.zoom * MeasurementSettings().edges.blur_px
    assert found.blur_px == pytest.approx(np.sqrt(widths_px[len(widths_px) // 2] ** 2 - kernel_px**2), rel=CLOSE)
    finger = GRIPPER.edge_finger[sampled.layout.edge]
    shares = [consensus.supported[finger == f].sum() / sampled.ok[finger == f].sum() for f in (0, 1)]
    assert agreeing_fingers(found, GRIPPER) == pytest.approx(shares, rel=CLOSE) and min(shares) < 0.8 < max(shares)
    residual_px, edge = edge_residuals_px(found, GRIPPER), sampled.layout.edge[candidates.sample]
    for e in range(EDGES):
        own = (edge == e) & (consensus.weight > 0.0)
        mean = np.average(consensus.residual_px[own], weights=consensus.weight[own]) if own.any() else np.nan
        assert residual_px[e] == pytest.approx(mean, abs=CLOSE, nan_ok=True)
    pose = moved(found.cam_T_grip, np.array([1e-4, 2e-4, -1e-4, 1e-3, 2e-3, 3e-3]))
    points_grip_m = GRIPPER.points_grip_m(found.jaw_opening_m)[GRIPPER.corner_points]
    points = points_grip_m @ pose[:3, :3].T + pose[:3, 3]
    miss_px = np.einsum("cij,cj->ci", sampled.corners.d_uv_d_xy, found.corners.xy - points[:, :2] / points[:, 2:])
    rms_px = np.sqrt((miss_px[found.corners.usable] ** 2).sum(axis=1).mean())
    assert found.corner_rms_px(pose) == pytest.approx(rms_px, rel=1e-3)  # the jaw's motion is linear there


ENTRIES = {
    "fit", "assess", "contradictions_without", "read_profiles", "low_third_difference", "find_candidates", "worth",
    "_fit_lines", "_intersect", "largest_motion", "usual_width", "corner_rms", "agreeing_shares", "edge_means",
    "sampled_ranges", "levers", "across_edges", "maps", "ideal_lines", "gains",
}  # fmt: skip


def signatures() -> dict[str, int]:
    """For how many combinations of types each function that Python calls is compiled."""
    rooms = (kernel, profile_kernel, lines, prediction, prediction_kernel, settling, evidence)
    functions = {name: f for room in rooms for name, f in vars(room).items() if hasattr(f, "signatures")}
    return {name: len(functions[name].signatures) for name in ENTRIES}


def test_after_warming_up_no_frame_waits_for_the_compiler():
    """Whatever the gripper and the image: with a jaw and without, in colour, that may not be written to."""
    warm_up_profiles()
    warm_up_fit()
    warm_up_geometry()
    before = signatures()
    assert min(before.values()) >= 1
    clear = picture(plain_scenario())
    covered = clear.copy()
    covered[:, :300] = 90
    for image in (clear, covered, np.dstack([clear] * 3)[:, :, ::-1]):
        found = measure(image)
        found.corner_rms_px(found.cam_T_grip)
        agreeing_fingers(found, GRIPPER)
        edge_residuals_px(found, GRIPPER)
        measure(image, using=FingertipMeter(CAMERA, gripper_from_dict(cube_model()), MeasurementSettings(), 0.0))
    contradictions_without(VOTES[4], prior(7), np.zeros(7), SETTINGS)
    assert signatures() == before


MEASURE = """
import numba
import numpy as np
from test_golden import measured
found, _ = measured("clutter")
corners_px = np.nan_to_num(found.corners.uv_px)
print(int(numba.config.DISABLE_JIT), *found.cam_T_grip.ravel(), *found.covariance.ravel(), *corners_px.ravel())
"""


def test_what_is_compiled_measures_as_it_is_written():
    """A whole measurement in a cluttered image, to the last bits; with NUMBA_DISABLE_JIT the same functions run as
    Python, for a debugger.
    """
    found = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(Path(__file__).parent)}
        said = subprocess.run(
            [sys.executable, "-c", MEASURE], env=environment, capture_output=True, text=True, timeout=600, check=True
        )
        was_disabled, *numbers = said.stdout.split()
        assert was_disabled == disabled
        found.append(np.array(numbers, dtype=float))
    one, other = found
    assert len(one) > 60
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-24)


def test_numpy_measures_the_same(monkeypatch: pytest.MonkeyPatch):
    """A whole measurement in a cluttered image: pose to a picometre, corners to a millionth of a pixel."""
    one, _ = measured("clutter")
    for module, name, by in (
        (prediction, "prediction_kernel", by_numpy_prediction),
        (settling, "read_profiles", by_numpy_profiles.read_profiles),
        (settling, "find_candidates", by_numpy_profiles.find_candidates),
        (settling, "weigh", by_numpy_profiles.weigh),
        (settling, "fit_irls", by_numpy.fit_irls),
        (robust_fit, "fit_irls", by_numpy.fit_irls),
        (settling, "assess", by_numpy.assess),
    ):
        monkeypatch.setattr(module, name, by)
    other, _ = measured("clutter")
    assert not np.array_equal(one.cam_T_grip, other.cam_T_grip), "the same code twice"
    np.testing.assert_allclose(one.cam_T_grip, other.cam_T_grip, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(one.cam_T_grip[:3, 3], other.cam_T_grip[:3, 3], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-20)
    np.testing.assert_allclose(one.corners.uv_px, other.corners.uv_px, rtol=0.0, atol=1e-6)
