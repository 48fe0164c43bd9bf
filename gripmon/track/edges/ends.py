"""Whether the ends of the fingers are seen as ends: edges that meet in a corner, and none that goes on beyond it.

Edges along a finger say nothing about a motion along it; only its ends do, and a rim, a fold or a plate's border
parallel to them looks like them.  But such a border goes on beside the finger, and a finger that reaches farther goes
on beyond it.  A rounded fingertip has no corner: there the curve is seen, and the side that it begins at doesn't go on.
Where little shows of a rounding it is like a corner, at which neither of its two edges goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.gripper import Gripper
from gripmon.model.records import Array, Image
from gripmon.track.edges.evidence import edge_means
from gripmon.track.edges.lines import SHOWN_BESIDE
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import filter_reach_px, find_candidates, profile_offsets_px, read_profiles
from gripmon.track.edges.roles import PARALLEL_COSINE, along_fingers
from gripmon.track.edges.roundings import GoesOn, Rounding, Roundings, crossing
from gripmon.track.edges.settings import EdgeSettings
from gripmon.track.edges.settling import Measurement

END_CORNERS = 2
"""Corners that make an end: a border that crosses a finger seems to make one, or two with more of it beside them."""

PROBES_PX = np.linspace(3.0, 16.5, 10)
"""Distances of the search lines beyond a corner, px: clear of the corner's own blur, 1.5 px apart, since neighbours see
the same pixels, and as far as the stretch of an edge that makes a corner seen (``corners.neighbourhood_px``).
"""

PROBES_SKIPPED = 2
"""Probes next to a corner that another edge of the finger may run through."""

PROBES_AT_CORNER = 3
"""Probes next to a corner that all show an edge where it goes on a little: beyond a step on the finger."""

CONTINUATION_PX = 1.0
"""An edge this near to the continued line is its continuation, px."""

CONTINUATION_STEP_RATIO = 0.4
"""Step of a continuation over the edge's own, from which it is one."""


@dataclass(frozen=True, slots=True)
class FingerEndsSeen:
    """(f,) corners at the end of each finger, or places where its sides turn into a curve: ``seen`` with nothing that
    goes on beyond them, and those that ``might`` be seen in this view; ``strictly`` those seen beyond which nothing
    goes on by a few pixels either, as beyond a step on the finger; clutter does, too.  ``past``: the edges at the ends
    that go on beyond one of their corners; ``longer``: the fingers of which a side does.
    """

    seen: NDArray[np.intp]
    might: NDArray[np.intp]
    strictly: NDArray[np.intp]
    past: frozenset[int] = frozenset()
    longer: frozenset[int] = frozenset()

    @property
    def sure(self) -> bool:
        """Whether enough of them are seen, wherever the gripper was expected: four in all on two fingers or more; two
        if the view has the end of only one finger.
        """
        fingers = int(np.count_nonzero(self.might >= END_CORNERS))
        if fingers < 2:
            return fingers == 1 and int(self.seen.max()) >= END_CORNERS
        return int(np.count_nonzero(self.seen)) >= 2 and int(self.seen.sum()) >= 2 * END_CORNERS

    @property
    def at_each(self) -> bool:
        """Whether one is seen on each of the fingers whose ends the view has, which are two or more."""
        in_view = self.might > 0
        return bool(np.count_nonzero(in_view) >= 2 and (self.seen[in_view] > 0).all())

    @property
    def only_strictly(self) -> FingerEndsSeen:
        """With those alone that are seen strictly."""
        return replace(self, seen=self.strictly)


@dataclass(frozen=True, slots=True)
class _Probes:
    """Search lines beyond places, for one prediction; c extensions, each at all of :data:`PROBES_PX`.

    ``place`` (c,) among those at the fingers' ends, ``sample`` (c,) the edge's search line next to it, ``ok`` (c * p,)
    of their p probes.  ``turns``: for each place where a side turns into a curve, the search lines of the stretches
    that show it.
    """

    place: NDArray[np.intp]
    sample: NDArray[np.intp]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    ok: NDArray[np.bool_]
    turns: dict[int, tuple[NDArray[np.intp], ...]]


