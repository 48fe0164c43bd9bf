"""Stills of two fingers with narrow faces and a pad that forms a notch, before walls and things, as in a laboratory;
polygons, so that the true outline is known.  Each face has a light of its own, each image an exposure and some play.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.outlines import points_on, projected_outline
from gripmon.model.camera import PaperLens, make_camera
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.model.response import as_light
from gripmon.teach.from_images import gripper_from_images

SIZE_PX = (480, 360)
LENS = PaperLens(width_px=SIZE_PX[0], height_px=SIZE_PX[1], fx_px=600.0, fy_px=600.0, cx_px=239.5, cy_px=179.5)
DISTANCE_M = (0.115, 5e-5)
FACES = ("the wall's grey", "darker", "lighter", "none")
"""What narrow faces beside a finger's border look like."""
WRONG_PX = 1.0
"""Beside the truth at 95 % of what was written: search lines at work reach 3 px to either side."""
BLUR_PX = 0.8
LIGHT_SHARE, EXPOSURE_SHARE = 0.03, 0.12
"""Standard deviations of a face's light and of an image's exposure."""
_FINE = 4
_TINT = (0.96, 1.0, 1.04)


HEAD = ("narrow faces", "sets", "right", "refused", "wrong", "95 % off, px", "rms over stated sigma, median and most")


class Outcome(NamedTuple):
    """Of a set with these ``faces``: distance of what was written from the true outline (px, at 95 %; root mean square
    of what is not wrong), the standard deviation that is stated (px); NaN, and ``why``, where it is refused.
    """

    faces: str
    off_px: float
    rms_px: float
    sigma_px: float
    why: str

    @property
    def wrong(self) -> bool:
        return self.off_px > WRONG_PX


