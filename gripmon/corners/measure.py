"""The corner measurement as one: from an image and an expected pose to edge points that agree, and corners.

The cheap way is tried first: profiles about the expected pose and one robust fit.  Only when too few profiles agree
are other starts tried, and only when those fail, too, is the gripper searched for in the whole neighbourhood.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from gripmon.camera import Camera
from gripmon.corners.consensus import (
    Consensus,
    ConsensusSettings,
    Prior,
    Votes,
    agree,
    agree_from_grid,
    agree_on_seen,
    base_weights,
    grid_of_starts,
    prior_information,
)
from gripmon.corners.lines import CornerGeometry, Corners, CornerSettings, intersect_edges
from gripmon.corners.prediction import EdgeLayout, Prediction, SamplingSettings, lay_out, predict
from gripmon.corners.profiles import (
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
from gripmon.corners.search import SearchSettings, search_poses
from gripmon.corners.taught import TaughtEdges
from gripmon.corners.uncertainty import CONTRADICTION, Uncertainty, assess, without_one_edge
from gripmon.geometry import perturb, perturbation_between
from gripmon.gripper import Gripper
from gripmon.records import Array, Image

RELAYOUT_PX = 6.0
"""Motion of the prediction after which the sampled parts of the edges are chosen anew, px."""


JAW_UNREPORTED_SIGMA_M = 0.02
"""What is known about a jaw opening that nobody reports, m: it changes by this much between frames at most."""


FOUND_EDGES = 0.85
"""Part of the sampled edges that must be seen where the gripper was looked for."""

SETTLED_STARTS = 2
"""Starts of a wide search that are followed to the end."""

ZOOMS = (1, 2, 4)
"""Factors on all lengths along the profiles, for images that are out of focus."""

BLUR_AT_ZOOM = (0.7, 1.7)
"""Blur of the edges at zoom 1, px, below which the next finer and above which the next coarser zoom fits better."""

FEWEST_WIDTHS = 20
"""Edge points from which the blur is told."""

SATISFIED = 0.65
"""Part of the usual share below which the gripper may be elsewhere."""

TRUSTED = 0.4
"""Part of the usual share below which a fit is not believed, whatever the settings allow."""

CLEARLY_BETTER = 1.3
"""Factor by which the share elsewhere must exceed a trusted one where the gripper was expected."""


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


@dataclass(frozen=True, slots=True)
class Patience:
    """Whether to look further, which takes the time of many frames: where the fit may be true but is poor, and where
    there is none.
    """

    when_doubtful: bool
    when_lost: bool


@dataclass(slots=True)
class Measurement:
    """``cam_T_grip`` and ``jaw_opening_m`` that the agreed edge points give, and everything that led there.

    ``covariance`` (6 or 7, 6 or 7) of ``xi`` (and the opening); ``jaw_surprise``: the seen jaw opening against the
    reported one (``jaw_reported_m``), in standard deviations of the latter.

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
class _Expected:
    """A pose and the two openings that go with it: the one to start from and the one that the robot reports."""

    cam_T_grip: Array
    jaw_opening_m: float
    jaw_reported_m: float


