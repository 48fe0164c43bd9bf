"""What stays the same in images in front of changing backgrounds, the gripper, and how certain that is.

Light and exposure change between images, so each is first adjusted to the others' grey levels by a gain and an offset,
computed from the pixels that change least.  A pixel of the gripper then keeps its grey level except for noise, a pixel
of the background doesn't.  All statistics over images are robust: a shadow or a hand in a few of them does no harm.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import linkage
from scipy.spatial.distance import squareform

from gripmon.model.errors import NoResultError
from gripmon.model.pixels import GREY_BGR
from gripmon.model.records import Array, Image
from gripmon.track.edges.profiles import full_scale, quantum

FEWEST_IMAGES = 10
"""Fewest images of one opening: the scatter of ten is known to 24 % (1 / sqrt(2 (n - 1)))."""
NOISE_FACTOR = 4.0
"""Scatter over the gripper's own from which a pixel is background (no unit): with ten images noise alone exceeds it in
none of a million pixels (chi-squared)."""
MOST_STILL_SHARE = 0.9
"""Largest static part of the image: a gripper that hides more of a wrist camera's view leaves too little background."""
FEWEST_STILL_SHARE = 0.005
"""Least static part of the image: less is not a trackable fingertip (0.5 % of 640 x 480 px is 40 x 38 px)."""
ALIKE_SHARE = 0.8
"""Least part of the gripper's pixels that an image must show as the others do; a shadow takes some."""
MOST_DILUTION = 0.01
"""Largest relative error of a gain by noise, which flattens a slope: one grey level of 100 between a finger's faces."""
_AROUND = np.ones((3, 3), np.uint8)
_STEP = 3
_ROUNDS = 3
_MAD = 1.4826


@dataclass(frozen=True)
class Matte:
    """The static pixels of images: ``mean`` (h, w) grey levels; ``scatter`` (h, w), their robust standard deviation
    over the images; ``still`` (h, w), which pixels belong to the gripper; ``noise``, the usual scatter of these, in
    grey levels of 0 to 255.

    ``images`` (n, h, w) float32 at common grey levels, ``kept`` (n,) their indices among those given, ``left_out`` why
    others weren't used.
    """

    mean: NDArray[np.float32]
    scatter: NDArray[np.float32]
    still: NDArray[np.bool_]
    noise: float
    images: NDArray[np.float32]
    kept: tuple[int, ...]
    left_out: dict[int, str]


def grey_levels(image: Image) -> NDArray[np.float32]:
    """An image as (h, w) float32 from 0 to 255; colour (blue first) is converted as in the measurement."""
    pixels = image.astype(np.float32) * np.float32(255.0 / full_scale(image))
    if pixels.ndim == 3:
        pixels = pixels @ GREY_BGR
    return np.ascontiguousarray(pixels)


def smallest_noise(image: Image) -> float:
    """Standard deviation of a pixel by rounding alone, in grey levels of 0 to 255."""
    return 255.0 * quantum(image) / full_scale(image) / 12.0**0.5