class FacedFingers:
    """Two fingers by ``seed``, straight or tapered, sharp or rounded, of one tone or two, with ``faces`` of a look."""

    def __init__(self, seed: int, faces: str = FACES[0]) -> None:
        rng = np.random.default_rng([7, seed])
        self._seed, self._wall_dn = seed, float(rng.uniform(90.0, 170.0))
        self.faces = faces
        self._count = int(rng.integers(5, 13))
        self._srgb, self._kind = bool(rng.random() < 0.5), ("walls", "things", "texture")[int(rng.integers(3))]
        play_px = rng.uniform(0.5, 1.4)
        self.play_px = rng.normal(0.0, play_px / 2.0**0.5, (200, 2))
        self._layers: list[tuple[Array, float]] = []
        for side in (1, -1):  # the sign of x towards the other finger
            self._add_finger(side, rng)

    def _add_finger(self, side: int, rng: np.random.Generator) -> None:
        width, height = SIZE_PX
        middle = width / 2 - side * width * rng.uniform(0.16, 0.3)
        wide, top, lean = rng.uniform(26.0, 60.0), height * rng.uniform(0.55, 0.75), rng.uniform(-0.25, 0.25)
        taper = rng.uniform(0.05, 0.25) if rng.random() < 0.4 else 0.0
        radius = rng.uniform(4.0, wide / 2) if rng.random() < 0.35 else 0.0
        own = rng.choice(3, p=(0.5, 0.25, 0.25))
        dark = rng.uniform(*((20.0, 60.0), (60.0, 150.0), (190.0, 230.0))[own])
        chance = 0.0 if self.faces == "none" else 0.5
        outside, inside, above = (rng.uniform(2.0, 12.0) * (rng.random() < chance) for _ in range(3))

        def part(out: float, into: float, up: float, round_px: float = radius, from_px: float = -1e3) -> Array:
            shape = _shape((-wide / 2 - out, wide / 2 + into), up, round_px and round_px + min(out, into, up), taper)
            shape[:, 1] = np.maximum(shape[:, 1], from_px)
            return np.column_stack([middle + side * shape[:, 0] + lean * shape[:, 1], top + shape[:, 1]])

        def grey() -> float:
            if self.faces == "darker":
                return float(dark * rng.uniform(0.3, 0.8))
            if self.faces == "lighter":
                return float(dark + rng.uniform(0.2, 0.7) * (235.0 - dark))
            return self._wall_dn + float(rng.normal(0.0, 6.0))

        shapes = [(part(outside, inside, above), grey())] if max(outside, inside, above) else []
        if outside and (inside or above):
            shapes.append((part(outside, 0.0, 0.0), grey()))
        if inside and above:
            shapes.append((part(0.0, inside, 0.0), grey()))
        shapes.append((part(0.0, 0.0, 0.0), dark))
        if rng.random() < 0.3:
            tone = part(0.0, 0.0, 0.0, 0.0, radius + rng.uniform(10.0, 40.0))
            shapes.append((tone, dark * rng.uniform(0.5, 0.8)))
        if rng.random() < 0.3:
            pad = part(-wide / 2, inside + rng.uniform(8.0, 22.0), 0.0, 0.0, radius + rng.uniform(8.0, 26.0))
            shapes.append((pad, dark + (self._wall_dn - dark) * rng.uniform(0.3, 0.7)))
        self._layers += [(shape, float(level)) for shape, level in shapes]

    def images(self) -> list[NDArray[np.uint8]]:
        return [self._image(k) for k in range(self._count)]

    def _image(self, k: int) -> NDArray[np.uint8]:
        rng = np.random.default_rng([11, self._seed, k])
        width, height = SIZE_PX
        fine = cv2.resize(self._background(rng), (width * _FINE, height * _FINE), interpolation=cv2.INTER_LINEAR)
        for shape, level in self._layers:
            fine[_filled(shape + self.play_px[k]) > 0] = level * (1.0 + LIGHT_SHARE * rng.normal())
        light = _seen(as_light(fine, 255.0).astype(np.float32) if self._srgb else fine)
        light *= np.exp(EXPOSURE_SHARE * rng.normal())
        # Of an industrial camera, or of a colour camera, which sees the light tinted.
        out = _encoded(light[..., None] * np.float32(_TINT)) if self._srgb else light
        return np.clip(np.rint(out + rng.normal(0.0, 1.0, out.shape)), 0, 255).astype(np.uint8)

    def _background(self, rng: np.random.Generator) -> NDArray[np.float32]:
        width, height = SIZE_PX
        shade = cv2.resize(rng.normal(0.0, 3.0, (4, 5)), SIZE_PX, interpolation=cv2.INTER_CUBIC)
        out = self._wall_dn + rng.normal(0.0, 5.0) + shade
        strong, spread = {"walls": (5.0, 40.0), "things": (5.0, 70.0), "texture": (60.0, 40.0)}[self._kind]
        out += cv2.GaussianBlur(rng.normal(0.0, strong, (height, width)), (0, 0), 1.5)
        for _ in range(rng.integers(15, 45)):
            out = np.where(_thing(rng) > 0, self._wall_dn + rng.normal(0.0, spread), out)
        return np.clip(out, 8.0, 245.0).astype(np.float32)

    def beside_px(self, uv_px: Array) -> Array:
        """Distance (n,) of points from the true outline, where the fingers usually are."""
        mask = np.max([_filled(shape) for shape, _ in self._layers], axis=0)
        out, into = (cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) for m in (1 - mask, mask))
        away = out - into - (0.5 - mask)
        at = ((uv_px + 0.5) * _FINE - 0.5).astype(np.float32)
        return np.abs(cv2.remap(away, at[:, :1], at[:, 1:], cv2.INTER_LINEAR)[:, 0] / _FINE).astype(float)


class PaddedFingers(FacedFingers):
    """Bright metal with a pad on its inner side, before rooms of which most are as dark as the pads."""

    def __init__(self, seed: int, pad_dn: float = 25.0, room_dn: tuple[float, float] = (8.0, 45.0)) -> None:
        self._pad_dn, self._room_dn = pad_dn, room_dn
        super().__init__(seed)
        self._srgb, self._count = False, 16
        self.play_px[:] = 0.0  # with it they are refused: so few of their edges show

    def _add_finger(self, side: int, rng: np.random.Generator) -> None:
        width, height = SIZE_PX
        middle, wide = width / 2 - side * width * rng.uniform(0.16, 0.28), rng.uniform(34.0, 56.0)
        top, lean = height * rng.uniform(0.45, 0.6), rng.uniform(-0.2, 0.2)
        inner, outer = middle + side * wide / 2, middle - side * wide / 2

        def part(first: float, last: float, above: float) -> Array:
            corners = (first, above), (last, above), (last, height + 40.0), (first, height + 40.0)
            return np.array([[x + lean * (y - top), y] for x, y in corners])

        pad = part(inner, inner + side * rng.uniform(14.0, 36.0), top + 0.3 * height)
        self._layers += [(part(outer, inner, top), float(rng.uniform(150.0, 210.0))), (pad, self._pad_dn)]

    def _background(self, rng: np.random.Generator) -> NDArray[np.float32]:
        width, height = SIZE_PX
        shade = cv2.resize(rng.normal(0.0, 3.0, (4, 5)), SIZE_PX, interpolation=cv2.INTER_CUBIC)
        out = rng.uniform(60.0, 200.0) if rng.random() > 0.7 else rng.uniform(*self._room_dn)
        out = out + shade + cv2.GaussianBlur(rng.normal(0.0, 5.0, (height, width)), (0, 0), 1.5)
        for _ in range(rng.integers(6, 20)):
            level = rng.uniform(8.0, 60.0) if rng.random() < 0.7 else rng.uniform(60.0, 245.0)
            out = np.where(_thing(rng) > 0, level, out)
        return np.asarray(np.clip(out, 2.0, 250.0), np.float32)