class FingertipMeter:
    """Measures one gripper with one camera.  Keeps the prediction between calls and nothing that depends on the
    images.
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

    def measure(
        self,
        image: Image,
        cam_T_grip: Array,
        jaw_opening_m: float,
        usual_share: float,
        patience: Patience,
        jaw_reported: bool = True,
    ) -> Measurement:
        """Measure about an expected pose and jaw opening (``jaw_reported``: by the robot; else it is only a guess to
        start from).

        ``usual_share`` of the profiles agree when all is well.  With clearly less, and where ``patience`` allows, the
        gripper is looked for elsewhere, and the place with the largest share is returned.
        """
        self._prior = self._prior_reported if jaw_reported else self._prior_unreported
        # Encoders report a little beyond the end at which a jaw stands.
        jaw_opening_m = min(max(jaw_opening_m, self._gripper.jaw_min_m), self._gripper.jaw_max_m)
        expected = _Expected(cam_T_grip, jaw_opening_m, jaw_opening_m)
        best = self._settle(image, expected)
        satisfied = SATISFIED * usual_share
        if self._gripper.has_jaw and not jaw_reported:
            best = self._from_openings(image, expected, satisfied, best)
        if best.consensus.share < satisfied:
            best = self._at_other_zooms(image, expected, best)
        if best.consensus.share >= self._settings.consensus.trusted_share:
            self._zoom_to(self._fitting_zoom(best))
        if best.consensus.share >= satisfied:
            best.trusted = best.consensus.share >= self._settings.consensus.trusted_share
            return best
        best.trusted = trusted = self._trusted(best, usual_share)
        if not (patience.when_doubtful if trusted else patience.when_lost):
            return best
        # Fingers look alike when they slide along themselves: elsewhere must be clearly better than a place that may
        # be true.
        beat = CLEARLY_BETTER * best.consensus.share if trusted else best.consensus.share
        for look in (self._from_grid, self._search):
            other = look(image, expected)
            # A place that may be true is not given up for one that isn't believed.
            if other.consensus.share > max(beat, best.consensus.share) and (
                not trusted or self._trusted(other, usual_share)
            ):
                best = other
            if best.consensus.share >= satisfied:
                break
        best.trusted, best.looked_far = self._trusted(best, usual_share), True
        return best

    def _at_other_zooms(self, image: Image, expected: _Expected, best: Measurement) -> Measurement:
        """The best of the zooms: the image may have lost, or found, its focus."""
        chosen = self._zoom
        for zoom in ZOOMS:
            if zoom == chosen:
                continue
            self._zoom_to(zoom)
            other = self._settle(image, expected)
            # A coarse zoom reaches far and sees little: only where the edges are as blurred as it expects.
            if other.consensus.share > CLEARLY_BETTER * best.consensus.share and self._fitting_zoom(other) == zoom:
                best, chosen = other, zoom
        self._zoom_to(chosen)
        return best

    def _fitting_zoom(self, measurement: Measurement) -> int:
        """The zoom for the next frame: by how blurred the edges are that agreed."""
        widths_px = measurement.candidates.width_px[measurement.consensus.weight > 0.0]
        if len(widths_px) < FEWEST_WIDTHS:
            return self._zoom
        kernel_px = measurement.candidates.zoom * self._settings.edges.blur_px
        blur_px = math.sqrt(max(_median(widths_px) ** 2 - kernel_px**2, 0.0))
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

    def _trusted(self, measurement: Measurement, usual_share: float) -> bool:
        consensus = self._settings.consensus
        if measurement.effort is Effort.NARROW:
            return measurement.consensus.share >= max(consensus.trusted_share, TRUSTED * usual_share)
        # Slid along its fingers a gripper looks like itself but for its tips: elsewhere most edges must be seen.
        return _shows_nearly_all(measurement) and measurement.consensus.share >= max(
            consensus.found_share, TRUSTED * usual_share
        )

    def _settle(self, image: Image, expected: _Expected) -> Measurement:
        """Fit from the expected pose; linearise again where the result lies too far from the prediction, twice at
        most.
        """
        settings = self._settings
        for _ in range(3):
            prediction, start = self._predicted(expected)
            votes = self._look(image, prediction)
            prior = self._prior_about(prediction, expected)
            consensus = agree(votes, prior, start, settings.consensus)
            moved_px = prediction.moved_px(consensus.xi)
            if moved_px > 2.0 * self._reach_px:
                # Nothing was seen out there: the few points that agree don't determine the motion.
                consensus = replace(consensus, share=0.0)
                break
            expected = self._moved(prediction, consensus.xi, expected)
            if moved_px <= settings.relinearise_px:
                break
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
        )

    def _from_openings(self, image: Image, expected: _Expected, satisfied: float, best: Measurement) -> Measurement:
        """Starts at other openings, for a jaw that moves and doesn't report it: nearby first, then in its whole range
        until nearly all edges are seen.
        """
        prediction, _ = self._predicted(expected)
        rate = float(np.abs(prediction.jacobian[:, 6]).max(initial=0.0))  # px/m
        if rate == 0.0:
            return best
        gripper, step_m = self._gripper, 0.8 * self._reach_px / rate
        starts = np.zeros((7, 7))
        starts[:, 6] = np.linspace(-0.5, 0.5, len(starts)) * step_m
        openings_m = expected.jaw_opening_m + step_m * np.arange(
            math.floor((gripper.jaw_min_m - expected.jaw_opening_m) / step_m),
            math.ceil((gripper.jaw_max_m - expected.jaw_opening_m) / step_m) + 1,
        )
        openings_m = np.clip(openings_m, gripper.jaw_min_m, gripper.jaw_max_m)
        for opening_m in sorted(openings_m.tolist(), key=lambda o: abs(o - expected.jaw_opening_m)):
            far = abs(opening_m - expected.jaw_opening_m) > 2.1 * step_m
            if far and best.consensus.share >= satisfied and _shows_nearly_all(best):
                break
            there = replace(expected, jaw_opening_m=opening_m)
            seen = self._predict(prediction.layout, there)
            votes, prior = self._look(image, seen), self._prior_about(seen, there)
            fit = agree_from_grid(votes, prior, starts, self._settings.consensus, refine=len(starts))
            if _completeness(fit, seen) > _completeness(best.consensus, best.prediction):
                other = self._settle(image, self._moved(seen, fit.xi, there))
                best = max(best, other, key=lambda m: _completeness(m.consensus, m.prediction))
        return best

    def _from_grid(self, image: Image, expected: _Expected) -> Measurement:
        """Starts all over the reach of the profiles; the best one settled."""
        prediction, start = self._predicted(expected)
        if not prediction.ok.any():
            return self._settle(image, expected)
        settings = self._settings.consensus
        starts = grid_of_starts(prediction, self._reach_px, settings.start_width_px)
        prior = self._prior_about(prediction, expected)
        consensus = agree_from_grid(self._look(image, prediction), prior, starts + start, settings)
        return replace(self._settle(image, self._moved(prediction, consensus.xi, expected)), effort=Effort.GRID)

    def _search(self, image: Image, expected: _Expected) -> Measurement:
        """The places that a search in a reduced image proposes, all tried roughly; the most promising are settled."""
        tried = []
        search, jaw_opening_m = self._settings.search, expected.jaw_opening_m
        for cam_T_grip in search_poses(image, self._camera, self._gripper, expected.cam_T_grip, jaw_opening_m, search):
            there = replace(expected, cam_T_grip=cam_T_grip)
            seen = self._predict(self._lay_out(there), there)
            if not seen.ok.any():
                continue
            prior = self._prior_about(seen, there)
            fit = agree(self._look(image, seen), prior, np.zeros(len(self._prior)), self._settings.consensus)
            tried.append((fit.share, self._moved(seen, fit.xi, there)))
        tried.sort(key=lambda item: -item[0])
        found = [self._settle(image, there) for _, there in tried[:SETTLED_STARTS]]
        return replace(max(found, key=_agreement) if found else self._settle(image, expected), effort=Effort.SEARCH)

    def _predicted(self, expected: _Expected) -> tuple[Prediction, Array]:
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

    def _lay_out(self, expected: _Expected) -> EdgeLayout:
        sampling = self._settings.sampling
        margin_px = self._zoom * sampling.end_margin_px
        sampling = msgspec.structs.replace(sampling, reach_px=self._reach_px, end_margin_px=margin_px)
        cam_T_grip, jaw_opening_m = expected.cam_T_grip, expected.jaw_opening_m
        return lay_out(self._camera, self._gripper, cam_T_grip, jaw_opening_m, sampling, self._taught)

    def _predict(self, layout: EdgeLayout, expected: _Expected) -> Prediction:
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

    def _layout_moved_px(self, expected: _Expected) -> float:
        assert self._laid_out is not None
        moved = np.abs(self._corner_pixels(expected) - self._laid_out[1])
        return float(np.nanmax(moved)) if np.isfinite(moved).any() else np.inf

    def _corner_pixels(self, expected: _Expected) -> Array:
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
        width_px = max(_median(candidates.width_px), 1.0) if len(candidates.sample) else 1.0
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

    def _from_prediction(self, prediction: Prediction, expected: _Expected) -> Array:
        """(m,) from the prediction's pose and opening to the expected ones."""
        xi = perturbation_between(prediction.cam_T_grip, expected.cam_T_grip)
        return np.append(xi, expected.jaw_opening_m - prediction.jaw_opening_m) if len(self._prior) == 7 else xi

    def moved_px(self, measurement: Measurement, cam_T_grip: Array) -> float:
        """How far the measured gripper shows from where ``cam_T_grip`` had put it, px."""
        return measurement.prediction.moved_px(perturbation_between(cam_T_grip, measurement.cam_T_grip))

    def _prior_about(self, prediction: Prediction, expected: _Expected) -> Prior:
        mean = np.zeros(len(self._prior))
        mean[6:] = expected.jaw_reported_m - prediction.jaw_opening_m
        return Prior(mean, self._prior)

    def _moved(self, prediction: Prediction, xi: Array, expected: _Expected) -> _Expected:
        """The expectation after a fit; an opening beyond the jaw's range stays at its end (the fit sees the misfit)."""
        gripper = self._gripper
        jaw_opening_m = prediction.jaw_opening_m + (float(xi[6]) if len(xi) == 7 else 0.0)
        jaw_opening_m = min(max(jaw_opening_m, gripper.jaw_min_m), gripper.jaw_max_m)
        return _Expected(perturb(prediction.cam_T_grip, xi[:6]), jaw_opening_m, expected.jaw_reported_m)


def _agreement(measurement: Measurement) -> float:
    return measurement.consensus.share


def _shows_nearly_all(measurement: Measurement) -> bool:
    return _seen_part(measurement.consensus, measurement.prediction) >= FOUND_EDGES


def _seen_part(consensus: Consensus, prediction: Prediction) -> float:
    """Part of the sampled edges that are seen."""
    edges = prediction.layout.edges
    return np.count_nonzero(consensus.edge_seen[edges]) / max(len(edges), 1)


def _completeness(consensus: Consensus, prediction: Prediction) -> float:
    """At a wrong opening one finger can agree alone: what agrees counts by how many edges it is spread over."""
    return consensus.share * _seen_part(consensus, prediction)


def _median(values: Array) -> float:
    """The upper one of two middle values; NumPy's own checks for NaN take longer than the rest."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])
