"""Rendered images that are kept: the same as when they were made, and made anew when anything else would make them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import kept

calls: list[object] = []


@kept.kept
def drawn(seed: int, shade: np.ndarray) -> list[np.ndarray]:
    calls.append(seed)
    return [shade + seed]


def written(folder: Path, text: str) -> None:
    calls.append(text)
    folder.mkdir()
    (folder / "a.txt").write_text(text)


@pytest.fixture(autouse=True)
def _own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FOLDER", tmp_path / "kept")
    monkeypatch.setattr(kept, "_SET", None)
    calls.clear()


def test_images_are_made_once_for_each_arguments_and_sources(monkeypatch: pytest.MonkeyPatch):
    first, again = drawn(1, np.arange(3)), drawn(1, np.arange(3))
    np.testing.assert_array_equal(first[0], again[0])
    again[0][:] = 0  # a test may draw on what it gets
    assert drawn(1, shade=np.arange(3))[0].tolist() == drawn(1, np.arange(3))[0].tolist() == [1, 2, 3]
    assert calls == [1, 1]
    drawn(1, np.arange(4)), drawn(2, np.arange(3))
    monkeypatch.setattr(kept, "_sources", lambda: b"a changed simulator")
    drawn(1, np.arange(3))
    assert calls == [1, 1, 1, 2, 1]


def test_what_is_damaged_is_made_anew():
    drawn(1, np.arange(3))
    (path,) = kept.FOLDER.iterdir()
    path.write_bytes(path.read_bytes()[:20])
    assert drawn(1, np.arange(3))[0].tolist() == [1, 2, 3] and calls == [1, 1]


def test_folders_are_copies_and_an_unfinished_one_is_none(tmp_path: Path):
    def fails(folder: Path) -> None:
        folder.mkdir()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kept.copied(fails, tmp_path / "never")
    assert not list(kept.FOLDER.iterdir())
    kept.copied(written, tmp_path / "one", "x")
    (tmp_path / "one" / "a.txt").write_text("spoilt")
    kept.copied(written, tmp_path / "two", "x")
    assert (tmp_path / "two" / "a.txt").read_text() == "x" and calls == ["x"]


def test_the_oldest_are_forgotten(monkeypatch: pytest.MonkeyPatch):
    drawn(1, np.arange(1000))
    (old,) = kept.FOLDER.iterdir()
    drawn(2, np.arange(1000))
    monkeypatch.setattr(kept, "MOST_BYTES", 10_000)
    kept.forget_the_oldest()
    (left,) = kept.FOLDER.iterdir()
    assert left != old
