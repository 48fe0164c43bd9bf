"""Means over the last n frames for many n at once, at a cost that doesn't depend on n."""

from __future__ import annotations

import numpy as np

from gripmon.model.records import Array

LENGTHS = tuple(2**k for k in range(13))
"""Frames that a window holds: 1, 2, 4 ... 4096, which is a minute at 60 frames/s."""


class Windows:
    """Running means of ``streams`` series of 6-vectors, from a ring of their sums.

    One stream is the daemon; benchmarks run hundreds beside one another.
    """

    def __init__(self, streams: int):
        self._ring = np.zeros((2 * LENGTHS[-1] + 1, streams, 6))
        self._lengths = np.array(LENGTHS)
        self._shape = (-1, 1, 1)
        self._frames = np.zeros(streams, dtype=np.intp)
        self._newest = 0

    @property
    def frames(self) -> np.ndarray:
        """(s,) frames in the windows of each stream."""
        return self._frames

    def add(self, values: Array) -> None:
        """One frame's values (s, 6)."""
        following = (self._newest + 1) % len(self._ring)
        np.add(self._ring[self._newest], values, out=self._ring[following])
        self._newest = following
        self._frames += 1

    def means(self) -> tuple[Array, Array]:
        """Means (k, s, 6) of the last n frames, and of the n before those, for every n of :data:`LENGTHS`.

        What reaches back beyond the first frame is meaningless; see :meth:`full`.
        """
        ago = self._ring[(self._newest - self._lengths) % len(self._ring)]
        twice_ago = self._ring[(self._newest - 2 * self._lengths) % len(self._ring)]
        count = self._lengths.reshape(self._shape)
        return (self._ring[self._newest] - ago) / count, (ago - twice_ago) / count

    def full(self) -> tuple[np.ndarray, np.ndarray]:
        """(k, s) whether the last n frames, and the last 2 n, lie within the stream."""
        count = self._lengths[:, None]
        return self._frames >= count, self._frames >= 2 * count

    def mean_of_last(self, frames: int) -> Array:
        """(s, 6) mean over the last ``frames`` frames, 1 to 4096."""
        return (self._ring[self._newest] - self._ring[(self._newest - frames) % len(self._ring)]) / frames

    def keep(self, streams: np.ndarray, frames: np.ndarray | int) -> None:
        """Forget all but the last ``frames`` frames of some streams (s,) bool."""
        self._frames = np.where(streams, np.minimum(self._frames, frames), self._frames)
