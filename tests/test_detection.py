"""Chequerboards in rendered images: where their corners are, to a few hundredths of a pixel, and what is no corner."""

from __future__ import annotations

import dataclasses
import re

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.plates import Look, fingers, points_of, pose, render, true_uv

from gripmon.calibrate.chequers import _Alternating
from gripmon.calibrate.detection import detect, ends_all_round
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings
from gripmon.model.records import Array, Image
from gripmon.model.targets import Chequerboard, parse_target

LENS = BrownConradyLens(
    width_px=640, height_px=480, fx_px=760.0, fy_px=761.0, cx_px=316.0, cy_px=244.0,
    coefficients=(-0.15, 0.05, 0.001, 0.0),
)  # fmt: skip
FISHEYE = FisheyeLens(
    width_px=640, height_px=480, fx_px=215.0, fy_px=215.0, cx_px=316.0, cy_px=244.0,
    coefficients=(0.02, -0.01, 0.003, -0.0004),
)  # fmt: skip
BOARD = Chequerboard(columns=9, rows=6, square_m=0.02)
HELD = pose(BOARD, (0.005, -0.003, 0.34), (0.35, -0.25), 0.5)
QUICK = Look(supersampling=2)


def found_in(image: Image, target: Chequerboard = BOARD) -> Sighting:
    sight = detect(image, target, "view")
    assert isinstance(sight, Sighting), sight
    return sight


def checked(sight: Sighting, settings: LensSettings, T: Array, target: Chequerboard = BOARD) -> Array:
    """Distances (n,) of the points to the true ones; the lattice must be the plate's, turned and shifted at most."""
    points = points_of(target)
    uv = true_uv(settings, T, points)
    distance, index = cKDTree(np.where(np.isfinite(uv), uv, -1e6)).query(sight.uv_px)
    design = np.column_stack([sight.plate_m[:, :2], np.ones(len(sight))])
    change, *_ = np.linalg.lstsq(design, points[index, :2], rcond=None)
    np.testing.assert_allclose(design @ change, points[index, :2], atol=1e-9)
    np.testing.assert_allclose(change[:2] @ change[:2].T, np.eye(2), atol=1e-9)
    assert np.linalg.det(change[:2]) > 0.0, "z points out of the plate"
    assert (sight.plate_m[:, 2] == 0.0).all() and len(set(index.tolist())) == len(sight)
    return distance


CONDITIONS = {
    "plain": (LENS, HELD, QUICK, 0.0, 54, 0.0043),
    "fingers over a third of the plate": (LENS, HELD, QUICK, 0.36, 30, 0.0042),
    "full of other corners": (LENS, HELD, Look(supersampling=2, clutter="mosaic"), 0.3, 36, 0.0045),
    "three quarters of the light gone on one side": (LENS, HELD, Look(supersampling=2, falloff=0.75), 0.25, 40, 0.0136),
    "blurred": (LENS, HELD, Look(supersampling=2, blur_px=2.2), 0.25, 40, 0.0216),
    "noisy": (LENS, HELD, Look(supersampling=2, noise=8.0), 0.25, 40, 0.0218),
    "light and dark exchanged": (LENS, HELD, Look(supersampling=2, inverted=True), 0.25, 40, 0.0039),
    "small squares": (LENS, pose(BOARD, (0.0, 0.0, 1.4), (0.4, 0.2), 0.2), Look(supersampling=4), 0.0, 54, 0.0074),
    "partly out of the image": (LENS, pose(BOARD, (0.05, 0.02, 0.2), (0.3, 0.3), 2.0), QUICK, 0.0, 20, 0.0041),
    "a fisheye": (FISHEYE, pose(BOARD, (0.0, 0.0, 0.075), (0.3, -0.3), 1.0), QUICK, 0.2, 30, 0.0055),
}


@pytest.mark.parametrize("condition", CONDITIONS)
def test_corners_are_found_where_they_are(condition: str):
    """To twice what was measured (root mean square, px, of two seeds): three times as far off is no accident."""
    settings, T, look, reach, least, rms_px = CONDITIONS[condition]
    image = render(settings, T, BOARD, look, covers=fingers(settings, reach) if reach else (), seed=2)
    sight = found_in(image)
    distance = checked(sight, settings, T)
    assert len(sight) >= least
    assert np.sqrt(np.mean(distance**2) / 2.0) < 2.0 * rms_px and distance.max() < 0.3
    assert sight.note == ("" if len(sight) == 54 else f"{len(sight)} of 54 points")
    assert len(set(map(tuple, sight.plate_m.tolist()))) == len(sight)


