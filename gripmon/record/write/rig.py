"""Camera, gripper and reference in space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from gripmon.model.records import Array, FrameRecord, ReferenceRecord, Verdict
from gripmon.record.write import palette
from gripmon.record.write.wire import Scene

if TYPE_CHECKING:
    from gripmon.record.write.columns import Row, Sender

_IMAGE_PLANE_SHARE = 1.35  # of the distance to the TCP: the image is a backdrop for the fingers
_AXIS_M = 0.012
_LINE_M = 0.0004
_SMALLEST_JAW_STEP_M = 2e-5
_NOWHERE = np.empty((0, 3))


class RigWriter:
    """The fingers as solids at the newest estimate, the reference as a wire frame, the TCP's shift as an arrow."""

    def __init__(self, send: Sender, scene: Scene):
        self._send = send
        self._openings_m = np.array(scene.jaw_openings_m)
        self._points_m = np.array(scene.points_m, dtype=float)
        self._nominal_m = scene.jaw_nominal_m
        self._edges = np.array(scene.edges, dtype=np.intp).reshape(-1, 2)
        self._triangles, self._face_points = _triangulate(scene.faces)
        self._drawn: tuple[float, Verdict] | None = None
        distance_m = float(np.linalg.norm(scene.tcp_m))
        send.static("rig", rr.ViewCoordinates.RDF)
        send.static(
            "rig/camera",
            rr.Pinhole(
                resolution=[scene.width_px, scene.height_px],
                focal_length=scene.focal_px,
                principal_point=scene.centre_px,
                image_plane_distance=_IMAGE_PLANE_SHARE * distance_m,
                camera_xyz=rr.ViewCoordinates.RDF,
                color=palette.IDLE,
                line_width=0.3 * _LINE_M,
            ),
            rr.TransformAxes3D(_AXIS_M),
        )
        send.static("rig/gripper", rr.TransformAxes3D(_AXIS_M))
        if len(self._triangles):
            send.static("rig/gripper/faces", _static_mesh(self._triangles))

    def repeat(self) -> None:
        """Draw the fingers again with the next frame, changed or not."""
        self._drawn = None

    def write(self, rows: Sequence[Row]) -> None:
        posed = [row for row in rows if row.record.cam_T_grip is not None]
        if posed:
            transforms = [row.record.cam_T_grip for row in posed if row.record.cam_T_grip is not None]
            columns = rr.Transform3D.columns(
                translation=[t.translation_m for t in transforms], quaternion=[t.rotation_xyzw for t in transforms]
            )
            self._send.frames("rig/gripper", posed, columns)
        averaged = [row for row in rows if row.record.smoothed is not None]
        if averaged:
            poses = [row.record.smoothed for row in averaged if row.record.smoothed is not None]
            columns = rr.Transform3D.columns(
                translation=[p.translation_m for p in poses], quaternion=[p.rotation_xyzw for p in poses]
            )
            self._send.frames("rig/smoothed", averaged, columns)
        redrawn = [row for row in rows if self._looks_different(row)]
        if redrawn:
            self._write_fingers(redrawn)
        pictured = [row for row in rows if row.picture is not None or not row.record.measured]
        if pictured:
            self._write_shift(pictured)

    def write_reference(self, reference: ReferenceRecord, first: FrameRecord) -> None:
        """Where the gripper was calibrated to be, from frame ``first`` on."""
        transform = reference.cam_T_grip
        columns = rr.Transform3D.columns(translation=[transform.translation_m], quaternion=[transform.rotation_xyzw])
        self._send.columns("rig/reference", [first.stamp_ns], [first.seq], columns)

    def _looks_different(self, row: Row) -> bool:
        """Whether the jaws moved or the verdict changed since the fingers were drawn last."""
        opening_m, verdict = self._look(row.record)
        if self._drawn is not None:
            same_opening = abs(opening_m - self._drawn[0]) < _SMALLEST_JAW_STEP_M
            if same_opening and verdict == self._drawn[1]:
                return False
        self._drawn = (opening_m, verdict)
        return True

    def _look(self, record: FrameRecord) -> tuple[float, Verdict]:
        opening_m = self._nominal_m if record.jaw_opening_m is None else record.jaw_opening_m
        return opening_m, record.verdict if record.cam_T_grip is not None else Verdict.UNKNOWN

    def _write_fingers(self, rows: Sequence[Row]) -> None:
        """The fingers as they are and, white, at the reference; without estimate there is only that."""
        looks = [self._look(row.record) for row in rows]
        points_m = [self._points_at(opening_m) for opening_m, _ in looks]
        posed = [row.record.cam_T_grip is not None for row in rows]
        counts = [len(self._edges) * shown for shown in posed]
        edges = rr.LineStrips3D.columns(
            strips=[s for some, shown in zip(points_m, posed, strict=True) if shown for s in some[self._edges]],
            colors=[palette.VERDICTS[v] for (_, v), n in zip(looks, counts, strict=True) for _ in range(n)],
            radii=[_LINE_M] * sum(counts),
        )
        self._send.frames("rig/gripper/edges", rows, edges.partition(counts))
        ghosts = [strip for some in points_m for strip in some[self._edges]]
        wires = rr.LineStrips3D.columns(
            strips=ghosts, colors=[palette.REFERENCE] * len(ghosts), radii=[0.7 * _LINE_M] * len(ghosts)
        )
        self._send.frames("rig/reference/edges", rows, wires.partition([len(self._edges)] * len(rows)))
        if len(self._triangles):
            solids = [
                some[self._face_points] if shown else _NOWHERE for some, shown in zip(points_m, posed, strict=True)
            ]
            normals = [_face_normals(each, self._triangles) if len(each) else each for each in solids]
            mesh = rr.Mesh3D.columns(vertex_positions=np.concatenate(solids), vertex_normals=np.concatenate(normals))
            self._send.frames("rig/gripper/faces", rows, mesh.partition([len(each) for each in solids]))

    def _write_shift(self, rows: Sequence[Row]) -> None:
        """An arrow from the reference's TCP to the estimated one, true to scale."""
        arrows = [_arrow(row.record) for row in rows]
        known = [arrow for arrow in arrows if arrow is not None]
        columns = rr.Arrows3D.columns(
            origins=[origin for origin, _ in known],
            vectors=[vector for _, vector in known],
            colors=[palette.SHIFT] * len(known),
            radii=[_LINE_M] * len(known),
        )
        self._send.frames("rig/tcp_shift", rows, columns.partition([int(arrow is not None) for arrow in arrows]))

    def _points_at(self, opening_m: float) -> Array:
        """(p, 3) in the gripper frame; a picture, so an opening outside the jaw's range shows the end of it."""
        if len(self._openings_m) == 1:
            return self._points_m[0]
        position = float(np.interp(opening_m, self._openings_m, np.arange(len(self._openings_m))))
        low = min(int(position), len(self._openings_m) - 2)
        share = position - low
        return (1.0 - share) * self._points_m[low] + share * self._points_m[low + 1]


def _arrow(record: FrameRecord) -> tuple[Array, Array] | None:
    if record.cam_T_grip is None or record.drift is None:
        return None
    shift_m = np.array(record.drift.tcp_shift_m)
    return np.array(record.cam_T_grip.translation_m) - shift_m, shift_m


def _triangulate(faces: Sequence[tuple[int, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3) into a vertex list that repeats the points for each face, and that list's points (v,)."""
    triangles: list[tuple[int, int, int]] = []
    points: list[int] = []
    for face in faces:
        first = len(points)
        points += face
        triangles += [(first, first + i, first + i + 1) for i in range(1, len(face) - 1)]
    return np.array(triangles, np.uint32).reshape(-1, 3), np.array(points, np.intp)


def _face_normals(vertices: Array, triangles: np.ndarray) -> Array:
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    out = np.zeros_like(vertices)
    out[triangles.ravel()] = np.repeat(normals / np.linalg.norm(normals, axis=1, keepdims=True), 3, axis=0)
    return out


def _static_mesh(triangles: np.ndarray) -> rr.Mesh3D:
    return rr.Mesh3D.from_fields(triangle_indices=triangles, albedo_factor=palette.GRIPPER_FACE)
