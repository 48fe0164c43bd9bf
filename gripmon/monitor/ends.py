"""Whether the fingers' ends are seen as ends, and how probably what is seen in their place is something else.

Only the ends show a motion along the fingers; a rim, a plate's border, a step or a mark on the finger looks like one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.track.edges import FingerEndsSeen, Measurement, edges_at_ends
from gripmon.track.look import ONE_EDGE_PX

MISREAD_PROBABILITY = 0.1
"""Probability that what is seen where a finger's end is expected is something else, and that each further corner of it
is: that of a border anywhere within the search lines' reach to lie within a tenth of it.
"""

CORNERS_WHERE_EXPECTED = 3
"""Corners at the fingers' ends that prove a pose where the gripper is expected; elsewhere four of two fingers."""


class EndsEvidence:
    """What a gripper's measured edges tell about its fingers' ends."""

    def __init__(self, gripper: Gripper, along: NDArray[np.bool_]):
        """``along`` (e,): which edges run along the fingers."""
        self._finger, self._along, self._at_ends = gripper.edge_finger, along, edges_at_ends(gripper)

    def confirmations(self, measurement: Measurement, ends: FingerEndsSeen | None) -> int:
        """How many times the fingers' ends are seen where the pose has them: once for each finger by its edges, and
        once more for each further corner.
        """
        return self._times(self._across(measurement), ends)

    def misread(
        self, measurement: Measurement, ends: FingerEndsSeen | None, kept: NDArray[np.bool_] | None = None
    ) -> float:
        """Probability that what is seen where the fingers' ends are expected is something else; ``kept`` (v,): the
        measured edges that count, None for all.  A finger's root isn't an end, and edges on one line count once, of
        whichever fingers, where no corner is seen: a single straight border may show them all.  An edge that goes on
        beyond a finger that shows no corner is such a border, whatever corner another finger makes with it.  A finger
        counts once less where something goes on by a few pixels beyond each of its corners: that is what a slide by a
        few pixels looks like; so does one that shows no corner and of which a side goes on beyond its end, and its
        edges don't count: what is taken for its end lies on something longer.
        """
        edges = self._across(measurement)
        edges = edges[self._at_ends[edges]]
        longer = [] if ends is None else [finger for finger in ends.longer if not ends.seen[finger]]
        if ends is not None:
            edges = edges[~np.isin(edges, list(ends.past)) | (ends.seen[self._finger[edges]] > 0)]
            edges = edges[~np.isin(self._finger[edges], longer)]
        if kept is not None:
            edges = edges[np.isin(edges, measurement.normal.edge[kept])]
        times = self._times(edges, ends)
        if ends is not None:
            if not ends.seen.any() and _on_one_line(measurement, edges):
                times = min(times, 1)
            fingers = list(set(self._finger[edges].tolist()))
            times -= int(np.count_nonzero((ends.seen[fingers] > 0) & (ends.strictly[fingers] == 0)))
        return MISREAD_PROBABILITY ** max(times - len(longer), 0)

    def sides_misread(self, measurement: Measurement) -> float:
        """Probability that all sides of fingers that are seen are something else, each as probably as an end."""
        edge = measurement.normal.edge
        return float(MISREAD_PROBABILITY ** int((measurement.consensus.edge_seen[edge] & self._along[edge]).sum()))

    def _across(self, measurement: Measurement) -> NDArray[np.intp]:
        """The edges that are seen and don't run along the fingers."""
        edge = measurement.normal.edge
        return edge[measurement.consensus.edge_seen[edge] & ~self._along[edge]]

    def _times(self, edges: NDArray[np.intp], ends: FingerEndsSeen | None) -> int:
        by_edge = set(self._finger[edges].tolist())
        return len(by_edge) if ends is None else sum(max(int(ends.seen[finger]), 1) for finger in by_edge)


def within(probability: float, risk: float) -> bool:
    """Whether a probability is no more than a risk; powers of ten are equal but for rounding."""
    return probability <= (1.0 + 1e-9) * risk


class Proof(NamedTuple):
    """Whether the fingers' ends prove a pose, and with which probability what looks like them is something else."""

    proven: bool
    misread: float


def proof(
    ends: FingerEndsSeen | None,
    misread: float,
    risk: float,
    displaced: bool = False,
    again: bool = True,
    along: float | None = None,
) -> Proof:
    """What fingers' ends say that are something else with a probability ``misread``; None: not checked, no proof.

    Where the pose is expected, or the fingers' strips are seen, ``along``, which leave that part of a misreading, fewer
    corners suffice than where it is ``displaced``; where the innovation is within noise (``again``), one of each
    finger; but one of these strictly, since a slide by a few pixels shows everywhere that something goes on.  Each
    finger beyond whose ends nothing goes on even by a few pixels is worth as much as one more corner.  Narrow tips may
    show one corner each: they prove a pose, too, where all of that together leaves no more than the ``risk``.
    """
    if ends is None:
        return Proof(False, misread)
    strictly = int(np.count_nonzero((ends.seen > 0) & (ends.strictly >= ends.seen)))
    left = misread * MISREAD_PROBABILITY**strictly
    enough = int(ends.seen.sum()) >= CORNERS_WHERE_EXPECTED and (along is not None or not displaced)
    proven = ends.sure or ((enough or (again and ends.at_each)) and bool(ends.strictly.any()))
    if ends.at_each and (strictly or not displaced):
        proven = proven or within(left * (1.0 if along is None else along), risk)
    return Proof(proven, left if proven else misread)


def _on_one_line(measurement: Measurement, edges: NDArray[np.intp]) -> bool:
    """Whether some edges lie on one straight line of the image."""
    prediction = measurement.prediction
    uv_px = prediction.uv_px[np.isin(prediction.layout.edge, edges) & prediction.ok]
    if len(uv_px) == 0:
        return True
    off_px = uv_px - uv_px.mean(axis=0)
    return bool(np.abs(off_px @ np.linalg.svd(off_px, full_matrices=False)[2][-1]).max() < ONE_EDGE_PX)
