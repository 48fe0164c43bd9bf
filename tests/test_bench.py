"""``tools/bench latency`` in small: it runs, counts every frame, and measures what it says.  No speed is asserted."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import pytest

SIZE = (384, 288)

pytestmark = pytest.mark.usefixtures("tools_importable")


def _small():
    from benchmarks import latency

    plan = latency.quick_plan()
    loop = replace(plan.loop, frames=60, compared=200, block=50, beside=2, turns=1, turn=20, gone=110, staged=40)
    program = replace(plan.program, daemon_s=1.0, replayed=12, calls=1)
    return replace(plan, loop=loop, program=program, small=SIZE, ring=8, ring_gone=48)


@pytest.mark.slow("40 s: a benchmark in small; the figures that it computes are tested beside it")
def test_parts_in_small(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    from benchmarks import latency, stages

    names = ["frame", "plain", "hidden", "daemon", "replay", "profile"]
    kept = tmp_path / "kept.jsonl"
    results = latency.measure(_small(), names, kept)
    parts = {name: results["parts"][name] for name in names}
    rows = {name: {row["what"]: row for row in part["rows"]} for name, part in parts.items()}
    assert "received 120 of 120" in parts["frame"]["notes"][1]
    assert "longest of 60" in "".join(rows["frame"])
    assert "both tags found in 8 of 8 frames" in parts["plain"]["notes"][0]  # two before each of four blocks
    (valid,) = (row for what, row in rows["hidden"].items() if what.startswith("frames that were valid"))
    assert valid["value"] == 0 and valid["note"] == "measured, but not valid: 0"
    assert all(row["value"] is None or row["value"] >= 0.0 for part in rows.values() for row in part.values())
    assert rows["daemon"]["frames that the recording dropped"]["value"] == 0
    _, *lines = parts["profile"]["notes"]
    assert [line[:46].strip() for line in lines] == list(stages.STAGES)
    assert all(float(line[46:].split()[0]) > 0.0 for line in lines)  # none is passed by
    printed = capsys.readouterr().out
    assert printed.count("  met") + printed.count("  missed") == sum(
        row["target"] is not None for part in parts.values() for row in part["rows"]
    )
    assert [json.loads(line)["part"] for line in kept.read_text().splitlines()] == names


def test_finished_parts_are_not_measured_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from benchmarks import latency, latency_rows

    measured: list[str] = []

    def measure(part, rings, plan):
        measured.append(part.measure)
        return latency_rows.Measured((latency_rows.Row("a figure", 2.0, "ms", 1.0),)).plain()

    monkeypatch.setattr(latency, "_measured", measure)
    kept, plan = tmp_path / "kept.jsonl", _small()
    latency.measure(plan, ["frame"], kept)
    with kept.open("a") as file:
        file.write('{"part": "hid')  # cut off
    results = latency.measure(plan, ["frame", "hidden"], kept)
    assert measured == ["loop.frame", "loop.gone hidden"]
    assert [part["missed"] for part in results["parts"].values()] == [["a figure"], ["a figure"]]
    # Another amount of work is another measurement.
    latency.measure(replace(plan, ring=9), ["frame"], kept)
    assert measured[-1] == "loop.frame" and len(measured) == 3


@pytest.mark.parametrize(
    ("value", "target", "at_least", "verdict"),
    [(1.0, 1.0, False, "met"), (1.1, 1.0, False, "missed"), (19.9, 20.0, True, "missed"), (3.0, None, False, ""),
     (None, 1.0, False, "")],
)  # fmt: skip
def test_a_row_says_whether_its_target_is_met(value, target, at_least, verdict):
    from benchmarks.latency_rows import Row

    assert Row("what", value, "ms", target, at_least).verdict == verdict


def test_the_page_has_every_row_and_what_is_missed():
    from benchmarks import latency_page
    from benchmarks.latency_rows import Measured, Row

    frame = Measured((Row("median", 0.4, "ms", 0.5), Row("longest", 31.5, "ms", 10.0)), ("a note",))
    profile = Measured((Row("a frame", 0.4, "ms", note="whole loop 0.5 ms"),), ("predict   48 µs",))
    machine = {"commit": "abc", "date": "today", "cpu": "c", "cpus": 2, "system": "s", "python": "3", "packages": {},
               "load_before": 0.1}  # fmt: skip
    parts = {"frame": frame.plain(), "profile": profile.plain()}
    page = latency_page.as_markdown({"machine": machine, "parts": parts}, " --quick")
    assert "`tools/bench latency --quick --out docs/results`" in page and "gripmon abc, today" in page
    assert "| frame | median | 0.4 ms | at most 0.5 ms | met |  |" in page
    assert "- longest (31.5 ms, at most 10 ms)" in page and "predict   48 µs" in page


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
    watches.counting = False
    outer()
    assert sum(watches.total_ns.values()) == 5
