"""``tools/bench recovery``: back on track after the camera was knocked, and never at a wrong place."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Knocks the simulated camera about at random, up to 10 mm at the TCP and 4 degrees in any direction, and counts in how
many frames the monitor is back on track: three grippers, each before a camera of its own, at random poses and jaw
openings, before six kinds of background that move on.  Every other trial begins with an estimate that is wrong from
the first frame on, the others jump while the monitor tracks.  Further rows: frames of the rendered sequences beside
the checkout, if they are there, from wrong starts; jumps of twice the size; views without any gripper.
Back on track: a measured transform whose TCP is less than 0.2 mm from the truth; found: less than 1 mm.  Bounds are
one-sided with 95 % confidence (Clopper and Pearson).  Takes some ten minutes."""

TRACK_M, FOUND_M = 2e-4, 1e-3
"""Errors of the TCP below which the monitor is back on track, and has found the gripper."""

BEFORE = 4
"""Frames before a jump."""

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Plan:
    """How many trials of each kind; ``after``: frames that are looked at in a trial."""

    trials: int = 1080
    beyond: int = 180
    absent: int = 180
    rendered: bool = True
    per_scene: int = 10
    after: int = 8
    beyond_after: int = 45
    seed: int = 1


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


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "recovery",
        run,
        "back on track after jumps of the camera, and never at a wrong place",
        _DESCRIPTION,
        seed=True,
        as_json="write everything that was measured",
        markdown=True,
    )
    plan = Plan()
    for name, what in (
        ("trials", "jumps within 10 mm and 4 degrees"),
        ("beyond", "jumps of up to twice that"),
        ("absent", "views without the gripper"),
    ):
        parser.add_argument(
            f"--{name}",
            type=options.count,
            default=getattr(plan, name),
            metavar="N",
            help=f"{what} (default %(default)s)",
        )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench recovery``."""
    from benchmarks import machine

    plan = Plan(arguments.trials, arguments.beyond, arguments.absent, seed=arguments.seed)
    described = machine.description()
    results = measure(plan)
    rows = {name: [_plain(outcome) for outcome in outcomes] for name, outcomes in results.items()}
    text = as_text(described, plan, results)
    options.deliver(arguments, "recovery", text, {"machine": described, "rows": rows})
    return 0


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {name: getattr(outcome, name) for name in Outcome.__dataclass_fields__}


def measure(plan: Plan) -> dict[str, list[Outcome]]:
    """Outcomes by row of the report."""
    from tqdm import tqdm

    from benchmarks import jumps

    rows: dict[str, list[Outcome]] = {}
    total = plan.trials + plan.beyond + plan.absent
    with tqdm(total=total, desc="trials", unit="trial", file=sys.stderr, disable=None) as bar:
        for kind, count in (("", plan.trials), ("beyond", plan.beyond), ("absent", plan.absent)):
            for place in range(count // plan.per_scene):
                rig, background = jumps.combination(place)
                scene = jumps.scene(rig, background, [plan.seed, len(kind), place], plan.per_scene, kind)
                for index in range(plan.per_scene):
                    rows.setdefault(kind or background, []).append(_trial(plan, scene, index, kind))
                    bar.update()
            bar.update(count % plan.per_scene)
    if plan.rendered:
        rows |= _rendered(plan)
    return rows


def _trial(plan: Plan, scene: Any, index: int, kind: str) -> Outcome:
    """The camera jumps while the monitor tracks, or (odd trials, and without a gripper) is elsewhere from the start."""
    while_tracking = kind != "absent" and index % 2 == 0
    after = plan.beyond_after if kind == "beyond" else plan.after
    trial = scene.trial(index, BEFORE if while_tracking else 0, after)
    process = _monitor(scene.camera, scene.rig.gripper, trial.before_cam_T_grip)
    for frame in trial.before:
        process(frame)
    return _watch(process, trial.after, None if kind == "absent" else [trial.after_cam_T_grip] * after)


def _monitor(camera: Any, gripper: Any, cam_T_grip: Any) -> Callable[[Any], Any]:
    import numpy as np

    from gripmon.model.geometry import to_record
    from gripmon.model.records import ReferenceRecord
    from gripmon.monitor import Monitor, MonitorSettings

    sigma = np.array([2e-4] * 3 + [2e-3] * 3)
    covariance = tuple(np.diag(sigma**2).ravel().tolist())
    reference = ReferenceRecord("start", 1, 0, "configuration", to_record(cam_T_grip), covariance)
    return Monitor(camera, gripper, MonitorSettings(), reference).process


def _watch(process: Callable[[Any], Any], frames: Sequence[Any], truths: Sequence[Any] | None) -> Outcome:
    """``truths``: poses of the gripper, None if there is none in view."""
    import time

    import numpy as np

    from gripmon.model.records import Origin, Verdict

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


def _rendered(plan: Plan) -> dict[str, list[Outcome]]:
    """A wrong start at each frame; unrelated frames are shown several times."""
    import numpy as np

    from benchmarks import jumps, rendered
    from gripmon.model.geometry import perturb

    rows: dict[str, list[Outcome]] = {}
    rng = np.random.default_rng([plan.seed, 99])
    for name, together in (("clean", False), ("static_background", True), ("jaw_cycle", True), ("series2", False)):
        for sequence in rendered.sequences(f"rendered {name}"):
            shots = list(sequence.shots())
            for first in range(len(shots)):
                chosen = [shots[min(first + k, len(shots) - 1) if together else first] for k in range(5)]
                frames = [jumps.restamped(shot.frame, k) for k, shot in enumerate(chosen)]
                wrong = perturb(chosen[0].cam_T_grip, jumps.draw(rng, 1)[0])
                process = _monitor(sequence.camera, sequence.gripper, wrong)
                outcome = _watch(process, frames, [shot.cam_T_grip for shot in chosen])
                rows.setdefault(f"rendered {name}", []).append(outcome)
    return rows


def as_text(machine: dict[str, Any], plan: Plan, rows: dict[str, list[Outcome]]) -> str:
    """The whole report."""
    lines = [
        f"gripmon {machine['commit']}, {machine['date']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"load average {machine['load_before']} before (1 belongs to this benchmark)",
        f"seed {plan.seed}",
        "",
        _row("", "trials", "found in", "", "", "on track", "at least", "valid,", "at most", "valid,", "searching"),
        _row("", "", "frame 1", "2", "5", "in 5", "", ">1 mm", "", ">0.2 mm", "ms: median", "99 %"),
    ]
    within = [o for name, outcomes in rows.items() if name not in ("beyond", "absent") for o in outcomes]
    simulated = [o for name, os in rows.items() if not name.startswith(("beyond", "absent", "rendered")) for o in os]
    for name, outcomes in rows.items():
        if name != "absent":
            lines.append(_outcome_row(name, outcomes))
    lines += ["", _outcome_row("all simulated", simulated), _outcome_row("all within 10 mm and 4°", within)]
    if "beyond" in rows:
        late = sum(o.found is not None for o in rows["beyond"])
        lines.append(f"beyond: {late} of {len(rows['beyond'])} found within {plan.beyond_after} frames")
    if "absent" in rows:
        absent = rows["absent"]
        shown = len(absent) * plan.after
        measured, valid = sum(o.astray for o in absent), sum(o.valid for o in absent)
        most = 100 * at_most(measured, len(absent))
        lines.append(
            f"without a gripper: something was measured in {measured} of {len(absent)} views of {plan.after} frames"
        )
        lines.append(f"  (at most {most:.2f} %); valid in {valid} of {shown} frames")
    lines += ["", "targets", *_targets(within)]
    return "\n".join(lines)


def _targets(within: list[Outcome]) -> list[str]:
    count = len(within)
    back = sum(o.back is not None and o.back <= 5 for o in within)
    lies = sum(o.lies > 0 for o in within)
    return [
        f"  back on track within 5 frames in 99 % of trials: {100 * back / count:.2f} %{_met(back >= 0.99 * count)}",
        f"  confident at a wrong place in less than 0.1 % of trials: {lies} of {count}{_met(lies < 1e-3 * count)}",
    ]


def _met(met: bool) -> str:
    return "   met" if met else "   NOT MET"


def _outcome_row(name: str, outcomes: list[Outcome]) -> str:
    import numpy as np

    count = len(outcomes)
    if not count:
        return _row(name, "0")
    found = [sum(o.found is not None and o.found <= k for o in outcomes) for k in (1, 2, 5)]
    back = sum(o.back is not None and o.back <= 5 for o in outcomes)
    lies = sum(o.lies > 0 for o in outcomes)
    valid, inexact = sum(o.valid for o in outcomes), sum(o.inexact for o in outcomes)
    times = np.concatenate([o.searched_ms for o in outcomes])
    return _row(
        name,
        str(count),
        *(f"{100 * k / count:.1f} %" for k in found),
        f"{100 * back / count:.1f} %",
        f"{100 * _at_least(back, count):.1f} %",
        str(lies),
        f"{100 * at_most(lies, count):.2f} %",
        f"{100 * inexact / max(valid, 1):.1f} %",
        f"{np.median(times):.0f}",
        f"{np.percentile(times, 99.0):.0f}",
    )


def _at_least(successes: int, trials: int) -> float:
    """Lower bound of the probability of success."""
    from scipy.special import betaincinv

    return float(betaincinv(successes, trials - successes + 1, 1.0 - CONFIDENCE)) if successes else 0.0


def at_most(events: int, trials: int) -> float:
    """Upper bound of the probability of an event."""
    return 1.0 - _at_least(trials - events, trials)


def _row(label: str, *values: str) -> str:
    return label.ljust(28) + "".join(value.rjust(11) for value in values)
