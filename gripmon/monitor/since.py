"""The motion d since the reference: what is the same in the reference's frames and now cancels.

A measured pose is ``x = exp(d) exp(b) reference``, with left perturbations as in equation (11): d is the camera's
motion since the reference, b how far off the reference the measurements had the gripper then, an average over the first
proved frames or a recalibration's own.  With their pose ``x_b = exp(b) reference``, ``exp(d) = x x_b^-1``.  An error E
that is constant in gripper axes (another TCP, bevels, worn or rounded tips, edges taught at a wrong reference) is in
both poses: ``x E (x_b E)^-1 = x x_b^-1``, whatever the motion (``docs/integrity.md``).

What doesn't cancel: a gripper larger by a factor 1 + s is seen farther away by it, so that the translation of d is
larger, too; as the jaws move, the reported travel contradicts the image by s times the travel, which the fit turns into
a motion; edges taught at a reference that is wrong by an angle, or by a part of its distance, are off by that part of
the motion, and so are those of a file whose plane is tilted (:mod:`~gripmon.monitor.common`); a longer finger moves a
fit by its visible edges, which may be others than then.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import NamedTuple, Protocol

import msgspec
import numpy as np

from gripmon.model.geometry import from_record, invert
from gripmon.model.gripper import SIZE_UNKNOWN
from gripmon.model.poses import perturbation_between, to_record
from gripmon.model.records import (
    Absolute,
    Array,
    AtReferenceRecord,
    Protection,
    ReferenceRecord,
    Since,
    SinceReference,
    ValidBy,
)
from gripmon.monitor.common import CommonError
from gripmon.track.edges import Measurement
from gripmon.track.integrity import Separation
from gripmon.track.integrity.frame_kernel import First, begun, motion_since

FIRST_FRAMES = 30
"""Proved frames that b is the average of: in two seconds at 15 frames/s a mount creeps by 0.014 mm at the default rate,
less than such an average claims.
"""

UNSETTLED_FRAMES = 5
"""Proved frames after a start in which another place within their bound is no knock: within two seconds at 15 frames/s
(one in four is proved), in which a mount that is knocked once a month is knocked with a probability of 8e-7; that an
edge of theirs belongs to something else has one of 1e-2.
"""

KEPT_REFERENCES = 8
"""References of which b is kept: the configured one's and the newest, 20 kB each.  An undo beyond them begins anew."""


class Bounds(NamedTuple):
    """Protection levels of a measured pose, and of the motion since the reference that it shows."""

    absolute: Protection
    since_reference: Protection

    def by(self, valid_by: ValidBy) -> Protection:
        """The one that a setting names."""
        return self.since_reference if valid_by is ValidBy.REFERENCE else self.absolute


class Named(NamedTuple):
    """What is published of a measured pose: what ``valid_by`` names, pose (4, 4), covariance (6, 6) and protection
    level, and both bounds.
    """

    cam_T_grip: Array
    covariance: Array
    protection: Protection
    since_reference: SinceReference | None
    absolute: Absolute


class Opened(NamedTuple):
    """A fit's jaw opening, m, and how the fitted pose changes with the reported one (6,), per metre."""

    jaw_opening_m: float
    pose_rate: Array

    @classmethod
    def of(cls, measurement: Measurement) -> Opened:
        """As in a Kalman update: the better the image shows the opening by itself, the less the pose changes.  Zero for
        a gripper without jaw.
        """
        covariance = measurement.covariance
        if len(covariance) < 7:
            return cls(0.0, np.zeros(6))
        known = max(measurement.jaw_known_sigma_m**2, covariance[6, 6])  # exact: as certain as the fit
        return cls(measurement.jaw_opening_m, covariance[:6, 6] / known if known > 0.0 else np.zeros(6))


class Average(Protocol):
    """An average of proven poses: the anchor."""

    cam_T_grip: Array
    frames: int
    proven: bool

    @property
    def misread(self) -> float:
        """Probability that what looked like the fingers' ends was something else in all of its frames."""

    def fits(self) -> Separation:
        """The averages under the lasting hypotheses, as shifts from ``cam_T_grip``."""

    def bound(self, risk: float) -> Protection:
        """The protection level of the average itself."""


