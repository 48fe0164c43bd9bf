"""What the newest frame was judged by, gathered for people who look; nothing is decided by it."""

from __future__ import annotations

import numpy as np

from gripmon.judge.drift import Baseline, MotionWatch
from gripmon.judge.smoothing import PoseAverage
from gripmon.model.records import Array, Limits, MonitorNotes
from gripmon.model.records.notes import SixNumbers
from gripmon.monitor.settings import MonitorSettings


class NoteTaker:
    """Gathers notes; the limits, which change slowly, only when the test has reckoned them again."""

    def __init__(self, settings: MonitorSettings):
        self._policy, self._tolerated = settings.policy, _six(settings.drift.tolerated)
        self._limits: Limits | None = None
        self._of: tuple[int, Array | None] = (-1, None)

    def take(self, watch: MotionWatch, baseline: Baseline, average: PoseAverage, measured: bool) -> MonitorNotes:
        """``measured``: whether the newest frame was, so that it may have been tested."""
        refreshes, offset = watch.test.refreshes, baseline.error
        if self._limits is None or self._of[0] != refreshes or self._of[1] is not offset:
            self._of = refreshes, offset
            self._limits = self._read(watch, offset, average)
        return MonitorNotes(watch.statistic_share if measured else None, self._limits)

    def _read(self, watch: MotionWatch, offset: Array | None, average: PoseAverage) -> Limits:
        policy, noticed = self._policy, watch.test.noticed()
        known = watch.test.refreshes > 0
        return Limits(
            policy.warn_m,
            policy.warn_rad,
            policy.limit_m,
            policy.limit_rad,
            self._tolerated,
            None if noticed is None else _six(noticed),
            None if offset is None else _six(offset),
            _six(np.sqrt(watch.test.scatter.of_single_frames()[0].diagonal())) if known else None,
            _six(average.learnt.scatter),
            _six(np.sqrt(average.learnt.walk)),
            policy.alert_limit_m,
            policy.alert_limit_rad,
        )


def _six(values: Array) -> SixNumbers:
    x, y, z, about_x, about_y, about_z = values.tolist()
    return x, y, z, about_x, about_y, about_z
