"""Fingers as meshes by equations, pictures of meshes, and sequences of them: independent of how outlines are found."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from gripmon.model.camera import Camera
from gripmon.simulate.coverage import CoverageRaster

LAMP = np.array([0.4, -0.5, -0.77])


def finger_mesh(profile_yz_m: np.ndarray, x_m: tuple[float, float]) -> trimesh.Trimesh:
    """A convex profile (n, 2) in y and z, drawn out along x."""
    count = len(profile_yz_m)
    points = np.concatenate([np.column_stack([np.full(count, x), profile_yz_m]) for x in x_m])
    k, after = np.arange(count), np.roll(np.arange(count), -1)
    fan = np.column_stack([np.zeros(count - 2, int), k[1:-1], k[2:]])
    wall = [np.column_stack([k, after, after + count]), np.column_stack([k, after + count, k + count])]
    mesh = trimesh.Trimesh(points, np.concatenate([fan[:, ::-1], fan + count, *wall]), process=False)
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def toned(mesh: trimesh.Trimesh, z_m: float, gain: float) -> list[tuple[trimesh.Trimesh, float]]:
    """A finger's surface in two parts with their gains."""
    parts = []
    for sign, of_part in ((1.0, gain), (-1.0, 1.0)):
        cut = trimesh.intersections.slice_faces_plane(mesh.vertices, mesh.faces, [0.0, 0.0, sign], [0.0, 0.0, z_m])
        parts.append((trimesh.Trimesh(*cut[:2], process=False), of_part))
    return parts


def box_fingers() -> list[trimesh.Trimesh]:
    """Two sharp fingers of the size and at the places of the rounded ones."""
    profile = np.array([[0.008, -0.04], [0.008, 0.0], [-0.008, 0.0], [-0.008, -0.04]])
    return [finger_mesh(profile, x) for x in ((-0.027, -0.017), (0.017, 0.027))]


def bevelled_fingers(bevel_m: float) -> list[trimesh.Trimesh]:
    """The sharp fingers with a bevel of that width on all edges, at 45 degrees."""
    out = []
    for mesh in box_fingers():
        middle, half = mesh.bounds.mean(axis=0), 0.5 * np.ptp(mesh.bounds, axis=0)
        # Of each corner three are left, one on each of its faces, both of whose edges are broken.
        broken = half - bevel_m / np.sqrt(2.0) * (1.0 - np.eye(3))
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        points = middle + (signs[:, None] * broken).reshape(-1, 3)
        out.append(trimesh.convex.convex_hull(points))
    return out


def rounded_profile(radius_m: float) -> np.ndarray:
    """Of a finger whose tip's two edges are rounded: (n, 2), the tip at z = 0."""
    turn = np.linspace(0.0, 0.5 * np.pi, 49)
    arc = radius_m * np.column_stack([np.cos(turn) - 1.0, np.sin(turn) - 1.0]) + [0.008, 0.0]
    mirrored = arc[::-1] * [-1.0, 1.0]
    out = np.concatenate([[[0.008, -0.04]], arc, mirrored, [[-0.008, -0.04]]])
    return out[np.linalg.norm(out - np.roll(out, 1, axis=0), axis=1) > 1e-9]


def rounded_fingers(radius_m: float) -> list[trimesh.Trimesh]:
    """Two fingers of 10 x 16 x 40 mm, 34 mm apart, their tips rounded about x."""
    profile = rounded_profile(radius_m)
    return [finger_mesh(profile, x) for x in ((-0.027, -0.017), (0.017, 0.027))]


def curved_fingers() -> list[trimesh.Trimesh]:
    """Two fingers of 8 x 14 mm that bend inwards on an arc of radius 60 mm over 40 mm, so that they aren't convex:
    rings of four corners, 30 mm apart at the tips.
    """
    out, parts, bend_m = [], 96, 0.06
    for side in (-1.0, 1.0):
        turn = np.linspace(0.0, 0.04 / bend_m, parts + 1)
        # From the tip backwards, bending outwards.
        x, z = 0.015 + bend_m * (1.0 - np.cos(turn)), -bend_m * np.sin(turn)
        normal = np.column_stack([np.cos(turn), np.sin(turn)])
        rings = []
        for k in range(parts + 1):
            outer = np.array([x[k], z[k]]) + 0.008 * normal[k]
            rings.append([(side * px, y, pz) for px, pz in ((x[k], z[k]), outer) for y in (-0.007, 0.007)])
        vertices = np.reshape(rings, (-1, 3))
        faces = [(0, 1, 3), (0, 3, 2)]
        for k in range(parts):
            a, b = 4 * k, 4 * (k + 1)
            for i, j in ((0, 1), (1, 3), (3, 2), (2, 0)):
                faces += [(a + i, b + i, b + j), (a + i, b + j, a + j)]
        last = 4 * parts
        faces += [(last, last + 3, last + 1), (last, last + 2, last + 3)]
        mesh = trimesh.Trimesh(vertices, np.array(faces), process=False)
        if mesh.volume < 0.0:
            mesh.invert()
        out.append(mesh)
    return out


def write_meshes(meshes: Sequence[trimesh.Trimesh], folder: Path, ending: str = "stl") -> list[Path]:
    """One file a finger, in millimetres."""
    paths = []
    for k, mesh in enumerate(meshes):
        path = folder / f"finger{k}.{ending}"
        mesh.copy().apply_scale(1000.0).export(path)
        paths.append(path)
    return paths


