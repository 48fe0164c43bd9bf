"""Laser spots in rendered images: where to a part of a pixel, how well that is known, and when there is none."""

from __future__ import annotations

import numpy as np
import pytest
from laser_images import cluttered, spot_image

from gripmon.calibration.laser.spots import find_spots
from gripmon.calibration.sighting import NotFound


def errors(trials=30, *, off=False, **options):
    """Errors (n, 2) of the first candidate and their covariances (n, 2, 2)."""
    out, covariances = [], []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        truth = rng.uniform([60.0, 60.0], [580.0, 420.0])
        kinds = dict(options)
        if kinds.pop("cluttered", False):
            kinds["ambient"] = cluttered(rng)
        image = spot_image(truth, rng, **kinds)
        dark = spot_image(truth, rng, **{**kinds, "height": 0.0, "reflections": ()}) if off else None
        found = find_spots(image, dark)
        assert not isinstance(found, NotFound), found
        out.append(found[0].uv_px - truth)
        covariances.append(found[0].covariance_px)
    return np.array(out), np.array(covariances)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(
    ("limit_px", "options"),
    [
        (0.05, {}),
        (0.06, {"height": 1500.0}),  # a core of twelve pixels that is saturated
        (0.05, {"colour": True}),
        (0.05, {"dtype": np.uint16}),
        (0.12, {"height": 60.0}),
        (0.05, {"sigma_px": 1.2}),
        (0.2, {"sigma_px": 7.0}),
        (0.7, {"speckle": 0.6}),
        (0.15, {"cluttered": True, "off": True}),
    ],
)
def test_the_spot_is_found_to_a_part_of_a_pixel(limit_px, options):
    found, _ = errors(**options)
    assert rms(found) < limit_px


@pytest.mark.parametrize("options", [{"speckle": 0.4}, {"speckle": 0.8, "sigma_px": 5.0}, {"height": 60.0}])
def test_the_covariance_says_how_wrong_it_is_within_a_factor(options):
    found, covariances = errors(60, **options)
    size = np.einsum("ni,nij,nj->n", found, np.linalg.inv(covariances), found) / 2.0
    # Standard deviations within a factor of two: one spot's own speckle says no more.
    assert 0.25 < np.median(size) / 0.693 < 4.0
    assert np.mean(covariances) < np.mean(errors(20, speckle=1.0, sigma_px=8.0)[1])


def test_a_laser_off_image_takes_a_lamp_away_that_outshines_the_spot():
    rng = np.random.default_rng(2)
    lamp = ((400.0, 100.0, 200.0),)
    truth = np.array([200.3, 300.7])
    image = spot_image(truth, rng, height=80.0, reflections=lamp)
    dark = spot_image(truth, rng, height=0.0, reflections=lamp)
    alone = find_spots(image)
    assert not isinstance(alone, NotFound)
    assert len(alone) == 2 and np.abs(alone[1].uv_px - truth).max() < 0.2  # the lamp comes first
    with_dark = find_spots(image, dark)
    assert not isinstance(with_dark, NotFound)
    assert np.abs(with_dark[0].uv_px - truth).max() < 0.2


def test_a_saturated_core_is_reported():
    rng = np.random.default_rng(4)
    for height, least, most in ((150.0, 0.0, 0.0), (2000.0, 0.3, 1.0)):
        found = find_spots(spot_image(np.array([300.0, 200.0]), rng, height=height))
        assert not isinstance(found, NotFound)
        assert least <= found[0].saturated <= most


@pytest.mark.parametrize("kind", ["nothing", "black", "white", "smooth light", "one hot pixel"])
def test_no_spot_is_said(kind):
    rng = np.random.default_rng(5)
    image = {
        "nothing": spot_image(np.array([300.0, 200.0]), rng, height=0.0),
        "black": np.zeros((480, 640), np.uint8),
        "white": np.full((480, 640), 255, np.uint8),
        "smooth light": spot_image(np.array([320.0, 240.0]), rng, height=100.0, sigma_px=120.0),
        "one hot pixel": spot_image(np.array([300.0, 200.0]), rng, height=0.0),
    }[kind]
    if kind == "one hot pixel":
        image[100, 100] = 255
    found = find_spots(image)
    assert isinstance(found, NotFound)
    assert found.reason.startswith("no spot")


def test_a_laser_off_image_of_another_size_is_refused():
    rng = np.random.default_rng(6)
    image = spot_image(np.array([300.0, 200.0]), rng)
    found = find_spots(image, image[:200])
    assert isinstance(found, NotFound)
    assert "640 x 200" in found.reason
