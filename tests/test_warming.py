"""What frames need is compiled before the first of them; where that can't be, or can't be kept, a person is told."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from gripmon.model.compiled import Watched, locked
from gripmon.monitor import warm_up, warming

ROOT = Path(__file__).resolve().parent.parent
CLOCK = SimpleNamespace(now_s=0.0)


class Part:
    """Takes a while, and fails some times as numba does that can't write what it has compiled."""

    def __init__(self, failures: int = 0, takes_s: float = 0.0) -> None:
        self.failures, self.takes_s = failures, takes_s

    def warm_up(self) -> None:
        CLOCK.now_s += self.takes_s
        assert Watched.watcher is not None
        if self.takes_s:
            Watched.watcher.missing("kernel.one")
            Watched.watcher.ready("kernel.one")
        if self.failures:
            self.failures -= 1
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def part(monkeypatch: pytest.MonkeyPatch) -> Part:
    made = Part()
    monkeypatch.setattr(warming, "PARTS", {str(number): (made.warm_up,) for number in range(5)})
    monkeypatch.setattr(warming, "_cores", lambda: 1)
    monkeypatch.setattr(warming, "time", SimpleNamespace(perf_counter=lambda: CLOCK.now_s, monotonic=time.monotonic))
    return made


def test_what_is_only_loaded_is_no_news(part: Part):
    assert warm_up() == ""
    assert Watched.watcher is None


def test_a_first_start_says_what_took_so_long(part: Part, caplog: pytest.LogCaptureFixture):
    part.takes_s = 8.0
    with caplog.at_level(logging.INFO, "gripmon"):
        assert warm_up() == "what every frame needs was compiled, in 40 s; the next start loads it"
    assert re.search(r"compiling what every frame needs.*: 0 of \d+, now kernel.one", caplog.text)


def test_where_nobody_reads_the_log_it_is_said_on_stderr(part: Part, capsys: pytest.CaptureFixture[str]):
    """As in `gripmon check` and `teach`, the first commands of a new installation, which said nothing for minutes."""
    part.takes_s = 8.0
    warm_up()
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and re.search(r"compiling what every frame needs.*: 0 of \d+, now kernel.one", said[0])


def test_a_full_disk_costs_time_at_every_start_and_no_start(part: Part):
    part.takes_s, part.failures = 2.0, 7
    said = warm_up()
    assert part.failures == 0, "tried on: each failure is another function that works from then on"
    assert "No space left on device" in said and "NUMBA_CACHE_DIR" in said


