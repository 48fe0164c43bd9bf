"""A gripper file from images in front of changing backgrounds; ``gripmon gripper from-images`` calls this.

The images show outlines and inner edges in pixels (:mod:`~gripmon.teach.image_outline`).  Perspective and the jaws'
motion give their positions in space up to scale (:mod:`~gripmon.teach.finger_depth`,
:mod:`~gripmon.teach.image_motion`).  The scale is given, or comes from a calibration or from the openings in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gripmon.model.camera import Camera, LensSettings, make_camera
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.geometry import make_transform
from gripmon.model.gripper import Gripper, GripperError
from gripmon.model.images import NamedImage, images_of_one_camera
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.model.response import in_light, response_of
from gripmon.teach.finger_depth import PlacedOutlines
from gripmon.teach.fingers import Box, UnclearPartsError
from gripmon.teach.image_borders import WELL_SEEN
from gripmon.teach.image_drawing import draw_outlines
from gripmon.teach.image_model import MeasuredGripper, as_gaps, build_model
from gripmon.teach.image_motion import SAME_OPENING_M, WORST_OUTLINE_PX
from gripmon.teach.image_outline import OpeningSeen, see_opening
from gripmon.teach.image_size import Length, Pose, depth_by_openings, size_of, travel_of, unit_notes
from gripmon.teach.matte import FEWEST_IMAGES, STRONG_BLOCKS, blocks, grey_levels, image_sets, smallest_noise
from gripmon.teach.motion_depth import Moved
from gripmon.teach.other_openings import place_and_move
from gripmon.teach.result import GripperResult
from gripmon.teach.vanishing import Outline

MOST_IMAGES = 200


@dataclass(frozen=True, kw_only=True)
class GripperFromImages(GripperResult):
    """A gripper from images with its pose.  ``outline_sigma_px``: median standard deviation of the outline's vertices
    from their scatter over the images; ``left_out``: images that weren't used, and why; ``seen``: what the others show,
    ``shown`` the first of them; ``used``: of each finger the pieces of its outline that are in the file.
    """

    cam_T_grip: Array
    covariance: Array
    outline_sigma_px: float
    left_out: dict[str, str]
    seen: OpeningSeen
    shown: Image
    used: tuple[tuple[tuple[int, int], ...], ...]

    def picture(self) -> Image:
        """The first image used, with outline, scatter and fingers, and what of them isn't in the file; BGR."""
        return draw_outlines(self.shown, self.seen, self.gripper.finger_ids, self.used)

    def values(self) -> dict[str, Any]:
        """The result as plain values: m, rad, px."""
        own = {"outline_sigma_px": self.outline_sigma_px, "images": self.images, "left_out": self.left_out}
        return {**super().values(), **own}

    def about(self) -> list[str]:
        """How well the outline is known, and which images weren't used."""
        known = f"outline known to {self.outline_sigma_px:.3f} px (median), by {self.images} images"
        return [known, *(f"left out: {file}: {why}" for file, why in self.left_out.items())]


