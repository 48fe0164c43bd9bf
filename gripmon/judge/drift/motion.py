"""One stream of poses: is the camera at its reference, since when not, and how does it move?

The part of a shift that an inexact reference explains doesn't count.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from gripmon.judge.drift.kinds import BLOCK_S, SIGNIFICANT_SIGMAS, History, VibrationWatch, goes_on
from gripmon.judge.drift.sequential import SequentialTest
from gripmon.judge.drift.settings import DriftSettings
from gripmon.judge.drift.statistics import BLOCK_FRAMES
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.records import AlertKind, Array, Creep, Motion, Vibration


class Baseline:
    """The error of a reference that is only roughly known, such as a configured one.

    A calibration is off by some tenths of a millimetre from the start, which is not a drift.  The mean shift of the
    first frames, outliers left out, is taken for that error if the reference's own uncertainty allows it; otherwise the
    error is taken as zero.  Of frames among which the mount was knocked those before that count.
    """

    def __init__(self, reference_sigma: Array, frames: int, error: Array | None = None):
        """``reference_sigma`` (6,): standard deviations of the reference's error, m and rad; ``frames``: number of
        first frames; ``error`` (6,): the error, if it is already known.
        """
        self._allowed = SIGNIFICANT_SIGMAS * reference_sigma
        self._frames = frames
        self._first: list[Array] = []
        self.error = error
        """Error (6,) that is subtracted; None until it is known."""

    def subtract(self, shift: Array) -> Array | None:
        """The shift (6,) minus the reference's error; None until that is known."""
        if self.error is None:
            self._first.append(shift)
            if len(self._first) < self._frames:
                return None
            self._settle()
        assert self.error is not None
        return shift - self.error

    def knocked(self) -> None:
        """The mount was knocked before the next frame: those so far have to do, lest a knock soon after the start is
        told only once there are as many frames as usual.
        """
        if self.error is None and self._first:
            self._settle()

    def _settle(self) -> None:
        mean = _mean_of_the_inner_half(_before_a_step(np.array(self._first)))
        self.error = mean if (np.abs(mean) <= self._allowed).all() else np.zeros(6)
        self._first.clear()


