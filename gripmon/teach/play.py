"""How far off the others each teaching image shows the gripper: a mount, and fingers in their holders, have some play.

The play of the mounts that were measured is 0.5 to 1.4 px, some tenths of a millimetre.  Averaged as if there were
none, it would count as scatter of every edge; an image with more of it than noise would be lost.  So each image's small
motion is estimated from all of its edges together, and taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gripmon.model.least_squares import chi_square_limit
from gripmon.model.records import Array
from gripmon.teach.estimate import SHAPE_M, SINGLE_SIGMA_PX
from gripmon.teach.lines import find_line
from gripmon.teach.views import ImageRefused, TeachingImage, View, Viewer, sampled

MOST_PLAY_PX = 2.0
"""Largest play of an edge (px): real mounts have up to 1.4; above it the camera or the jaws moved."""

PLAY_M = 3e-4
"""Standard deviation of the play before anything is seen: fingers of real grippers have some tenths of a millimetre;
of the rotation by as much at the fingers' mean distance from the TCP.  It only keeps directions that the edges don't
show from being made up."""

SURE = chi_square_limit(1e-3, 6)
"""Reduction of the squared deviations, over their noise, from which an image has play: noise reaches it in one image of
a thousand."""

AGREEING_PX = 0.5
"""Largest median distance of an image's edges from where all images show them, but for its play; above it the image
shows something else."""

HUBER = 1.345
"""Residual, in standard deviations, from which it counts by its size alone: 95 % efficiency for normal errors (Holland
and Welsch, "Robust regression using iteratively reweighted least-squares", 1977).
"""

_FEWEST_SHARED = 4
_ROUNDS, _SETTLING = 4, 10


def with_play(viewer: Viewer, views: Sequence[View]) -> tuple[list[TeachingImage], Array]:
    """The images, each with its play where it has more than noise explains, and standard deviations (6,) of the play
    between them, m and rad: of what they show, and of what they don't; zeros where noise explains all.  Raises
    :class:`~gripmon.teach.views.ImageRefused` for the image that is farthest from the others, if it is too far for play
    or its edges don't move together.
    """
    images = [replace(view.image, play=None) for view in views]
    places_px, rows = _places(viewer, views)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(places_px).all(axis=2))
    enough = seen.sum(axis=1) >= _FEWEST_SHARED
    if len(views) < 2 or not enough.any():
        return images, np.zeros(6)
    prior, unsure = _prior(viewer), np.zeros((len(views), 6))
    play, noise_px, sure = np.zeros((len(views), 6)), SINGLE_SIGMA_PX, 0.0
    for _ in range(_ROUNDS):
        common_px = np.nanmedian(places_px - np.einsum("nekm,nm->nek", rows, play), axis=0)
        for number in np.flatnonzero(enough).tolist():
            own = seen[number]
            off_px = (places_px[number] - common_px)[own]
            play[number], unsure[number] = _moved(off_px, rows[number, own], noise_px, prior, sure)
        play[enough] -= play[enough].mean(axis=0)
        rest_px = places_px - common_px - np.einsum("nekm,nm->nek", rows, play)
        # The scatter that no play explains, from the first round, in which every image may have some.
        noise_px = max(1.4826 * float(np.nanmedian(np.abs(rest_px[enough]))), SINGLE_SIGMA_PX) if not sure else noise_px
        sure = SURE
    _refuse(views, rest_px, np.einsum("nekm,nm->nek", rows, play), enough)
    images = [replace(image, play=own if own.any() else None) for image, own in zip(images, play, strict=True)]
    own, unsure = play[enough], unsure[enough]
    if not unsure.any():
        return images, np.zeros(6)
    # The play that the images have, as far as each shows its own, and the variance of what it doesn't show of it.  A
    # spread that few images show is known as badly: its variance is Student's, and of three or fewer that has none.
    squares, free = np.square(own - own.mean(axis=0)).sum(axis=0), len(own) - 1
    spread = squares / (free - 2) if free > 2 else np.maximum(squares, 1.0 / prior.diagonal())
    return images, np.sqrt(spread + unsure.mean(axis=0))


def _places(viewer: Viewer, views: Sequence[View]) -> tuple[Array, Array]:
    """Where each image shows the ends of each edge (n, e, 2), px from the reference's, NaN where it doesn't, of those
    edges that most images show; and their derivatives (n, e, 2, 6) by a motion.
    """
    edges = sorted({edge for view in views for edge in view.prediction.layout.edges.tolist()})
    edges = [edge for edge in edges if not viewer.gripper.edge_curved[edge]]
    places_px = np.full((len(views), len(edges), 2), np.nan)
    rows = np.zeros((len(views), len(edges), 2, 6))
    for number, view in enumerate(views):
        for k, edge in enumerate(edges):
            seen = sampled([view], edge)
            if seen is None:
                continue
            rows[number, k] = seen.per_m * seen.rows[:, :6]
            line = find_line(seen.points, seen.expected_px, SHAPE_M * seen.per_m)
            if line is not None:
                places_px[number, k] = line.ends_px
    often = 2 * np.isfinite(places_px[:, :, 0]).sum(axis=0) > len(views)
    return places_px[:, often], rows[:, often]


def _prior(viewer: Viewer) -> Array:
    """(6, 6) information about the play before anything is seen."""
    lever_m = float(np.sqrt(np.mean(np.square(np.linalg.norm(viewer.points_grip_m, axis=1)))))
    return np.diag(np.square([1.0 / PLAY_M] * 3 + [lever_m / PLAY_M] * 3))


def _moved(off_px: Array, rows: Array, noise_px: float, prior: Array, sure: float) -> tuple[Array, Array]:
    """The motion (6,) that explains most of an image's deviations (e, 2), by Huber's weights, and its variances (6,);
    zeros where it reduces their squares, over their noise, by less than ``sure``.
    """
    y, design = off_px.ravel() / noise_px, rows.reshape(-1, 6) / noise_px
    motion, weight = np.zeros(6), np.ones(len(y))
    for _ in range(_SETTLING):
        information = design.T @ (weight[:, None] * design) + prior
        motion = np.linalg.solve(information, design.T @ (weight * y))
        rest = np.abs(y - design @ motion)
        weight = HUBER / np.maximum(rest, HUBER)
    explained = float(weight @ (np.square(y) - np.square(y - design @ motion)))
    return (motion, np.linalg.inv(information).diagonal()) if explained > sure else (np.zeros(6), np.zeros(6))


def _refuse(views: Sequence[View], rest_px: Array, play_px: Array, enough: NDArray[np.bool_]) -> None:
    off_px, moved_px = np.zeros(len(views)), np.zeros(len(views))
    off_px[enough] = np.nanmedian(np.abs(rest_px[enough].mean(axis=2)), axis=1)
    moved_px[enough] = np.abs(play_px[enough]).max(axis=(1, 2))
    share = np.maximum(off_px / AGREEING_PX, moved_px / MOST_PLAY_PX)
    worst = int(share.argmax())
    if not share[worst] > 1.0:
        return
    right = "images without motion of the camera, each with its own jaw opening"
    moved = moved_px[worst] > MOST_PLAY_PX
    size_px, most_px = (moved_px[worst], MOST_PLAY_PX) if moved else (off_px[worst], AGREEING_PX)
    wrong = f"the gripper appears {size_px:.1f} px from where it is in the other images"
    wrong += "" if moved else ", beside what play explains"
    raise ImageRefused(views[worst].image, f"{wrong}; at most {most_px:g} px: {right}")
