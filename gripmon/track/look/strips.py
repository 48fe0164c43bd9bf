"""What a finger shows along its own direction, inside its outline: how far a pose has slid along the fingers.

Long edges say nothing about a motion along the fingers, and a line round a finger looks like its end.  But the grey
levels between the end and some millimetres behind it belong to the gripper: a pose that has taken something else for
the ends has them elsewhere.  They lie inside the outline, so that no other backgrounds have to be waited for.  A line
parallel to the fingers stays the same line when the gripper is slid along them: read once, it serves for every slide.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.compiled import compiled
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import GREY_BGR
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Image, StripsRecord

LENGTH_PX, REACH_PX = 64, 96
"""How much of a finger behind its end is learnt, and how far off slides are tried, px where it was learnt: as far as a
lost gripper is searched for, 12 mm at 8 px to the millimetre.
"""

STRIP_LINES = 3
"""Side by side behind each end edge: something partly in front of a finger hides some of them."""

SLOPE_PX = 15
"""Length of the mean along the strips that is subtracted, px: light that falls off along the finger says nothing."""

FILTERED_PX = SLOPE_PX // 2 + 1
"""Beside a strip that what is smooth and what changes slowly on it are taken from."""

NODE_PX = 16
"""Between points of a strip that are projected: lenses bend a line by less than a hundredth of a pixel between them."""

INDEPENDENT_PX = 4.0
"""Between points of a strip whose errors have nothing to do with each other: the smoothing and the lens's blur."""

FEWEST_POINTS = 40
"""Independent points of the fingers in view below which strips don't say that the gripper has slid: two faces of each
of two fingers that show 50 px.  Fewer look alike elsewhere by chance, and an exposure that changes moves them as much
as a slide would: 25 px of two fingers said so in half of the stills of a gripper that didn't move.
"""

ONE_EDGE_PX = 2
"""Edges of an image that are nearer to each other are one, and fitted ten times better: no mark on a finger is taken
for its end then, and a slide up to this can't be seen.
"""

CLIP_SIGMAS = 3.0
"""Standard deviations that a grey level counts for at most in a strip's mean: a bright thing in front of a finger
weighs no more than a line on it.
"""

EXPLAINED_CORRELATION = 0.87
"""Correlation above which a place isn't better for a higher one: three quarters of the variance; the rest is light."""

FIRST_FRAMES, MOST_FRAMES = 3, 32
"""Frames learned one after the other, and remembered.  One is enough to judge: seen inside the outline, they differ by
noise alone.
"""

RELEARN_S = 1.0
"""Pause between frames that are learnt when enough are, s: wear and dirt take hours."""

LIKE_CORRELATION = 0.5
"""Correlation below which strips aren't those that were learnt: a quarter of the variance, when noise leaves seven
tenths of it.  Something is in front of them then, unless it stays for :data:`MOST_FRAMES`.
"""


class _Layout(NamedTuple):
    """Where n strips lie, gripper frame: their points nearest to the finger's end (n, 3), the steps (n, 3) from each
    point to the next, which points are on the finger (n, LENGTH_PX), and the finger of each (n,); ``fingers_m`` (f, 3):
    where the fingers' first points were.
    """

    start_m: Array
    step_m: Array
    within: NDArray[np.float32]
    finger: NDArray[np.intp]
    fingers_m: Array


class _Places(NamedTuple):
    """Where points on the strips were projected at a pose (4, 4) and an opening: (m, 2), px, and by how much that
    changes with the pose and the opening (m, 2, 7); zero where the lens maps nothing.
    """

    cam_T_grip: Array
    jaw_opening_m: float | None
    uv_px: Array
    jacobian: Array


class StripsRefused(ValueError):
    """Kept strips belong to something else, or don't hold together; the text says so."""


class StripsSeen(NamedTuple):
    """What the strips show at a pose."""

    slide_m: Array | None = None
    """(3,) by how much the gripper stands along its fingers from there, gripper frame; None where that isn't seen."""

    here: bool = False
    """Whether it is seen to stand there."""

    undecided: bool = False
    """Whether it may as well stand elsewhere: fingers that look alike all along themselves."""