def gripper_from_images(
    images: Sequence[str | Path | NamedImage | Image],
    camera: LensSettings,
    *,
    openings_m: Sequence[float | None] | None = None,
    distance_m: Length | None = None,
    finger_width_m: Length | None = None,
    reference: Pose | None = None,
    jaw_range_m: tuple[float, float] | None = None,
    fingers: int | None = None,
    within: Sequence[Box] = (),
    name: str = "gripper",
    provenance: Provenance | None = None,
    response: str = "auto",
    progress: Progress = quiet,
) -> GripperFromImages:
    """A gripper and its reference from five to some hundred ``images`` in front of changing backgrounds.

    ``openings_m``: the jaw's opening in each image (None: images of one opening are recognised by themselves); an
    opening with fewer than five images isn't used.  ``fingers``: how many are seen, 1 or 2 (default: 2, and anything
    else is refused); ``within``: where in the
    image they are, or a box (left, top, right, bottom), px, for each.  The scale comes from
    ``distance_m`` (of the fingertips from the camera, along the optical axis), ``finger_width_m`` (of a fingertip,
    across the jaws), a ``reference`` calibration, or from several openings.  ``response``: how grey levels follow the
    light, linear or srgb; auto: as the images show it.

    Raises :class:`~gripmon.model.errors.InputError` for wrong arguments,
    :class:`~gripmon.model.errors.NoResultError` where the images show no gripper.
    """
    _check(distance_m, finger_width_m, reference, openings_m, len(images))
    _check_range(jaw_range_m, openings_m)
    made = make_camera(camera)
    taken = list(images_of_one_camera(images, (camera.width_px, camera.height_px)))
    least = smallest_noise(taken[0][1])
    light = response_of([image for _, image in taken], response, openings_m)
    grey = [grey_levels(in_light(image, light.response)) for _, image in taken]
    # Which images are of one opening shows in grey levels as stored: in light, edges on dark fingers are faint.
    stored = grey if light.response != "srgb" else (grey_levels(image) for _, image in taken)
    groups = _groups(openings_m, stored)
    notes = [*light.notes]
    left_out: dict[str, str] = {}
    hint = _compressed([image for _, image in taken[::10]])
    notes += [hint] if hint else []
    with progress(None, "step") as step:
        see = partial(see_opening, made, least_noise=least, step=step, fingers=fingers, within=within)
        every = _see_openings(see, grey, groups, [file for file, _ in taken], notes, left_out, hint)
        pose = None if reference is None else reference[0]
        first, seen, around, outlines, placed, motion, more = _in_space(made, every, reference, openings_m is not None)
        if seen.rest.any():
            notes.append("what joins the fingers, or stays elsewhere in the image, isn't used")
        notes += more
        step()
    if openings_m is None and around:
        motion.check_opened([len(own) for own in groups.values()])
    opening_m = first if openings_m is not None else None
    by_openings, why = depth_by_openings(motion, opening_m)
    size = size_of(placed, made.fx_px, distance_m, finger_width_m, reference, by_openings, notes)
    scale, moved = (size.depth_m, size.sigma_m), motion.by_opening
    if around and not moved:
        notes.append(f"the file holds one opening, without a jaw: {motion.why or 'the others show too little'}")
    if openings_m is None and moved:
        opening_m, moved = as_gaps(placed, moved, size.depth_m)
        notes.append(
            f"openings: the gap between the fingertips, as the images show it, {1e3 * min(opening_m, *moved):.2f} to "
            f"{1e3 * max(opening_m, *moved):.2f} mm; the jaws may report another number"
        )
    parts = made, seen, outlines, placed, moved, size.depth_m, size.scale_sigma, opening_m, jaw_range_m
    described = MeasuredGripper(*parts)
    try:
        gripper = Gripper(build_model(described, name, provenance, notes))
    except GripperError as error:
        raise NoResultError(f"the gripper in the images can't be tracked: {error}") from None
    if pose is None:
        cam_T_grip = make_transform(placed.rotation, placed.tcp * scale[0])
        covariance = _covariance(made.fx_px, placed, scale, seen)
    else:
        assert reference is not None
        cam_T_grip, covariance = reference
    notes += unit_notes(size, why) if reference is None else []
    notes += [border.words() for border in seen.borders if border.share < WELL_SEEN][:2]
    notes += _assumptions(placed, reference is not None, left_out, len(taken))
    sigmas = np.concatenate([chain.sigma_px for finger in seen.fingers for chain in finger.chains])
    outline_px = float(np.hypot(np.median(sigmas), light.sigma_px))
    if outline_px >= WORST_OUTLINE_PX:
        raise UnclearPartsError(
            f"the outline is known to {outline_px:.1f} px, less than {WORST_OUTLINE_PX:g} px is needed: more images, "
            "each before another background that is brighter or darker than the fingers",
            [finger.mask for finger in seen.fingers],
            seen.matte.still,
            image=groups[first][0],
        )
    rms = np.concatenate([chain.rms_px for finger in seen.fingers for chain in finger.chains])
    used = len(seen.matte.kept)
    shown = taken[groups[first][seen.matte.kept[0]]][1]
    rms_px = float(np.sqrt(np.square(rms).mean()))
    return GripperFromImages(
        gripper=gripper, notes=tuple(notes), lens=camera, cam_T_grip=cam_T_grip, covariance=covariance,
        opening_m=opening_m, corners=len(gripper.corner_ids), images=used, rms_px=rms_px,
        rms_m=rms_px * float(cam_T_grip[2, 3]) / camera.fx_px, outline_sigma_px=outline_px,
        left_out=left_out, seen=seen, shown=shown, used=placed.kept, with_gripper=reference is None,
        response=light.response,
    )  # fmt: skip


