"""When a gripper that isn't seen is searched for, and that it is done beside the frames."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.monitor.backlog import Backlog
from gripmon.track.edges import Measurement, Patience
from gripmon.track.edges.search import SearchSettings, search_poses

NOWHERE = np.zeros((0, 4, 4))


class GripperSearch:
    """One search at a time: begun with one frame's image, tried in a later frame.  Only the first one for a gripper
    that was seen until then is done in its frame: what was knocked away is found at once, for one frame that is late.

    A doubtful fit pays for looking further from a credit that good frames refill slowly; a lost gripper is searched for
    some times one after the other, then in one of several frames.
    """

    def __init__(self, camera: Camera, gripper: Gripper, settings: SearchSettings):
        self._camera, self._gripper, self._settings = camera, gripper, settings
        self._backlog: Backlog[Array] = Backlog()
        self._found: Array | None = None  # for the newest frame
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
        eager = self._searches < self._settings.eager_frames
        return Patience(
            when_doubtful=self._credit >= 1.0,
            when_lost=eager or self._untrusted % self._settings.patient_every == 0,
        )

    def poses(self, image: Image, cam_T_grip: Array, jaw_opening_m: float, lost: bool) -> Array:
        """Poses (s, 4, 4) to try in this frame about ``cam_T_grip`` (4, 4): what was found in an earlier one, or here
        if the gripper is just ``lost``; else none, and a search begins with a copy of the image.
        """
        if self._found is not None:
            return self._found
        camera, gripper, settings = self._camera, self._gripper, self._settings
        self._searches += 1
        if lost and self._searches == 1:
            return search_poses(image, camera, gripper, cam_T_grip, jaw_opening_m, settings)
        kept = image.copy()
        self._backlog.add(lambda: search_poses(kept, camera, gripper, cam_T_grip, jaw_opening_m, settings), self._now_s)
        return NOWHERE

    def end_frame(self, measurement: Measurement) -> None:
        """What came of this frame."""
        pays = measurement.looked_far and self._found is None
        earned = -1.0 if pays else 1.0 / self._settings.refill_frames
        self._credit = min(max(self._credit + earned, 0.0), float(self._settings.eager_frames))
        self._untrusted += 1
        if measurement.trusted:
            self._untrusted = self._searches = 0
