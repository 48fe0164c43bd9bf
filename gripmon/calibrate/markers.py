"""Markers of ArUco: the corners of ChArUco boards by them, and their dictionaries."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gripmon.calibrate.grey_levels import to_bytes, to_grey
from gripmon.model.records import Array, Image
from gripmon.model.targets import Charuco, TargetError

_CHARUCO = cv2.aruco.CharucoParameters()
_CHARUCO.minMarkers = 1  # of the two beside a corner: fingers cover many, and the corner itself is measured here
_Marked = tuple[cv2.aruco.CharucoBoard, Array, NDArray[np.intp], int]


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """One of OpenCV's dictionaries.  :class:`TargetError` for an unknown one."""
    if not hasattr(cv2.aruco, name) or not name.startswith("DICT_"):
        raise TargetError(f"there is no dictionary {name}; one of OpenCV's, e.g. DICT_4X4_250")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marked_corners(shown: NDArray[np.uint8], target: Charuco) -> _Marked:
    """The board, corners (n, 2), their numbers (n,) and the number of visible markers, for the pattern that shows more:
    before version 4.6 of OpenCV boards with an even number of rows began with the other colour.
    """
    dictionary = dictionary_of(target.dictionary)
    found: list[_Marked] = []
    for legacy in (False, True) if target.rows % 2 == 0 else (False,):
        board = cv2.aruco.CharucoBoard((target.columns, target.rows), target.square_m, target.marker_m, dictionary)
        board.setLegacyPattern(legacy)
        corners, ids, _, marks = cv2.aruco.CharucoDetector(board, _CHARUCO).detectBoard(shown)
        numbers = np.zeros(0, np.intp) if ids is None else np.asarray(ids, np.intp).ravel()
        places = np.asarray(corners if len(numbers) else [], np.float64).reshape(-1, 2)
        agreeing = _agreeing(np.asarray(board.getChessboardCorners())[numbers], places)
        found.append((board, places[agreeing], numbers[agreeing], 0 if marks is None else len(marks)))
        if 2 * len(found[-1][2]) > (target.columns - 1) * (target.rows - 1):
            break
    return max(found, key=lambda one: len(one[2]))


def other_dictionary(images: Iterable[tuple[str, Image]], target: Charuco) -> str | None:
    """The dictionary of OpenCV's, the smallest of several, with the most markers in the images; None if none has twice
    as many as the target's, and at least four.
    """
    seen: Counter[str] = Counter()
    names = [name for name in dir(cv2.aruco) if re.fullmatch(r"DICT_(\dX\d_\d+|ARUCO_(ORIGINAL|MIP_36h12))", name)]
    for _, image in images:
        shown = to_bytes(to_grey(image))
        for name in names:
            ids = cv2.aruco.ArucoDetector(dictionary_of(name)).detectMarkers(shown)[1]
            seen[name] += 0 if ids is None else len(np.unique(ids))
    most = max(seen.values(), default=0)
    if most < max(4, 2 * seen[target.dictionary]):
        return None
    return min((n for n in names if seen[n] == most), key=lambda name: len(dictionary_of(name).bytesList))


def _agreeing(plate: Array, places: Array) -> NDArray[np.bool_]:
    """(n,) which corners agree roughly with one plane: what looks like a marker need not be one."""
    if len(places) < 5:
        return np.ones(len(places), bool)
    tolerance_px = 0.6 * float(np.median(cKDTree(places).query(places, 2)[0][:, 1]))
    plane, mask = cv2.findHomography(
        plate[:, :2].astype(np.float64), places, cv2.RANSAC, tolerance_px, maxIters=500, confidence=0.999
    )
    if plane is None or _mirrors(np.asarray(plane, np.float64), plate[mask.ravel() > 0]):
        return np.zeros(len(places), bool)
    out: NDArray[np.bool_] = mask.ravel() > 0
    return out


def _mirrors(plane: Array, plate: Array) -> bool:
    """Whether a homography flips the plate at these points (n, 3); elsewhere its sign means nothing."""
    depth = plate[:, :2] @ plane[2, :2] + plane[2, 2]
    return bool(np.linalg.det(plane) * np.median(depth) < 0.0)
