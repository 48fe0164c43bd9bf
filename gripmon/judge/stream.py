"""Faults of the frame stream, detected from the frames alone: frozen, replaced, or a wrong clock; and its rate.

Time is the frames' own stamps.  Of each frame about 1,700 pixels are examined, whatever its size.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.judge.inspection import FULL_SCALE, sparse
from gripmon.model.compiled import compiled
from gripmon.model.records import Cause, Frame, Image
from gripmon.model.records.values import NS_PER_S

RING_FRAMES = 8
"""Newest frames among which a repeated frame is recognised: a driver that hangs cycles through a ring of buffers."""

FREEZE_TO_USUAL_RATIO = 4
"""A source that repeats frames now and then counts as frozen at this multiple of its longest repetition."""

STILL_PIXEL_SHARE = 0.95
"""Share of bit-identical pixels, between two images that differ, from which the stream is a coded one.  Of a sensor's
own pixels fewer than nine in ten repeat, down to a noise of 0.1 grey levels.
"""

FEWEST_INNER = 200
"""Fewest pixels, of about 1,700, strictly between the image's darkest and brightest; with fewer it proves nothing."""

SURE_FRAMES = 3
"""Frames that confirm a finding: images with large identical parts; repeated stamps, which mean a clock that stands
still and not a frame that was delivered twice; and images of one size and type, which are then the camera's own, or
another camera's.
"""

CALM_FRAMES = 30
"""Consecutive frames without a fault of their stamps after which the clock counts as right again; and consecutive
frames without anything wrong after which the evidence of a cause is forgotten.
"""

JUMP_PERIODS, JUMP_NS = 50.0, 5 * NS_PER_S
"""A stamp has jumped if it is more than both of these after the one before: usual periods, and time."""

FEWEST_INTERVALS, MOST_INTERVALS = 8, 64
"""Newest intervals from which the rate is known, and most of them that count."""


class StreamSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a stream of frames counts as faulty."""

    frozen_s: Annotated[
        float,
        Meta(gt=0.0, le=3600.0, description="time of identical images after which the camera counts as frozen (s)"),
    ] = 1.0
    frozen_frames: Annotated[int, Meta(ge=2, le=100000, description="least number of identical images for that")] = 10
    frozen_coded_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=3600.0,
            description="the same for a stream whose images repeat in large parts: H.264 and similar codecs "
            "send nothing for still parts until the next key frame (s)",
        ),
    ] = 10.0


class StreamFault(NamedTuple):
    """What is wrong with the stream now; at most one of each ``kind`` at a time.

    A fault of the stamps is reported until :data:`CALM_FRAMES` frames in a row are free of it.  A ``gap`` is already
    over when it is reported; its cause is unknown: the camera was away, or its clock was set.
    """

    kind: Literal["frozen", "repeated", "replaced", "clock", "gap"]
    cause: Cause
    text: str


class StreamWatch:
    """Watches one camera's stream.  Depends on nothing but the frames so far."""

    def __init__(self, settings: StreamSettings | None = None):
        settings = settings or StreamSettings()
        self._frozen = _Frozen(settings)
        self._clock = _Clock()
        self._rate = _Rate()
        self._kind = _Kind()

    def add(self, frame: Frame) -> tuple[StreamFault, ...]:
        """What is wrong now; empty when all is well.  Never raises for a bad frame."""
        clock = self._clock.add(frame, self._rate)
        self._rate.add(frame)
        faults = clock, self._kind.add(frame.image), self._frozen.add(frame, self._rate.interval_ns)
        return tuple(filter(None, faults))

    @property
    def pixels(self) -> Image | None:
        """The last image's sparse pixels; None before the first image."""
        return self._frozen.pixels

    @property
    def repeats(self) -> bool:
        """Whether the last frame's image was seen a few frames ago: it adds no information, frozen or not yet."""
        return self._frozen.repeats

    @property
    def coded(self) -> bool:
        """Whether the stream has shown that its coder leaves out what stands still."""
        return self._frozen.coded

    @property
    def frames_per_s(self) -> float | None:
        """Rate at which frames arrive here, from the median interval of their stamps; None until known."""
        return self._rate.frames_per_s


