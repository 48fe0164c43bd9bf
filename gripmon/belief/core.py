"""The belief: hypotheses about where the gripper stands and what may be wrong, one frame after another.

Multi-hypothesis tracking with fault modes as in ARAIM, merging by moments (GPB2).  Each frame: predict, branch by the
rates, weigh by p(frame | hypothesis), keep.  Every hypothesis always learns from every row that it doesn't doubt; there
is no other rule about learning.  Where the gripper is, how surely, and what is doubted are questions asked of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from gripmon.belief import bound as bounds
from gripmon.belief.doubts import Doubt, Onsets, Table, Told, bits, edges_of, nothing_told
from gripmon.belief.ends import lie_across, look
from gripmon.belief.held import follow
from gripmon.belief.jumps import Jumps
from gripmon.belief.keep import keep, remember, same_place
from gripmon.belief.nodes import Nodes, prepare
from gripmon.belief.rows import add_noise, fade, move
from gripmon.belief.search import AT_ONCE, Asked, Candidates, known, put, put_all, put_pairs, search, take_one_of
from gripmon.belief.state import (
    LATELY_S,
    LEAST_LIGHT_MEMORY,
    LIGHT,
    MOST_LAG,
    MOTION,
    OPENING,
    REFERENCE,
    SIZE,
    Bank,
    Flags,
    Ints,
    Priors,
    Seen,
)
from gripmon.model.records import Array

GUARD = 20.0
"""No hypothesis is believed beyond a surprise that the right one exceeds with at most e^-20 (once a year at 15/s)."""
NOT_KNOWN_WEIGHT = 0.1
"""Of the hypothesis that the pose isn't known, while the guard stops: policy."""
_MOST_CANDIDATES = 16384
"""Sets weighed in a frame; where there are more, what wasn't weighed isn't known, and there is no bound."""
_OF_SIZES = 10.0
"""Into how many parts a knock falls by its size and way; the smallest is a twentieth."""
_MOST_LISTED = 256
"""Hypotheses of one frame that count in its bound and don't go on."""


class Bound(NamedTuple):
    """``position_m`` and ``rotation_rad`` of the motion since the reference, ``absolute_m`` and ``absolute_rad`` of it
    and the reference's error together; infinite where there is none.
    """

    position_m: float
    rotation_rad: float
    absolute_m: float
    absolute_rad: float

    def within(self, position_m: float, rotation_rad: float) -> bool:
        """Whether the bound on the motion is no more than these."""
        return self.position_m <= position_m and self.rotation_rad <= rotation_rad


class Believed(NamedTuple):
    """After a frame: ``motion`` (6,) since the reference and ``reference_error`` (6,), of the heaviest place, and their
    ``bound``; ``dropped``, the probability that it doesn't count: what wasn't kept, and what of the frame before
    didn't go on; ``surprise`` of the best set; ``known``: False while nothing explains what is seen.
    """

    motion: Array
    reference_error: Array
    bound: Bound
    dropped: float
    surprise: float
    known: bool


