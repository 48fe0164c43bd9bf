"""The corner measurement as one: from an image and an expected pose to edge points that agree, and corners.

The cheap way is tried first: profiles about the expected pose and one robust fit.  Only when too few profiles agree
are other starts tried, and only when those fail, too, is the gripper searched for in the whole neighbourhood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gripmon.corners.consensus import (
    Consensus,
    agree,
    agree_from_grid,
    grid_of_starts,
)
from gripmon.corners.prediction import Prediction
from gripmon.corners.search import search_poses
from gripmon.corners.settling import ZOOMS, Effort, Expected, Measurement, Settler
from gripmon.records import Array, Image

FOUND_EDGES = 0.85
"""Part of the sampled edges that must be seen where the gripper was looked for."""

SETTLED_STARTS = 2
"""Starts of a wide search that are followed to the end."""

SATISFIED = 0.65
"""Part of the usual share below which the gripper may be elsewhere."""

TRUSTED = 0.4
"""Part of the usual share below which a fit is not believed, whatever the settings allow."""

CLEARLY_BETTER = 1.3
"""Factor by which the share elsewhere must exceed a trusted one where the gripper was expected."""


@dataclass(frozen=True, slots=True)
class Patience:
    """Whether to look further, which takes the time of many frames: where the fit may be true but is poor, and where
    there is none.
    """

    when_doubtful: bool
    when_lost: bool


class FingertipMeter(Settler):
    """Measures one gripper with one camera, and looks for it elsewhere when it isn't seen where it is expected."""

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
        expected = Expected(cam_T_grip, jaw_opening_m, jaw_opening_m)
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

    def _at_other_zooms(self, image: Image, expected: Expected, best: Measurement) -> Measurement:
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

    def _trusted(self, measurement: Measurement, usual_share: float) -> bool:
        consensus = self._settings.consensus
        if measurement.effort is Effort.NARROW:
            return measurement.consensus.share >= max(consensus.trusted_share, TRUSTED * usual_share)
        # Slid along its fingers a gripper looks like itself but for its tips: elsewhere most edges must be seen.
        return _shows_nearly_all(measurement) and measurement.consensus.share >= max(
            consensus.found_share, TRUSTED * usual_share
        )

    def _from_openings(self, image: Image, expected: Expected, satisfied: float, best: Measurement) -> Measurement:
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

    def _from_grid(self, image: Image, expected: Expected) -> Measurement:
        """Starts all over the reach of the profiles; the best one settled."""
        prediction, start = self._predicted(expected)
        if not prediction.ok.any():
            return self._settle(image, expected)
        settings = self._settings.consensus
        starts = grid_of_starts(prediction, self._reach_px, settings.start_width_px)
        prior = self._prior_about(prediction, expected)
        consensus = agree_from_grid(self._look(image, prediction), prior, starts + start, settings)
        return replace(self._settle(image, self._moved(prediction, consensus.xi, expected)), effort=Effort.GRID)

    def _search(self, image: Image, expected: Expected) -> Measurement:
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
