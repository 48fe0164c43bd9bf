"""The parts of rerun that it doesn't call public: used in one place, and missed in words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import rerun as rr

from gripmon.record.container import RerunChangedError
from gripmon.record.files import FileSeries
from gripmon.record.recorder import make_scene

GRIPMON = Path(__file__).resolve().parent.parent / "gripmon"


def test_they_are_used_in_one_file_alone():
    private = re.compile(r"\brr\.bindings|rerun_bindings|\._chunk_index|rerun\.\w*\._|rerun\._")
    using = {path.name for path in GRIPMON.rglob("*.py") if private.search(path.read_text())}
    assert using <= {"container.py"}


def test_a_recorder_that_could_not_free_its_files_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from support.recorded import CAMERA, GRIPPER, REFERENCE, settings

    monkeypatch.delattr(rr.bindings, "flush_and_cleanup_orphaned_recordings")
    scene = make_scene(settings(), str(tmp_path), "run", "arm", "wrist", CAMERA, GRIPPER, REFERENCE)
    series = FileSeries(scene)
    with pytest.raises(
        RerunChangedError, match=r"has no rerun\.bindings\.flush_and_cleanup_orphaned_recordings; gripmon"
    ):
        series.write()
