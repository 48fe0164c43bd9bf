"""What the runs come to: final distances, what was worse than with the truth, and whether anybody broke the rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from benchmarks.kit import Target

from gripmon.model.records import Array, Verdict
from servoing.runs import GRIPMON, SMOOTHED, SOURCES, TRUTH, WITHOUT, Run, Track

WORSE_M = 5e-5
"""To reach: an arm that follows the monitor ends no farther from the object than this beyond the one by the truth."""

MONITORED = (GRIPMON, SMOOTHED)
LABELS = {
    WITHOUT: "without gripmon",
    GRIPMON: "gripmon",
    SMOOTHED: "gripmon, smoothed",
    TRUTH: "truth",
}


@dataclass(frozen=True)
class Conduct:
    """Breaches of the rules by one arm in one run, from its joints and the verdicts on the wire alone.

    ``unknown``: frames with that verdict while the fingers were open; ``moved_on_unknown``: those of them from which to
    the next one a joint turned.  ``begun_unsure``: motions that began by a transform that was not valid;
    ``closed_unsure``: fingers that closed by one.
    """

    unknown: int
    moved_on_unknown: int
    begun_unsure: int
    closed_unsure: int

    @property
    def breaches(self) -> int:
        return self.moved_on_unknown + self.begun_unsure + self.closed_unsure


def conduct(run: Run, track: Track) -> Conduct:
    """How an arm behaved by the monitor's verdicts, whether it listened to them or not."""
    valid = np.array([verdict is Verdict.VALID for verdict in run.verdict])
    unknown = np.array([verdict is Verdict.UNKNOWN for verdict in run.verdict])[:-1] & ~np.array(track.grasped[:-1])
    moved = track.moved()
    begun = moved & ~np.concatenate([[False], moved[:-1]])
    closed = np.flatnonzero(np.diff(np.array(track.grasped, dtype=int)) == 1) + 1
    return Conduct(
        unknown=int(unknown.sum()),
        moved_on_unknown=int((unknown & moved).sum()),
        begun_unsure=int((begun & ~valid[:-1]).sum()),
        closed_unsure=int((~valid[closed]).sum()),
    )


@dataclass(frozen=True)
class Figures:
    """One source in one row, m; the arrays hold a value a run.

    ``across_m`` and ``along_m``: parts of ``final_m`` across the optical axis and along it.
    """

    row: str
    source: str
    final_m: Array
    across_m: Array
    along_m: Array
    worse_m: Array
    grasped: int
    conduct: tuple[Conduct, ...]
    stopped_by_range: int

    @property
    def runs(self) -> int:
        return len(self.final_m)


def figures(runs: Sequence[Run]) -> list[Figures]:
    """All sources of all rows, in their order."""
    rows = dict.fromkeys(run.row.name for run in runs)
    return [_of([run for run in runs if run.row.name == row], source) for row in rows for source in SOURCES]


def _of(runs: Sequence[Run], source: str) -> Figures:
    tracks = [run.tracks[source] for run in runs]
    truth_m = np.array([run.tracks[TRUTH].distance_m[-1] for run in runs])
    final_m = np.array([track.distance_m[-1] for track in tracks])
    off_m = np.array([track.off_m[-1] for track in tracks])
    return Figures(
        row=runs[0].row.name,
        source=source,
        final_m=final_m,
        across_m=np.hypot(off_m[:, 0], off_m[:, 1]),
        along_m=np.abs(off_m[:, 2]),
        worse_m=final_m - truth_m,
        grasped=sum(track.grasped[-1] for track in tracks),
        conduct=tuple(conduct(run, track) for run, track in zip(runs, tracks, strict=True)),
        stopped_by_range=sum(track.stopped_by_range for track in tracks),
    )


def targets(every: Sequence[Figures]) -> list[Target]:
    """Of the arms that follow the monitor; a rule that no frame put to the test is not met."""
    followed = [each for each in every if each.source in MONITORED]
    runs, grasped = sum(each.runs for each in followed), sum(each.grasped for each in followed)
    out = []
    for source in MONITORED:
        worst_m = max(float(each.worse_m.max()) for each in followed if each.source == source)
        what = f"{LABELS[source]}: at most {1e3 * WORSE_M:g} mm worse than with truth, in every run"
        out.append(Target(what, f"{1e3 * worst_m:.3f} mm", worst_m <= WORSE_M))
    out.append(Target("the object is grasped in every run", f"{grasped} of {runs}", grasped == runs))
    conducts = [each for figure in followed for each in figure.conduct]
    unknown, moved = sum(c.unknown for c in conducts), sum(c.moved_on_unknown for c in conducts)
    out.append(Target("no move on unknown", f"{moved} in {unknown} frames", moved == 0 and unknown > 0))
    unsure = sum(c.begun_unsure + c.closed_unsure for c in conducts)
    out.append(Target("no motion begun, no finger closed by what is not valid", f"{unsure}", unsure == 0))
    return out


def renewed_on_the_way(run: Run) -> bool:
    """Did the reference change while an arm that follows the monitor was still at it?"""
    open_frames = [not all(closed) for closed in zip(*(run.tracks[s].grasped for s in MONITORED), strict=True)]
    return len({revision for revision, still in zip(run.revision, open_frames, strict=True) if still}) > 1
