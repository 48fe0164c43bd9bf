"""Step 3 of the corner measurement: sub-pixel edgel hypotheses on the sampled search lines, and what each is worth.

The derivative of a Gaussian is applied to all search lines; every local extremum that stands out of the noise is an
edgel hypothesis.  The joint fit decides which of them belong to the gripper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array, Image
from gripmon.model.response import as_light
from gripmon.track.edges import profile_kernel
from gripmon.track.edges.kernel import FEWEST_AGREEING
from gripmon.track.edges.prediction import STEP_PX, Prediction
from gripmon.track.edges.settings import EdgeSettings, RobustFitSettings

_CUBIC_AT_HALVES = (-0.094, 0.0, 0.594, 1.0, 0.594, 0.0, -0.094)  # the weights of read_profiles, every half pixel

BESIDE_SAMPLES = (4, 10)
"""From where to where beside an edge grey levels are averaged and texture is looked for that may shift it, in samples
of a search line: 2 to 5 px of the zoomed image, clear of the edge's blur.
"""

FEWEST_WIDTHS = 20
"""Edge points from which the blur is estimated."""


class Candidates(NamedTuple):
    """Edgel hypotheses of one image: ``sample`` (k,) index of the search line, ``offset_px`` (k,) along its normal,
    ``step`` (k,) signed height of the grey-level step (positive: brighter to the right of the edge), ``sigma_px`` (k,)
    standard deviation from the noise and texture around it, ``width_px`` (k,) of the edge's response as a Gaussian,
    ``cut_off`` (k,) from 0 to 1 how sure it is that one of its sides is.  ``zoom``: factor on the lengths of the search
    lines that were read.  ``noise`` is the image noise in grey levels, ``full_scale`` the largest grey level of the
    image's type.
    """

    sample: NDArray[np.intp]
    offset_px: Array
    step: Array
    sigma_px: Array
    width_px: Array
    cut_off: Array
    noise: float
    full_scale: float
    zoom: int = 1


@dataclass(frozen=True, slots=True)
class _Kernel:
    """Derivative of Gaussian: its ``taps`` (t,) at half pixels, whose response is the height of a step in grey levels;
    and by how much noise of one grey level a pixel makes a response scatter, and shifts the peak of a step of one, px.
    """

    taps: Array
    response_noise: float
    curvature_noise_px: float


def profile_offsets_px(reach_px: float) -> Array:
    """Sample positions (s,) of a search line along its normal, px, symmetric about the predicted edge."""
    half = round(reach_px / STEP_PX)
    return np.arange(-half, half + 1) * STEP_PX


def filter_reach_px(blur_px: float) -> float:
    """How far the derivative of a Gaussian of this standard deviation reaches to both sides, px: three of them."""
    return math.ceil(3.0 * blur_px / STEP_PX) * STEP_PX


def read_profiles(
    image: Image, map_x: NDArray[np.float32], map_y: NDArray[np.float32], response: str = "linear"
) -> Array:
    """Interpolate the image at the maps (r, n, s), or (n, s), and average over r: grey levels (n, s), which no step of
    it rounds.  Colour (blue first) is reduced to grey here, so that cost grows with edges: of those colours that aren't
    cut off (overexposed, or black) near a search line, if there are any.

    OpenCV's bicubic kernel; beyond the image everything is as at its border.  With the ``response`` srgb grey levels in
    proportion to the light, which the lens blurs: an edge lies in the middle of that (IEC 61966-2-1).
    """
    if map_x.size == 0:
        return np.zeros(map_x.shape[-2:])
    if map_x.ndim == 2:
        map_x, map_y = map_x[None], map_y[None]
    profiles: Array = profile_kernel.read_profiles(
        _pixels(image),
        np.ascontiguousarray(map_x, np.float32),
        np.ascontiguousarray(map_y, np.float32),
        _largest(image.dtype),
    )
    return as_light(profiles, full_scale(image)) if response == "srgb" else profiles


def _pixels(image: Image) -> Image:
    """The image as (h, w, channels), with one of three types and without leave to write: each other combination would
    be compiled again.
    """
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        image = image.astype(np.float32)
    pixels = np.ascontiguousarray(image).reshape(*image.shape[:2], -1)
    pixels.flags.writeable = False
    return pixels


def full_scale(image: Image) -> float:
    """Largest grey level of an image's type; 1 for float images."""
    return _largest(image.dtype)


@cache
def _largest(dtype: np.dtype[Any]) -> float:
    return 1.0 if dtype.kind == "f" else float(np.iinfo(dtype.str).max)


def quantum(image: Image) -> float:
    """Step between grey levels of an image's type; float images are taken to come from 16 bits."""
    return 1.0 / 65535.0 if image.dtype.kind == "f" else 1.0


@lru_cache(maxsize=64)
def _kernel(samples: int, blur_px: float, zoom: int) -> _Kernel:
    half = round(filter_reach_px(blur_px) / STEP_PX)
    if 2 * half + 5 > samples:
        raise ValueError(
            f"a blur of {blur_px} px needs search lines of at least {(half + 2) * STEP_PX} px to both sides"
        )
    x = np.arange(-half, half + 1) * STEP_PX
    taps = x * np.exp(-0.5 * (x / blur_px) ** 2)
    # A unit step gives a response of one: the answer reads as the height of the step in grey levels.
    taps /= taps[x > 0].sum() + 0.5 * taps[half]
    # Pixels, not half-pixel samples, carry independent noise: cubic interpolation spreads each over its neighbours.
    # Zoomed samples are pixels apart.
    taps_of_pixel = np.array(_CUBIC_AT_HALVES) if zoom == 1 else np.ones(1)
    apart = 2 if zoom == 1 else 1
    effective = np.convolve(taps, taps_of_pixel)[::apart]
    slope = np.gradient(np.convolve(taps, taps_of_pixel), STEP_PX)[::apart]
    response_noise = float(np.sqrt((effective**2).sum()))
    # A step blurred by the lens (about 0.6 px) answers with a Gaussian of this width; its peak moves by noise' /
    # curvature.
    width_squared = blur_px**2 + 0.6**2
    return _Kernel(taps, response_noise, float(np.sqrt((slope**2).sum())) * width_squared)


