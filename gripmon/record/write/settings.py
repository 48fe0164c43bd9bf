"""Settings of the recording."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta


class RecordingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is recorded, how much of it, and what the disk must keep free."""

    enabled: Annotated[bool, Meta(description="false: nothing is recorded")] = True
    directory: Annotated[str, Meta(min_length=1, description="where the .rrd files go; made if it is missing")] = (
        "recordings"
    )
    image_rate_hz: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1000.0,
            description="images and overlays a second of capture time, besides those at alerts and state changes (Hz)",
        ),
    ] = 10.0
    image_every: Annotated[
        int, Meta(ge=0, description="besides, the image of every n-th frame; 1: of every frame; 0: none (frames)")
    ] = 0
    around_alert_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=600.0,
            description="so long before and after an alert every image is kept; 0: none but the usual ones (s)",
        ),
    ] = 5.0
    ring_bytes: Annotated[
        int, Meta(ge=0, description="memory for the images before an alert; the oldest give way (bytes)")
    ] = 100_000_000
    image_format: Annotated[Literal["jpeg", "png"], Meta(description="png is lossless and about five times larger")] = (
        "jpeg"
    )
    jpeg_quality: Annotated[int, Meta(ge=1, le=100, description="JPEG quality (%)")] = 85
    queue_frames: Annotated[
        int, Meta(ge=1, le=100_000, description="frames that wait for a slow recording before frames are dropped")
    ] = 512
    queue_images: Annotated[
        int, Meta(ge=1, le=256, description="images that wait for a slow recording before images are dropped")
    ] = 8
    flush_period_s: Annotated[
        float, Meta(ge=0.05, le=10.0, description="how often the file is written: the most that a crash can lose (s)")
    ] = 0.5
    min_free_bytes: Annotated[
        int, Meta(ge=0, description="space that the disk keeps; recording pauses below it (bytes)")
    ] = 200_000_000
    max_file_bytes: Annotated[
        int, Meta(ge=100_000, description="a file this long is closed and the next begun (bytes)")
    ] = 500_000_000
    max_file_s: Annotated[
        float, Meta(ge=1.0, description="a file this old is closed and the next begun once it holds frames (s)")
    ] = 300.0
    budget_bytes: Annotated[
        int,
        Meta(
            ge=0,
            description="all recordings of this robot and camera in the directory, earlier runs' too: beyond this the "
            "oldest without a .pinned file are deleted; at least 4 * max_file_bytes; 0: no limit (bytes)",
        ),
    ] = 50_000_000_000

    def __post_init__(self) -> None:
        if 0 < self.budget_bytes < 4 * self.max_file_bytes:
            raise ValueError(
                f"budget_bytes {self.budget_bytes} is less than four files of max_file_bytes {self.max_file_bytes}; "
                "a larger budget_bytes, a smaller max_file_bytes, or budget_bytes 0 for no limit"
            )