def _see_openings(
    see: Callable[[Sequence[NDArray[np.float32]]], OpeningSeen],
    grey: Sequence[NDArray[np.float32]],
    groups: Mapping[float, list[int]],
    files: Sequence[str],
    notes: list[str],
    left_out: dict[str, str],
    hint: str,
) -> dict[float, OpeningSeen]:
    """What the images of the first opening show, and of each other opening with enough images; adds to ``notes`` and
    ``left_out``.  ``hint``: what refusals end with.
    """
    seen: dict[float, OpeningSeen] = {}
    for opening, own in groups.items():
        if seen and len(own) < FEWEST_IMAGES:
            notes.append(f"opening {opening:g} m: {len(own)} images aren't used; {FEWEST_IMAGES} or more")
            continue
        try:
            seen[opening] = see([grey[k] for k in own])
        except NoResultError as refused:
            if isinstance(refused, UnclearPartsError):
                refused.image = own[0]
            if hint:
                refused.args = (f"{refused}; {hint}",)
            if len(groups) > 1:
                of = f"{len(own)} of {len(files)} images show one opening, from {files[own[0]]} to {files[own[-1]]}"
                refused.args = (f"{of}; of them {refused}",)
            raise
        left_out.update({files[own[k]]: why for k, why in seen[opening].left_out.items()})
    return seen


class _InSpace(NamedTuple):
    """The outlines that the images of the ``first`` opening show, where they are up to scale, and how they move to the
    openings ``around``; ``notes`` on that.
    """

    first: float
    seen: OpeningSeen
    around: Mapping[float, OpeningSeen]
    outlines: list[Outline]
    placed: PlacedOutlines
    motion: Moved
    notes: list[str]


def _in_space(camera: Camera, every: Mapping[float, OpeningSeen], reference: Pose | None, in_metres: bool) -> _InSpace:
    """Of ``every`` opening the first whose outlines are seen to move to the others, since what fingers hide of each
    other, or of a palm, differs; the first one where none is, and of openings that nobody told (not ``in_metres``).
    """
    found: _InSpace | None = None
    at = None if reference is None else (reference[0][:3, :3], reference[0][:3, 3] / reference[0][2, 3])
    for first, seen in every.items():
        notes, around = list[str](), {opening: other for opening, other in every.items() if opening != first}
        travel = None if reference is None or not in_metres else travel_of(reference, [first, *around])
        try:
            outlines, placed, motion = place_and_move(camera, seen, around, pose=at, travel=travel, notes=notes)
        except NoResultError:
            if found is None:
                raise
            continue
        now = _InSpace(first, seen, around, outlines, placed, motion, notes)
        if motion.by_opening or not in_metres:
            return now
        found = found or now
    assert found is not None
    return found


def _compressed(images: Sequence[Image]) -> str:
    """A hint that images are compressed strongly; empty if they aren't."""
    coarse = blocks([grey_levels(image) for image in images])
    if coarse <= STRONG_BLOCKS:
        return ""
    return (
        f"the images are compressed strongly (steps at the borders of coded blocks are {coarse:.1f} times those "
        "elsewhere): a higher quality, 90 for JPEG"
    )


def _check(
    distance_m: Length | None,
    finger_width_m: Length | None,
    reference: Pose | None,
    openings_m: Sequence[float | None] | None,
    count: int,
) -> None:
    if count < FEWEST_IMAGES:
        raise InputError(f"{count} images; at least {FEWEST_IMAGES}, each in front of another background", "images")
    if count > MOST_IMAGES:
        raise InputError(f"{count} images; at most {MOST_IMAGES}, each in front of another background", "images")
    lengths = {"distance_m": distance_m, "finger_width_m": finger_width_m, "reference": reference}
    given = [key for key, value in lengths.items() if value is not None]
    if len(given) > 1:
        raise InputError("two lengths for one scale; one of distance, finger width and reference", given[1])
    if openings_m is not None:
        if len(openings_m) != count:
            raise InputError(f"{len(openings_m)} for {count} images; one for each", "openings_m")
        if any(opening is None for opening in openings_m):
            raise InputError("some images have one and others don't; of all images or of none", "openings_m")


