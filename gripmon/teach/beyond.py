"""Whether the background begins at an edge, or something else of the gripper lies beyond it: a face, a pad, a tip."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri, ndtri, stdtrit

from gripmon.model.records import Array
from gripmon.model.staying import CELL_PX, LEAST_CHANGING, Bits, Plane
from gripmon.teach.silhouette import NARROW_PX, STEP_PX, WIDE_PX, Stations, across

WITHIN_PX = 1.0
"""How far beside its edge an outline may be taken to be: search lines at work reach 3 px to either side."""
RISEN = 0.75
"""Part of a contrast that shows two thirds of the blur (the normal distribution's quantile) beyond an edge."""
WIDEST_FACE_PX = 12.0
"""Widest face that is told from a background: 1.5 mm at 8 px/mm, a chamfer or the side of a slim finger."""
BY_CHANCE = 0.01
"""How often grey levels of backgrounds beyond an edge may be taken for something that stays there."""
NOT_SURE = 0.05
"""How often what follows less than half of a background's changes, by chance, may seem to follow more."""
_FAR_PX = 20.0
"""From what stays: the widest face and a search line's reach."""


@dataclass(frozen=True)
class Background:
    """What changes over ``count`` images (h, w) ``outside`` of what stays: standard deviation of grey levels,
    ``scatter``, and where edges come and go, ``changing``; ``places`` (2, h, w), both in the mean over squares of
    :data:`~gripmon.model.staying.CELL_PX`; ``far`` from what stays.
    """

    count: int
    scatter: Plane
    changing: Plane
    places: Plane
    outside: Bits
    far: Bits

    @classmethod
    def of(cls, images: NDArray[np.float32], still: Bits, changing: Bits) -> Background:
        """Of ``images`` (n, h, w) in which these pixels stay, and edges come and go there."""
        away = cv2.distanceTransform((~still).astype(np.uint8), cv2.DIST_L2, 5)
        scatter = np.asarray(images.std(axis=0), np.float32)
        comes = np.asarray(cv2.resize(changing.astype(np.float32), images.shape[:0:-1]), np.float32)
        places = np.asarray([cv2.blur(plane, (CELL_PX, CELL_PX)) for plane in (scatter, comes)], np.float32)
        return cls(len(images), scatter, comes, places, ~still, away > _FAR_PX)

    def begins(self, stations: Stations) -> bool:
        """Whether grey levels at 4.5 to 8 px beyond these stations change as a background's, or edges come and go: what
        does neither more than almost anywhere in the background is a tip or a pad of whatever grey, or the finger
        itself, of which only a face was found: it isn't compared with what joins it.  What of a gripper shows no
        edge is no larger than what stays: a plain table that is lit alike in all images is no part of it.
        """
        s = np.arange(4.5, WIDE_PX + 0.25, STEP_PX)
        found = across(np.stack([self.scatter, self.changing]), stations, s).mean(axis=(1, 2))
        joined = self._joined(stations, s, *found.tolist())
        others = self.far & ~joined
        if np.count_nonzero(joined) > np.count_nonzero(~self.outside) or not others.any():
            return True
        # Strictly: before plain walls edges come and go hardly anywhere, and as little of that says nothing.
        calmer = (self.places[:, others] < found[:, None]).mean(axis=1)
        return bool((calmer >= BY_CHANCE).any())

    def _joined(self, stations: Stations, s: Array, scatter: float, changing: float) -> Bits:
        """What joins the places at distances ``s`` (m,) beyond these stations and doesn't surely change by more than
        they do (Fisher's F of as many images).
        """
        more = float(fdtri(self.count - 1, self.count - 1, 1.0 - NOT_SURE)) ** 0.5
        calm = (self.places[0] <= more * scatter) & (self.places[1] <= more * max(changing, LEAST_CHANGING))
        _, label = cv2.connectedComponents((calm & self.outside).astype(np.uint8), connectivity=4)
        beyond_px = stations.uv_px[:, None] + stations.normal[:, None] * s[:, None]
        column, row = np.clip(np.rint(beyond_px).astype(int).reshape(-1, 2).T, 0, [[k - 1] for k in label.shape[::-1]])
        own = np.unique(label[row, column])
        return np.isin(label, own[own > 0])


def is_outermost(images: NDArray[np.float32], stations: Stations, blur_px: float) -> bool:
    """Whether the background begins at an edge at these stations in ``images`` (n, h, w), and not :data:`WITHIN_PX` or
    more beyond it: something else of the gripper, as a narrow face, may lie between, of whatever grey level.

    An edge so far out would leave more than a quarter of the contrast open where this is asked.  Grey levels there are
    compared over the images with those 4.5 to 8 px out.  What stays differs in the mean (Student's t, of means along
    the edge), or it doesn't change as the background does.  Out there grey levels have to change by at least a quarter
    of what they change by up to :data:`WIDEST_FACE_PX` farther out: what is lit in another way changes, too.  Where the
    background hardly changes nothing shows it.
    """
    s = np.arange(-NARROW_PX, WIDEST_FACE_PX + WIDE_PX + 0.25, STEP_PX)
    profiles = across(images, stations, s)
    if _begins_farther_out(profiles[:, :, s >= 4.5]):
        return False
    s = s[s <= WIDE_PX]
    profiles = profiles[:, :, : len(s)]
    levels = profiles.mean(axis=1)
    begun_px = WITHIN_PX + float(ndtri(RISEN)) * blur_px
    inner, there, outer = (s >= -4.0) & (s <= -2.0), [int(np.searchsorted(s, begun_px))], s >= 4.5
    far = levels[:, outer].mean(axis=1)
    near = np.array([np.interp(begun_px, s, own) for own in levels])
    off = near - far
    scatter = float(np.std(off, ddof=1)) / len(off) ** 0.5
    contrast = float(np.sqrt(np.square(far - levels[:, inner].mean(axis=1)).mean()))
    least = max(float(stdtrit(len(off) - 1, 1.0 - 0.5 * BY_CHANCE)) * scatter, (1.0 - RISEN) * contrast)
    if abs(float(off.mean())) > least:
        return False
    return _follows(near, far) or _changes(*(profiles[:, :, at] for at in (inner, there, outer)))


def _begins_farther_out(levels: NDArray[np.float32]) -> bool:
    """Whether grey levels (n, stations, samples) change over the images by far more somewhere than in the first px."""
    width = round((WIDE_PX - 4.5) / STEP_PX)
    changes = np.convolve(levels.var(axis=0).mean(axis=0), np.full(width, 1.0 / width), "valid")
    return bool(changes[0] < (1.0 - RISEN) ** 2 * changes.max())


def _follows(near: Array, far: Array) -> bool:
    """Whether grey levels (n,) show three quarters of the changes of others (n,), by the straight line through them,
    and by its slope's standard error surely half.
    """
    change = far - far.mean()
    changes = max(float(change @ change), 1e-9)
    slope = float(change @ near) / changes
    rest = near - near.mean() - slope * change
    sigma = (float(rest @ rest) / (len(far) - 2) / changes) ** 0.5
    return slope > RISEN and slope - float(stdtrit(len(far) - 2, 1.0 - NOT_SURE)) * sigma > 0.5


def _changes(inner: NDArray[np.float32], near: NDArray[np.float32], far: NDArray[np.float32]) -> bool:
    """Whether grey levels (n, stations, samples) near an edge surely change by half as much as those far out, and by
    more than those on the finger's side, from image to image and along the edge: a texture, which near doesn't follow
    (Fisher's F).
    """
    variance, dof = [], []
    for levels in (inner, near, far):
        off = levels - levels.mean(axis=0)
        each = float(np.square(off).mean())
        variance.append(each)
        # As many places along the edge as its mean is better known than one of them.
        dof.append((len(levels) - 1) * each / max(float(np.square(off.mean(axis=1)).mean()), 1e-9))
    return all(
        variance[1] > part * float(fdtri(dof[1], dof[k], 1.0 - NOT_SURE)) * variance[k]
        for k, part in ((0, 1.0), (2, 0.25))
    )
