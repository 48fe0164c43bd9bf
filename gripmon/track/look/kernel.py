"""Reading the gripper's learned pixels in an image and fitting its motion to them, compiled.

p patches of n pixels; grey levels, motions in m and rad with the opening as seventh.  What they are for stands in
:mod:`~gripmon.track.look.alignment`.  Tests hold each function against that of its name in
``tests/support/by_numpy/look.py``.
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.model.compiled import compiled
from gripmon.model.least_squares import TUKEY
from gripmon.model.records import Array, Image

ROUNDS = 2
"""Re-weightings: a third one changed no scatter that was measured in its second digit."""

CLIP_SIGMAS = 3.0
"""Standard deviations that a residual counts for at most in the frame's own scatter, and a grey level in a strip's
mean: a bright thing in front of a finger weighs no more than a line on it.
"""

GAIN_BOUNDS = (0.25, 4.0)
"""Of a patch's light; beyond, it shows something else."""


@compiled
def read(image: Image, weights: Array, base_px: Array, flow: Array, motion: Array) -> Array:
    """Grey levels (p, n) of patches, by cubic convolution (Keys 1981, a = -1/2); NaN where one leaves the image.

    ``image`` (h, w, c), whose channels ``weights`` (c,) add up to grey; ``base_px`` (p, n, 2) where the pixels lie,
    ``flow`` (p, n, 2, 7) how a ``motion`` (7,) moves them, px per unit.
    """
    height, width, channels = image.shape
    out = np.empty(base_px.shape[:2])
    along, down = np.empty(4), np.empty(4)
    for p in range(base_px.shape[0]):
        for n in range(base_px.shape[1]):
            u, v = base_px[p, n, 0], base_px[p, n, 1]
            for j in range(7):
                u += flow[p, n, 0, j] * motion[j]
                v += flow[p, n, 1, j] * motion[j]
            if not (1.0 <= u < width - 2.0 and 1.0 <= v < height - 2.0):
                out[p, n] = np.nan
                continue
            left, top = math.floor(u), math.floor(v)
            _taps(u - left, along)
            _taps(v - top, down)
            total = 0.0
            for c in range(channels):
                level = 0.0
                for i in range(4):
                    row = 0.0
                    for j in range(4):
                        row += along[j] * image[top - 1 + i, left - 1 + j, c]
                    level += down[i] * row
                total += weights[c] * level
            out[p, n] = total
    return out


@compiled
def _taps(x: float, out: Array) -> None:
    out[0] = ((-0.5 * x + 1.0) * x - 0.5) * x
    out[1] = (1.5 * x - 2.5) * x * x + 1.0
    out[2] = ((-1.5 * x + 2.0) * x + 0.5) * x
    out[3] = (0.5 * x - 0.5) * x * x


@compiled
def _light(values: Array, mean: Array, weight: Array) -> tuple[float, float, float]:
    """Gain, and middles of ``values`` (n,) and ``mean`` (n,), by which a patch shows what was learnt; no gain: 0."""
    total, value, learnt = 0.0, 0.0, 0.0
    for n in range(len(values)):
        total += weight[n]
        value += weight[n] * values[n]
        learnt += weight[n] * mean[n]
    if not total > 0.0:  # NaN, too: part of the patch lies outside the image
        return 0.0, 0.0, 0.0
    value, learnt = value / total, learnt / total
    own, both = 0.0, 0.0
    for n in range(len(values)):
        off = weight[n] * (mean[n] - learnt)
        own += off * (mean[n] - learnt)
        both += off * (values[n] - value)
    if not own > 0.0:
        return 0.0, 0.0, 0.0
    gain = both / own
    if not GAIN_BOUNDS[0] <= gain <= GAIN_BOUNDS[1]:
        return 0.0, 0.0, 0.0
    return gain, value, learnt


