"""Monitor of a laser calibration: after every pulse a state, a verdict, and alerts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gripmon.calibrate.sighting import NotFound
from gripmon.judge.policy import AlertBook
from gripmon.laser.beliefs import MotionTest, Places, Pulse
from gripmon.laser.judgement import (
    UNIT,
    Moved,
    SpotFault,
    SpotJudgement,
    SpotSeen,
    SpotWatchSettings,
    alert_of,
    how,
    lost_alert,
    outlier_text,
)
from gripmon.laser.setup import LaserCalibration
from gripmon.laser.spots import Spot
from gripmon.laser.world import Prediction, Single, alone, calibrated, larger, predict, visible
from gripmon.model.records import Alert, State, Verdict

MOTION, VIEW = "motion", "view"
"""Topics of the alerts."""
SUSPICIOUS = 0.03
"""Odds of a motion, over those of an alarm, above which the calibration is suspect."""
BETTER = 0.5
"""An open alert is updated when the standard deviation falls below this fraction of the reported one."""
_OCCLUDED = 2
"""Successive rejected pulses from which the view counts as blocked."""


class SpotWatch:
    """A pure function of the pulses so far; time is that of the pulses.

    ``state`` and ``verdict`` are those after the last pulse: acquiring until ``confirm_pulses`` spots are where they
    should be; tracking; drifting while something has moved; occluded and lost while pulses show no acceptable spot.
    ``valid``: measure with the calibration; ``suspect``: finish a motion with it, don't begin one; ``unknown``: don't
    move by it.  ``book`` holds the alerts.
    """

    def __init__(self, calibration: LaserCalibration, settings: SpotWatchSettings | None = None):
        """Raises :class:`~gripmon.calibrate.sighting.CalibrationError` for a file whose numbers make no set-up,
        ValueError for an implausible camera.
        """
        self.settings = settings or SpotWatchSettings()
        self._calibrated = calibrated(calibration)
        self._test = MotionTest(self._calibrated, self.settings.false_alarms_per_1000_pulses, self.settings.wrong_spots)
        self._arm = self.settings.arm_covariance
        self.book = AlertBook(self.settings.update_alert_s, 0.0)
        self.pulses = 0
        self._stamp_ns = 0
        self._begin()

    def _begin(self) -> None:
        self._test.reset()
        self._places = Places()
        self.state, self.verdict = State.ACQUIRING, Verdict.UNKNOWN
        self._bad: list[SpotFault] = []
        self._good = 0
        self._odds = 0.0
        self._moved: Moved | None = None
        self._said_sigma = math.inf  # of the camera's motion, as last reported in the alert

    def judge(self, seen: SpotSeen) -> SpotJudgement:
        """Judge a pulse.  A stamp that goes back counts as the previous one's."""
        self.pulses += 1
        self._stamp_ns = max(self._stamp_ns, seen.stamp_ns)
        if not np.isfinite(seen.base_T_ee).all():
            return self._judged(seen, SpotFault.NOT_FINITE, "the arm's pose is not finite")
        predicted = predict(self._calibrated.world, self._calibrated.camera, seen.base_T_ee)
        why_not = visible(self._calibrated, predicted, self._arm)
        if why_not is not None:
            return self._judged(seen, SpotFault.NOT_FORESEEN, why_not)
        if isinstance(seen.candidates, NotFound):
            return self._missing(seen, predicted, seen.candidates.reason)
        spots = [
            spot for spot in seen.candidates if np.isfinite(spot.uv_px).all() and np.isfinite(spot.covariance_px).all()
        ]
        if not spots:
            return self._missing(seen, predicted, "no spot was found")
        return self._seen(seen, predicted, spots)

    def _seen(self, seen: SpotSeen, predicted: Prediction, spots: list[Spot]) -> SpotJudgement:
        noise = self._calibrated.sigma_px**2 * np.eye(2)
        place = self._places.find(seen.base_T_ee)
        if place is None:
            place = self._places.take(seen.base_T_ee)
            self._test.at_new_place(place, larger(predicted.arm_rows @ self._arm @ predicted.arm_rows.T, noise))
        pulse = Pulse(
            seen.base_T_ee,
            place,
            np.stack([spot.uv_px for spot in spots]),
            np.stack([larger(spot.covariance_px, noise) for spot in spots]),
            predicted.uv_px,
            predicted.rows,
        )
        found = self._test.add(pulse)
        self._odds = found.odds
        single = alone(self._calibrated, predicted, seen.base_T_ee, spots[found.candidate], self._arm)
        self._moved = how(self._test, self._calibrated, self._places.poses) if self._test.moved else None
        if found.believed:
            return self._judged(seen, None, "", predicted, single)
        reason = outlier_text(single.off_px, single.square)
        return self._judged(seen, SpotFault.OUTLIER, reason, predicted, single)

    def _missing(self, seen: SpotSeen, predicted: Prediction, reason: str) -> SpotJudgement:
        """No spot was found: that counts as a fault only where one should be visible."""
        camera, spread = self._calibrated.camera, predicted.rows @ self._calibrated.covariance @ predicted.rows.T
        margin = 3.0 * np.sqrt(spread.diagonal() + self._calibrated.sigma_px**2)
        size = np.array([camera.width_px, camera.height_px])
        if (predicted.uv_px < margin).any() or (predicted.uv_px > size - 1.0 - margin).any():
            u, v = predicted.uv_px
            where = f"the spot should be at ({u:.0f}, {v:.0f}) px, not safely within the image, and was not seen"
            return self._judged(seen, SpotFault.NOT_FORESEEN, where, predicted)
        return self._judged(seen, SpotFault.NO_SPOT, reason, predicted)

    def _judged(
        self,
        seen: SpotSeen,
        fault: SpotFault | None,
        reason: str,
        predicted: Prediction | None = None,
        single: Single | None = None,
    ) -> SpotJudgement:
        if fault is None:
            self._bad, self._good = [], self._good + 1
        elif fault in (SpotFault.NO_SPOT, SpotFault.OUTLIER):
            self._bad, self._good = [*self._bad, fault][-1000:], 0
        self.state, self.verdict = self._state(), Verdict.UNKNOWN
        self.verdict = self._verdict()
        moved = self._moved
        out = SpotJudgement(
            seen.stamp_ns,
            fault is None,
            self.state,
            self.verdict,
            predicted_px=None if predicted is None else predicted.uv_px,
            fault=fault,
            reason=reason,
            probability_moved=1.0 if self._test.moved else self._odds / (1.0 + self._odds),
            causes=() if moved is None else moved.causes,
            motion=None if moved is None else moved.motion,
            alerts=self._alerts(),
        )
        return out if single is None else replace(out, **single._asdict())

    def _state(self) -> State:
        # Wrong spots may be the start of a motion, which the motion test explains better: they count half.
        astray = sum(fault is SpotFault.OUTLIER for fault in self._bad)
        if len(self._bad) - 0.5 * astray >= self.settings.pulses_until_lost:
            return State.LOST
        if self._test.moved:
            return State.DRIFTING
        if self._good >= self.settings.confirm_pulses:
            return State.TRACKING
        if self.state in (State.ACQUIRING, State.LOST):
            return State.ACQUIRING if not self._bad else self.state
        return State.OCCLUDED if len(self._bad) >= _OCCLUDED else State.TRACKING

    def _verdict(self) -> Verdict:
        if self.state is State.LOST or (self.state is State.ACQUIRING and self._good == 0):
            return Verdict.UNKNOWN
        if self._moved is not None:
            return Verdict.UNKNOWN if self._moved.shift_m >= self.settings.limit_m else Verdict.SUSPECT
        sure = self.state is State.TRACKING and not self._bad and self._odds < SUSPICIOUS
        return Verdict.VALID if sure else Verdict.SUSPECT

    def _alerts(self) -> tuple[Alert, ...]:
        book, now_s, stamp_ns = self.book, self._now_s, self._stamp_ns
        if self.state is State.LOST:
            alerts = book.present(VIEW, lost_alert(self._bad), now_s, stamp_ns)
        else:
            alerts = book.absent(VIEW, "spots are seen again", now_s, at_once=True) if not self._bad else ()
        motion_alert = self.motion_alert
        if motion_alert is not None:
            raised = book.present(MOTION, motion_alert, now_s, stamp_ns, news=self._known_better())
            if raised:
                self._said_sigma = self._sigma
            return alerts + raised
        self._said_sigma = math.inf
        return alerts + book.absent(MOTION, "spots are where the calibration has them again", now_s, at_once=True)

    @property
    def motion_alert(self) -> Alert | None:
        """The motion according to the pulses so far, even if the open alert is older; None if nothing has moved."""
        if self._moved is None:
            return None
        return alert_of(self._moved, self.settings, self.book.about(MOTION))

    @property
    def _sigma(self) -> float:
        """Largest standard deviation of the camera's motion, in 10 mm and 10 mrad; infinite if none is reported."""
        motion = None if self._moved is None else self._moved.motion
        if motion is None:
            return math.inf
        return math.sqrt(float(np.linalg.eigvalsh(motion.covariance / np.outer(UNIT, UNIT))[-1]))

    def _known_better(self) -> bool:
        """Whether the motion is known much better than the alert reports: the first pulses hardly determine it."""
        return self._sigma < BETTER * self._said_sigma

    @property
    def _now_s(self) -> float:
        return self._stamp_ns * 1e-9

    def reset(self) -> tuple[Alert, ...]:
        """Start again, as after a repair: the calibration is trusted again, alerts are cleared."""
        self._begin()
        text = "begun again"
        alerts: tuple[Alert, ...] = ()
        for topic in (MOTION, VIEW):
            alerts += self.book.absent(topic, text, self._now_s, at_once=True)
        return alerts
