"""Recording, on both sides of the pipe: settings, the recorder's interface, and the messages.

The loop's thread only appends to a bounded queue.  Another thread of the daemon passes the queue on to a separate
process, which encodes the images, logs to rerun and manages the files, so that neither JPEG, rerun nor a slow disk
ever blocks the interpreter in which the loop runs.  The daemon itself never imports rerun.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon import __version__
from gripmon.model.camera import LensSettings
from gripmon.model.gripper import GripperModel
from gripmon.model.outputs import Event, Output
from gripmon.model.records import (
    AlertRecord,
    FrameRecord,
    Limits,
    MeasurementTrace,
    RecordedCommand,
    RecordedConfiguration,
    ReferenceRecord,
    StateRecord,
)
from gripmon.model.shared_images import ImagePlace

LOOPBACK = "127.0.0.1"

RECORDING_PATIENCE_S = 30.0
"""How long a source that can wait, and is read faster than any camera, waits for the recording before a frame is
dropped (s)."""


class RecordingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is recorded, how much of it, and what the disk must keep free."""

    enabled: Annotated[bool, Meta(description="false: nothing is recorded")] = True
    directory: Annotated[str, Meta(
        min_length=1, description="where the .rrd files go; made if it is missing")] = "recordings"
    image_rate_hz: Annotated[float, Meta(ge=0.0, le=1000.0, description="rate of recorded images and overlays in "
        "capture time, besides those at alerts and state changes (Hz)")] = 10.0
    image_every: Annotated[int, Meta(
        ge=0, description="in addition, the image of every n-th frame; 1: every frame; 0: none (frames)")] = 0
    around_alert_s: Annotated[float, Meta(ge=0.0, le=600.0, description="time before and after an alert in which every "
        "image is kept; 0: only the usual images (s)")] = 5.0
    ring_bytes: Annotated[int, Meta(
        ge=0, description="memory for the images before an alert; the oldest are dropped (bytes)")] = 100_000_000
    image_format: Annotated[Literal["jpeg", "png"], Meta(
        description="png is lossless and about five times larger")] = "jpeg"
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="JPEG quality (%)")] = 85
    queue_frames: Annotated[int, Meta(ge=1, le=100_000, description="length of the queue to the recording; when it is "
        "full, frames are dropped")] = 512
    queue_images: Annotated[int, Meta(ge=1, le=256, description="length of the queue of images to the recording; when "
        "it is full, images are dropped")] = 8
    flush_period_s: Annotated[float, Meta(ge=0.05, le=10.0, description="period at which the file is written, and the "
        "most that a crash can lose (s)")] = 0.5
    min_free_bytes: Annotated[int, Meta(
        ge=0, description="free disk space below which recording pauses (bytes)")] = 200_000_000
    max_file_bytes: Annotated[int, Meta(
        ge=100_000, description="size at which a file is closed and the next one begun (bytes)")] = 500_000_000
    max_file_s: Annotated[float, Meta(
        ge=1.0, description="age at which a file that holds frames is closed and the next one begun (s)")] = 300.0
    budget_bytes: Annotated[int, Meta(ge=0, description="limit for all recordings of this robot and camera in the "
        "directory, earlier runs included: beyond it the oldest without a .pinned file are deleted; at least 4 * "
        "max_file_bytes; 0: no limit (bytes)")] = 50_000_000_000

    def __post_init__(self) -> None:
        if 0 < self.budget_bytes < 4 * self.max_file_bytes:
            raise ValueError(
                f"budget_bytes {self.budget_bytes} is less than four files of max_file_bytes {self.max_file_bytes}; "
                "a larger budget_bytes, a smaller max_file_bytes, or budget_bytes 0 for no limit"
            )


class ViewSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How ``gripmon run --view`` serves viewers, on this machine only."""

    port: Annotated[int, Meta(ge=1, le=65535, description="TCP port on 127.0.0.1 for rerun viewers (no unit)")] = 9876
    web_port: Annotated[
        int, Meta(ge=1, le=65535, description="TCP port on 127.0.0.1 of the page with the web viewer (no unit)")
    ] = 9090
    memory_limit_bytes: Annotated[
        int,
        Meta(
            ge=10_000_000,
            le=64_000_000_000,
            description="memory for viewers that join late or fall behind; the oldest data are dropped (bytes)",
        ),
    ] = 300_000_000

    @property
    def stream_url(self) -> str:
        """What a viewer connects to."""
        return f"rerun+http://{LOOPBACK}:{self.port}/proxy"


class Recorder(Output):
    """A recording, as an output; this base class records nothing.

    ``dropped`` counts frames that are not in the recording, ``images_dropped`` images missing from recorded frames;
    ``failure`` says why nothing is being written, None while all is well.
    """

    name = "recording"

    @property
    def dropped(self) -> int:
        return 0

    @property
    def images_dropped(self) -> int:
        return 0

    @property
    def failure(self) -> str | None:
        return None

    def close(self, timeout_s: float = 2.0) -> None:
        """Write what is queued, finish the file and release everything, within ``timeout_s``, then by force."""


class Then(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a run beside whose replay it is drawn, but for its frames: its limits (None: unknown), and the
    commands that it received.
    """

    limits: Limits | None
    commands: tuple[RecordedCommand, ...]


class Scene(msgspec.Struct, frozen=True, kw_only=True):
    """What the recording process is started with: everything that doesn't change while a recording runs.

    ``recording_id``: an id of its own, unless one is given.  ``then``: of the run that is replayed, None: it is none.
    """

    name: str
    directory: str
    settings: RecordingSettings
    robot: str
    camera: str
    lens: LensSettings
    gripper: GripperModel
    reference: ReferenceRecord
    has_truth: bool = False
    version: str = __version__
    configuration: RecordedConfiguration | None = None
    view: ViewSettings | None = None  # served live, too
    then: Then | None = None
    recording_id: str = ""

    def __post_init__(self) -> None:
        if not self.recording_id:
            msgspec.structs.force_setattr(self, "recording_id", f"{self.name}-{uuid.uuid4()}")

    @property
    def tcp_m(self) -> NDArray[np.float64]:
        """The TCP at the reference, in the camera frame."""
        return np.array(self.reference.cam_T_grip.translation_m)


class TraceNote(msgspec.Struct, frozen=True, array_like=True):
    """A :class:`MeasurementTrace` in bytes: positions as float32 pairs, distances as float32, flags as uint8."""

    edge_uv_px: bytes
    edge_used: bytes
    edge_residual_px: bytes
    predicted_edges_uv_px: bytes
    predicted_edge_lengths: list[int]
    predicted_corners_uv_px: bytes


class Picture(msgspec.Struct, frozen=True, array_like=True):
    """An encoded image with its statistics (grey values 0..255)."""

    blob: bytes
    media_type: str
    mean_grey: float
    contrast_grey: float
    saturated_percent: float
    sharpness: float


class Row(msgspec.Struct, frozen=True, array_like=True):
    """A frame on its way into a recording: through the daemon's queue, the pipe, and the process to the files.

    ``limits``: those in force, None: unknown; ``statistic_share``: see :class:`gripmon.model.records.MonitorNotes`.
    ``due``: its image is always written, not only around an alert; ``lost``: there was no room for it; ``image``: where
    it lies until it is a ``picture``; ``then``: what was recorded of it, if it is replayed.
    """

    record: FrameRecord
    picture: Picture | None = None
    trace: TraceNote | None = None
    truth_tcp_m: tuple[float, float, float] | None = None
    jaw_reported_m: float | None = None
    statistic_share: float | None = None
    limits: Limits | None = None
    due: bool = False
    lost: bool = False
    image: ImagePlace | None = None
    then: FrameRecord | None = None

    @property
    def picture_bytes(self) -> int:
        return 0 if self.picture is None else len(self.picture.blob)


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """One message over the pipe."""

    rows: list[Row]
    events: list[Event]


class Status(msgspec.Struct, frozen=True):
    """The status of the recording process; all counts are since its start.

    ``failure`` says why nothing is being written, None while all is well.
    """

    path: str | None = None
    failure: str | None = None
    frames: int = 0
    frames_lost: int = 0
    images_done: int = 0
    view_failure: str | None = None  # of the live view; the recording itself is not affected
    notice: str | None = None  # advice about earlier files
    images_lost: int = 0  # around alerts, or because of a failed disk; the sender counts dropped images that were due
    hangs: bool = False  # the disk doesn't answer


Kind = TypeVar("Kind", AlertRecord, RecordedCommand, ReferenceRecord, StateRecord)


def those(kind: type[Kind], events: Sequence[Event]) -> list[Kind]:
    """The events of a kind."""
    return [event for event in events if isinstance(event, kind)]


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
