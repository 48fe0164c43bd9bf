"""What isn't known of two fingers that move with the jaws, what is assumed of it, and where it puts their outlines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.records import Array
from gripmon.teach.finger_depth import PlacedOutlines
from gripmon.teach.image_motion import TIP_SHARE, Unfit, along_finger, contact, rough_shift_px
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.vanishing import Outline

LARGEST_COMMON_MOTION = 0.2
"""Largest common motion along the jaws' travel, over the relative one: 0.5 if one jaw is fixed, a few hundredths for
tips at different depths that move equally far."""
BESIDE = 0.1
"""Standard deviation (rad) of the angle between the travel and the connection of two tips' vertices that correspond:
4 mm of 40, where the front edge of one and the back edge of the other are seen."""
SQUARE = 0.2
"""Standard deviation (rad) of the travel's angle with the image plane: cameras face the middle of the jaws."""
BESIDE_ROUGHLY = 0.4
"""The same of the tips' innermost vertices where none correspond: 16 mm, the thickness of a finger, of 40."""
CORRESPOND_RAD = math.radians(3.0)
"""Largest angle in the image between the travel and the connection of vertices that correspond: 2 px of 40, the
shortest gap at which a tip is told from its neighbour."""
OFF_PLANE = 0.05
"""Standard deviation of an outline's points from a plane, over their distance: half of a finger 10 mm thick, 100 mm
away."""
AS_PLACED = 0.03
"""Standard deviation of an outline's points, over their distance, from where perspective places them: 2 degrees of the
fingers' direction, seen 45 degrees from it."""
LEAST_TRAVEL_PX = 4.0
"""Least motion of the fingers against each other: twice what a rough shift resolves."""
STATIONS = 12
"""Number of stations on each piece."""
_PARTS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75))
"""Parts of a finger's length, from its tip, whose motions start the search."""


