"""Which parts of what stays in the image are fingers: those that enter from the image's border or from a palm and end
in view.  A palm's border between two fingers is seen, and they are cut off along it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gripmon.model.errors import NoResultError
from gripmon.model.records import Array, Image
from gripmon.model.staying import Bits, Edges, Plane

SHORTEST_OUTLINE_PX = 40.0
"""Shortest outline of a finger in view: 8 px across a tip and twice 16 px along it are the least that six parameters of
a pose need."""
LEAST_DEPTH = 0.25
"""Least depth of a finger, from where it enters to its tip, over the length of border it enters through: a corner of
the image that a lens hides, or a housing, is flatter; a finger cut off by a corner is deeper than a third of it."""
LEAST_VALLEY = 0.25
"""Least depth of the space between two fingers of one part, over the distance of their tips."""
LEAST_STEEPNESS = 1.2
"""Least rise of both sides of that space over their way along the line between the tips: 50°, as far down as they have
it.  In the corner between one finger and what carries it, of 90° or so, a side has 45° at most."""
PRONGS_SHARE = 0.5
"""Least share of a part's outline in view that its two fingers have; a notch in one finger's tip leaves less."""
ALIKE_OUTLINES = 0.3
"""Least outline of a second finger over the first one's; what is shorter is taken for something else."""
ALIKE_SHARES = 0.8
"""Least part of an outline along which an edge stays, over that of the part with the longest one: of what edges enclose
by chance about half.  In how many images it shows depends on a part's own grey."""
_BOTTOM = 0.9
_FLANK = (0.2, 0.7)  # parts of a valley's depth: above, a finger's end that is farther back than the other one's
_BORDER_PX = 2


@dataclass(frozen=True)
class Parts:
    """``fingers``, each a mask (h, w), and ``outwards``, the directions (2,) to their tips in the image; ``rest`` (h,
    w): what stays and is no finger.
    """

    fingers: tuple[Bits, ...]
    outwards: tuple[Array, ...]
    rest: Bits


class UnclearPartsError(NoResultError):
    """Which parts are the fingers isn't clear.  ``parts``: masks (h, w) of those that may be; ``unseen_px``: points
    (k, 2) of their outlines that don't show; ``image``: number of the first image that shows them there.
    """

    def __init__(self, text: str, parts: list[Bits], still: Bits, unseen_px: Sequence[Array] = (), image: int = 0):
        super().__init__(text)
        self.parts, self.still, self.unseen_px, self.image = parts, still, unseen_px, image

    def picture(self, shown: Image) -> Image:
        """The image (h, w[, 3]) with what stays (blue), what may be a finger (green, numbered), and what of its outline
        doesn't show (red); BGR.
        """
        grey = shown if shown.ndim == 2 else shown.mean(axis=2)
        out = cv2.cvtColor(np.clip(grey * (255.0 / max(float(grey.max()), 1.0)), 0, 255).astype(np.uint8), 8)
        for number, (mask, colour) in enumerate(
            [(self.still, (230, 120, 40)), *((p, (60, 200, 60)) for p in self.parts)]
        ):
            found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(out, found, -1, colour, 2, cv2.LINE_AA)
            if number:
                at = np.argwhere(mask).mean(axis=0)[::-1].round().astype(int)
                cv2.putText(out, str(number), tuple(at.tolist()), cv2.FONT_HERSHEY_SIMPLEX, 0.8, colour, 2, cv2.LINE_AA)
        for point in np.rint(np.vstack([np.zeros((0, 2)), *self.unseen_px])).astype(int).tolist():
            cv2.circle(out, point, 2, (40, 40, 255), -1, cv2.LINE_AA)
        return out


_Part = tuple[Bits, Array, float, bool]
"""A part's mask, the direction to its tip, the length of its outline in view (px), and whether it enters the view."""
Box = tuple[int, int, int, int]
"""A part of an image, px: left, top, right, bottom."""


