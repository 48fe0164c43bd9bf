"""The loop first: what works beside it gives way on a shared core.  No privilege is needed for that."""

from __future__ import annotations

import contextlib
import os
import threading

NICENESS = 5
"""By how much (steps of Linux's niceness, each a factor of 1.25 in time) renderers and the recording stand back.  At 10
a recording process waited for seconds on a busy machine.
"""

_MOST = 19


def give_way() -> None:
    """Lower the priority of the calling thread, and of threads and processes that it starts from then on."""
    with contextlib.suppress(OSError):
        thread = threading.get_native_id()
        now = os.getpriority(os.PRIO_PROCESS, thread)  # Linux: a thread's number is taken, too
        os.setpriority(os.PRIO_PROCESS, thread, min(now + NICENESS, _MOST))
