"""The motion of the TCP over a recording, relative to the reference in force and to the first one, on a clock that
doesn't run backwards; and its curves: for a long series the median and the bounds per piece of time, so that outliers
remain visible and pages stay small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.analyse.content import Curve, Displacement
from gripmon.analyse.vectors import to_vectors
from gripmon.analyse.words import COVERAGE, clock_time
from gripmon.judge.drift import Baseline
from gripmon.model.geometry import from_record
from gripmon.model.records import Array, ReferenceRecord

if TYPE_CHECKING:
    from gripmon.record.table import FrameTable

Key = tuple[str, int]
"""Id and revision of a reference."""
SECOND_NS = 1_000_000_000
_NEAR_NS = 3600 * SECOND_NS  # from the frames: an event's own time is believed
_LONGEST_NS = 7 * 86400 * SECOND_NS  # longest pause within one run
_BASE_FRAMES = 20
_PIECES = 1200
_DETAIL_NS = 2 * SECOND_NS  # every frame is shown on either side of a motion
_MOST_DETAIL = 2400  # frames


@dataclass(frozen=True, slots=True)
class Track:
    """Arrays over the n frames of a recording; (n, 6) are TCP shift (m) and turn (rad) in camera axes.

    ``stamp_ns`` never falls; ``faults``: what was corrected of it, in words.  ``measured`` (n,): the frame has its own
    transform, not a held one.  ``against_reference`` is relative to the reference that the frame names, ``keys`` [
    ``reference`` ], ``against_first`` to the first of these; both minus that first reference's own error, if it was
    configured and the first frames show an error within its uncertainty.  ``sigma`` (n, 6): standard deviations.  NaN
    where nothing was measured.
    """

    seq: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    faults: tuple[str, ...]
    measured: NDArray[np.bool_]
    against_reference: Array
    against_first: Array
    sigma: Array
    reference: NDArray[np.int64]
    keys: tuple[Key, ...]

    def __len__(self) -> int:
        return len(self.seq)

    def index_at(self, stamp_ns: int) -> int:
        """Index of the first frame at or after a time; n if there is none."""
        return int(np.searchsorted(self.stamp_ns, stamp_ns))

    def time_of(self, seq: int, stamp_ns: int) -> int:
        """The time of an event: its own if that is near its frame's, or to all frames if it belongs to none."""
        if not len(self):
            return stamp_ns
        i = int(np.searchsorted(self.seq, seq))
        if i < len(self) and self.seq[i] == seq:
            own = int(self.stamp_ns[i])
            return stamp_ns if own <= stamp_ns <= own + _NEAR_NS else own
        first, last = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        return stamp_ns if first - _NEAR_NS <= stamp_ns <= last + _NEAR_NS else min(max(stamp_ns, first), last)

    def in_force_ns(self) -> dict[Key, int]:
        """From when on each reference was in force, in order."""
        return {key: int(self.stamp_ns[np.argmax(self.reference == i)]) for i, key in enumerate(self.keys)}

    def displacement(self, vectors: Array, of: NDArray[np.intp]) -> Displacement | None:
        """Median of ``vectors`` (n, 6) over some frames (indices), with the median uncertainty of a frame."""
        of = of[self.measured[of]]
        if not of.size:
            return None
        return displacement(np.median(vectors[of], axis=0), np.median(self.sigma[of], axis=0))


def displacement(vector: Array, sigma: Array) -> Displacement:
    """From a vector (6,) with standard deviations (6,); that of a length is along its direction, the largest if the
    length is zero.
    """
    sizes: list[float] = []
    for part in (slice(0, 3), slice(3, 6)):
        size = float(np.linalg.norm(vector[part]))
        along = float(np.linalg.norm(vector[part] * sigma[part])) / size if size > 0.0 else float(sigma[part].max())
        sizes += [size, along]
    x, y, z = vector[:3].tolist()
    return Displacement((x, y, z), *sizes)


