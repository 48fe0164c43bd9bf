"""Search lines and edgel hypotheses in machine code.

n search lines of s samples, k edgel hypotheses, e edges of the gripper; grey levels, and px of the image or of the
zoomed one.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from gripmon.model.compiled import compiled
from gripmon.model.pixels import BLUE, GREEN, RED

SHARPNESS = -0.75
"""Slope of the interpolating cubic one pixel away: OpenCV's, which keeps steps as steep as they are."""

BEYOND_PX = 3.0
"""So far outside the image everything is the border's pixel."""

FLAT_PEAK_CURVATURE = 1e-6
"""Curvature of a peak over its height below which rounding alone makes it one."""

SATURATION_SHARE = 0.998
"""Share of an image's range from which grey levels count as cut off: 254.5 of 255; and 0.5 of 255 below."""

SURELY, HARDLY = 1.1, 1.6
"""Way from an edge to the end of the range, in widths of the edge response: a step that is cut off at nine tenths of
its height or less gets there within the first, one that just reaches it not before the second.
"""

SATURATION_SHIFT_WIDTHS = 0.58
"""Root mean square shift in widths of the edge response, if anything from none to a whole one is equally likely: a step
of twice to five times the visible height is found 0.5 to 1 of them too far on the dark side.
"""

# Indices that are known not to be negative need no look at the array's end.
_at = np.uintp


@compiled
def read_profiles(image: Any, map_x: Any, map_y: Any, full_scale: float) -> Any:
    """Grey levels (n, s): an image (h, w, 1 or 3), blue first, interpolated at maps (r, n, s), mean over r.  By cubic
    convolution with the slope :data:`SHARPNESS` (Keys 1981), which no step rounds; beyond the image everything is as at
    its border.  What is not a number is read there, too.  A colour that is cut off near a search line doesn't count.
    """
    rows, count, samples = map_x.shape
    profiles = np.empty((count, samples))
    taps = rows * samples
    column, row, base = np.empty(taps, np.int32), np.empty(taps, np.int32), np.empty(taps, np.int32)
    part, grey = np.empty(taps), np.empty(taps)
    across, down, patch = np.empty((4, taps)), np.empty((4, taps)), np.empty(1024)
    for n in range(count):
        _whole_and_part(map_x, n, float(image.shape[1]), column, part)
        _cubic(part, across)
        _whole_and_part(map_y, n, float(image.shape[0]), row, part)
        _cubic(part, down)
        left, right = _extent(column)
        top, bottom = _extent(row)
        width, height = right - left + 4, bottom - top + 4
        if width * height > len(patch):
            patch = np.empty(width * height)
        weights = _whole_colours(image, left - 1, top - 1, width, height, full_scale)
        _cut_out(image, left - 1, top - 1, width, height, weights, patch)
        for q in range(taps):
            base[q] = (row[q] - top) * width + (column[q] - left)
        _interpolate(patch, base, width, across, down, grey)
        for k in range(samples):
            total = 0.0
            for r in range(rows):
                total += grey[_at(r * samples + k)]
            profiles[n, k] = total / rows
    return profiles


@compiled
def _whole_and_part(mapped: Any, n: int, size: float, whole: Any, part: Any) -> None:
    """Pixel before each sample (r * s,) of search line ``n`` along one axis of the image, and the way on from there."""
    rows, _, samples = mapped.shape
    far = size - 1.0 + 2.0 * BEYOND_PX
    for r in range(rows):
        for k in range(samples):
            # Positive numbers are rounded down when their fraction is cut off; what is not a number goes to the border.
            place = float(mapped[_at(r), _at(n), _at(k)]) + BEYOND_PX
            place = place if place > 0.0 else 0.0
            place = place if place < far else far
            pixel = np.int32(place)
            whole[_at(r * samples + k)] = pixel - np.int32(BEYOND_PX)
            part[_at(r * samples + k)] = place - pixel


@compiled
def _cubic(part: Any, weight: Any) -> None:
    """Weights (4, t) of the pixels around places that lie a ``part`` (t,) of the way from the second to the third."""
    for q in range(len(part)):
        on, back = part[q], 1.0 - part[q]
        before, after = SHARPNESS * on * back * back, SHARPNESS * back * on * on
        here = ((SHARPNESS + 2.0) * on - (SHARPNESS + 3.0)) * on * on + 1.0
        weight[0, q], weight[1, q], weight[2, q], weight[3, q] = before, here, 1.0 - before - here - after, after


