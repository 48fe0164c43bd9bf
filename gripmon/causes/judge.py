"""Which single cause explains what the fingers' edges show, with probabilities, and an honest ``unknown``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.camera import Camera
from gripmon.causes.baseline import Baseline, isotropic_blur_px2
from gripmon.causes.models import JAW_UNREPORTED_SIGMA_M, Knowledge, Suspect, suspects
from gripmon.causes.state import JAW, POSE, EdgeView, State, fingers_of
from gripmon.causes.weighing import Weighed, covariance_px2, weigh
from gripmon.causes.words import sentence
from gripmon.gripper import Gripper
from gripmon.records import Array, Cause, CauseWeight, EdgeEvidence

FEWEST_STRETCHES, FEWEST_SHARE = 3, 0.25
"""Stretches of a finger, and share of its profiles, with which it counts as seen."""

ABSENT = {Cause.VIEW_BLOCKED: 0.5, Cause.FINGER_BENT: 0.2, Cause.UNKNOWN: 0.1}
"""How probable it is that a finger isn't seen at all: in a blocked view, for the finger itself that is bent, and when
several things happened; with every other cause it is a ``STRAY``."""
STRAY = 0.02

BLOCKED = 0.1
"""Probability of a blocked view beforehand, where a finger isn't seen."""

FLOOR_PX = 0.015
"""Standard deviation of a stretch's place that nothing else explains."""

SETTLED_SIGMA = np.array([5e-6] * 3 + [5e-5] * 3)
"""Of the pose that a baseline knows, m and rad."""
SETTLED_JAW_M = 5e-6

WITH_BASELINE = 0.5
"""Part of what a whole edge is off by that is left when it is compared with itself before."""

BLUR_SIGMA_PX, BLUR_RANGE_PX = 0.1, 4.0
"""Scatter of the blur while the lens stays as it is, and how far it goes when it doesn't."""

WORST = -40.0
"""Log likelihood ratio that a single frame's blur is worth at most."""


class CauseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a cause is named."""

    probable: Annotated[
        float, Meta(gt=0.5, lt=1.0, description="probability from which a cause is named, else it is unknown")
    ] = 0.9
    frames: Annotated[int, Meta(ge=1, le=1000, description="newest frames that the evidence is taken from")] = 20


@dataclass(frozen=True, slots=True)
class Explanation:
    """``causes``: all that were weighed, the most probable first; ``probable`` the one to name, UNKNOWN where none is
    probable enough; ``text`` a sentence, with what this camera can't separate.  No evidence: UNKNOWN alone.
    """

    causes: tuple[CauseWeight, ...]
    probable: CauseWeight
    text: str


@dataclass(frozen=True, slots=True)
class _Frame:
    """One frame's log evidence by (cause, finger), and what each would have moved by."""

    log_evidence: dict[tuple[Cause | None, int | None], float]
    fits: dict[tuple[Cause | None, int | None], Weighed]
    absent: tuple[int, ...]
    blur_change_px: float | None


