"""What one would do instead: an AprilTag (36h11) on each finger, a detector with sub-pixel corners, solvePnP."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.machine import ROOT
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import Camera
from gripmon.model.geometry import make_transform
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array

_CELLS = 8  # across a 36h11 tag, its black border included
_QUIET_CELLS = 1
_INK_DN, _PAPER_DN = 40.0, 205.0
_PSF_PX = 0.6
_FINE = 3  # points a pixel at which the print is looked up before the lens blurs it
_REACH_SIGMAS = 4.0
FAMILY = "tag36h11"


@dataclass(frozen=True)
class TagPlace:
    """A tag on a finger's face towards the camera: its number, a point on its finger, and in the gripper frame at the
    nominal opening its middle and the vectors (3,) of one cell to the right and downwards in the image.
    """

    number: int
    point: int
    middle_m: Array
    right_m: Array
    down_m: Array


class FingerTags:
    """A tag as large as the fingertip is wide, quiet zone included, one cell behind the tip, on every finger.

    The fingers' points have to be named as in ``configs/grippers``: ``L_in_near``, ``R_out_near`` …; tag 0 is on the
    left, 1 on the right one.
    """

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        places = [_place(gripper, number, side) for number, side in enumerate("LR")]
        self.places = tuple(place for place in places if place is not None)
        self._prints: dict[int, tuple[bytes, _Print | None]] = {}  # the latest: often nothing moves

    def points_grip_m(self, place: TagPlace, jaw_opening_m: float, half_cells: float) -> Array:
        """Corners (4, 3) of a square about a tag's middle: top left, top right, bottom right, bottom left."""
        moved = self._gripper.points_grip_m(jaw_opening_m) - self._gripper.points_grip_m(None)
        across, down = half_cells * place.right_m, half_cells * place.down_m
        square = np.array([-across - down, across - down, across + down, -across + down])
        return place.middle_m + moved[place.point] + square

    def black_points_grip_m(self, jaw_opening_m: float) -> dict[int, Array]:
        """Corners (4, 3) of each tag's black square, which is what detectors return, by number."""
        return {p.number: self.points_grip_m(p, jaw_opening_m, 0.5 * _CELLS) for p in self.places}

    def paint(
        self,
        light: NDArray[np.float32],
        camera: Camera,
        cam_T_grip: Array,
        jaw_opening_m: float,
        psf_px: float,
        numbers: Iterable[int] = (0, 1),
    ) -> NDArray[np.float32]:
        """Light (height, width) with the printed tags, averaged over pixels and blurred by the lens; a new array."""
        out = light.copy()
        size = (light.shape[1], light.shape[0])
        for place in self.places:
            if place.number in numbers:
                outer = self.points_grip_m(place, jaw_opening_m, 0.5 * _CELLS + _QUIET_CELLS)
                outer_cam_m = outer @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]
                key = outer_cam_m.tobytes()
                if self._prints.get(place.number, (b"", None))[0] != key:
                    self._prints[place.number] = key, _print(size, camera, outer_cam_m, place.number, psf_px)
                printed = self._prints[place.number][1]
                if printed is not None:
                    window = out[printed.window]
                    window *= 1.0 - printed.covered
                    window += _INK_DN * printed.covered + (_PAPER_DN - _INK_DN) * printed.paper
        return out


def with_tags(
    image: NDArray[np.uint8],
    camera: Camera,
    cam_T_grip: Array,
    jaw_opening_m: float,
    rng: np.random.Generator,
    tags: FingerTags | None = None,
    noise_dn: float = 1.2,
) -> NDArray[np.uint8]:
    """A finished image with a printed tag on each finger, as noisy as the rest; of the box fingers by default."""
    before = image.astype(np.float32)
    after = (tags or _box_tags()).paint(before, camera, cam_T_grip, jaw_opening_m, _PSF_PX)
    after += rng.normal(0.0, noise_dn, after.shape).astype(np.float32) * (after != before)
    return np.clip(np.round(after), 0, 255).astype(np.uint8)


