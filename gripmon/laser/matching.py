"""Laser pulses as reported, and which frames show which of them: by their stamps alone, without a clock."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.calibrate.tables import Row, check_scale, pose_of, rows_of
from gripmon.model.errors import input_errors
from gripmon.model.records import Array, Frame, Image, LaserPulse, PulseFault
from gripmon.model.records.values import NS_PER_S

_ENDS_KEPT = 256
_MOST_WAITING = 64


@dataclass(frozen=True, slots=True)
class Pulse:
    """The laser was on, and the end-effector stood still at ``base_T_ee`` (4, 4), between two stamps (ns, the frames'
    clock).

    ``number`` counts the pulses in the order of their reports.
    """

    number: int
    stamp_ns: int
    until_ns: int
    base_T_ee: Array

    def overlaps(self, other: Pulse) -> bool:
        return self.stamp_ns <= other.until_ns and other.stamp_ns <= self.until_ns

    def repeats(self, other: Pulse) -> bool:
        """Whether it is the same pulse reported again, for example by a client that got no answer."""
        same = (self.stamp_ns, self.until_ns) == (other.stamp_ns, other.until_ns)
        return same and bool(np.array_equal(self.base_T_ee, other.base_T_ee))


@dataclass(frozen=True, slots=True)
class Shown:
    """A pulse with its frames, in the order of their stamps: ``lit`` are those with the laser on, ``dark`` the last one
    before it, None if there is none.  A pulse with a ``fault`` must not be judged; ``reason`` says why, in one line.
    """

    pulse: Pulse
    lit: tuple[Frame, ...] = ()
    dark: Frame | None = None
    fault: PulseFault | None = None
    reason: str = ""


@dataclass(slots=True)
class _Waiting:
    """An incomplete pulse; ``until_s`` is its deadline, by the caller's clock (infinite for pulses of a table)."""

    pulse: Pulse
    until_s: float
    fault: PulseFault | None = None
    reason: str = ""


@dataclass(slots=True)
class _Kept:
    """The newest frames, bounded in time and in bytes; ``forgotten_ns`` is the newest stamp that was dropped."""

    frames: deque[Frame] = field(default_factory=deque)
    size_bytes: int = 0
    forgotten_ns: int = -1

    def add(self, frame: Frame) -> None:
        self.frames.append(frame)
        self.size_bytes += _bytes(frame.image)

    def forget_oldest(self) -> None:
        frame = self.frames.popleft()
        self.size_bytes -= _bytes(frame.image)
        self.forgotten_ns = frame.stamp_ns


