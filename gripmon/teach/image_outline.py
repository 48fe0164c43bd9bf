"""From images of one jaw opening to outlines of fingers; images that show motion or blur, or contradict the others, are
left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.teach.inner_edges import InnerEdge, find_inner_edges
from gripmon.teach.matte import FEWEST_IMAGES, Matte, find_matte
from gripmon.teach.silhouette import Stations, Transitions, measure_transitions, stations_along, trace
from gripmon.teach.straight_pieces import Chain, fit_chain, runs, without_outliers

BORDER_PX = 9.0
"""Distance from the image's border below which outlines aren't measured: search lines would leave the image."""
SHORTEST_CONTOUR_PX = 60
MOST_SHIFT_PX = 0.5
"""Largest shift of the gripper in an image against the others, as in teaching."""
MOST_BLUR_PX = 2.5
"""Largest blur of an outline's transition: beyond it the background's edges merge with the fingers' (see Limits)."""
LEAST_SHARPNESS = 0.6
"""Least sharpness of an image's transitions over that of all: an image blurred to 1.7 times their width has less."""
MOST_PARTS = 6
"""Most separate parts of a gripper in view: five fingers and a palm."""
_FEWEST_STATIONS = 60


@dataclass(frozen=True)
class FingerSeen:
    """A connected part of the gripper: its ``mask`` (h, w), the ``chains`` of its outline, ``inner`` edges, and
    ``outwards`` (2,), the direction to its tip in the image.
    """

    mask: NDArray[np.bool_]
    chains: tuple[Chain, ...]
    inner: tuple[InnerEdge, ...]
    outwards: Array


@dataclass(frozen=True)
class OpeningSeen:
    """What the images of one opening show.  ``left_out``: index of each image that isn't used, and why; ``blur_px`` of
    the outline.
    """

    matte: Matte
    fingers: tuple[FingerSeen, ...]
    left_out: dict[int, str]
    blur_px: float


def see_opening(
    camera: Camera,
    images: Sequence[NDArray[np.float32]],
    least_noise: float,
    step: Callable[[], None] = lambda: None,
) -> OpeningSeen:
    """Measure the outlines in ``images`` (h, w), grey levels of 0 to 255.  Raises :class:`NoResultError`."""
    matte = find_matte(images, least_noise, step)
    left_out = dict(matte.left_out)
    for turn in range(3):
        stations, found, contours = _around(matte)
        if found.blur_px > MOST_BLUR_PX:
            raise NoResultError(
                f"the outline is blurred by {found.blur_px:.1f} px in all images; at most {MOST_BLUR_PX:g} px: "
                "fingertips in focus, no motion during exposure"
            )
        bad = _unlike(matte, stations, found)
        if not bad or turn == 2:
            break
        for k, why in bad.items():
            left_out[matte.kept[k]] = why
        good = [k for k in range(len(matte.kept)) if k not in bad]
        if len(good) < max(FEWEST_IMAGES, (len(images) + 2) // 2):
            raise NoResultError(
                f"{len(left_out)} of {len(images)} images can't be used ({next(iter(bad.values()))}); a camera that is "
                "fixed to the gripper, jaws at rest, sharp images"
            )
        again = find_matte([images[matte.kept[k]] for k in good], least_noise)
        matte = replace(again, kept=tuple(matte.kept[good[k]] for k in again.kept))
        step()
    fingers = _fingers(camera, matte, contours, found.blur_px, step)
    return OpeningSeen(matte, fingers, left_out, found.blur_px)


def see_parts(
    camera: Camera, seen: OpeningSeen, parts: Sequence[NDArray[np.bool_]], outwards: Sequence[Array]
) -> OpeningSeen:
    """The same images with given ``parts`` (h, w) of what is static as the fingers, and the directions (2,) to their
    tips.  The cut between a part and the rest isn't outline.
    """
    contours = [(part, contour) for part in parts for contour in trace(part, SHORTEST_CONTOUR_PX)]
    rest = seen.matte.still & ~np.any(parts, axis=0)
    fingers = _fingers(camera, seen.matte, contours, seen.blur_px, lambda: None, rest)
    ways = {id(part): way for part, way in zip(parts, outwards, strict=True)}
    return replace(seen, fingers=tuple(replace(f, outwards=ways[id(f.mask)]) for f in fingers))


def _parts(still: NDArray[np.bool_]) -> list[NDArray[np.bool_]]:
    count, labels = cv2.connectedComponents(still.astype(np.uint8), connectivity=4)
    return [labels == k for k in range(1, count)]


def _around(matte: Matte) -> tuple[Stations, Transitions, list[tuple[NDArray[np.bool_], Array]]]:
    """Stations along all contours, the transitions measured there, and the contours with their parts."""
    contours = [(part, contour) for part in _parts(matte.still) for contour in trace(part, SHORTEST_CONTOUR_PX)]
    if not contours:
        raise NoResultError("nothing static has an outline; the gripper's fingertips in view")
    each = [stations_along(contour, part, BORDER_PX) for part, contour in contours]
    stations = Stations(
        np.vstack([s.uv_px for s in each]),
        np.vstack([s.normal for s in each]),
        np.concatenate([s.inside for s in each]),
    )
    found = measure_transitions(matte.images, stations, matte.noise, wide=True)
    if np.count_nonzero(found.usable) < _FEWEST_STATIONS:
        raise NoResultError(
            f"the outline is visible along only {np.count_nonzero(found.usable)} px; at least {_FEWEST_STATIONS} px: "
            "backgrounds of other grey levels than the fingers, changing between the images"
        )
    return stations, found, contours


def _unlike(matte: Matte, stations: Stations, found: Transitions) -> dict[int, str]:
    """Images that show the outline displaced or blurred: the reason by their index in the matte."""
    out = {}
    chosen = found.usable
    normal, centre = stations.normal[chosen], stations.uv_px[chosen].mean(axis=0)
    arm = stations.uv_px[chosen] - centre
    size = float(np.sqrt(np.square(arm).sum(axis=1).mean()))
    design = np.column_stack([normal, (arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]) / size])
    for k in range(len(matte.images)):
        worth, shift = np.sqrt(found.worth[k, chosen]), np.clip(found.shift_px[k, chosen], -4.0, 4.0)
        weight = worth.copy()
        moved = np.zeros(3)
        for _ in range(6):
            moved = np.linalg.lstsq(design * weight[:, None], shift * weight, rcond=None)[0]
            off = np.abs(shift - design @ moved)
            weight = worth / np.maximum(off / max(1.4826 * float(np.median(off)), 0.05), 1.0)
        away_px = float(np.linalg.norm(moved))
        if away_px > MOST_SHIFT_PX:
            out[k] = (
                f"shows the gripper {away_px:.1f} px from where the others do, at most {MOST_SHIFT_PX:g} px: the "
                "camera or the jaws moved"
            )
        elif found.sharpness[k] < LEAST_SHARPNESS * float(np.median(found.sharpness)):
            out[k] = f"shows the outline {100.0 * found.sharpness[k]:.0f} % as sharp as the others do: it is blurred"
    return out


