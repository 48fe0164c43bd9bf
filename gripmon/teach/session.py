"""One gripper in front of one camera while a person teaches it: images, corners set by hand, what follows from them up
to the expected accuracy, and the session behind the page's requests.  Nothing here knows HTTP.

Corners set by hand stay with the page, so that two open pages don't disturb each other; images taken from a live camera
are shared by all pages.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.io.sources import Source, Waiting
from gripmon.judge.inspection import inspect
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import in_full_scale
from gripmon.model.records import Array, Frame, Image, ReferenceRecord
from gripmon.monitor import MonitorSettings
from gripmon.teach.accuracy import forecast_frame
from gripmon.teach.api import Picture
from gripmon.teach.corner_pose import (
    CornerPose,
    PoseRefused,
    Prior,
    corners_fault,
    place,
    pose_from_corners,
    prior_of,
    usual_view,
)
from gripmon.teach.kept import promise_of
from gripmon.teach.measure import Taught, teach
from gripmon.teach.messages import (
    BadRequest,
    CornersRequest,
    Evaluation,
    Expectation,
    PictureInfo,
    Place,
    Saved,
    SaveOrder,
    SavingRefused,
    State,
    encoded,
)
from gripmon.teach.snapping import FEWEST_PUT, Snapper
from gripmon.teach.views import TeachingImage, TeachingRefused
from gripmon.teach.visibility import Rig
from gripmon.track.edges import TaughtEdges
from gripmon.track.edges.taught import own_covariance

_MOST_PICTURES = 50
_LIVE_WAIT_S = 10.0


@dataclass(frozen=True)
class Setup:
    """What is known before teaching; ``reference`` None before the hand/eye calibration; ``distance_m``: rough distance
    of the TCP along the camera's axis, with its standard deviation.
    """

    camera: Camera
    gripper: Gripper
    settings: MonitorSettings
    reference: ReferenceRecord | None
    camera_error: GivenCamera | None = None
    distance_m: tuple[float, float] | None = None

    def prior(self, jaw_opening_m: float | None) -> Prior:
        """The expected pose of the gripper before any corner is set."""
        if self.reference is not None:
            return prior_of(self.reference)
        return usual_view(self.camera, self.gripper, jaw_opening_m, self.distance_m)

    def first_places(self, jaw_opening_m: float | None) -> dict[str, Array]:
        """Positions at which the page first shows the corners, px."""
        here = place(self.camera, self.gripper, jaw_opening_m, {}, self.prior(jaw_opening_m))[0].cam_T_grip
        points_m = self.gripper.points_grip_m(jaw_opening_m)[self.gripper.corner_points]
        uv_px = self.camera.project(points_m @ here[:3, :3].T + here[:3, 3])
        return dict(zip(self.gripper.corner_ids, uv_px, strict=True))

    def evaluate(
        self, image: Image, put_px: Mapping[str, Array], by_hand: Sequence[str], jaw_opening_m: float | None
    ) -> Evaluation:
        """Snap, then compute the reference, then the expected accuracy.

        ``put_px`` (name: (2,)): corners set by hand; those listed in ``by_hand`` are used as they are, the others only
        start the search.
        """
        known = self.reference is not None
        snapper = Snapper(self.camera, self.gripper, self.settings.corners, self.settings.jaw_sigma_m)
        snapped, seen = snapper.snap(image, put_px, jaw_opening_m, self.prior(jaw_opening_m), known)
        pose, reference, why, expected = None, self.reference, None, None
        if reference is None:
            try:
                exact = self.settings.model_sigma_m == 0.0
                fixed = {name: put_px[name] for name in by_hand if name in put_px}
                pose = pose_from_corners(self.camera, self.gripper, snapped, seen, fixed, self.camera_error, exact)
                reference = _reference_of(pose)
            except PoseRefused as refused:
                why = str(refused)
        if reference is not None:
            expected = self._expected(image, reference, snapped.jaw_opening_m)
        return Evaluation(snapped=snapped, pose=pose, reference=reference, no_reference=why, expected=expected)

    def _expected(self, image: Image, reference: ReferenceRecord, jaw_opening_m: float | None) -> Expectation | None:
        """The numbers that ``gripmon check`` prints, with what this image alone would teach."""
        gripper, settings, taught = self.gripper, self.settings, None
        opening_m = gripper.jaw_nominal_m if jaw_opening_m is None else jaw_opening_m
        with contextlib.suppress(TeachingRefused):
            taught = self.taught(reference, [TeachingImage(image, opening_m, "")])[1]
        rig, cam_T_grip = Rig(self.camera, gripper, settings, taught), from_record(reference.cam_T_grip)
        frame = forecast_frame(rig, cam_T_grip, jaw_opening_m, with_jaw=True)
        if not frame.enough:
            return None
        promise = promise_of(rig, cam_T_grip, jaw_opening_m, frame)
        return Expectation(accuracy=frame, promise=f"forecast: {promise.promise()}", reachable=promise.reachable)

    def taught(self, reference: ReferenceRecord, images: Sequence[TeachingImage]) -> tuple[Taught, TaughtEdges]:
        """Teach from the images.  Raises :class:`~gripmon.teach.views.TeachingRefused`."""
        found = teach(Rig(self.camera, self.gripper, self.settings), reference, images)
        opening_m = float(np.mean([image.jaw_opening_m for image in found.used(images)]))
        pose, covariance = from_record(reference.cam_T_grip), own_covariance(reference, self.gripper)
        shown = found.reference_offset, found.reference_covariance
        return found, TaughtEdges.of(found.edges, self.gripper, pose, opening_m, covariance, *shown)


def _reference_of(pose: CornerPose) -> ReferenceRecord:
    """A pose from corners as the reference, rounded as in a file."""
    transform = to_record(pose.cam_T_grip)
    rounded = msgspec.structs.replace(
        transform,
        translation_m=tuple(round(v, 9) for v in transform.translation_m),
        rotation_xyzw=tuple(round(v, 10) for v in transform.rotation_xyzw),
    )
    digest = hashlib.sha256(msgspec.json.encode(rounded)).hexdigest()[:8]
    flat = tuple(float(f"{v:.6e}") for v in pose.covariance.ravel().tolist())
    return ReferenceRecord(f"corners-{digest}", 0, 0, "configuration", rounded, flat)


class Saving(Protocol):
    """Writes what was taught."""

    def save(self, order: SaveOrder, found: Evaluation, number: int, pictures: Sequence[Picture]) -> Saved:
        """Raises :class:`SavingRefused`; an existing file is reported, and replaced only if that was agreed."""
        ...


@dataclass(frozen=True)
class Labels:
    """What the page shows beside the image."""

    robot: str
    camera_name: str
    fixed_names: bool
    folder: str
    files: dict[str, str]
    reference: str | None
    live: str | None


class TeachSession:
    """Images, corners and files of one person's teaching; every method may be called from any thread."""

    def __init__(
        self, setup: Setup, pictures: Sequence[Picture], labels: Labels, saving: Saving, live: Source | None = None
    ):
        self._setup, self._labels, self._saving, self._live = setup, labels, saving, live
        self._pictures = list(pictures)
        self._newest: Picture | None = None
        self._why_dark: str | None = None
        self._seen_s = time.monotonic()
        self._lock = threading.Lock()  # one computation at a time: OpenCV and NumPy would only slow each other down
        self._arrived = threading.Condition()
        self._ended = False
        self._reader: threading.Thread | None = None
        if live is not None:
            self._reader = threading.Thread(target=self._read, args=(live,), name="gripmon-teach-camera", daemon=True)
            self._reader.start()

    def close(self) -> None:
        """Release the camera."""
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()
        if self._live is not None:
            self._live.close()
        if self._reader is not None:
            self._reader.join(10.0)

    def state(self) -> State:
        setup, gripper = self._setup, self._setup.gripper
        opening_m = self._pictures[0].jaw_opening_m if self._pictures else None
        return State(
            width_px=setup.camera.width_px,
            height_px=setup.camera.height_px,
            corners=gripper.corner_ids,
            places={name: _place(at) for name, at in setup.first_places(opening_m).items()},
            pictures=self._infos(),
            has_jaw=gripper.has_jaw,
            jaw_m=(gripper.jaw_min_m, gripper.jaw_nominal_m, gripper.jaw_max_m),
            gripper=gripper.name,
            needed=0 if setup.reference is not None else FEWEST_PUT,
            **vars(self._labels),
        )

    def look(self, put: CornersRequest) -> Evaluation:
        """Snap.  Raises :class:`BadRequest`."""
        return self._evaluated(put, self._picture(put.image))

    def take(self) -> tuple[PictureInfo, ...]:
        """Keep the live image.  Raises :class:`BadRequest`."""
        picture = self._picture(None)
        with self._arrived:
            if len(self._pictures) >= _MOST_PICTURES:
                raise BadRequest(f"{_MOST_PICTURES} images are enough")
            name = f"live-{len(self._pictures):03d}.png"
            self._pictures.append(Picture(name, picture.image, picture.jaw_opening_m, None))
        return self._infos()

    def save(self, order: SaveOrder) -> Saved:
        """Write what was taught, or return the reason why not.  Raises :class:`BadRequest`."""
        if not self._pictures:
            self.take()
        number = order.put.image if order.put.image is not None else len(self._pictures) - 1
        found = self._evaluated(order.put, self._picture(number))
        with self._lock:
            try:
                return self._saving.save(order, found, number, tuple(self._pictures))
            except SavingRefused as refused:
                return Saved(refused=str(refused))

    def still(self, number: int) -> bytes:
        """An image as PNG.  Raises :class:`BadRequest`."""
        return encoded(self._picture(number).image, ".png")

    def live(self) -> bytes:
        """The live image as JPEG.  Raises :class:`BadRequest`."""
        return encoded(self._picture(None).image, ".jpg")

    def dark(self) -> tuple[float, str]:
        """For how long (s) the live camera has delivered no usable image, and why; 0 without a live camera."""
        with self._arrived:
            if self._live is None or self._newest is not None:
                return 0.0, ""
            return time.monotonic() - self._seen_s, self._why_dark or "the camera has sent nothing yet"

    def _evaluated(self, put: CornersRequest, picture: Picture) -> Evaluation:
        gripper = self._setup.gripper
        fault = corners_fault(put.corners, gripper)
        if fault is not None:
            raise BadRequest("{}: {}; {}".format(*fault))
        opening_m = put.jaw_opening_m if gripper.has_jaw else None
        if opening_m is not None and not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
            low_mm, high_mm = 1e3 * gripper.jaw_min_m, 1e3 * gripper.jaw_max_m
            raise BadRequest(f"jaw opening {1e3 * opening_m:g} mm; the gripper's {low_mm:g} to {high_mm:g} mm")
        corners = {name: np.array(at) for name, at in put.corners.items()}
        with self._lock:
            return self._setup.evaluate(picture.image, corners, put.by_hand, opening_m)

    def _picture(self, number: int | None) -> Picture:
        if number is not None:
            if number >= len(self._pictures):
                raise BadRequest(f"there is no image {number}; {len(self._pictures)} are there")
            return self._pictures[number]
        if self._live is None:
            raise BadRequest("there is no live camera here; the number of an image")
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest or self._why_dark or self._ended, _LIVE_WAIT_S)
            if self._newest is None:
                raise BadRequest(self._why_dark or "the camera has sent nothing yet")
            return self._newest

    def _infos(self) -> tuple[PictureInfo, ...]:
        return tuple(
            PictureInfo(number=number, name=picture.name, jaw_opening_m=picture.jaw_opening_m)
            for number, picture in enumerate(self._pictures)
        )

    def _read(self, live: Source) -> None:
        while not self._ended:
            try:
                frame = live.read()
            except Exception as error:  # noqa: BLE001  whatever a driver raises, report it to the page
                frame = Waiting(f"{self._labels.live}: {error}; start gripmon teach again")
                self._ended = True
            if frame is None:
                break
            with self._arrived:
                # An old image would look like a camera that stands still.
                self._newest = None
                if isinstance(frame, Waiting):
                    self._why_dark = frame.reason
                else:
                    self._newest = self._usable(frame)
                if self._newest is not None:
                    self._seen_s = time.monotonic()
                self._arrived.notify_all()

    def _usable(self, frame: Frame) -> Picture | None:
        frame = in_full_scale(frame, self._setup.settings.bit_depth)
        fault = inspect(frame, self._setup.camera, self._setup.gripper)
        self._why_dark = None if fault is None else f"{self._labels.live}: {fault[1]}"
        if fault is not None:
            return None
        assert frame.image is not None
        return Picture("live", frame.image, frame.jaw_opening_m, None)


def _place(at: Array) -> Place | None:
    u, v = np.asarray(at, dtype=float).tolist()
    return (round(u, 4), round(v, 4)) if np.isfinite(at).all() else None
