"""Times in which something should not be relied on; the limits for this, from the recorded configuration; and how
large errors may have been, compared with them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from gripmon.analyse.content import AffectedRange, Displacement, Event, Integrity, Limits, Onset
from gripmon.analyse.events import MOTIONS
from gripmon.analyse.track import SECOND_NS, Track, displacement
from gripmon.analyse.words import COVERAGE
from gripmon.judge.policy import PolicySettings
from gripmon.model.records import Array
from gripmon.record.recordings import Recording
from gripmon.record.table import FrameTable

_MEDIAN_FRAMES = 9  # against the noise of single frames
_RELIEF = 0.8  # fraction of the limit below which a range ends
_SHORTEST_NS = SECOND_NS // 10
_MEANING = {
    "old_calibration": "Grasps and data that used the calibration from the beginning are off by up to this much. "
    "gripmon correct gives the transform for every instant.",
    "stale_reference": "What used the monitor's reference instead of its live transforms was off by up to this much.",
    "suspect": "Transforms were given as suspect: motions begun by them are doubtful.",
    "unknown": "No transform was given: what was done in this time was done without one.",
}


def motion_ranges(track: Track, events: Sequence[Event], limits: Limits) -> list[AffectedRange]:
    """When a calibration didn't hold: the one from the beginning and, if that was replaced, the one in force."""
    if not track.measured.any():
        return []
    motions = [event for event in events if event.kind in MOTIONS]
    kinds = [("old_calibration", track.against_first, np.zeros(len(track), np.int64))]
    if len(track.keys) > 1:
        kinds.append(("stale_reference", track.against_reference, track.reference))
    frame_ns = int(np.median(np.diff(track.stamp_ns))) if len(track) > 1 else 0
    begun_ns = min((event.onset.stamp_ns for event in motions), default=np.iinfo(np.int64).max)
    out: list[AffectedRange] = []
    for what, vectors, reference in kinds:
        before_ns = 0
        for first, last in _past(track, vectors, limits, reference, track.stamp_ns >= begun_ns):
            limit_ns = int(track.stamp_ns[first])
            causes_ns = [
                _as_early_as(event.onset, frame_ns)
                for event in motions
                if event.onset.stamp_ns <= limit_ns <= (event.end_ns or limit_ns) + SECOND_NS
            ]
            # If one motion causes two ranges, only the first begins with the motion.
            start_ns = min([limit_ns, *(at_ns for at_ns in causes_ns[-1:] if at_ns >= before_ns)])
            following = track.reference[last + 1 : last + 2]
            renewed = what == "stale_reference" and (following != track.reference[first]).any()
            out.append(
                msgspec.structs.replace(
                    _range(track, what, "recalibration" if renewed else "return", reference, first, last, start_ns),
                    limit_ns=limit_ns,
                    largest=_largest(track, vectors, first, last),
                )
            )
            before_ns = out[-1].end_ns
    return out


def _as_early_as(onset: Onset, frame_ns: int) -> int:
    """When a motion may have begun: where frames are missing, or nothing was measured, from the first of these on."""
    return min(onset.stamp_ns, onset.earliest_ns + frame_ns) if onset.found_by == "hindsight" else onset.stamp_ns


def verdict_ranges(track: Track, table: FrameTable) -> list[AffectedRange]:
    """When transforms were suspect or missing, for a tenth of a second or more."""
    out = []
    for name in ("suspect", "unknown"):
        mine = table.verdict == table.VERDICTS.index(name)
        for part in runs_of_equal(mine):
            if mine[part.start]:
                start_ns = int(track.stamp_ns[part.start])
                each = _range(track, name, "measured_again", track.reference, part.start, part.stop - 1, start_ns)
                out += [each] if each.end_ns - start_ns >= _SHORTEST_NS else []
    return out


def _range(
    track: Track, what: str, ended_by: str, reference: NDArray[np.int64], first: int, last: int, start_ns: int
) -> AffectedRange:
    """The frames from ``first`` to ``last``, and the time until the next one."""
    at_end = last >= len(track) - 1
    reference_id, revision = track.keys[int(reference[first])]
    return AffectedRange(
        what=what, start_ns=start_ns, limit_ns=None, end_ns=int(track.stamp_ns[last if at_end else last + 1]),
        ended_by="end_of_recording" if at_end else ended_by, reference_id=reference_id, revision=revision,
        frames=last - first + 1, meaning=_MEANING[what],
    )  # fmt: skip


