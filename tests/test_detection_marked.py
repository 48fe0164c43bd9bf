"""Lattices of discs and ChArUco boards in rendered images, and targets as they are written on a command line."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.discs import blob_centres_px
from support.plates import Look, fingers, points_of, pose, render, true_uv

from gripmon.calibrate.detection import detect
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, make_camera
from gripmon.model.records import Array
from gripmon.model.targets import Charuco, Chequerboard, CircleGrid, Target, name_of, parse_target

LENS = BrownConradyLens(
    width_px=640, height_px=480, fx_px=760.0, fy_px=761.0, cx_px=316.0, cy_px=244.0,
    coefficients=(-0.15, 0.05, 0.001, 0.0),
)  # fmt: skip
FISHEYE = FisheyeLens(
    width_px=640, height_px=480, fx_px=215.0, fy_px=215.0, cx_px=316.0, cy_px=244.0,
    coefficients=(0.02, -0.01, 0.003, -0.0004),
)  # fmt: skip
PAPERS = CircleGrid(columns=8, rows=8, spacing_m=0.008, diameter_m=0.004)
MARKED = Charuco(columns=8, rows=6, square_m=0.024, marker_m=0.017)
HELD = pose(PAPERS, (0.001, -0.001, 0.145), (0.35, -0.25), 0.5)
FAR = pose(PAPERS, (0.0, 0.0, 0.4), (0.4, 0.2), 0.2)
HELD_MARKED = pose(MARKED, (0.0, 0.0, 0.33), (0.3, -0.25), 0.4)


def found_in(image: Array, target: Target) -> Sighting:
    sight = detect(image, target, "view")
    assert isinstance(sight, Sighting), sight
    return sight


def disc_errors(sight: Sighting, settings: LensSettings, T: Array) -> Array:
    """Distances (n,) to where the centre of each disc's *image* truly is; the lattice must be the plate's."""
    points = points_of(PAPERS)
    uv = blob_centres_px(make_camera(settings), T, points, 0.002)
    distance, index = cKDTree(np.where(np.isfinite(uv), uv, -1e6)).query(sight.uv_px)
    design = np.column_stack([sight.plate_m[:, :2], np.ones(len(sight))])
    change, *_ = np.linalg.lstsq(design, points[index, :2], rcond=None)
    np.testing.assert_allclose(design @ change, points[index, :2], atol=1e-9)
    np.testing.assert_allclose(change[:2] @ change[:2].T, np.eye(2), atol=1e-9)
    assert np.linalg.det(change[:2]) > 0.0
    return distance


CONDITIONS = {
    "plain": (LENS, HELD, Look(supersampling=3), 0.0, 64, 0.0051),
    "fingers over a third of the plate": (LENS, HELD, Look(supersampling=3), 0.36, 34, 0.006),
    "full of other shapes": (LENS, HELD, Look(supersampling=3, clutter="mosaic"), 0.3, 40, 0.0059),
    "light on dark": (LENS, HELD, Look(supersampling=3, inverted=True), 0.3, 40, 0.011),
    "three quarters of the light gone on one side": (LENS, HELD, Look(supersampling=3, falloff=0.75), 0.25, 40, 0.008),
    "blurred": (LENS, HELD, Look(supersampling=2, blur_px=2.0), 0.25, 40, 0.0156),
    "noisy": (LENS, HELD, Look(supersampling=2, noise=8.0), 0.25, 40, 0.0263),
    "small": (LENS, FAR, Look(supersampling=3, clutter="plain"), 0.0, 64, 0.0106),
    "a fisheye": (FISHEYE, pose(PAPERS, (0.0, 0.0, 0.035), (0.3, -0.3), 1.0), Look(supersampling=2), 0.2, 45, 0.0059),
}


@pytest.mark.parametrize("condition", CONDITIONS)
def test_discs_are_found_where_they_are(condition: str):
    """To twice what was measured (root mean square, px, of two seeds)."""
    settings, T, look, reach, least, rms_px = CONDITIONS[condition]
    image = render(settings, T, PAPERS, look, covers=fingers(settings, reach) if reach else (), seed=2)
    sight = found_in(image, PAPERS)
    errors = disc_errors(sight, settings, T)
    assert len(sight) >= least and sight.disc_radius_m == 0.002
    assert np.sqrt(np.mean(errors**2) / 2.0) < 2.0 * rms_px and errors.max() < 0.25


def test_discs_that_a_finger_cuts_are_left_out():
    """The edge of a finger runs through a column of discs."""
    image = render(LENS, HELD, PAPERS, Look(supersampling=3, clutter="plain"), seed=1)
    whole = found_in(image, PAPERS)
    assert len(whole) == 64
    cut = 0
    for column in np.linspace(200.0, 420.0, 7):
        covered = render(
            LENS, HELD, PAPERS, Look(supersampling=3, clutter="plain"), seed=1,
            covers=[(np.array([[-5.0, -5.0], [column, -5.0], [column + 20.0, 485.0], [-5.0, 485.0]]), 90.0)],
        )  # fmt: skip
        sight = detect(covered, PAPERS)
        if isinstance(sight, Sighting):
            assert disc_errors(sight, LENS, HELD).max() < 0.2
            cut += 1
    assert cut >= 5


def test_a_wrong_count_of_discs_is_told():
    sight = detect(render(LENS, HELD, PAPERS), parse_target("circles:6x5:0.008:0.004"))
    assert isinstance(sight, NotFound)
    assert sight.reason == "the target shows 8 x 8 discs; it should have 6 x 5"
    assert isinstance(detect(np.full((480, 640), 90, np.uint8), PAPERS), NotFound)


def test_discs_too_blurred_to_be_measured_are_told():
    sight = detect(render(LENS, HELD, PAPERS, Look(supersampling=1, blur_px=9.0, clutter="plain")), PAPERS)
    assert isinstance(sight, NotFound) and "blurred" in sight.reason


def test_a_target_that_is_too_small_is_not_called_blurred():
    """A sharp image by a fisheye from far away: discs of six pixels."""
    discs = CircleGrid(12, 10, 0.008, 0.004)
    image = render(FISHEYE, pose(discs, (0.0, 0.0, 0.2), (0.2, 0.1), 0.5), discs, Look(supersampling=2))
    sight = detect(image, discs)
    assert isinstance(sight, NotFound) and "too small for its edges: its points lie 8 px apart" in sight.reason
    assert "nearer to it" in sight.reason and "blurred" not in sight.reason


def numbers(sight: Sighting, points: np.ndarray) -> np.ndarray:
    """Of the board's points (n, 3) those that are seen, by where they are on it."""
    return np.linalg.norm(sight.plate_m[:, None] - points, axis=2).argmin(axis=1)


