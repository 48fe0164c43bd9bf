"""What one would do instead: an AprilTag (36h11) on each finger, OpenCV's detector with sub-pixel corners, solvePnP."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.camera import Camera
from gripmon.records import Array

_CELLS = 8  # across a 36h11 tag, its black border included
_CELL_M = 0.001
_QUIET_CELLS = 1
_NEAR_FACE_M = -0.008  # y of the fingers' faces towards the camera
_MIDDLE_BEYOND_JAW_M = 0.005  # from the inner face to the middle of a finger
_MIDDLE_Z_M = -0.006
_INK_DN, _PAPER_DN = 40.0, 205.0
_NOISE_DN = 1.2
_TEXEL_PER_CELL = 16


def tag_points_grip_m(side: int, jaw_opening_m: float, half_cells: float) -> Array:
    """Corners (4, 3) of a square about a tag's middle: top left, top right, bottom right, bottom left in the image.

    ``side``: -1 left finger, 1 right finger.  The fingertips point upwards in the image: down is the gripper's -z.
    """
    middle = np.array([side * (0.5 * jaw_opening_m + _MIDDLE_BEYOND_JAW_M), _NEAR_FACE_M, _MIDDLE_Z_M])
    half_m = half_cells * _CELL_M
    across, down = np.array([half_m, 0.0, 0.0]), np.array([0.0, 0.0, -half_m])
    return middle + np.array([-across - down, across - down, across + down, -across + down])


def with_tags(
    image: NDArray[np.uint8], camera: Camera, cam_T_grip: Array, jaw_opening_m: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The image with a printed tag on each finger, blurred and noisy like the rest."""
    out = image.astype(np.float32)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cells = _CELLS + 2 * _QUIET_CELLS
    texels = cells * _TEXEL_PER_CELL
    for number, side in enumerate((-1, 1)):
        printed = np.full((texels, texels), 255, np.uint8)
        quiet = _QUIET_CELLS * _TEXEL_PER_CELL
        printed[quiet:-quiet, quiet:-quiet] = cv2.aruco.generateImageMarker(
            dictionary, number, _CELLS * _TEXEL_PER_CELL
        )
        points = tag_points_grip_m(side, jaw_opening_m, 0.5 * cells)
        corners_px = camera.project(points @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]).astype(np.float32)
        # Texels average out over a pixel before they are sampled.
        texels_per_px = texels / float(np.linalg.norm(corners_px[1] - corners_px[0]))
        grey = cv2.GaussianBlur(printed.astype(np.float32) / 255.0, (0, 0), max(0.6 * texels_per_px, 0.3))
        edge = texels - 0.5
        square = np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]], np.float32)
        warp = cv2.getPerspectiveTransform(square, corners_px)
        size = (image.shape[1], image.shape[0])
        paper = cv2.warpPerspective(_INK_DN + (_PAPER_DN - _INK_DN) * grey, warp, size, flags=cv2.INTER_LINEAR)
        covered = cv2.warpPerspective(np.ones_like(grey), warp, size, flags=cv2.INTER_LINEAR)
        noisy = paper + rng.normal(0.0, _NOISE_DN, paper.shape).astype(np.float32) * covered
        out = out * (1.0 - covered) + noisy
    return np.clip(np.round(out), 0, 255).astype(np.uint8)


class TagTracker:
    """Detect both tags in a whole image and solve for the pose, as in OpenCV's tutorials."""

    def __init__(self, camera: Camera) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        self._camera = camera

    def tcp_m(self, image: NDArray[np.uint8], jaw_opening_m: float) -> Array | None:
        """The TCP (3,) in the camera frame; None unless both tags are found."""
        corners, ids, _ = self._detector.detectMarkers(image)
        if ids is None or {0, 1} - set(ids.ravel().tolist()):
            return None
        by_id = dict(zip(ids.ravel().tolist(), corners, strict=True))
        seen_px = np.concatenate([by_id[0].reshape(4, 2), by_id[1].reshape(4, 2)]).astype(float)
        points = np.concatenate([tag_points_grip_m(side, jaw_opening_m, 0.5 * _CELLS) for side in (-1, 1)])
        xy = self._camera.undistort(seen_px)
        found, _, tcp_m = cv2.solvePnP(points, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        return tcp_m.ravel() if found else None
