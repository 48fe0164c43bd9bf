"""A wrist camera in the viewer: the image with its overlay, camera and gripper in space, the layout."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, FrameRecord, ReferenceRecord, Transform, Verdict
from gripmon.record.columns import (
    APPLICATION_ID,
    AXIS,
    Palette,
    Sender,
    image_view,
    log_view,
    pinhole,
    plot,
    pose_columns,
    two_columns,
)
from gripmon.record.pictures import Row
from gripmon.record.recorder import Scene, TraceNote, pairs

IMAGE = "rig/camera/image"
_POINT_PX, _CORNER_PX, _LINE_PX = 1.6, 3.5, 0.6
_LABEL_HEIGHT_FRACTION = 0.05  # of the image's
_IMAGE_PLANE_FRACTION = 1.35  # of the distance to the TCP: the image is a backdrop for the fingers
_AXIS_M, _LINE_M = 0.012, 0.0004
_CURVE_POINTS = 33
"""Points of a curved edge in the 3D view."""

_JAW_STEP_M = 2e-5  # beyond it the fingers are drawn again
_EYE = (0.66, -0.36, -0.03)  # beside and above, so that camera and gripper are both visible
_LOOK_AT_FRACTION = 0.64  # of the way from camera to TCP
_CLOSE_UP_MM = (-0.3, 0.3)
_STATISTIC_SHOWN = (0.0, 2.0)  # a collision gives hundreds of times the threshold; the crossing of 1 matters
_Pixels = NDArray[np.float32]
_NOT_TRACED = TraceNote(b"", b"", b"", b"", [], b"")
_NO_POINTS = np.empty((0, 3))
_BOUNDS = [f"protection/{name}_mm" for name in ("level", "since_reference", "absolute", "limit")]


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


class RigWriter:
    """The fingers as solids at the newest estimate, the reference as a wire frame, the TCP's shift as an arrow."""

    def __init__(self, send: Sender, scene: Scene, gripper: Gripper):
        self._send, self._gripper = send, gripper
        self._triangles, self._face_points = _triangulate(gripper)
        self._drawn: tuple[float, Verdict] | None = None
        lens, distance_m = scene.lens, float(np.linalg.norm(scene.tcp_m))
        send.static("rig", rr.ViewCoordinates.RDF)
        send.static(
            "rig/camera",
            pinhole(lens, _IMAGE_PLANE_FRACTION * distance_m, color=Palette.IDLE, line_width=0.3 * _LINE_M),
            rr.TransformAxes3D(_AXIS_M),
        )
        send.static("rig/gripper", rr.TransformAxes3D(_AXIS_M))
        if len(self._triangles):
            mesh = rr.Mesh3D.from_fields(triangle_indices=self._triangles, albedo_factor=Palette.GRIPPER_FACE)
            send.static("rig/gripper/faces", mesh)

    def repeat(self) -> None:
        """Draw the fingers again with the next frame, changed or not."""
        self._drawn = None

    def write(self, rows: Sequence[Row]) -> None:
        for path, name in (("rig/gripper", "cam_T_grip"), ("rig/smoothed", "smoothed")):
            posed = [row for row in rows if getattr(row.record, name) is not None]
            if posed:
                poses: list[Transform] = [getattr(row.record, name) for row in posed]
                self._send.frames(path, posed, pose_columns(poses))
        redrawn = [row for row in rows if self._looks_different(row)]
        if redrawn:
            self._write_fingers(redrawn)
        pictured = [row for row in rows if row.picture is not None or not row.record.measured]
        if pictured:
            self._write_shift(pictured)

    def write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> None:
        """The reference pose of the gripper, from frame ``first`` on."""
        self._send.columns("rig/reference", [first.stamp_ns], [first.seq], pose_columns([reference.cam_T_grip]))

    def _looks_different(self, row: Row) -> bool:
        """Whether the jaws moved or the verdict changed since the fingers were last drawn."""
        look = self._look(row.record)
        if self._drawn is not None and look[1] == self._drawn[1] and abs(look[0] - self._drawn[0]) < _JAW_STEP_M:
            return False
        self._drawn = look
        return True

    def _look(self, record: FrameRecord) -> tuple[float, Verdict]:
        opening_m = self._gripper.jaw_nominal_m if record.jaw_opening_m is None else record.jaw_opening_m
        return opening_m, record.verdict if record.cam_T_grip is not None else Verdict.UNKNOWN

    def _write_fingers(self, rows: Sequence[Row]) -> None:
        """The fingers at the estimate and, in white, at the reference; only the latter without an estimate."""
        looks = [self._look(row.record) for row in rows]
        points_m = [self._points_at(opening_m) for opening_m, _ in looks]
        outlines = [self._outlines(some) for some in points_m]
        posed = [row.record.cam_T_grip is not None for row in rows]
        edge_count = len(self._gripper.edge_ids)
        counts = [edge_count * shown for shown in posed]
        edges = rr.LineStrips3D.columns(
            strips=[s for some, shown in zip(outlines, posed, strict=True) if shown for s in some],
            colors=[Palette.VERDICTS[v] for (_, v), n in zip(looks, counts, strict=True) for _ in range(n)],
            radii=[_LINE_M] * sum(counts),
        )
        self._send.frames("rig/gripper/edges", rows, edges.partition(counts))
        ghosts = [strip for some in outlines for strip in some]
        wires = rr.LineStrips3D.columns(
            strips=ghosts, colors=[Palette.REFERENCE] * len(ghosts), radii=[0.7 * _LINE_M] * len(ghosts)
        )
        self._send.frames("rig/reference/edges", rows, wires.partition([edge_count] * len(rows)))
        if len(self._triangles):
            solids = [
                some[self._face_points] if shown else _NO_POINTS for some, shown in zip(points_m, posed, strict=True)
            ]
            normals = [_face_normals(each, self._triangles) if len(each) else each for each in solids]
            mesh = rr.Mesh3D.columns(vertex_positions=np.concatenate(solids), vertex_normals=np.concatenate(normals))
            self._send.frames("rig/gripper/faces", rows, mesh.partition([len(each) for each in solids]))

    def _write_shift(self, rows: Sequence[Row]) -> None:
        """An arrow from the reference's TCP to the estimated TCP, to scale."""
        arrows = [_arrow(row.record) for row in rows]
        known = [arrow for arrow in arrows if arrow is not None]
        columns = rr.Arrows3D.columns(
            origins=[origin for origin, _ in known], vectors=[vector for _, vector in known],
            colors=[Palette.SHIFT] * len(known), radii=[_LINE_M] * len(known),
        )  # fmt: skip
        self._send.frames("rig/tcp_shift", rows, columns.partition([int(arrow is not None) for arrow in arrows]))

    def _outlines(self, points_m: Array) -> list[Array]:
        """(s, 3) each: an edge's two ends, or points along a curved one."""
        gripper = self._gripper
        outlines = list(points_m[gripper.edge_points])
        for edge in np.flatnonzero(gripper.edge_curved).tolist():
            outlines[edge] = gripper.outlines_m(points_m, np.array([edge]), _CURVE_POINTS)[0]
        return outlines

    def _points_at(self, opening_m: float) -> Array:
        """(p, 3) in the gripper frame; for display, an opening outside the jaw's range is clipped to it."""
        gripper = self._gripper
        return gripper.points_grip_m(min(max(opening_m, gripper.jaw_min_m), gripper.jaw_max_m))


