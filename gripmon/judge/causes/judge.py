"""The single cause that explains where the fingers' edges are seen, with probabilities; ``unknown`` if none does.

Its text says which part moved how far, and which causes a single camera can't distinguish.
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
from gripmon.judge.causes.kernel import FOCAL, JAW, POSE
from gripmon.judge.causes.models import MOST_FOREIGN_EDGES
from gripmon.judge.causes.pooling import SEEN_EDGES, Baseline, Pooled, pool
from gripmon.judge.causes.state import finger_slice
from gripmon.judge.causes.watches import BASELINE_FRAMES
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause, CauseWeight, EdgeEvidence, Explanation
from gripmon.track.edges.evidence import FINGER_SEEN_SHARE

FEWEST_PIECES = 4
"""Pieces of edges below which no motions are compared."""

SCATTERED_PX = 0.4
"""Median standard deviation of the pieces' places above which no cause is named, px; usual are 0.03 to 0.3."""

FEWEST_BASELINE_FRAMES = 6
"""Frames in which all was well that suffice for a baseline while there aren't :data:`BASELINE_FRAMES` yet."""

CONTRADICTION_LOG_EVIDENCE = 8.0
"""Log Bayes factor of a cause against "nothing moved" above which frames are no baseline."""

BLIND_CAUSES = {Cause.VIEW_BLOCKED: 0.93, Cause.UNKNOWN: 0.05, Cause.CAMERA_MOUNT: 0.02}
"""Probabilities where the search finds no finger in an image with the usual noise."""

BAD_IMAGE_CAUSES = {Cause.IMAGE_BAD: 0.93, Cause.UNKNOWN: 0.05, Cause.VIEW_BLOCKED: 0.02}
"""The same in an image that is dark, or too noisy."""

MAX_NOISE_RATIO, MAX_NOISE = 4.0, 0.02
"""Noise, over the usual one and as a fraction of full scale, that hides edges where it exceeds both."""

DARK_LEVEL, BRIGHT_LEVEL = 0.08, 0.95
"""Levels, fractions of full scale: an image is dark if its brightest pixels are below the first, too bright if its
darkest cell is above the second.
"""

UNSHARP_RATIO = 0.5
"""Steepest grey-level slope, over the usual one, below which an image may be out of focus."""

BLUR_TOLD_PX = 0.3
"""Change of the edges' blur that is told, px, and that may be why a gripper isn't found."""

STEADY_CELL_RANGE, SAME_CELL_DIFFERENCE, SAME_CELLS_SHARE = 0.02, 0.05, 0.7
"""A blur keeps the mean grey levels of an image's cells; a thing before the lens doesn't.  Of the cells that varied by
less than the first while all was well, the share in the third must differ from then by less than the second; both
fractions of full scale.
"""

NOT_THE_CAMERA = (Cause.FINGER_BENT, Cause.JAW_OPENING, Cause.LENS)
"""Causes of a drift that the transform doesn't describe: it follows a finger, the jaw or the lens.  The camera may be
where it was, and is not calibrated again.  Borders of other things near some of the edges can imitate them, so that two
conclusions in a row must name one.
"""


class CauseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When a cause is named."""

    probable: Annotated[
        float,
        Meta(gt=0.5, lt=1.0, description="probability from which a cause is named; below it the cause is unknown"),
    ] = 0.9
    frames: Annotated[int, Meta(ge=1, le=1000, description="number of newest frames used as evidence")] = 12


class CauseJudge:
    """Compares models of what moved on the same pieces of edges, over some frames.

    Frames in which all is well (:meth:`well`) let it detect much smaller changes.  Deterministic: it depends on the
    frames alone.  Adding one costs nothing; an explanation takes 20 to 50 ms.
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
        """Start again with a new reference (``reference_sigma`` as above): evidence and baseline are dropped."""
        self._reference_sigma = reference_sigma
        self._well: list[EdgeEvidence] = []
        self._baseline: Baseline | None = None
        self._learning = True
        self.reset()

    def reset(self) -> None:
        """All is well again: drop the evidence."""
        self._frames.clear()
        self._interrupted = False
        self._named: tuple[Cause, str | None] | None = None  # by the last conclusion

    def interrupted(self) -> None:
        """No frames came for a long time before those added next: the camera may have been exchanged."""
        self._interrupted = True

    @property
    def wants_baseline(self) -> bool:
        """Whether frames in which all is well still improve the baseline."""
        return self._learning and len(self._well) < BASELINE_FRAMES

    def well(self, evidence: EdgeEvidence) -> None:
        """Add a frame in which all seems well."""
        if self.wants_baseline:
            self._well.append(evidence)
            self._baseline = None

    def knocked(self) -> None:
        """The camera is elsewhere from now on: frames from before and after a knock make no baseline together.  Those
        from before are kept if they suffice.
        """
        if len(self._well) < FEWEST_BASELINE_FRAMES:
            self._well = []
        else:
            self._learning = False

    def add(self, evidence: EdgeEvidence) -> None:
        """Add a frame in which something may be wrong, measured or not."""
        self._frames.append(evidence)

    def explanation(self, ref_cam_T_grip: Array) -> Explanation:
        """What has moved since ``ref_cam_T_grip`` (4, 4), by all frames since the last reset; confirmed if the
        conclusion before named the same cause, or the cause needs no confirmation.
        """
        found = self._concluded(ref_cam_T_grip)
        named, before = (found.probable.cause, found.probable.part), self._named
        self._named = named
        if found.probable.cause not in NOT_THE_CAMERA or named == before:
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
        if blind and pooled.cells.min() > BRIGHT_LEVEL:
            level = f"{100.0 * BRIGHT_LEVEL:.0f} % of the full scale"
            text = f"no part of the image is below {level}: too much light, or hidden"
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
        for key in [key for key in shares if _of_lost_gripper(key, pooled, comparison)]:
            shares[Cause.UNKNOWN, None] += shares.pop(key)
        text = sentence(shares, comparison, pooled.absent, self._settings.probable, self._gripper)
        best = max(shares, key=lambda key: shares[key])
        of_few_edges = _of_few_edges(best, comparison) or _of_one_edge(best, comparison)
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
        """The baseline from the frames in which all was well; None with too few.

        Frames that contradict the gripper's model, given what is known of reference and jaw, are no baseline: a finger
        that was bent from the start must not pass for normal.
        """
        if self._baseline is not None or len(self._well) < FEWEST_BASELINE_FRAMES:
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
        """An explanation without a comparison of models."""
        return _explained({(c, None): p for c, p in shares.items()}, self._gripper, self._settings.probable, text)


def _spoilt(pooled: Pooled, baseline: Baseline | None) -> str | None:
    """What about the image hides the gripper's edges, in words; None if nothing does."""
    if pooled.brightest < DARK_LEVEL:
        return f"the image is dark: hardly a pixel above {100.0 * pooled.brightest:.0f} % of the full scale"
    if pooled.noise > max(MAX_NOISE_RATIO * (0.0 if baseline is None else baseline.noise), MAX_NOISE):
        return f"noise of {100.0 * pooled.noise:.0f} % of the full scale hides the gripper's edges"
    return None


def _unsharp(pooled: Pooled, baseline: Baseline) -> bool:
    """Whether the image has kept its grey levels and lost its sharp edges."""
    steady = baseline.wander < STEADY_CELL_RANGE
    if not steady.any() or pooled.steepest >= UNSHARP_RATIO * baseline.steepest:
        return False
    return bool((np.abs(pooled.cells - baseline.cells)[steady] < SAME_CELL_DIFFERENCE).mean() >= SAME_CELLS_SHARE)


