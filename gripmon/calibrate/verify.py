"""Comparison of two calibrations: their difference with its uncertainty, and its probability by chance.

Both are taken as independent.  What they share (a camera calibration, a plate) cancels in the difference but not in the
sum of their covariances, so that differences then look less significant than they are, never more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from gripmon.calibrate.bundle import GivenCamera, independent_errors
from gripmon.calibrate.documents import CalibratedGripper
from gripmon.calibrate.lens_models import lens_vector
from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.camera import LensSettings, make_camera, same_lens
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, perturb, perturbation_between, skew
from gripmon.model.least_squares import whitening
from gripmon.model.records import Array, Transform

CHANCE = 1e-3
"""Probability that two measurements of one pose are called different."""
NEGLIGIBLE_PX = 1e-3
"""Difference (px) below which two cameras count as the same, however certain they are."""
_GRID = 25
_DRAWS = 4000
_SEED = 7


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration to compare, with its ``name``: a ``lens`` with the covariance of its ``parameters``, a
    ``cam_T_grip`` with ``covariance`` (36), or both; ``kind`` is where it comes from, ``target`` what it was
    made with, if that is known, ``notes`` describe its origin for people, ``pose_notes`` add to the transform's;
    ``with_gripper``: the gripper file was made of the same images.  ``frame``: which one ``cam_T_grip`` is of, where
    the file doesn't say where the TCP is in it; empty: the gripper's, at the TCP.
    """

    name: str
    kind: str
    lens: LensSettings | None = None
    parameters: tuple[str, ...] = ()
    lens_covariance: tuple[float, ...] = ()
    cam_T_grip: Transform | None = None
    covariance: tuple[float, ...] = ()
    with_gripper: bool = False
    gripper: CalibratedGripper | None = None
    jaw_opening_m: float | None = None
    target: str | None = None
    notes: tuple[str, ...] = ()
    pose_notes: tuple[str, ...] = ()
    frame: str = ""


@dataclass(frozen=True, slots=True)
class HandEyeDifference:
    """Difference of two ``cam_T_grip``, second against first: the TCP's ``position_m`` (3,) and the ``rotation_rad``
    (3,) vector along the camera's axes, with standard deviations.

    ``p_value``: probability of a ``chi2`` as large if both are the same, ``position_p_value`` and ``rotation_p_value``
    those of the parts alone.
    """

    position_m: Array
    position_sigma_m: Array
    rotation_rad: Array
    rotation_sigma_rad: Array
    chi2: float
    p_value: float
    position_p_value: float
    rotation_p_value: float
    degrees_of_freedom: int = 6
    kind: str = "hand_eye"


def compare_hand_eye(
    a_cam_T_grip: Array, a_covariance: Array, b_cam_T_grip: Array, b_covariance: Array
) -> HandEyeDifference:
    """Compare transforms (4, 4) with the covariances (6, 6) of their errors (position, then rotation, camera axes; m,
    rad).

    If there is no difference, ``xi = perturbation_between(a, b)`` has the covariance ``A + B`` to first order, and
    ``xiᵀ (A + B)⁻¹ xi`` is chi-square with six degrees of freedom.  :class:`CalibrationError` for invalid covariances,
    or if their sum leaves a direction exactly known.
    """
    for name, matrix in (("first", a_covariance), ("second", b_covariance)):
        if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0):
            raise CalibrationError(f"the {name} covariance isn't symmetric; one of errors")
    xi, covariance = perturbation_between(a_cam_T_grip, b_cam_T_grip), a_covariance + b_covariance
    whole, position, rotation = (
        _chi2(xi[part], covariance[part, part]) for part in (slice(6), slice(3), slice(3, 6))
    )
    sigma = np.sqrt(covariance.diagonal())
    return HandEyeDifference(
        position_m=xi[:3],
        position_sigma_m=sigma[:3],
        rotation_rad=xi[3:],
        rotation_sigma_rad=sigma[3:],
        chi2=whole,
        p_value=float(chdtrc(6, whole)),
        position_p_value=float(chdtrc(3, position)),
        rotation_p_value=float(chdtrc(3, rotation)),
    )


def _chi2(difference: Array, covariance: Array) -> float:
    sigma = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    if not (sigma > 0.0).all():
        raise CalibrationError("the uncertainties are zero or negative; covariances of the errors")
    # In units of the standard deviations: with metres and radians any matrix would look singular.
    try:
        root = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
    except np.linalg.LinAlgError:
        raise CalibrationError("the uncertainties leave a direction exactly known; full covariances") from None
    return float(np.sum(np.square(np.linalg.solve(root, difference / sigma))))


def mean_of_one_scene(cam_T_grip: Sequence[Array], covariances: Sequence[Array]) -> tuple[Array, Array]:
    """Mean (4, 4) of measurements of one pose, and their mean covariance (6, 6): the causes of errors, such as
    background, light and lens, are the same in all images, so that more images don't reduce the uncertainty.
    """
    mean = cam_T_grip[0]
    for _ in range(3):
        mean = perturb(mean, np.mean([perturbation_between(mean, T) for T in cam_T_grip], axis=0))
    return mean, np.mean(covariances, axis=0)


