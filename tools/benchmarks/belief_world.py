"""A gripper in a wrist camera, sampled from the belief's own model, without images: what it must be right about.

Two box fingers 10 x 10 x 40 mm, 120 mm before a lens of 600 px, of whose 16 edges 8 to 16 are measured.  A rare fault
may be forced once in a run, so that its risk is known from few runs (strata).  A second world differs from the model.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.belief.doubts import FINGER, GROUP, Doubt, Told, of_edges, of_ends, of_mount
from gripmon.belief.state import FOCAL, LIGHT, MOTION, OPENING, SIZE, STILL, Priors, Seen
from gripmon.model.records import Array

Flags = NDArray[np.bool_]
DT_S = 1.0 / 15.0
WHITE_PX, BACKGROUND_PX = 0.02, 0.10
RIGHT, WRONG = np.array([0.05, 0.25, 0.70]), np.array([0.62, 0.36, 0.02])
"""Of a finger's 0, 1 or 2 indications of an end, by whether it is one."""
MEMORY = 0.95
OTHERS = 0.15
"""How often another line is found beside an edge (0.1 to 0.25 in rendered and simulated scenes)."""
_FOCAL_PX, _DISTANCE_M = 600.0, 0.12


@dataclass(frozen=True)
class View:
    """``rows`` (e, 2, 23) of the edges' offsets and slopes; which run ``along`` the fingers (e,); the fingers' ``axis``
    (3,) in camera axes; the ``doubts``, and of each what it is called.
    """

    rows: Array
    along: Flags
    axis: Array
    doubts: tuple[Doubt, ...]
    names: tuple[str, ...]


class Edge(NamedTuple):
    """Of a finger (0, 1): ``ends`` (2, 3), m, in the gripper; it may be an ``inner`` one, of the ``side`` 0, 1 (2:
    across).
    """

    finger: int
    along: bool
    inner: bool
    side: int
    ends: Array


def view(rng: np.random.Generator) -> View:
    """Fingers along -y of the gripper, the jaw along x, seen from 30 degrees above."""
    gap, tilt = rng.uniform(0.02, 0.06), math.radians(30.0 + rng.uniform(-8.0, 8.0))
    rotation = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    at = np.array([rng.uniform(-0.008, 0.008), rng.uniform(-0.006, 0.006), _DISTANCE_M])
    edges = _edges(gap)
    count = int(rng.integers(8, 17))
    while True:
        chosen = [edges[i] for i in np.sort(rng.permutation(len(edges))[:count])]
        runs = sum(e.along for e in chosen)
        if runs >= 4 and count - runs >= 2:
            break
    rows = np.array([_rows(edge, rotation, at, gap) for edge in chosen])
    along = np.array([e.along for e in chosen])
    doubts, names = _doubts(chosen)
    return View(rows, along, rotation @ np.array([0.0, 1.0, 0.0]), doubts, names)


def _edges(gap: float) -> list[Edge]:
    out = []
    for finger, sign in ((0, -1.0), (1, 1.0)):
        near, far, half = sign * gap / 2.0, sign * (gap / 2.0 + 0.01), 0.005
        for x, z, inner, side in (
            (near, -half, True, 0),
            (far, -half, False, 0),
            (far, half, False, 1),
            (near, half, True, 1),
        ):
            out.append(Edge(finger, True, inner, side, np.array([[x, 0.04, z], [x, 0.0, z]])))
        for a, b, inner, side in (
            ((near, -half), (far, -half), False, 0),
            ((near, -half), (near, half), True, 2),
            ((far, -half), (far, half), False, 2),
            ((near, half), (far, half), False, 1),
        ):
            out.append(Edge(finger, False, inner, side, np.array([[a[0], 0.0, a[1]], [b[0], 0.0, b[1]]])))
    return out


