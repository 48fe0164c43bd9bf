"""How a gripper's edges look in images at the reference calibration: the measuring half of ``gripmon teach``.

By definition the gripper in the teaching images is at the reference, its jaws open as reported.  So the taught offsets
contain everything in which the images differ from the sharp model there: bevels, shading and blur, but also the errors
of the reference and of the reported opening.  All of it cancels later, as with the method's own reference corners,
which are measured in the reference image.  A reference or an opening with a larger error than its stated standard
deviation and a plausible bevel allow is refused: the error would persist, and the offsets' part along the line of
sight, which can't be measured, would grow with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import msgspec
import numpy as np
from scipy.stats import norm

from gripmon.judge.smoothing import GATE_SQUARE
from gripmon.model.geometry import perturb, perturbation_between
from gripmon.model.records import Array, ReferenceRecord
from gripmon.teach.estimate import (
    PLAUSIBLE_OWN_M,
    SHAPE_M,
    EdgeLines,
    check_edges,
    check_enough,
    check_reference,
    estimate_edges,
    found_off,
    is_absent,
)
from gripmon.teach.lines import find_line, of_image, settle_line
from gripmon.teach.play import with_play
from gripmon.teach.views import (
    REMEDIES,
    TAKE_MEASURED,
    ImageRefused,
    SampledEdge,
    TeachingImage,
    TeachingRefused,
    View,
    Viewer,
    sampled,
)
from gripmon.teach.visibility import Rig
from gripmon.track.edges import Measurement
from gripmon.track.edges.taught import PoseOffset, TaughtCorner, TaughtEdge, TaughtEdges

T = TypeVar("T")

SEEN_SHARE = 0.6
"""Least part of an edge's search lines that must show its line, in at least half of the images."""

CLOSED_PX = 0.3
"""Largest distance of the gripper from the reference when the images are measured with what was taught; a larger one
passes only if that measurement's covariance explains it."""


@dataclass(frozen=True, slots=True)
class Taught:
    """What was learnt.  ``untaught``: for each other edge in view the reason; ``notes``: what a person should know.

    ``closure_px``: largest distance of the gripper from where it stands when the images are measured with what was
    taught.  ``reference_offset`` (6,): the perturbation from the reference to the gripper in the images, as far as
    bevels don't explain it, with ``reference_covariance`` (36,) of how well the images show it.  ``play`` (6,):
    standard deviations of where one image has the gripper from another, m and rad.  ``left_out``: the images that
    contradict the others, by their numbers, and why.
    """

    edges: dict[str, TaughtEdge]
    corners: dict[str, TaughtCorner]
    untaught: dict[str, str]
    notes: tuple[str, ...]
    closure_px: float
    reference_offset: PoseOffset
    reference_covariance: tuple[float, ...]
    play: Array
    left_out: dict[int, str]

    def used(self, images: Sequence[T]) -> list[T]:
        """The items, given one for each image, that belong to the images taught from."""
        return [one for number, one in enumerate(images) if number not in self.left_out]


def teach(rig: Rig, reference: ReferenceRecord, images: Sequence[TeachingImage]) -> Taught:
    """Measure every edge in view against its prediction at the reference.  Raises :class:`TeachingRefused`.

    Several images with different backgrounds are averaged, and their scatter gives the standard deviations; in a single
    image a straight line of the background next to an outline may be taken for it.  An image that contradicts the
    others is left out as long as most of them remain.
    """
    assert images, "nothing to teach from"
    viewer = everywhere = Viewer(rig, reference, images)
    fits = {number: viewer.fitted(image) for number, image in enumerate(images)}
    unfitted = [image for image, fit in zip(images, fits.values(), strict=True) if fit is None]
    left_out: dict[int, str] = {}
    while True:
        used = [images[number] for number in fits]
        try:
            viewer = Viewer(rig, reference, used)
            return replace(_teach_or_locate(viewer, used, list(fits.values())), left_out=left_out)
        except ImageRefused as refused:
            number = next(n for n in fits if images[n].image is refused.image.image)
            if 2 * (len(fits) - 1) <= len(images):
                raise _with_reasons(refused, left_out, _astray(everywhere, unfitted, len(images))) from None
            del fits[number]
            left_out[number] = str(refused)
        except TeachingRefused as refused:
            raise _with_reasons(refused, left_out, _astray(everywhere, unfitted, len(images))) from None


