"""Bundle adjustment: a camera with derivatives by its parameters, fitted together with plate poses to all points.

The fit is weighted, robust least squares on the manifold: the unknowns are the parameters of the lens and, for each
view, a perturbation of its pose; the Jacobian is analytic.  Outliers are found by their residuals against the rest
(Tukey's biweight on a robust scale) and then left out.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.lens_models import LensModel, centre_offsets_px, model_of, parameter_names
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.target_shape import TargetPoints
from gripmon.model.camera import LensSettings
from gripmon.model.geometry import perturb, skew
from gripmon.model.least_squares import (
    TUKEY,
    Equations,
    covariance_of,
    minimise,
    normal_equations,
    robust_scale,
    tukey_weights,
    whitening,
)
from gripmon.model.records import Array

MOST_EVALUATIONS = 1000
"""Costs that one calibration may compute, over all its starts and rounds: some sixteen times what views tilted to
different sides take with any model.
"""
OUTLIER = 5.0
"""Normalised residual, in robust standard deviations, above which a point is left out at the end."""
LEAST_VIEW_INLIERS = 0.5
"""Inlier ratio of a view below which it doesn't show the same target with the same camera."""
PARALLEL_COSINE = float(np.cos(np.radians(3.0)))
"""Cosine between the normals of the plate's poses above which views count as equally tilted."""
ROUNDS = 12
"""Maximum number of rounds of reweighting and of correcting the offsets of discs' centres."""


_State = tuple[Array, list[Array], Array]
"""Parameters of the lens, the views' poses, and the displacements (m, 3) of the target's points; m = 0: it is exact."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """Result of a fit.

    ``parameters`` (k,) of the lens; ``covariance`` (p, p) of the p free ones followed by 6 for each view (position then
    rotation of ``cam_T_plate``, camera axes), scaled by the residuals; ``residuals_px``: one (n, 2) per view, measured
    less predicted; ``used``: one (n,) per view; ``scale``: the residuals' standard deviation over the one by their
    covariances; ``displacement_m`` (m, 3): of the target's points, if they were unknowns.
    """

    parameters: Array
    cam_T_plate: tuple[Array, ...]
    covariance: Array
    residuals_px: tuple[Array, ...]
    used: tuple[NDArray[np.bool_], ...]
    scale: float
    degrees_of_freedom: int
    displacement_m: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals, u and v each."""
        used = np.concatenate([r[u] for r, u in zip(self.residuals_px, self.used, strict=True)])
        return float(np.sqrt(np.mean(np.square(used))))


class ContradictionError(CalibrationError):
    """A view of another camera, focus or target than the others."""

    def __init__(self, sighting: Sighting, points: int) -> None:
        self.sighting = sighting
        self.said = f"{points} of {len(sighting)} points contradict the other images"
        super().__init__(f"{sighting.name}: {self.said}; images of one camera and focus, or without this one")


class Effort:
    """What a calibration may still compute."""

    def __init__(self) -> None:
        self.left = MOST_EVALUATIONS


class _SpentError(Exception):
    """The effort is spent."""


