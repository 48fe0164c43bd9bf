"""From spots and poses to a refined set-up: start, refinement, other candidates, and reasons for failure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.robot_world import out_of_step, w_first
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.closed_form import FEWEST_ORIENTATIONS, FEWEST_SHIFTS, orientation_groups, solve
from gripmon.laser.documents import LEAST_NOISE_PX
from gripmon.laser.refinement import PoseNoise, Refined, SpotProblem, refine, with_held_lens
from gripmon.laser.setup import LASER, LaserSetup
from gripmon.model.camera import Camera
from gripmon.model.records import Array

FARTHEST_PLANE_M = 50.0
NEAREST_PLANE_M = 0.01
FARTHEST_LASER_M = 1.0
"""Largest distance of the beam's line from the end-effector's origin (m): no tool holds a laser farther away."""
LEAST_AGREEING = 0.5
"""Minimum inlier ratio of the spots: with fewer, another set-up might explain as many."""
MOST_TURN_RAD = 0.02
"""Largest rotation between samples that are labelled with one orientation (rad): above an arm's noise."""
LARGEST_NOISE_SHARE = 0.01
"""Largest noise of the spots, over the image's width, for which they count as explained."""
LEAST_OF_ORIENTATION = 0.5
"""Minimum inlier ratio of one orientation: scattered wrong spots leave more, so that below it the orientation itself
contradicts the others.
"""
MOST_CONTRADICTING = 1.0 / 3.0
"""Largest share of orientations that may contradict the rest: above it there is no telling which are right."""
SUSPECT_PX = 3.0
"""Noise of the spots (px) above which other readings of the poses are tried; where none fits, there is a warning."""
_LARGE = (
    "residuals of {:.2g} px are larger than a spot's: an orientation or a pose that was misread, or something moved "
    "between them"
)
LEAST_FITTING = 0.7
"""Minimum inlier ratio of another reading before it is reported."""
_NOISE_ROUNDS = 8
_CANDIDATE_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Spots:
    """Measured spots: ``uv_px`` (n, 2), ``covariance_px`` (n, 2, 2) or None; ``others`` (k, 2) each: alternatives."""

    uv_px: Array
    covariance_px: Array | None = None
    others: tuple[Array, ...] = ()


@dataclass(frozen=True, slots=True)
class LaserResult:
    """A laser calibration: the ``refined`` result, and the ``candidate`` taken for each sample (n,): 0 is the
    brightest.  ``warnings`` name orientations that contradict the rest.
    """

    refined: Refined
    uv_px: Array
    candidate: NDArray[np.intp]
    warnings: tuple[str, ...] = ()


def calibrate(
    camera: Camera,
    base_T_ee: Array,
    spots: Spots,
    labels: Sequence[str] | None = None,
    *,
    lens: GivenCamera | None = None,
    refine_lens: bool = True,
    pose_noise: PoseNoise | None = None,
) -> LaserResult:
    """Calibrate camera pose, plane and laser line together.  The ``lens`` covariance is added to the result's; without
    ``refine_lens`` the lens itself is kept.  Raises :class:`CalibrationError` with what is wrong with the data.
    """
    xy = camera.undistort(spots.uv_px)
    if not np.isfinite(xy).all():
        index = int(np.flatnonzero(~np.isfinite(xy).all(axis=1))[0])
        u, v = spots.uv_px[index]
        raise CalibrationError(f"spot {index + 1} at ({u:.1f}, {v:.1f}) px is outside of what the lens maps")
    groups = groups_of(labels, base_T_ee)
    refiner = _Refiner(camera, base_T_ee, spots.covariance_px, lens if refine_lens else None, pose_noise)
    fault: CalibrationError | None = None
    try:
        found = _with_candidates(refiner, spots, solve(xy, base_T_ee, groups))
    except CalibrationError as error:
        fault = error
    if fault is not None or found.refined.used.mean() < LEAST_AGREEING or found.refined.scale_px >= SUSPECT_PX:
        check_reading(camera, base_T_ee, spots.uv_px, fault)
    if fault is not None:
        raise fault
    _check_agreement(found.refined, camera.width_px)
    _check_sizes(found.refined)
    refined = found.refined
    if lens is not None and not refine_lens:
        problem = SpotProblem(camera, base_T_ee, found.uv_px, spots.covariance_px, lens=lens, pose_noise=pose_noise)
        refined = with_held_lens(refined, problem, lens)
    large = (_LARGE.format(refined.scale_px),) if refined.scale_px >= SUSPECT_PX else ()
    return replace(found, refined=refined, warnings=(*contradictions(refined.used, groups), *large))