def make_track(
    table: FrameTable, references: Sequence[ReferenceRecord], known_error: Sequence[float] | None = None
) -> Track:
    """``known_error`` (6,): the configured reference's error as estimated by the monitor, if known."""
    poses = table.matrices()
    measured = table.measured
    sigma = np.sqrt(np.maximum(np.diagonal(table.covariance, axis1=1, axis2=2), 0.0))
    sigma[~measured] = np.nan
    named = list(zip(table.reference.tolist(), table.revision.tolist(), strict=True))
    place = {key: i for i, key in enumerate(dict.fromkeys(named))}
    number = np.array([place[key] for key in named], np.int64)
    keys = tuple((table.reference_ids[reference], revision) for reference, revision in place)
    records = {(r.reference_id, r.revision): r for r in references}
    against_reference, against_first = np.full((2, len(table), 6), np.nan)
    for i, key in enumerate(keys):
        mine = np.flatnonzero(measured & (number == i))
        record = records.get(key)
        origin_T = _inferred_T(table, poses, mine[:_BASE_FRAMES]) if record is None else from_record(record.cam_T_grip)
        against_reference[mine] = to_vectors(origin_T, poses[mine])
        if i == 0:
            against_first[measured] = to_vectors(origin_T, poses[measured])
    if measured.any():
        error = _own_error(records.get(keys[0]), against_first[measured & (number == 0)], known_error)
        against_first -= error
        against_reference[number == 0] -= error
    stamp_ns, faults = _straightened(table.seq, table.stamp_ns)
    return Track(table.seq, stamp_ns, faults, measured, against_reference, against_first, sigma, number, keys)


def _inferred_T(table: FrameTable, poses: Array, first: NDArray[np.intp]) -> Array:
    """(4, 4) of a reference that isn't recorded, by its first frames and their drift; the turn is theirs."""
    if not first.size:
        return np.eye(4)
    pose = np.eye(4)
    middle = Rotation.from_matrix(poses[first, :3, :3]).mean()
    away = (Rotation.from_matrix(poses[first, :3, :3]) * middle.inv()).as_rotvec()
    pose[:3, :3] = (Rotation.from_rotvec(np.median(away, axis=0)) * middle).as_matrix()
    pose[:3, 3] = np.median(table.cam_T_grip[first, :3] - table.tcp_shift_m[first], axis=0)
    return pose


def _own_error(first: ReferenceRecord | None, shifts: Array, known_error: Sequence[float] | None) -> Array:
    """(6,) the part of the shift that is the configured reference's own error, not drift."""
    if first is None or first.origin != "configuration" or not len(shifts):
        return np.zeros(6)
    if known_error is not None:
        return np.array(known_error)
    sigma = np.sqrt(np.maximum(np.reshape(first.covariance, (6, 6)).diagonal(), 0.0))
    begun = shifts[:_BASE_FRAMES]
    baseline = Baseline(sigma, len(begun))  # as the monitor's own
    for shift in begun:
        baseline.subtract(shift)
    return np.zeros(6) if baseline.error is None else baseline.error


