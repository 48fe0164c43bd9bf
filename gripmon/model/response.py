"""How a camera's grey levels follow the light, as its images show it, and grey levels in proportion to the light.

A lens blurs light, not grey levels.  So in the blurred border between a finger and its background a pixel shows the
share ``alpha`` of the background's light, and this share is the same before every background::

    g(v_k) = (1 - alpha) g(f_k) + alpha g(b_k)

f_k and b_k are the grey levels that image k shows on both sides, v_k is that of a pixel between them.  With g, the
light of a grey level, this holds for dark and bright backgrounds at once, whatever the exposures; with another curve
the border seems to wander with the contrast.  Powers ``g(v) = v ** gamma`` are tried (Debevec and Malik, 1997, take
exposures in place of backgrounds); sRGB (IEC 61966-2-1) is close to 2.2.  Sharpening and other treatment of the image
count as far as they move borders, which is what a measurement has to know.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.errors import InputError
from gripmon.model.records import Array, Image

Response = Literal["linear", "srgb", "unknown"]
"""How grey levels follow the light; unknown: read as linear, and :data:`UNKNOWN_SIGMA_PX` in every bound."""

UNKNOWN_SIGMA_PX, TAUGHT_SIGMA_PX = 0.2, 0.1
"""Standard deviation of an edge whose response isn't known (px), and of a taught one: sRGB taken as linear moves edges
of dark fingers by 0.04 to 0.33 px; teaching takes off what the backgrounds have in common, the rest is evenly spread.
"""

BETWEEN_GAMMAS = 1.5
"""Power between those of linear (1) and sRGB (2.2) grey levels, their geometric mean (no unit)."""

FEWEST_IMAGES = 4
"""Least number of images: fewer before too few different backgrounds can't show their own scatter."""

FEWEST_PLACES = 100
"""Least number of pixels of borders that stay: three sides of a fingertip of 30 px."""

_GAMMAS = np.arange(0.4, 3.61, 0.2)
_MOST_IMAGES, _MOST_PIXELS, _MOST_PLACES = 24, 40_000_000, 2000
_NEAR_PX, _FAR_PX = 2.5, 5.0  # range beside a border where its sides are read
_BETWEEN_PX = 1.5
_LEAST_STEP = 0.06  # part of the full scale
_UNEVEN = 0.15  # largest scatter of a side, as part of the step
_NOISE = 0.01  # least standard deviation of a grey level, part of the full scale
_DRAWS, _RISK = 400, 0.1
_BLOCK_PX = 40.0  # neighbours within it show the same background
_ROUNDS = 5


@dataclass(frozen=True)
class ResponseSeen:
    """How grey levels follow the light, and how that is known.

    ``response`` as the images show it; the ``gamma`` that explains them best, within ``low`` and ``high`` (90 %), NaN
    where nothing can be said; ``why``, a text.
    """

    response: Response
    why: str
    gamma: float = math.nan
    low: float = math.nan
    high: float = math.nan

    @property
    def sigma_px(self) -> float:
        """What not knowing it adds to an edge's standard deviation (px)."""
        return UNKNOWN_SIGMA_PX if self.response == "unknown" else 0.0

    @property
    def notes(self) -> tuple[str, ...]:
        """:meth:`text`, where it isn't what everybody takes for granted."""
        return () if self.response == "linear" and not self.gamma > 0.0 else (self.text(),)

    def text(self) -> str:
        """One line for a person."""
        effect = f": read as linear, up to {UNKNOWN_SIGMA_PX:g} px more in every edge's standard deviation"
        return f"response: {self.response}{effect if self.response == 'unknown' else ''} ({self.why})"


class _Borders(NamedTuple):
    """Columns and rows (p,) of pixels on borders that stay, and the normals there (p, 2)."""

    x: Array
    y: Array
    normal: Array


def as_light(levels: NDArray[Any], full_scale: float) -> Array:
    """Grey levels of the response srgb in proportion to the light, to the same full scale (IEC 61966-2-1)."""
    encoded = np.maximum(levels / full_scale, 0.0)
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    return np.asarray(full_scale * light)


