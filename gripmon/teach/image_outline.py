"""From images of one jaw opening to outlines of fingers; images that show motion or blur, or contradict the others, are
left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gripmon.model.camera import Camera
from gripmon.model.errors import NoResultError
from gripmon.model.records import Array
from gripmon.model.staying import Bits, Plane
from gripmon.teach.beyond import Background
from gripmon.teach.fingers import SHORTEST_OUTLINE_PX, Box, Parts, UnclearPartsError, find_fingers
from gripmon.teach.image_borders import WELL_SEEN, Border, borders_of
from gripmon.teach.inner_edges import InnerEdge, find_inner_edges
from gripmon.teach.matte import FEWEST_IMAGES, Matte, find_matte
from gripmon.teach.piece_lines import STRAIGHT_PX
from gripmon.teach.silhouette import Stations, Transitions, measure_transitions, stations_along, trace
from gripmon.teach.straight_pieces import Chain, fit_chains, runs, without_outliers

_BESIDE_PX = 9.0
"""How far beside a part another one counts as joined to it: a search line's reach."""
LEAST_PLAY_PX = 0.03
"""Displacement of an image that isn't moved back: a seventh of the accuracy wanted of an outline."""
MOST_BLUR_PX = 2.5
"""Largest blur of an outline's transition: beyond it the background's edges merge with the fingers' (see Limits)."""
LEAST_SHARPNESS = 0.6
"""Least sharpness of an image's transitions over that of all: an image blurred to 1.7 times their width has less."""
LEAST_SEEN = 0.7
"""Least part of a finger's outline in view that is measured: with less, what is missing may be its tip."""
_TURNS = 4


@dataclass(frozen=True)
class FingerSeen:
    """A connected part of the gripper: its ``mask`` (h, w), the ``chains`` of its outline, ``inner`` edges, and
    ``outwards`` (2,), the direction to its tip in the image.
    """

    mask: Bits
    chains: tuple[Chain, ...]
    inner: tuple[InnerEdge, ...]
    outwards: Array


@dataclass(frozen=True)
class OpeningSeen:
    """What the images of one opening show.  ``left_out``: index of each image that isn't used, and why; ``blur_px`` of
    the outline; ``rest`` (h, w): what stays as well and is no finger; ``borders``: what shows of each, worst first.
    """

    matte: Matte
    fingers: tuple[FingerSeen, ...]
    left_out: dict[int, str]
    blur_px: float
    rest: Bits
    borders: tuple[Border, ...] = ()


def see_opening(
    camera: Camera,
    images: Sequence[Plane],
    least_noise: float,
    step: Callable[[], None] = lambda: None,
    *,
    fingers: int | None = None,
    within: Sequence[Box] = (),
) -> OpeningSeen:
    """Measure the outlines in ``images`` (h, w), grey levels of 0 to 255; ``fingers`` and ``within`` as in
    :func:`~gripmon.teach.fingers.find_fingers`.  Raises :class:`NoResultError`.
    """
    matte = find_matte(images, least_noise, step)
    parts = find_fingers(matte.still, matte.edges, fingers, within)
    count = len(images)
    left_out = dict(matte.left_out)
    contours = [(part, contour) for part in parts.fingers for contour in trace(part, int(SHORTEST_OUTLINE_PX))]
    for turn in range(_TURNS):
        stations, found = _around(matte, contours, parts.rest)
        if found.blur_px > MOST_BLUR_PX:
            raise NoResultError(
                f"the outline is blurred by {found.blur_px:.1f} px in all images; at most {MOST_BLUR_PX:g} px: "
                "fingertips in focus, no motion during exposure"
            )
        bad = _blurred(found)
        if bad:
            left_out.update({matte.kept[k]: why for k, why in bad.items()})
            if len(matte.kept) - len(bad) < max(FEWEST_IMAGES, (count + 2) // 2):
                raise NoResultError(
                    f"{len(left_out)} of {count} images can't be used ({next(iter(bad.values()))}); a camera "
                    "that is fixed to the gripper, jaws at rest, sharp images"
                )
            matte = _without(matte, bad)
        elif turn + 1 < _TURNS:
            moved = _displaced(stations, found)
            if np.abs(moved).max() < LEAST_PLAY_PX:
                break
            matte = _moved_back(matte, moved, stations.uv_px[found.usable])
        step()
    seen, borders = _fingers(camera, matte, contours, parts, found.blur_px, step)
    return OpeningSeen(matte, seen, left_out, found.blur_px, parts.rest, borders)


def _around(matte: Matte, contours: Sequence[tuple[Bits, Array]], rest: Bits) -> tuple[Stations, Transitions]:
    """Stations along all contours, and the transitions measured there."""
    if not contours:
        raise NoResultError("nothing that stays has an outline; the gripper's fingertips in view")
    near = _near(rest)
    each = [_stations(contour, part, near) for part, contour in contours]
    stations = Stations(
        np.vstack([s.uv_px for s in each]),
        np.vstack([s.normal for s in each]),
        np.concatenate([s.inside for s in each]),
    )
    found = measure_transitions(matte.images, stations, matte.noise, wide=True)
    if np.count_nonzero(found.usable) < SHORTEST_OUTLINE_PX:
        raise NoResultError(
            f"the outline is visible along only {np.count_nonzero(found.usable)} px; at least "
            f"{SHORTEST_OUTLINE_PX:.0f} px: backgrounds of other grey levels than the fingers, changing between the "
            "images"
        )
    return stations, found


def _near(rest: Bits) -> Bits:
    """Pixels (h, w) on what stays and is no finger, or beside it."""
    size = 2 * int(_BESIDE_PX) + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(rest.astype(np.uint8), shape) > 0)


