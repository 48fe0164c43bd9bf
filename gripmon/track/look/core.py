"""The gripper's own look, learnt from frames whose pose is trusted, and held against poses that are asked about.

The background moves and the gripper doesn't: a mean over time of the image in the gripper's frame keeps the texture,
screws, pads and letters of the fingers, and loses the rest.  Small patches each lose their brightness, two slopes of
light and their contrast, so that light may change; the length of the mean of such unit vectors tells how much of a
patch is the gripper's.  What a patch looks like when the gripper is taken to be elsewhere along its fingers is learnt,
too: one that looks the same there tells nothing, and a finger of one shade has no other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import GREY_BGR
from gripmon.model.records import Array, Image
from gripmon.track.look.agreement import (
    AGREEING_CORRELATION,
    CHANCE_BOUNDS,
    LookAgreement,
    patch_evidence,
)
from gripmon.track.look.layout import PATCH_SIDE_POINTS, POINTS, Layout, get_ready, lay_out

FORGET_S = 4.0 * 3600.0
"""Time after which a frame counts 1/e, s: a shift of work; dirt and wear take hours, lamps and daylight minutes."""

FEWEST_VIEWS = 12
"""Frames with new backgrounds before a look counts: what isn't the gripper's then averages to 1/sqrt(12) = 0.3, and a
pixel's scatter is known to 1/sqrt(24) = 0.2.
"""

MANY_VIEWS, RELEARN_S = 100, 0.1
"""Number of frames that are learnt one after the other, so that what isn't the gripper's averages to a tenth; and pause
between later ones, s: frames of a fast camera show nearly the same, and forgetting takes hours.
"""

LAY_OUT_AGAIN_S = 60.0
"""Pause before fingers that weren't in view are looked for again, s: it takes as long as some frames."""

CHANGED_CORRELATION = 0.5
"""Correlation of some pixels with what they showed before, below which they show something else: a patch beside a
finger another background, a block on it another look.  A patch of which two frames correlate by more on average is the
gripper's: that is the square of the length of the mean of its unit vectors.
"""

MOST_BACKGROUNDS = 8
"""Different backgrounds that are remembered: a robot that goes to and fro between two stations sees two."""

CHANGED_BACKGROUND_SHARE = 0.33
"""Of the patches beside the fingers: the rest may be other parts of the gripper, which move with it."""

SLIDES_M = (1e-3, 2e-3, 4e-3, 9e-3)
"""Ways along the fingers that are tried while learning, m: wrong fits were seen to slide by 0.2 to 28 mm.  From the
second on a patch must look otherwise to count: things that are mistaken for a tip lie farther off than the first.
"""

KEPT_PATCHES = 16
"""Most telling ones of a finger that poses are compared with: 512 points on two fingers."""

DISAGREEING_FRAME_WEIGHT = 0.125
"""Of a frame in which a known patch disagrees, when it is learnt: mostly something hides it, rarely it has changed."""


def _without_light() -> Array:
    """(POINTS, POINTS), symmetric: takes brightness and both slopes out of a patch."""
    side = np.linspace(-1.0, 1.0, PATCH_SIDE_POINTS)
    u, v = np.meshgrid(side, side)
    light = np.linalg.qr(np.column_stack([np.ones(POINTS), u.ravel(), v.ravel()]))[0]
    return np.eye(POINTS) - light @ light.T


_TEXTURE = _without_light().astype(np.float32)


