"""Many poses at once, held against a reduced image: where they put the gripper's outlines, what the image says for
them, and better ones near by.

h poses are rotations (h, 3, 3) and translations (h, 3) of ``cam_T_grip``; n points lie on the outlines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, skew
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import PLACES
from gripmon.track.edges.reduced import (
    ORIENTATIONS,
    RANK_LEVELS,
    Floats,
    Window,
    against_surroundings,
    calmness,
    evidence_table,
    gradients,
)

POINTS_LENGTH_EXPONENT = 0.75
"""Exponent of the length in an edge's number of points: short edges across the fingers tell what long ones don't."""

FEWEST_POINTS = 3
"""Points on an edge that always shows, however short it is."""

_EDGE_MARGIN = 0.03  # of an edge at each end: the neighbour shows there


class Poses(NamedTuple):
    rotation: Array
    translation_m: Array

    def take(self, which: NDArray[np.intp]) -> Poses:
        return Poses(self.rotation[which], self.translation_m[which])

    def matrices(self) -> Array:
        """(h, 4, 4)."""
        out = np.tile(np.eye(4), (len(self.rotation), 1, 1))
        out[:, :3, :3], out[:, :3, 3] = self.rotation, self.translation_m
        return out


@dataclass(frozen=True, slots=True)
class OutlinePoints:
    """Points (3, n) on the visible outlines and the directions (3, n) of their edges, gripper frame; ``edge`` (n,)."""

    points_m: Floats
    direction: Floats
    edge: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.edge)


def outline_points(
    camera: Camera,
    gripper: Gripper,
    cam_T_grip: Array,
    jaw_opening_m: float,
    margin_px: float,
    count: int,
    shown: Array | None = None,
) -> OutlinePoints:
    """Some ``count`` points on the outlines that show from a pose, up to ``margin_px`` outside of the image; fewer on
    those that are rarely ``shown`` (e,), 0 to 1.
    """
    ends_m = gripper.points_grip_m(jaw_opening_m)
    view = gripper.edge_view(ends_m, invert(cam_T_grip)[:3, 3])
    wanted = view.visible & ~view.crease
    if np.count_nonzero(wanted) < FEWEST_EDGES:  # then lines between two faces are looked at, too
        wanted = view.visible
    edges = np.flatnonzero(wanted)
    share = np.linspace(_EDGE_MARGIN, 1.0 - _EDGE_MARGIN, PLACES)
    points_m, _ = _places(gripper, ends_m, np.repeat(edges, len(share)), np.tile(share, len(edges)))
    uv = camera.project(points_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]).reshape(-1, len(share), 2)
    with np.errstate(invalid="ignore"):
        limit = np.array([camera.width_px, camera.height_px]) - 1.0 + margin_px
        near: NDArray[np.bool_] = np.all((uv >= -margin_px) & (uv <= limit), axis=2)
    way_px = np.where(near[:, 1:] & near[:, :-1], np.linalg.norm(np.diff(uv, axis=1), axis=2), 0.0)
    often = np.ones(len(edges)) if shown is None else shown[edges]
    length_px = np.nansum(way_px, axis=1)
    weight = often * length_px**POINTS_LENGTH_EXPONENT
    counts = np.maximum(count * weight / max(float(weight.sum()), 1e-9), FEWEST_POINTS * often)
    counts = np.round(counts).astype(int)
    chosen, which = [], []
    for k in np.flatnonzero((length_px > 0.0) & (counts > 0)).tolist():
        travelled = np.concatenate([[0.0], np.cumsum(way_px[k])])
        # Within what is near, equally spaced in the image.
        chosen.append(np.interp(np.linspace(0.0, travelled[-1], counts[k]), travelled, share))
        which.append(np.full(counts[k], edges[k]))
    if not chosen:
        nothing = np.zeros((3, 0), np.float32)
        return OutlinePoints(nothing, nothing, np.zeros(0, np.intp))
    edge = np.concatenate(which)
    points_m, direction = _places(gripper, ends_m, edge, np.concatenate(chosen))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return OutlinePoints(
        np.ascontiguousarray(points_m.T, dtype=np.float32), np.ascontiguousarray(direction.T, dtype=np.float32), edge
    )


def _places(gripper: Gripper, ends_m: Array, edge: NDArray[np.intp], fraction: Array) -> tuple[Array, Array]:
    """Points (n, 3) at fractions (n,) of edges (n,), and the way (n, 3) that the edge goes there."""
    start, end = gripper.tangents_m(ends_m, edge, fraction)
    return start + fraction[:, None] * (end - start), end - start


class Projected(NamedTuple):
    """(h, n) each: column and row in cells, inverse depth, unit normal in the image; ``lever_m`` (h, 3, n) from the
    TCP, camera axes.
    """

    column: Floats
    row: Floats
    per_z: Floats
    normal_x: Floats
    normal_y: Floats
    lever_m: Floats


def project(points: OutlinePoints, poses: Poses, window: Window) -> Projected:
    """Outline points of all poses in the cells of a window."""
    rotation, translation = (np.asarray(a, dtype=np.float32) for a in poses)
    lever = rotation @ points.points_m
    along = rotation @ points.direction
    z = lever[:, 2] + translation[:, 2:3]
    per_z = 1.0 / np.maximum(z, np.float32(1e-4))
    x, y = (lever[:, 0] + translation[:, 0:1]) * per_z, (lever[:, 1] + translation[:, 1:2]) * per_z
    tangent_x, tangent_y = along[:, 0] - x * along[:, 2], along[:, 1] - y * along[:, 2]
    norm = 1.0 / np.sqrt(tangent_x * tangent_x + tangent_y * tangent_y + np.float32(1e-12))
    low_x, low_y = window.low_xy.tolist()
    per_pitch = np.float32(1.0 / window.pitch)
    column, row = (x - np.float32(low_x)) * per_pitch, (y - np.float32(low_y)) * per_pitch
    return Projected(column, row, per_z, -tangent_y * norm, tangent_x * norm, lever)


def _cells(points: OutlinePoints, poses: Poses, window: Window) -> tuple[Floats, Floats]:
    """As :func:`project`, column and row only."""
    rotation, translation = (np.asarray(a, dtype=np.float32) for a in poses)
    cam_m = (rotation.reshape(-1, 3) @ points.points_m).reshape(len(rotation), 3, -1)
    cam_m += translation[..., None]
    per_z = np.float32(1.0 / window.pitch) / np.maximum(cam_m[:, 2], np.float32(1e-4))
    low_x, low_y = (np.asarray(window.low_xy) / window.pitch).astype(np.float32).tolist()
    column, row = cam_m[:, 0] * per_z, cam_m[:, 1] * per_z
    column -= np.float32(low_x)
    row -= np.float32(low_y)
    return column, row


def orientation_of(seen: Projected) -> NDArray[np.int32]:
    """(h, n) index of the map for each point's normal."""
    angle = np.arctan2(seen.normal_y, seen.normal_x)
    return np.rint(angle * np.float32(ORIENTATIONS / math.pi)).astype(np.int32) % ORIENTATIONS


