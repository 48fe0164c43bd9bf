"""Robot-world and hand-eye calibration together, from a target on the hand and a fixed camera (or the reverse).

Dornaika and Horaud, "Simultaneous robot-world and hand-eye calibration" (IEEE Trans. Robotics and Automation, 1998):
for every pose ``cam_T_target = cam_T_base base_T_ee ee_T_target``, the first and the last unknown.  Closed form by
quaternions, then joint refinement.  A camera on the hand is the same with ``ee_T_base`` for ``base_T_ee``; the results
are then ``cam_T_ee`` and ``base_T_target``.

The arm's inaccuracy shows in what its poses leave unexplained beyond the targets' own covariances.  A target's pose
from one image is accurate to some hundredths of a millimetre, most arms aren't: weighted by the images alone, the poses
seen best would count far too much.  Two variances, of the arm's positions and rotations, are estimated by restricted
maximum likelihood (Patterson and Thompson, Biometrika 58, 1971).  An arm's errors act at its hand: with a camera on the
hand a wrong rotation shifts the target by its distance from the hand, however far the base is.

Errors of the camera's own calibration are the same in all images; they don't average out however many there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from gripmon.calibrate.sighting import CalibrationError
from gripmon.model.geometry import invert, make_transform, perturb, skew
from gripmon.model.least_squares import (
    TUKEY,
    covariance_of,
    minimise,
    normal_equations,
    robust_scale,
    tukey_weights,
    whitening,
)
from gripmon.model.records import Array

FEWEST_POSES = 3
LEAST_TURN_RAD = 5e-3
"""Minimum rotation of every direction of the end-effector (rad), root mean square over the orientations."""
FALSE_OUTLIERS = 0.05
"""Expected number of good poses in a whole data set that are left out."""
_ROUNDS, _ARM_ROUNDS = 20, 5
_LEAST_M, _LEAST_RAD = 1e-7, 1e-7
_MOST_M, _MOST_RAD = 0.1, 0.5
_STARTS = (1e-5, 2e-4, 3e-3)
FARTHEST_M = 20.0
"""Largest distance of a target from the camera, and of an arm from its base (m): larger numbers are millimetres."""
SUSPECT_RAD = 0.02
"""Residual rotation (rad, each axis) above which other readings of the poses are tried."""
LARGEST_RESIDUAL_RAD = 0.1
"""Residual rotation (rad, each axis) above the errors of any arm and camera."""
_OTHER_READING_SHARE = 0.1  # another reading must leave less than this part of the residual rotation,
_OTHER_READING_USED = 0.7  # and use at least this part of the poses
OFFSETS = (1, -1, 2, -2)
"""Offsets in rows between poses and images that are tried."""


@dataclass(frozen=True, slots=True)
class RobotWorld:
    """``covariance`` (12, 12) of ``cam_T_base`` and ``ee_T_target``, position then rotation each (axes of cam, of ee);
    ``residuals`` (n, 6), measured against predicted ``cam_T_target``, position (m) and rotation (rad), camera axes;
    ``used`` (n,).
    """

    cam_T_base: Array
    ee_T_target: Array
    covariance: Array
    residuals: Array
    used: NDArray[np.bool_]
    degrees_of_freedom: int

    @property
    def rms_m(self) -> float:
        """Root mean square of the used positions' residuals, each axis."""
        return float(np.sqrt(np.mean(np.square(self.residuals[self.used, :3]))))

    @property
    def rms_rad(self) -> float:
        """Root mean square of the used rotations' residuals, each axis."""
        return float(np.sqrt(np.mean(np.square(self.residuals[self.used, 3:]))))


def solve(cam_T_target: Array, base_T_ee: Array) -> tuple[Array, Array]:
    """Closed form from poses (n, 4, 4) each: ``cam_T_base`` and ``ee_T_target``.  Raises :class:`CalibrationError` for
    too few poses, or rotations about a single axis.
    """
    _check_turns(cam_T_target, base_T_ee)
    cam_R_base, target_R_ee = rotations(cam_T_target[:, :3, :3], base_T_ee[:, :3, :3])
    shift, back = translations(cam_T_target, base_T_ee, cam_R_base)
    return make_transform(cam_R_base, shift), invert(make_transform(target_R_ee, back))


