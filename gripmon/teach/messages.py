"""Messages between the teaching page and its server: JSON, typed on the server's side.  Lengths in metres, angles in
radians, image coordinates in px (centre of the first pixel: 0, 0), as everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.records import Image
from gripmon.teach.accuracy import Accuracy

Pixel = Annotated[float, Meta(ge=-1e5, le=1e5)]
Place = tuple[Pixel, Pixel]
Key = Annotated[str, Meta(pattern=r"^[^/*$#?@\s][^/*$#?\s]*$", max_length=100)]
Opening = Annotated[float, Meta(ge=0.0, le=0.5)]


class BadRequest(ValueError):
    """A request that can't be met; the text gives the reason in one line."""


class SavingRefused(Exception):
    """Nothing was written; the text gives the reason in one line, ``notes`` the rest."""

    def __init__(self, text: str, notes: Sequence[str] = ()):
        super().__init__(text)
        self.notes = tuple(notes)


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of the page's requests."""


class CornersRequest(Request, frozen=True):
    """Corners set by hand in one image; those ``by_hand`` are used as they are.  ``image`` None: the live image."""

    corners: Annotated[dict[str, Place], Meta(max_length=1000)]
    by_hand: Annotated[tuple[str, ...], Meta(max_length=1000)] = ()
    image: Annotated[int, Meta(ge=0)] | None = None
    jaw_opening_m: Opening | None = None


class SaveOrder(Request, frozen=True):
    """What to write.  ``replace``: the person has agreed to replace existing files."""

    put: CornersRequest
    robot: Key
    camera_name: Key
    taught: bool = True
    config: bool = True
    corners: bool = True
    replace: bool = False


class EmptyRequest(Request, frozen=True):
    """A request without parameters."""


class PictureInfo(msgspec.Struct, frozen=True, kw_only=True):
    number: int
    name: str
    jaw_opening_m: float | None


class State(msgspec.Struct, frozen=True, kw_only=True):
    """What the page starts with.  ``corners_only``: there is no gripper, nothing snaps; ``saves``: what can be saved;
    ``back``: where the page goes when the person is done.
    """

    width_px: int
    height_px: int
    corners: tuple[str, ...]
    places: dict[str, Place | None]
    pictures: tuple[PictureInfo, ...]
    live: str | None
    has_jaw: bool
    jaw_m: tuple[float, float, float]
    gripper: str
    reference: str | None
    needed: int
    robot: str
    camera_name: str
    fixed_names: bool
    folder: str
    files: dict[str, str]
    corners_only: bool = False
    saves: tuple[str, ...] = ("config", "taught", "corners")
    back: str | None = None


class CornerReply(msgspec.Struct, frozen=True, kw_only=True):
    """``model_px``: where the pose projects it; the rest as in :class:`gripmon.teach.snapping.SnappedCorner`."""

    name: str
    model_px: Place | None
    uv_px: Place | None
    covariance_px2: tuple[float, float, float] | None
    sigma_px: float | None
    inliers: float | None
    reason: str | None


class Expectation(msgspec.Struct, frozen=True, kw_only=True):
    """Of one frame: its ``accuracy``, and as a text the ``promise``: bounds on its error beside the alert limits;
    ``reachable``: it keeps them.
    """

    accuracy: Accuracy
    promise: str
    reachable: bool


class ReferenceReply(msgspec.Struct, frozen=True, kw_only=True):
    """``id`` with standard deviations (6,)."""

    id: str
    sigma: tuple[float, ...]
    corners: int | None
    rival: bool


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """What follows from corners set by hand."""

    corners: tuple[CornerReply, ...]
    outlines_px: dict[str, tuple[Place, ...]]
    edge_points_px: tuple[Place, ...]
    share: float
    refused: str | None
    jaw_opening_m: float | None
    jaw_sigma_m: float | None
    reference: ReferenceReply | None
    no_reference: str | None
    expected: Expectation | None


class Saved(msgspec.Struct, frozen=True, kw_only=True):
    """``refused``: why nothing was written; ``exists``: files in the way, for which nothing was written either;
    otherwise ``written`` (path: what it is, as a text), ``notes`` and the ``next`` command.
    """

    refused: str | None = None
    exists: tuple[str, ...] = ()
    written: dict[str, str] = {}
    notes: tuple[str, ...] = ()
    next: str | None = None


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    error: str


def encoded(image: Image, ending: str) -> bytes:
    """An image (h, w) for a browser, ``.png`` or ``.jpg``: eight bits, more are scaled to the image's own range."""
    grey = image
    if image.dtype != np.uint8:
        low, high = np.percentile(image[::4, ::4], [0.5, 99.5]).tolist()
        grey = np.clip((image.astype(np.float32) - low) * (255.0 / max(high - low, 1e-6)), 0.0, 255.0).astype(np.uint8)
    _, data = cv2.imencode(ending, grey, [cv2.IMWRITE_JPEG_QUALITY, 85] if ending == ".jpg" else [])
    return bytes(data.tobytes())
