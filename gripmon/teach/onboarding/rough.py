"""A file with rough corners: where somebody has seen the gripper's corners in an image."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

Pixel = tuple[float, float]


class RoughCorners(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``corners``: u right, v down in pixels, the centre of the first one at (0, 0); several pixels off is fine."""

    corners: Annotated[dict[str, Pixel], Meta(min_length=1, description="name: [u, v] (px)")]
