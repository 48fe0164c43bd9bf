"""The image and what was measured in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.recording import palette
from gripmon.recording.wire import Scene, TraceNote, pairs
from gripmon.records import FrameRecord

if TYPE_CHECKING:
    from gripmon.recording.rows import Row, Sender

IMAGE = "rig/camera/image"
_POINT_PX = 1.6
_CORNER_PX = 3.5
_LINE_PX = 0.6
_LABEL_SHARE = 0.06  # of the image's height
_Pixels = NDArray[np.float32]
_NO_PIXELS: _Pixels = np.empty((0, 2), np.float32)


class OverlayWriter:
    """Image, predicted edges, edge points and corners, all of the same frame: the overlay fits the image it lies on."""

    def __init__(self, send: Sender, scene: Scene):
        self._send = send
        self._corner_ids = scene.corner_ids
        self._label_px = _LABEL_SHARE * scene.height_px
        static = send.static
        static(f"{IMAGE}/edges/predicted", rr.LineStrips2D.from_fields(colors=palette.PREDICTED, radii=_LINE_PX))
        static(f"{IMAGE}/edges/used", rr.Points2D.from_fields(colors=palette.EDGE_USED, radii=_POINT_PX))
        static(f"{IMAGE}/edges/refused", rr.Points2D.from_fields(colors=palette.EDGE_REFUSED, radii=_POINT_PX))
        static(f"{IMAGE}/corners/predicted", rr.Points2D.from_fields(colors=palette.PREDICTED, radii=_CORNER_PX))
        static(f"{IMAGE}/corners/used", rr.Points2D.from_fields(colors=palette.CORNER_USED, radii=_CORNER_PX))
        static(f"{IMAGE}/corners/refused", rr.Points2D.from_fields(colors=palette.CORNER_REFUSED, radii=_CORNER_PX))
        static(f"{IMAGE}/labels/used", rr.Points2D.from_fields(colors=palette.CORNER_USED, radii=0.0))
        static(f"{IMAGE}/labels/refused", rr.Points2D.from_fields(colors=palette.CORNER_REFUSED, radii=0.0))

    def write(self, rows: Sequence[Row]) -> None:
        # A refused frame has no picture to lie on, but must take the overlay of the one before away.
        rows = [row for row in rows if row.picture is not None or row.record.reason is not None]
        if not rows:
            return
        self._images([row for row in rows if row.picture is not None])
        traces = [row.trace for row in rows]
        self._edges(rows, traces)
        self._points("edges/used", rows, [_edge_points(trace, used=True) for trace in traces])
        self._points("edges/refused", rows, [_edge_points(trace, used=False) for trace in traces])
        self._points("corners/predicted", rows, [_predicted_corners(trace) for trace in traces])
        for kind, used in (("used", True), ("refused", False)):
            corners = [self._corners(row.record, row.trace, used) for row in rows]
            self._points(f"corners/{kind}", rows, [uv_px for uv_px, _ in corners])
            places = [self._label_places(row, uv_px) for row, (uv_px, _) in zip(rows, corners, strict=True)]
            self._points(f"labels/{kind}", rows, places, [labels for _, labels in corners])

    def _images(self, rows: Sequence[Row]) -> None:
        pictures = [row.picture for row in rows if row.picture is not None]
        if pictures:
            columns = rr.EncodedImage.columns(
                blob=[np.frombuffer(p.blob, np.uint8) for p in pictures], media_type=[p.media_type for p in pictures]
            )
            self._send.frames(IMAGE, rows, columns)

    def _edges(self, rows: Sequence[Row], traces: Sequence[TraceNote | None]) -> None:
        strips: list[_Pixels] = []
        counts = []
        for trace in traces:
            some = [] if trace is None else _predicted_edges(trace)
            strips += some
            counts.append(len(some))
        columns = rr.LineStrips2D.columns(strips=strips).partition(counts)
        self._send.frames(f"{IMAGE}/edges/predicted", rows, columns)

    def _points(
        self, name: str, rows: Sequence[Row], points: Sequence[_Pixels], labels: Sequence[list[str]] | None = None
    ) -> None:
        positions = np.concatenate(points)
        flat = None if labels is None else [label for some in labels for label in some]
        columns = rr.Points2D.columns(positions=positions, labels=flat).partition([len(p) for p in points])
        self._send.frames(f"{IMAGE}/{name}", rows, columns)

    def _label_places(self, row: Row, uv_px: _Pixels) -> _Pixels:
        """Labels go up from the upper corners and down from the lower ones, off the edges that meet there."""
        every = np.concatenate([self._corners(row.record, row.trace, used)[0] for used in (True, False)])
        places = uv_px.copy()
        if len(places):
            lower = places[:, 1] > every[:, 1].mean()
            places[:, 1] += np.where(lower, 0.3 * self._label_px, -self._label_px).astype(np.float32)
        return places

    def _corners(self, record: FrameRecord, trace: TraceNote | None, used: bool) -> tuple[_Pixels, list[str]]:
        """Corners with their labels; one that was not measured is shown where it was predicted, with the reason."""
        predicted = _NO_PIXELS if trace is None else pairs(trace.predicted_corners_uv_px)
        where = dict(zip(self._corner_ids, predicted, strict=False))
        uv_px, labels = [], []
        for corner in record.corners:
            position = corner.uv_px if corner.uv_px is not None else where.get(corner.id)
            if corner.used == used and position is not None and np.isfinite(position).all():
                uv_px.append(position)
                labels.append(corner.id if corner.reason is None else f"{corner.id}: {corner.reason}")
        return np.array(uv_px, np.float32).reshape(-1, 2), labels


def _edge_points(trace: TraceNote | None, used: bool) -> _Pixels:
    if trace is None:
        return _NO_PIXELS
    return pairs(trace.edge_uv_px)[np.frombuffer(trace.edge_used, np.uint8) == used]


def _predicted_edges(trace: TraceNote) -> list[_Pixels]:
    splits = np.cumsum(trace.predicted_edge_lengths)[:-1]
    strips = np.split(pairs(trace.predicted_edges_uv_px), splits)
    return [strip for strip in (s[np.isfinite(s).all(axis=1)] for s in strips) if len(strip) > 1]


def _predicted_corners(trace: TraceNote | None) -> _Pixels:
    if trace is None:
        return _NO_PIXELS
    corners = pairs(trace.predicted_corners_uv_px)
    return corners[np.isfinite(corners).all(axis=1)]
