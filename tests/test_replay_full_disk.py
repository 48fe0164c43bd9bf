"""``gripmon replay … --recording FILE`` where the disk has no room for it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.gripmon_process import GRIPMON
from support.small_disks import small_disk

from gripmon.cli import main
from gripmon.record.read import open_recordings

ROOT = Path(__file__).resolve().parent.parent
DISK_BYTES = 3_000_000


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images whose recording is larger than the disk, with their configuration."""
    out = tmp_path_factory.mktemp("simulated") / "creep"
    assert main(["simulate", "creep", "--out", str(out), "--seconds", "2", "--fps", "10", "--seed", "2"]) == 0
    with (out / "config.yaml").open("a") as file:
        file.write("recording: {image_every: 1, image_format: png, min_free_bytes: 0}\n")
    return out


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", DISK_BYTES) as place:
        yield place


def test_a_recording_that_has_no_room_leaves_what_was_there(sequence: Path, disk: Path, tmp_path: Path):
    """A replay of images, and of a recording, which is drawn beside it."""
    then, wanted = tmp_path / "then.rrd", disk / "wanted.rrd"
    images = (str(sequence), "--config", str(sequence / "config.yaml"))
    assert main(["replay", *images, "--out", str(tmp_path / "then.jsonl"), "--recording", str(then)]) == 0
    assert then.stat().st_size > DISK_BYTES
    wanted.write_text("old")
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    for inputs in (images, (str(then),)):
        out = tmp_path / "again.jsonl"
        command = [*GRIPMON, "replay", *inputs, "--out", str(out), "--recording", str(wanted)]
        # The recorder is given a minute for its end: one that has failed needs none of it.
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=55.0)
        assert done.returncode == 3, done.stderr
        *summary, fault = done.stderr.splitlines()
        assert all(line.startswith("replay: ") for line in summary), done.stderr
        assert fault.startswith(f"--recording {wanted}: writing failed (") and fault.endswith(" MB free)")
        assert wanted.read_text() == "old" and list(disk.iterdir()) == [wanted]
        assert len(out.read_bytes().splitlines()) == 20, "the lines are there all the same"


def test_a_log_that_the_user_asks_for_is_his(sequence: Path, tmp_path: Path):
    """rerun's own lines, silenced else."""
    said = {}
    for level in (None, "debug"):
        environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
        environment |= {} if level is None else {"RUST_LOG": level}
        command = [*GRIPMON, "replay", str(sequence), "--config", str(sequence / "config.yaml"), "--out", os.devnull]
        command += ["--recording", str(tmp_path / "told.rrd")]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=True)
        said[level] = done.stderr.splitlines()
        (run,) = open_recordings([tmp_path / "told.rrd"]).recordings
        assert len(run.frames) == 20
    assert len(said[None]) == 1 and len(said["debug"]) > 1, "the summary"
