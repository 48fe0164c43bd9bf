"""``tools/servo``: what a controller may do by a verdict, as a table, and that breaches are counted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gripmon.records import Verdict

TOOLS = Path(__file__).resolve().parent.parent / "tools"
NAN = float("nan")


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(TOOLS))
    yield
    for name in [name for name in sys.modules if name.split(".")[0] in ("servoing", "benchmarks")]:
        del sys.modules[name]


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


def test_speeds_are_in_the_order_of_trust():
    from servoing.rules import Action, Limits

    speeds = [Limits().speed(action) for action in (Action.STOP, Action.SLOW, Action.GO)]
    assert speeds[0] == 0.0 and speeds[2] == 1.0 and 0.0 < speeds[1] < 1.0


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


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--runs", "0"], "'0'; a whole number, 1 to 1000"),
        (["--seed", "-1"], "'-1' is no seed"),
        (["--fps", "5"], "'5'; a number from 10 to 200"),
        (["--fps", "nan"], "'nan'; a number from 10 to 200"),
        (["--json", "/nowhere/at/all.json"], "--json /nowhere/at/all.json: can't be written"),
    ],
)
def test_wrong_usage_is_one_line(options: list[str], said: str, monkeypatch, capsys: pytest.CaptureFixture[str]):
    import importlib.util

    from servoing import __main__ as command

    monkeypatch.setattr(sys, "argv", ["servo", *options])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    try:
        code = command.main()
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
