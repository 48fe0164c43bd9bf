"""From spots and poses to a refined set-up: start, refinement, other candidates, and why it can't be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.robot_world import OFFSETS
from gripmon.calibrate.sighting import CalibrationError
from gripmon.laser.closed_form import FEWEST_ORIENTATIONS, FEWEST_SHIFTS, orientation_groups, solve
from gripmon.laser.refinement import PoseNoise, Refined, SpotProblem, refine, with_held_lens
from gripmon.laser.setup import (
    NAMES,
    LaserCalibration,
    LaserLine,
    LaserResiduals,
    LaserSetup,
    Plane,
    _vector,
    pose_jacobian,
)
from gripmon.laser.world import LEAST_NOISE_PX
from gripmon.model.camera import Camera
from gripmon.model.geometry import invert, to_record
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array

FARTHEST_PLANE_M = 50.0
NEAREST_PLANE_M = 0.01
FARTHEST_LASER_M = 1.0
"""Of the beam's line from the end-effector's origin: no hand holds it farther off."""
LEAST_AGREEING = 0.5
"""Part of the spots that has to agree: with fewer, another set-up might explain as many."""
MOST_TURN_RAD = 0.02
"""Of samples that share an orientation by their labels: more than an arm's noise."""
LARGEST_NOISE_SHARE = 0.01
"""The spots' noise over the image's width beyond which they aren't explained at all."""
LEAST_OF_ORIENTATION = 0.5
"""Part of an orientation's spots that has to agree: scattered wrong spots leave more, so that the orientation itself
contradicts the others.
"""
MOST_CONTRADICTING = 1.0 / 3.0
"""Part of the orientations that may contradict the rest: beyond it no one knows which are right."""
_NOISE_ROUNDS = 8


@dataclass(frozen=True, slots=True)
class Spots:
    """``uv_px`` (n, 2) and ``covariance_px`` (n, 2, 2) or None; ``others`` one (k, 2) a sample, further candidates."""

    uv_px: Array
    covariance_px: Array | None = None
    others: tuple[Array, ...] = ()


@dataclass(frozen=True, slots=True)
class LaserResult:
    """The closed form's ``start``, what it was ``refined`` to, and which ``candidate`` was taken of each sample
    (n,): 0 is the brightest.  ``warnings`` name orientations that contradict the rest.
    """

    start: LaserSetup
    refined: Refined
    uv_px: Array
    candidate: NDArray[np.intp]
    warnings: tuple[str, ...] = ()


