"""What is known of a pulse of the laser, and what was made of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.calibrate.sighting import NotFound
from gripmon.laser.pointer.spots import Spot
from gripmon.model.records import Alert, Array, CauseWeight, State, Verdict
from gripmon.model.records.values import OpenEnum


class SpotFault(OpenEnum):
    """Why a pulse tells nothing, or was not believed."""

    NO_SPOT = "no_spot"
    OUTLIER = "outlier"
    NOT_FORESEEN = "not_foreseen"
    NOT_FINITE = "not_finite"


@dataclass(frozen=True, slots=True)
class SpotSeen:
    """A pulse: when (Unix ns), where the arm says that its hand was (4, 4), and the candidates for the spot, as
    :func:`~gripmon.laser.pointer.spots.find_spots` gives them.
    """

    stamp_ns: int
    base_T_ee: Array
    candidates: Sequence[Spot] | NotFound


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Two of the three ways to a spot, how far apart they put it (m), the standard deviation of that distance along the
    gap (m), and its normalised square with ``freedom`` degrees of freedom.
    """

    ways: tuple[str, str]
    gap_m: Array
    sigma_m: float
    square: float
    freedom: int

    @property
    def distance_m(self) -> float:
        return float(np.linalg.norm(self.gap_m))


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """``shift`` (6,): motion of ``base_T_cam`` since the calibration, position (m) then rotation vector (rad), base
    axes, with ``covariance`` (6, 6): ``base_T_cam' = perturb(base_T_cam, shift)``.  Along directions that the pulses
    don't show it is what the rest suggests, and the covariance is wide; ``observed`` (k, 6) are those known better than
    before by far, rows of unit length in ``shift`` divided by the 10 mm and 10 mrad that make metres and radians alike.
    ``complete``: all six are.  ``text`` says so in words.
    """

    shift: Array
    covariance: Array
    observed: Array
    complete: bool
    text: str


@dataclass(frozen=True, slots=True)
class SpotJudgement:
    """What was made of one pulse.

    ``chosen``: index of the candidate that was taken for the spot, at ``uv_px`` (2,); ``foreseen_px`` (2,) by the
    calibration; ``off_px`` (2,) seen less foreseen, whose ``covariance_px`` (2, 2) counts the calibration, the spot and
    the arm; ``square``: normalised, two degrees of freedom.  ``spots_base_m`` (3, 3): the spot in the base frame by
    beam and plane, by ray and plane, by beam and ray; ``disagreements`` of these.  ``used``: the pulse was believed,
    else ``fault`` and ``reason`` say why not.  ``probability_moved``: that anything has moved; ``causes``: what, each
    with its probability.  ``motion`` of the camera, where it is the camera that moved or may be.  None is what isn't
    known.
    """

    stamp_ns: int
    used: bool
    state: State
    verdict: Verdict
    chosen: int | None = None
    uv_px: Array | None = None
    foreseen_px: Array | None = None
    off_px: Array | None = None
    covariance_px: Array | None = None
    square: float | None = None
    spots_base_m: Array | None = None
    disagreements: tuple[Disagreement, ...] = ()
    fault: SpotFault | None = None
    reason: str = ""
    probability_moved: float = 0.0
    causes: tuple[CauseWeight, ...] = ()
    motion: CameraMotion | None = None
    alerts: tuple[Alert, ...] = ()
