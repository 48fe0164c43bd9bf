"""Back on track after the camera was knocked, and never at a wrong place.

Knocks the simulated camera about at random, up to 10 mm at the TCP and 4 degrees in any direction, and counts in how
many frames the monitor is back on track: three grippers, each before a camera of its own, at random poses and jaw
openings, before six kinds of background that move on.  Every other trial begins with an estimate that is wrong from
the first frame on, the others jump while the monitor tracks.  Further rows: frames of the rendered sequences beside
the checkout, if they are there, from wrong starts; jumps of twice the size; views without any gripper.
Back on track: a measured transform whose TCP is less than 0.2 mm from the truth; found: less than 1 mm.  Bounds are
one-sided with 95 % confidence (Clopper and Pearson).  Takes some ten minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import jumps, kit, rendered
from benchmarks.drawn import reference_record
from benchmarks.kit import Report
from gripmon.model.camera import Camera
from gripmon.model.geometry import perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Frame, FrameRecord, Origin, Verdict
from gripmon.monitor import Monitor, MonitorSettings

TRACK_M, FOUND_M = 2e-4, 1e-3
"""Errors of the TCP below which the monitor is back on track, and has found the gripper."""
BEFORE, AFTER, BEYOND_AFTER = 4, 8, 45
"""Frames before a jump, and after it; after one of twice the size."""
PER_SCENE = 10
_START_SIGMA = np.array([2e-4] * 3 + [2e-3] * 3)
_RENDERED = {"clean": False, "static_background": True, "jaw_cycle": True, "series2": False}
"""Sequences, and whether their frames follow each other; unrelated ones are shown several times."""


@dataclass(frozen=True)
class Outcome:
    """One trial: frame (from 1) in which the gripper was found, and in which the monitor was back on track, None for
    never; frames that were valid and further off than 1 mm, and than 0.2 mm; whether any measured frame, valid or
    not, was further off than 1 mm; times of the frames until found, ms.
    """

    found: int | None
    back: int | None
    valid: int
    lies: int
    inexact: int
    astray: bool
    searched_ms: tuple[float, ...]


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    for name, default, what in (
        ("trials", 1080, "jumps within 10 mm and 4 degrees"),
        ("beyond", 180, "jumps of up to twice that"),
        ("absent", 180, "views without the gripper"),
    ):
        text = f"{what}, {PER_SCENE} a scene (default {default})"
        parser.add_argument(f"--{name}", type=kit.count, default=default, metavar="N", help=text)


def run(arguments: argparse.Namespace, report: Report) -> None:
    seed = arguments.seed
    kinds = (("", arguments.trials), ("beyond", arguments.beyond), ("absent", arguments.absent))
    scenes = [(kind, place) for kind, trials in kinds for place in range(trials // PER_SCENE)]
    rows: dict[str, list[Outcome]] = {}
    for kind, place in kit.progress(scenes, "scene"):
        rig, background = jumps.combination(place)
        scene = jumps.scene(rig, background, [seed, len(kind), place], PER_SCENE, kind)
        rows.setdefault(kind or background, []).extend(_trial(scene, index, kind) for index in range(PER_SCENE))
    rows |= _rendered(seed)
    report.values |= {"seed": seed, "rows": rows}
    show(rows, seed, report)


def _trial(scene: jumps.Scene, index: int, kind: str) -> Outcome:
    """The camera jumps while the monitor tracks, or (odd trials, and without a gripper) is elsewhere from the start."""
    while_tracking = kind != "absent" and index % 2 == 0
    after = BEYOND_AFTER if kind == "beyond" else AFTER
    trial = scene.trial(index, BEFORE if while_tracking else 0, after)
    process = _monitor(scene.camera, scene.rig.gripper, trial.before_cam_T_grip)
    for frame in trial.before:
        process(frame)
    return _watch(process, trial.after, None if kind == "absent" else [trial.after_cam_T_grip] * after)


def _monitor(camera: Camera, gripper: Gripper, cam_T_grip: Array) -> Callable[[Frame], FrameRecord]:
    start = reference_record(cam_T_grip, np.diag(_START_SIGMA**2))
    return Monitor(camera, gripper, MonitorSettings(), start).process


def _watch(process: Callable[[Frame], FrameRecord], frames: Sequence[Frame], truths: Sequence[Array] | None) -> Outcome:
    """``truths``: poses of the gripper, None if there is none in view."""
    found = back = None
    valid = lies = inexact = 0
    astray = False
    searched_ms = []
    for number, frame in enumerate(frames, 1):
        start = time.perf_counter()
        record = process(frame)
        if found is None:
            searched_ms.append(1e3 * (time.perf_counter() - start))
        if record.cam_T_grip is None or record.source is Origin.HELD:
            continue
        error_m = np.inf
        if truths is not None:
            error_m = float(np.linalg.norm(np.array(record.cam_T_grip.translation_m) - truths[number - 1][:3, 3]))
        found = found or (number if error_m < FOUND_M else None)
        back = back or (number if error_m < TRACK_M else None)
        astray |= error_m > FOUND_M
        if record.verdict is Verdict.VALID:
            valid, lies, inexact = valid + 1, lies + (error_m > FOUND_M), inexact + (error_m > TRACK_M)
    return Outcome(found, back, valid, lies, inexact, astray, tuple(searched_ms))


def _rendered(seed: int) -> dict[str, list[Outcome]]:
    """A wrong start at each frame."""
    rows: dict[str, list[Outcome]] = {}
    rng = np.random.default_rng([seed, 99])
    for name, together in _RENDERED.items():
        for sequence in rendered.sequences(f"rendered {name}"):
            shots = list(sequence.shots())
            for first in range(len(shots)):
                chosen = [shots[min(first + k, len(shots) - 1) if together else first] for k in range(5)]
                frames = [jumps.restamped(shot.frame, k) for k, shot in enumerate(chosen)]
                process = _monitor(
                    sequence.camera, sequence.gripper, perturb(chosen[0].cam_T_grip, jumps.draw(rng, 1)[0])
                )
                outcome = _watch(process, frames, [shot.cam_T_grip for shot in chosen])
                rows.setdefault(f"rendered {name}", []).append(outcome)
    return rows


def show(rows: dict[str, list[Outcome]], seed: int, report: Report) -> None:
    """A line for each background and sequence, all together, and what was to be reached."""
    within = [o for name, own in rows.items() if name not in ("beyond", "absent") for o in own]
    simulated = [o for name, own in rows.items() if not name.startswith(("beyond", "absent", "rendered")) for o in own]
    lines = {name: own for name, own in rows.items() if name != "absent"}
    lines |= {"all simulated": simulated, "all within 10 mm and 4°": within}
    head = (
        "", "trials", "found in frame 1", "2", "5", "on track in 5", "at least", "valid, >1 mm", "at most",
        "valid, >0.2 mm", "searching, ms: median", "99 %",
    )  # fmt: skip
    report.say(f"seed {seed}", kit.table(head, [[name, *_cells(own)] for name, own in lines.items()]))
    if "beyond" in rows:
        late = sum(o.found is not None for o in rows["beyond"])
        report.say(f"beyond: {late} of {len(rows['beyond'])} found within {BEYOND_AFTER} frames")
    if "absent" in rows:
        absent = rows["absent"]
        measured, valid = sum(o.astray for o in absent), sum(o.valid for o in absent)
        report.say(
            f"without a gripper: something was measured in {measured} of {len(absent)} views of {AFTER} frames "
            f"(at most {kit.percent(kit.at_most(measured, len(absent)), 2)} %); valid in {valid} of "
            f"{len(absent) * AFTER} frames"
        )
    if within:
        back, lies = _back(within), sum(o.lies > 0 for o in within)
        report.reach(
            [
                ("back on track within 5 frames in 99 % of trials", f"{kit.percent(back / len(within), 2)} %",
                 back >= 0.99 * len(within)),
                ("confident at a wrong place in less than 0.1 % of trials", f"{lies} of {len(within)}",
                 lies < 1e-3 * len(within)),
            ]
        )  # fmt: skip


def _back(outcomes: list[Outcome]) -> int:
    return sum(o.back is not None and o.back <= 5 for o in outcomes)


def _cells(outcomes: list[Outcome]) -> list[object]:
    count = len(outcomes)
    if not count:
        return [0]
    found = [sum(o.found is not None and o.found <= k for o in outcomes) for k in (1, 2, 5)]
    back, lies = _back(outcomes), sum(o.lies > 0 for o in outcomes)
    valid, inexact = sum(o.valid for o in outcomes), sum(o.inexact for o in outcomes)
    times = np.concatenate([o.searched_ms for o in outcomes])
    parts = (*(k / count for k in found), back / count, kit.at_least(back, count))
    shares = [f"{kit.percent(part)} %" for part in parts]
    beyond = [lies, f"{kit.percent(kit.at_most(lies, count), 2)} %", f"{kit.percent(inexact / max(valid, 1))} %"]
    return [count, *shares, *beyond, *(f"{np.percentile(times, q):.0f}" for q in (50.0, 99.0))]
