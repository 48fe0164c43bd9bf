"""A camera from views of a flat target: focal lengths, principal point and lens, with covariance and warnings.

Many views: Zhang, "A flexible new technique for camera calibration", 2000, then bundle adjustment.  One view of a
plane: as Tsai ("A versatile camera calibration technique", 1987) with principal point and aspect held fixed, as in the
self-viewing method; see :func:`calibrate_single_view`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.calibrate.bundle import DEGENERATE, Bundle, BundleProblem, ContradictionError, Effort, check_fit, merit
from gripmon.calibrate.lens_models import LensModel, ModelName, lens_vector, parameter_names
from gripmon.calibrate.plate_pose import plate_pose_start
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.target_shape import UNEVEN_TARGET, TargetPoints, off_plane_m
from gripmon.calibrate.uneven_target import with_shape
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.records import Array

Fixed = Mapping[str, float | None]
"""Parameters that aren't estimated, with the values at which they are held; None: at their start."""

FEWEST_POINTS = 8
"""Minimum number of points in a view; a plane's pose needs four."""
FOCAL_STARTS = np.geomspace(0.25, 8.0, 31)
"""Trial focal lengths over the image's width: fields of view from 127 to 7 degrees."""


def calibrate(
    sightings: Sequence[Sighting],
    model: ModelName,
    *,
    fixed: Fixed = MappingProxyType({}),
    near: LensSettings | None = None,
    exact_target: bool | None = None,
) -> IntrinsicsResult:
    """Calibrate a camera from views of a plane, all of one size.  Parameters named in ``fixed`` keep the value given
    there, or with None their start (the principal point at the image's centre, coefficients 0); ``"aspect"`` ties
    ``fy_px`` to ``fx_px``.  ``near``: a camera of this model to start from, if one is known.  ``exact_target``: whether
    its points are where they should be; None: as the views show.

    Raises :class:`CalibrationError`: images of different sizes, too few points, views that don't determine the camera,
    no convergence, or an implausible lens.
    """
    size = _one_size(sightings)
    lens_model = LensModel(model, *size)
    names, free, bundle, held = _supported(lens_model, sightings, fixed, near)
    target: TargetPoints | None = None
    uneven: tuple[str, ...] = ()
    if not exact_target:
        shaped, uneven = with_shape(lens_model, sightings, free, bundle, tested=exact_target is None)
        target, sightings, bundle = shaped or (None, sightings, bundle)
    camera = lens_model.settings(bundle.parameters)
    p = free.shape[1]
    poses = range(len(sightings))
    result = IntrinsicsResult(
        model=model,
        camera=camera,
        parameters=names,
        covariance=bundle.covariance[:p, :p],
        cam_T_plate=bundle.cam_T_plate,
        pose_covariance=tuple(bundle.covariance[p + 6 * k : p + 6 * k + 6, p + 6 * k : p + 6 * k + 6] for k in poses),
        residuals_px=bundle.residuals_px,
        used=bundle.used,
        rms_px=bundle.rms_px,
        criterion={model: _bayes(bundle, p + (0 if target is None else target.unknowns))},
        target=target,
        displacement_m=bundle.displacement_m,
        sightings=tuple(sightings),
    )
    return replace(result, warnings=(*held, *uneven, *doubts_of(result)))


def calibrate_best(
    sightings: Sequence[Sighting],
    models: Sequence[ModelName],
    *,
    fixed: Fixed = MappingProxyType({}),
    step: Callable[[], None] = lambda: None,
) -> IntrinsicsResult:
    """The one of several models with the smallest information criterion (Schwarz, "Estimating the dimension of a
    model", 1978).  Models that can't be fitted are dropped; :class:`CalibrationError` if all fail.
    """
    best: IntrinsicsResult | None = None
    criterion: dict[str, float] = {}
    reasons: list[CalibrationError] = []
    for model in models:
        try:
            result = calibrate(sightings, model, fixed=fixed)
        except CalibrationError as error:
            reasons.append(error)
        else:
            criterion[model] = (result.criterion or {})[model]
            if best is None or criterion[model] < criterion[best.model]:
                best = result
        step()
    if best is None:
        raise next((error for error in reasons if isinstance(error, ContradictionError)), reasons[0])
    return replace(best, criterion=criterion)


def _supported(
    lens_model: LensModel, sightings: Sequence[Sighting], fixed: Fixed, near: LensSettings | None
) -> tuple[tuple[str, ...], Array, Bundle, tuple[str, ...]]:
    """The fit with as many of the lens's terms as give a plausible camera all over the image: where there are no
    points, the highest terms are unconstrained.  Returns the names of the free parameters, their effect, the fit, and
    what was held.
    """
    held: list[str] = []
    effort = Effort()
    lens = [name for name in parameter_names(lens_model.name)[5:] if name not in fixed]
    for name in (*reversed(lens), ""):
        names, free = free_parameters(lens_model.name, frozenset((*fixed, *held)))
        problem = BundleProblem(lens_model, sightings, free, effort)
        if near is None:
            bundle = _solve(problem, lens_model, sightings, fixed)
        else:
            start = lens_vector(near)
            start[[name in held for name in parameter_names(lens_model.name)]] = 0.0
            bundle = problem.solve(start, [plate_pose_start(lens_model, start, s) for s in sightings])
        check_fit(lens_model, bundle, free)
        try:
            make_camera(lens_model.settings(bundle.parameters))
            break
        except ValueError as error:
            if not name:
                raise CalibrationError(f"the fit ends at an implausible camera ({error})") from None
        held.append(name)
    warning = f"held at 0, as the views don't support more of a lens: {', '.join(held)}"
    return names, free, bundle, (warning,) if held else ()