@dataclass(frozen=True, slots=True)
class _Places:
    """Where fingers may end, s places: all corners of the gripper in their order, then where sides turn into curves,
    then roundings.

    ``point`` and ``finger`` (s,) of each, ``at_end`` (s,) whether its finger ends there; ``corner`` (s,), or -1 where
    the edge ``side`` (s,) turns into the curved edge ``curve`` (s,), each -1 where none does; ``rounding`` (s,) its
    number, or -1.
    """

    point: NDArray[np.intp]
    finger: NDArray[np.intp]
    at_end: NDArray[np.bool_]
    corner: NDArray[np.intp]
    side: NDArray[np.intp]
    curve: NDArray[np.intp]
    rounding: NDArray[np.intp]

    @classmethod
    def of(cls, gripper: Gripper, along: NDArray[np.bool_], roundings: NDArray[np.intp]) -> _Places:
        rows: list[tuple[int, bool, int, int, int, int]] = []
        for number, point in enumerate(gripper.corner_points.tolist()):
            at_it = along[gripper.edges_at_corner(number)]
            # Without a direction of the fingers every corner is an end.
            at_end = bool(along.all() or (at_it.any() and not at_it.all()))
            rows.append((point, at_end, number, -1, -1, -1))
        corners = set(gripper.corner_points.tolist())
        for curve in np.flatnonzero(gripper.edge_curved & ~along).tolist():
            for point in set(gripper.edge_points[curve].tolist()) - corners:
                at_it = (gripper.edge_points == point).any(axis=1)
                rows += [(point, True, -1, side, curve, -1) for side in np.flatnonzero(at_it & along).tolist()[:1]]
        rows += [(point, True, -1, -1, -1, number) for number, point in enumerate(roundings.tolist())]
        columns = np.array(rows, dtype=np.intp).reshape(-1, 6).T
        return cls(columns[0], gripper.point_finger[columns[0]], columns[1] > 0, *columns[2:])


def edges_at_ends(gripper: Gripper) -> NDArray[np.bool_]:
    """(e,) which edges meet a place at which a finger may end, and don't run along it: not those of its root."""
    ends = FingerEnds(gripper, EdgeSettings())
    return ~ends.along & np.isin(gripper.edge_points, ends.points).any(axis=1)


