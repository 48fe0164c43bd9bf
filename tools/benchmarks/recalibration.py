"""What becomes the reference after the camera was knocked, and never a wrong one.

Knocks a simulated camera at random, by up to 15 mm at the TCP and 8 degrees, uniform in size and in direction, and lets
the whole monitor see it: four grippers before three lenses at random poses and openings, six kinds of background that
move or stand still, jaws that rest or move and report their opening exactly, with an error, or not at all; in half of
the trials something else happens at the same moment: part of the view is covered, an object is held, the image loses
focus, the light changes, a finger is bent by 0.1 to 1 mm.

A new reference that the monitor accepts by itself is right if its TCP is within 0.05 mm of the truth.  Bounds are
one-sided with 95 % confidence (Clopper and Pearson).
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks import kit
from benchmarks.drawn import reference_record
from benchmarks.kit import Report
from benchmarks.knocks import BEFORE, draw_knock
from gripmon.judge.recalibrate import Refusal
from gripmon.model.geometry import from_record
from gripmon.model.records import State
from gripmon.monitor import Monitor, MonitorSettings

RIGHT_M = 5e-5
"""Error of an accepted TCP up to which it is right."""
AFTER, LOST_FOR = 66, 15
"""Frames after the knock that are looked at, at most; fewer once this many in a row don't show the gripper."""
_UNSEEN = (State.LOST, State.OCCLUDED, State.ACQUIRING)
ANSWERS = {
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


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=kit.count, default=1, metavar="N", help="of everything random (default 1)")
    parser.add_argument("--trials", type=kit.count, default=1000, metavar="N", help="knocks (default %(default)s)")
    parser.add_argument("--first", type=kit.count, default=0, metavar="N", help="number of the first one (default 0)")


def run(arguments: argparse.Namespace, report: Report) -> None:
    numbers = range(arguments.first, arguments.first + arguments.trials)
    outcomes = [trial(arguments.seed, number) for number in kit.progress(numbers, "knock")]
    report.values |= {"seed": arguments.seed, "trials": outcomes}
    report.say(f"seed {arguments.seed}, trials {numbers.start} to {numbers.stop - 1}")
    show(outcomes, report)


def trial(seed: int, number: int) -> Outcome:
    """One knock, watched until the monitor has made up its mind."""
    knock = draw_knock(seed, number)
    known = {} if knock.jaw_sigma_m is None else {"jaw_sigma_m": knock.jaw_sigma_m}
    start = reference_record(knock.start_cam_T_grip)
    monitor = Monitor(knock.camera, knock.model, MonitorSettings(**known), start)
    states: list[State] = []
    answer, why, index = "", "", 0
    for index in range(BEFORE + AFTER):
        states.append(monitor.process(knock.simulator.frame(index)).state)
        outcome = monitor.recalibration
        if monitor.reference.revision != start.revision:
            answer = "accepted"
        elif monitor.proposal is not None:
            answer, why = "person", getattr(outcome, "needs_person", None) or ""
        elif isinstance(outcome, Refusal) and not outcome.wait:
            answer, why = "refused", str(outcome.reason)
        if answer or (len(states) > LOST_FOR and all(s in _UNSEEN for s in states[-LOST_FOR:])):
            break
    answer = answer or _without_answer(states[BEFORE:])
    new = monitor.reference if answer == "accepted" else monitor.proposal
    error_m = sigma_m = None
    if new is not None:
        truth = knock.simulator.truth(index).cam_T_grip
        error_m = float(np.linalg.norm(from_record(new.cam_T_grip)[:3, 3] - truth[:3, 3]))
        sigma_m = float(np.sqrt(np.trace(np.reshape(new.covariance, (6, 6))[:3, :3])))
    return Outcome(number, knock.words, knock.also, answer, why, index + 1 - BEFORE, error_m, sigma_m)


def _without_answer(states: list[State]) -> str:
    """What a trial comes to in which no one asked for a new reference, or no frames were fit for one."""
    last = Counter(states[len(states) // 2 :])
    if sum(last[state] for state in _UNSEEN) > 0.2 * last.total():
        return "lost"
    if last[State.RECALIBRATING] > 0.2 * last.total():
        return "unsettled"
    return "gripper" if State.RECALIBRATING in states else "needless"


def show(outcomes: list[Outcome], report: Report) -> None:
    """What came of the knocks, by what else happened; how far the new references are off; the wrong ones."""
    lines = []
    for also in [*sorted({o.also for o in outcomes}), None]:
        own = [o for o in outcomes if also is None or o.also == also]
        wrong, found = sum(o.wrong for o in own), Counter(o.answer for o in own)
        others = (found[answer] for answer in ANSWERS if answer != "accepted")
        lines.append([also or "all", len(own), found["accepted"] - wrong, wrong, *others])
    head = ("what else happened", "trials", "accepted, right", "accepted, WRONG", *list(ANSWERS)[1:])
    report.say(kit.table(head, lines), "\n".join(f"- {answer}: {meaning}" for answer, meaning in ANSWERS.items()))
    accepted, asked = ([o for o in outcomes if o.answer == answer] for answer in ("accepted", "person"))
    for name, own in (("accepted", accepted), ("put to a person", asked)):
        if own:
            report.say(_errors(name, own))
    if accepted:
        report.say(f"frames until accepted: median {np.median([o.frames for o in accepted]):.0f}")
    report.say(f"refused because of {_reasons(o.why for o in outcomes if o.answer == 'refused')}")
    report.say(f"put to a person because of {_reasons(_kind(o.why) for o in asked)}")
    wrong = [o for o in outcomes if o.wrong]
    for o in wrong:
        report.say(f"WRONG by {1e3 * (o.error_m or 0.0):.3f} mm: trial {o.number}, {o.words}")
    most = [f"of {len(of)} {what}, at most {kit.percent(kit.at_most(len(wrong), len(of)), 2)} %"
            for of, what in ((outcomes, "trials"), (accepted, "accepted")) if of]  # fmt: skip
    report.reach([("accepted and wrong 0 times", f"{len(wrong)}: {'; '.join(most)}", not wrong)])


def _errors(name: str, outcomes: list[Outcome]) -> str:
    errors, sigmas = (1e3 * np.array([getattr(o, what) for o in outcomes], float) for what in ("error_m", "sigma_m"))
    ratio = errors / sigmas
    median, most, largest = np.quantile(errors, [0.5, 0.95, 1.0]).tolist()
    return (
        f"TCP, {name}: error median {median:.4f}, 95 % {most:.4f}, largest {largest:.4f} mm; over its standard "
        f"deviation: rms {kit.rms(ratio):.2f} (1 if that holds), largest {ratio.max():.1f}; "
        f"within 0.05 mm: {np.count_nonzero(errors <= 1e3 * RIGHT_M)} of {len(outcomes)}"
    )


def _kind(text: str) -> str:
    """A question to a person without its numbers."""
    return " ".join(word for word in text.split() if not any(c.isdigit() for c in word))


def _reasons(texts: Iterable[str]) -> str:
    return kit.counts(Counter(texts)) or "nothing"
