"""What goes between the daemon and the recording process: messages over a pipe, images through shared memory."""

from __future__ import annotations

import mmap
import os
import uuid
from collections.abc import Iterator

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.laser.setup import LaserCalibration
from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import (
    AlertRecord,
    Array,
    FrameRecord,
    Limits,
    MeasurementTrace,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    SpotRecord,
    StateRecord,
)
from gripmon.record.write.settings import RecordingSettings
from gripmon.record.write.view import ViewSettings

_JAW_SAMPLES = 33
_LENGTH_BYTES = 4
_PIXEL_TYPES = frozenset({"|u1", "<u2", "<f4"})


class Scene(msgspec.Struct, frozen=True):
    """The first message: all that doesn't change while a recording runs.

    ``points_m`` (k, p, 3) are the gripper's points in its own frame at the k openings ``jaw_openings_m``; ``edges`` and
    ``faces`` index the points.
    """

    name: str
    recording_id: str
    directory: str
    settings: RecordingSettings
    robot: str
    camera: str
    gripper: str
    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    lens: str
    corner_ids: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    faces: tuple[tuple[int, ...], ...]
    jaw_nominal_m: float
    jaw_openings_m: tuple[float, ...]
    points_m: list[list[tuple[float, float, float]]]
    reference: ReferenceRecord | None  # of a wrist camera
    has_truth: bool
    version: str
    configuration: RecordedConfiguration | None
    view: ViewSettings | None = None  # for whom it is served live, too
    laser: LaserCalibration | None = None  # of a second camera

    @property
    def tcp_m(self) -> Array:
        """Where the reference has the TCP of a wrist camera's gripper, camera frame."""
        assert self.reference is not None, "a wrist camera's"
        return np.array(self.reference.cam_T_grip.translation_m)


class ImageNote(msgspec.Struct, frozen=True, array_like=True):
    """An image in the shared memory."""

    slot: int
    shape: tuple[int, ...]
    pixel_type: str


class TraceNote(msgspec.Struct, frozen=True, array_like=True):
    """A :class:`MeasurementTrace` in bytes: positions as float32 pairs, distances as float32, flags as uint8."""

    edge_uv_px: bytes
    edge_used: bytes
    edge_residual_px: bytes
    predicted_edges_uv_px: bytes
    predicted_edge_lengths: list[int]
    predicted_corners_uv_px: bytes


class FrameNote(msgspec.Struct, frozen=True, array_like=True):
    """``limits`` where they are others than those of the frame before; ``statistic_share`` as in
    :class:`gripmon.model.records.MonitorNotes`.
    """

    record: FrameRecord | SpotRecord
    image: ImageNote | None
    trace: TraceNote | None
    truth_tcp_m: tuple[float, float, float] | None
    jaw_reported_m: float | None
    statistic_share: float | None
    limits: Limits | None
    due: bool  # its image is written in any case, not only around an alert
    lost: bool  # its image had no room


class Events(msgspec.Struct, frozen=True, array_like=True):
    """What happened beside the frames: alerts that are in no frame's record, and the rest as the daemon has it."""

    alerts: list[AlertRecord] = []
    references: list[ReferenceRecord] = []
    commands: list[RecordedCommand] = []
    states: list[StateRecord] = []

    @staticmethod
    def at_first(reference: ReferenceRecord | None) -> Events:
        """What a file begins with: the reference in force, if there is one."""
        return Events(references=[] if reference is None else [reference])

    def __bool__(self) -> bool:
        return bool(self.alerts or self.references or self.commands or self.states)

    def __add__(self, later: Events) -> Events:
        return Events(
            self.alerts + later.alerts,
            self.references + later.references,
            self.commands + later.commands,
            self.states + later.states,
        )


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """What goes over the pipe at once, as it is read."""

    frames: list[FrameNote]
    events: Events


class EncodedBatch(msgspec.Struct, frozen=True, array_like=True):
    """The same as it is written: every :class:`FrameNote` is encoded on its own."""

    frames: list[msgspec.Raw]
    events: Events


class Status(msgspec.Struct, frozen=True):
    """What the recording process reports; all counts are since it began.

    ``failure`` says why nothing is being written at the moment, None when all is well.
    """

    path: str | None
    failure: str | None
    frames: int
    frames_lost: int
    images_done: int
    view_failure: str | None = None  # of the live view, which is no failure of the recording
    notice: str | None = None  # what a person may want to do about earlier files
    images_lost: int = 0  # around alerts, or with a disk that failed; those that were due never came here


def make_scene(
    settings: RecordingSettings,
    directory: str,
    name: str,
    robot: str,
    camera_name: str,
    camera: Camera,
    gripper: Gripper,
    reference: ReferenceRecord,
    has_truth: bool = False,
    configuration: RecordedConfiguration | None = None,
) -> Scene:
    from gripmon import __version__

    openings_m = np.linspace(gripper.jaw_min_m, gripper.jaw_max_m, _JAW_SAMPLES) if gripper.has_jaw else np.zeros(1)
    return Scene(
        name=name,
        recording_id=f"{name}-{uuid.uuid4()}",
        directory=directory,
        settings=settings,
        robot=robot,
        camera=camera_name,
        gripper=gripper.name,
        width_px=camera.width_px,
        height_px=camera.height_px,
        focal_px=(camera.fx_px, camera.fy_px),
        centre_px=(camera.cx_px, camera.cy_px),
        lens=msgspec.json.encode(camera.settings).decode(),
        corner_ids=gripper.corner_ids,
        edges=tuple((int(i), int(j)) for i, j in gripper.edge_points),
        faces=tuple(tuple(int(i) for i in face.points) for face in gripper.faces),
        jaw_nominal_m=gripper.jaw_nominal_m,
        jaw_openings_m=tuple(openings_m.tolist()),
        points_m=[gripper.points_grip_m(opening_m).tolist() for opening_m in openings_m.tolist()],
        reference=reference,
        has_truth=has_truth,
        version=__version__,
        configuration=configuration,
    )


