"""What the loop needs of those around it, which tests stand in for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol


class JawFeed(Protocol):
    """Where the jaw opening at a frame's time comes from when the frames don't bring it, e.g.
    :class:`gripmon.io.publish.inputs.ZenohJaw`.
    """

    def opening_m(self, stamp_ns: int | None = None) -> float | None: ...
    def fault(self) -> str: ...


@dataclass(frozen=True)
class Reports:
    """What the state message says of things that the loop doesn't see itself; asked in its thread, at once answered.

    ``faults`` say what is wrong in a few words, empty or None while nothing is; ``unsent`` counts transforms that could
    not be sent, ``malformed`` messages received that were none; ``alert_limit_m`` as configured; ``others`` are the ids
    of other monitors of this name.
    """

    faults: Sequence[Callable[[], str | None]] = ()
    unsent: Callable[[], int] = int
    malformed: Callable[[], int] = int
    alert_limit_m: float | None = None
    others: Callable[[], tuple[str, ...]] = tuple
