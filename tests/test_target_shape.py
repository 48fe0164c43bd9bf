"""Targets that aren't flat: fitted with their shape, or with an error that covers it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.sightings import CAMERAS, PLATE_M, part_of, poses, seen

from gripmon.calibrate.bundle import BundleProblem
from gripmon.calibrate.cross_validation import cross_validate, with_scatter
from gripmon.calibrate.intrinsics import IntrinsicsResult, calibrate
from gripmon.calibrate.lens_models import LensModel, lens_vector
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.target_shape import TargetPoints, off_plane_m
from gripmon.model.geometry import exp_rotation
from gripmon.model.records import Array

MODEL = "brown_conrady"
CAMERA = CAMERAS[MODEL]
TRUE = lens_vector(CAMERA)
X, Y = (PLATE_M[:, k] / PLATE_M[:, k].max() - 0.5 for k in (0, 1))
TWISTED = np.stack([0 * X, 0 * X, 0.002 * X * Y + 0.0006 * X**2], axis=1)
"""Its corners lie half a millimetre off a plane: a sheet of 160 x 120 mm on a box."""


def leaning(rng: np.random.Generator, count: int) -> list[Array]:
    """A plate that leans backward in all images, as one that stands on a table does."""
    out = poses(rng, count)
    for T in out:
        middle = T[:3, :3] @ PLATE_M.mean(axis=0) + T[:3, 3]
        T[:3, :3] = exp_rotation(np.array([rng.uniform(0.45, 0.9), *rng.uniform(-0.3, 0.3, 2)]))
        T[:3, 3] = middle - T[:3, :3] @ PLATE_M.mean(axis=0)
    return out


def twisted(seed: int, *, turns: int, count: int = 16) -> list[Sighting]:
    rng = np.random.default_rng(seed)
    held = leaning(rng, count)
    return seen(CAMERA, held, rng, noise_px=0.05, displacement_m=TWISTED, turns=turns)


LOPSIDED = np.stack([0.0003 * Y, 0 * X, 0.0008 * X**2 + 0.002 * X**3 + 0.001 * Y**3], axis=1)
"""Another shape after half a turn, and after a quarter."""


def in_sigmas(found: IntrinsicsResult) -> Array:
    """Errors of the pinhole's four parameters over their standard deviations."""
    return (lens_vector(found.camera) - TRUE)[:4] / np.sqrt(found.covariance.diagonal())[:4]


def test_the_shape_is_estimated_where_every_image_tells_the_points(monkeypatch: pytest.MonkeyPatch):
    """Images that don't would hold their points flat, with all their weight; a fit that fails costs no camera."""
    views = twisted(0, turns=1)
    some = [*views[:10], *(replace(view, turns=0) for view in views[10:])]
    for given, words in ((some, "as 10 of these 16 do"), (views, "its shape couldn't be estimated")):
        if given is views:
            monkeypatch.setattr(BundleProblem, "solve", only_of_flat_ones(BundleProblem.solve))
        found = calibrate(given, MODEL)
        assert found.target is None
        np.testing.assert_allclose(
            lens_vector(found.camera), lens_vector(calibrate(given, MODEL, exact_target=True).camera)
        )
        assert any("isn't flat and exact" in warning and words in warning for warning in found.warnings)


def only_of_flat_ones(solve: Callable[..., Any]) -> Callable[..., Any]:
    def solved(problem: BundleProblem, *start: Any) -> Any:
        if problem._target is not None:
            raise CalibrationError("37 of 56 points contradict the other images")
        return solve(problem, *start)

    return solved


def test_a_twisted_target_gives_the_camera_and_its_own_shape():
    """With an exact one assumed, the same images are wrong by ten of their standard deviations."""
    squares = []
    for seed in range(4):
        views = twisted(seed, turns=1)
        found = calibrate(views, MODEL)
        assert found.target is not None and 0.04 < found.rms_px < 0.055
        assert any("isn't flat and exact" in warning for warning in found.warnings)
        off_m = off_plane_m(found.target.places_m, found.displacement_m)
        assert off_m == pytest.approx(off_plane_m(PLATE_M, TWISTED), rel=0.1)
        error = lens_vector(found.camera)[list(range(8))] - TRUE
        squares.append(error @ np.linalg.solve(found.covariance, error) / len(error))
    assert 0.4 < np.mean(squares) < 1.95  # 32 degrees of freedom: 0.42 to 1.93 in 99.9 %
    flat = calibrate(twisted(0, turns=1), MODEL, exact_target=True)
    assert np.abs(in_sigmas(flat)).max() > 10.0


def as_numbered(view: Sighting, turns: int, number: int) -> Sighting:
    """By an image that doesn't tell which of so many turns its points have."""
    about = np.array([0.08 if turns == 2 else 0.06, 0.06, 0.0])
    turn = exp_rotation(np.array([0.0, 0.0, 2.0 * np.pi * number / turns]))
    return replace(view, plate_m=(view.plate_m - about) @ turn.T + about, turns=turns)