def _rows(edge: Edge, rotation: Array, at: Array, gap: float) -> Array:
    """Central differences of the edge's offset at its middle and slope times half its length, px."""

    def seen(g: Array) -> tuple[Array, Array, Array]:
        sign = -1.0 if edge.finger == 0 else 1.0
        shift = np.array([sign * g[OPENING] / 2.0, 0.0 if edge.along else -g[19 + edge.finger], 0.0])
        turn = g[3:6] + g[15:18]
        points = (np.vstack([edge.ends, edge.ends.mean(axis=0)]) + shift) @ rotation.T
        points = points + np.cross(turn, points) + g[:3] + g[12:15] + at
        first, last, middle = _FOCAL_PX * (1.0 + g[FOCAL]) * points[:, :2] / points[:, 2:]
        return first, last, middle

    first, last, middle = seen(np.zeros(SIZE))
    way = (last - first) / np.linalg.norm(last - first)
    normal = np.array([-way[1], way[0]])
    body = np.array([(-1.0 if edge.finger == 0 else 1.0) * (gap / 2.0 + 0.005), 0.02, 0.0]) @ rotation.T + at
    if normal @ (middle - _FOCAL_PX * body[:2] / body[2]) < 0.0:
        normal = -normal
    rows = np.zeros((2, SIZE))
    for k in range(SIZE):
        step = np.zeros(SIZE)
        step[k] = 1e-6
        (a0, b0, m0), (a1, b1, m1) = seen(-step), seen(step)
        rows[0, k], rows[1, k] = normal @ (m1 - m0) / 2e-6, normal @ ((b1 - a1) - (b0 - a0)) / 4e-6
    rows[0, LIGHT] = 1.0
    return rows


def _doubts(edges: Sequence[Edge]) -> tuple[tuple[Doubt, ...], tuple[str, ...]]:
    along, finger = np.array([e.along for e in edges]), np.array([e.finger for e in edges])
    inner, side = np.array([e.inner for e in edges]), np.array([e.side for e in edges])
    doubts = of_edges(len(edges), 2)
    names = ["edge"] * len(doubts)
    for d in of_ends([~along & (finger == f) for f in (0, 1)]):
        doubts.append(d)
        names.append(("fooled " if d.fooled else "") + ("all ends" if d.ends.all() else "ends"))
    doubts.append(of_mount(len(edges), 2))
    names.append("loose")
    groups = [("plate", inner & along & (side == 0), GROUP), ("inner", inner, GROUP)]
    groups += [("side", along & (side == s), GROUP) for s in (0, 1)]
    groups += [("finger", finger == f, FINGER) for f in (0, 1)]
    for name, flags, rates in groups:
        if 1 < flags.sum() < len(edges):
            doubts.append(Doubt(flags, rates, np.zeros(2, bool)))
            names.append(name)
    return tuple(doubts), tuple(names)


class Sample(NamedTuple):
    """A frame, what it is true of it: ``motion`` (6,), and which doubts are ``on`` (d,)."""

    seen: Seen
    told: Told
    light_memory: float
    motion: Array
    on: Flags


FAULTS = ("knock", "knock unseen", "finger", "opening", "fooled")
SECOND = ("tails", "rates", "likeness")


