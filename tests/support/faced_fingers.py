"""Stills of two fingers with narrow faces of the wall's grey and a pad that forms a notch, before walls and things, as
in a laboratory; polygons, so that the true outline is known.  Each face has a light of its own, each image an exposure.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

SIZE_PX = (480, 360)
BLUR_PX = 0.8
_FINE = 4
_FACES = 0.7, 0.4
"""How often a finger has a face along its outer border, and one along its tip."""


class FacedFingers:
    """Fingers by ``seed``."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([7, seed])
        self._seed, self._wall_dn = seed, float(rng.uniform(90.0, 170.0))
        self._faces: list[tuple[NDArray[np.uint8], float]] = []
        for side in (1, -1):  # the sign of x towards the other finger
            self._add_finger(side, rng)

    def _add_finger(self, side: int, rng: np.random.Generator) -> None:
        width, height = SIZE_PX
        middle = width / 2 - side * width * rng.uniform(0.14, 0.3)
        wide, top, lean = rng.uniform(26.0, 60.0), height * rng.uniform(0.62, 0.8), rng.uniform(-0.25, 0.25)
        dark = rng.uniform(20.0, 60.0) if rng.random() < 0.7 else rng.uniform(190.0, 230.0)
        inner, outer = middle + side * wide / 2, middle - side * wide / 2

        def part(first: float, last: float, above: float, below: float = height + 40.0) -> Array:
            return np.array([
                [x + lean * (y - top), y] for x, y in ((first, above), (last, above), (last, below), (first, below))
            ])  # fmt: skip

        def grey() -> float:
            return self._wall_dn + float(rng.normal(0.0, 6.0))

        pad = part(inner, inner + side * rng.uniform(8.0, 22.0), top + rng.uniform(6.0, 18.0))
        shapes = [(part(outer, inner, top), dark), (pad, dark + (self._wall_dn - dark) * rng.uniform(0.3, 0.7))]
        if rng.random() < _FACES[0]:
            shapes.append((part(outer, outer - side * rng.uniform(1.5, 7.0), top), grey()))
        if rng.random() < _FACES[1]:
            shapes.append((part(outer, inner, top - rng.uniform(1.5, 5.0), top), grey()))
        self._faces += [(_filled(shape), float(level)) for shape, level in shapes]

    def images(self, count: int, first: int = 0) -> list[NDArray[np.uint8]]:
        return [self._image(np.random.default_rng([11, self._seed, k])) for k in range(first, first + count)]

    def _image(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        width, height = SIZE_PX
        fine = cv2.resize(self._background(rng), (width * _FINE, height * _FINE), interpolation=cv2.INTER_LINEAR)
        for covered, level in self._faces:
            fine = np.where(covered > 0, np.float32(level * (1.0 + 0.03 * rng.normal())), fine)
        out = _seen(fine) * np.exp(0.12 * rng.normal()) + rng.normal(0.0, 1.0, (height, width))
        return np.clip(np.rint(out), 0, 255).astype(np.uint8)

    def _background(self, rng: np.random.Generator) -> NDArray[np.float32]:
        width, height = SIZE_PX
        shade = cv2.resize(rng.normal(0.0, 3.0, (4, 5)), SIZE_PX, interpolation=cv2.INTER_CUBIC)
        out = self._wall_dn + rng.normal(0.0, 5.0) + shade
        out += cv2.GaussianBlur(rng.normal(0.0, 5.0, (height, width)), (0, 0), 1.5)
        for _ in range(rng.integers(6, 24)):
            at, size = rng.uniform((0, 0), SIZE_PX), rng.uniform(8.0, 110.0, 2)
            box = cv2.boxPoints((at.tolist(), size.tolist(), float(rng.uniform(0.0, 180.0))))
            thing = np.zeros((height, width), np.uint8)
            cv2.fillPoly(thing, [np.rint(box).astype(np.int32)], 1)
            out = np.where(thing > 0, np.clip(self._wall_dn + rng.normal(0.0, 35.0), 8.0, 245.0), out)
        return np.asarray(out, np.float32)

    def covered(self) -> NDArray[np.float32]:
        """Part of each pixel (h, w) that the fingers hide, as blurred as the images."""
        return _seen(np.max([covered for covered, _ in self._faces], axis=0).astype(np.float32))


class PaddedFingers(FacedFingers):
    """Bright metal with a pad on its inner side, before rooms of which most are as dark as the pads."""

    def __init__(self, seed: int, pad_dn: float = 25.0, room_dn: tuple[float, float] = (8.0, 45.0)) -> None:
        self._pad_dn, self._room_dn = pad_dn, room_dn
        super().__init__(seed)

    def _add_finger(self, side: int, rng: np.random.Generator) -> None:
        width, height = SIZE_PX
        middle, wide = width / 2 - side * width * rng.uniform(0.16, 0.28), rng.uniform(34.0, 56.0)
        top, lean = height * rng.uniform(0.45, 0.6), rng.uniform(-0.2, 0.2)
        inner, outer = middle + side * wide / 2, middle - side * wide / 2

        def part(first: float, last: float, below: float) -> NDArray[np.uint8]:
            corners = (first, top), (last, top), (last, below), (first, below)
            return _filled(np.array([[x + lean * (y - top), y] for x, y in corners]))

        metal_dn = float(rng.uniform(150.0, 210.0))
        pad = part(inner, inner + side * rng.uniform(14.0, 36.0), top + 0.3 * height)
        self._faces += [(part(outer, inner, height + 40.0), metal_dn), (pad, self._pad_dn)]

    def _background(self, rng: np.random.Generator) -> NDArray[np.float32]:
        width, height = SIZE_PX
        bright = rng.random() > 0.7
        shade = cv2.resize(rng.normal(0.0, 3.0, (4, 5)), SIZE_PX, interpolation=cv2.INTER_CUBIC)
        out = rng.uniform(60.0, 200.0) if bright else rng.uniform(*self._room_dn)
        out = out + shade + cv2.GaussianBlur(rng.normal(0.0, 5.0, (height, width)), (0, 0), 1.5)
        for _ in range(rng.integers(6, 20)):
            at, size = rng.uniform((0, 0), SIZE_PX), rng.uniform(8.0, 110.0, 2)
            box = cv2.boxPoints((at.tolist(), size.tolist(), float(rng.uniform(0.0, 180.0))))
            thing = np.zeros((height, width), np.uint8)
            cv2.fillPoly(thing, [np.rint(box).astype(np.int32)], 1)
            level = rng.uniform(8.0, 60.0) if rng.random() < 0.7 else rng.uniform(60.0, 245.0)
            out = np.where(thing > 0, level, out)
        return np.asarray(np.clip(out, 2.0, 250.0), np.float32)


def _filled(shape: Array) -> NDArray[np.uint8]:
    out = np.zeros((SIZE_PX[1] * _FINE, SIZE_PX[0] * _FINE), np.uint8)
    cv2.fillPoly(out, [np.rint((shape + 0.5) * _FINE - 0.5).astype(np.int32)], 1)
    return out


def _seen(fine: NDArray[np.float32]) -> NDArray[np.float32]:
    soft = cv2.GaussianBlur(fine, (0, 0), BLUR_PX * _FINE)
    return np.asarray(cv2.resize(soft, SIZE_PX, interpolation=cv2.INTER_AREA), np.float32)