def likely_linear(images: Sequence[Image]) -> bool:
    """Whether grey levels are taken as linear where nothing tells: those without colour, or of more than 8 bits, as of
    industrial cameras.
    """
    return not any(
        image.ndim == 3 and image.dtype == np.uint8 and float(np.ptp(image, axis=2).mean()) >= COLOURED_LEVELS
        for image in images
    )


COLOURED_LEVELS = 1.0
"""Mean range of a pixel's three colours (8-bit grey levels) from which a camera is a colour camera."""


def response_of(
    images: Sequence[Image], asked: str = "auto", openings_m: Sequence[float | None] | None = None
) -> ResponseSeen:
    """What is ``asked`` for, linear or srgb; auto: :func:`find_response`."""
    if asked == "auto":
        return find_response(images, openings_m)
    if asked not in ("linear", "srgb", "unknown"):
        raise InputError(f"'{asked}' is no response; auto, linear or srgb", "response")
    return ResponseSeen(asked, "as given")  # type: ignore[arg-type]


def in_light(image: Image, response: Response) -> Image:
    """The image with grey levels in proportion to the light: as it is, but for srgb, of which each colour is converted
    by itself, to 16 bits (float images stay float).
    """
    if response != "srgb":
        return image
    if image.dtype.kind == "f":
        return np.asarray(as_light(image, 1.0), dtype=image.dtype)
    top = int(np.iinfo(image.dtype.str).max)
    table = np.rint(as_light(np.arange(top + 1), float(top)) * (65535.0 / top)).astype(np.uint16)
    return np.asarray(table[image])


def find_response(images: Sequence[Image], openings_m: Sequence[float | None] | None = None) -> ResponseSeen:
    """The response of the camera that took the images (one size), in which the gripper stays but for some play and the
    background changes.  ``openings_m``: of the jaws in each; fingers are compared at the same one only.
    """
    if len(images) < FEWEST_IMAGES:
        return _untold(images, f"{len(images)} images; {FEWEST_IMAGES} before different backgrounds would tell it")
    sets = [_costs([images[k] for k in own]) for own in _alike(openings_m, len(images))]
    found = [costs for costs in sets if costs is not None]
    if not found:
        return _untold(images, "the images show too few borders that stay before backgrounds that change")
    gamma = _best(np.sum([costs.sum(axis=(1, 2)) for costs in found], axis=0))
    low, high = np.quantile(_drawn(found), [0.5 * _RISK, 1.0 - 0.5 * _RISK]).tolist()
    seen = f"borders before different backgrounds show gamma {gamma:.1f}, {low:.1f} to {high:.1f} (90 %)"
    sound = _GAMMAS[1] <= gamma <= _GAMMAS[-2]
    if sound and high < BETWEEN_GAMMAS:
        return ResponseSeen("linear", seen, gamma, low, high)
    if sound and low > BETWEEN_GAMMAS:
        return ResponseSeen("srgb", seen, gamma, low, high)
    return _untold(images, f"{seen}: neither linear nor sRGB for sure", gamma, low, high)


def _alike(openings_m: Sequence[float | None] | None, count: int) -> list[list[int]]:
    """Indices of the images of each opening that enough of them show."""
    sets: dict[float | None, list[int]] = {}
    for k in range(count):
        opening_m = None if openings_m is None else openings_m[k]
        sets.setdefault(opening_m if opening_m is None else round(opening_m, 4), []).append(k)
    return [own for own in sets.values() if len(own) >= FEWEST_IMAGES]


def _untold(
    images: Sequence[Image], why: str, gamma: float = np.nan, low: float = np.nan, high: float = np.nan
) -> ResponseSeen:
    if likely_linear(images) and not low > 1.0:
        return ResponseSeen("linear", f"{why}; linear is assumed of images without colour", gamma, low, high)
    return ResponseSeen("unknown", why, gamma, low, high)


def _levels(image: Image) -> NDArray[np.float32]:
    """The green of an image from 0 to 1: a mixture of colours is no power of the light."""
    top = 1.0 if image.dtype.kind == "f" else float(np.iinfo(image.dtype.str).max)
    return np.asarray((image[:, :, 1] if image.ndim == 3 else image), dtype=np.float32) / np.float32(top)


