"""The corner measurement at one place: profiles about an expected pose, one robust fit, corners, covariance."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Image
from gripmon.track.edges.consensus import (
    AGAIN_PX,
    Consensus,
    ConsensusSettings,
    Prior,
    Votes,
    agree,
    agree_on_seen,
    base_weights,
    prior_information,
)
from gripmon.track.edges.lines import CornerGeometry, Corners, CornerSettings, intersect_edges
from gripmon.track.edges.prediction import EdgeLayout, Prediction, SamplingSettings, lay_out, predict
from gripmon.track.edges.profiles import (
    Candidates,
    EdgeSettings,
    cut_off_spread,
    estimate_noise,
    find_candidates,
    full_scale,
    profile_offsets_px,
    quantum,
    read_profiles,
)
from gripmon.track.edges.search import SearchSettings
from gripmon.track.edges.taught import TaughtEdges
from gripmon.track.edges.uncertainty import CONTRADICTION, NormalEquations, Uncertainty, assess, without_one_edge

RELAYOUT_PX = 6.0
"""Motion of the prediction after which the sampled parts of the edges are chosen anew, px."""

JAW_UNREPORTED_SIGMA_M = 0.02
"""What is known about a jaw opening that nobody reports, m: it changes by this much between frames at most."""

ZOOMS = (1, 2, 4)
"""Factors on all lengths along the profiles, for images that are out of focus."""

BLUR_AT_ZOOM = (0.7, 1.7)
"""Blur of the edges at zoom 1, px, below which the next finer and above which the next coarser zoom fits better."""

FEWEST_WIDTHS = 20
"""Edge points from which the blur is told."""


class MeasurementSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From the image to edge points and corners."""

    sampling: SamplingSettings = SamplingSettings()
    edges: EdgeSettings = EdgeSettings()
    consensus: ConsensusSettings = ConsensusSettings()
    corners: CornerSettings = CornerSettings()
    search: SearchSettings = SearchSettings()
    relinearise_px: Annotated[
        float, Meta(ge=0.05, le=5.0, description="motion from the prediction after which it is computed anew (px)")
    ] = 1.0


class Effort(enum.IntEnum):
    """How far the gripper had to be looked for."""

    NARROW = 0
    GRID = 1
    SEARCH = 2


@dataclass(slots=True)
class Measurement:
    """``cam_T_grip`` and ``jaw_opening_m`` that the agreed edge points give, and everything that led there.

    ``covariance`` (6 or 7, 6 or 7) of ``xi`` (and the opening); ``jaw_surprise``: the seen jaw opening against the
    reported one (``jaw_reported_m``), in standard deviations of the latter.

    ``normal``: the fit's normal equations edge by edge; ``jaw_known_m`` with its standard deviation: the opening as far
    as it is known without the image.

    ``trusted``: enough profiles agree; fewer suffice where the gripper was expected than where it was looked for.
    ``effort``: what found it; ``looked_far``: whether more than the narrow way was tried.
    """

    prediction: Prediction
    candidates: Candidates
    consensus: Consensus
    corners: Corners
    cam_T_grip: Array
    jaw_opening_m: float
    covariance: Array
    jaw_reported_m: float
    jaw_surprise: float
    effort: Effort
    normal: NormalEquations
    jaw_known_m: float
    jaw_known_sigma_m: float
    trusted: bool = False
    looked_far: bool = False

    def corners_at(self, jaw_opening_m: float) -> Array:
        """Corners (c, 3) in the camera frame at the prediction's pose, but with another jaw opening."""
        prediction = self.prediction
        opened_m = jaw_opening_m - prediction.jaw_opening_m
        return prediction.corners.cam_m + opened_m * prediction.corners.jaw_rate

    def corner_rms_px(self, cam_T_grip: Array) -> float | None:
        """Root mean square distance between the usable corners and where ``cam_T_grip`` puts them, px; None without
        corners.
        """
        usable = self.corners.usable
        count = int(np.count_nonzero(usable))
        if not count:
            return None
        prediction = self.prediction
        turn = cam_T_grip[:3, :3] @ prediction.cam_T_grip[:3, :3].T
        points = (self.corners_at(self.jaw_opening_m) - prediction.cam_T_grip[:3, 3]) @ turn.T + cam_T_grip[:3, 3]
        miss_xy = self.corners.xy - points[:, :2] / points[:, 2:]
        miss_px = (prediction.corners.d_uv_d_xy @ miss_xy[..., None])[usable]
        return math.sqrt(float(np.vdot(miss_px, miss_px)) / count)