def rotations(cam_R_target: Array, base_R_ee: Array) -> tuple[Array, Array]:
    """``cam_R_base`` and ``target_R_ee`` with ``cam_R_target target_R_ee = cam_R_base base_R_ee`` for all of (n, 3, 3).

    As quaternions ``Q(a) x = W(b) z``; the sum of squared differences under unit norms is smallest for the singular
    vectors of ``sum Q(a)ᵀ W(b)`` with the largest singular value.  A quaternion and its negative are the same rotation:
    signs are chosen by motions from the first pose, which have the same angle on both sides.
    """
    from scipy.spatial.transform import Rotation

    a = Rotation.from_matrix(cam_R_target).as_quat()
    b = Rotation.from_matrix(base_R_ee).as_quat()
    # Scalar part of q q_first⁻¹: the quaternions' inner product.
    b = b * np.where((a @ a[0]) * (b @ b[0]) < 0.0, -1.0, 1.0)[:, None]
    total = np.einsum("nji,njk->ik", _left(a), _right(b))
    left, _, right = np.linalg.svd(total)
    x, z = left[:, 0], right[0]
    return Rotation.from_quat(z).as_matrix(), Rotation.from_quat(x).as_matrix()


def translations(cam_T_target: Array, base_T_ee: Array, cam_R_base: Array) -> tuple[Array, Array]:
    """Positions (3,) of ``cam_T_base`` and ``target_T_ee``, linear least squares of
    ``cam_R_target x + cam_t_target = cam_R_base base_t_ee + z``.
    """
    count = len(cam_T_target)
    rows = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), -cam_T_target[:, :3, :3]], axis=2).reshape(-1, 6)
    sides = (cam_T_target[:, :3, 3] - base_T_ee[:, :3, 3] @ cam_R_base.T).ravel()
    found = np.linalg.lstsq(rows, sides, rcond=None)[0]
    return found[:3], found[3:]


def refine(
    cam_T_target: Array,
    base_T_ee: Array,
    start: tuple[Array, Array],
    covariance: Array | None = None,
    *,
    inexact_arm: bool = False,
    eye_in_hand: bool = False,
    common: Array | None = None,
) -> RobotWorld:
    """All twelve unknowns together, robustly.  ``covariance`` (n, 6, 6) of the measured ``cam_T_target`` (position then
    rotation, camera axes), up to a common scale; without it positions and rotations are weighted by their residuals.
    With an ``inexact_arm`` the arm's contribution to the covariances is estimated, too; ``eye_in_hand``: ``base_T_ee``
    are the arm's poses inverted.  ``common`` (n, 6, k): effect of each of k independent errors that all poses share,
    per standard deviation, on each of them; it is added to the covariance.
    """
    cam_T_base, ee_T_target = start
    count = len(cam_T_target)
    if 6 * count <= 12:
        raise CalibrationError(f"{count} pose(s); at least {FEWEST_POSES}, better ten")
    whiten = None if covariance is None else whitening(covariance)
    used = np.ones(count, dtype=bool)
    weights: Array = np.ones(count)
    sigmas: Array | None = None
    for turn in range(_ROUNDS):
        values = residuals(cam_T_target, base_T_ee, cam_T_base, ee_T_target)
        if covariance is not None and inexact_arm and turn < _ARM_ROUNDS:
            by_arm = arm_slopes(base_T_ee, cam_T_base, ee_T_target, eye_in_hand=eye_in_hand)
            rows = slopes(base_T_ee, cam_T_base, ee_T_target)
            sigmas = arm_sigmas(covariance, by_arm, rows, values, weights, sigmas)
            whiten = whitening(with_arm(covariance, by_arm, sigmas))
        root = whiten if whiten is not None else _weights_of(values[used])
        if count > FEWEST_POSES:
            sizes = _sizes(root, values)
            # Norms of six coordinates are typically sqrt(3) times those of two, to which TUKEY * scale is applied
            # elsewhere.
            weights = tukey_weights(sizes, TUKEY * _scale(sizes, 6) * float(np.sqrt(3.0)))
        before = cam_T_base, ee_T_target
        cam_T_base, ee_T_target = _minimise(cam_T_target, base_T_ee, before, root, weights)
        if (
            turn > _ARM_ROUNDS
            and np.allclose(before[0], cam_T_base, atol=1e-12)
            and np.allclose(before[1], ee_T_target, atol=1e-12)
        ):
            break
    sizes = _sizes(root, residuals(cam_T_target, base_T_ee, cam_T_base, ee_T_target))
    if count > FEWEST_POSES:
        # The unknowns reduce the residuals.
        left = np.sqrt(1.0 - 2.0 / count)
        used = sizes <= np.sqrt(chdtri(6, FALSE_OUTLIERS / count)) * _scale(sizes, 6) / left
    if used.sum() < FEWEST_POSES:
        raise CalibrationError(f"{int(used.sum())} of {count} poses agree with each other; at least {FEWEST_POSES}")
    cam_T_base, ee_T_target = _minimise(cam_T_target, base_T_ee, (cam_T_base, ee_T_target), root, used.astype(float))
    return _conclude(cam_T_target, base_T_ee, (cam_T_base, ee_T_target), root, used, common)