class MapScore:
    """Sums of evidence over the outlines, read from maps (o, rows, columns); outside of them a point says nothing."""

    def __init__(self, points: OutlinePoints, window: Window, maps: Floats) -> None:
        self._points, self._window = points, window
        padded = np.zeros((ORIENTATIONS, window.rows + 2, window.columns + 2), np.float32)
        padded[:, 1:-1, 1:-1] = maps
        self._flat = padded.ravel()

    def shaken(self, poses: Poses, xi: Array, middle_m: Array) -> tuple[Poses, Floats]:
        """For each pose the best of its perturbations ``xi`` (k, 6) about ``middle_m`` (3,), a point of the gripper
        frame, and its score.
        """
        count, turns = len(poses.rotation), rotations(xi[:, 3:])
        rotation = turns[None] @ poses.rotation[:, None]
        centre = poses.rotation @ middle_m + poses.translation_m
        translation = centre[:, None] + xi[:, :3] - rotation @ middle_m
        many = Poses(rotation.reshape(-1, 3, 3), translation.reshape(-1, 3))
        column, row = _cells(self._points, many, self._window)
        columns, rows = self._window.columns + 2, self._window.rows + 2
        column += np.float32(1.5)
        row += np.float32(1.5)
        index = np.clip(row, 0.0, rows - 1.0, out=row).astype(np.int32)
        index *= columns
        index += np.clip(column, 0.0, columns - 1.0, out=column).astype(np.int32)
        index = index.reshape(count, len(xi), -1)
        # Small turns leave the normals' orientations as they are.
        orientation = orientation_of(project(self._points, poses, self._window))
        index += (orientation * (rows * columns))[:, None]
        score = self._flat.take(index).sum(axis=2)
        best = score.argmax(axis=1)
        chosen = np.arange(count) * len(xi) + best
        return many.take(chosen), score[np.arange(count), best]


