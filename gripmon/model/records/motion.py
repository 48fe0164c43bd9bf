"""The result of the drift test: has the camera moved, how, and why?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from gripmon.model.records.alerts import AlertKind, Cause, CauseWeight
from gripmon.model.records.values import Array

UNEXPLAINED = CauseWeight(Cause.UNKNOWN, 1.0)


@dataclass(frozen=True, slots=True)
class Creep:
    """``velocity`` (6,) of the drift, m/s and rad/s, and the time ``since_s`` when it began."""

    velocity: Array
    since_s: float

    @property
    def rate_m_per_min(self) -> float:
        """Speed of the TCP."""
        import numpy as np  # not at the top: programs that only read messages needn't load it

        return 60.0 * float(np.linalg.norm(self.velocity[:3]))


@dataclass(frozen=True, slots=True)
class Vibration:
    """Root mean square of the TCP's motion about its mean, m, and its strongest frequency, 1/s.  The frame rate limits
    it: frequencies above half of it are aliased.
    """

    rms_m: float
    frequency_hz: float


class Motion(NamedTuple):
    """The drift test's result for a frame.

    ``present``: the camera isn't where the reference has it, by the mean ``shift`` (6,) of the last ``frames`` frames
    with standard deviations ``sigma`` (6,); ``kind``: step, creep, or drift if neither is certain.  ``begun``: the
    motion was detected in this frame; ``stepped``: it was a step, ``step_frames`` ago.  ``suspicious``: there is some
    evidence for a motion.
    """

    present: bool
    kind: AlertKind
    shift: Array
    sigma: Array
    frames: int
    begun: bool = False
    stepped: bool = False
    step_frames: int = 0
    creep: Creep | None = None
    vibration: Vibration | None = None
    suspicious: bool = False

    @property
    def quiet(self) -> bool:
        """Nothing moves, and there is no evidence for a motion."""
        return not (self.present or self.suspicious or self.vibration is not None)


@dataclass(frozen=True, slots=True)
class Explanation:
    """Possible causes of an observation: all that were weighed, the ``probable`` one, and a sentence about it.

    One that isn't ``confirmed`` yet makes a transform doubtful; an alert doesn't name it.
    """

    causes: tuple[CauseWeight, ...] = ()
    probable: CauseWeight = UNEXPLAINED
    text: str = ""
    confirmed: bool = True

    @property
    def confirmed_cause(self) -> CauseWeight:
        """The probable cause if it is confirmed, else that it is unknown."""
        return self.probable if self.confirmed else UNEXPLAINED
