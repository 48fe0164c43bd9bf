"""What frames keep: a monitor's own bounds over images that are there, what makes them as large and what would help.

A forecast knows neither the light nor what stands behind the fingers; on real grippers it promised a third of what the
frames needed.  So wherever there are images, the monitor itself is run over them; without any, the same is said of the
bounds that are forecast of a frame.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.geometry import from_record
from gripmon.model.poses import perturbation_between
from gripmon.model.records import (
    NOTHING_WRONG,
    Absolute,
    Array,
    Frame,
    ReferenceRecord,
    Transform,
    ValidBy,
    Verdict,
)
from gripmon.model.units import in_degrees, in_mm
from gripmon.monitor import Monitor
from gripmon.monitor.weigher import Weigher
from gripmon.teach.accuracy import Accuracy, as_if_measured, forecast_frame
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig
from gripmon.track.edges import VAGUE_M, VAGUE_RAD
from gripmon.track.edges.words import in_words

APART_S = 1.0
"""Between two still images that have no time stamps."""

SHARE = 0.9
"""Of the frames that a proposed alert limit is to leave valid: that of real grippers' stills (docs/integrity.md)."""

QUANTILE_ERROR = 1.71 / 1.2816
"""Standard error of a normal sample's 90 % quantile, times the root of its size, in units of its distance from the
median (no unit): sqrt(0.9 · 0.1) over the density there, 0.1755, is 1.71 standard deviations; the quantile is 1.2816
away.
"""

LEAST_HELP = 0.9
"""Ratio of bounds below which a remedy is worth saying."""

USUAL_SPREAD = 2.0
"""Ratio of the bound to the forecast one that one frame in twenty reaches (no unit; docs/integrity.md)."""


class Sizes(msgspec.Struct, frozen=True):
    """A bound over all counted images: its median, and what nine of ten are within (m, rad); None where fewer have a
    bound.
    """

    median_m: float | None
    median_rad: float | None
    most_m: float | None
    most_rad: float | None

    @classmethod
    def of(cls, bounds: Array) -> Sizes:
        """From (n, 2) in m and rad, infinite without one."""
        if not len(bounds):
            return cls(None, None, None, None)
        ordered = np.sort(bounds, axis=0)
        rows = [ordered[math.ceil(share * len(ordered)) - 1].tolist() for share in (0.5, SHARE)]
        return cls(*(value if math.isfinite(value) else None for row in rows for value in row))


