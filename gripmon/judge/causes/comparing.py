"""All models on the same pooled evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gripmon.judge.causes.models import Errors, Knowledge, Suspect, Weighed, something_else, suspects, weigh
from gripmon.judge.causes.pooling import Baseline, Pooled
from gripmon.judge.causes.state import EdgeView, State
from gripmon.judge.recalibrate.edges import STRETCH_PX
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M

Key = tuple[Cause | None, int | None]
"""A cause and the finger that it is about; None for the cause: nothing moved."""

FOLLOWED = (Cause.CAMERA_MOUNT, Cause.CAMERA_REPLACED, Cause.UNKNOWN)
"""Causes that move the whole gripper in the image, however far; fits of them start at the measured pose."""

BASELINE_ERROR_SHARE = 0.1
"""Share of a whole edge's error that remains after the baseline is subtracted."""

EDGE_SIGMA_PX = 0.02
"""Smallest standard deviation of a whole edge's error, px."""

MODEL_M = 3e-5
"""Standard deviation of the edges' places in a gripper file, m; it counts while there is no baseline."""

SETTLED_SIGMA = np.array([5e-6] * 3 + [5e-5] * 3)
"""Standard deviations of the pose that a baseline knows, m and rad; the first also of the opening."""

LENS_CHANGES = (Cause.LENS, Cause.CAMERA_REPLACED, Cause.UNKNOWN)
"""Causes with which the blur may change."""

BLUR_SIGMA_PX, BLUR_RANGE_PX = 0.1, 4.0
"""Standard deviation of the blur while the lens is unchanged, and the range of its changes otherwise, px."""

LOWEST_BLUR_LOG_RATIO = -40.0
"""Lower limit of the log likelihood ratio of a change of the blur."""

ABSENT_PROBABILITY = {Cause.VIEW_BLOCKED: 0.5, Cause.FINGER_BENT: 0.2, Cause.UNKNOWN: 0.1}
"""How probable it is that a finger isn't seen at all: in a blocked view, for the finger itself that is bent, and when
several things happened."""

STRAY_PROBABILITY = 0.02
"""The same with every other cause, and with a bent finger that is seen itself."""

BLOCKED_VIEW_PROBABILITY = 0.15
"""Prior probability of a blocked view where a finger isn't seen."""


@dataclass(frozen=True, slots=True)
class Report:
    """Standard deviations of a reported opening's error, m: of the part that changes as the jaw moves, and the rest."""

    sigma_m: float
    offset_sigma_m: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """``log``: evidence times prior of each model, as a logarithm; ``fits``: its fit; ``blur_change_px``: None where
    the blur isn't known; ``baseline``: whether motions count from frames in which all was well, or the reference.
    """

    log: Mapping[Key, float]
    fits: Mapping[Key, Weighed]
    blur_change_px: float | None
    baseline: bool