def _solve(problem: BundleProblem, lens_model: LensModel, sightings: Sequence[Sighting], fixed: Fixed) -> Bundle:
    """Solve from the best of several focal lengths: closed forms for them fail with strong lenses and single views."""
    starts = []
    for share in FOCAL_STARTS.tolist():
        parameters = _start(lens_model, share * lens_model.width_px, fixed)
        try:
            poses = [plate_pose_start(lens_model, parameters, s) for s in sightings]
        except (CalibrationError, cv2.error):
            continue
        camera = lens_model.camera(parameters)
        errors = [
            np.linalg.norm(s.uv_px - camera.project(s.plate_m @ T[:3, :3].T + T[:3, 3]), axis=1)
            for s, T in zip(sightings, poses, strict=True)
        ]
        cost = float(np.mean([np.median(np.where(np.isfinite(e), e, 1e6)) for e in errors]))
        starts.append((cost, share, parameters, poses))
    if not starts:
        raise CalibrationError("no focal length fits the views; images of one camera and the right target")
    # Where lens and focal length can trade off, the best start may mislead: try its neighbours, too.
    starts.sort(key=lambda start: start[:2])
    best: Bundle | None = None
    failure: CalibrationError | None = None
    for _, _, parameters, poses in starts[:3]:
        try:
            bundle = problem.solve(parameters, poses)
        except CalibrationError as error:
            failure = failure or error
            continue
        again = best is not None and np.allclose(bundle.parameters[:4], best.parameters[:4], rtol=1e-5)
        if best is None or merit(bundle) < merit(best):
            best = bundle
        if best.scale < 1.5 or again:
            break
    if best is None:
        raise failure or CalibrationError(DEGENERATE)
    return best


def _start(lens_model: LensModel, focal_px: float, fixed: Fixed) -> Array:
    """Start parameters (k,), with held ones at their values."""
    values = {name: value for name, value in fixed.items() if value is not None}
    out = lens_model.without_distortion(values.get("fx_px", values.get("fy_px", focal_px)))
    for k, name in enumerate(parameter_names(lens_model.name)):
        out[k] = values.get(name, out[k])
    return out


def free_parameters(model: ModelName, fixed: frozenset[str]) -> tuple[tuple[str, ...], Array]:
    """Names of the free parameters, and their effect (k, p)."""
    names = parameter_names(model)
    unknown = fixed - set(names) - {"aspect"}
    if unknown:
        known = f"{', '.join(names)} or aspect"
        raise CalibrationError(f"{sorted(unknown)[0]} is not a parameter of {model}; one of {known}")
    columns, kept = [], []
    for i, name in enumerate(names):
        if name in fixed or (name == "fy_px" and "aspect" in fixed):
            continue
        column = np.zeros(len(names))
        column[i] = 1.0
        if name == "fx_px" and "aspect" in fixed:
            column[1] = 1.0
        columns.append(column)
        kept.append(name)
    return tuple(kept), np.stack(columns, axis=1) if columns else np.zeros((len(names), 0))


def _one_size(sightings: Sequence[Sighting]) -> tuple[int, int]:
    if not sightings:
        raise CalibrationError("no view shows the target; at least one image of it")
    sizes = {s.size_px: s.name for s in sightings}
    if len(sizes) > 1:
        (a, name_a), (b, name_b) = list(sizes.items())[:2]
        raise CalibrationError(
            f"{name_a} has {a[0]} x {a[1]} px and {name_b} {b[0]} x {b[1]} px; images of one camera, in one size"
        )
    for sighting in sightings:
        if len(sighting) < FEWEST_POINTS:
            raise CalibrationError(f"{sighting.name} shows {len(sighting)} points; at least {FEWEST_POINTS}")
    return sightings[0].size_px


def _bayes(bundle: Bundle, free: int) -> float:
    """Bayesian information criterion for normal errors of unknown size.  All points count, outliers at the cost of an
    outlier's size, so that a model doesn't win by leaving points out.
    """
    squares = 0.0
    count = 0
    for residual, used in zip(bundle.residuals_px, bundle.used, strict=True):
        bound = 25.0 * bundle.rms_px**2
        squares += float(np.minimum(np.where(np.isfinite(residual), np.square(residual), bound), bound).sum())
        count += 2 * len(used)
    parameters = free + 6 * len(bundle.used)
    return count * math.log(squares / count) + parameters * math.log(count)