class Kept(msgspec.Struct, frozen=True):
    """What a monitor said of ``images`` one after the other; ``first``: how many were not counted at the beginning, as
    a single frame is never confirmed.  ``measured`` and ``valid`` of the counted ones; both bounds, of which
    ``valid_by`` names the one that a verdict goes by.

    ``hypothesis``: what it can't be excluded most often, that makes this bound as large, and in how many images;
    ``reason``: why most of those that weren't measured weren't.  ``away_m`` and ``away_rad``: how far from the
    reference the images show the gripper, in the median; None where none was measured.  ``helps``: what would help
    most, and the median that the bound has with it, None where that wasn't computed.

    ``forecast``: of no image, but of a frame that measures all edges in view, before the usual clutter.
    """

    images: int
    first: int
    measured: int
    valid: int
    valid_by: ValidBy
    since_reference: Sizes
    absolute: Sizes
    hypothesis: str
    hypothesis_images: int
    reason: str | None
    alert_limit_m: float
    alert_limit_rad: float
    away_m: float | None = None
    away_rad: float | None = None
    helps: str | None = None
    helped_m: float | None = None
    helped_rad: float | None = None
    forecast: bool = False

    @property
    def counted(self) -> int:
        return self.images - self.first

    @property
    def sizes(self) -> Sizes:
        """The bound that verdicts go by."""
        return self.since_reference if self.valid_by is ValidBy.REFERENCE else self.absolute

    @property
    def proposed(self) -> tuple[float, float] | None:
        """Alert limits (m, rad) within which nine of ten further frames like these should be; None where too few images
        have a bound.

        The 90 % quantile of few images is itself uncertain, by a standard error that follows from its distance from the
        median, on a logarithmic scale, and the number of images (:data:`QUANTILE_ERROR`): that much is added.
        """
        sizes = self.sizes
        if sizes.most_m is None or sizes.most_rad is None or sizes.median_m is None or sizes.median_rad is None:
            return None
        power = QUANTILE_ERROR / math.sqrt(max(self.counted, 1))
        return (
            sizes.most_m * (sizes.most_m / sizes.median_m) ** power,
            sizes.most_rad * (sizes.most_rad / sizes.median_rad) ** power,
        )

    @property
    def excess(self) -> float:
        """The larger of the bounds that nine of ten images keep, over its alert limit; infinite where there is none."""
        return self._over_limits(self.sizes.most_m, self.sizes.most_rad)

    @property
    def median_excess(self) -> float:
        """The same of the median."""
        return self._over_limits(self.sizes.median_m, self.sizes.median_rad)

    def _over_limits(self, m: float | None, rad: float | None) -> float:
        return math.inf if m is None or rad is None else max(m / self.alert_limit_m, rad / self.alert_limit_rad)

    @property
    def reachable(self) -> bool:
        """Whether nine of ten frames are within the alert limits."""
        return self.excess <= 1.0

    def text(self) -> str:
        """One line for a person: what the bounds are."""
        sizes, by_reference = self.sizes, self.valid_by is ValidBy.REFERENCE
        known = sizes.median_m is not None and sizes.median_rad is not None
        median = _said(sizes.median_m, sizes.median_rad) if known else "no bound is known"
        if self.forecast:
            subject = "the motion since the reference" if by_reference else "a transform"
            return f"{subject} of this view is good to {median}" if known else median
        seen = f"{self.measured} of {self.counted} measured, {self.valid} valid"
        if not known:
            return f"{seen}; {self.reason or median}"
        text = f"{seen}; bound on {'the motion since the reference' if by_reference else 'the TCP'}, median {median}"
        if sizes.most_m is None or sizes.most_rad is None:
            return f"{text}, {100.0 * SHARE:g} % of them: none"
        return f"{text}, {100.0 * SHARE:g} % within {_said(sizes.most_m, sizes.most_rad)}"

    def promise(self) -> str:
        """The same beside the alert limits, with what would be needed where they are too tight."""
        text = f"{self.text()}, alert limit {_said(self.alert_limit_m, self.alert_limit_rad)}"
        if self.reachable:
            close = self.forecast and USUAL_SPREAD * self.excess > 1.0
            some = "close to the alert limit: one frame in twenty is twice as uncertain, some will be suspect"
            return f"{text}; {some}" if close else text
        needed, why, takes = self.needed(), self.why(), "for nine of ten frames to be valid it takes"
        if self.forecast:
            why, takes = "", "no transform can be valid: valid needs"
        return "; ".join(filter(None, [text, why, f"{takes} {needed}" if needed else "", self.help()]))

    def why(self) -> str:
        """What makes the bound as large, in words of the picture; empty where nothing was measured."""
        if not self.hypothesis:
            return ""
        often = f"in {self.hypothesis_images} of {self.measured} images"
        if self.hypothesis == NOTHING_WRONG:
            return f"{often} it is as large since too little of the gripper is seen"
        return f"{often} it is as large since it can't be excluded that {self.hypothesis}"

    def needed(self) -> str:
        """The alert limits that nine of ten such frames would keep, where the present ones are too tight, as settings;
        empty where they are wide enough.
        """
        proposed = self.proposed
        if proposed is None and self.forecast:
            return "more of the fingers in view: no limit would do"
        if proposed is None or self.reachable:
            return ""
        parts, (m, rad) = [], (rounded_up(value) for value in proposed)
        if m > self.alert_limit_m:
            parts.append(f"alert_limit_m of at least {m:g} ({1e3 * m:g} mm)")
        if rad > self.alert_limit_rad:
            parts.append(f"alert_limit_rad of at least {rad:g} ({in_degrees(rad)} degrees)")
        return " and ".join(parts)

    def help(self) -> str:
        """The one thing that helps most, in words."""
        if self.helps is None:
            return ""
        if self.helped_m is None or self.helped_rad is None:
            return f"what helps most: {self.helps}"
        then = f"{'then' if self.forecast else 'median then'} {_said(self.helped_m, self.helped_rad)}"
        enough = self.helped_m <= self.alert_limit_m and self.helped_rad <= self.alert_limit_rad
        return f"what helps most: {self.helps} ({then}{'' if enough else ', not enough'})"


def _said(position_m: float | None, rotation_rad: float | None) -> str:
    assert position_m is not None and rotation_rad is not None
    return f"{in_mm(position_m)} mm and {in_degrees(rotation_rad)}°"


