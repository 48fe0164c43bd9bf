"""Two fingers in space and their motion with the jaws, from outlines at several openings; what gives the distance, too.

Where a finger moves by T, a point of it moves by ``T / depth`` in the image, so its outline across T shows its depth.
One least-squares fit over all openings has as unknowns the inverse depth of every vertex, the direction u of the jaws'
relative travel, its length at each opening, the motion that both fingers have in common (tips on arcs go back while
they open), and how far each finger turns.  What one camera can't tell from another place or size is assumed with a
standard deviation, which reaches the result's covariance:

* both fingers move equally far along u, straight or on arcs (:data:`STRAIGHT`, :data:`ON_ARCS`);
* their tips, mirror images of each other, lie along u (:data:`~gripmon.teach.jaw_unknowns.BESIDE`);
* a finger's outline lies near a plane (:data:`~gripmon.teach.jaw_unknowns.OFF_PLANE`).

Each piece of an outline counts as two measurements, an offset and a turn, since its points err together.  Edges that
move along themselves show no depth; they are placed near the plane of the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gripmon.model.camera import Camera
from gripmon.model.least_squares import chi_square_limit
from gripmon.model.records import Array
from gripmon.teach.finger_depth import PlacedOutlines
from gripmon.teach.image_motion import FingerMoved, JawMotion, Unfit
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.jaw_unknowns import STATIONS, Jaws
from gripmon.teach.piece_lines import LEAST_SCATTER_PX, STRAIGHT_PX
from gripmon.teach.silhouette import FROM_BORDER_PX, NARROW_PX, in_image, measure_transitions, stations_ahead
from gripmon.teach.straight_pieces import LONGEST_CUT_PX
from gripmon.teach.vanishing import Outline

MORE_CHI2 = 9.0
"""Least decrease of the fit's chi-squared by which tips move on arcs: three standard deviations."""
BY_CHANCE = 0.0027
"""How often fingers that don't turn may seem to: three standard deviations.  Each opening has turns of its own, of
which each explains some of the noise."""
LEAST_TURN_RAD = math.radians(0.5)
"""Least turn that matters: at the root of a finger as long as the distance is six times as large, it is a twentieth of
a millimetre at its tip."""
_ROUNDS = ((40.0, 5.0), (25.0, 3.0), (15.0, 2.0), (8.0, 1.0), (5.0, 0.5), (3.0, STRAIGHT_PX), (3.0, STRAIGHT_PX))
"""Distances within which an outline is looked for, and its scatter (px), in turn: a start is known to a few tenths of a
motion of 100 px."""
_FINER = ((True, 1.0), (True, 0.5), (False, 0.3), (False, LEAST_SCATTER_PX))
"""Whether images are searched widely (4 px), and the least scatter (px), in turn."""
CONTRADICTS = 3.0
"""Scatters by which a piece contradicts the rest."""
AGREEING = 0.8
"""Least part of the outlines in view that agrees, and of what moves with the tips that perspective places: of two
fingers with four edges each, one or two may be others.
"""
_SAME_WAY = math.cos(math.radians(30.0))
_PER_PIECE = 2.0
_STEPS = 5


STRAIGHT = np.array([0.02, 0.01, 0.01])
"""Standard deviations of the common motion along the travel, square to travel and fingers, and along the fingers, over
the relative one: jaws that a rack, gears or a linkage moves on guides: 0.2 and 0.1 mm in 10 mm."""
ON_ARCS = np.array([0.02, 0.1, 1.0])
"""The same where tips move on arcs: 1 at 45 degrees, along fingers whose direction is known to 6 degrees."""
UNEQUAL = np.array([0.3, 0.01, 0.01])
"""The same of jaws that move unequally far: 0.5 if one stands."""
LOOSE = np.array([1.0, 1.0, 1.0])
"""The same of fingers that move each on its own."""


def fit_motion(
    camera: Camera,
    fingers: Sequence[Outline],
    seen: OpeningSeen,
    around: Mapping[float, OpeningSeen],
    *,
    placed: PlacedOutlines | None = None,
    travel: Mapping[float, tuple[float, float]] | None = None,
    direction: Array | None = None,
    loose: bool = False,
) -> JawMotion:
    """The motion from the ``seen`` opening to those ``around``.  ``placed``: where perspective places the fingers,
    which is used unless the motion contradicts it; ``travel``: their relative motion, over the TCP's depth, with its
    standard deviation, and ``direction`` (3,), where a calibration tells both.  ``loose``: how one finger, or each of
    two, moves, whatever that is; ``placed``, or an assumption, is needed then.  Raises :class:`Unfit`.
    """
    make = partial(_Fit, camera, fingers, seen, around, loose=loose)
    fits = [] if placed is None else [make(placed, None, None)]
    fit, best = _best_of(fits if loose else [*fits, make(None, travel, direction)], loose=loose)
    turned = fit.turned(fit.checked(best))
    return fit.result(fit.finer(best), turned)