class _Frozen:
    """Sensor noise makes every image different.  A video coder may remove the noise: then whole images repeat while
    nothing moves, and large parts of images before that.
    """

    def __init__(self, settings: StreamSettings):
        self._settings = settings
        self.pixels: Image | None = None
        self._coded = 0
        self._before: deque[int] = deque(maxlen=RING_FRAMES)
        self._run = 0
        self._since_ns = 0
        self._longest = 0
        self._frozen = False

    @property
    def repeats(self) -> bool:
        return self._run > 0

    @property
    def coded(self) -> bool:
        return self._coded >= SURE_FRAMES

    def add(self, frame: Frame, interval_ns: float | None) -> StreamFault | None:
        image = frame.image
        if not isinstance(image, np.ndarray) or image.ndim not in (2, 3):
            return None
        sample = sparse(image)
        number = hash(sample.tobytes())
        again = number in self._before
        self._before.append(number)
        if self._coded < SURE_FRAMES and not again:
            self._coded += _stands_in_large_parts(sample, self.pixels)
        self.pixels = sample
        # A uniform image shows no noise; that is another fault.
        if not again or sample.size == 0 or sample.min() == sample.max():
            self._longest = self._longest if self._frozen else max(self._longest, self._run)
            self._run, self._since_ns, self._frozen = 0, frame.stamp_ns, False
            return None
        self._run += 1
        # The stamps may repeat together with the images.
        lasted_ns = max(frame.stamp_ns - self._since_ns, self._run * (interval_ns or 0.0))
        enough = max(self._settings.frozen_frames, FREEZE_TO_USUAL_RATIO * self._longest)
        settings = self._settings
        frozen_s = max(settings.frozen_s, settings.frozen_coded_s) if self.coded else settings.frozen_s
        self._frozen |= self._run >= enough and lasted_ns >= NS_PER_S * frozen_s
        if not self._frozen:
            return None
        text = f"the last {self._run} images repeat earlier ones to the bit: the camera, or its driver, is frozen"
        return StreamFault("frozen", Cause.CAMERA_FROZEN, text)


def _stands_in_large_parts(sample: Image, before: Image | None) -> bool:
    """Whether two samples of images differ, but in few of the pixels; those cut off at black or white always stand."""
    if before is None or before.shape != sample.shape or before.dtype != sample.dtype:
        return False
    if sample.size < FEWEST_INNER:
        return False
    if sample.dtype in FULL_SCALE:  # for no other type is it compiled again
        count, standing = inner_pixels(sample.ravel(), before.ravel())
        return bool(count >= FEWEST_INNER and STILL_PIXEL_SHARE * count <= standing)
    stands = sample == before
    if np.count_nonzero(stands) < STILL_PIXEL_SHARE * FEWEST_INNER:
        return False  # too few, whichever of them count
    inner = (sample > sample.min()) & (sample < sample.max())
    count = int(np.count_nonzero(inner))
    return count >= FEWEST_INNER and STILL_PIXEL_SHARE * count <= int(np.count_nonzero(inner & stands))


@compiled
def inner_pixels(sample: Any, before: Any) -> tuple[int, int]:
    """How many pixels (n,) are neither the darkest nor the brightest, and how many of them are as ``before`` (n,)."""
    darkest, brightest = sample[0], sample[0]
    for value in sample:
        if value != value:
            return 0, 0
        darkest, brightest = min(darkest, value), max(brightest, value)
    count, standing = 0, 0
    for k in range(len(sample)):
        if darkest < sample[k] < brightest:
            count += 1
            standing += sample[k] == before[k]
    return count, standing


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    pixels = np.zeros((36, 48), dtype=np.uint8)
    _stands_in_large_parts(pixels, pixels)