class Jaws:
    """The unknowns, in turn: inverse depths; three of each finger's plane, or its factor on what perspective says; the
    travel's direction, two; at each opening its logarithm, the common motion (3,) over it, and the fingers' turns.
    Arguments as of :func:`~gripmon.teach.jaw_fit.fit_motion`.
    """

    def __init__(
        self,
        camera: Camera,
        fingers: Sequence[Outline],
        seen: OpeningSeen,
        around: Mapping[float, OpeningSeen],
        placed: PlacedOutlines | None,
        travel: Mapping[float, tuple[float, float]] | None,
        direction: Array | None,
        *,
        loose: bool,
    ):
        if len(fingers) > 2 or (len(fingers) < 2 and not loose):
            raise Unfit("it takes two fingers")
        self.common: Array = np.ones(3)  # standard deviations of the common motion
        self.loose, self.sides = loose, np.array([-0.5, 0.5] if len(fingers) == 2 else [1.0])
        self.camera, self.focal, self.fingers, self.openings = camera, camera.fx_px, fingers, tuple(around)
        self.shape_px = seen.fingers[0].mask.shape
        self.placed, self.travel, self.direction = placed, travel, direction
        self.first = np.concatenate([[0], np.cumsum([len(f.xy) for f in fingers])])
        self.rays = np.vstack([np.column_stack([f.xy, np.ones(len(f.xy))]) for f in fingers])
        self.finger = np.repeat(np.arange(len(fingers)), np.diff(self.first))
        self.each = 4 + len(fingers)
        self.around, self.blur_px = tuple(around.values()), seen.blur_px
        self.others = [_lines(camera, other) for other in around.values()]
        self._start(camera, seen, around)

    def _stations(self) -> None:
        ends, finger = [], []
        for k, kept in enumerate(self.kept):
            ends += [(a + self.first[k], b + self.first[k]) for a, b in kept]
            finger += [k] * len(kept)
        lengths = np.linalg.norm(np.subtract(*self.rays[np.reshape(ends, (-1, 2)).T]), axis=1)
        self.length_px = self.focal * lengths
        self.ends = np.repeat(np.reshape(ends, (-1, 2)).astype(int), STATIONS, axis=0)
        self.piece = np.repeat(np.arange(len(ends)), STATIONS)
        self.of_finger = np.repeat(np.array(finger), STATIONS)
        self.share = np.tile(np.linspace(0.05, 0.95, STATIONS), len(ends))[:, None]
        self.ray = (1.0 - self.share) * self.rays[self.ends[:, 0]] + self.share * self.rays[self.ends[:, 1]]

    def _start(self, camera: Camera, seen: OpeningSeen, around: Mapping[float, OpeningSeen]) -> None:
        rough = np.array([
            [[rough_shift_px(f.mask, f.outwards, other, part) for part in _PARTS] for f in seen.fingers]
            for other in around.values()
        ]) / camera.fx_px  # fmt: skip
        tips = rough[:, :, 0]
        apart = tips[:, 1] - tips[:, 0] if len(self.fingers) == 2 else tips[:, 0]
        common = tips.mean(axis=1) if len(self.fingers) == 2 else 0.0 * apart
        length = np.linalg.norm(apart, axis=1)
        if not length.min() > LEAST_TRAVEL_PX / camera.fx_px:
            raise Unfit("the fingers don't move against each other")
        far = int(length.argmax())
        way = apart[far] / length[far]
        foremost = [f.xy[(f.xy @ f.outwards).argmax()] for f in self.fingers]
        if len(foremost) == 2:
            way = way * np.sign(float(way @ (foremost[1] - foremost[0])))
        shown = tuple(_shown(f, way) for f in self.fingers)
        self.kept = shown if self.placed is None else self.placed.kept
        self.placed_share = _length(self.fingers, self.kept) / _length(self.fingers, shown)
        """Of the outlines whose depth the motion shows, the part that is placed."""
        self._stations()
        self.tips = [first + own for first, own in zip(self.first, contact(self.fingers, way)[0], strict=False)]
        self.sign = np.sign(apart @ way)
        along = common @ way / length
        if np.abs(along).max() > LARGEST_COMMON_MOTION and not self.loose:
            raise Unfit("one finger moves farther than the other")
        if self.placed is None:
            q = np.concatenate([
                _roughly(f, s * 0.5 * apart[far], shifts)
                for f, s, shifts in zip(self.fingers, (-1.0, 1.0), rough[far], strict=True)
            ])  # fmt: skip
        else:
            depth = np.concatenate([p[:, 2] for p in self.placed.points])
            q = np.where(np.isfinite(depth), 1.0 / depth, 1.0)
        self.pairs = self._corresponding(way) if len(self.fingers) == 2 else np.zeros((0, 2), int)
        self.shape = q
        self.extra = 6 if self.placed is None else 2
        tail = np.zeros((len(self.openings), self.each))
        tail[:, 0] = np.log(length)
        tail[:, 1] = self.sign * along
        outwards = np.sum([f.outwards for f in self.fingers], axis=0)
        outwards -= way * float(way @ outwards)
        tail[:, 3] = self.sign * (common @ outwards) / float(np.linalg.norm(outwards)) / length
        self.start = np.concatenate([q, self._planes(q), [math.atan2(way[1], way[0]), 0.0], tail.ravel()])

    def _corresponding(self, way: Array) -> NDArray[np.intp]:
        """Pairs (p, 2) of the tips' vertices that lie beside each other along the travel, a direction (2,)."""
        off = self.rays[self.tips[1], :2][None] - self.rays[self.tips[0], :2][:, None]
        angle = np.abs(np.arctan2(off[..., 0] * way[1] - off[..., 1] * way[0], off @ way))
        nearest = [(i, int(j)) for i, j in enumerate(angle.argmin(axis=1)) if angle[i, j] < CORRESPOND_RAD]
        pairs = [(i, j) for i, j in nearest if angle[:, j].argmin() == i]
        return np.array([(self.tips[0][i], self.tips[1][j]) for i, j in pairs], int).reshape(-1, 2)

    def _planes(self, q: Array) -> Array:
        if self.placed is not None:
            return np.ones(len(self.fingers))
        return np.concatenate([np.linalg.lstsq(self.plane(k), q[self.finger == k], rcond=None)[0] for k in range(2)])

    def plane(self, k: int) -> Array:
        xy = self.fingers[k].xy
        return np.column_stack([np.ones(len(xy)), xy - xy.mean(axis=0)])

    def split(self, unknowns: Array) -> tuple[Array, Array, Array, Array]:
        """Inverse depths, what they are expected to be, the travel's direction (3,), and a row of each opening."""
        count = len(self.rays)
        q, extra = unknowns[:count], unknowns[count : count + self.extra]
        angle, rise = unknowns[count + self.extra : count + self.extra + 2]
        if self.placed is None:
            expected = np.concatenate([self.plane(k) @ extra[3 * k : 3 * k + 3] for k in range(2)])
        else:
            expected = self.shape * extra[self.finger]
        way = np.array([math.cos(angle), math.sin(angle), rise])
        return (
            q,
            expected,
            way / np.linalg.norm(way),
            unknowns[count + self.extra + 2 :].reshape(len(self.openings), -1),
        )

    def frame(self, unknowns: Array) -> tuple[Array, Array]:
        """Directions (3,) along the fingers, and square to them and to the travel."""
        q, _, way, _ = self.split(unknowns)
        points = self.rays / q[:, None]
        along = np.sum([along_finger(f, points[self.finger == k])[0] for k, f in enumerate(self.fingers)], axis=0)
        along = along - way * float(along @ way)
        along /= np.linalg.norm(along)
        return along, np.cross(along, way)

    def moved(self, unknowns: Array, frame: tuple[Array, Array]) -> tuple[Array, Array]:
        """Motions (o, 2, 3) of the fingers' tips, and all stations (o, n, 3) where they have moved to."""
        q, _, way, tail = self.split(unknowns)
        along, square = frame
        travel = self.sign * np.exp(tail[:, 0])
        common = tail[:, 1:2] * way + tail[:, 2:3] * square + tail[:, 3:4] * along
        motion = travel[:, None, None] * (self.sides[None, :, None] * way + common[:, None])
        here = (1.0 - self.share) * q[self.ends[:, :1]] + self.share * q[self.ends[:, 1:]]
        points = self.ray / here
        pivot = np.array([(self.rays[tip] / q[tip, None]).mean(axis=0) for tip in self.tips])[self.of_finger]
        arm = points - pivot
        turn = tail[:, 4:][:, self.of_finger, None]
        turned = (
            arm * np.cos(turn)
            + np.cross(square, arm) * np.sin(turn)
            + square * (arm @ square)[:, None] * (1.0 - np.cos(turn))
        )
        return motion, pivot + turned + motion[:, self.of_finger]

    def expected(self, unknowns: Array) -> list[Array]:
        """What is assumed, over its standard deviation."""
        q, expected, way, tail = self.split(unknowns)
        out = [
            (q - expected) / (OFF_PLANE if self.placed is None else AS_PLACED),
            self._off_beside(self.rays / q[:, None], way),
            way[2:] / SQUARE,
            (tail[:, 1:4] / self.common).ravel(),
        ]
        if self.travel is None:
            mean = (
                np.mean([1.0 / q[tip].mean() for tip in self.tips])
                if self.placed is None
                else np.mean(expected / self.shape)
            )
            out.append(np.array([1e3 * (mean - 1.0)]))
        else:
            known = np.array([self.travel[opening] for opening in self.openings])
            out.append((np.exp(tail[:, 0]) - known[:, 0]) / known[:, 1])
        if self.direction is not None:
            out.append(np.cross(self.direction, way) / (0.2 * BESIDE))
        return out

    def _off_beside(self, points: Array, way: Array) -> Array:
        """How far two tips aren't beside each other along the travel."""
        if len(self.fingers) == 1:
            return np.zeros(0)
        if len(self.pairs):
            between, sigma = points[self.pairs[:, 1]] - points[self.pairs[:, 0]], BESIDE
        else:
            first, last = (points[tip].mean(axis=0) for tip in self.tips)
            between, sigma = (last - first)[None], BESIDE_ROUGHLY
        between /= np.linalg.norm(between, axis=1)[:, None]
        return np.asarray(np.cross(between, way).ravel() / sigma)


