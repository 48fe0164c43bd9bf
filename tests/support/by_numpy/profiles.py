"""What ``track.edges.profile_kernel`` compiles, by NumPy: grey levels, edge candidates and what these are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gripmon.model.pixels import BLUE, GREEN, RED
from gripmon.model.records import Array, Image
from gripmon.track.edges.prediction import STEP_PX, Prediction
from gripmon.track.edges.profile_kernel import (
    BEYOND_PX,
    FLAT_PEAK_CURVATURE,
    HARDLY,
    SATURATION_SHARE,
    SATURATION_SHIFT_WIDTHS,
    SHARPNESS,
    SURELY,
)
from gripmon.track.edges.profiles import BESIDE_SAMPLES, Candidates, Edgels, _kernel, _pixels, full_scale
from gripmon.track.edges.settings import EdgeSettings, RobustFitSettings


def read_profiles(
    image: Image, map_x: NDArray[np.float32], map_y: NDArray[np.float32], response: str = "linear"
) -> Array:
    pixels = _pixels(image).astype(float)
    (column, across), (row, down) = _cubic(map_x, pixels.shape[1]), _cubic(map_y, pixels.shape[0])
    columns = [sum(down[j][..., None] * pixels[row[j], column[i]] for j in range(4)) for i in range(4)]
    colours = np.asarray(sum(across[i][..., None] * columns[i] for i in range(4)).mean(axis=0))
    if pixels.shape[2] == 1:
        return np.asarray(colours[..., 0])
    left, right = column[0].min(axis=(0, 2)), column[3].max(axis=(0, 2)) + 1
    top, bottom = row[0].min(axis=(0, 2)), row[3].max(axis=(0, 2)) + 1
    end = full_scale(image)
    cut_off = (pixels >= SATURATION_SHARE * end) | (pixels <= (1.0 - SATURATION_SHARE) * end)
    whole = [~cut_off[a:b, c:d].any(axis=(0, 1)) for a, b, c, d in zip(top, bottom, left, right, strict=True)]
    weights = np.array([BLUE, GREEN, RED]) * np.where(np.any(whole, axis=1, keepdims=True), whole, True)
    return np.asarray(np.einsum("nsc,nc->ns", colours, weights / weights.sum(axis=1, keepdims=True)))


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


def find_candidates(
    profiles: Array,
    ok: NDArray[np.bool_],
    noise: float,
    grey_range: float,
    settings: EdgeSettings,
    zoom: int = 1,
) -> Candidates:
    kernel = _kernel(profiles.shape[1], settings.blur_px, zoom)
    responses = profiles.shape[1] - len(kernel.taps) + 1
    response = profiles @ np.array([np.pad(kernel.taps, (k, responses - 1 - k)) for k in range(responses)]).T
    height = np.abs(response)
    left, middle, right = height[:, :-2], height[:, 1:-1], height[:, 2:]
    curved = (middle - left) + (middle - right)
    least = max(settings.noise_factor * noise * kernel.response_noise, settings.contrast_fraction * grey_range)
    peak = (middle > left) & (middle >= right) & (middle > least)
    # A flat top is no peak of anything but rounding.
    peak &= (curved > FLAT_PEAK_CURVATURE * middle) & ok[:, None]
    sample, column = np.nonzero(peak)
    left, centre, right, curvature = left[peak], middle[peak], right[peak], curved[peak]
    # A blurred step answers with a Gaussian, whose logarithm is a parabola.
    log_left, log_right = (np.log(np.maximum(beside / centre, 1e-3)) for beside in (left, right))
    shift = 0.5 * (log_left - log_right) / (log_left + log_right)
    offset_px = STEP_PX * -(responses // 2) + STEP_PX * (column + 1.0 + shift)
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
    near, far = BESIDE_SAMPLES
    ends = [np.minimum(np.maximum(column + k, 0), last) for k in (-far, -near, near, far)]
    a, b, c, d = (running[row + end] for end in ends)
    total = (b - a) + (d - c)
    count = (ends[1] - ends[0]) + (ends[3] - ends[2])
    return np.sqrt(np.maximum(total, 0.0) / np.maximum(count, 1))


def low_third_difference(profiles: Array) -> float:
    """The tenth of third differences of every third profile; zero without any."""
    whole = profiles[::3, ::2]
    third = np.abs(whole[:, 3:] - whole[:, :-3] - 3.0 * (whole[:, 2:-1] - whole[:, 1:-2])).ravel()
    return float(np.partition(third, third.size // 10)[third.size // 10]) if third.size else 0.0


def weigh(
    candidates: Candidates, prediction: Prediction, polarity: NDArray[np.int8], settings: RobustFitSettings
) -> Edgels:
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


def median(values: Array) -> float:
    """The upper one of two middle values; NumPy's own checks for NaN take longer than the rest."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def doubt(
    profiles: Array,
    sample: NDArray[np.intp],
    place: Array,
    side: NDArray[np.intp],
    width: Array,
    end: float,
) -> Array:
    """(k,) from 0, for edges that are surely whole, to 1 for those that are surely cut off.

    ``profiles`` (n, s) in grey levels up to ``end``; for each edge: its profile ``sample``, ``place`` and ``width`` of
    its response in samples, and on which ``side`` (-1, 1) it is bright.
    """
    white, black = SATURATION_SHARE * end, (1.0 - SATURATION_SHARE) * end
    start = np.round(place).astype(np.intp)
    steps = np.arange(int(np.ceil(HARDLY * float(np.max(width, initial=1.0)))) + 2)
    out = np.zeros(len(sample))
    nearest = np.full(len(sample), len(steps))
    for toward, cut_off in ((-side, profiles <= black), (side, profiles >= white)):  # of two as near, the bright one
        columns = start[:, None] + toward[:, None] * steps
        inside = (columns >= 0) & (columns < profiles.shape[1])
        reached = inside & cut_off[sample[:, None], np.clip(columns, 0, profiles.shape[1] - 1)]
        step = np.where(reached.any(axis=1), reached.argmax(axis=1), len(steps))
        way = np.abs(start + toward * step - place) / width
        nearer = (step < len(steps)) & (step <= nearest)
        out[nearer] = np.clip((HARDLY - way) / (HARDLY - SURELY), 0.0, 1.0)[nearer]
        nearest = np.minimum(nearest, step)
    return out
