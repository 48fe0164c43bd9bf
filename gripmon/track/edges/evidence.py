"""Each finger by itself: the pose of its own inlier edgels, independently of the other fingers.

The joint fit may have followed a bent finger, or a compromise between pose and jaw opening.  For the cause analysis the
edgel hypotheses are therefore fitted again with a rigid motion of each finger: the effects of all causes (camera moved,
one finger bent, jaw elsewhere) are special cases of that.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.compiled import compiled
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, EdgeEvidence, Image
from gripmon.track.edges.prediction import FEWEST_SAMPLES
from gripmon.track.edges.profiles import Edgels, weigh
from gripmon.track.edges.robust_fit import Prior, RobustFit, fit_irls, prior_information
from gripmon.track.edges.settling import ZOOMS, Expected, Measurement, Settler

FINGER_SIGMA = np.array([3e-3] * 3 + [0.1] * 3)
"""How far a finger's own fit may go from its start, m and rad: only keeps weak views solvable."""

ELSEWHERE_SHARE_RATIO = 1.3
"""Least inlier ratio elsewhere over that where something is expected: of a gripper over that of a trusted fit, of a
finger over that at the pose of the whole gripper.
"""

FINGER_SEEN_SHARE = 0.5
"""Least inlier ratio of a finger that is seen; below, it is searched for farther away: anything with an edge or two may
give less, such as a shadow, the finger's other side, or something behind it.
"""

STRETCH_SEEN_SHARE = 0.4
"""Least inlier ratio of a stretch that counts as seen; it also needs as many inliers as an edge's own line."""

_STEP_PX = 2.0  # of the grid of shifts that a finger's fit starts from; px of the zoomed image
_REFINED = 3  # shifts of the grid that are fitted


class _Place(NamedTuple):
    """A finger's own fit on some edgels, and the inlier ratio of its search lines."""

    edgels: Edgels
    fit: RobustFit
    share: float


class FingerMeter(Settler):
    """Fits the fingers one by one in a measured frame."""

    def evidence(
        self, image: Image, measurement: Measurement, *elsewhere: Array, jaw_reported: bool = True
    ) -> EdgeEvidence:
        """The evidence of each finger in a measured frame; takes about as long as the measurement, several times longer
        if a finger has to be searched for, and as long again if one has moved.

        ``elsewhere``: poses (4, 4) at which a finger may have stayed while the others moved, such as the reference.
        ``jaw_reported``: the robot reported the opening of this frame.  A frame without inliers gives evidence without
        stretches.
        """
        self._zoom = measurement.candidates.zoom
        settings = self._settings.consensus
        edgels = weigh(measurement.candidates, measurement.prediction, self._polarity, settings)
        places = [
            self._finger_place(image, measurement, edgels, finger, elsewhere)
            for finger in range(len(self._gripper.finger_ids))
        ]
        found = [place for place in places if place is not None]
        kernel_px = self._settings.edges.blur_px
        stretches = [_Stretches.of(place, kernel_px) for place in found]
        zoom = measurement.candidates.zoom
        return EdgeEvidence(
            cam_T_grip=measurement.cam_T_grip,
            jaw_opening_m=measurement.jaw_opening_m,
            jaw_reported_m=measurement.jaw_reported_m if jaw_reported and self._gripper.has_jaw else None,
            **{
                name: np.concatenate([getattr(s, name) for s in stretches]) if stretches else empty
                for name, empty in _EMPTY._asdict().items()
            },
            finger_share=np.array([np.nan if place is None else place.share for place in places]),
            noise=measurement.candidates.noise / measurement.candidates.full_scale,
            brightest=_brightest(image) / measurement.candidates.full_scale,
            steepest=_steepest(image) / measurement.candidates.full_scale,
            cells=_cells(image) / measurement.candidates.full_scale,
            reach_px=zoom * self._settings.sampling.reach_px,
            found=measurement.trusted,
        )

    def _finger_place(
        self, image: Image, measurement: Measurement, edgels: Edgels, finger: int, elsewhere: tuple[Array, ...]
    ) -> _Place | None:
        """The finger's best place: where all fingers together show unless another is clearly better; None if none of
        its edges is in view.
        """
        prediction, joint = measurement.prediction, measurement.consensus.xi
        poses = [perturbation_between(prediction.cam_T_grip, pose) for pose in elsewhere]
        starts = [joint, *(np.concatenate([xi, np.zeros(len(joint) - 6)]) for xi in poses)]
        starts = [s for s in starts if prediction.moved_px(s) < 2.0 * self._reach_px] or [np.zeros(len(joint))]
        shifted = _shifted(edgels, finger_of(self, edgels) == finger, starts[-1])
        best = self._best(edgels, finger, chain(starts, shifted))
        if best is None or best.share >= FINGER_SEEN_SHARE:
            return best
        opening_m = prediction.jaw_opening_m
        for zoom in ZOOMS[1:]:
            if zoom <= measurement.candidates.zoom:
                continue
            for pose in (measurement.cam_T_grip, *elsewhere):
                other = self._farther(image, Expected(pose, opening_m, opening_m), zoom, finger)
                if other is not None and other.share >= max(FINGER_SEEN_SHARE, ELSEWHERE_SHARE_RATIO * best.share):
                    best = other
            if best.share >= FINGER_SEEN_SHARE:
                break
        return best

    def _farther(self, image: Image, expected: Expected, zoom: int, finger: int) -> _Place | None:
        """Looked for with a coarser zoom, then measured with the present one."""
        present = self._zoom
        with self._zoomed(zoom):
            edgels = self._look(image, self._predict(self._lay_out(expected), expected))
            own = finger_of(self, edgels) == finger
            start = np.zeros(len(self._prior))
            rough = self._best(edgels, finger, chain([start], _shifted(edgels, own, start)))
        if rough is None:
            return None
        there = expected._replace(cam_T_grip=perturb(expected.cam_T_grip, rough.fit.xi[:6]))
        with self._zoomed(present):
            edgels = self._look(image, self._predict(self._lay_out(there), there))
            return self._best(edgels, finger, [start])

    @contextmanager
    def _zoomed(self, zoom: int) -> Iterator[None]:
        before, self._zoom = self._zoom, zoom
        try:
            yield
        finally:
            self._zoom = before

    def _best(self, edgels: Edgels, finger: int, starts: Iterable[Array]) -> _Place | None:
        """The best fit of one finger from starts (m,), the first unless another is clearly better: no more are tried
        where none can be.
        """
        own = finger_of(self, edgels)
        sampled = int(np.count_nonzero(own[edgels.prediction.ok] == finger))
        if not sampled:
            return None
        edgels = edgels._replace(weight=np.where(own[edgels.candidates.sample] == finger, edgels.weight, 0.0))
        best: _Place | None = None
        for start in starts:
            information = prior_information(0.0)[: len(start)]  # the opening stays
            information[:6] = FINGER_SIGMA**-2
            fit = fit_irls(edgels, Prior(start, information), start, self._settings.consensus)
            share = np.count_nonzero(fit.supported) / sampled
            if best is None or share > ELSEWHERE_SHARE_RATIO * best.share:
                best = _Place(edgels, fit, share)
                if ELSEWHERE_SHARE_RATIO * share >= 1.0:
                    break
        return best