def compare(
    pooled: Pooled,
    camera: Camera,
    gripper: Gripper,
    ref_cam_T_grip: Array,
    reference_sigma: Array,
    report: Report,
    baseline: Baseline | None,
    interrupted: bool,
) -> Comparison:
    """``reference_sigma`` (6,): standard deviations of ``ref_cam_T_grip`` (4, 4), m and rad, which count as long as
    there is no ``baseline``.  ``pooled`` has at least some pieces.  ``interrupted``: see :func:`models.suspects`.
    """
    evidence = pooled.evidence
    reported = evidence.jaw_reported_m is not None
    opening_m = evidence.jaw_opening_m if evidence.jaw_reported_m is None else evidence.jaw_reported_m
    start = State(ref_cam_T_grip, opening_m, 0.0, np.zeros((len(gripper.finger_ids), 6)))
    sigma_px: Array = np.hypot(evidence.sigma_px, STRETCH_PX)
    bias_px: Array = np.zeros(len(evidence.edge))
    model_px = MODEL_M / (evidence.per_px * float(ref_cam_T_grip[2, 3]))
    spread_px: Array = np.hypot(np.hypot(evidence.spread_px, EDGE_SIGMA_PX), model_px)
    if baseline is not None:
        start = baseline.start(start, reported, gripper)
        bias_px, bias_sigma_px = baseline.bias_of(pooled.piece)
        sigma_px = np.hypot(sigma_px, bias_sigma_px)
        seen = baseline.known(pooled.piece)
        spread_px = np.where(seen, np.hypot(BASELINE_ERROR_SHARE * evidence.spread_px, EDGE_SIGMA_PX), spread_px)
    known = _knowledge(evidence.jaw_reported_m, reference_sigma, report, baseline)
    models = suspects(gripper, float(ref_cam_T_grip[2, 3]), known, interrupted)
    view = EdgeView(camera, gripper, evidence)

    def fitted(suspect: Suspect, errors: Errors) -> Weighed:
        pose = evidence.cam_T_grip if suspect.cause in FOLLOWED else start.cam_T_grip
        firsts = [replace(start, cam_T_grip=pose, jaw_opening_m=opening) for opening in openings_m]
        fits = [weigh(view, gripper, suspect.model, start, first, errors) for first in firsts]
        return max(fits, key=lambda fit: fit.log_evidence)

    openings_m = [start.jaw_opening_m]
    if baseline is not None and not reported and gripper.has_jaw:
        # What was seen of an opening that no one reports may be as wrong as the fingers are.
        openings_m.append(baseline.jaw_opening_m)
    errors = Errors(bias_px, sigma_px, spread_px, np.unique(evidence.edge, return_inverse=True)[1])
    # What even the freest model doesn't explain all pieces share as an error.
    shared_px = _shared_px(fitted(models[-1], errors).residual_px, sigma_px)
    errors = replace(errors, sigma_px=np.hypot(sigma_px, shared_px))
    borders = something_else(view.residual(start)[0] - bias_px, evidence.fraction, errors, evidence.reach_px)
    errors = replace(errors, something_else=borders)
    fits = {(suspect.cause, suspect.part): fitted(suspect, errors) for suspect in models}
    log = {(s.cause, s.part): fits[s.cause, s.part].log_evidence + math.log(s.prior) for s in models}
    change_px = _blur_change_px(pooled, baseline)
    if change_px is not None:
        for key in log:
            log[key] += _blur_log_likelihood(change_px, may=key[0] in LENS_CHANGES)
    if pooled.absent:
        log[Cause.VIEW_BLOCKED, None] = fits[None, None].log_evidence + math.log(BLOCKED_VIEW_PROBABILITY)
        fits[Cause.VIEW_BLOCKED, None] = fits[None, None]
        for cause, part in log:
            chance = ABSENT_PROBABILITY.get(cause, STRAY_PROBABILITY) if cause is not None else STRAY_PROBABILITY
            log[cause, part] += math.log(
                STRAY_PROBABILITY if part is not None and part not in pooled.absent else chance
            )
    return Comparison(log, fits, change_px, baseline is not None)


def _knowledge(
    jaw_reported_m: float | None, reference_sigma: Array, report: Report, baseline: Baseline | None
) -> Knowledge:
    """What is known while nothing has moved."""
    exact = report.sigma_m == 0.0
    if jaw_reported_m is None:
        pose = reference_sigma if baseline is None else SETTLED_SIGMA
        return Knowledge(pose, JAW_UNREPORTED_SIGMA_M, jaw_reported=False)
    if baseline is None:
        jaw_m = 0.0 if exact else math.hypot(report.sigma_m, report.offset_sigma_m)
        return Knowledge(reference_sigma, max(jaw_m, float(SETTLED_SIGMA[0])), jaw_reported=True)
    jaw_m = float(SETTLED_SIGMA[0])
    if baseline.jaw_reported_m is not None and not exact:
        # The part of the report's error that changes is another one some way on.
        way_m = abs(jaw_reported_m - baseline.jaw_reported_m)
        jaw_m = math.hypot(jaw_m, report.sigma_m * math.sqrt(2.0 - 2.0 * math.exp(-way_m / (2.0 * report.sigma_m))))
    return Knowledge(SETTLED_SIGMA, jaw_m, jaw_reported=True)


def _shared_px(residual_px: Array, sigma_px: Array) -> float:
    """Standard deviation to add to the assumed one: from the median residual of the freest model, which itself absorbs
    about half of the scatter.
    """
    excess = float(np.median(residual_px**2 / sigma_px**2)) / (0.6745**2 * 0.5) - 1.0
    return math.sqrt(max(excess, 0.0) * float(np.median(sigma_px**2)))


def _blur_change_px(pooled: Pooled, baseline: Baseline | None) -> float | None:
    if pooled.blur_px2 is None or baseline is None or baseline.blur_px2 is None:
        return None
    return math.sqrt(pooled.blur_px2) - math.sqrt(baseline.blur_px2)


def _blur_log_likelihood(change_px: float, *, may: bool) -> float:
    """Log likelihood of a change of the blur with an unchanged lens, or one that ``may`` have changed."""
    stays = -0.5 * (change_px / BLUR_SIGMA_PX) ** 2
    if not may:
        return max(stays, LOWEST_BLUR_LOG_RATIO)
    changes = math.log(BLUR_SIGMA_PX * math.sqrt(2.0 * math.pi) / BLUR_RANGE_PX)
    return float(np.logaddexp(stays, changes)) - math.log(2.0)
