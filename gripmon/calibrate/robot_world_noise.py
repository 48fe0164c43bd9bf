"""How inexact an arm is, from what its poses leave unexplained beside a target's own covariances.

A target's pose from one image is known to some hundredths of a millimetre, most arms aren't: weighed by the images
alone, the poses seen best count for far more than they know.  Two variances, of the arm's positions and rotations, are
estimated by restricted maximum likelihood (Patterson and Thompson, Biometrika 58, 1971).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from gripmon.model.geometry import skew
from gripmon.model.records import Array

_LEAST_M, _LEAST_RAD = 1e-7, 1e-7
_MOST_M, _MOST_RAD = 0.1, 0.5
_STARTS = (1e-5, 2e-4, 3e-3)


def arm_slopes(base_T_ee: Array, cam_T_base: Array, ee_T_target: Array) -> Array:
    """(n, 6, 6): what errors of the arm's poses (position, then rotation about the hand's origin, camera axes) do to
    the predicted ``cam_T_target``.
    """
    cam_R_ee = cam_T_base[:3, :3] @ base_T_ee[:, :3, :3]
    out = np.tile(np.eye(6), (len(base_T_ee), 1, 1))
    out[:, :3, 3:] = -skew(cam_R_ee @ ee_T_target[:3, 3])
    return out


def arm_sigmas(
    covariance: Array, by_arm: Array, rows: Array, values: Array, weights: Array, before: Array | None
) -> Array:
    """Standard deviations (2,) of the arm's positions (m) and rotations (rad), each axis.

    ``covariance`` (n, 6, 6) of the targets' poses, ``by_arm`` (n, 6, 6) of :func:`arm_slopes`, ``rows`` (n, 6, k) the
    derivatives by the k unknowns, ``values`` (n, 6) the residuals, of which each pose's has one of the ``weights``
    (n,).  Begun at what they were ``before``.
    """
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
    """``covariance`` (n, 6, 6) with what an arm's errors of standard deviations (2,), m and rad, add to it."""
    position, rotation = by_arm[:, :, :3] * sigmas[0], by_arm[:, :, 3:] * sigmas[1]
    out: Array = covariance + position @ position.transpose(0, 2, 1) + rotation @ rotation.transpose(0, 2, 1)
    return out
