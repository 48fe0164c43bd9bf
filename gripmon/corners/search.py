"""Finding the gripper again after a jump that is wider than the profiles reach.

In an image reduced to some 160 columns, every predicted edge point asks for a gradient across its edge.  The answers,
limited so that strong texture counts no more than a clear edge, are added up over shifts, turns about the optical
axis and scales; the best places become starts for the joint fit on the full image.
"""

from __future__ import annotations

import math
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from gripmon.corners.prediction import Prediction
from gripmon.corners.profiles import GREY_BGR
from gripmon.records import Array, Image

_ORIENTATIONS = 16

POINTS = 80
"""Edge points that vote; more cost more and tell little."""

TICK = 2.0
"""Step of turn and scale: so many coarse pixels of motion at the farthest edge point."""


class SearchSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far around the prediction a lost gripper is looked for."""

    reach_m: Annotated[
        float,
        Meta(
            ge=0.0, le=0.1, description="shift of the TCP across the optical axis, and along it, that is searched (m)"
        ),
    ] = 0.012
    turn_rad: Annotated[
        float, Meta(ge=0.0, le=0.5, description="turn about the optical axis that is searched (rad)")
    ] = 0.08
    coarse_columns: Annotated[int, Meta(ge=64, le=1024, description="width of the reduced image (columns)")] = 160
    starts: Annotated[int, Meta(ge=1, le=64, description="places that are tried on the full image")] = 12
    eager_frames: Annotated[
        int, Meta(ge=1, le=1000, description="so many frames may look further one after the other")
    ] = 4
    refill_frames: Annotated[
        int, Meta(ge=1, le=100000, description="good frames after which one more frame may look further")
    ] = 60
    patient_every: Annotated[
        int, Meta(ge=1, le=1000, description="a lost gripper is then searched for in one of so many frames")
    ] = 15


def search_starts(image: Image, prediction: Prediction, settings: SearchSettings) -> Array:
    """Starts (s, m) for the joint fit, best first: perturbations of the prediction's pose.  Empty when nothing is
    predicted.

    The pose's tilt isn't searched: within some degrees it shows as a shift, and the fit finds the rest.
    """
    unknowns = prediction.jacobian.shape[1]
    usable = np.flatnonzero(prediction.ok)
    if len(usable) < 8:
        return np.zeros((0, unknowns))
    points = usable[:: max(1, len(usable) // POINTS)]
    factor = max(1.0, image.shape[1] / settings.coarse_columns)
    depth = float(prediction.corners.cam_m[:, 2].mean())
    reach = math.ceil(settings.reach_m * prediction.pixels_per_m / factor)
    padded = np.pad(_edge_answers(image, factor), ((0, 0), (reach, reach), (reach, reach)))
    centre = prediction.uv_px[points].mean(axis=0)
    spread_px = float(np.abs(prediction.uv_px[points] - centre).max())
    turns = _ticks(settings.turn_rad, TICK * factor / spread_px)
    scales = _ticks(settings.reach_m / depth, TICK * factor / spread_px)
    found: list[tuple[float, Array]] = []
    for turn in turns:
        for scale in scales:
            votes = _votes(padded, prediction, points, centre, turn, scale, factor, reach)
            for score, dx, dy in _peaks(votes, 2):
                start = np.zeros(unknowns)
                # A scale s about the camera's axis is a depth z / s; shift and turn act at that depth.
                start[2] = depth / (1.0 + scale) - depth
                start[5] = turn
                start[:2] = _shift_of_tcp(prediction, centre, (dx * factor, dy * factor), turn, scale)
                found.append((score, start))
    found.sort(key=lambda item: -item[0])
    return np.array([start for _, start in found[: settings.starts]])


def _ticks(reach: float, step: float) -> list[float]:
    count = math.ceil(reach / step) if reach > 0.0 else 0
    return [reach * k / count for k in range(-count, count + 1)] if count else [0.0]


def _shift_of_tcp(
    prediction: Prediction, centre: Array, shift_px: tuple[float, float], turn: float, scale: float
) -> Array:
    """Translation (2,) of the TCP, m, that moves the point seen at ``centre`` by ``shift_px`` when the gripper also
    turns and comes nearer.
    """
    tcp = prediction.cam_T_grip[:3, 3]
    lens = prediction.corners.d_uv_d_xy.mean(axis=0)
    tcp_uv = prediction.corners.uv_px.mean(axis=0) + lens @ (tcp[:2] / tcp[2] - prediction.corners.xy.mean(axis=0))
    arm = tcp_uv - centre
    turned = (1.0 + scale) * np.array(
        [math.cos(turn) * arm[0] - math.sin(turn) * arm[1], math.sin(turn) * arm[0] + math.cos(turn) * arm[1]]
    )
    move_xy = np.linalg.solve(lens, np.asarray(shift_px) + turned - arm)
    return (tcp[:2] / tcp[2] + move_xy) * (tcp[2] / (1.0 + scale)) - tcp[:2]


def _edge_answers(image: Image, factor: float) -> NDArray[np.float32]:
    """(o, h, w) for each orientation of the normal in [0, pi): squared cosine to the gradient, times a limited
    strength.
    """
    size = (max(16, round(image.shape[1] / factor)), max(16, round(image.shape[0] / factor)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    if small.ndim == 3:
        small = small @ GREY_BGR
    if not np.isfinite(small).all():
        # Dead pixels of a float camera: the usual level makes no edge that would outshine all others.
        small[~np.isfinite(small)] = np.nanmedian(small)
    gx = cv2.Scharr(small, cv2.CV_32F, 1, 0)
    gy = cv2.Scharr(small, cv2.CV_32F, 0, 1)
    energy = gx * gx + gy * gy
    usual = float(np.median(energy)) + 1e-12
    limited = 1.0 / (energy + 2.0 * usual)
    out = np.empty((_ORIENTATIONS, *small.shape), dtype=np.float32)
    for k in range(_ORIENTATIONS):
        angle = math.pi * k / _ORIENTATIONS
        across = math.cos(angle) * gx + math.sin(angle) * gy
        out[k] = across * across * limited
    return out


def _votes(
    padded: NDArray[np.float32],
    prediction: Prediction,
    points: NDArray[np.intp],
    centre: Array,
    turn: float,
    scale: float,
    factor: float,
    reach: int,
) -> NDArray[np.float32]:
    """(2 reach + 1, 2 reach + 1) summed answers over shifts in coarse pixels; rows are shifts along v.

    ``padded`` are the answers with ``reach`` more pixels all around; points that fall outside even so have no vote.
    """
    c, s = math.cos(turn), math.sin(turn)
    arms = prediction.uv_px[points] - centre
    rotation = np.array([[c, -s], [s, c]])
    # Pixel centres are integers in both images.
    places = ((1.0 + scale) * arms @ rotation.T + centre + 0.5) / factor - 0.5
    normals = prediction.normal[points] @ rotation.T
    orientation = (
        np.round(np.arctan2(normals[:, 1], normals[:, 0]) / math.pi * _ORIENTATIONS).astype(int) % _ORIENTATIONS
    )
    column, row = np.round(places).astype(int).T
    height, width = padded.shape[1] - 2 * reach, padded.shape[2] - 2 * reach
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    size = 2 * reach + 1
    votes = np.zeros((size, size), dtype=np.float32)
    for k, u, v in np.column_stack([orientation, column, row])[inside].tolist():
        votes += padded[k, v : v + size, u : u + size]
    return votes


def _peaks(votes: NDArray[np.float32], count: int) -> list[tuple[float, int, int]]:
    """The highest separate peaks: (score, dx, dy) in coarse pixels."""
    left = votes.copy()
    reach = votes.shape[0] // 2
    out = []
    for _ in range(count):
        row, column = divmod(int(left.argmax()), votes.shape[1])
        out.append((float(votes[row, column]), column - reach, row - reach))
        left[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = 0.0
    return out