def residuals(cam_T_target: Array, base_T_ee: Array, cam_T_base: Array, ee_T_target: Array) -> Array:
    """(n, 6): measured against predicted ``cam_T_target``, position and rotation, camera axes."""
    from scipy.spatial.transform import Rotation

    predicted = cam_T_base @ base_T_ee @ ee_T_target
    out = np.empty((len(predicted), 6))
    out[:, :3] = cam_T_target[:, :3, 3] - predicted[:, :3, 3]
    out[:, 3:] = Rotation.from_matrix(cam_T_target[:, :3, :3] @ predicted[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return out


def slopes(base_T_ee: Array, cam_T_base: Array, ee_T_target: Array) -> Array:
    """Derivatives (n, 6, 12) of predicted ``cam_T_target`` by perturbations of ``cam_T_base`` and ``ee_T_target``."""
    predicted = cam_T_base @ base_T_ee @ ee_T_target
    cam_R_ee = cam_T_base[:3, :3] @ base_T_ee[:, :3, :3]
    out = np.zeros((len(predicted), 6, 12))
    out[:, :3, :3] = out[:, 3:, 3:6] = np.eye(3)
    out[:, :3, 3:6] = -skew(predicted[:, :3, 3] - cam_T_base[:3, 3])
    out[:, :3, 6:9] = out[:, 3:, 9:] = cam_R_ee
    return out


def _minimise(
    cam_T_target: Array, base_T_ee: Array, start: tuple[Array, Array], whiten: Array, weights: Array
) -> tuple[Array, Array]:
    def cost(at: tuple[Array, Array]) -> float:
        return float((weights * np.square(_sizes(whiten, residuals(cam_T_target, base_T_ee, *at)))).sum())

    def equations(at: tuple[Array, Array]) -> tuple[Array, Array]:
        values = (whiten @ residuals(cam_T_target, base_T_ee, *at)[:, :, None])[:, :, 0]
        return normal_equations(whiten @ slopes(base_T_ee, *at), values, weights)

    def moved(at: tuple[Array, Array], step: Array) -> tuple[Array, Array]:
        return perturb(at[0], step[:6]), perturb(at[1], step[6:])

    return minimise(start, cost, equations, moved, tolerance=1e-12, damping=1e-9).state


def arm_slopes(base_T_ee: Array, cam_T_base: Array, ee_T_target: Array, *, eye_in_hand: bool = False) -> Array:
    """(n, 6, 6): effect of errors of the arm's poses (position, then rotation about the hand's origin, camera axes) on
    the predicted ``cam_T_target``, up to a sign; ``eye_in_hand`` as in :func:`refine`.
    """
    hand = cam_T_base @ (np.eye(4) if eye_in_hand else base_T_ee)
    out = np.tile(np.eye(6), (len(base_T_ee), 1, 1))
    out[:, :3, 3:] = -skew((cam_T_base @ base_T_ee @ ee_T_target - hand)[:, :3, 3])
    return out


def arm_sigmas(
    covariance: Array, by_arm: Array, rows: Array, values: Array, weights: Array, before: Array | None
) -> Array:
    """Standard deviations (2,) of the arm's positions (m) and rotations (rad), each axis.

    ``covariance`` (n, 6, 6) of the targets' poses, ``by_arm`` (n, 6, 6) of :func:`arm_slopes`, ``rows`` (n, 6, k) the
    derivatives by the k unknowns, ``values`` (n, 6) the residuals, weighted per pose by ``weights`` (n,).  Starts at
    the values ``before``, if given.
    """
    from scipy.optimize import minimize

    scaled = rows / np.linalg.norm(rows.reshape(-1, rows.shape[2]), axis=0)

    def unlikely(log_sigmas: Array) -> float:
        matrix = with_arm(covariance, by_arm, np.exp(log_sigmas))
        inverse = np.linalg.inv(matrix)
        squares = np.einsum("ni,nij,nj->n", values, inverse, values)
        information = np.tensordot(scaled, weights[:, None, None] * (inverse @ scaled), axes=((0, 1), (0, 1)))
        return float((weights * (np.linalg.slogdet(matrix)[1] + squares)).sum() + np.linalg.slogdet(information)[1])

    bounds = [(np.log(_LEAST_M), np.log(_MOST_M)), (np.log(_LEAST_RAD), np.log(_MOST_RAD))]
    starts = [np.log([s, s]) for s in _STARTS] if before is None else [np.log(before)]
    found = [minimize(unlikely, start, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-6}) for start in starts]
    out: Array = np.exp(min(found, key=lambda each: each.fun).x)
    return out


def with_arm(covariance: Array, by_arm: Array, sigmas: Array) -> Array:
    """``covariance`` (n, 6, 6) plus the contribution of an arm's errors with standard deviations (2,), m and rad."""
    position, rotation = by_arm[:, :, :3] * sigmas[0], by_arm[:, :, 3:] * sigmas[1]
    out: Array = covariance + position @ position.transpose(0, 2, 1) + rotation @ rotation.transpose(0, 2, 1)
    return out


def _conclude(
    cam_T_target: Array,
    base_T_ee: Array,
    at: tuple[Array, Array],
    whiten: Array,
    used: NDArray[np.bool_],
    common: Array | None,
) -> RobotWorld:
    values = residuals(cam_T_target, base_T_ee, *at)
    freedom = 6 * int(used.sum()) - 12
    variance = max(float(np.square(_sizes(whiten, values)[used]).sum()) / freedom, 1e-18)
    rows = whiten @ slopes(base_T_ee, *at)
    normal, _ = normal_equations(rows[used], values[used])
    try:
        unscaled = covariance_of(normal)
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the poses leave a direction undetermined; poses turned about at least two axes, and shifted"
        ) from None
    covariance = variance * unscaled
    if common is not None:
        by_common = unscaled @ np.einsum("nij,nik->jk", rows[used], (whiten @ common)[used])
        covariance = covariance + by_common @ by_common.T
    return RobotWorld(at[0], at[1], covariance, values, used, freedom)


