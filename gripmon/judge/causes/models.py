"""Models of what may have moved: what each frees, its prior, and its marginal likelihood in Laplace's approximation.

Every model has the same unknowns; what it doesn't free is held by what is known (the calibration's error, the error of
the reported opening), and what it frees has a normal prior of a size that is itself unknown: an average over sizes
from the smallest worth reporting to the largest plausible.  A model with more freedom spreads its prior over more that
could have been seen, and so pays for what it doesn't need (MacKay 1992, "Bayesian interpolation").

Pieces of edges, and whole edges, err with Student's distribution (Lange, Little and Taylor 1989), and an edge may as
well belong to something else, a border anywhere within the search lines' reach: a mistaken edge costs every model the
same, so that no motion is fitted to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.judge.causes.kernel import FINGERS, FOCAL, JAW, POSE
from gripmon.judge.causes.state import EdgeView, State, finger_lever_m, finger_slice
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Cause
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M

SMALLEST_M = 5e-5
"""The smallest motion worth reporting, m."""

MOUNT_SIZES_M = np.geomspace(SMALLEST_M, 1e-2, 8)
PART_SIZES_M = np.geomspace(SMALLEST_M, 3e-3, 6)
FOCAL_SIZES = np.geomspace(1e-3, 5e-2, 6)
"""How far things move when they move: shift of the TCP; of a finger or the opening; relative focal length."""

PRIOR: dict[Cause | None, float] = {
    Cause.CAMERA_MOUNT: 0.3,
    Cause.CAMERA_REPLACED: 0.3,
    Cause.FINGER_BENT: 0.25,
    Cause.JAW_OPENING: 0.15,
    Cause.LENS: 0.1,
    Cause.UNKNOWN: 0.1,
    None: 0.1,
}
"""Probability of each cause, given that something looks wrong: of another camera after a pause, of any bent finger, of
several things at once (``UNKNOWN``), and of nothing at all.
"""

MOST_FOREIGN_EDGES = 0.5
"""Share of the seen edges that may belong to something else; a cause must explain the others to be named.  The
prior of their share is uniform up to this: a grasped thing has borders beside several edges at once, so that edges
aren't mistaken independently of each other.
"""


@cache
def _shares() -> tuple[Array, Array, Array]:
    """Logarithms of the shares (12, 1) of foreign edges that are averaged over, of one less those, and of their weights
    (12,): Gauss's quadrature, exact up to 23 edges.
    """
    nodes, weights = np.polynomial.legendre.leggauss(12)
    foreign = 0.5 * MOST_FOREIGN_EDGES * (1.0 + nodes)[:, None]
    return np.log(foreign), np.log1p(-foreign), np.log(0.5 * weights)


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Standard deviations of what holds while nothing has moved: ``pose`` (6,) of the reference, ``jaw_m`` of the
    opening; ``jaw_reported``: a robot reports it.
    """

    pose: Array
    jaw_m: float
    jaw_reported: bool


@dataclass(frozen=True, slots=True)
class Suspect:
    """One model: the cause that it stands for (``None``: nothing moved; ``UNKNOWN``: several things at once), the
    finger that it is about, and its prior probability.
    """

    cause: Cause | None
    part: int | None
    prior: float
    model: Model


