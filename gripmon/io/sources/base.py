"""The common interface of all sources of frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, Self

from gripmon.model.errors import InputError
from gripmon.model.pixels import in_full_scale
from gripmon.model.records import Frame


class SourceError(InputError):
    """A source that can't start: "key: what is wrong; what would be right", the key as in the source's settings."""


@dataclass(frozen=True, slots=True)
class Waiting:
    """No frame arrived within the time that ``read`` may take; ``reason`` says why, if known."""

    reason: str


class Source(Protocol):
    """Frames, one at a time.

    ``read`` has one caller and returns one of three:

    * a :class:`Frame`; a faulty one has image None and the reason in ``fault``;
    * :class:`Waiting`: nothing arrived, call again.  Only live sources return it, after at most ``READ_TIMEOUT_S``, so
      that the caller can stop, and can report that the camera is missing;
    * None: finished, also for all later calls.

    A source with ``live`` true is a camera in real time: ``read`` returns the newest frame; older ones that were not
    read in time are counted in ``dropped`` (their ``seq`` is missing).  Otherwise ``read`` returns every frame in
    order, immediately; ``dropped`` stays 0 and ``connected`` true.  ``connected``: the camera delivers at present.

    ``close`` may be called from any thread and more than once; a concurrent ``read`` then returns None.
    """

    @property
    def live(self) -> bool: ...
    @property
    def connected(self) -> bool: ...
    @property
    def dropped(self) -> int: ...
    def read(self) -> Frame | Waiting | None: ...
    def close(self) -> None: ...


class Stored:
    """Base of the sources of recorded frames: no real time, and no frame is dropped."""

    live = False
    connected = True
    dropped = 0


READ_TIMEOUT_S = 0.5


class OpenedSource:
    """An iterator over a source: ``for frame in source`` waits for a live camera, and ends with the last frame or with
    ``close``.  As a context manager it closes itself.
    """

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def live(self) -> bool:
        return self._source.live

    @property
    def connected(self) -> bool:
        return self._source.connected

    @property
    def dropped(self) -> int:
        return self._source.dropped

    def read(self) -> Frame | Waiting | None:
        return self._source.read()

    def close(self) -> None:
        self._source.close()

    def __iter__(self) -> Iterator[Frame]:
        while (answer := self.read()) is not None:
            if isinstance(answer, Frame):
                yield answer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class FullScale(OpenedSource):
    """A source of a camera that uses only a part of its 16 bits, scaled to the full range of the type, so that
    recordings and previews are visible, too.
    """

    def __init__(self, source: Source, bit_depth: int) -> None:
        super().__init__(source)
        self._bit_depth = bit_depth

    def read(self) -> Frame | Waiting | None:
        answer = self._source.read()
        return in_full_scale(answer, self._bit_depth) if isinstance(answer, Frame) else answer
