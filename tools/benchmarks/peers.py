"""What others would use, on the same frames: corners refined by OpenCV, its edge tracker, tags on the fingertips.

A peer is handed each image and the reported jaw opening, and keeps its own last pose.  None of them knows about
hidden parts, tells how sure it is, or can do without the jaw opening: where the robot reports none, they take the
nominal one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.machine import ROOT
from benchmarks.scenes import Sequence
from benchmarks.tags import FingerTags, TagTracker, apriltags_installed, pose_of
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

Grey = NDArray[np.uint8]

LOST_M = 2e-3
"""A peer whose TCP is further from the truth than this is lost; its error then doesn't count, which favours it."""
_VERTEX_STEP_M = 1e-3
_BOX_GRIPPER = ROOT / "configs" / "grippers" / "two_box_fingers.yaml"


class Peer(Protocol):
    """``tagged``: it looks at the image with tags."""

    tagged: bool

    def cam_T_grip(self, image: Grey, jaw_opening_m: float) -> Array | None: ...


class CornerPeer:
    """``cv2.cornerSubPix`` from where the last pose puts the visible corners, then ``cv2.solvePnP`` from that pose.

    A corner that moved to the rim of the search window has found something else and is left out.
    """

    tagged = False
    _WINDOW_PX = 7
    _RIM_PX = 6.0
    _BORDER_PX = 10.0

    def __init__(self, sequence: Sequence) -> None:
        self._camera, self._gripper, self._pose = sequence.camera, sequence.gripper, sequence.start_cam_T_grip

    def cam_T_grip(self, image: Grey, jaw_opening_m: float) -> Array | None:
        gripper, pose = self._gripper, self._pose
        points = gripper.points_grip_m(jaw_opening_m)
        corners = points[gripper.corner_points]
        guess = self._camera.project(corners @ pose[:3, :3].T + pose[:3, 3])
        limit = np.array([image.shape[1], image.shape[0]]) - 1.0 - self._BORDER_PX
        with np.errstate(invalid="ignore"):
            usable = ((guess > self._BORDER_PX) & (guess < limit)).all(axis=1)
        usable &= gripper.corners_visible(points, invert(pose)[:3, 3])
        if np.count_nonzero(usable) < 3:
            return None
        start = guess[usable].astype(np.float32).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.001)
        window = (self._WINDOW_PX, self._WINDOW_PX)
        seen = np.asarray(cv2.cornerSubPix(image, start, window, (-1, -1), stop), float)[:, 0]
        kept = np.linalg.norm(seen - guess[usable], axis=1) < self._RIM_PX
        if np.count_nonzero(kept) < 4:
            return None
        xy = self._camera.undistort(seen[kept])
        turn, way = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
        found, new_turn, tcp_m = cv2.solvePnP(
            corners[usable][kept], xy, np.eye(3), None, turn, way, True, cv2.SOLVEPNP_ITERATIVE
        )
        if not found or not np.isfinite(tcp_m).all():
            return None
        self._pose = pose_of(new_turn, tcp_m)
        return self._pose


class RapidPeer:
    """``cv2.rapid`` as well as it can be used: several iterations with search lines that grow shorter.

    Its high-level function follows one closed outline only, so its steps run for each finger and one
    ``solvePnPRefineLM`` takes the points of all of them; it knows no lens, so the image is undistorted first; and it
    takes short cuts where corners of the mesh lie outside the image, so the outline is drawn on a larger one; and it
    divides edges as if there were no perspective, so the mesh has a vertex at each millimetre of them.
    Of two pixels that are as steep it always takes the one on the same side, which makes the gripper look larger: so
    it searches each line from both ends, and the middle counts.
    Matches on the rear parts of the fingers, which their carriers hide, are left out, and so are weak ones, as inside
    the module.
    """

    tagged = False
    _LINES = 400  # a finger
    _LENGTHS_PX = (12, 8, 5, 3, 3)
    _WEAK_DN = 20
    _REAR_SHARE = 0.2
    _MARGIN_PX = 200

    def __init__(self, sequence: Sequence) -> None:
        camera, self._gripper = sequence.camera, _with_faces(sequence.gripper)
        self._turn = np.asarray(cv2.Rodrigues(sequence.start_cam_T_grip[:3, :3])[0], float)
        self._tcp_m = sequence.start_cam_T_grip[:3, 3:].copy()
        self._matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
        self._canvas_matrix = self._matrix + np.array([[0, 0, self._MARGIN_PX], [0, 0, self._MARGIN_PX], [0, 0, 0.0]])
        self._maps = undistorting_maps(camera)
        self._meshes = [_mesh(self._gripper, finger) for finger in range(len(self._gripper.finger_ids))]

    def cam_T_grip(self, image: Grey, jaw_opening_m: float) -> Array | None:
        ideal = np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), np.uint8)
        moved = self._gripper.points_grip_m(jaw_opening_m) - self._gripper.points_grip_m(None)
        meshes = [
            (_moved(points, moved[self._gripper.point_finger == k][0]), triangles)
            for k, (points, triangles) in enumerate(self._meshes)
        ]
        turn, tcp_m = self._turn, self._tcp_m
        for length_px in self._LENGTHS_PX:
            found = [self._matches(ideal, *mesh, length_px, turn, tcp_m) for mesh in meshes]
            seen, solid = (np.concatenate([f[i] for f in found]) for i in (0, 1))
            if len(seen) < 12:
                return None
            refined = cv2.solvePnPRefineLM(solid, seen, self._matrix, None, turn.copy(), tcp_m.copy())
            turn, tcp_m = (np.asarray(part, float) for part in refined)
            if not np.isfinite(tcp_m).all() or tcp_m[2, 0] < 0.01:
                return None
        self._turn, self._tcp_m = turn, tcp_m
        return pose_of(turn, tcp_m)

    def _matches(
        self,
        image: Grey,
        mesh: NDArray[np.float32],
        triangles: NDArray[np.int32],
        length_px: int,
        turn: Array,
        tcp_m: Array,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Image (n, 2) and solid points (n, 3) of one finger's outline."""
        nothing = np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32)
        size = np.array([image.shape[1], image.shape[0]])
        canvas = (size + 2 * self._MARGIN_PX).tolist()
        try:
            flat, solid = cv2.rapid.extractControlPoints(
                self._LINES, length_px, mesh, turn, tcp_m, self._canvas_matrix, canvas, triangles
            )
        except cv2.error:
            return nothing  # it asserts where the outline has left the canvas
        if np.size(flat) < 8:
            return nothing
        flat = np.reshape(flat, (-1, 2)).astype(np.float32) - np.float32(self._MARGIN_PX)
        solid = np.reshape(solid, (-1, 3)).astype(np.float32)
        inside = ((flat > length_px) & (flat < size - 1 - length_px)).all(axis=1)
        inside &= solid[:, 2] > mesh[:, 2].min() + self._REAR_SHARE * np.ptp(mesh[:, 2])
        if np.count_nonzero(inside) < 4:
            return nothing
        bundle, places = cv2.rapid.extractLineBundle(length_px, flat[inside].reshape(-1, 1, 2), image)
        bundle, places = np.asarray(bundle), np.asarray(places, np.float32)
        columns, strength = cv2.rapid.findCorrespondencies(bundle)
        mirrored, _ = cv2.rapid.findCorrespondencies(np.ascontiguousarray(bundle[:, ::-1]))
        ends, rows = (np.ravel(columns), bundle.shape[1] - 1 - np.ravel(mirrored)), np.arange(len(bundle))
        seen = 0.5 * (places[rows, ends[0]] + places[rows, ends[1]])
        sure = (np.ravel(strength) > self._WEAK_DN) & (np.abs(ends[0] - ends[1]) <= 1)
        return seen[sure], solid[inside][sure]