class FingerEnds:
    """Checks the ends of one gripper's fingers: whether edges go on beyond them."""

    def __init__(self, gripper: Gripper, settings: EdgeSettings):
        self._gripper, self._settings = gripper, settings
        self.axis, self.along = along_fingers(gripper)
        self._roundings = Roundings(gripper, self.along, float(PROBES_PX[-1]), PARALLEL_COSINE)
        self._places = _Places.of(gripper, self.along, self._roundings.point)
        self._kept: tuple[Prediction, _Probes] | None = None
        self._kept_roundings: tuple[Prediction, dict[int, Rounding]] | None = None

    @property
    def points(self) -> NDArray[np.intp]:
        """The gripper's points at which fingers may end."""
        return self._places.point[self._places.at_end]

    @property
    def finger(self) -> NDArray[np.intp]:
        """(s,) the finger of each place at which one ends."""
        return self._places.finger

    def seen(self, image: Image, measurement: Measurement) -> FingerEndsSeen:
        """How many of each finger's ends are seen; takes a quarter of a measurement's time."""
        fingers = len(self._gripper.finger_ids)
        places, strictly, past, longer = self._at_places(image, measurement)
        asked = places, self.in_view(measurement.prediction), strictly
        seen, might, of_these = (np.bincount(self.finger[each], minlength=fingers) for each in asked)
        return FingerEndsSeen(seen, might, of_these, past, longer)

    def in_view(self, prediction: Prediction) -> NDArray[np.bool_]:
        """(s,) the places that might be seen as ends in this view."""
        places, profiles = self._places, prediction.profiles
        curved = (profiles[places.side] > 0) & (profiles[places.curve] > 0) & (places.rounding < 0)
        curved[np.isin(places.rounding, list(self._rounded(prediction)))] = True
        return places.at_end & np.where(places.corner < 0, curved, _of_corners(prediction.corners.visible, places))

    def _at_places(
        self, image: Image, measurement: Measurement
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], frozenset[int], frozenset[int]]:
        """(s,) the measured places that are ends: no edge goes on beyond them; (s,) those that are strictly.  And which
        edges across go on, and the fingers of which a side does.
        """
        prediction, places = measurement.prediction, self._places
        if self._kept is None or self._kept[0] is not prediction:
            self._kept = prediction, self._lay_out(prediction)
        probes = self._kept[1]
        measured = places.at_end & _of_corners(measurement.corners.usable, places)
        consensus, edge = measurement.consensus, prediction.layout.edge
        for number, stretches in probes.turns.items():
            shown = [consensus.supported[stretch].mean() for stretch in stretches]
            usual = np.ones(len(shown))
            if places.rounding[number] < 0:
                usual[0] = consensus.edge_share[places.side[number]]
            seen = all(consensus.edge_seen[edge[stretch[0]]] for stretch in stretches)
            measured[number] = seen and (shown >= SHOWN_BESIDE * usual).all()
        if not len(probes.place) or not measured.any():
            return measured, measured, frozenset(), frozenset()
        goes_on, by_a_few_px = self._going_on(image, measurement, probes)
        extended = edge[probes.sample]
        past = frozenset(extended[goes_on & ~self.along[extended]].tolist())
        longer = frozenset(self.finger[probes.place[goes_on & self.along[extended]]].tolist())
        measured[probes.place[goes_on]] = False
        strictly = measured.copy()
        strictly[probes.place[by_a_few_px]] = False
        return measured, strictly, past, longer

    def _going_on(
        self, image: Image, measurement: Measurement, probes: _Probes
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(c,) which of the extended edges have a continuation, and which one of a few pixels."""
        prediction, candidates = measurement.prediction, measurement.candidates
        # Where the measurement has them: the edge filter sees less far than the search lines reach.
        offset_px = prediction.jacobian[probes.sample] @ measurement.consensus.xi
        of_edge_px = (offset_px[:, None] * prediction.normal[probes.sample]).astype(np.float32)
        shift_px = np.repeat(of_edge_px, len(PROBES_PX), axis=0)
        maps = probes.map_x + shift_px[:, :1], probes.map_y + shift_px[:, 1:]
        profiles = read_profiles(image, *maps, self._settings.response)
        found = find_candidates(profiles, probes.ok, candidates.noise, candidates.full_scale, self._settings)
        step = np.nan_to_num(own_steps(measurement))[prediction.layout.edge[probes.sample]]
        of = found.sample // len(PROBES_PX)
        near = np.abs(found.offset_px) < CONTINUATION_PX
        # Of either sign, and beside the corner of any height: a finger's tip may be of another shade than the rest.
        strong = near & (np.abs(found.step) > CONTINUATION_STEP_RATIO * np.abs(step[of]))
        shown, well_shown = np.zeros((2, len(probes.place), len(PROBES_PX)), dtype=bool)
        shown.ravel()[found.sample[near]] = True
        well_shown.ravel()[found.sample[strong]] = True
        goes_on = well_shown[:, PROBES_SKIPPED:].mean(axis=1) > SHOWN_BESIDE
        return np.asarray(goes_on), np.asarray(shown[:, :PROBES_AT_CORNER].all(axis=1))

    def _lay_out(self, prediction: Prediction) -> _Probes:
        places, points = self._places, self._gripper.edge_points
        place, sample, at, across = [], [], [], []
        turns: dict[int, tuple[NDArray[np.intp], ...]] = {}
        further: list[tuple[int, GoesOn]] = []
        for slot, edge in enumerate(prediction.layout.edges.tolist()):
            for number in np.flatnonzero(places.at_end & np.isin(places.point, points[edge])).tolist():
                if places.rounding[number] >= 0 or (places.corner[number] < 0 and places.side[number] != edge):
                    continue
                beyond = self._beyond(prediction, slot, edge, number)
                if beyond is None:
                    continue
                here, from_uv_px, way = beyond
                if places.corner[number] < 0:
                    turns[number] = self._turn(prediction, number, here, from_uv_px)
                    back = crossing(prediction, turns[number][2], from_uv_px, way, PARALLEL_COSINE)
                    further += [] if back is None else [(number, back)]
                place.append(number)
                sample.append(here)
                at.append(from_uv_px + PROBES_PX[:, None] * way)
                across.append(np.broadcast_to(prediction.normal[here], (len(PROBES_PX), 2)))
        for number, rounding in self._rounded(prediction).items():
            here = int(np.flatnonzero(places.rounding == number)[0])
            turns[here] = rounding.beside
            further += [(here, goes_on) for goes_on in rounding.go_on]
        for number, goes_on in further:
            place.append(number)
            sample.append(goes_on.profile)
            at.append(goes_on.from_px + PROBES_PX[:, None] * goes_on.way)
            across.append(np.broadcast_to(prediction.normal[goes_on.profile], (len(PROBES_PX), 2)))
        if not place:
            nowhere = np.zeros((0, 3), dtype=np.float32)
            none = np.zeros(0, dtype=np.intp)
            return _Probes(none, none, nowhere, nowhere, np.zeros(0, dtype=bool), {})
        # To both sides what the edge filter needs about a continuation, and as much again to see its response decline.
        offsets = profile_offsets_px(filter_reach_px(self._settings.blur_px) + 2.0 * CONTINUATION_PX)
        probes = np.concatenate(at)
        maps = probes[:, :, None] + np.concatenate(across)[:, :, None] * offsets
        inside: NDArray[np.bool_] = np.asarray(np.isfinite(probes).all(axis=1))
        return _Probes(
            np.array(place, dtype=np.intp),
            np.array(sample, dtype=np.intp),
            np.nan_to_num(maps[:, 0]).astype(np.float32),
            np.nan_to_num(maps[:, 1]).astype(np.float32),
            inside,
            turns,
        )

    def _rounded(self, prediction: Prediction) -> dict[int, Rounding]:
        """The roundings that this view has, where it isn't seen how a side turns into a curve."""
        if self._kept_roundings is not None and self._kept_roundings[0] is prediction:
            return self._kept_roundings[1]
        places, profiles = self._places, prediction.profiles
        turning = (places.side >= 0) & (profiles[places.side] > 0) & (profiles[places.curve] > 0)
        pairs = np.column_stack([places.side, places.curve])[turning].tolist()
        seen = self._roundings.seen_in(prediction, {frozenset(pair) for pair in pairs})
        self._kept_roundings = prediction, seen
        return seen

    def _turn(
        self, prediction: Prediction, number: int, here: int, clear_px: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """The search lines that show a side turn into a curve: of the side's end, of the curve beside it, and of the
        curve from where it has left the side's direction, ``clear_px`` (2,), on; as long
        each as the probes reach.

        A straight border beside or across the finger is like two of them at most.
        """
        uv_px, edge = prediction.uv_px, prediction.layout.edge
        side, curve = (np.flatnonzero(edge == edges[number]) for edges in (self._places.side, self._places.curve))
        reach_px = float(PROBES_PX[-1])
        on_side = side[np.linalg.norm(uv_px[side] - uv_px[here], axis=1) < reach_px]
        if self._gripper.edge_points[self._places.curve[number], 1] == self._places.point[number]:
            curve = curve[::-1]
        travelled_px = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv_px[curve], axis=0), axis=1))])
        left_px = travelled_px[np.argmin(np.linalg.norm(uv_px[curve] - clear_px, axis=1))]
        beside = curve[travelled_px < reach_px]
        return on_side, beside, curve[(travelled_px >= left_px) & (travelled_px < left_px + reach_px)]

    def _beyond(self, prediction: Prediction, slot: int, edge: int, number: int) -> tuple[int, Array, Array] | None:
        """Beyond a place at an end of a sampled edge: the edge's search line next to it, where (2,), px, to look from,
        and the way (2,) in which the edge would go on.  None if it is too short for one, or its curve goes the same
        way.
        """
        layout, places, uv_px = prediction.layout, self._places, prediction.uv_px
        ends = layout.first[slot], np.append(layout.first, len(layout.edge))[slot + 1] - 1
        at_end = int(self._gripper.edge_points[edge, 1] == places.point[number])
        here, there = int(ends[at_end]), int(ends[1 - at_end])
        way = uv_px[here] - uv_px[there]
        length = float(np.linalg.norm(way))
        if not length > 1.0:
            return None
        if places.corner[number] >= 0:
            return here, prediction.corners.uv_px[places.corner[number]], way / length
        fraction = layout.fraction
        left = (at_end - fraction[here]) / (fraction[here] - fraction[there])
        from_px = uv_px[here] + left * way
        way = way / length
        curve = uv_px[layout.edge == places.curve[number]] - from_px
        forward, aside = curve @ way, np.abs(curve @ np.array([-way[1], way[0]]))
        # As much again as a continuation may be off by: the prediction is off by something, too.
        clear = forward[(forward > 0.0) & (aside > 2.0 * CONTINUATION_PX)]
        return (here, from_px + clear.min() * way, way) if len(clear) else None


def _of_corners(value: NDArray[np.bool_], places: _Places) -> NDArray[np.bool_]:
    """(s,) of ``value`` (c,), False where there is no corner."""
    return np.append(value, False)[places.corner]


def own_steps(measurement: Measurement) -> Array:
    """(e,) mean step of each edge's agreed points, grey levels; NaN where there are none."""
    weight, candidates, prediction = measurement.consensus.weight, measurement.candidates, measurement.prediction
    edges = len(prediction.line_origin)
    return np.asarray(edge_means(candidates.sample, weight, candidates.step, prediction.layout.edge, edges))
