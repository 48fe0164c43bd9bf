"""The compiled sampler against OpenCV's own interpolation; what is found in its profiles: test_edge_profiles.py."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gripmon.track.edges.profiles import full_scale, read_profiles

HEIGHT, WIDTH = 576, 768


def picture(kind: str, low: float = 0.0, high: float = 1.15, seed: int = 1) -> np.ndarray:
    """Edges, texture and noise, from ``low`` to ``high``; what is beyond the range from 0 to 1 is cut off."""
    rng = np.random.default_rng(seed)
    colours = (3,) if kind.endswith("colour") else ()
    coarse = rng.uniform(size=(HEIGHT // 16 + 1, WIDTH // 16 + 1, *colours))
    blocks = np.kron(coarse, np.ones((16, 16, *(1 for _ in colours))))[:HEIGHT, :WIDTH]
    light = gaussian_filter(blocks, (0.7, 0.7, *(0.0 for _ in colours)))
    light = low + (high - low) * light + rng.normal(scale=0.01, size=light.shape)
    if kind.startswith("float32"):
        return np.clip(light, 0.0, 1.0).astype(np.float32)
    most = 255.0 if kind.startswith("uint8") else 65535.0
    return np.rint(np.clip(light, 0.0, 1.0) * most).astype(kind.split()[0])


KINDS = [f"{dtype}{colour}" for dtype in ("uint8", "uint16", "float32") for colour in ("", " colour")]


def maps(seed: int = 2, zoom: float = 1.0, inside: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """(3, n, 29) places of profiles in all directions; some beyond the image unless ``inside``."""
    rng = np.random.default_rng(seed)
    margin = 30.0 * zoom if inside else -12.0
    at = np.column_stack([rng.uniform(margin, size - 1.0 - margin, 200) for size in (WIDTH, HEIGHT)])
    angle = rng.uniform(0.0, 2.0 * np.pi, len(at))
    angle[:40] = rng.integers(0, 8, 40) * np.pi / 4.0
    along, across = zoom * np.arange(-14, 15) * 0.5, zoom * np.arange(-1.0, 2.0)[:, None, None]
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    map_x, map_y = at[:, :1] + c * along - across * s, at[:, 1:] + s * along + across * c
    return map_x.astype(np.float32), map_y.astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_samples_are_those_of_opencv_but_for_its_roundings(kind: str):
    """OpenCV rounds places to 1/32 px and, of whole numbers, what it interpolates to a grey level."""
    image, (map_x, map_y) = picture(kind, 0.25, 0.75), maps(inside=False)
    rounded = [np.round(place * 32.0) / 32.0 for place in (map_x, map_y)]
    rows = [place.reshape(-1, place.shape[-1]) for place in rounded]
    seen = cv2.remap(image, *rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(float)
    if seen.ndim == 3:
        seen = seen @ [0.114, 0.587, 0.299]
    one_by_one = read_profiles(image, *(place[None] for place in rows))
    # Half a grey level, and the tables' sixteen bits.
    whole = image.dtype != np.float32
    assert np.abs(one_by_one - seen).max() < 0.5 * whole + 3e-4 * full_scale(image)
    together = one_by_one.reshape(map_x.shape).mean(axis=0)
    np.testing.assert_allclose(read_profiles(image, *rounded), together, rtol=0.0, atol=1e-9 * full_scale(image))
    if image.dtype == np.uint8:
        assert np.abs(seen - one_by_one).std() > 0.1, "what is no longer rounded"


def test_nothing_rounds_a_sample_to_a_grey_level():
    """A ramp of a tenth of a grey level a pixel, dithered by nothing: interpolated in uint8 it would be stairs."""
    image = np.tile(np.array([100, 101], dtype=np.uint8).repeat(20), (40, 1))
    place = np.linspace(18.0, 21.0, 61, dtype=np.float32)[None, None]
    profile = read_profiles(image, place, np.full_like(place, 20.0))[0]
    assert len(np.unique(np.round(profile, 9))) > 15
    assert 100.45 < profile[30] < 100.55


def test_images_may_be_read_only_or_parts_of_others():
    image = picture("uint8 colour")
    expected = read_profiles(image, *maps())
    frozen = np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape)
    wide = np.zeros((HEIGHT, WIDTH + 5, 3), np.uint8)
    wide[:, 5:] = image
    for same in (frozen, wide[:, 5:], np.asfortranarray(image)):
        np.testing.assert_array_equal(read_profiles(same, *maps()), expected)
    assert image.flags.writeable


def test_places_that_are_no_numbers_are_read_at_the_border():
    image = picture("uint8")
    place = np.array([np.nan, -np.inf, np.inf, 1e9, -1e9], dtype=np.float32)[None, None]
    profile = read_profiles(image, place, np.full_like(place, 7.0))[0]
    np.testing.assert_allclose(profile, image[7, [0, 0, -1, -1, 0]], atol=1e-9)
