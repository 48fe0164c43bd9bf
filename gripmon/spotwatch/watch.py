"""Pulse after pulse: is the set-up still the one that was calibrated?"""

from __future__ import annotations

from gripmon.calibration.laser.document import LaserCalibration, setup_of
from gripmon.camera import make_camera
from gripmon.policy import AlertBook
from gripmon.records import Alert, State, Verdict
from gripmon.spotwatch.judgement import SpotJudgement, SpotSeen
from gripmon.spotwatch.settings import SpotWatchSettings


class SpotWatch:
    """A pure function of the pulses so far; time is theirs."""

    def __init__(self, calibration: LaserCalibration, settings: SpotWatchSettings | None = None):
        """Raises :class:`~gripmon.calibration.sighting.CalibrationError` for a file whose numbers make no set-up."""
        self._settings = settings or SpotWatchSettings()
        self._setup = setup_of(calibration)
        self._camera = make_camera(calibration.camera)
        self.book = AlertBook(self._settings.update_alert_s, 0.0)
        self.state = State.ACQUIRING
        self.verdict = Verdict.UNKNOWN
        self.pulses = 0

    def judge(self, seen: SpotSeen) -> SpotJudgement:
        """What a pulse says.  Stamps that go back count as the last one's."""
        self.pulses += 1
        return SpotJudgement(seen.stamp_ns, False, self.state, self.verdict)

    def acknowledge(self, alert_id: str = "") -> tuple[Alert, ...]:
        """A person has taken note of an alert, or of all; empty if there is none that isn't acknowledged."""
        return self.book.acknowledge(alert_id)

    def reset(self) -> tuple[Alert, ...]:
        """Begin anew, as after a repair: the calibration is believed again, alerts are cleared."""
        return ()