class TagTracker:
    """Detect the tags in a whole image and solve for the pose; ``detector``: ``aruco`` (sub-pixel corners, as in
    OpenCV's tutorials) or ``apriltag`` (pyapriltags).
    """

    def __init__(self, camera: Camera, tags: FingerTags | None = None, detector: str = "aruco") -> None:
        self._camera, self._tags = camera, tags or _box_tags()
        self._detect = _Aruco() if detector == "aruco" else _AprilTags()

    def cam_T_grip(self, image: NDArray[np.uint8], jaw_opening_m: float, least: int = 2) -> Array | None:
        """The pose (4, 4); None unless this many tags are found."""
        found = self._detect(image)
        points_m = self._tags.black_points_grip_m(jaw_opening_m)
        numbers = sorted(set(found) & set(points_m))
        if len(numbers) < least:
            return None
        seen_px = np.concatenate([found[n] for n in numbers])
        points = np.concatenate([points_m[n] for n in numbers])
        return pose_from_points(points, self._camera.undistort(seen_px))

    def tcp_m(self, image: NDArray[np.uint8], jaw_opening_m: float) -> Array | None:
        """The TCP (3,) in the camera frame; None unless both tags are found."""
        pose = self.cam_T_grip(image, jaw_opening_m)
        return None if pose is None else np.asarray(pose[:3, 3])


def apriltags_installed() -> bool:
    return importlib.util.find_spec("pyapriltags") is not None


