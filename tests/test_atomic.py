"""Files that are there whole or not at all, and what is no file."""

from __future__ import annotations

import ast
import os
import stat
from pathlib import Path

import pytest

from gripmon.model.atomic import opened_atomically, write_atomically

PACKAGE = Path(__file__).resolve().parent.parent / "gripmon"
OTHERWISE = {
    "model/atomic.py",
    "daemon/estimates.py",  # lines, as they come
    "cli/alert_log.py",
    "analyse/dataset.py",  # a temporary file that is renamed, and one that is only locked
    "daemon/starting.py",  # whether lines can be written there
    "cli/look_back.py",
    "cli/common.py",
    "daemon/simulated.py",  # folders that were empty before
    "simulate/sequence.py",
    "simulate/calibration_images.py",
    "daemon/config/recorded.py",  # temporary folders
    "record/rrd.py",  # what is whole of a damaged recording, in one
}
"""Files of the product that write without :mod:`gripmon.model.atomic`, and why they may."""


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


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept"
    path.write_bytes(b"old")

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gripmon.model.atomic.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o644 & ~mask, "as any other file, not private"


def writes(call: ast.Call) -> bool:
    """Whether a call opens a file to be written, or writes one."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
    opens = name in ("open", "fdopen") and any(isinstance(m, str) and set(m) & set("wxa") and len(m) < 4 for m in modes)
    return opens or name in ("write_text", "write_bytes", "imwrite")


def test_every_file_of_the_product_is_written_so() -> None:
    """Whatever a command writes: a fault, or a full disk, leaves what was there before."""
    assert writes(ast.parse("p.open('wb')").body[0].value) and not writes(ast.parse("p.open('rb')").body[0].value)  # type: ignore[attr-defined]
    found = set()
    for path in PACKAGE.rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        found |= {path.relative_to(PACKAGE).as_posix() for call in calls if writes(call)}
    assert found == OTHERWISE
