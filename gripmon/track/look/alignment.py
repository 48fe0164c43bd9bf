"""How far the gripper has moved since its look was learnt: alignment of its own pixels, behind which nothing changes.

Blocks of pixels inside the fingers are chosen for what they tell of a motion; their mean, scatter and gradient are
learnt in the gripper's frame.  In a frame they are read where the gripper is expected, each block in a light of its
own, and the motion that explains the rest follows (inverse compositional: Baker and Matthews 2004, with the gradient of
what was learnt).  A pixel that changes with the background, with the jaw or for any other reason scatters, and counts
for little.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.compiled import COMPILES
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import BLUE, GREEN, RED
from gripmon.model.records import Array, Image
from gripmon.track.look import kernel, plain
from gripmon.track.look.layout import BORDER_PX, finger_depths_m

BLOCK_PX = 8
"""Side of a block, px; its outermost pixels only serve for gradients."""

LEARNT_BLOCKS, MEASURED_BLOCKS = 128, 32
"""Of which the most telling ones are measured, a thousand pixels; twice as many scatter by a tenth less."""

FEWEST_VIEWS = 12
"""Learnt frames from which a pixel's scatter is known to a fifth."""

MOST_VIEWS = 256
"""Frames that a mean reaches back: a change shows as scatter for as long, then as the new look."""

CHOOSE_EVERY = 16
"""Learnt frames after which blocks are chosen again."""

LINEAR_PX = 0.5
"""Motion up to which pixels are taken to move linearly, px: over 500 px the rest is (0.5 / 500)² 500 = 0.0005 px."""

CLOSE_PX = 0.1
"""Step of the alignment up to which the image isn't read again, px: central differences are a fifth too small."""

READINGS = 3

LEAST_DN = 0.5
"""Scatter below which no pixel is believed, steps of grey: the root mean square of rounding is 0.3."""

TEXTURE = 5.0
"""Mean square of a block's gradient over what the noise of its mean makes of it, below which it has no texture: noise
would show a gripper that never moves.
"""

UNLIKE = 2.0
"""Root mean square of a block's residuals, in standard deviations, from which it looks otherwise than learnt: noise
gives 1.  It isn't learnt from then; after :data:`FEWEST_VIEWS` running it is learnt again: what covered it is gone.
"""

RENEWED = 0.5
"""Correlation of a block with what it was first, below which it shows something else."""

ARITHMETIC: ModuleType = kernel if COMPILES else plain


@dataclass(frozen=True, slots=True)
class LookMotion:
    """Where the look has the gripper: ``cam_T_grip`` (4, 4) with covariance (6, 6) of its error since it was learnt,
    camera axes; the opening then.
    """

    cam_T_grip: Array
    covariance: Array
    jaw_opening_m: float | None


class _Placed:
    """Pixels (p, n) of fingers, projected where the gripper is; again only when it has moved."""

    def __init__(self, camera: Camera, gripper: Gripper, points_grip_m: Array, finger: NDArray[np.intp]):
        """``points_grip_m`` (p, n, 3) at the jaw's nominal opening."""
        self._camera, self._gripper = camera, gripper
        self._points_grip_m, self._finger = points_grip_m, finger
        self._first = [int(np.argmax(gripper.point_finger == f)) for f in range(len(gripper.finger_ids))]
        self._at: tuple[Array, float | None] | None = None
        self.base_px: Array = np.zeros((0, 0, 2))
        self.flow: Array = np.zeros((0, 0, 2, 7))

    def offsets_m(self, jaw_opening_m: float | None) -> Array:
        """(f, 3) of each finger from where it is at the nominal opening."""
        now, then = (self._gripper.points_grip_m(o) for o in (jaw_opening_m, self._gripper.jaw_nominal_m))
        return np.asarray(now[self._first] - then[self._first])

    def motion_to(self, cam_T_grip: Array, jaw_opening_m: float | None) -> Array:
        """(7,) motion, gripper axes, from where the pixels are projected; they are projected there if it is far."""
        if self._at is not None:
            motion = motion_between(self._at[0], cam_T_grip, self._at[1], jaw_opening_m)
            if self.moved_px(motion) <= LINEAR_PX:
                return motion
        self._project(cam_T_grip, jaw_opening_m)
        return np.zeros(7)

    def moved_px(self, motion: Array) -> float:
        """How far a motion (7,) takes the first pixel of any patch; infinite before there is a projection."""
        return float(np.abs(self.flow[:, 0] @ motion).max(initial=0.0)) if self._at is not None else np.inf

    def _project(self, cam_T_grip: Array, jaw_opening_m: float | None) -> None:
        self._at = cam_T_grip.copy(), jaw_opening_m
        shape = self._points_grip_m.shape[:2]
        points = (self._points_grip_m + self.offsets_m(jaw_opening_m)[self._finger][:, None]).reshape(-1, 3)
        rotation = cam_T_grip[:3, :3]
        uv_px, d_uv = self._camera.project_with_jacobian(points @ rotation.T + cam_T_grip[:3, 3])
        d_grip = d_uv @ rotation
        flow = np.empty((len(points), 2, 7))
        flow[..., :3] = d_grip
        for row in range(2):
            flow[:, row, 3:6] = np.cross(points, d_grip[:, row])
        per_m = self._per_opening(jaw_opening_m)[self._finger].repeat(shape[1], axis=0)
        flow[..., 6] = np.einsum("nij,nj->ni", d_grip, per_m)
        self.base_px, self.flow = uv_px.reshape(*shape, 2), flow.reshape(*shape, 2, 7)

    def _per_opening(self, jaw_opening_m: float | None) -> Array:
        """(f, 3) way of each finger for each metre that the jaw opens."""
        if jaw_opening_m is None or not self._gripper.has_jaw:
            return np.zeros((len(self._first), 3))
        low = max(jaw_opening_m - 1e-5, self._gripper.jaw_min_m)
        high = min(jaw_opening_m + 1e-5, self._gripper.jaw_max_m)
        return (self.offsets_m(high) - self.offsets_m(low)) / (high - low)


