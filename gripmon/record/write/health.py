"""Whether the recording process answers and keeps up, as the daemon sees it."""

from __future__ import annotations

import time
from pathlib import Path

SILENT_AFTER_S = 5.0
_START_TAKES_S = 30.0  # its imports, on a machine that is busy
_LOOK_EVERY_S = 1.0
_LOOKS_TO_RAISE = 3
_LOOKS_TO_CLEAR = 5
_LOOKS_AT_A_PROCESS = 5
_STOPPED = ("T", "t")  # by SIGSTOP, by a debugger


class Health:
    """Judges from counts and times alone: one line on what is wrong, None while all is well."""

    def __init__(self, now_s: float) -> None:
        self.fault: str | None = None
        self._looked_s = now_s
        self._counts = (0, 0)
        self._looks_with_losses = 0
        self._looks_without = 0
        self._thins: str | None = None

    def look(
        self, now_s: float, heard_s: float, heard: bool, pid: int, frames: int, images: int, explained: bool = False
    ) -> None:
        """``heard_s``: when it last reported, or was started while never ``heard``; then what was dropped so far.

        ``explained``: the process itself says why it writes nothing, and what is lost meanwhile is no thinning.
        """
        if now_s - heard_s > (SILENT_AFTER_S if heard else _START_TAKES_S):
            self.fault = f"recording pauses: {_why_silent(pid)}"
            self._counts, self._looked_s = (frames, images), now_s
            return
        if now_s - self._looked_s >= _LOOK_EVERY_S:
            self._looked_s = now_s
            self._count(heard and not explained, frames, images)
        if explained:
            self._thins, self._looks_with_losses = None, 0
        self.fault = self._thins

    def _count(self, heard: bool, frames: int, images: int) -> None:
        """A short burst is no news, losses that go on for seconds are."""
        frames_before, images_before = self._counts
        self._counts = (frames, images)
        what = "frames" if frames > frames_before else "images" if images > images_before else ""
        if what and heard:
            self._looks_with_losses += 1
            self._looks_without = 0
        else:
            self._looks_without += 1
            self._looks_with_losses = 0
        if self._looks_with_losses >= _LOOKS_TO_RAISE and self._thins is None:
            self._thins = f"recording thins: it can't keep up, {what} are dropped"
        elif self._looks_without >= _LOOKS_TO_CLEAR:
            self._thins = None


def stands_still(pid: int) -> bool:
    """Whether a process was stopped from outside, or one of its threads waits for a disk at every look in a tenth of a
    second.
    """
    for _ in range(_LOOKS_AT_A_PROCESS):
        states = [_state(thread) for thread in Path(f"/proc/{pid}/task").glob("*")]
        if not any(state in ("D", *_STOPPED) for state in states):
            return False
        time.sleep(0.1 / _LOOKS_AT_A_PROCESS)
    return True


def _state(process: Path) -> str:
    """The letter that Linux has for a process or thread; empty if there is none."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return ""


def _why_silent(pid: int) -> str:
    state = _state(Path(f"/proc/{pid}"))
    if state == "D":
        return "the disk doesn't answer"
    if state in _STOPPED:
        return "its process was stopped from outside"
    return f"its process hasn't answered for {SILENT_AFTER_S:g} s"
