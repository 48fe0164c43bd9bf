"""Cheap tests in each frame for faults that the drift test doesn't see, so that the causes are compared.

A lens that lost its focus moves nothing; a joint fit may treat a finger that is bent by tenths of a millimetre as an
outlier; and the error of a reported opening that is off by tenths is soon estimated along.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Collection, Sequence

import numpy as np

from gripmon.judge.causes.models import SMALLEST_M
from gripmon.judge.causes.pooling import SEEN_EDGES
from gripmon.judge.drift.kinds import SIGNIFICANT_SIGMAS
from gripmon.model.records import Array

BASELINE_FRAMES, NEWEST_FRAMES = 20, 5
"""Frames from which the usual value is learnt, and newest ones that are compared with it."""

BLUR_CHANGE_PX, BLUR_CHANGE_RATIO = 0.25, 0.3
"""Change of the blur that counts, px, and over the usual one; both must be exceeded."""

FINGER_MISSING_RATIO = 0.8
"""Inlier ratio of a finger's search lines, over the usual one, below which the finger may be elsewhere."""

RESIDUAL_CHANGE_PX = 0.05
"""Smallest change of an edge's mean residual that counts, px."""

JAW_SIGMAS = 3.0
"""Standard deviations of one frame, of which five have to agree, by which the opening must differ from the report
otherwise than usually; and by no less than what counts as a motion at all.
"""


class _Usual:
    """Medians of the first values, and of the newest."""

    def __init__(self) -> None:
        self._first: list[float] = []
        self._newest: deque[float] = deque(maxlen=NEWEST_FRAMES)
        self.usual: float | None = None
        self.scatter = 0.0  # of the first values

    def add(self, value: float) -> float:
        """The median of the newest values, this one among them."""
        self._newest.append(value)
        if self.usual is None:
            self._first.append(value)
            if len(self._first) == BASELINE_FRAMES:
                self.usual, self.scatter = _middle(self._first), statistics.pstdev(self._first)
        return _middle(self._newest)


def _middle(values: Collection[float]) -> float:
    """The median, as the standard library has it with many checks."""
    ordered = sorted(values)
    half, odd = divmod(len(ordered), 2)
    return ordered[half] if odd else 0.5 * (ordered[half - 1] + ordered[half])


class BlurWatch:
    """Whether the edges' blur has changed.  What the cause is, :class:`gripmon.judge.causes.CauseJudge` decides: motion
    smears edges, too.
    """

    def __init__(self) -> None:
        self._blur_px = _Usual()

    def add(self, blur_px: float | None) -> bool:
        """Whether the last frames' blur isn't the usual one; ``blur_px`` of one frame, None where it isn't known."""
        if blur_px is None:
            return False
        now_px, usual_px = self._blur_px.add(blur_px), self._blur_px.usual
        return usual_px is not None and abs(now_px - usual_px) > max(BLUR_CHANGE_PX, BLUR_CHANGE_RATIO * usual_px)


class FingerWatch:
    """Whether clearly fewer search lines of a finger are inliers of the fit than usually."""

    def __init__(self, fingers: int) -> None:
        self._shares = [_Usual() for _ in range(fingers)]

    def add(self, shares: Sequence[float]) -> bool:
        """``shares``: inlier ratio of each finger's search lines in one frame."""
        fewer = False
        for known, share in zip(self._shares, shares, strict=True):
            now = known.add(share)
            fewer |= known.usual is not None and now < FINGER_MISSING_RATIO * known.usual
        return fewer


class ResidualWatch:
    """Whether the edges' residuals in the joint fit have changed: it may split the difference between a bent finger and
    the others.
    """

    def __init__(self) -> None:
        self._first: list[Array] = []
        self._newest: deque[Array] = deque(maxlen=NEWEST_FRAMES)
        self._usual: tuple[Array, Array] | None = None

    def add(self, residual_px: Array) -> bool:
        """``residual_px`` (e,) mean of each edge in one frame, NaN for edges that are not seen."""
        self._newest.append(residual_px)
        if self._usual is None:
            self._first.append(residual_px)
            if len(self._first) == BASELINE_FRAMES:
                # Means of five frames before a background that stands still scatter as much as one.
                allowed_px = np.maximum(RESIDUAL_CHANGE_PX, SIGNIFICANT_SIGMAS * np.std(self._first, axis=0))
                self._usual = np.mean(self._first, axis=0), allowed_px
            return False
        usual_px, allowed_px = self._usual
        beyond = np.abs(sum(self._newest) / NEWEST_FRAMES - usual_px) > allowed_px
        return int(np.count_nonzero(beyond)) >= SEEN_EDGES


class JawWatch:
    """Whether the difference between the measured and the reported opening has changed."""

    def __init__(self) -> None:
        self._error_m = _Usual()

    def add(self, reported_m: float | None, seen_m: float) -> bool:
        """``seen_m`` by one frame and those before; ``reported_m`` with it, None if nothing was."""
        if reported_m is None:
            return False
        now_m, usual_m = self._error_m.add(seen_m - reported_m), self._error_m.usual
        return usual_m is not None and abs(now_m - usual_m) > max(SMALLEST_M, JAW_SIGMAS * self._error_m.scatter)


class Watches:
    """All of them for one camera and gripper."""

    def __init__(self, fingers: int) -> None:
        self._blur, self._fingers = BlurWatch(), FingerWatch(fingers)
        self._residuals, self._jaw = ResidualWatch(), JawWatch()

    def add(
        self,
        blur_px: float | None,
        shares: Sequence[float],
        residual_px: Array,
        reported_m: float | None,
        seen_m: float,
    ) -> bool:
        """Whether any of them sees a change in this frame."""
        blurred, fewer = self._blur.add(blur_px), self._fingers.add(shares)
        contradicted, jaw_elsewhere = self._residuals.add(residual_px), self._jaw.add(reported_m, seen_m)
        return blurred or fewer or contradicted or jaw_elsewhere