@pytest.mark.parametrize(
    ("look", "reach", "least"),
    [
        (Look(supersampling=2), 0.0, 32),
        (Look(supersampling=2, clutter="mosaic"), 0.3, 14),
        (Look(supersampling=2, falloff=0.7), 0.25, 14),
        (Look(supersampling=2, blur_px=2.0), 0.25, 14),
    ],
)
def test_corners_of_a_marked_board_keep_their_numbers(look: Look, reach: float, least: int):
    image = render(LENS, HELD_MARKED, MARKED, look, covers=fingers(LENS, reach) if reach else (), seed=4)
    sight = found_in(image, MARKED)
    points = points_of(MARKED)
    own = numbers(sight, points)
    np.testing.assert_allclose(sight.plate_m, points[own], atol=1e-9)
    errors = np.linalg.norm(sight.uv_px - true_uv(LENS, HELD_MARKED, points)[own], axis=1)
    assert len(sight) >= least
    # OpenCV's own corners lie 0.4 px off here: its windows take in the marks' edges.
    assert np.sqrt(np.mean(errors**2) / 2.0) < 0.06 and errors.max() < 0.2


@pytest.mark.parametrize("quarter", [0, 3])
def test_a_board_is_found_where_a_corner_of_the_image_looks_past_its_horizon(quarter: int):
    """A wide lens and a steep view; which corner it is must not matter, nor how the board lies."""
    wide = BrownConradyLens(width_px=640, height_px=480, fx_px=260.0, fy_px=260.0, cx_px=319.5, cy_px=239.5)
    board = Charuco(columns=12, rows=9, square_m=0.01, marker_m=0.0075, dictionary="DICT_5X5_100")
    for signs in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)):
        T = pose(board, (0.0, 0.0, 0.07), 0.62 * np.array(signs), 0.5 * np.pi * quarter + 0.2)
        sight = found_in(render(wide, T, board, Look(supersampling=2)), board)
        points = points_of(board)
        errors = np.linalg.norm(sight.uv_px - true_uv(wide, T, points)[numbers(sight, points)], axis=1)
        assert len(sight) >= 30 and errors.max() < 0.3


def swapped(target: Target) -> Target:
    return msgspec.structs.replace(target, columns=target.rows, rows=target.columns)


