"""The belief beside the rules: what it says of the frames that a monitor measures.  Nothing else listens to it.

Each edge of the frame's fit is reduced to two numbers, where its own line lies at the middle of what is seen and how it
is turned, with the pixels that stand beside it; the belief does the rest (:mod:`gripmon.belief`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gripmon.belief.core import Belief, Believed
from gripmon.belief.doubts import CURVE, FINGER, GROUP, Doubt, Told, of_edges, of_ends, of_mount
from gripmon.belief.ends import LOOKED_PX
from gripmon.belief.state import FOCAL, LENGTHS, MOTION, OPENING, REFERENCE, SIZE, Flags, Ints, Priors, Seen
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturb, perturbation_between
from gripmon.model.records import Array, Frame, Image, ReferenceRecord
from gripmon.monitor.edge_lines import Frame2d, Parts, found_at, merged
from gripmon.monitor.ends_told import EndsTold, off_by_px
from gripmon.monitor.lighting import Lighting, own_side
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, Measurement, edges_at_ends, inner_edges, sides
from gripmon.track.edges.profiles import read_profiles

MOST_PLACES = 3
FEWEST_EDGES = 3
"""Edges below which a frame says nothing: two straight ones leave two of six directions open, whatever they are."""
SETTLES_M, SETTLES_RAD = 0.3e-3, 3e-3
"""How far a fit goes from a place at which it starts, beside what isn't known of that: that of a small motion."""
BESIDE_PX, BESIDE_POINTS = 6.0, 12
"""Distance from an edge of the pixels beside it that are compared, clear of its blur, and how many a side."""
TEXTURE_PX = 0.34 * math.sqrt(40.0)
"""Background's error of an edge of one profile over its texture by contrast, px (simulated: blur 1 px, texture of 2 px;
0.34 with 40 profiles).
"""
MOST_TEXTURE_PX = 0.25
"""Background's error beyond which another line would have been found: where more than this was expected, 95 % of 13,688
right lines of 33 simulated scenes were within 0.3 to 0.6 px, 68 % within 0.15 (seed 501 of the integrity scenes).
"""
STILL_NOISES = 1.5
"""Difference of two pictures, in units of what their noise makes of it, up to which nothing has changed."""
LIKE_STILL, MOST_LIKE = 0.999, 0.98
ANOTHER = 0.5
"""Likeness under which a background is another one; different stills reach it in a tenth of the pairs, at most."""


class Look(NamedTuple):
    """A frame searched at a place: the measurement ``of`` it, how far that began ``away`` (6,) from the reference, and
    how its search lines change with g, ``columns`` (n, 23).
    """

    of: Measurement
    away: Array
    columns: Array