def _astray(viewer: Viewer, unfitted: Sequence[TeachingImage], count: int) -> str:
    """What a refusal says first where several, but not all, of ``count`` images show nothing of the gripper at the
    reference.
    """
    absent = [image for image in unfitted if _nothing_of_it(viewer, image)]
    if not 1 < len(absent) < count:
        return ""
    right = "images at one jaw opening, for which the gripper file holds"
    if viewer.gripper.has_jaw:
        right = "each image with its own jaw opening (jaw_opening_m in timestamps.csv, jaw.source: frames)"
    return (
        f"{len(absent)} of {count} images ({absent[0].name} to {absent[-1].name}) don't show the gripper at the "
        f"reference, the others do: the jaws or the camera stood elsewhere in them, or something hides it; {right}"
    )


def _nothing_of_it(viewer: Viewer, image: TeachingImage) -> bool:
    view = viewer.view(image, None)
    return is_absent(viewer, view, _lines(viewer, [view], search=True)[0])


def _with_reasons(refused: TeachingRefused, left_out: Mapping[int, str], astray: str) -> TeachingRefused:
    """The refusal, with the images that were left out before, each with its reason, as notes; ``astray`` instead of it
    where that says more.
    """
    reasons = [f"left out: {why}" for why in left_out.values()]
    if astray:
        return TeachingRefused(astray, [*reasons, str(refused), *refused.notes])
    if not left_out:
        return refused
    count = f"{len(left_out)} image{'s' * (len(left_out) > 1)}"
    return TeachingRefused(f"{refused}; and left out before: {count}", [*reasons, *refused.notes])


def _teach_or_locate(viewer: Viewer, images: Sequence[TeachingImage], fits: Sequence[Measurement | None]) -> Taught:
    """Teach from these images; if that fails, an image that shows the gripper displaced is the more likely reason."""
    try:
        return _teach(viewer, images, fits)
    except ImageRefused:
        raise
    except TeachingRefused:
        for image, fit in zip(images, fits, strict=True):
            if fit is None and (found := viewer.elsewhere(image)) is not None:
                raise _elsewhere(viewer, image, found) from None
        raise


def _elsewhere(viewer: Viewer, image: TeachingImage, found: Measurement) -> ImageRefused:
    """The refusal of an image that shows the gripper elsewhere; the pose to take, in its notes, allows for bevels."""
    there = viewer.at(found.cam_T_grip, image)
    views = [there.view(image, there.fitted(image))]
    lines, _ = _lines(there, views, search=True)
    motion = perturbation_between(viewer.ref_cam_T_grip, found.cam_T_grip)
    try:
        check_enough(there, views, lines)
    except TeachingRefused:
        remedies, notes = REMEDIES, []
    else:
        moved = found_off(there, lines)
        pose = perturb(found.cam_T_grip, moved.common[:6])
        motion = perturbation_between(viewer.ref_cam_T_grip, pose)
        remedies, notes = TAKE_MEASURED, [viewer.measured_note(motion, moved.common_covariance[:6, :6])]
    why = f"the gripper is {viewer.off_reference_px(found):.1f} px off the reference, {viewer.distance(motion)}"
    return ImageRefused(image, f"{why}; at most {viewer.reach_px:g} px: {remedies}", notes)


def _teach(viewer: Viewer, images: Sequence[TeachingImage], fits: Sequence[Measurement | None]) -> Taught:
    gripper = viewer.gripper
    views = [viewer.view(image, fit) for image, fit in zip(images, fits, strict=True)]
    images, play = with_play(viewer, views)
    if any(image.play is not None for image in images):
        views = [viewer.view(image, fit) for image, fit in zip(images, fits, strict=True)]
    lines, untaught = _lines(viewer, views, search=True)
    check_enough(viewer, views, lines)
    reference = check_reference(viewer, images[0].name, lines)
    check_edges(viewer, views, lines)
    notes = _notes(viewer, lines, len(images), reference.doubt)
    edges = estimate_edges(viewer, lines, None)
    arrays = viewer.arrays(edges)
    # Repeat with the search lines centred on the real edges.
    views = [viewer.view(view.image, None, arrays, view.candidates.zoom) for view in views]
    lines, lost = _lines(viewer, views, search=False)
    edges = estimate_edges(viewer, lines, edges)
    # Next to an outline the background decides, and it will differ from that of the teaching images.
    for index in (index for index, edge in lines.items() if edge.line is not None and viewer.crease[index]):
        name = gripper.edge_ids[index]
        edges[name] = msgspec.structs.replace(edges[name], brighter=_brighter(lines[index]))
    arrays = viewer.arrays(edges)
    return Taught(
        edges,
        _corners(viewer, arrays, images[0].jaw_opening_m),
        {**untaught, **lost},
        (*notes, *_strays(viewer, lines, edges)),
        round(_closure_px(viewer, images, arrays), 4),
        reference.offset,
        reference.covariance,
        play,
        {},
    )


