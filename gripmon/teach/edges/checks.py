"""Images that can't be taught from: each check raises :class:`TeachingRefused`, with numbers and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gripmon.judge.smoothing import GATE
from gripmon.teach.edges.estimate import SHAPE_M, EdgeLines, motion_off
from gripmon.teach.edges.lines import find_line
from gripmon.teach.edges.views import ImageRefused, TeachingRefused, View, Viewer, sampled

REFERENCE_SIGMAS = 3.0
"""So many standard deviations of the reference and of the reported opening are allowed on top."""

JAW_SIGMAS = 5.0
"""So many standard deviations the seen opening may be from the reported one, as in the monitor."""

NOTED_PX = 1.0
"""A reference that is off by more than this is worth a word: a view turned by 3° makes a twentieth of it an error."""

TAUGHT_SHARE = 0.5
"""Part of the outlines in view, by profiles, that must be seen: with fewer, something hides the gripper."""

LOST_SHARE = 0.25
"""With a smaller part the gripper, or a finger, isn't there."""

AGREEING_PX = 0.5
"""So far the edges of an image may lie from where all images show them, in the median; else something has moved."""

_FEWEST_SHARED = 4


def check_enough(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> None:
    """Refuse a gripper of which too little is seen, on the whole or of one finger."""
    profiles = np.sum([view.prediction.profiles for view in views], axis=0) * ~viewer.crease
    seen = profiles * np.array([e in lines and bool(lines[e].images) for e in range(len(profiles))])
    share = seen.sum() / max(profiles.sum(), 1)
    if share < TAUGHT_SHARE:
        found = "the gripper isn't found: " if share < LOST_SHARE else ""
        raise TeachingRefused(
            f"{found}only {100.0 * share:.0f} % of the outlines in view are seen as lines; at least "
            f"{100.0 * TAUGHT_SHARE:.0f} %: images in focus, at the reference and their jaw openings, the fingers free"
        )
    for finger, name in enumerate(viewer.gripper.finger_ids):
        own = viewer.gripper.edge_finger == finger
        if profiles[own].sum() and seen[own].sum() < LOST_SHARE * profiles[own].sum():
            raise TeachingRefused(f"finger {name} isn't seen; images in focus, all fingers free")


def check_standing(views: Sequence[View], edges: Sequence[int]) -> None:
    """Refuse the image in which the gripper stands farthest from where the others show it: most of its ``edges`` then
    show elsewhere, each looked for in every image by itself.  A few that differ are clutter, or bevels before another
    background.
    """
    if len(views) < 2:
        return
    places_px = np.full((len(views), len(edges)), np.nan)
    for number, view in enumerate(views):
        for k, edge in enumerate(edges):
            seen = sampled([view], edge)
            line = None if seen is None else find_line(seen.points, seen.expected_px, SHAPE_M * seen.per_m)
            if line is not None:
                places_px[number, k] = line.ends_px.mean()
    # By edges that most images show: one that shows nothing says nothing about the others.
    places_px = places_px[:, 2 * np.isfinite(places_px).sum(axis=0) > len(views)]
    enough = np.isfinite(places_px).sum(axis=1) >= _FEWEST_SHARED
    if not enough.any():
        return
    off_px = np.zeros(len(views))
    off_px[enough] = np.nanmedian(np.abs(places_px[enough] - np.nanmedian(places_px, axis=0)), axis=1)
    worst = int(off_px.argmax())
    if off_px[worst] > AGREEING_PX:
        raise ImageRefused(
            views[worst].image,
            f"the gripper shows {off_px[worst]:.1f} px from where it is in the other images; at most {AGREEING_PX:g} "
            "px: images without motion of the camera, each with its own jaw opening",
        )


def check_reference(viewer: Viewer, name: str, lines: Mapping[int, EdgeLines]) -> str | None:
    """Refuse a gripper that stands elsewhere, or opens its jaw otherwise, than the stated deviations allow.

    Each is tried with the other one taken as stated, since together they can hardly be told apart; what leaves less of
    their own to the edges is named first.  What is allowed, but more than a pixel, is returned in words.
    """
    stated = viewer.prior_covariance
    free_pose, free_jaw = stated.copy(), stated.copy()
    free_pose[:6, :6] = np.diag(np.square([0.01] * 3 + [0.1] * 3))
    free_jaw[6, 6] = 0.01**2
    moved, opened = (motion_off(viewer, lines, prior) for prior in (free_pose, free_jaw))
    pose = moved.common[:6]
    pose_square = pose @ np.linalg.solve((moved.common_covariance[:7, :7] + stated)[:6, :6], pose)
    jaw_m, jaw_sigma_m = float(opened.common[6]), float(np.sqrt(opened.common_covariance[6, 6] + stated[6, 6]))
    # Bevels on the inner sides alone look like a wider opening.
    allowed_m = JAW_SIGMAS * jaw_sigma_m + SHAPE_M
    said = []
    if pose_square > GATE:
        said.append(
            f"the gripper is off the reference, {viewer.distance(pose)}, {np.sqrt(pose_square / GATE):.1f} times what "
            f"position_sigma_m and rotation_sigma_rad allow: {viewer.advice(pose)}"
        )
    if viewer.gripper.has_jaw and abs(jaw_m) > allowed_m:
        said.append(
            f"the jaw shows an opening of {viewer.jaw_opening_m + jaw_m:.6f} m, {viewer.jaw_opening_m:.6f} m is "
            f"reported, at most {1e3 * allowed_m:.3f} mm may be between them: the opening corrected "
            "(timestamps.csv, --jaw-opening), or a larger monitor.jaw_sigma_m"
        )
    if said:
        likelier_first = said if moved.usual_own_m[0] <= opened.usual_own_m[0] else said[::-1]
        raise TeachingRefused(f"{name}: {'; or '.join(likelier_first)}")
    away_px = max(float(np.abs(e.sampled.rows[:, :6] @ pose).max()) * e.sampled.per_m for e in lines.values())
    if away_px <= NOTED_PX:
        return None
    return (
        f"the reference is taken at its word, though the gripper shows up to {away_px:.1f} px beside it, "
        f"{viewer.distance(pose)}; taught there it holds over a wider range: {viewer.pose(pose)}"
    )


def check_edges(viewer: Viewer, views: Sequence[View], lines: Mapping[int, EdgeLines]) -> None:
    """Refuse edges that lie farther from the reference than a bevel and the stated deviations explain."""
    for index, edge in lines.items():
        if not edge.images:
            continue
        allowed_px = viewer.allowed_px(views[edge.images[0]], index, SHAPE_M, REFERENCE_SIGMAS)
        away_px = float(np.abs(edge.mean_px).max())
        if away_px > allowed_px:
            raise TeachingRefused(
                f"edge {viewer.gripper.edge_ids[index]} shows {away_px:.1f} px "
                f"({1e3 * away_px / edge.sampled.per_m:.2f} mm) from the reference; at most {allowed_px:.1f} px, which "
                "a bevel and the standard deviations of reference and jaw explain: correct the gripper file"
            )
