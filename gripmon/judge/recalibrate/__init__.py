"""A new reference from many frames, checked by the fingertip corners alone: when to accept it, when to ask a person."""

from gripmon.judge.recalibrate.pnp import (
    FEWEST_COPLANAR,
    FEWEST_GENERAL,
    Recalibration,
    RecalibrationRefused,
    coplanar,
    recalibrate,
    refusal,
    rivals,
    solutions,
)
from gripmon.judge.recalibrate.recalibrator import Proposal, Recalibrator, Refusal, RefusalReason
from gripmon.judge.recalibrate.settings import RecalibrationSettings
from gripmon.judge.recalibrate.stills import StillFrame

__all__ = [
    "FEWEST_COPLANAR",
    "FEWEST_GENERAL",
    "Proposal",
    "Recalibration",
    "RecalibrationRefused",
    "RecalibrationSettings",
    "Recalibrator",
    "Refusal",
    "RefusalReason",
    "StillFrame",
    "coplanar",
    "recalibrate",
    "refusal",
    "rivals",
    "solutions",
]