class GripperLook:
    """The look of one gripper in one camera.  ``axis_grip`` (3,): the direction of its fingers, gripper frame.

    A pure function of the frames so far: no clock, time is what comes with them.
    """

    def __init__(self, camera: Camera, gripper: Gripper, axis_grip: Sequence[float] | Array = (0.0, 0.0, 1.0)):
        self._camera, self._gripper = camera, gripper
        get_ready(gripper)
        axis = np.asarray(axis_grip, dtype=float)
        steps_m = np.array([sign * way for way in SLIDES_M for sign in (1.0, -1.0)])
        self._slides_grip_m = steps_m[:, None] * (axis / np.linalg.norm(axis))
        self._far = np.abs(steps_m) > SLIDES_M[0]
        self._first = [int(np.argmax(gripper.point_finger == f)) for f in range(len(gripper.finger_ids))]
        self.views = 0
        self._different: list[NDArray[np.float32]] = []
        self._laid_out: tuple[Array, float | None] | None = None
        self._last_s: float | None = None
        self._not_before_s = -math.inf
        self._behind: NDArray[np.float32] | None = None
        self._begin(Layout(np.zeros((0, POINTS, 3)), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=bool)))

    @property
    def backgrounds(self) -> int:
        """Before how many different backgrounds it was learnt since they are counted, of :data:`MOST_BACKGROUNDS`."""
        return len(self._different)

    def count_again(self) -> None:
        """Count different backgrounds anew: the gripper stands elsewhere."""
        self._different = []

    @property
    def ready(self) -> bool:
        """Whether it may judge: enough backgrounds were seen, and some patches would tell."""
        return len(self._chosen) > 0

    @property
    def missing(self) -> str:
        """Why the look can't judge yet, in words; empty when it can."""
        if self.ready:
            return ""
        if not len(self._points):
            return "no part of a finger is in view that is large enough to look at"
        if self.views < FEWEST_VIEWS:
            return f"learnt before {self.views} backgrounds, of at least {FEWEST_VIEWS}"
        return "the fingers look the same all along, or never the same twice"

    def learn(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, now_s: float) -> bool:
        """Learn from an image whose pose (4, 4) is trusted; ``now_s``: time of the frame, s.  About 1 ms, the
        first time 0.1 s, when the patches are laid out.

        False, and nothing learnt, while the background is the same as in the last frame that was: it would be taken for
        the gripper's; while no finger is in view; and soon after the last one where :data:`MANY_VIEWS` were learnt.
        """
        if self.views >= MANY_VIEWS and self._last_s is not None and 0.0 <= now_s - self._last_s < RELEARN_S:
            return False
        if not len(self._points):
            if now_s < self._not_before_s:
                return False
            self._not_before_s = now_s + LAY_OUT_AGAIN_S
            self._laid_out = cam_T_grip.copy(), jaw_opening_m
            self._begin(lay_out(self._camera, self._gripper, cam_T_grip, jaw_opening_m))
            if not len(self._points):
                return False
        behind = self.behind(image, cam_T_grip, jaw_opening_m)
        if self._behind is not None and not another_background(behind, self._behind):
            return False
        self._behind = behind
        new = len(behind) > 0 and all(another_background(behind, other) for other in self._different)
        if new and len(self._different) < MOST_BACKGROUNDS:
            self._different.append(behind)
        pair = 2 * (self.views % len(SLIDES_M))
        slid = np.stack([cam_T_grip] * 3)
        slid[1:, :3, 3] += self._slides_grip_m[pair : pair + 2] @ cam_T_grip[:3, :3].T
        look, inside = self._look(image, slid, jaw_opening_m, self._points, self._finger)
        kept = 1.0 if self._last_s is None else math.exp(-max(now_s - self._last_s, 0.0) / FORGET_S)
        self._last_s = now_s
        self._add(look, inside, pair, kept)
        self.views += 1
        if self.views >= FEWEST_VIEWS:
            self._choose()
        return True

    def behind(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None) -> NDArray[np.float32]:
        """Textures (n, POINTS) beside the fingers at a pose (4, 4), for :func:`another_background`; none before patches
        are laid out.
        """
        return self._look(image, cam_T_grip[None], jaw_opening_m, self._guards, self._guard_finger)[0][0]

    def compare(self, image: Image, poses_cam_T_grip: Array, jaw_opening_m: float | None) -> LookAgreement:
        """Hold the look against poses (k, 4, 4), or one (4, 4); all say nothing before :attr:`ready`."""
        poses = poses_cam_T_grip.reshape(-1, 4, 4)
        fingers = len(self._gripper.finger_ids)
        if not len(self._chosen):
            none = np.zeros((len(poses), fingers), dtype=np.intp)
            return LookAgreement(np.full(none.shape, np.nan), none, none, np.zeros(none.shape))
        look, inside = self._look(image, poses, jaw_opening_m, self._chosen_points, self._chosen_finger)
        alike = np.einsum("knp,np->kn", look, self._template)
        agree = (alike > AGREEING_CORRELATION) & inside
        odds = np.where(agree, self._gain, self._loss) * inside
        ends = np.append(self._starts, len(self._chosen))
        out = LookAgreement(
            np.full((len(poses), fingers), np.nan),
            np.zeros((len(poses), fingers), dtype=np.intp),
            np.zeros((len(poses), fingers), dtype=np.intp),
            np.zeros((len(poses), fingers)),
        )
        for start, end in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            finger = self._chosen_finger[start]
            out.agree[:, finger] = agree[:, start:end].sum(axis=1)
            out.seen[:, finger] = inside[:, start:end].sum(axis=1)
            out.log_odds[:, finger] = odds[:, start:end].sum(axis=1)
            out.correlation[:, finger] = np.sort(alike[:, start:end], axis=1)[:, (end - start) // 2]
        return out

    def supports(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, risk: float) -> bool:
        """:meth:`LookAgreement.supports` for a pose (4, 4), beside all of the slides along the fingers."""
        poses = np.stack([cam_T_grip] * (1 + len(self._slides_grip_m)))
        poses[1:, :3, 3] += self._slides_grip_m @ cam_T_grip[:3, :3].T
        return self.compare(image, poses, jaw_opening_m).supports(risk)

    def _begin(self, layout: Layout) -> None:
        own = ~layout.guard
        self._points, self._finger = layout.points_grip_m[own], layout.finger[own]
        self._guards, self._guard_finger = layout.points_grip_m[layout.guard], layout.finger[layout.guard]
        count, slides = len(self._points), len(self._slides_grip_m)
        self._mean = np.zeros((count, POINTS), dtype=np.float32)
        self._weight, self._hit = np.zeros(count), np.zeros(count)
        self._chance, self._tried = np.zeros((slides, count)), np.zeros(slides)
        self._offsets: tuple[float | None, Array] | None = None
        self._take(np.zeros(0, dtype=np.intp))

    def _look(
        self,
        image: Image,
        poses_cam_T_grip: Array,
        jaw_opening_m: float | None,
        points_grip_m: Array,
        finger: NDArray[np.intp],
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Textures (k, n, POINTS) of patches at k poses, and which of them (k, n) lie inside the image."""
        shape = len(poses_cam_T_grip), len(points_grip_m)
        if not len(points_grip_m):
            return np.zeros((*shape, POINTS), dtype=np.float32), np.zeros(shape, dtype=bool)
        grip_m = (points_grip_m + self._offsets_m(jaw_opening_m)[finger][:, None]).reshape(-1, 3)
        cam_m = [grip_m @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3] for cam_T_grip in poses_cam_T_grip]
        uv_px = self._camera.project(cam_m[0] if len(cam_m) == 1 else np.concatenate(cam_m)).astype(np.float32)
        u, v = uv_px.T.reshape(2, -1, POINTS)
        height, width = image.shape[:2]
        # A point outside the lens is NaN, which is inside of nothing; OpenCV needs a number for it.
        within = (u >= 0.0) & (u <= width - 1.0) & (v >= 0.0) & (v <= height - 1.0)
        if not within.all():
            u, v = np.where(within, u, np.float32(0.0)), np.where(within, v, np.float32(0.0))
        values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        quantum = 1.0 if np.issubdtype(image.dtype, np.integer) else 1.0 / 65535.0
        texture = _texture(values @ GREY_BGR if values.ndim == 3 else values, quantum)
        return texture.reshape(*shape, POINTS), within.all(axis=1).reshape(shape)

    def _offsets_m(self, jaw_opening_m: float | None) -> Array:
        """(f, 3) by how much each finger has moved since the patches were laid out."""
        assert self._laid_out is not None
        if self._offsets is None or self._offsets[0] != jaw_opening_m:
            now, then = self._gripper.points_grip_m(jaw_opening_m), self._gripper.points_grip_m(self._laid_out[1])
            self._offsets = jaw_opening_m, np.asarray(now[self._first] - then[self._first])
        return self._offsets[1]

    def _add(self, look: NDArray[np.float32], inside: NDArray[np.bool_], pair: int, kept: float) -> None:
        """Learn textures (3, n, POINTS) at the pose and at two slides from it, the ``pair``-th and the next.

        Time alone never empties the means: after a pause one frame would be all, its background included.
        """
        length = np.linalg.norm(self._mean, axis=1)
        alike = np.einsum("knp,np->kn", look, self._mean) / np.maximum(length, 1e-12)
        agree = alike > AGREEING_CORRELATION
        known = (length**2 > CHANGED_CORRELATION) & (self._weight > FEWEST_VIEWS / 2)
        weight = np.where(known & ~agree[0], DISAGREEING_FRAME_WEIGHT, 1.0) * inside[0]
        self._weight = np.maximum(kept * self._weight, np.minimum(self._weight, FEWEST_VIEWS)) + weight
        share = weight / np.maximum(self._weight, 1e-12)
        self._mean += share[:, None].astype(np.float32) * (look[0] - self._mean)
        self._hit += share * (agree[0] - self._hit)
        if self.views >= len(SLIDES_M):  # before, there is little that a slid image could agree with
            now = slice(pair, pair + 2)
            tried = self._tried[now]
            # Old tries are forgotten down to as many as the fewest views hold of each slide.
            self._tried[now] = np.maximum(kept * tried, np.minimum(tried, FEWEST_VIEWS // len(SLIDES_M))) + 1.0
            self._chance[now] += (agree[1:] - self._chance[now]) / self._tried[now, None]

    def _choose(self) -> None:
        """The patches of each finger that tell most: always the same where they are, and another view elsewhere."""
        length = np.linalg.norm(self._mean, axis=1)
        chance = self._chance[self._far].max(axis=0)
        tells = (length**2 > CHANGED_CORRELATION) & (chance <= CHANCE_BOUNDS[1]) & bool((self._tried >= 0.5).all())
        worth = np.where(tells, length - chance, -np.inf)
        best = []
        for finger in range(len(self._first)):
            own = np.flatnonzero((self._finger == finger) & tells)
            best.append(np.sort(own[np.argsort(-worth[own], kind="stable")[:KEPT_PATCHES]]))
        self._take(np.concatenate(best))

    def _take(self, chosen: NDArray[np.intp]) -> None:
        self._chosen = chosen
        self._chosen_points, self._chosen_finger = self._points[chosen], self._finger[chosen]
        mean = self._mean[chosen]
        self._template = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
        self._gain, self._loss = patch_evidence(
            self._hit[chosen], self._chance[np.ix_(self._far, chosen)].max(axis=0, initial=0.0)
        )
        self._starts = np.flatnonzero(np.diff(self._chosen_finger, prepend=-1))


def _texture(values: NDArray[np.float32], quantum: float) -> NDArray[np.float32]:
    """Unit vectors (n, POINTS) of grey levels (n, POINTS) less their brightness and slopes; zero where their root mean
    square is no more than a step of grey, ``quantum``.
    """
    texture = values @ _TEXTURE
    length = np.sqrt(np.einsum("np,np->n", texture, texture))
    shows = length > quantum * math.sqrt(POINTS)
    np.divide(texture, length[:, None], out=texture, where=shows[:, None])
    texture[~shows] = 0.0
    return texture


def another_background(now: NDArray[np.float32], before: NDArray[np.float32]) -> bool:
    """Whether enough of the patches beside the fingers (n, POINTS) show something else than before."""
    if not len(now):
        return True  # nothing but the gripper is in view
    return bool(np.mean(np.einsum("np,np->n", now, before) < CHANGED_CORRELATION) > CHANGED_BACKGROUND_SHARE)