def _borders(grey: Sequence[NDArray[np.float32]]) -> _Borders:
    """Pixels on the strongest edges that stay, whose direction (doubled angles) and place most images agree on."""
    from gripmon.model.staying import LEAST_CHANGING, edges_that_stay

    edges = edges_that_stay([255.0 * image for image in grey])
    # The steepest that stay most surely: a finger's own texture stays, too, and changes with no background.
    strength = np.where(edges.stays & (edges.most_changing >= LEAST_CHANGING), edges.slope * edges.share, 0.0)
    rim = int(2 * _FAR_PX)
    strength[:rim] = strength[-rim:] = strength[:, :rim] = strength[:, -rim:] = 0.0
    y, x = np.nonzero(strength)
    strongest = np.argsort(-strength[y, x], kind="stable")[:_MOST_PLACES]
    y, x = y[strongest], x[strongest]
    across = edges.across_rad[y, x].astype(float)
    return _Borders(x.astype(float), y.astype(float), np.column_stack([np.cos(across), np.sin(across)]))


class _Read(NamedTuple):
    """Grey levels across borders: ``across`` (n, p, s), both sides' means ``near``, ``beyond`` (n, p), their scatters,
    which are ``usable`` (n, p): even on both sides, with a step, not cut off; and the middle samples' ``usual`` place
    (p, m) between both sides.
    """

    across: NDArray[np.float32]
    near: Array
    beyond: Array
    near_sigma: Array
    beyond_sigma: Array
    usable: NDArray[np.bool_]
    usual: Array


_S = np.arange(-_FAR_PX, _FAR_PX + 0.01, 0.5)
_MIDDLE = np.abs(_S) <= _BETWEEN_PX


def _read(grey: Sequence[NDArray[np.float32]], borders: _Borders, shifts_px: Array) -> _Read:
    import cv2

    across = np.stack([
        cv2.remap(
            image,
            (borders.x[:, None] + borders.normal[:, :1] * _S + shift[0]).astype(np.float32),
            (borders.y[:, None] + borders.normal[:, 1:] * _S + shift[1]).astype(np.float32),
            cv2.INTER_CUBIC,
        )
        for image, shift in zip(grey, shifts_px, strict=True)
    ])  # fmt: skip
    inner, outer = across[:, :, _S <= -_NEAR_PX], across[:, :, _S >= _NEAR_PX]
    near, beyond = inner.mean(axis=2), outer.mean(axis=2)
    scatter = inner.std(axis=2), outer.std(axis=2)
    step = beyond - near
    usable = (np.abs(step) > _LEAST_STEP) & (np.maximum(*scatter) < _UNEVEN * np.abs(step))
    usable &= (across.max(axis=2) < 0.98) & (np.minimum(near, beyond) > _NOISE)
    chosen = usable | ~usable.any(axis=0)
    place = (across[:, :, _MIDDLE] - near[:, :, None]) / np.where(usable, step, 1.0)[:, :, None]
    usual = np.nanmedian(np.where(chosen[:, :, None], place, np.nan), axis=0)
    return _Read(np.asarray(across, np.float32), near, beyond, *scatter, np.asarray(usable), usual)


class _Fit(NamedTuple):
    """Deviations ``off`` (n, p, s) from the equation, in standard deviations ``sigma``, where it holds (``inside``)."""

    off: Array
    sigma: Array
    inside: NDArray[np.bool_]


def _fit(read: _Read, gamma: float) -> _Fit:
    """The middle samples with each pixel's best share, the same in all images."""
    v = read.across[:, :, _MIDDLE]
    near, beyond = read.near[:, :, None], read.beyond[:, :, None]
    usual = read.usual
    inside = read.usable[:, :, None] & (usual > 0.1) & (usual < 0.9)
    sigma = np.sqrt(
        _NOISE**2 + (usual * read.beyond_sigma[:, :, None]) ** 2 + ((1.0 - usual) * read.near_sigma[:, :, None]) ** 2
    )
    light = np.maximum(v, 0.0) ** gamma
    f, b = np.maximum(near, 0.0) ** gamma, np.maximum(beyond, 0.0) ** gamma
    slope = gamma * np.maximum(v, _NOISE) ** (gamma - 1.0) * sigma
    weight = inside.astype(float)
    off = np.zeros(v.shape)
    wide = (b - f) / slope
    along, square = wide * (light - f) / slope, wide**2
    for _ in range(_ROUNDS):
        share = (weight * along).sum(axis=0) / np.maximum((weight * square).sum(axis=0), 1e-12)
        off = (v - np.maximum(f + share * (b - f), 1e-9) ** (1.0 / gamma)) / sigma
        weight = inside / (1.0 + off**2)
    return _Fit(off, sigma, np.asarray(inside))