class AtReference(NamedTuple):
    """What the monitor measured at the reference: ``fits`` under each of g lasting hypotheses as shifts from
    ``cam_T_grip`` (4, 4), which is exp(b) reference; the opening, and the number of ``frames`` that were averaged.
    ``misread``: probability that what looked like the fingers' ends in all of these was something else; ``proven``:
    whether one of them proved the pose; ``knocked``: whether the mount was, later on.  ``of_images``: they are images
    to teach from, each at another place of the mount's play: it is their average that a motion counts from.  ``away``
    (6,): from there to where the first frames that proved a pose had the gripper; None before.
    """

    cam_T_grip: Array
    fits: Separation
    jaw_opening_m: float
    frames: int
    since: Since
    since_ns: int
    misread: float
    proven: bool
    knocked: bool = False
    of_images: bool = False
    away: Array | None = None

    @classmethod
    def of_record(cls, record: AtReferenceRecord, lasting: int, fingers: int) -> AtReference | None:
        """As kept; None if that has another number of hypotheses or fingers, or no numbers."""
        fits = _fits(record, lasting, fingers)
        if fits is None:
            return None
        at = from_record(record.cam_T_grip), fits, record.jaw_opening_m, record.frames, record.since, record.since_ns
        away = np.array(record.away) if len(record.away) == 6 else None
        return cls(*at, record.misread, record.proven, record.knocked, record.of_images, away)

    def record(self, reference_id: str, measured_as: str) -> AtReferenceRecord:
        """To be kept."""
        shift, covariance, of_model = (np.ascontiguousarray(each, dtype="<f8").tobytes() for each in self.fits)
        return AtReferenceRecord(
            reference_id,
            measured_as,
            to_record(self.cam_T_grip),
            shift,
            covariance,
            of_model,
            self.jaw_opening_m,
            self.frames,
            self.since,
            self.since_ns,
            self.misread,
            self.proven,
            self.knocked,
            self.of_images,
            () if self.away is None else tuple(self.away.tolist()),
        )

    def looks_away(self, cam_T_grip: Array) -> Array | None:
        """(6,) by how much what is measured may be off since the images to teach from, m and rad; None without these.

        An error that is the same in these and now cancels: between another day's images and this one's a lamp, the
        focus, a pad or the camera may have been changed, and tips worn, which looks like a motion.  Where this run's
        first frames have the gripper elsewhere than the images, nothing tells such a change from a knock in between:
        ``cam_T_grip`` (4, 4) until one of them has proved a pose.
        """
        if not self.of_images:
            return None
        return perturbation_between(self.cam_T_grip, cam_T_grip) if self.away is None else self.away

    def motion(self, cam_T_grip: Array) -> Array:
        """exp(d) (4, 4) of a measured pose (4, 4)."""
        return np.asarray(cam_T_grip @ invert(self.cam_T_grip))

    def covariance_of(self, covariance: Array, cam_T_grip: Array, reference_T: Array) -> Array:
        """(6, 6) of exp(d) reference, of a measured pose (4, 4) with a ``covariance`` (6, 6)."""
        lever, turn, *_ = motion_since(cam_T_grip, self.cam_T_grip, reference_T)
        return np.asarray(lever @ (covariance + turn @ self.fits.covariance[0] @ turn.T) @ lever.T)

    def differences(
        self, cam_T_grip: Array, reference_T: Array, opened: Opened, common: CommonError | None, swing: Array
    ) -> First:
        """What makes fits near a published pose (4, 4) fits of exp(d) reference; ``swing`` (6,): variances by which a
        mount that vibrates differs from its average.
        """
        # That each image was at another place is in their average.
        more, travel = np.zeros((6, 6)) if self.of_images else np.diag(swing), np.zeros(6)
        if common is not None:
            more = common.of_motion(self.motion(cam_T_grip), self.cam_T_grip) + more
        first, lever, moved, at, unmoved = begun(cam_T_grip, self.cam_T_grip, reference_T, *self.fits, more)
        by_motion = np.zeros((0, 6, 3))
        if common is not None:
            travel_m = opened.jaw_opening_m - self.jaw_opening_m
            # Of unknown size, lengths are in units of the distance, of which the motion is exact.
            size = common.scale_sigma if common.scale_sigma < SIZE_UNKNOWN else 0.0
            travel = size * travel_m * (lever @ opened.pose_rate)
            by_motion = np.concatenate([-size * np.eye(6, 3)[None], lever @ common.tilt.of_motion])
        return first, lever, by_motion, travel, moved, at, unmoved


def digest_of(measured_as: tuple[object, ...]) -> str:
    """What a measured pose depends on besides gripper and camera, as :class:`AtReferenceRecord` has it."""
    return hashlib.sha256(msgspec.json.encode(measured_as)).hexdigest()[:16]


