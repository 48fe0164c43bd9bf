"""The image and what was measured in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.model.records import FrameRecord
from gripmon.record.write import palette
from gripmon.record.write.wire import Scene, TraceNote, pairs

if TYPE_CHECKING:
    from gripmon.record.write.columns import Row, Sender

IMAGE = "rig/camera/image"
_POINT_PX = 1.6
_CORNER_PX = 3.5
_LINE_PX = 0.6
_LABEL_SHARE = 0.05  # of the image's height
_Pixels = NDArray[np.float32]
_NO_PIXELS: _Pixels = np.empty((0, 2), np.float32)


class _Corner(NamedTuple):
    uv_px: tuple[float, float]
    label_px: tuple[float, float]
    label: str
    used: bool


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
        rows = [row for row in rows if row.picture is not None or not row.record.measured]
        if not rows:
            return
        self._images([row for row in rows if row.picture is not None])
        self._draw(rows)

    def write_late(self, rows: Sequence[Row]) -> None:
        """Images of frames that were written before without; a refused frame's overlay is there already."""
        self._images(rows)
        rows = [row for row in rows if row.record.measured]
        if rows:
            self._draw(rows)

    def _draw(self, rows: Sequence[Row]) -> None:
        traces = [row.trace for row in rows]
        self._edges(rows, traces)
        self._points("edges/used", rows, [_edge_points(trace, used=True) for trace in traces])
        self._points("edges/refused", rows, [_edge_points(trace, used=False) for trace in traces])
        self._points("corners/predicted", rows, [_predicted_corners(trace) for trace in traces])
        corners = [self._corners(row.record, row.trace) for row in rows]
        for kind, used in (("used", True), ("refused", False)):
            shown = [[corner for corner in some if corner.used == used] for some in corners]
            self._points(f"corners/{kind}", rows, [_pixels([c.uv_px for c in some]) for some in shown])
            places = [_pixels([c.label_px for c in some]) for some in shown]
            self._points(f"labels/{kind}", rows, places, [[c.label for c in some] for some in shown])

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

    def _corners(self, record: FrameRecord, trace: TraceNote | None) -> list[_Corner]:
        """Corners with their labels; one that was not measured is shown where it was predicted, with the reason."""
        predicted = _NO_PIXELS if trace is None else pairs(trace.predicted_corners_uv_px)
        where = {name: (float(u), float(v)) for name, (u, v) in zip(self._corner_ids, predicted, strict=False)}
        found = [(corner, corner.uv_px or where.get(corner.id)) for corner in record.corners]
        known = [(corner, uv_px) for corner, uv_px in found if uv_px is not None and np.isfinite(uv_px).all()]
        labels_px = _label_places([uv_px for _, uv_px in known], self._label_px)
        return [
            _Corner(
                uv_px, label_px, corner.id if corner.reason is None else f"{corner.id}: {corner.reason}", corner.used
            )
            for (corner, uv_px), label_px in zip(known, labels_px, strict=True)
        ]


def _label_places(corners_px: Sequence[tuple[float, float]], step_px: float) -> list[tuple[float, float]]:
    """Above the upper corners and below the lower ones, off the edges that meet there; neighbours on two levels."""
    middle_px = float(np.mean([v for _, v in corners_px])) if corners_px else 0.0
    places = list(corners_px)
    for below in (False, True):
        row = sorted(
            (i for i, (_, v) in enumerate(corners_px) if (v > middle_px) == below), key=lambda i: corners_px[i]
        )
        for rank, i in enumerate(row):
            u, v = corners_px[i]
            level = rank % 2
            places[i] = (u, v + (0.3 + level) * step_px if below else v - (1.0 + level) * step_px)
    return places


def _pixels(points: Sequence[tuple[float, float]]) -> _Pixels:
    return np.array(points, np.float32).reshape(-1, 2)


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
