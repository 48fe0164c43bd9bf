"""Step 3 of the corner measurement: sub-pixel edge candidates on the sampled profiles, and what each is worth.

The derivative of a Gaussian is applied to all profiles; every local extremum that stands out of the noise is a
candidate.  Which of them belong to the gripper is decided later, jointly (``consensus``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.model.compiled import COMPILES
from gripmon.model.pixels import BLUE, GREEN, RED
from gripmon.model.records import Array, Image
from gripmon.track.edges import profile_kernel
from gripmon.track.edges.prediction import STEP_PX, Prediction
from gripmon.track.edges.profile_kernel import (
    BEYOND_PX,
    FLAT_PEAK_CURVATURE,
    SATURATION_SHIFT_WIDTHS,
    SHARPNESS,
)
from gripmon.track.edges.saturation import doubt

if TYPE_CHECKING:
    from gripmon.track.edges.robust_fit import RobustFitSettings


class EdgeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as an edge candidate."""

    blur_px: Annotated[float, Meta(ge=0.4, le=5.0, description="sigma of the derivative of Gaussian (px)")] = 0.65
    noise_factor: Annotated[
        float, Meta(ge=2.0, le=50.0, description="smallest edge response in standard deviations of its noise")
    ] = 3.0
    contrast_fraction: Annotated[
        float, Meta(ge=0.0, le=0.5, description="smallest step in grey levels as a fraction of the image's full scale")
    ] = 0.008


_CUBIC_AT_HALVES = (-0.094, 0.0, 0.594, 1.0, 0.594, 0.0, -0.094)

BESIDE_PX = (2.0, 5.0)
"""From where to where the grey levels beside an edge are averaged, and texture is looked for that may shift it, px of
the zoomed image: clear of its blur.
"""

_NEAR, _FAR = (round(way_px / STEP_PX) for way_px in BESIDE_PX)


