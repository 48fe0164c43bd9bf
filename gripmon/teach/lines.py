"""The line that one edge shows in the teaching images, among everything else that looks like an edge beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.least_squares import TUKEY, tukey_weights
from gripmon.model.records import Array
from gripmon.track.edges.prediction import STRETCH

_START_PX = 1.0  # half width of a line while it is looked for: two lines closer than this are one to a blurred image
_FLOOR_PX = 0.05  # the scatter of edge points is never taken to be less: pixels are that coarse
_GATE_PX = 0.5  # a profile shows the line if it has an edge point so close to it
_STEP_PX = 0.5
_TILTS_PX = (-1.0, 0.0, 1.0)
_FEWEST = 6
_ROUNDS = 20
_SETTLED_PX = 1e-4


@dataclass(frozen=True, slots=True)
class EdgePoints:
    """Edge candidates of one edge in all images, against the reference's prediction.

    ``way`` (k,) from 0 to 1 along the sampled part, ``offset_px`` (k,), ``step`` (k,) grey-level step, ``profile`` (k,)
    number of the profile, ``image`` (k,) of the image, ``candidate`` (k,) number among that image's candidates;
    ``profiles`` (i,) how many profiles each image has on this edge.
    """

    way: Array
    offset_px: Array
    step: Array
    profile: NDArray[np.intp]
    image: NDArray[np.intp]
    candidate: NDArray[np.intp]
    profiles: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Line:
    """An edge's offset at both ends of its sampled part, px, with its covariance (2, 2) from the points' scatter.

    ``inlier`` (k,) which points belong to it, ``rms_px`` their scatter, ``seen`` the part of the profiles that show it,
    ``rival_px``: distance of another line that nearly as many profiles show, None if there is none.
    """

    ends_px: Array
    covariance_px2: Array
    inlier: NDArray[np.bool_]
    rms_px: float
    seen: float
    rival_px: float | None = None


def find_line(points: EdgePoints, expected_px: Array, reach_px: float) -> Line | None:
    """The line that most profiles of all images show within ``reach_px`` of the expected one (2,); None if there is
    none.

    Of lines that are shown alike the one nearer to the expected line is taken.
    """
    if len(points.way) < _FEWEST:
        return None
    shifts = np.arange(-round(reach_px / _STEP_PX), round(reach_px / _STEP_PX) + 1) * _STEP_PX
    starts = np.array([expected_px + s + 0.5 * t * np.array([-1.0, 1.0]) for s in shifts for t in _TILTS_PX])
    away = np.abs(starts.mean(axis=1) - expected_px.mean())
    votes = _votes(points, starts)
    wish = votes * (1.0 - 0.5 * np.square(away / (reach_px + _STEP_PX)))
    best = int(wish.argmax())
    line = settle_line(points, starts[best])
    if line is None:
        return None
    apart = np.abs(starts.mean(axis=1) - line.ends_px.mean()) > 1.5 * _START_PX
    rivals = np.flatnonzero(apart & (votes > 0.8 * votes[best]))
    rival_px = None
    if len(rivals):
        rival_px = float(starts[rivals[votes[rivals].argmax()]].mean() - line.ends_px.mean())
    return Line(line.ends_px, line.covariance_px2, line.inlier, line.rms_px, line.seen, rival_px)


def settle_line(points: EdgePoints, start_px: Array, worth: Array | None = None) -> Line | None:
    """Robust straight line (Tukey's biweight, its width from the points' own scatter) from a start (2,); None if too
    few points lie there.  ``worth`` (k,): the points' information, on average 1; all the same if None.
    """
    given = np.ones(len(points.way)) if worth is None else worth
    root = np.sqrt(given)
    design = np.column_stack([1.0 - points.way, points.way])
    ends_px, width, scale = start_px, _START_PX, _FLOOR_PX
    for _ in range(_ROUNDS):
        residual = root * (points.offset_px - design @ ends_px)
        weight = tukey_weights(np.abs(residual), width)
        near = np.abs(residual) < width
        if np.count_nonzero(near) < _FEWEST:
            return None
        scale = max(1.4826 * float(np.median(np.abs(residual[near]))), _FLOOR_PX)
        width = min(TUKEY * scale, _START_PX)
        weighted = design * (root * weight)[:, None]
        normal = weighted.T @ (design * root[:, None])
        if not np.linalg.cond(normal) < 1e6:
            return None
        step = np.linalg.solve(normal, weighted.T @ residual)
        ends_px = ends_px + step
        if np.abs(step).max() < _SETTLED_PX:
            break
    residual = root * (points.offset_px - design @ ends_px)
    inlier = np.abs(residual) < width
    if np.count_nonzero(inlier) < _FEWEST:
        return None
    # Neighbours see the same pixels and the same texture: a whole stretch of them is worth one.
    rms_px = float(np.sqrt(np.mean(np.square(residual[inlier]))))
    covariance = np.linalg.inv(design[inlier].T @ design[inlier]) * max(rms_px, scale) ** 2 * STRETCH
    shown = np.unique(points.profile[np.abs(residual) < _GATE_PX])
    return Line(ends_px, covariance, inlier, rms_px, len(shown) / max(int(points.profiles.sum()), 1))


def of_image(points: EdgePoints, image: int) -> EdgePoints:
    """The points of one image alone."""
    own = points.image == image
    profiles = np.zeros_like(points.profiles)
    profiles[image] = points.profiles[image]
    return EdgePoints(
        points.way[own],
        points.offset_px[own],
        points.step[own],
        points.profile[own],
        points.image[own],
        points.candidate[own],
        profiles,
    )


def _votes(points: EdgePoints, starts: Array) -> Array:
    """(s,) sum of a weight that falls with the distance of each point to each line (s, 2)."""
    lines = starts[:, :1] * (1.0 - points.way) + starts[:, 1:] * points.way
    nearness = np.maximum(1.0 - np.square((points.offset_px - lines) / _START_PX), 0.0)
    return np.asarray(nearness.sum(axis=1))
