"""Finding the gripper again after a jump that is wider than the search lines reach.

In a reduced image (``reduced``) the points on the predicted outlines vote for shifts in all three directions and turns
about the optical axis.  The best places are perturbed in all six directions, tilts included, then refined by least
squares on an image of twice the resolution (``hypotheses``).  Far places need better evidence than near ones, as few
knocks are so large; the result is a few starts for the joint fit on the full image, which decides.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.track.edges.hypotheses import (
    MapScore,
    OutlinePoints,
    Poses,
    ProfileScore,
    Projected,
    apart,
    orientation_of,
    outline_points,
    project,
    rotations,
)
from gripmon.track.edges.reduced import BESIDE_CELLS, Floats, Window, evidence_maps, rectify, window_about
from gripmon.track.edges.settings import SearchSettings
from gripmon.track.integrity.knocks import log_likely

POINTS, FINE_POINTS = 80, 120
"""Points on the outlines that are looked at in the reduced image, and in the finer one."""

STEP_CELLS = 3.0
"""Step of turn and scale, in cells of motion at the farthest outline point."""

FOLLOWED_PLACES = 64
"""Best places of the votes that are followed."""

POLISHED_PLACES = 24
"""Of these, how many are polished."""

PERTURBATION_ROUNDS = ((24, 2.5, 1.0), (12, 1.25, 0.5))
"""Rounds of perturbations: number of them at each place, their range in cells, and as a part of the searched tilt."""

POLISHING_ZOOM = 2
"""Resolution of the image for polishing over that for voting."""

POLISH_REACH, POLISH_ROUNDS = 4, 4
"""Finer cells to both sides of the outlines that are read in the first least squares step; number of steps."""

DISTINCT_CELLS = 2.0
"""Difference of the outlines, in cells of the finer image, up to which two poses count as one."""


def search_poses(
    image: Image,
    camera: Camera,
    gripper: Gripper,
    cam_T_grip: Array,
    jaw_opening_m: float,
    settings: SearchSettings,
    shown: Array | None = None,
) -> Array:
    """Poses (s, 4, 4) about an expected one from which a joint fit may find the gripper, best first.

    ``shown`` (e,): how often each edge shows, 0 to 1; None: all are looked for alike.  Empty when none of its outlines
    can be in the image.
    """
    depth_m = float(cam_T_grip[2, 3])
    if not depth_m > 0.0:
        return np.zeros((0, 4, 4))
    margin_px = settings.reach_m / depth_m * camera.fx_px
    points = outline_points(camera, gripper, cam_T_grip, jaw_opening_m, margin_px, POINTS, shown)
    if not len(points):
        return np.zeros((0, 4, 4))
    place = _Place(cam_T_grip, points, settings)
    window = window_about(camera, place.xy, place.reach_m / place.depth_m, settings.coarse_columns)
    if min(window.columns, window.rows) < 8:
        return np.zeros((0, 4, 4))
    maps = evidence_maps(*rectify(image, camera, window))
    poses = place.voted(maps, window)
    score = MapScore(points, window, maps)
    for count, cells, part in PERTURBATION_ROUNDS:
        poses, scores = score.shaken(poses, place.shakes(count, cells * window.pitch, part), place.middle_m)
    likely = scores + place.log_likely(poses)
    poses = poses.take(
        np.array(apart(poses, points, window, likely, 0.5 * DISTINCT_CELLS / POLISHING_ZOOM, POLISHED_PLACES))
    )
    finer = window.finer(POLISHING_ZOOM)
    points = outline_points(camera, gripper, cam_T_grip, jaw_opening_m, margin_px, FINE_POINTS, shown)
    profiles = ProfileScore(points, finer, *rectify(image, camera, finer), POLISHING_ZOOM * BESIDE_CELLS)
    poses = profiles.polished(poses, POLISH_REACH, POLISH_ROUNDS, place.sigma)
    likely = profiles.score(poses) + place.log_likely(poses)
    best = apart(poses, points, finer, likely, DISTINCT_CELLS, settings.starts)
    return poses.take(np.array(best)).matrices()


class _Place:
    """Where the gripper is expected, and how far from there it may be."""

    def __init__(self, cam_T_grip: Array, points: OutlinePoints, settings: SearchSettings) -> None:
        self._settings, self._points = settings, points
        self._expected = Poses(cam_T_grip[None, :3, :3], cam_T_grip[None, :3, 3])
        self.middle_m = np.asarray(points.points_m.mean(axis=1), dtype=float)
        middle_cam_m = cam_T_grip[:3, :3] @ self.middle_m + cam_T_grip[:3, 3]
        self.depth_m = max(float(middle_cam_m[2]), 1e-3)
        self._middle_cam_m = np.array([*middle_cam_m[:2], self.depth_m])
        seen_m = cam_T_grip[:3, :3] @ points.points_m + cam_T_grip[:3, 3:4]
        self.xy: Array = (seen_m[:2] / np.maximum(seen_m[2], 1e-3)).T
        self._spread = float(np.abs(self.xy - self.xy.mean(axis=0)).max())
        # A turn about the TCP shifts what is seen of the fingers.
        self.reach_m = settings.reach_m + settings.tilt_rad * float(np.linalg.norm(self.middle_m))
        turns = [settings.tilt_rad, settings.tilt_rad, settings.turn_rad]
        self.sigma = np.array([0.5 * settings.reach_m] * 3 + [0.6 * turn for turn in turns]) + 1e-6

    def log_likely(self, poses: Poses) -> Floats:
        """(h,) natural logarithms of how likely a knock brings the gripper there: the votes reach farther than most."""
        return np.asarray(log_likely(poses.translation_m - self._expected.translation_m), dtype=np.float32)

    def shakes(self, count: int, shift: float, part: float) -> Array:
        """(count, 6) perturbations: by up to ``shift`` (ideal) in the image, and a part of the searched tilt."""
        across, turn = shift * self.depth_m, min(shift / self._spread, 1.0)
        tilt = part * self._settings.tilt_rad
        return _spread_evenly(count) * np.array([across, across, turn * self.depth_m, tilt, tilt, turn])

    def voted(self, maps: Floats, window: Window) -> Poses:
        """The places with most votes over shifts, and turns about the optical axis."""
        settings = self._settings
        reach = math.ceil(self.reach_m / self.depth_m / window.pitch)
        tick = STEP_CELLS * window.pitch / self._spread
        found: list[tuple[float, Array, Array]] = []
        for turn in _ticks(settings.turn_rad, tick):
            turned = rotations(np.array([[0.0, 0.0, turn]])) @ self._expected.rotation
            for nearer in _ticks(self.reach_m / self.depth_m, tick):
                middle_m = self._middle_cam_m / (1.0 + nearer)  # in the same place of the image
                seen = project(self._points, Poses(turned, middle_m - turned @ self.middle_m), window)
                votes = _votes(maps, seen, float(middle_m[2]), reach)
                step_m = window.pitch * float(middle_m[2])
                for score, (right, down) in _peaks(votes, 2):
                    there_m = middle_m + step_m * np.array([right, down, 0.0])
                    found.append((score, turned[0], there_m - turned[0] @ self.middle_m))
        found.sort(key=lambda item: -item[0])
        best = found[:FOLLOWED_PLACES]
        return Poses(np.array([item[1] for item in best]), np.array([item[2] for item in best]))


def _ticks(reach: float, step: float) -> list[float]:
    count = math.ceil(reach / step) if reach > 0.0 else 0
    return [reach * k / count for k in range(-count, count + 1)] if count else [0.0]


def _votes(maps: Floats, seen: Projected, depth_m: float, reach: int) -> Floats:
    """(2 reach + 1, 2 reach + 1) summed evidence over shifts of the gripper by whole cells at a depth; rows are shifts
    along v.

    What is nearer is shifted by more, what is farther by less: fingers reach from half of the TCP's distance to all of
    it.  Points that fall outside of the maps (o, rows, columns) have no vote.
    """
    rows, columns = maps.shape[1] + 2, maps.shape[2] + 2
    flat = np.pad(maps, ((0, 0), (1, 1), (1, 1))).ravel()
    ways = depth_m * np.asarray(seen.per_z[0], dtype=float)[:, None] * np.arange(-reach, reach + 1)
    row = np.clip(np.rint(seen.row[0][:, None] + ways) + 1.0, 0.0, rows - 1.0).astype(np.intp)
    column = np.clip(np.rint(seen.column[0][:, None] + ways) + 1.0, 0.0, columns - 1.0).astype(np.intp)
    row = (orientation_of(seen)[0][:, None] * rows + row) * columns
    votes = np.zeros((2 * reach + 1, 2 * reach + 1), dtype=np.float32)
    for v, u in zip(row, column, strict=True):
        votes += flat.take(v[:, None] + u)
    return votes


def _peaks(votes: Floats, count: int) -> list[tuple[float, Array]]:
    """The highest separate peaks: score and shift (2,) in cells."""
    left = votes.copy()
    reach = votes.shape[0] // 2
    out = []
    for _ in range(count):
        row, column = divmod(int(left.argmax()), votes.shape[1])
        out.append((float(votes[row, column]), np.array([column - reach, row - reach], dtype=float)))
        left[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = -np.inf
    return out


@lru_cache(maxsize=8)
def _spread_evenly(count: int) -> Array:
    """(count, 6) in [-1, 1): zero, then a sequence without gaps or clusters (additive recurrence of the generalised
    golden ratio: Roberts 2018, "The unreasonable effectiveness of quasirandom sequences").
    """
    ratio = 1.1127756842787055  # the root of x**7 = x + 1
    steps = ratio ** -np.arange(1.0, 7.0)
    places = 2.0 * ((0.5 + np.arange(count)[:, None] * steps) % 1.0) - 1.0
    places[0] = 0.0
    places.flags.writeable = False
    return places
