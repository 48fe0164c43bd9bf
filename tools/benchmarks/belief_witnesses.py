"""What the fingers' ends answer at right and at wrong places: the tables that the belief weighs its witness with.

In frames of scenes of ``tools/bench integrity`` whose gripper is as its file says, it is measured from its true place,
and from places farther along its fingers, where only its ends could tell.  What settles there and shows edges at the
ends is a fit of something else.
"""

from __future__ import annotations

import sys
from collections import Counter
from typing import NamedTuple

import numpy as np

from benchmarks import integrity_runs as runs
from benchmarks.integrity_scenes import make_integrity_scene
from gripmon.model.poses import perturb
from gripmon.monitor.tracker import USUAL_SHARE, Tracker
from gripmon.track.edges import FingertipMeter, Measurement, Patience, edges_at_ends

SLIDES_M = (0.0, -8e-3, -4e-3, -2e-3, 2e-3, 4e-3, 8e-3)
RIGHT_M, WRONG_M = 0.3e-3, 1e-3
EVERY = 8
"""Frames: between those the background has moved on."""
_NARROW = Patience(when_doubtful=False, when_lost=False)


class Answer(NamedTuple):
    """Of one fit: whether it is ``right``, and each finger's indications of an end, 0 to 2; -1 out of view."""

    right: bool
    seen: tuple[int, ...]


def answers(name: str, seed: int, number: int, frames: int) -> list[Answer]:
    """All fits of a scene that show edges at the fingers' ends."""
    watched = runs._simulated(make_integrity_scene(runs._BY_NAME[name], seed, number, frames))
    tracker = Tracker(watched.camera, watched.gripper, runs._settings(watched))
    across = edges_at_ends(watched.gripper) & ~tracker.along
    out = []
    for index, look in enumerate(watched.looks):
        if index % EVERY or not isinstance(look.frame.image, np.ndarray) or not tracker.finger_axis.any():
            continue
        axis = look.cam_T_grip[:3, :3] @ tracker.finger_axis
        for slide_m in SLIDES_M:
            meter: FingertipMeter = tracker._meter
            start_T = perturb(look.cam_T_grip, np.append(slide_m * axis, np.zeros(3)))
            opening_m = tracker._opening_m(look.frame)
            fit: Measurement = meter.measure(look.frame.image, start_T, opening_m, USUAL_SHARE, _NARROW)
            if not fit.trusted or not fit.consensus.edge_seen[across].any():
                continue
            off_m = fit.cam_T_grip[:3, 3] - look.cam_T_grip[:3, 3]
            right, wrong = np.linalg.norm(off_m) <= RIGHT_M, abs(off_m @ axis) >= WRONG_M
            if not (right or wrong):
                continue
            ends = tracker.ends(look.frame, fit)
            seen = np.where(ends.might > 0, np.minimum(ends.seen, 2), -1)
            out.append(Answer(bool(right), tuple(seen.tolist())))
    return out


def names() -> list[str]:
    """Conditions whose gripper is as its file says."""
    return [name for name, condition in runs._BY_NAME.items() if condition.enough]


def measured(seed: int, frames: int) -> list[Answer]:
    """One scene of each condition."""
    from tqdm import tqdm

    bar = tqdm(names(), desc="witnesses", unit="scene", file=sys.stderr, disable=None)
    return [answer for name in bar for answer in answers(name, seed, 0, frames)]


def table(every: list[Answer]) -> str:
    """By number of fingers in view: how often each answer is given at right and at wrong places."""
    counts = {right: Counter(tuple(sorted(a.seen)) for a in every if a.right == right) for right in (True, False)}
    totals = {right: sum(of.values()) for right, of in counts.items()}
    lines = [f"{totals[True]} right fits, {totals[False]} wrong ones", "", "| indications | right | wrong |"]
    lines.append("| --- | --- | --- |")
    for seen in sorted({*counts[True], *counts[False]}):
        cells = (f"{counts[r][seen]} ({100.0 * counts[r][seen] / max(totals[r], 1):.2f} %)" for r in (True, False))
        lines.append(f"| {', '.join(map(str, seen))} | {' | '.join(cells)} |")
    return "\n".join(lines)
