"""Which frames are refused before anything is measured, why, and in which words."""

from __future__ import annotations

import numpy as np
import pytest
from support.simulated import PAPER_LENS, sharp_gripper

from gripmon.judge.inspection import inspect
from gripmon.model.camera import make_camera
from gripmon.model.pixels import in_full_scale
from gripmon.model.records import Frame, Refusal

CAMERA, GRIPPER = make_camera(PAPER_LENS), sharp_gripper()
HEIGHT, WIDTH = PAPER_LENS.height_px, PAPER_LENS.width_px
RAMP = np.tile(np.linspace(0.1, 0.9, WIDTH), (HEIGHT, 1))


def frame(image: object, jaw_opening_m: float | None = None, fault: str | None = None) -> Frame:
    return Frame(0, 0, image, jaw_opening_m=jaw_opening_m, fault=fault)  # type: ignore[arg-type]


def grey(level: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), round(255 * level), np.uint8)


def spoiled(value: float) -> np.ndarray:
    image = RAMP.astype(np.float32)
    image[HEIGHT // 2 :, : WIDTH // 2] = value
    return image


@pytest.mark.parametrize(
    "image",
    [
        (RAMP * 255).astype(np.uint8),
        (RAMP * 65535).astype(np.uint16),
        RAMP.astype(np.float32),
        np.repeat((RAMP * 255).astype(np.uint8)[..., None], 3, axis=2),
        np.asfortranarray((RAMP * 255).astype(np.uint8)),
        grey(0.5) + np.arange(WIDTH, dtype=np.uint8) % 5,  # hardly any contrast, but more than none
        (RAMP * 0.05 * 255).astype(np.uint8),  # dark, but not black
    ],
    ids=["uint8", "uint16", "float32", "colour", "columns first", "faint", "dark"],
)
def test_frames_that_can_be_measured_pass(image: np.ndarray):
    assert inspect(frame(image, 0.03), CAMERA, GRIPPER) is None


@pytest.mark.parametrize(
    ("image", "reason", "came", "right"),
    [
        (None, Refusal.NOT_AN_IMAGE, "there is no image", ""),
        ([[1, 2], [3, 4]], Refusal.NOT_AN_IMAGE, "there is no image", ""),
        (np.zeros(WIDTH, np.uint8), Refusal.WRONG_TYPE, "(768,)", "H x W"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), Refusal.WRONG_TYPE, "(576, 768, 4)", "BGR"),
        (np.zeros((2, HEIGHT, WIDTH, 3), np.uint8), Refusal.WRONG_TYPE, "(2, 576, 768, 3)", "H x W"),
        (np.zeros((WIDTH, HEIGHT), np.uint8), Refusal.WRONG_SIZE, "576x768", "768x576"),
        (np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8), Refusal.WRONG_SIZE, "384x288", "768x576"),
        (np.zeros((0, 0), np.uint8), Refusal.WRONG_SIZE, "0x0", "768x576"),
        (RAMP, Refusal.WRONG_TYPE, "float64", "uint8, uint16 or float32"),
        ((RAMP * 100).astype(np.int16), Refusal.WRONG_TYPE, "int16", "uint8, uint16 or float32"),
        (RAMP > 0.5, Refusal.WRONG_TYPE, "bool", "uint8, uint16 or float32"),
        ((RAMP * 255).astype(np.float32), Refusal.WRONG_TYPE, "to 227", "0 to 1"),
        (RAMP.astype(np.float32) - 0.5, Refusal.WRONG_TYPE, "from -0.39", "0 to 1"),
        (spoiled(np.nan), Refusal.NOT_FINITE, "NaN", "0 to 1"),
        (spoiled(np.inf), Refusal.NOT_FINITE, "infinite", "0 to 1"),
        (spoiled(-np.inf), Refusal.NOT_FINITE, "infinite", "0 to 1"),
        (grey(0.0), Refusal.BLACK, "0 %", "full scale"),
        ((RAMP * 0.019 * 65535).astype(np.uint16), Refusal.BLACK, "2 %", "full scale"),
        (grey(1.0), Refusal.WHITE, "100 %", "full scale"),
        (np.ones((HEIGHT, WIDTH), np.float32), Refusal.WHITE, "100 %", "full scale"),
        (grey(0.5), Refusal.FLAT, "0.0 %", "full scale"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_measured_are_refused_in_words(image: object, reason: Refusal, came: str, right: str):
    found = inspect(frame(image), CAMERA, GRIPPER)
    assert found is not None
    assert found[0] is reason
    assert came in found[1], found[1]
    assert right in found[1], found[1]


@pytest.mark.parametrize("opening_m", [None, -0.0009, 0.034, 0.0609])
def test_openings_within_a_millimetre_of_the_jaws_range_pass(opening_m: float | None):
    assert inspect(frame((RAMP * 255).astype(np.uint8), opening_m), CAMERA, GRIPPER) is None


@pytest.mark.parametrize("opening_m", [-0.0011, 0.0611, 34.0, float("nan"), float("inf")])
def test_openings_beyond_the_jaws_range_are_refused(opening_m: float):
    found = inspect(frame((RAMP * 255).astype(np.uint8), opening_m), CAMERA, GRIPPER)
    assert found is not None and found[0] is Refusal.JAW_OPENING
    assert "0 to 0.06 m" in found[1]


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_bits_that_a_camera_leaves_empty(bits: int):
    """Mono10 and Mono12 in 16 bits: the lowest ones.  What was black before is the picture that it is."""
    top = (1 << bits) - 1
    filled = np.round(RAMP * top).astype(np.uint16)
    filled[0, :2] = 0, top
    scaled = in_full_scale(frame(filled), bits)
    assert inspect(scaled, CAMERA, GRIPPER) is None and scaled.image is not None
    assert scaled.image.dtype == np.uint16 and scaled.image[0, :2].tolist() == [0, 65535]
    np.testing.assert_allclose(scaled.image / 65535.0, filled / top, atol=1.0 / 65535.0 + 1e-9)
    assert filled.max() == top, "the caller's image stays what it is"
    again = in_full_scale(scaled, bits)
    assert again is scaled, "as a recorded one comes back"
    dark = in_full_scale(frame((filled >> max(bits - 4, 0)).astype(np.uint16)), bits)
    assert in_full_scale(dark, bits) is dark, "nor does a dark one become bright"
    brighter = filled.copy()
    brighter[5, 5] = top + 1
    refused = inspect(in_full_scale(frame(brighter), bits), CAMERA, GRIPPER)
    assert refused == (Refusal.WRONG_TYPE, f"grey level {top + 1}; at most {top} with monitor.bit_depth {bits}")


def test_bit_depth_is_about_16_bits_only():
    for image in ((RAMP * 255).astype(np.uint8), RAMP.astype(np.float32), None):
        assert in_full_scale(frame(image), 12).image is image
    whole = frame((RAMP * 65535).astype(np.uint16))
    assert in_full_scale(whole, 16) is whole
    ten = inspect(frame((RAMP * 1023).astype(np.uint16)), CAMERA, GRIPPER)
    assert ten is not None and ten[0] == Refusal.BLACK and "monitor.bit_depth" in ten[1]
    assert "bit_depth" not in str(inspect(frame(np.zeros((HEIGHT, WIDTH), np.uint16)), CAMERA, GRIPPER))
