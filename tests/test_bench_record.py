"""``tools/bench record`` in small: every part measures what it says.  No speed is asserted."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

TOOLS = Path(__file__).resolve().parent.parent / "tools"
SIZE = (384, 288)

pytestmark = pytest.mark.usefixtures("tools_importable")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(TOOLS))
        from benchmarks import rings

        path = tmp_path_factory.mktemp("frames") / "ring.npz"
        rings.render(SIZE, 6, path, "quiet")
    return path


@pytest.fixture
def ring(tools_importable: None, rendered: Path) -> Path:
    return rendered


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
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


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
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


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
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


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
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


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
def test_kills_are_counted_and_what_they_cost(ring: Path):
    from benchmarks import record_killed

    plan = record_killed.Plan(size=SIZE, ring=6, tries=1, span_s=(1.0, 1.0))
    (tried,) = record_killed.measure(ring, plan)["tries"]
    assert tried["delivered"] >= tried["in_file"] > 0 and tried["opened"]
    assert tried["loss_s"] == pytest.approx((tried["delivered"] - tried["in_file"]) / 60.0)


@pytest.mark.slow("15 s: a benchmark in small; recordings have tests of their own")
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
