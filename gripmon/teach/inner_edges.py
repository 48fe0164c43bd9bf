"""Edges within a finger that are the same in all images: creases, borders of two tones, pads, straight sides of screws.

They are searched for in the mean over the images, in which noise and reflections of the background average out: found
as line segments (Grompone von Gioi et al., LSD, 2010), then measured like the outline, by the steepest place across.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.matte import Matte
from gripmon.teach.piece_lines import jackknife_sigma
from gripmon.teach.silhouette import folds_of, from_ideal_px, to_ideal_px

SHORTEST_PX = 20.0
"""Least length of an edge: texture has shorter lines, scratches and brush marks."""
LEAST_CONTRAST = 6.0
"""Least step over a pixel's noise: a search line averaged over three rows then shows it at ten sigma."""
SEEN_SHARE = 0.7
"""Least part of an edge's length along which its step has one sign."""
FROM_OUTLINE_PX = 3.0
"""Least distance from the outline, where the background shines in: two and a half times a usual blur of 1.2 px."""
_REACH_PX = 3.0
_STEP_PX = 0.25
_SAME_PX, _SAME_COS = 3.0, 0.996


@dataclass(frozen=True)
class InnerEdge:
    """Its ends (2, 2) in the image, ``folds_px`` (f, 2, 2), the same with one tenth of the images left out, the
    ``step`` in grey levels (positive: brighter to the right when going from the first end), ``rms_px`` of its points.
    """

    uv_px: Array
    folds_px: Array
    step: float
    rms_px: float

    @property
    def sigma_px(self) -> float:
        """Standard deviation across the edge, from the scatter over the images."""
        return float(jackknife_sigma(self.folds_px).max())


def find_inner_edges(camera: Camera, matte: Matte, mask: NDArray[np.bool_]) -> list[InnerEdge]:
    """The edges within a part of the gripper, longest first."""
    size = 2 * int(FROM_OUTLINE_PX) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    inside = np.asarray(cv2.erode(mask.astype(np.uint8), kernel, borderValue=1), np.uint8)
    fold = folds_of(len(matte.images))
    images = np.bincount(fold)
    sums = np.stack([np.sum(matte.images[fold == f], axis=0, dtype=float) for f in range(len(images))])
    total = sums.sum(axis=0)
    left = [(total, len(fold)), *((total - sums[f], len(fold) - count) for f, count in enumerate(images.tolist()))]
    means = [np.asarray(part / count, np.float32) for part, count in left]
    grey = np.clip(cv2.GaussianBlur(matte.mean, (0, 0), 0.8), 0.0, 255.0).astype(np.uint8)
    segments = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    out: list[InnerEdge] = []
    for segment in [] if segments is None else segments.reshape(-1, 2, 2).astype(float):
        kept = _inside_part(segment, inside)
        if kept is None:
            continue
        edge = _measured(camera, means, kept, matte.noise)
        if edge is not None:
            out.append(edge)
    out.sort(key=lambda e: -float(np.linalg.norm(e.uv_px[1] - e.uv_px[0])))
    return _different(out)


def _inside_part(segment: Array, inside: NDArray[np.uint8]) -> Array | None:
    """The longest part of a segment (2, 2) well inside the mask; None if it is too short."""
    length = float(np.linalg.norm(segment[1] - segment[0]))
    count = max(int(length), 2)
    points = segment[0] + np.linspace(0.0, 1.0, count)[:, None] * (segment[1] - segment[0])
    at = np.clip(np.round(points).astype(int), 0, np.array(inside.shape[::-1]) - 1)
    ok = np.concatenate([[0], inside[at[:, 1], at[:, 0]].astype(int), [0]])
    change = np.flatnonzero(np.diff(ok))
    if not len(change):
        return None
    starts, stops = change[::2], change[1::2]
    best = int((stops - starts).argmax())
    if stops[best] - starts[best] < SHORTEST_PX:
        return None
    return np.asarray(points[[starts[best], stops[best] - 1]])


