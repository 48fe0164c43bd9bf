"""``tools/bench causes``: is the right cause named, and never a wrong one?"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import dataclass
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Lets one thing go wrong at a time before simulated cameras, at random: the mount moves (0.1 to 10 mm, 0.05 to 5
degrees), one finger is bent (0.15 to 1.5 mm at its tip), the jaw opening is reported wrong (0.1 to 2 mm), focal
length (0.2 to 3 %) or focus (1 to 3 px) change, a hand or a sheet covers the view, images turn dark, white, flat,
noisy or are missing, the camera freezes or is replaced, its clock or its frame rate goes wrong; or nothing does.
Grippers of four shapes, three cameras with lenses of their own, poses, openings, still and moving backgrounds and how
the opening is reported (exact, noisy, not at all) are random, and no trial is left out.  What the monitor's alerts name
in the end counts: the right cause, and the finger that is bent; another one (wrong, also beside the right one); or
unknown.  Without any alert nothing was detected, which is right if nothing happened.  Takes some hours."""

RIGHT_OR_UNKNOWN, WRONG = 0.95, 0.01
"""To reach."""

VERDICTS = ("right", "unknown", "silent", "wrong")


@dataclass(frozen=True)
class Outcome:
    """One trial: its number, what went wrong, the cause reported in the end and its probability; ``verdict``: right,
    unknown, silent (no alert) or wrong; ``misled``: some alert named a wrong cause for a while.
    """

    row: str
    number: int
    what: str
    told: str
    verdict: str
    misled: bool
    causes: tuple[tuple[str, str | None, float], ...]
    text: str


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "causes",
        run,
        "is the right cause named when something goes wrong",
        _DESCRIPTION,
        seed=True,
        as_json="write every trial",
    )
    parser.add_argument("--trials", type=options.positive, default=200, metavar="N", help="of each cause (default 200)")
    parser.add_argument("--only", metavar="ROWS", help="rows, separated by commas (default: all)")


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench causes``."""
    from benchmarks import machine
    from benchmarks.causes_trials import ROWS

    rows = list(ROWS) if arguments.only is None else arguments.only.split(",")
    strange = [row for row in rows if row not in ROWS]
    if strange:
        print(f"--only: there is no row {strange[0]}; {', '.join(ROWS)}", file=sys.stderr)
        return 2
    described = machine.description()
    outcomes = measure(rows, arguments.trials, arguments.seed)
    plain = [dataclasses.asdict(outcome) for outcome in outcomes]
    document = {"machine": described, "seed": arguments.seed, "trials": plain}
    options.deliver(arguments, "causes", as_text(described, arguments.seed, outcomes), document)
    return 0


def measure(rows: list[str], trials: int, seed: int) -> list[Outcome]:
    """All outcomes, the rows in turn so that a part of the trials tells about all of them."""
    from tqdm import tqdm

    from benchmarks import causes_runs
    from benchmarks.causes_trials import ROWS, make_trial

    outcomes = []
    with tqdm(total=trials * len(rows), desc="trials", unit="trial", file=sys.stderr, disable=None) as bar:
        for number in range(trials):
            for name in rows:
                trial = make_trial(ROWS[name], seed, number)
                outcomes.append(judged(name, number, trial, causes_runs.run(trial)))
                bar.update()
    return outcomes


def judged(row: str, number: int, trial: Any, told: Any) -> Outcome:
    """Right: the cause, and the finger where it is one's; where nothing happened, that none is named."""
    from benchmarks.causes_trials import ROWS
    from gripmon.model.records import Cause

    expected = ROWS[row].cause
    truth = (expected, trial.part)
    named = {each for each in told.last if each[0] is not Cause.UNKNOWN}
    if named - {truth}:
        verdict = "wrong"
    elif named or (expected is None and not told.last):
        verdict = "right"
    else:
        verdict = "unknown" if told.last else "silent"
    misled = any(each != truth and each[0] is not Cause.UNKNOWN for each in told.ever)
    strange = sorted(cause.value for cause, _ in named - {truth})
    rig = trial.rig
    scene = f"{rig.gripper.name}, {rig.scenario.background.kind} {rig.scenario.background.motion}"
    right = expected.value if expected is not None else "nothing"
    text = strange[0] if strange else right if verdict == "right" else verdict
    return Outcome(row, number, f"{trial.what}; {scene}", text, verdict, misled, told.causes, told.text)


def as_text(machine: dict[str, Any], seed: int, outcomes: list[Outcome]) -> str:
    """The confusion matrix, the shares, and every wrong one."""
    rows = list(dict.fromkeys(outcome.row for outcome in outcomes))
    columns = list(dict.fromkeys(o.told for o in sorted(outcomes, key=lambda o: rows.index(o.row))))
    lines = [
        f"gripmon {machine['commit']}, {machine['date']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"seed {seed}; what went wrong (rows), cause reported in the end (columns), fractions of the trials",
        "",
        _row("", *(column.replace("_", " ")[:13] for column in columns), *VERDICTS, "misled"),
    ]
    for row in rows:
        own = [o for o in outcomes if o.row == row]
        counts = [str(sum(o.told == column for o in own) or ".") for column in columns]
        lines.append(_row(row, *counts, *_shares(own)))
    lines += ["", _row("all", *("" for _ in columns), *_shares(outcomes)), "", "targets", *_targets(outcomes)]
    wrong = [o for o in outcomes if o.verdict == "wrong"]
    lines += ["", f"{len(wrong)} wrong"] if wrong else []
    lines += [f"  {o.row} {o.number}: {o.what}: {o.text}" for o in wrong]
    return "\n".join(lines)


def _shares(outcomes: list[Outcome]) -> list[str]:
    counts = [sum(o.verdict == verdict for o in outcomes) for verdict in VERDICTS]
    counts.append(sum(o.misled for o in outcomes))
    return [f"{100.0 * count / len(outcomes):.1f} %" for count in counts]


def _targets(outcomes: list[Outcome]) -> list[str]:
    """Of the trials in which there was something to tell."""
    told = [o for o in outcomes if o.verdict != "silent"]
    wrong = sum(o.verdict == "wrong" for o in told) / max(len(told), 1)
    share = f"{100.0 * (1.0 - wrong):.1f} %{_met(1.0 - wrong >= RIGHT_OR_UNKNOWN)}"
    return [
        f"  right or unknown in at least 95 % of what was noticed: {share}",
        f"  wrong in at most 1 %: {100.0 * wrong:.1f} %{_met(wrong <= WRONG)}",
        f"  not noticed: {len(outcomes) - len(told)} of {len(outcomes)}",
    ]


def _met(met: bool) -> str:
    return "   met" if met else "   NOT MET"


def _row(label: str, *values: str) -> str:
    return label.ljust(10) + "".join(value.rjust(14) for value in values)