@compiled
def _extent(whole: Any) -> tuple[int, int]:
    low, high = whole[0], whole[0]
    for q in range(len(whole)):
        low, high = min(low, whole[q]), max(high, whole[q])
    return low, high


@compiled
def _whole_colours(
    image: Any, left: int, top: int, width: int, height: int, full_scale: float
) -> tuple[float, float, float]:
    """What blue, green and red are worth in the grey of a part of the image: nothing where they are cut off in a pixel,
    which would shift its edges before the grey of all three shows it; unless all are.
    """
    rows, columns, channels = image.shape
    white, black = SATURATION_SHARE * full_scale, (1.0 - SATURATION_SHARE) * full_scale
    blue, green, red = BLUE, GREEN, RED
    if channels == 3:
        for y in range(min(max(top, 0), rows - 1), min(max(top + height, 1), rows)):
            for x in range(min(max(left, 0), columns - 1), min(max(left + width, 1), columns)):
                blue = 0.0 if image[y, x, 0] >= white or image[y, x, 0] <= black else blue
                green = 0.0 if image[y, x, 1] >= white or image[y, x, 1] <= black else green
                red = 0.0 if image[y, x, 2] >= white or image[y, x, 2] <= black else red
    total = blue + green + red
    return (blue / total, green / total, red / total) if total > 0.0 else (BLUE, GREEN, RED)


@compiled
def _cut_out(
    image: Any, left: int, top: int, width: int, height: int, weights: tuple[float, float, float], patch: Any
) -> None:
    """Grey levels of a part of the image, row by row; beyond the image those at its border.  ``weights`` of blue, green
    and red.
    """
    rows, columns, channels = image.shape
    if channels == 1 and left >= 0 and top >= 0 and left + width <= columns and top + height <= rows:
        for v in range(height):
            for u in range(width):
                patch[_at(v * width + u)] = image[_at(top + v), _at(left + u), 0]
        return
    for v in range(height):
        y = min(max(top + v, 0), rows - 1)
        for u in range(width):
            x = min(max(left + u, 0), columns - 1)
            grey = float(image[y, x, 0])
            if channels == 3:
                grey = weights[0] * grey + weights[1] * image[y, x, 1] + weights[2] * image[y, x, 2]
            patch[v * width + u] = grey


def _four_sums(patch: Any, at: Any, width: Any, above: float, here: float, below: float, under: float) -> Any:
    """Sums down four neighbouring columns of a patch from the pixel ``at`` on, in rows of ``width``: with the weights
    of four rows, as a processor adds up four numbers at once.
    """
    rows = [patch[at + k * width : at + k * width + 4] for k in range(4)]
    return above * rows[0] + here * rows[1] + below * rows[2] + under * rows[3]


def _write_four_sums(
    context: Any, patch: Any, at: Any, width: Any, above: Any, here: Any, below: Any, under: Any
) -> Any:
    """:func:`_four_sums` for numba: its type, and what writes its code.  Of Python's loops it adds number by number."""

    def write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        patch = context.make_array(signature.args[0])(context, builder, values[0])
        four = ir.VectorType(ir.DoubleType(), 4)
        place, total = values[1], None
        for weight in values[3:]:
            address = builder.bitcast(builder.gep(patch.data, [place]), four.as_pointer())
            single = builder.insert_element(ir.Constant(four, ir.Undefined), weight, ir.IntType(32)(0))
            each = builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))
            part = builder.fmul(each, builder.load(address, align=8))
            total = part if total is None else builder.fadd(total, part)
            place = builder.add(place, values[2])
        columns = [builder.extract_element(total, ir.IntType(32)(k)) for k in range(4)]
        return context.make_tuple(builder, signature.return_type, columns)

    four_numbers: Any = types.UniTuple(types.float64, 4)  # type: ignore[no-untyped-call]
    return four_numbers(patch, at, width, above, here, below, under), write


if not getattr(numba.config, "DISABLE_JIT", False):  # else for a debugger: everything here runs as Python
    _four_sums = intrinsic(_write_four_sums)  # type: ignore[assignment]