class Matcher:
    """Takes pulses and frames as they arrive; returns every pulse once, with its frames.

    A pulse is complete with the first frame after its end, or when :meth:`finish` says that no more will come.  If two
    pulses overlap, they can't both be right, and neither is used; nor is a pulse that is reported out of order, before
    one that has been judged.  A pulse that is reported twice counts once.
    """

    def __init__(self, settings: PulseSettings) -> None:
        self._settings = settings
        self._margin_ns = round(settings.margin_s * NS_PER_S)
        self._history_ns = round(settings.history_s * NS_PER_S)
        self._kept = _Kept()
        self._waiting: list[_Waiting] = []
        self._done: deque[Pulse] = deque(maxlen=_ENDS_KEPT)
        self._newest_ns = -1
        self._count = 0

    @property
    def waiting(self) -> int:
        """Number of pulses whose last frame hasn't arrived."""
        return len(self._waiting)

    def pulse(self, reported: ReportedPulse, now_s: float) -> list[Shown]:
        """Take a reported pulse; return the pulses that are complete now, oldest first.  ``now_s``: as for
        :meth:`tick`, by any clock.
        """
        pulse = Pulse(self._count, *reported)
        if any(pulse.repeats(known) for known in (*self._done, *(each.pulse for each in self._waiting))):
            return []
        self._count += 1
        if len(self._waiting) >= _MOST_WAITING:
            text = f"{_MOST_WAITING} pulses wait for their frames already; each reported when it is over"
            return [Shown(pulse, fault=PulseFault.OUT_OF_ORDER, reason=text)]
        length_s = 1e-9 * (pulse.until_ns - pulse.stamp_ns)
        entry = _Waiting(pulse, now_s + length_s + self._settings.wait_s)
        self._check(entry)
        self._waiting.append(entry)
        self._waiting.sort(key=lambda each: each.pulse.stamp_ns)
        return self._complete()

    def load(self, table: Sequence[ReportedPulse]) -> None:
        """Load all pulses of recorded frames at once, by their stamps, none of them overlapping; before any frame."""
        self._waiting = [_Waiting(Pulse(k, *reported), math.inf) for k, reported in enumerate(table)]
        self._count = len(table)

    def frame(self, frame: Frame) -> list[Shown]:
        """Take a frame, without image if it can't be used; return the pulses that are complete with it."""
        back_ns = self._newest_ns - frame.stamp_ns
        if 0 <= back_ns <= self._history_ns:
            return []  # its stamp doesn't increase: nothing new
        if back_ns > self._history_ns:  # a clock was set back: what is stored is of another time
            self._kept = _Kept()
            self._done.clear()
        self._newest_ns = frame.stamp_ns
        self._kept.add(frame)
        shown = self._complete()
        self._forget()
        return shown

    def tick(self, now_s: float) -> list[Shown]:
        """The pulses whose deadline has passed."""
        over = [each for each in self._waiting if each.until_s < now_s]
        self._waiting = [each for each in self._waiting if each.until_s >= now_s]
        return [self._shown(entry) for entry in over]

    def finish(self) -> list[Shown]:
        """No more frames will come: return the pulses that still wait, with the frames that there are."""
        entries, self._waiting = self._waiting, []
        return [self._shown(entry) for entry in entries]

    def _check(self, entry: _Waiting) -> None:
        """Mark a new pulse, and those that contradict it, with a fault."""
        pulse = entry.pulse
        for other in self._waiting:
            if pulse.overlaps(other.pulse):
                text = "overlaps with another pulse, and the hand can't have stood still in two places"
                for each in (entry, other):
                    each.fault, each.reason = PulseFault.OVERLAP, text
        if self._done and pulse.stamp_ns <= (last := max(self._done, key=lambda p: p.until_ns)).until_ns:
            overlaps = any(pulse.overlaps(done) for done in self._done)
            entry.fault = PulseFault.OVERLAP if overlaps else PulseFault.OUT_OF_ORDER
            entry.reason = (
                "overlaps with a pulse that was judged before it was reported"
                if overlaps
                else f"was reported {_seconds(last.until_ns - pulse.stamp_ns)} out of order: a later one was judged"
            )

    def _complete(self) -> list[Shown]:
        # Sorted by their start: only the first few of a long table are examined.
        begun = bisect_left(self._waiting, self._newest_ns, key=lambda each: each.pulse.stamp_ns)
        over = [each for each in self._waiting[:begun] if each.pulse.until_ns < self._newest_ns]
        if over:
            on = [each for each in self._waiting[:begun] if each.pulse.until_ns >= self._newest_ns]
            self._waiting = on + self._waiting[begun:]
        return [self._shown(entry) for entry in over]

    def _shown(self, entry: _Waiting) -> Shown:
        pulse, margin_ns = entry.pulse, self._margin_ns
        self._done.append(pulse)
        if entry.fault is not None:
            return Shown(pulse, fault=entry.fault, reason=entry.reason)
        first_ns, last_ns = pulse.stamp_ns + margin_ns, pulse.until_ns - margin_ns
        within = [frame for frame in self._kept.frames if first_ns <= frame.stamp_ns <= last_ns]
        lit = [frame for frame in within if frame.image is not None]
        if not lit:
            fault, reason = self._not_shown(pulse, within)
            return Shown(pulse, fault=fault, reason=reason)
        return Shown(pulse, tuple(lit[-self._settings.most_frames :]), self._dark(pulse))

    def _dark(self, pulse: Pulse) -> Frame | None:
        """The last frame before the pulse that shows no other pulse."""
        before_ns = pulse.stamp_ns - self._margin_ns
        for frame in reversed(self._kept.frames):
            if pulse.stamp_ns - frame.stamp_ns > self._history_ns:
                break
            if frame.stamp_ns < before_ns and frame.image is not None and not self._lit(frame):
                return frame
        return None

    def _lit(self, frame: Frame) -> bool:
        """Whether the laser was on then, for another pulse."""
        margin_ns = self._margin_ns
        begun = bisect_right(self._waiting, frame.stamp_ns + margin_ns, key=lambda each: each.pulse.stamp_ns)
        pulses = (*self._done, *(each.pulse for each in self._waiting[:begun]))
        return any(p.stamp_ns - margin_ns <= frame.stamp_ns <= p.until_ns + margin_ns for p in pulses)

    def _not_shown(self, pulse: Pulse, within: list[Frame]) -> tuple[PulseFault, str]:
        """Why no frame shows the pulse."""
        if within:
            return PulseFault.IMAGE, f"none of its {len(within)} frames can be used: {within[-1].fault}"
        length_s, margin_s = 1e-9 * (pulse.until_ns - pulse.stamp_ns), self._settings.margin_s
        if length_s <= 2.0 * margin_s:
            return PulseFault.NO_FRAME, (
                f"lasts {length_s:g} s, of which margin_s, {margin_s:g} s, is left out at both ends; longer pulses, or "
                "a smaller margin_s"
            )
        if pulse.stamp_ns <= self._kept.forgotten_ns:
            return PulseFault.TOO_LATE, (
                f"was reported {_seconds(self._newest_ns - pulse.until_ns)} after its end, its frames are gone; "
                "report it sooner, or a larger history_s and history_bytes (or do the clocks differ?)"
            )
        if not self._kept.frames or self._newest_ns < pulse.stamp_ns:
            behind = (
                f"; the newest is {_seconds(pulse.stamp_ns - self._newest_ns)} older" if self._newest_ns >= 0 else ""
            )
            return (
                PulseFault.NO_FRAME,
                f"no frame of its time has come{behind}; stamps by the same clock as the images'",
            )
        nearest_ns = min(
            (frame.stamp_ns - pulse.stamp_ns for frame in self._kept.frames), key=lambda offset_ns: abs(offset_ns)
        )
        return PulseFault.NO_FRAME, (
            f"no frame within its {length_s:g} s: the nearest one is {_seconds(abs(nearest_ns))} "
            f"{'after' if nearest_ns > 0 else 'before'} its beginning; stamps by the same clock as the images'"
        )

    def _forget(self) -> None:
        """Drop frames that no future pulse can need."""
        kept = self._kept
        oldest_ns = self._newest_ns - self._history_ns
        if self._waiting:
            oldest_ns = min(oldest_ns, self._waiting[0].pulse.stamp_ns - self._history_ns)
        most_bytes = self._settings.history_bytes
        while len(kept.frames) > 1 and (kept.frames[0].stamp_ns < oldest_ns or kept.size_bytes > most_bytes):
            kept.forget_oldest()


