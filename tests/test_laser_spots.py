"""Laser spots in rendered images: where to a part of a pixel, how well that is known, and when there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gripmon.calibrate.sighting import NotFound
from gripmon.laser.spots import find_spots
from gripmon.simulate.laser import cluttered, spot_image


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
        (0.06, {"height": 1500.0}),  # a core of twelve pixels that is saturated
        (0.05, {"colour": True, "dtype": np.uint16}),
        (0.12, {"height": 60.0}),
        (0.2, {"sigma_px": 7.0}),
        (0.7, {"speckle": 0.6}),
        (0.15, {"cluttered": True, "off": True}),
    ],
)
def test_the_spot_is_found_to_a_part_of_a_pixel(limit_px, options):
    found, _ = errors(**options)
    assert rms(found) < limit_px


@pytest.mark.parametrize("options", [{"speckle": 0.8, "sigma_px": 5.0}, {"height": 60.0}])
def test_the_covariance_says_how_wrong_it_is_within_a_factor(options):
    found, covariances = errors(40, **options)
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


def test_many_wide_faint_things_don_t_crowd_the_spot_out():
    """Without an image with the laser off: a plane with smudges, each wider than the spot and far fainter."""
    rng = np.random.default_rng(7)
    size, truth = (900, 700), np.array([452.3, 347.8])
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(float)
    ambient = np.full((size[1], size[0]), 60.0)
    for x in range(60, 900, 90):
        for y in range(50, 700, 100):
            ambient += 25.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * 8.0**2))
    found = find_spots(spot_image(truth, rng, size_px=size, ambient=ambient))
    assert not isinstance(found, NotFound)
    assert np.linalg.norm(found[0].uv_px - truth) < 0.3


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


def test_a_spot_that_the_border_cuts_is_none():
    rng = np.random.default_rng(7)
    found = find_spots(spot_image(np.array([2.0, 200.0]), rng))
    assert isinstance(found, NotFound)
    assert "cut off by the image's border" in found.reason


def scene_image(kind, rng, truth):
    """Image, laser-off image or None: conditions that no other test has."""
    v, u = np.mgrid[0:480, 0:640].astype(float)
    spot = np.exp(-((u - truth[0]) ** 2 + (v - truth[1]) ** 2) / 18.0)

    def grains(width):
        parts = [cv2.GaussianBlur(rng.normal(size=u.shape), (0, 0), width / 2.355) for _ in range(2)]
        return sum(np.square(part) for part in parts) / np.mean(sum(np.square(part) for part in parts))

    def taken(light):
        return np.clip(np.rint(light + rng.normal(0.0, 2.0, light.shape)), 0, 255).astype(np.uint8)

    texture = sum(cv2.GaussianBlur(rng.normal(size=u.shape), (0, 0), s) * s for s in (1.0, 2.0, 4.0, 8.0))
    if kind == "textured plane":
        return taken(90.0 + 15.0 * texture / texture.std() + 150.0 * spot), None
    if kind == "steep light":
        return taken(20.0 + 190.0 / (1.0 + np.exp(np.clip((truth[0] + 8.0 - u) / 6.0, -50, 50))) + 60.0 * spot), None
    if kind == "whole speckle":  # contrast 1, as a laser on a rough surface has it
        return taken(30.0 + 150.0 * spot * grains(2.5)), None
    if kind == "saturated speckle":
        return taken(30.0 + 800.0 * spot * grains(2.5)), None
    if kind == "shadow that moved":
        shadow = 60.0 * (u > rng.uniform(100.0, 500.0))
        return taken(100.0 - shadow + 120.0 * spot), taken(np.full(u.shape, 100.0))
    assert kind == "smeared"
    along = np.array([np.cos(1.0), np.sin(1.0)])
    places = [truth + t * 25.0 * along for t in np.linspace(-0.5, 0.5, 25)]
    streak = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / 12.5) for x, y in places)
    return taken(30.0 + 120.0 * streak), None


@pytest.mark.parametrize(
    ("kind", "limit_px"),
    [
        ("textured plane", 0.4),
        ("steep light", 0.5),
        ("whole speckle", 1.0),
        ("saturated speckle", 0.7),
        ("shadow that moved", 0.06),
        ("smeared", 0.05),
    ],
)
def test_what_light_and_surface_do_to_the_spot_is_in_its_covariance(kind, limit_px):
    found, sizes = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        truth = rng.uniform([60.0, 60.0], [580.0, 420.0])
        spots = find_spots(*scene_image(kind, rng, truth))
        assert not isinstance(spots, NotFound), spots
        error = spots[0].uv_px - truth
        found.append(error)
        sizes.append(error @ np.linalg.solve(spots[0].covariance_px, error) / 2.0)
    assert rms(found) < limit_px
    # Normalised squares are 1 for what is stated exactly; standard deviations are within a factor of about two.
    assert np.mean(sizes) < 4.5
    assert np.median(sizes) / 0.693 < 5.0
