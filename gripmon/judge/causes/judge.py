"""Which single cause explains what the fingers' edges show, with probabilities, and an honest ``unknown``.

In words it says how far which part moved, and which causes a single camera can't distinguish.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.judge.causes.comparing import Comparison, Key, Report, compare
from gripmon.judge.causes.models import MOST_FOREIGN_EDGES, Weighed
from gripmon.judge.causes.pooling import Baseline, Pooled, pool
from gripmon.judge.causes.state import FOCAL, JAW, POSE, finger_slice
from gripmon.judge.causes.watches import LEARNT
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause, CauseWeight, EdgeEvidence, Explanation
from gripmon.track.edges.evidence import FINGER_SEEN_SHARE

FEWEST_PIECES = 4
"""Pieces of edges without which nothing is told about motions."""

SCATTERED_PX = 0.4
"""Standard deviation of most pieces' places beyond which they are not believed: they usually have 0.03 to 0.3."""

SETTLED = 6
"""Frames in which all was well with which a first baseline is made, if it is asked for before :data:`LEARNT`."""

CONTRADICTION_LOG_EVIDENCE = 8.0
"""Log evidence by which a cause must beat "nothing moved" among these frames for them not to be a baseline."""

BLIND_CAUSES = {Cause.VIEW_BLOCKED: 0.93, Cause.UNKNOWN: 0.05, Cause.CAMERA_MOUNT: 0.02}
"""Where no finger is seen at all, though the search has looked for them, in an image with the usual noise."""
BAD_IMAGE_CAUSES = {Cause.IMAGE_BAD: 0.93, Cause.UNKNOWN: 0.05, Cause.VIEW_BLOCKED: 0.02}
"""And in one that is noisier than that (so many times, at least by a part of the full scale), or dark."""
MUCH_NOISE, LEAST_NOISE, DARK, BRIGHT = 4.0, 0.02, 0.08, 0.95

FLATTENED = 0.5
STEADY, ALIKE, MOSTLY = 0.02, 0.05, 0.7
"""Part of the usual steepness to which the steepest edges of an image must have sunk for its focus to be in doubt; and
by how much its cells may have wandered before, and may differ now, parts of the full scale, so that so many of those
that were steady show what they showed: a blur leaves grey levels as they were, a thing before the lens doesn't.
"""

TO_CONFIRM = (Cause.FINGER_BENT, Cause.JAW_OPENING, Cause.LENS)
"""Causes that borders of other things near some of the edges can imitate: two conclusions in a row must name them."""


class CauseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a cause is named."""

    probable: Annotated[
        float,
        Meta(gt=0.5, lt=1.0, description="probability from which a cause is named; below it the cause is unknown"),
    ] = 0.9
    frames: Annotated[int, Meta(ge=1, le=1000, description="number of newest frames used as evidence")] = 12


class CauseJudge:
    """Compares models of what moved on the same pieces of edges, over some frames.

    Frames from a time when all is well (:meth:`well`) let it tell much smaller changes.  A pure function of what it was
    shown.  Frames cost nothing; an explanation takes some milliseconds.
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
        the part that changes as the jaw moves (zero: the report is exact), and the part that doesn't.
        """
        self._camera, self._gripper, self._settings = camera, gripper, settings
        self._report = Report(jaw_sigma_m, jaw_offset_sigma_m)
        self._frames: deque[EdgeEvidence] = deque(maxlen=settings.frames)
        self.rebase(reference_sigma)

    def rebase(self, reference_sigma: Array) -> None:
        """There is a new reference (``reference_sigma`` as above): evidence and baseline are forgotten."""
        self._reference_sigma = reference_sigma
        self._well: list[EdgeEvidence] = []
        self._baseline: Baseline | None = None
        self._learning = True
        self.reset()

    def reset(self) -> None:
        """All is well again: evidence is forgotten."""
        self._frames.clear()
        self._interrupted = False
        self._named: tuple[Cause, str | None] | None = None  # by the last conclusion

    def interrupted(self) -> None:
        """No frames came for long, before those that are added next: someone may have exchanged the camera."""
        self._interrupted = True

    @property
    def wants_baseline(self) -> bool:
        """Whether frames in which all is well still teach anything."""
        return self._learning and len(self._well) < LEARNT

    def well(self, evidence: EdgeEvidence) -> None:
        """A frame in which all seems well."""
        if self.wants_baseline:
            self._well.append(evidence)
            self._baseline = None

    def knocked(self) -> None:
        """The camera is elsewhere from now on: frames from before and after a knock are no baseline together.  Those
        from before stay one if they suffice.
        """
        if len(self._well) < SETTLED:
            self._well = []
        else:
            self._learning = False

    def add(self, evidence: EdgeEvidence) -> None:
        """A frame in which something may be wrong, measured or not."""
        self._frames.append(evidence)

    def explanation(self, ref_cam_T_grip: Array) -> Explanation:
        """What the frames since the last reset say together about what moved since ``ref_cam_T_grip`` (4, 4);
        confirmed if the conclusion before named the same cause, or the cause needs no confirmation.
        """
        found = self._concluded(ref_cam_T_grip)
        named, before = (found.probable.cause, found.probable.part), self._named
        self._named = named
        if found.probable.cause not in TO_CONFIRM or named == before:
            return found
        return replace(found, text=f"perhaps {found.text}", confirmed=False)

    def _concluded(self, ref_cam_T_grip: Array) -> Explanation:
        if not self._frames:
            return self._told({Cause.UNKNOWN: 1.0}, "nothing was seen that tells a cause")
        baseline = self._learnt(ref_cam_T_grip)
        pooled = pool(self._frames, self._camera, self._gripper)
        blind = len(pooled.piece) < FEWEST_PIECES
        scatter_px = 0.0 if blind else float(np.median(pooled.evidence.sigma_px))
        ill_seen = bool((pooled.share < FINGER_SEEN_SHARE).any())
        # What the image itself explains needs no other cause.
        if blind or (baseline is not None and (ill_seen or scatter_px > SCATTERED_PX)):
            spoilt = _spoilt(pooled, baseline)
            if spoilt is not None:
                return self._told(BAD_IMAGE_CAUSES, spoilt)
        if blind and baseline is not None and _unsharp(pooled, baseline):
            text = "no finger is seen, and the image is as it was, but nothing in it as sharp: out of focus, or shaken"
            return self._told({Cause.LENS: 0.7, Cause.UNKNOWN: 0.3}, text)
        if blind and pooled.cells.min() > BRIGHT:
            text = f"no part of the image is below {100.0 * BRIGHT:.0f} % of the full scale: too much light, or hidden"
            return self._told({Cause.IMAGE_BAD: 0.7, Cause.UNKNOWN: 0.3}, text)
        if blind:
            return self._told(
                BLIND_CAUSES, "no finger is seen where it should be, nor near it; hidden, or far out of place"
            )
        if scatter_px > SCATTERED_PX:
            text = f"the places of the gripper's edges scatter by {scatter_px:.1f} px, which doesn't tell what is wrong"
            return self._told({Cause.UNKNOWN: 1.0}, text)
        comparison = self._compared(pooled, ref_cam_T_grip, baseline)
        top = max(comparison.log.values())
        total = sum(math.exp(value - top) for value in comparison.log.values())
        shares = {key: math.exp(value - top) / total for key, value in comparison.log.items()}
        text = sentence(shares, comparison, pooled.absent, self._settings.probable, self._gripper)
        best = max(shares, key=lambda key: shares[key])
        of_few_edges = _of_few_edges(best, comparison)
        for key in [key for key in shares if _ill_founded(key, pooled) or (of_few_edges and key == best)]:
            if shares[key] >= self._settings.probable:
                text = f"too little of the fingers is seen to tell what moved; what is seen would fit if {text}"
            shares[Cause.UNKNOWN, None] += shares.pop(key)
        return _explained(shares, self._gripper, self._settings.probable, text)

    def _compared(self, pooled: Pooled, ref_cam_T_grip: Array, baseline: Baseline | None) -> Comparison:
        return compare(
            pooled,
            self._camera,
            self._gripper,
            ref_cam_T_grip,
            self._reference_sigma,
            self._report,
            baseline,
            self._interrupted,
        )

    def _learnt(self, ref_cam_T_grip: Array) -> Baseline | None:
        """The baseline of the frames in which all was well; None with too few.

        Frames that contradict the gripper's model within what is known of reference and jaw teach nothing: a finger
        that is bent from the start must not pass for normal.
        """
        if self._baseline is not None or len(self._well) < SETTLED:
            return self._baseline
        pooled = pool(self._well, self._camera, self._gripper)
        if len(pooled.piece) < FEWEST_PIECES or pooled.absent:
            return None
        comparison = self._compared(pooled, ref_cam_T_grip, None)
        nothing = comparison.fits[None, None]
        if max(comparison.log.values()) - comparison.log[None, None] > CONTRADICTION_LOG_EVIDENCE:
            return None
        edges = len(self._gripper.edge_ids)
        self._baseline = Baseline.of(pooled, nothing.motion, nothing.residual_px, edges)
        return self._baseline

    def _told(self, shares: Mapping[Cause, float], text: str) -> Explanation:
        """Where no models were compared."""
        return _explained({(c, None): p for c, p in shares.items()}, self._gripper, self._settings.probable, text)


def _spoilt(pooled: Pooled, baseline: Baseline | None) -> str | None:
    """By what the image hides the gripper's edges; None if by nothing."""
    if pooled.brightest < DARK:
        return f"the image is dark: hardly a pixel above {100.0 * pooled.brightest:.0f} % of the full scale"
    if pooled.noise > max(MUCH_NOISE * (0.0 if baseline is None else baseline.noise), LEAST_NOISE):
        return f"noise of {100.0 * pooled.noise:.0f} % of the full scale hides the gripper's edges"
    return None