def mean_image(frames: tuple[Frame, ...]) -> Image:
    """Mean of at least one frame; all images have one shape and type, and the mean is rounded to that type."""
    images = [frame.image for frame in frames if frame.image is not None]
    if len(images) == 1:
        return images[0]
    total = images[0].astype(np.float64)
    for image in images[1:]:
        total += image
    total /= len(images)
    if np.issubdtype(images[0].dtype, np.integer):
        total = np.rint(total)
    out: Image = total.astype(images[0].dtype)
    return out


def _bytes(image: Image | None) -> int:
    return 0 if image is None else int(image.nbytes)


def _seconds(span_ns: int) -> str:
    return f"{1e-9 * span_ns:.3g} s"


class PulseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which frames show a pulse."""

    margin_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=10.0,
            description="frames this close to either end of a pulse are left out, for exposure, transfer and "
            "the laser's rise (s)",
        ),
    ] = 0.05
    history_s: Annotated[
        float,
        Meta(gt=0.0, le=600.0, description="how long frames are kept for pulses that are reported afterwards (s)"),
    ] = 3.0
    history_bytes: Annotated[
        int, Meta(ge=1_000_000, description="memory for these frames; the oldest are dropped (bytes)")
    ] = 500_000_000
    most_frames: Annotated[
        int,
        Meta(ge=1, le=1000, description="largest number of a pulse's frames that are averaged, the last ones (frames)"),
    ] = 8
    wait_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=3600.0,
            description="time after a pulse's end, counted from its report, in which its frames may still arrive (s)",
        ),
    ] = 10.0


LONGEST_S = 60.0
"""Longest pulse (s): no arm stands still longer to show a spot; longer ones mix two clocks or use another unit."""

_LAST_NS = 2**63 - 1


class ReportedPulse(NamedTuple):
    """The laser was on, and the end-effector stood still at ``base_T_ee`` (4, 4), between two stamps (ns)."""

    stamp_ns: int
    until_ns: int
    base_T_ee: Array


def of_message(pulse: LaserPulse) -> ReportedPulse:
    """The pulse in a message.  ValueError: "what is wrong; what would be right"."""
    pose = pulse.base_T_ee
    row = {
        "base_T_ee": {"translation_m": list(pose.translation_m), "rotation_xyzw": list(pose.rotation_xyzw)},
    }
    return _checked(pulse.stamp_ns, pulse.until_ns, row, "the pulse")


def read_pulses(path: Path) -> list[ReportedPulse]:
    """The pulses of a table, in the order of their stamps; poses as in the tables of ``calibrate laser``.

    Raises :class:`~gripmon.model.errors.InputError`: "file: line: what is wrong; what would be right".
    """
    rows, places = rows_of(path, "a table stamp_ns,until_ns,tx_m,ty_m,tz_m,qx,qy,qz,qw")
    with input_errors(str(path)):
        return of_rows(rows, places)


def of_rows(rows: Sequence[Row], places: Sequence[str]) -> list[ReportedPulse]:
    """A table's pulses, in the order of their stamps.  ValueError: "place: what is wrong; what would be right"."""
    if not rows:
        raise ValueError("holds no pulse; a header line, then a line for each pulse")
    found = [
        _checked(_stamp(row, "stamp_ns", place), _stamp(row, "until_ns", place), row, place)
        for row, place in zip(rows, places, strict=True)
    ]
    order = sorted(range(len(found)), key=lambda k: found[k].stamp_ns)
    for earlier, later in itertools.pairwise(order):
        if found[later].stamp_ns <= found[earlier].until_ns:
            raise ValueError(
                f"{places[later]}: begins before the pulse of {places[earlier]} ends; pulses one after the other"
            )
    return [found[k] for k in order]


def _checked(stamp_ns: int, until_ns: int, row: Row, place: str) -> ReportedPulse:
    if until_ns <= stamp_ns:
        raise ValueError(f"{place}: until_ns is not after stamp_ns; when the laser went on, and when it went off")
    if until_ns - stamp_ns > LONGEST_S * NS_PER_S:
        length_s = (until_ns - stamp_ns) / NS_PER_S
        raise ValueError(f"{place}: lasts {length_s:.4g} s; {LONGEST_S:g} s at most, both stamps in nanoseconds")
    base_T_ee = pose_of(row, place)
    try:
        check_scale(base_T_ee[None])
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None
    return ReportedPulse(stamp_ns, until_ns, base_T_ee)


def _stamp(row: Row, key: str, place: str) -> int:
    value: Any = row.get(key)
    try:
        stamp_ns = int(value)
    except (TypeError, ValueError):
        missing = "has no " + key if value in (None, "") else f"{key} is {value!r}"
        raise ValueError(f"{place}: {missing}; a whole number of nanoseconds, as the frames' stamps") from None
    if not 0 <= stamp_ns <= _LAST_NS:
        raise ValueError(f"{place}: {key} is {stamp_ns}; 0 or more, below 2^63")
    return stamp_ns
