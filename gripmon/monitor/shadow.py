"""The belief beside the rules: what it says of the frames that a monitor measures.  Nothing else listens to it.

Each edge of the frame's fit is reduced to two numbers, where its own line lies at the middle of what is seen and how it
is turned, with the pixels that stand beside it; the belief does the rest (:mod:`gripmon.belief`).
"""

from __future__ import annotations

import math

import numpy as np

from gripmon.belief.core import Belief, Believed
from gripmon.belief.doubts import FINGER, GROUP, Doubt, Told, of_edges, of_ends, of_mount
from gripmon.belief.state import FOCAL, LENGTHS, LIGHT, MOTION, OPENING, REFERENCE, SIZE, Flags, Ints, Priors, Seen
from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Frame, Image, ReferenceRecord
from gripmon.monitor.settings import MonitorSettings
from gripmon.monitor.tracker import Tracker
from gripmon.track.edges import JAW_UNREPORTED_SIGMA_M, FingerEndsSeen, Measurement, edges_at_ends, inner_edges, sides
from gripmon.track.edges.profiles import read_profiles

FEWEST_POINTS = 6
"""Points of an edge from which it has an offset and a slope with a scatter."""
LEAST_WHITE_PX = 0.02
"""Standard deviation of an edge that no pixel noise explains: interpolation between pixels."""
MOST_LINES = 3
WITHIN_PX = 0.6
"""Distance from a line within which an edgel hypothesis is on it: three standard deviations of the least sure ones."""
PLACES_PX = np.array([(offset, slope) for offset in np.arange(-7.0, 7.01, 0.3) for slope in np.arange(-2.0, 2.01, 0.5)])
"""Where lines are looked for (offset, slope): as far as search lines reach."""
BESIDE_PX, BESIDE_POINTS = 6.0, 12
"""Distance from an edge of the pixels beside it that are compared, clear of its blur, and how many a side."""
TEXTURE_PX = 0.34 * math.sqrt(40.0)
"""Background's error of an edge of one profile over its texture by contrast, px (simulated: blur 1 px, texture of 2 px;
0.34 with 40 profiles).
"""
STILL_NOISES = 1.5
"""Difference of two pictures, in units of what their noise makes of it, up to which nothing has changed."""
LIKE_STILL, MOST_LIKE = 0.999, 0.98
RIGHT, WRONG = np.array([0.155, 0.276, 0.569]), np.array([0.812, 0.117, 0.071])
"""How probable 0, 1 or 2 indications of a finger's end are where it is one and where it is something else, of one of
several fingers in view.  These tables: 1,518 right fits and 524 that had slid (``tools/bench belief --witnesses``).
"""
LONE_RIGHT, LONE_WRONG = np.array([0.049, 0.121, 0.830]), np.array([0.687, 0.139, 0.174])
"""The same of the only finger in view."""
BOTH_RIGHT = np.array([[106.0, 37.5, 54.5], [37.5, 120.0, 194.0], [54.5, 194.0, 473.0]]) / 1271.0
BOTH_WRONG = np.array([[290.0, 15.5, 3.0], [15.5, 17.0, 11.5], [3.0, 11.5, 13.0]]) / 380.0
"""Of both of two fingers."""
REPEATS = 0.95
"""Probability that an answer about ends only repeats that of the frame before, at 15 frames/s."""