def groups_of(labels: Sequence[str] | None, base_T_ee: Array) -> list[NDArray[np.intp]]:
    """Orientation groups from labels, or from the poses.  Raises :class:`CalibrationError` if samples with one label
    have different orientations.
    """
    if labels is None:
        return orientation_groups(base_T_ee)
    out = []
    for label in dict.fromkeys(labels):
        members = np.flatnonzero(np.array([other == label for other in labels]))
        if len(orientation_groups(base_T_ee[members], MOST_TURN_RAD)) > 1:
            raise CalibrationError(
                f"the end-effector turns within group {label}; groups of shifts without turning, or no groups: they "
                "are found from the poses"
            )
        out.append(members)
    return out


@dataclass(frozen=True, slots=True)
class _Refiner:
    """Everything that a refinement needs beside the spots themselves and a start."""

    camera: Camera
    base_T_ee: Array
    covariance_px: Array | None
    lens: GivenCamera | None
    pose_noise: PoseNoise | None

    def refine(self, uv_px: Array, start: LaserSetup) -> Refined:
        if self.pose_noise is None or self.covariance_px is not None:
            return refine(self._problem(uv_px, self.covariance_px, self.pose_noise), start)
        # The arm's noise is given in metres: the rest of the residuals is the spots' own noise.
        found = refine(self._problem(uv_px, None, None), start)
        sigma_px = found.scale
        for _ in range(_NOISE_ROUNDS):
            noise = np.tile(sigma_px**2 * np.eye(2), (len(uv_px), 1, 1))
            found = refine(self._problem(uv_px, noise, self.pose_noise), found.setup)
            if abs(found.scale - 1.0) < 0.03 or sigma_px <= LEAST_NOISE_PX:
                break
            sigma_px = max(sigma_px * min(found.scale, 1.0) ** 2, LEAST_NOISE_PX)
        return found

    def _problem(self, uv_px: Array, covariance_px: Array | None, pose_noise: PoseNoise | None) -> SpotProblem:
        return SpotProblem(self.camera, self.base_T_ee, uv_px, covariance_px, lens=self.lens, pose_noise=pose_noise)


def _with_candidates(refiner: _Refiner, spots: Spots, start: LaserSetup) -> LaserResult:
    """Refine; where a reflection is brighter than the spot, with the candidate nearest to the prediction."""
    uv_px, choice = spots.uv_px, np.zeros(len(spots.uv_px), dtype=np.intp)
    found = refiner.refine(uv_px, start)
    for _ in range(_CANDIDATE_ROUNDS if spots.others else 0):
        predicted = uv_px - found.residuals_px
        new, new_choice = spots.uv_px.copy(), np.zeros_like(choice)
        for k in np.flatnonzero(~found.used):
            candidates = np.concatenate([spots.uv_px[k][None], spots.others[k].reshape(-1, 2)])
            nearest = int(np.linalg.norm(candidates - predicted[k], axis=1).argmin())
            new[k], new_choice[k] = candidates[nearest], nearest
        kept = found.used & (choice > 0)
        new[kept], new_choice[kept] = uv_px[kept], choice[kept]
        if (new_choice == choice).all():
            break
        uv_px, choice = new, new_choice
        found = refiner.refine(uv_px, found.setup)
    return LaserResult(found, uv_px, choice)


def _check_sizes(found: Refined) -> None:
    """Reject implausible sizes.  Positions in another unit fit as well: they scale the distances of camera, plane and
    laser, and the image doesn't change.  Only implausible sizes reveal it.
    """
    setup = found.setup
    if setup.distance_cam_m > FARTHEST_PLANE_M:
        raise CalibrationError(
            f"the plane would be {setup.distance_cam_m:.4g} m from the camera: are the poses in millimetres? metres"
        )
    if setup.distance_cam_m < NEAREST_PLANE_M:
        raise CalibrationError(
            f"the plane would be {1e3 * setup.distance_cam_m:.4g} mm from the camera: were metres divided once too "
            "often? metres"
        )
    offset = float(np.linalg.norm(np.cross(setup.point_ee_m, setup.direction_ee)))
    sigma = float(np.sqrt(found.covariance.diagonal()[LASER][2:].max()))
    if offset - 3.0 * sigma > FARTHEST_LASER_M:
        raise CalibrationError(
            f"the laser's line would pass the end-effector's origin at {offset:.3g} m: are the poses in centimetres or "
            "inches, or of another frame than the hand's? metres, base_T_ee"
        )