def _check_range(jaw_range_m: tuple[float, float] | None, openings_m: Sequence[float | None] | None) -> None:
    shown = [opening for opening in openings_m or () if opening is not None]
    if jaw_range_m is not None and shown and not (jaw_range_m[0] <= min(shown) and max(shown) <= jaw_range_m[1]):
        raise InputError(
            f"is {jaw_range_m[0]:g} to {jaw_range_m[1]:g} m, but the images show openings of {min(shown):g} to "
            f"{max(shown):g} m; a range that holds them",
            "jaw_range",
        )


def _groups(openings_m: Sequence[float | None] | None, grey: Iterable[NDArray[np.float32]]) -> dict[float, list[int]]:
    """Indices of the images of each opening: first the widest of those with at least half as many images as any, since
    fingers that are apart hide nothing of each other; then the one with most.  Unknown openings are numbered, the one
    with most images first; for them alone the images are looked at.
    """
    if openings_m is None:
        return {float(k): own for k, own in enumerate(image_sets(list(grey)))}
    order = sorted(range(len(openings_m)), key=lambda k: openings_m[k] or 0.0)
    runs: list[list[int]] = [[order[0]]]
    for k in order[1:]:
        apart = (openings_m[k] or 0.0) - (openings_m[runs[-1][0]] or 0.0)
        if apart <= SAME_OPENING_M:
            runs[-1].append(k)
        else:
            runs.append([k])
    runs.sort(key=lambda run: -len(run))
    if len(runs[0]) < FEWEST_IMAGES:
        raise InputError(
            f"at most {len(runs[0])} images are of one opening; {FEWEST_IMAGES} or more with changing backgrounds, "
            "the jaws at rest",
            "openings_m",
        )
    least = max(FEWEST_IMAGES, 0.5 * len(runs[0]))
    widest = max((run for run in runs if len(run) >= least), key=lambda run: openings_m[run[0]] or 0.0)
    runs = [widest, *(run for run in runs if run is not widest)]
    return {round(float(np.mean([openings_m[k] or 0.0 for k in run])), 6): sorted(run) for run in runs}


def _covariance(fx_px: float, placed: PlacedOutlines, scale: Length, seen: OpeningSeen) -> Array:
    """Covariance (6, 6): from the distance along the line of sight, the outline's scatter across it, and the axes'
    directions.
    """
    depth, sigma = scale
    sigmas = np.concatenate([chain.sigma_px for finger in seen.fingers for chain in finger.chains])
    across = float(np.median(sigmas)) / fx_px * depth
    ray = placed.tcp / placed.tcp[2]
    out = np.zeros((6, 6))
    out[:3, :3] = sigma**2 * np.outer(ray, ray) + across**2 * np.eye(3)
    if placed.tcp_covariance is not None:
        # Of the depth itself the size has it already.
        beside = np.eye(3) - np.outer(ray, [0.0, 0.0, 1.0])
        out[:3, :3] += depth**2 * beside @ placed.tcp_covariance @ beside.T
    out[3:, 3:] = np.diag(placed.sigma_rad**2) + (across / depth) ** 2 * np.eye(3)
    return out


def _assumptions(placed: PlacedOutlines, calibrated: bool, left_out: Mapping[str, str], count: int) -> list[str]:
    """What is unknown or was assumed, as texts."""
    notes = []
    if placed.assumed:
        notes.append(
            "the outline is assumed flat, and the fingers to point away at 35 degrees from the line of sight: their "
            "long edges aren't parallel, or not enough of them show. The tilt's standard deviation of 15 degrees is in "
            "the bounds of motions and of the absolute rotation (tilt_sigma_rad in the gripper file), by which no "
            "transform is valid then: configure monitor.policy.valid_by: reference"
        )
    elif placed.flat:
        notes.append("the outline is assumed to lie in the reference's plane of x and z: its own edges show no other")
    elif not calibrated and len(placed.points) == 1:
        notes.append("the finger's long edges are assumed parallel: a taper would look like another direction of it")
    if placed.by_motion:
        notes.append(
            "depths are from the fingers' motion: both are assumed to move equally far, in opposite directions"
        )
    if placed.round_tips:
        notes.append(
            "round fingertips are assumed to lie in the plane of their sides. Corrections of the camera's tilt, and of "
            "motions of some per cent of the distance, are too small or too large by what they stand out of it"
        )
    if left_out:
        notes.append(f"{len(left_out)} of {count} images left out")
    return notes