def find_fingers(still: Bits, edges: Edges, count: int | None = None, within: Sequence[Box] = ()) -> Parts:
    """The fingers among what stays (h, w), from left to right (or from top to bottom): ``count`` of them if given,
    else two.  ``within``: only there; with several boxes one finger in each.  Raises :class:`UnclearPartsError`, also
    if there are more: a cable that hangs in the view has a finger's shape, and may be the longer one.
    """
    strength = np.asarray(cv2.resize(edges.strength, still.shape[::-1]), np.float32)
    if len(within) > 1:
        each = [_candidates(_inside_box(still, box), strength, edges.limit)[:1] for box in within]
        return _chosen([own for found in each for own in found], still, len(within))
    found = _candidates(_inside_box(still, within[0]) if within else still, strength, edges.limit)
    alike = [own for own in found if own[2] >= ALIKE_OUTLINES * found[0][2]]
    if count != 1 and len(alike) == 1 and len(found) > 1:  # the largest may be a cable
        raise UnclearPartsError(
            f"{len(found)} parts that stay may be fingers, one much larger than the others (see --picture); --fingers "
            "1 if that is the gripper's only one, else --within LEFT,TOP,RIGHT,BOTTOM around each finger without what "
            "it holds, in pixels",
            [own[0] for own in found],
            still,
        )
    return _chosen(alike, still, count or 2)


def _inside_box(still: Bits, box: Box) -> Bits:
    left, top, right, bottom = box
    out = np.zeros_like(still)
    out[top : bottom + 1, left : right + 1] = still[top : bottom + 1, left : right + 1]
    return out


def _candidates(still: Bits, strength: Plane, limit: float) -> list[_Part]:
    """Parts that may be fingers, those with the longest outline first."""
    found = [own for part in _connected(still) for own in _divided(part) if own[2] >= SHORTEST_OUTLINE_PX]
    shares = [_stays_along(own[0], still, strength, limit) for own in found]
    longest = int(np.argmax([own[2] * share for own, share in zip(found, shares, strict=True)])) if found else 0
    found = [own for own, share in zip(found, shares, strict=True) if share > ALIKE_SHARES * shares[longest]]
    if any(enters for *_, enters in found):  # what floats in the view is a mark on the lens, a stamp, a reflection
        found = [own for own in found if own[3]]
    return sorted(found, key=lambda own: -own[2])


def _chosen(found: list[_Part], still: Bits, wanted: int) -> Parts:
    parts = [own[0] for own in found]
    if not parts:
        raise UnclearPartsError(
            "what stays in the images has no finger's shape: it should enter from the image's border or from a palm "
            "and end in view; where something is held in all images, --within LEFT,TOP,RIGHT,BOTTOM around each finger",
            [],
            still,
        )
    if len(parts) < wanted:
        raise UnclearPartsError(
            "one finger is seen; --fingers 1 if the gripper shows no more, a timestamps.csv if the jaws moved",
            parts,
            still,
        )
    if len(parts) > wanted:
        around = "the two, in pixels, or one around each" if wanted > 1 else "the finger, in pixels"
        raise UnclearPartsError(
            f"{len(parts)} parts that stay may be fingers (see --picture); --within LEFT,TOP,RIGHT,BOTTOM around "
            f"{around}",
            parts,
            still,
        )
    chosen = found[:wanted]
    centres = np.array([np.argwhere(own[0])[:, ::-1].mean(axis=0) for own in chosen])
    axis = int(np.ptp(centres, axis=0).argmax()) if len(chosen) > 1 else 0
    chosen = [chosen[k] for k in np.argsort(centres[:, axis]).tolist()]
    fingers = tuple(own[0] for own in chosen)
    return Parts(fingers, tuple(own[1] for own in chosen), still & ~np.any(fingers, axis=0))


def _connected(mask: Bits) -> list[Bits]:
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return [labels == k for k in range(1, count)]


