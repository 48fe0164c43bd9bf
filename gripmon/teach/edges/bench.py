"""One gripper before one camera, while a person teaches it: images, corners put by hand, and what follows from them,
down to the accuracy to expect.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from gripmon.judge.drift import foresee
from gripmon.judge.recalibrate import refusal
from gripmon.model.camera import Camera
from gripmon.model.geometry import to_record
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image, ReferenceRecord
from gripmon.monitor import CORNER_COUNTS, MonitorSettings
from gripmon.teach.edges.corner_pose import CameraError, CornerPose, PoseRefused, pose_from_corners
from gripmon.teach.edges.measure import Taught, teach
from gripmon.teach.edges.placing import Prior, place, prior_of, usual_view
from gripmon.teach.edges.snapping import Snapped, Snapper
from gripmon.teach.edges.views import TeachingImage, TeachingRefused
from gripmon.teach.forecast import FEWEST_EDGES, Promise, expect, promise
from gripmon.track.edges import TaughtEdges

LARGEST_OFF_PX = 100_000.0
"""Corners are put in the image, or beside it; nothing farther is meant."""


class Found(NamedTuple):
    """Everything that follows from corners put by hand in one image: the reference that it gives (or is known), None
    with a reason in words.
    """

    snapped: Snapped
    pose: CornerPose | None
    reference: ReferenceRecord | None
    no_reference: str | None
    prospects: Prospects | None


@dataclass(frozen=True)
class Bench:
    """What is known before teaching; ``reference`` None where nobody has calibrated hand and eye."""

    camera: Camera
    gripper: Gripper
    settings: MonitorSettings
    reference: ReferenceRecord | None
    camera_error: CameraError | None = None

    def prior(self, jaw_opening_m: float | None) -> Prior:
        """Where the gripper is before any corner is put."""
        if self.reference is not None:
            return prior_of(self.reference)
        return usual_view(self.camera, self.gripper, jaw_opening_m)

    def first_places(self, jaw_opening_m: float | None) -> dict[str, Array]:
        """Where a person finds the corners before any is put, px."""
        here = place(self.camera, self.gripper, jaw_opening_m, {}, self.prior(jaw_opening_m))[0].cam_T_grip
        points_m = self.gripper.points_grip_m(jaw_opening_m)[self.gripper.corner_points]
        uv_px = self.camera.project(points_m @ here[:3, :3].T + here[:3, 3])
        return dict(zip(self.gripper.corner_ids, uv_px, strict=True))

    def look(
        self, image: Image, put_px: Mapping[str, Array], by_hand: Sequence[str], jaw_opening_m: float | None
    ) -> Found:
        """Snap, then the reference, then what may be expected.

        ``put_px`` (name: (2,)): corners put by hand; those of them that are ``by_hand`` count as they stand, the others
        only say about where to look.
        """
        known = self.reference is not None
        snapper = Snapper(self.camera, self.gripper, self.settings.corners, self.settings.jaw_sigma_m)
        snapped = snapper.snap(image, put_px, jaw_opening_m, self.prior(jaw_opening_m), known)
        pose, reference, why = None, self.reference, None
        if reference is None:
            try:
                fixed = {name: put_px[name] for name in by_hand if name in put_px}
                pose = pose_from_corners(self.camera, self.gripper, snapped, fixed, self.camera_error)
                reference = reference_of(pose)
            except PoseRefused as refused:
                why = str(refused)
        expected = None
        if reference is not None:
            taught = self._taught_by(image, reference, snapped.jaw_opening_m)
            expected = prospects(self.camera, self.gripper, self.settings, reference, snapped.jaw_opening_m, taught)
        return Found(snapped, pose, reference, why, expected)

    def _taught_by(self, image: Image, reference: ReferenceRecord, jaw_opening_m: float | None) -> TaughtEdges | None:
        """What this image alone would teach; None if nothing."""
        opening_m = self.gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
        try:
            return self.taught(reference, [TeachingImage(image, opening_m, "")])[1]
        except TeachingRefused:
            return None

    def taught(self, reference: ReferenceRecord, images: Sequence[TeachingImage]) -> tuple[Taught, TaughtEdges]:
        """What the images show of every edge.  Raises :class:`gripmon.teach.edges.TeachingRefused`."""
        found = teach(self.camera, self.gripper, self.settings.corners, self.settings.jaw_sigma_m, reference, images)
        opening_m = float(np.mean([image.jaw_opening_m for image in found.used(images)]))
        arrays = TaughtEdges.of(found.edges, self.gripper, _pose(reference), opening_m)
        return found, arrays


def reference_of(pose: CornerPose) -> ReferenceRecord:
    """A pose by corners as the reference; numbers as a file holds them."""
    transform = to_record(pose.cam_T_grip)
    rounded = msgspec.structs.replace(
        transform,
        translation_m=tuple(round(v, 9) for v in transform.translation_m),
        rotation_xyzw=tuple(round(v, 10) for v in transform.rotation_xyzw),
    )
    digest = hashlib.sha256(msgspec.json.encode(rounded)).hexdigest()[:8]
    flat = tuple(float(f"{v:.6e}") for v in pose.covariance.ravel().tolist())
    return ReferenceRecord(f"corners-{digest}", 0, 0, "configuration", rounded, flat)


def _pose(reference: ReferenceRecord) -> Array:
    from gripmon.model.geometry import from_record

    return from_record(reference.cam_T_grip)


def rough_fault(corners: Mapping[str, Sequence[float]], gripper: Gripper) -> tuple[str, str, str] | None:
    """Key, what is wrong, what would be right, of corners that somebody wrote or sent; None if nothing is."""
    for name, uv_px in corners.items():
        if name not in gripper.corner_ids:
            return f"corners.{name}", "the gripper has no such corner", f"one of {', '.join(gripper.corner_ids)}"
        if not all(np.isfinite(v) and abs(v) <= LARGEST_OFF_PX for v in uv_px):
            return f"corners.{name}", f"is {list(uv_px)}", "column and row in the image (px)"
    return None


@dataclass(frozen=True, slots=True)
class Prospects:
    """Expected of one frame, vectors (6,) of position, then rotation, m and rad: ``sigma`` standard deviations,
    ``weakest`` one standard deviation along the least certain direction, ``smallest`` step along each axis that the
    drift test notices; ``promise``: bounds on its error, beside the alert limits.  ``delay_frames``: after how many
    frames it notices a step of the TCP by 0.1 mm along x, y and z, None for never.  ``recalibration``: why the corners
    in view give no new pose, None if they do.
    """

    edges: int
    sigma: Array
    weakest: Array
    smallest: Array
    promise: Promise
    delay_frames: tuple[int | None, ...]
    recalibration: str | None


STEP_M = 1e-4
"""Step of the TCP for which the delay is told."""


def prospects(
    camera: Camera,
    gripper: Gripper,
    settings: MonitorSettings,
    reference: ReferenceRecord,
    jaw_opening_m: float | None,
    taught: TaughtEdges | None = None,
) -> Prospects | None:
    """The numbers that ``gripmon check`` prints; None where too few edges are in view to measure anything."""
    outlook = expect(camera, gripper, settings, reference, jaw_opening_m, taught)
    if outlook.edges < FEWEST_EDGES:
        return None
    foresight = foresee(outlook.covariance, settings.drift)
    taken = gripper.innermost_corners(outlook.corners, CORNER_COUNTS[settings.recalibrate_corners])
    points_grip_m = gripper.points_grip_m(jaw_opening_m)[gripper.corner_points][taken]
    return Prospects(
        outlook.edges,
        outlook.sigma,
        outlook.weakest,
        foresight.smallest,
        promise(outlook.protection, settings.policy),
        tuple(foresight.delay_frames(STEP_M, axis) for axis in range(3)),
        refusal(points_grip_m),
    )
