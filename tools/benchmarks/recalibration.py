"""``tools/bench recalibration``: what becomes the reference after the camera was knocked, and never a wrong one."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks import options

_DESCRIPTION = """\
Knocks a simulated camera at random, by up to 15 mm at the TCP and 8 degrees, uniform in size and in direction, and lets
the whole monitor see it: four grippers before three lenses at random poses and openings, six kinds of background that
move or stand still, jaws that rest or move and report their opening exactly, with an error, or not at all; in half of
the trials something else happens at the same moment: part of the view is covered, an object is held, the image loses
focus, the light changes, a finger is bent by 0.1 to 1 mm.

A new reference that the monitor accepts by itself is right if its TCP is within 0.05 mm of the truth.  Bounds are
one-sided with 95 % confidence (Clopper and Pearson)."""

RIGHT_M = 5e-5
"""Error of an accepted TCP up to which it is right."""

AFTER, LOST_FOR = 66, 15
"""Frames after the knock that are looked at, at most; fewer once this many in a row don't show the gripper."""

ANSWERS = ("accepted", "person", "refused", "gripper", "unsettled", "lost", "needless")
_MEANINGS = {
    "accepted": "a new reference, taken by the monitor itself",
    "person": "a new reference, put to an operator",
    "refused": "no new reference, and why",
    "gripper": "no new reference: the fingers or the jaw are reported to have moved",
    "unsettled": "past the limit, but no still frames in a row",
    "lost": "the gripper isn't found, or only now and then",
    "needless": "not past the limit",
}


@dataclass(frozen=True)
class Outcome:
    """One trial: what was drawn, what came of it, why, after how many frames; the new TCP's error and standard
    deviation (all axes together), m, None without a new reference.
    """

    number: int
    words: str
    also: str
    answer: str
    why: str
    frames: int
    error_m: float | None = None
    sigma_m: float | None = None

    @property
    def wrong(self) -> bool:
        """Whether the monitor took a reference that is too far from the truth."""
        return self.answer == "accepted" and self.error_m is not None and self.error_m > RIGHT_M