def check_target_scale(cam_T_target: Array) -> None:
    """ValueError for poses (n, 4, 4) of a target that is too far away for any camera."""
    far_m = float(np.median(np.linalg.norm(cam_T_target[:, :3, 3], axis=1)))
    if far_m > FARTHEST_M:
        raise ValueError(f"the target is {far_m:.4g} m from the camera (median): millimetres? metres")


def check_reading(found: RobotWorld, cam_T_target: Array, base_T_ee: Array) -> None:
    """:class:`CalibrationError` if large residuals vanish under another reading of the poses (n, 4, 4), or exceed the
    errors of any arm and camera.
    """
    if found.rms_rad < SUSPECT_RAD:
        return
    left_deg = np.degrees(found.rms_rad)
    for text, target, arm in _readings(cam_T_target, base_T_ee):
        try:
            other = refine(target, arm, solve(target, arm))
        except CalibrationError:
            continue
        if other.rms_rad < _OTHER_READING_SHARE * found.rms_rad and other.used.mean() >= _OTHER_READING_USED:
            raise CalibrationError(f"{text} ({np.degrees(other.rms_rad):.2g} degrees are left, else {left_deg:.2g})")
    if found.rms_rad > LARGEST_RESIDUAL_RAD:
        raise CalibrationError(
            f"the poses of arm and target contradict each other: {left_deg:.2g} degrees are left on average; each "
            "target's pose with the arm's at that time"
        )


