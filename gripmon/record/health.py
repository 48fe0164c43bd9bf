"""Whether the recording process answers and keeps up."""

from __future__ import annotations

SILENT_AFTER_S = 5.0
SILENT = f"recording pauses: its process hasn't answered for {SILENT_AFTER_S:g} s"
START_TAKES_S = 30.0  # its imports, on a machine that is busy
_LOSSES_PERIOD_S = 1.0
_PERIODS_TO_RAISE = 3  # with losses
_PERIODS_TO_CLEAR = 5  # without


class Health:
    """Judges by counts and times alone; ``fault`` is one line, None while all is well."""

    def __init__(self, now_s: float) -> None:
        self.fault: str | None = None
        self._looked_s = now_s
        self._counts = (0, 0)
        self._with_losses = self._without = 0
        self._thins: str | None = None

    def look(
        self, now_s: float, heard_s: float, heard: bool, frames: int, images: int, explained: bool = False
    ) -> None:
        """``heard_s``: time of its last report, or of its start if it was never ``heard``; ``frames`` and ``images``
        count what was dropped so far.  ``explained``: the process itself says why it writes nothing, so that losses
        don't mean that it is too slow.
        """
        if now_s - heard_s > (SILENT_AFTER_S if heard else START_TAKES_S):
            self.fault = SILENT
            self._counts, self._looked_s = (frames, images), now_s
            return
        if now_s - self._looked_s >= _LOSSES_PERIOD_S:
            self._looked_s = now_s
            self._count(heard and not explained, frames, images)
        if explained:
            self._thins, self._with_losses = None, 0
        self.fault = self._thins

    def _count(self, counts: bool, frames: int, images: int) -> None:
        """A short burst of losses is not reported, losses that last for seconds are."""
        (frames_before, images_before), self._counts = self._counts, (frames, images)
        what = "frames" if frames > frames_before else "images" if images > images_before else ""
        losing = bool(what) and counts
        self._with_losses = self._with_losses + 1 if losing else 0
        self._without = 0 if losing else self._without + 1
        if self._with_losses >= _PERIODS_TO_RAISE and self._thins is None:
            self._thins = f"recording thins: it can't keep up, {what} are dropped"
        elif self._without >= _PERIODS_TO_CLEAR:
            self._thins = None
