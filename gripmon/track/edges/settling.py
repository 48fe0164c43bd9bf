"""The corner measurement at one place: search lines about an expected pose, one robust fit, corners, covariance."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.compiled import compiled
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Image
from gripmon.track.edges.lines import CornerGeometry, Corners, intersect_edges
from gripmon.track.edges.prediction import EdgeLayout, Prediction, lay_out, predict
from gripmon.track.edges.profiles import (
    Candidates,
    Edgels,
    blur_px,
    estimate_noise,
    find_candidates,
    full_scale,
    profile_offsets_px,
    quantum,
    read_profiles,
    weigh,
)
from gripmon.track.edges.robust_fit import (
    CONTRADICTION_RATIO,
    RESTART_WIDTH_PX,
    NormalEquations,
    Prior,
    RobustFit,
    Uncertainty,
    assess,
    fit_irls,
    prior_information,
    refit_visible,
    without_one_edge,
)
from gripmon.track.edges.settings import MeasurementSettings
from gripmon.track.edges.taught import TaughtEdges
from gripmon.track.jaw import OpeningSeen

RELAYOUT_PX = 6.0
"""Motion of the prediction after which the sampled parts of the edges are chosen again, px."""

JAW_UNREPORTED_SIGMA_M = 0.02
"""Standard deviation of a jaw opening that is not reported, m: a bound on its change between frames."""

ZOOMS = (1, 2, 4)
"""Factors on all lengths along the search lines, for images that are out of focus."""

BLUR_AT_ZOOM = (0.7, 1.7)
"""Blur of the edges at zoom 1, px, below which the next finer and above which the next coarser zoom fits better."""


class Effort(enum.IntEnum):
    """How far the gripper had to be searched for."""

    NARROW = 0
    GRID = 1
    SEARCH = 2


@dataclass(slots=True)
class Measurement:
    """``cam_T_grip`` and ``jaw_opening_m`` from the inlier edgels, with all intermediate results.

    ``covariance`` (6 or 7, 6 or 7) of ``xi`` (and the opening); ``jaw_innovation``: the seen jaw opening less the
    reported one (``jaw_reported_m``), in standard deviations of the latter.

    ``normal``: the fit's normal equations edge by edge; ``jaw_known_m`` with its standard deviation: the opening as far
    as it is known without the image; ``jaw_seen``: what the image tells of the report's error, None for nothing.

    ``blur_px``: standard deviation across the edges that agreed, None with few of them.  ``cut_off`` (v,): which of the
    seen edges are less certain by what is cut off beside them, white or black, than by all else.

    ``trusted``: enough search lines agree; fewer suffice where the gripper was expected than where it was looked for.
    ``effort``: what found it; ``looked_far``: whether more than the narrow way was tried.
    """

    prediction: Prediction
    candidates: Candidates
    consensus: RobustFit
    corners: Corners
    cam_T_grip: Array
    jaw_opening_m: float
    covariance: Array
    jaw_reported_m: float
    jaw_innovation: float
    effort: Effort
    normal: NormalEquations
    jaw_known_m: float
    jaw_known_sigma_m: float
    blur_px: float | None
    cut_off: NDArray[np.bool_]
    trusted: bool = False
    looked_far: bool = False
    jaw_seen: OpeningSeen | None = None

    def corners_at(self, jaw_opening_m: float) -> Array:
        """Corners (c, 3) in the camera frame at the prediction's pose, but with another jaw opening."""
        prediction = self.prediction
        opened_m = jaw_opening_m - prediction.jaw_opening_m
        return prediction.corners.cam_m + opened_m * prediction.corners.jaw_rate

    def moved_px(self, cam_T_grip: Array) -> float:
        """Distance of the measured gripper from where ``cam_T_grip`` (4, 4) puts it, px."""
        return self.prediction.moved_px(perturbation_between(cam_T_grip, self.cam_T_grip))

    def corner_rms_px(self, cam_T_grip: Array) -> float | None:
        """Root mean square distance between the usable corners and where ``cam_T_grip`` puts them, px; None without
        corners.
        """
        prediction, corners = self.prediction, self.corners
        rms_px = corner_rms(
            corners.xy,
            corners.usable,
            self.corners_at(self.jaw_opening_m),
            prediction.cam_T_grip,
            cam_T_grip,
            prediction.corners.d_uv_d_xy,
        )
        return None if math.isnan(rms_px) else rms_px