@dataclass(frozen=True, slots=True)
class Expected:
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
        self._camera, self._gripper, self._settings, self._taught = camera, gripper, settings, taught
        # What the gripper file says of an edge's polarity counts; teaching fills in the rest.
        known = gripper.edge_polarity
        self._polarity = known if taught is None else np.where(known, known, taught.polarity)
        self._offsets_px = profile_offsets_px(settings.sampling.reach_px)
        self._zoom = 1
        self._prior_reported = prior_information(jaw_sigma_m if gripper.has_jaw else None)
        self._prior_unreported = prior_information(JAW_UNREPORTED_SIGMA_M if gripper.has_jaw else None)
        self._prior = self._prior_reported
        self._laid_out: tuple[EdgeLayout, Array] | None = None
        self._prediction: Prediction | None = None

    def _settle(self, image: Image, expected: Expected) -> Measurement:
        """Fit from the expected pose; linearise again where the result lies too far from the prediction, twice at
        most.
        """
        settings = self._settings
        for _ in range(3):
            prediction, start = self._predicted(expected)
            votes = self._look(image, prediction)
            prior = self._prior_about(prediction, expected)
            consensus = agree(votes, prior, start, settings.consensus)
            if expected.held_T is not None:
                free = self._prior_about(prediction, replace(expected, held_T=None))
                consensus = agree(votes, free, consensus.xi, settings.consensus, AGAIN_PX)
            moved_px = prediction.moved_px(consensus.xi)
            if moved_px > 2.0 * self._reach_px:
                # Nothing was seen out there: the few points that agree don't determine the motion.
                consensus = replace(consensus, share=0.0)
                break
            expected = self._moved(prediction, consensus.xi, expected)
            if moved_px <= settings.relinearise_px:
                break
        prior = self._prior_about(prediction, replace(expected, held_T=None))
        votes, consensus = agree_on_seen(votes, prior, consensus, settings.consensus)
        uncertainty = self._assess(votes, consensus)
        if uncertainty.contradiction > CONTRADICTION:
            found = without_one_edge(votes, prior, start, settings.consensus, uncertainty.contradiction)
            if found is not None:
                votes, consensus, uncertainty = found
        expected = self._moved(prediction, consensus.xi, expected)
        corners = intersect_edges(votes, consensus, uncertainty.line_weight, self._geometry, settings.corners)
        return Measurement(
            prediction,
            votes.candidates,
            consensus,
            corners,
            expected.cam_T_grip,
            expected.jaw_opening_m,
            uncertainty.covariance,
            expected.jaw_reported_m,
            self._jaw_surprise(consensus.xi, prior),
            Effort.NARROW,
            uncertainty.normal,
            expected.jaw_reported_m,
            float(self._prior[6] ** -0.5) if len(self._prior) == 7 else 0.0,
        )

    def _fitting_zoom(self, measurement: Measurement) -> int:
        """The zoom for the next frame: by how blurred the edges are that agreed."""
        widths_px = measurement.candidates.width_px[measurement.consensus.weight > 0.0]
        if len(widths_px) < FEWEST_WIDTHS:
            return self._zoom
        kernel_px = measurement.candidates.zoom * self._settings.edges.blur_px
        blur_px = math.sqrt(max(median(widths_px) ** 2 - kernel_px**2, 0.0))
        finer, coarser = BLUR_AT_ZOOM
        if blur_px > coarser * self._zoom:
            return min(2 * self._zoom, ZOOMS[-1])
        return max(self._zoom // 2, 1) if blur_px < finer * self._zoom else self._zoom

    def _zoom_to(self, zoom: int) -> None:
        if zoom != self._zoom:
            self._zoom, self._laid_out, self._prediction = zoom, None, None

    @property
    def _reach_px(self) -> float:
        return self._zoom * self._settings.sampling.reach_px

    def _predicted(self, expected: Expected) -> tuple[Prediction, Array]:
        """The kept prediction while it holds, else a new one at the expected pose; and the unknowns (m,) from it to
        there.
        """
        kept = self._prediction
        if kept is not None and len(kept.uv_px):
            start = self._from_prediction(kept, expected)
            if kept.moved_px(start) <= self._settings.relinearise_px:
                return kept, start
        if self._laid_out is None or self._layout_moved_px(expected) > RELAYOUT_PX:
            self._laid_out = self._lay_out(expected), self._corner_pixels(expected)
        self._prediction = self._predict(self._laid_out[0], expected)
        self._geometry = CornerGeometry.of(self._gripper, self._prediction, self._settings.corners)
        return self._prediction, np.zeros(len(self._prior))

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

    def _layout_moved_px(self, expected: Expected) -> float:
        assert self._laid_out is not None
        moved = np.abs(self._corner_pixels(expected) - self._laid_out[1])
        return float(np.nanmax(moved)) if np.isfinite(moved).any() else np.inf

    def _corner_pixels(self, expected: Expected) -> Array:
        points_grip_m = self._gripper.points_grip_m(expected.jaw_opening_m)[self._gripper.corner_points]
        return self._camera.project(points_grip_m @ expected.cam_T_grip[:3, :3].T + expected.cam_T_grip[:3, 3])

    def _look(self, image: Image, prediction: Prediction) -> Votes:
        settings = self._settings
        profiles = read_profiles(image, prediction.map_x, prediction.map_y)
        noise = estimate_noise(profiles, quantum(image))
        candidates = find_candidates(profiles, prediction.ok, noise, full_scale(image), settings.edges, self._zoom)
        return self._votes(candidates, prediction)

    def _votes(self, candidates: Candidates, prediction: Prediction) -> Votes:
        weights = base_weights(candidates, prediction, self._polarity, self._settings.consensus)
        # A whole edge is off by a share of the edges' width, and by what the model doesn't say of a bevel.
        width_px = max(median(candidates.width_px), 1.0) if len(candidates.sample) else 1.0
        bevel_px = prediction.edge_spread_m * prediction.pixels_per_m
        spread_px = np.hypot(bevel_px, self._settings.consensus.edge_floor_px * width_px)
        return Votes(candidates, prediction, weights, spread_px, width_px * cut_off_spread(candidates, prediction))

    def _assess(self, votes: Votes, consensus: Consensus) -> Uncertainty:
        return assess(votes, consensus, self._prior)

    def _jaw_surprise(self, xi: Array, prior: Prior) -> float:
        """By how many standard deviations of the reported jaw opening the seen one differs from it; zero without a
        jaw.
        """
        return float((xi[6] - prior.mean[6]) * np.sqrt(prior.information[6])) if len(self._prior) == 7 else 0.0

    def _from_prediction(self, prediction: Prediction, expected: Expected) -> Array:
        """(m,) from the prediction's pose and opening to the expected ones."""
        xi = perturbation_between(prediction.cam_T_grip, expected.cam_T_grip)
        return np.append(xi, expected.jaw_opening_m - prediction.jaw_opening_m) if len(self._prior) == 7 else xi

    def moved_px(self, measurement: Measurement, cam_T_grip: Array) -> float:
        """How far the measured gripper shows from where ``cam_T_grip`` had put it, px."""
        return measurement.prediction.moved_px(perturbation_between(cam_T_grip, measurement.cam_T_grip))

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
        return replace(expected, cam_T_grip=perturb(prediction.cam_T_grip, xi[:6]), jaw_opening_m=jaw_opening_m)


def median(values: Array) -> float:
    """The upper one of two middle values; NumPy's own checks for NaN take longer than the rest."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