def _ill_founded(key: Key, pooled: Pooled) -> bool:
    """Whether a cause rests on fingers that most of their own search lines contradict.

    A finger that isn't seen at all is weighed as such.  An opening or a lens needs two well-seen fingers: what one
    shows may as well be its own motion.
    """
    cause, part = key
    if cause is Cause.FINGER_BENT and part is not None:
        return part not in pooled.absent and not pooled.share[part] >= FINGER_SEEN_SHARE
    several = min(len(pooled.share), 2)
    return cause in (Cause.JAW_OPENING, Cause.LENS) and int((pooled.share >= FINGER_SEEN_SHARE).sum()) < several


def _of_lost_gripper(key: Key, pooled: Pooled, comparison: Comparison) -> bool:
    """Whether a cause is the lens while the gripper isn't found: at another scale it would be, as one that is farther
    away, and only a blur hides it.
    """
    return key[0] is Cause.LENS and not pooled.found and not abs(comparison.blur_change_px or 0.0) > BLUR_TOLD_PX


def _of_few_edges(key: Key, comparison: Comparison) -> bool:
    """Whether a cause predicts where edges are seen, but doesn't explain most of them."""
    says_where = key[0] not in (Cause.UNKNOWN, Cause.VIEW_BLOCKED)
    return says_where and bool((comparison.fits[key].own > 0.5).mean() <= 1.0 - MOST_FOREIGN_EDGES)


def _of_one_edge(key: Key, comparison: Comparison) -> bool:
    """Whether a finger seems bent because of a single edge: a border of something else beside it shows the same."""
    moved = (comparison.fits[key].own > 0.5) & (comparison.fits[None, None].own <= 0.5)
    return key[0] is Cause.FINGER_BENT and int(moved.sum()) < SEEN_EDGES


def _explained(shares: Mapping[Key, float], gripper: Gripper, probable: float, text: str) -> Explanation:
    """An explanation from the models' probabilities ``shares``; that nothing moved counts as unknown."""
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
    """One sentence for the alert; ``shares``: the models' probabilities."""
    ranked = sorted(shares, key=lambda key: -shares[key])
    best = ranked[0]
    names = gripper.finger_ids
    gone = f"finger {', '.join(names[f] for f in absent)} is not seen near where it should be" if absent else ""
    named = best[0] not in (None, Cause.UNKNOWN)
    if named and shares[best] >= probable:
        text = _of(best, comparison, gripper)
        return f"{text}; {gone}" if gone and best[0] is not Cause.VIEW_BLOCKED else text
    if gone:
        return f"{gone}: hidden, or bent by more than edges are looked for; one image doesn't tell which"
    if best[0] is None and shares[best] >= 0.5:
        return "the edges that are seen show no motion of the camera or a finger"
    if best[0] is Cause.UNKNOWN and shares[best] >= 0.5:
        return "no single cause explains what is seen: several things may have changed at once"
    said = " or ".join(
        f"{_name(key, gripper)} ({100.0 * shares[key]:.0f} %)" for key in ranked[:3] if shares[key] > 0.05
    )
    return f"this camera can't tell the causes apart: {said}"


def _of(key: Key, comparison: Comparison, gripper: Gripper) -> str:
    cause, part = key
    motion, blur_change_px = comparison.fits[key].motion, comparison.blur_change_px
    match cause:
        case Cause.CAMERA_MOUNT:
            shift_mm = 1e3 * float(np.linalg.norm(motion[POSE][:3]))
            turn_deg = math.degrees(float(np.linalg.norm(motion[POSE][3:])))
            also = (
                "all fingers bent alike"
                if len(gripper.finger_ids) > 1
                else "a finger bent so, or something else in place of its end,"
            )
            since = "since all was well" if comparison.baseline else "from the reference"
            return (
                f"the camera moved against the gripper: TCP by {shift_mm:.3f} mm, turned by {turn_deg:.3f} degrees "
                f"{since}; {also} would look the same"
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
            if blur_change_px is not None and abs(blur_change_px) > BLUR_TOLD_PX:
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