def find_matte(
    images: Sequence[NDArray[np.float32]], least_noise: float, step: Callable[[], None] = lambda: None
) -> Matte:
    """The matte of ``images`` (h, w) at one jaw opening.  Raises :class:`NoResultError` if too few are alike, nothing
    changes behind the gripper, or nothing is static.
    """
    stack = np.stack(images)
    kept = np.arange(len(stack))
    left_out: dict[int, str] = {}
    while True:
        mean, scatter, still, noise = _statistics(stack, least_noise)
        step()
        alike = _alike(stack, mean, scatter, still, noise)
        bad = alike < ALIKE_SHARE
        if not bad.any():
            break
        for k in np.flatnonzero(bad).tolist():
            left_out[int(kept[k])] = (
                f"shows {100.0 * alike[k]:.1f} % of the gripper where the others do, at least "
                f"{100.0 * ALIKE_SHARE:.0f} %: the camera or the jaws moved, something hides it, or another gripper"
            )
        if np.count_nonzero(~bad) < max(FEWEST_IMAGES, (len(images) + 2) // 2):
            raise NoResultError(
                f"{len(left_out)} of {len(images)} images contradict the others (each shows less than "
                f"{100.0 * ALIKE_SHARE:.0f} % of the gripper where the others do); one camera, one gripper, jaws at "
                "rest, sharp images"
            )
        stack, kept = stack[~bad], kept[~bad]
    sets = _sets(np.ascontiguousarray(stack[:, :: _STEP + 1, :: _STEP + 1]), noise)
    if len(sets) > 1:
        raise sets_refused([len(own) for own in sets])
    return Matte(mean, scatter, still, noise, stack, tuple(kept.tolist()), left_out)


def sets_refused(counts: Sequence[int]) -> NoResultError:
    """The refusal of sets of images (``counts`` images each) that don't show one gripper."""
    sizes = " and ".join(map(str, counts))
    return NoResultError(
        f"the images fall into {len(counts)} sets, of {sizes}, in which different parts stay the same; images of one "
        "gripper, a camera fixed to it, jaws at rest, each with another background"
    )


def image_sets(images: Sequence[NDArray[np.float32]], least_noise: float) -> list[list[int]]:
    """Indices of images (h, w) with the same static part, the largest set first; usually a set per jaw opening.  A set
    has at least :data:`FEWEST_IMAGES`; fewer images unlike all others stay with a set, whose matte rejects them.
    """
    small = np.stack([image[:: _STEP + 1, :: _STEP + 1] for image in images])
    noise = _levelled(small, least_noise)[3]
    if len(images) > FEWEST_IMAGES:
        # The noise shows within a set: in one image and those most like it.
        alike = _alikeness(small, noise)
        core = np.argsort(-alike, axis=1)[:, : FEWEST_IMAGES - 1]
        first = int(np.take_along_axis(alike, core, axis=1).sum(axis=1).argmax())
        noise = min(noise, _levelled(small[[first, *core[first]]], least_noise)[3])
    return _sets(small, noise)


def _sets(small: NDArray[np.float32], noise: float) -> list[list[int]]:
    """As :func:`image_sets`, of images (n, h, w) at common grey levels.  Merges the most similar first, but never two
    sets of enough images, each of which is static in places where the other one isn't.
    """
    apart = 1.0 - _alikeness(small, noise)
    np.fill_diagonal(apart, 0.0)
    flat, limit = small.reshape(len(small), -1), NOISE_FACTOR * noise
    nodes = [[[k]] for k in range(len(small))]
    for i, j in linkage(squareform(apart, checks=False), "average")[:, :2]:
        one, other = nodes[int(i)], nodes[int(j)]
        both = [*one, *other]
        if len(both) == 2 and not _differ(flat[both[0]], flat[both[1]], limit):
            both = [both[0] + both[1]]
        nodes.append(both)
    found = [part for part in nodes[-1] if len(part) >= FEWEST_IMAGES]
    for part in nodes[-1]:
        if len(part) < FEWEST_IMAGES:
            min(found, key=lambda own: float(apart[np.ix_(part, own)].mean())).extend(part)
    return sorted(map(sorted, found), key=lambda own: (-len(own), own[0]))


def _differ(one: NDArray[np.float32], other: NDArray[np.float32], limit: float) -> bool:
    """Whether each of two sets of images (n, p) has more static pixels than both together."""
    if min(len(one), len(other)) < FEWEST_IMAGES:
        return False
    least = min(_still_share(one, limit), _still_share(other, limit))
    both = _still_share(np.concatenate([one, other]), limit)
    return least > both + 4.0 * FEWEST_STILL_SHARE and least > 1.1 * both


def _alikeness(small: NDArray[np.float32], noise: float) -> Array:
    """Part (n, n) of two images (n, h, w) that is the same.  Backgrounds agree in single pixels by chance; static
    pixels agree together with their neighbours.
    """
    alike = np.zeros((len(small), len(small)))
    for i, j in itertools.combinations(range(len(small)), 2):
        same = cv2.absdiff(small[i], small[j]) < 2.0**0.5 * NOISE_FACTOR * noise
        alike[i, j] = alike[j, i] = cv2.erode(same.view(np.uint8), _AROUND).mean()
    return alike


def _still_share(part: NDArray[np.float32], limit: float) -> float:
    """Part of the pixels (n, p) that stay the same in all but a tenth of the images."""
    last = max(int(0.9 * len(part)), 2)
    off = _partitioned(np.abs(part - _median(part)), last - 1)[..., last - 1]
    return float((off < limit).mean())


def _statistics(
    stack: NDArray[np.float32], least_noise: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], float]:
    """Mean, scatter, static pixels, and noise; adjusts ``stack`` to common grey levels, in place."""
    mean, scatter, still, noise = _levelled(stack, least_noise)
    share = float(still.mean())
    if share > MOST_STILL_SHARE:
        raise NoResultError(
            f"{100.0 * share:.0f} % of the image stays the same; images with changing backgrounds: move the robot "
            "between them"
        )
    still = _cleaned(still)
    if still.mean() < FEWEST_STILL_SHARE:
        raise NoResultError(
            f"only {100.0 * float(still.mean()):.1f} % of the image stays the same; a camera that is fixed to the "
            "gripper, one gripper, jaws at rest, constant light"
        )
    return mean, scatter, still, noise


def _levelled(
    stack: NDArray[np.float32], least_noise: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], float]:
    """As :func:`_statistics`, without its checks; specks and holes of the static part remain."""
    quiet = None
    for _ in range(_ROUNDS):
        _level(stack, quiet)
        mean, scatter = _robust(stack)
        clipped = (mean <= 1.0) | (mean >= 254.0)
        noise = _noise(scatter, mean, clipped, least_noise)
        still = scatter < NOISE_FACTOR * noise
        quiet = still & ~clipped
    return mean, scatter, still, noise