class MeshCamera:
    """Pictures of meshes before a background that moves; exact masks of triangles, which must not cover each other."""

    def __init__(
        self,
        camera: Camera,
        meshes: Sequence[trimesh.Trimesh],
        seed: int = 1,
        tone: tuple[float, float] | None = None,
    ) -> None:
        """``tone``: beyond this z (m) towards the tips the fingers are that much brighter."""
        self._camera, self._raster = camera, CoverageRaster(camera, 0.7)
        parts = [toned(mesh, *tone) if tone else [(mesh, 1.0)] for mesh in meshes]
        self._meshes = [
            (k, np.asarray(part.vertices), np.asarray(part.faces), np.asarray(part.face_normals), gain)
            for k, of_finger in enumerate(parts)
            for part, gain in of_finger
        ]
        self._rng = np.random.default_rng(seed)
        table = sum(
            weight * cv2.resize(self._rng.normal(0.0, 1.0, (1440 // cell, 1920 // cell)), (1920, 1440), None, 0, 0, 2)
            for cell, weight in ((80, 30.0), (20, 15.0), (6, 6.0))
        )
        self._table = 70.0 + table
        self._newest: tuple[bytes, tuple[np.ndarray, np.ndarray]] | None = None  # often nothing but the table moves

    def picture(
        self,
        cam_T_grip: np.ndarray,
        offsets_m: Sequence[np.ndarray] | None = None,
        *,
        before: Sequence[tuple[np.ndarray, float]] = (),
        behind: Sequence[tuple[np.ndarray, float]] = (),
    ) -> np.ndarray:
        """(h, w) 8 bits: fingers moved by ``offsets_m`` each; flat things (n, 3), camera frame, with their grey level
        ``before`` and ``behind`` them.
        """
        height, width = self._camera.height_px, self._camera.width_px
        v, u = (int(self._rng.integers(0, n - m)) for n, m in zip(self._table.shape, (height, width), strict=True))
        table = self._table[v : v + height, u : u + width]
        table = self._covered(table, behind)
        passes, light = self._fingers(cam_T_grip, offsets_m)
        image = self._covered(table * passes + light, before) + self._rng.normal(0.0, 1.5, passes.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def coverage(self, cam_T_grip: np.ndarray, offsets_m: Sequence[np.ndarray] | None = None) -> np.ndarray:
        """Part (h, w) of each pixel that the fingers hide."""
        return np.asarray(1.0 - self._fingers(cam_T_grip, offsets_m)[0], np.float32)

    def _fingers(self, cam_T_grip: np.ndarray, offsets_m: Sequence[np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
        """Part of the background that passes by them, and their light."""
        at = b"".join(np.asarray(given, float).tobytes() for given in (cam_T_grip, *(offsets_m or ())))
        if self._newest is None or self._newest[0] != at:
            self._newest = at, self._drawn(cam_T_grip, offsets_m)
        return self._newest[1]

    def _drawn(self, cam_T_grip: np.ndarray, offsets_m: Sequence[np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
        shape = self._camera.height_px, self._camera.width_px
        passes, light = np.ones(shape), np.zeros(shape)
        for k, vertices, faces, normals, gain in self._meshes:
            shift = np.zeros(3) if offsets_m is None else offsets_m[k]
            cam = (vertices + shift) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
            n_cam = normals @ cam_T_grip[:3, :3].T
            facing = np.flatnonzero(np.einsum("ti,ti->t", n_cam, cam[faces[:, 0]]) < 0.0)
            level = gain * (130.0 + 90.0 * np.clip(n_cam @ LAMP, 0.0, 1.0))
            for t, mask in zip(facing, self._raster.masks([cam[faces[t]] for t in facing]), strict=True):
                if mask is not None:
                    part = (
                        slice(mask.top, mask.top + mask.mask.shape[0]),
                        slice(mask.left, mask.left + mask.mask.shape[1]),
                    )
                    passes[part] -= mask.mask
                    light[part] += level[t] * mask.mask
        # Masks of a hundred slivers are off by a per cent where they meet.
        assert passes.min() > -0.05, "faces of a finger cover each other in this view: the picture would be wrong"
        return passes, light

    def _covered(self, image: np.ndarray, things: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
        image = image.copy()
        for (_, level), mask in zip(things, self._raster.masks([thing for thing, _ in things]), strict=True):
            if mask is not None:
                rows = slice(mask.top, mask.top + mask.mask.shape[0])
                part = rows, slice(mask.left, mask.left + mask.mask.shape[1])
                image[part] += (level - image[part]) * mask.mask
        return image


def wandering(cam_T_grip: np.ndarray, share: float, most_m: float = 0.001, most_rad: float = 0.005) -> np.ndarray:
    """A pose on a smooth way about one: by at most so much along and about each axis."""
    phase = 2.0 * np.pi * share
    shift = most_m * np.array([np.sin(phase), np.sin(2.0 * phase), np.sin(phase + 1.0) - np.sin(1.0)])
    turn = most_rad * np.array([np.sin(phase), np.sin(2.0 * phase), -np.sin(phase)])
    out = np.array(cam_T_grip)
    out[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ cam_T_grip[:3, :3]
    out[:3, 3] += shift
    return out