@pytest.mark.parametrize("turns", [2, 4])
def test_whole_views_of_an_unmarked_target_are_numbered_alike(turns: int):
    """Each may be turned by half, or on a square target by a quarter; numbered as they come, they hold a mixture."""
    rng = np.random.default_rng(3)
    told = seen(CAMERA, leaning(rng, 14), rng, noise_px=0.05, displacement_m=LOPSIDED, turns=1)
    if turns == 4:
        told = [part_of(view, 0.12, 0.12) for view in told]
    views = [as_numbered(view, turns, int(rng.integers(turns))) for view in told]
    right, found = calibrate(told, MODEL), calibrate(views, MODEL)
    assert right.target is not None and found.target is not None
    assert found.rms_px == pytest.approx(right.rms_px, rel=1e-3) and 0.04 < found.rms_px < 0.055
    np.testing.assert_allclose(lens_vector(found.camera), lens_vector(right.camera), rtol=1e-3, atol=1e-4)
    assert np.abs(in_sigmas(found)).max() < 4.0
    # A view that had no part in it is numbered like the others, too.
    assert cross_validate(found).rms_px == pytest.approx(cross_validate(right).rms_px, rel=0.01)


@pytest.mark.parametrize("step_m", [0.02, 0.0254 / 3.0, 0.0238125, 0.211 / 9.0, 0.034925])
@pytest.mark.parametrize(("columns", "rows", "turns"), [(9, 7, 2), (8, 6, 2), (8, 8, 4)])
def test_no_point_is_lost_by_a_turn_whatever_the_step_is(step_m: float, columns: int, rows: int, turns: int):
    """Of 8 x 6 points 23.8125 mm apart (15/16 inch), which end between two micrometres, 39 of 48 were."""
    v, u = np.divmod(np.arange(columns * rows), columns)
    plate_m = step_m * np.column_stack([u, v, np.zeros(len(u))])
    n = len(plate_m)
    view = Sighting(np.zeros((n, 2)), plate_m, np.zeros((n, 2, 2)), (640, 480), turns=turns)
    target = TargetPoints.of([view] * 4)
    assert target is not None and len(target.places_m) == columns * rows
    for number in range(turns):
        turn = target.turned(turns, number)
        turned = target.numbers(target.places_m @ turn[:3, :3].T + turn[:3, 3])
        assert sorted(turned.tolist()) == list(range(columns * rows))


@pytest.mark.parametrize("turns", [1, 2])
def test_an_exact_target_is_taken_for_one(turns: int):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        views = seen(CAMERA, leaning(rng, 12), rng, noise_px=0.05, turns=turns)
        found = calibrate(views, MODEL)
        assert found.target is None and not any("flat" in warning for warning in found.warnings)
        again = with_scatter(found, cross_validate(found))
        assert np.array_equal(again.covariance, found.covariance) and again.warnings == found.warnings


def test_where_the_images_dont_tell_which_point_is_which_the_error_is_enlarged():
    """By what parts of the views differ; what is wrong in all of them alike doesn't show in that."""
    for seed in range(2):
        views = twisted(seed, turns=0)
        found = calibrate(views, MODEL)
        assert found.target is None and np.abs(in_sigmas(found)).max() > 5.0
        covered = with_scatter(found, cross_validate(found))
        assert np.abs(in_sigmas(covered)).max() < 0.4 * np.abs(in_sigmas(found)).max()
        assert any("differ more than their errors allow" in warning for warning in covered.warnings)


def test_views_that_had_no_part_in_the_fit_have_the_shape_that_was_found_without_them():
    views = twisted(0, turns=1)
    assert cross_validate(calibrate(views, MODEL)).rms_px == pytest.approx(0.05, rel=0.1)


def test_the_right_hand_side_is_the_costs_slope():
    """Of all unknowns: lens, poses, displacements."""
    views = twisted(1, turns=1, count=4)
    model = LensModel(MODEL, *views[0].size_px)
    target = TargetPoints.of(views)
    assert target is not None
    problem, rng = BundleProblem(model, views, np.eye(8), target=target), np.random.default_rng(0)
    at = TRUE, [T.copy() for T in calibrate(views, MODEL).cam_T_plate], rng.normal(0.0, 1e-4, (63, 3))
    weights = [np.linspace(0.2, 1.0, len(view)) for view in views]
    normal, side = problem._equations(at, weights)
    assert np.allclose(normal, normal.T) and len(side) == 8 + 6 * 4 + 3 * 63
    for k in (0, 3, 5, *rng.integers(0, 3 * 63, 12) + 8 + 6 * 4):
        step = np.zeros(len(side))
        step[k] = 1e-7 if k > 7 else 1e-4 * max(abs(TRUE[k]), 1e-2)
        costs = [
            problem._cost((at[0] + s * step[:8], at[1], at[2] + s * step[8 + 24 :].reshape(-1, 3)), weights)
            for s in (1.0, -1.0)
        ]
        assert (costs[1] - costs[0]) / (4.0 * step[k]) == pytest.approx(side[k], rel=1e-4)
