"""Camera and gripper in space, as they are drawn in a recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, FrameRecord, ReferenceRecord, Transform, Verdict
from gripmon.record.columns import Palette, Sender, pinhole, pose_columns
from gripmon.record.recorder import Row, Scene

_IMAGE_PLANE_FRACTION = 1.35  # of the distance to the TCP: the image is a backdrop for the fingers
_AXIS_M, _LINE_M = 0.012, 0.0004
_CURVE_POINTS = 33
"""Points of a curved edge in the 3D view."""

_JAW_STEP_M = 2e-5  # beyond it the fingers are drawn again
_NO_POINTS = np.empty((0, 3))


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