def agreeing_fingers(measurement: Measurement, gripper: Gripper) -> list[float]:
    """Share of each finger's search lines that agree with the measured pose; 1 for a finger that isn't sampled."""
    prediction = measurement.prediction
    finger, fingers = gripper.edge_finger, len(gripper.finger_ids)
    shares = agreeing_shares(finger, prediction.layout.edge, prediction.ok, measurement.consensus.supported, fingers)
    return list(shares.tolist())


def edge_residuals_px(measurement: Measurement, gripper: Gripper) -> Array:
    """(e,) weighted mean of each edge's residuals in the joint fit, px; NaN for edges that it doesn't rest on."""
    consensus, edge = measurement.consensus, measurement.prediction.layout.edge
    sample, edges = measurement.candidates.sample, len(gripper.edge_ids)
    residual_px: Array = edge_means(sample, consensus.weight, consensus.residual_px, edge, edges)
    return residual_px


@compiled
def agreeing_shares(finger: Any, edge: Any, ok: Any, supported: Any, fingers: int) -> Any:
    """(f,) share of each finger's search lines in the image that are ``supported`` (n,); 1 without any."""
    agreeing, sampled = np.zeros(fingers), np.zeros(fingers)
    for n in range(len(edge)):
        agreeing[finger[edge[n]]] += supported[n]
        sampled[finger[edge[n]]] += ok[n]
    for f in range(fingers):
        agreeing[f] = agreeing[f] / sampled[f] if sampled[f] else 1.0
    return agreeing


@compiled
def edge_means(sample: Any, weight: Any, value: Any, edge: Any, edges: int) -> Any:
    """(e,) weighted mean of a value of edgel hypotheses on each edge; NaN without weight."""
    total, moment = np.zeros(edges), np.zeros(edges)
    for k in range(len(sample)):
        total[edge[sample[k]]] += weight[k]
        moment[edge[sample[k]]] += weight[k] * value[k]
    for e in range(edges):
        moment[e] = moment[e] / total[e] if total[e] > 0.0 else np.nan
    return moment


