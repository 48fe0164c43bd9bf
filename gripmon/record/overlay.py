"""What is drawn on a recorded image: predicted edges, edge points, corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from gripmon.model.records import FrameRecord
from gripmon.record.columns import Palette, Sender
from gripmon.record.recorder import Row, TraceNote, pairs

IMAGE = "rig/camera/image"
_POINT_PX, _CORNER_PX, _LINE_PX = 1.6, 3.5, 0.6
_LABEL_HEIGHT_FRACTION = 0.05  # of the image's
_Pixels = NDArray[np.float32]
_NOT_TRACED = TraceNote(b"", b"", b"", b"", [], b"")
_LAYERS = {
    "edges/used": (Palette.EDGE_USED, _POINT_PX),
    "edges/refused": (Palette.EDGE_REFUSED, _POINT_PX),
    "corners/predicted": (Palette.PREDICTED, _CORNER_PX),
    "corners/used": (Palette.CORNER_USED, _CORNER_PX),
    "corners/refused": (Palette.CORNER_REFUSED, _CORNER_PX),
    "labels/used": (Palette.CORNER_USED, 0.0),
    "labels/refused": (Palette.CORNER_REFUSED, 0.0),
}
"""Points of the overlay: colour, radius."""
_Points = dict[str, tuple[_Pixels, list[str] | None]]


class OverlayWriter:
    """Image, predicted edges, edge points and corners, all of the same frame: the overlay fits the image it lies on."""

    def __init__(self, send: Sender, corner_ids: tuple[str, ...], height_px: int):
        self._send, self._corner_ids = send, corner_ids
        self._label_px = _LABEL_HEIGHT_FRACTION * height_px
        send.static(f"{IMAGE}/edges/predicted", rr.LineStrips2D.from_fields(colors=Palette.PREDICTED, radii=_LINE_PX))
        for name, (colour, radius_px) in _LAYERS.items():
            send.static(f"{IMAGE}/{name}", rr.Points2D.from_fields(colors=colour, radii=radius_px))

    def write(self, rows: Sequence[Row]) -> None:
        """A refused frame has no picture, but must remove the overlay of the frame before."""
        self._send.images(IMAGE, [row for row in rows if row.picture is not None])
        self._draw([row for row in rows if row.picture is not None or not row.record.measured])

    def write_late(self, rows: Sequence[Row]) -> None:
        """Images of frames that were written earlier without them; overlays of refused frames are written already."""
        self._send.images(IMAGE, rows)
        self._draw([row for row in rows if row.record.measured])

    def _draw(self, rows: Sequence[Row]) -> None:
        if not rows:
            return
        edges = [_predicted_edges(row.trace or _NOT_TRACED) for row in rows]
        columns = rr.LineStrips2D.columns(strips=[strip for some in edges for strip in some])
        self._send.frames(f"{IMAGE}/edges/predicted", rows, columns.partition([len(some) for some in edges]))
        drawn = [self._points(row.record, row.trace or _NOT_TRACED) for row in rows]
        for name in _LAYERS:
            points = [each[name][0] for each in drawn]
            labels = [label for each in drawn for label in each[name][1] or ()]
            named = labels if drawn[0][name][1] is not None else None
            columns = rr.Points2D.columns(positions=np.concatenate(points), labels=named)
            self._send.frames(f"{IMAGE}/{name}", rows, columns.partition([len(each) for each in points]))

    def _points(self, record: FrameRecord, trace: TraceNote) -> _Points:
        """A frame's, by layer; a corner that was not measured is shown at its prediction, with the reason."""
        predicted = pairs(trace.predicted_corners_uv_px)
        where = {name: (float(u), float(v)) for name, (u, v) in zip(self._corner_ids, predicted, strict=False)}
        found = [(corner, corner.uv_px or where.get(corner.id)) for corner in record.corners]
        known = [(corner, uv_px) for corner, uv_px in found if uv_px is not None and np.isfinite(uv_px).all()]
        labels_px = _label_places([uv_px for _, uv_px in known], self._label_px)
        points: _Points = {"corners/predicted": (_finite(predicted), None)}
        uv_px, fitted = pairs(trace.edge_uv_px), np.frombuffer(trace.edge_used, np.uint8)
        for kind, used in (("used", True), ("refused", False)):
            shown = [i for i, (corner, _) in enumerate(known) if corner.used == used]
            texts = [f"{known[i][0].id}: {known[i][0].reason}" if known[i][0].reason else known[i][0].id for i in shown]
            points[f"edges/{kind}"] = uv_px[fitted == used], None
            points[f"corners/{kind}"] = _pixels([known[i][1] for i in shown]), None
            points[f"labels/{kind}"] = _pixels([labels_px[i] for i in shown]), texts
        return points


def _label_places(corners_px: Sequence[tuple[float, float]], step_px: float) -> list[tuple[float, float]]:
    """Labels above the upper corners and below the lower ones, clear of the edges; neighbours on two levels."""
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


def _predicted_edges(trace: TraceNote) -> list[_Pixels]:
    strips = np.split(pairs(trace.predicted_edges_uv_px), np.cumsum(trace.predicted_edge_lengths)[:-1])
    return [strip for strip in map(_finite, strips) if len(strip) > 1]


def _finite(points: _Pixels) -> _Pixels:
    return points[np.isfinite(points).all(axis=1)]