def _divided(part: Bits) -> list[_Part]:
    """The two fingers of a part with a valley between them, without the palm that joins them; else the part itself,
    if it is deep enough for a finger.
    """
    cut = _cut(part)
    if cut is not None:
        way, level = cut
        ahead = np.indices(part.shape)[::-1].transpose(1, 2, 0) @ way > level
        prongs = sorted(_connected(part & ahead), key=lambda own: -np.count_nonzero(own))[:2]
        outlines = [_outline_px(prong, part) for prong in prongs]
        most = sum(outlines) >= PRONGS_SHARE * _outline_px(part, part)
        if len(prongs) == 2 and most and min(outlines) >= max(SHORTEST_OUTLINE_PX, ALIKE_OUTLINES * max(outlines)):
            body = cv2.dilate((part & ~ahead).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            roots = [np.argwhere(prong & body)[:, ::-1] for prong in prongs]
            return [
                (prong, outwards_from(prong, root.mean(axis=0) if len(root) else _root(prong)), outline, True)
                for prong, root, outline in zip(prongs, roots, outlines, strict=True)
            ]
    outwards, outline = outwards_from(part, _root(part)), _outline_px(part, part)
    border = part & _at_border(part.shape)
    if not border.any():
        return [(part, outwards, outline, False)]
    if not _ends_within(part, border):
        return []
    points = np.argwhere(part)[:, ::-1] @ outwards
    depth = float(points.max() - (np.argwhere(border)[:, ::-1] @ outwards).min())
    inside = float(points.max() - np.median(np.argwhere(border)[:, ::-1] @ outwards))
    if min(depth, inside) < LEAST_DEPTH * np.count_nonzero(border) / _BORDER_PX:
        return []
    return [(part, outwards, outline, True)]


def _ends_within(part: Bits, border: Bits) -> bool:
    """Whether a part ends in view: what is farthest from where it enters (most of its ``border``) isn't where it leaves
    again, as a cable that crosses the view; what enters along a whole side, as a housing, must stand out from it.
    """
    root = max(_connected(border), key=np.count_nonzero)
    if (root[:, 0].any() and root[:, -1].any()) or (root[0].any() and root[-1].any()):
        out = float(cv2.distanceTransform((~root).astype(np.uint8), cv2.DIST_L2, 5)[part].max())
        return bool(out >= LEAST_DEPTH * np.count_nonzero(root) / _BORDER_PX)
    points = np.argwhere(part)
    away = np.linalg.norm(points - np.argwhere(root).mean(axis=0), axis=1)
    tip = points[away >= np.quantile(away, 0.99)]
    return not bool((border & ~root)[tip[:, 0], tip[:, 1]].any())


def _cut(part: Bits) -> tuple[Array, float] | None:
    """A line along the bottom of the valley between two fingers, or where their sides end above a shoulder of what
    carries them: its unit normal (2,) towards their tips, and its level along that; None where there is no such valley.
    """
    contours, _ = cv2.findContours(part.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=len)
    hull = np.sort(cv2.convexHull(contour, returnPoints=False), axis=0)[::-1]
    defects = cv2.convexityDefects(contour, hull) if len(hull) > 3 else None
    if defects is None:
        return None
    points = np.reshape(contour, (-1, 2)).astype(float)
    best: tuple[float, Array, float] | None = None
    for row in np.reshape(defects, (-1, 4)):
        start, end, depth = int(row[0]), int(row[1]), float(row[3])
        tips = points[[start, end]]
        valley = points[start : end + 1] if start < end else np.vstack([points[start:], points[: end + 1]])
        apart = float(np.linalg.norm(tips[1] - tips[0]))
        if apart < 1.0 or depth / 256.0 < LEAST_VALLEY * apart or not _ends_in_view(tips, part.shape):
            continue
        chord = (tips[1] - tips[0]) / apart
        normal = np.array([-chord[1], chord[0]])
        below = (valley - tips[0]) @ normal
        normal *= -1.0 if abs(below.max()) > abs(below.min()) else 1.0
        below = np.abs(below)
        level = _steep_to(below, (valley - tips[0]) @ chord, LEAST_VALLEY * apart)
        if level is None or (best is not None and level <= best[0]):
            continue
        if level < below.max():
            best = level, normal, float(tips[0] @ normal) - level
            continue
        bottom = valley[below > _BOTTOM * below.max()]
        spread = bottom - bottom.mean(axis=0)
        way = np.linalg.svd(spread, full_matrices=False)[2][0] if len(bottom) > 2 else chord
        # A valley that ends in a point has no bottom to go along: then along the line from tip to tip.
        if np.ptp(spread @ way) < 0.2 * apart or abs(float(way @ chord)) < math.cos(math.radians(30.0)):
            way = chord
        across = np.array([-way[1], way[0]])
        across *= np.sign(float(across @ normal)) or 1.0
        best = level, across, float((bottom @ across).max()) + 1.0
    return None if best is None else (best[1], best[2])


def _steep_to(below: Array, along: Array, least: float) -> float | None:
    """The largest depth, ``least`` or more, to which both sides of a valley are steep, from its bottom upwards: its
    points, in order, lie ``below`` (n,) and ``along`` (n,) a line from tip to tip.
    """
    return next((level for level in np.arange(below.max(), least, -1.0).tolist() if _steep(below, along, level)), None)


def _steep(below: Array, along: Array, depth: float) -> bool:
    high, low = (along[below >= part * depth] for part in _FLANK)
    run = max(low[0] - high[0], high[-1] - low[-1])
    return bool(run * LEAST_STEEPNESS < (_FLANK[1] - _FLANK[0]) * depth)


def _ends_in_view(tips: Array, shape: tuple[int, ...]) -> bool:
    last = np.array([shape[1] - 1.0, shape[0] - 1.0])
    return bool(((tips > _BORDER_PX) & (tips < last - _BORDER_PX)).all())


def _at_border(shape: tuple[int, ...]) -> Bits:
    out = np.ones(shape, bool)
    out[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX] = False
    return out


def _outline_px(mask: Bits, part: Bits) -> float:
    """Length of a mask's outline in view that is also the outline of the part it belongs to."""
    return float(np.count_nonzero(_outline(mask, part)))


def _outline(mask: Bits, part: Bits) -> Bits:
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    return mask & (cv2.erode(part.astype(np.uint8), cross, borderValue=1) == 0) & ~_at_border(mask.shape)


def _stays_along(mask: Bits, still: Bits, strength: Plane, limit: float) -> float:
    """Part of an outline along which an edge stays, to a pixel or two."""
    near = cv2.dilate(strength, np.ones((3, 3), np.uint8))
    return float((near[_outline(mask, still)] > limit).mean())


def _root(mask: Bits) -> Array:
    """Where (2,) a part enters the image, or would enter it."""
    points = np.argwhere(mask)[:, ::-1].astype(float)
    border = np.argwhere(mask & _at_border(mask.shape))[:, ::-1]
    if len(border):
        return np.asarray(border.mean(axis=0))
    centre = points.mean(axis=0)
    last = np.array([mask.shape[1] - 1.0, mask.shape[0] - 1.0])
    gaps = np.concatenate([centre, last - centre])
    nearest = int(gaps.argmin())
    centre[nearest % 2] = 0.0 if nearest < 2 else last[nearest % 2]
    return centre


def outwards_from(mask: Bits, root: Array) -> Array:
    """Direction (2,) in the image from a part's root (2,) to its farthest points."""
    points = np.argwhere(mask)[:, ::-1].astype(float)
    # The farthest hundredth of the pixels: a single pixel is not a tip.
    away = np.linalg.norm(points - root, axis=1)
    tip = points[away >= np.quantile(away, 0.99)].mean(axis=0)
    return np.asarray((tip - root) / max(float(np.linalg.norm(tip - root)), 1e-9))