def _length(fingers: Sequence[Outline], pieces: Sequence[Sequence[tuple[int, int]]]) -> float:
    """Of some pieces of each finger's outline, in the image."""
    return sum(float(np.linalg.norm(f.xy[a] - f.xy[b])) for f, own in zip(fingers, pieces, strict=True) for a, b in own)


def _shown(finger: Outline, way: Array) -> tuple[tuple[int, int], ...]:
    """The pieces whose depth the motion shows: not those behind the tip that move along themselves and end free, as the
    border of a body does behind which the finger comes out; nothing tells how far that is away.
    """
    pieces = np.reshape(finger.pieces, (-1, 2)).astype(int)
    ahead = finger.xy @ finger.outwards
    behind = (ahead[pieces] < ahead.max() - TIP_SHARE * float(np.ptp(ahead))).any(axis=1)
    free = (np.bincount(pieces.ravel(), minlength=len(ahead))[pieces] == 1).any(axis=1)
    along = finger.xy[pieces[:, 1]] - finger.xy[pieces[:, 0]]
    across = np.abs(along[:, 0] * way[1] - along[:, 1] * way[0])
    unknown = behind & free & (across < math.sin(CORRESPOND_RAD) * np.linalg.norm(along, axis=1))
    return tuple(piece for piece, left in zip(finger.pieces, unknown.tolist(), strict=True) if not left)


def _roughly(finger: Outline, shift: Array, of_parts: Array) -> Array:
    """Inverse depths (v,), linear along the finger, from its parts' motions (p, 2) over the tip's ``shift`` (2,)."""
    middles = [0.5 * (near + far) for near, far in _PARTS]
    by_part = of_parts @ shift / float(shift @ shift)
    slope, at_tip = np.polyfit(middles, by_part, 1)
    ahead = finger.xy @ finger.outwards
    return np.clip(at_tip + slope * (ahead.max() - ahead) / float(np.ptp(ahead)), 0.5, 2.0)


def _lines(camera: Camera, seen: OpeningSeen) -> tuple[Array, Array]:
    """Both ends (n, 2) of all pieces of outlines, ideal coordinates."""
    starts, ends = [], []
    for finger in seen.fingers:
        for chain in finger.chains:
            xy = camera.undistort(chain.uv_px)
            pieces = np.reshape(chain.pieces, (-1, 2)).astype(int)
            starts.append(xy[pieces[:, 0]])
            ends.append(xy[pieces[:, 1]])
    return np.vstack(starts), np.vstack(ends)
