"""``tools/bench record`` in small: every part measures what it says.  No speed is asserted."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"
SIZE = (384, 288)

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        from benchmarks import latency

        path = tmp_path_factory.mktemp("frames") / "ring.npz"
        latency.render(SIZE, 6, path, creep_m=0.0)
    return path


@pytest.fixture
def ring(tools_importable: None, rendered: Path) -> Path:
    return rendered


def test_the_loop_is_measured_in_turns_and_nothing_that_was_stopped_stays_stopped(ring: Path):
    from benchmarks import record_loop

    plan = record_loop.Plan(sizes=(SIZE,), ring=6, block=40, settle=10, rounds=1)
    measured = record_loop.measure(ring, SIZE, plan, may_mount=False)
    assert "SIGSTOP" in measured["how"]
    for condition in record_loop.CONDITIONS:
        row = measured[condition]
        assert row["frames"] == 30
        assert 0.0 < row["published_us"]["median"] < row["loop_us"]["median"] <= row["loop_us"]["p99"]
    # Had the stopped process stayed so, the end would have dropped what waited.
    assert measured["dropped"] == {"off": 0, "on": 0, "stalled": 0}


def test_a_frozen_disk_keeps_every_writer_waiting_until_it_goes_on(tools_importable: None, tmp_path: Path):
    from benchmarks import stalled_disk

    with stalled_disk.disk(tmp_path) as disk:
        if not isinstance(disk, stalled_disk.FrozenDisk):
            pytest.skip("no file system can be mounted here")
        disk.stall(None)
        writer = subprocess.Popen(["sh", "-c", f"echo > {disk.directory}/file"])
        try:
            with pytest.raises(subprocess.TimeoutExpired):
                writer.wait(0.3)
        finally:
            disk.go_on()
        assert writer.wait(30.0) == 0
        directory = disk.directory
    assert not os.path.ismount(directory)


def test_bytes_by_policy(ring: Path):
    from benchmarks import record_bytes

    names = tuple(record_bytes.POLICIES)
    policies = (names[1], names[-1])  # every frame's image, and none
    measured = record_bytes.measure(ring, SIZE, record_bytes.Plan(ring=6, begin_s=0.5, seconds=0.5, policies=policies))
    every, none = (measured[name] for name in policies)
    assert every["frames"] == none["frames"] == 30
    assert every["bytes_per_hour"] == every["bytes_per_frame"] * 216_000
    # An image of this size has a few kB, a record without one less than images of a real camera.
    assert every["bytes_per_frame"] > none["bytes_per_frame"] + 2_000 > 2_500


def test_an_hour_in_small_is_whole_and_of_one_piece(ring: Path, tmp_path: Path):
    from benchmarks import record_hour

    plan = record_hour.Plan(size=SIZE, ring=6, frames=360, in_file=120, quiet=60, moving=60)
    written = record_hour.write(ring, ring, tmp_path, plan)
    assert (written["frames"], written["files"], written["images"]) == (360, 3, 60)
    from gripmon.record.read import open_recordings

    (recording,) = open_recordings([tmp_path]).recordings
    assert recording.frames.seq.tolist() == list(range(360))
    assert np.ptp(np.diff(recording.frames.stamp_ns)) <= 2
    assert len(recording.image_seqs) == 60 and len(recording.states) == 6
    assert not recording.faults


def test_commands_that_are_not_there_have_no_row(
    tools_importable: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    from benchmarks import record_hour

    monkeypatch.setattr(record_hour, "COMMANDS", {"prophesy": ("--out", "future"), "schema": ("--no-such-option",)})
    read = record_hour.read(tmp_path, record_hour.Plan(commands=("prophesy", "schema")))
    assert list(read) == ["schema"] and read["schema"]["code"] == 2 and "no-such-option" in read["schema"]["said"]


def test_kills_are_counted_and_what_they_cost(ring: Path):
    from benchmarks import record_killed

    plan = record_killed.Plan(size=SIZE, ring=6, tries=1, span_s=(1.0, 1.0))
    (tried,) = record_killed.measure(ring, plan)["tries"]
    assert tried["delivered"] >= tried["in_file"] > 0 and tried["opened"]
    assert tried["loss_s"] == pytest.approx((tried["delivered"] - tried["in_file"]) / 60.0)


def test_memory_over_frames(ring: Path):
    from benchmarks import record_memory

    plan = record_memory.Plan(size=SIZE, ring=6, hours=0.01, look_every=540, judged=24)
    measured = record_memory.measure(ring, plan)
    assert measured["frames"] == measured["written"] == 2160 and measured["dropped"] == 0
    assert [look["hours"] for look in measured["looks"]] == pytest.approx([0.0025, 0.005, 0.0075, 0.01])
    assert all(look["process_mib"] > 20.0 < look["daemon_mib"] for look in measured["looks"])


def test_slopes_and_their_errors_are_right(tools_importable: None):
    from benchmarks import record_memory

    rng = np.random.default_rng(3)
    hours = np.linspace(0.1, 24.0, 240)
    found = []
    for _ in range(200):
        values = 300.0 + 0.7 * hours + rng.normal(0.0, 5.0, len(hours))
        looks = [{"hours": h, "mib": v} for h, v in zip(hours.tolist(), values.tolist(), strict=True)]
        slope = record_memory.slope(looks, "mib")
        found.append((slope["mib_per_hour"] - 0.7) / slope["sigma_mib_per_hour"])
    # Student's t with 8 degrees of freedom: its standard deviation is 1.15.
    assert abs(np.mean(found)) < 0.3 and 0.9 < np.std(found) < 1.45


def results(**changes: Any) -> dict[str, Any]:
    """All targets just reached, but for the changes."""

    def times(median_us: float, p99_us: float) -> dict[str, float]:
        return {"median": median_us, "p99": p99_us, "max": 9_000.0}

    def row(published: tuple[float, float], loop: tuple[float, float]) -> dict[str, Any]:
        return {"frames": 10, "published_us": times(*published), "loop_us": times(*loop)}

    at = {"on": (1_099.0, 2_499.0), "stalled": (1_099.0, 2_499.0), "code": 0, "took_s": 59.0, "loss_s": 2.0}
    at |= {"opened": True, "mib": 1.0} | changes
    off = (1_000.0, 2_000.0)
    done = {"took_s": at["took_s"], "cpu_s": 1.0, "code": at["code"], "said": "no such thing"}
    slope = {"mib_per_hour": at["mib"], "sigma_mib_per_hour": 0.1}
    tries = [{"loss_s": 0.3, "opened": True}, {"loss_s": at["loss_s"], "opened": at["opened"]}]
    policy = {"frames": 600, "bytes_per_hour": 1e9, "bytes_per_frame": 5e3, "images_dropped": 0}
    loop = {"how": "a stall", "dropped": {"off": 0, "on": 0, "stalled": 7}, "off": row(off, off)}
    machine = {"packages": {}, "commit": "", "date": "", "cpu": "", "cpus": 2, "system": "", "load_before": 0.0}
    return {
        "machine": machine | {"load_after": 0.0, "python": ""},
        "loop": {"a": loop | {"on": row(off, at["on"]), "stalled": row(at["stalled"], off)}},
        "bytes": {"a": {"some": policy}},
        "hour": {
            "written": {"frames": 9, "images": 3, "alerts": 1, "files": 1, "bytes": 1e9, "written_s": 3.0},
            "read": {"report": done, "export": done | {"took_s": 70.0}},
        },
        "killed": {"tries": tries, "span_s": (1.0, 6.0)},
        "memory": {
            "frames": 9, "hours": 1.0, "took_s": 2.0, "written": 9, "dropped": 0, "files": 5,
            "looks": [{"hours": 1.0, "daemon_mib": 100.0, "process_mib": 200.0}],
            "slopes": {"daemon_mib": slope, "process_mib": slope | {"mib_per_hour": 0.0}},
        },
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, []),
        ({"on": (1_101.0, 2_499.0)}, ["whole loop, on: median"]),
        ({"on": (1_099.0, 2_501.0)}, ["whole loop, on: 99 %"]),
        ({"stalled": (1_101.0, 2_501.0)}, ["published, on, disk stalled: median", "published, on, disk stalled: 99 %"]),
        ({"took_s": 60.0}, ["report of an hour"]),
        ({"code": 3}, ["gripmon report of an hour is done", "gripmon export of an hour is done"]),
        ({"loss_s": 2.01}, ["kill -9"]),
        ({"opened": False}, ["opens"]),
        ({"mib": 1.01}, ["daemon's side"]),
        ({"on": (float("nan"), 2_499.0)}, ["whole loop, on: median"]),
    ],
)
def test_what_is_not_reached_is_said(tools_importable: None, changes: dict[str, Any], missed: list[str]):
    from benchmarks import record_report

    made = results(**changes)
    not_met = [what for what, _, met in record_report.verdicts(made) if not met]
    assert len(not_met) == len(missed)
    assert all(part in what for part, what in zip(missed, not_met, strict=True))
    text = record_report.as_text(made)
    assert text.count("NOT MET") == len(missed)
    assert all(part in text for part in ("a stall", "50 GB last", "an hour of recording", "2 times", "MiB an hour"))


def test_a_missed_target_ends_with_code_1(tools_importable: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    import argparse
    import json

    from benchmarks import record

    commands = argparse.ArgumentParser().add_subparsers()
    record.add_parser(commands)
    arguments = commands.choices["record"].parse_args(["--quick", "--json", str(tmp_path / "all.json")])
    for changes, code in (({}, 0), ({"loss_s": 2.1}, 1)):
        monkeypatch.setattr(record, "measure", lambda plans, changes=changes: results(**changes))
        assert record.run(arguments) == code
        assert len(json.loads((tmp_path / "all.json").read_text())["killed"]["tries"]) == 2


def test_quick_measures_everything_with_less(tools_importable: None):
    from benchmarks import record

    full, quick = record.full_plans(), record.quick_plans()
    assert list(full) == list(quick) == [*record.PARTS, "memory"]
    assert quick["killed"] == replace(full["killed"], tries=10)
    assert quick["hour"].frames == full["hour"].frames == 216_000
