"""``tools/bench latency`` in small: it runs, counts every frame, and measures what it says.  No speed is asserted."""

from __future__ import annotations

import argparse
import itertools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

SIZE = (384, 288)

pytestmark = pytest.mark.usefixtures("tools_importable")


def _small():
    """The parts of the benchmark on few and small frames."""
    from benchmarks import latency

    loop = {"frames": 60, "compared": 200, "block": 50, "beside": 2, "turns": 1, "turn": 20, "gone": 110, "staged": 40}
    program = {"daemon_s": 1.0, "replayed": 12, "calls": 1}
    out = {}
    for name, part in latency.PARTS.items():
        plan = replace(part.plan, **part.quick)
        changes = {key: value for key, value in (loop | program).items() if hasattr(plan, key)}
        frames = [replace(f, size=SIZE, count=48 if f.kind in ("hidden", "lost") else 8) for f in part.frames]
        out[name] = replace(part, plan=replace(plan, **changes), frames=tuple(frames))
    return out


def _measured(every, names, kept=None):
    """What a report says of these parts."""
    from benchmarks import parts
    from benchmarks.kit import Report

    report = Report("tools/bench latency")
    asked = argparse.Namespace(list=False, quick=False, only=names, resume=kept)
    assert parts.run(asked, report, every) is None
    return report


@pytest.mark.slow("40 s: a benchmark in small; the figures that it computes are tested beside it")
def test_parts_in_small(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    from benchmarks import stages

    names = ["frame", "plain", "hidden", "daemon", "replay", "profile"]
    kept = tmp_path / "kept.jsonl"
    report = _measured(_small(), names, kept)
    parts = report.values["parts"]
    rows = {name: {row["what"]: row for row in part["rows"]} for name, part in parts.items()}
    assert "received 120 of 120" in parts["frame"]["notes"][1]
    assert "longest of 60" in "".join(rows["frame"])
    assert "both tags found in 8 of 8 frames" in parts["plain"]["notes"][0]  # two before each of four blocks
    (valid,) = (row for what, row in rows["hidden"].items() if what.startswith("frames that were valid"))
    assert valid["value"] == 0 and valid["note"] == "measured, but not valid: 0"
    assert all(row["value"] is None or row["value"] >= 0.0 for part in rows.values() for row in part.values())
    assert rows["daemon"]["frames that the recording dropped"]["value"] == 0
    cells = [[cell.strip() for cell in line.split("|")] for line in parts["profile"]["notes"][0].splitlines()[2:]]
    assert [row[1] for row in cells] == list(stages.STAGES)
    assert all(float(row[2].split(",")[0]) > 0.0 for row in cells)  # none is passed by
    targets = sum(row["target"] is not None for part in parts.values() for row in part["rows"])
    assert len(report.targets) == targets
    printed = capsys.readouterr().out
    assert len(re.findall(r"\| +(met|missed) +\|", printed)) == targets
    assert [json.loads(line)["part"] for line in kept.read_text().splitlines()] == names


def test_finished_parts_are_not_measured_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from benchmarks import kit, parts

    measured: list[str] = []

    def measure(function, paths, plan):
        measured.append(getattr(function, "func", function).__name__)
        return parts.Measured((parts.Row("a figure", 2.0, "ms", 1.0),))

    monkeypatch.setattr(kit, "in_new_process", measure)
    monkeypatch.setattr(parts.Rings, "of", lambda self, frames: tmp_path)
    kept, every = tmp_path / "kept.jsonl", _small()
    _measured(every, ["frame"], kept)
    with kept.open("a") as file:
        file.write('{"part": "hid')  # cut off
    report = _measured(every, ["frame", "hidden"], kept)
    assert measured == ["frame", "gone"]
    assert [target.met for target in report.targets] == [False, False]
    # Another amount of work is another measurement.
    more = replace(every["frame"], frames=(replace(every["frame"].frames[0], count=9),))
    _measured({"frame": more}, ["frame"], kept)
    assert measured[-1] == "frame" and len(measured) == 3


def test_a_part_that_fails_is_missed_and_the_next_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from benchmarks import kit, parts

    def measure(function, paths, plan):
        if function is one:
            raise RuntimeError("no camera")
        return parts.Measured((parts.Row("a figure", 1.0, "ms", 1.0),))

    def one() -> None: ...

    def other() -> None: ...

    monkeypatch.setattr(kit, "in_new_process", measure)
    report = _measured({"one": parts.Part("the first", one, None), "other": parts.Part("the second", other, None)}, [])
    assert [target.met for target in report.targets] == [False, True] and report.end(None, None) == 1
    assert "no camera" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "target", "at_least", "verdict"),
    [(1.0, 1.0, False, "met"), (1.1, 1.0, False, "missed"), (19.9, 20.0, True, "missed"), (3.0, None, False, ""),
     (None, 1.0, False, "")],
)  # fmt: skip
def test_a_row_says_whether_its_target_is_met(value, target, at_least, verdict):
    from benchmarks.parts import Row

    assert Row("what", value, "ms", target, at_least).verdict == verdict


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


def test_the_ring_goes_back_without_repeating_an_image_to_the_bit():
    from benchmarks.scene import Ring

    images, none = np.random.default_rng(1).integers(0, 256, (4, 6, 8)).astype(np.uint8), np.zeros(4)
    ring = Ring(images, images, none, np.zeros((4, 3)), none > 0.0)
    assert [ring.place(seq) for seq in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]
    for forth, back in ((2, 4), (1, 5)):
        one, other = (ring.frame(seq).image.astype(int) for seq in (forth, back))
        assert (np.abs(one - other) == 1).all()
    np.testing.assert_array_equal(ring.frame(6).image, images[0])