def _unsharp(pooled: Pooled, baseline: Baseline) -> bool:
    """Whether the image shows what it did, without its edges."""
    steady = baseline.wander < STEADY
    if not steady.any() or pooled.steepest >= FLATTENED * baseline.steepest:
        return False
    return bool((np.abs(pooled.cells - baseline.cells)[steady] < ALIKE).mean() >= MOSTLY)


def _ill_founded(key: Key, pooled: Pooled) -> bool:
    """Whether a cause is told from fingers that most of their own profiles contradict.

    A finger that isn't seen at all is weighed as such.  Of an opening and of the lens two fingers have to tell: what
    one does may as well be its own.
    """
    cause, part = key
    if cause is Cause.FINGER_BENT and part is not None:
        return part not in pooled.absent and not pooled.share[part] >= FINGER_SEEN_SHARE
    several = min(len(pooled.share), 2)
    return cause in (Cause.JAW_OPENING, Cause.LENS) and int((pooled.share >= FINGER_SEEN_SHARE).sum()) < several


def _of_few_edges(key: Key, comparison: Comparison) -> bool:
    """Whether a cause says where the edges stand, but most of them don't."""
    says_where = key[0] not in (Cause.UNKNOWN, Cause.VIEW_BLOCKED)
    return says_where and bool((comparison.fits[key].own > 0.5).mean() <= 1.0 - MOST_FOREIGN_EDGES)


def _explained(shares: Mapping[Key, float], gripper: Gripper, probable: float, text: str) -> Explanation:
    """``shares``: probabilities of the models; that nothing moved counts as unknown."""
    weights: dict[tuple[Cause, int | None], float] = {}
    for (cause, part), share in shares.items():
        named = (Cause.UNKNOWN if cause is None else cause, part)
        weights[named] = weights.get(named, 0.0) + share
    names = gripper.finger_ids
    causes = sorted(
        (CauseWeight(c, p, None if f is None else names[f]) for (c, f), p in weights.items()),
        key=lambda weight: -weight.probability,
    )
    unknown = CauseWeight(Cause.UNKNOWN, weights.get((Cause.UNKNOWN, None), 0.0))
    return Explanation(tuple(causes), causes[0] if causes[0].probability >= probable else unknown, text)