class TagPeer:
    """Tags on the fingertips of the same scene, whichever of them are found, by ``detector``."""

    tagged = True

    def __init__(self, sequence: Sequence, detector: str) -> None:
        self._tracker = TagTracker(sequence.camera, FingerTags(sequence.gripper), detector)

    def cam_T_grip(self, image: Grey, jaw_opening_m: float) -> Array | None:
        return self._tracker.cam_T_grip(image, jaw_opening_m, least=1)


PEERS: dict[str, Callable[[Sequence], Peer]] = {
    "cornerSubPix": CornerPeer,
    "rapid": RapidPeer,
    "aruco": lambda sequence: TagPeer(sequence, "aruco"),
    "apriltag": lambda sequence: TagPeer(sequence, "apriltag"),
}
MARKERLESS = ("cornerSubPix", "rapid")


def missing_peers() -> dict[str, str]:
    """Peers that can't run here, and why."""
    return {} if apriltags_installed() else {"apriltag": "pyapriltags is not installed"}


def timed(peer: Peer, image: Grey, jaw_opening_m: float) -> tuple[Array | None, float]:
    """The peer's pose and its processor time, ms; everybody runs in this one thread."""
    start_ns = time.thread_time_ns()
    pose = peer.cam_T_grip(image, jaw_opening_m)
    return pose, 1e-6 * (time.thread_time_ns() - start_ns)


def _with_faces(gripper: Gripper) -> Gripper:
    """The gripper itself, or, if its file tells no faces, the box gripper if its corners are the same."""
    if gripper.faces:
        return gripper
    box = read_gripper(_BOX_GRIPPER)
    own = dict(zip(gripper.corner_ids, gripper.points_grip_m(None)[gripper.corner_points], strict=True))
    of_box = dict(zip(box.corner_ids, box.points_grip_m(None)[box.corner_points], strict=True))
    if any(name not in of_box or not np.allclose(of_box[name], xyz, atol=1e-6) for name, xyz in own.items()):
        raise ValueError(f"gripper {gripper.name} has no faces to make a mesh of")
    return box


def _mesh(gripper: Gripper, finger: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Points (p, 3) at the nominal opening and triangles (t, 3) of a finger: each face a fan about its middle, its
    borders cut into millimetres, in the order of rotation that rapid takes for the front.
    """
    corners = gripper.points_grip_m(None)
    points: list[Array] = []
    triangles: list[tuple[int, int, int]] = []
    for face in gripper.faces:
        if face.finger != finger:
            continue
        loop = corners[face.points]
        middle, first = len(points), len(points) + 1
        points.append(loop.mean(axis=0))
        for start, end in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            count = max(round(float(np.linalg.norm(end - start)) / _VERTEX_STEP_M), 1)
            points += [start + share * (end - start) for share in np.arange(count) / count]
        border = list(range(first, len(points)))
        triangles += [(middle, b, a) for a, b in zip(border, border[1:] + border[:1], strict=True)]
    return np.array(points, np.float32), np.array(triangles, np.int32)


def _moved(points: NDArray[np.float32], way_m: Array) -> NDArray[np.float32]:
    return points + way_m.astype(np.float32)


def undistorting_maps(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps from the ideal image, of the same focal length and centre, to the camera's."""
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    xy = np.stack([(u.ravel() - camera.cx_px) / camera.fx_px, (v.ravel() - camera.cy_px) / camera.fy_px], axis=1)
    uv = camera.distort(xy).reshape(camera.height_px, camera.width_px, 2).astype(np.float32)
    return np.ascontiguousarray(uv[..., 0]), np.ascontiguousarray(uv[..., 1])