def _readings(cam_T_target: Array, base_T_ee: Array) -> Iterator[tuple[str, Array, Array]]:
    # Inverting the arm's poses is equivalent to inverting the target's: the two can't be distinguished.
    text = (
        "the poses fit with the arm's or the target's inverted: base_T_ee and cam_T_target; or --eye-in-hand is missing"
    )
    yield f"{text}, or too much", cam_T_target, np.linalg.inv(base_T_ee)
    for offset in OFFSETS:
        count = len(base_T_ee) - abs(offset)
        if count <= FEWEST_POSES:
            continue
        own, other = max(offset, 0), max(-offset, 0)
        which = "later" if offset > 0 else "earlier"
        text = f"arm and target are out of step: targets fit the arm's poses {abs(offset)} row(s) {which}"
        yield text, cam_T_target[other : other + count], base_T_ee[own : own + count]


def _check_turns(cam_T_target: Array, base_T_ee: Array) -> None:
    if len(base_T_ee) < FEWEST_POSES:
        raise CalibrationError(f"{len(base_T_ee)} pose(s); at least {FEWEST_POSES}, better ten")
    for which, poses in (("arm's", base_T_ee), ("target's", cam_T_target)):
        turns = (poses[:, :3, :3] - poses[:, :3, :3].mean(axis=0)).reshape(-1, 3)
        moved = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(poses))
        if moved[2] < LEAST_TURN_RAD:
            raise CalibrationError(
                f"the {which} poses are turned about one axis only, or not at all; poses turned about at least two axes"
            )


def _weights_of(values: Array) -> Array:
    """(6, 6) that normalises residuals: positions and rotations each by their own robust scale."""
    sizes = [_scale(np.linalg.norm(part, axis=1), 3) for part in (values[:, :3], values[:, 3:])]
    return np.diag(1.0 / np.repeat(sizes, 3))


def _sizes(whiten: Array, values: Array) -> Array:
    out: Array = np.linalg.norm((whiten @ values[:, :, None])[:, :, 0], axis=1)
    return out


def _scale(sizes: Array, freedom: int) -> float:
    return max(robust_scale(sizes, freedom), 1e-12)


def _left(q: Array) -> Array:
    """(n, 4, 4): matrices of left multiplication by quaternions x y z w."""
    x, y, z, w = q.T
    return np.stack([np.stack(row, -1) for row in ((w, -z, y, x), (z, w, -x, y), (-y, x, w, z), (-x, -y, -z, w))], 1)


def _right(q: Array) -> Array:
    """(n, 4, 4): matrices of right multiplication."""
    x, y, z, w = q.T
    return np.stack([np.stack(row, -1) for row in ((w, z, -y, x), (-z, w, x, y), (y, -x, w, z), (-x, -y, -z, w))], 1)