class World:
    """One run.  ``fault`` (of FAULTS, or None) is forced once; what of SECOND ``differs`` from the belief's model:
    errors with heavy tails, more frequent faults and motions, a likeness of moving pictures that is told wrong by 0.3.
    """

    def __init__(
        self, rng: np.random.Generator, priors: Priors, frames: int, fault: str | None = None,
        differs: Collection[str] = (),
    ) -> None:  # fmt: skip
        self.view, self._rng, self._priors, self._fault, self._differs = view(rng), rng, priors, fault, differs
        edges = len(self.view.along)
        self._g = rng.normal(size=SIZE) * np.sqrt(np.diag(priors.covariance()))
        self._g[:12] = 0.0
        self._lasting, self._back = self._noise(priors.lasting_px, edges), np.zeros((edges, 2))
        self._busier = 3.0 if "rates" in differs else 1.0
        rare = [n == "finger" or n.startswith("fooled") for n in self.view.names]  # strata of their own
        first = [d.rates.first for d in self.view.doubts]
        self._on = (rng.random(len(first)) < first) & ~np.array(rare)
        self._hides = rng.random(len(first)) < 0.5
        self._place, self._around = np.zeros((edges, 2)), np.zeros((edges, 2))
        self._size, self._was = np.ones(edges), np.zeros(edges, bool)
        self._before = np.zeros((edges, 2))
        self._answer, self._answered = np.zeros(2, int), np.full(2, -1)
        self._moving, self._t = bool(rng.random() < 0.5), -1
        self.at = int(rng.integers(10, frames - 10)) if fault else -1
        self._from = int(rng.integers(1, self.at)) if fault in ("knock unseen", "fooled") else -1

    def _noise(self, sigma: float, edges: int) -> Array:
        if "tails" in self._differs:
            return np.asarray(sigma * self._rng.standard_t(4, (edges, 2)) / math.sqrt(2.0))
        return self._rng.normal(0.0, sigma, (edges, 2))

    def frame(self) -> Sample:
        """The next one."""
        self._t += 1
        rng, edges, first = self._rng, len(self.view.along), self._t == 0
        if rng.random() < DT_S / 2.0:
            self._moving = not self._moving
        like = np.full(edges, 0.999) if not self._moving else rng.uniform(0.0, 0.95, edges)
        like = np.zeros(edges) if first else like
        light = 1.0
        if not first:
            light = self._move()
            self._begin(like)
        new = self._noise(BACKGROUND_PX, edges) * (1.0, math.sqrt(3.0))
        self._back = like[:, None] * self._back + np.sqrt(1.0 - like[:, None] ** 2) * new
        own = self.view.rows @ self._g
        foreign = self._foreign(own, like)
        self._before = own
        shown = np.ones(edges, bool)
        for i in np.flatnonzero(self._on & self._hides):
            if self.view.doubts[i].held and self.view.names[i] in ("ends", "all ends", "inner", "side"):
                shown &= ~self.view.doubts[i].edges
        where = np.where(foreign[:, None], self._around + self._place, own + self._lasting)
        lines, count, fitted = self._lines(where + self._back + self._noise(WHITE_PX, edges), shown, own)
        rows, searched = (of[:, None].repeat(2, axis=1) for of in (self.view.rows, own))
        white = np.full(lines.shape, WHITE_PX**2)
        seen = Seen(
            rows, lines, white, searched, lines, white, count, fitted,
            np.zeros(edges, np.int64), self._told_likeness(like), np.full(edges, BACKGROUND_PX**2),
        )  # fmt: skip
        return Sample(seen, self._witnesses(first), light, self._g[MOTION].copy(), self._on.copy())

    def _lines(self, measured: Array, shown: Flags, own: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
        """Lines (e, 2, 2) where edges were searched, how many (e,), and which is the fit's, -1 for none (e,): what is
        there and now and then another beside it, or only that.
        """
        rng, priors, edges = self._rng, self._priors, len(shown)
        other = own + rng.normal(0.0, priors.far_px, (edges, 2))
        lines = np.stack([measured, other], axis=1)
        missed = rng.random(edges) < priors.missed
        lines[missed, 0] = other[missed]
        two = shown & ~missed & (rng.random(edges) < OTHERS)
        return lines, np.where(two, 2, np.where(shown, 1, 0)), np.where(shown & ~missed, 0, -1)

    def _told_likeness(self, like: Array) -> Array:
        if "likeness" not in self._differs or self._t == 0:
            return like
        wrong = like + self._rng.choice([-0.3, 0.3], len(like))
        return np.where(like < STILL, np.clip(wrong, 0.0, 0.98), like)

    def _move(self) -> float:
        """Creep, small motions, the forced fault, another light; what is left of the light before."""
        rng, priors = self._rng, self._priors
        creep = np.repeat([priors.creep_m_s, priors.creep_rad_s], 3) * math.sqrt(DT_S)
        small = np.repeat([priors.small_m, priors.small_rad], 3)
        self._g[MOTION] += rng.normal(size=6) * creep
        loose = bool(self._on[self.view.names.index("loose")])
        often = priors.shakes_per_s if loose else priors.small_per_s * (10.0 if "rates" in self._differs else 1.0)
        if rng.random() < -math.expm1(-often * DT_S):
            self._g[MOTION] += rng.normal(size=6) * small
        if loose:
            self._g[MOTION] += rng.normal(size=6) * small * math.sqrt(DT_S)
        if self._t == self.at:
            if self._fault in ("knock", "knock unseen"):
                self._g[MOTION] += self._knock()
            if self._fault == "opening":
                self._g[OPENING] += rng.normal(0.0, priors.opening_jump_m)
        if rng.random() < 0.1 * DT_S:
            self._g[LIGHT] = rng.normal(0.0, priors.light_px)
            return 0.0
        return 1.0

    def _knock(self) -> Array:
        """Log-normal, median 3 mm, nine in ten between 1 and 10; one in three along the fingers."""
        rng, out = self._rng, np.zeros(6)
        size_m = 3e-3 * math.exp(rng.normal(0.0, 0.7))
        if rng.random() < self._priors.along_share:
            out[:3] = self.view.axis * size_m * rng.choice([-1.0, 1.0])
            return out
        way = rng.normal(size=3)
        out[:3], out[3:] = way / np.linalg.norm(way) * size_m, rng.normal(0.0, self._priors.knock_rad, 3)
        return out

    def _begin(self, like: Array) -> None:
        rng, now = self._rng, self._on.copy()
        for i, d in enumerate(self.view.doubts):
            rates, name = d.rates, self.view.names[i]
            new = 0.0 if d.held else 1.0 - float(like[d.edges][0])
            if self._on[i]:
                now[i] = rng.random() < (1.0 - rates.leaves_per_background * new) * math.exp(-rates.leaves_per_s * DT_S)
            elif name != "finger" and not d.fooled:
                stays = (1.0 - rates.per_background * new) * math.exp(-rates.per_s * DT_S)
                now[i] = rng.random() < self._busier * (1.0 - stays)
        if self._from >= 0 and self._from <= self._t <= self.at:
            now[self.view.names.index("fooled all ends" if self._fault == "fooled" else "all ends")] = True
        if self._fault == "finger" and self._t == self.at:
            now[rng.choice([i for i, n in enumerate(self.view.names) if n == "finger"])] = True
        self._hides = np.where(now & ~self._on, rng.random(len(now)) < 0.5, self._hides)
        self._on = now

    def _foreign(self, own: Array, like: Array) -> Flags:
        """Which edges are another thing's; where these lie is drawn when an edge begins to be one, and what is held
        goes where the gripper goes.
        """
        rng, priors, doubts = self._rng, self._priors, self.view.doubts
        foreign, held = np.zeros(len(like), bool), np.zeros(len(like), bool)
        for i in np.flatnonzero(self._on):
            foreign |= doubts[i].edges
            held |= doubts[i].edges & doubts[i].held
        stays = np.where(held | (like >= STILL), 1.0, like)[:, None]
        fresh = rng.normal(size=self._place.shape) * self._size[:, None]
        self._place = stays * self._place + np.sqrt(1.0 - stays**2) * fresh
        self._around += np.where(held[:, None], own - self._before, 0.0)
        for e in np.flatnonzero(foreign & ~self._was):
            self._size[e] = priors.near_px if rng.random() < 0.5 else priors.far_px
            self._place[e], self._around[e] = rng.normal(0.0, self._size[e], 2), own[e]
        self._was = foreign
        return foreign

    def _witnesses(self, first: bool) -> Told:
        repeats = np.zeros(2, bool)
        for f in (0, 1):
            about = [d for i, d in enumerate(self.view.doubts) if self._on[i] and d.ends[f]]
            right = not about or any(d.fooled for d in about)
            state = 2 * int(right) + int(bool(about))
            before = self._answer[f]
            if first or state != self._answered[f] or self._rng.random() >= MEMORY:
                self._answer[f] = self._rng.choice(3, p=RIGHT if right else WRONG)
            self._answered[f], repeats[f] = state, not first and before == self._answer[f]
        right, wrong = (np.log(of[self._answer])[None] for of in (RIGHT, WRONG))
        none, rows = np.full((1, 2), np.nan), self.view.rows[:, 0]
        memory, zero = np.full((1, 2), MEMORY), np.zeros(1)
        return Told(right, wrong, memory, 1.0 * repeats[None], none, zero, zero, rows, self._g[None], 0)
