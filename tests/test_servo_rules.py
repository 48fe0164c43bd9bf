"""``tools/servo``: what a controller may do by a verdict, as a table, and that breaches are counted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gripmon.model.records import Verdict

NAN = float("nan")

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.parametrize(
    ("verdict", "age_s", "sigma_m", "moving", "action", "grasp"),
    [
        (Verdict.VALID, 0.0, 1e-5, True, "go", True),
        (Verdict.VALID, 0.0, 1e-5, False, "go", True),
        (Verdict.VALID, 0.2, 1e-5, True, "go", True),
        (Verdict.VALID, 0.21, 1e-5, True, "stop", False),  # stale
        (Verdict.VALID, -0.21, 1e-5, True, "stop", False),  # clocks differ: its age isn't known
        (Verdict.VALID, NAN, 1e-5, True, "stop", False),
        (Verdict.VALID, 0.0, None, True, "stop", False),  # says valid, but there is no transform
        (Verdict.VALID, 0.0, NAN, True, "stop", False),
        (Verdict.SUSPECT, 0.0, 1e-5, True, "slow", False),
        (Verdict.SUSPECT, 0.0, 1e-5, False, "stop", False),  # begins none
        (Verdict.SUSPECT, 0.0, 3.3e-4, True, "slow", False),
        (Verdict.SUSPECT, 0.0, 3.4e-4, True, "stop", False),  # the fingers might touch
        (Verdict.SUSPECT, 0.3, 1e-5, True, "stop", False),
        (Verdict.SUSPECT, 0.0, None, True, "stop", False),
        (Verdict.UNKNOWN, 0.0, None, True, "stop", False),
        (Verdict.UNKNOWN, 0.0, 1e-6, True, "stop", False),  # whatever else it says
        (Verdict.UNKNOWN, 0.0, 1e-6, False, "stop", False),
        (None, 0.0, None, True, "stop", False),
        (None, 0.0, 1e-6, True, "stop", False),
    ],
)
def test_what_a_verdict_allows(verdict, age_s, sigma_m, moving, action, grasp):
    from servoing.rules import Limits, action_for, may_grasp

    allowed = action_for(verdict, age_s=age_s, sigma_m=sigma_m, moving=moving, limits=Limits())
    assert allowed == action
    assert may_grasp(verdict, allowed) is grasp


def _run(verdicts: str, places: list[float], closed: int | None = None):
    """A run of one arm by letters of verdicts (v, s, u) and a joint's angles."""
    from servoing.rules import Action
    from servoing.runs import Run, Track
    from servoing.stage import ROWS

    names = {"v": Verdict.VALID, "s": Verdict.SUSPECT, "u": Verdict.UNKNOWN}
    count = len(verdicts)
    q = np.zeros((count, 6))
    q[:, 2] = places
    grasped = tuple(closed is not None and k >= closed for k in range(count))
    track = Track(q, np.zeros((count, 3)), np.zeros((count, 3)), (Action.GO,) * count, grasped, False)
    every = tuple(names[letter] for letter in verdicts)
    return Run(ROWS[0], 0, np.arange(count) / 30.0, every, (0,) * count, 0, {"gripmon": track}), track


@pytest.mark.parametrize(
    ("verdicts", "places", "closed", "expected"),
    [
        ("vvvv", [0, 1, 2, 3], None, (0, 0, 0, 0)),
        ("vvuuv", [0, 1, 2, 2, 2], None, (2, 0, 0, 0)),
        ("vvuuv", [0, 1, 2, 3, 3], None, (2, 1, 0, 0)),  # moved after the first unknown
        ("vvuuv", [0, 1, 2, 2, 2 + 1e-15], None, (2, 1, 1, 0)),  # by however little
        ("vssvv", [0, 0, 0, 0, 1], None, (0, 0, 0, 0)),
        ("vssvv", [0, 0, 0, 1, 2], None, (0, 0, 1, 0)),  # began by the second suspect
        ("vssvv", [0, 1, 2, 3, 4], None, (0, 0, 0, 0)),  # was under way
        ("uuvv", [0, 1, 1, 1], None, (2, 1, 1, 0)),
        ("vvvv", [0, 1, 1, 1], 2, (0, 0, 0, 0)),
        ("vvsv", [0, 1, 1, 1], 2, (0, 0, 0, 1)),  # closed by what isn't valid
        ("vvuu", [0, 1, 1, 1], 1, (0, 0, 0, 0)),  # closed before: nothing left to do wrong
    ],
)
def test_breaches_are_counted_from_joints_and_verdicts_alone(verdicts, places, closed, expected):
    pytest.importorskip("pinocchio")
    from servoing.figures import Conduct, conduct

    assert conduct(*_run(verdicts, places, closed)) == Conduct(*expected)


def _whole_run(row, number: int, *, off_mm: float, verdicts: str, places: list[float]):
    """Four arms of which those by the monitor end ``off_mm`` away, and turn a joint as ``places`` says."""
    from dataclasses import replace

    from servoing.runs import SOURCES

    run, track = _run(verdicts, places, closed=len(verdicts) - 1)
    tracks = {}
    for source in SOURCES:
        end_m = {"without": 4.5e-3, "truth": 1e-5}.get(source, 1e-3 * off_mm)
        tracks[source] = replace(track, off_m=np.full((len(verdicts), 3), [0.0, 0.0, end_m]))
    return replace(run, row=row, number=number, tracks=tracks)


MOVES = [0.0, 1.0, 2.0, 3.0, 4.0]
PAUSES = [0.0, 1.0, 2.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("off_mm", "verdicts", "places", "code", "said"),
    [
        (0.059, "vvuvv", PAUSES, 0, "- met: no move on unknown: 0 in 8 frames"),
        (0.061, "vvuvv", PAUSES, 1, "worse than with truth, in every run: 0.051 mm"),
        (0.02, "vvuvv", MOVES, 1, "- MISSED: no move on unknown: 8 in 8 frames"),
        (0.02, "vvvvv", MOVES, 1, "- MISSED: no move on unknown: 0 in 0 frames"),  # the rule wasn't tried
        (0.02, "vvuvs", PAUSES, 1, "closed by what is not valid: 8"),
    ],
)
def test_the_exit_code_says_whether_all_was_reached(
    off_mm, verdicts, places, code, said, monkeypatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("pinocchio")
    import json

    from benchmarks import __main__ as command
    from servoing import runs

    def run(row, number, *_args, **_named):
        return _whole_run(row, number, off_mm=off_mm, verdicts=verdicts, places=places)

    monkeypatch.setattr(runs, "run", run)
    monkeypatch.setattr(sys, "argv", ["bench", "servo", "--runs", "1", "--json", str(tmp_path / "servo.json")])
    assert command.main() == code
    assert said in capsys.readouterr().out
    rows = json.loads((tmp_path / "servo.json").read_text())["rows"]
    assert len(rows) == 16 and rows[0]["final_m"] == [4.5e-3]
