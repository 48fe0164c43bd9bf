"""Whether the ends of the fingers are seen as ends: edges that meet in a corner, and none that goes on beyond it.

Edges along a finger say nothing about a motion along it; only its ends do, and a rim, a fold or a plate's border
parallel to them looks like them.  But such a border goes on beside the finger, and a finger that reaches farther goes
on beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import END_CORNERS, Array, Image
from gripmon.track.edges.prediction import STEP_PX, Prediction
from gripmon.track.edges.profiles import EdgeSettings, find_candidates, read_profiles
from gripmon.track.edges.settling import Measurement

ALONG_COSINE = 0.87
"""Edges within 30 degrees of the fingers' direction run along them."""

MAJORITY = 0.5
"""Part of the edges' length that has to run one way for the fingers to have a direction at all."""

BEYOND_PX = (3.0, 16.5)
"""Stretch beyond a corner that is looked at, px: clear of the corner's own blur, and as long as the stretch of an edge
that makes a corner seen (``corners.neighbourhood_px``).
"""

PROBES = 10
"""Profiles on it: one each 1.5 px, since neighbours see the same pixels."""

CLEAR = 2
"""Probes next to a corner that another edge of the finger may run through."""

FROM_THE_CORNER = 3
"""Probes next to a corner that all show an edge where it goes on a little: beyond a step on the finger."""

REACH_PX = 4.0
"""How far they reach to both sides, px: the shortest that shows the decline of the edge filter's response."""

NEAR_PX = 1.0
"""An edge this near to the continued line is its continuation, px."""

AS_STRONG = 0.4
"""Step of a continuation over the edge's own, from which it is one."""

GOES_ON = 0.5
"""Share of the probes that must show it: half of them, as for an edge beside a corner."""


def along_fingers(gripper: Gripper) -> tuple[Array, NDArray[np.bool_]]:
    """The way (3,) that most of the edges' length has, gripper frame, and (e,) which edges run along it.

    Where no way has most of it: zero, and all True, so that nothing is an end.
    """
    points_m = gripper.points_grip_m()
    way = points_m[gripper.edge_points[:, 1]] - points_m[gripper.edge_points[:, 0]]
    length = np.linalg.norm(way, axis=1)
    direction = way / length[:, None]
    near = np.abs(direction @ direction.T) > ALONG_COSINE
    together = near @ length
    best = int(np.argmax(together))
    if together[best] < MAJORITY * length.sum():
        return np.zeros(3), np.ones(len(length), dtype=bool)
    return direction[best], np.asarray(near[best])


@dataclass(frozen=True, slots=True)
class FingerEndsSeen:
    """(f,) corners at the end of each finger: ``seen`` with nothing that goes on beyond them, and those that ``might``
    be seen in this view.
    """

    seen: NDArray[np.intp]
    might: NDArray[np.intp]

    @property
    def sure(self) -> bool:
        """Whether enough of them are seen, wherever the gripper was expected: two of each of two fingers or as many in
        all; two of the only one whose end the view has.
        """
        fingers = int(np.count_nonzero(self.might >= END_CORNERS))
        if fingers < 2:
            return fingers == 1 and int(self.seen.max()) >= END_CORNERS
        return int(np.count_nonzero(self.seen)) >= 2 and int(self.seen.sum()) >= 2 * END_CORNERS

    @property
    def at_each(self) -> bool:
        """Whether one is seen of each of the fingers whose ends the view has, which are two or more."""
        in_view = self.might > 0
        return bool(np.count_nonzero(in_view) >= 2 and (self.seen[in_view] > 0).all())


@dataclass(frozen=True, slots=True)
class _Probes:
    """Profiles beyond corners, for one prediction; c extensions of :data:`PROBES` each.

    ``corner`` (c,) of the gripper, ``sample`` (c,) the edge's profile next to the corner, ``ok`` (c * PROBES,).
    """

    corner: NDArray[np.intp]
    sample: NDArray[np.intp]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    ok: NDArray[np.bool_]