class BundleProblem:
    """Sightings and a lens model; ``free`` (k, p) maps p free parameters to changes of all k: a column with two ones
    ties two parameters together.  Problems of one calibration share their ``effort``.  ``target``: the displacements of
    its points are unknowns, too.
    """

    def __init__(
        self,
        model: LensModel,
        sightings: Sequence[Sighting],
        free: Array,
        effort: Effort | None = None,
        target: TargetPoints | None = None,
    ):
        self._model, self._sightings, self._free, self._effort = model, sightings, free, effort or Effort()
        self._target = target
        self._information: Array = np.zeros((0, 3)) if target is None else target.information
        self._whiten: list[Array] = [whitening(s.covariance_px) for s in sightings]
        self._offsets: list[Array] = [np.zeros(s.uv_px.shape) for s in sightings]

    def solve(self, parameters: Array, cam_T_plate: Sequence[Array]) -> Bundle:
        """Solve from a good start.  Raises :class:`CalibrationError` if that fails."""
        state: _State = parameters, list(cam_T_plate), np.zeros_like(self._information)
        weights: list[Array] = [np.ones(len(s)) for s in self._sightings]
        for turn in range(ROUNDS):
            self._correct_discs(state)
            before = state[0]
            state = self._minimise(state, weights)
            sizes = self._sizes(state)
            scale = max(robust_scale(np.concatenate(sizes), 2), 1e-9)
            weights = [tukey_weights(size, TUKEY * scale) for size in sizes]
            if turn > 0 and np.allclose(state[0], before, rtol=1e-9, atol=1e-12):
                break
        used = [size <= OUTLIER * scale for size in sizes]
        self._check_views(used)
        for _ in range(2):
            self._correct_discs(state)
            state = self._minimise(state, [u.astype(float) for u in used])
        return self._conclude(state, used)

    def _placed(self, displacement_m: Array) -> Sequence[Sighting]:
        if self._target is None:
            return self._sightings
        return self._target.displaced(self._sightings, displacement_m)

    def _correct_discs(self, at: _State) -> None:
        camera = self._model.camera(at[0])
        for k, (sighting, pose) in enumerate(zip(self._placed(at[2]), at[1], strict=True)):
            if sighting.disc_radius_m > 0.0:
                self._offsets[k] = centre_offsets_px(camera, pose, sighting.plate_m, sighting.disc_radius_m)

    def _residuals(self, at: _State) -> list[Array]:
        camera = self._model.camera(at[0])
        return [
            s.uv_px - offset - camera.project(s.plate_m @ T[:3, :3].T + T[:3, 3])
            for s, offset, T in zip(self._placed(at[2]), self._offsets, at[1], strict=True)
        ]

    def _sizes(self, at: _State) -> list[Array]:
        """Norm of each point's whitened residual; infinite where it doesn't project."""
        out = []
        for residual, whiten in zip(self._residuals(at), self._whiten, strict=True):
            size = np.linalg.norm(np.einsum("nij,nj->ni", whiten, residual), axis=1)
            out.append(np.where(np.isfinite(size), size, np.inf))
        return out

    def _cost(self, at: _State, weights: Sequence[Array]) -> float:
        squares = [
            (w * np.square(np.where(w > 0.0, s, 0.0))).sum() for s, w in zip(self._sizes(at), weights, strict=True)
        ]
        return float(sum(squares) + (self._information * np.square(at[2])).sum())

    def _equations(self, at: _State, weights: Sequence[Array]) -> Equations:
        """Normal equations, assembled view by view: p free parameters, 6 for each view, 3 for each displacement."""
        (parameters, poses, displacement_m), p = at, self._free.shape[1]
        last = p + 6 * len(poses)
        n = last + displacement_m.size
        normal, side = np.zeros((n, n)), np.zeros(n)
        normal[range(last, n), range(last, n)] = self._information.ravel()
        side[last:] = -(self._information * displacement_m).ravel()
        for k, (sighting, T, whiten, weight) in enumerate(
            zip(self._placed(displacement_m), poses, self._whiten, weights, strict=True)
        ):
            turned = sighting.plate_m @ T[:3, :3].T
            uv_px, by_parameters, by_point = self._model.project(parameters, turned + T[:3, 3])
            residual = sighting.uv_px - self._offsets[k] - uv_px
            # x' = x + rho + omega x (R x_plate): position, then rotation, camera axes.
            by_pose = np.concatenate([by_point, -by_point @ skew(turned)], axis=2)
            rows = whiten @ np.concatenate([by_parameters @ self._free, by_pose], axis=2)
            values = np.einsum("nij,nj->ni", whiten, residual)
            good = (weight > 0.0) & np.isfinite(values).all(axis=1) & np.isfinite(rows).all(axis=(1, 2))
            own = np.concatenate([np.arange(p), p + 6 * k + np.arange(6)])
            view = normal_equations(rows[good], values[good], weight[good])
            normal[np.ix_(own, own)] += view[0]
            side[own] += view[1]
            if self._target is not None:
                good &= self._target.index[k] >= 0
                places = last + 3 * self._target.index[k][good, None] + np.arange(3)
                weighted = (weight[:, None, None] * whiten @ by_point @ T[:3, :3])[good]
                across = np.einsum("nia,nij->anj", rows[good], weighted).reshape(len(own), -1)
                normal[np.ix_(own, places.ravel())] += across
                normal[np.ix_(places.ravel(), own)] += across.T
                # In one image each point of the target is seen once.
                by_place = (whiten @ by_point @ T[:3, :3])[good]
                normal[places[:, :, None], places[:, None, :]] += np.einsum("nia,nib->nab", weighted, by_place)
                side[places] += np.einsum("nia,ni->na", weighted, values[good])
        return normal, side

    def of_shape(self, parameters: Array, cam_T_plate: Array, used: NDArray[np.bool_]) -> Equations:
        """The normal equations of a single view in the free parameters and the displacements of the target's points,
        without their prior: its pose is eliminated.
        """
        at = parameters, [cam_T_plate], np.zeros_like(self._information)
        self._correct_discs(at)
        normal, side = self._equations(at, [used.astype(float)])
        p, prior = self._free.shape[1], np.concatenate([np.zeros(self._free.shape[1]), self._information.ravel()])
        pose, rest = slice(p, p + 6), np.r_[:p, p + 6 : len(normal)]
        through = np.linalg.solve(normal[pose, pose], np.column_stack([normal[pose, rest], side[pose]]))
        across, alone = normal[rest, pose], normal[np.ix_(rest, rest)] - np.diag(prior)
        return alone - across @ through[:, :-1], side[rest] - across @ through[:, -1]

    def normal_matrix(self, parameters: Array, cam_T_plate: Array) -> Array:
        """(p + 6, p + 6) of a single view with all its points: free parameters, then the pose."""
        at = parameters, [cam_T_plate], np.zeros((0, 3))
        return self._equations(at, [np.ones(len(self._sightings[0]))])[0]

    def gain(self, bundle: Bundle) -> float:
        """How much the displacements of the target's points would explain of what a fit to the same views leaves over,
        to first order: the decrease of its cost, over its variance.
        """
        assert self._target is not None
        at = bundle.parameters, list(bundle.cam_T_plate), np.zeros_like(self._information)
        self._correct_discs(at)
        normal, side = self._equations(at, [u.astype(float) for u in bundle.used])
        size = np.sqrt(normal.diagonal())
        decrease = side / size @ np.linalg.solve(normal / np.outer(size, size), side / size)
        return float(decrease) / bundle.scale**2

    def _minimise(self, start: _State, weights: Sequence[Array]) -> _State:
        if not np.isfinite(self._cost(start, weights)):
            raise CalibrationError("the start is outside of what the lens model maps; more views, or another model")
        p = self._free.shape[1]

        def cost(at: _State) -> float:
            if self._effort.left <= 0:
                raise _SpentError
            self._effort.left -= 1
            return self._cost(at, weights) if (at[0][:2] > 0.0).all() else np.inf

        def moved(at: _State, step: Array) -> _State:
            last = p + 6 * len(at[1])
            steps = step[p:last].reshape(-1, 6)
            poses = [perturb(T, xi) for T, xi in zip(at[1], steps, strict=True)]
            return at[0] + self._free @ step[:p], poses, at[2] + step[last:].reshape(-1, 3)

        with contextlib.suppress(_SpentError):
            return minimise(
                start, cost, lambda at: self._equations(at, weights), moved, iterations=MOST_EVALUATIONS
            ).state
        normals = np.stack([T[:3, 2] for T in start[1]])
        if len(normals) > 1 and (normals @ normals.T).min() > PARALLEL_COSINE:
            raise CalibrationError(DEGENERATE)
        raise CalibrationError(
            f"did not converge in {MOST_EVALUATIONS} evaluations; more views, more tilted against each other, or a "
            "model with fewer parameters"
        )

    def _check_views(self, used: Sequence[NDArray[np.bool_]]) -> None:
        if len(used) > 1:
            sighting, good = min(zip(self._sightings, used, strict=True), key=lambda one: float(one[1].mean()))
            if good.mean() < LEAST_VIEW_INLIERS:
                raise ContradictionError(sighting, int((~good).sum()))

    def _conclude(self, at: _State, used: list[NDArray[np.bool_]]) -> Bundle:
        weights = [u.astype(float) for u in used]
        normal, _ = self._equations(at, weights)
        unknowns = len(normal) - (0 if self._target is None else at[2].size - self._target.unknowns)
        freedom = 2 * int(sum(u.sum() for u in used)) - unknowns
        if freedom <= 0:
            raise CalibrationError(
                f"{unknowns} unknowns and {freedom + unknowns} measured coordinates; more points or views"
            )
        variance = self._cost(at, weights) / freedom
        try:
            covariance = covariance_of(normal, variance)
        except np.linalg.LinAlgError:
            raise CalibrationError(DEGENERATE) from None
        return Bundle(
            at[0], tuple(at[1]), covariance, tuple(self._residuals(at)), tuple(used), float(np.sqrt(variance)), freedom,
            at[2],
        )  # fmt: skip


