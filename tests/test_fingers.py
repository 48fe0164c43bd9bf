"""What stays before changing backgrounds, and which parts of it are fingers, on drawn masks and pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gripmon.teach.fingers import UnclearPartsError, find_fingers
from gripmon.teach.staying import Edges, edges_that_stay, enclosed

SHAPE = (240, 320)


def polygons(*corners: list[tuple[int, int]]) -> np.ndarray:
    out = np.zeros(SHAPE, np.uint8)
    for own in corners:
        cv2.fillPoly(out, [np.array(own, np.int32)], 1)
    return out > 0


def sure(still: np.ndarray) -> Edges:
    """All borders of a mask stay in all images."""
    border = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    share = border.astype(np.float32)
    return Edges(share, np.zeros(SHAPE, np.float32), border, ~still, 0.1)


LEFT = [(60, 239), (70, 120), (100, 120), (100, 239)]
RIGHT = [(220, 239), (220, 120), (250, 120), (260, 239)]


def rolled_hand(degrees: float) -> np.ndarray:
    """Two fingers on a palm, which the image's lower border cuts off, before a rolled camera."""
    half = [(50, 60), (50, -60), (80, -60), (90, 60), (200, 60), (200, 260)]
    corners = np.array([(-x, y) for x, y in half[::-1]] + half, float)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return polygons((corners @ turn.T + [160, 130]).round().astype(int).tolist())


def test_two_parts_that_enter_and_end_in_view_are_the_fingers():
    still = polygons(LEFT, RIGHT)
    parts = find_fingers(still, sure(still))
    assert len(parts.fingers) == 2 and not parts.rest.any()
    assert parts.fingers[0][200, 80] and parts.fingers[1][200, 240]
    assert all(outwards[1] < -0.9 for outwards in parts.outwards)


@pytest.mark.parametrize("degrees", [-12.0, 0.0, 12.0])
def test_fingers_are_cut_off_a_palm_along_its_border_also_when_the_camera_is_rolled(degrees: float):
    still = rolled_hand(degrees)
    parts = find_fingers(still, sure(still))
    assert len(parts.fingers) == 2 and parts.rest.any()
    angle = np.radians(degrees)
    out_of_palm = np.array([np.sin(angle), -np.cos(angle)])
    for finger in parts.fingers:
        ahead = (np.argwhere(finger)[:, ::-1] - [160, 130]) @ out_of_palm
        assert ahead.min() > -63.0 and ahead.max() > 57.0  # the palm begins at -60


def test_what_else_stays_is_left_out_and_one_finger_has_to_be_said():
    stamp, corner = [(10, 10), (110, 10), (110, 25), (10, 25)], [(280, 0), (319, 0), (319, 40)]
    still = polygons(LEFT, RIGHT, stamp, corner)
    assert find_fingers(still, sure(still)).rest[15, 50]
    one = polygons(LEFT, stamp)
    with pytest.raises(UnclearPartsError, match="--fingers 1") as unclear:
        find_fingers(one, sure(one))
    assert unclear.value.picture(np.zeros(SHAPE, np.uint8)).shape == (*SHAPE, 3)
    assert len(find_fingers(one, sure(one), 1).fingers) == 1


def test_three_parts_are_a_question_that_boxes_answer():
    cable = [(150, 0), (150, 90), (175, 90), (175, 0)]
    still = polygons(LEFT, RIGHT, cable)
    with pytest.raises(UnclearPartsError, match=r"3 parts.*--within"):
        find_fingers(still, sure(still))
    assert len(find_fingers(still, sure(still), within=[(40, 100, 280, 239)]).fingers) == 2
    each = find_fingers(still, sure(still), within=[(50, 100, 110, 239), (210, 100, 270, 239)])
    assert each.fingers[0][200, 80] and each.fingers[1][200, 240]
    with pytest.raises(UnclearPartsError):
        find_fingers(still, sure(still), within=[(50, 100, 110, 239), (110, 100, 140, 239)])


def pictures(still: np.ndarray, count: int, wall: bool) -> list[np.ndarray]:
    """A grey gripper with noise before blots that change; with a ``wall`` without any in the upper third."""
    rng = np.random.default_rng(5)
    out = []
    for _ in range(count):
        back = np.full(SHAPE, rng.uniform(60.0, 190.0), np.float32)
        for _ in range(60):
            x, y = int(rng.integers(SHAPE[1])), int(rng.integers(80 if wall else 0, SHAPE[0]))
            cv2.circle(back, (x, y), int(rng.integers(6, 22)), float(rng.uniform(20.0, 240.0)), -1)
        if wall:
            back[: int(rng.integers(50, 110))] = 128.0
        image = np.where(still, 90.0, back).astype(np.float32)
        out.append(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 1.0, SHAPE).astype(np.float32))
    return out


@pytest.mark.parametrize("count", [5, 12])
@pytest.mark.parametrize("wall", [False, True])
def test_what_edges_enclose_is_the_gripper_and_no_plain_wall(count: int, wall: bool):
    still = polygons(LEFT, RIGHT)
    found = enclosed(edges_that_stay(pictures(still, count, wall)))
    assert found is not None
    assert (found & still).sum() > 0.9 * still.sum()
    assert (found[:50].mean() if wall else 0.0) < 0.02
    assert (found & ~still).sum() < 0.15 * still.sum()


def test_nothing_is_enclosed_where_nothing_changes():
    rng = np.random.default_rng(1)
    first = pictures(polygons(LEFT), 1, wall=False)[0]
    assert enclosed(edges_that_stay([first + rng.normal(0.0, 1.0, SHAPE).astype(np.float32) for _ in range(8)])) is None