def _stations(contour: Array, part: Bits, near: Bits) -> Stations:
    """Stations along a part's contour; where it is cut off from the rest of what stays, or ``near`` it, isn't
    outline.
    """
    stations = stations_along(contour, part)
    column, row = np.clip(np.rint(contour).astype(int), 0, np.array(near.shape[::-1]) - 1).T
    return replace(stations, inside=stations.inside & ~near[row, column])


def _blurred(found: Transitions) -> dict[int, str]:
    """Images that show the outline blurred: why, by their index in the matte."""
    least = LEAST_SHARPNESS * float(np.median(found.sharpness))
    return {
        k: f"shows the outline {max(100.0 * sharp, 0.0):.0f} % as sharp as the others do: it is blurred, or what is "
        "behind is nearly as bright as the fingers"
        for k, sharp in enumerate(found.sharpness.tolist())
        if sharp < least
    }


def _middle(at_px: Array) -> tuple[Array, float]:
    """Centre (2,) of points (s, 2) and their root mean square distance from it, px."""
    centre = at_px.mean(axis=0)
    return centre, float(np.sqrt(np.square(at_px - centre).sum(axis=1).mean()))


def _displaced(stations: Stations, found: Transitions) -> Array:
    """How far (n, 3) each image shows the outline beside where all do: a shift, and a turn about the centre of its
    usable stations, in pixels at their usual distance from it (:func:`_middle`); robust least squares.
    """
    chosen = found.usable
    centre, size = _middle(stations.uv_px[chosen])
    normal, arm = stations.normal[chosen], stations.uv_px[chosen] - centre
    design = np.column_stack([normal, (arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]) / size])
    out = np.zeros((len(found.worth), 3))
    shift, trust = np.clip(found.shift_px[:, chosen], -4.0, 4.0), np.ones(np.count_nonzero(chosen))
    for _ in range(2):
        for k in range(len(out)):
            out[k] = _robust(design, shift[k], np.sqrt(found.worth[k, chosen] * trust))
        # Beside a face of the gripper each background shows the edge elsewhere, whatever moved.
        off = shift - (out - np.median(out, axis=0)) @ design.T
        off = np.square(off - np.median(off, axis=0))
        scatter = np.average(off, axis=0, weights=found.worth[:, chosen] + 1e-9)
        trust = 1.0 / np.maximum(scatter, STRAIGHT_PX**2)
    return np.asarray(out - np.median(out, axis=0))


def _robust(design: Array, wanted: Array, worth: Array) -> Array:
    """Least squares with weights (s,), without outliers."""
    weight = worth.copy()
    for _ in range(6):
        out = np.linalg.lstsq(design * weight[:, None], wanted * weight, rcond=1e-3)[0]
        off = np.abs(wanted - design @ out)
        weight = worth / np.maximum(off / max(1.4826 * float(np.median(off)), 0.05), 1.0)
    return np.asarray(out)


