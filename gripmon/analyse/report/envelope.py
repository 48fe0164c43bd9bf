"""Long series, short: per piece of time the median and the bounds, so that no outlier is lost and pages stay small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.report.clock import SECOND_NS
from gripmon.analyse.report.content import Curve
from gripmon.analyse.report.formats import COVERAGE
from gripmon.analyse.report.track import Track
from gripmon.model.records import Array

if TYPE_CHECKING:
    from gripmon.record.read import FrameTable

_PIECES = 1200
_DETAIL_NS = 2 * SECOND_NS  # on either side of a motion every frame is shown
_MOST_DETAIL = 2400  # frames


def curves_of(table: FrameTable, track: Track, moments_ns: Sequence[int]) -> tuple[Curve, ...]:
    """The TCP's way from the calibration at the beginning and from the reference in force, and that one's parts; with
    every frame around some moments; and the bounds on errors, where the recording has them.
    """
    if not len(track):
        return ()
    cuts = pieces(track.stamp_ns, moments_ns)
    # Of a length the largest along any axis: its own direction changes from frame to frame.
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
    for name in ("protection_m", "protection_rad"):
        bounds = getattr(table, name)
        if np.isfinite(bounds).any():
            series.append((name, bounds, np.zeros(len(bounds))))
    return tuple(_curve(name, track, cuts, values, sigma) for name, values, sigma in series)


def pieces(stamp_ns: NDArray[np.int64], moments_ns: Sequence[int]) -> NDArray[np.intp]:
    """(k,) ascending indices where a new piece begins, the first 0: every frame, if there are few; else equal times,
    with every frame around some moments, and a new piece after every pause.
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