def _level(stack: NDArray[np.float32], quiet: NDArray[np.bool_] | None) -> None:
    """Adjust each image in place by a gain and an offset, so that the quiet pixels agree with their median."""
    small = stack[:, ::_STEP, ::_STEP].reshape(len(stack), -1)
    middle = _median(small)
    if quiet is None:
        scatter = _median(np.abs(small - middle)) / np.maximum(middle, 8.0)
        usable = (middle > 4.0) & (middle < 250.0)
        chosen = usable & (scatter <= np.quantile(scatter[usable], 0.05)) if usable.any() else usable
    else:
        chosen = quiet[::_STEP, ::_STEP].ravel()
    if np.count_nonzero(chosen) < 50:
        return
    wanted = middle[chosen].astype(float)
    for k in range(len(stack)):
        gain, offset = _gain(small[k, chosen].astype(float), wanted)
        if 0.2 < gain < 5.0:
            stack[k] = gain * stack[k] + offset


def _gain(seen: Array, wanted: Array) -> tuple[float, float]:
    """Robust gain and offset that adjust grey levels (p,) of an image to those of all images."""
    weight, gain, offset = np.ones(len(seen)), 1.0, 0.0
    for _ in range(6):
        total = float(weight.sum())
        centre = float(weight @ seen) / total, float(weight @ wanted) / total
        spread = float(weight @ np.square(seen - centre[0])) / total
        noise = _MAD * float(np.median(np.abs(gain * seen + offset - wanted)))
        # Without a spread of grey levels, beyond noise, only one of the two can be determined: the gain.
        if spread > noise**2 / MOST_DILUTION:
            gain = float(weight @ ((seen - centre[0]) * (wanted - centre[1]))) / total / spread
            offset = centre[1] - gain * centre[0]
        else:
            gain, offset = centre[1] / max(centre[0], 1.0), 0.0
        off: Array = np.abs(gain * seen + offset - wanted)
        weight = 1.0 / np.maximum(off / max(_MAD * float(np.median(off)), 0.1), 1.0)
    return gain, offset


def _partitioned(values: NDArray[np.float32], kth: int) -> NDArray[np.float32]:
    """Partition along the first axis, which becomes the last: contiguous data takes a fraction of the time."""
    turned = np.ascontiguousarray(np.moveaxis(values, 0, -1))
    turned.partition(kth, axis=-1)
    return turned


def _median(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Median along the first axis; the upper of two middle values."""
    middle = len(values) // 2
    return np.asarray(_partitioned(values, middle)[..., middle])


def _robust(stack: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Median and scatter (h, w) over images, by rows to save memory.  The scatter is the root mean square of the
    smallest nine tenths of the deviations; unlike their median it shows background that differs in few images.
    """
    mean, scatter = np.empty_like(stack[0]), np.empty_like(stack[0])
    rows = max(1, int(4e6 / (stack.shape[0] * stack.shape[2])))
    last = max(int(0.9 * len(stack)), 2)
    for top in range(0, stack.shape[1], rows):
        part = stack[:, top : top + rows]
        mean[top : top + rows] = middle = _median(part)
        off = _partitioned(np.abs(part - middle), last - 1)[..., :last]
        scatter[top : top + rows] = np.sqrt(np.square(off).mean(axis=-1)) / 0.79
    return mean, scatter


def _noise(
    scatter: NDArray[np.float32], mean: NDArray[np.float32], clipped: NDArray[np.bool_], least_noise: float
) -> float:
    """Scatter of the gripper's pixels: the first mode of the histogram of scatters."""
    usable = np.log(np.maximum(scatter[~clipped], 0.5 * least_noise))
    if not usable.size:
        return least_noise
    counts, ends = np.histogram(usable, bins=np.arange(np.log(0.4 * least_noise), np.log(128.0), 0.08))
    smooth = np.convolve(counts, np.ones(3), mode="same")
    # The first mode with as many pixels as the smallest fingertip has.
    enough = smooth >= 0.25 * FEWEST_STILL_SHARE * scatter.size
    peaks = enough & (smooth >= np.roll(smooth, 1)) & (smooth > np.roll(smooth, -1))
    first = int(np.flatnonzero(peaks)[0]) if peaks.any() else int(smooth.argmax())
    return max(float(np.exp(0.5 * (ends[first] + ends[first + 1]))), least_noise)


def _cleaned(still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Remove specks and holes: a background pixel may stay the same by chance, its neighbourhood doesn't."""
    mask = cv2.medianBlur(still.astype(np.uint8) * 255, 7)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)
    smallest = FEWEST_STILL_SHARE * mask.size
    for value in (255, 0):
        count, labels, stats, _ = cv2.connectedComponentsWithStats((mask == value).astype(np.uint8), connectivity=4)
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] < smallest:
                mask[labels == k] = 255 - value
    return np.asarray(mask > 0)


def _alike(
    stack: NDArray[np.float32],
    mean: NDArray[np.float32],
    scatter: NDArray[np.float32],
    still: NDArray[np.bool_],
    noise: float,
) -> Array:
    """Part (n,) of the gripper's pixels that each image shows as the others do."""
    inside = cv2.erode(still.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    inside = inside if inside.sum() > 100 else still
    limit = NOISE_FACTOR * np.maximum(scatter[inside], noise)
    return np.array([float((np.abs(image[inside] - mean[inside]) < limit).mean()) for image in stack])
