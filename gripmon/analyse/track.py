"""The motion of the TCP over a recording, relative to the reference in force and to the first one; a clock that doesn't
run backwards; and the curves: for a long series the median and the bounds per piece of time, so that outliers remain
visible and pages stay small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.analyse.content import COVERAGE, Curve, Displacement, clock_time
from gripmon.model.records import Array, ReferenceRecord

if TYPE_CHECKING:
    from gripmon.record.table import FrameTable


_BASE_FRAMES = 20
_ALLOWED_SIGMA = 4.0  # as the monitor's own baseline


@dataclass(frozen=True, slots=True)
class Track:
    """Arrays over the n frames of a recording; (n, 6) are TCP shift (m) and turn (rad) in camera axes.

    ``measured`` (n,): the frame has its own transform, not a held one.  ``against_reference`` is relative to the
    reference that the frame names, ``against_first`` to the one in force at the beginning; both minus that first
    reference's own error, if it was configured and the first frames show an error within its uncertainty.  ``sigma``
    (n, 6): standard deviations.  NaN where nothing was measured.  ``error`` (6,): what was subtracted.
    """

    seq: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    measured: NDArray[np.bool_]
    against_reference: Array
    against_first: Array
    sigma: Array
    reference: NDArray[np.int64]
    error: Array

    def __len__(self) -> int:
        return len(self.seq)

    def index_at(self, stamp_ns: int) -> int:
        """Index of the first frame at or after a time; n if there is none."""
        return int(np.searchsorted(self.stamp_ns, stamp_ns))

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
    lengths, sigmas = [], []
    for part in (slice(0, 3), slice(3, 6)):
        size = float(np.linalg.norm(vector[part]))
        along = vector[part] / size if size > 0.0 else np.zeros(3)
        lengths.append(size)
        sigmas.append(float(np.sqrt(((along * sigma[part]) ** 2).sum())) if size > 0.0 else float(sigma[part].max()))
    x, y, z = vector[:3].tolist()
    return Displacement((x, y, z), lengths[0], sigmas[0], lengths[1], sigmas[1])


def make_track(
    table: FrameTable, references: Sequence[ReferenceRecord], known_error: Sequence[float] | None = None
) -> Track:
    """``known_error`` (6,): the configured reference's error as estimated by the monitor, if known."""
    seq, stamp_ns, poses = table.seq, table.stamp_ns, table.cam_T_grip
    held = table.source == table.ORIGINS.index("held")
    measured = np.isfinite(poses).all(axis=1) & ~held
    variances = np.diagonal(table.covariance, axis1=1, axis2=2)
    sigma = np.sqrt(np.maximum(variances, 0.0))
    sigma[~measured] = np.nan
    known = {(r.reference_id, r.revision): r for r in references}
    keys = list(zip(table.reference.tolist(), table.revision.tolist(), strict=True))
    distinct = list(dict.fromkeys(keys))
    number = np.array([distinct.index(key) for key in keys], np.int64) if keys else np.empty(0, np.int64)
    poses_of = [_pose_of(table, key, known, measured, number == i) for i, key in enumerate(distinct)]
    origins = np.array(poses_of).reshape(-1, 7)
    against_reference, against_first = np.full((2, len(seq), 6), np.nan)
    error: Array = np.zeros(6)
    if measured.any():
        against_reference[measured] = _between(origins[number[measured]], poses[measured])
        against_first[measured] = _between(np.broadcast_to(origins[0], (int(measured.sum()), 7)), poses[measured])
        first = known.get((table.reference_ids[distinct[0][0]], distinct[0][1]))
        error = _own_error(first, against_first[measured & (number == 0)], known_error)
        against_first -= error
        against_reference[number == 0] -= error
    return Track(seq, stamp_ns, measured, against_reference, against_first, sigma, number, error)


def _pose_of(
    table: FrameTable,
    key: tuple[int, int],
    known: dict[tuple[str, int], ReferenceRecord],
    measured: NDArray[np.bool_],
    mine: NDArray[np.bool_],
) -> Array:
    """(7,) of a reference; one that isn't recorded is inferred from its frames, the turn from the first ones only."""
    record = known.get((table.reference_ids[key[0]], key[1]))
    if record is not None:
        return np.array([*record.cam_T_grip.translation_m, *record.cam_T_grip.rotation_xyzw])
    frames = np.flatnonzero(mine & measured)[:_BASE_FRAMES]
    if not frames.size:
        return np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    pose = np.median(table.cam_T_grip[frames], axis=0)
    pose[:3] = np.median(table.cam_T_grip[frames, :3] - table.tcp_shift_m[frames], axis=0)
    return pose


def _between(from_poses: Array, to_poses: Array) -> Array:
    """(m, 6) from (m, 7) each: ``perturbation_between`` of the geometry, vectorised."""
    turn = Rotation.from_quat(to_poses[:, 3:]) * Rotation.from_quat(from_poses[:, 3:]).inv()
    return np.hstack([to_poses[:, :3] - from_poses[:, :3], turn.as_rotvec()])


def _own_error(first: ReferenceRecord | None, shifts: Array, known_error: Sequence[float] | None) -> Array:
    """(6,) the part of the shift that is the configured reference's own error, not drift."""
    if first is None or first.origin != "configuration" or not len(shifts):
        return np.zeros(6)
    if known_error is not None:
        return np.array(known_error)
    allowed = _ALLOWED_SIGMA * np.sqrt(np.maximum(np.reshape(first.covariance, (6, 6)).diagonal(), 0.0))
    median = np.median(shifts[:_BASE_FRAMES], axis=0)
    return np.asarray(median) if (np.abs(median) <= allowed).all() else np.zeros(6)


