"""What the replays of a real gripper's stills amount to, where the true motion since the reference is zero."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import kit
from benchmarks.real_runs import Part, Run, Still
from gripmon.model.geometry import make_transform, perturbation_between, rotation_from_xyzw
from gripmon.model.records import Array

MOVED = ("step", "creep", "drift", "vibration", "recalibrated", "recalibration_proposed")
"""Kinds of alerts that say that the mount moved, or follow from it."""
SHARE = 0.9
"""Of the stills that are to be valid within the smallest limit."""


@dataclass(frozen=True)
class Figures:
    """Of the stills that count; vectors are (position, rotation) about the camera's axes, m and rad.

    ``bound`` (2,): median of the measured ones' bounds; ``least`` (2,): the smallest limits, each by itself, within
    which those of nine of ten stills are, infinite for one that wasn't measured; ``proposed`` (2,): what ``check``
    promises, the larger of the halves.

    Of the measured ones ``scatter`` (6,): standard deviation; ``chi2_scatter``: mean squared deviation from their
    median, in units of the published covariance and per degree of freedom; ``chi2_motion``: the same of the motion
    since the reference.  ``beyond``: of each still that deviates from the median by more than its bounds, by how much
    more (m, rad); ``moved_beyond``: the same of the motion since the reference.

    ``alerts``: of all stills, also those that don't count; ``hypotheses``: what makes the bound as large; ``reasons``:
    why stills aren't measured; ``teaching``: what was left out, or refused.
    """

    stills: int
    measured: int
    valid: int
    bound: Array
    least: Array
    proposed: Array
    scatter: Array
    chi2_scatter: float
    chi2_motion: float
    beyond: tuple[tuple[float, float], ...]
    moved_beyond: tuple[tuple[float, float], ...]
    alerts: Counter[str]
    hypotheses: Counter[str]
    reasons: Counter[str]
    teaching: tuple[str, ...]


def figures_of(run: Run) -> Figures:
    """Stills of a half that nothing could be taught for count, as not measured."""
    counted = [still for part in run.parts for still in part.stills[part.uncounted :]]
    total = sum(len(part.names) - part.uncounted for part in run.parts)
    measured = [still for still in counted if still.measured]
    bounds = np.full((total, 2), np.inf)
    for row, still in zip(bounds, measured, strict=False):
        row[:] = [math.inf if v is None or math.isnan(v) else v for v in (still.bound_m, still.bound_rad)]
    motion = motions(run, measured)
    away = motion - np.median(motion, axis=0) if len(motion) else motion
    proposals = [[math.nan if v is None else v for v in (p.proposed_m, p.proposed_rad)] for p in run.parts if p.stills]
    return Figures(
        stills=total,
        measured=len(measured),
        valid=sum(still.valid for still in counted),
        bound=np.median(bounds[: len(measured)], axis=0) if measured else np.full(2, np.inf),
        least=np.sort(bounds, axis=0)[math.ceil(SHARE * total) - 1],
        proposed=np.max(proposals, axis=0) if proposals else np.full(2, np.nan),
        scatter=away.std(axis=0, ddof=1) if len(away) > 1 else np.full(6, np.nan),
        chi2_scatter=_chi2(away, measured),
        chi2_motion=_chi2(motion, measured),
        beyond=_beyond(away, bounds),
        moved_beyond=_beyond(motion, bounds),
        alerts=Counter(kind for p in run.parts for s in p.stills for kind in s.alerts if kind in MOVED),
        hypotheses=Counter(still.hypothesis for still in measured),
        reasons=Counter((still.reason or "").partition(":")[0] for still in counted if not still.measured),
        teaching=tuple(filter(None, map(_teaching, run.parts))),
    )


def _teaching(part: Part) -> str:
    """What a half could teach, in words."""
    if part.taught is None:
        return ""
    if part.refused is not None:
        why, left_out, _ = part.refused.removeprefix("teach: ").partition("; and left out before: ")
        return (
            f"nothing is taught from the {part.taught} stills: {why}{' (others were left out before)' * bool(left_out)}"
        )
    return f"taught from the {part.taught} stills, {part.left_out} of which are left out" if part.left_out else ""


def motions(run: Run, measured: Sequence[Still]) -> Array:
    """(n, 6) from the reference to each still."""
    reference = make_transform(rotation_from_xyzw(run.reference_xyzw), np.array(run.reference_m))
    out = np.zeros((len(measured), 6))
    for row, still in zip(out, measured, strict=True):
        assert still.translation_m is not None and still.rotation_xyzw is not None
        pose = make_transform(rotation_from_xyzw(still.rotation_xyzw), np.array(still.translation_m))
        row[:] = perturbation_between(reference, pose)
    return out


def _chi2(motion: Array, measured: Sequence[Still]) -> float:
    """Per degree of freedom, of which each still has six."""
    if not len(motion):
        return math.nan
    covariances = np.array([still.covariance for still in measured]).reshape(-1, 6, 6)
    return float(kit.nees(motion, covariances).mean()) / 6.0


def _beyond(motion: Array, bounds: Array) -> tuple[tuple[float, float], ...]:
    """By how much (m, rad) the stills outside of either bound are; 0 for the other one."""
    sizes = np.stack([np.linalg.norm(motion[:, :3], axis=1), np.linalg.norm(motion[:, 3:], axis=1)], axis=1)
    excess = np.maximum(sizes - bounds[: len(sizes)], 0.0)
    return tuple((float(m), float(rad)) for m, rad in excess[excess.any(axis=1)])
