"""What edges that stay leave open of a finger, grey levels that stay amend."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from support.changing_backgrounds import CAMERA

from gripmon.model.staying import Edges
from gripmon.teach.constant_grey import amended
from gripmon.teach.fingers import Parts
from gripmon.teach.image_outline import see_opening
from gripmon.teach.matte import Matte

SHAPE = (CAMERA.height_px, CAMERA.width_px)
LEFT, RIGHT = np.s_[200:, 120:220], np.s_[200:, 420:520]
FACE = np.s_[200:, 220:260]
"""Of the left finger, as grey as the background is on average."""


def images(count: int, own_light: float = 0.0) -> list[np.ndarray]:
    """Two fingers of 190 before backgrounds of 60 to 140."""
    rng, out = np.random.default_rng(4), []
    for _ in range(count):
        blots = cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), 2.5)
        image = 100.0 + 20.0 / blots.std() * blots
        image[LEFT] = image[RIGHT] = 190.0
        image[FACE] = 100.0 * (1.0 + own_light * rng.normal())
        out.append((cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(size=SHAPE)).astype(np.float32))
    return out


def matte_of(stack: list[np.ndarray]) -> Matte:
    none = np.zeros(SHAPE, np.float32)
    edges = Edges(none, none, none > 0, none > 0, 0.0)
    return Matte(none > 0, edges, 1.0, np.stack(stack), np.zeros((len(stack), 2)), tuple(range(len(stack))), {})


def mask(*parts: tuple[slice, slice]) -> np.ndarray:
    out = np.zeros(SHAPE, bool)
    for part in parts:
        out[part] = True
    return out


def test_a_face_as_grey_as_the_background_is_added_and_what_changes_taken_away() -> None:
    rubbish = np.s_[400:, 60:120]
    parts = Parts((mask(LEFT, rubbish), mask(RIGHT)), (np.zeros(2), np.zeros(2)), mask())
    found = amended(matte_of(images(10)), parts).fingers
    for part, true in zip(found, (mask(LEFT, FACE), mask(RIGHT)), strict=True):
        beside = cv2.dilate(true.astype(np.uint8), np.ones((9, 9))) - cv2.erode(true.astype(np.uint8), np.ones((9, 9)))
        assert not ((part != true) & (beside == 0)).any(), "but for 4 px on either side of its border"


def test_outside_of_a_persons_boxes_nothing_is_added() -> None:
    """As around fingers without what they hold, which stays as well."""
    parts = Parts((mask(LEFT), mask(RIGHT)), (np.zeros(2), np.zeros(2)), mask())
    height, width = SHAPE
    found = amended(matte_of(images(10)), parts, ((0, 0, 219, height - 1), (400, 0, width - 1, height - 1))).fingers
    assert not found[0][FACE].any() and found[0][LEFT].mean() > 0.95 and found[1][RIGHT].mean() > 0.95


def test_a_face_in_a_light_of_its_own_stays_where_edges_enclose_it() -> None:
    """Its grey levels change like those of a background; then the part is what the rest of it encloses."""
    inside = np.s_[300:340, 150:190]
    stack = images(10)
    for k, image in enumerate(stack):
        image[inside] = 60.0 + 8.0 * k
    parts = Parts((mask(LEFT, FACE), mask(RIGHT)), (np.zeros(2), np.zeros(2)), mask())
    assert amended(matte_of(stack), parts).fingers[0][inside].all()


@pytest.mark.parametrize("count", [6, 12])
def test_the_outline_has_the_face(count: int) -> None:
    seen = see_opening(CAMERA, images(count), 0.3)
    left = min(seen.fingers, key=lambda finger: np.argwhere(finger.mask)[:, 1].mean())
    true, off = mask(LEFT, FACE), []
    inner = cv2.distanceTransform(true.astype(np.uint8), cv2.DIST_L2, 5)
    outer = cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, 5)
    for chain in left.chains:
        for a, b in chain.pieces:
            ends = chain.uv_px[[a, b]]
            way = ends[1] - ends[0]
            at = ends[0] + np.linspace(0.0, 1.0, int(np.linalg.norm(way)) + 1)[:, None] * way
            u, v = np.clip(np.rint(at).astype(int), 0, np.array(SHAPE[::-1]) - 1).T
            off += np.maximum(inner[v, u], outer[v, u]).tolist()
    assert len(off) > 0.8 * (140 + 2 * (SHAPE[0] - 200)), "all sides of it"
    assert np.quantile(off, 0.95) < 2.0, "pixels beside a border are 1 px from the other side"
