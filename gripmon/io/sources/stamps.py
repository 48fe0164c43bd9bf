"""Times of recorded messages: a wrong stamp costs its own frame, and a clock that was set costs one frame.

Each message has two times: its sender's stamp and when it was logged.  Their difference is the sender's offset; it
changes slowly, unless a stamp is wrong (it returns with the next message) or the sender's clock was set (it stays).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple, TypeVar

from gripmon.model.records.values import NS_PER_S

JUMP_NS = 5 * NS_PER_S
"""A stamp that advances by more than this beyond the log's time is wrong: as far as a gap of the monitor's stream, and
more than a recorder's queue holds back.
"""

_T = TypeVar("_T")


class Stamped(NamedTuple):
    """A message's stamp and the time when it was logged, Unix ns."""

    stamp_ns: int
    log_ns: int

    @property
    def offset_ns(self) -> int:
        return self.stamp_ns - self.log_ns


def rising(messages: Iterable[tuple[_T, Stamped]]) -> Iterator[tuple[_T, int, str | None]]:
    """Each message with a time that rises, Unix ns, and None; or with what is wrong with its stamp.

    Where each stamp is later than the one before, and none jumps ahead of the log by :data:`JUMP_NS`, all are as they
    were sent.  After a clock was set, times go on by the log: the following ones are shifted by the step.
    """
    waiting: deque[tuple[_T, Stamped]] = deque()
    last: Stamped | None = None
    last_ns, shift_ns = -1, 0

    def judged() -> tuple[_T, int, str | None]:
        nonlocal last, last_ns, shift_ns
        message, stamped = waiting.popleft()
        following = [after for _, after in waiting]
        fault = None
        if last is not None and stamped.stamp_ns == last.stamp_ns:
            return message, last_ns, "its time stamp is that of the message before"
        if _is_wrong(last, stamped, following):
            fault = f"its time stamp is wrong: {_apart(stamped, last or following[0])} than the log's times say"
            return message, max(last_ns, 0), fault
        if last is not None and _in_conflict(last, stamped):
            shift_ns += last.offset_ns - stamped.offset_ns
            fault = f"its clock was set: {_apart(stamped, last)} than the log's times say, by which later stamps go on"
        last = stamped
        last_ns = max(stamped.stamp_ns + shift_ns, last_ns + 1)
        return message, last_ns, fault

    for each in messages:
        waiting.append(each)
        if len(waiting) > 2:
            yield judged()
    while waiting:
        yield judged()


def _in_conflict(one: Stamped, later: Stamped) -> bool:
    return later.stamp_ns <= one.stamp_ns or later.offset_ns - one.offset_ns > JUMP_NS


def _is_wrong(before: Stamped | None, stamped: Stamped, following: list[Stamped]) -> bool:
    """Whether the stamp is out of order and the log's times say the same of both neighbours: the one before and the one
    after, or two on one side at the recording's ends.
    """
    neighbours = [each for each in (before, *following) if each is not None][:2]
    conflict = (before is not None and _in_conflict(before, stamped)) or (
        bool(following) and _in_conflict(stamped, following[0])
    )
    if not conflict or not neighbours:
        return False
    away_ns = [stamped.offset_ns - each.offset_ns for each in neighbours]
    # On the same side of both, and by about as much: not at a step, where it agrees with one of them.
    return min(away_ns) * max(away_ns) > 0 and 2 * min(map(abs, away_ns)) > max(map(abs, away_ns))


def _apart(stamped: Stamped, other: Stamped) -> str:
    off_ns = stamped.offset_ns - other.offset_ns
    return f"{abs(off_ns) / NS_PER_S:.6g} s {'later' if off_ns > 0 else 'earlier'}"