def _costs(images: Sequence[Image]) -> Array | None:
    """Cost (gammas, images, blocks) of each power, by images and blocks of neighbours; None if too little is seen."""
    most = min(_MOST_IMAGES, max(FEWEST_IMAGES, _MOST_PIXELS // (images[0].shape[0] * images[0].shape[1])))
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), most)).round().astype(int))
    grey = [_levels(images[k]) for k in chosen.tolist()]
    borders = _borders(grey)
    if len(borders.x) < FEWEST_PLACES:
        return None
    shifts_px = np.zeros((len(grey), 2))
    read = _read(grey, borders, shifts_px)
    for _ in range(3):  # the play of a real mount: small, and not the background's doing
        moved_px = _play_px(read, borders, _fit(read, BETWEEN_GAMMAS))[1]
        shifts_px = shifts_px + moved_px - np.median(moved_px, axis=0)
        read = _read(grey, borders, shifts_px)
    enough = read.usable.sum(axis=0) >= FEWEST_IMAGES
    if np.count_nonzero(enough) < FEWEST_PLACES:
        return None
    read = _Read(
        read.across[:, enough], read.near[:, enough], read.beyond[:, enough], read.near_sigma[:, enough],
        read.beyond_sigma[:, enough], read.usable[:, enough], read.usual[enough],
    )  # fmt: skip
    block = np.floor(np.column_stack([borders.x, borders.y])[enough] / _BLOCK_PX) @ [1.0, 1e4]
    _, block = np.unique(block, return_inverse=True)
    costs = np.zeros((len(_GAMMAS), len(grey), int(block.max()) + 1))
    borders = _Borders(*(part[enough] for part in borders))
    for number, gamma in enumerate(_GAMMAS.tolist()):
        fit = _fit(read, gamma)
        along, moved_px = _play_px(read, borders, fit)
        off = fit.off - np.einsum("npsi,ni->nps", along, moved_px) / fit.sigma
        own = np.where(fit.inside, np.log1p(off**2), 0.0).sum(axis=2)
        np.add.at(costs[number].T, block, own.T)
    return costs


def _play_px(read: _Read, borders: _Borders, fit: _Fit) -> tuple[Array, Array]:
    """How grey levels change as the gripper moves (n, p, s, 2), 1/px, and how far (n, 2) it does in each image, px."""
    steep = np.gradient(read.across, 0.5, axis=2)[:, :, _MIDDLE]
    weight = fit.inside / (1.0 + fit.off**2) / fit.sigma**2
    along = -steep[..., None] * borders.normal[None, :, None, :]
    normal = np.einsum("npsi,npsj,nps->nij", along, along, weight, optimize=True) + np.eye(2)
    side = np.einsum("npsi,nps->ni", along, weight * fit.off * fit.sigma)
    return along, np.clip(np.linalg.solve(normal, side[..., None])[..., 0], -1.0, 1.0)


def _best(cost: Array) -> float:
    """The power at the least cost, by a parabola through its neighbours."""
    at = int(cost.argmin())
    if at in (0, len(_GAMMAS) - 1):
        return float(_GAMMAS[at])
    low, mid, high = cost[at - 1 : at + 2].tolist()
    return float(_GAMMAS[at] + 0.5 * 0.2 * (low - high) / max(low - 2.0 * mid + high, 1e-12))


def _drawn(found: Sequence[Array]) -> Array:
    """The power from images and blocks drawn again with replacement (the bootstrap of a two-way layout)."""
    rng = np.random.default_rng(0)
    out = np.empty(_DRAWS)
    for k in range(_DRAWS):
        total: Array = np.zeros(len(_GAMMAS))
        for costs in found:
            image, block = (np.bincount(rng.integers(0, n, n), minlength=n) for n in costs.shape[1:])
            total = total + np.einsum("gnb,n,b->g", costs, image, block, optimize=True)
        out[k] = _best(total)
    return out
