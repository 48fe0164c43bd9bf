"""``tools/bench latency`` in small: it runs, counts every message, and measures what it says.  No speed is asserted."""

from __future__ import annotations

import itertools

import pytest

SIZE = (384, 288)

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.mark.slow("10 s: a benchmark in small; the figures that it computes are tested beside it")
def test_the_whole_run_in_small(capsys: pytest.CaptureFixture[str]):
    from benchmarks import latency, report, stages

    plan = latency.Plan(
        sizes=(SIZE,),
        ring=8,
        warm_up=20,
        frames=60,
        block=20,
        tags_per_block=2,
        staged=40,
        paced_block=40,
        paced_blocks=2,
        memory_marks=(50, 100),
    )
    results = latency.measure(plan)
    name = f"{SIZE[0]}x{SIZE[1]}"
    measured = results["latency"][name]
    assert measured["published_us"]["count"] == 60
    assert 0.0 < measured["published_us"]["median"] <= measured["published_us"]["p99"]
    assert measured["received"] == [80, 80]
    assert results["memory"][name]["received"] == [101, 101]
    assert measured["tags_us"]["count"] == 6
    assert set(results["stages"][name]) == set(stages.STAGES)
    assert all(us > 0.0 for us in results["stages"][name].values())
    assert results["recording"][name]["written_bytes"] > 10_000
    assert all(rss > 20e6 for rss in results["memory"][name]["rss_bytes"].values())
    text = report.as_text(results)
    assert "384 x 288" in text and "times faster than tags" in text
    assert text.count("  met") + text.count("NOT MET") == 5


def test_stop_watches_count_every_nanosecond_once(monkeypatch: pytest.MonkeyPatch):
    """By a clock that advances by 1 ns whenever it is read."""
    from benchmarks import stages

    monkeypatch.setattr(stages.time, "perf_counter_ns", itertools.count().__next__)
    watches = stages.StopWatches()
    inner = watches.wrapped(lambda: None, "corners")
    outer = watches.wrapped(lambda: (inner(), inner()), "joint fit")
    outer()
    assert watches.total_ns["corners"] == 2
    assert watches.total_ns["joint fit"] == 3
    assert sum(watches.total_ns.values()) == 5
    watches.reset()
    assert not any(watches.total_ns.values())


def test_stop_watches_leave_the_product_as_it_was():
    from benchmarks import stages

    before = {(owner, name): getattr(owner, name) for places in stages.STAGES.values() for owner, name in places}
    with stages.stop_watches():
        assert all(getattr(owner, name) is not function for (owner, name), function in before.items())
    assert all(getattr(owner, name) is function for (owner, name), function in before.items())