LARGEST_RMS_SHARE = 0.003
"""Root mean square residual over the image's width above which no camera of the model fits at all."""
USELESS_FOCAL = 0.2
"""Relative standard deviation of the focal length above which there is no calibration."""


def check_fit(lens_model: LensModel, bundle: Bundle, free: Array) -> None:
    """Reject a fit that is not a calibration: :class:`CalibrationError`."""
    if bundle.rms_px > LARGEST_RMS_SHARE * lens_model.width_px:
        raise CalibrationError(
            f"no {lens_model.name} camera explains the views: residuals of {bundle.rms_px:.3g} px are left; images of "
            "one camera and focus, the target as it was described, or another model"
        )
    moves_focal = np.flatnonzero(free[0])
    if len(moves_focal):
        share = float(np.sqrt(bundle.covariance[moves_focal[0], moves_focal[0]])) / bundle.parameters[0]
        if share > USELESS_FOCAL:
            raise CalibrationError(DEGENERATE)


DEGENERATE = (
    "the views don't determine the camera (all of them show the plate at the same tilt, or parallel to the image); "
    "views tilted by 20 to 45 degrees to different sides"
)


def merit(bundle: Bundle) -> tuple[float, float]:
    """Sort key, smaller is better: number of points left out, then the residuals of the rest."""
    used = np.concatenate(bundle.used)
    return float(np.count_nonzero(~used)), bundle.rms_px