class FingerStrips:
    """Strips along the fingers of one gripper in one camera; ``along`` (e,): which of its edges run along them."""

    def __init__(self, camera: Camera, gripper: Gripper, along: NDArray[np.bool_]):
        self._camera, self._gripper, self._along = camera, gripper, along
        self._first = [int(np.argmax(gripper.point_finger == f)) for f in range(len(gripper.finger_ids))]
        self.frames = 0
        self._unlike = 0  # frames that could have been learnt and didn't look like those that were, in succession
        self._learnt_s = -math.inf
        self._laid_out: tuple[Array, float | None] | None = None  # by which pose and opening
        self._layout: _Layout | None = None
        self._places: dict[int, _Places] = {}  # by how far the strips go on
        self._beyond = 0  # how far the last comparison had to look
        self.ready = False
        """Whether it may judge: not by fingers of one shade."""
        self._usual = np.zeros(2 * REACH_PX + 1)  # correlations at each slide while the gripper stands in its place

    @property
    def awaited(self) -> bool:
        """Whether a frame has to be learned before it may judge; False where the fingers have no strips."""
        return self._laid_out is None

    def learn(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, now_s: float) -> None:
        """Learn from an image whose pose (4, 4) is trusted; ``now_s``: time of the frame, s."""
        if self.frames >= FIRST_FRAMES and now_s - self._learnt_s < RELEARN_S:
            return
        if self._layout is None:
            self._lay_out(cam_T_grip, jaw_opening_m)
        if self._layout is None:
            return
        strips, within = self._read(self._layout, image, cam_T_grip, jaw_opening_m), self._layout.within
        self._learnt_s = now_s
        if self.frames >= FIRST_FRAMES and _correlations(strips, *self._learnt, 0)[0] < LIKE_CORRELATION:
            self._unlike += 1
            if self._unlike < MOST_FRAMES:
                return
            self.frames = 0  # not something in front: the fingers look otherwise now
        self._unlike = 0
        self.frames += 1
        self._mean += (strips - self._mean) * within / min(self.frames, MOST_FRAMES)
        self._prepare(self._layout)
        farther = self._read(self._layout, image, cam_T_grip, jaw_opening_m, REACH_PX)
        usual = _correlations(farther, *self._learnt, REACH_PX)
        self._usual += (usual - self._usual) / min(self.frames, MOST_FRAMES)
        self._know_farther()

    def state(self) -> StripsRecord | None:
        """What survives a restart, some 10 kB; None before a frame was learned."""
        if self._laid_out is None or not self.frames:
            return None
        cam_T_grip, jaw_opening_m = self._laid_out
        mean, usual = (part.astype("<f4").tobytes() for part in (self._mean, self._usual))
        return StripsRecord(to_record(cam_T_grip), jaw_opening_m, self.frames, mean, usual)

    def restore(self, record: StripsRecord) -> None:
        """Go on with kept strips of the same gripper and camera.  Raises :class:`StripsRefused`, and begins again,
        if they don't fit.
        """
        self._lay_out(from_record(record.cam_T_grip), record.jaw_opening_m)
        layout = self._layout
        sizes = (0 if layout is None else layout.within.size), len(self._usual)
        fits = all(len(data) == 4 * size for data, size in zip((record.mean, record.usual), sizes, strict=True))
        if layout is None or not fits or not np.isfinite(np.frombuffer(record.mean + record.usual, "<f4")).all():
            self._laid_out = self._layout = None
            raise StripsRefused("the kept strips along the fingers aren't this gripper's; they are learnt again")
        self._mean = np.frombuffer(record.mean, "<f4").reshape(layout.within.shape).astype(np.float32)
        self._usual = np.frombuffer(record.usual, "<f4").astype(float)
        self._know_farther()
        self.frames = record.frames
        self._prepare(layout)

    def compare(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, risk: float) -> StripsSeen:
        """Where the gripper stands along its fingers, against a pose (4, 4): elsewhere only at odds of 1 to ``risk``
        for each slide that is tried.
        """
        layout = self._layout
        if layout is None or not self.ready:
            return StripsSeen()
        independent = self._independent
        # By how much more of the variance a slide has to explain.
        beyond_chance = math.exp(2.0 / independent * math.log((2 * REACH_PX + 1) / risk))
        farthest = self._farthest
        alone = beyond_chance * (1.0 - EXPLAINED_CORRELATION**2) <= 1.0 - farthest**2
        most_alike = EXPLAINED_CORRELATION if alone else 1.0  # one rib more or less is little
        # Read farther at once where that was needed the last time: mostly it is again.
        beyond = self._beyond if alone else REACH_PX
        strips = self._read(layout, image, cam_T_grip, jaw_opening_m, beyond)
        explained = alone and _correlations(strips, *self._learnt, 0)[0] >= most_alike
        self._beyond = 0 if explained else REACH_PX
        if explained:
            return StripsSeen(here=True)  # usually: no slide could be better
        if beyond == 0:
            strips = self._read(layout, image, cam_T_grip, jaw_opening_m, REACH_PX)
        unexplained = _unexplained(_correlations(strips, *self._learnt, REACH_PX), most_alike)
        here = float(unexplained[REACH_PX])
        unexplained[REACH_PX - ONE_EDGE_PX : REACH_PX + ONE_EDGE_PX + 1] = 1.0
        best = float(unexplained.min())
        # What looks alike farther on is always seen there, and alone where the place itself is hidden.
        unexplained[beyond_chance * unexplained >= self._farther_left[most_alike]] = 1.0
        slide_px = int(np.argmin(unexplained)) - REACH_PX
        if here > beyond_chance * float(unexplained.min()):
            if independent < FEWEST_POINTS:
                return StripsSeen()
            return StripsSeen(slide_px * layout.step_m.mean(axis=0))
        # Where a rib or a thread looks alike farther on, strips never confirm a place: one more or less is little.
        confirmed = beyond_chance * here <= best and farthest <= EXPLAINED_CORRELATION
        # Odds of ten to one for this slide; what hides a part of them leaves less.  One of the places that look alike
        # is seen no better than they are from the place itself, whichever of them is the best now.
        rival = min(best, 1.0 - min(farthest, most_alike) ** 2)
        as_well = math.exp(2.0 / independent * math.log(10.0)) * here >= rival
        return StripsSeen(here=confirmed, undecided=not alone and independent >= FEWEST_POINTS and as_well)

    def _know_farther(self) -> None:
        """What a comparison needs of the usual correlations."""
        farther = _farther_on(self._usual)
        self._farthest = float(farther.max())
        self._farther_left = {most: _unexplained(farther, most) for most in (EXPLAINED_CORRELATION, 1.0)}

    def _prepare(self, layout: _Layout) -> None:
        """What a comparison needs of the mean."""
        # Strips side by side show the same.
        self._independent = float(layout.within.sum()) / (STRIP_LINES * INDEPENDENT_PX)
        most = CLIP_SIGMAS * math.sqrt(float(np.square(self._mean).sum() / layout.within.sum()))
        learnt = np.clip(self._mean, -most, most)
        own = float(np.square(learnt).sum())
        self._learnt, self.ready = (learnt, layout.within, most, own), own > 0.0

    def _read(
        self, layout: _Layout, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, beyond: int = 0
    ) -> NDArray[np.float32]:
        """(n, LENGTH_PX + 2 beyond) grey levels along the strips, without their slow changes."""
        _, share = _nodes(LENGTH_PX + 2 * (FILTERED_PX + beyond))
        kept = self._places.get(beyond)
        moved_px = math.inf
        if kept is not None and (kept.jaw_opening_m is None) == (jaw_opening_m is None):
            opened_m = 0.0 if jaw_opening_m is None else jaw_opening_m - (kept.jaw_opening_m or 0.0)
            u, v, moved_px = _followed(kept.uv_px, kept.jacobian, kept.cam_T_grip, cam_T_grip, opened_m, share)
        # Followed so far, they are off by the second order of a rotation by as much: its square over the focal length.
        if not moved_px <= ONE_EDGE_PX:
            kept = self._project(layout, cam_T_grip, jaw_opening_m, beyond)
            u, v, _ = _followed(kept.uv_px, kept.jacobian, cam_T_grip, cam_T_grip, 0.0, share)
            self._places.pop(beyond, None)
            if kept.jacobian.any():  # from a pose at which nothing projects nothing can be followed
                self._places[beyond] = kept
        values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        return _fast_changes(values if values.ndim == 2 else values @ GREY_BGR)

    def _project(self, layout: _Layout, cam_T_grip: Array, jaw_opening_m: float | None, beyond: int) -> _Places:
        node, _ = _nodes(LENGTH_PX + 2 * (FILTERED_PX + beyond))
        along = (node - FILTERED_PX - beyond)[:, None] * layout.step_m[:, None]
        now = self._gripper.points_grip_m(jaw_opening_m)[self._first]
        rate: Array = np.zeros_like(now)
        if jaw_opening_m is not None:
            rate = self._gripper.point_motion(jaw_opening_m)[self._first]
        moved = (now - layout.fingers_m)[layout.finger]
        points = (layout.start_m[:, None] + moved[:, None] + along).reshape(-1, 3)
        rotation = cam_T_grip[:3, :3]
        lever = points @ rotation.T
        uv_px, d_uv = self._camera.project_with_jacobian(lever + cam_T_grip[:3, 3])
        opened = np.repeat(rate[layout.finger] @ rotation.T, len(node), axis=0)
        turned = np.stack([np.cross(row, lever) for row in np.eye(3)], axis=-1)
        jacobian = np.concatenate([d_uv, d_uv @ turned, d_uv @ opened[:, :, None]], axis=2)
        # A point outside the lens is NaN; OpenCV needs a number for it.
        return _Places(cam_T_grip.copy(), jaw_opening_m, np.nan_to_num(uv_px, nan=-1.0), np.nan_to_num(jacobian))

    def _lay_out(self, cam_T_grip: Array, jaw_opening_m: float | None) -> None:
        self._laid_out, self._places = (cam_T_grip.copy(), jaw_opening_m), {}
        start, way, length_m, finger = self._strips(cam_T_grip, jaw_opening_m)
        if not len(start):
            return
        tips_px, behind_px = (
            self._camera.project((start + reach_m * way) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])
            for reach_m in (0.0, 1e-3)
        )
        px_per_m = 1e3 * float(np.median(np.linalg.norm(behind_px - tips_px, axis=1)))
        if not px_per_m > 0.0:
            return
        pitch_m = 1.0 / px_per_m
        # What the filters take in at the first point must be the finger, not what lies behind its end.
        start, length_m = start + FILTERED_PX * pitch_m * way, length_m - FILTERED_PX * pitch_m
        long_enough = length_m >= 4.0 * INDEPENDENT_PX * pitch_m  # four independent points
        within = (np.arange(LENGTH_PX) * pitch_m < length_m[long_enough, None]).astype(np.float32)
        start, way, finger = start[long_enough], way[long_enough], finger[long_enough]
        along_m = start[:, None] + np.arange(LENGTH_PX)[:, None] * pitch_m * way[:, None]
        # Beyond the image there is nothing to see of a finger.
        uv_px = self._camera.project((along_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3]).reshape(-1, 3))
        last_px = np.array([self._camera.width_px - 1.0, self._camera.height_px - 1.0])
        within *= ((uv_px >= 0.0) & (uv_px <= last_px)).all(axis=1).reshape(within.shape)
        if not within.any():
            return
        fingers_m = self._gripper.points_grip_m(jaw_opening_m)[self._first]
        self._layout = _Layout(start, pitch_m * way, within, finger, fingers_m)
        self._mean = np.zeros_like(within)

    def _strips(self, cam_T_grip: Array, jaw_opening_m: float | None) -> tuple[Array, Array, Array, NDArray[np.intp]]:
        """Strips behind the end edges on faces that look at the camera: where they start (n, 3) and the way (n, 3)
        that they go, gripper frame (z points out of the gripper), for how long (n,), m, and on which finger (n,).
        """
        gripper = self._gripper
        points_m = gripper.points_grip_m(jaw_opening_m)
        eye_m = invert(cam_T_grip)[:3, 3]
        rows, across = [], ((np.arange(STRIP_LINES) + 0.5) / STRIP_LINES).tolist()
        for edge in np.flatnonzero(~self._along & gripper.edge_view(points_m, eye_m).visible).tolist():
            ends = gripper.edge_points[edge].tolist()
            for face in self._faces(points_m, eye_m, ends):
                ways = [points_m[far] - points_m[end] for end in ends for far in self._behind(end, face)]
                # At the fingers' roots there are edges across them, too.
                if ways and ways[0][2] < 0.0:
                    both = np.stack([ways[0], ways[-1]])
                    rows += [(points_m[ends], both, share, gripper.edge_finger[edge]) for share in across]
        if not rows:
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp)
        share = np.array([[1.0 - row[2], row[2]] for row in rows])
        sides = np.array([row[1] for row in rows])
        start = np.einsum("ns,nsi->ni", share, np.array([row[0] for row in rows]))
        way = np.einsum("ns,nsi->ni", share, sides)
        length_m = np.linalg.norm(sides, axis=2).min(axis=1)
        return start, way / np.linalg.norm(way, axis=1)[:, None], length_m, np.array([row[3] for row in rows])

    def _faces(self, points_m: Array, eye_m: Array, ends: list[int]) -> list[set[int]]:
        """Points of each face at an edge that looks at the camera; all points where the gripper has no faces."""
        if not self._gripper.faces:
            return [set(range(len(points_m)))]
        out = []
        for face in self._gripper.faces:
            corners = points_m[face.points]
            normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)
            if set(ends) <= set(face.points.tolist()) and normal @ (eye_m - corners.mean(axis=0)) > 0.0:
                out.append(set(face.points.tolist()))
        return out

    def _behind(self, point: int, face: set[int]) -> list[int]:
        """Where the edges along the finger lead that begin in a point, from one to the next on a ``face``: a side may
        be made of several.
        """
        edges = self._gripper.edge_points[self._along]
        out, passed, begin = [], {point}, [point]
        while begin:
            at = begin.pop()
            further = (set(edges[:, ::-1][edges == at].tolist()) & face) - passed
            if not further and at != point:
                out.append(at)
            passed |= further
            begin += sorted(further)
        return out