class Shadow:
    """Of one monitor.  ``newest`` is what the belief says of the frame, None while none was measured."""

    def __init__(
        self, camera: Camera, gripper: Gripper, tracker: Tracker, reference: ReferenceRecord,
        settings: MonitorSettings,
    ) -> None:  # fmt: skip
        self._camera, self._gripper, self._tracker = camera, gripper, tracker
        self._ref_T = from_record(reference.cam_T_grip)
        self._jaw_sigma_m = settings.jaw_sigma_m
        self._axis = self._ref_T[:3, :3] @ tracker.finger_axis
        priors = Priors() if self._axis.any() else Priors(along_share=0.0)
        covariance = priors.covariance()
        covariance[REFERENCE, REFERENCE] = np.reshape(reference.covariance, (6, 6))
        covariance[OPENING, OPENING] = max(math.hypot(settings.jaw_sigma_m, settings.jaw_offset_sigma_m), 1e-6) ** 2
        covariance[LENGTHS, LENGTHS] = np.eye(2) * max(tracker.model_sigma_m, 1e-6) ** 2
        self._parts = Parts(gripper.edge_curved)
        ends = (edges_at_ends(gripper) & ~tracker.along)[self._parts.edge]
        self._finger_of = gripper.edge_finger[self._parts.edge]
        self._ends_of = [ends & (self._finger_of == finger) for finger in range(len(gripper.finger_ids))]
        self._belief = Belief(
            doubts_of(gripper, tracker.along, self._ends_of, self._parts.edge), self._axis, priors,
            risk=settings.policy.integrity_risk, covariance=covariance,
        )  # fmt: skip
        self._beside = np.full((len(self._parts), 2, BESIDE_POINTS), np.nan)  # of each, before a background
        self._like = np.zeros(len(self._parts))  # how like that is to what was seen of it last
        self._floor_px = settings.corners.consensus.edge_floor_px  # what averaging along an edge doesn't remove
        self._frames: dict[int, Frame2d] = {}
        self._last_s: float | None = None
        self._jaw_m: float | None = None
        self._ends_told = EndsTold(len(self._ends_of))
        self._lighting, self._light_kept = Lighting(), 1.0
        self.newest: Believed | None = None

    @property
    def covariance(self) -> Array:
        """(6, 6) of the motion since the reference, over all hypotheses."""
        return self._belief.moments[1][MOTION, MOTION]

    def see(self, frame: Frame, measurement: Measurement, now_s: float) -> None:
        """A frame of the monitor's, measured."""
        self.newest = None
        if self._last_s is not None and now_s <= self._last_s:
            return
        looks = [self._look(of) for of in self._searched(frame, measurement)]
        fit = next(k for k, look in enumerate(looks) if look.of is measurement)
        seen = self._seen(frame, looks, fit)
        if seen is None:
            return
        dt_s = 1.0 if self._last_s is None else now_s - self._last_s
        told = self._told(frame, looks, fit, now_s)
        self.newest = self._belief.update(
            seen, dt_s, told, light_memory=self._light_kept, opening_m=self._opening_noise_m(frame)
        )
        self._last_s = now_s

    def _opening_noise_m(self, frame: Frame) -> float:
        """What the error of the reported opening changes by: renewed as the jaws move."""
        before, self._jaw_m = self._jaw_m, frame.jaw_opening_m
        if not self._gripper.has_jaw or self._jaw_sigma_m == 0.0:
            return 0.0
        if frame.jaw_opening_m is None or before is None:
            return JAW_UNREPORTED_SIGMA_M  # what was learnt is of the other kind
        kept = math.exp(-abs(frame.jaw_opening_m - before) / (2.0 * self._jaw_sigma_m))
        return self._jaw_sigma_m * math.sqrt(1.0 - kept * kept)

    def _told(self, frame: Frame, looks: list[Look], fit: int, now_s: float) -> Told:
        rows, at = np.zeros((len(self._parts), SIZE)), np.zeros((len(looks), SIZE))
        lies_on = self._parts.of(looks[0].of.prediction.layout)
        for edge in np.unique(lies_on):
            rows[edge] = looks[0].columns[lies_on == edge].mean(axis=0)
        for k, look in enumerate(looks):
            at[k, MOTION] = look.away
            at[k, OPENING] = look.of.prediction.jaw_opening_m - self._reported_m(frame)
        measured = [look.of for look in looks]
        ends = [self._tracker.ends(frame, of) for of in measured]
        return self._ends_told.told(ends, measured, rows, at, fit, now_s)

    def _reported_m(self, frame: Frame) -> float:
        return self._gripper.jaw_nominal_m if frame.jaw_opening_m is None else frame.jaw_opening_m

    def _searched(self, frame: Frame, measurement: Measurement) -> list[Measurement]:
        """The frame as the rules' fit measured it, and at the heaviest places that this isn't near to: what isn't
        looked for isn't found.  The first is that at the heaviest.
        """
        looks, main = [measurement], 0
        for k, (mean, covariance) in enumerate(self._belief.places[:MOST_PLACES]):
            cam_T_grip = perturb(self._ref_T, mean[MOTION] + mean[REFERENCE])
            if any(off_by_px(look, cam_T_grip) < LOOKED_PX for look in looks):  # well within its search lines
                continue
            both = covariance[MOTION, MOTION] + covariance[REFERENCE, REFERENCE]
            sigma = np.sqrt(np.diag(both) + np.repeat([SETTLES_M**2, SETTLES_RAD**2], 3))
            main = len(looks) if k == 0 else main
            looks.append(self._tracker.measure_held(frame, cam_T_grip, sigma))
        return [looks[main], *looks[:main], *looks[main + 1 :]]

    def _look(self, of: Measurement) -> Look:
        return Look(of, perturbation_between(self._ref_T, of.prediction.cam_T_grip), self._columns(of))

    def _seen(self, frame: Frame, looks: list[Look], fit: int) -> Seen | None:
        """The frame's edges, of several looks at it, of which that of the ``fit`` is named; None with too few of them.
        """
        main, edges = looks[0].of, len(self._parts)
        assert isinstance(frame.image, np.ndarray)
        noise = main.candidates.noise / math.sqrt(3.0)  # of three pixels
        beside = _beside(frame.image, main, self._parts)
        found = [
            found_at(look.of, look.columns, look.away, self._reported_m(frame), self._frames, self._parts)
            for look in looks
        ]
        all_lines = [merged([of[edge] for of in found], fit) for edge in range(edges)]
        most = max(1, max(len(of) for of, _ in all_lines))
        rows, (white, image_white) = np.zeros((edges, most, 2, SIZE)), np.ones((2, edges, most, 2))
        lines, searched, image = np.zeros((3, edges, most, 2))
        strength, fitted = np.full(edges, 1.0), np.full(edges, -1)
        for edge, (of, by_fit) in enumerate(all_lines):
            fitted[edge] = by_fit
            for k, line in enumerate(of):
                rows[edge, k], lines[edge, k], white[edge, k] = line.rows, line.place_px, line.white_px2
                searched[edge, k], image[edge, k] = line.searched_px, line.image_px
                image_white[edge, k] = line.image_px2
            if of:
                texture = TEXTURE_PX * _texture(beside, edge, noise)
                texture /= max(abs(of[0].step), 1.0) * math.sqrt(of[0].points)
                strength[edge] = min(texture, MOST_TEXTURE_PX) ** 2 + self._floor_px**2
        count = np.array([len(of) for of, _ in all_lines])
        shown = count > 0
        if len(np.unique(self._parts.edge[shown])) < FEWEST_EDGES:
            return None
        side = own_side(main, self._finger_of, self._parts.of(main.prediction.layout), edges)
        self._light_kept = self._lighting.kept(beside[np.arange(edges), side], noise)
        likeness = np.array([self._compare(e, beside[e], noise) if shown[e] else 0.0 for e in range(edges)])
        background = np.zeros(edges, np.int64)
        return Seen(rows, lines, white, searched, image, image_white, count, fitted, background, likeness, strength)

    def _compare(self, edge: int, now: Array, noise: float) -> float:
        """How like a picture (2, p) of an edge's sides is to that of it seen last; by how both are like the one with
        which its background began, else what creeps is taken for still.
        """
        like, before = _likeness(now, self._beside[edge], noise), self._like[edge]
        self._like[edge] = like
        if like < ANOTHER:
            self._beside[edge], self._like[edge] = now, LIKE_STILL
        return like if like == before == LIKE_STILL else min(like / max(before, ANOTHER), MOST_LIKE)

    def _columns(self, measurement: Measurement) -> Array:
        """(n, 23): how each search line's offset changes with g, at the present pose."""
        p = measurement.prediction
        out = np.zeros((len(p.uv_px), SIZE))
        out[:, MOTION] = out[:, REFERENCE] = p.jacobian[:, :6]
        if p.jacobian.shape[1] > 6:
            out[:, OPENING] = p.jacobian[:, 6]
        along = p.jacobian[:, :3] @ (p.cam_T_grip[:3, :3] @ self._tracker.finger_axis)
        for finger, ends in enumerate(self._ends_of[:2]):
            out[:, LENGTHS.start + finger] = np.where(ends[self._parts.of(p.layout)], along, 0.0)
        camera = self._camera
        centre = np.array([camera.cx_px, camera.cy_px])
        out[:, FOCAL] = np.einsum("ni,ni->n", p.normal, p.uv_px - centre)
        return out