def suspects(gripper: Gripper, distance_m: float, known: Knowledge, interrupted: bool) -> list[Suspect]:
    """The models that exist for this gripper, ``distance_m`` from the camera to the TCP.

    A gripper of one finger has none for a bent finger, which looks like a motion of the camera; without a jaw, or
    where no one reports its opening, there is none for a wrong report.  No one exchanges a camera without the stream
    being ``interrupted``.
    """
    fingers = len(gripper.finger_ids)
    held = np.zeros(FINGERS + 6 * fingers)
    held[POSE] = known.pose
    held[JAW] = 0.0 if not gripper.has_jaw else known.jaw_m if known.jaw_reported else JAW_UNREPORTED_SIGMA_M
    lever_m = finger_lever_m(gripper)

    def freed(*parts: tuple[int | slice, Array | float]) -> Array:
        out = np.zeros(len(held))
        for place, size in parts:
            out[place] = size
        return out

    def bent(finger: int) -> tuple[slice, Array]:
        return finger_slice(finger), np.array([1.0] * 3 + [1.0 / lever_m[finger]] * 3)

    pose = np.array([1.0] * 3 + [1.0 / distance_m] * 3)
    out = [
        Suspect(None, None, PRIOR[None], Model(held, freed(), np.zeros(0))),
        Suspect(Cause.CAMERA_MOUNT, None, PRIOR[Cause.CAMERA_MOUNT], Model(held, freed((POSE, pose)), MOUNT_SIZES_M)),
        Suspect(Cause.LENS, None, PRIOR[Cause.LENS], Model(held, freed((FOCAL, 1.0)), FOCAL_SIZES)),
    ]
    if interrupted:
        # Another camera in its place: an image of another scale from nearly the same place.
        model = Model(held, freed((POSE, pose), (FOCAL, 5.0)), MOUNT_SIZES_M)
        out.append(Suspect(Cause.CAMERA_REPLACED, None, PRIOR[Cause.CAMERA_REPLACED], model))
    if gripper.has_jaw and known.jaw_reported:
        model = Model(held, freed((JAW, 1.0)), PART_SIZES_M)
        out.append(Suspect(Cause.JAW_OPENING, None, PRIOR[Cause.JAW_OPENING], model))
    if fingers > 1:
        for finger in range(fingers):
            model = Model(held, freed(bent(finger)), PART_SIZES_M)
            out.append(Suspect(Cause.FINGER_BENT, finger, PRIOR[Cause.FINGER_BENT] / fingers, model))
    every = freed((POSE, pose), (FOCAL, 5.0), *(bent(finger) for finger in range(fingers)))
    out.append(Suspect(Cause.UNKNOWN, None, PRIOR[Cause.UNKNOWN], Model(held, every, MOUNT_SIZES_M)))
    return out


STUDENT_FREEDOM = 3.0
"""Degrees of freedom of Student's distribution of the errors."""

LEAST_SHARE = 1e-9
"""Of an edge's weight, so that an edge that belongs to something else still has an offset."""

_COARSE_PX = 1.0  # standard deviation that is added to each piece's own, so that all count alike at first
_COARSE_ROUNDS, _FINE_ROUNDS = 3, 8  # steps with it; most steps with the weights that residuals give
_CONVERGED_PX = 2e-3  # largest motion of a piece by a step that ends the fit


