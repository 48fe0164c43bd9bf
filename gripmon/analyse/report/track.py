"""The motion of the TCP through a recording, against the reference in force and against the first one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.analyse.report.content import Displacement
from gripmon.model.records import Array, ReferenceRecord

if TYPE_CHECKING:
    from gripmon.record.read import FrameTable

_BASE_FRAMES = 20
_ALLOWED_SIGMA = 4.0  # as the monitor's own baseline


@dataclass(frozen=True, slots=True)
class Track:
    """Arrays over the n frames of a recording; (n, 6) are TCP shift (m) and turn (rad) in camera axes.

    ``measured`` (n,): the frame has a transform of its own, which isn't held.  ``against_reference`` is reckoned from
    the reference that the frame names, ``against_first`` from the one in force at the beginning; both less that first
    one's own error, if it is a configured one and the first frames show it within its uncertainty.  ``sigma`` (n, 6)
    standard deviations.  NaN where nothing was measured.  ``error`` (6,) is what was subtracted.
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
        """Of the first frame at or after a time; n if there is none."""
        return int(np.searchsorted(self.stamp_ns, stamp_ns))

    def displacement(self, vectors: Array, of: NDArray[np.intp]) -> Displacement | None:
        """Median over some frames (indices) of (n, 6) ``vectors``, with what a frame's transform is uncertain by."""
        of = of[self.measured[of]]
        if not of.size:
            return None
        return displacement(np.median(vectors[of], axis=0), np.median(self.sigma[of], axis=0))


def displacement(vector: Array, sigma: Array) -> Displacement:
    """From (6,) with its standard deviations (6,); that of a length is the one along its direction, the largest where
    it has none.
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
    """``known_error`` (6,): what the monitor itself took for the configured reference's error, where that is known."""
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
    """(7,) of a reference; of one that isn't recorded what its own frames say: the turn only from the first of them."""
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
    """(m, 6) from (m, 7) each: ``perturbation_between`` of the geometry, for many."""
    turn = Rotation.from_quat(to_poses[:, 3:]) * Rotation.from_quat(from_poses[:, 3:]).inv()
    return np.hstack([to_poses[:, :3] - from_poses[:, :3], turn.as_rotvec()])


def _own_error(first: ReferenceRecord | None, shifts: Array, known_error: Sequence[float] | None) -> Array:
    """(6,) the part of the shift that an inexact configured reference explains: no drift."""
    if first is None or first.origin != "configuration" or not len(shifts):
        return np.zeros(6)
    if known_error is not None:
        return np.array(known_error)
    allowed = _ALLOWED_SIGMA * np.sqrt(np.maximum(np.reshape(first.covariance, (6, 6)).diagonal(), 0.0))
    median = np.median(shifts[:_BASE_FRAMES], axis=0)
    return np.asarray(median) if (np.abs(median) <= allowed).all() else np.zeros(6)
