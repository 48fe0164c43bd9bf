"""Images in memory that two processes share: one writes the slots, the other reads them."""

from __future__ import annotations

import mmap
import os
from multiprocessing.reduction import DupFd
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

_PIXEL_TYPES = frozenset({"|u1", "<u2", "<f4"})
_WIDEST_PIXEL_BYTES = 3 * 4


class ImagePlace(msgspec.Struct, frozen=True, array_like=True):
    """Where an image lies."""

    slot: int
    shape: tuple[int, ...]
    pixel_type: str


class SharedImages:
    """Slots for images.  Passed to a process of :mod:`multiprocessing` when that starts, it is the same memory there.

    The memory has no name: it is freed when both processes have ended, however they end, and needs no room in
    ``/dev/shm``.  Pages that were never written cost nothing, so each slot has room for the widest pixels.
    """

    def __init__(self, slots: int, width_px: int, height_px: int, inherited: Any = None) -> None:
        self._size = slots, width_px, height_px
        self.slots, self.slot_bytes = slots, width_px * height_px * _WIDEST_PIXEL_BYTES
        self._descriptor: int = os.memfd_create("gripmon-images") if inherited is None else inherited.detach()
        if inherited is None:
            os.ftruncate(self._descriptor, slots * self.slot_bytes)
        self._map = mmap.mmap(self._descriptor, slots * self.slot_bytes)

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedImages, (*self._size, DupFd(self._descriptor))

    def put(self, slot: int, image: NDArray[np.generic]) -> ImagePlace:
        """Copy an image into a slot; the interpreter lock is free while the pixels move."""
        view = np.frombuffer(self._map, image.dtype, image.size, slot * self.slot_bytes).reshape(image.shape)
        np.copyto(view, image)
        return ImagePlace(slot, image.shape, image.dtype.str)

    def get(self, place: ImagePlace) -> NDArray[np.generic]:
        """A view of the slot, valid until the slot is used again."""
        count = int(np.prod(place.shape))
        flat = np.frombuffer(self._map, np.dtype(place.pixel_type), count, place.slot * self.slot_bytes)
        return flat.reshape(place.shape)

    def takes(self, image: object) -> bool:
        """Whether this is an image (grey or BGR, 8 or 16 bit or float) that fits into a slot."""
        if not isinstance(image, np.ndarray) or image.dtype.str not in _PIXEL_TYPES or image.size == 0:
            return False
        grey_or_bgr = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        return grey_or_bgr and image.nbytes <= self.slot_bytes

    def close(self) -> None:
        self._map.close()
        os.close(self._descriptor)