@compiled
def _residuals(
    values: Array, mean: Array, weight: Array, jacobian: Array, motion: Array, robust: Array, residual: Array
) -> float:
    """What each pixel shows more than the light and a motion explain, NaN where no light does; and the scatter."""
    count, squares = 0, 0.0
    for p in range(values.shape[0]):
        gain, value, learnt = _light(values[p], mean[p], robust[p])
        if gain == 0.0:
            residual[p] = np.nan
            continue
        off = residual[p]
        for n in range(values.shape[1]):
            off[n] = (values[p, n] - value) / gain - (mean[p, n] - learnt)
        for j in range(7):
            for n in range(values.shape[1]):
                off[n] -= jacobian[p, j, n] * motion[j]
        for n in range(values.shape[1]):
            if weight[p, n] > 0.0:
                count += 1
                squares += min(off[n] * off[n] * weight[p, n], CLIP_SIGMAS * CLIP_SIGMAS)
    return max(1.0, math.sqrt(squares / max(count, 1)))


@compiled
def _pull(of_motion: Array, off: Array) -> float:
    """Sum of the products (n,), in four that don't wait for one another."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    pixels = len(off)
    for n in range(0, pixels - 3, 4):
        a += of_motion[n] * off[n]
        b += of_motion[n + 1] * off[n + 1]
        c += of_motion[n + 2] * off[n + 2]
        d += of_motion[n + 3] * off[n + 3]
    for n in range(pixels - pixels % 4, pixels):
        a += of_motion[n] * off[n]
    return (a + b) + (c + d)


@compiled
def align(
    values: Array, mean: Array, weight: Array, jacobian: Array, prior: Array, known: Array
) -> tuple[Array, Array, Array, Array, float]:
    """The motion (7,) of the learned pixels that shows best in ``values`` (p, n): iteratively re-weighted least squares
    with Tukey's weight, each patch having its own gain and offset of light, taken out of the residuals with the present
    weights.

    ``mean`` (p, n) as learnt; ``weight`` (p, n) one over the variances, 0 for what doesn't count; ``jacobian``
    (p, 7, n) by how much a motion changes what is seen where the gripper was, less what light could; ``prior`` (7,)
    information that the motion is ``known`` (7,).  Also the information (7, 7), the sum (7, 7) of squares of what each
    patch pulls, the share (p,) of each patch's weight that agrees, and the scatter of the residuals over what was
    learnt, at least 1.
    """
    patches, pixels = values.shape
    motion, scatter = np.zeros(7), 1.0
    robust, residual, weighed = weight.copy(), np.empty((patches, pixels)), np.empty((7, pixels))
    own, pull, pulls = np.empty(7), np.empty(7), np.empty((7, 7))
    # Sums over the patches for each place in a patch: the innermost loop then runs along them.
    sums, information = np.empty((7, 7, pixels)), np.empty((7, 7))
    for turn in range(ROUNDS + 1):
        scatter = _residuals(values, mean, weight, jacobian, motion, robust, residual)
        beyond = 1.0 / (TUKEY * TUKEY * scatter * scatter)
        sums[:], pull[:], pulls[:] = 0.0, 0.0, 0.0
        for p in range(patches):
            off = residual[p]
            for n in range(pixels):
                far = off[n] * off[n] * weight[p, n] * beyond
                if far < 1.0:
                    robust[p, n] = weight[p, n] * (1.0 - far) * (1.0 - far)
                else:  # NaN, too
                    robust[p, n] = off[n] = 0.0
            for i in range(7):
                for n in range(pixels):
                    weighed[i, n] = robust[p, n] * jacobian[p, i, n]
                own[i] = _pull(weighed[i], off)
                for j in range(i + 1):
                    for n in range(pixels):
                        sums[i, j, n] += weighed[i, n] * jacobian[p, j, n]
            for i in range(7):
                pull[i] += own[i]
                for j in range(7):
                    pulls[i, j] += own[i] * own[j]
        for i in range(7):
            pull[i] += prior[i] * (known[i] - motion[i])
            for j in range(i + 1):
                information[i, j] = information[j, i] = sums[i, j].sum()
            information[i, i] += prior[i]
        if turn < ROUNDS:
            motion += np.linalg.solve(information, pull)
    share = np.zeros(patches)
    for p in range(patches):
        whole, kept = 0.0, 0.0
        for n in range(pixels):
            whole += weight[p, n]
            kept += robust[p, n]
        share[p] = kept / whole if whole > 0.0 else 0.0
    return motion, information, pulls, share, scatter
