"""Edge candidates on analytic images: a step blurred by a Gaussian is an error function, so every offset is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

from gripmon.track.edges.profiles import (
    Candidates,
    estimate_noise,
    find_candidates,
    full_scale,
    profile_offsets_px,
    quantum,
    read_profiles,
)
from gripmon.track.edges.settings import EdgeSettings

SIZE = 160
CENTRE = np.array([79.3, 80.6])
REACH_PX = 7.0
ANGLES_DEG = [0.0, 7.0, 33.0, 45.0, 90.0, 128.0, 180.0, 251.0]


def step_image(
    angle_deg: float, blur_px: float, *, low: float = 60.0, high: float = 170.0, second_px: float | None = None
) -> np.ndarray:
    """Brighter on the side that ``angle_deg`` (of the normal, from u towards v) points to; ``second_px``: dark again so
    far on.
    """
    normal = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    distance = (u - CENTRE[0]) * normal[0] + (v - CENTRE[1]) * normal[1]
    share = 0.5 + 0.5 * erf(distance / (np.sqrt(2.0) * blur_px))
    if second_px is not None:
        share = share - (0.5 + 0.5 * erf((distance - second_px) / (np.sqrt(2.0) * blur_px)))
    return low + (high - low) * share


def profiles_of(
    image: np.ndarray, angle_deg: float, shift_px: np.ndarray, count: int = 60, zoom: int = 1
) -> np.ndarray:
    """Profiles along the normal at points along the edge, each shifted off the edge by its ``shift_px``."""
    normal = np.array([np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))])
    along = np.array([-normal[1], normal[0]])
    points = CENTRE + np.linspace(-40.0, 40.0, count)[:, None] * along + np.asarray(shift_px)[:, None] * normal
    offsets = zoom * profile_offsets_px(REACH_PX)
    map_x = (points[:, :1] + normal[0] * offsets).astype(np.float32)
    map_y = (points[:, 1:] + normal[1] * offsets).astype(np.float32)
    return read_profiles(image, map_x, map_y)


def candidates_of(
    image: np.ndarray, angle_deg: float, shift_px: np.ndarray, zoom: int = 1, **settings: float
) -> Candidates:
    profiles = profiles_of(image, angle_deg, shift_px, len(shift_px), zoom)
    noise = estimate_noise(profiles, quantum(image))
    ok = np.ones(len(profiles), dtype=bool)
    return find_candidates(profiles, ok, noise, full_scale(image), EdgeSettings(**settings), zoom)


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
@pytest.mark.parametrize(("blur_px", "bound_px"), [(0.5, 0.1), (0.8, 0.05), (1.5, 0.1), (3.0, 0.2)])
@pytest.mark.parametrize("contrast", [1.0, -1.0])
def test_edges_are_found_where_they_are(angle_deg: float, blur_px: float, bound_px: float, contrast: float):
    """The error of a single profile stays below ``bound_px``, that of their mean below half of it."""
    low, high = (60.0, 170.0) if contrast > 0.0 else (170.0, 60.0)
    shift_px = np.linspace(-3.0, 3.0, 60)
    found = candidates_of(
        step_image(angle_deg, blur_px, low=low, high=high).astype(np.float32) / 255.0,
        angle_deg,
        shift_px,
        2 if blur_px > 2.0 else 1,
    )
    assert found.sample.tolist() == list(range(60)), "one candidate a profile"
    error_px = found.offset_px + shift_px
    assert np.abs(error_px).max() < bound_px
    assert abs(error_px.mean()) < bound_px / 2.0
    assert (np.sign(found.step) == contrast).all(), "positive: brighter where the normal points"


@pytest.mark.parametrize("blur_px", [0.4, 0.8, 1.6])
def test_the_answer_reads_as_the_height_of_the_step(blur_px: float):
    """A derivative of Gaussian b answers to a step blurred by s with b / sqrt(b² + s²); interpolation adds nothing."""
    image = step_image(0.0, blur_px).astype(np.float32) / 255.0
    found = candidates_of(image, 0.0, np.linspace(-0.5, 0.5, 41), blur_px=1.0)
    expected = 110.0 / 255.0 / np.sqrt(1.0 + blur_px**2)
    np.testing.assert_allclose(found.step, expected, rtol=0.06)


@pytest.mark.parametrize("noise_dn", [3.0, 8.0])
@pytest.mark.parametrize("angle_deg", [0.0, 33.0, 90.0])
def test_noise_scatters_the_edges_as_much_as_is_claimed(noise_dn: float, angle_deg: float):
    rng = np.random.default_rng(1)
    clean = step_image(angle_deg, 0.6)
    errors, claims = [], []
    for _ in range(25):
        image = (clean + rng.normal(scale=noise_dn, size=clean.shape)).astype(np.float32) / 255.0
        shift_px = rng.uniform(-1.0, 1.0, 25)
        found = candidates_of(image, angle_deg, shift_px)
        error_px = found.offset_px + shift_px[found.sample]
        true = np.abs(error_px) < 1.0
        errors.append(error_px[true])
        claims.append(found.sigma_px[true])
        assert np.count_nonzero(true) >= 24
    spread, claimed = np.concatenate(errors).std(), np.concatenate(claims).mean()
    # The claim rests on an estimate of the noise that edges raise and interpolation lowers.
    assert 0.55 < spread / claimed < 1.5


@pytest.mark.parametrize("noise_dn", [1.0, 3.0, 8.0, 15.0])
def test_the_noise_is_estimated_within_a_factor_in_spite_of_the_edge(noise_dn: float):
    rng = np.random.default_rng(2)
    image = (step_image(33.0, 0.7) + rng.normal(scale=noise_dn, size=(SIZE, SIZE))).astype(np.float32)
    assert 0.7 * noise_dn < estimate_noise(profiles_of(image, 33.0, np.zeros(60)), 0.01) < 1.8 * noise_dn


def test_an_image_without_noise_still_has_that_of_its_grey_levels():
    image = np.rint(step_image(0.0, 1.0)).astype(np.uint8)
    assert estimate_noise(profiles_of(image, 0.0, np.zeros(60)), quantum(image)) >= 1.0 / np.sqrt(12.0)
    assert estimate_noise(np.zeros((0, 29), np.float32)) == pytest.approx(1.0 / np.sqrt(12.0))


def test_a_narrow_bar_gives_two_candidates_of_opposite_signs():
    found = candidates_of(step_image(20.0, 0.6, second_px=5.0), 20.0, np.full(30, 2.0))
    first, second = found.step > 0.0, found.step < 0.0
    assert np.count_nonzero(first) == np.count_nonzero(second) == 30
    np.testing.assert_allclose(found.offset_px[first], -2.0, atol=0.06)
    np.testing.assert_allclose(found.offset_px[second], 3.0, atol=0.06)


def test_smooth_shading_and_pure_noise_are_no_edges():
    shading = np.tile(np.linspace(60.0, 140.0, SIZE), (SIZE, 1)).astype(np.float32) / 255.0
    assert len(candidates_of(shading, 0.0, np.zeros(60)).sample) == 0
    rng, found = np.random.default_rng(3), []
    for _ in range(60):
        noise = np.clip(128.0 + rng.normal(scale=6.0, size=(SIZE, SIZE)), 0, 255).astype(np.uint8)
        found.append(len(candidates_of(noise, 33.0, np.zeros(60)).sample))
    # Next to nothing of sixty profiles with about ten independent places each; samples in whole grey levels show twice
    # as many.
    assert np.median(found) <= 3


def test_profiles_that_leave_the_image_are_not_measured():
    image = step_image(0.0, 0.8)
    profiles = profiles_of(image, 0.0, np.zeros(60))
    ok = np.arange(60) % 3 == 0
    found = find_candidates(profiles, ok, 1.0, 255.0, EdgeSettings())
    assert found.sample.tolist() == np.flatnonzero(ok).tolist()


def test_nothing_sampled_is_nothing_found():
    empty = np.zeros((0, 29), np.float32)
    found = find_candidates(
        read_profiles(np.zeros((4, 4), np.uint8), empty, empty), np.zeros(0, bool), 1.0, 255.0, EdgeSettings()
    )
    assert len(found.sample) == len(found.offset_px) == 0


def test_a_blur_wider_than_the_profiles_is_refused():
    with pytest.raises(ValueError, match=r"a blur of 5\.0 px needs search lines of at least"):
        candidates_of(step_image(0.0, 1.0), 0.0, np.zeros(60), blur_px=5.0)


def test_grey_levels_that_are_not_finite_spoil_only_their_own_profiles():
    image = step_image(0.0, 0.8).astype(np.float32) / 255.0
    whole = candidates_of(image, 0.0, np.zeros(60))
    image[:60] = np.nan
    found = candidates_of(image, 0.0, np.zeros(60))
    assert 0 < len(found.sample) < 60
    assert np.isfinite(found.offset_px).all() and np.isfinite(found.sigma_px).all()
    np.testing.assert_allclose(found.offset_px, whole.offset_px[found.sample], atol=1e-6)