def _best_of(fits: Sequence[_Fit], *, loose: bool) -> tuple[_Fit, _Solved]:
    """The first of the fits, which takes the depths from perspective, unless the outlines contradict it, as they
    contradict what perspective says of a taper's sides, which aren't parallel, and another one explains them clearly
    better; or it leaves out much of what moves with the tips, which another one places.  Otherwise what disagrees are
    the outlines, and the first agrees as far as the other one.
    """
    found: list[tuple[_Fit, _Solved]] = []
    why = Unfit("")
    for fit in fits:
        try:
            best = fit.solve(LOOSE if loose else STRAIGHT)
            if not loose:
                other = min((fit.solve(ON_ARCS), fit.solve(UNEQUAL)), key=lambda solved: solved.chi2)
                if best.chi2 - other.chi2 > MORE_CHI2:
                    best = other
        except Unfit as unfit:
            why = unfit
            continue
        if found:
            first, before = found[0]
            more = first.placed_share < AGREEING <= best.agreeing
            if not more and before.chi2 - best.chi2 <= MORE_CHI2:
                found = [(first, replace(before, agreeing=max(before.agreeing, best.agreeing)))]
                continue
        found = [(fit, best)]
        if min(fit.placed_share, best.agreeing) >= AGREEING:
            break
    if not found:
        raise why
    return found[0]


_Found = tuple[NDArray[np.intp], Array, Array]
"""Stations (m,) that meet an outline, a point of its line (m, 2), and its normal (m, 2), ideal coordinates."""


@dataclass(frozen=True)
class _Solved:
    unknowns: Array
    covariance: Array
    turns: Array
    chi2: float
    agreeing: float
    common: Array
    free: NDArray[np.bool_]