def _straightened(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Times that go on by one frame interval where the original was set back, or ahead by more than a week; and what
    was corrected, in words.
    """
    steps_ns = np.diff(stamp_ns.astype(np.float64))  # as integers, absurd stamps would overflow
    wrong = np.flatnonzero((steps_ns < 0.0) | (steps_ns > _LONGEST_NS))
    absurd = bool(len(stamp_ns)) and not 0 <= int(stamp_ns[0]) < 2**62
    if not wrong.size and not absurd:
        return stamp_ns, ()
    sound = steps_ns[(steps_ns > 0.0) & (steps_ns <= _LONGEST_NS)]
    steps = np.diff(stamp_ns)
    steps[wrong] = int(np.median(sound)) if sound.size else SECOND_NS // 30
    out = (0 if absurd else int(stamp_ns[0])) + np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])
    faults = ["the first frame's time is absurd; times are shown from 1970 on"] if absurd else []
    if wrong.size:
        i = int(wrong[0])
        by_s, late_s = 1e-9 * float(steps_ns[i]), 1e-9 * (float(out[-1]) - float(stamp_ns[-1]))
        how = f"runs backwards by {-by_s:.3f} s" if by_s < 0.0 else f"jumps ahead by {by_s:.0f} s"
        more = f" and {len(wrong) - 1} more times" if len(wrong) > 1 else ""
        faults.append(
            f"time {how} at frame {int(seq[i + 1])} (after {clock_time(int(stamp_ns[i]))}){more}: from there on times "
            f"are shown as if the clock had gone on, at the end {abs(late_s):.3f} s "
            f"{'later' if late_s > 0.0 else 'earlier'} than stamped"
        )
    return out, tuple(faults)


def curves_of(table: FrameTable, track: Track, moments_ns: Sequence[int]) -> tuple[Curve, ...]:
    """The TCP's displacement from the calibration at the beginning and from the reference in force, the latter's
    components, and the error bounds if recorded; with every frame around the given moments.
    """
    if not len(track):
        return ()
    cuts = _pieces(track.stamp_ns, moments_ns)
    # For a length the largest sigma of any axis, since its direction changes from frame to frame.
    position, turn = track.sigma[:, :3].max(axis=1), track.sigma[:, 3:].max(axis=1)
    shift = track.against_reference
    series = [
        ("tcp_from_beginning_m", np.linalg.norm(track.against_first[:, :3], axis=1), position),
        ("tcp_from_reference_m", np.linalg.norm(shift[:, :3], axis=1), position),
        *((f"{axis}_m", shift[:, i], track.sigma[:, i]) for i, axis in enumerate("xyz")),
        ("rotation_rad", np.linalg.norm(shift[:, 3:], axis=1), turn),
    ]
    names = (f"{of}_{unit}" for of in ("protection", "since_reference", "absolute") for unit in ("m", "rad"))
    bounds = ((name, getattr(table, name)) for name in names)
    series += [(name, values, np.zeros(len(values))) for name, values in bounds if np.isfinite(values).any()]
    return tuple(_curve(name, track, cuts, values, sigma) for name, values, sigma in series)


def _pieces(stamp_ns: NDArray[np.int64], moments_ns: Sequence[int]) -> NDArray[np.intp]:
    """(k,) ascending indices where pieces begin, the first 0: every frame if there are few; otherwise equal times, with
    every frame around the given moments, and a new piece after every pause.
    """
    n = len(stamp_ns)
    if n <= 2 * _PIECES:
        return np.arange(n)
    edges = stamp_ns[0] + np.linspace(0, int(stamp_ns[-1] - stamp_ns[0]), _PIECES, endpoint=False).astype(np.int64)
    cuts = [np.searchsorted(stamp_ns, edges), np.flatnonzero(np.diff(stamp_ns) > SECOND_NS) + 1]
    room = _MOST_DETAIL
    for moment_ns in moments_ns:
        start, stop = np.searchsorted(stamp_ns, [moment_ns - _DETAIL_NS, moment_ns + _DETAIL_NS]).tolist()
        if stop - start <= room:
            cuts.append(np.arange(start, stop))
            room -= stop - start
    joined = np.unique(np.concatenate([[0], *cuts]))
    return joined[joined < n]


def _curve(name: str, track: Track, cuts: NDArray[np.intp], values: Array, sigma: Array) -> Curve:
    low = np.fmin.reduceat(values - COVERAGE * sigma, cuts)
    high = np.fmax.reduceat(values + COVERAGE * sigma, cuts)
    parts = [part[np.isfinite(part)] for part in np.split(values, cuts[1:])]
    middle = [float(np.median(part)) if part.size else None for part in parts]
    last = np.append(cuts[1:], len(track)) - 1
    stamps = [(a + b) // 2 for a, b in zip(track.stamp_ns[cuts].tolist(), track.stamp_ns[last].tolist(), strict=True)]
    bounds = (tuple(None if np.isnan(v) else v for v in some.tolist()) for some in (low, high))
    return Curve(name, tuple(stamps), tuple(middle), *bounds)
