"""An event's pictures: which frames show it, and each of them with what was measured in it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.analyse.content import Event
from gripmon.analyse.events import MOTIONS
from gripmon.analyse.track import Track
from gripmon.model.canvas import Canvas, Colour
from gripmon.model.records import AlertKind, Origin, Verdict
from gripmon.record.recordings import Picture, Recording

_SEEN = (
    *MOTIONS, AlertKind.VIBRATION, AlertKind.GRIPPER, AlertKind.LENS, AlertKind.LOST, AlertKind.OCCLUDED,
    AlertKind.IMAGE, AlertKind.STREAM,
)  # fmt: skip
"""Kinds of events for which pictures may be instructive."""
_OVERLAY_FRAMES = 6
_WIDTH_PX, _JPEG_QUALITY = 560, 82  # of a picture on the page
_DOT_PX, _RING_PX = 2.0, 5.0
_MARGIN = 0.18  # of the gripper's size, around it
_SMALLEST = 0.35  # of the image's width: a smaller part doesn't show the scene
_PREDICTED: Colour = (255, 200, 60)
_USED: Colour = (120, 235, 70)
_REFUSED: Colour = (70, 70, 255)
_CORNER: Colour = (60, 225, 255)
_BEFORE: Colour = (255, 255, 255)
Points = NDArray[np.float32]


def picture_seqs(event: Event, source: Recording, track: Track, images: NDArray[np.intp]) -> dict[str, int]:
    """Of the frames with ``images`` (indices): the last one before it began, preferably with the gripper measured; the
    first one that shows it, of a slow motion with half of the way; and the first valid one after it, if it is over.
    All of them differ.
    """
    if event.kind not in _SEEN:
        return {}
    table, stamps_ns = source.frames, track.stamp_ns[images]
    motion = event.kind in MOTIONS
    before = images[stamps_ns <= event.onset.earliest_ns] if motion else images[stamps_ns < event.onset.stamp_ns]
    begun_ns = _half_way_ns(event, track) if motion else event.noticed_ns or event.onset.stamp_ns
    over_ns = max(event.onset.latest_ns, event.end_ns or 0) if motion else event.end_ns
    at = images[(stamps_ns >= begun_ns) & (stamps_ns > event.onset.earliest_ns)]
    after = images[stamps_ns >= over_ns] if over_ns is not None else images[:0]
    valid = table.verdict[after] == table.VERDICTS.index(Verdict.VALID)
    found: dict[str, int] = {}
    for name, choices in (
        ("before_seq", (before[track.measured[before]][::-1], before[::-1])),
        ("after_seq", (after[valid], after[track.measured[after]], after if motion else after[:0])),
        ("at_seq", (at,)),
    ):
        seqs = next((track.seq[choice] for choice in choices if choice.size), None)
        if seqs is not None:
            # Not all pictures of an alert have an overlay.
            seq = int(seqs[np.argmax(np.isin(seqs[:_OVERLAY_FRAMES], source.overlay_seqs))])
            if seq not in found.values():
                found[name] = seq
    return found


def _half_way_ns(event: Event, track: Track) -> int:
    """When half of a motion's way was behind it: at once, for a step."""
    onset_ns = event.onset.stamp_ns
    if event.kind == AlertKind.STEP or event.moved is None or event.end_ns is None:
        return onset_ns
    during = np.flatnonzero(track.measured & (track.stamp_ns >= onset_ns) & (track.stamp_ns <= event.end_ns))
    way = np.array(event.moved.tcp_shift_m)
    if not during.size or not way.any():
        return onset_ns
    along = (track.against_first[during, :3] - track.against_first[during[0], :3]) @ way
    beyond = np.flatnonzero(along >= 0.5 * float(way @ way))
    return int(track.stamp_ns[during[beyond[0]]]) if beyond.size else onset_ns


@dataclass(frozen=True, slots=True)
class ShownPicture:
    """A picture on the page; ``uri`` is a JPEG in a data URI."""

    seq: int
    stamp_ns: int
    uri: str
    width_px: int
    height_px: int


def pictures_of(event: Event, source: Recording) -> tuple[ShownPicture | None, ...]:
    """Before, at and after an event, as far as there are pictures."""
    table, pictures, used = source.frames, [], []
    for seq in (event.before_seq, event.at_seq, event.after_seq):
        pictures.append(None if seq is None else source.picture(seq))
        row = min(int(np.searchsorted(table.seq, seq or 0)), len(table) - 1)
        used.append(bool(table.source[row] != table.ORIGINS.index(Origin.HELD)))
    return cut_alike(pictures, used)


def cut_alike(pictures: Sequence[Picture | None], used: Sequence[bool]) -> tuple[ShownPicture | None, ...]:
    """Pictures in order of time, cropped to the same part of the image; the gripper's outline in the first one is also
    drawn into the later ones, in white.  All points of a picture whose measurement was not ``used`` are refused.
    """
    first = pictures[0]
    box = _box([picture for picture in pictures if picture is not None])
    outline = () if first is None else first.predicted_edges
    return tuple(
        None if picture is None else _drawn(picture, is_used, box, () if picture is first else outline)
        for picture, is_used in zip(pictures, used, strict=True)
    )


def _corners(picture: Picture) -> Points:
    """(n, 2) corners that were measured and used."""
    found = [corner.uv_px for corner in picture.corners if corner.uv_px is not None and corner.used]
    return np.array(found, np.float32).reshape(-1, 2)


def _box(pictures: Sequence[Picture]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom around the gripper, in the image's aspect ratio; the whole image without a gripper."""
    if not pictures:
        return 0, 0, 0, 0
    height, width = pictures[0].image.shape[:2]
    points = np.concatenate([part for p in pictures for part in (*p.predicted_edges, p.edges_used, _corners(p))])
    inside = points[((points >= 0.0) & (points < (width, height))).all(axis=1)]  # NaN is not
    if len(inside) < 3:
        return 0, 0, width, height
    low, high = inside.min(axis=0), inside.max(axis=0)
    share = max(*((high - low) * (1.0 + 2.0 * _MARGIN) / (width, height)), _SMALLEST)
    if share >= 0.9:
        return 0, 0, width, height
    size = np.round(share * np.array([width, height])).astype(int)
    left, top = np.clip(np.round(0.5 * (low + high - size)).astype(int), 0, (width, height) - size).tolist()
    return left, top, left + int(size[0]), top + int(size[1])


def _drawn(
    picture: Picture, used: bool, box: tuple[int, int, int, int], outline: Sequence[Points]
) -> ShownPicture | None:
    left, top, right, bottom = box
    part = picture.image[top:bottom, left:right]
    if not part.size:
        return None
    canvas = Canvas(part, _WIDTH_PX / (right - left), (left, top), colours=True)
    for strip in outline:
        canvas.line(strip, _BEFORE, 2)
    for strip in picture.predicted_edges:
        canvas.line(strip, _PREDICTED)
    canvas.circle(picture.edges_used, _DOT_PX, _USED if used else _REFUSED, -1)
    canvas.circle(picture.edges_refused, _DOT_PX, _REFUSED, -1)
    if used:
        canvas.circle(_corners(picture), _RING_PX, _CORNER, 2)
    text = base64.b64encode(canvas.jpeg(_JPEG_QUALITY)).decode("ascii")
    height_px = max(round(_WIDTH_PX / (right - left) * (bottom - top)), 1)
    return ShownPicture(picture.seq, picture.stamp_ns, f"data:image/jpeg;base64,{text}", _WIDTH_PX, height_px)