@compiled
def _followed(
    uv_px: Any, jacobian: Any, from_T: Any, to_T: Any, opened_m: float, share: Any
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Points (n, w) of strips, u and v, px, at a pose ``to_T`` (4, 4) and an opening that is larger by ``opened_m``:
    those of :class:`_Places`, k of each strip, and what lies between them by their ``share`` (k, w).  And the largest
    motion of the former, px.
    """
    xi, largest, (nodes, width) = perturbation_between(from_T, to_T), 0.0, share.shape
    count = len(uv_px) // nodes
    at, place = np.zeros((2, width)), np.empty((2, count, width), np.float32)
    for n in range(count):
        at[:] = 0.0
        for k in range(nodes):
            for axis in range(2):
                moved = jacobian[n * nodes + k, axis, 6] * opened_m
                for i in range(6):
                    moved += jacobian[n * nodes + k, axis, i] * xi[i]
                largest = max(largest, abs(moved))
                for w in range(width):
                    at[axis, w] += share[k, w] * (uv_px[n * nodes + k, axis] + moved)
        for axis in range(2):
            for w in range(width):
                place[axis, n, w] = at[axis, w]
    return place[0], place[1], largest


@compiled
def _fast_changes(values: Any) -> NDArray[np.float32]:
    """(n, w - 2 FILTERED_PX) of grey levels (n, w): smoothed by a quarter of each neighbour, so that a shift by a tenth
    of a millimetre does no harm, less their mean over SLOPE_PX.
    """
    count, width = values.shape
    out, smooth = np.empty((count, width - 2 * FILTERED_PX), np.float32), np.zeros(width)
    for n in range(count):
        for x in range(1, width - 1):
            smooth[x] = 0.25 * values[n, x - 1] + 0.5 * values[n, x] + 0.25 * values[n, x + 1]
        total = 0.0
        for x in range(1, SLOPE_PX):
            total += smooth[x]
        for x in range(width - 2 * FILTERED_PX):
            total += smooth[x + SLOPE_PX]
            out[n, x] = smooth[x + FILTERED_PX] - total / SLOPE_PX
            total -= smooth[x + 1]
    return out


@compiled
def _correlations(strips: Any, learnt: Any, within: Any, most: float, own: float, reach: int) -> Array:
    """(2 reach + 1,) correlations of ``learnt`` strips (n, l), zero but ``within``, whose squares sum to ``own``, with
    what ``strips`` (n, w), no farther than ``most`` from zero, show at each slide from their middle; gain and
    brightness are free, as light is.
    """
    (count, length), slides = learnt.shape, 2 * reach + 1
    width, first = length + 2 * reach, (strips.shape[1] - length) // 2 - reach
    product, energy, out = np.zeros(slides, np.float32), np.zeros(slides), np.empty(slides)
    row, squares = np.empty(width, np.float32), np.zeros(width + 1)
    for n in range(count):
        for x in range(width):
            row[x] = min(max(strips[n, first + x], -most), most)
            squares[x + 1] = squares[x] + row[x] * row[x]
        begin = 0
        for x in range(length + 1):
            if x < length and within[n, x] > 0.0:
                weight, shown = learnt[n, x], row[x:]
                for s in range(slides):  # each of its own, so that they are added side by side
                    product[s] += weight * shown[s]
                continue
            if x > begin:
                for s in range(slides):
                    energy[s] += squares[x + s] - squares[begin + s]
            begin = x + 1
    # Where the strips leave the image nothing would differ.
    least = 0.25 * energy[reach]
    for s in range(slides):
        out[s] = product[s] / math.sqrt(max(energy[s], least) * own + 1e-12)
    return out


def _farther_on(alike: Array) -> Array:
    """Correlations at each slide, zero from the place itself to where they are first no longer alike: what is left is
    of something else that looks alike.
    """
    low = np.flatnonzero(alike < LIKE_CORRELATION)
    before, after = low[low < REACH_PX], low[low > REACH_PX]
    out = np.maximum(alike, 0.0)
    out[before[-1] if len(before) else 0 : after[0] if len(after) else len(out)] = 0.0
    return out


def _unexplained(alike: Array, most_alike: float) -> Array:
    """Part of the variance that correlations leave, none being better than ``most_alike``."""
    return np.asarray(1.0 - np.square(np.clip(alike, 0.0, most_alike)))


@lru_cache(maxsize=4)
def _nodes(width: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(k,) points of a strip that are projected, of ``width``, and (k, width) their shares in those between them."""
    node = np.linspace(0.0, width - 1.0, width // NODE_PX + 2)
    share = np.maximum(1.0 - np.abs(np.arange(width) - node[:, None]) / node[1], 0.0)
    return node, share.astype(np.float32)


def warm_up() -> None:
    """Compile what a frame needs, or load what was compiled."""
    _followed(np.zeros((1, 2)), np.zeros((1, 2, 7)), np.eye(4), np.eye(4), 0.0, np.ones((1, 1), np.float32))
    strips = _fast_changes(np.zeros((1, LENGTH_PX + 2 * FILTERED_PX), np.float32))
    _correlations(strips, strips, strips, 1.0, 1.0, 0)
