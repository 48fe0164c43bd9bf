"""Another Python process that does one piece of our work.

:mod:`multiprocessing` imports the program's main module in each process that it spawns: anybody's script, which may
have no guard.  It takes that module from this process's ``sys.modules``, which belongs to the program's other threads,
too.  Here the main module has no part in it.
"""

from __future__ import annotations

import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

_HOME = str(Path(__file__).resolve().parents[2])
_BEGIN = (
    "import sys; home = sys.argv[1]; home in sys.path or sys.path.insert(0, home); "
    "from gripmon.model.own_process import begin; begin()"
)
_FOR_THE_PARENT = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class OwnProcess(subprocess.Popen[bytes]):
    """A process that calls ``work(*given)`` and ends; with exit code 1 if that raises.

    It has this process's ``sys.path``, and writes nothing but to stderr.  Signals for this process's group (Ctrl-C, the
    SIGTERM of a service manager) don't reach it: whoever starts it tells it to end, by the end of a pipe.
    """

    def __init__(
        self, work: Callable[..., None], *given: Any, inherits: Sequence[int] = (), quiet: bool = False
    ) -> None:
        """``work`` and what it is ``given`` travel by pickle; the descriptors that it ``inherits`` keep their numbers.
        ``quiet``: stderr is dropped, too.  Raises OSError if no process can be started.
        """
        told = pickle.dumps(sys.path) + pickle.dumps((work, given))
        former = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_THE_PARENT)  # it inherits the mask
        try:
            super().__init__(
                [sys.executable, "-P", "-c", _BEGIN, _HOME], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL if quiet else None, pass_fds=inherits, start_new_session=True,
            )  # fmt: skip
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, former)
        assert self.stdin is not None
        try:
            with self.stdin:
                self.stdin.write(told)
        except OSError:
            self.end()
            raise

    @property
    def runs(self) -> bool:
        return self.poll() is None

    def ended_within(self, wait_s: float) -> bool:
        """Wait for its end for this long at most."""
        try:
            self.wait(wait_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def end(self) -> None:
        """Kill it, and wait for its end."""
        self.kill()
        self.wait()

    def leave(self) -> None:
        """Let it go on by itself; nothing waits for it."""
        threading.Thread(target=self.wait, name="left process", daemon=True).start()


def begin() -> None:
    """In the new process: what it is told to do; nothing if its parent is gone before that."""
    try:
        sys.path[:] = pickle.load(sys.stdin.buffer)
        if _HOME not in sys.path:
            sys.path.append(_HOME)
        work, given = pickle.load(sys.stdin.buffer)
    except (EOFError, pickle.UnpicklingError):
        sys.exit(1)
    work(*given)
