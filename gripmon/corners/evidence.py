"""Each finger by itself: where its own edge points agree, whatever the others do.

The joint fit may have followed a bent finger, or split the difference between pose and jaw opening.  What has moved is
therefore judged from the candidates again, with a rigid motion for every finger: all that one cause can do (camera
moved, one finger bent, jaw elsewhere) are special cases of that.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.corners.consensus import Consensus, ConsensusSettings, Prior, Votes, agree
from gripmon.corners.settling import Measurement
from gripmon.geometry import perturbation_between
from gripmon.gripper import Gripper
from gripmon.records import Array, EdgeEvidence

FINGER_SIGMA = np.array([3e-3] * 3 + [0.1] * 3)
"""How far a finger may stand from where all of them together show, m and rad: only keeps weak views solvable."""

CLEARLY_BETTER = 1.2
"""Factor by which more profiles of a finger must agree elsewhere than where the gripper as a whole shows."""

FEWEST_POINTS, FEWEST_SHARE = 4, 0.4
"""Points of a stretch, and part of its profiles, that must agree for it to count as seen."""

_STEP_PX = 2.0
_REFINED = 3


class _Finger(NamedTuple):
    """A finger's own fit: which candidates belong to it, and the share of its profiles that agree."""

    fit: Consensus
    share: float


def edge_evidence(
    measurement: Measurement,
    votes: Votes,
    gripper: Gripper,
    settings: ConsensusSettings,
    elsewhere: tuple[Array, ...],
    jaw_reported: bool,
    kernel_px: float,
    reach_px: float,
) -> EdgeEvidence:
    """What the fingers show one by one.

    ``votes``: all candidates of the measurement with their weights.  ``elsewhere``: poses (4, 4) that a finger may
    have stayed at, the reference for one.  ``kernel_px``: standard deviation of the filter that the edges were
    found with, ``reach_px`` that of the profiles.  No finger found gives evidence without stretches.
    """
    prediction, candidates = measurement.prediction, measurement.candidates
    fingers = len(gripper.finger_ids)
    share = np.full(fingers, np.nan)
    taken = np.zeros(len(candidates.sample), dtype=bool)
    finger_of = gripper.edge_finger[prediction.layout.edge]
    for finger in range(fingers):
        sampled = int(np.count_nonzero(finger_of[prediction.ok] == finger))
        if not sampled:
            continue
        own = np.where(finger_of[candidates.sample] == finger, votes.weight, 0.0)
        best = _fit(replace(votes, weight=own), measurement, elsewhere, sampled, settings, reach_px)
        share[finger] = best.share
        taken |= best.fit.weight > 0.0
    jaw_reported_m = measurement.jaw_reported_m if jaw_reported and gripper.has_jaw else None
    return _stretches(measurement, votes, taken, share, jaw_reported_m, kernel_px, reach_px)


def _fit(
    votes: Votes,
    measurement: Measurement,
    elsewhere: tuple[Array, ...],
    sampled: int,
    settings: ConsensusSettings,
    reach_px: float,
) -> _Finger:
    """The finger's best place: where all fingers together show unless another is clearly better."""
    prediction, joint = measurement.prediction, measurement.consensus.xi
    information = np.full(len(joint), 1e12)
    information[:6] = FINGER_SIGMA**-2
    prior = Prior(joint, information)

    def fitted(start: Array) -> _Finger:
        fit = agree(votes, prior, start, settings)
        return _Finger(fit, np.count_nonzero(fit.supported) / sampled)

    best = fitted(joint)
    starts = [np.concatenate([perturbation_between(prediction.cam_T_grip, T), joint[6:]]) for T in elsewhere]
    starts = [s for s in starts if prediction.moved_px(s) < 2.0 * reach_px]
    starts += _shifted(votes, measurement, reach_px, settings)
    for start in starts:
        other = fitted(start)
        if other.share > CLEARLY_BETTER * best.share:
            best = other
    return best


def _shifted(votes: Votes, measurement: Measurement, reach_px: float, settings: ConsensusSettings) -> list[Array]:
    """The most promising starts that shift the finger in the image."""
    prediction, joint, candidates = measurement.prediction, measurement.consensus.xi, votes.candidates
    if not prediction.pixels_per_m > 0.0:
        return []
    count = round(reach_px / _STEP_PX)
    ticks = np.arange(-count, count + 1) * _STEP_PX / prediction.pixels_per_m
    starts = np.tile(joint, (len(ticks) ** 2, 1))
    starts[:, 0] += np.repeat(ticks, len(ticks))
    starts[:, 1] += np.tile(ticks, len(ticks))
    active = np.flatnonzero(votes.weight > 0.0)
    sample = candidates.sample[active]
    distance = (candidates.offset_px[active] - starts @ prediction.jacobian_by_unknown[:, sample]) / (
        settings.start_width_px
    )
    score = np.maximum(1.0 - distance**2, 0.0).sum(axis=1)
    return [starts[i] for i in np.argsort(-score, kind="stable")[:_REFINED]]


def _stretches(
    measurement: Measurement,
    votes: Votes,
    taken: NDArray[np.bool_],
    share: Array,
    jaw_reported_m: float | None,
    kernel_px: float,
    reach_px: float,
) -> EdgeEvidence:
    """Means over the points taken, one of each profile at most, on each stretch that shows enough of them."""
    prediction, candidates = measurement.prediction, measurement.candidates
    layout = prediction.layout
    index = np.flatnonzero(taken)
    # Of two candidates of one profile that belong to the fit the heavier one counts.
    index = index[np.lexsort((-votes.weight[index], candidates.sample[index]))]
    index = index[np.diff(candidates.sample[index], prepend=-1) > 0]
    sample = candidates.sample[index]
    number = layout.stretch
    profiles = np.bincount(number[prediction.ok], minlength=int(number.max(initial=0)) + 1)
    points = np.bincount(number[sample], minlength=len(profiles))
    good = (points >= FEWEST_POINTS) & (points >= FEWEST_SHARE * profiles)
    index = index[good[number[sample]]]
    sample = candidates.sample[index]
    stretch = np.unique(number[sample], return_inverse=True)[1]
    count = int(stretch.max(initial=-1)) + 1
    weight = votes.weight[index]
    total = np.bincount(stretch, weight, count)

    def mean(values: Array) -> Array:
        return np.bincount(stretch, weight * values, count) / total

    edge = layout.edge[sample]
    direction = prediction.line_direction[edge]
    off = prediction.gain[sample] * candidates.offset_px[index]
    xy = prediction.line_origin[edge] + prediction.along[sample][:, None] * direction
    xy = xy + off[:, None] * np.column_stack([-direction[:, 1], direction[:, 0]])
    first = np.flatnonzero(np.diff(stretch, prepend=-1))
    normal = prediction.normal[sample]
    return EdgeEvidence(
        cam_T_grip=measurement.cam_T_grip,
        jaw_opening_m=measurement.jaw_opening_m,
        jaw_reported_m=jaw_reported_m,
        edge=edge[first],
        fraction=mean(layout.fraction[sample]),
        xy=np.column_stack([mean(xy[:, 0]), mean(xy[:, 1])]),
        per_px=mean(prediction.gain[sample]),
        sigma_px=1.0 / np.sqrt(total),
        spread_px=np.hypot(votes.edge_spread_px, votes.cut_off_px)[edge[first]],
        blur_px2=mean(candidates.width_px[index] ** 2) - (candidates.zoom * kernel_px) ** 2,
        across=np.column_stack([mean(normal[:, 0]), mean(normal[:, 1])]),
        finger_share=share,
        reach_px=reach_px,
    )