def _moved_back(matte: Matte, moved: Array, usable_px: Array) -> Matte:
    """The matte with each image moved back by (n, 3), as :func:`_displaced` found it by the usable stations (s, 2)."""
    centre, size = _middle(usable_px)
    images = np.empty_like(matte.images)
    for k, (image, (dx, dy, turn)) in enumerate(zip(matte.images, moved, strict=True)):
        angle = turn / size
        back = np.array([[1.0, -angle, 0.0], [angle, 1.0, 0.0]])  # to first order, as the turn was found
        back[:, 2] = centre + np.array([dx, dy]) - back[:, :2] @ centre
        images[k] = cv2.warpAffine(
            image,
            back,
            image.shape[::-1],
            flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return replace(matte, images=images, moved_px=matte.moved_px + moved[:, :2])


def _without(matte: Matte, bad: Mapping[int, str]) -> Matte:
    good = [k for k in range(len(matte.kept)) if k not in bad]
    kept = tuple(matte.kept[k] for k in good)
    return replace(matte, images=matte.images[good], moved_px=matte.moved_px[good], kept=kept)


def _length_px(chain: Chain) -> float:
    ends = chain.uv_px[np.array(chain.pieces)]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def _fingers(
    camera: Camera,
    matte: Matte,
    contours: Sequence[tuple[Bits, Array]],
    parts: Parts,
    blur_px: float,
    step: Callable[[], None],
) -> tuple[tuple[FingerSeen, ...], tuple[Border, ...]]:
    """The fingers with the chains of their outlines, and how much of each border that is."""
    chains: dict[int, list[Chain]] = {id(part): [] for part in parts.fingers}
    in_view = dict.fromkeys(chains, 0)
    along, near = [], _near(parts.rest)
    behind = Background.of(matte.images, matte.still, matte.edges.changing)
    for part, contour in contours:
        stations = _stations(contour, part, near)
        found = measure_transitions(matte.images, stations, matte.noise, wide=True, blur_px=blur_px)
        points = stations.uv_px + found.offset_px[:, None] * stations.normal
        in_view[id(part)] += int(np.count_nonzero(stations.inside))
        along.append((next(k for k, own in enumerate(parts.fingers) if own is part), stations, found))
        for run, closed in runs(found.usable, points):
            run = without_outliers(found.offset_px, run)
            chains[id(part)] += fit_chains(
                camera, matte.images, matte.noise, behind, points[run], stations.normal[run], closed, blur_px
            )
        step()
    centres_px = [np.argwhere(part)[:, ::-1].mean(axis=0) for part in parts.fingers]
    own = [chains[id(part)] for part in parts.fingers]
    borders = tuple(borders_of(_names(centres_px), parts.outwards, centres_px, along, own, matte.mean.shape))
    worst = [border for border in borders if border.share < WELL_SEEN][:2] or borders[:1]
    shares = [sum(map(_length_px, chains[id(part)])) / max(in_view[id(part)], 1) for part in parts.fingers]
    if min(shares) < LEAST_SEEN:
        raise UnclearPartsError(
            f"only {100.0 * min(shares):.0f} % of a finger's outline shows against the backgrounds, at least "
            f"{100.0 * LEAST_SEEN:.0f} %: {'; '.join(border.words() for border in worst)}",
            list(parts.fingers),
            matte.still,
            [border.unseen_px for border in borders],
        )
    if not all(chains.values()):
        raise NoResultError("a finger has no straight or curved edge of 8 px; fingertips in view and in focus")
    fingers = tuple(
        FingerSeen(part, tuple(chains[id(part)]), tuple(find_inner_edges(camera, matte, part)), outwards)
        for part, outwards in zip(parts.fingers, parts.outwards, strict=True)
    )
    return fingers, borders


def _names(centres_px: Sequence[Array]) -> list[str]:
    """The fingers in words of the picture."""
    if len(centres_px) == 1:
        return ["finger"]
    across = int(np.abs(centres_px[1] - centres_px[0]).argmax()) == 0
    return ["left finger", "right finger"] if across else ["upper finger", "lower finger"]