@compiled
def corner_rms(xy: Any, usable: Any, points_m: Any, predicted_T: Any, cam_T_grip: Any, lens: Any) -> float:
    """Of corners ``points_m`` (c, 3) that move from one pose to the other, against ``xy``; NaN without usable ones."""
    squares, count, place = 0.0, 0, np.empty(3)
    for c in range(len(usable)):
        if not usable[c]:
            continue
        count += 1
        for i in range(3):
            place[i] = cam_T_grip[i, 3]
            for j in range(3):
                lever = 0.0  # along the axis j of the gripper
                for k in range(3):
                    lever += predicted_T[k, j] * (points_m[c, k] - predicted_T[k, 3])
                place[i] += cam_T_grip[i, j] * lever
        miss_x, miss_y = xy[c, 0] - place[0] / place[2], xy[c, 1] - place[1] / place[2]
        for i in range(2):
            squares += (lens[c, i, 0] * miss_x + lens[c, i, 1] * miss_y) ** 2
    return math.sqrt(squares / count) if count else math.nan


class Expected(NamedTuple):
    """A pose and the two openings that go with it: the one to start from and the one that the robot reports.

    ``held_sigma`` (6,): edges are chosen as if the gripper were at ``held_T`` (4, 4) but for that, m and rad; what is
    chosen is then measured freely.
    """

    cam_T_grip: Array
    jaw_opening_m: float
    jaw_reported_m: float
    held_T: Array | None = None
    held_sigma: Array | None = None


