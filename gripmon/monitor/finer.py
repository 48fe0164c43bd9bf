"""The gripper's look as a measurement: it refines the edges' pose, and reports a gripper that looks different."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import (
    Alert,
    AlertKind,
    Array,
    Cause,
    FinerLookRecord,
    Frame,
    Image,
    LookNote,
    LookVersion,
    ReferenceRecord,
    Severity,
)
from gripmon.monitor.answers import gripper_astray
from gripmon.monitor.refits import reaching
from gripmon.monitor.since import Bounds
from gripmon.monitor.standing import Standing
from gripmon.monitor.weigher import swinging
from gripmon.track.edges import agreeing_fingers
from gripmon.track.look import (
    BLOCK_PX,
    GripperLook,
    LookAlignment,
    LookFusion,
    LookMotion,
    LookRefused,
    another_background,
)

RENEWED_SHARE = 0.5
"""Share of a finger's blocks that no longer look as learnt, above which it looks different: grasps hide half."""

RENEWED_AFTER_S = 300.0
"""How long a finger has to look different, or the look to contradict the edges, before an alert and a new look, s:
robots hold a grasped object for seconds or a minute.
"""


class _Pending(NamedTuple):
    """A frame that may be learnt: its image, pose (4, 4), covariance (6, 6) of the edges' errors that change with the
    background, opening, times, and the motion that the look measured in it.
    """

    image: Image
    cam_T_grip: Array
    of_background: Array
    jaw_opening_m: float | None
    now_s: float
    stamp_ns: int
    motion: LookMotion | None