def find_candidates(
    profiles: Array,
    ok: NDArray[np.bool_],
    noise: float,
    grey_range: float,
    settings: EdgeSettings,
    zoom: int = 1,
) -> Candidates:
    """Local extrema of the edge response of search lines (n, s), refined by a parabola through three responses.

    ``noise`` is the image's standard deviation in grey levels (:func:`estimate_noise`); the search lines' samples lie
    ``zoom`` half pixels apart.  Nothing found is an empty result.
    """
    kernel = _kernel(profiles.shape[1], settings.blur_px, zoom)
    sample, offset_px, step, sigma_px, width_px, cut_off = profile_kernel.find_candidates(
        profiles,
        ok,
        kernel.taps,
        zoom * STEP_PX,
        max(settings.noise_factor * noise * kernel.response_noise, settings.contrast_fraction * grey_range),
        zoom * noise * kernel.curvature_noise_px,
        *BESIDE_SAMPLES,
        grey_range,
    )
    return Candidates(sample, offset_px, step, sigma_px, width_px, cut_off, noise, grey_range, zoom)


def estimate_noise(profiles: Array, quantum: float = 1.0) -> float:
    """Standard deviation of the noise of a pixel, averaged as the search lines (n, s) are, from their quiet parts, grey
    levels.

    Third differences at whole pixels suppress everything smooth; texture and edges only add to their size, so that
    the lowest tenth is taken.  ``quantum`` is the step of the image's grey levels, whose rounding alone gives 0.29
    of it.
    """
    tenth = profile_kernel.low_third_difference(profiles)
    # Of a normal distribution a tenth lies within 0.1257 sigma; a third difference of white noise has variance 20,
    # of which cubic interpolation at a random phase leaves 0.64 along the search line.
    return max(tenth / (0.1257 * math.sqrt(20.0 * 0.64)), quantum / math.sqrt(12.0))


class Edgels(NamedTuple):
    """The edgel hypotheses of one image with what they are worth: ``weight`` (k,) before the robust part, 1/px², zero
    where the taught polarity disagrees; ``edge_spread_px`` (e,) the standard deviation that all points of an edge
    share.

    ``cut_off_px`` (e,): what comes on top where one of an edge's sides may be cut off; it isn't known well enough to
    prefer other edges.
    """

    candidates: Candidates
    prediction: Prediction
    weight: Array
    edge_spread_px: Array
    cut_off_px: Array


def weigh(
    candidates: Candidates, prediction: Prediction, polarity: NDArray[np.int8], settings: RobustFitSettings
) -> Edgels:
    """The edgel hypotheses with their weights; ``polarity`` (e,) belongs to the gripper's edges."""
    worth = profile_kernel.worth(
        candidates.sample,
        candidates.step,
        candidates.sigma_px,
        candidates.width_px,
        candidates.cut_off,
        prediction.layout.edge,
        polarity,
        prediction.bevel_px,
        prediction.independence,
        settings.point_floor_px,
        settings.edge_floor_px,
    )
    return Edgels(candidates, prediction, *worth)


def blur_px(candidates: Candidates, weight: Array, settings: EdgeSettings) -> float | None:
    """Standard deviation of the blur across edges, px: of the median width of the edgel hypotheses that have a
    ``weight`` (k,), what the derivative of Gaussian leaves; None with few of them.
    """
    count, width_px = profile_kernel.usual_width(candidates.width_px, weight)
    if count < FEWEST_WIDTHS:
        return None
    return math.sqrt(max(width_px**2 - (candidates.zoom * settings.blur_px) ** 2, 0.0))


def unevenness(image: Image, prediction: Prediction) -> float:
    """Standard deviation of the grey level along the more even side of each edge, over that beside all edges together;
    1 where there is too little to tell.

    Along the gripper's outlines one side is the finger and the other whatever lies behind; where a background imitates
    them, both sides vary alike.
    """
    profiles = read_profiles(image, prediction.map_x, prediction.map_y)
    middle = profiles.shape[1] // 2
    near, far = (min(samples, middle) for samples in BESIDE_SAMPLES)
    right = profiles[:, middle + near : middle + far + 1].mean(axis=1)
    left = profiles[:, middle - far : middle - near + 1].mean(axis=1)
    square, count, all_of_them = 0.0, 0, []
    for edge in prediction.layout.edges:
        own = (prediction.layout.edge == edge) & prediction.ok
        number = int(np.count_nonzero(own))
        if number < FEWEST_AGREEING:
            continue
        square += number * min(float(right[own].var()), float(left[own].var()))
        count += number
        all_of_them += [right[own], left[own]]
    together = float(np.concatenate(all_of_them).var()) if all_of_them else 0.0
    return math.sqrt(square / (count * together)) if together > 0.0 else 1.0