def _lines(viewer: Viewer, views: Sequence[View], search: bool) -> tuple[dict[int, EdgeLines], dict[str, str]]:
    """Lines of all edges that some image samples, and why others have none; outlines are included without a line."""
    lines, untaught = {}, {}
    for edge in sorted({e for view in views for e in view.prediction.layout.edges.tolist()}):
        if viewer.bent[edge]:
            untaught[viewer.gripper.edge_ids[edge]] = "it is curved"
            continue
        seen = sampled(views, edge)
        found = "out of view" if seen is None else _lines_of(seen, len(views), search)
        if isinstance(found, EdgeLines):
            lines[edge] = found
        elif seen is None or viewer.crease[edge]:
            untaught[viewer.gripper.edge_ids[edge]] = found
        else:
            lines[edge] = EdgeLines(seen, None, (), np.zeros((0, 2)), np.zeros(2))
    return lines, untaught


def _lines_of(seen: SampledEdge, images: int, search: bool) -> EdgeLines | str:
    """An edge's line in all images together and in each, or the reason why there is none."""
    points, expected_px = seen.points, seen.expected_px
    line = find_line(points, expected_px, SHAPE_M * seen.per_m) if search else settle_line(points, expected_px)
    if line is None:
        return "no line is seen"
    shown = {}
    for number in range(images):
        own = settle_line(of_image(points, number), line.ends_px)
        if own is not None and own.seen >= SEEN_SHARE:
            shown[number] = own
    if 2 * len(shown) < images:
        return f"its line is visible along {100.0 * line.seen:.0f} % of it"
    ends_px = np.array([own.ends_px for own in shown.values()])
    within_px2 = np.mean([own.covariance_px2.diagonal() for own in shown.values()], axis=0)
    return EdgeLines(seen, line, tuple(shown), ends_px, within_px2)


def _closure_px(viewer: Viewer, images: Sequence[TeachingImage], arrays: TaughtEdges) -> float:
    """Largest distance (px) of the gripper from where it stands in images measured with what they taught."""
    worst_px, refused_px = 0.0, 0.0
    refused: ImageRefused | None = None
    for image in images:
        found = viewer.measured(image, arrays)
        xi = perturbation_between(found.cam_T_grip, viewer.stands(image))
        away_px = found.prediction.moved_px(xi) if found.trusted else math.inf
        explained = xi @ np.linalg.solve(found.covariance[:6, :6], xi) <= GATE_SQUARE
        worst_px = max(worst_px, away_px)
        if away_px > max(CLOSED_PX, refused_px) and not (found.trusted and explained):
            shows = f"appears {away_px:.2f} px off the reference" if found.trusted else "isn't found"
            why = f"measured with the taught edges the gripper {shows}; at most {CLOSED_PX:g} px: images in focus, "
            refused, refused_px = ImageRefused(image, f"{why}without motion, the fingers free"), away_px
    if refused is not None:
        raise refused
    return worst_px


