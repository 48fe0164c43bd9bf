"""``tools/bench wire`` in small: every condition is measured, every message counted.  No speed is asserted."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.slow("40 s: a benchmark in small; publishing has tests of its own")
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