@dataclass(frozen=True, slots=True)
class Model:
    """``held`` (m,): standard deviations of the unknowns by what is known; ``freed`` (m,): of those that the model
    frees, for a motion of size 1, zero for the others; ``sizes`` (n,): sizes that are equally probable.
    """

    held: Array
    freed: Array
    sizes: Array

    def precision(self, size: float) -> Array:
        """(m,) of the prior; infinite where an unknown doesn't move."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / (self.held**2 + (size * self.freed) ** 2))


@dataclass(frozen=True, slots=True)
class Errors:
    """Of the pieces (s,) of edges: what they showed beyond the model when all was well, their scale ``sigma_px``, and
    the scale ``spread_px`` of what a whole edge is off by; ``edge`` (s,) numbers the edges from 0 to k - 1.
    ``something_else`` (k,): log probability density of what each edge shows if it belongs to something else, up to the
    constant that all models share (see :func:`something_else`); None where none may.
    """

    bias_px: Array
    sigma_px: Array
    spread_px: Array
    edge: NDArray[np.intp]
    something_else: Array | None = None

    @property
    def edges(self) -> int:
        return int(self.edge.max(initial=-1)) + 1

    @property
    def of_edge_px(self) -> Array:
        """(k,) the spread of each edge."""
        out = np.zeros(self.edges)
        out[self.edge] = self.spread_px
        return out


@dataclass(frozen=True, slots=True)
class Weighed:
    """``log_evidence`` up to a constant that all models of a frame share; the state that fits best, how far it is
    from the model's start (m,), and the residual (s,) in px that it leaves; ``own`` (k,): probability of each edge that
    it is that edge, not something else.
    """

    log_evidence: float
    state: State
    motion: Array
    residual_px: Array
    own: Array


def weigh(view: EdgeView, gripper: Gripper, model: Model, start: State, first: State, errors: Errors) -> Weighed:
    """Evidence of a model whose prior is centred on the state ``start``; the fit begins at ``first``.

    At first all pieces count alike, so that the way may be long; where edges belong to something else they may have
    dragged the fit along, which then begins once more without that, and the likelier one counts.
    """
    largest = model.precision(float(model.sizes.max(initial=0.0)))
    free = np.flatnonzero(np.isfinite(largest))
    problem = _Problem(view, gripper, model, start, errors, free, largest[free])
    fit = problem.fitted(problem.approached(first))
    if (fit.own > 0.5).all():
        return fit
    other = problem.fitted(problem.point(first))
    return max(fit, other, key=lambda fit: fit.log_evidence)


class _Point(NamedTuple):
    """A state with offsets (k,) of the edges, the residual (s,) that it leaves, in px, the motion (m,) from the prior's
    centre, and what residuals change by with the free unknowns and the offsets (s, n + k).
    """

    state: State
    off_px: Array
    residual: Array
    motion: Array
    design: Array


class _Problem:
    """What one model's fit is made of: the numbers ``free`` (n,) of its unknowns, and the ``precision`` (n,) of the
    widest prior of them.
    """

    def __init__(
        self,
        view: EdgeView,
        gripper: Gripper,
        model: Model,
        start: State,
        errors: Errors,
        free: NDArray[np.intp],
        precision: Array,
    ):
        self._view, self._gripper, self._model, self._start, self._errors = view, gripper, model, start, errors
        self._free, self._precision = free, precision
        self._belongs = (errors.edge[:, None] == np.arange(errors.edges)).astype(float)
        self._spread_px = errors.of_edge_px

    def approached(self, first: State) -> _Point:
        """Nearer to the solution from far away: all pieces count alike."""
        point = self.point(first)
        weights = 1.0 / (self._errors.sigma_px**2 + _COARSE_PX**2), 1.0 / self._spread_px**2
        for _ in range(_COARSE_ROUNDS):
            point = self._moved(point, self._step(point, *weights))
        return point

    def fitted(self, point: _Point) -> Weighed:
        """The solution that is reached from there, each piece and each edge weighed by how well it agrees."""
        model = self._model
        for _ in range(_FINE_ROUNDS):
            step = self._step(point, *self._weights(point))
            converged = float(np.abs(point.design @ step).max(initial=0.0)) < _CONVERGED_PX
            point = self._moved(point, step)
            if converged:
                break
        shown, own = _of_edges(point.residual, point.off_px, self._errors)
        priors = np.array([model.precision(size)[self._free] for size in (model.sizes.tolist() or [0.0])])
        log = shown + _volume(point.design, *self._weights(point), point.motion[self._free], priors)
        evidence = float(np.logaddexp.reduce(log)) - math.log(len(log))
        return Weighed(evidence, point.state, point.motion, point.residual, own)

    def point(self, state: State, off_px: Array | None = None) -> _Point:
        """At a state, with all edges' offsets zero unless given."""
        residual, jacobian = self._view.residual(state)
        design = np.hstack([jacobian[:, self._free], self._belongs])
        off_px = np.zeros(self._errors.edges) if off_px is None else off_px
        return _Point(state, off_px, residual - self._errors.bias_px, state.since(self._start), design)

    def _moved(self, point: _Point, step: Array) -> _Point:
        """The point a step farther; the same one where the gripper would be behind the camera."""
        full = np.zeros(len(point.motion))
        full[self._free] = step[: len(self._free)]
        moved = self.point(point.state.moved(full, self._gripper), point.off_px + step[len(self._free) :])
        return moved if np.isfinite(moved.residual).all() else point

    def _step(self, point: _Point, weight: Array, spread_weight: Array) -> Array:
        """(n + k,) of the unknowns and the offsets."""
        precision = np.concatenate([self._precision, spread_weight])
        at = np.concatenate([point.motion[self._free], point.off_px])
        normal = (point.design.T * weight) @ point.design
        normal.flat[:: len(normal) + 1] += precision
        rest = point.residual - self._belongs @ point.off_px
        return np.linalg.solve(normal, point.design.T @ (weight * rest) - precision * at)

    def _weights(self, point: _Point) -> tuple[Array, Array]:
        """What pieces (s,) and the edges' offsets (k,) count, 1/px²."""
        sigma_px, spread_px = self._errors.sigma_px, self._spread_px
        own = _of_edges(point.residual, point.off_px, self._errors)[1]
        rest = point.residual - self._belongs @ point.off_px
        weight = (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM * sigma_px**2 + rest**2)
        spread_weight = (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM * spread_px**2 + point.off_px**2)
        return weight * own[self._errors.edge], spread_weight * own