SECOND_NS = 1_000_000_000
_LONGEST_NS = 7 * 86400 * SECOND_NS  # longest pause within one run


@dataclass(frozen=True, slots=True)
class Clock:
    """Frame numbers ``seq`` (n,), ascending, and the times ``stamp_ns`` (n,) that the report uses."""

    seq: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]

    def of(self, seq: int, stamp_ns: int) -> int:
        """The time of an event: that of its frame, or if it belongs to none its own stamp, clipped to the frames' times
        if it is far outside.
        """
        i = int(np.searchsorted(self.seq, seq))
        if i < len(self.seq) and self.seq[i] == seq:
            own = int(self.stamp_ns[i])
            return own if abs(stamp_ns - own) > 3600 * SECOND_NS or stamp_ns < own else stamp_ns
        if not len(self.seq):
            return stamp_ns
        first, last = int(self.stamp_ns[0]), int(self.stamp_ns[-1])
        near = first - 3600 * SECOND_NS <= stamp_ns <= last + 3600 * SECOND_NS
        return stamp_ns if near else int(np.clip(stamp_ns, first, last))


def straightened(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> tuple[Clock, tuple[str, ...]]:
    """A clock in which time continues by one frame interval where the original was set back, or ahead by more than a
    week; and what was corrected, in words.
    """
    steps_ns = np.diff(stamp_ns.astype(np.float64))  # as integers, absurd stamps would overflow
    wrong = np.flatnonzero((steps_ns < 0.0) | (steps_ns > _LONGEST_NS))
    absurd = bool(len(stamp_ns)) and not 0 <= int(stamp_ns[0]) < 2**62
    if not wrong.size and not absurd:
        return Clock(seq, stamp_ns), ()
    sound = steps_ns[(steps_ns > 0.0) & (steps_ns <= _LONGEST_NS)]
    steps = np.diff(stamp_ns)
    steps[wrong] = int(np.median(sound)) if sound.size else SECOND_NS // 30
    out = (0 if absurd else int(stamp_ns[0])) + np.concatenate([np.zeros(1, np.int64), np.cumsum(steps)])
    faults = ["the first frame's time is absurd; times are shown from 1970 on"] if absurd else []
    if wrong.size:
        faults.append(_clock_fault(seq, stamp_ns, wrong.tolist(), 1e-9 * (float(out[-1]) - float(stamp_ns[-1]))))
    return Clock(seq, out), tuple(faults)


def _clock_fault(seq: NDArray[np.int64], stamp_ns: NDArray[np.int64], wrong: Sequence[int], off_s: float) -> str:
    i = wrong[0]
    by_s = 1e-9 * (float(stamp_ns[i + 1]) - float(stamp_ns[i]))
    how = f"runs backwards by {-by_s:.3f} s" if by_s < 0.0 else f"jumps ahead by {by_s:.0f} s"
    more = f" and {len(wrong) - 1} more times" if len(wrong) > 1 else ""
    late = f"{abs(off_s):.3f} s {'later' if off_s > 0.0 else 'earlier'} than stamped"
    return (
        f"time {how} at frame {int(seq[i + 1])} (after {clock_time(int(stamp_ns[i]))}){more}: from there on times are "
        f"shown as if the clock had gone on, at the end {late}"
    )


_PIECES = 1200
_DETAIL_NS = 2 * SECOND_NS  # every frame is shown on either side of a motion
_MOST_DETAIL = 2400  # frames


def curves_of(table: FrameTable, track: Track, moments_ns: Sequence[int]) -> tuple[Curve, ...]:
    """The TCP's displacement from the calibration at the beginning and from the reference in force, the latter's
    components, and the error bounds if recorded; with every frame around the given moments.
    """
    if not len(track):
        return ()
    cuts = pieces(track.stamp_ns, moments_ns)
    # For a length the largest sigma of any axis, since its direction changes from frame to frame.
    position, turn = (
        np.where(track.measured, track.sigma[:, part].max(axis=1), np.nan) for part in (slice(3), slice(3, 6))
    )
    shift = track.against_reference
    series = [
        ("tcp_from_beginning_m", np.linalg.norm(track.against_first[:, :3], axis=1), position),
        ("tcp_from_reference_m", np.linalg.norm(shift[:, :3], axis=1), position),
        *((f"{axis}_m", shift[:, i], track.sigma[:, i]) for i, axis in enumerate("xyz")),
        ("rotation_rad", np.linalg.norm(shift[:, 3:], axis=1), turn),
    ]
    bounds_of = ("protection", "since_reference", "absolute")
    for name in (f"{of}_{unit}" for of in bounds_of for unit in ("m", "rad")):
        bounds = getattr(table, name)
        if np.isfinite(bounds).any():
            series.append((name, bounds, np.zeros(len(bounds))))
    return tuple(_curve(name, track, cuts, values, sigma) for name, values, sigma in series)


def pieces(stamp_ns: NDArray[np.int64], moments_ns: Sequence[int]) -> NDArray[np.intp]:
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
    stops = [*cuts[1:].tolist(), len(track)]
    middle, stamps = [], []
    for start, stop in zip(cuts.tolist(), stops, strict=True):
        part = values[start:stop]
        part = part[np.isfinite(part)]
        middle.append(float(np.median(part)) if part.size else None)
        stamps.append(int(track.stamp_ns[start] + track.stamp_ns[stop - 1]) // 2)
    bounds = ([None if np.isnan(v) else v for v in some.tolist()] for some in (low, high))
    return Curve(name, tuple(stamps), tuple(middle), *(tuple(some) for some in bounds))
