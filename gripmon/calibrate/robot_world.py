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
from gripmon.calibrate.target_shape import MISPRINTED
from gripmon.model.geometry import invert, make_transform, perturb, skew
from gripmon.model.least_squares import (
    TUKEY,
    covariance_of,
    fit,
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
_ARM_BOUNDS = ((1e-7, 0.1), (1e-7, 0.5))
"""Of an arm's standard deviations, m and rad: what is beyond isn't an arm's."""
_ARM_STARTS = (1e-5, 2e-4, 3e-3)
FARTHEST_M = 20.0
"""Largest distance of a target from the camera, and of an arm from its base (m): larger numbers are millimetres."""
SUSPECT_RAD = 0.02
"""Residuals (rad, each axis; positions as the camera sees them) above which other readings of the poses are tried."""
LARGEST_RESIDUAL_RAD = 0.1
"""The same above the errors of any arm and camera."""
_OTHER_READING_SHARE = 0.1  # another reading must leave less than this part of the residuals,
_OTHER_READING_USED = 0.7  # and use at least this part of the poses
_OFFSETS = (1, -1, 2, -2)
"""Offsets in rows between poses and what was seen at them that are tried."""
Unknowns = tuple[Array, Array]
"""``cam_T_base`` and ``ee_T_target`` (4, 4) each."""


@dataclass(frozen=True, slots=True)
class RobotWorld:
    """``covariance`` (12, 12) of ``cam_T_base`` and ``ee_T_target``, position then rotation each (axes of cam, of ee);
    ``residuals`` (n, 6), measured against predicted ``cam_T_target``, position (m) and rotation (rad), camera axes;
    ``used`` (n,).  ``warnings``: doubts, in words.
    """

    cam_T_base: Array
    ee_T_target: Array
    covariance: Array
    residuals: Array
    used: NDArray[np.bool_]
    degrees_of_freedom: int
    warnings: tuple[str, ...] = ()

    @property
    def rms_m(self) -> float:
        """Root mean square of the used positions' residuals, each axis."""
        return float(np.sqrt(np.mean(np.square(self.residuals[self.used, :3]))))

    @property
    def rms_rad(self) -> float:
        """Root mean square of the used rotations' residuals, each axis."""
        return float(np.sqrt(np.mean(np.square(self.residuals[self.used, 3:]))))


def solve(cam_T_target: Array, base_T_ee: Array) -> Unknowns:
    """Closed form from poses (n, 4, 4) each.  Raises :class:`CalibrationError` for too few poses, or rotations about a
    single axis.

    Rotations ``cam_R_target target_R_ee = cam_R_base base_R_ee`` as quaternions ``Q(a) x = W(b) z``: the sum of squared
    differences under unit norms is smallest for the singular vectors of ``sum Q(a)ᵀ W(b)`` with the largest singular
    value.  Then positions, by linear least squares of
    ``cam_R_target target_t_ee + cam_t_target = cam_R_base base_t_ee + cam_t_base``.
    """
    from scipy.spatial.transform import Rotation

    count = len(base_T_ee)
    if count < FEWEST_POSES:
        raise CalibrationError(f"{count} pose(s); at least {FEWEST_POSES}, better ten")
    for which, poses in (("arm's", base_T_ee), ("target's", cam_T_target)):
        if least_turn_rad(poses[:, :3, :3]) < LEAST_TURN_RAD:
            raise CalibrationError(
                f"the {which} poses are turned about one axis only, or not at all; poses turned about at least two axes"
            )
    a, b = (Rotation.from_matrix(poses[:, :3, :3]).as_quat() for poses in (cam_T_target, base_T_ee))
    # A quaternion and its negative are the same rotation.  Motions from the first pose have the same angle on both
    # sides; its cosine is the quaternions' inner product.
    b = b * np.where((a @ a[0]) * (b @ b[0]) < 0.0, -1.0, 1.0)[:, None]
    left, _, right = np.linalg.svd(np.einsum("nji,njk->ik", _product(a, 1.0), _product(b, -1.0)))
    cam_R_base, target_R_ee = Rotation.from_quat(right[0]).as_matrix(), Rotation.from_quat(left[:, 0]).as_matrix()
    rows = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), -cam_T_target[:, :3, :3]], axis=2).reshape(-1, 6)
    sides = (cam_T_target[:, :3, 3] - base_T_ee[:, :3, 3] @ cam_R_base.T).ravel()
    found = np.linalg.lstsq(rows, sides, rcond=None)[0]
    return make_transform(cam_R_base, found[:3]), invert(make_transform(target_R_ee, found[3:]))


