"""A gripper model in arrays: where its points are at a jaw opening, and which parts are visible from a viewpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper.curves import Curves
from gripmon.model.gripper.faces import (
    LARGEST_SKEW,
    LARGEST_WARP_M,
    FaceLoop,
    extent_m,
    inwards,
    normal_of,
    off_plane_m,
    triangles,
)
from gripmon.model.gripper.model import EdgeModel, FaceModel, GripperError, GripperModel, JawModel
from gripmon.model.gripper.motion import beyond_table_m, motion_table, offset_m
from gripmon.model.gripper.rounds import Rounds
from gripmon.model.records import Array

LARGEST_EXTENT_M = 1.0
SMALLEST_SPREAD_RATIO = 0.02


@dataclass(frozen=True, slots=True)
class EdgeView:
    """Visibility of all edges from one viewpoint: arrays over the gripper's edges.

    ``visible``: at least one adjacent face is turned towards the camera (or the edge has no faces).  ``crease``: both
    adjacent faces are, so that the edge separates two shades of the finger and is not its outline.  ``inside_point_m``
    (e, 3): a point of the visible adjacent face, gripper frame, which shows on which side of an outline the finger
    lies; NaN if unknown.
    """

    visible: NDArray[np.bool_]
    crease: NDArray[np.bool_]
    inside_point_m: Array


class Gripper:
    """A validated gripper model in arrays.  Raises :class:`GripperError` if the model can't work.

    ``faces`` are planar: a face that isn't planar in the file is split into several, and ``notes`` reports it in words.
    """

    def __init__(self, model: GripperModel):
        self.model = model
        self.name = model.name
        self.finger_ids = tuple(model.fingers)
        self.point_ids = tuple(model.points)
        self.edge_ids = tuple(model.edges)
        self._point_index = {name: i for i, name in enumerate(self.point_ids)}
        finger_index = {name: i for i, name in enumerate(self.finger_ids)}
        fingers = [_named(f"points.{n}.finger", "finger", p.finger, finger_index) for n, p in model.points.items()]
        self.point_finger = np.array(fingers, dtype=np.intp)
        self._nominal_points_m = np.array([p.xyz_m for p in model.points.values()], dtype=float).reshape(-1, 3)
        self._check_places()
        self._rounds = Rounds.of(model.points, self._nominal_points_m)
        self.corner_points = np.flatnonzero([p.corner for p in model.points.values()])
        self.corner_ids = tuple(self.point_ids[i] for i in self.corner_points)
        self._corners_outwards = self._from_the_tcp_outwards()
        self.edge_points = np.array([self._ends(n, e) for n, e in model.edges.items()], dtype=np.intp).reshape(-1, 2)
        self.edge_finger = self.point_finger[self.edge_points[:, 0]]
        through = [self._through(n, e, p) for (n, e), p in zip(model.edges.items(), self.edge_points, strict=True)]
        self._curves = Curves(through, self.edge_ids)
        self.edge_curved, self.has_curves = self._curves.curved, bool(self._curves.curved.any())
        self.edge_bend_rad = self._curves.bend_rad
        at_corner = (self.edge_points[None] == self.corner_points[:, None, None]).any(axis=2)
        self._edges_at_corner = [np.flatnonzero(at_it & ~self.edge_curved) for at_it in at_corner]
        self.edge_bevel_m = np.array([e.bevel_m for e in model.edges.values()])
        self.edge_polarity = np.array([POLARITY[e.brighter] for e in model.edges.values()], dtype=np.int8)
        self.edge_crease = np.array([e.kind == "crease" for e in model.edges.values()])
        self.notes: list[str] = []
        self.faces = tuple(flat for i, f in enumerate(model.faces) for flat in self._face(i, f, finger_index))
        self._check_outwards()
        longest = max((len(face.points) for face in self.faces), default=0)
        padded = [np.pad(face.points, (0, longest - len(face.points)), mode="edge") for face in self.faces]
        self.face_loops = np.array(padded, dtype=np.intp).reshape(len(self.faces), longest)
        self.face_finger = np.array([face.finger for face in self.faces], dtype=np.intp)
        self._face_span = np.array([self._spanning(f) for f in self.faces], dtype=np.intp).reshape(-1, 3)
        self._edge_faces, self._point_faces = self._adjacency()
        self.landmarks = self._stand_for_the_tips()
        """(l,) points by which visibility of the fingertips is judged: the corners; with fewer than three corners also
        the ends of curved edges, and if that isn't enough all points.
        """
        self.landmark_ids = tuple(self.point_ids[i] for i in self.landmarks)
        jaw = model.jaw or JawModel(nominal_m=0.0, min_m=0.0, max_m=0.0)
        self.has_jaw = model.jaw is not None
        self.jaw_nominal_m, self.jaw_min_m, self.jaw_max_m = jaw.nominal_m, jaw.min_m, jaw.max_m
        if self.has_jaw and not self.jaw_min_m <= self.jaw_nominal_m <= self.jaw_max_m:
            raise GripperError("jaw: nominal_m is outside min_m to max_m; min_m <= nominal_m <= max_m")
        self._motion = [motion_table(n, f.motion, model.jaw) for n, f in model.fingers.items()]
        self._check()
        self._known_m = max(float(t[0, 0]) for t in self._motion), min(float(t[-1, 0]) for t in self._motion)

    def points_grip_m(self, jaw_opening_m: float | None = None, eye_grip_m: Array | None = None) -> Array:
        """All points (p, 3) in the gripper frame at an opening (nominal if None).  ValueError outside the jaw's range.
        Points on round surfaces lie where ``eye_grip_m`` (3,) sees the outline; if it is None, where the file has them.
        """
        if jaw_opening_m is None or not self.has_jaw:
            return self._rounds.seen_from(eye_grip_m, self._nominal_points_m, np.zeros((1, 3)))
        if not self.jaw_min_m - 1e-9 <= jaw_opening_m <= self.jaw_max_m + 1e-9:
            raise ValueError(f"jaw opening {jaw_opening_m:.4f} m is outside {self.jaw_min_m} to {self.jaw_max_m} m")
        offsets_m = self._finger_offsets_m(jaw_opening_m)[self.point_finger]
        return self._rounds.seen_from(eye_grip_m, self._nominal_points_m + offsets_m, offsets_m)

    def beyond_m(self, jaw_opening_m: float) -> float:
        """Standard deviation of the fingers' places at an opening beyond those that the file's motions are known for;
        0 within them (see :func:`~gripmon.model.gripper.motion.beyond_table_m`).
        """
        if not self.has_jaw or self._known_m[0] <= jaw_opening_m <= self._known_m[1]:
            return 0.0
        return max(beyond_table_m(table, jaw_opening_m) for table in self._motion)

    def point_motion(self, jaw_opening_m: float) -> Array:
        """Derivative (p, 3) of all points by the jaw opening, m/m; central difference over 0.1 mm, as motion is
        piecewise linear in the opening.
        """
        low, high = max(jaw_opening_m - 5e-5, self.jaw_min_m), min(jaw_opening_m + 5e-5, self.jaw_max_m)
        if not high > low:
            return np.zeros_like(self._nominal_points_m)
        rate = (self._finger_offsets_m(high) - self._finger_offsets_m(low)) / (high - low)
        return rate[self.point_finger]

    def tangents_m(
        self, points_m: Array, edge: NDArray[np.intp], fraction: Array, rotation: Array | None = None
    ) -> tuple[Array, Array]:
        """Tangents of edges (n,) at fractions (n,): ``start`` and ``end`` (n, 3), so that the place is ``start +
        fraction * (end - start)`` and the edge's direction there is ``end - start``.  On a straight edge these are its
        two ends, on a curved one those of its tangent.

        ``points_m`` (p, 3): the gripper's points in any frame; ``rotation`` (3, 3) rotates gripper axes to that frame.
        """
        ends = self.edge_points[edge]
        start, end = points_m[ends[:, 0]], points_m[ends[:, 1]]
        if self.has_curves:
            bulge, rate = self._curves.bulge_m(edge, fraction)
            before, behind = bulge - fraction[:, None] * rate, bulge + (1.0 - fraction[:, None]) * rate
            if rotation is not None:
                before, behind = before @ rotation.T, behind @ rotation.T
            start, end = start + before, end + behind
        return start, end

    def outlines_m(self, points_m: Array, edges: NDArray[np.intp], count: int, rotation: Array | None = None) -> Array:
        """(k, count, 3) evenly spaced places along edges (k,); ``points_m``, ``rotation`` as for :meth:`tangents_m`."""
        edge, fraction = np.repeat(edges, count), np.tile(np.linspace(0.0, 1.0, count), len(edges))
        start, end = self.tangents_m(points_m, edge, fraction, rotation)
        return np.asarray(start + fraction[:, None] * (end - start)).reshape(len(edges), count, 3)

    def edge_view(self, points_grip_m: Array, eye_grip_m: Array) -> EdgeView:
        """Which edges are visible from ``eye_grip_m`` (3,), the camera's centre in the gripper frame."""
        facing = self._facing(points_grip_m, eye_grip_m)
        seen = facing[self._edge_faces]
        known = self._edge_faces >= 0
        visible = ~known.any(axis=1) | seen.any(axis=1)
        crease = np.where(known.all(axis=1), seen.all(axis=1), self.edge_crease)
        inside = np.full((len(self.edge_ids), 3), np.nan)
        for i in np.flatnonzero(seen.sum(axis=1) == 1):
            face = self.faces[self._edge_faces[i, 0 if seen[i, 0] else 1]]
            inside[i] = points_grip_m[face.points].mean(axis=0)
        return EdgeView(np.asarray(visible), crease, inside)

    def corners_visible(self, points_grip_m: Array, eye_grip_m: Array) -> NDArray[np.bool_]:
        """(c,) whether a face at the corner is turned towards the camera; True for corners without faces."""
        return self.points_visible(points_grip_m, eye_grip_m, self.corner_points)

    def points_visible(self, points_grip_m: Array, eye_grip_m: Array, points: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(k,) whether a face at each of the ``points`` (k,) is turned towards the camera; True without faces."""
        facing, touching = self._facing(points_grip_m, eye_grip_m), self._point_faces[points]
        return np.asarray(~touching.any(axis=1) | (touching & facing[:-1]).any(axis=1))

    def edges_at_corner(self, corner: int) -> NDArray[np.intp]:
        """Indices of the straight edges that end in a corner (index into ``corner_ids``) and can be intersected."""
        return self._edges_at_corner[corner]

    def innermost_corners(self, among: NDArray[np.bool_], count: int | None) -> NDArray[np.bool_]:
        """(c,) mask of at most ``count`` (None: all) of the corners ``among`` (c,): the nearest to the TCP, taken from
        the fingers in turn.

        With the inner corners of two fingertips ``among`` them, 4 gives the paper's rectangle around the TCP, 5 adds an
        outer corner, 3 drops one of the rectangle.  A finger without corners ``among`` them is skipped.  If the chosen
        corners would be collinear, the last is replaced by the next one that avoids this.
        """
        if count is None:
            return among
        outwards = self._corners_outwards[among[self._corners_outwards]]
        finger = self.point_finger[self.corner_points[outwards]]
        # A corner's turn: how many corners of the same finger are nearer to the TCP.
        turn = np.array([np.count_nonzero(finger[:i] == finger[i]) for i in range(len(finger))], dtype=np.intp)
        order = outwards[np.argsort(turn, kind="stable")]
        taken = order[:count]
        for instead in order[count:]:
            if not on_a_line(self._nominal_points_m[self.corner_points[taken]]):
                break
            taken = np.append(order[: count - 1], instead)
        chosen = np.zeros(len(self.corner_points), dtype=bool)
        chosen[taken] = True
        return chosen

    def _from_the_tcp_outwards(self) -> NDArray[np.intp]:
        """(c,) indices of the corners by distance from the TCP at the nominal opening, so that the order doesn't change
        while the jaws move; ties (within 0.1 mm) keep the file's order.
        """
        distance_m = np.linalg.norm(self._nominal_points_m[self.corner_points], axis=1)
        return np.argsort(np.round(distance_m, 4), kind="stable")

    def _ends(self, name: str, edge: EdgeModel) -> tuple[int, int]:
        i = _named(f"edges.{name}.from", "point", edge.start, self._point_index)
        j = _named(f"edges.{name}.to", "point", edge.end, self._point_index)
        if self.point_finger[i] != self.point_finger[j]:
            raise GripperError(f"edges.{name}: its ends lie on two fingers; an edge belongs to one finger")
        if not np.linalg.norm(self._nominal_points_m[i] - self._nominal_points_m[j]) > 1e-4:
            raise GripperError(f"edges.{name}: its ends are less than 0.1 mm apart; two different points")
        return i, j

    def _through(self, name: str, edge: EdgeModel, ends: NDArray[np.intp]) -> Array | None:
        """All points (n, 3) of a curved edge at the nominal opening; None for a straight one."""
        if not edge.via:
            return None
        via_m = np.array(edge.via, dtype=float)
        if not np.isfinite(via_m).all() or np.abs(via_m).max() > LARGEST_EXTENT_M:
            raise GripperError(f"edges.{name}.via: a value that is not finite or over a metre; metres")
        first, last = self._nominal_points_m[ends]
        return np.vstack([first, via_m, last])

    def _face(self, index: int, face: FaceModel, finger_index: Mapping[str, int]) -> list[FaceLoop]:
        loop = np.array([_named(f"faces[{index}].points", "point", p, self._point_index) for p in face.points])
        finger = _named(f"faces[{index}].finger", "finger", face.finger, finger_index)
        strange = [p for p in face.points if self.model.points[p].finger != face.finger]
        if strange:
            raise GripperError(
                f"faces[{index}].points: '{strange[0]}' is not on finger '{face.finger}'; points of that finger"
            )
        corners = self._nominal_points_m[loop]
        return [FaceLoop(finger, loop[list(flat)]) for flat in self._flat(f"faces[{index}].points", corners)]

    def _check_outwards(self) -> None:
        """Reject faces whose normal points into the finger; see :func:`gripmon.model.gripper.faces.inwards`."""
        loops = [tuple(self._point_index[p] for p in face.points) for face in self.model.faces]
        fingers = [face.finger for face in self.model.faces]
        wrong = inwards(fingers, loops, self._nominal_points_m)
        if wrong is not None:
            raise GripperError(
                f"faces[{wrong}].points: it looks into the finger; the points counter-clockwise seen from outside"
            )

    def _flat(self, key: str, corners: Array) -> list[tuple[int, ...]]:
        """Split a face's corners (n, 3) into planar parts, each given as indices into the corners."""
        if not np.linalg.norm(normal_of(corners)) > 0.0:
            raise GripperError(f"{key}: these points lie on a line; the points in turn around the face")
        off_m = off_plane_m(corners)
        if off_m <= LARGEST_WARP_M:
            return [tuple(range(len(corners)))]
        off = f"{key}: {1e3 * off_m:.1f} mm off a plane"
        if off_m > LARGEST_SKEW * extent_m(corners):
            raise GripperError(
                f"{off}, of {1e3 * extent_m(corners):.1f} mm from end to end; one of these points is wrong, or several "
                "faces"
            )
        parts = triangles(corners)
        if parts is None:
            raise GripperError(f"{off}, and it crosses itself; the points in turn around the face")
        self.notes.append(f"{off}: taken as {len(parts)} triangles; if it is flat, one of its points is wrong")
        return list(parts)

    def _spanning(self, face: FaceLoop) -> NDArray[np.intp]:
        """The three consecutive points (3,) of a face that define its plane best: others may be collinear."""
        loop = self._nominal_points_m[face.points]
        ahead, behind = np.roll(loop, -1, axis=0) - loop, np.roll(loop, 1, axis=0) - loop
        best = int(np.argmax(np.cross(ahead, behind) @ normal_of(loop)))
        return np.roll(face.points, 1 - best)[:3]

    def _adjacency(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Adjacent faces of each edge (e, 2), -1 for none, and whether a face touches a point (p, f)."""
        members = [set(f.points.tolist()) for f in self.faces]
        edge_faces = np.full((len(self.edge_points), 2), -1, dtype=np.intp)
        for i, (start, end) in enumerate(self.edge_points.tolist()):
            faces = [k for k, m in enumerate(members) if {start, end} <= m]
            if len(faces) > 2:
                raise GripperError(f"edges.{self.edge_ids[i]}: {len(faces)} faces meet in it; at most two")
            edge_faces[i, : len(faces)] = faces
        point_faces = np.array([[point in m for m in members] for point in range(len(self.point_ids))], dtype=bool)
        return edge_faces, point_faces.reshape(len(self.point_ids), len(members))

    def _stand_for_the_tips(self) -> NDArray[np.intp]:
        every = np.arange(len(self.point_ids))
        of_curves = np.union1d(self.corner_points, self.edge_points[self.edge_curved])
        return next((some for some in (self.corner_points, of_curves) if len(some) >= 3), every)

    def _facing(self, points_grip_m: Array, eye_grip_m: Array) -> NDArray[np.bool_]:
        """(f + 1,) which faces are turned towards the eye; the last is False and stands for "no face" (index -1)."""
        out = np.zeros(len(self.faces) + 1, dtype=bool)
        if self.faces:
            first = points_grip_m[self._face_span]
            (ax, ay, az), (bx, by, bz) = (first[:, 1] - first[:, 0]).T, (first[:, 2] - first[:, 0]).T
            normals = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
            np.greater(np.einsum("ij,ij->i", normals, eye_grip_m - first[:, 0]), 0.0, out=out[:-1])
        return out

    def _finger_offsets_m(self, jaw_opening_m: float) -> Array:
        return np.array([offset_m(table, jaw_opening_m) for table in self._motion])

    def _check_places(self) -> None:
        strange = ~np.isfinite(self._nominal_points_m).all(axis=1)
        if strange.any():
            name = self.point_ids[int(strange.argmax())]
            raise GripperError(f"points.{name}.xyz_m: holds a value that is not finite; three ordinary numbers")
        far = np.abs(self._nominal_points_m).max(axis=1, initial=0.0)
        if far.max(initial=0.0) > LARGEST_EXTENT_M:
            name = self.point_ids[int(far.argmax())]
            raise GripperError(f"points.{name}.xyz_m: {far.max():g} m from the TCP; metres (millimetres were meant?)")

    def _check(self) -> None:
        if not self.finger_ids:
            raise GripperError("fingers: there are none; at least one finger")
        corners = self._nominal_points_m[self.corner_points]
        if len(corners) < 3 or on_a_line(corners):
            where = ", all on a line" if len(corners) > 2 else ""
            self.notes.append(
                f"{len(corners)} corners{where}: too few for a calibration by corners, it is measured by its edges; "
                "`corner: true` where two straight edges meet"
            )
        if len(self.edge_ids) < 3:
            raise GripperError(f"edges: {len(self.edge_ids)}; at least 3 edges, two at each corner")
        for i, name in enumerate(self.corner_ids):
            if len(self.edges_at_corner(i)) < 2:
                raise GripperError(
                    f"points.{name}: fewer than two straight edges end in this corner; a corner is where edges meet"
                )


POLARITY = {"any": 0, "right": 1, "left": -1}


def _named(key: str, kind: str, name: str, index: Mapping[str, int]) -> int:
    """The index of a point or finger that is named at ``key``."""
    if name not in index:
        raise GripperError(f"{key}: there is no {kind} '{name}'; one of {', '.join(index)}")
    return index[name]


def on_a_line(points_m: Array) -> bool:
    """Whether points (n, 3) are collinear: they lie beside a line by at most two per cent of their extent."""
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= SMALLEST_SPREAD_RATIO * spread[0])