@dataclass(frozen=True, slots=True)
class Candidates:
    """Edge candidates of one image: ``sample`` (k,) index of the profile, ``offset_px`` (k,) along its normal,
    ``step`` (k,) signed height of the grey-level step (positive: brighter to the right of the edge), ``sigma_px``
    (k,) standard deviation from the noise and texture around it, ``width_px`` (k,) of the edge's response as a
    Gaussian, ``cut_off`` (k,) from 0 to 1 how sure it is that its bright side is.  ``zoom``: factor on the lengths of
    the profiles that were read.  ``noise`` is the image noise in grey levels, ``full_scale`` the largest grey level of
    the image's type.
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
    """Derivative of Gaussian, as ``taps`` and as a matrix (s, r): r responses inside the profile, in grey levels of a
    step.
    """

    taps: Array
    matrix: Array
    first_offset_px: float
    response_noise: float
    curvature_noise_px: float


def profile_offsets_px(reach_px: float) -> Array:
    """Sample positions (s,) of a profile along its normal, px, symmetric about the predicted edge."""
    half = round(reach_px / STEP_PX)
    return np.arange(-half, half + 1) * STEP_PX


def read_profiles(image: Image, map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> Array:
    """Interpolate the image at the maps (r, n, s), or (n, s), and average over r: grey levels (n, s), which no step of
    it rounds.  Colour (blue first) is reduced to grey here, so that cost grows with edges.

    OpenCV's bicubic kernel; beyond the image everything is as at its border.
    """
    if map_x.size == 0:
        return np.zeros(map_x.shape[-2:])
    if map_x.ndim == 2:
        map_x, map_y = map_x[None], map_y[None]
    if not COMPILES:
        return read_profiles_with_numpy(image, map_x, map_y)
    profiles: Array = profile_kernel.read_profiles(
        _pixels(image), np.ascontiguousarray(map_x, np.float32), np.ascontiguousarray(map_y, np.float32)
    )
    return profiles


def read_profiles_with_numpy(image: Image, map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> Array:
    """:func:`read_profiles` at maps (r, n, s) where nothing compiles, and what the compiled one is held against."""
    pixels = _pixels(image).astype(float)
    grey = pixels @ [BLUE, GREEN, RED] if pixels.shape[2] == 3 else pixels[:, :, 0]
    (column, across), (row, down) = _cubic(map_x, grey.shape[1]), _cubic(map_y, grey.shape[0])
    columns = [sum(down[j] * grey[row[j], column[i]] for j in range(4)) for i in range(4)]
    return np.asarray(sum(across[i] * columns[i] for i in range(4)).mean(axis=0))


def _cubic(place: NDArray[np.float32], size: int) -> tuple[list[NDArray[np.intp]], list[Array]]:
    """The four pixels around each place along an axis of ``size`` pixels, and their weights (Keys 1981)."""
    inside = np.fmin(np.fmax(place.astype(float), -BEYOND_PX), size - 1 + BEYOND_PX)
    first = np.floor(inside)
    on = inside - first
    back = 1.0 - on
    before, after = SHARPNESS * on * back * back, SHARPNESS * back * on * on
    here = ((SHARPNESS + 2.0) * on - (SHARPNESS + 3.0)) * on * on + 1.0
    pixels = [np.clip(first.astype(np.intp) + k, 0, size - 1) for k in (-1, 0, 1, 2)]
    return pixels, [before, here, 1.0 - before - here - after, after]


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
    half = math.ceil(3.0 * blur_px / STEP_PX)
    if 2 * half + 5 > samples:
        raise ValueError(f"a blur of {blur_px} px needs profiles of at least {(half + 2) * STEP_PX} px to both sides")
    x = np.arange(-half, half + 1) * STEP_PX
    taps = x * np.exp(-0.5 * (x / blur_px) ** 2)
    # A unit step gives a response of one: the answer reads as the height of the step in grey levels.
    taps /= taps[x > 0].sum() + 0.5 * taps[half]
    responses = samples - 2 * half
    matrix = np.zeros((samples, responses))
    for k in range(responses):
        matrix[k : k + len(taps), k] = taps
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
    return _Kernel(
        taps, matrix, -(responses // 2) * STEP_PX, response_noise, float(np.sqrt((slope**2).sum())) * width_squared
    )


def find_candidates(
    profiles: Array,
    ok: NDArray[np.bool_],
    noise: float,
    grey_range: float,
    settings: EdgeSettings,
    zoom: int = 1,
) -> Candidates:
    """Local extrema of the edge response of profiles (n, s), refined by a parabola through three responses.

    ``noise`` is the image's standard deviation in grey levels (:func:`estimate_noise`); the profiles' samples lie
    ``zoom`` half pixels apart.  Nothing found is an empty result.
    """
    if not COMPILES:
        return find_candidates_with_numpy(profiles, ok, noise, grey_range, settings, zoom)
    kernel = _kernel(profiles.shape[1], settings.blur_px, zoom)
    sample, offset_px, step, sigma_px, width_px, cut_off = profile_kernel.find_candidates(
        profiles,
        ok,
        kernel.taps,
        zoom * STEP_PX,
        _threshold(kernel, noise, grey_range, settings),
        zoom * noise * kernel.curvature_noise_px,
        _NEAR,
        _FAR,
        grey_range,
    )
    return Candidates(sample, offset_px, step, sigma_px, width_px, cut_off, noise, grey_range, zoom)


def _threshold(kernel: _Kernel, noise: float, grey_range: float, settings: EdgeSettings) -> float:
    return max(settings.noise_factor * noise * kernel.response_noise, settings.contrast_fraction * grey_range)


def find_candidates_with_numpy(
    profiles: Array,
    ok: NDArray[np.bool_],
    noise: float,
    grey_range: float,
    settings: EdgeSettings,
    zoom: int = 1,
) -> Candidates:
    """:func:`find_candidates` where nothing compiles, and what the compiled one is held against."""
    kernel = _kernel(profiles.shape[1], settings.blur_px, zoom)
    response = profiles @ kernel.matrix
    height = np.abs(response)
    left, middle, right = height[:, :-2], height[:, 1:-1], height[:, 2:]
    curved = (middle - left) + (middle - right)
    peak = (middle > left) & (middle >= right) & (middle > _threshold(kernel, noise, grey_range, settings))
    # A flat top is no peak of anything but rounding.
    peak &= (curved > FLAT_PEAK_CURVATURE * middle) & ok[:, None]
    sample, column = np.nonzero(peak)
    left, centre, right, curvature = left[peak], middle[peak], right[peak], curved[peak]
    # A blurred step answers with a Gaussian, whose logarithm is a parabola.
    log_left, log_right = (np.log(np.maximum(beside / centre, 1e-3)) for beside in (left, right))
    shift = 0.5 * (log_left - log_right) / (log_left + log_right)
    offset_px = kernel.first_offset_px + STEP_PX * (column + 1.0 + shift)
    step = response[:, 1:-1][peak]
    sigma_px = np.maximum(
        (noise * kernel.curvature_noise_px) / centre, STEP_PX * _unrest(response, sample, column + 1) / curvature
    )
    width = np.sqrt(centre / curvature)
    margin = (profiles.shape[1] - response.shape[1]) // 2
    bright = np.where(step > 0.0, 1, -1)
    cut_off = doubt(profiles, sample, margin + column + 1.0 + shift, bright, width, grey_range)
    return Candidates(
        sample, zoom * offset_px, step, zoom * sigma_px, zoom * STEP_PX * width, cut_off, noise, grey_range, zoom
    )


def _unrest(response: Array, sample: NDArray[np.intp], column: NDArray[np.intp]) -> Array:
    """Root mean square change of the response from sample to sample around each candidate (k,), but not at it.

    What lies beside an edge, texture and noise alike, would go on under the edge, where it shifts the peak.
    """
    squares = np.empty_like(response)
    squares[:, 0] = 0.0
    np.subtract(response[:, 1:], response[:, :-1], out=squares[:, 1:])
    np.square(squares, out=squares)
    running = np.cumsum(squares, axis=1).ravel()
    columns = response.shape[1]
    row = sample * columns
    last = columns - 1
    ends = [np.minimum(np.maximum(column + k, 0), last) for k in (-_FAR, -_NEAR, _NEAR, _FAR)]
    a, b, c, d = (running[row + end] for end in ends)
    total = (b - a) + (d - c)
    count = (ends[1] - ends[0]) + (ends[3] - ends[2])
    return np.sqrt(np.maximum(total, 0.0) / np.maximum(count, 1))


def estimate_noise(profiles: Array, quantum: float = 1.0) -> float:
    """Standard deviation of the noise of a pixel, averaged as the profiles (n, s) are, from their quiet parts, grey
    levels.

    Third differences at whole pixels suppress everything smooth; texture and edges only add to their size, so that
    the lowest tenth is taken.  ``quantum`` is the step of the image's grey levels, whose rounding alone gives 0.29
    of it.
    """
    tenth = (profile_kernel.low_third_difference if COMPILES else low_third_difference)(profiles)
    # Of a normal distribution a tenth lies within 0.1257 sigma; a third difference of white noise has variance 20,
    # of which cubic interpolation at a random phase leaves 0.64 along the profile.
    return max(tenth / (0.1257 * math.sqrt(20.0 * 0.64)), quantum / math.sqrt(12.0))


def low_third_difference(profiles: Array) -> float:
    """The tenth of third differences of every third profile; zero without any."""
    whole = profiles[::3, ::2]
    third = np.abs(whole[:, 3:] - whole[:, :-3] - 3.0 * (whole[:, 2:-1] - whole[:, 1:-2])).ravel()
    return float(np.partition(third, third.size // 10)[third.size // 10]) if third.size else 0.0


@dataclass(frozen=True, slots=True)
class Edgels:
    """The candidates of one image with what they are worth: ``weight`` (k,) from :func:`base_weights`, 1/px², and
    ``edge_spread_px`` (e,) the standard deviation that all points of an edge share.

    ``cut_off_px`` (e,): what comes on top where an edge's bright side may be cut off; it isn't known well enough to
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
    """The candidates with their weights; ``polarity`` (e,) belongs to the gripper's edges."""
    if not COMPILES:
        return weigh_with_numpy(candidates, prediction, polarity, settings)
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


