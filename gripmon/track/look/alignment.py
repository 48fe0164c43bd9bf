"""How far the gripper has moved since its look was learnt: alignment of its own pixels, behind which nothing changes.

Blocks of pixels inside the fingers are chosen for what they tell of a motion; their mean, scatter and gradient are
learnt in the gripper's frame.  In a frame they are read where the gripper is expected, each block in a light of its
own, and the motion that explains the rest follows (inverse compositional: Baker and Matthews 2004, with the gradient of
what was learnt).  A pixel that changes with the background, with the jaw or for any other reason scatters, and counts
for little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.pixels import BLUE, GREEN, RED
from gripmon.model.poses import to_record
from gripmon.model.records import Array, Image, LookPixels
from gripmon.track.look import kernel
from gripmon.track.look.agreement import LookRefused
from gripmon.track.look.blocks import BLOCK_PX, INNER, blocks_in, gradients, jacobian_of, most_telling
from gripmon.track.look.core import CHANGED_CORRELATION, FEWEST_VIEWS
from gripmon.track.look.placed import LINEAR_PX, Placed, motion_between, moved

LEARNT_BLOCKS, MEASURED_BLOCKS = 128, 32
"""Of which the most telling ones are measured, a thousand pixels; twice as many scatter by a tenth less."""

MOST_VIEWS = 256
"""Frames that a mean reaches back: a change shows as scatter for as long, then as the new look."""

CHOOSE_EVERY = 16
"""Learnt frames after which blocks are chosen again."""

CLOSE_PX = 0.1
"""Step of the alignment up to which the image isn't read again, px: central differences are a fifth too small."""

READINGS = 3
"""Times that the image is read in one alignment, at most."""

LEAST_DN = 0.5
"""Scatter below which no pixel is believed, steps of grey: the root mean square of rounding is 0.3."""

TEXTURE_NOISE_RATIO = 5.0
"""Mean square of a block's gradient over what the noise of its mean makes of it, below which it has no texture: noise
would show a gripper that never moves.
"""

UNLIKE_SIGMAS = 2.0
"""Root mean square of a block's residuals, in standard deviations, from which it looks otherwise than learnt: noise
gives 1.  It isn't learnt from then; after :data:`FEWEST_VIEWS` running it is learnt again: what covered it is gone.
"""

_KINDS = ("<u2", "<f4", "<f4", "<f4", "<f4", "<u2")
"""How places, means, variances, first means, counts and unlike frames are kept."""


@dataclass(frozen=True, slots=True)
class LookMotion:
    """Where the look has the gripper: ``cam_T_grip`` (4, 4) with covariance (6, 6) of its error since it was learnt,
    camera axes; the opening then.
    """

    cam_T_grip: Array
    covariance: Array
    jaw_opening_m: float | None