def motion_between(from_T: Array, to_T: Array, from_m: float | None, to_m: float | None) -> Array:
    """(7,): shift and turn in gripper axes, m and rad, and by how much the jaw opens, m."""
    xi = perturbation_between(from_T, to_T)
    opened_m = 0.0 if from_m is None or to_m is None else to_m - from_m
    return np.concatenate([xi[:3] @ from_T[:3, :3], xi[3:] @ from_T[:3, :3], [opened_m]])


def moved(cam_T_grip: Array, motion: Array) -> Array:
    """A pose (4, 4) after a motion (7,) in gripper axes."""
    rotation = cam_T_grip[:3, :3]
    return perturb(cam_T_grip, np.concatenate([rotation @ motion[:3], rotation @ motion[3:6]]))


class LookAlignment:
    """Learns and measures the pixels of one gripper in one camera.  A pure function of the frames so far."""

    def __init__(self, camera: Camera, gripper: Gripper, by: ModuleType = ARITHMETIC):
        self._camera, self._gripper, self._by = camera, gripper, by
        self.forget()

    def forget(self) -> None:
        """Learn again."""
        self.views = 0
        self._learnt: _Placed | None = None
        self._count: Array = np.zeros(0)
        self._measured: _Placed | None = None
        self._last: tuple[Array, float | None] | None = None

    @property
    def ready(self) -> bool:
        """Whether it measures: some blocks were seen often enough."""
        return self._measured is not None

    @property
    def renewed(self) -> Array:
        """(f,) share of each finger's textured blocks that look otherwise than when they were first learnt."""
        fingers = len(self._gripper.finger_ids)
        if self._learnt is None:
            return np.zeros(fingers)
        now, first = (m - m.mean(axis=1, keepdims=True) for m in (self._mean, self._at_first))
        told = (self._count >= FEWEST_VIEWS) & (np.sqrt((first**2).mean(axis=1)) > 2.0 * LEAST_DN)
        alike = (now * first).sum(axis=1) > RENEWED * np.sqrt((now**2).sum(axis=1) * (first**2).sum(axis=1))
        other = np.bincount(self._finger[told], ~alike[told], fingers)
        return np.asarray(other / np.maximum(np.bincount(self._finger[told], minlength=fingers), 1))

    def renew(self) -> None:
        """The present look counts as the first."""
        if self._learnt is not None:
            self._at_first = np.where(self._count[:, None] >= FEWEST_VIEWS, self._mean, np.nan)

    def learn(self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None) -> None:
        """Learn from an image whose pose (4, 4) is trusted, some 2 ms; the first time 0.1 s, to choose blocks."""
        grey = _channels(image)
        if self._learnt is None and not self._lay_out(grey, cam_T_grip, jaw_opening_m):
            return
        assert self._learnt is not None
        motion = self._learnt.motion_to(cam_T_grip, jaw_opening_m)
        values = self._by.read(*grey, self._learnt.base_px, self._learnt.flow, motion)
        self._add(values)
        if self.views >= FEWEST_VIEWS and (self.views - FEWEST_VIEWS) % CHOOSE_EVERY == 0:
            self._choose()
        elif self._measured is not None:
            self._take()

    def measure(
        self, image: Image, cam_T_grip: Array, jaw_opening_m: float | None, jaw_sigma_m: float
    ) -> LookMotion | None:
        """Where the look has the gripper, from a pose (4, 4) near it and an opening known to ``jaw_sigma_m``; None
        before :attr:`ready`, and where too little of it is seen.
        """
        if self._measured is None:
            return None
        grey, start = _channels(image), (cam_T_grip, jaw_opening_m)
        if self._last is not None and self._near(start, self._last):
            start = self._last
        prior = np.zeros(7)
        known_m = 0.0 if jaw_opening_m is None or start[1] is None else jaw_opening_m - start[1]
        prior[6] = 1.0 / max(jaw_sigma_m, 1e-8) ** 2
        motion = self._measured.motion_to(*start)
        here = motion.copy()
        here[6] += known_m
        try:
            for _ in range(READINGS):
                values = self._by.read(*grey, self._measured.base_px, self._measured.flow, here)
                step, information, pulls, share, scatter = self._by.align(
                    values, self._mean_in, self._weight_in, self._jacobian, prior
                )
                here = here + step
                if self._measured.moved_px(step) <= CLOSE_PX:
                    break
        except np.linalg.LinAlgError:  # hidden, but for too little
            self._last = None
            return None
        if not np.isfinite(here).all() or not (self._agree(share) > 0.5).any():
            self._last = None
            return None
        since = here - motion
        found_T = moved(start[0], since)
        opening_m = None if start[1] is None else start[1] + since[6]
        self._last = found_T, opening_m
        covariance = self._covariance(information, pulls, scatter, len(share))
        turn = np.kron(np.eye(2), found_T[:3, :3])
        return LookMotion(found_T, turn @ covariance[:6, :6] @ turn.T, opening_m)

    def _covariance(self, information: Array, pulls: Array, scatter: float, patches: int) -> Array:
        """(7, 7): by how much pixels scatter, and more if those of a patch pull together."""
        inverse = np.linalg.inv(information)
        together = float(np.trace(inverse @ pulls)) / 7.0 * patches / max(patches - 7, 1)
        return np.asarray(inverse * max(together, scatter**2))

    def _near(self, one: tuple[Array, float | None], other: tuple[Array, float | None]) -> bool:
        assert self._measured is not None
        return self._measured.moved_px(motion_between(one[0], other[0], one[1], other[1])) <= LINEAR_PX

    def _agree(self, share: Array) -> Array:
        """(f,) share of each finger that looks as learnt, NaN where none is known."""
        fingers = len(self._gripper.finger_ids)
        known = self._weight_in.any(axis=1)
        count = np.bincount(self._finger_in[known], minlength=fingers)
        total = np.bincount(self._finger_in[known], share[known], fingers)
        return np.divide(total, count, out=np.full(fingers, np.nan), where=count > 0)

    def _lay_out(self, grey: tuple[Image, Array], cam_T_grip: Array, jaw_opening_m: float | None) -> bool:
        points_grip_m, finger = _blocks(self._camera, self._gripper, cam_T_grip, jaw_opening_m)
        if not len(finger):
            return False
        every = _Placed(self._camera, self._gripper, points_grip_m, finger)
        # At the nominal opening: fingers move as wholes.
        points_grip_m = points_grip_m - every.offsets_m(jaw_opening_m)[finger][:, None]
        every = _Placed(self._camera, self._gripper, points_grip_m, finger)
        every.motion_to(cam_T_grip, jaw_opening_m)
        values = self._by.read(*grey, every.base_px, every.flow, np.zeros(7))
        values = np.nan_to_num(values)
        jacobian = _jacobian(values, every.flow, np.ones_like(values))
        best = _most_telling(jacobian, np.ones((len(finger), _INNER.size)), LEARNT_BLOCKS)
        self._points, self._finger = points_grip_m[best], finger[best]
        self._learnt = _Placed(self._camera, self._gripper, self._points, self._finger)
        self._learnt.motion_to(cam_T_grip, jaw_opening_m)
        # How a motion changes what is seen was the same from everywhere near: as where they were laid out.
        self._flow = self._learnt.flow.copy()
        self._mean, self._variance = np.zeros(self._points.shape[:2]), np.zeros(self._points.shape[:2])
        self._at_first = np.full(self._points.shape[:2], np.nan)
        self._count, self._unlike = np.zeros(len(best)), np.zeros(len(best), dtype=np.intp)
        return True

    def _add(self, values: Array) -> None:
        """Follow the means and variances, in the light of what was learnt."""
        self.views += 1
        seen = np.isfinite(values).all(axis=1)
        first = seen & (self._count == 0)
        self._mean[first] = values[first]
        level = values.mean(axis=1, keepdims=True)
        middle = self._mean.mean(axis=1, keepdims=True)
        learnt = self._mean - middle
        own = np.maximum((learnt**2).sum(axis=1, keepdims=True), 1e-9)
        gain = ((values - level) * learnt).sum(axis=1, keepdims=True) / own
        told = seen & (gain[:, 0] >= kernel.GAINS[0]) & (gain[:, 0] <= kernel.GAINS[1])
        with np.errstate(invalid="ignore", divide="ignore"):
            away = np.where(told[:, None], (values - level) / gain + middle, values) - self._mean
        usual = np.sqrt(self._variance) + LEAST_DN
        unlike = seen & (self._count >= FEWEST_VIEWS) & (((away / usual) ** 2).mean(axis=1) > UNLIKE**2)
        self._unlike = np.where(seen, np.where(unlike, self._unlike + 1, 0), self._unlike)
        again = self._unlike >= FEWEST_VIEWS
        self._mean[again], away[again] = values[again], 0.0
        self._variance[again], self._count[again], self._unlike[again] = 0.0, 0.0, 0
        seen &= ~unlike | again
        self._count[seen] += 1.0
        share = 1.0 / np.minimum(self._count[seen], MOST_VIEWS)[:, None]
        self._mean[seen] += share * away[seen]
        self._variance[seen] += share * ((1.0 - share) * away[seen] ** 2 - self._variance[seen])
        known = seen & (self._count == FEWEST_VIEWS) & np.isnan(self._at_first[:, 0])
        self._at_first[known] = self._mean[known]

    def _choose(self) -> None:
        weight = self._weights()
        jacobian = _jacobian(self._mean, self._flow, weight)
        noise = 0.5 / (weight * np.minimum(self._count, MOST_VIEWS)[:, None] + 1e-12)
        across, down = _gradients(self._mean)
        textured = (across**2 + down**2).mean(axis=1) > TEXTURE * 2.0 * noise[:, _INNER].mean(axis=1)
        weight = weight * textured[:, None]
        best = _most_telling(jacobian, weight[:, _INNER], MEASURED_BLOCKS)
        best = best[textured[best]]
        if not len(best):
            self._measured = None
            return
        self._chosen, self._finger_in = best, self._finger[best]
        self._measured = _Placed(self._camera, self._gripper, self._points[best][:, _INNER], self._finger_in)
        self._last = None
        self._take()

    def _weights(self) -> Array:
        """(p, n) one over the variance of a pixel about its mean; 0 where it wasn't seen often enough."""
        views = np.maximum(self._count, 2.0)[:, None]
        variance = self._variance * views / (views - 1.0) + LEAST_DN**2
        return np.where(self._count[:, None] >= FEWEST_VIEWS, 1.0 / variance, 0.0)

    def _take(self) -> None:
        weight, best = self._weights()[self._chosen], self._chosen
        self._mean_in = np.ascontiguousarray(self._mean[best][:, _INNER])
        self._weight_in = np.ascontiguousarray(weight[:, _INNER])
        self._jacobian = _jacobian(self._mean[best], self._flow[best], weight)


