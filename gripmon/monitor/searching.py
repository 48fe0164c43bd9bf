"""When a gripper that isn't seen is searched for, and that it is done beside the frames."""

from __future__ import annotations

from collections.abc import Sequence

from gripmon.model.records import Image
from gripmon.monitor.backlog import RESULT_AFTER_S, Backlog
from gripmon.track.edges import Expected, FingertipMeter, Measurement, Patience, SearchSettings, Sought

EAGER_RESULT_AFTER_S = 0.05
"""The same for the searches right after the first: what was knocked away, and still rings, has to be found
in an image that isn't older than need be.  A search takes 25 to 50 ms.
"""


class GripperSearch:
    """One search at a time: begun with one frame's image, followed in a later frame.  Only the first one for a gripper
    that was seen until then is done in its frame: what was knocked away is found at once, for one frame that is late.

    A doubtful fit pays for looking further from a credit that good frames refill slowly; a lost gripper is searched for
    some times one after the other, then in one of several frames.
    """

    def __init__(self, meter: FingertipMeter, settings: SearchSettings):
        """``meter``: the search's own, for it runs beside the frames."""
        self._meter, self._settings = meter, settings
        self._backlog: Backlog[Sequence[Expected]] = Backlog()
        self._found: Sequence[Expected] | None = None  # for the newest frame
        self._asked: tuple[Image, Expected, Sought] | None = None  # in it
        self._now_s = 0.0
        self._credit = float(settings.eager_frames)
        self._untrusted = self._searches = 0  # frames and searches since the gripper was seen

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
        if self._found is not None or len(self._backlog):
            return Patience(self._found is not None, self._found is not None)
        return Patience(
            when_doubtful=self._credit >= 1.0,
            when_lost=self._eager or self._untrusted % self._settings.patient_every == 0,
        )

    def places(self, image: Image, expected: Expected, sought: Sought) -> Sequence[Expected]:
        """Places to follow in this frame: what was found in an earlier one, or here if the gripper is just lost; else
        none, and a search begins with a copy of the image.
        """
        if self._found is not None:
            self._asked = image, expected, sought
            return self._found
        if sought.lost and self._searches == 0:
            self._searches = 1
            return self._meter.searched(image, expected, sought)
        self._begin(image, expected, sought)
        return ()

    def _begin(self, image: Image, expected: Expected, sought: Sought) -> None:
        kept, eager = image.copy(), sought.lost and self._eager
        self._searches += 1
        after_s = EAGER_RESULT_AFTER_S if eager else RESULT_AFTER_S
        self._backlog.add(lambda: self._meter.searched(kept, expected, sought), self._now_s, after_s)

    @property
    def _eager(self) -> bool:
        return self._searches < self._settings.eager_frames

    def end_frame(self, measurement: Measurement) -> None:
        """What came of this frame."""
        pays = measurement.looked_far and self._found is None
        earned = -1.0 if pays else 1.0 / self._settings.refill_frames
        self._credit = min(max(self._credit + earned, 0.0), float(self._settings.eager_frames))
        self._untrusted += 1
        asked, self._asked = self._asked, None
        if measurement.trusted:
            self._untrusted = self._searches = 0
        elif asked is not None and self._eager:
            self._begin(*asked)  # what was found has gone on meanwhile
