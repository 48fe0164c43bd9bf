"""What programs call to teach; ``gripmon teach --config`` calls it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import cv2
import msgspec
import numpy as np

from gripmon import __version__
from gripmon.io.sources.files import TIMESTAMPS_NAME, opening_beside
from gripmon.judge.inspection import inspect
from gripmon.model.camera import Camera
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.images import image_in, image_paths
from gripmon.model.pixels import in_full_scale
from gripmon.model.records import Array, Frame, Image, ReferenceRecord
from gripmon.model.response import Response, ResponseSeen, response_of
from gripmon.model.yaml_text import as_yaml
from gripmon.monitor import MonitorSettings, Tracker, seen_in_images, warm_up
from gripmon.teach.drawing import draw_taught
from gripmon.teach.kept import Kept, as_frames, kept, with_help
from gripmon.teach.measure import Taught
from gripmon.teach.measure import teach as teach_images
from gripmon.teach.views import TeachingImage, TeachingRefused
from gripmon.teach.visibility import Rig
from gripmon.track.edges import TaughtEdges
from gripmon.track.edges.taught import Provenance, TaughtImage, TaughtModel, identity, own_covariance

__all__ = ["Configured", "Teaching", "teach"]


class _Jaw(Protocol):
    @property
    def source(self) -> str: ...


class _Settings(Protocol):
    @property
    def monitor(self) -> MonitorSettings: ...
    @property
    def jaw(self) -> _Jaw: ...


class Configured(Protocol):
    """The part of a configuration that teaching needs; :class:`gripmon.Config` has it."""

    @property
    def camera(self) -> Camera: ...
    @property
    def gripper(self) -> Gripper: ...
    @property
    def reference(self) -> ReferenceRecord: ...
    @property
    def jaw_opening_m(self) -> float | None: ...
    @property
    def settings(self) -> _Settings: ...
    @property
    def says_response(self) -> bool: ...


@dataclass(frozen=True)
class Teaching:
    """How every edge looks in the images (``taught``), and the ``model`` that a configuration names; ``images``: those
    that were taught from; ``rig``: what was taught, with the monitor's settings for the ``response`` of the camera.
    """

    taught: Taught
    model: TaughtModel
    rig: Rig
    reference: ReferenceRecord
    images: tuple[TeachingImage, ...]
    response: ResponseSeen

    @property
    def edges(self) -> TaughtEdges:
        """What was taught, as the monitor uses it."""
        gripper = self.rig.gripper
        return TaughtEdges.of_model(self.model, gripper, own_covariance(self.reference, gripper))

    def kept(self) -> tuple[Kept, Kept]:
        """What a monitor says over the images without what was taught, and with it."""
        frames, taught = as_frames(self.images), self.rig._replace(taught=self.edges)
        before, after = (kept(rig, self.reference, frames) for rig in (self.rig, taught))
        return before, with_help(after, taught, lambda rig: kept(rig, self.reference, frames))

    def text(self) -> str:
        """The taught model's file (YAML)."""
        return to_yaml(self.model)

    def picture(self, ending: str = ".png") -> bytes:
        """The first image used, with what was taught drawn, offsets enlarged; ``ending``: .png, .jpg or .jpeg."""
        camera, gripper, _, _ = self.rig
        edges, pose = TaughtEdges.of_model(self.model, gripper), from_record(self.reference.cam_T_grip)
        drawn = draw_taught(camera, gripper, pose, self.images[0], edges, self.model)
        return bytes(cv2.imencode(ending, drawn)[1].tobytes())