def warm_up() -> None:
    """Compile, or load, what grey and colour images of eight bits need."""
    if not COMPILES:
        return
    nothing = np.zeros((1, 1, 2)), np.zeros((1, 1, 2, 7)), np.zeros(7)
    for shape in ((8, 8), (8, 8, 3)):
        values = kernel.read(*_channels(np.zeros(shape, dtype=np.uint8)), *nothing)
    kernel.align(values, values, values, np.zeros((1, 1, 7)), np.ones(7))


_INNER = np.arange(BLOCK_PX**2).reshape(BLOCK_PX, BLOCK_PX)[1:-1, 1:-1].ravel()


def _channels(image: Image) -> tuple[Image, Array]:
    """An image (h, w, c), and what its channels weigh in steps of 8 bits."""
    quantum = {np.dtype(np.uint8): 1.0, np.dtype(np.uint16): 257.0}.get(image.dtype, 1.0 / 255.0)
    if image.ndim == 2:
        return image[..., None], np.array([1.0 / quantum])
    return image, np.array([BLUE, GREEN, RED]) / quantum


def _blocks(
    camera: Camera, gripper: Gripper, cam_T_grip: Array, jaw_opening_m: float | None
) -> tuple[Array, NDArray[np.intp]]:
    """Points (p, n, 3), gripper frame, of all blocks that lie inside a finger, and whose they are (p,)."""
    depths = finger_depths_m(camera, gripper, cam_T_grip, jaw_opening_m)
    nearest = np.fmin.reduce(depths)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BORDER_PX + 1,) * 2)
    points, finger = [np.zeros((0, BLOCK_PX**2, 3))], []
    reach = np.arange(BLOCK_PX)
    within = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    for f, depth_m in enumerate(depths):
        own = (np.isfinite(depth_m) & (depth_m <= nearest)).astype(np.uint8)
        own = np.asarray(cv2.erode(own, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0), dtype=np.uint8)
        rows, columns = (np.arange(0, size - BLOCK_PX + 1, BLOCK_PX) for size in own.shape)
        corner = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
        block = corner + within
        block = block[own[block[..., 1], block[..., 0]].all(axis=1)]
        flat = block.reshape(-1, 2)
        xy = camera.undistort(flat.astype(float))
        z_m = depth_m[flat[:, 1], flat[:, 0]]
        place = (np.column_stack([xy, np.ones(len(xy))]) * z_m[:, None] - cam_T_grip[:3, 3]) @ cam_T_grip[:3, :3]
        place = place.reshape(-1, BLOCK_PX**2, 3)
        sound = np.isfinite(place).all(axis=(1, 2))
        points.append(place[sound])
        finger += [f] * int(sound.sum())
    return np.concatenate(points), np.array(finger, dtype=np.intp)


