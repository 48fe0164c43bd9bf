"""Pieces of a finger's outline that the images of another opening contradict: a finger slides, a bar on it turns."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from support.changing_backgrounds import CAMERA

from gripmon.model.records import Array
from gripmon.teach import other_openings
from gripmon.teach.finger_depth import PlacedOutlines
from gripmon.teach.image_motion import FingerMoved
from gripmon.teach.motion_depth import Moved
from gripmon.teach.vanishing import Outline

FINGER_PX = np.array([(360.0, 560.0), (360.0, 200.0), (300.0, 200.0), (300.0, 560.0)])
BAR_PX = np.array([(360.0, 400.0), (420.0, 400.0), (420.0, 380.0), (360.0, 380.0)])
OUTLINE_PX = np.vstack([FINGER_PX[:1], BAR_PX, FINGER_PX[1:]])
PIECES = tuple((k, k + 1) for k in range(7))
BAR = frozenset(PIECES[1:4])
SLIDES_PX, NARROW = np.array([-30.0, 0.0]), 0.02
PALM_PX = np.array([(200.0, 450.0), (300.0, 450.0), (300.0, 575.0), (200.0, 575.0)])
"""It hides what is left of the finger's lower part, once that has slid."""
XY = CAMERA.undistort(OUTLINE_PX)
BLUR_PX = 0.8


def turned(points: Array, degrees: float) -> Array:
    """About the middle of the bar's root."""
    angle, pin = np.radians(degrees), np.array([360.0, 390.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray((points - pin) @ turn.T + pin)


def seen(degrees: float) -> Any:
    """Images of the narrow opening, drawn: the finger has slid, its bar has turned, before eight backgrounds."""
    shape, fine = (CAMERA.height_px, CAMERA.width_px), 8.0
    covered = np.zeros((4 * shape[0], 4 * shape[1]), np.uint8)
    moves = CAMERA.undistort(OUTLINE_PX[:1] + SLIDES_PX) - XY[:1]
    for polygon in (FINGER_PX, turned(BAR_PX, degrees), PALM_PX - SLIDES_PX):
        share = np.linspace(0.0, 1.0, 50)[:, None]
        ideal = CAMERA.undistort(polygon)
        sides = np.vstack([a + share * (b - a) for a, b in zip(ideal, np.roll(ideal, -1, axis=0), strict=True)])
        points = 4.0 * (CAMERA.distort(sides + moves) + 0.5) - 0.5
        cv2.fillPoly(covered, [np.rint(fine * points).astype(np.int32)], 255, shift=3)
    part = cv2.resize(covered, shape[::-1], interpolation=cv2.INTER_AREA).astype(float) / 255.0
    rng, images = np.random.default_rng(1), []
    for _ in range(8):
        table = cv2.resize(rng.normal(0.0, 1.0, (24, 32)), shape[::-1], interpolation=cv2.INTER_CUBIC)
        image = (1.0 - part) * (80.0 + 35.0 * table) + 215.0 * part
        images.append(cv2.GaussianBlur(image, (0, 0), BLUR_PX) + rng.normal(0.0, 1.0, shape))
    return SimpleNamespace(matte=SimpleNamespace(images=np.array(images, np.float32), still=part > 0.5, noise=1.0))


def placed(*, flat: bool = False) -> PlacedOutlines:
    points = np.column_stack([XY, np.ones(len(XY))])
    return PlacedOutlines((points,), (PIECES,), np.eye(3), np.array([0.0, 0.0, 1.0]), flat, np.zeros(3))


def moved() -> dict[float, list[FingerMoved]]:
    shift = CAMERA.undistort(OUTLINE_PX[:1] + SLIDES_PX)[0] - XY[0]
    return {NARROW: [FingerMoved(np.array([*shift, 0.0]))]}


def wrong(degrees: float, **kinds: bool) -> Any:
    return other_openings.contradicted(CAMERA, placed(**kinds), moved(), {NARROW: seen(degrees)}, BLUR_PX)[0][0]


@pytest.mark.parametrize("degrees", [-20.0, 20.0])
def test_a_bar_that_turns_while_its_finger_slides_contradicts_the_motion(degrees: float) -> None:
    """What the palm and the bar itself hide of the finger then doesn't."""
    assert wrong(degrees) == BAR


def test_a_bar_that_slides_with_its_finger_is_part_of_it() -> None:
    # Its end lies 60 px from the pin: 0.3 degrees are 0.3 px there, less than an outline is known to at worst.
    assert wrong(0.0) == wrong(0.3) == frozenset()


def test_an_outline_that_is_assumed_flat_may_lie_elsewhere() -> None:
    assert wrong(20.0, flat=True) == frozenset()


def test_what_hangs_on_a_bar_alone_goes_with_it() -> None:
    """Of a chain cut in two by a piece that turns, one part of which is seen elsewhere, and of a piece by itself."""
    hanging = other_openings._hanging_on(frozenset({(2, 3)}), frozenset({(5, 6)}), [*PIECES, (9, 10)])
    assert hanging == {(0, 1), (1, 2)}


@pytest.mark.parametrize(("bar_px", "left"), [(10.0, PIECES[:1] + PIECES[4:]), (1000.0, PIECES)])
def test_a_finger_is_written_without_its_bar(
    bar_px: float, left: tuple[Any, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where most of an outline contradicts the motion it isn't the fingers'."""
    lengths = np.where([piece in BAR for piece in PIECES], bar_px, 100.0)
    none = np.zeros((0, 2, 2)), np.zeros(0)
    whole = Outline("finger", XY, np.ones(len(XY), bool), PIECES, np.array([0.0, -1.0]), lengths, *none)

    monkeypatch.setattr(other_openings, "finger_outlines", lambda *_: [whole])
    monkeypatch.setattr(other_openings, "place", lambda *_: placed())
    monkeypatch.setattr(other_openings, "move", lambda *given, **_: (given[4], Moved(moved(), None)))
    first: Any = SimpleNamespace(blur_px=BLUR_PX)
    notes: list[str] = []
    outlines, made, motion = other_openings.place_and_move(CAMERA, first, {NARROW: seen(20.0)}, notes=notes)
    assert outlines[0].pieces == made.kept[0] == left and len(outlines[0].length_px) == len(left)
    assert bool(motion.by_opening) == (left != PIECES) == any("3 outer edges" in note for note in notes)
    assert left != PIECES or "% of the outlines are seen where" in motion.why
