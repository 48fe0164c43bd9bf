"""Machine code for the frames' arithmetic, loaded or compiled before the first frame."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from gripmon.judge import causes, drift, repeats, smoothing, stream
from gripmon.model import poses
from gripmon.model.compiled import FUNCTIONS, Kept, Watched, locked
from gripmon.model.own_process import OwnProcess
from gripmon.track import edges, integrity, look

_log = logging.getLogger(__name__)

PARTS: dict[str, tuple[Callable[[], object], ...]] = {
    "protection level": (integrity.warm_up,),
    "joint fit": (edges.warm_up_fit,),
    "drift": (drift.warm_up,),
    "edge points": (edges.warm_up_profiles,),
    "geometry": (edges.warm_up_geometry,),
    "averages": (smoothing.warm_up, stream.warm_up, repeats.warm_up, causes.warm_up, poses.warm_up, look.warm_up),
}
"""What frames need, in parts that can be compiled at once, the longest first."""

MOST_UNKEPT = 1000
"""Bound on retries for functions that can't be kept on the disk: more than there are functions."""

MOST_HELPERS = 3
"""Processes beside this one: with more there is nothing left to share."""

SAID_EVERY_S = 10.0
"""How often the log says how far the compiler is, where there is no terminal for a bar (s)."""

ANOTHER_TAKES_S = 600.0
"""How long another process that compiles the same is waited for (s): longer than the slowest known, which took 451."""

_DONE = "done"


def warm_up() -> str:
    """Load the machine code that frames need, or compile it in all cores, once on a machine, with a bar on a terminal
    and lines in the log, or on stderr where nobody reads the log, elsewhere; return a message for the user, or an empty
    string.
    """
    begin_s, unkept = time.perf_counter(), ""
    with contextlib.ExitStack() as closing:
        work = _Work(closing)
        Watched.watcher = work
        closing.callback(setattr, Watched, "watcher", None)
        while (part := work.next_part()) is not None:
            unkept = _warm(part) or unkept
        if work.shared():  # load what others compiled, and compile what they couldn't keep
            for part in PARTS:
                unkept = _warm(part) or unkept
    took_s = time.perf_counter() - begin_s
    _log.debug("the arithmetic of frames was ready after %.1f s", took_s)
    if not work.compiles:
        return ""
    text = f"what every frame needs was compiled, in {took_s:.0f} s"
    if unkept := unkept or work.unkept:
        return f"{text}; it can't be kept ({unkept}), so that every start takes as long: set NUMBA_CACHE_DIR"
    return f"{text}; the next start loads it"


def help_compiling(descriptor: int) -> None:
    """In a helping process, until the other end closes: it is sent names of parts, and sends what becomes of which
    function, and ``_DONE`` after each part.
    """
    with contextlib.suppress(EOFError, OSError), Connection(descriptor) as told:
        Watched.watcher = _Told(told)
        while True:
            _warm(told.recv())
            told.send((_DONE, ""))


def _warm(part: str) -> str:
    """Run one part's warm-up; return why its code could not be kept on the disk, or an empty string."""
    unkept = ""
    for warm in PARTS[part]:
        for _ in range(MOST_UNKEPT):
            try:
                warm()
            except OSError as error:  # raised after a function was compiled: it works from then on
                unkept = error.strerror or str(error)
            else:
                break
    return unkept


class _Told:
    """Tells the process that is helped."""

    def __init__(self, told: Connection[Any, Any]) -> None:
        self._told = told

    def missing(self, name: str) -> bool:
        self._told.send(("missing", name))
        return False

    def ready(self, name: str) -> None:
        self._told.send(("ready", name))


class _Work:
    """The parts that are left, who compiles them, and how far all are."""

    def __init__(self, closing: contextlib.ExitStack) -> None:
        """``closing`` ends, with the warm-up, everything that is begun with the first function that is missing."""
        self.compiles = False
        self.unkept = ""
        self._parts = deque(PARTS)
        self._closing = closing
        self._helpers: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._ready: set[str] = set()
        self._show: Callable[[int, int, str], None] = lambda _ready, _total, _what: None

    def next_part(self) -> str | None:
        """A part that nobody has taken, None if there is none left."""
        with contextlib.suppress(IndexError):
            return self._parts.popleft()
        return None

    def shared(self) -> bool:
        """Whether anyone helped; waits for them."""
        for helper in self._helpers:
            helper.join()
        return bool(self._helpers)

    def missing(self, name: str) -> bool:
        """A function must be compiled; at the first one, unless another process is just doing that, help is called."""
        look_again = not self.compiles
        if look_again:
            self._begin()
        self._tell(name)
        return look_again

    def ready(self, name: str) -> None:
        self._tell(name, ready=True)

    def _tell(self, name: str, *, ready: bool = False) -> None:
        with self._lock:
            if ready:
                self._ready.add(name)
            self._show(len(self._ready), max(len(FUNCTIONS), len(self._ready)), name)

    def _begin(self) -> None:
        self.compiles = True
        self._show = _shown(self._closing)
        caches = [made._cache for made in FUNCTIONS]
        kept = [str(cache.cache_path) for cache in caches if isinstance(cache, Kept) and cache.keeps]
        if len(kept) < len(FUNCTIONS):
            self.unkept = "no folder for it may be written"
            return
        wait = locked(
            Path(kept[0]) / "gripmon-compiling.lock", fcntl.LOCK_EX, ANOTHER_TAKES_S,
            lambda: self._tell("another process compiles the same"),
        )  # fmt: skip
        self._closing.enter_context(wait)
        for number in range(min(_cores() - 1, MOST_HELPERS)):
            helper = threading.Thread(target=self._be_helped, name=f"compiling-{number}", daemon=True)
            helper.start()
            self._helpers.append(helper)

    def _be_helped(self) -> None:
        """Let a process of its own take parts; one that fails leaves them to :func:`warm_up`'s second round."""
        ours, theirs = Pipe()
        with contextlib.suppress(OSError, EOFError), ours:
            with theirs:
                process = OwnProcess(help_compiling, theirs.fileno(), inherits=(theirs.fileno(),), quiet=True)
            self._closing.callback(process.end)
            while (part := self.next_part()) is not None:
                ours.send(part)
                while (said := ours.recv())[0] != _DONE:
                    self._tell(said[1], ready=said[0] == "ready")


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def _shown(closing: contextlib.ExitStack) -> Callable[[int, int, str], None]:
    """A function of how many functions are ready, of how many, and which one is being compiled."""
    what = "compiling what every frame needs, once per installation"
    if sys.stderr.isatty():
        from tqdm import tqdm

        bar = closing.enter_context(tqdm(file=sys.stderr, dynamic_ncols=True, leave=False, desc="compiling", unit=""))

        def draw(ready: int, total: int, name: str) -> None:
            bar.total, bar.n = total, ready
            bar.set_postfix_str(name)

        _log.info("%s", what)
        return draw
    said_s = -SAID_EVERY_S

    def say(ready: int, total: int, name: str) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= SAID_EVERY_S:
            said_s = time.monotonic()
            text = f"{what}: {ready} of {total}, now {name}"
            if _log.isEnabledFor(logging.INFO):
                _log.info("%s", text)
            else:
                sys.stderr.write(f"{text}\n")

    return say
