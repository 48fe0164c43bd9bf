"""Images in memory that processes share: each is written by one of them and read by another."""

from __future__ import annotations

import mmap
import os
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Image

_PIXEL_TYPES = frozenset({"|u1", "<u2", "<f4"})
_WIDEST_PIXEL_BYTES = 3 * 4
_HEAD_BYTES = 64  # of a slot: the number of the image that lies in it whole
_BEING_WRITTEN = -1


class ImagePlace(msgspec.Struct, frozen=True, array_like=True):
    """Which image it is, and its form."""

    number: int
    shape: tuple[int, ...]
    pixel_type: str


class SharedImages:
    """A ring of slots: image ``number`` lies in slot ``number % slots`` until the next one is put there.

    Passed by pickle to a process that inherits ``descriptor``, it is the same memory there.  The memory has no name: it
    is freed when all its processes have ended, however they end, and needs no room in ``/dev/shm``.  Pages that were
    never written cost nothing, so each slot has room for the widest pixels.
    """

    def __init__(self, slots: int, width_px: int, height_px: int, descriptor: int | None = None) -> None:
        self._size = slots, width_px, height_px
        self.slots, self.image_bytes = slots, width_px * height_px * _WIDEST_PIXEL_BYTES
        self._slot_bytes = _HEAD_BYTES * (1 + -(-self.image_bytes // _HEAD_BYTES))
        self.descriptor = os.memfd_create("gripmon-images") if descriptor is None else descriptor
        if descriptor is None:
            os.ftruncate(self.descriptor, slots * self._slot_bytes)
        self._map = mmap.mmap(self.descriptor, slots * self._slot_bytes)
        if descriptor is None:
            for slot in range(slots):
                self._head(slot)[0] = _BEING_WRITTEN

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedImages, (*self._size, self.descriptor)

    def put(self, number: int, image: NDArray[np.generic]) -> ImagePlace:
        """Copy an image into its slot; the interpreter lock is free while the pixels move."""
        place, head = ImagePlace(number, image.shape, image.dtype.str), self._head(number)
        head[0] = _BEING_WRITTEN
        np.copyto(self.get(place), image)
        head[0] = number
        return place

    def get(self, place: ImagePlace) -> Image:
        """A view of the slot, valid until it is used again."""
        begin = place.number % self.slots * self._slot_bytes + _HEAD_BYTES
        flat = np.frombuffer(self._map, np.dtype(place.pixel_type), int(np.prod(place.shape)), begin)
        return flat.reshape(place.shape)

    def copy(self, place: ImagePlace) -> Image | None:
        """A copy; None if the slot has been used again."""
        head = self._head(place.number)
        if head[0] != place.number:
            return None
        image = self.get(place).copy()
        return image if head[0] == place.number else None

    def takes(self, image: object) -> bool:
        """Whether this is an image (grey or BGR, 8 or 16 bit or float) that fits into a slot."""
        if not isinstance(image, np.ndarray) or image.dtype.str not in _PIXEL_TYPES or image.size == 0:
            return False
        grey_or_bgr = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        return grey_or_bgr and image.nbytes <= self.image_bytes

    def close(self) -> None:
        self._map.close()
        os.close(self.descriptor)

    def _head(self, number: int) -> NDArray[np.int64]:
        return np.frombuffer(self._map, np.int64, 1, number % self.slots * self._slot_bytes)