def _gradients(mean: Array) -> tuple[Array, Array]:
    """(p, inner) each, of blocks (p, n): central differences, as of the interpolation between pixels."""
    square = mean.reshape(-1, BLOCK_PX, BLOCK_PX)
    across = 0.5 * (square[:, 1:-1, 2:] - square[:, 1:-1, :-2])
    down = 0.5 * (square[:, 2:, 1:-1] - square[:, :-2, 1:-1])
    return across.reshape(len(mean), -1), down.reshape(len(mean), -1)


def _jacobian(mean: Array, flow: Array, weight: Array) -> Array:
    """(p, inner, 7): how a motion changes what blocks (p, n) show where they were, less gain and offset of light."""
    gradient = np.stack(_gradients(mean), axis=-1)
    out = -np.einsum("pnk,pnkj->pnj", gradient, flow[:, _INNER])
    weight, mean = weight[:, _INNER], mean[:, _INNER]
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    learnt = mean - (weight * mean).sum(axis=1, keepdims=True) / total
    out -= np.einsum("pn,pnj->pj", weight, out)[:, None] / total[:, None]
    own = np.maximum((weight * learnt**2).sum(axis=1), 1e-300)[:, None]
    out -= learnt[..., None] * (np.einsum("pn,pnj->pj", weight * learnt, out) / own)[:, None]
    return np.ascontiguousarray(out)


def _most_telling(jacobian: Array, weight: Array, most: int) -> NDArray[np.intp]:
    """Blocks that together tell most of the weakest motions: each in turn adds most to the information's determinant.

    The opening is left out: it is mostly known.
    """
    of_block = np.einsum("pn,pni,pnj->pij", weight, jacobian[..., :6], jacobian[..., :6])
    whole = of_block.sum(axis=0)
    so_far = np.diag(np.maximum(whole.diagonal(), 1e-12)) * (1e-3 / max(len(weight), 1))
    left = np.ones(len(weight), dtype=bool)
    for _ in range(min(most, len(weight))):
        gain = np.einsum("ij,pij->p", np.linalg.inv(so_far), of_block)
        best = int(np.argmax(np.where(left, gain, -1.0)))
        left[best] = False
        so_far = so_far + of_block[best]
    return np.flatnonzero(~left)
