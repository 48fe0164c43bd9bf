"""How a lattice bends in its image, against steps and opposite steps sent through the camera."""

from __future__ import annotations

import numpy as np
import pytest
from support.plates import pose, true_uv
from support.simulated import PAPER_LENS, STRONG_LENS

from gripmon.calibrate.chequers import FEWEST, bends
from gripmon.model.camera import FisheyeLens, LensSettings
from gripmon.model.targets import Chequerboard

BOARD = Chequerboard(9, 7, 0.01)
FISHEYE = FisheyeLens(
    width_px=768, height_px=576, fx_px=420.0, fy_px=421.0, cx_px=370.0, cy_px=295.0,
    coefficients=(-0.01, 0.003, -0.001, 0.0),
)  # fmt: skip
CELLS = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2)


def image_of(lens: LensSettings, cells: np.ndarray) -> np.ndarray:
    cam_T_plate = pose(BOARD, [0.006, -0.004, 0.1 * lens.fx_px / 760.0], [0.45, -0.3], 0.4)
    return true_uv(lens, cam_T_plate, np.column_stack([0.01 * cells, np.zeros(len(cells))]))


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS, FISHEYE], ids=["paper", "strong", "fisheye"])
def test_opposite_steps_meet_where_they_should(lens: LensSettings):
    size = (lens.width_px, lens.height_px)
    at = image_of(lens, CELLS)
    noisy = at + np.random.default_rng(1).normal(0.0, 0.02, at.shape)
    found = bends(CELLS, noisy, size)
    largest = 0.0
    for step in (np.array([0.25, 0.0]), np.array([0.0, 0.25]), np.array([0.2, -0.2])):
        plus, minus = image_of(lens, CELLS + step), image_of(lens, CELLS - step)
        x, y = (0.5 * (plus - minus)).T
        q = np.einsum("kn,nki->ni", np.stack([x * x, x * y, y * y]), found)
        true = 0.5 * (plus + minus) - at
        off, size_px = np.abs(q - true), np.abs(true).max()
        assert np.median(off) < 0.003 + 0.02 * size_px and off.max() < 0.01 + 0.2 * size_px
        largest = max(largest, float(np.abs(true).max()))
    assert largest > 0.08, "there is something to be found"


def test_a_few_wrong_points_and_hidden_ones_hardly_matter():
    at = image_of(STRONG_LENS, CELLS)
    clean = bends(CELLS, at, (768, 576))
    seen = np.random.default_rng(2).permutation(len(CELLS))[:40]
    wrong = at[seen].copy()
    wrong[:2] += [2.0, -1.5]
    np.testing.assert_allclose(
        bends(CELLS[seen], wrong, (768, 576))[2:], clean[seen][2:], atol=0.1 * np.abs(clean).max()
    )


def test_points_that_dont_tell_bend_nothing():
    at = image_of(STRONG_LENS, CELLS)
    assert not bends(CELLS[: FEWEST - 1], at[: FEWEST - 1], (768, 576)).any()
    assert not bends(CELLS[:9], at[:9], (768, 576)).any(), "all on a line"
