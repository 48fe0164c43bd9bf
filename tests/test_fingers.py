"""What stays before changing backgrounds, and which parts of it are fingers, on drawn masks and pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gripmon.model.staying import Edges, edges_that_stay, enclosed
from gripmon.teach.fingers import Parts, UnclearPartsError, find_fingers

SHAPE = (240, 320)


def polygons(*corners: list[tuple[int, int]], shape: tuple[int, int] = SHAPE) -> np.ndarray:
    out = np.zeros(shape, np.uint8)
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


def test_soft_shading_that_comes_and_goes_on_a_plain_body_is_no_background():
    """A coder leaves a black surround without noise: slopes of a level and a half are many times that."""
    still = polygons([(60, 239), (60, 120), (260, 120), (260, 239)])
    rng, shown = np.random.default_rng(6), []
    for image in pictures(still, 12, False):
        shade = cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), 6.0)
        shade *= 1.2 / np.hypot(*np.gradient(shade)).mean()
        clean = np.where(cv2.erode(still.astype(np.uint8), np.ones((9, 9))) > 0, 90.0 + shade, image)
        clean[:40] = 0.0
        shown.append(clean.astype(np.float32))
    found = enclosed(edges_that_stay(shown))
    assert found is not None and (found & still).sum() > 0.9 * still.sum()


def test_a_small_face_on_which_shadows_come_and_go_is_the_grippers():
    """Beside a finger at the image's border, smaller than a cell: hardly any of it is a pixel away from its edges."""
    pad = [(100, 229), (112, 229), (112, 239), (100, 239)]
    own = polygons(pad)
    face, shown = cv2.GaussianBlur(own.astype(np.float32), (0, 0), 0.8), []
    for k, picture in enumerate(pictures(polygons(LEFT, RIGHT, pad), 12, wall=False)):
        shadow = np.zeros(SHAPE, np.float32)
        shadow[:, 106:112] = 60.0 if k % 4 <= 1 else 0.0
        shown.append(picture + face * (50.0 + shadow))
    found = enclosed(edges_that_stay(shown))
    assert found is not None and found[own].mean() > 0.7


def test_nothing_is_enclosed_where_nothing_changes():
    rng = np.random.default_rng(1)
    first = pictures(polygons(LEFT), 1, wall=False)[0]
    assert enclosed(edges_that_stay([first + rng.normal(0.0, 1.0, SHAPE).astype(np.float32) for _ in range(8)])) is None


FINGER = [(300, 479), (300, 300), (360, 300), (360, 479)]
SECOND = [(430, 479), (430, 310), (490, 310), (490, 479)]
CABLE = [(60, 0), (85, 0), (110, 380), (95, 380)]
CROSSING_CABLE = [(60, 0), (80, 0), (130, 240), (80, 479), (60, 479), (110, 240)]
HOUSING = [(0, 0), (639, 0), (639, 50), (420, 65), (200, 45), (0, 55)]


def mask(*corners: list[tuple[int, int]]) -> np.ndarray:
    return polygons(*corners, shape=(480, 640))


def found(still: np.ndarray, count: int | None = None) -> Parts:
    """Where an edge is anywhere, so that only the shapes tell."""
    ones = np.ones(still.shape, np.float32)
    return find_fingers(still, Edges(ones, ones, ones > 0.0, ones < 0.0, 0.1), count)


@pytest.mark.parametrize("other", [CROSSING_CABLE, HOUSING])
def test_what_crosses_the_view_or_lies_along_a_side_has_no_tip_and_is_no_finger(other: list[tuple[int, int]]):
    for flip in (1, -1):
        still = mask(FINGER, other)[::flip]
        assert (found(still, 1).fingers[0] == mask(FINGER)[::flip]).all()
        assert len(found(mask(FINGER, SECOND, other)[::flip]).fingers) == 2


@pytest.mark.parametrize("count", [1, 2, None])
def test_a_cable_that_ends_in_view_is_never_preferred_silently(count: int | None):
    fingers = [FINGER] if count == 1 else [FINGER, SECOND]
    assert len(found(mask(*fingers), count).fingers) == len(fingers)
    with pytest.raises(UnclearPartsError, match="--within"):
        found(mask(*fingers, CABLE), count)


def test_of_parts_of_different_size_the_largest_is_not_said_to_be_the_only_one():
    small = [[(x, 479), (x, 440), (x + 20, 440), (x + 20, 479)] for x in (300, 400)]
    with pytest.raises(UnclearPartsError, match=r"3 parts .* one much larger") as caught:
        found(mask(*small, CABLE))
    assert len(caught.value.parts) == 3


def test_the_corner_between_a_finger_and_its_carrier_is_no_valley_between_two_fingers():
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
def test_a_finger_that_enters_in_an_odd_way_still_ends_in_view(shape: list[tuple[int, int]]):
    assert len(found(mask(shape), 1).fingers) == 1


@pytest.mark.parametrize("count", [5, 9, 12])
def test_between_jaws_that_meet_is_background_though_edges_that_stay_enclose_it(count: int):
    jaws = polygons([(180, 239), (180, 110), (270, 110), (270, 239)])
    hole = polygons([(205, 239), (205, 150), (245, 150), (245, 239)])
    kept = enclosed(edges_that_stay(pictures(jaws & ~hole, count, False)))
    assert kept is not None and kept[jaws & ~hole].mean() > 0.95
    assert kept[cv2.erode(hole.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0].mean() < 0.05


def test_fingers_on_shoulders_as_wide_as_the_gap_between_them_end_above_these():
    """Of one the shoulder slopes to half of the valley's depth, as on a jaw that carries its own motor."""
    left = [(60, 0), (60, 70), (80, 75), (80, 130), (105, 150), (120, 130), (130, 90), (190, 80), (230, 20), (230, 0)]
    right = [(230, 0), (230, 20), (270, 70), (265, 90), (250, 150), (275, 150), (319, 120), (319, 0)]
    still = polygons(left, right)
    parts = find_fingers(still, sure(still))
    assert len(parts.fingers) == 2 and parts.rest[10, 200]
    assert parts.fingers[0][140, 105] and parts.fingers[1][140, 260]
    assert all(outwards[1] > 0.7 for outwards in parts.outwards)