def _check_agreement(refined: Refined, width_px: int) -> None:
    if refined.used.mean() < LEAST_AGREEING:
        raise CalibrationError(
            f"only {int(refined.used.sum())} of {len(refined.used)} spots agree with each other: wrong spots, poses of "
            "other images, or a camera that is another one; each spot with the pose that it was seen at"
        )
    if refined.scale_px > LARGEST_NOISE_SHARE * width_px:
        raise CalibrationError(
            f"the spots don't fit the poses: residuals of {refined.scale_px:.3g} px; each spot with the pose that it "
            "was seen at, base_T_ee in metres, the camera that took the images"
        )


def contradictions(used: NDArray[np.bool_], groups: Sequence[NDArray[np.intp]]) -> tuple[str, ...]:
    """A line for each orientation most of whose spots aren't ``used`` (n,); ``groups`` holds each orientation's
    members.  Raises :class:`CalibrationError` if too few orientations agree to tell which are right.
    """

    def where(members: NDArray[np.intp]) -> str:
        wrong = len(members) - int(used[members].sum())
        return f"{wrong} of its {len(members)} spots left out, spots {members.min() + 1} to {members.max() + 1}"

    counted = [members for members in groups if len(members) >= FEWEST_SHIFTS]
    against = [members for members in counted if used[members].mean() < LEAST_OF_ORIENTATION]
    left = len(counted) - len(against)
    if against and (left < FEWEST_ORIENTATIONS or len(against) > MOST_CONTRADICTING * len(counted)):
        raise CalibrationError(
            f"{len(against)} of {len(counted)} orientations contradict the others ({where(against[0])}): the "
            "hand turned or the plane moved between them, spots beside the plane, or another camera's file; "
            f"at least {FEWEST_ORIENTATIONS} orientations that agree, and twice as many as don't"
        )
    return tuple(
        f"an orientation contradicts the others: {where(members)}; this calibration holds if it is that one "
        "which is wrong (spots beside the plane, a pose that was misread)"
        for members in against
    )


def check_reading(camera: Camera, base_T_ee: Array, uv_px: Array, fault: CalibrationError | None) -> None:
    """Raise :class:`CalibrationError` if the spots (n, 2) fit another reading of the poses (n, 4, 4); ``fault`` is the
    failure under the given reading.
    """
    for poses, part, wrong, right in _readings(base_T_ee):
        try:
            start = solve(camera.undistort(uv_px[part]), poses)
            found = refine(SpotProblem(camera, poses, uv_px[part]), start)
        except CalibrationError:
            continue
        if found.used.mean() > LEAST_FITTING and found.scale < SUSPECT_PX:
            agree = f"{int(found.used.sum())} of {len(poses)} agree, {found.scale:.2g} px"
            raise CalibrationError(f"{wrong} ({agree}); {right}") from fault


def _readings(base_T_ee: Array) -> Iterator[tuple[Array, slice, str, str]]:
    """Other readings: poses, the spots that belong to them, what is wrong if the spots fit, and what would be right."""
    everything = slice(None)
    yield np.linalg.inv(base_T_ee), everything, "the poses are ee_T_base: inverted, the spots fit", "base_T_ee"
    text = "the quaternions have w first: read so, the spots fit"
    yield w_first(base_T_ee), everything, text, "qx, qy, qz, qw, in this order"
    text, turned = "the rotations are the other way round: inverted, the spots fit", base_T_ee.copy()
    turned[:, :3, :3] = base_T_ee[:, :3, :3].transpose(0, 2, 1)
    yield turned, everything, text, "base_R_ee"
    for rows, poses, spots in out_of_step(len(base_T_ee)):
        text = f"poses and images are out of step: spots fit the poses {rows}"
        yield base_T_ee[poses], spots, text, "each spot with its own pose"
