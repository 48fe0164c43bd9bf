"""The state file on a disk that doesn't play along, and what is on it when."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from support.state_files import DATA, STATE, beside, opened, read_once, state_of, write
from test_references import broken

from gripmon.judge.statefile import (
    StateFileError,
    unpack,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "arm.json"


def test_a_folder_that_can_not_be_made_is_said_and_nothing_is_kept(tmp_path: Path):
    (tmp_path / "a-file").write_text("x")
    path = tmp_path / "a-file" / "state" / "arm.json"
    file = opened(path)
    assert file.state is None and file.failure.startswith("state not kept: ")
    assert not file.write(STATE) and "Not a directory" in file.failure
    file.close()


def test_a_folder_without_the_right_to_write_still_gives_its_state(path: Path, monkeypatch: pytest.MonkeyPatch):
    """As on a disk that the kernel has made read-only after an error."""
    write(path, DATA)
    real = os.open

    def read_only(name: object, flags: int, *rest: int, **named: object) -> int:
        if flags & os.O_CREAT:
            raise OSError(errno.EROFS, "Read-only file system")
        return real(name, flags, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("gripmon.judge.statefile.os.open", read_only)
    file = opened(path)
    assert file.state == STATE
    assert file.failure == f"state not kept: {path}.lock can't be locked: Read-only file system"
    assert not file.write(STATE)
    assert path.read_bytes() == DATA


def test_a_damaged_file_that_can_not_be_set_aside_is_not_overwritten(path: Path, monkeypatch: pytest.MonkeyPatch):
    write(path, b"damage")

    def forbidden(self: Path, target: object) -> Path:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "rename", forbidden)
    file = opened(path)
    assert "damaged" in file.notices[0] and "not used" in file.notices[0]
    assert not file.write(STATE) and "can't be set aside: Operation not permitted" in file.failure
    assert path.read_bytes() == b"damage"


def test_a_full_disk_leaves_the_last_state_and_is_over_when_it_is_over(path: Path, monkeypatch: pytest.MonkeyPatch):
    file = opened(path)
    assert file.write(STATE)
    with monkeypatch.context() as patched:

        def full(_: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

        patched.setattr("gripmon.model.atomic.os.fsync", full)
        assert not file.write(state_of("a"))
        assert file.failure == f"state not kept: {path} can't be written: No space left on device"
        assert unpack(path.read_bytes()).state == STATE and beside(path) == ["arm.json"]
    assert file.write(state_of("a")) and file.failure == ""
    assert unpack(path.read_bytes()).state == state_of("a")


@pytest.mark.parametrize("what", ["a pipe", "a folder"])
def test_what_is_no_file_is_refused_and_not_waited_for(path: Path, what: str):
    path.parent.mkdir()
    os.mkfifo(path) if what == "a pipe" else path.mkdir()
    with pytest.raises(StateFileError, match=r"arm\.json is (no regular file|a folder); a file"):
        opened(path)
    assert path.exists()


def test_what_could_not_be_read_again_is_not_written(path: Path):
    """NaN is null in JSON: a state with one would be lost as a whole."""
    file = opened(path)
    assert file.write(STATE)
    assert not file.write(state_of("a", probability=float("nan")))
    assert "internal error in the state, the last sound one is kept" in file.failure
    assert not file.write(broken("parent"))
    assert unpack(path.read_bytes()).state == STATE


def test_a_link_leads_to_the_file_and_stays(tmp_path: Path, path: Path):
    link = tmp_path / "link.json"
    link.symlink_to(path)
    file = opened(link)
    assert file.write(STATE)
    with pytest.raises(StateFileError, match="in use"):
        opened(path)
    file.close()
    assert link.is_symlink() and read_once(path).state == read_once(link).state == STATE


def test_file_and_folder_are_on_the_disk_before_writing_ends(path: Path, monkeypatch: pytest.MonkeyPatch):
    """A power cut after that takes nothing back: first the content, then the name."""
    file = opened(path)
    assert file.write(state_of("a"))
    synced, real = [], os.fsync

    def noted(descriptor: int) -> None:
        named = Path(f"/proc/self/fd/{descriptor}").readlink()
        synced.append(
            (named.name.startswith(".arm.json-"), named == path.parent, unpack(path.read_bytes()).state == STATE)
        )
        real(descriptor)

    monkeypatch.setattr("gripmon.model.atomic.os.fsync", noted)
    assert file.write(STATE)
    assert synced == [(True, False, False), (False, True, True)]


def test_leftovers_of_killed_writers_are_cleared_but_nothing_else(path: Path):
    write(path, DATA)
    others = [".arm.json-0a1b2c3d.tmp.keep", ".arms.json-0a1b2c3d.tmp", "arm.json-1.tmp", "arm.json.damaged-1"]
    for name in (".arm.json-0a1b2c3d.tmp", *others):
        (path.parent / name).write_text("x")
    read_once(path)
    assert beside(path) == sorted(["arm.json", *others])