def teach(
    config: Configured,
    images: Sequence[str | Path],
    *,
    jaw_opening_m: float | None = None,
    response: str = "auto",
    command: str = "gripmon.teach.api.teach",
) -> Teaching:
    """Measure how the gripper's edges look in image files taken at the reference calibration; of a folder, all images.

    ``config``: load it without a taught model (``with_taught=False``).  ``jaw_opening_m``: the opening in all images
    (m); if None, the configuration's fixed one, else that in a ``timestamps.csv`` beside each image.  ``response``:
    linear or srgb; auto: as the configuration says, else as the images show.  ``command`` is written into the model's
    provenance.

    Raises :class:`~gripmon.model.errors.InputError` for images that can't be used,
    :class:`~gripmon.model.errors.NoResultError` if nothing can be taught from them.
    """
    cv2.setNumThreads(1)
    if not images:
        raise InputError("teach: no image; image files at the reference calibration")
    gripper, settings = config.gripper, config.settings.monitor
    if jaw_opening_m is None and config.settings.jaw.source == "fixed":
        jaw_opening_m = config.jaw_opening_m
    pictures = [
        read_picture(path, config.camera, gripper, settings.bit_depth, jaw_opening_m) for path in image_paths(images)
    ]
    for each in pictures:
        if each.jaw_opening_m is None and gripper.has_jaw:
            assert each.path is not None
            wrong = f"its jaw opening isn't known (jaw.source is {config.settings.jaw.source})"
            right = f"--jaw-opening M, or jaw_opening_m in {Path(each.path).parent / TIMESTAMPS_NAME}"
            raise InputError(f"{each.path}: {wrong}; {right}")
    _check_different(pictures)
    seen = told_response(pictures, response, settings.corners.edges.response if config.says_response else None)
    rig = Rig(config.camera, gripper, settings.with_response(seen.response))
    try:
        return taught_from(pictures, rig, config.reference, seen, command)
    except TeachingRefused as refused:
        raise NoResultError(f"teach: {refused}", refused.notes) from None


def taught_from(
    pictures: Sequence[Picture],
    rig: Rig,
    reference: ReferenceRecord,
    response: ResponseSeen,
    command: str,
    data: Mapping[str, bytes] = {},
) -> Teaching:
    """The same from pictures that are read; a jaw opening that isn't known counts as the nominal one.  ``rig``: with
    the settings for the ``response``; ``data``: by path, images not yet written to files.  Raises
    :class:`~gripmon.teach.views.TeachingRefused`.
    """
    warm_up()
    nominal_m = rig.gripper.jaw_nominal_m
    shown = [
        TeachingImage(p.image, nominal_m if p.jaw_opening_m is None else p.jaw_opening_m, str(p.path)) for p in pictures
    ]
    taught = teach_images(rig, reference, shown)
    model, used = _model(taught, rig, reference, pictures, command, data), tuple(taught.used(shown))
    model = _with_what_is_seen(model, rig, reference, as_frames(used), taught.play)
    return Teaching(taught, model, rig, reference, used, response)


def _with_what_is_seen(
    model: TaughtModel, rig: Rig, reference: ReferenceRecord, frames: Sequence[Frame], play: Array
) -> TaughtModel:
    """The model with where a monitor that knows it sees the gripper in its images: what a motion counts from."""
    edges = TaughtEdges.of_model(model, rig.gripper, own_covariance(reference, rig.gripper))
    tracker = Tracker(rig.camera, rig.gripper, rig.settings, edges)
    taught_ns = 1_000_000_000 * int(datetime.fromisoformat(model.provenance.time).timestamp())
    seen = seen_in_images(tracker, rig.gripper, rig.settings, reference, frames, play, taught_ns)
    if seen is None:
        return model
    x, y, z, about_x, about_y, about_z = np.round(play, 9).tolist()
    known = msgspec.structs.replace(model.reference, play=(x, y, z, about_x, about_y, about_z), seen=seen)
    return msgspec.structs.replace(model, reference=known)


def told_response(pictures: Sequence[Picture], asked: str, configured: Response | None) -> ResponseSeen:
    """The response that is ``asked`` for; for auto the one that is ``configured`` (None: not said), else what the
    pictures show.  Raises :class:`~gripmon.model.errors.InputError` where what is asked contradicts what is configured.
    """
    if configured is not None:
        if asked not in ("auto", configured):
            wrong = f"{asked}, and the configuration has monitor.corners.edges.response: {configured}"
            raise InputError(f"{wrong}; the same, or leave one of them out", "response")
        found = response_of([p.image for p in pictures], "auto", [p.jaw_opening_m for p in pictures])
        against = found.gamma > 0.0 and "unknown" not in (found.response, configured) and found.response != configured
        why = f"as configured, but {found.why}" if against else "as configured"
        return replace(found, response=configured, why=why) if against else ResponseSeen(configured, why)
    return response_of([p.image for p in pictures], asked, [p.jaw_opening_m for p in pictures])


def _check_different(pictures: Sequence[Picture]) -> None:
    """A duplicate image would make the scatter, and so the uncertainty, too small."""
    seen: dict[str, str] = {}
    for each in pictures:
        assert each.path is not None
        digest = hashlib.sha256(Path(each.path).read_bytes()).hexdigest()
        if digest in seen:
            raise InputError(f"{each.path}: is the same image as {seen[digest]}; each image once")
        seen[digest] = each.path


