"""What frames need is compiled before the first of them; where that can't be, or can't be kept, a person is told."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from gripmon.monitor import warm_up, warming


class Part:
    """Takes a while, and fails some times as numba does that can't write what it has compiled."""

    def __init__(self, failures: int = 0, takes_s: float = 0.0) -> None:
        self.failures, self.takes_s = failures, takes_s

    def warm_up(self) -> None:
        CLOCK.now_s += self.takes_s
        if self.failures:
            self.failures -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


CLOCK = SimpleNamespace(now_s=0.0)


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> Part:
    made = Part()
    for name in ("edges", "integrity", "drift", "smoothing", "poses"):
        monkeypatch.setattr(warming, name, made)
    monkeypatch.setattr(warming, "time", SimpleNamespace(perf_counter=lambda: CLOCK.now_s))
    return made


def test_what_is_only_loaded_is_no_news(part: Part):
    part.takes_s = 0.1
    assert warm_up() == ""


def test_a_first_start_says_what_took_so_long(part: Part):
    part.takes_s = 8.0
    assert warm_up() == "what every frame needs was compiled, in 40 s; the next start loads it"


def test_who_waits_for_the_compiler_reads_for_what(part: Part, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(warming, "LOADED_WITHIN_S", 0.01)
    said = threading.Event()
    monkeypatch.setattr(warming._log, "info", lambda text: said.set() if text.startswith("compiling") else None)
    monkeypatch.setattr(part, "warm_up", lambda: said.wait(10.0))
    warm_up()
    assert said.is_set()


def test_a_full_disk_costs_time_at_every_start_and_no_start(part: Part):
    part.takes_s, part.failures = 2.0, 7
    said = warm_up()
    assert part.failures == 0, "tried on: each failure is another function that works from then on"
    assert "No space left on device" in said and "NUMBA_CACHE_DIR" in said


DOUBLED = """
from gripmon.model.compiled import compiled

@compiled
def double(x):
    return x + x

assert double(21.0) == 42.0
print(len(double.signatures), double._cache.__class__.__name__)
"""


@pytest.mark.parametrize("kept", [True, False])
def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(tmp_path: Path, kept: bool):
    """A service without a home on a read-only system: no folder can be written to, whatever NUMBA_CACHE_DIR says."""
    (tmp_path / "doubled.py").write_text(DOUBLED)
    (tmp_path / "__pycache__").touch()  # no folder, and none can be made in its place
    (nowhere := tmp_path / "file").touch()
    cache = tmp_path / "cache" if kept else nowhere / "cache"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "HOME": str(nowhere), "XDG_CACHE_HOME": str(nowhere)}
    said = subprocess.run(
        [sys.executable, tmp_path / "doubled.py"], env=environment, capture_output=True, text=True, timeout=300
    )
    assert (said.returncode, said.stderr) == (0, "")
    assert said.stdout.split() == ["1", "FunctionCache" if kept else "NullCache"]
    assert any(tmp_path.glob("cache/*/*.nbi")) == kept
