"""Files that are there whole or not at all, and what is no file."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from gripmon.model.atomic import opened_atomically, write_atomically


def test_a_fault_leaves_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "kept").write_bytes(b"old")

    def write() -> None:
        with opened_atomically(tmp_path / "kept") as file:
            file.write(b"new")
            (tmp_path / "missing").open("rb")

    with pytest.raises(FileNotFoundError):
        write()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"kept": b"old"}


def test_what_is_no_file_is_written_to_and_stays_what_it_is(tmp_path: Path) -> None:
    """Written to ``/dev/null``, whoever may would otherwise have a file there from then on."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK), "rb") as reader:
        write_atomically(pipe, b"told")
        assert reader.read() == b"told"
    assert stat.S_ISFIFO(pipe.stat().st_mode) and list(tmp_path.iterdir()) == [pipe]


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(IsADirectoryError):
        write_atomically(tmp_path, b"told")