def _arrow(record: FrameRecord) -> tuple[Array, Array] | None:
    if record.cam_T_grip is None or record.drift is None:
        return None
    shift_m = np.array(record.drift.tcp_shift_m)
    return np.array(record.cam_T_grip.translation_m) - shift_m, shift_m


def _triangulate(gripper: Gripper) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3) into a vertex list that repeats the points for each face, and that list's points (v,)."""
    triangles: list[tuple[int, int, int]] = []
    points: list[int] = []
    for face in gripper.faces:
        first = len(points)
        points += face.points.tolist()
        triangles += [(first, first + i, first + i + 1) for i in range(1, len(face.points) - 1)]
    return np.array(triangles, np.uint32).reshape(-1, 3), np.array(points, np.intp)


def _face_normals(vertices: Array, triangles: np.ndarray) -> Array:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    out = np.zeros_like(vertices)
    out[triangles.ravel()] = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3, axis=0)
    return out


def layout_file(layout: rrb.Blueprint) -> bytes:
    """A layout as a rerun blueprint file, for :meth:`rerun.RecordingStream.log_file_from_contents`.

    Each ``send_blueprint`` leaks two threads and more than a MiB; logging this file leaks nothing.
    """
    descriptor = os.memfd_create("gripmon-layout")
    try:
        layout.save(APPLICATION_ID, f"/proc/self/fd/{descriptor}")
        return os.pread(descriptor, os.fstat(descriptor).st_size, 0)
    finally:
        os.close(descriptor)