def _past(
    track: Track, vectors: Array, limits: Limits, group: NDArray[np.int64], moved: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """First and last frame of each period beyond the limits, within one group each; it ends only with a frame that is
    clearly within them.  Before anything has ``moved`` (n,), it begins only where the excess is significant: if the
    uncertainty of a frame is as large as the limit, exceeding it means nothing.
    """
    frames = np.flatnonzero(track.measured)
    smooth = np.empty((len(frames), 6))
    pauses = np.cumsum(np.diff(track.stamp_ns[frames], prepend=0) > SECOND_NS)
    # A median must not mix two references, nor what is seconds apart.
    for part in runs_of_equal(group[frames] + len(track.keys) * pauses):
        smooth[part] = median_filter(vectors[frames[part]], size=(_MEDIAN_FRAMES, 1), mode="nearest")
    size = np.linalg.norm(smooth[:, :3], axis=1) / limits.affected_m
    turn = np.linalg.norm(smooth[:, 3:], axis=1) / limits.affected_rad
    excess = np.maximum(size, turn)
    significant = (size >= 1.0) & _significant(smooth[:, :3], track.sigma[frames, :3])
    significant |= (turn >= 1.0) & _significant(smooth[:, 3:], track.sigma[frames, 3:])
    significant |= moved[frames]
    out: list[tuple[int, int]] = []
    start: int | None = None
    for i, frame in enumerate(frames.tolist()):
        if start is not None and (excess[i] < _RELIEF or group[frame] != group[start]):
            out.append((start, frame - 1))
            start = None
        if start is None and excess[i] >= 1.0 and significant[i]:
            start = frame
    if start is not None:
        out.append((start, len(track) - 1))
    return [each for each in out if _lasts(track, *each)]


def _lasts(track: Track, first: int, last: int) -> bool:
    """Whether the measured frames of a period are more than a few outliers, or a second apart."""
    stamps_ns = track.stamp_ns[first : last + 1][track.measured[first : last + 1]]
    return len(stamps_ns) > _MEDIAN_FRAMES // 2 or int(np.ptp(stamps_ns)) >= SECOND_NS


def _significant(vectors: Array, sigma: Array) -> NDArray[np.bool_]:
    """(n,) which vectors (n, 3) are longer than :data:`COVERAGE` standard deviations (n, 3) along them."""
    along = np.linalg.norm(vectors * sigma, axis=1)
    return np.asarray(~(np.square(vectors).sum(axis=1) <= COVERAGE * along))  # also true where there is no deviation


def runs_of_equal(values: NDArray[np.int64] | NDArray[np.bool_]) -> list[slice]:
    """Slices over which a value stays the same."""
    cuts = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [slice(a, b) for a, b in itertools.pairwise(cuts) if b > a]


def _largest(track: Track, vectors: Array, first: int, last: int) -> Displacement:
    """The largest of the medians over a few frames each, robust against single outliers."""
    frames = first + np.flatnonzero(track.measured[first : last + 1])
    pauses = np.flatnonzero(np.diff(track.stamp_ns[frames]) > SECOND_NS) + 1
    parts = np.split(frames, pauses)
    blocks = [part[i : i + _MEDIAN_FRAMES] for part in parts for i in range(0, len(part), _MEDIAN_FRAMES)]
    blocks = [block for block in blocks if len(block) >= _MEDIAN_FRAMES // 2] or blocks
    levels = np.array([np.median(vectors[block], axis=0) for block in blocks])
    i = int(np.argmax(np.linalg.norm(levels[:, :3], axis=1)))
    return displacement(levels[i], np.median(track.sigma[blocks[i]], axis=0))


def limits_of(source: Recording, affected_m: float | None, affected_rad: float | None) -> Limits:
    """Limits from the recorded configuration; defaults if it names none or is missing.

    ``affected_m`` and ``affected_rad``: given by the user; None: the limits for a warning.
    """
    policy, origin = _policy(source)
    if affected_m is not None or affected_rad is not None:
        origin += "; what counts as affected was given with the command"
    names = ("warn_m", "warn_rad", "limit_m", "limit_rad", "alert_limit_m", "alert_limit_rad")
    return Limits(
        affected_m=policy.warn_m if affected_m is None else affected_m,
        affected_rad=policy.warn_rad if affected_rad is None else affected_rad,
        origin=origin,
        valid_by=policy.valid_by.value,
        **{name: getattr(policy, name) for name in names},
    )


def excess(size_m: float, turn_rad: float, limits: Limits) -> float:
    """Size over the limit for affected, the larger of shift and turn; NaN counts as zero."""
    parts = (size_m / limits.affected_m, turn_rad / limits.affected_rad)
    return max((part for part in parts if math.isfinite(part)), default=0.0)


def _policy(source: Recording) -> tuple[PolicySettings, str]:
    configuration = source.configuration
    file = None if configuration is None else configuration.files.get(configuration.main)
    if file is None:
        return PolicySettings(), "gripmon's defaults: the recording holds no configuration"
    try:
        document: Any = yaml.safe_load(file.data.decode("utf-8", "replace"))
        known = {field.name for field in msgspec.structs.fields(PolicySettings)}
        given = {k: v for k, v in ((document.get("monitor") or {}).get("policy") or {}).items() if k in known}
        return msgspec.convert(given, PolicySettings), "the recording's configuration"
    except (yaml.YAMLError, msgspec.ValidationError, AttributeError, TypeError, ValueError):
        return PolicySettings(), "gripmon's defaults: the recording's configuration can't be read"


def integrity_of(table: FrameTable, limits: Limits) -> Integrity | None:
    """The error bounds of one recording; None if no frame has any."""
    known = np.isfinite(table.protection_m) & np.isfinite(table.protection_rad)
    if not known.any() or limits.alert_limit_m is None or limits.alert_limit_rad is None:
        return None
    position_m, rotation_rad = table.protection_m[known], table.protection_rad[known]
    within = (position_m <= limits.alert_limit_m) & (rotation_rad <= limits.alert_limit_rad)
    total = int(table.seq[-1] - table.seq[0]) + 1
    median_m, p99_m = np.percentile(position_m, (50.0, 99.0)).tolist()
    median_rad, p99_rad = np.percentile(rotation_rad, (50.0, 99.0)).tolist()
    return Integrity(
        frames=int(known.sum()),
        valid=float((table.verdict == table.VERDICTS.index("valid")).sum() / total),
        within=float(within.sum() / total),
        median_m=median_m,
        p99_m=p99_m,
        median_rad=median_rad,
        p99_rad=p99_rad,
        risk=float(np.median(table.integrity_risk[known])),
    )