@dataclass(frozen=True, slots=True)
class GivenCamera:
    """A camera with the covariance of those of its ``parameters`` that aren't exact, named as in its file; ``target``:
    what it was calibrated with, if that is known.
    """

    lens: LensSettings
    parameters: tuple[str, ...] = ()
    covariance: Array | None = None
    target: str | None = None

    @classmethod
    def calibrated(cls, found: CameraCalibration) -> GivenCamera:
        """The camera of a calibration."""
        count = len(found.parameters)
        covariance = np.reshape(np.array(found.covariance), (count, count))
        return cls(found.camera, found.parameters, covariance, found.target)

    @property
    def model(self) -> LensModel:
        """Its lens model with derivatives.  :class:`CalibrationError` for models that aren't calibrated here."""
        return LensModel(model_of(self.lens), self.lens.width_px, self.lens.height_px)

    @property
    def free(self) -> Array:
        """(k, p): effect of the p ``parameters`` on all k; fy follows fx if the aspect was held."""
        names = parameter_names(model_of(self.lens))
        unknown = [name for name in self.parameters if name not in names]
        if unknown:
            raise CalibrationError(f"{unknown[0]} is not a parameter of this camera; one of {', '.join(names)}")
        out = np.zeros((len(names), len(self.parameters)))
        out[[names.index(name) for name in self.parameters], np.arange(len(self.parameters))] = 1.0
        if "fx_px" in self.parameters and "fy_px" not in self.parameters:
            out[1, self.parameters.index("fx_px")] = self.lens.fy_px / self.lens.fx_px
        return out


def independent_errors(covariance: Array) -> Array:
    """(n, n) rows of independent errors, one standard deviation each.  By eigenvectors, because a covariance is nearly
    singular if corners share an edge or parameters were hardly free.
    """
    scale = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    variances, axes = np.linalg.eigh(covariance / np.outer(scale, scale))
    if not np.isfinite(variances).all() or variances.min() < -1e-6:
        raise CalibrationError("a covariance has negative variances; one of errors")
    roots: Array = scale[:, None] * axes * np.sqrt(np.maximum(variances, 0.0))
    return roots.T