def pose_from_points(points_m: Array, xy: Array) -> Array | None:
    """Coplanar points (n, 3) and ideal coordinates (n, 2) -> pose (4, 4): closed form, then least squares."""
    found, turn, tcp_m = cv2.solvePnP(points_m, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return None
    refined, refined_tcp_m = cv2.solvePnPRefineLM(points_m, xy, np.eye(3), None, turn, tcp_m)
    return pose_of(refined, refined_tcp_m)


def pose_of(turn: Any, tcp_m: Any) -> Array:
    """OpenCV's rotation vector and translation as a transform (4, 4)."""
    return make_transform(np.asarray(cv2.Rodrigues(turn)[0], float), np.reshape(np.asarray(tcp_m, float), 3))


class _Aruco:
    def __init__(self) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(_dictionary(), parameters)

    def __call__(self, image: NDArray[np.uint8]) -> dict[int, Array]:
        corners, ids, _ = self._detector.detectMarkers(image)
        numbers = [] if ids is None else [int(n) for n in np.ravel(ids)]
        return {n: np.reshape(c, (4, 2)).astype(float) for n, c in zip(numbers, corners, strict=True)}


class _AprilTags:
    """Its corners start at the top right and run clockwise the other way; its pixel centres lie at halves."""

    def __init__(self) -> None:
        from pyapriltags import Detector

        self._detector = Detector(families=FAMILY, nthreads=1, quad_decimate=1.0)

    def __call__(self, image: NDArray[np.uint8]) -> dict[int, Array]:
        found = self._detector.detect(image)
        return {f.tag_id: np.asarray(f.corners, float)[[1, 0, 3, 2]] - 0.5 for f in found if f.hamming == 0}


def _place(gripper: Gripper, number: int, side: str) -> TagPlace | None:
    names = gripper.point_ids
    if f"{side}_in_near" not in names:
        return None
    tip, out = names.index(f"{side}_in_near"), names.index(f"{side}_out_near")
    points = gripper.points_grip_m(None)
    right = points[tip] - points[out] if side == "L" else points[out] - points[tip]
    cell_m = float(np.linalg.norm(right)) / (_CELLS + 2 * _QUIET_CELLS)
    right = right / np.linalg.norm(right)
    # Down in the image is backwards along the finger, in the plane of its face.
    ends = gripper.edge_points[(gripper.edge_points == tip).any(axis=1)]
    back = min(ends.ravel().tolist(), key=lambda p: points[p, 2])
    down = points[back] - points[tip]
    down = down - right * float(down @ right)
    down /= np.linalg.norm(down)
    middle = 0.5 * (points[tip] + points[out]) + down * cell_m * (0.5 * _CELLS + 2 * _QUIET_CELLS)
    return TagPlace(number, tip, middle, cell_m * right, cell_m * down)


@dataclass(frozen=True)
class _Print:
    """One tag in the image: its window, the share of each pixel that it covers, and that which is white paper."""

    window: tuple[slice, slice]
    covered: NDArray[np.float32]
    paper: NDArray[np.float32]


def _print(size: tuple[int, int], camera: Camera, outer_cam_m: Array, number: int, psf_px: float) -> _Print | None:
    """One tag, quiet zone and all, in an image of (width, height); ``outer_cam_m`` (4, 3) are its corners."""
    uv = camera.project(outer_cam_m)
    reach = _REACH_SIGMAS * psf_px + 2.0
    if not np.isfinite(uv).all():
        return None
    low = np.clip(np.floor(uv.min(axis=0) - reach).astype(int), 0, size)
    high = np.clip(np.ceil(uv.max(axis=0) + reach).astype(int) + 1, 0, size)
    if (high <= low).any():
        return None
    columns, rows = (high - low).tolist()
    u = low[0] - 0.5 + (np.arange(columns * _FINE) + 0.5) / _FINE
    v = low[1] - 0.5 + (np.arange(rows * _FINE) + 0.5) / _FINE
    xy = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    # Where the rays meet the tag's plane, in cells from its top left corner.
    cells = _CELLS + 2 * _QUIET_CELLS
    right, down = (outer_cam_m[1] - outer_cam_m[0]) / cells, (outer_cam_m[3] - outer_cam_m[0]) / cells
    plane = np.linalg.inv(np.column_stack([right, down, outer_cam_m[0]]))
    along = np.column_stack([xy, np.ones(len(xy))]) @ plane.T
    a, b = (np.reshape(along[:, k] / along[:, 2], (rows * _FINE, columns * _FINE)) for k in (0, 1))
    # Each point stands for an area; the cells' axes are taken for its sides.
    half_a = 0.5 * np.hypot(np.gradient(a, axis=0), np.gradient(a, axis=1))
    half_b = 0.5 * np.hypot(np.gradient(b, axis=0), np.gradient(b, axis=1))
    ends = [np.clip(end, 0.0, cells) for end in (a - half_a, a + half_a, b - half_b, b + half_b)]
    area = 4.0 * half_a * half_b
    covered = (ends[1] - ends[0]) * (ends[3] - ends[2]) / area
    paper = _sum_between(_print_integral(number), *ends) / area
    window = slice(low[1], high[1]), slice(low[0], high[0])
    return _Print(window, _through_lens(covered, psf_px), _through_lens(paper, psf_px))


def _sum_between(table: Array, a_low: Array, a_high: Array, b_low: Array, b_high: Array) -> Array:
    """Sum of cells over rectangles, from their integral."""
    total = _bilinear(table, a_high, b_high) - _bilinear(table, a_low, b_high)
    return np.asarray(total + _bilinear(table, a_low, b_low) - _bilinear(table, a_high, b_low))


def _bilinear(table: Array, a: Array, b: Array) -> Array:
    last = table.shape[0] - 1
    i, j = np.minimum(a, last - 1).astype(np.intp), np.minimum(b, last - 1).astype(np.intp)
    s, t = a - i, b - j
    upper = (1.0 - s) * table[j, i] + s * table[j, i + 1]
    lower = (1.0 - s) * table[j + 1, i] + s * table[j + 1, i + 1]
    return np.asarray((1.0 - t) * upper + t * lower)


def _through_lens(fine: Array, psf_px: float) -> NDArray[np.float32]:
    blurred = np.asarray(cv2.GaussianBlur(fine, (0, 0), psf_px * _FINE), dtype=float)
    rows, columns = blurred.shape[0] // _FINE, blurred.shape[1] // _FINE
    return blurred.reshape(rows, _FINE, columns, _FINE).mean(axis=(1, 3)).astype(np.float32)


def _integral(cells: Array) -> Array:
    return np.pad(cells.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))


@cache
def _print_integral(number: int) -> Array:
    """Integral of a tag's print, 1 where it is white, quiet zone included."""
    marker = np.asarray(cv2.aruco.generateImageMarker(_dictionary(), number, _CELLS)) / 255.0
    return _integral(np.pad(marker, _QUIET_CELLS, constant_values=1.0))


@cache
def _dictionary() -> Any:
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)


@cache
def _box_tags() -> FingerTags:
    return FingerTags(read_gripper(ROOT / "configs" / "grippers" / "two_box_fingers.yaml"))
