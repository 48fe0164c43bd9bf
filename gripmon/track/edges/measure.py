"""The whole corner measurement: from an image and an expected pose to inlier edgels and corners.

The cheap way is tried first: search lines about the expected pose and one robust fit.  Only when too few search lines
agree are other starts tried, and only when those fail, too, is the gripper searched for in the whole neighbourhood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Image
from gripmon.track.edges.ends import FingerEnds, FingerEndsSeen, edges_at_ends
from gripmon.track.edges.evidence import ELSEWHERE_SHARE_RATIO, FingerMeter
from gripmon.track.edges.kernel import FEWEST_EDGES
from gripmon.track.edges.prediction import EdgeLayout, Prediction
from gripmon.track.edges.profiles import unevenness
from gripmon.track.edges.robust_fit import (
    RobustFit,
    fit_irls,
    fit_irls_from_grid,
    grid_of_starts,
)
from gripmon.track.edges.search import search_poses
from gripmon.track.edges.settling import ZOOMS, Effort, Expected, Measurement

FOUND_EDGE_SHARE = 0.85
"""Least part of the sampled edges that usually show which is seen at a place found by a search."""

FOUND_SHARE_RATIO = 0.7
"""Fraction of the usual inlier ratio that suffices at a place found by a search, where that is less than the settings'
``found_share``: its default over the inlier ratio that is expected before anything is known.  What shows less than
that in its place isn't asked for more elsewhere.
"""

EVEN_SIDES = (0.35, 0.7)
"""Unevenness of the edges' calmer sides up to which a smaller part suffices, and that part."""

UNEVEN_SIDES = 0.6
"""Unevenness from which all edges must be seen: neither of their sides is of one shade."""

REFITTED_PLACES, SETTLED_PLACES = 4, 2
"""Best places elsewhere that are fitted roughly once more; and those of them that are followed to the end."""

PROMISING_RATIO = 0.8
"""Part of the share to beat, and of the best rough fit's, that a rough fit must show to be followed: the refit after it
finds more.
"""

SATISFYING_SHARE_RATIO = 0.65
"""Fraction of the usual inlier ratio below which the gripper may be elsewhere."""

TRUSTED_SHARE_RATIO = 0.4
"""Fraction of the usual inlier ratio below which a fit is not believed, whatever the settings allow."""


class Patience(NamedTuple):
    """Whether to look further, which takes the time of many frames: where the fit may be true but is poor, and where
    there is none.  ``at_once``: near by in this frame, else the search does that as well.
    """

    when_doubtful: bool
    when_lost: bool
    at_once: bool = True


class Sought(NamedTuple):
    """How a gripper is searched for: whether it is ``lost`` where it is expected, or only poor, and whether ``near``
    by as well; the image's ``zoom``, whether the jaw's opening is reported, the share that is usual, how often each
    edge is ``shown`` (e,), and the share that a rough fit must show.
    """

    lost: bool
    near: bool
    zoom: int
    jaw_reported: bool
    usual_share: float
    shown: Array
    least_share: float


Search = Callable[[Image, Expected, Sought], Sequence[Expected]]
"""From an image and an expected place to those at which the gripper may be, best first."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the gripper may be, and the share that a rough fit shows there."""

    share: float
    expected: Expected


