"""A process of our own: what it gets, how it ends, and that the program's main module has no part in it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from gripmon.model.own_process import OwnProcess

ROOT = Path(__file__).resolve().parent.parent
UNGUARDED = """
import pickle, sys, threading
from pathlib import Path
print("begins")

class Mine:
    pass

stopped, wrong = threading.Event(), []
def pickling():
    while not stopped.is_set():
        try:
            pickle.dumps(Mine())
        except Exception as error:
            wrong.append(error)

pickling_thread = threading.Thread(target=pickling, daemon=True)
pickling_thread.start()
from support.recorded import frame, record, recorder
for turn in range(3):
    opened = recorder(Path(sys.argv[1]) / str(turn))
    opened.frame(frame(0), record(0), lambda: None)
    opened.close(60.0)
    assert opened.frames_written == 1, opened.failure
stopped.set()
pickling_thread.join()
print(len(wrong), wrong[:1])
"""


def write_words(descriptor: int, *words: str) -> None:
    os.write(descriptor, " ".join(words).encode())


def fail() -> None:
    raise ArithmeticError("no result")


def wait_for_the_end(descriptor: int) -> None:
    os.read(descriptor, 1)


def test_it_does_what_it_is_told_with_what_it_inherits():
    reads, writes = os.pipe()
    process = OwnProcess(write_words, writes, "two", "words", inherits=(writes,))
    os.close(writes)
    with os.fdopen(reads) as pipe:
        assert pipe.read() == "two words"
    assert process.ended_within(60.0) and process.returncode == 0 and not process.runs


def test_what_it_raises_is_its_exit_code(capfd: pytest.CaptureFixture[str]):
    assert OwnProcess(fail, quiet=True).wait(60.0) == 1
    assert capfd.readouterr().err == ""
    assert OwnProcess(fail).wait(60.0) == 1
    assert "ArithmeticError: no result" in capfd.readouterr().err


def test_signals_for_its_parent_s_group_don_t_reach_it():
    reads, writes = os.pipe()
    process = OwnProcess(wait_for_the_end, reads, inherits=(reads,))
    os.close(reads)
    assert os.getpgid(process.pid) != os.getpgid(0)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(process.pid, number)
    assert not process.ended_within(0.5)
    os.close(writes)
    assert process.wait(60.0) == 0
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & {signal.SIGINT, signal.SIGTERM}, "ours are as before"


def test_one_that_is_left_is_reaped():
    reads, writes = os.pipe()
    process = OwnProcess(wait_for_the_end, reads, inherits=(reads,))
    os.close(reads)
    pid = process.pid
    process.leave()
    del process
    os.close(writes)
    end_s = time.monotonic() + 60.0
    while psutil.pid_exists(pid) and time.monotonic() < end_s:
        time.sleep(0.01)
    assert not psutil.pid_exists(pid)
    assert "left process" not in {thread.name for thread in threading.enumerate() if not thread.daemon}


def test_a_script_without_a_guard_records_while_it_pickles_its_own_classes(tmp_path: Path):
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    command = [sys.executable, str(script), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=100.0)
    assert (done.returncode, done.stdout) == (0, "begins\n0 []\n"), done.stderr