def test_a_board_whose_columns_and_rows_are_swapped_is_told():
    """Its marks stand elsewhere then: 8 x 6 squares are another board than 6 x 8."""
    sight = detect(render(LENS, HELD_MARKED, MARKED, Look(supersampling=2)), swapped(MARKED))
    assert isinstance(sight, NotFound)
    assert sight.reason == "the board has 8 x 6 squares, not 6 x 8: columns and rows are swapped"
    other = detect(render(LENS, HELD_MARKED, MARKED, Look(supersampling=2)), msgspec.structs.replace(MARKED, columns=7))
    assert isinstance(other, NotFound) and "0 corners of a board of 7 x 6 squares; at least 6" in other.reason


@pytest.mark.parametrize(
    "target", [CircleGrid(columns=9, rows=7, spacing_m=0.008, diameter_m=0.004), Chequerboard(9, 6, 0.012)], ids=name_of
)
def test_a_board_without_marks_is_the_same_with_columns_and_rows_swapped(target: Target):
    """Turned by a quarter, it is that board: the same points, at the same distances from each other, not mirrored."""
    T = pose(target, (0.0, 0.0, 0.22), (0.3, -0.25), 0.4)
    image = render(LENS, T, target, Look(supersampling=2), covers=fingers(LENS, 0.2))
    one, other = found_in(image, target), found_in(image, swapped(target))
    order = [cKDTree(other.uv_px).query(uv)[1] for uv in one.uv_px]
    np.testing.assert_allclose(other.uv_px[order], one.uv_px, atol=1e-9)
    design = np.column_stack([one.plate_m[:, :2], np.ones(len(one))])
    change, *_ = np.linalg.lstsq(design, other.plate_m[order, :2], rcond=None)
    np.testing.assert_allclose(design @ change, other.plate_m[order, :2], atol=1e-9)
    np.testing.assert_allclose(change[:2] @ change[:2].T, np.eye(2), atol=1e-9)
    assert np.linalg.det(change[:2]) > 0.0


def test_a_mirrored_board_is_told():
    sight = detect(render(LENS, HELD_MARKED, MARKED, Look(supersampling=2, mirrored=True)), MARKED)
    assert isinstance(sight, NotFound) and sight.reason == "the board is mirrored; an image that isn't flipped"


def test_a_board_of_before_opencv_4_6_is_read_by_its_own_pattern():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    board = cv2.aruco.CharucoBoard((8, 6), 0.024, 0.017, dictionary)
    board.setLegacyPattern(True)
    image = np.full((480, 640), 200, np.uint8)
    image[60:420, 80:560] = board.generateImage((480, 360), marginSize=0, borderBits=1)
    sight = found_in(cv2.GaussianBlur(image, (0, 0), 0.7), MARKED)
    assert len(sight) == 35
    expected = np.array([80.0, 60.0]) - 0.5 + sight.plate_m[:, :2] / 0.024 * 60.0
    assert np.abs(sight.uv_px - expected).max() < 0.1


def test_the_mark_that_is_not_the_boards():
    """Another dictionary on the plate than was said: nothing is found, and a dictionary that there isn't is refused."""
    image = render(LENS, HELD_MARKED, MARKED, Look(supersampling=2))
    other = parse_target("charuco:8x6:0.024:0.017:DICT_7X7_50")
    sight = detect(image, other)
    assert isinstance(sight, NotFound) and "marks and" in sight.reason
    with pytest.raises(ValueError, match="there is no dictionary DICT_9X9; one of OpenCV's"):
        detect(image, parse_target("charuco:8x6:0.024:0.017:DICT_9X9"))


@pytest.mark.parametrize(
    "text", ["chequerboard:9x6:0.025", "charuco:8x6:0.03:0.022:DICT_4X4_250", "circles:8x8:0.008:0.004"]
)
def test_targets_are_read_as_they_are_named(text: str):
    assert name_of(parse_target(text)) == text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("checkers:9x6:0.025", "'checkers' is not a target; chequerboard:COLUMNSxROWS:SQUARE"),
        ("chequerboard:9x6", "has 1 part after its kind"),
        ("chequerboard:9x6x2:0.02", "can't be read"),
        ("chequerboard:9x6:wide", "can't be read"),
        ("chequerboard:9x6:25", "25.0 m between its points (millimetres?)"),
        ("chequerboard:9x6:-0.02", "> 0.0"),
        ("chequerboard:3x2:0.02", "3 x 2 points, too few"),
        ("chequerboard:900x6:0.02", "<= 200"),
        ("charuco:8x6:0.022:0.03", "marker_m is not below square_m"),
        ("circles:8x8:0.008:0.009", "diameter_m is not below spacing_m"),
    ],
)
def test_what_is_no_target_is_refused_in_one_line(text: str, reason: str):
    with pytest.raises(ValueError) as refused:
        parse_target(text)
    assert reason in str(refused.value) and "\n" not in str(refused.value) and "e.g. " in str(refused.value)