def weigh_with_numpy(
    candidates: Candidates, prediction: Prediction, polarity: NDArray[np.int8], settings: RobustFitSettings
) -> Edgels:
    """:func:`weigh` where nothing compiles, and what the compiled one is held against."""
    # A whole edge is off by a share of the edges' width, and by what the model doesn't say of a bevel.
    width_px = max(median(candidates.width_px), 1.0) if len(candidates.sample) else 1.0
    return Edgels(
        candidates,
        prediction,
        base_weights(candidates, prediction, polarity, settings),
        np.hypot(prediction.bevel_px, settings.edge_floor_px * width_px),
        width_px * cut_off_spread(candidates, prediction),
    )


def base_weights(
    candidates: Candidates, prediction: Prediction, polarity: NDArray[np.int8], settings: RobustFitSettings
) -> Array:
    """Weight (k,) of each candidate before the robust part, 1/px²; zero where the taught polarity disagrees.  Profiles
    that see the same pixels share what these are worth.
    """
    edge = prediction.layout.edge[candidates.sample]
    weight = prediction.independence[edge] / (candidates.sigma_px**2 + settings.point_floor_px**2)
    wanted = polarity[edge]
    weight[(wanted != 0) & (np.sign(candidates.step) != wanted)] = 0.0
    return weight


def cut_off_spread(candidates: Candidates, prediction: Prediction) -> Array:
    """(e,) standard deviation of each edge's position, in widths of the edge, where its bright side is cut off."""
    edges = len(prediction.line_origin)
    edge = prediction.layout.edge[candidates.sample]
    # High steps are the outline's, low ones texture beside it.
    energy = candidates.step**2
    total = np.bincount(edge, energy, edges)
    return SATURATION_SHIFT_WIDTHS * np.bincount(edge, energy * candidates.cut_off, edges) / np.maximum(total, 1e-12)


def usual_width_px(candidates: Candidates, weight: Array) -> tuple[int, float]:
    """How many candidates have a ``weight`` (k,), and the median width of these, px; 0 without any."""
    if COMPILES:
        count, width_px = profile_kernel.usual_width(candidates.width_px, weight)
        return count, width_px
    widths_px = candidates.width_px[weight > 0.0]
    return len(widths_px), median(widths_px) if len(widths_px) else 0.0


def median(values: Array) -> float:
    """The upper one of two middle values; NumPy's own checks for NaN take longer than the rest."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
