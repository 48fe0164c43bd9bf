"""Staggered discs (asymmetric circles) in rendered images, against OpenCV's own places of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.plates import Look, fingers, pose, render

from gripmon.calibrate.detection import detect
from gripmon.calibrate.markers import other_dictionary
from gripmon.calibrate.sighting import NotFound, Sighting
from gripmon.calibrate.staggered import places_of
from gripmon.model.camera import BrownConradyLens
from gripmon.model.targets import Charuco, CircleGrid, StaggeredCircles, TargetError, name_of, parse_target

LENS = BrownConradyLens(
    width_px=640, height_px=480, fx_px=760.0, fy_px=761.0, cx_px=316.0, cy_px=244.0,
    coefficients=(-0.15, 0.05, 0.001, 0.0),
)  # fmt: skip
TARGET = StaggeredCircles(columns=4, rows=11, spacing_m=0.02, diameter_m=0.008)
HELD = pose(TARGET, (0.0, 0.0, 0.24), (0.3, -0.2), 0.4)
QUICK = Look(supersampling=2)


@pytest.mark.parametrize("roll_rad", [0.0, 0.4, 1.7, 3.0, -1.4])
def test_discs_have_the_places_that_opencv_gives_them(roll_rad: float):
    image = render(LENS, pose(TARGET, (0.0, 0.0, 0.24), (0.3, -0.2), roll_rad), TARGET, QUICK, seed=2)
    sight = detect(image, TARGET, "view")
    assert isinstance(sight, Sighting) and len(sight) == 44 and sight.disc_radius_m == 0.004
    shown = np.clip(image, 0, 255).astype(np.uint8)
    found, centres = cv2.findCirclesGrid(shown, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    # As in OpenCV's calibration sample, with its square size, half the distance in a row.
    theirs_m = np.array([((2 * j + i % 2) * 0.01, i * 0.01) for i in range(11) for j in range(4)])
    nearest = np.linalg.norm(centres.reshape(-1, 1, 2) - sight.uv_px[None], axis=2)
    assert nearest.min(axis=1).max() < 0.5
    np.testing.assert_allclose(sight.plate_m[nearest.argmin(axis=1), :2], theirs_m, atol=1e-12)


def test_a_part_of_them_is_enough():
    image = render(LENS, HELD, TARGET, QUICK, covers=fingers(LENS, 0.3), seed=2)
    sight = detect(image, TARGET, "view")
    assert isinstance(sight, Sighting) and 15 < len(sight) < 44
    plane, _ = cv2.findHomography(sight.plate_m[:, :2], sight.uv_px)
    mapped = cv2.perspectiveTransform(sight.plate_m[None, :, :2], plane)[0]
    assert np.abs(mapped - sight.uv_px).max() < 1.0  # bent by the lens alone


def test_the_other_kind_of_lattice_is_named():
    image = render(LENS, HELD, TARGET, QUICK, seed=2)
    plain = detect(image, CircleGrid(4, 11, 0.02, 0.008), "view")
    assert isinstance(plain, NotFound)
    assert plain.reason == "the discs are staggered (asymmetric circles); --target acircles:4x11:0.02:0.008"
    square = CircleGrid(6, 8, 0.02, 0.008)
    other = render(LENS, pose(square, (0.0, 0.0, 0.3), (0.3, -0.2), 0.4), square, QUICK, seed=2)
    found = detect(other, TARGET, "view")
    assert isinstance(found, NotFound) and "not as staggered as acircles:4x11" in found.reason


def test_places_are_unique_on_a_whole_target_and_none_on_another():
    places = np.array(TARGET.places)
    cells = np.stack([places.sum(axis=1) // 2, (places[:, 1] - places[:, 0]) // 2], axis=1)
    for _ in range(4):
        cells = np.stack([cells[:, 1], -cells[:, 0]], axis=1)
        found = places_of(cells - cells.min(axis=0), TARGET)
        assert found is not None
        np.testing.assert_array_equal(found, places)
    assert places_of(np.array([(c, r) for r in range(6) for c in range(6)]), TARGET) is None


def test_they_are_described_like_discs_in_rows():
    assert parse_target("acircles:4x11:0.02:0.008") == TARGET and name_of(TARGET) == "acircles:4x11:0.02:0.008"
    with pytest.raises(TargetError, match=r"discs would touch those of the next row, 0.01 m away"):
        parse_target("acircles:4x11:0.02:0.015")


def test_a_board_of_another_dictionary_is_recognised_by_its_markers():
    board = Charuco(8, 6, 0.024, 0.017, "DICT_4X4_50")
    image = render(LENS, pose(board, (0.0, 0.0, 0.33), (0.3, -0.25), 0.4), board, QUICK, seed=2)
    told = Charuco(8, 6, 0.024, 0.017, "DICT_5X5_50")
    assert other_dictionary([("a", image)], told) == "DICT_4X4_50"
    assert other_dictionary([("a", image)], board) is None
    assert other_dictionary([("a", np.full((480, 640), 128, np.uint8))], told) is None