class FinerLook:
    """Refines one monitor's poses.  ``look`` distinguishes backgrounds; ``floor`` (6, 6): the systematic part of the
    edges' covariance; ``edges``: digest of the taught edges.
    """

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        look: GripperLook,
        floor: Array,
        reference: ReferenceRecord,
        edges: str = "",
    ):
        self._gripper = gripper
        self._look, self._floor, self._edges = look, floor, edges
        self._reference = reference
        self._alignment = LookAlignment(camera, gripper)
        self._fusion = LookFusion(float(np.linalg.norm(gripper.points_grip_m(None), axis=1).mean()))
        self._pending: _Pending | None = None
        self._behind: NDArray[np.float32] | None = None
        self._last_T: Array | None = None
        self.swing: Array = np.zeros(6)
        """(6,) variance of the way between one refined pose and the next, m² and rad²."""
        self._since_s = np.full(len(gripper.finger_ids) + 1, np.inf)  # each finger, and all of it
        self._since_ns: list[int | None] = [None] * len(self._since_s)
        self._due: list[Alert] = []
        self._number, self._origin, self._reported = 1, "start", False
        self.version: LookVersion | None = None
        """Of the look that is learnt; None before its first frame."""

    def refer(self, reference: ReferenceRecord) -> None:
        """Set the reference in force.  The learnt look stays; the next version names the new reference."""
        self._reference = reference

    def state(self) -> FinerLookRecord | None:
        """What survives a restart, some 150 kB as JSON; None before the first frame that was learnt."""
        pixels = self._alignment.state()
        if pixels is None or self.version is None:
            return None
        return FinerLookRecord(self._edges, self.version, pixels, self._fusion.state(), tuple(self._since_ns))

    def restore(self, record: FinerLookRecord) -> None:
        """Continue with a kept look.  Raises :class:`LookRefused`, and begins again, if it is of another gripper, or
        was learnt with other taught edges.
        """
        if record.edges != self._edges:
            raise LookRefused("the kept look was learnt against edges that were taught otherwise; it is learnt again")
        if len(record.different_since_ns) != len(self._since_ns):
            raise LookRefused("the kept look is of another number of fingers; it is learnt again")
        try:
            self._alignment.restore(record.pixels)
            if record.bias is not None:
                self._fusion.restore(record.bias)
        except LookRefused:
            self._alignment.forget()
            raise
        self.version, self._number, self._reported = record.version, record.version.number, False
        # How long it looked different while the monitor was off is not known: that is counted from here.
        self._since_ns = list(record.different_since_ns)
        self._since_s = np.array([np.inf if since is None else 0.0 for since in self._since_ns])

    def refine(self, frame: Frame, standing: Standing, now_s: float, swing: Array) -> Standing:
        """The pose fused from edges and look, with bounds increased by its distance from the edges' pose.  Unchanged
        where the look measures nothing or contradicts the edges, or where a finger or the jaw isn't where it should be.
        ``swing`` (6,): variance of the vibration according to the edges.
        """
        self._pending = None
        measurement = standing.measurement
        astray = gripper_astray(measurement, agreeing_fingers(measurement, self._gripper))
        if astray or not standing.believed or frame.image is None:
            return standing
        refined, (opening_m, sigma_m) = None, self._opening(frame, standing)
        motion = self._alignment.measure(frame.image, standing.cam_T_grip, opening_m, sigma_m)
        of_background = standing.covariance - self._floor
        if motion is not None:
            refined = self._fusion.fuse(standing.cam_T_grip, of_background, motion)
        pose = standing.cam_T_grip if refined is None else refined.cam_T_grip
        # A copy: learning can wait, and the caller may read the next image into the same memory.
        self._pending = _Pending(frame.image.copy(), pose, of_background, opening_m, now_s, frame.stamp_ns, motion)
        if refined is None:
            return standing
        if self._last_T is None:
            self.swing = swing
        else:
            way = perturbation_between(self._last_T, pose)
            self.swing = swinging(self.swing, way, 2.0 * refined.of_change.diagonal())
        self._last_T = pose
        away = perturbation_between(standing.cam_T_grip, pose)
        wider = Bounds(*(reaching(each, away, each.hypothesis) for each in standing.bounds))
        return replace(standing, cam_T_grip=pose, bounds=wider, finer=refined)

    def learn(self) -> None:
        """Learn from the newest frame if its background is a new one."""
        pending, self._pending = self._pending, None
        if pending is None:
            return
        where = pending.image, pending.cam_T_grip, pending.jaw_opening_m
        behind = self._look.behind(*where)
        before, self._behind = self._behind, behind
        if before is not None and len(before) == len(behind) and not another_background(behind, before):
            self._behind = before
            return
        measured, views = self._alignment.ready, self._alignment.views
        self._alignment.learn(*where)
        if measured and pending.motion is not None:
            self._fusion.learn()
        elif not measured and self._alignment.views > views:
            self._fusion.place(pending.cam_T_grip, pending.of_background, pending.jaw_opening_m)
        self._count(pending.stamp_ns)
        self._report_lasting(self._alignment.renewed > RENEWED_SHARE, pending.now_s, pending.stamp_ns)

    def _count(self, stamp_ns: int) -> None:
        """Update the version with this frame; an alert reports when it begins to measure."""
        if not self._alignment.views:
            return
        if self.version is None:
            reference = self._reference.reference_id, self._reference.revision
            self.version = LookVersion(self._number, self._origin, *reference, stamp_ns, stamp_ns)
        self.version = msgspec.structs.replace(self.version, last_stamp_ns=stamp_ns)
        if self._alignment.ready and not self._reported:
            self._reported = True
            begun = f"version {self._number}, learnt before {self._alignment.views} backgrounds"
            self._report(Severity.INFO, f"the gripper's look refines the edges: {begun}", None)

    def _opening(self, frame: Frame, standing: Standing) -> tuple[float | None, float]:
        """The jaw opening and its standard deviation, m: from earlier frames, so that its error is the same in all."""
        measurement = standing.measurement
        if not self._gripper.has_jaw:
            return None, 0.0
        if frame.jaw_opening_m is None:
            return measurement.jaw_opening_m, math.sqrt(measurement.covariance[6, 6])
        return measurement.jaw_known_m, measurement.jaw_known_sigma_m

    def take_alerts(self) -> list[Alert]:
        """Alerts since the last call."""
        due, self._due = self._due, []
        return due

    def _report_lasting(self, different: NDArray[np.bool_], now_s: float, stamp_ns: int) -> None:
        """Report fingers (f,) that look different, or a look that contradicts the edges for :data:`RENEWED_AFTER_S`."""
        wrong = np.append(different, self._fusion.contradicts)
        self._since_s = np.where(wrong, np.minimum(self._since_s, now_s), np.inf)
        self._since_ns = [
            (stamp_ns if since is None else since) if now else None
            for now, since in zip(wrong.tolist(), self._since_ns, strict=True)
        ]
        long = now_s - self._since_s >= RENEWED_AFTER_S
        if not long.any():
            return
        since_ns = min(
            since for since, now in zip(self._since_ns, long.tolist(), strict=True) if now and since is not None
        )
        fingers = self._gripper.finger_ids
        names = [f"finger {name}" for name, now in zip(fingers, long[:-1].tolist(), strict=True) if now]
        text = f"the gripper looks different: {', '.join(names)}, since {_clock(since_ns)}"
        self._origin = f"{', '.join(names)} looked different"
        if long[-1]:
            text = "the gripper's look contradicts its edges, which count alone while it is learnt again"
            self._origin = "it contradicted the edges"
        self._report(Severity.WARNING, text, since_ns)
        if long[-1]:
            self._alignment.forget()
            self._fusion.forget()
        self._alignment.renew()
        self._number, self.version, self._reported = self._number + 1, None, False
        self._since_s[:] = np.inf
        self._since_ns = [None] * len(self._since_ns)

    def _report(self, severity: Severity, text: str, since_ns: int | None) -> None:
        assert self.version is not None
        middle_px, other = self._alignment.places_px()
        places = tuple((u, v) for u, v in np.rint(middle_px).astype(int).tolist())
        note = LookNote(self.version, self._alignment.views, BLOCK_PX, places, tuple(np.flatnonzero(other).tolist()))
        self._due.append(Alert(AlertKind.LOOK, Cause.UNKNOWN, severity, text, since_ns=since_ns, look=note))


def _clock(stamp_ns: int) -> str:
    return f"{datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC):%Y-%m-%d %H:%M:%S} UTC"
