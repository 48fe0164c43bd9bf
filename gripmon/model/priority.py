"""The loop first: processes that work beside it give way on a shared core.  No privilege is needed for that.

Threads of its own process don't: one that holds the interpreter lock and has to wait for a core makes the loop wait.
The analysis beside the frames yields that lock within half a millisecond instead (``daemon.running``); with real-time
priority, which the system has to allow, neither waits for other programs.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

NICENESS = 5
"""By how much (steps of Linux's niceness, each a factor of 1.25 in time) renderers and the recording stand back.  At 10
a recording process waited for seconds on a busy machine.
"""

_MOST = 19
_BESIDE, _LOOP = 1, 2  # the lowest of Linux's real-time priorities: above all that has none, below what a driver takes
_THREADS = Path("/proc/self/task")


def give_way() -> None:
    """Lower the priority of the calling thread, and of threads and processes that it starts from then on, for good."""
    with contextlib.suppress(OSError):
        thread = threading.get_native_id()
        if _is_real_time(thread):
            os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0))
        now = os.getpriority(os.PRIO_PROCESS, thread)  # Linux: a thread's number is taken, too
        os.setpriority(os.PRIO_PROCESS, thread, min(now + NICENESS, _MOST))


def stand_beside() -> None:
    """The calling thread is less urgent than the one that started it, but holds the interpreter lock as that does: of
    real-time priority, where that has one, but below it.
    """
    thread = threading.get_native_id()
    if _is_real_time(thread):
        os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(_BESIDE))


@contextlib.contextmanager
def real_time() -> Iterator[tuple[bool, str]]:
    """Real-time priority for all threads of this process, above the others for the calling one, until the end of the
    context.  Yields whether the system gave it, and in one line what, or why not; never raises for that.
    """
    if not _THREADS.is_dir():
        yield False, "real-time priority was asked for, and this system gives none to single threads: it needs Linux"
        return
    calling = threading.get_native_id()
    try:
        _set_all(os.SCHED_RR, _BESIDE)
        os.sched_setscheduler(calling, os.SCHED_RR, os.sched_param(_LOOP))
    except OSError as error:
        _set_all(os.SCHED_OTHER, 0)
        why = f"real-time priority was asked for, and the system refused it ({error.strerror}): "
        yield False, why + f"allow priority {_LOOP}, by LimitRTPRIO={_LOOP} of the service, or ulimit -r {_LOOP}"
        return
    cores = ", ".join(map(str, sorted(os.sched_getaffinity(calling))))
    try:
        yield True, f"real-time priority {_LOOP} for the loop, {_BESIDE} for what works beside it; cores {cores}"
    finally:
        _set_all(os.SCHED_OTHER, 0)


def _is_real_time(thread: int) -> bool:
    return hasattr(os, "SCHED_RR") and os.sched_getscheduler(thread) == os.SCHED_RR


def _set_all(policy: int, priority: int) -> None:
    """For all threads of this process.  One that has ended meanwhile needs none."""
    for thread in sorted(int(each.name) for each in _THREADS.iterdir()):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setscheduler(thread, policy, os.sched_param(priority))