class FingerEnds:
    """Looks beyond the corners at the ends of one gripper's fingers."""

    def __init__(self, gripper: Gripper, settings: EdgeSettings):
        self._gripper, self._settings = gripper, settings
        self.axis, self.along = along_fingers(gripper)
        at_corner = [self.along[gripper.edges_at_corner(i)] for i in range(len(gripper.corner_ids))]
        # Without a direction of the fingers every corner is an end.
        self._at_end = np.array([self.along.all() or (a.any() and not a.all()) for a in at_corner], dtype=bool)
        self._kept: tuple[Prediction, _Probes] | None = None

    def seen(self, image: Image, measurement: Measurement, strict: bool = False) -> FingerEndsSeen:
        """How many of each finger's ends are seen; takes as long as a fourth of a measurement.  ``strict``: see
        :meth:`at_corners`.
        """
        gripper = self._gripper
        finger = gripper.point_finger[gripper.corner_points]
        fingers = len(gripper.finger_ids)
        return FingerEndsSeen(
            np.bincount(finger[self.at_corners(image, measurement, strict)], minlength=fingers),
            np.bincount(finger[self.in_view(measurement.prediction)], minlength=fingers),
        )

    def in_view(self, prediction: Prediction) -> NDArray[np.bool_]:
        """(c,) the corners that might be seen as ends in this view."""
        return self._at_end & prediction.corners.visible

    def at_corners(self, image: Image, measurement: Measurement, strict: bool = False) -> NDArray[np.bool_]:
        """(c,) the measured corners that are ends: looks beyond them.

        ``strict``: an edge must not go on by a few pixels either, as beyond a step on the finger; clutter does, too.
        """
        prediction, corners = measurement.prediction, measurement.corners
        if self._kept is None or self._kept[0] is not prediction:
            self._kept = prediction, self._lay_out(prediction)
        probes = self._kept[1]
        measured = self._at_end & corners.usable
        goes_on = np.zeros(len(measured), dtype=bool)
        if len(probes.corner) and measured.any():
            goes_on[probes.corner[self._going_on(image, measurement, probes, strict)]] = True
        return measured & ~goes_on

    def _going_on(self, image: Image, measurement: Measurement, probes: _Probes, strict: bool) -> NDArray[np.bool_]:
        """(c,) which of the extended edges go on."""
        prediction, candidates = measurement.prediction, measurement.candidates
        profiles = read_profiles(image, probes.map_x, probes.map_y)
        found = find_candidates(profiles, probes.ok, candidates.noise, candidates.full_scale, self._settings)
        step = _own_step(measurement)[prediction.layout.edge[probes.sample]]
        offset_px = prediction.jacobian[probes.sample] @ measurement.consensus.xi
        of = found.sample // PROBES
        near = np.abs(found.offset_px - offset_px[of]) < NEAR_PX
        # Of either sign, and beside the corner of any height: a finger's tip may be of another shade than the rest.
        strong = near & (np.abs(found.step) > AS_STRONG * np.abs(step[of]))
        shown, well_shown = np.zeros((2, len(probes.corner), PROBES), dtype=bool)
        shown.ravel()[found.sample[near]] = True
        well_shown.ravel()[found.sample[strong]] = True
        goes_on = well_shown[:, CLEAR:].mean(axis=1) > GOES_ON
        return np.asarray(goes_on | shown[:, :FROM_THE_CORNER].all(axis=1) if strict else goes_on)

    def _lay_out(self, prediction: Prediction) -> _Probes:
        gripper, layout, uv_px = self._gripper, prediction.layout, prediction.corners.uv_px
        bounds = [*layout.first.tolist(), len(layout.edge)]
        corner, sample, place, normal = [], [], [], []
        for slot, edge in enumerate(layout.edges.tolist()):
            ends = (bounds[slot], bounds[slot + 1] - 1)
            for point, here, there in zip(gripper.edge_points[edge].tolist(), ends, ends[::-1], strict=True):
                number = np.flatnonzero(gripper.corner_points == point)
                if not len(number) or not self._at_end[number[0]]:
                    continue
                way = prediction.uv_px[here] - prediction.uv_px[there]
                length = float(np.linalg.norm(way))
                if not length > 1.0:
                    continue
                reach = np.linspace(*BEYOND_PX, PROBES)
                corner.append(int(number[0]))
                sample.append(here)
                place.append(uv_px[number[0]] + reach[:, None] * (way / length))
                normal.append(np.broadcast_to(prediction.normal[here], (PROBES, 2)))
        if not corner:
            nowhere = np.zeros((0, 3), dtype=np.float32)
            none = np.zeros(0, dtype=np.intp)
            return _Probes(none, none, nowhere, nowhere, np.zeros(0, dtype=bool))
        half = round(REACH_PX / STEP_PX)
        offsets = np.arange(-half, half + 1) * STEP_PX
        at, across = np.concatenate(place), np.concatenate(normal)
        maps = at[:, :, None] + across[:, :, None] * offsets
        inside = np.isfinite(at).all(axis=1)
        return _Probes(
            np.array(corner, dtype=np.intp),
            np.array(sample, dtype=np.intp),
            np.nan_to_num(maps[:, 0]).astype(np.float32),
            np.nan_to_num(maps[:, 1]).astype(np.float32),
            inside,
        )


def _own_step(measurement: Measurement) -> Array:
    """(e,) mean step of each edge's agreed points; zero where there are none."""
    weight, candidates = measurement.consensus.weight, measurement.candidates
    edges = len(measurement.prediction.line_origin)
    edge = measurement.prediction.layout.edge[candidates.sample]
    total = np.bincount(edge, weight, edges)
    return np.asarray(np.bincount(edge, weight * candidates.step, edges) / np.maximum(total, 1e-12))