def make_blueprint(scene: Scene) -> rrb.Blueprint:
    """The default layout.  Left: the image with its overlay, and the events.  Right: the rig in space, the TCP's drift
    with its limits, the drift test's statistic over its threshold, and the resulting states.
    """
    truth = ["drift/truth_mm"] if scene.has_truth else []
    truth_named = "; wide, pale: truth" if scene.has_truth else ""
    drift = plot(
        "drift",
        [*truth, "drift/limits_mm", "drift/tcp_shift_sigma_mm", "drift/tcp_shift_mm", "drift/alerts/**"],
        f"TCP drift (mm): x red, y green, z blue, length white{truth_named}; lines: warning, limit",
        legend=False,
    )
    test_name = "Drift test: statistic / threshold (alarm above 1)"
    test = plot("test", "$origin/**", test_name, legend=False, shown=_STATISTIC_SHOWN)
    status = rrb.StateTimelineView(origin="status", name="State and verdict", time_view=AXIS)
    judged = rrb.Vertical(rig_view(scene), drift, test, status, _details(scene), row_shares=[3.9, 4, 2.1, 2, 2.6])
    return two_columns([wrist_image_view(scene), log_view()], [7, 2.4], judged)


def wrist_image_view(scene: Scene) -> rrb.Spatial2DView:
    """The image with its overlay."""
    legend = "edge points: green used, red refused; corners yellow; predicted blue"
    return image_view(scene, "rig/camera", IMAGE, legend)


def rig_view(scene: Scene) -> rrb.Spatial3DView:
    """Camera and gripper in space."""
    tcp_m = scene.tcp_m
    distance_m = float(np.linalg.norm(tcp_m))
    target_m = _LOOK_AT_FRACTION * tcp_m
    eye = rrb.EyeControls3D(
        position=target_m + distance_m * np.array(_EYE), look_target=target_m, eye_up=(0.0, -1.0, 0.0)
    )
    return rrb.Spatial3DView(
        origin="rig", contents=["rig/**"], name="Camera and gripper; white: gripper at the reference",
        eye_controls=eye, line_grid=False, background=Palette.BACKGROUND,
    )  # fmt: skip


def _details(scene: Scene) -> rrb.Tabs:
    error = [plot("drift", "drift/error_mm", "Error (mm)")] if scene.has_truth else []
    close_up = ["drift/noticed_mm", "drift/tcp_shift_sigma_mm", "drift/tcp_shift_mm"]
    return rrb.Tabs(
        plot("drift", close_up, "Close up (mm)", legend=False, shown=_CLOSE_UP_MM),
        plot("protection", _BOUNDS, "Protection (mm)"),
        *error,
        plot("residual", "residual/rms_px", "Residual (px)"),
        plot("residual", "residual/corners_px", "Corners (px)"),
        plot("drift", ["drift/d_mm", "drift/limits_mm"], "d (mm)"),
        plot("drift", ["drift/delta_deg", "drift/limits_deg"], "δ (°)"),
        plot("sigma", "sigma/tcp_um", "σ (µm)"),
        plot("quality", ["quality/corners_used", "quality/edge_points"], "Points"),
        plot("timing", "timing/**", "Latency (µs)"),
        plot("noise", "noise/scatter_um", "Noise (µm)"),
        plot("image", "image/**", "Image"),
        rrb.TextDocumentView(origin="about", name="About"),
        active_tab=0,
    )