def test_the_stated_covariance_follows_the_noise():
    """Not of one image alone: the same view, drawn again with other noise."""
    for noise in (3.0, 9.0):
        errors = []
        for seed in range(3):
            image = render(LENS, HELD, BOARD, Look(supersampling=3, noise=noise, clutter="plain"), seed=seed)
            errors.append(found_in(image))
        a, b, c = (dict(zip(map(tuple, s.plate_m.tolist()), s.uv_px, strict=True)) for s in errors)
        shared = sorted(set(a) & set(b) & set(c))
        scatter = np.std([[d[i] for i in shared] for d in (a, b, c)], axis=0, ddof=1)
        stated = np.sqrt(np.mean([np.trace(s.covariance_px.mean(axis=0)) / 2.0 - 0.015**2 for s in errors]))
        assert 0.6 < np.sqrt(np.mean(scatter**2)) / stated < 1.4


def test_x_runs_along_the_columns_where_all_is_seen():
    for roll in (0.1, 1.6, 3.1, -1.6):
        sight = found_in(render(LENS, pose(BOARD, (0.0, 0.0, 0.36), (0.2, 0.1), roll), BOARD, QUICK))
        assert len(sight) == 54
        np.testing.assert_allclose(sight.plate_m.max(axis=0), [0.16, 0.1, 0.0])


@pytest.mark.parametrize("dtype", ["uint16 of 12 bits", "float of 0 to 1", "colour", "dark"])
def test_any_image_that_a_camera_delivers(dtype: str):
    grey = render(LENS, HELD, BOARD, QUICK)
    image: Image = {
        "uint16 of 12 bits": grey.astype(np.uint16) * 16,
        "float of 0 to 1": (grey / 255.0).astype(np.float32),
        "colour": np.dstack([grey, grey, grey]),
        "dark": (grey // 5).astype(np.uint8),
    }[dtype]
    distance = checked(found_in(image), LENS, HELD)
    assert len(distance) == 54 and distance.max() < 0.15


def test_a_small_board_and_a_large_image():
    small = parse_target("chequerboard:4x3:0.03")
    T = pose(small, (0.0, 0.0, 0.3), (0.3, 0.2), 0.4)
    assert len(checked(found_in(render(LENS, T, small, QUICK), small), LENS, T, small)) == 12
    large = BrownConradyLens(
        width_px=2448, height_px=2048, fx_px=2900.0, fy_px=2902.0, cx_px=1220.0, cy_px=1030.0,
        coefficients=(-0.15, 0.05, 0.001, 0.0),
    )  # fmt: skip
    image = render(large, HELD, BOARD, Look(supersampling=1, clutter="mosaic"), covers=fingers(large, 0.2))
    distance = checked(found_in(image), large, HELD)
    assert len(distance) >= 40 and np.sqrt(np.mean(distance**2)) < 0.2


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("chequerboard:8x5:0.02", r"the target shows 9 x 6 inner corners; it should have 8 x 5"),
        ("chequerboard:7x7:0.02", r"it should have 7 x 7"),
    ],
)
def test_a_wrong_count_is_told(target: str, reason: str):
    sight = detect(render(LENS, HELD, BOARD, QUICK), parse_target(target))
    assert isinstance(sight, NotFound)
    assert re.search(reason, sight.reason)


def test_what_is_too_blurred_is_told_with_its_blur():
    sight = detect(render(LENS, HELD, BOARD, Look(supersampling=1, blur_px=9.0)), BOARD)
    assert isinstance(sight, NotFound) and sight.reason.startswith("blurred: its sharpest edges")
    noted = found_in(render(LENS, HELD, BOARD, Look(supersampling=1, blur_px=4.2)))
    assert "blurred (edges 4." in noted.note