class Settler:
    """Fits one gripper in the images of one camera from where it is expected.  Keeps the prediction between calls, and
    how blurred the images are.
    """

    def __init__(
        self,
        camera: Camera,
        gripper: Gripper,
        settings: MeasurementSettings,
        jaw_sigma_m: float,
        taught: TaughtEdges | None = None,
    ):
        self._camera, self._gripper, self._taught = camera, gripper, taught
        self._settings = settings.with_response(taught is not None)
        # What the gripper file says of an edge's polarity counts; teaching fills in the rest.
        known = gripper.edge_polarity
        self._polarity = known if taught is None else np.where(known, known, taught.polarity)
        self._offsets_px = profile_offsets_px(settings.sampling.reach_px)
        self._zoom = 1
        self._prior_reported = prior_information(jaw_sigma_m if gripper.has_jaw else None)
        self._prior_unreported = prior_information(JAW_UNREPORTED_SIGMA_M if gripper.has_jaw else None)
        self._prior = self._prior_reported
        self._laid_out: dict[int, tuple[EdgeLayout, Array]] = {}  # by zoom
        self._prediction: dict[int, Prediction] = {}
        self._geometry: tuple[Prediction, CornerGeometry] | None = None

    def _settle(self, image: Image, expected: Expected) -> Measurement:
        """Fit from the expected pose; linearise again where the result lies too far from the prediction, twice at
        most.  Where nothing agrees no fit leads to anything: it isn't followed.
        """
        settings, moved = self._settings, None
        for _ in range(3):
            prediction, start = self._predicted(expected)
            edgels = self._look(image, prediction)
            prior = self._prior_about(prediction, expected)
            consensus = fit_irls(edgels, prior, start, settings.consensus)
            if expected.held_T is not None:
                free = self._prior_about(prediction, expected._replace(held_T=None))
                consensus = fit_irls(edgels, free, consensus.xi, settings.consensus, RESTART_WIDTH_PX)
            moved_px = prediction.moved_px(consensus.xi)
            if moved_px > 2.0 * self._reach_px:
                # Nothing was seen there: the few inliers don't determine the motion.
                consensus = consensus._replace(share=0.0)
            if consensus.share == 0.0:
                break
            expected, moved = self._moved(prediction, consensus.xi, expected), consensus
            if moved_px <= settings.relinearise_px:
                break
        if expected.held_T is not None:
            prior = self._prior_about(prediction, expected._replace(held_T=None))
        edgels, consensus = refit_visible(edgels, prior, consensus, settings.consensus)
        uncertainty = self._assess(edgels, consensus)
        if uncertainty.contradiction > CONTRADICTION_RATIO and consensus.share > 0.0:
            found = without_one_edge(edgels, prior, start, settings.consensus, uncertainty.contradiction)
            if found is not None:
                edgels, consensus, uncertainty = found
        if consensus is not moved:
            expected = self._moved(prediction, consensus.xi, expected)
        if self._geometry is None or self._geometry[0] is not prediction:
            self._geometry = prediction, CornerGeometry.of(self._gripper, prediction, settings.corners)
        corners = intersect_edges(edgels, consensus, uncertainty.line_weight, self._geometry[1], settings.corners)
        jaw_known_sigma_m = jaw_innovation = 0.0
        if len(self._prior) == 7:
            jaw_known_sigma_m = float(self._prior[6] ** -0.5)
            jaw_innovation = float((consensus.xi[6] - prior.mean[6]) * np.sqrt(prior.information[6]))
        return Measurement(
            prediction,
            edgels.candidates,
            consensus,
            corners,
            expected.cam_T_grip,
            expected.jaw_opening_m,
            uncertainty.covariance,
            expected.jaw_reported_m,
            jaw_innovation,
            Effort.NARROW,
            uncertainty.normal,
            expected.jaw_reported_m,
            jaw_known_sigma_m,
            blur_px(edgels.candidates, consensus.weight, settings.edges),
            (edgels.cut_off_px > edgels.edge_spread_px)[uncertainty.normal.edge],
        )

    def _fitting_zoom(self, measurement: Measurement) -> int:
        """The zoom for the next frame: by how blurred the edges are that agreed."""
        blur_px = measurement.blur_px
        if blur_px is None:
            return self._zoom
        finer, coarser = BLUR_AT_ZOOM
        if blur_px > coarser * self._zoom:
            return min(2 * self._zoom, ZOOMS[-1])
        return max(self._zoom // 2, 1) if blur_px < finer * self._zoom else self._zoom

    @property
    def _reach_px(self) -> float:
        return self._zoom * self._settings.sampling.reach_px

    def _predicted(self, expected: Expected) -> tuple[Prediction, Array]:
        """The kept prediction while it holds, else a new one at the expected pose; and the unknowns (m,) from it to
        there.
        """
        kept, laid_out = self._prediction.get(self._zoom), self._laid_out.get(self._zoom)
        if kept is not None and len(kept.uv_px):
            start = np.empty(len(self._prior))
            start[:6] = perturbation_between(kept.cam_T_grip, expected.cam_T_grip)
            start[6:] = expected.jaw_opening_m - kept.jaw_opening_m
            if kept.moved_px(start) <= self._settings.relinearise_px:
                return kept, start
        if laid_out is None or self._layout_moved_px(laid_out[1], expected) > RELAYOUT_PX:
            laid_out = self._laid_out[self._zoom] = self._lay_out(expected), self._corner_pixels(expected)
        prediction = self._prediction[self._zoom] = self._predict(laid_out[0], expected)
        return prediction, np.zeros(len(self._prior))

    def _lay_out(self, expected: Expected) -> EdgeLayout:
        sampling = self._settings.sampling
        margin_px = self._zoom * sampling.end_margin_px
        sampling = msgspec.structs.replace(sampling, reach_px=self._reach_px, end_margin_px=margin_px)
        cam_T_grip, jaw_opening_m = expected.cam_T_grip, expected.jaw_opening_m
        return lay_out(self._camera, self._gripper, cam_T_grip, jaw_opening_m, sampling, self._taught)

    def _predict(self, layout: EdgeLayout, expected: Expected) -> Prediction:
        jaw_unknown = len(self._prior) == 7
        return predict(
            self._camera,
            self._gripper,
            layout,
            expected.cam_T_grip,
            expected.jaw_opening_m,
            self._zoom * self._offsets_px,
            jaw_unknown,
            self._taught,
        )

    def _layout_moved_px(self, corners_px: Array, expected: Expected) -> float:
        """How far the corners are from where they were laid out, px."""
        moved = np.abs(self._corner_pixels(expected) - corners_px)
        return float(np.nanmax(moved)) if np.isfinite(moved).any() else np.inf

    def _corner_pixels(self, expected: Expected) -> Array:
        points_grip_m = self._gripper.points_grip_m(expected.jaw_opening_m)[self._gripper.corner_points]
        return self._camera.project(points_grip_m @ expected.cam_T_grip[:3, :3].T + expected.cam_T_grip[:3, 3])

    def _look(self, image: Image, prediction: Prediction) -> Edgels:
        settings = self._settings
        profiles = read_profiles(image, prediction.map_x, prediction.map_y, settings.edges.response)
        noise = estimate_noise(profiles, quantum(image))
        candidates = find_candidates(profiles, prediction.ok, noise, full_scale(image), settings.edges, self._zoom)
        return weigh(candidates, prediction, self._polarity, settings.consensus)

    def _assess(self, edgels: Edgels, consensus: RobustFit) -> Uncertainty:
        return assess(edgels, consensus, self._prior)

    def _prior_about(self, prediction: Prediction, expected: Expected) -> Prior:
        mean, information = np.zeros(len(self._prior)), self._prior
        mean[6:] = expected.jaw_reported_m - prediction.jaw_opening_m
        if expected.held_T is not None and expected.held_sigma is not None:
            mean[:6] = perturbation_between(prediction.cam_T_grip, expected.held_T)
            information = information + np.append(expected.held_sigma**-2.0, np.zeros(len(mean) - 6))
        return Prior(mean, information)

    def _moved(self, prediction: Prediction, xi: Array, expected: Expected) -> Expected:
        """The expectation after a fit; an opening beyond the jaw's range stays at its end (the fit sees the misfit)."""
        gripper = self._gripper
        jaw_opening_m = prediction.jaw_opening_m + (float(xi[6]) if len(xi) == 7 else 0.0)
        jaw_opening_m = min(max(jaw_opening_m, gripper.jaw_min_m), gripper.jaw_max_m)
        cam_T_grip = perturb(prediction.cam_T_grip, xi[:6])
        return Expected(cam_T_grip, jaw_opening_m, expected.jaw_reported_m, expected.held_T, expected.held_sigma)
