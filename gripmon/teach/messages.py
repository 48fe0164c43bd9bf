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

from gripmon.model.records import Image, ReferenceRecord
from gripmon.teach.accuracy import Accuracy
from gripmon.teach.corner_pose import CornerPose, Snapped

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
    """What the page starts with.  ``places``: where corners first show; ``needed``: how many of them must be set;
    ``corners_only``: there is no gripper, nothing snaps; ``saves``: what can be saved; ``back``: where the page goes
    when the person is done.
    """

    width_px: int
    height_px: int
    corners: tuple[str, ...]
    places: dict[str, Place | None]
    pictures: tuple[PictureInfo, ...]
    gripper: str
    needed: int
    folder: str
    files: dict[str, str]
    live: str | None = None
    has_jaw: bool = False
    jaw_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reference: str | None = None
    robot: str = ""
    camera_name: str = ""
    fixed_names: bool = True
    corners_only: bool = False
    saves: tuple[str, ...] = ("config", "taught", "corners")
    back: str | None = None


class Expectation(msgspec.Struct, frozen=True, kw_only=True):
    """Of one frame: its ``accuracy``, and as a text the ``promise``: bounds on its error beside the alert limits;
    ``reachable``: it keeps them.
    """

    accuracy: Accuracy
    promise: str
    reachable: bool


class Evaluation(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that follows from corners set by hand in one image: the resulting (or known) ``reference``, None with
    the reason as a text; ``pose``: what it results from; ``expected`` None where too few edges are in view to measure
    anything.
    """

    snapped: Snapped
    pose: CornerPose | None = None
    reference: ReferenceRecord | None = None
    no_reference: str | None = None
    expected: Expectation | None = None


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
