"""``tools/bench wire`` in small: every condition is measured, every message counted.  No speed is asserted."""

from __future__ import annotations

import math
from typing import Any

import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


def test_the_whole_run_in_small():
    from benchmarks import wire, wire_runs

    plan = wire_runs.Plan(
        size=(384, 288), ring=8, block=20, settle=5, rounds=2, more_subscribers=1, restarts=1,
        before_s=0.5, down_s=0.25, after_s=6.0, slow_s=1.5, slow_after_s=1.0, stopped_s=1.0,
    )  # fmt: skip
    results = wire.measure(plan)
    measured = results["conditions"]
    for condition in wire_runs.CONDITIONS:
        row = measured[condition]
        assert row["frames"] == 30
        assert 0.0 < row["judged_us"]["median"] <= row["loop_us"]["p99"]
        # What is in another process's callback has been judged before.
        assert row["received_us"]["median"] > row["judged_us"]["median"]
        assert row["lost"] < 15  # a busy machine drops some
        assert len(row["published_p99_by_round_us"]) == len(row["loop_p99_by_round_us"]) == 2
    (turn,) = results["restarts"]["runs"]
    assert turn["router_away_s"] > 0.0
    assert turn["lost"] >= turn["lost_while_away"] > 0
    assert turn["recovery_s"] is None or turn["recovery_s"] > -turn["router_away_s"]
    assert results["restarts"]["exceptions"] == measured["exceptions"] == 0
    slow = results["slow"]
    assert len(slow) == 6 and all(row["polls"] > 0 for row in slow.values())
    assert slow["no limit"]["usable"] > 0.5 * slow["no limit"]["polls"]
    assert slow["router stopped for 1 s"]["newest_max_s"] > 0.8
    assert max(row["true_max_s"] for row in slow.values()) <= wire.AGE_BOUND_S  # of whatever is usable, on any machine
    text = wire.as_text(results)
    assert text.count("  met") + text.count("NOT MET") == len(wire.verdicts(results)) == 8


def figures(
    median_us: float, tails_us: tuple[float, float], recovery_s: float | None, exceptions: int, oldest_s: float = 0.2
) -> dict[str, Any]:
    def row(median: float, tails: tuple[float, float]) -> dict[str, Any]:
        # Two quiet rounds and one in which the machine did something else: the middle one counts.
        by_round = {
            f"{what}_p99_by_round_us": [tail, 99_000.0, tail - 1.0]
            for what, tail in zip(("published", "loop"), tails, strict=True)
        }
        return {"received_us": {"median": median}, "judged_us": {"median": 1000.0}, **by_round}

    measured: dict[str, Any] = {condition: row(median_us, (2000.0, 2000.0)) for condition in ("alone", "blocked")}
    measured |= {"stopped": row(median_us, tails_us), "exceptions": exceptions}
    slow = {"30 kB/s": {"true_max_s": oldest_s}}
    return {"slow": slow, "conditions": measured, "restarts": {"runs": [{"recovery_s": recovery_s}], "exceptions": 0}}


@pytest.mark.parametrize(
    ("values", "missed"),
    [
        ((1499.0, (2199.0, 2199.0), 1.9, 0), None),
        ((1501.0, (2199.0, 2199.0), 1.9, 0), 0),
        ((1499.0, (2201.0, 2199.0), 1.9, 0), 1),
        ((1499.0, (2199.0, 2201.0), 1.9, 0), 2),
        ((1499.0, (2199.0, 2199.0), 2.1, 0), 5),
        ((1499.0, (2199.0, 2199.0), None, 0), 5),
        ((1499.0, (2199.0, 2199.0), 1.9, 0, 0.26), 6),
        ((1499.0, (2199.0, 2199.0), 1.9, 1), 7),
        ((math.nan, (2199.0, 2199.0), 1.9, 0), 0),
    ],
)
def test_what_is_not_reached_is_said(values: tuple[Any, ...], missed: int | None):
    from benchmarks import wire

    met = [reached for _, _, reached in wire.verdicts(figures(*values))]
    assert [i for i, reached in enumerate(met) if not reached] == ([] if missed is None else [missed])