class AtReferences:
    """What was measured at each reference, of one monitor, and at the one in force."""

    def __init__(self, reference: ReferenceRecord, valid_by: ValidBy, risk: float, measured_as: tuple[object, ...]):
        """``valid_by``: what is published; ``risk``: the integrity risk; ``measured_as``: what a measured pose depends
        on besides gripper and camera.
        """
        self._valid_by = valid_by
        self._digest = digest_of(measured_as)
        self._known: dict[str, AtReference] = {}
        self.current: AtReference | None = None
        """At the reference in force; None until a frame proves a pose."""
        self._growing: Average | None = None  # the average that b follows, or is compared with
        self._risk = risk
        self._unproved_T: Array | None = None  # of the first frame, while none has proved a pose
        self.weighed: AtReference | None = None
        """What the newest bounds count from: until the next ones what is published does, too, though by now their frame
        counts in the average; None before there is any: from :attr:`current`.
        """
        self.changes = 0
        """Grows with each change that a restart should know."""
        self.now_ns = 0
        """Stamp of the newest frame."""
        self.first_ns: int | None = None
        """Stamp of the run's first frame."""
        self.refer(reference)

    @property
    def elapsed_s(self) -> float:
        """Time since the reference's frames; of a clock that was set back none.  Of images to teach from at least that
        since the run's first frame: recorded frames may be older than these.
        """
        first = self.current
        if first is None:
            return 0.0
        began_ns = first.since_ns
        if first.of_images and self.first_ns is not None:
            began_ns = min(began_ns, self.first_ns)
        return 1e-9 * max(self.now_ns - began_ns, 0)

    @property
    def published_by(self) -> tuple[AtReference | None, Array]:
        """The same with the reference (4, 4) itself."""
        return self.current, self.reference_T

    def quantity(self, cam_T_grip: Array, covariance: Array) -> tuple[Array, Array]:
        """What is published of a measured pose (4, 4) and its covariance (6, 6): these, or those of exp(d) reference.
        Before a frame has proved a pose d is the motion since the first one: nothing bounds it, but a mount that moves
        isn't said to stand still.
        """
        if self._valid_by is ValidBy.ABSOLUTE:
            return cam_T_grip, covariance
        first = self.weighed or self.current
        if first is None:
            if self._unproved_T is None:
                self._unproved_T = cam_T_grip
            return cam_T_grip @ invert(self._unproved_T) @ self.reference_T, 2.0 * covariance
        of_motion = first.covariance_of(covariance, cam_T_grip, self.reference_T)
        return first.motion(cam_T_grip) @ self.reference_T, of_motion

    def named(self, cam_T_grip: Array, covariance: Array, both: Bounds) -> Named:
        """What is published of a measured pose (4, 4), its covariance (6, 6) and bounds."""
        (absolute, since), first, at = both, self.weighed or self.current, to_record(cam_T_grip)
        return Named(
            *self.quantity(cam_T_grip, covariance),
            both.by(self._valid_by),
            None
            if first is None
            else SinceReference(since.position_m, since.rotation_rad, first.since, first.since_ns),
            Absolute(absolute.position_m, absolute.rotation_rad, at.translation_m, at.rotation_xyzw),
        )

    def refer(self, reference: ReferenceRecord) -> None:
        """Another reference is in force; one that is restored is still known."""
        self._id = reference.restores or reference.reference_id
        self.reference_T = from_record(reference.cam_T_grip)
        self._growing, self.current = None, self._known.get(self._id)
        self._unproved_T = self.weighed = None

    def measured(self, reference: ReferenceRecord, anchor: Average, jaw_opening_m: float) -> None:
        """A reference is measured again, in force or only proposed, from frames that ``anchor`` is the average of."""
        at = anchor.cam_T_grip, anchor.fits(), jaw_opening_m, anchor.frames, Since.REFERENCE, reference.stamp_ns
        self._keep(reference.reference_id, AtReference(*at, anchor.misread, anchor.proven))

    def add(self, anchor: Average, jaw_opening_m: float, stamp_ns: int) -> None:
        """A frame counts, which ``anchor`` includes: it has proved a pose, or none has yet."""
        growing, taught = self._growing, self._taught
        if taught is not None and not anchor.proven:
            return
        if growing is None and self.current is not None and (taught is None or taught.away is not None):
            return
        if growing is not None and growing is not anchor and not self._was_wrong(growing, anchor):
            self._end()  # the mount was knocked
            return
        if growing is not anchor:
            self._growing, self._stamps_ns, self._openings_m = anchor, [], []
        self._stamps_ns.append(stamp_ns)
        self._openings_m.append(jaw_opening_m)
        if taught is not None:
            self.current = taught._replace(away=perturbation_between(taught.cam_T_grip, anchor.cam_T_grip))
        else:
            # A mount that creeps meanwhile stands at the average's place in the middle of its frames.
            since_ns = self._stamps_ns[(len(self._stamps_ns) - 1) // 2]
            at = anchor.cam_T_grip, anchor.fits(), float(np.mean(self._openings_m)), len(self._openings_m)
            self.current = AtReference(*at, Since.FIRST_PROVED, since_ns, anchor.misread, anchor.proven)
        self._known[self._id] = self.current
        if (len(self._openings_m) if taught is None else anchor.frames) >= FIRST_FRAMES:
            self._end()

    @property
    def _taught(self) -> AtReference | None:
        """What is known of the reference in force, if by images to teach from."""
        return self.current if self.current is not None and self.current.of_images else None

    def proved(self) -> None:
        """A frame has proved a pose: what was known of the reference in force without the fingers' ends is dropped."""
        if self.current is not None and not self.current.proven:
            self._known.pop(self._id)
            self._growing = self.current = None

    def moved(self) -> None:
        """The mount was knocked: that it stays where it was says nothing about the motion since any reference."""
        self._known = {name: at._replace(knocked=True) for name, at in self._known.items()}
        self.current = self._known.get(self._id)
        self.changes += 1

    def _was_wrong(self, first: Average, anchor: Average) -> bool:
        """Whether the first frames were wrong, rather than the mount knocked just after them, when another place is
        proved: the other place is one that they allow by their own bound.
        """
        bound, away = first.bound(self._risk), perturbation_between(first.cam_T_grip, anchor.cam_T_grip)
        within = np.linalg.norm(away[:3]) <= bound.position_m and np.linalg.norm(away[3:]) <= bound.rotation_rad
        return first.frames <= UNSETTLED_FRAMES and bool(within)

    def _end(self) -> None:
        self._growing = None
        self._keep(self._id, self._known[self._id])

    def _keep(self, reference_id: str, at: AtReference) -> None:
        self._known[reference_id] = at
        self.changes += 1
        while len(self._known) > KEPT_REFERENCES:
            _configured, *others = self._known
            del self._known[next(each for each in others if each != self._id)]
        self.current = self._known.get(self._id)

    def state(self) -> tuple[AtReferenceRecord, ...]:
        """What survives a restart: without an average that is still growing, which begins anew."""
        growing = self._id if self._growing is not None and self._taught is None else None
        return tuple(at.record(name, self._digest) for name, at in self._known.items() if name != growing)

    def begin(self, taught: AtReferenceRecord, lasting: int, fingers: int) -> bool:
        """Count the motion since the reference in force from the images that edges were taught from, with these numbers
        of lasting hypotheses and fingers.  Returns whether that is possible: not if they were measured otherwise.
        """
        at = AtReference.of_record(taught, lasting, fingers) if taught.measured_as == self._digest else None
        if at is not None:
            self._known[self._id] = self.current = at
        return at is not None

    def restore(self, records: Iterable[AtReferenceRecord], lasting: int, fingers: int) -> str | None:
        """Go on with what an earlier run measured, with these numbers of lasting hypotheses and fingers.  Returns why
        some of it isn't used: settings or taught edges have changed since; None if all of it is.
        """
        refused, right = None, "the motion since the reference counts from the next 30 frames that prove where it is"
        if self._id not in {*self._known, *(each.reference_id for each in records)}:
            refused = (
                "the state has nothing of the reference's frames: it is from an earlier version, or too few frames had "
                f"proved where the gripper is; {right}, or recalibrate"
            )
        for each in records:
            at = AtReference.of_record(each, lasting, fingers) if each.measured_as == self._digest else None
            taught = self._known.get(each.reference_id)
            if at is not None and taught is not None and taught.of_images and taught.proven and not at.of_images:
                # Taught again since, to the same edges: of what the run saw only whether the mount was knocked counts.
                self._known[each.reference_id] = taught._replace(knocked=at.knocked)
            elif at is not None:
                self._known[each.reference_id] = at
            elif each.reference_id not in self._known:
                refused = (
                    "where the reference's frames had the gripper isn't used: the edges were taught again, or measured "
                    f"with other settings, since; {right}, or recalibrate"
                )
        self.current = self._known.get(self._id)
        return refused


def _fits(record: AtReferenceRecord, lasting: int, fingers: int) -> Separation | None:
    """The kept fits; None if they are of another number of hypotheses or fingers, or no numbers."""
    shapes = (lasting, 6), (lasting, 6, 6), (lasting, fingers, 6)
    kept = record.shift, record.covariance, record.of_model
    if any(len(each) != 8 * np.prod(shape) for each, shape in zip(kept, shapes, strict=True)):
        return None
    arrays = [np.frombuffer(each, "<f8").reshape(shape).copy() for each, shape in zip(kept, shapes, strict=True)]
    return Separation(*arrays) if all(np.isfinite(each).all() for each in arrays) else None