def _measured(camera: Camera, means: list[NDArray[np.float32]], ends: Array, noise: float) -> InnerEdge | None:
    ideal = to_ideal_px(camera, ends)
    length = float(np.linalg.norm(ideal[1] - ideal[0]))
    share = np.linspace(1.0, length - 1.0, max(int(length) - 1, 4)) / length
    base = ideal[0] + share[:, None] * (ideal[1] - ideal[0])
    uv = from_ideal_px(camera, base)
    tangent = np.gradient(uv, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    s = np.arange(-_REACH_PX - 2.0, _REACH_PX + 2.01, _STEP_PX)
    maps = [(uv[:, k, None] + normal[:, k, None] * s).astype(np.float32) for k in (0, 1)]
    lines, first = [], None
    for image in means:
        profile = cv2.remap(image, maps[0], maps[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slope = np.gradient(cv2.GaussianBlur(profile, (0, 0), sigmaX=1.0 / _STEP_PX, sigmaY=1.0), _STEP_PX, axis=1)
        found = _steps(slope, s)
        if first is None:
            sign = float(np.sign(np.median(found[1])))
            usable = (np.sign(found[1]) == sign) & (np.abs(found[1]) > LEAST_CONTRAST * noise)
            if usable.mean() < SEEN_SHARE or not length > SHORTEST_PX:
                return None
            fitted = np.polyfit(share[usable], found[0][usable], 1)
            off = np.abs(found[0] - np.polyval(fitted, share))
            usable &= off < max(3.0 * 1.4826 * float(np.median(off[usable])), 0.3)
            if usable.mean() < SEEN_SHARE:
                return None
            first = found, usable
        lines.append(np.polyval(np.polyfit(share[first[1]], found[0][first[1]], 1), [0.0, 1.0]))
    assert first is not None
    rough = from_ideal_px(camera, ideal)
    at = [rough + np.array(line)[:, None] * normal[[0, -1]] for line in lines]
    residual = first[0][0][first[1]] - np.polyval(
        np.polyfit(share[first[1]], first[0][0][first[1]], 1), share[first[1]]
    )
    return InnerEdge(
        at[0], np.stack(at[1:]), float(np.median(first[0][1][first[1]])), float(np.sqrt(np.square(residual).mean()))
    )


def _steps(slope: Array, s: Array) -> tuple[Array, Array]:
    """Position of the steepest slope (stations,), and the step there in grey levels."""
    near = np.abs(s) <= _REACH_PX
    height = np.where(near[None], np.abs(slope), 0.0)
    at = np.clip(height.argmax(axis=1), 1, len(s) - 2)
    row = np.arange(len(slope))
    low, mid, high = height[row, at - 1], height[row, at], height[row, at + 1]
    bend = np.maximum(2.0 * mid - low - high, 1e-9)
    # The step over the slope of an edge with a Gaussian blur of 1.2 px, by the lens and the filter together.
    step = slope[row, at] * 1.2 * (2.0 * np.pi) ** 0.5
    return s[at] + 0.5 * _STEP_PX * np.clip((high - low) / bend, -1.0, 1.0), step


def _different(edges: list[InnerEdge]) -> list[InnerEdge]:
    """Drop edges beside a longer one in the same direction."""
    out: list[InnerEdge] = []
    for edge in edges:
        way = edge.uv_px[1] - edge.uv_px[0]
        beside = False
        for other in out:
            along = other.uv_px[1] - other.uv_px[0]
            along = along / np.linalg.norm(along)
            off = edge.uv_px - other.uv_px[0]
            across = np.abs(off[:, 0] * along[1] - off[:, 1] * along[0])
            alike = abs(float(way @ along)) > _SAME_COS * float(np.linalg.norm(way))
            beside |= alike and float(across.max()) < _SAME_PX
        if not beside:
            out.append(edge)
    return out