@dataclass(frozen=True)
class Picture:
    """An image to teach from; ``jaw_opening_m`` is None if unknown, ``path`` None for a live image without a file."""

    name: str
    image: Image
    jaw_opening_m: float | None
    path: str | None


def read_picture(
    path: Path, camera: Camera, gripper: Gripper, bit_depth: int, jaw_opening_m: float | None = None
) -> Picture:
    """Read an image that fits the camera, in full scale, with its jaw opening: the one given, else that in its folder's
    ``timestamps.csv``.  Raises :class:`~gripmon.model.errors.InputError`.
    """
    image = image_in(path)
    frame = in_full_scale(Frame(0, 0, image, None, str(path)), bit_depth)
    refused = inspect(frame, camera, gripper)
    if refused is not None or frame.image is None:
        kind, why = refused or (frame.refusal, frame.fault)
        raise InputError(f"{path}: {kind}: {why}")
    return Picture(path.name, frame.image, _opening(path, gripper, jaw_opening_m), str(path))


def _opening(path: Path, gripper: Gripper, opening_m: float | None) -> float | None:
    if not gripper.has_jaw:
        if opening_m is not None:
            raise InputError("the gripper has no jaw; leave it out", "jaw_opening_m")
        return None
    opening_m = opening_beside(path) if opening_m is None else opening_m
    if opening_m is not None and not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
        raise InputError(
            f"{path}: jaw opening {opening_m:g} m; the gripper's {gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m"
        )
    return opening_m


def _model(
    taught: Taught,
    rig: Rig,
    reference: ReferenceRecord,
    pictures: Sequence[Picture],
    command: str,
    data: Mapping[str, bytes],
) -> TaughtModel:
    """The model of what was taught, bound to its inputs."""
    images = []
    for picture in pictures:
        assert picture.path is not None, "an image has a file before it is taught from"
        content = data.get(picture.path) or Path(picture.path).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        images.append(TaughtImage(file=picture.path, sha256=digest, jaw_opening_m=picture.jaw_opening_m))
    lens, model, stated_reference = identity(
        rig.camera, rig.gripper, reference.reference_id, from_record(reference.cam_T_grip)
    )
    return TaughtModel(
        provenance=Provenance(
            gripmon=__version__,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            command=command,
            images=tuple(taught.used(images)),
            closure_px=taught.closure_px,
        ),
        camera=lens,
        gripper=model,
        reference=msgspec.structs.replace(
            stated_reference, offset=taught.reference_offset, images_covariance=taught.reference_covariance
        ),
        edge_settings=rig.settings.corners.edges,
        edges=taught.edges,
        corners=taught.corners,
    )


_HEADER = """\
# Taught model: written by gripmon teach, named by `taught:` in a configuration.  Not to be edited: teach again.
# It belongs to exactly this camera, gripper file, reference and edge settings, and is refused with any others.
#   reference.offset    how far off the reference the gripper appeared in the images, as far as bevels don't explain it:
#                       along and about the camera's axes (m, rad); every bound includes it
#   reference.images_covariance  how well the images show where the gripper was, 6 x 6 row by row; with the covariance
#                       of the configured reference it is what absolute bounds include of the reference's error
#   reference.play      standard deviations of where one image has the gripper from another, by the play of mount and
#                       fingers: along and about the camera's axes (m, rad)
#   reference.seen      where a monitor sees the gripper in the images: what the motion since the reference counts from
#   edges.*.share       the part of the edge that was seen, between its `from` (0) and its `to` (1)
#   edges.*.offset_m    how far the edge shows beside the sharp model's at the two ends of that part, across the line of
#                       sight, positive to the right of someone who walks along it in the image (m); sigma_m: its
#                       standard deviation
#   edges.*.depth_m     how much deeper it lies, along the line of sight; follows from the shape of a bevel (m)
#   edges.*.crease      true: between two visible faces; false: an outline
#   edges.*.brighter    the brighter side of a crease, where it may be relied on
#   edges.*.rms_px      scatter of the edge points about the line (px); seen: share of its search lines that showed it
#   corners.*.uv_px     where taught edges meet in the first image (px), and its standard deviation
# The measurement uses offsets, depths, their deviations, crease and brighter; the rest below edges and corners
# describes what was seen.
"""


def to_yaml(model: TaughtModel) -> str:
    """The file's text; reading it gives exactly the same model."""
    return _HEADER + as_yaml(_without_nothing(msgspec.to_builtins(model)), inline=True)


def _without_nothing(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nothing(item) for key, item in value.items() if item is not None}
    return [_without_nothing(item) for item in value] if isinstance(value, list | tuple) else value