def groups_of(labels: Sequence[str] | None, base_T_ee: Array) -> list[NDArray[np.intp]]:
    """Orientation groups from labels, or from the poses.  Raises :class:`CalibrationError` where a label's samples are
    turned against each other.
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
    """Everything at once.  What isn't known of the ``lens`` comes into the covariance; without ``refine_lens`` the lens
    itself stays as it is.  Raises :class:`CalibrationError` with what is wrong with the data.
    """
    xy = camera.undistort(spots.uv_px)
    if not np.isfinite(xy).all():
        index = int(np.flatnonzero(~np.isfinite(xy).all(axis=1))[0])
        u, v = spots.uv_px[index]
        raise CalibrationError(f"spot {index + 1} at ({u:.1f}, {v:.1f}) px is outside of what the lens maps")
    groups = groups_of(labels, base_T_ee)
    fault: CalibrationError | None = None
    try:
        start = solve(xy, base_T_ee, groups)
        found = _refined(camera, base_T_ee, spots, start, lens if refine_lens else None, pose_noise)
    except CalibrationError as error:
        fault = error
    sound = fault is None and found.refined.used.mean() >= LEAST_AGREEING
    if not sound or found.refined.scale_px >= SUSPECT_PX:
        check_reading(camera, base_T_ee, spots.uv_px, fault)
    if fault is not None:
        raise fault
    _check_sizes(found.refined)
    _check_agreement(found.refined, camera.width_px)
    refined = found.refined
    if lens is not None and not refine_lens:
        problem = SpotProblem(camera, base_T_ee, found.uv_px, spots.covariance_px, lens=lens, pose_noise=pose_noise)
        refined = with_held_lens(refined, problem, lens)
    return replace(found, refined=refined, warnings=contradictions(refined.used, groups))


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
    """A line for each orientation most of whose spots aren't ``used`` (n,), where ``groups`` are the orientations'
    members.  Raises :class:`CalibrationError` where too few are left for anybody to know which are right.
    """
    counted = [members for members in groups if len(members) >= FEWEST_SHIFTS]
    against = [members for members in counted if used[members].mean() < LEAST_OF_ORIENTATION]
    left = len(counted) - len(against)
    if against and (left < FEWEST_ORIENTATIONS or len(against) > MOST_CONTRADICTING * len(counted)):
        raise CalibrationError(
            f"{len(against)} of {len(counted)} orientations contradict the others ({_where(against[0], used)}): the "
            "hand turned or the plane moved between them, spots beside the plane, or another camera's file; "
            f"at least {FEWEST_ORIENTATIONS} orientations that agree, and twice as many as don't"
        )
    return tuple(
        f"an orientation contradicts the others: {_where(members, used)}; this calibration holds if it is that one "
        "which is wrong (spots beside the plane, a pose that was misread)"
        for members in against
    )


def _where(members: NDArray[np.intp], used: NDArray[np.bool_]) -> str:
    wrong = len(members) - int(used[members].sum())
    return f"{wrong} of its {len(members)} spots left out, spots {members.min() + 1} to {members.max() + 1}"


def _refined(
    camera: Camera,
    base_T_ee: Array,
    spots: Spots,
    start: LaserSetup,
    lens: GivenCamera | None,
    pose_noise: PoseNoise | None,
) -> LaserResult:
    def solved(uv_px: Array, setup: LaserSetup) -> Refined:
        noise = spots.covariance_px
        problem = SpotProblem(camera, base_T_ee, uv_px, noise, lens=lens, pose_noise=pose_noise)
        if pose_noise is None or noise is not None:
            return refine(problem, setup)
        return _separated(problem, uv_px, refine(SpotProblem(camera, base_T_ee, uv_px, lens=lens), setup))

    def _separated(problem: SpotProblem, uv_px: Array, found: Refined) -> Refined:
        # The arm's noise is given in metres: the spots' own is what is left of the residuals.
        sigma_px = found.scale
        for _ in range(_NOISE_ROUNDS):
            noise = np.tile(sigma_px**2 * np.eye(2), (len(uv_px), 1, 1))
            problem = SpotProblem(camera, base_T_ee, uv_px, noise, lens=lens, pose_noise=pose_noise)
            found = refine(problem, found.setup)
            if abs(found.scale - 1.0) < 0.03 or sigma_px <= LEAST_NOISE_PX:
                break
            sigma_px = max(sigma_px * min(found.scale, 1.0) ** 2, LEAST_NOISE_PX)
        return found

    uv_px, choice = spots.uv_px, np.zeros(len(spots.uv_px), dtype=np.intp)
    found = solved(uv_px, start)
    for _ in range(3 if spots.others else 0):
        # A reflection may be brighter than the spot: the candidate that the rest predicts takes its place.
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
        found = solved(uv_px, found.setup)
    return LaserResult(start, found, uv_px, choice)


def _check_sizes(found: Refined) -> None:
    """Positions in another unit fit as well: camera, plane and laser then are as many times too far, and the image says
    nothing of it.  Only sizes that no cell has do.
    """
    setup = found.setup
    if setup.distance_m > FARTHEST_PLANE_M:
        raise CalibrationError(
            f"the plane would be {setup.distance_m:.4g} m from the camera: are the poses in millimetres? metres"
        )
    if setup.distance_m < NEAREST_PLANE_M:
        raise CalibrationError(
            f"the plane would be {1e3 * setup.distance_m:.4g} mm from the camera: were metres divided once too often? "
            "metres"
        )
    across = setup.point_ee_m - setup.direction_ee * float(setup.point_ee_m @ setup.direction_ee)
    offset, sigma = float(np.linalg.norm(across)), float(np.sqrt(found.covariance.diagonal()[11:13].max()))
    if offset - 3.0 * sigma > FARTHEST_LASER_M:
        raise CalibrationError(
            f"the laser's line would pass the end-effector's origin at {offset:.3g} m: are the poses in centimetres or "
            "inches, or of another frame than the hand's? metres, base_T_ee"
        )


SUSPECT_PX = 3.0
"""Noise of spots from which it is asked whether the poses are what they are taken for."""
LEAST_FITTING = 0.7
"""Part of the spots that has to fit another reading before it is named."""


def check_reading(camera: Camera, base_T_ee: Array, uv_px: Array, fault: CalibrationError | None) -> None:
    """Raise :class:`CalibrationError` with the reading of poses (n, 4, 4) that spots (n, 2) fit, if there is one;
    ``fault`` is what was wrong with the reading that was taken.
    """
    xy = camera.undistort(uv_px)
    for poses, part, said in _readings(base_T_ee):
        try:
            found = refine(SpotProblem(camera, poses, uv_px[part]), solve(xy[part], poses))
        except CalibrationError:
            continue
        if found.used.mean() > LEAST_FITTING and found.scale < SUSPECT_PX:
            agree = f"{int(found.used.sum())} of {len(poses)} agree, {found.scale:.2g} px"
            raise CalibrationError(said.format(agree=agree)) from fault


def _readings(base_T_ee: Array) -> Iterator[tuple[Array, slice, str]]:
    """Poses, the spots that belong to them, and what there is to say with how well they fit."""
    everything = slice(None)
    inverted = np.stack([invert(pose) for pose in base_T_ee])
    yield inverted, everything, "the poses are ee_T_base: inverted, the spots fit ({agree}); base_T_ee"
    quaternions = Rotation.from_matrix(base_T_ee[:, :3, :3]).as_quat()
    reordered = base_T_ee.copy()
    reordered[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    yield (
        reordered,
        everything,
        ("the quaternions have w first: read so, the spots fit ({agree}); qx, qy, qz, qw, in this order"),
    )
    transposed = base_T_ee.copy()
    transposed[:, :3, :3] = base_T_ee[:, :3, :3].transpose(0, 2, 1)
    yield (
        transposed,
        everything,
        ("the rotations are the other way round: inverted, the spots fit ({agree}); base_R_ee"),
    )
    for offset in OFFSETS:
        count = len(base_T_ee) - abs(offset)
        own = slice(max(offset, 0), max(offset, 0) + count)
        other = slice(max(-offset, 0), max(-offset, 0) + count)
        which = "later" if offset > 0 else "earlier"
        yield (
            base_T_ee[own],
            other,
            (
                f"poses and images are out of step: spots fit the poses {abs(offset)} row(s) {which} ({{agree}}); each "
                "spot with its own pose"
            ),
        )


def base_covariance(refined: Refined) -> Array:
    """(13, 13) of :data:`NAMES`."""
    change = np.eye(len(NAMES))
    change[:6, :6] = pose_jacobian(refined.setup.cam_T_base)
    out: Array = change @ refined.covariance @ change.T
    return out


def document(
    refined: Refined, names: tuple[str, ...], orientations: int, warnings: tuple[str, ...], provenance: Provenance
) -> LaserCalibration:
    """What is written of a result."""
    setup, covariance = refined.setup, base_covariance(refined)
    base_T_cam = invert(setup.cam_T_base)
    normal_base = base_T_cam[:3, :3] @ setup.normal_cam
    sigmas = np.sqrt(covariance.diagonal())
    return LaserCalibration(
        camera=refined.camera,
        base_T_cam=to_record(base_T_cam),
        plane=Plane(
            normal_cam=_vector(setup.normal_cam),
            distance_cam_m=setup.distance_m,
            normal_base=_vector(normal_base),
            distance_base_m=setup.distance_m + float(normal_base @ base_T_cam[:3, 3]),
        ),
        laser=LaserLine(point_ee_m=_vector(setup.point_ee_m), direction_ee=_vector(setup.direction_ee)),
        parameters=NAMES,
        sigmas=dict(zip(NAMES, sigmas.tolist(), strict=True)),
        covariance=tuple(covariance.ravel().tolist()),
        residuals=LaserResiduals(
            rms_px=refined.rms_px,
            sigma_px=refined.scale_px,
            spots=len(names),
            used=int(refined.used.sum()),
            orientations=orientations,
            degrees_of_freedom=refined.degrees_of_freedom,
            outliers=tuple(name for name, used in zip(names, refined.used, strict=True) if not used),
        ),
        warnings=warnings,
        provenance=provenance,
    )
