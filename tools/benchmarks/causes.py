"""Is the right cause named, and never a wrong one?

Lets one thing go wrong at a time before simulated cameras, at random: the mount moves (0.1 to 10 mm, 0.05 to 5
degrees), one finger is bent (0.15 to 1.5 mm at its tip), the jaw opening is reported wrong (0.1 to 2 mm), focal
length (0.2 to 3 %) or focus (1 to 3 px) change, a hand or a sheet covers the view, images turn dark, white, flat,
noisy or are missing, the camera freezes or is replaced, its clock goes wrong; or nothing does.
Grippers of four shapes, three cameras with lenses of their own, poses, openings, still and moving backgrounds and how
the opening is reported (exact, noisy, not at all) are random, and no trial is left out.  What the monitor's alerts name
in the end counts: the right cause, and the finger that is bent; another one (wrong, also beside the right one); or
unknown.  Without any alert nothing was detected, which is right if nothing happened.  Takes some hours.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks import kit
from benchmarks.causes_trials import ROWS, Trial, make_trial
from benchmarks.drawn import reference_record
from benchmarks.kit import Report
from gripmon.judge.drift import DriftSettings
from gripmon.judge.recalibrate import RecalibrationSettings
from gripmon.model.camera import make_camera
from gripmon.model.records import Alert, AlertEvent, Cause
from gripmon.monitor import Monitor, MonitorSettings

RIGHT_OR_UNKNOWN, WRONG = 0.95, 0.01
"""To reach."""
VERDICTS = ("right", "unknown", "silent", "wrong")


@dataclass(frozen=True)
class Told:
    """``last``: causes in the alerts open at the end, ``ever``: in any alert since it went wrong, each
    a cause and a finger.  ``text`` and ``causes`` (cause, finger, probability) of the alert that named one, or of the
    last.
    """

    last: frozenset[tuple[Cause, str | None]]
    ever: frozenset[tuple[Cause, str | None]]
    causes: tuple[tuple[str, str | None, float], ...]
    text: str


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


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    kit.numbers(parser, trials=(200, "of each cause"))
    parser.add_argument("--only", nargs="+", metavar="NAME", default=[], help="rows with these names")


def run(arguments: argparse.Namespace, report: Report) -> None:
    rows = kit.chosen(arguments.only, ROWS)
    # The rows in turn, so that a part of the trials tells about all of them.
    work = [(name, number) for number in range(arguments.trials) for name in rows]
    outcomes = []
    for name, number in kit.progress(work, "trial"):
        trial = make_trial(ROWS[name], arguments.seed, number)
        outcomes.append(judged(name, number, trial, watched(trial)))
    report.values |= {"seed": arguments.seed, "trials": outcomes}
    show(outcomes, arguments.seed, report)


def watched(trial: Trial) -> Told:
    """A monitor sees the frames; what its alerts name."""
    rig = trial.rig
    settings = MonitorSettings(
        jaw_sigma_m=rig.jaw_sigma_m,
        drift=DriftSettings(frames_per_s=rig.scenario.fps),
        recalibration=RecalibrationSettings(mode="off"),
    )
    monitor = Monitor(make_camera(rig.camera_settings), rig.gripper, settings, reference_record(rig.start_cam_T_grip))
    newest: dict[str, Alert] = {}
    ever: set[tuple[Cause, str | None]] = set()
    for index, frame in enumerate(trial.frames()):
        for alert in monitor.process(frame).alerts:
            if alert.event in (AlertEvent.RAISED, AlertEvent.UPDATED) and index >= trial.well:
                ever.add((alert.cause, alert.part))
            newest[alert.alert_id or alert.kind] = alert
    # Also what was over by then: a clock that was set once is right again.
    alerts = [a for a in newest.values() if a.event is not AlertEvent.NOTED]
    named = [a for a in alerts if a.cause is not Cause.UNKNOWN]
    alert = (named or alerts or [None])[-1]
    return Told(
        frozenset((a.cause, a.part) for a in alerts),
        frozenset(ever),
        () if alert is None else tuple((c.cause.value, c.part, c.probability) for c in alert.causes),
        "" if alert is None else alert.text,
    )


def judged(row: str, number: int, trial: Trial, told: Told) -> Outcome:
    """Right: the cause, and the finger where it is one's; where nothing happened, that none is named."""
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


def show(outcomes: list[Outcome], seed: int, report: Report) -> None:
    """The confusion matrix, the shares, every wrong one, and what was to be reached."""
    rows = list(dict.fromkeys(outcome.row for outcome in outcomes))
    columns = list(dict.fromkeys(o.told for o in sorted(outcomes, key=lambda o: rows.index(o.row))))
    lines = []
    for row in rows:
        own = [o for o in outcomes if o.row == row]
        lines.append([row, *(sum(o.told == column for o in own) or "." for column in columns), *_shares(own)])
    lines.append(["all", *("" for _ in columns), *_shares(outcomes)])
    report.say(
        f"seed {seed}; what went wrong (rows), cause reported in the end (columns), fractions of the trials",
        kit.table(["", *(column.replace("_", " ") for column in columns), *VERDICTS, "misled"], lines),
    )
    wrong = [f"- {o.row} {o.number}: {o.what}: {o.text}" for o in outcomes if o.verdict == "wrong"]
    if wrong:
        report.say(f"{len(wrong)} wrong", "\n".join(wrong))
    noticed = [o for o in outcomes if o.verdict != "silent"]
    report.say(f"not noticed: {len(outcomes) - len(noticed)} of {len(outcomes)}")
    share = len(wrong) / max(len(noticed), 1)
    what = f"right or unknown in at least {100.0 * RIGHT_OR_UNKNOWN:g} % of what was noticed"
    report.reach(
        [
            (what, f"{100.0 * (1.0 - share):.1f} %", 1.0 - share >= RIGHT_OR_UNKNOWN),
            (f"wrong in at most {100.0 * WRONG:g} %", f"{100.0 * share:.1f} %", share <= WRONG),
        ]
    )


def _shares(outcomes: list[Outcome]) -> list[str]:
    counts = [sum(o.verdict == verdict for o in outcomes) for verdict in VERDICTS]
    return [f"{100.0 * n / len(outcomes):.1f} %" for n in (*counts, int(np.sum([o.misled for o in outcomes])))]