def _product(q: Array, side: float) -> Array:
    """(n, 4, 4): matrices of multiplication by quaternions x y z w, from the left (``side`` 1) or the right (-1)."""
    out = np.zeros((len(q), 4, 4))
    out[:, :3, :3] = side * skew(q[:, :3])
    out[:, :3, 3], out[:, 3, :3] = q[:, :3], -q[:, :3]
    out[:, range(4), range(4)] = q[:, 3:]
    return out


def least_turn_rad(rotations: Array) -> float:
    """By how much rotations (n, 3, 3) turn the direction that they turn least, root mean square."""
    turns = (rotations - rotations.mean(axis=0)).reshape(-1, 3)
    return float(np.linalg.svd(turns, compute_uv=False)[2] / np.sqrt(len(rotations)))


def refine(
    cam_T_target: Array,
    base_T_ee: Array,
    start: Unknowns,
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
    at, count = start, len(cam_T_target)
    if 6 * count <= 12:
        raise CalibrationError(f"{count} pose(s); at least {FEWEST_POSES}, better ten")
    whiten = None if covariance is None else whitening(covariance)
    weights: Array = np.ones(count)
    sigmas: Array | None = None

    def whitened(at: Unknowns, root: Array) -> Array:
        return (root @ residuals(cam_T_target, base_T_ee, *at)[:, :, None])[:, :, 0]

    def fitted(at: Unknowns, root: Array, weights: Array) -> Unknowns:
        each = np.sqrt(weights)[:, None]

        def linearised(at: Unknowns) -> tuple[Array, Array]:
            return each[:, :, None] * (root @ slopes(base_T_ee, *at)), each * whitened(at, root)

        return fit(
            at, linearised, lambda at, step: (perturb(at[0], step[:6]), perturb(at[1], step[6:])), iterations=100
        ).state

    for turn in range(_ROUNDS):
        values = residuals(cam_T_target, base_T_ee, *at)
        if covariance is not None and inexact_arm and turn < _ARM_ROUNDS:
            by_arm = _arm_slopes(base_T_ee, at, eye_in_hand)
            sigmas = _arm_sigmas(covariance, by_arm, slopes(base_T_ee, *at), values, weights, sigmas)
            whiten = whitening(_with_arm(covariance, by_arm, sigmas))
        root = whiten if whiten is not None else _by_scatter(values)
        if count > FEWEST_POSES:
            sizes = np.linalg.norm(whitened(at, root), axis=1)
            # Norms of six coordinates are typically sqrt(3) times those of two, for which TUKEY is.
            weights = tukey_weights(sizes, TUKEY * _scale(sizes, 6) * float(np.sqrt(3.0)))
        before, at = at, fitted(at, root, weights)
        if turn > _ARM_ROUNDS and all(np.allclose(a, b, atol=1e-12) for a, b in zip(before, at, strict=True)):
            break
    used = np.ones(count, dtype=bool)
    if count > FEWEST_POSES:
        sizes = np.linalg.norm(whitened(at, root), axis=1)
        # The unknowns reduce the residuals.
        left = np.sqrt(1.0 - 2.0 / count)
        used = sizes <= np.sqrt(chdtri(6, FALSE_OUTLIERS / count)) * _scale(sizes, 6) / left
    if used.sum() < FEWEST_POSES:
        raise CalibrationError(f"{int(used.sum())} of {count} poses agree with each other; at least {FEWEST_POSES}")
    at = fitted(at, root, used.astype(float))
    rows, left_over, freedom = (root @ slopes(base_T_ee, *at))[used], whitened(at, root)[used], 6 * int(used.sum()) - 12
    try:
        unscaled = covariance_of(normal_equations(rows, left_over)[0])
    except np.linalg.LinAlgError:
        raise CalibrationError(
            "the poses leave a direction undetermined; poses turned about at least two axes, and shifted"
        ) from None
    found = max(float(np.square(left_over).sum()) / freedom, 1e-18) * unscaled
    if common is not None:
        by_common = unscaled @ np.einsum("nij,nik->jk", rows, (root @ common)[used])
        found = found + by_common @ by_common.T
    return RobotWorld(*at, found, residuals(cam_T_target, base_T_ee, *at), used, freedom)


def residuals(cam_T_target: Array, base_T_ee: Array, cam_T_base: Array, ee_T_target: Array) -> Array:
    """(n, 6): measured against predicted ``cam_T_target``, position and rotation, camera axes."""
    from scipy.spatial.transform import Rotation

    predicted = cam_T_base @ base_T_ee @ ee_T_target
    turned = Rotation.from_matrix(cam_T_target[:, :3, :3] @ predicted[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([cam_T_target[:, :3, 3] - predicted[:, :3, 3], turned], axis=1)


def slopes(base_T_ee: Array, cam_T_base: Array, ee_T_target: Array) -> Array:
    """Derivatives (n, 6, 12) of predicted ``cam_T_target`` by perturbations of ``cam_T_base`` and ``ee_T_target``."""
    cam_R_ee = cam_T_base[:3, :3] @ base_T_ee[:, :3, :3]
    out = np.zeros((len(base_T_ee), 6, 12))
    out[:, :3, :3] = out[:, 3:, 3:6] = np.eye(3)
    out[:, :3, 3:6] = -skew((cam_T_base @ base_T_ee @ ee_T_target)[:, :3, 3] - cam_T_base[:3, 3])
    out[:, :3, 6:9] = out[:, 3:, 9:] = cam_R_ee
    return out


def _arm_slopes(base_T_ee: Array, at: Unknowns, eye_in_hand: bool) -> Array:
    """(n, 6, 6): effect of errors of the arm's poses (position, then rotation about the hand's origin, camera axes) on
    the predicted ``cam_T_target``, up to a sign; ``eye_in_hand`` as in :func:`refine`.
    """
    cam_T_base, ee_T_target = at
    hand = cam_T_base @ (np.eye(4) if eye_in_hand else base_T_ee)
    out = np.tile(np.eye(6), (len(base_T_ee), 1, 1))
    out[:, :3, 3:] = -skew((cam_T_base @ base_T_ee @ ee_T_target - hand)[:, :3, 3])
    return out


def _arm_sigmas(
    covariance: Array, by_arm: Array, rows: Array, values: Array, weights: Array, before: Array | None
) -> Array:
    """Standard deviations (2,) of the arm's positions (m) and rotations (rad), each axis, by restricted maximum
    likelihood.

    ``covariance`` (n, 6, 6) of the targets' poses, ``by_arm`` (n, 6, 6) of :func:`_arm_slopes`, ``rows`` (n, 6, k) the
    derivatives by the k unknowns, ``values`` (n, 6) the residuals, weighted per pose by ``weights`` (n,).  Starts at
    the values ``before``, if given.
    """
    from scipy.optimize import minimize

    scaled = rows / np.linalg.norm(rows.reshape(-1, rows.shape[2]), axis=0)

    def unlikely(log_sigmas: Array) -> float:
        matrix = _with_arm(covariance, by_arm, np.exp(log_sigmas))
        inverse = np.linalg.inv(matrix)
        squares = np.einsum("ni,nij,nj->n", values, inverse, values)
        information = np.tensordot(scaled, weights[:, None, None] * (inverse @ scaled), axes=((0, 1), (0, 1)))
        return float((weights * (np.linalg.slogdet(matrix)[1] + squares)).sum() + np.linalg.slogdet(information)[1])

    starts = [(s, s) for s in _ARM_STARTS] if before is None else [before]
    found = [
        minimize(unlikely, np.log(s), method="L-BFGS-B", bounds=np.log(_ARM_BOUNDS), options={"ftol": 1e-6})
        for s in starts
    ]
    out: Array = np.exp(min(found, key=lambda each: each.fun).x)
    return out


def _with_arm(covariance: Array, by_arm: Array, sigmas: Array) -> Array:
    """``covariance`` (n, 6, 6) plus the contribution of an arm's errors with standard deviations (2,), m and rad."""
    scaled = by_arm * np.repeat(sigmas, 3)
    out: Array = covariance + scaled @ scaled.transpose(0, 2, 1)
    return out


def _by_scatter(values: Array) -> Array:
    """(6, 6) that normalises residuals: positions and rotations each by their own robust scale."""
    sizes = [_scale(np.linalg.norm(part, axis=1), 3) for part in (values[:, :3], values[:, 3:])]
    return np.diag(1.0 / np.repeat(sizes, 3))


def _scale(sizes: Array, freedom: int) -> float:
    return max(robust_scale(sizes, freedom), 1e-12)


def check_target_scale(cam_T_target: Array) -> None:
    """ValueError for poses (n, 4, 4) of a target that is too far away for any camera."""
    far_m = float(np.median(np.linalg.norm(cam_T_target[:, :3, 3], axis=1)))
    if far_m > FARTHEST_M:
        raise ValueError(f"the target is {far_m:.4g} m from the camera (median): millimetres? metres")


def check_reading(found: RobotWorld, cam_T_target: Array, base_T_ee: Array) -> tuple[str, ...]:
    """A line where residuals are larger than an arm's and a camera's errors.  :class:`CalibrationError` if they vanish
    under another reading of the poses (n, 4, 4) or with a target of another size, or exceed the errors of any arm and
    camera.
    """
    _check_size(found, cam_T_target, base_T_ee)
    off_rad = _off_rad(found, cam_T_target)
    if off_rad < SUSPECT_RAD:
        return ()
    for text, target, arm in _readings(cam_T_target, base_T_ee):
        other = _again(target, arm)
        if other is not None and (left_rad := _off_rad(other, target)) < _OTHER_READING_SHARE * off_rad:
            left = f"{np.degrees(left_rad):.2g} degrees are left, else {np.degrees(off_rad):.2g}"
            raise CalibrationError(f"{text} ({left})")
    left = f"{1e3 * found.rms_m:.2g} mm and {np.degrees(found.rms_rad):.2g} degrees are left on average"
    right = "each target's pose with the arm's at that time"
    if off_rad > LARGEST_RESIDUAL_RAD:
        raise CalibrationError(f"the poses of arm and target contradict each other: {left}; {right}")
    return (f"{left}, more than an arm's and a camera's errors: {right}",)


def _off_rad(found: RobotWorld, cam_T_target: Array) -> float:
    """Residuals of rotations, and of positions as the camera sees them, each axis."""
    far_m = float(np.median(np.linalg.norm(cam_T_target[:, :3, 3], axis=1)))
    return float(np.hypot(found.rms_rad, found.rms_m / max(far_m, 1e-9)))


def _again(cam_T_target: Array, base_T_ee: Array) -> RobotWorld | None:
    """The result of another reading; None if too few poses agree in it."""
    try:
        other = refine(cam_T_target, base_T_ee, solve(cam_T_target, base_T_ee))
    except CalibrationError:
        return None
    return other if other.used.mean() >= _OTHER_READING_USED else None


def _check_size(found: RobotWorld, cam_T_target: Array, base_T_ee: Array) -> None:
    """Reject poses whose positions agree if all targets are farther away or nearer by one factor, which leaves
    rotations as they are: by linear least squares, then all together.
    """
    seen, arm = cam_T_target[found.used], base_T_ee[found.used]
    shifts = np.broadcast_to(-np.eye(3), (len(seen), 3, 3))
    rows = np.concatenate([seen[:, :3, 3:], shifts, seen[:, :3, :3]], axis=2).reshape(-1, 7)
    times = float(np.linalg.lstsq(rows, (arm[:, :3, 3] @ found.cam_T_base[:3, :3].T).ravel(), rcond=None)[0][0])
    if times <= 0.0 or abs(times - 1.0) < MISPRINTED or len(seen) <= FEWEST_POSES + 1:
        return
    scaled = cam_T_target.copy()
    scaled[:, :3, 3] *= times
    other = _again(scaled, base_T_ee)
    if other is not None and other.rms_m < _OTHER_READING_SHARE * found.rms_m:
        left = f"{1e3 * other.rms_m:.2g} mm are left, else {1e3 * found.rms_m:.2g}"
        right = "the target in its real size, both in metres, the camera that took the images"
        raise CalibrationError(f"the poses fit with targets {times:.3g} times as far from the camera ({left}); {right}")


def _readings(cam_T_target: Array, base_T_ee: Array) -> Iterator[tuple[str, Array, Array]]:
    # Inverting the arm's poses is equivalent to inverting the target's: the two can't be distinguished.
    text = "the poses fit with the arm's or the target's inverted: base_T_ee and cam_T_target"
    yield f"{text}; or --eye-in-hand is missing, or too much", cam_T_target, np.linalg.inv(base_T_ee)
    text = "the poses fit if {} quaternions have w first: qx, qy, qz, qw, in this order"
    yield text.format("all"), w_first(cam_T_target), w_first(base_T_ee)
    yield text.format("the arm's"), cam_T_target, w_first(base_T_ee)
    yield text.format("the target's"), w_first(cam_T_target), base_T_ee
    for rows, arm, target in out_of_step(len(base_T_ee)):
        text = f"arm and target are out of step: targets fit the arm's poses {rows}"
        yield text, cam_T_target[target], base_T_ee[arm]


def w_first(poses: Array) -> Array:
    """Poses (n, 4, 4) with rotations as they are if their quaternions were w x y z, but were read as x y z w."""
    from scipy.spatial.transform import Rotation

    out = poses.copy()
    turns = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), -1, axis=1)
    out[:, :3, :3] = Rotation.from_quat(turns).as_matrix()
    return out


def out_of_step(count: int) -> Iterator[tuple[str, slice, slice]]:
    """Other pairs of a table's poses and of what was seen at them: in words, and the rows of both."""
    for offset in _OFFSETS:
        if (left := count - abs(offset)) > FEWEST_POSES:
            poses, seen = (slice(first, first + left) for first in (max(offset, 0), max(-offset, 0)))
            yield f"{abs(offset)} row(s) {'later' if offset > 0 else 'earlier'}", poses, seen