def outcomes(count: int, seed: int) -> Iterator[Outcome]:
    """Of so many sets, with each kind of faces in turn."""
    for k in range(count):
        yield outcome(FacedFingers(1000 * (seed - 1) + k, FACES[k % len(FACES)]))


def outcome(fingers: FacedFingers) -> Outcome:
    """What ``gripper from-images`` makes of a set."""
    faces = fingers.faces
    try:
        found = gripper_from_images(fingers.images(), LENS, distance_m=DISTANCE_M)
    except NoResultError as refused:
        return Outcome(faces, np.nan, np.nan, np.nan, str(refused))
    kept = list(found.seen.matte.kept)
    moved_px = np.median(fingers.play_px[kept] - found.seen.matte.moved_px, axis=0)
    written = points_on(projected_outline(found.gripper, make_camera(LENS), found.cam_T_grip), SIZE_PX)
    off = fingers.beside_px(written - moved_px)
    rms_px = float(np.sqrt(np.square(off[off < WRONG_PX]).mean()))
    return Outcome(faces, float(np.quantile(off, 0.95)), rms_px, found.outline_sigma_px, "")


def rows(sets: Sequence[Outcome]) -> Iterator[list[str]]:
    """Cells of :data:`HEAD`, for each kind of faces and for all."""
    for faces in (*FACES, "all"):
        own = [each for each in sets if faces in (each.faces, "all")]
        written = [each for each in own if not each.why]
        wrong = sum(each.wrong for each in written)
        cells = [faces, str(len(own)), str(len(written) - wrong), str(len(own) - len(written)), str(wrong)]
        right = [each for each in written if not each.wrong]
        if right:
            ratio = [each.rms_px / each.sigma_px for each in right]
            cells += [f"{np.median([e.off_px for e in right]):.2f}", f"{np.median(ratio):.1f}, {max(ratio):.1f}"]
        yield cells


def _shape(sides: tuple[float, float], up: float, radius: float, taper: float) -> Array:
    """A finger (n, 2) that points up, between its two sides at y = 0 and beyond there by ``up``; its corners rounded by
    a radius; each side goes outwards by ``taper`` px per px.
    """
    turn = np.linspace(0.0, 0.5 * np.pi, 13)
    arc = radius * np.column_stack([1.0 - np.cos(turn), 1.0 - np.sin(turn)])
    tip = np.vstack([np.add(arc, (sides[0], -up)), np.add(arc * (-1.0, 1.0), (sides[1], -up))[::-1]])
    tip[:, 0] += np.sign(tip[:, 0]) * taper * np.clip(tip[:, 1], 0.0, None)
    root = float(SIZE_PX[1])
    return np.vstack([[sides[0] - taper * root, root], tip, [sides[1] + taper * root, root]])


def _thing(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Where something stands in the room."""
    at, size = rng.uniform((0, 0), SIZE_PX), rng.uniform(8.0, 110.0, 2)
    box = cv2.boxPoints((at.tolist(), size.tolist(), float(rng.uniform(0.0, 180.0))))
    return cv2.fillPoly(np.zeros(SIZE_PX[::-1], np.uint8), [np.rint(box).astype(np.int32)], 1)


def _encoded(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """sRGB grey levels of light, both to 255; the inverse of :func:`as_light`."""
    grey = np.arange(0.0, 300.0)
    return np.asarray(np.interp(light, as_light(grey, 255.0), grey), np.float32)


def _filled(shape: Array) -> NDArray[np.uint8]:
    out = np.zeros((SIZE_PX[1] * _FINE, SIZE_PX[0] * _FINE), np.uint8)
    cv2.fillPoly(out, [np.rint((shape + 0.5) * _FINE - 0.5).astype(np.int32)], 1)
    return out


def _seen(fine: NDArray[np.float32]) -> NDArray[np.float32]:
    soft = cv2.GaussianBlur(fine, (0, 0), BLUR_PX * _FINE)
    return np.asarray(cv2.resize(soft, SIZE_PX, interpolation=cv2.INTER_AREA), np.float32)