def agreeing(cam_T_grip: Sequence[Array], covariances: Sequence[Array]) -> NDArray[np.bool_]:
    """The largest set (n,) of measurements of one pose that all agree with one of them, pairwise: they differ no more
    than equal ones do in all but :data:`CHANCE` of the cases.
    """
    count = len(cam_T_grip)
    apart = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            xi = perturbation_between(cam_T_grip[i], cam_T_grip[j])
            apart[i, j] = apart[j, i] = _chi2(xi, np.asarray(covariances[i]) + np.asarray(covariances[j]))
    agree = apart < chdtri(6, CHANCE)
    # Among sets of equal size take the tighter one.
    spread = np.where(agree, apart, 0.0).sum(axis=1)
    best = np.lexsort((spread, -agree.sum(axis=1)))[0]
    out: NDArray[np.bool_] = agree[best]
    return out


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether two calibrations are the ``same``: their difference isn't significant at the ``level`` of false alarms,
    or is ``within`` the tolerance.  ``warnings``: what else may explain it.
    """

    same: bool
    within: bool
    level: float
    difference: HandEyeDifference | CameraDifference
    warnings: tuple[str, ...] = ()

    def values(self) -> dict[str, Any]:
        """As plain values: m, rad, px."""
        parts = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in asdict(self.difference).items()}
        verdict = {"within_tolerance": self.within, "same": self.same, "level": self.level}
        return {**parts, **verdict, "warnings": list(self.warnings)}


def verify(
    first: Calibrated,
    second: Calibrated,
    *,
    level: float = 0.01,
    tolerance_m: float | None = None,
    tolerance_rad: float | None = None,
    tolerance_px: float | None = None,
) -> Verdict:
    """Compare two hand/eye calibrations, or two cameras, by their uncertainties.  ``tolerance_m`` and ``tolerance_rad``
    (shift of the TCP and rotation), or ``tolerance_px`` (anywhere in the image): differences that don't matter, however
    significant.  :class:`~gripmon.model.errors.InputError` for calibrations that can't be compared.
    """
    try:
        if first.cam_T_grip is not None and second.cam_T_grip is not None:
            if tolerance_px is not None:
                raise InputError("--tolerance-px: is for two cameras; leave it out")
            return _hand_eyes(first, second, level, tolerance_m, tolerance_rad)
        if first.lens is not None and second.lens is not None:
            if tolerance_m is not None or tolerance_rad is not None:
                raise InputError("--tolerance-mm: is for hand/eye calibrations; leave it out")
            return _cameras(first, second, level, tolerance_px)
    except CalibrationError as error:
        raise InputError(f"calibrate verify: {first.name} and {second.name}: {error}") from None
    raise InputError(f"{first.name} is {first.kind}, {second.name} is {second.kind}; two of one kind")


def _hand_eyes(
    first: Calibrated, second: Calibrated, level: float, tolerance_m: float | None, tolerance_rad: float | None
) -> Verdict:
    assert first.cam_T_grip is not None and second.cam_T_grip is not None
    if first.frame != second.frame:
        of = " and ".join(f"{each.name} that of {each.frame or 'the TCP'}" for each in (first, second))
        raise InputError(f"two poses of different frames: {of}; flange_T_tcp in the imported file")
    warnings = []
    if first.lens is not None and second.lens is not None and not same_lens(first.lens, second.lens):
        warnings.append("made with different camera calibrations, which may explain a difference")
    if first.gripper is not None and second.gripper is not None and first.gripper != second.gripper:
        warnings.append(f"made with different gripper files ({first.gripper.name}, {second.gripper.name})")
    found = compare_hand_eye(
        from_record(first.cam_T_grip),
        np.reshape(first.covariance, (6, 6)),
        from_record(second.cam_T_grip),
        np.reshape(second.covariance, (6, 6)),
    )
    within = (
        tolerance_m is not None
        and tolerance_rad is not None
        and float(np.linalg.norm(found.position_m)) <= tolerance_m
        and float(np.linalg.norm(found.rotation_rad)) <= tolerance_rad
    )
    return Verdict(found.p_value >= level or within, within, level, found, tuple(warnings))


def _cameras(first: Calibrated, second: Calibrated, level: float, tolerance_px: float | None) -> Verdict:
    calibrated = []
    for one in (first, second):
        assert one.lens is not None
        count = len(one.parameters)
        calibrated.append(GivenCamera(one.lens, one.parameters, np.reshape(one.lens_covariance, (count, count))))
    found = compare_cameras(*calibrated)
    within = found.largest_px <= max(tolerance_px or 0.0, NEGLIGIBLE_PX)
    if found.p_value is None and tolerance_px is None and not within:
        raise InputError(
            f"{first.name} and {second.name}: up to {found.largest_px:.3g} px apart, and neither says how certain it "
            "is; --tolerance-px PX for a difference that doesn't matter"
        )
    return Verdict(within or (found.p_value is not None and found.p_value >= level), within, level, found)


@dataclass(frozen=True, slots=True)
class CameraDifference:
    """The difference of two cameras' mappings: where the second one shows what the first one shows at a pixel.

    ``largest_px`` with its standard deviation along the difference, at ``at_px`` (2,) of the first image; ``rms_px``
    over the image.  ``turn_rad`` (3,): the rotation of the camera about its axes that explains most of it, and
    ``largest_turned_px`` the largest difference after it: a hand/eye calibration made with each would absorb that
    rotation.  ``p_value``: probability by chance of the most significant difference in the image; None, like
    ``largest_sigma_px``, if neither camera's uncertainty is known.  ``compared``: share of the image that both show.
    """

    largest_px: float
    largest_sigma_px: float | None
    at_px: Array
    rms_px: float
    turn_rad: Array
    largest_turned_px: float
    p_value: float | None
    compared: float
    kind: str = "camera"


def compare_cameras(a: GivenCamera, b: GivenCamera) -> CameraDifference:
    """Compare two cameras, also with different models; image sizes must be equal (:class:`CalibrationError`).

    At pixel u of a grid the difference is ``d = pi_b(pi_a⁻¹(u)) - u``, with covariance ``J_a A J_aᵀ + J_b B J_bᵀ`` to
    first order (J: derivative of the pixel by the parameters).  The statistic is the largest ``dᵀ cov⁻¹ d`` of the
    grid; its distribution without a difference is sampled with random parameter errors, with a fixed seed.
    """
    size = (a.lens.width_px, a.lens.height_px)
    if size != (b.lens.width_px, b.lens.height_px):
        raise CalibrationError(
            f"images of {size[0]} x {size[1]} px and of {b.lens.width_px} x {b.lens.height_px} px; one camera in "
            "one size"
        )
    camera_a, camera_b = make_camera(a.lens), make_camera(b.lens)
    grid_px = np.stack(np.meshgrid(*(np.linspace(0.0, n - 1.0, _GRID) for n in size)), axis=-1).reshape(-1, 2)
    xy = camera_a.undistort(grid_px)
    apart_px = np.full_like(grid_px, np.nan)
    shown = np.isfinite(xy).all(axis=1)
    apart_px[shown] = camera_b.distort(xy[shown]) - grid_px[shown]
    both = np.isfinite(apart_px).all(axis=1)
    if np.count_nonzero(both) < 0.5 * len(grid_px):
        raise CalibrationError("less than half of the image is seen by both lens models; calibrations of one camera")
    uv_px, apart_px = grid_px[both], apart_px[both]
    rays = np.column_stack([xy[both], np.ones(len(uv_px))])
    roots = np.concatenate([_root(a, rays), -_root(b, rays)], axis=2)
    length = np.linalg.norm(apart_px, axis=1)
    worst = int(np.argmax(length))
    along = apart_px[worst] / max(length[worst], 1e-300)
    known = roots.shape[2] > 0
    # A turn of the camera by omega moves a ray p by omega x p.
    by_turn = (-camera_b.project_with_jacobian(rays)[1] @ skew(rays)).reshape(-1, 3)
    turn_rad: Array = np.linalg.lstsq(by_turn, apart_px.ravel(), rcond=None)[0]
    left_px = apart_px - (by_turn @ turn_rad).reshape(-1, 2)
    return CameraDifference(
        largest_px=float(length[worst]),
        largest_sigma_px=float(np.linalg.norm(along @ roots[worst])) if known else None,
        at_px=uv_px[worst],
        rms_px=float(np.sqrt(np.mean(np.square(length)))),
        turn_rad=turn_rad,
        largest_turned_px=float(np.linalg.norm(left_px, axis=1).max()),
        p_value=_chance(apart_px, roots) if known else None,
        compared=len(uv_px) / len(grid_px),
    )


def _root(calibrated: GivenCamera, rays: Array) -> Array:
    """(n, 2, p): effect of independent unit errors in the parameters on each pixel."""
    if calibrated.covariance is None or not calibrated.parameters:
        return np.zeros((len(rays), 2, 0))
    _, by_parameters, _ = calibrated.model.project(lens_vector(calibrated.lens), rays)
    out: Array = by_parameters @ calibrated.free @ independent_errors(calibrated.covariance).T
    return out


def _chance(apart_px: Array, roots: Array) -> float:
    """Probability of a largest ``dᵀ cov⁻¹ d`` as large as that of ``apart_px`` (n, 2), by sampling errors with the
    effects ``roots`` (n, 2, p).
    """
    # Directions that neither camera left free have no variance: add a thousandth of a pixel.
    inverse_root = whitening(roots @ roots.transpose(0, 2, 1) + NEGLIGIBLE_PX**2 * np.eye(2))
    observed = np.square(inverse_root @ apart_px[:, :, None]).sum(axis=(1, 2)).max()
    whitened = inverse_root @ roots
    draws = np.random.default_rng(_SEED).standard_normal((whitened.shape[2], _DRAWS))
    largest = np.zeros(_DRAWS)
    for place in whitened:
        np.maximum(largest, np.square(place @ draws).sum(axis=0), out=largest)
    return float((1 + np.count_nonzero(largest >= observed)) / (1 + _DRAWS))