def make_spot_scene(
    settings: RecordingSettings,
    directory: str,
    name: str,
    robot: str,
    camera_name: str,
    calibration: LaserCalibration,
    configuration: RecordedConfiguration | None = None,
) -> Scene:
    """The same of a second camera; there is no gripper."""
    from gripmon import __version__

    lens = calibration.camera
    return Scene(
        name=name,
        recording_id=f"{name}-{uuid.uuid4()}",
        directory=directory,
        settings=settings,
        robot=robot,
        camera=camera_name,
        gripper="",
        width_px=lens.width_px,
        height_px=lens.height_px,
        focal_px=(lens.fx_px, lens.fy_px),
        centre_px=(lens.cx_px, lens.cy_px),
        lens=msgspec.json.encode(lens).decode(),
        corner_ids=(),
        edges=(),
        faces=(),
        jaw_nominal_m=0.0,
        jaw_openings_m=(),
        points_m=[],
        reference=None,
        has_truth=False,
        version=__version__,
        configuration=configuration,
        laser=calibration,
    )


def pack_trace(trace: MeasurementTrace) -> TraceNote:
    edges = trace.predicted_edges_uv_px
    return TraceNote(
        edge_uv_px=trace.edge_uv_px.astype(np.float32).tobytes(),
        edge_used=trace.edge_used.astype(np.uint8).tobytes(),
        edge_residual_px=trace.edge_residual_px.astype(np.float32).tobytes(),
        predicted_edges_uv_px=b"".join([edge.astype(np.float32).tobytes() for edge in edges]),
        predicted_edge_lengths=[len(edge) for edge in edges],
        predicted_corners_uv_px=trace.predicted_corners_uv_px.astype(np.float32).tobytes(),
    )


def pairs(packed: bytes) -> NDArray[np.float32]:
    """(n, 2) from the bytes of a :class:`TraceNote`."""
    return np.frombuffer(packed, np.float32).reshape(-1, 2)


class ImageRing:
    """Slots for images in memory that two processes share.

    The memory has no name: it is gone as soon as both processes are, however they end.  Pages that were never written
    cost nothing, so a slot has room for the widest pixels.
    """

    def __init__(self, slots: int, slot_bytes: int, descriptor: int | None = None):
        """With a ``descriptor``: the ring that another process made."""
        self.slots = slots
        self.slot_bytes = slot_bytes
        self.descriptor = os.memfd_create("gripmon-images") if descriptor is None else descriptor
        if descriptor is None:
            os.ftruncate(self.descriptor, slots * slot_bytes)
        self._map = mmap.mmap(self.descriptor, slots * slot_bytes)

    @staticmethod
    def for_camera(width_px: int, height_px: int, slots: int, descriptor: int | None = None) -> ImageRing:
        return ImageRing(slots, width_px * height_px * 3 * 4, descriptor)

    def put(self, slot: int, image: NDArray[np.generic]) -> ImageNote:
        """Copy an image into a slot; the interpreter lock is free while the pixels move."""
        view = np.frombuffer(self._map, image.dtype, image.size, slot * self.slot_bytes).reshape(image.shape)
        np.copyto(view, image)
        return ImageNote(slot, image.shape, image.dtype.str)

    def get(self, note: ImageNote) -> NDArray[np.generic]:
        """A view, good until the slot is given back."""
        count = int(np.prod(note.shape))
        flat = np.frombuffer(self._map, np.dtype(note.pixel_type), count, note.slot * self.slot_bytes)
        return flat.reshape(note.shape)

    def takes(self, image: object) -> bool:
        """Whether this is an image (grey or BGR, 8 or 16 bit or float) that fits into a slot."""
        if not isinstance(image, np.ndarray) or image.dtype.str not in _PIXEL_TYPES or image.size == 0:
            return False
        grey_or_bgr = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
        return grey_or_bgr and image.nbytes <= self.slot_bytes

    def close(self) -> None:
        self._map.close()
        os.close(self.descriptor)


def framed(payload: bytes) -> bytes:
    return len(payload).to_bytes(_LENGTH_BYTES, "little") + payload


class Unframer:
    """Bytes as they come from a pipe -> whole payloads."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, part: bytes) -> Iterator[bytes]:
        self._buffer += part
        while len(self._buffer) >= _LENGTH_BYTES:
            end = _LENGTH_BYTES + int.from_bytes(self._buffer[:_LENGTH_BYTES], "little")
            if len(self._buffer) < end:
                return
            payload = bytes(self._buffer[_LENGTH_BYTES:end])
            del self._buffer[:end]
            yield payload