class _Fit(Jaws):
    """Finds the unknowns."""

    def solve(self, common: Array, *, turning: bool = False, start: _Solved | None = None) -> _Solved:
        """``common`` (3,): standard deviations of the common motion."""
        self.common = common
        unknowns = self.start.copy() if start is None else start.unknowns.copy()
        count, openings = len(unknowns), len(self.openings)
        free = np.ones(count, bool)
        if not turning:
            free[count - self.each * openings :].reshape(openings, -1)[:, 4:] = False
        for reach_px, scatter_px in _ROUNDS if start is None else _ROUNDS[3:]:
            self.scatter_px = scatter_px
            frame = self.frame(unknowns)
            found = self._match(self.moved(unknowns, frame)[1], reach_px)
            unknowns, jacobian = self._least_squares(unknowns, free, frame, found)
        normal = jacobian.T @ jacobian
        covariance = np.zeros((count, count))
        covariance[np.ix_(free, free)] = np.linalg.pinv(normal, hermitian=True)
        cost, agreeing = self._cost(unknowns, frame)
        chi2 = cost + float(np.square(np.concatenate(self.expected(unknowns))).sum())
        return _Solved(unknowns, covariance, self.split(unknowns)[3][:, 4:], chi2, agreeing, common, free)

    def finer(self, best: _Solved) -> _Solved:
        """The same by the images themselves, and weighted by how well they agree; its covariance stays that of before,
        with what lines may miss their edges by.
        """
        self.common, unknowns, free = best.common, best.unknowns, best.free
        for wide, least_px in _FINER:
            frame = self.frame(unknowns)
            moved = self.moved(unknowns, frame)[1]
            met = self._match(moved, _ROUNDS[-1][0])
            found = [self._in_images(*each, wide=wide) for each in zip(moved, self.around, met, strict=True)]
            rms = self._rms(self._off_px(unknowns, frame, found), self._pieces(found))
            self.scatter_px = max(float(np.median(rms[rms > 0.0])), least_px)
            unknowns = self._least_squares(unknowns, free, frame, found)[0]
        return replace(best, unknowns=unknowns)

    def turned(self, best: _Solved) -> str:
        """Why fingers turn while they move, if they do."""
        turning = self.solve(best.common, turning=True, start=best)
        turn = float(np.abs(turning.turns).max())
        more = int(np.count_nonzero(turning.free) - np.count_nonzero(best.free))
        if best.chi2 - turning.chi2 > chi_square_limit(BY_CHANCE, more) and turn > LEAST_TURN_RAD:
            return f"the fingers turn by {math.degrees(turn):.1f} degrees while they move"
        along = self.frame(best.unknowns)[0]
        if self.placed is None and float(along @ self.rays[np.concatenate(self.tips)].mean(axis=0)) < 0.0:
            # As if they pointed at the camera, which looks along them: roots are nearer, and would move farther.
            return "the fingers' tips move farther than their roots, so that they turn"
        return ""

    def _cost(self, unknowns: Array, frame: tuple[Array, Array]) -> tuple[float, float]:
        """The outlines' part of chi-squared, to which a piece that contradicts or isn't found adds a limited one, and
        which part of them agrees.
        """
        moved = self.moved(unknowns, frame)[1]
        found = self._match(moved, _ROUNDS[-1][0])
        off, piece = self._off_px(unknowns, frame, found), self._pieces(found)
        rms = self._rms(off, piece)[piece] / self.scatter_px
        most = CONTRADICTS**2
        each = _PER_PIECE * self._share(piece) / STATIONS
        cost = float(np.sum(each * rms**2 / (1.0 + rms**2 / most)))
        agreeing, total = float(np.sum(each[rms < CONTRADICTS])), float(np.sum(each))
        for k, (points, (met, _, _)) in enumerate(zip(moved, found, strict=True)):
            in_view = in_image(self.camera.project(points), self.shape_px, 2.0 * FROM_BORDER_PX)
            in_view[met] = False
            lost = _PER_PIECE / STATIONS * float(self._share(self.piece[in_view] + k * len(self.length_px)).sum())
            cost, total = cost + most * lost, total + lost
        return cost, agreeing / total

    def checked(self, best: _Solved) -> _Solved:
        """Raises :class:`Unfit` where the outlines contradict it."""
        if best.agreeing < AGREEING:
            raise Unfit(f"only {100.0 * best.agreeing:.0f} % of the outlines move as those of two rigid fingers would")
        return best

    def _match(self, moved: Array, reach_px: float) -> list[_Found]:
        """For each opening: the stations that meet an outline, a point of its line (m, 2), and its normal (m, 2)."""
        out = []
        ways = self.rays[self.ends[:, 1]] - self.rays[self.ends[:, 0]]
        for opening, points, (start, end) in zip(self.openings, moved, self.others, strict=True):
            xy = points[:, :2] / points[:, 2:]
            own = np.gradient(xy.reshape(-1, STATIONS, 2), axis=1).reshape(-1, 2)
            own = own / np.maximum(np.linalg.norm(own, axis=1), 1e-12)[:, None]
            own = own * np.sign((own * ways[:, :2]).sum(axis=1))[:, None]
            length = np.linalg.norm(end - start, axis=1)
            way = (end - start) / length[:, None]
            normal = np.column_stack([-way[:, 1], way[:, 0]])
            off = xy[:, None] - start
            across, ahead = (off * normal).sum(axis=2), (off * way).sum(axis=2)
            margin = np.minimum(2.0 / self.focal, 0.25 * length)
            fits = (own @ way.T > _SAME_WAY) & (ahead > -margin) & (ahead < length + margin)
            away = np.where(fits, np.abs(across), np.inf)
            best = away.argmin(axis=1)
            met = np.flatnonzero(away.min(axis=1) < reach_px / self.focal)
            if any(np.count_nonzero(self.of_finger[met] == k) < STATIONS for k in range(len(self.fingers))):
                raise Unfit("a finger of the first one isn't found there", opening)
            out.append((met, start[best[met]], normal[best[met]]))
        return out

    def _in_images(self, points: Array, other: OpeningSeen, matched: _Found, *, wide: bool) -> _Found:
        """As :meth:`_match`, each station measured in an opening's images; ``matched``, where those don't show it."""
        ahead = np.asarray(np.gradient(points.reshape(-1, STATIONS, 3), axis=1)).reshape(-1, 3)
        ways = self.camera.project(points + 1e-3 * ahead)
        uv = np.nan_to_num(self.camera.project(points), nan=-1e3)
        stations = stations_ahead(uv, ways, self.shape_px, NARROW_PX)
        seen = other.matte.images, stations, other.matte.noise
        got = measure_transitions(*seen, wide=wide, blur_px=self.blur_px)
        met = np.flatnonzero(got.usable)
        if len(met) < 0.5 * len(matched[0]):
            return matched
        across = stations.normal[met]
        at_px = uv[met] + across * got.offset_px[met, None]
        at, aside = (self.camera.undistort(at_px + k * across) for k in (0.0, 0.5))
        normal = (aside - at) / np.linalg.norm(aside - at, axis=1)[:, None]
        return met, at, normal

    def _off_px(self, unknowns: Array, frame: tuple[Array, Array], found: list[_Found]) -> Array:
        moved = self.moved(unknowns, frame)[1]
        out = []
        for points, (met, at, normal) in zip(moved, found, strict=True):
            xy = points[met, :2] / points[met, 2:]
            out.append(((xy - at) * normal).sum(axis=1) * self.focal)
        return np.concatenate(out)

    def _least_squares(
        self,
        unknowns: Array,
        free: NDArray[np.bool_],
        frame: tuple[Array, Array],
        found: list[_Found],
    ) -> tuple[Array, Array]:
        def at(part: Array) -> Array:
            full = unknowns.copy()
            full[free] = part
            return full

        def residuals(part: Array) -> Array:
            full = at(part)
            return np.concatenate([self._off_px(full, frame, found) * each, *self.expected(full)])

        each = self._worth(self._off_px(unknowns, frame, found), self._pieces(found))
        solved = least_squares(residuals, unknowns[free], max_nfev=_STEPS)
        return at(solved.x), np.asarray(solved.jac)

    def _pieces(self, found: list[_Found]) -> NDArray[np.intp]:
        """Which piece, at which opening, each matched station is of."""
        return np.concatenate([self.piece[met] + k * len(self.length_px) for k, (met, _, _) in enumerate(found)])

    def _worth(self, off: Array, piece: NDArray[np.intp]) -> Array:
        """Square root of each station's weight, 1/px: pieces that the rest contradicts hardly count (Geman and McClure
        1987), e.g. where a face turns and another of its edges is seen, and those that may only cut a corner off less.
        """
        agrees = 1.0 / (1.0 + np.square(self._rms(off, piece)[piece] / (CONTRADICTS * self.scatter_px)))
        return np.asarray(np.sqrt(_PER_PIECE * self._share(piece) / STATIONS) * agrees / self.scatter_px)

    def _share(self, piece: NDArray[np.intp]) -> Array:
        """How much pieces count: less if they may only cut a corner off."""
        return np.minimum(self.length_px[piece % len(self.length_px)] / LONGEST_CUT_PX, 1.0)

    @staticmethod
    def _rms(off: Array, piece: NDArray[np.intp]) -> Array:
        """Of each piece's stations."""
        return np.asarray(np.sqrt(np.bincount(piece, off**2) / np.maximum(np.bincount(piece), 1)))

    def result(self, best: _Solved, turned: str) -> JawMotion:
        q, _, way, tail = self.split(best.unknowns)
        frame = self.frame(best.unknowns)
        motions = self.moved(best.unknowns, frame)[0]
        moved = {
            opening: tuple(FingerMoved(m, float(t)) for m, t in zip(motion, turns, strict=True))
            for opening, motion, turns in zip(self.openings, motions, best.turns, strict=True)
        }
        travel = np.exp(tail[:, 0])
        at = len(best.unknowns) - self.each * (len(travel) - np.arange(len(travel)))
        covariance = best.covariance[np.ix_(at, at)] * np.outer(travel, travel)
        of_each = tuple(q[self.finger == k] for k in range(len(self.fingers)))
        slopes = []
        for k in range(len(self.fingers)):
            own = np.flatnonzero(self.finger == k)
            fit = np.linalg.pinv(self.plane(k))[1:]
            slopes.append(np.diag(fit @ best.covariance[np.ix_(own, own)] @ fit.T))
        slope_sigma = np.sqrt(np.mean(slopes, axis=0))
        # The TCP is the mean over the tips of the mean of their vertices, each at its ray over q.
        at_q = np.zeros((3, len(best.unknowns)))
        for tip in self.tips:
            at_q[:, tip] = -(self.rays[tip] / np.square(q[tip, None])).T / (len(tip) * len(self.tips))
        tcp = at_q @ best.covariance @ at_q.T
        # The unit vector of (cos, sin of an angle, rise) over both.
        flat, first = math.hypot(way[0], way[1]), len(q) + self.extra
        aside, ahead = np.array([-way[1], way[0], 0.0]) / flat, np.array([*way[:2] * -way[2] / flat, flat])
        by = np.column_stack([aside * flat, ahead * flat**2])
        ways = by @ best.covariance[first : first + 2, first : first + 2] @ by.T
        depths = of_each, self.kept, self.placed is None
        return JawMotion(*depths, moved, travel, covariance, way, ways, slope_sigma, tcp, turned)
