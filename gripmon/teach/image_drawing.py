"""The picture of a gripper file made from images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gripmon.model.canvas import Canvas, Colour
from gripmon.model.records import Array, Image
from gripmon.teach.drawing import Labels, write
from gripmon.teach.image_outline import OpeningSeen
from gripmon.teach.straight_pieces import Chain

_FINGERS: tuple[Colour, ...] = ((96, 224, 96), (255, 176, 64), (224, 96, 224), (64, 208, 255))
_CORNER: Colour = (0, 255, 255)
_INNER: Colour = (0, 144, 255)
_TEXT: Colour = (255, 255, 255)
_SCATTER: Colour = (64, 64, 255)
_UNSEEN: Colour = (255, 64, 255)
_UNUSED: Colour = (255, 255, 255)
_ENLARGED = 10.0
_WIDTH_PX = 1400


def draw_outlines(
    image: Image, seen: OpeningSeen, names: Sequence[str], used: Sequence[Sequence[tuple[int, int]]]
) -> Image:
    """Draw outlines by finger, in white what isn't among the ``used`` pieces of each, corners as circles, and inner
    edges, over the part of the image around them; at each vertex its scatter, three standard deviations, enlarged; what
    of the outline doesn't show, as dots.
    """
    outlines = [chain.uv_px for finger in seen.fingers for chain in finger.chains]
    canvas = Canvas.about(image, np.concatenate(outlines), _WIDTH_PX)
    labels = Labels(canvas.picture)
    left_out = False
    for number, (finger, name, own) in enumerate(zip(seen.fingers, names, used, strict=True)):
        colour, first = _FINGERS[number % len(_FINGERS)], 0
        for edge in finger.inner:
            canvas.line(edge.uv_px, _INNER)
        for chain in finger.chains:
            for a, b in chain.pieces:
                unused = (first + a, first + b) not in own
                left_out |= unused
                canvas.line(chain.uv_px[[a, b]], _UNUSED if unused else colour)
            first += len(chain.uv_px)
            _draw_vertices(canvas, chain, colour)
        vertices = np.concatenate([chain.uv_px for chain in finger.chains])
        labels.put(name, canvas.pixel(vertices[np.argmin(vertices[:, 1])]), colour)
    unseen = np.vstack([np.zeros((0, 2)), *(border.unseen_px for border in seen.borders)])
    for at in unseen:
        canvas.circle(at, 1.5, _UNSEEN)
    text = (
        f"{len(seen.matte.kept)} images, blur {seen.blur_px:.1f} px; "
        f"red: 3 sigma of their scatter, x {_ENLARGED:g}{'; pink dots: not seen' if len(unseen) else ''}"
        f"{'; white: not in the file' if left_out else ''}"
    )
    write(canvas.picture, text, (12, canvas.picture.shape[0] - 14), _TEXT, 0.5)
    return canvas.picture


def _draw_vertices(canvas: Canvas, chain: Chain, colour: Colour) -> None:
    covariance = np.einsum("fvi,fvj->vij", *[chain.folds_px - chain.folds_px.mean(axis=0)] * 2)
    covariance *= (len(chain.folds_px) - 1) / len(chain.folds_px)
    for at, corner, matrix in zip(chain.uv_px, chain.corner.tolist(), covariance, strict=True):
        values, axes = np.linalg.eigh(matrix)
        reach: Array = 3.0 * _ENLARGED * np.sqrt(max(float(values[1]), 0.0)) * axes[:, 1]
        reach = reach * min(1.0, 40.0 / canvas.zoom / max(float(np.linalg.norm(reach)), 1e-9))
        canvas.line(np.array([at - reach, at + reach]), _SCATTER)
        canvas.circle(at, 6.0 if corner else 2.5, _CORNER if corner else colour)
