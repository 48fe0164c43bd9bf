"""Images that show the gripper displaced are moved back, and what stays beyond an edge is told from background."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from support.changing_backgrounds import CAMERA

from gripmon.model.staying import Edges, edges_that_stay
from gripmon.teach.beyond import Background, is_outermost
from gripmon.teach.image_outline import _displaced, _moved_back
from gripmon.teach.matte import Matte
from gripmon.teach.piece_lines import PieceLine
from gripmon.teach.silhouette import Stations, Transitions, from_ideal_px
from gripmon.teach.straight_pieces import _joined


def test_a_turned_image_is_moved_back_wherever_its_outline_shows() -> None:
    """Of an outline in view only one part may be measured, which isn't about the same centre as the whole."""
    shape, turn_rad, shift_px = (200, 300), 0.01, np.array([0.6, -0.4])
    rng = np.random.default_rng(5)
    usual = np.asarray(cv2.GaussianBlur(rng.uniform(0.0, 255.0, shape).astype(np.float32), (0, 0), 6.0), np.float32)
    matrix = np.array([[1.0, -turn_rad, shift_px[0]], [turn_rad, 1.0, shift_px[1]]])
    turned = cv2.warpAffine(usual, matrix, shape[::-1], flags=cv2.INTER_CUBIC)
    images = np.stack([turned, usual, usual]).astype(np.float32)

    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    uv_px = np.array([150.0, 100.0]) + normal * [100.0, 60.0]
    stations = Stations(uv_px, normal, np.ones(len(angle), bool))
    seen = np.zeros((3, len(angle)))
    seen[0] = ((uv_px @ matrix[:, :2].T + matrix[:, 2] - uv_px) * normal).sum(axis=1)
    usable = uv_px[:, 0] > 180.0
    none = np.zeros(len(angle))
    found = Transitions(none, none[None], usable, 0.7, seen, np.ones((3, len(angle))), np.ones(3), *3 * (none,))
    flat = np.zeros(shape, np.float32)
    edges = Edges(flat, flat, flat > 0, flat > 0, 0.0)
    matte = Matte(flat > 0, edges, 1.0, images, np.zeros((3, 2)), (0, 1, 2), {})

    back = _moved_back(matte, _displaced(stations, found), uv_px[usable]).images
    inner = np.s_[20:-20, 20:-20]
    off, off_before = (np.abs(image[inner] - usual[inner]).max() for image in (back[0], turned))
    assert off < 0.1 * off_before


@pytest.mark.parametrize("texture_dn", [0.0, 30.0])
@pytest.mark.parametrize("face_dn", [80.0, 145.0])
def test_a_narrow_face_beyond_an_edge_is_told_from_six_backgrounds(face_dn: float, texture_dn: float) -> None:
    """Between a finger of 40 and backgrounds of 90 to 200: darker than they are, and as they are in the mean."""

    def found(rng: np.random.Generator, face_px: int, spread_dn: float = 55.0, light: float = 0.0) -> bool:
        x, images = np.arange(60), []
        for _ in range(6):
            blots = 7.0 * cv2.GaussianBlur(rng.normal(size=(60, 60)), (0, 0), 2.0)
            back = rng.uniform(145.0 - spread_dn, 145.0 + spread_dn) + texture_dn * blots
            lit_dn = face_dn * (1.0 + light * rng.normal()) if light else face_dn
            image = np.where(x < 30, 40.0, np.where(x < 30 + face_px, lit_dn, back))
            images.append(cv2.GaussianBlur(image, (0, 0), 0.9) + rng.normal(size=(60, 60)))
        along = np.column_stack([np.full(30, 29.5), np.arange(15.0, 45.0)])
        stations = Stations(along, np.tile([1.0, 0.0], (30, 1)), np.ones(30, bool))
        return is_outermost(np.array(images, np.float32), stations, 0.9)

    rng = np.random.default_rng(1)
    assert np.mean([found(rng, 0) for _ in range(40)]) > (0.9 if texture_dn == 0.0 else 0.7)
    for face_px in (2, 4):
        assert np.mean([found(rng, face_px) for _ in range(40)]) < 0.1
    assert np.mean([found(rng, 10, light=0.03) for _ in range(40)]) < 0.1
    if texture_dn == 0.0:  # before one wall nothing shows
        assert np.mean([found(rng, 0, spread_dn=0.0) for _ in range(40)]) <= 0.1


def begins_right_of_the_finger(images: Sequence[np.ndarray], row: float, *, edges_come_and_go: bool) -> bool:
    """Whether a background begins beside 45 px from this row on of a finger whose right border is at column 99.5."""
    stack, still = np.array(images, np.float32), np.zeros((200, 300), bool)
    still[60:180, 60:100] = True
    changing = edges_that_stay(list(stack)).changing
    behind = Background.of(stack, still, changing if edges_come_and_go else np.zeros_like(changing))
    along = np.column_stack([np.full(45, 99.5), row + np.arange(45.0)])
    return behind.begins(Stations(along, np.tile([1.0, 0.0], (45, 1)), np.ones(45, bool)))