class LookAlignment:
    """Learns and measures the pixels of one gripper in one camera.  A pure function of the frames so far."""

    def __init__(self, camera: Camera, gripper: Gripper):
        self._camera, self._gripper = camera, gripper
        self.forget()

    def forget(self) -> None:
        """Learn again."""
        self.views = 0
        self._learnt: Placed | None = None
        self._laid_out: tuple[Array, float | None, NDArray[np.uint16]] | None = None
        self._count: Array = np.zeros(0)
        self._measured: Placed | None = None
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
        told, alike = self._likeness()
        other = np.bincount(self._finger[told], ~alike[told], fingers)
        return np.asarray(other / np.maximum(np.bincount(self._finger[told], minlength=fingers), 1))

    def _likeness(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(p,) blocks that are known and textured; and those (p,) that look as at first."""
        now, first = (m - m.mean(axis=1, keepdims=True) for m in (self._mean, self._at_first))
        told = (self._count >= FEWEST_VIEWS) & (np.sqrt((first**2).mean(axis=1)) > 2.0 * LEAST_DN)
        return told, (now * first).sum(axis=1) > CHANGED_CORRELATION * np.sqrt(
            (now**2).sum(axis=1) * (first**2).sum(axis=1)
        )

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
        values = kernel.read(*grey, self._learnt.base_px, self._learnt.flow, motion)
        self._add(values)
        if self.views >= FEWEST_VIEWS and (self.views - FEWEST_VIEWS) % CHOOSE_EVERY == 0:
            self._choose()
        elif self._measured is not None:
            self._take()

    def state(self) -> LookPixels | None:
        """What survives a restart, some 100 kB; None before the first frame."""
        if self._laid_out is None or not self.views:
            return None
        cam_T_grip, jaw_opening_m, places = self._laid_out
        parts = (places, self._mean, self._variance, self._at_first, self._count, self._unlike)
        kept = (np.asarray(part).astype(kind).tobytes() for part, kind in zip(parts, _KINDS, strict=True))
        return LookPixels(to_record(cam_T_grip), jaw_opening_m, self.views, *kept)

    def restore(self, record: LookPixels) -> None:
        """Go on with kept pixels.  Raises :class:`LookRefused`, and begins again, where they are not of these fingers
        or don't hold together.
        """
        self.forget()
        try:
            places, mean, variance, first, count, unlike = (
                np.frombuffer(data, kind).reshape(shape)
                for data, kind, shape in zip(
                    (record.blocks, record.mean, record.variance, record.first, record.count, record.unlike),
                    _KINDS,
                    ((-1, 3), *(((-1, BLOCK_PX**2),) * 3), (-1,), (-1,)),
                    strict=True,
                )
            )
        except ValueError:
            raise LookRefused("the kept look's pixels are cut off; it is learnt again") from None
        if len({len(part) for part in (places, mean, variance, first, count, unlike)}) > 1:
            raise LookRefused("the kept look's pixels don't belong together; it is learnt again")
        sound = np.isfinite(mean).all() and np.isfinite(variance).all() and np.isfinite(count).all()
        if not sound or (variance < 0.0).any() or (count < 0.0).any() or np.isinf(first).any():
            raise LookRefused("the kept look holds pixels that can't be; it is learnt again")
        cam_T_grip = from_record(record.cam_T_grip)
        points_grip_m, now = self._blocks(cam_T_grip, record.jaw_opening_m)
        where = {tuple(place): row for row, place in enumerate(now.tolist())}
        rows = [where.get(tuple(place), -1) for place in places.tolist()]
        if -1 in rows or len(set(rows)) < max(len(rows), 1):
            raise LookRefused("the kept look has other blocks of pixels than this version's; it is learnt again")
        self._begin(points_grip_m[rows], places, cam_T_grip, record.jaw_opening_m)
        self.views = record.views
        self._mean, self._variance, self._at_first = mean.astype(float), variance.astype(float), first.astype(float)
        self._count, self._unlike = count.astype(float), unlike.astype(np.intp)
        if self.views >= FEWEST_VIEWS:
            self._choose()

    def places_px(self) -> tuple[Array, NDArray[np.bool_]]:
        """(p, 2) middles of the blocks where the gripper was seen last, and which of them look otherwise than at first;
        none before the first frame.
        """
        if self._learnt is None:
            return np.zeros((0, 2)), np.zeros(0, dtype=bool)
        told, alike = self._likeness()
        return np.asarray(self._learnt.base_px.mean(axis=1)), told & ~alike

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
        known = motion.copy()
        known[6] += known_m
        here = known
        try:
            for _ in range(READINGS):
                values = kernel.read(*grey, self._measured.base_px, self._measured.flow, here)
                step, information, pulls, share, scatter = kernel.align(
                    values, self._mean_in, self._weight_in, self._jacobian, prior, known - here
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
        opening_m = None if start[1] is None else start[1] + float(since[6])
        self._last = found_T, opening_m
        covariance = self._covariance(information, pulls, scatter, len(share))
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = found_T[:3, :3]
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
        return self._finger_share @ share

    def _lay_out(self, grey: tuple[Image, Array], cam_T_grip: Array, jaw_opening_m: float | None) -> bool:
        points_grip_m, places = self._blocks(cam_T_grip, jaw_opening_m)
        if not len(places):
            return False
        every = Placed(self._camera, self._gripper, points_grip_m, places[:, 2].astype(np.intp))
        every.motion_to(cam_T_grip, jaw_opening_m)
        values = kernel.read(*grey, every.base_px, every.flow, np.zeros(7))
        values = np.nan_to_num(values)
        jacobian = jacobian_of(values, every.flow, np.ones_like(values))
        best = most_telling(jacobian, np.ones((len(places), INNER.size)), LEARNT_BLOCKS)
        self._begin(points_grip_m[best], places[best], cam_T_grip, jaw_opening_m)
        return True

    def _blocks(self, cam_T_grip: Array, jaw_opening_m: float | None) -> tuple[Array, NDArray[np.uint16]]:
        """As :func:`blocks_in`, at the nominal opening: fingers move as wholes."""
        points_grip_m, places = blocks_in(self._camera, self._gripper, cam_T_grip, jaw_opening_m)
        finger = places[:, 2].astype(np.intp)
        offsets_m = Placed(self._camera, self._gripper, points_grip_m, finger).offsets_m(jaw_opening_m)
        return points_grip_m - offsets_m[finger][:, None], places

    def _begin(
        self, points_grip_m: Array, places: NDArray[np.uint16], cam_T_grip: Array, jaw_opening_m: float | None
    ) -> None:
        """Nothing is known yet of blocks (p, n, 3) that were chosen at a pose (4, 4) and an opening."""
        self._laid_out = cam_T_grip.copy(), jaw_opening_m, places
        self._points, self._finger = points_grip_m, places[:, 2].astype(np.intp)
        self._learnt = Placed(self._camera, self._gripper, self._points, self._finger)
        self._learnt.motion_to(cam_T_grip, jaw_opening_m)
        # How a motion changes what is seen was the same from everywhere near: as where they were laid out.
        self._flow = self._learnt.flow.copy()
        self._mean, self._variance = np.zeros(self._points.shape[:2]), np.zeros(self._points.shape[:2])
        self._at_first = np.full(self._points.shape[:2], np.nan)
        self._count, self._unlike = np.zeros(len(places)), np.zeros(len(places), dtype=np.intp)

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
        told = seen & (gain[:, 0] >= kernel.GAIN_BOUNDS[0]) & (gain[:, 0] <= kernel.GAIN_BOUNDS[1])
        with np.errstate(invalid="ignore", divide="ignore"):
            away = np.where(told[:, None], (values - level) / gain + middle, values) - self._mean
        usual = np.sqrt(self._variance) + LEAST_DN
        unlike = seen & (self._count >= FEWEST_VIEWS) & (((away / usual) ** 2).mean(axis=1) > UNLIKE_SIGMAS**2)
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
        jacobian = jacobian_of(self._mean, self._flow, weight)
        noise = 0.5 / (weight * np.minimum(self._count, MOST_VIEWS)[:, None] + 1e-12)
        across, down = gradients(self._mean)
        textured = (across**2 + down**2).mean(axis=1) > TEXTURE_NOISE_RATIO * 2.0 * noise[:, INNER].mean(axis=1)
        weight = weight * textured[:, None]
        best = most_telling(jacobian, weight[:, INNER], MEASURED_BLOCKS)
        best = best[textured[best]]
        if not len(best):
            self._measured = None
            return
        self._chosen, self._finger_in = best, self._finger[best]
        self._measured = Placed(self._camera, self._gripper, self._points[best][:, INNER], self._finger_in)
        self._last = None
        self._take()

    def _weights(self) -> Array:
        """(p, n) one over the variance of a pixel about its mean; 0 where it wasn't seen often enough."""
        views = np.maximum(self._count, 2.0)[:, None]
        variance = self._variance * views / (views - 1.0) + LEAST_DN**2
        return np.where(self._count[:, None] >= FEWEST_VIEWS, 1.0 / variance, 0.0)

    def _take(self) -> None:
        weight, best = self._weights()[self._chosen], self._chosen
        self._mean_in = np.ascontiguousarray(self._mean[best][:, INNER])
        self._weight_in = np.ascontiguousarray(weight[:, INNER])
        own = self._finger_in == np.arange(len(self._gripper.finger_ids))[:, None]
        own = own & self._weight_in.any(axis=1)
        with np.errstate(invalid="ignore"):  # NaN for a finger of which nothing is known
            self._finger_share = own / own.sum(axis=1, keepdims=True)
        jacobian = jacobian_of(self._mean[best], self._flow[best], weight)
        self._jacobian = np.ascontiguousarray(jacobian.swapaxes(1, 2))


def warm_up() -> None:
    """Compile, or load, what grey and colour images of eight bits need."""
    nothing = np.zeros((1, 1, 2)), np.zeros((1, 1, 2, 7)), np.zeros(7)
    for shape in ((8, 8), (8, 8, 3)):
        values = kernel.read(*_channels(np.zeros(shape, dtype=np.uint8)), *nothing)
    kernel.align(values, values, values, np.zeros((1, 7, 1)), np.ones(7), np.zeros(7))


def _channels(image: Image) -> tuple[Image, Array]:
    """An image (h, w, c), and what its channels weigh in steps of 8 bits."""
    quantum = {np.dtype(np.uint8): 1.0, np.dtype(np.uint16): 257.0}.get(image.dtype, 1.0 / 255.0)
    if image.ndim == 2:
        return image[..., None], np.array([1.0 / quantum])
    return image, np.array([BLUE, GREEN, RED]) / quantum
