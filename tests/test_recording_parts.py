"""Parts of the recording by themselves: shared images, pixels, colours, labels."""

from __future__ import annotations

from collections import Counter

import numpy as np
from support.recorded import HEIGHT_PX, WIDTH_PX

from gripmon.model.pixels import to_8_bit
from gripmon.model.records import State, Verdict
from gripmon.model.shared_images import SharedImages
from gripmon.record.columns import Palette
from gripmon.record.overlay import _label_places


def test_shared_images_keep_apart() -> None:
    ring = SharedImages(3, WIDTH_PX, HEIGHT_PX)
    rng = np.random.default_rng(5)
    pictures = [
        rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8),
        rng.integers(0, 65535, (HEIGHT_PX, WIDTH_PX), np.uint16)[::2, ::3],
        rng.random((HEIGHT_PX, WIDTH_PX, 3), np.float32),
    ]
    notes = [ring.put(slot, picture) for slot, picture in enumerate(pictures)]
    for note, picture in zip(notes, pictures, strict=True):
        assert ring.takes(picture)
        np.testing.assert_array_equal(ring.get(note), picture)
    ring.close()


def test_an_image_that_another_one_took_the_place_of_is_none() -> None:
    ring = SharedImages(2, WIDTH_PX, HEIGHT_PX)
    first, second, third = (np.full((HEIGHT_PX, WIDTH_PX), grey, np.uint8) for grey in (1, 2, 3))
    one, two = ring.put(0, first), ring.put(1, second)
    kept = ring.copy(one)
    ring.put(2, third)
    assert kept is not None and (kept == first).all(), "a copy stays what it was"
    assert ring.copy(one) is None and (ring.copy(two) == second).all()
    ring.close()


def test_deep_pixels_become_8_bit() -> None:
    np.testing.assert_array_equal(to_8_bit(np.array([[0, 255, 256, 65535]], np.uint16)), [[0, 0, 1, 255]])
    floats = np.array([[0.0, 0.5, 1.0, 7.0, -1.0, np.nan]], np.float32)
    np.testing.assert_array_equal(to_8_bit(floats), [[0, 128, 255, 255, 0, 0]])


def test_every_state_and_verdict_has_its_own_colour() -> None:
    assert set(Palette.STATES) == set(State) and set(Palette.VERDICTS) == set(Verdict)
    assert max(Counter(Palette.STATES.values()).values()) == 1


def test_labels_keep_off_the_edges_and_each_other() -> None:
    corners = [(100.0, 50.0), (140.0, 52.0), (110.0, 150.0), (300.0, 49.0)]
    places = _label_places(corners, step_px=10.0)
    assert [u for u, _ in places] == [u for u, _ in corners]
    assert places[0][1] < 50.0 and places[1][1] < 52.0 and places[3][1] < 49.0 and places[2][1] > 150.0
    assert abs(places[0][1] - places[1][1]) > 5.0  # neighbours stand on two levels
    assert _label_places([], 10.0) == []