class _Clock:
    """Checks that stamps rise, by about the same interval."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._seq = 0
        self._calm = CALM_FRAMES
        self._standing = 0
        self._fault: StreamFault | None = None

    def add(self, frame: Frame, rate: _Rate) -> StreamFault | None:
        fault = self._found(frame, rate)
        self._stamp_ns, self._seq = frame.stamp_ns, frame.seq
        if fault is not None:
            self._calm, self._fault = 0, fault
            return fault
        self._calm += 1
        if self._calm >= CALM_FRAMES:
            self._standing, self._fault = 0, None
        return self._fault

    def _found(self, frame: Frame, rate: _Rate) -> StreamFault | None:
        if self._stamp_ns is None:
            return None
        step_ns = frame.stamp_ns - self._stamp_ns
        if step_ns < 0:
            return StreamFault("clock", Cause.CLOCK, f"the frames' clock went back by {-1e-9 * step_ns:.3f} s")
        if step_ns == 0:
            self._standing, self._calm = self._standing + 1, 0
            text = f"{self._standing} frames have the stamp of the one before: their clock stands still"
            return StreamFault("clock", Cause.CLOCK, text) if self._standing >= SURE_FRAMES else None
        if step_ns > JUMP_NS and step_ns > rate.longest_ns(max(frame.seq - self._seq, 1)):
            # The frames alone can't tell which.
            text = f"no frame came for {1e-9 * step_ns:.1f} s, or the frames' clock was set ahead by so much"
            return StreamFault("gap", Cause.UNKNOWN, text)
        return None


class _Rate:
    """The interval at which frames arrive: the median of the newest ones."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None
        self._intervals_ns: deque[int] = deque(maxlen=MOST_INTERVALS)
        self._in_order_ns: list[int] = []

    @property
    def interval_ns(self) -> float | None:
        """None until it is known."""
        if len(self._intervals_ns) < FEWEST_INTERVALS:
            return None
        half, odd = divmod(len(self._in_order_ns), 2)
        upper_ns = self._in_order_ns[half]
        return upper_ns if odd else 0.5 * (self._in_order_ns[half - 1] + upper_ns)

    @property
    def frames_per_s(self) -> float | None:
        interval_ns = self.interval_ns
        return None if interval_ns is None else NS_PER_S / interval_ns

    def longest_ns(self, frames: int) -> float:
        """Longest time that N ``frames`` take while nothing is wrong; infinite until the rate is known."""
        interval_ns = self.interval_ns
        return math.inf if interval_ns is None else frames * JUMP_PERIODS * interval_ns

    def add(self, frame: Frame) -> None:
        last, self._last = self._last, (frame.seq, frame.stamp_ns)
        if last is None or frame.stamp_ns <= last[1]:
            return
        step_ns = frame.stamp_ns - last[1]
        # Frame numbers account for dropped frames.
        interval_ns = step_ns / max(frame.seq - last[0], 1)
        if interval_ns > JUMP_NS and interval_ns > self.longest_ns(1):
            return  # a gap
        if len(self._intervals_ns) == MOST_INTERVALS:
            self._in_order_ns.remove(self._intervals_ns[0])
        self._intervals_ns.append(step_ns)
        bisect.insort(self._in_order_ns, step_ns)


class _Kind:
    """Size and type of the images, which a camera doesn't change by itself."""

    def __init__(self) -> None:
        self._own: tuple[tuple[int, ...], np.dtype[Any]] | None = None
        self._candidate: tuple[tuple[int, ...], np.dtype[Any]] | None = None
        self._run = 0

    def add(self, image: Image | None) -> StreamFault | None:
        if not isinstance(image, np.ndarray):
            return None
        kind = image.shape, image.dtype
        self._run = self._run + 1 if kind == self._candidate else 1
        self._candidate = kind
        if self._own is None:
            self._own = kind if self._run >= SURE_FRAMES else None
            return None
        if kind == self._own or self._run < SURE_FRAMES:
            return None
        text = f"images are now {_words(kind)}; they were {_words(self._own)}: another camera, or another setting of it"
        return StreamFault("replaced", Cause.CAMERA_REPLACED, text)


def _words(kind: tuple[tuple[int, ...], np.dtype[Any]]) -> str:
    shape, dtype = kind
    if len(shape) < 2:
        return f"arrays of shape {shape}"
    colours = f" in {shape[2]} channels" if len(shape) == 3 else ""
    return f"{shape[1]}x{shape[0]} px{colours} of type {dtype.name}"
