"""When a gripper that isn't seen is searched for, and that it is done beside the frames."""

from __future__ import annotations

from collections.abc import Sequence

from gripmon.model.records import Image
from gripmon.monitor.backlog import Backlog
from gripmon.track.edges import Expected, FingertipMeter, Measurement, Patience, SearchSettings, Sought


class GripperSearch:
    """One search at a time: begun with one frame's image, followed in a later frame.  Only the first one for a gripper
    that was seen until then is done in its frame: what was knocked away is found at once, for one frame that is late.

    A doubtful fit pays for looking further from a credit that good frames refill slowly.  A lost gripper is searched
    for all the time as long as the last transform is held: it may come back at any moment, and goes on moving; then in
    one of several frames.  What was found beside a doubtful fit is followed as long again: a place has to show the
    fingers' ends, and clutter hides them in some frames.
    """

    def __init__(self, meter: FingertipMeter, settings: SearchSettings, hold_s: float):
        """``meter``: the search's own, for it runs beside the frames."""
        self._meter, self._settings, self._hold_s = meter, settings, hold_s
        self._backlog: Backlog[Sequence[Expected]] = Backlog()
        self._found: Sequence[Expected] | None = None  # for the newest frame
        self._kept: tuple[Sequence[Expected], float] = (), 0.0  # found before a doubtful fit, and when
        self._now_s = self._seen_s = 0.0
        self._credit = float(settings.eager_frames)
        self._untrusted = 0  # frames since the gripper was seen
        self._searched = False  # since then

    @property
    def pending(self) -> bool:
        """Whether there is something to do for :meth:`run_pending`."""
        return self._backlog.undone

    def run_pending(self) -> None:
        """Do what is waiting; in any thread."""
        self._backlog.run()

    def begin_frame(self, now_s: float) -> Patience:
        """Whether this frame may look further than where the gripper is expected.  Raises what a search has raised."""
        self._now_s, self._found = now_s, None
        for found in self._backlog.results(now_s):
            if isinstance(found, Exception):
                raise found
            self._found = found
            self._kept = found, now_s
        kept, since_s = self._kept
        if kept and self._found is None and not self._untrusted and now_s - since_s <= self._hold_s:
            self._found = kept
        at_once = not self._searched
        if self._found is not None or len(self._backlog):
            return Patience(self._found is not None, self._found is not None, at_once)
        held = now_s - self._seen_s <= self._hold_s
        when_lost = held or self._untrusted % self._settings.patient_every == 0
        return Patience(self._credit >= 1.0, when_lost, at_once)

    def places(self, image: Image, expected: Expected, sought: Sought) -> Sequence[Expected]:
        """Places to follow in this frame: what was found in an earlier one, or here if the gripper is just lost; else
        none, and a search begins with a copy of the image.
        """
        if self._found is not None:
            return self._found
        first, self._searched = not self._searched, True
        if sought.lost and first:
            return self._meter.searched(image, expected, sought)
        kept = image.copy()
        self._backlog.add(lambda: self._meter.searched(kept, expected, sought), self._now_s)
        return ()

    def end_frame(self, measurement: Measurement) -> None:
        """What came of this frame."""
        pays = measurement.looked_far and self._found is None
        earned = -1.0 if pays else 1.0 / self._settings.refill_frames
        self._credit = min(max(self._credit + earned, 0.0), float(self._settings.eager_frames))
        self._untrusted += 1
        if not measurement.looked_far:
            self._kept = (), 0.0
        if measurement.trusted:
            self._untrusted, self._searched, self._seen_s = 0, False, self._now_s