@compiled
def _interpolate(patch: Any, base: Any, width: int, across: Any, down: Any, grey: Any) -> None:
    """Sixteen pixels of a patch each, weighted down its columns and then across."""
    for q in range(len(base)):
        first, second, third, fourth = _four_sums(
            patch, _at(base[q]), _at(width), down[0, q], down[1, q], down[2, q], down[3, q]
        )
        grey[q] = (across[0, q] * first + across[1, q] * second) + (across[2, q] * third + across[3, q] * fourth)


@compiled
def low_third_difference(profiles: Any) -> float:
    """The lowest tenth of the sizes of third differences at whole pixels, of every third search line of half pixels (n,
    s), grey levels; 0 without any, NaN where it isn't a number.
    """
    count, samples = profiles.shape
    third = np.empty(((count + 2) // 3) * ((samples + 1) // 2))
    found, finite = 0, 0
    for n in range(0, count, 3):
        for k in range(0, samples - 6, 2):
            step = profiles[n, k + 6] - profiles[n, k]
            size = abs(step - 3.0 * (profiles[n, k + 4] - profiles[n, k + 2]))
            found += 1
            if size == size:
                third[finite] = size
                finite += 1
    nth = found // 10
    if nth < finite:
        return _nth(third, finite, nth)
    return np.nan if found else 0.0


@compiled
def _nth(values: Any, count: int, nth: int) -> float:
    """The value that would stand at ``nth`` if the first ``count`` were sorted; moves them about (Hoare's "find")."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[nth], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < nth:
            low = i
        if nth < i:
            high = j
    return float(values[nth])


@compiled
def find_candidates(
    profiles: Any, ok: Any, taps: Any, step_px: float, threshold: float, peak_noise: float, near: int, far: int,
    full_scale: float,
) -> Any:  # fmt: skip
    """Local extrema of the response of search lines (n, s) that are ``ok`` (n,) to the derivative of Gaussian ``taps``
    (t,): sample, offset, step, sigma, width and how surely it is cut off, each (k,), as in ``profiles.Candidates``.

    A peak h above the ``threshold`` with neighbours l and r lies by the parabola through the three logarithms 0.5 (ln l
    - ln r) / (ln l + ln r - 2 ln h) samples of ``step_px`` on.  Its standard deviation is ``peak_noise`` / h, or what
    unrest ``near`` to ``far`` samples beside it, going on under it, would shift it by: the larger.  Its width is the
    root of h over its curvature, 2 h - l - r.  A flat top is no peak of anything but rounding.
    """
    count, samples = profiles.shape
    margin, responses = len(taps) // 2, samples - len(taps) + 1
    sample = np.empty(count * responses // 2 + 1, np.intp)
    found = np.empty((5, len(sample)))
    response, height, change = np.empty(responses), np.empty(responses), np.empty(responses)
    k = 0
    for n in range(count):
        spoilt = 0
        for c in range(samples):
            spoilt += profiles[n, c] - profiles[n, c] != 0.0  # what is not a number, or has no end
        if spoilt or not ok[n]:
            continue
        response[:] = 0.0
        for t in range(len(taps)):
            for c in range(responses):
                response[c] += taps[t] * profiles[n, c + t]
        for c in range(responses):
            height[c] = abs(response[c])
        change[0] = 0.0
        for c in range(1, responses):
            change[c] = (response[c] - response[c - 1]) ** 2
        for c in range(1, responses - 1):
            left, centre, right = height[c - 1], height[c], height[c + 1]
            if not (centre > left and centre >= right and centre > threshold):
                continue
            curvature = (centre - left) + (centre - right)
            if not curvature > FLAT_PEAK_CURVATURE * centre:
                continue
            # A blurred step answers with a Gaussian, whose logarithm is a parabola.
            log_left, log_right = math.log(max(left / centre, 1e-3)), math.log(max(right / centre, 1e-3))
            shift = 0.5 * (log_left - log_right) / (log_left + log_right)
            width = math.sqrt(centre / curvature)
            place, bright = margin + c + shift, 1 if response[c] > 0.0 else -1
            unrest = _unrest(change, c, near, far)
            sample[k] = n
            found[0, k] = step_px * (c + shift - responses // 2)
            found[1, k] = response[c]
            found[2, k] = max(peak_noise / centre, step_px * unrest / curvature)
            found[3, k] = step_px * width
            found[4, k] = _doubt(profiles, n, place, bright, width, full_scale)
            k += 1
    return (
        sample[:k].copy(),
        found[0, :k].copy(),
        found[1, :k].copy(),
        found[2, :k].copy(),
        found[3, :k].copy(),
        found[4, :k].copy(),
    )


@compiled
def _unrest(change: Any, at: int, near: int, far: int) -> float:
    """Root mean square change of the response from sample to sample around an edgel hypothesis, but not at it, from the
    squares ``change`` (r,).  What lies beside an edge, texture and noise alike, would go on under the edge, where it
    shifts the peak.
    """
    last = len(change) - 1
    a, b, c, d = max(at - far, 0), max(at - near, 0), min(at + near, last), min(at + far, last)
    total = 0.0
    for i in range(a + 1, b + 1):
        total += change[i]
    for i in range(c + 1, d + 1):
        total += change[i]
    return math.sqrt(total / max(b - a + d - c, 1))


@compiled
def _doubt(profiles: Any, n: int, place: float, side: int, width: float, full_scale: float) -> float:
    """From 0 for an edge that is surely whole to 1 for one that is surely cut off: within :data:`SURELY` to
    :data:`HARDLY` widths of its ``place`` in search line ``n`` there is white at the end of the range on the bright
    ``side`` (-1 or 1), or black at its beginning on the other.

    Overexposure cuts the upper part of a blurred step off; what is left is steepest nearer to the dark side, by up to
    most of the edge's width.  So does a black level that is too high with the lower part, the other way round.  By how
    much can't be told from the rest of the search line without knowing the lens's blur exactly, so that such edges only
    get a larger standard deviation.
    """
    start, white, black = int(np.rint(place)), SATURATION_SHARE * full_scale, (1.0 - SATURATION_SHARE) * full_scale
    for step in range(int(HARDLY * width) + 2):
        up, down = start + side * step, start - side * step
        bright = 0 <= up < profiles.shape[1] and profiles[n, up] >= white
        dark = 0 <= down < profiles.shape[1] and profiles[n, down] <= black
        if bright or dark:
            way = abs((up if bright else down) - place) / width
            return min(max((HARDLY - way) / (HARDLY - SURELY), 0.0), 1.0)
    return 0.0


@compiled
def usual_width(width_px: Any, weight: Any) -> tuple[int, float]:
    """How many points have a weight, and the upper median of their widths; 0 without any."""
    widths, count = np.empty(len(weight)), 0
    for k in range(len(weight)):
        if weight[k] > 0.0:
            widths[count] = width_px[k]
            count += 1
    return count, _nth(widths, count, count // 2) if count else 0.0


@compiled
def worth(
    sample: Any, step: Any, sigma_px: Any, width_px: Any, cut_off: Any, edge: Any, polarity: Any, bevel_px: Any,
    independence: Any, point_floor_px: float, edge_floor_px: float,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """What ``profiles.Edgels`` holds of the edgel hypotheses: weight (k,), 1/px², spread and what a cut-off side adds
    to it (e,), px.

    A weight is one over the variance and that of the floor, and 0 where the ``polarity`` (e,) disagrees; search lines
    that see the same pixels share what these are worth, ``independence`` (e,).  A whole edge is off by its bevel and a
    share of the edges' median width; and by :data:`SATURATION_SHIFT_WIDTHS` of that where its bright side is cut off,
    high steps counting more: they are the outline's, low ones texture beside it.
    """
    count, edges = len(sample), len(bevel_px)
    weight = np.empty(count)
    energy, cut_off_energy = np.zeros(edges), np.zeros(edges)
    for k in range(count):
        e = edge[sample[k]]
        wrong = polarity[e] != 0 and np.sign(step[k]) != polarity[e]
        weight[k] = 0.0 if wrong else independence[e] / (sigma_px[k] ** 2 + point_floor_px**2)
        energy[e] += step[k] ** 2
        cut_off_energy[e] += step[k] ** 2 * cut_off[k]
    usual_px = max(_nth(width_px.copy(), count, count // 2), 1.0) if count else 1.0
    spread_px, cut_off_px = np.empty(edges), np.empty(edges)
    for e in range(edges):
        spread_px[e] = math.hypot(bevel_px[e], edge_floor_px * usual_px)
        cut_off_px[e] = usual_px * SATURATION_SHIFT_WIDTHS * cut_off_energy[e] / max(energy[e], 1e-12)
    return weight, spread_px, cut_off_px
