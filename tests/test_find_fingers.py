"""Which parts of what stays are fingers, from drawn masks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gripmon.teach.fingers import Parts, UnclearPartsError, find_fingers
from gripmon.teach.staying import Edges

SHAPE = (480, 640)
FINGER = [(300, 479), (300, 300), (360, 300), (360, 479)]
SECOND = [(430, 479), (430, 310), (490, 310), (490, 479)]
CABLE = [(60, 0), (85, 0), (110, 380), (95, 380)]
CROSSING_CABLE = [(60, 0), (80, 0), (130, 240), (80, 479), (60, 479), (110, 240)]
HOUSING = [(0, 0), (639, 0), (639, 50), (420, 65), (200, 45), (0, 55)]


def mask(*polygons: list[tuple[int, int]]) -> NDArray[np.bool_]:
    out = np.zeros(SHAPE, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(out, [np.array(polygon)], 1)
    return out > 0


def found(still: NDArray[np.bool_], count: int | None = None) -> Parts:
    ones = np.ones(SHAPE, np.float32)
    edges = Edges(ones, ones, np.ones(SHAPE, bool), np.zeros(SHAPE, bool), 0.1)
    return find_fingers(still, edges, count)


@pytest.mark.parametrize("other", [CROSSING_CABLE, HOUSING])
def test_what_crosses_the_view_or_lies_along_a_side_has_no_tip_and_is_no_finger(other: list[tuple[int, int]]) -> None:
    for flip in (1, -1):
        still = mask(FINGER, other)[::flip]
        assert (found(still, 1).fingers[0] == mask(FINGER)[::flip]).all()
        assert len(found(mask(FINGER, SECOND, other)[::flip]).fingers) == 2


@pytest.mark.parametrize("count", [1, 2, None])
def test_a_cable_that_ends_in_view_is_never_preferred_silently(count: int | None) -> None:
    fingers = [FINGER] if count == 1 else [FINGER, SECOND]
    assert len(found(mask(*fingers), count).fingers) == len(fingers)
    with pytest.raises(UnclearPartsError, match="--within"):
        found(mask(*fingers, CABLE), count)


def test_of_parts_of_different_size_the_largest_is_not_said_to_be_the_only_one() -> None:
    small = [[(x, 479), (x, 440), (x + 20, 440), (x + 20, 479)] for x in (300, 400)]
    with pytest.raises(UnclearPartsError, match=r"3 parts .* one much larger") as caught:
        found(mask(*small, CABLE))
    assert len(caught.value.parts) == 3


def test_the_corner_between_a_finger_and_its_carrier_is_no_valley_between_two_fingers() -> None:
    for width, height in ((60, 60), (160, 60), (250, 80)):
        left, top = 300 - width, 479 - height
        joined = mask(FINGER, [(left, 479), (left, top), (360, top), (360, 479)])
        with pytest.raises(UnclearPartsError, match="one finger"):
            found(joined)
        assert len(found(joined, 1).fingers) == 1
    palm = [(250, 479), (250, 430), (540, 430), (540, 479)]
    assert len(found(mask(FINGER, SECOND, palm)).fingers) == 2


@pytest.mark.parametrize(
    "shape",
    [
        [(250, 479), (300, 440), (350, 479)],  # short and pointed
        [(0, 479), (0, 200), (60, 160), (90, 250), (90, 479)],  # cut lengthwise by the left border
        [(560, 479), (500, 400), (560, 350), (639, 400), (639, 479)],  # cut off by a corner
        [(0, 479), (0, 440), (280, 440), (280, 200), (360, 200), (360, 440), (639, 440), (639, 479)],  # on a wide palm
        [(300, 479), (380, 479), (60, 250), (140, 40), (100, 40), (0, 220), (0, 270)],  # its belly is cut off
    ],
)
def test_a_finger_that_enters_in_an_odd_way_still_ends_in_view(shape: list[tuple[int, int]]) -> None:
    assert len(found(mask(shape), 1).fingers) == 1
