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
    keep_files: Annotated[
        int, Meta(ge=0, description="newest files of a run that are kept, older ones are deleted; 0 keeps all")
    ] = 0