@pytest.mark.parametrize("pad_px", [30, 80])
@pytest.mark.parametrize("texture_dn", [0.0, 10.0])
def test_what_changes_less_than_all_of_a_textured_background_is_none(texture_dn: float, pad_px: int) -> None:
    """Beyond one half of an edge there is a plain pad, whose light changes, or a whole finger, of which only a face was
    found; plain walls as well may be one.
    """
    rng, images = np.random.default_rng(2), []
    pad = np.s_[60:120, 100 : 100 + pad_px]
    for _ in range(8):
        blots = cv2.GaussianBlur(rng.normal(size=(200, 300)), (0, 0), 1.5)
        image = 120.0 + texture_dn / blots.std() * blots + rng.normal(0.0, 4.0)
        image[pad] = 120.0 + rng.normal(0.0, 3.0)
        image[60:180, 60:100] = 50.0
        images.append(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(size=image.shape))
    for row, begins in ((65.0, texture_dn == 0.0), (130.0, True)):
        assert begins_right_of_the_finger(images, row, edges_come_and_go=True) == begins


def test_before_plain_walls_that_no_edge_crosses_a_pad_of_their_grey_is_no_background() -> None:
    """Edges come and go nowhere, which says nothing; grey levels change less beyond the pad's edge than anywhere."""
    rng, images = np.random.default_rng(3), []
    for _ in range(8):
        image = np.full((200, 300), 120.0 + rng.normal(0.0, 30.0))
        image[60:120, 100:130] = 120.0 + rng.normal(0.0, 3.0)
        image[60:180, 60:100] = 50.0
        images.append(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(size=image.shape))
    for row, begins in ((65.0, False), (130.0, True)):
        assert begins_right_of_the_finger(images, row, edges_come_and_go=False) == begins


@pytest.mark.parametrize(("table_px", "begins"), [(110, True), (30, False)])
def test_a_calm_plain_table_larger_than_all_that_stays_is_a_background(table_px: int, begins: bool) -> None:
    """It is lit alike in all images and no edge crosses it, while walls and things come and go beside it: as calm as a
    pad, but no gripper has a part without an edge that is larger than all of it that shows.
    """
    rng, images = np.random.default_rng(4), []
    for _ in range(8):
        image = np.full((200, 300), 120.0 + rng.normal(0.0, 30.0))
        image[100:180, 100 : 100 + table_px] = 140.0 + rng.normal(0.0, 3.0)
        image[60:180, 60:100] = 50.0
        images.append(cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(size=image.shape))
    assert begins_right_of_the_finger(images, 120.0, edges_come_and_go=False) == begins


def test_pieces_of_a_curve_meet_on_both_lines_wherever_between_them_that_is() -> None:
    """A long side is seen less far than its line goes on; halfway across the gap a vertex would tilt it."""
    a, turn_rad = np.array([101.0, 0.0]), np.radians(10.0)
    lines, ends = [], [np.array([[0.0, 0.0], [99.5, 0.0]])]
    ends.append(a + np.array([10.0, 20.0])[:, None] * [np.cos(turn_rad), np.sin(turn_rad)])
    for end in ends:
        way = (end[1] - end[0]) / np.linalg.norm(end[1] - end[0])
        normal = np.array([-way[1], way[0]])
        distance = float(normal @ end[0])
        lines.append(PieceLine(normal, distance, np.tile(normal, (5, 1)), np.full(5, distance), 0.05, end))
    chain = _joined(CAMERA, np.vstack(ends), lines, [(0, 1), (2, 3)], closed=False)
    assert not chain.corner.any()
    assert np.abs(chain.uv_px[1] - from_ideal_px(CAMERA, a[None])[0]).max() < 0.01


def test_pieces_that_pass_each_other_at_a_step_go_on_as_far_as_it_does() -> None:
    """Halfway across a step of 5 px the vertex would lie 2.5 px beside both."""
    lines, ends = [], [np.array([[0.0, 0.0], [50.0, 0.0]]), np.array([[53.0, 5.0], [90.0, 5.0]])]
    for end in ends:
        normal, distance = np.array([0.0, 1.0]), float(end[0, 1])
        lines.append(PieceLine(normal, distance, np.tile(normal, (5, 1)), np.full(5, distance), 0.05, end))
    chain = _joined(CAMERA, np.vstack(ends), lines, [(0, 1), (2, 3)], closed=False)
    assert not chain.corner.any()
    at = np.array([[0.0, 0.0], [51.5, 0.0], [51.5, 5.0], [90.0, 5.0]])
    assert np.abs(chain.uv_px - from_ideal_px(CAMERA, at)).max() < 0.01