class FingertipMeter(FingerMeter):
    """Measures one gripper with one camera, and searches elsewhere if it isn't seen where it is expected."""

    _lost = 0  # frames in a row in which it wasn't seen there

    @cached_property
    def shown(self) -> Array:
        """(e,) how often each edge shows where the gripper stands, 0 to 1; to be set once more is known than what was
        taught.  Some are hidden or of one shade with what is behind them, and aren't asked for elsewhere either.
        """
        return np.ones(len(self._gripper.edge_ids)) if self._taught is None else self._taught.shown

    @cached_property
    def _ends(self) -> FingerEnds:
        return FingerEnds(self._gripper, self._settings.edges)

    @property
    def finger_axis(self) -> Array:
        """(3,) the fingers' direction, gripper frame; zero if they have none."""
        return self._ends.axis

    @property
    def along(self) -> NDArray[np.bool_]:
        """(e,) which edges run along the fingers."""
        return self._ends.along

    @cached_property
    def _at_ends(self) -> NDArray[np.intp]:
        return np.flatnonzero(edges_at_ends(self._gripper))

    def measure(
        self,
        image: Image,
        cam_T_grip: Array,
        jaw_opening_m: float,
        usual_share: float,
        patience: Patience,
        jaw_reported: bool = True,
        rivals: tuple[Array, ...] = (),
        search: Search | None = None,
    ) -> Measurement:
        """Measure about an expected pose and jaw opening (``jaw_reported``: by the robot; else it is only a guess to
        start from).

        ``usual_share`` of the search lines agree when all is well.  With clearly less the ``rivals`` (4, 4) are looked
        at: poses at which the gripper was.  If it is not there either, or no end of its fingers is seen there, and
        where ``patience`` allows, it is looked for elsewhere, last of all where ``search`` proposes (if None, a search
        in this image): another place than one that may be true must show the fingers' ends.
        """
        self._prior = self._prior_reported if jaw_reported else self._prior_unreported
        jaw_opening_m = self._possible_opening_m(jaw_opening_m)
        expected = Expected(cam_T_grip, jaw_opening_m, jaw_opening_m)
        best = self._settle(image, expected)
        satisfied = SATISFYING_SHARE_RATIO * usual_share
        if self._gripper.has_jaw and not jaw_reported:
            best = self._from_openings(image, expected, satisfied, best)
        if best.consensus.share < satisfied:
            best = self._at_other_zooms(image, expected, best)
        if best.consensus.share < satisfied:
            best = self._at_rivals(image, expected, rivals, best)
        if best.consensus.share >= self._settings.consensus.trusted_share:
            self._zoom = self._fitting_zoom(best)
        at_once = patience.at_once and best.consensus.share < satisfied
        if best.consensus.share >= satisfied:
            best.trusted = best.consensus.share >= self._settings.consensus.trusted_share
            at_an_end = best.consensus.edge_seen[self._at_ends].any()
            # Slid along themselves, the fingers still show most of their outline.
            if not best.trusted or at_an_end or not self._looks_at_ends(best.prediction):
                self._lost = 0
                return best
        else:
            best.trusted = self._trusted(image, best, usual_share)
        self._lost = 0 if best.trusted else self._lost + 1
        if not (patience.when_doubtful if best.trusted else patience.when_lost):
            return best
        best = self._from_elsewhere(image, expected, best, usual_share, search or self.searched, at_once)
        best.looked_far = True
        return best

    def _looks_at_ends(self, prediction: Prediction) -> bool:
        """Whether an end of a finger might be seen in this view."""
        return bool(np.isin(prediction.layout.edges, self._at_ends).any())

    def _at_rivals(self, image: Image, expected: Expected, rivals: tuple[Array, ...], best: Measurement) -> Measurement:
        """The best of the expected place and of others at which the gripper was; none is fitted twice."""
        for rival in rivals:
            moved_px = best.prediction.moved_px
            away = perturbation_between(expected.cam_T_grip, rival), perturbation_between(best.cam_T_grip, rival)
            if min(moved_px(away[0]), moved_px(away[1])) > self._settings.relinearise_px:
                other = self._settle(image, expected._replace(cam_T_grip=rival))
                best = max(best, other, key=lambda m: m.consensus.share)
        return best

    def _from_elsewhere(
        self, image: Image, expected: Expected, best: Measurement, usual_share: float, search: Search, at_once: bool
    ) -> Measurement:
        """The best of the places farther away, if one is better than the expected one."""
        # Fingers look alike when they slide along themselves: elsewhere must be clearly better than a place that may
        # be true, and such a place is not given up for one that isn't believed.
        beat = (ELSEWHERE_SHARE_RATIO if best.trusted else 1.0) * best.consensus.share
        least = self._least_share(usual_share)
        for effort in (Effort.GRID, Effort.SEARCH) if at_once else (Effort.SEARCH,):
            enough = PROMISING_RATIO * max(beat, least)
            if effort is Effort.GRID:
                places = self._fitted_again(image, self._near_places(image, expected), enough)
            else:
                lost, reported = not best.trusted, self._prior is self._prior_reported
                sought = Sought(lost, not at_once, self._zoom, reported, usual_share, self.shown, enough)
                places = search(image, expected, sought)
            for place in places:
                other = replace(self._settle(image, place), effort=effort)
                other.trusted = self._trusted(image, other, usual_share)
                if best.trusted and not self.ends(image, other).only_strictly.sure:
                    continue
                if other.consensus.share > beat and other.trusted >= best.trusted:
                    best, beat = other, other.consensus.share
            if best.trusted and best.consensus.share >= SATISFYING_SHARE_RATIO * usual_share:
                break
        return best

    def measure_held(
        self, image: Image, cam_T_grip: Array, sigma: Array, jaw_opening_m: float, usual_share: float
    ) -> Measurement:
        """Measure at a pose (4, 4), of edges within the standard deviations (6,) of it, m and rad; nowhere else."""
        jaw_opening_m = self._possible_opening_m(jaw_opening_m)
        held = Expected(cam_T_grip, jaw_opening_m, jaw_opening_m, cam_T_grip, sigma)
        measurement = self._settle(image, held)
        measurement.trusted = self._trusted(image, measurement, usual_share)
        return measurement

    def _possible_opening_m(self, jaw_opening_m: float) -> float:
        """An opening within the jaw's range: encoders report a little beyond its ends."""
        return min(max(jaw_opening_m, self._gripper.jaw_min_m), self._gripper.jaw_max_m)

    def ends(self, image: Image, measurement: Measurement) -> FingerEndsSeen:
        """Whether the fingers' ends are seen as ends where they were measured."""
        return self._ends.seen(image, measurement)

    def _at_other_zooms(self, image: Image, expected: Expected, best: Measurement) -> Measurement:
        """The best of the zooms: the image may have lost, or regained, its focus.  Once the gripper is lost, one other
        zoom is tried a frame, in turn.
        """
        chosen = self._zoom
        others = [zoom for zoom in ZOOMS if zoom != chosen]
        for zoom in others[self._lost % len(others) :][:1] if self._lost else others:
            self._zoom = zoom
            beat = ELSEWHERE_SHARE_RATIO * best.consensus.share
            least = PROMISING_RATIO * max(beat, self._settings.consensus.trusted_share)
            if self._rough_share(image, expected) < least:
                continue
            other = self._settle(image, expected)
            # A coarse zoom reaches far and sees little: only where the edges are as blurred as it expects.
            if other.consensus.share > beat and self._fitting_zoom(other) == zoom:
                best, chosen = other, zoom
        self._zoom = chosen
        if best.consensus.share > 0.0:
            # What is sampled there is chosen again: it was for a place that may be poor.
            self._prediction.pop(chosen, None)
            self._laid_out.pop(chosen, None)
        return best

    def _trusted(self, image: Image, measurement: Measurement, usual_share: float) -> bool:
        consensus, share = self._settings.consensus, measurement.consensus.share
        if measurement.effort is Effort.NARROW:
            return share >= max(consensus.trusted_share, TRUSTED_SHARE_RATIO * usual_share)
        if share < self._least_share(usual_share):
            return False
        # Slid along its fingers a gripper looks like itself but for its tips: elsewhere most edges must be seen.
        uneven, part = unevenness(image, measurement.prediction), FOUND_EDGE_SHARE
        if uneven <= EVEN_SIDES[0]:
            part = EVEN_SIDES[1]
        elif uneven >= UNEVEN_SIDES:
            part = 1.0
        return self._seen_part(measurement.consensus, measurement.prediction) >= part

    def _least_share(self, usual_share: float) -> float:
        """The share that a place elsewhere must show: never less than where the gripper is expected."""
        consensus = self._settings.consensus
        return max(consensus.trusted_share, min(consensus.found_share, FOUND_SHARE_RATIO * usual_share))

    def _seen_part(self, consensus: RobustFit, prediction: Prediction) -> float:
        """The sampled edges that are seen, each as much as it usually shows, over what that gives on average."""
        edges = prediction.layout.edges
        often = self.shown[edges]
        return float(often @ consensus.edge_seen[edges]) / max(float(often @ often), FEWEST_EDGES)

    def _shows_nearly_all(self, measurement: Measurement) -> bool:
        return self._seen_part(measurement.consensus, measurement.prediction) >= FOUND_EDGE_SHARE

    def _completeness(self, consensus: RobustFit, prediction: Prediction) -> float:
        """The share weighted by the part of the edges that are seen: at a wrong opening one finger can agree alone."""
        return consensus.share * self._seen_part(consensus, prediction)

    def _from_openings(self, image: Image, expected: Expected, satisfied: float, best: Measurement) -> Measurement:
        """Starts at other openings, for a jaw that moves and doesn't report it: nearby first, then in its whole range
        until nearly all edges are seen.
        """
        if best.consensus.share >= satisfied and self._shows_nearly_all(best):
            return best
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
            if far and best.consensus.share >= satisfied and self._shows_nearly_all(best):
                break
            there = expected._replace(jaw_opening_m=opening_m)
            seen = self._predict(prediction.layout, there)
            edgels, prior = self._look(image, seen), self._prior_about(seen, there)
            fit = fit_irls_from_grid(edgels, prior, starts, self._settings.consensus, refine=len(starts))
            if self._completeness(fit, seen) > self._completeness(best.consensus, best.prediction):
                other = self._settle(image, self._moved(seen, fit.xi, there))
                best = max(best, other, key=lambda m: self._completeness(m.consensus, m.prediction))
        return best

    def searched(self, image: Image, expected: Expected, sought: Sought) -> Sequence[Expected]:
        """Where the gripper may be, best first, by a search in the whole neighbourhood; takes the time of many
        frames.
        """
        self._zoom, self.shown = sought.zoom, sought.shown
        self._prior = self._prior_reported if sought.jaw_reported else self._prior_unreported
        search, jaw_opening_m = self._settings.search, expected.jaw_opening_m
        poses = search_poses(
            image, self._camera, self._gripper, expected.cam_T_grip, jaw_opening_m, search, sought.shown
        )
        places = self._near_places(image, expected) if sought.near else []
        places += self._far_places(image, expected, poses, sought.usual_share)
        return self._fitted_again(image, places, sought.least_share)

    def _near_places(self, image: Image, expected: Expected) -> list[_Place]:
        """The best start within the reach of the search lines."""
        prediction, start = self._predicted(expected)
        if not prediction.ok.any():
            return []
        settings = self._settings.consensus
        starts = grid_of_starts(prediction, self._reach_px, settings.start_width_px)
        prior = self._prior_about(prediction, expected)
        fit = fit_irls_from_grid(self._look(image, prediction), prior, starts + start, settings)
        return [_Place(fit.share, self._moved(prediction, fit.xi, expected))]

    def _fitted_again(self, image: Image, places: list[_Place], least_share: float) -> Sequence[Expected]:
        """Where rough fits from some places lead: the best of them with at least ``least_share``."""
        again = [self._tried(image, place.expected) for place in _best(places)]
        return [place.expected for place in _promising(again, least_share)]

    def _far_places(self, image: Image, expected: Expected, poses: Array, usual_share: float) -> list[_Place]:
        """Rough fits at proposed ``poses`` (s, 4, 4), up to the first that shows as much as usual."""
        found: list[_Place] = []
        layout = None
        for pose in poses:
            there = expected._replace(cam_T_grip=pose)
            layout = layout or self._lay_out(there)
            found.append(self._tried(image, there, layout))
            if found[-1].share >= usual_share:
                break
        return found

    def _tried(self, image: Image, expected: Expected, layout: EdgeLayout | None = None) -> _Place:
        """One rough fit at a place, on its own layout unless one made near by is given."""
        prediction = self._predict(layout or self._lay_out(expected), expected)
        if not prediction.ok.any():
            return _Place(0.0, expected)
        prior = self._prior_about(prediction, expected)
        start = np.zeros(len(self._prior))
        fit = fit_irls(self._look(image, prediction), prior, start, self._settings.consensus)
        return _Place(fit.share, self._moved(prediction, fit.xi, expected))

    def _rough_share(self, image: Image, expected: Expected) -> float:
        """The share of a rough fit where the gripper is expected."""
        prediction, start = self._predicted(expected)
        if not prediction.ok.any():
            return 0.0
        prior = self._prior_about(prediction, expected)
        return fit_irls(self._look(image, prediction), prior, start, self._settings.consensus).share


def _best(places: list[_Place], count: int = REFITTED_PLACES) -> list[_Place]:
    return sorted(places, key=lambda place: -place.share)[:count]


def _promising(places: list[_Place], least: float) -> list[_Place]:
    """The best places with at least the share ``least``, and only those that may turn out as good as the first."""
    best = _best(places, SETTLED_PLACES)
    return [place for place in best if place.share >= max(least, PROMISING_RATIO * best[0].share)]