def _brightest(image: Image) -> float:
    """Grey level that one pixel in a hundred exceeds, from some 1,700 of them."""
    return float(np.percentile(image[:: max(1, image.shape[0] // 36), :: max(1, image.shape[1] // 48)], 99.0))


def _steepest(image: Image) -> float:
    """Difference between neighbouring pixels that one pair in a thousand exceeds, from some forty rows and columns."""
    rows, columns = image[:: max(1, image.shape[0] // 36)], image[:, :: max(1, image.shape[1] // 48)]
    pairs = (rows[:, 1:], rows[:, :-1]), (columns[1:], columns[:-1])
    return max(float(np.percentile(cv2.absdiff(*map(np.ascontiguousarray, pair)), 99.9)) for pair in pairs)


def _cells(image: Image) -> Array:
    """(12, 16) mean grey levels: what a blur leaves."""
    cells = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).astype(float)
    return cells if cells.ndim == 2 else cells.mean(axis=2)


def finger_of(meter: FingerMeter, edgels: Edgels) -> NDArray[np.intp]:
    """(n,) the finger of each search line."""
    return np.asarray(meter._gripper.edge_finger[edgels.prediction.layout.edge])


def _shifted(edgels: Edgels, own: NDArray[np.bool_], base: Array) -> Iterator[Array]:
    """The most promising starts that shift a finger, of which the search lines ``own`` (n,) are, in the image."""
    prediction, candidates = edgels.prediction, edgels.candidates
    active = np.flatnonzero((edgels.weight > 0.0) & own[candidates.sample])
    if not prediction.pixels_per_m > 0.0 or not len(active):
        return
    reach_px = float(np.abs(candidates.offset_px[active]).max())
    step_px = _STEP_PX * candidates.zoom
    count = round(reach_px / step_px)
    ticks = np.arange(-count, count + 1) * step_px / prediction.pixels_per_m
    starts = np.tile(base, (len(ticks) ** 2, 1))
    starts[:, 0] += np.repeat(ticks, len(ticks))
    starts[:, 1] += np.tile(ticks, len(ticks))
    predicted = starts @ prediction.jacobian_by_unknown[:, candidates.sample[active]]
    distance = (candidates.offset_px[active] - predicted) / (1.25 * step_px)
    score = np.maximum(1.0 - distance**2, 0.0).sum(axis=1)
    yield from starts[np.argsort(-score, kind="stable")[:_REFINED]]


class _Stretches(NamedTuple):
    """Means over the points that belong to a fit, on each stretch that shows enough of them; see ``EdgeEvidence``."""

    edge: NDArray[np.intp]
    fraction: Array
    xy: Array
    per_px: Array
    sigma_px: Array
    spread_px: Array
    blur_px2: Array
    across: Array

    @classmethod
    def of(cls, place: _Place, kernel_px: float) -> _Stretches:
        edgels, prediction, candidates = place.edgels, place.edgels.prediction, place.edgels.candidates
        index = _points(place)
        sample = candidates.sample[index]
        if not len(sample):
            return _EMPTY
        stretch = np.unique(prediction.layout.stretch[sample], return_inverse=True)[1]
        weight = edgels.weight[index]
        total = np.bincount(stretch, weight)

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(stretch, weight * values) / total)

        edge = prediction.layout.edge[sample]
        off, way = prediction.gain[sample] * candidates.offset_px[index], prediction.way_xy[sample]
        xy = prediction.xy[sample] + off[:, None] * np.column_stack([-way[:, 1], way[:, 0]])
        first = np.flatnonzero(np.diff(stretch, prepend=-1))
        normal = prediction.normal[sample]
        return cls(
            edge=edge[first],
            fraction=mean(prediction.layout.fraction[sample]),
            xy=np.column_stack([mean(xy[:, 0]), mean(xy[:, 1])]),
            per_px=mean(prediction.gain[sample]),
            sigma_px=1.0 / np.sqrt(total),
            spread_px=np.hypot(edgels.edge_spread_px, edgels.cut_off_px)[edge[first]],
            blur_px2=mean(candidates.width_px[index] ** 2) - (candidates.zoom * kernel_px) ** 2,
            across=np.column_stack([mean(normal[:, 0]), mean(normal[:, 1])]),
        )


_EMPTY = _Stretches(
    np.zeros(0, dtype=np.intp),
    np.zeros(0),
    np.zeros((0, 2)),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 2)),
)


def _points(place: _Place) -> NDArray[np.intp]:
    """Edgel hypotheses of a fit on well seen stretches: of two in one search line the heavier counts."""
    prediction, candidates = place.edgels.prediction, place.edgels.candidates
    index = np.flatnonzero(place.fit.weight)
    index = index[np.lexsort((-place.edgels.weight[index], candidates.sample[index]))]
    index = index[np.diff(candidates.sample[index], prepend=-1) > 0]
    number = prediction.layout.stretch
    profiles = np.bincount(number[prediction.ok], minlength=int(number.max(initial=0)) + 1)
    points = np.bincount(number[candidates.sample[index]], minlength=len(profiles))
    good = (points >= FEWEST_SAMPLES) & (points >= STRETCH_SEEN_SHARE * profiles)
    return index[good[number[candidates.sample[index]]]]