def doubts_of(gripper: Gripper, along: Flags, ends_of: list[Flags], edge: Ints) -> list[Doubt]:
    """What may be wrong with a gripper's s parts, of each of which the ``edge`` (s,) is given; ``along`` (e,), and
    of each finger its ``ends_of`` (s,).
    """
    count, fingers = len(edge), len(gripper.finger_ids)
    out = [*of_edges(count, fingers), *of_ends(ends_of), of_mount(count, fingers)]
    inner = inner_edges(gripper)
    nobody = np.zeros(fingers, bool)
    groups = [(np.arange(len(inner)) == e, CURVE) for e in np.flatnonzero(gripper.edge_curved)]
    groups += [(inner & along, GROUP), (inner, GROUP), *((side, GROUP) for side in sides(gripper))]
    if fingers > 1:
        groups += [(gripper.edge_finger == f, FINGER) for f in range(fingers)]
    taken = {d.edges.tobytes() for d in out[:count]}
    for of_edge, rates in groups:
        flags = np.asarray(of_edge, bool)[edge]
        if 1 < flags.sum() < count and flags.tobytes() not in taken:
            taken.add(flags.tobytes())
            out.append(Doubt(flags, rates, nobody))
    return out


def _beside(image: Image, measurement: Measurement, parts: Parts) -> Array:
    """(s, 2, p) grey levels to both sides of the parts, each the mean of three pixels across; NaN of those out of
    view.
    """
    p = measurement.prediction
    grey = np.full((len(parts), 2, BESIDE_POINTS), np.nan)
    moved = (p.jacobian @ measurement.consensus.xi)[:, None] * p.normal
    lies_on = parts.of(p.layout)
    for part in np.unique(lies_on):
        own = np.flatnonzero(lies_on == part)
        own = own[np.linspace(0, len(own) - 1, BESIDE_POINTS).astype(int)]
        for side, way in enumerate((-BESIDE_PX, BESIDE_PX)):
            uv = p.uv_px[own] + moved[own] + way * p.normal[own]
            maps = np.array([uv + k * p.normal[own] for k in (-1.0, 0.0, 1.0)], np.float32)
            grey[part, side] = read_profiles(image, maps[..., 0], maps[..., 1]).mean(axis=0)
    return grey