def _before_a_step(shifts: Array) -> Array:
    """The shifts (n, 6) before the clearest step among them; all where no two parts' means differ by more than twice
    what is significant, in standard deviations of that difference: it is sought in a hundred places and axes.  Less
    than a quarter of them before it are wild ones rather.
    """
    count, clearest, before = len(shifts), 2.0 * SIGNIFICANT_SIGMAS, len(shifts)
    for k in range(max(count // 4, 2), count - 1):
        parts = shifts[:k], shifts[k:]
        squares = sum(np.square(part - part.mean(axis=0)).sum(axis=0) for part in parts)
        sigma = np.sqrt(squares / (count - 2) * (1.0 / k + 1.0 / (count - k)))
        step = (np.abs(parts[0].mean(axis=0) - parts[1].mean(axis=0)) / np.maximum(sigma, 1e-12)).max()
        if step > clearest:
            clearest, before = float(step), k
    return shifts[:before]


def _mean_of_the_inner_half(shifts: Array) -> Array:
    """Mean (6,) of the half of the shifts (n, 6) closest to their median, so that wild frames don't count."""
    distance = np.abs(shifts - np.median(shifts, axis=0))
    scale = np.maximum(np.median(distance, axis=0), 1e-12)
    inner = np.argsort((distance / scale).max(axis=1), kind="stable")[: (len(shifts) + 1) // 2]
    return np.asarray(shifts[inner].mean(axis=0))


LEVEL_FRAMES, NEWEST_FRAMES = 64, 8
"""Most frames since the last step whose mean tells whether the camera is back; and number of newest frames whose mean
is reported as the present shift.
"""

USUAL_SQUARE = chi_square_limit(0.05)
"""Squared normalised distance that normal errors exceed once in twenty cases.  With a shift below it the camera counts
as back; between this and the test's threshold an alert stays.
"""

EVIDENCE_LOOK_RATIO = 0.4
"""Part of the threshold from which the evidence is examined more closely, before the test decides."""

VIBRATION_STEP_RATIO = 4.0
"""Multiple of a vibration's root mean square that two frames must be off to count as a step; a sinusoid reaches 1.4 to
either side.
"""


class MotionWatch:
    """The sequential test for one camera, and what follows from it."""

    def __init__(self, settings: DriftSettings):
        self.test = SequentialTest(settings)
        self._vibration = VibrationWatch(settings.vibration_m)
        self._history = History()
        self._frames_per_s = settings.frames_per_s
        self._newest: deque[Array] = deque(maxlen=4 * int(BLOCK_S * 240.0))
        self._kind = AlertKind.DRIFT
        self._present = False
        self._held = 0
        self._creep: Creep | None = None
        self._vibrates: Vibration | None = None
        self._last = Motion(False, AlertKind.DRIFT, np.zeros(6), np.zeros(6), 0)
        self.statistic_share: float | None = None
        """The newest frame's largest statistic over its threshold; None if the frame wasn't tested."""

    def reset(self, reference_covariance: Array) -> None:
        """There is a new reference, with the covariance (6, 6) of its error: drift counts from zero."""
        self.test.restart(np.array([True]))
        self.set_reference_covariance(reference_covariance)
        self._history.clear()
        self._newest.clear()
        self._vibration.forget()
        self._held = 0
        self._present, self._kind, self._creep, self._vibrates = False, AlertKind.DRIFT, None, None
        self._last = Motion(False, AlertKind.DRIFT, np.zeros(6), np.zeros(6), 0)

    def resume(self, moved: bool) -> None:
        """Continue after a restart; ``moved``: whether the camera was away from its reference."""
        self._present = moved
        self._last = self._last._replace(present=moved)

    def set_reference_covariance(self, covariance: Array) -> None:
        """Covariance (6, 6) of the reference's own error, which is not a drift."""
        self.test.set_reference_covariance(covariance)

    def set_frames_per_s(self, frames_per_s: float) -> None:
        """Set the stream's own frame rate."""
        self._frames_per_s = frames_per_s
        self.test.set_frames_per_s(frames_per_s)

    def add(self, shift: Array | None, covariance: Array, now_s: float) -> Motion:
        """Add one frame's shift (6,) against the reference, with its covariance (6, 6), at the frames' time.

        ``shift`` is None while the reference's error isn't known yet.
        """
        self.statistic_share = None
        if shift is None:
            self._last = Motion(self._present, self._kind, np.zeros(6), np.sqrt(covariance.diagonal()), 0)
            return self._last
        test = self.test
        finding = test.add(shift[None], covariance[None], at_least=self._shortest_window(shift))
        self.statistic_share = float(finding.excess[0])
        moved, stepped = bool(finding.moved[0]), bool(finding.stepped[0])
        length = int(finding.length[0])
        self._newest.append(shift)
        at_once = stepped and length <= BLOCK_S * self._frames_per_s and not self._goes_on(length)
        if stepped:
            test.restart(np.array([True]), length)
        self._vibrates = self._vibration.add(shift, now_s, test.usual_covariance)
        frames = max(int(test.windows.frames[0]), 1)
        level, level_covariance = self._level(min(frames, 2 * BLOCK_FRAMES if self.vibrates_anew else LEVEL_FRAMES))
        before = self._present
        # A detected difference discards the frames before it: as many frames again may be needed to show the motion.
        self._held = 2 * length if moved else max(self._held - 1, 0)
        self._present = moved or (before and (self._held > 0 or self._away(level, level_covariance)))
        complete = self._history.add(shift, now_s)
        begun = moved and not before
        if begun or at_once:
            self._kind, self._creep = (AlertKind.STEP if at_once else AlertKind.DRIFT), None
        if self._present and (complete or begun) and not at_once:
            self._look_back(level, level_covariance)
        newest, newest_covariance = self._level(min(frames, NEWEST_FRAMES))
        self._last = Motion(
            present=self._present,
            kind=self._kind,
            shift=newest,
            sigma=np.sqrt(newest_covariance.diagonal()),
            frames=min(int(test.windows.frames[0]), NEWEST_FRAMES),
            begun=begun,
            stepped=at_once,
            step_frames=length if at_once else 0,
            creep=self._creep,
            vibration=self._vibrates,
            suspicious=bool(finding.excess[0] > EVIDENCE_LOOK_RATIO),
        )
        return self._last

    def learn(self) -> None:
        """Learn from the newest frame, off the critical path; otherwise the next :meth:`add` does it first."""
        self.test.learn()

    @property
    def vibrates_anew(self) -> bool:
        """Whether it vibrates, and the learnt noise doesn't include that yet."""
        return self._vibration.is_news

    def skip(self) -> Motion:
        """Skip a frame whose transform is doubtful: nothing changes."""
        self.statistic_share = None
        return self._last._replace(begun=False, stepped=False, suspicious=False)

    def _shortest_window(self, shift: Array) -> int:
        """Frames of the shortest window that may decide: the swings of a vibration are not steps, and the mean over a
        block nearly cancels them.
        """
        if self._vibrates is None or not self.vibrates_anew or not self._newest:
            return 1
        frames = min(int(self.test.windows.frames[0]), BLOCK_FRAMES)
        middle = self._level(frames)[0] if frames > 1 else np.zeros(6)
        off_m = min(float(np.linalg.norm((each - middle)[:3])) for each in (shift, self._newest[-1]))
        return 1 if off_m > VIBRATION_STEP_RATIO * self._vibrates.rms_m else BLOCK_FRAMES

    def _goes_on(self, length: int) -> bool:
        """Whether the frames about a difference between windows of ``length`` frames show a creep, not a step."""
        frames = np.array(self._newest)[-4 * length :]
        towards = np.linalg.solve(self.test.usual_covariance(), frames[-length:].mean(axis=0) - frames[0])
        return goes_on(frames @ towards)

    def _level(self, frames: int) -> tuple[Array, Array]:
        mean, covariance = self.test.level(frames)
        return mean[0], covariance[0]

    def _away(self, level: Array, covariance: Array) -> bool:
        return self.test.square_beyond(level, covariance) > USUAL_SQUARE

    def _look_back(self, level: Array, covariance: Array) -> None:
        """Decide between step and creep from the last minutes."""
        towards = np.linalg.solve(covariance, level)
        length = float(np.sqrt(np.maximum(level @ towards, 1e-300)))
        towards = towards / length
        self._creep = self._history.creep(towards)
        if self._creep is not None:
            self._kind = AlertKind.CREEP
        elif self._kind is not AlertKind.STEP:
            self._kind = AlertKind.STEP if self._history.is_step(towards) else AlertKind.DRIFT