DOUBTFUL_FOCAL = 0.01
"""Relative standard deviation of the focal length above which there is a warning."""
COVERED = 0.6
"""Part of the image's half diagonal that points should reach: beyond them the lens is extrapolated."""
LARGE_RMS_SHARE = 0.0007
"""Root mean square residual over the image's width above which a warning calls it large."""


@dataclass(frozen=True, slots=True)
class IntrinsicsResult:
    """A calibrated camera.

    ``covariance`` (p, p) of the p ``parameters``, keys of ``camera``; all others were held fixed.  One per view:
    ``cam_T_plate`` (4, 4) and ``pose_covariance`` (6, 6) (position then rotation, camera axes), ``residuals_px`` (n, 2)
    and ``used`` (n,).  ``criterion``: Bayesian information criterion of each model that was tried, the smallest is
    best.  ``displacement_m`` (m, 3): of the ``target``'s points from their places, if it isn't exact; in its
    ``sightings`` they are numbered alike then.
    """

    model: ModelName
    camera: LensSettings
    parameters: tuple[str, ...]
    covariance: Array
    cam_T_plate: tuple[Array, ...]
    pose_covariance: tuple[Array, ...]
    residuals_px: tuple[Array, ...]
    used: tuple[NDArray[np.bool_], ...]
    rms_px: float
    warnings: tuple[str, ...] = ()
    criterion: dict[str, float] | None = None
    cross_validated_rms_px: float | None = None
    target: TargetPoints | None = None
    displacement_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    sightings: tuple[Sighting, ...] = ()

    def where_they_are(self, sightings: Sequence[Sighting]) -> Sequence[Sighting]:
        """Views of the same target, with its points where this fit found them."""
        if self.target is None:
            return sightings
        found = TargetPoints.numbered(sightings, self.target.places_m)
        return found.displaced(sightings, self.displacement_m)

    @property
    def view_rms_px(self) -> tuple[float, ...]:
        """Root mean square of each view's used residuals, u and v each."""
        return tuple(
            float(np.sqrt(np.mean(np.square(r[u])))) if u.any() else math.inf
            for r, u in zip(self.residuals_px, self.used, strict=True)
        )

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name, including those that were held."""
        return dict(zip(parameter_names(self.model), lens_vector(self.camera).tolist(), strict=True))


def doubts_of(result: IntrinsicsResult) -> tuple[str, ...]:
    """What the views can't support, one line each."""
    return (*_target(result), *_parameters(result), *_views(result))


def _target(result: IntrinsicsResult) -> list[str]:
    if result.target is None:
        return []
    places_m, moved_m = result.target.places_m, result.displacement_m
    off_mm = 1e3 * off_plane_m(places_m, moved_m)
    uneven = f"{UNEVEN_TARGET}: its points lie up to {off_mm:.2g} mm off a plane, alike in all images"
    return [f"{uneven}; their places were estimated, too, and the ± includes it; a print on glass or metal is flat"]


def _parameters(result: IntrinsicsResult) -> list[str]:
    out = []
    values = result.values
    sigma = dict(zip(result.parameters, np.sqrt(result.covariance.diagonal()).tolist(), strict=True))
    focal = sigma.get("fx_px", 0.0)
    if focal > DOUBTFUL_FOCAL * result.camera.fx_px:
        out.append(
            f"the focal length is uncertain by {100.0 * focal / result.camera.fx_px:.1f} %: views tilted by 20 to 45 "
            "degrees to different sides determine it"
        )
    lens = [n for n in result.parameters if n.startswith(("coefficients", "kappa"))]
    return out + [
        f"{n} can't be distinguished from 0 ({values[n]:.3g} ± {sigma[n]:.2g}): a model with fewer parameters"
        for n in lens
        if abs(values[n]) < 2.0 * sigma[n]
    ]


def _views(result: IntrinsicsResult) -> list[str]:
    out = []
    half_px = 0.5 * np.array([result.camera.width_px, result.camera.height_px])
    reach = max(float(np.linalg.norm(s.uv_px - half_px, axis=1).max()) for s in result.sightings)
    if reach < COVERED * float(np.linalg.norm(half_px)):
        out.append(
            f"no point lies farther than {100.0 * reach / float(np.linalg.norm(half_px)):.0f} % of the way from the "
            "image's centre to its corners: beyond, the lens is extrapolated"
        )
    lost = sum(int((~u).sum()) for u in result.used)
    total = sum(len(u) for u in result.used)
    if lost > 0.1 * total:
        out.append(
            f"{lost} of {total} points don't fit and were left out: is the target flat, and its description right?"
        )
    if result.rms_px > LARGE_RMS_SHARE * result.camera.width_px:
        out.append(
            f"residuals of {result.rms_px:.2g} px are large: is the target flat, the focus fixed, the model right?"
        )
    rms = result.view_rms_px
    for sighting, value in zip(result.sightings, rms, strict=True):
        if value > 3.0 * float(np.median(rms)) and value > 0.1:
            out.append(f"{sighting.name} fits badly: {value:.2g} px, the others {float(np.median(rms)):.2g} px")
    return out