class CauseJudge:
    """Compares models of what moved on the same stretches of edges, over some frames.

    It is asked when something looks wrong; shown frames from a time when all was well (:meth:`well`) it tells much
    smaller changes.  A pure function of what it was shown.
    """

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        settings: CauseSettings,
        reference_sigma: Array,
        jaw_sigma_m: float,
        jaw_offset_sigma_m: float,
    ):
        """``reference_sigma`` (6,): standard deviations of the reference, m and rad; of the reported opening's error
        the part that changes as the jaw moves, and the part that doesn't.
        """
        self._camera, self._gripper, self._settings = camera, gripper, settings
        self._jaw_sigma_m, self._jaw_offset_sigma_m = jaw_sigma_m, jaw_offset_sigma_m
        self._frames: deque[_Frame] = deque(maxlen=settings.frames)
        self.rebase(reference_sigma)

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference (``reference_sigma`` as above): evidence and baseline are forgotten."""
        self._reference_sigma = reference_sigma
        self._baseline = Baseline(8 + 6 * len(self._gripper.finger_ids), len(self._gripper.edge_ids))
        self._baseline_jaw_m: float | None = None
        self.reset()

    def reset(self) -> None:
        """All is well again: evidence is forgotten."""
        self._frames.clear()

    @property
    def wants_baseline(self) -> bool:
        """Whether frames in which all is well still teach anything."""
        return not self._baseline.complete

    def well(self, evidence: EdgeEvidence, ref_cam_T_grip: Array) -> None:
        """A frame in which all seems well.  One that contradicts the gripper's model within what is known of reference
        and jaw teaches nothing: a finger that is bent from the start must not pass for normal.
        """
        if self._baseline.complete or self._absent(evidence):
            return
        frame = self._judged(evidence, ref_cam_T_grip)
        if frame is None or max(frame.log_evidence, key=lambda k: frame.log_evidence[k])[0] is not None:
            return
        fit = frame.fits[None, None]
        start = self._start(evidence, ref_cam_T_grip, settled=False)
        motion = fit.state.since(start)
        view = EdgeView(self._camera, self._gripper, evidence)
        self._baseline.add(motion, evidence.edge, view.residual(fit.state)[0], isotropic_blur_px2(evidence))
        self._baseline_jaw_m = evidence.jaw_reported_m

    def add(self, evidence: EdgeEvidence, ref_cam_T_grip: Array) -> None:
        """One frame's evidence of what moved since ``ref_cam_T_grip`` (4, 4)."""
        frame = self._judged(evidence, ref_cam_T_grip)
        if frame is not None:
            self._frames.append(frame)

    def explanation(self) -> Explanation:
        """What the frames since the last reset say together."""
        names = self._gripper.finger_ids
        if not self._frames:
            unknown = CauseWeight(Cause.UNKNOWN, 1.0)
            return Explanation((unknown,), unknown, "nothing was seen that tells a cause")
        log = self._together()
        top = max(log.values())
        total = sum(math.exp(value - top) for value in log.values())
        weights: dict[tuple[Cause, int | None], float] = {}
        for (cause, part), value in log.items():
            named = (Cause.UNKNOWN if cause is None else cause, part)
            weights[named] = weights.get(named, 0.0) + math.exp(value - top) / total
        causes = sorted(
            (CauseWeight(c, p, None if f is None else names[f]) for (c, f), p in weights.items()),
            key=lambda weight: -weight.probability,
        )
        probable = causes[0]
        if probable.cause is Cause.UNKNOWN or probable.probability < self._settings.probable:
            unknown = next((c for c in causes if c.cause is Cause.UNKNOWN), CauseWeight(Cause.UNKNOWN, 0.0))
            probable = unknown
        best = max(log, key=lambda key: log[key])
        newest = self._frames[-1]
        text = sentence(probable, causes, best, newest.fits, newest.absent, newest.blur_change_px, self._gripper)
        return Explanation(tuple(causes), probable, text)

    def _together(self) -> dict[tuple[Cause | None, int | None], float]:
        """Log evidence of each model, all frames together: the middle one of the frames, relative to each frame's best.

        Before a background that stands still they err together, so that all of them say no more than one; and one whose
        edges were mistaken must not outweigh the others.
        """
        keys = {key: None for frame in self._frames for key in frame.log_evidence}
        rows = []
        for frame in self._frames:
            top = max(frame.log_evidence.values())
            rows.append([frame.log_evidence.get(key, WORST + top) - top for key in keys])
        return dict(zip(keys, np.median(rows, axis=0).tolist(), strict=True))

    def _absent(self, evidence: EdgeEvidence) -> tuple[int, ...]:
        """Fingers that should be in view and are not seen."""
        stretches = fingers_of(evidence, self._gripper)
        sampled = np.isfinite(evidence.finger_share)
        seen = (stretches >= FEWEST_STRETCHES) & (np.nan_to_num(evidence.finger_share) >= FEWEST_SHARE)
        return tuple(np.flatnonzero(sampled & ~seen).tolist())

    def _judged(self, evidence: EdgeEvidence, ref_cam_T_grip: Array) -> _Frame | None:
        """None if no finger is seen."""
        absent = self._absent(evidence)
        evidence = _without(evidence, absent, self._gripper)
        if len(evidence.edge) < FEWEST_STRETCHES:
            return None
        start = self._start(evidence, ref_cam_T_grip, settled=self._baseline.known)
        held = self._knowledge(evidence)
        models = suspects(self._gripper, float(ref_cam_T_grip[2, 3]), held)
        view = EdgeView(self._camera, self._gripper, evidence)
        bias_px = self._baseline.bias_px[evidence.edge] if self._baseline.known else np.zeros(len(evidence.edge))
        shared_px = 0.0
        fits: dict[tuple[Cause | None, int | None], Weighed] = {}
        log: dict[tuple[Cause | None, int | None], float] = {}
        # The freest model first: what even that leaves, all stretches share as an error.
        for suspect in reversed(models):
            first = self._first(suspect, start, evidence)
            for _ in range(2 if suspect is models[-1] else 1):
                covariance = covariance_px2(
                    evidence.edge, evidence.sigma_px, self._spread_px(evidence), shared_px, FLOOR_PX
                )
                fit = weigh(view, self._gripper, suspect.model, start, first, bias_px, np.linalg.inv(covariance))
                if suspect is models[-1]:
                    shared_px = _shared_px(evidence, fit.residual_px)
            fits[suspect.cause, suspect.part] = fit
            log[suspect.cause, suspect.part] = fit.log_evidence + math.log(suspect.prior)
        change_px = self._blur_change_px(evidence)
        if change_px is not None:
            for key in log:
                log[key] += _blur_log_likelihood(change_px, may=key[0] in (Cause.LENS, Cause.UNKNOWN))
        if absent:
            log[Cause.VIEW_BLOCKED, None] = log[None, None] + math.log(BLOCKED)
            fits[Cause.VIEW_BLOCKED, None] = fits[None, None]
            for cause, part in log:
                chance = ABSENT.get(cause, STRAY) if cause is not None else STRAY
                log[cause, part] += math.log(STRAY if part is not None and part not in absent else chance)
        return _Frame(log, fits, absent, change_px)

    def _start(self, evidence: EdgeEvidence, ref_cam_T_grip: Array, *, settled: bool) -> State:
        """Where everything stands if nothing has moved."""
        reported_m = evidence.jaw_reported_m
        opening_m = evidence.jaw_opening_m if reported_m is None else reported_m
        start = State(ref_cam_T_grip, opening_m, 0.0, np.zeros((len(self._gripper.finger_ids), 6)))
        if not settled:
            return start
        motion = np.zeros_like(self._baseline.motion)
        motion[POSE] = self._baseline.motion[POSE]
        if reported_m is not None:
            motion[JAW] = self._baseline.motion[JAW]
        return start.moved(motion, self._gripper)

    @staticmethod
    def _first(suspect: Suspect, start: State, evidence: EdgeEvidence) -> State:
        """Where a model's fit begins: a camera that moved is followed at once, however far."""
        if suspect.cause in (Cause.CAMERA_MOUNT, Cause.UNKNOWN):
            return replace(start, cam_T_grip=evidence.cam_T_grip)
        return start

    def _knowledge(self, evidence: EdgeEvidence) -> Knowledge:
        reported = evidence.jaw_reported_m is not None
        if not self._baseline.known:
            jaw_m = math.hypot(self._jaw_sigma_m, self._jaw_offset_sigma_m if self._jaw_sigma_m > 0.0 else 0.0)
            return Knowledge(self._reference_sigma, max(jaw_m, SETTLED_JAW_M), reported)
        jaw_m = SETTLED_JAW_M
        if reported and self._baseline_jaw_m is not None and self._jaw_sigma_m > 0.0:
            # The part of the report's error that changes is another one some way on.
            way_m = abs(evidence.jaw_reported_m - self._baseline_jaw_m)  # type: ignore[operator]
            jaw_m = math.hypot(
                jaw_m, self._jaw_sigma_m * math.sqrt(2.0 - 2.0 * math.exp(-way_m / (2.0 * self._jaw_sigma_m)))
            )
        return Knowledge(SETTLED_SIGMA, jaw_m if reported else JAW_UNREPORTED_SIGMA_M, reported)

    def _spread_px(self, evidence: EdgeEvidence) -> Array:
        """What an edge is off by; less where the baseline knows it."""
        seen = self._baseline.seen[evidence.edge]
        return np.where(seen, WITH_BASELINE, 1.0) * evidence.spread_px

    def _blur_change_px(self, evidence: EdgeEvidence) -> float | None:
        now_px2, before_px2 = isotropic_blur_px2(evidence), self._baseline.blur_px2
        if now_px2 is None or before_px2 is None:
            return None
        return math.sqrt(now_px2) - math.sqrt(before_px2)