def _likeness(now: Array, then: Array, noise: float) -> float:
    """How like two pictures (2, p) of an edge's sides are, of the side that changed more; 0 where one wasn't seen."""
    if not np.isfinite(now).all() or not np.isfinite(then).all():
        return 0.0
    return min(_alike(*sides, noise) for sides in zip(now, then, strict=True))


def _texture(grey: Array, edge: int, noise: float) -> float:
    """Scatter of the grey levels along the more uneven side of an edge, without noise and shading."""
    most = 0.0
    ways = np.linspace(-1.0, 1.0, BESIDE_POINTS)
    for side in grey[edge]:
        if np.isfinite(side).all():
            left = side - np.polyval(np.polyfit(ways, side, 1), ways)
            most = max(most, float(left @ left) / (BESIDE_POINTS - 2) - noise**2)
    return math.sqrt(most)


def _alike(now: Array, then: Array, noise: float) -> float:
    """Correlation of two pictures, free of gain and offset; nearly one where only their noise differs."""
    a, b = now - now.mean(), then - then.mean()
    power = float(a @ a) * float(b @ b)
    correlation = float(a @ b) / math.sqrt(power) if power > 0.0 else 1.0
    gain = float(a @ b) / float(b @ b) if float(b @ b) > 0.0 else 1.0
    left = a - gain * b
    if math.sqrt(float(left @ left) / len(a)) <= STILL_NOISES * math.sqrt(2.0) * noise and 0.5 < gain < 2.0:
        return LIKE_STILL
    return min(max(correlation, 0.0), MOST_LIKE)