class _Table(NamedTuple):
    """What values say, ranked among those that were read first."""

    evidence: Floats
    per_level: float

    @classmethod
    def of(cls, values: Floats) -> _Table:
        if not values.size:
            return cls(np.zeros(RANK_LEVELS, np.float32), 0.0)
        place = int(0.998 * (values.size - 1))
        per_level = (RANK_LEVELS - 1) / (float(np.partition(values, place)[place]) + 1e-12)
        counts = np.bincount(_levels(values, per_level), minlength=RANK_LEVELS)
        return cls(evidence_table(counts.astype(float)), per_level)

    def look_up(self, values: Floats) -> Floats:
        return np.asarray(self.evidence.take(_levels(values, self.per_level)), dtype=np.float32)


def _levels(values: Floats, per_level: float) -> NDArray[np.uint8]:
    return np.minimum(values * np.float32(per_level), RANK_LEVELS - 1).astype(np.uint8)


class ProfileScore:
    """Evidence along search lines across the outlines: to the pixel, for poses that are nearly right.

    Strengths are averaged over neighbouring points of an edge, and ranked among all that were read first.
    """

    def __init__(self, points: OutlinePoints, window: Window, grey: Floats, seen: NDArray[np.bool_], side: int) -> None:
        """``side``: cells from an outline to where its sides are looked at."""
        self._points, self._window, self._side = points, window, side
        gx, gy = gradients(grey)
        factor = against_surroundings(np.hypot(gx, gy), seen)
        self._columns, self._rows = window.columns + 2, window.rows + 2
        field = np.zeros((self._rows, self._columns, 2), np.float32)
        field[1:-1, 1:-1, 0], field[1:-1, 1:-1, 1] = gx * factor, gy * factor
        self._field = field.reshape(-1, 2)
        self._calm = np.pad(calmness(gx, gy, seen), 1).ravel()
        self._seen = np.pad(seen, 1).ravel()
        same = np.asarray(points.edge[1:] == points.edge[:-1], dtype=np.float32)
        self._same = same[None, :, None]
        neighbours = 1.0 + np.append(same, 0.0) + np.append(0.0, same)
        self._per_neighbours = np.asarray(1.0 / neighbours, dtype=np.float32)[None, :, None]
        self._tables: list[_Table] = []

    def evidence(self, at: Projected, half: int) -> Floats:
        """(h, n, 2 half + 1) at whole cells along the normals."""
        side = self._side
        offsets = np.arange(-half - side, half + side + 1, dtype=np.float32)
        normal_x, normal_y = at.normal_x[..., None], at.normal_y[..., None]
        column = (at.column + np.float32(1.5))[..., None] + normal_x * offsets
        row = (at.row + np.float32(1.5))[..., None] + normal_y * offsets
        around = np.clip(row, 0.0, self._rows - 1.0, out=row).astype(np.int32)
        around *= self._columns
        around += np.clip(column, 0.0, self._columns - 1.0, out=column).astype(np.int32)
        calm = self._calm.take(around)
        index = around[..., side:-side]
        strength = self._strength(index, normal_x, normal_y)
        calmer = np.maximum(calm[..., : -2 * side], calm[..., 2 * side :])
        shown = self._seen.take(index)
        if not self._tables:
            self._tables = [_Table.of(values[shown]) for values in (strength, calmer)]
        found = self._tables[0].look_up(strength) + self._tables[1].look_up(calmer)
        found *= shown
        return found

    def _strength(self, index: NDArray[np.int32], normal_x: Floats, normal_y: Floats) -> Floats:
        field = self._field[index]
        across = field[..., 0] * normal_x
        across += field[..., 1] * normal_y
        mean = across.copy()
        mean[:, 1:] += across[:, :-1] * self._same
        mean[:, :-1] += across[:, 1:] * self._same
        np.abs(mean, out=mean)
        mean *= self._per_neighbours
        return mean

    def score(self, poses: Poses) -> Floats:
        """(h,) sums of evidence exactly where the poses put the outlines."""
        at = project(self._points, poses, self._window)
        return np.asarray(self.evidence(at, 0).sum(axis=(1, 2)), dtype=np.float32)

    def polished(self, poses: Poses, reach: int, rounds: int, sigma: Array) -> Poses:
        """Poses that the evidence up to ``reach`` cells beside the outlines pulls them to: of all rounds the one with
        the highest score, give or take a cell.

        Each round is a least squares step to the evidence's means along the search lines, on a width that shrinks;
        ``sigma`` (6,), m and rad, keeps the whole way short where nothing pulls.
        """
        rotation, translation = poses.rotation.copy(), poses.translation_m.copy()
        best, best_score = Poses(rotation.copy(), translation.copy()), np.full(len(rotation), -np.inf)
        gone, width = np.zeros((len(rotation), 6)), float(reach)
        for round_ in range(rounds + 1):
            half = max(round(width), 1)
            offsets = np.arange(-half, half + 1, dtype=np.float32)
            at = project(self._points, Poses(rotation, translation), self._window)
            found = self.evidence(at, half)
            score = found[:, :, half - 1 : half + 2].max(axis=2).sum(axis=1)
            better = score > best_score
            best_score[better] = score[better]
            best.rotation[better], best.translation_m[better] = rotation[better], translation[better]
            if round_ == rounds:
                return best
            pull = np.maximum(np.exp(found) - 1.0, 0.0) * np.exp(-0.5 * (offsets / (0.6 * width)) ** 2)
            xi = self._step(at, pull, offsets, width, gone, sigma)
            gone += xi
            rotation, translation = rotations(xi[:, 3:]) @ rotation, translation + xi[:, :3]
            width = max(0.8 * width, 1.5)
        return best

    def _step(self, at: Projected, pull: Floats, offsets: Floats, width: float, gone: Array, sigma: Array) -> Array:
        """(h, 6)."""
        total = pull.sum(axis=2)
        with np.errstate(invalid="ignore"):  # which OpenBLAS may set for finite numbers (NumPy's issue 24067)
            offset = (pull @ offsets) / np.maximum(total, 1e-9)
        weight = total / (total + 3.0)
        per_pitch = 1.0 / self._window.pitch
        x = at.column * self._window.pitch + self._window.low_xy[0]
        y = at.row * self._window.pitch + self._window.low_xy[1]
        jacobian = np.empty((*offset.shape, 6))
        jacobian[..., 0] = at.normal_x * at.per_z * per_pitch
        jacobian[..., 1] = at.normal_y * at.per_z * per_pitch
        jacobian[..., 2] = -(jacobian[..., 0] * x + jacobian[..., 1] * y)
        for i, j, k in ((3, 1, 2), (4, 2, 0), (5, 0, 1)):
            jacobian[..., i] = at.lever_m[:, j] * jacobian[..., k] - at.lever_m[:, k] * jacobian[..., j]
        weighted = np.swapaxes(jacobian * weight[..., None], 1, 2)
        hold = (0.5 * width / sigma) ** 2
        normal = weighted @ jacobian + np.diag(hold)
        right = (weighted @ offset[..., None])[..., 0] - hold * gone
        return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def rotations(omega: Array) -> Array:
    """Rotation vectors (h, 3), rad -> matrices (h, 3, 3).  Rodrigues."""
    angle = np.linalg.norm(omega, axis=1)[:, None, None]
    turn = skew(omega)
    # numpy's sinc is sin(pi x) / (pi x): exact at zero.
    half = np.sinc(angle / (2.0 * math.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / math.pi) * turn + 0.5 * half * half * (turn @ turn))


def apart(poses: Poses, points: OutlinePoints, window: Window, scores: Floats, cells: float, most: int) -> list[int]:
    """Indices of the best poses, best first, whose outlines lie at least ``cells`` from those of better ones."""
    column, row = _cells(points, poses, window)
    places = np.concatenate([column[:, ::6], row[:, ::6]], axis=1)
    taken = np.zeros(len(places), dtype=bool)
    kept: list[int] = []
    for k in np.argsort(-scores, kind="stable").tolist():
        if not taken[k]:
            kept.append(k)
            if len(kept) == most:
                break
            taken |= np.abs(places - places[k]).max(axis=1) <= cells
    return kept