def _without(evidence: EdgeEvidence, absent: Sequence[int], gripper: Gripper) -> EdgeEvidence:
    """The evidence less what was taken for fingers that are not there."""
    if not absent:
        return evidence
    kept = ~np.isin(gripper.edge_finger[evidence.edge], absent)
    names = ("edge", "fraction", "xy", "per_px", "sigma_px", "spread_px", "blur_px2", "across")
    return replace(evidence, **{name: getattr(evidence, name)[kept] for name in names})


def _shared_px(evidence: EdgeEvidence, residual_px: Array) -> float:
    """Standard deviation that the points of a stretch share, from what the freest model leaves (moment estimator of a
    random effect, DerSimonian and Laird 1986; the degrees of freedom are shared out evenly).
    """
    weight = 1.0 / (evidence.sigma_px**2 + FLOOR_PX**2)
    excess = float(weight @ residual_px**2) - 0.5 * len(residual_px)
    return math.sqrt(max(excess, 0.0) / float(weight.sum()))


def _blur_log_likelihood(change_px: float, *, may: bool) -> float:
    """Of a change of the blur where the lens stays as it is, or may have changed."""
    stays = -0.5 * (change_px / BLUR_SIGMA_PX) ** 2
    if not may:
        return max(stays, WORST)
    changes = math.log(BLUR_SIGMA_PX * math.sqrt(2.0 * math.pi) / BLUR_RANGE_PX)
    return float(np.logaddexp(stays, changes)) - math.log(2.0)