class Shadow:
    """Of one monitor.  ``newest`` is what the belief says of the frame, None while none was measured."""

    def __init__(
        self, camera: Camera, gripper: Gripper, tracker: Tracker, reference: ReferenceRecord,
        settings: MonitorSettings, most: int = 64,
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
        self._ends_of = [
            edges_at_ends(gripper) & ~tracker.along & (gripper.edge_finger == finger)
            for finger in range(len(gripper.finger_ids))
        ]
        self._belief = Belief(
            doubts_of(gripper, tracker.along, self._ends_of), self._axis, priors,
            risk=settings.policy.integrity_risk, most=most, covariance=covariance,
        )  # fmt: skip
        self._beside = np.full((len(gripper.edge_ids), 2, BESIDE_POINTS), np.nan)  # of each edge, when it was seen last
        self._last_s: float | None = None
        self._jaw_m: float | None = None
        self._answer = np.full(len(self._ends_of), -1)
        self._hidden = False
        self.newest: Believed | None = None

    @property
    def covariance(self) -> Array:
        """(6, 6) of the motion since the reference, over all hypotheses."""
        return self._belief.moments[1][MOTION, MOTION]

    def see(self, frame: Frame, measurement: Measurement, now_s: float) -> None:
        """A frame of the monitor's, measured."""
        self.newest = None
        seen = self._seen(frame, measurement)
        if seen is None or (self._last_s is not None and now_s <= self._last_s):
            return
        ends = self._tracker.ends(frame, measurement)
        ends_shown = bool(np.any([seen.shown & own for own in self._ends_of]))
        hidden, self._hidden = not ends_shown and not self._hidden, not ends_shown
        dt_s = 1.0 if self._last_s is None else now_s - self._last_s
        due = self._belief.priors.unseen_knock if hidden else 0.0
        self.newest = self._belief.update(
            seen, dt_s, self._told(ends), hidden_knock=due, opening_m=self._opening_noise_m(frame)
        )
        self._last_s = now_s

    def _opening_noise_m(self, frame: Frame) -> float:
        """What the error of the reported opening changes by: renewed as the jaws move."""
        before, self._jaw_m = self._jaw_m, frame.jaw_opening_m
        if not self._gripper.has_jaw or self._jaw_sigma_m == 0.0:
            return 0.0
        if frame.jaw_opening_m is None or before is None:
            return JAW_UNREPORTED_SIGMA_M if frame.jaw_opening_m is None else 0.0
        kept = math.exp(-abs(frame.jaw_opening_m - before) / (2.0 * self._jaw_sigma_m))
        return self._jaw_sigma_m * math.sqrt(1.0 - kept * kept)

    def _told(self, ends: FingerEndsSeen) -> Told:
        """Of fingers whose ends are out of view, nothing."""
        answer = np.where(ends.might > 0, np.minimum(ends.seen, 2), -1)
        asked, together = np.flatnonzero(answer >= 0), np.full(2, np.nan)
        tables = (LONE_RIGHT, LONE_WRONG) if len(asked) == 1 else (RIGHT, WRONG)
        right, wrong = (np.where(answer >= 0, np.log(of[answer]), 0.0) for of in tables)
        if len(asked) == len(answer) == 2:
            together = np.log([of[answer[0], answer[1]] for of in (BOTH_RIGHT, BOTH_WRONG)])
        repeats, self._answer = (answer == self._answer) & (answer >= 0), answer
        return Told(right, wrong, repeats, REPEATS, together)

    def _seen(self, frame: Frame, measurement: Measurement) -> Seen | None:
        """The frame's edges; None with too few of them."""
        p, c, fit = measurement.prediction, measurement.candidates, measurement.consensus
        edges = len(self._gripper.edge_ids)
        rows, lines = np.zeros((edges, 2, SIZE)), np.zeros((edges, MOST_LINES, 2))
        white, count = np.ones((edges, MOST_LINES, 2)), np.zeros(edges, np.int64)
        searched, fitted, strength = np.zeros((edges, 2)), np.zeros(edges, bool), np.full(edges, 1.0)
        assert isinstance(frame.image, np.ndarray)
        beside, noise = _beside(frame.image, measurement, edges), c.noise / math.sqrt(3.0)  # of three pixels' mean
        at = self._columns(measurement)
        away = perturbation_between(self._ref_T, p.cam_T_grip)
        reported_m = self._gripper.jaw_nominal_m if frame.jaw_opening_m is None else frame.jaw_opening_m
        from_reference = at[:, MOTION] @ away + at[:, OPENING] * (p.jaw_opening_m - reported_m)
        edge_of = p.layout.edge[c.sample]
        for edge in measurement.normal.edge:
            own = np.flatnonzero(edge_of == edge)
            agree = fit.weight[own] > 0.0 if fit.edge_seen[edge] else np.zeros(len(own), bool)
            search_lines = int(np.count_nonzero(p.layout.edge == edge))
            found = lines_of(c.offset_px[own], c.sample[own], p.layout.fraction[c.sample[own]], agree, search_lines)
            if not found:
                continue
            first = own[found[0]]
            fraction = p.layout.fraction[c.sample[first]]
            line = _line(_basis(fraction, fraction), 1.0 / np.square(c.sigma_px[first]))
            all_of = line @ np.column_stack([from_reference[c.sample[first]], at[c.sample[first]]])
            searched[edge], rows[edge] = all_of[:, 0], all_of[:, 1:]
            for k, on in enumerate(found):
                points = own[on]
                basis = _basis(p.layout.fraction[c.sample[points]], fraction)
                lines[edge, k] = _line(basis, 1.0 / np.square(c.sigma_px[points])) @ c.offset_px[points]
                left = c.offset_px[points] - basis @ lines[edge, k]
                spread = float(left @ left) / max(len(points) - 2, 1)
                single = np.diag(np.linalg.inv(basis.T @ basis)) / float(p.independence[edge])
                white[edge, k] = LEAST_WHITE_PX**2 + spread * single
                lines[edge, k] += searched[edge]
            count[edge], fitted[edge] = len(found), found[0] is agree
            step = float(np.median(c.step[first]))
            texture = _texture(beside, int(edge), noise)
            strength[edge] = (TEXTURE_PX * texture / max(abs(step), 1.0)) ** 2 / max(
                float(p.independence[edge]) * len(first), 2.0
            )
            rows[edge, 0, LIGHT], rows[edge, 1, LIGHT] = -np.sign(step), 0.0
        shown = count > 0
        if np.count_nonzero(shown) < 3:
            return None
        likeness = np.array([_likeness(beside[e], self._beside[e], noise) if shown[e] else 0.0 for e in range(edges)])
        self._beside = np.where(shown[:, None, None], beside, self._beside)
        return Seen(rows, lines, white, count, fitted, np.zeros(edges, np.int64), likeness, strength, searched)

    def _columns(self, measurement: Measurement) -> Array:
        """(n, 23): how each search line's offset changes with g, at the present pose."""
        p = measurement.prediction
        out = np.zeros((len(p.uv_px), SIZE))
        out[:, MOTION] = out[:, REFERENCE] = p.jacobian[:, :6]
        if p.jacobian.shape[1] > 6:
            out[:, OPENING] = p.jacobian[:, 6]
        along = p.jacobian[:, :3] @ (p.cam_T_grip[:3, :3] @ self._tracker.finger_axis)
        for finger, ends in enumerate(self._ends_of[:2]):
            out[:, LENGTHS.start + finger] = np.where(ends[p.layout.edge], along, 0.0)
        camera = self._camera
        centre = np.array([camera.cx_px, camera.cy_px])
        out[:, FOCAL] = np.einsum("ni,ni->n", p.normal, p.uv_px - centre)
        return out


def doubts_of(gripper: Gripper, along: Flags, ends_of: list[Flags]) -> list[Doubt]:
    """What may be wrong with a gripper's edges."""
    edges, fingers = len(gripper.edge_ids), len(gripper.finger_ids)
    out = [*of_edges(edges, fingers), *of_ends(ends_of), of_mount(edges, fingers)]
    inner = inner_edges(gripper)
    nobody = np.zeros(fingers, bool)
    groups = [(inner & along, GROUP), (inner, GROUP), *((side, GROUP) for side in sides(gripper))]
    if fingers > 1:
        groups += [(gripper.edge_finger == f, FINGER) for f in range(fingers)]
    taken = {d.edges.tobytes() for d in out[:edges]}
    for flags, rates in groups:
        if 1 < flags.sum() < edges and flags.tobytes() not in taken:
            taken.add(flags.tobytes())
            out.append(Doubt(np.asarray(flags, bool), rates, nobody))
    return out


def lines_of(offset_px: Array, sample: Ints, fraction: Array, agree: Flags, search_lines: int) -> list[Flags]:
    """Which of an edge's edgel hypotheses (n,), at ``offset_px`` on ``sample``, the search line at ``fraction`` of the
    edge, are on each of the lines there, at most MOST_LINES: first that of those which ``agree`` with the fit, if there
    are enough, then what at least half of the ``search_lines`` support.
    """
    out: list[Flags] = []
    left, basis = np.ones(len(offset_px), bool), _basis(fraction, fraction)

    def take(on: Flags) -> None:
        nonlocal left
        place = np.linalg.lstsq(basis[on], offset_px[on], rcond=None)[0]
        left = left & (np.abs(offset_px - basis @ place) > 2.0 * WITHIN_PX)
        out.append(on)

    if len(np.unique(sample[agree])) >= FEWEST_POINTS:
        take(agree)
    least = max(FEWEST_POINTS, 0.5 * search_lines)
    while len(out) < MOST_LINES and len(np.unique(sample[left])) >= least:
        among = np.flatnonzero(left)
        hit = np.abs(offset_px[among, None] - basis[among] @ PLACES_PX.T) < WITHIN_PX
        first = np.concatenate([[0], np.flatnonzero(np.diff(sample[among])) + 1])
        votes = np.logical_or.reduceat(hit, first, axis=0).sum(axis=0)
        place = PLACES_PX[int(np.argmax(votes))]
        if votes.max() < least:
            break
        for _ in range(2):
            on = left & (np.abs(offset_px - basis @ place) < WITHIN_PX)
            if np.ptp(fraction[on]) == 0.0:
                return out
            place = np.linalg.lstsq(basis[on], offset_px[on], rcond=None)[0]
        if len(np.unique(sample[on])) < FEWEST_POINTS:
            break
        take(on)
    return out


def _basis(fraction: Array, along: Array) -> Array:
    """(n, 2): one, and the way along an edge, -1 to 1 from the first to the last of ``along`` (s,)."""
    middle, half = 0.5 * (along.min() + along.max()), 0.5 * (along.max() - along.min())
    return np.column_stack([np.ones(len(fraction)), (fraction - middle) / max(half, 1e-9)])


def _line(basis: Array, weight: Array) -> Array:
    """(2, n): from values along an edge to their offset at its middle and slope times half its length, weighted."""
    weighted = basis.T * weight
    return np.asarray(np.linalg.solve(weighted @ basis, weighted))


def _beside(image: Image, measurement: Measurement, edges: int) -> Array:
    """(e, 2, p) grey levels to both sides of the edges, each the mean of three pixels across; NaN of those out of
    view.
    """
    p = measurement.prediction
    grey = np.full((edges, 2, BESIDE_POINTS), np.nan)
    moved = (p.jacobian @ measurement.consensus.xi)[:, None] * p.normal
    for edge in p.layout.edges:
        own = np.flatnonzero(p.layout.edge == edge)
        own = own[np.linspace(0, len(own) - 1, BESIDE_POINTS).astype(int)]
        for side, way in enumerate((-BESIDE_PX, BESIDE_PX)):
            uv = p.uv_px[own] + moved[own] + way * p.normal[own]
            maps = np.array([uv + k * p.normal[own] for k in (-1.0, 0.0, 1.0)], np.float32)
            grey[edge, side] = read_profiles(image, maps[..., 0], maps[..., 1]).mean(axis=0)
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