def test_what_is_no_chequerboard_is_none():
    rng = np.random.default_rng(0)
    for image in (
        np.full((480, 640), 90, np.uint8),
        np.zeros((480, 640), np.uint8),
        rng.integers(0, 256, (480, 640)).astype(np.uint8),
        render(LENS, HELD, parse_target("circles:8x8:0.016:0.008"), Look(supersampling=1)),
    ):
        sight = detect(image, BOARD)
        assert isinstance(sight, NotFound) and "\n" not in sight.reason


def test_of_two_boards_the_one_that_was_described():
    """Another, larger one beside it doesn't fit the description."""
    other = parse_target("chequerboard:12x10:0.006")
    image = render(LENS, pose(BOARD, (-0.06, 0.0, 0.5), (0.2, 0.1)), BOARD, Look(supersampling=2, clutter="plain"))
    second = render(LENS, pose(other, (0.1, 0.0, 0.4), (0.1, 0.1)), other, Look(supersampling=2, clutter="plain"))
    image[:, 400:] = second[:, 400:]
    sight = found_in(image)
    checked(sight, LENS, pose(BOARD, (-0.06, 0.0, 0.5), (0.2, 0.1)))
    assert len(sight) >= 40


def test_a_fisheyes_border_where_steps_shrink_by_a_third():
    board = parse_target("chequerboard:8x7:0.02")
    T = pose(board, (0.003, -0.004, 0.063), (0.63, 0.63), 0.8)
    distance = checked(found_in(render(FISHEYE, T, board, QUICK), board), FISHEYE, T, board)
    assert len(distance) >= 40 and np.median(distance) < 0.05


def test_a_knights_move_is_no_step_of_a_chequerboard():
    """It leads to a corner of the other kind, too; where the true neighbours are hidden it must not count."""
    turns = _Alternating(np.ones(1, np.complex128))
    right, down = np.array([30.0, 4.0]), np.array([-6.0, 26.0])
    assert turns.basis(0, right, down)
    assert not turns.basis(0, right, down + 2.0 * right)
    assert not turns.basis(0, right - 2.0 * down, down)


@pytest.mark.parametrize("target", ["chequerboard:9x6:0.02", "circles:9x6:0.02:0.01"])
def test_more_than_the_plate_has_is_told_where_the_plate_ends_all_round(target: str):
    """And only there: where a finger hides a part, or the image ends, the rest may be anywhere."""
    plate, more = parse_target(target), parse_target(target.replace("9x6", "9x8"))
    look = Look(supersampling=1, margin=1.2)
    T = pose(plate, (0.0, 0.0, 0.4), (0.3, -0.2), 0.3)
    for inverted in (False, True):
        whole = detect(render(LENS, T, plate, dataclasses.replace(look, inverted=inverted)), more)
        assert isinstance(whole, NotFound) and "shows 9 x 6" in whole.reason and "have 9 x 8" in whole.reason
    assert isinstance(detect(render(LENS, T, plate, look), plate), Sighting)
    assert isinstance(detect(render(LENS, T, plate, look, covers=fingers(LENS, 0.35)), more), Sighting)
    part = T.copy()
    part[0, 3] += 0.09
    assert isinstance(detect(render(LENS, part, plate, look), more), Sighting)


@pytest.mark.parametrize(("part", "ends"), [(0.24, True), (0.36, False)])
@pytest.mark.parametrize("squares", [False, True], ids=["discs", "squares"])
def test_a_plate_ends_where_what_follows_differs_by_less_than_three_tenths_of_its_contrast(
    squares: bool, part: float, ends: bool
):
    """Drawn by hand: dark on 200 grey levels, and beyond one side another ground by ``part`` of the contrast."""
    grey, step, dark = np.full((400, 400), 200, np.uint8), 40, 60
    cells = np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(-1, 2)
    for column, row in cells.tolist():
        if not squares:
            cv2.circle(grey, (100 + step * column, 100 + step * row), 9, dark, -1)
        elif (column + row) % 2 == 0 and max(column, row) < 4:
            grey[100 + step * row : 100 + step * (row + 1), 100 + step * column : 100 + step * (column + 1)] = dark
    grey[: 92 if squares else 80] = round(200 - part * (200 - dark))
    assert ends_all_round(grey, cells, 100.0 + step * cells, squares) is ends