def _corners(viewer: Viewer, arrays: TaughtEdges, jaw_opening_m: float) -> dict[str, TaughtCorner]:
    """Where taught edges meet in the image: weighted least squares of their offsets at the corner."""
    gripper, camera = viewer.gripper, viewer.rig.camera
    points_grip_m = gripper.points_grip_m(jaw_opening_m)
    points_cam_m = points_grip_m @ viewer.ref_cam_T_grip[:3, :3].T + viewer.ref_cam_T_grip[:3, 3]
    uv_px, d_uv = camera.project_with_jacobian(points_cam_m)
    corners = {}
    for number, point in enumerate(gripper.corner_points.tolist()):
        edges = gripper.edges_at_corner(number)
        edges = edges[arrays.known[edges]]
        if len(edges) < 2:
            continue
        ends = gripper.edge_points[edges]
        gradient = d_uv[point] @ viewer.ref_cam_T_grip[:3, :3]
        tangent = (points_grip_m[ends[:, 1]] - points_grip_m[ends[:, 0]]) @ gradient.T
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
        per_m = np.linalg.norm(normal @ gradient, axis=1)
        shift_m = arrays.shift_at_m(edges, (ends[:, 1] == point).astype(float))
        offset_px = np.einsum("ei,ei->e", normal @ gradient, shift_m)
        weighted = normal.T / np.square(per_m * arrays.sigma_m[edges])
        if np.linalg.cond(weighted @ normal) > _LARGEST_CONDITION:
            continue
        covariance = np.linalg.inv(weighted @ normal)
        u, v = (uv_px[point] + covariance @ weighted @ offset_px).tolist()
        corners[gripper.corner_ids[number]] = TaughtCorner(
            uv_px=(round(u, 4), round(v, 4)),
            sigma_px=round(float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])), 4),
        )
    return corners


_LARGEST_CONDITION = 100.0  # edges that meet at less than about 11° form no corner


def _notes(viewer: Viewer, lines: Mapping[int, EdgeLines], images: int, doubt: str | None) -> tuple[str, ...]:
    """Doubts about what was taught."""
    notes = [] if doubt is None else [doubt]
    found = {index: edge.line for index, edge in lines.items() if edge.line is not None and not viewer.crease[index]}
    rivals = {index: line.rival_px for index, line in found.items() if line.rival_px is not None}
    if rivals and images == 1:
        named = ", ".join(f"{viewer.gripper.edge_ids[i]} ({px:+.1f} px)" for i, px in rivals.items())
        notes.append(f"another line runs beside {named}: teach from several images with different backgrounds")
    return tuple(notes)


STRAY_PROBABILITY = 1e-3
"""Of a note about an edge in a teaching in which none strays."""


def _strays(viewer: Viewer, lines: Mapping[int, EdgeLines], edges: Mapping[str, TaughtEdge]) -> list[str]:
    """Edges that appear farther beside the others of their kind, outlines or creases, than bevels differ by chance:
    another line may have been taken for them.
    """
    names = viewer.gripper.edge_ids
    of_kind: dict[str, dict[int, float]] = {"outlines": {}, "creases": {}}
    for index, edge in lines.items():
        if edge.images:
            own, kind = edges[names[index]], "creases" if edges[names[index]].crease else "outlines"
            # Towards the finger, as bevels move all outlines alike.
            side = float(viewer.inside[index]) if kind == "outlines" else 1.0
            of_kind[kind][index] = side * float(np.mean(own.offset_m))
    notes = []
    for kind, own_m in of_kind.items():
        values_m = np.array([*own_m.values(), 0.0])
        middle_m = float(np.median(values_m))
        usual_m = max(1.4826 * float(np.median(np.abs(values_m - middle_m))), PLAUSIBLE_OWN_M)
        for index, away_m in ((index, abs(m - middle_m)) for index, m in own_m.items()):
            if away_m > usual_m * norm.isf(0.5 * STRAY_PROBABILITY / len(own_m)):
                px = lines[index].sampled.per_m * away_m
                notes.append(
                    f"{names[index]} appears {1e3 * away_m:.2f} mm ({px:.1f} px) beside the other {kind}, which differ "
                    f"by {1e3 * usual_m:.2f} mm: another line may have been taken for it; see it in --picture"
                )
    return notes


AGREEING_SHARE = 0.95
"""Least part of the edge points of all images that must have the same side brighter."""


def _brighter(edge: EdgeLines) -> Literal["left", "right", "any"]:
    """The brighter side of an edge in all images; any where they don't agree."""
    assert edge.line is not None
    right = float(np.mean(edge.sampled.points.step[edge.line.inlier] > 0.0))
    return "right" if right >= AGREEING_SHARE else "left" if right <= 1.0 - AGREEING_SHARE else "any"
