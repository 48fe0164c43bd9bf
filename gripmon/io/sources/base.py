"""What every source of frames has in common."""

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
    """No frame arrived within the time that ``read`` may take; ``reason`` says why, as far as is known."""

    reason: str


class Source(Protocol):
    """Frames, one at a time.

    ``read`` has one caller and three kinds of answers:

    * a :class:`Frame`; one that could not be made has image None and says why in ``fault``;
    * :class:`Waiting`: nothing arrived, ask again.  Only live sources say so, after at most ``READ_TIMEOUT_S``, so the
      caller can stop, and can report that the camera is missing;
    * None: finished, and so is every later answer.

    A source with ``live`` true is a camera in real time: ``read`` gives the newest frame, older ones that no one asked
    for in time are counted in ``dropped`` (their ``seq`` is missing).  Otherwise ``read`` gives every frame in order,
    at once, ``dropped`` stays 0 and ``connected`` true.  ``connected`` says whether the camera delivers at present.

    ``close`` may be called from any thread and more than once; a ``read`` under way then returns None.
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
    """What every source of recorded frames is: it waits for nobody, and nobody misses one of its frames."""

    live = False
    connected = True
    dropped = 0


READ_TIMEOUT_S = 0.5


class OpenedSource:
    """A source to iterate over: ``for frame in source``, which waits for a live camera, and ends with the frames or by
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
    """A source of a camera that fills only a part of its 16 bits, in the full scale of the type: so that recordings and
    previews show what is measured, too.
    """

    def __init__(self, source: Source, bit_depth: int) -> None:
        super().__init__(source)
        self._bit_depth = bit_depth

    def read(self) -> Frame | Waiting | None:
        answer = self._source.read()
        return in_full_scale(answer, self._bit_depth) if isinstance(answer, Frame) else answer