def rounded_up(value: float) -> float:
    """Round up to two significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / unit - 1e-9) * unit


def kept(rig: Rig, reference: ReferenceRecord, frames: Iterable[Frame]) -> Kept:
    """Run the daemon's monitor over frames, each with the jaw opening that it would be told, and say what came of it.

    The same frames give the same answer.  Without a frame, nothing is measured.
    """
    policy = rig.settings.policy
    monitor = Monitor(rig.camera, rig.gripper, rig.settings, reference, rig.taught)
    records = [monitor.process(frame) for frame in frames]
    first = min(policy.confirm_frames - 1, max(len(records) - 1, 0))
    counted = records[first:]
    since, absolute = np.full((len(counted), 2), np.inf), np.full((len(counted), 2), np.inf)
    for k, record in enumerate(counted):
        if record.measured and record.since_reference is not None:
            since[k] = record.since_reference.position_m, record.since_reference.rotation_rad
        if record.measured and record.absolute is not None:
            absolute[k] = record.absolute.position_m, record.absolute.rotation_rad
    for bounds in (since, absolute):  # what a frame's reason calls undetermined
        bounds[(bounds > (VAGUE_M, VAGUE_RAD)).any(axis=1)] = np.inf
    measured = [record for record in counted if record.measured]
    away = [_away(record.absolute, reference) for record in measured if record.absolute is not None]
    away_m, away_rad = np.median(away, axis=0).tolist() if away else (None, None)
    named = Counter(r.protection.hypothesis for r in measured if r.protection is not None)
    hypothesis, often = named.most_common(1)[0] if named else ("", 0)
    unseen = Counter(r.reason for r in counted if not r.measured and r.reason)
    return Kept(
        images=len(records),
        first=first,
        measured=len(measured),
        valid=sum(record.verdict is Verdict.VALID for record in counted),
        valid_by=policy.valid_by,
        since_reference=Sizes.of(since),
        absolute=Sizes.of(absolute),
        hypothesis=hypothesis,
        hypothesis_images=often,
        reason=unseen.most_common(1)[0][0] if unseen else None,
        alert_limit_m=policy.alert_limit_m,
        alert_limit_rad=policy.alert_limit_rad,
        away_m=away_m,
        away_rad=away_rad,
    )


def _away(seen: Absolute, reference: ReferenceRecord) -> tuple[float, float]:
    """How far (m, rad) the TCP as measured is from the reference."""
    measured_T = from_record(Transform(seen.translation_m, seen.rotation_xyzw))
    way = perturbation_between(from_record(reference.cam_T_grip), measured_T)
    return float(np.linalg.norm(way[:3])), float(np.linalg.norm(way[3:]))


def foreseen(accuracy: Accuracy, rig: Rig) -> Kept:
    """What is forecast of a frame of a view, as if it had been kept."""
    policy, bound = rig.settings.policy, accuracy.by(rig.settings.policy.valid_by)
    since, absolute = (
        Sizes.of(np.array([(each.position_m, each.rotation_rad)] if each is not None else []))
        for each in (accuracy.since_reference, accuracy.absolute)
    )
    hypothesis = "" if bound is None else bound.hypothesis
    limits = policy.alert_limit_m, policy.alert_limit_rad
    return Kept(0, 0, 0, 0, policy.valid_by, since, absolute, hypothesis, 0, None, *limits, forecast=True)


def promise_of(rig: Rig, cam_T_grip: Array, jaw_opening_m: float | None, accuracy: Accuracy | None = None) -> Kept:
    """The same of the view from a pose (4, 4), and what would help most where the alert limits are too tight."""

    def run(known: Rig) -> Kept:
        return foreseen(forecast_frame(known, cam_T_grip, jaw_opening_m), known)

    found = run(rig) if accuracy is None else foreseen(accuracy, rig)
    return found if found.reachable else with_help(found, rig, run)


def as_frames(images: Iterable[TeachingImage]) -> list[Frame]:
    """Teaching images as frames, one after the other."""
    return [
        Frame(k, round(1e9 * APART_S * (k + 1)), each.image, each.jaw_opening_m, each.name)
        for k, each in enumerate(images)
    ]


def with_help(found: Kept, rig: Rig, again: Callable[[Rig], Kept]) -> Kept:
    """The same with the one thing that helps most: ``again`` says what is kept with each thing known that a person can
    measure, and if none of these suffices, with less to be promised.  Where none helps, what the hypothesis asks for.
    """
    if found.hypothesis.startswith(Weigher.not_as_expected):
        return msgspec.structs.replace(found, helps=_asked_for(found))
    tried = {words: again(known) for words, known in as_if_measured(rig).items()}
    if found.valid_by is ValidBy.ABSOLUTE and not any(each.reachable for each in tried.values()):
        tried["valid_by: reference, if only the motion since the reference counts"] = msgspec.structs.replace(
            found, valid_by=ValidBy.REFERENCE
        )
    if tried and math.isfinite(found.median_excess):
        words, best = min(tried.items(), key=lambda each: each[1].median_excess)
        if best.median_excess < LEAST_HELP * found.median_excess:
            sizes = best.sizes
            return msgspec.structs.replace(found, helps=words, helped_m=sizes.median_m, helped_rad=sizes.median_rad)
    return msgspec.structs.replace(found, helps=_asked_for(found))


def _asked_for(found: Kept) -> str | None:
    """What would exclude the hypothesis that makes a bound as large."""
    hypothesis = found.hypothesis
    if not hypothesis:
        return None
    if hypothesis.startswith(Weigher.not_as_expected) and found.away_m is not None:
        seen = f"the gripper appears {_said(found.away_m, found.away_rad)} from the reference"
        return f"{seen}: calibrate again, correct the gripper file, or take the pose that gripmon teach prints"
    if hypothesis == NOTHING_WRONG:
        return "more of the fingers in the picture, nearer and in focus"
    if "grasped" in hypothesis:
        return "frames with nothing between the fingers"
    if "opening" in hypothesis:
        return "a jaw opening that is known better (monitor.jaw_sigma_m)"
    if "end" in hypothesis or "stand" in hypothesis or "tip" in hypothesis:
        return "all fingers' tips in the picture, with nothing over them"
    return "more edges of the fingers in the picture, so that none decides alone"


def doubted_edges(found: Kept, rig: Rig, cam_T_grip: Array) -> NDArray[np.bool_]:
    """(e,) which of the gripper's edges the hypothesis is about, seen from a pose (4, 4)."""
    return in_words(rig.gripper, cam_T_grip).meant(found.hypothesis, rig.gripper)