def _student(error: Array, scale: Array) -> Array:
    """Log of the density over that of an error of zero."""
    return np.asarray(-0.5 * (STUDENT_FREEDOM + 1.0) * np.log1p((error / scale) ** 2 / STUDENT_FREEDOM))


def _of_edges(residual: Array, off_px: Array, errors: Errors) -> tuple[float, Array]:
    """Log probability of what all edges show, and (k,) the probability of each that it is the edge, not something else;
    averaged over the shares of edges that may be something else.
    """
    pieces = _student(residual - off_px[errors.edge], errors.sigma_px)
    own = np.bincount(errors.edge, pieces, errors.edges) + _student(off_px, errors.of_edge_px)
    if errors.something_else is None:
        return float(own.sum()), np.ones(len(own))
    log_foreign, log_own, log_weight = _shares()
    is_own = own + log_own
    either = np.logaddexp(is_own, errors.something_else + log_foreign)
    of_share = either.sum(axis=1) + log_weight
    log = float(np.logaddexp.reduce(of_share))
    return log, np.maximum(np.exp(of_share - log) @ np.exp(is_own - either), LEAST_SHARE)


def something_else(residual: Array, fraction: Array, errors: Errors, reach_px: float) -> Array:
    """(k,) see :class:`Errors`: a straight border whose distance from each end of the edge is anything up to
    ``reach_px``; ``residual`` (s,) of any model, which differs from others by a line, ``fraction`` (s,) along the edge.
    Borders beside a curved edge are curved as it is, and one beyond the reach costs no more.
    """
    out = np.zeros(errors.edges)
    weight = (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM * errors.sigma_px**2)
    spread_weight = (STUDENT_FREEDOM + 1.0) / (STUDENT_FREEDOM * errors.of_edge_px**2)
    # Student's density of an error of zero, for a scale of one.
    height = math.gamma(0.5 * STUDENT_FREEDOM + 0.5) / math.gamma(0.5 * STUDENT_FREEDOM)
    height /= math.sqrt(math.pi * STUDENT_FREEDOM)
    for k in range(errors.edges):
        at = np.flatnonzero(errors.edge == k)
        first, last = fraction[at].min(), fraction[at].max()
        ends = np.ones((len(at), 1))
        if last > first:
            along = (fraction[at] - first) / (last - first)
            ends = np.column_stack([1.0 - along, along])
        information = (ends.T * weight[at]) @ ends
        border = ends @ np.linalg.solve(information, ends.T @ (weight[at] * residual[at]))
        # Volumes of what agrees: of the border's ends within the reach, of the edge's own offset within its spread.
        may_be = 0.5 * np.log(2.0 * math.pi) * len(information) - 0.5 * np.linalg.slogdet(information)[1]
        may_be -= len(information) * math.log(2.0 * reach_px)
        is_own = math.log(height / errors.of_edge_px[k]) + 0.5 * math.log(2.0 * math.pi)
        is_own -= 0.5 * math.log(weight[at].sum() + spread_weight[k])
        fit = float(_student(residual[at] - border, errors.sigma_px[at]).sum())
        out[k] = fit + may_be - is_own
    return out


def _volume(design: Array, weight: Array, spread_weight: Array, motion: Array, priors: Array) -> Array:
    """(n,) for priors (n, free): the height of each at the solution, moved to where it is best, and how much of its
    volume agrees.  The curvature is that of the weights as they are, without what a step changes them by.
    """
    normal = (design.T * weight) @ design
    normal.flat[:: len(normal) + 1] += np.concatenate([np.zeros(len(motion)), spread_weight])
    # Less what the edges' own offsets take.
    m = len(motion)
    information = normal[:m, :m] - normal[:m, m:] @ np.linalg.solve(normal[m:, m:], normal[m:, :m])
    full = information + priors[:, :, None] * np.eye(m)
    pull = priors * motion
    shorter = np.linalg.solve(full, pull[:, :, None])[:, :, 0]
    height = (pull * motion).sum(axis=1) - (pull * shorter).sum(axis=1)
    # det(N + P) / det(P) from the scaled matrix: P spans twenty orders of magnitude.
    scale = 1.0 / np.sqrt(priors)
    occam = np.linalg.slogdet(full * scale[:, :, None] * scale[:, None, :])[1]
    return np.asarray(-0.5 * (height + occam))