def test_the_log_is_not_flooded(part: Part, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    part.takes_s = 1.0
    with caplog.at_level(logging.INFO, "gripmon"):
        warm_up()
    assert len(caplog.records) == 1, "five parts, ten events, within ten seconds"
    monkeypatch.setattr(warming, "SAID_EVERY_S", 0.0)
    with caplog.at_level(logging.INFO, "gripmon"):
        warm_up()
    assert len(caplog.records) == 11


ONE = """
import math
from gripmon.model.compiled import compiled, Watched
from other import FACTOR, third

class Printed:
    def missing(self, name): print("missing", name); return False
    def ready(self, name): print("ready", name)

@compiled
def times(x):
    return FACTOR * x + third(x)

Watched.watcher = Printed()
print(times(3.0), type(times._cache).__name__)
"""
OTHER = """
from gripmon.model.compiled import compiled

FACTOR = {factor}

@compiled
def third(x):
    return {third}
"""


@pytest.fixture
def run_one(tmp_path: Path) -> Callable[..., str]:
    """Runs a program with a compiled function, a constant and a callee from another file; its standard output."""

    def run(
        factor: float = 2.0, third: str = "x / 3.0", cache: Path = tmp_path / "cache", one: str = ONE, **more: str
    ) -> str:
        (tmp_path / "one.py").write_text(one)
        (tmp_path / "other.py").write_text(OTHER.format(factor=factor, third=third))
        environment = os.environ | {"NUMBA_CACHE_DIR": "" if cache == Path() else str(cache)} | more
        said = subprocess.run(
            [sys.executable, "-B", tmp_path / "one.py"], env=environment, capture_output=True, text=True, timeout=300
        )
        assert (said.returncode, said.stderr) == (0, "")
        return said.stdout

    return run


def test_a_constant_of_another_file_is_noticed(run_one: Callable[..., str]):
    """Numba itself compares a function's own file alone: the second program gave 7.0 once more."""
    assert "7.0 Kept" in run_one() and "missing" not in run_one()
    changed = run_one(factor=10.0)
    assert "31.0 Kept" in changed and "missing __main__.times" in changed


def test_a_callee_of_another_file_is_noticed(run_one: Callable[..., str]):
    run_one()
    assert "12.0 Kept" in run_one(third="2.0 * x")


def test_a_caller_is_compiled_with_a_callee_that_was_loaded(tmp_path: Path, run_one: Callable[..., str]):
    """Whose bitcode is parsed only then: it is inlined as if both had been compiled."""
    run_one()
    changed = run_one(one=ONE.replace("return FACTOR", "return 1.0 + FACTOR"))
    assert "8.0 Kept" in changed and "missing __main__.times" in changed
    assert "ready other.third" in changed and "missing other.third" not in changed


@pytest.mark.parametrize("kept", [True, False])
def test_where_nothing_can_be_kept_functions_are_compiled_all_the_same(
    tmp_path: Path, run_one: Callable[..., str], kept: bool
):
    """A service without a home on a read-only system: no folder can be written to, whatever NUMBA_CACHE_DIR says."""
    (tmp_path / "__pycache__").touch()  # no folder, and none can be made in its place
    (nowhere := tmp_path / "file").touch()
    cache = tmp_path / "cache" if kept else nowhere / "cache"
    said = run_one(cache=cache, HOME=str(nowhere), XDG_CACHE_HOME=str(nowhere))
    assert f"7.0 {'Kept' if kept else 'Unkept'}" in said
    assert "missing __main__.times" in said and "ready __main__.times" in said
    assert any(tmp_path.glob("cache/*/*.nbi")) == kept


READ_ONLY = """
import errno, os, tempfile

made = tempfile.TemporaryFile

def refuse(dir):  # by which numba tries whether a folder may be written
    if os.path.basename(dir) == "__pycache__":
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))
    return made(dir=dir)

tempfile.TemporaryFile = refuse
"""


@pytest.mark.parametrize("home", [True, False])
def test_what_was_compiled_when_it_was_installed_is_loaded_where_nothing_may_be_written(
    tmp_path: Path, run_one: Callable[..., str], home: bool
):
    """A wheel that another user installed, or a container's image; with a home of one's own, and without."""
    (nowhere := tmp_path / "file").touch()
    where = {"cache": Path(), "HOME": str(nowhere), "XDG_CACHE_HOME": str(tmp_path / "home" if home else nowhere)}
    assert "missing other.third" in run_one(**where)
    assert any((tmp_path / "__pycache__").glob("*.nbi"))
    installed = {**where, "one": READ_ONLY + ONE}
    assert "missing other.third" not in run_one(**installed)
    # Another program, which nobody compiled when it was installed.
    assert "10.0 Kept" in run_one(3.0, **installed)
    assert ("missing __main__.times" in run_one(3.0, **installed)) is not home
    assert any(tmp_path.glob("home/**/*.nbi")) == home


def test_a_lock_waits_and_gives_up(tmp_path: Path):
    path, waits = tmp_path / "lock", []
    with locked(path, fcntl.LOCK_EX, 0.0) as first, locked(path, fcntl.LOCK_EX, 0.1, lambda: waits.append(1)) as second:
        assert first and not second and waits
    with locked(path, fcntl.LOCK_SH, 0.0) as one, locked(path, fcntl.LOCK_SH, 0.0) as two:
        assert one and two
    with locked(tmp_path / "no" / "lock", fcntl.LOCK_EX, 0.0) as nowhere:
        assert not nowhere


HELPED = """
import logging, sys
from gripmon.monitor import warming

warming.PARTS = {name: warming.PARTS[name] for name in ("averages", "drift")}
warming._cores = lambda: 2
logging.basicConfig(level=logging.INFO, stream=sys.stdout)
warming.SAID_EVERY_S = 0.0
print(warming.warm_up())
print("misses", sum(sum(f._cache_misses.values()) for f in warming.FUNCTIONS))
"""


@pytest.mark.slow("40; the other tests of this file, and that every run of the suite begins with this")
def test_several_starts_at_once_compile_once_and_share_it(tmp_path: Path):
    """Three programs at once, nothing compiled yet: what each part needs is compiled by one of six processes."""
    shutil.copytree(ROOT / "gripmon", tmp_path / "gripmon", ignore=shutil.ignore_patterns("__pycache__"))
    environment = os.environ | {"NUMBA_CACHE_DIR": "", "PYTHONPATH": str(tmp_path)}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", HELPED], env=environment, stdout=subprocess.PIPE, text=True, cwd=tmp_path
        )
        for _ in range(3)
    ]
    texts = [process.communicate(timeout=600)[0] for process in started]
    assert all(process.returncode == 0 for process in started)
    assert any("now drift.kernel" in text and "now judge.smoothing" in text for text in texts)
    first = [text for text in texts if "another process compiles the same" not in text]
    assert len(first) == 1
    for text in set(texts) - set(first):
        assert int(text.rpartition("misses")[2]) <= 1


KNOCKED = """
import sys
from gripmon.daemon.config import builtin_config, load_config
from gripmon.monitor import Monitor, warm_up
from gripmon.simulate import Scenario
from gripmon.simulate.scenario import Bump

def compiled():
    rooms = [room for name, room in sys.modules.items() if name.startswith("gripmon.")]
    return {f: len(f.signatures) for room in rooms for f in vars(room).values() if hasattr(f, "nopython_signatures")}

config = load_config(builtin_config("demo.yaml"), check_source=False)
scenario = Scenario(name="knock", duration_s=1.0, fps=60.0, mount=(Bump(at_s=0.25, translation_m=(0.0, 1e-3, 2e-3)),))
simulator = config.scene.simulator(scenario, seed=1)
frames = [simulator.frame(k) for k in range(30)]
warm_up()
before = compiled()
monitor = Monitor(config.camera, config.gripper, config.settings.monitor, config.reference)
for frame in frames:
    monitor.process(frame)
print(sorted(f"{f.py_func.__module__}.{f.py_func.__name__}" for f, n in compiled().items() if n != before.get(f, 0)))
"""


def test_after_a_start_no_frame_compiles():
    """Neither the first frames nor a knock and what follows it, in a process that has compiled nothing else."""
    done = subprocess.run([sys.executable, "-c", KNOCKED], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["[]"]), done.stdout + done.stderr
