"""Edges within a finger that are the same in all images: creases, borders of two tones, pads, straight sides of screws.

They are searched for in the mean over the images, in which noise and reflections of the background average out: found
as line segments (Grompone von Gioi et al., LSD, 2010), then measured like those of one image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.matte import Matte
from gripmon.teach.outline_edges import edge_between

SHORTEST_PX = 20.0
"""Least length of an edge: texture has shorter lines, scratches and brush marks."""
LEAST_CONTRAST = 4.0
"""Least response over a pixel's noise: that of a step of six, of which a lens's blur of 0.8 px leaves two thirds."""
SEEN_SHARE = 0.7
"""Least part of an edge's length along which its step is clear and has one sign."""
FROM_OUTLINE_PX = 3.0
"""Least distance from the outline, where the background shines in: two and a half times a usual blur of 1.2 px."""
_REACH_PX, _MARGIN_PX = 3.0, 1.0
_SAME_PX, _SAME_COS = 3.0, 0.996


@dataclass(frozen=True)
class InnerEdge:
    """Its ends (2, 2) in the image, the ``step`` in grey levels (positive: brighter to the right when going from the
    first end), and ``sigma_px``, its standard deviation across itself.
    """

    uv_px: Array
    step: float
    sigma_px: float


def find_inner_edges(camera: Camera, matte: Matte, mask: NDArray[np.bool_]) -> list[InnerEdge]:
    """The edges within a part of the gripper, longest first."""
    size = 2 * int(FROM_OUTLINE_PX) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    inside = np.asarray(cv2.erode(mask.astype(np.uint8), kernel, borderValue=1), np.uint8)
    grey = np.clip(cv2.GaussianBlur(matte.mean, (0, 0), 0.8), 0.0, 255.0).astype(np.uint8)
    segments = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    out: list[InnerEdge] = []
    mean = np.asarray(matte.images.mean(axis=0, dtype=float) / 255.0, np.float32)
    for segment in [] if segments is None else segments.reshape(-1, 2, 2).astype(float):
        kept = _inside_part(segment, inside)
        found = None if kept is None else edge_between(camera, mean, kept, _REACH_PX, _MARGIN_PX)
        if found is None:
            continue
        steps = 255.0 * found.points.step[found.line.inlier]
        step = float(np.median(steps))
        clear = np.sign(step) * steps > LEAST_CONTRAST * matte.noise
        if found.line.seen * clear.mean() >= SEEN_SHARE:
            sigma_px = float(np.sqrt(found.line.covariance_px2.diagonal().max()))
            out.append(InnerEdge(found.at_px(found.line.ends_px), step, sigma_px))
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