class Belief:
    """Of one gripper with e edges.  ``along`` (3,): the fingers' direction in camera axes; ``risk`` of each of position
    and rotation together; at most ``most`` hypotheses are kept, and ``backgrounds`` remembered per edge.
    ``covariance`` (23, 23) of g at the reference, where it isn't that of the priors.
    ``everything``: all sets of doubts are weighed and none is merged or dropped, for tests with few doubts.
    ``searching`` False leaves the search out, which a test shows to be wrong.
    """

    def __init__(
        self, doubts: Sequence[Doubt], along: Array, priors: Priors | None = None, *, risk: float = 1e-5,
        most: int = 256, backgrounds: int = 1, everything: bool = False, searching: bool = True,
        covariance: Array | None = None,
    ) -> None:  # fmt: skip
        self.priors, self.risk, self.most = priors or Priors(), risk, most
        self.least = risk * 1e-3
        self._table = Table.of(doubts)
        self._onsets = Onsets(self._table)
        self._jumps = Jumps.of(self.priors, along)
        self._edges, self._fingers = len(doubts[0].edges), len(doubts[0].ends)
        p = self.priors
        self._sizes = np.array([p.near_px**2, p.far_px**2, p.missed, p.aligned, p.across_m**2, p.lasting_px**2])
        self._everything, self._searching = everything, searching
        kept = _MOST_CANDIDATES if everything else most + 1
        listed = kept if everything else kept + _MOST_LISTED
        self._bank, self._other = (Bank.empty(listed, self._edges, backgrounds) for _ in range(2))
        nodes = kept * (1 if everything else 1 + 2 * len(self._jumps.share))
        self._nodes = Nodes.empty(nodes, self._edges, len(doubts), self._fingers)
        self._candidates = Candidates.empty(kept * 4 if everything else _MOST_CANDIDATES)
        self._bank.covariance[0] = self.priors.covariance() if covariance is None else covariance
        self._bank.spread[0, :, 0, 0] = self.priors.lasting_px**2
        self._hypotheses = self._listed = 1
        self._first, self._lost = True, False
        self._of_ends = int(np.bitwise_or.reduce(self._table.ends))
        self._weighed = np.zeros(1, bool)  # of each hypothesis: it sees no end, and a knock since is weighed beside it
        self._dropped, self._mean = 0.0, np.zeros(SIZE)
        rows = np.arange(2 * self._edges + 1)
        self._rare = 0.5 * (stats.chi2.isf(max(self.priors.unseen_knock, 1e-300), np.maximum(rows, 1)) - rows)
        self._shaken = np.zeros((0, SIZE))  # the noise that g got before this frame where the mount is loose

    @property
    def weights(self) -> dict[int, float]:
        """Probability of each set of doubts (as bits)."""
        out: dict[int, float] = {}
        for h in range(self._hypotheses):
            doubts = int(self._bank.doubts[h])
            out[doubts] = out.get(doubts, 0.0) + math.exp(self._bank.log_weight[h])
        return out

    @property
    def moments(self) -> tuple[Array, Array]:
        """Mean (23,) and covariance (23, 23) of g over all hypotheses."""
        n = self._hypotheses
        weights, means = np.exp(self._bank.log_weight[:n]), self._bank.mean[:n]
        mean = weights @ means
        away = means - mean
        return mean, np.einsum("h,hij->ij", weights, self._bank.covariance[:n]) + (weights[:, None] * away).T @ away

    @property
    def places(self) -> list[tuple[Array, Array]]:
        """Mean (23,) and covariance (23, 23) of each place, the heaviest first."""
        bank, out = self._bank, list[tuple[Array, Array]]()
        for h in np.argsort(-bank.log_weight[: self._hypotheses]):
            here = bank.mean[h], bank.covariance[h]
            if not any(same_place(there[0], there[1], here[0], here[1]) for there in out):
                out.append(here)
        return out

    def update(
        self, seen: Seen, dt_s: float, told: Told | None = None, *, light_memory: float = 1.0,
        opening_m: float = 0.0,
    ) -> Believed:  # fmt: skip
        """One frame, ``dt_s`` after the last one.  ``light_memory``: 1 while the brightness at the fingers stays, else
        0. ``opening_m``: standard deviation of what the reported opening's error has changed by.  Raises ValueError
        unless time goes on.
        """
        first = self._first
        if not dt_s > 0.0:
            raise ValueError(f"dt_s = {dt_s}: frames follow each other in time")
        seen = Seen._make(map(np.ascontiguousarray, seen))  # machine code is made for each layout
        if not first:
            self._predict(dt_s, max(light_memory, LEAST_LIGHT_MEMORY), opening_m)
        for h in range(self._hypotheses):
            fade(self._bank, h, seen)
        told = told or nothing_told(self._edges, self._fingers)
        asked = Asked(seen, self._table, self._onsets.of(seen, dt_s), told, first, self.priors.near_px**2)
        n = self._branch(asked, dt_s)
        surprise = float(self._candidates.surprise[int(np.argmax(self._candidates.log_weight[:n]))])
        # A bound on the tail of chi-squared (Laurent and Massart 2000, lemma 1).
        usual = math.sqrt(2.0 * GUARD * int(seen.shown.sum())) + GUARD
        was_lost, self._lost, self._first = self._lost, not surprise <= usual, False
        if not self._lost:
            dropped = self._keep(n, asked) + float(n >= len(self._candidates.node))
        else:  # nothing is learnt from what nothing explains
            dropped = 0.0
            if not was_lost:
                self._not_known()
        return self._believed(dropped, surprise)

    def _predict(self, dt_s: float, light: float, opening_m: float) -> None:
        priors, root_dt = self.priors, math.sqrt(dt_s)
        lag = min(1.0 - math.exp(-dt_s / LATELY_S), MOST_LAG)
        factors = []
        for step_m, step_rad in (
            (priors.creep_m_s, priors.creep_rad_s),
            (priors.small_m, priors.small_rad),
        ):
            rows = np.zeros((8, SIZE))
            rows[range(6), range(6)] = np.repeat([step_m * root_dt, step_rad * root_dt], 3)
            rows[6, LIGHT], rows[7, OPENING] = priors.light_px * math.sqrt(1.0 - light * light), opening_m
            factors.append(rows[rows.any(axis=1)])
        self._shaken = factors[1]
        for h in range(self._hypotheses):
            move(self._bank, h, lag, light)
            factor = factors[int(self._is_loose(h))]
            if factor.any():
                add_noise(self._bank, h, self._bank.mean[h], self._bank.covariance[h], factor)

    def _branch(self, asked: Asked, dt_s: float) -> int:
        """Candidates of a frame; their number."""
        bank, nodes, candidates = self._bank, self._nodes, self._candidates
        nothing = np.zeros((0, SIZE))
        n, shakes = 0, -self.priors.shakes_per_s * dt_s
        for h in range(self._hypotheses):
            stays = 0.0 if self._everything else shakes * self._is_loose(h)
            self._node(h, h, -1, float(bank.log_weight[h]) + stays, nothing, asked)
            if not self._everything:
                n = put(candidates, n, nodes, h, int(bank.doubts[h]), bank, asked)
        if self._everything:
            for h in range(self._hypotheses):
                n = put_all(candidates, n, nodes, h, bank, asked)
            return n
        least = -math.log(self.least)
        n = self._jump(n, asked, dt_s, least)
        if asked.first or self._lost:
            for h in np.argsort(-bank.log_weight[: self._hypotheses])[:AT_ONCE]:
                n = put_pairs(candidates, n, nodes, int(h), bank, asked)
        reach = -math.log(0.3 * self.risk)
        n = int(search(candidates, n, nodes, bank, asked, reach, least)) if self._searching else n
        return self._knock_unseen(n, asked)

    def _knock_unseen(self, n: int, asked: Asked) -> int:
        """Sets that see no end, as soon as they matter, also after each knock: what hides the ends is what knocks, and
        a knock is what may hide them.
        """
        nodes, candidates, jumps = self._nodes, self._candidates, self._jumps
        self._just_weighed = np.zeros(len(candidates.node), bool)
        sees, i = self._see_an_end(n, asked.seen), 1 + int(candidates.node[:n].max())
        made = dict[tuple[int, int], int]()
        due = math.log(max(self.priors.unseen_knock, 1e-300))
        floor = float(candidates.log_weight[:n].max()) + math.log(self.least) - due + math.log(_OF_SIZES)
        by_policy = dict[int, float]()
        for c in np.flatnonzero(candidates.log_weight[:n] > floor) if self._table.at_ends else ():
            h, doubts = self._parent(int(c)), int(candidates.doubts[c])
            if sees[c] or self._is_knocked(int(c)) or self._is_weighed(int(c)):
                continue
            self._just_weighed[c] = True
            for j in np.flatnonzero(jumps.knock):
                log = due + math.log(jumps.share[j])
                if (h, int(j)) not in made:
                    factor = jumps.factors[j, : jumps.ranks[j]]
                    self._node(i, h, int(j), float(self._bank.log_weight[h]) + log, factor, asked)
                    made[h, int(j)], i = i, i + 1
                m = put(candidates, n, nodes, made[h, int(j)], doubts, self._bank, asked)
                k = n if m > n else int(known(candidates, n, made[h, int(j)], doubts))
                n = m
                if k < 0:
                    self._just_weighed[c] = False
                    continue
                # Policy, whatever the ends that aren't trusted say of it.
                by_policy[k] = float(np.logaddexp(by_policy.get(k, -math.inf), candidates.log_weight[c] + log))
        for k, log in by_policy.items():
            candidates.log_weight[k] = max(candidates.log_weight[k], log)
        return n

    def _parent(self, c: int) -> int:
        return int(self._nodes.parent[self._candidates.node[c]])

    def _is_knocked(self, c: int) -> bool:
        jump = int(self._nodes.jump[self._candidates.node[c]])
        return jump >= 0 and bool(self._jumps.knock[jump])

    def _is_weighed(self, c: int) -> bool:
        """Whether a candidate's parent saw no end either, doubted the same ends, and a knock was weighed beside it."""
        h = self._parent(c)
        changed = int(self._bank.doubts[h]) ^ int(self._candidates.doubts[c])
        return bool(self._weighed[h]) and not changed & self._of_ends

    def _jump(self, n: int, asked: Asked, dt_s: float, least: float) -> int:
        """Each hypothesis after each jump that may matter: whose prior, with what it could explain, isn't too light.
        Policy: what by chance is as rare as an unseen knock is may have been a knock.
        """
        bank, candidates, jumps = self._bank, self._candidates, self._jumps
        stayed = candidates.log_weight[: self._hypotheses].copy()
        best = float(candidates.log_weight[:n].max())
        i = self._hypotheses
        for h in range(self._hypotheses):
            hope = max(float(candidates.surprise[h]), 0.0) + float(self._nodes.hope[h])
            struck = not asked.first and float(candidates.surprise[h]) > self._rare[int(candidates.own[h])]
            per_s = jumps.loose_per_s if self._is_loose(h) else jumps.per_s
            for j in range(len(jumps.share)):
                chance = jumps.share[j] * (jumps.at_first[j] if asked.first else -math.expm1(-per_s[j] * dt_s))
                if jumps.knock[j] and struck:
                    chance = max(chance, jumps.share[j] * self.priors.unseen_knock)
                if chance <= 0.0:
                    continue
                log = math.log(chance)
                if stayed[h] + hope + log < best - least:
                    continue
                factor = jumps.factors[j, : jumps.ranks[j]]
                self._node(i, h, j, float(bank.log_weight[h]) + log, factor, asked)
                n = put(candidates, n, self._nodes, i, int(bank.doubts[h]), bank, asked)
                i += 1
        return n

    def _is_loose(self, h: int) -> bool:
        return bool(self._bank.doubts[h] & self._table.moves)

    def _node(self, i: int, h: int, jump: int, before: float, factor: Array, asked: Asked) -> None:
        nodes = self._nodes
        nodes.parent[i], nodes.jump[i], nodes.before[i] = h, jump, before
        doubts = int(self._bank.doubts[h])
        doubted = edges_of(doubts, self._table.edges)
        prepare(nodes, i, self._bank, h, factor, asked.seen, self._sizes, doubted)
        lie_across(nodes, i, self._bank, asked.seen, self._table, self._sizes)
        look(nodes, i, self._bank, asked.told, self._table)
        noise = np.concatenate([self._shaken, factor]) if self._is_loose(h) else factor
        held = edges_of(doubts & self._table.held, self._table.edges)
        follow(nodes, i, self._bank, h, noise, asked.seen, held, self.priors.missed)

    def _keep(self, n: int, asked: Asked) -> float:
        bank, other, nodes, candidates = self._bank, self._other, self._nodes, self._candidates
        most, least = (min(n, len(bank.doubts)), 0.0) if self._everything else (self.most, self.least)
        merging = not self._everything
        chosen, listed, dropped = keep(
            candidates, n, nodes, bank, other, asked.seen, self._table, asked.near, most, least, merging
        )
        parents = nodes.parent[candidates.node[chosen]]
        for old, new in zip(bank[4:], other[4:], strict=True):
            new[: len(chosen)] = old[parents]
        jumps = self._jumps
        remember(
            other, chosen, candidates, nodes, bank, jumps.factors, jumps.ranks, asked.seen, self._table, self._sizes
        )
        owed = self._owed(chosen, other.log_weight, self._see_an_end(n, asked.seen)[chosen])
        left = float(np.exp(bank.log_weight[self._hypotheses : self._listed]).sum())  # of the frame before
        self._bank, self._other, self._hypotheses, self._listed = other, bank, len(chosen), listed
        return left + float(dropped) + owed

    def _owed(self, chosen: Ints, log_weight: Array, sees: Flags) -> float:
        """Probability of a knock that isn't weighed beside hypotheses that see no end: they were too light for it."""
        weighed, owed = np.zeros(len(chosen), bool), 0.0
        for q, c in enumerate(chosen) if self._table.at_ends and not self._everything else ():
            if not sees[q]:
                weighed[q] = self._is_knocked(int(c)) or self._is_weighed(int(c)) or self._just_weighed[c]
                owed += 0.0 if weighed[q] else math.exp(log_weight[q]) * self.priors.unseen_knock
        self._weighed = weighed
        return owed

    def _see_an_end(self, n: int, seen: Seen) -> Flags:
        """(n,) whether candidates take an edge at a finger's end for the gripper's that is seen better than to an
        edge's width; a worse one doesn't tell of it.
        """
        sharp = seen.shown & (seen.strength + seen.white[:, 0, 0] < self.priors.near_px**2)
        return take_one_of(self._candidates, n, self._nodes, self._table.edges, self._table.at_ends & bits(sharp))

    def _not_known(self) -> None:
        """Beside what explains nothing: the pose is anywhere a knock may have brought it."""
        bank, n = self._bank, self._hypotheses
        h = int(np.argmax(bank.log_weight[:n]))
        if n == len(bank.log_weight):
            n -= 1
        for of in bank:
            of[n] = of[h]
        widest = self._jumps.factors[len(self.priors.any_way)]  # behind the small motion: knocks any way, by size
        add_noise(bank, n, bank.mean[n], bank.covariance[n], widest)
        bank.log_weight[:n] += math.log(1.0 - NOT_KNOWN_WEIGHT)
        bank.log_weight[n] = math.log(NOT_KNOWN_WEIGHT)
        self._hypotheses = self._listed = n + 1
        self._weighed = np.append(self._weighed[:n], self._weighed[h])

    def _believed(self, dropped: float, surprise: float) -> Believed:
        bank, n, mean = self._bank, self._listed, np.empty(SIZE)
        bounds.place(bank, n, mean)
        self._dropped, self._mean = dropped, mean
        return Believed(mean[MOTION], mean[REFERENCE], self.bound(self.risk), dropped, surprise, not self._lost)

    def bound(self, risk: float) -> Bound:
        """Of the last frame, at another risk; that of the filter is the smallest for which enough is kept."""
        left = 0.0 if self._lost else 0.5 * risk - self._dropped
        floors = (bounds.SPLIT_M, bounds.SPLIT_RAD) * 2
        of = (self._bank, self._listed, self._mean)
        return Bound(*(float(bounds.bound(*of, a, f, left)) for a, f in zip(_BOUNDED, floors, strict=True)))


def _bounded() -> Array:
    asked = np.zeros((4, 3, SIZE))
    asked[0, :, MOTION][:, :3] = asked[1, :, MOTION][:, 3:] = np.eye(3)
    asked[2:] = asked[:2]
    asked[2, :, REFERENCE][:, :3] = asked[3, :, REFERENCE][:, 3:] = np.eye(3)
    return asked


_BOUNDED = _bounded()
"""(4, 3, 23): which combinations of g :class:`Bound` is about, in its order."""