def sentence(
    shares: Mapping[Key, float], comparison: Comparison, absent: Sequence[int], probable: float, gripper: Gripper
) -> str:
    """One sentence for the alert; ``shares``: probability of each model."""
    ranked = sorted(shares, key=lambda key: -shares[key])
    best = ranked[0]
    names = gripper.finger_ids
    gone = f"finger {', '.join(names[f] for f in absent)} is not seen near where it should be" if absent else ""
    named = best[0] not in (None, Cause.UNKNOWN)
    if named and shares[best] >= probable:
        text = _of(best, comparison.fits[best], comparison.blur_change_px, gripper)
        return f"{text}; {gone}" if gone and best[0] is not Cause.VIEW_BLOCKED else text
    if gone:
        return f"{gone}: hidden, or bent by more than edges are looked for; one image doesn't tell which"
    if best[0] is None and shares[best] >= 0.5:
        return "every finger and the camera stand where they did"
    if best[0] is Cause.UNKNOWN and shares[best] >= 0.5:
        return "no single cause explains what is seen: several things may have changed at once"
    said = " or ".join(
        f"{_name(key, gripper)} ({100.0 * shares[key]:.0f} %)" for key in ranked[:3] if shares[key] > 0.05
    )
    return f"this camera can't tell the causes apart: {said}"


def _of(key: Key, fit: Weighed, blur_change_px: float | None, gripper: Gripper) -> str:
    cause, part = key
    motion = fit.motion
    match cause:
        case Cause.CAMERA_MOUNT:
            shift_mm = 1e3 * float(np.linalg.norm(motion[POSE][:3]))
            turn_deg = math.degrees(float(np.linalg.norm(motion[POSE][3:])))
            also = (
                "all fingers bent alike"
                if len(gripper.finger_ids) > 1
                else "a finger bent so, or something else in place of its end,"
            )
            return (
                f"the camera moved against the gripper: TCP by {shift_mm:.3f} mm, turned by {turn_deg:.3f} degrees; "
                f"{also} would look the same"
            )
        case Cause.CAMERA_REPLACED:
            return (
                f"the image has another scale ({100.0 * math.expm1(float(motion[FOCAL])):+.2f} %) and is seen from "
                f"elsewhere ({1e3 * float(np.linalg.norm(motion[POSE][:3])):.2f} mm at the TCP): another camera, or a "
                "lens that changed as the mount moved"
            )
        case Cause.FINGER_BENT:
            assert part is not None
            own = motion[finger_slice(part)]
            shift_mm = 1e3 * float(np.linalg.norm(own[:3]))
            return (
                f"finger {gripper.finger_ids[part]} is bent: its middle stands {shift_mm:.3f} mm away, turned by "
                f"{math.degrees(float(np.linalg.norm(own[3:]))):.2f} degrees, the rest where it was"
            )
        case Cause.JAW_OPENING:
            return (
                f"the jaws stand {1e3 * float(motion[JAW]):+.3f} mm from what is reported, the camera where it was; "
                "fingers bent apart alike would look the same"
            )
        case Cause.LENS:
            parts = []
            if abs(float(motion[FOCAL])) > 5e-4:
                parts.append(f"the focal length changed by {100.0 * math.expm1(float(motion[FOCAL])):+.2f} %")
            if blur_change_px is not None and abs(blur_change_px) > 0.3:
                parts.append(f"the edges' blur changed by {blur_change_px:+.1f} px")
            what = " and ".join(parts) or "the image's scale or sharpness changed"
            return f"{what}; a camera that moved along its axis would show nearly so"
        case _:
            return "the view of the gripper is blocked"


def _name(key: Key, gripper: Gripper) -> str:
    cause, part = key
    if cause is None:
        return "nothing moved"
    named = {
        Cause.CAMERA_MOUNT: "the camera moved",
        Cause.FINGER_BENT: f"finger {'' if part is None else gripper.finger_ids[part]} is bent",
        Cause.JAW_OPENING: "the opening is reported wrong",
        Cause.LENS: "focal length or focus changed",
        Cause.CAMERA_REPLACED: "the camera was replaced",
        Cause.VIEW_BLOCKED: "the view is blocked",
        Cause.UNKNOWN: "several things at once",
    }
    return named.get(cause, str(cause))