def _fingers(
    camera: Camera,
    matte: Matte,
    contours: list[tuple[NDArray[np.bool_], Array]],
    blur_px: float,
    step: Callable[[], None],
    rest: NDArray[np.bool_] | None = None,
) -> tuple[FingerSeen, ...]:
    """The parts with at least one chain, from left to right (or from top to bottom); ``rest`` (h, w) of what is static,
    from which a part was cut off.
    """
    chains: dict[int, list[Chain]] = {}
    masks: dict[int, NDArray[np.bool_]] = {}
    for part, contour in contours:
        stations = stations_along(contour, part, BORDER_PX)
        if rest is not None:
            ahead = np.clip(
                np.rint(contour + BORDER_PX * stations.normal).astype(int), 0, np.array(rest.shape[::-1]) - 1
            )
            stations = replace(stations, inside=stations.inside & ~rest[ahead[:, 1], ahead[:, 0]])
        found = measure_transitions(matte.images, stations, matte.noise, wide=True, blur_px=blur_px)
        points = stations.uv_px + found.offset_px[:, None] * stations.normal
        for run, closed in runs(found.usable, points):
            run = without_outliers(found.offset_px, run)
            chain = fit_chain(camera, matte.images, matte.noise, points[run], stations.normal[run], closed, blur_px)
            if chain is not None:
                chains.setdefault(id(part), []).append(chain)
                masks[id(part)] = part
        step()
    seen = []
    for key, own in chains.items():
        mask = masks[key]
        inner = find_inner_edges(camera, matte, mask)
        seen.append(FingerSeen(mask, tuple(own), tuple(inner), _outwards(mask)))
    if len(seen) > MOST_PARTS:
        raise NoResultError(
            f"{len(seen)} separate parts stay the same: not a gripper; the camera or the jaws moved between the "
            "images, or they show too few backgrounds"
        )
    if not seen:
        raise NoResultError("nothing static has a straight or curved edge of 8 px; fingertips in view and in focus")
    centres = np.array([np.argwhere(f.mask)[:, ::-1].mean(axis=0) for f in seen])
    axis = int(np.ptp(centres, axis=0).argmax()) if len(seen) > 1 else 0
    return tuple(seen[k] for k in np.argsort(centres[:, axis]))


def _outwards(mask: NDArray[np.bool_]) -> Array:
    """Direction (2,) in the image from where a part leaves the image to its farthest points."""
    points = np.argwhere(mask)[:, ::-1].astype(float)
    last = np.array([mask.shape[1] - 1.0, mask.shape[0] - 1.0])
    border = ((points <= 0.0) | (points >= last)).any(axis=1)
    if border.any():
        root = points[border].mean(axis=0)
    else:
        centre = points.mean(axis=0)
        gaps = np.concatenate([centre, last - centre])
        root = centre.copy()
        nearest = int(gaps.argmin())
        root[nearest % 2] = 0.0 if nearest < 2 else last[nearest % 2]
    return outwards_from(mask, root)


def outwards_from(mask: NDArray[np.bool_], root: Array) -> Array:
    """Direction (2,) in the image from a part's root (2,) to its farthest points."""
    points = np.argwhere(mask)[:, ::-1].astype(float)
    # The farthest hundredth of the pixels: a single pixel is not a tip.
    away = np.linalg.norm(points - root, axis=1)
    tip = points[away >= np.quantile(away, 0.99)].mean(axis=0)
    return np.asarray((tip - root) / np.linalg.norm(tip - root))
