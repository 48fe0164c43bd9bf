"""What the edges say together: how far from the sharp model they lie, and what of each edge's offset is noise.

An edge's offset in the images is its share of what is common to all (the reference, or the reported opening, is off by
a little; bevels make every outline lie inside of the sharp one) plus what is its own, plus noise, which clutter behind
an outline can make large.  How much edges have of their own is read from all of them, and what of an offset their noise
explains is taken back.  So a gripper with sharp edges isn't taught the clutter of its teaching images.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.records import Array

_ROUNDS = 30
_SETTLED = 1e-3


@dataclass(frozen=True, slots=True)
class Pooled:
    """Offsets ``ends_m`` (e, 2) and their covariances (e, 2, 2), ``own_m`` (e, 2) what of them is the edges' own,
    ``usual_own_m`` (g,) its standard deviation over edges of a kind, ``common`` (m,) what is common and
    ``common_covariance`` (m, m).
    """

    ends_m: Array
    covariance_m2: Array
    own_m: Array
    usual_own_m: Array
    common: Array
    common_covariance: Array


def pool(ends_m: Array, covariance_m2: Array, rows: Array, kind: NDArray[np.intp], prior_covariance: Array) -> Pooled:
    """Posterior of the offsets ``ends_m`` (e, 2), whose noise has ``covariance_m2`` (e, 2, 2).

    ``rows`` (e, 2, m): metres of offset by what is common, which is known to ``prior_covariance`` (m, m) about zero.
    ``kind`` (e,): edges of a kind (outlines, creases) have a standard deviation of their own in common, both ends of an
    edge the same offset but for half of it; estimated by restricted maximum likelihood (expectation maximisation).
    """
    kinds = int(kind.max()) + 1
    own_m2 = np.full(kinds, float(np.mean(np.square(ends_m))) + 1e-16)
    common = np.zeros(rows.shape[2])
    mean, covariance, own, common_covariance = ends_m, covariance_m2, ends_m, prior_covariance
    for _ in range(_ROUNDS):
        shape = own_m2[kind][:, None, None] * _SHAPE
        weight = np.linalg.inv(covariance_m2 + shape)
        information = np.einsum("eim,eij,ejn->mn", rows, weight, rows) + np.linalg.inv(prior_covariance)
        common_covariance = np.linalg.inv(information)
        common = common_covariance @ np.einsum("eim,eij,ej->m", rows, weight, ends_m)
        gain = shape @ weight  # of what isn't common this much is the edge's own
        own = np.einsum("eij,ej->ei", gain, ends_m - np.einsum("eim,m->ei", rows, common))
        mean = np.einsum("eim,m->ei", rows, common) + own
        rest = np.eye(2) - gain
        own_covariance = shape - gain @ shape + gain @ _quadratic(rows, common_covariance) @ gain.transpose(0, 2, 1)
        lever = rest @ rows
        covariance = shape - gain @ shape + _quadratic(lever, common_covariance)
        whitened = np.einsum("ij,ei,ej->e", _INVERSE_SHAPE, own, own) + np.einsum(
            "ij,eji->e", _INVERSE_SHAPE, own_covariance
        )
        new = np.array([np.mean(whitened[kind == k]) / 2.0 if (kind == k).any() else 0.0 for k in range(kinds)])
        settled = np.abs(np.sqrt(new) - np.sqrt(own_m2)).max() < _SETTLED * np.sqrt(np.mean(own_m2) + 1e-16)
        own_m2 = new + 1e-18
        if settled:
            break
    return Pooled(mean, covariance, own, np.sqrt(own_m2), common, common_covariance)


_SHAPE = np.array([[1.0, 0.5], [0.5, 1.0]])
_INVERSE_SHAPE = np.linalg.inv(_SHAPE)


def _quadratic(rows: Array, covariance: Array) -> Array:
    return np.asarray(rows @ covariance @ rows.transpose(0, 2, 1))
