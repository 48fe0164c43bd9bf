"""SIGINT and SIGTERM at any moment between the first import and the end: none is lost, whatever Python does with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from support.daemon_bench import Bench

from gripmon.io.sources.realtime import SimulatedCamera
from gripmon.model.records import Frame
from gripmon.model.stopping import StopRequest, interrupts_kept, signals_exit

HERE = Path(__file__).resolve().parent


class Dying:
    """Something that is let go while a signal arrives: Python drops what its handler raises."""

    def __init__(self, number: signal.Signals) -> None:
        self._number = number

    def __del__(self) -> None:
        signal.raise_signal(self._number)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_one_that_python_drops_during_the_start_up_ends_the_loop_at_once(number: signal.Signals, code: int):
    bench = Bench(range(50))
    with signals_exit() as stop:
        dying = Dying(number)
        del dying  # nothing is raised here
        assert bench.run(stop=stop) == code
    assert bench.network.transforms == []
    assert bench.source.closed and bench.network.closed and bench.recording.closed


def test_one_that_python_drops_interrupts_a_command_a_moment_later():
    """As `replay` did: it went on to its end, exit code 0."""

    def work() -> None:
        dying = Dying(signal.SIGINT)
        del dying  # nothing is raised here
        time.sleep(30.0)

    before = sys.unraisablehook
    with pytest.raises(KeyboardInterrupt), interrupts_kept():
        work()
    assert sys.unraisablehook is before


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_during_the_start_up_it_raises_what_closes_everything(number: signal.Signals, error: type[BaseException]):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(error) as caught, signals_exit():
        signal.raise_signal(number)
    assert getattr(caught.value, "code", 0) == 0
    assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


def test_a_background_job_that_ignores_ctrl_c_is_interrupted_as_well_while_it_starts():
    """A shell starts ``gripmon run … &`` in a script with SIGINT ignored; the loop hears it all the same."""
    code = (
        "import signal; from gripmon.model.stopping import signals_exit\n"
        "assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN\n"
        "with signals_exit():\n    signal.raise_signal(signal.SIGINT)\n"
    )
    job = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-c", code]
    done = subprocess.run(job, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(HERE.parent)})
    assert "KeyboardInterrupt" in done.stderr, done.stderr


class NeverReady:
    """Frames that no one lives to see."""

    def frame(self, index: int) -> Frame:
        time.sleep(600.0)
        raise AssertionError


def test_one_that_another_thread_takes_ends_the_wait_for_a_camera():
    """It wakes no system call of the main thread's; so does one that comes right before such a call."""

    def interrupt() -> None:
        time.sleep(1.0)
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    begun_s = time.monotonic()
    with signals_exit():
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            SimulatedCamera(NeverReady(), size_px=(8, 8), fps=10.0, name="slow")
    thread.join()
    assert time.monotonic() - begun_s < 30.0, "half of what a camera that starts is given"


def test_in_another_thread_signals_are_left_alone():
    stops: list[StopRequest] = []

    def start() -> None:
        with signals_exit() as stop:
            stops.append(stop)

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=start)
    thread.start()
    thread.join(20.0)
    assert signal.getsignal(signal.SIGINT) is before
    assert stops[0].exit_code is None