def add_parser(commands: Any) -> None:
    """Add the benchmark to ``tools/bench``."""
    parser = options.add_command(
        commands,
        "recalibration",
        run,
        "what becomes the reference after the camera was knocked",
        _DESCRIPTION,
        seed=True,
        as_json="write every trial",
    )
    parser.add_argument("--trials", type=options.count, default=1000, metavar="N", help="knocks (default %(default)s)")
    parser.add_argument(
        "--first", type=options.count, default=0, metavar="N", help="number of the first one (default 0)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Handle ``tools/bench recalibration``; 1 if a wrong reference was accepted."""
    from tqdm import tqdm

    from benchmarks import machine

    described = machine.description()
    numbers = range(arguments.first, arguments.first + arguments.trials)
    bar = tqdm(numbers, desc="knocks", unit="knock", file=sys.stderr, disable=None)
    outcomes = [trial(arguments.seed, number) for number in bar]
    rows = [asdict(outcome) for outcome in outcomes]
    document = {"machine": described, "seed": arguments.seed, "trials": rows}
    options.deliver(arguments, "recalibration", as_text(described, arguments.seed, outcomes), document)
    return int(any(outcome.wrong for outcome in outcomes))


def trial(seed: int, number: int) -> Outcome:
    """One knock, watched until the monitor has made up its mind."""
    from benchmarks.knocks import BEFORE, draw_knock
    from gripmon.judge.recalibrate import Refusal
    from gripmon.model.geometry import from_record, to_record
    from gripmon.model.records import ReferenceRecord, State
    from gripmon.monitor import Monitor, MonitorSettings

    knock = draw_knock(seed, number)
    known = {} if knock.jaw_sigma_m is None else {"jaw_sigma_m": knock.jaw_sigma_m}
    settings = MonitorSettings(**known)
    covariance = tuple(knock.start_covariance.ravel().tolist())
    start = ReferenceRecord("start", 1, 0, "configuration", to_record(knock.start_cam_T_grip), covariance)
    monitor = Monitor(knock.camera, knock.model, settings, start)
    unseen = (State.LOST, State.OCCLUDED, State.ACQUIRING)
    states = []
    answer, why = "", ""
    index = 0
    for index in range(BEFORE + AFTER):
        record = monitor.process(knock.simulator.frame(index))
        states.append(record.state)
        outcome = monitor.recalibration
        if monitor.reference.revision != start.revision:
            answer = "accepted"
        elif monitor.proposal is not None:
            answer, why = "person", getattr(outcome, "needs_person", None) or ""
        elif isinstance(outcome, Refusal) and not outcome.wait:
            answer, why = "refused", str(outcome.reason)
        if answer or (len(states) > LOST_FOR and all(s in unseen for s in states[-LOST_FOR:])):
            break
    if not answer:
        answer = _without_answer(states[BEFORE:], State)
    new = monitor.reference if answer == "accepted" else monitor.proposal
    error_m = sigma_m = None
    if new is not None:
        import numpy as np

        truth = knock.simulator.truth(index).cam_T_grip
        error_m = float(np.linalg.norm(from_record(new.cam_T_grip)[:3, 3] - truth[:3, 3]))
        sigma_m = float(np.sqrt(np.trace(np.reshape(new.covariance, (6, 6))[:3, :3])))
    return Outcome(number, knock.words, knock.also, answer, why, index + 1 - BEFORE, error_m, sigma_m)


def _without_answer(states: list[Any], state: Any) -> str:
    """What a trial comes to in which no one asked for a new reference, or no frames were fit for one."""
    last = Counter(states[len(states) // 2 :])
    if last[state.LOST] + last[state.OCCLUDED] + last[state.ACQUIRING] > 0.2 * last.total():
        return "lost"
    if last[state.RECALIBRATING] > 0.2 * last.total():
        return "unsettled"
    return "gripper" if state.RECALIBRATING in states else "needless"


def as_text(machine: dict[str, Any], seed: int, outcomes: list[Outcome]) -> str:
    """The whole report."""
    import numpy as np

    accepted = [o for o in outcomes if o.answer == "accepted"]
    asked = [o for o in outcomes if o.answer == "person"]
    lines = [
        f"gripmon {machine['commit']}, {machine['date']}",
        f"{machine['cpu']}, {machine['cpus']} cores, {machine['system']}",
        f"seed {seed}, trials {outcomes[0].number} to {outcomes[-1].number}" if outcomes else "no trials",
        "",
        _row("", "trials", "accepted,", "accepted,", *(a for a in ANSWERS if a != "accepted")),
        _row("what else happened", "", "right", "WRONG"),
    ]
    for also in [*sorted({o.also for o in outcomes}), None]:
        rows = [o for o in outcomes if also is None or o.also == also]
        counts = Counter(o.answer for o in rows)
        wrong = sum(o.wrong for o in rows)
        lines.append(
            _row(
                also or "all",
                len(rows),
                counts["accepted"] - wrong,
                wrong,
                *(counts[a] for a in ANSWERS if a != "accepted"),
            )
        )
    lines += ["", *(f"  {answer:10s} {meaning}" for answer, meaning in _MEANINGS.items())]
    wrong = sum(o.wrong for o in outcomes)
    lines += ["", f"wrong: {wrong} of {len(outcomes)} trials, at most {_percent(wrong, len(outcomes))};"]
    lines.append(f"  of {len(accepted)} accepted, at most {_percent(wrong, len(accepted))}")
    for name, rows in (("accepted", accepted), ("put to a person", asked)):
        if rows:
            errors = 1e3 * np.array([o.error_m for o in rows], dtype=float)
            ratio = errors / (1e3 * np.array([o.sigma_m for o in rows], dtype=float))
            median, most, largest = np.quantile(errors, [0.5, 0.95, 1.0]).tolist()
            lines.append(
                f"TCP, {name}: error median {median:.4f}, 95 % {most:.4f}, largest {largest:.4f} mm; over its standard "
                f"deviation: rms {np.sqrt(np.mean(ratio**2)):.2f} (1 if that holds), largest {ratio.max():.1f}; "
                f"within 0.05 mm: {np.count_nonzero(errors <= 1e3 * RIGHT_M)} of {len(rows)}"
            )
    if accepted:
        lines.append(f"frames until accepted: median {np.median([o.frames for o in accepted]):.0f}")
    lines += ["", "refused because of", *_counts(o.why for o in outcomes if o.answer == "refused")]
    lines += ["put to a person because of", *_counts(_kind(o.why) for o in asked)]
    lines += [f"WRONG by {1e3 * (o.error_m or 0.0):.3f} mm: trial {o.number}, {o.words}" for o in outcomes if o.wrong]
    lines += ["", f"target: accepted and wrong 0 times: {wrong}   {'met' if wrong == 0 else 'NOT MET'}"]
    return "\n".join(lines)


def _kind(text: str) -> str:
    """A question to a person without its numbers."""
    return " ".join(word for word in text.split() if not any(c.isdigit() for c in word))


def _counts(texts: Iterable[str]) -> list[str]:
    return [f"  {count:5d}  {text}" for text, count in Counter(texts).most_common()] or ["  nothing"]


def _percent(events: int, trials: int) -> str:
    from benchmarks.recovery import at_most

    return f"{100.0 * at_most(events, trials):.2f} %" if trials else "-"


def _row(label: str, *values: object) -> str:
    return label.ljust(20) + "".join(str(value).rjust(11) for value in values)
