"""One teaching image against the reference: whether the gripper is there, and the edge points near its edges."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from gripmon.model.geometry import from_record, invert, perturb, perturbation_between, to_record
from gripmon.model.records import Array, Image, ReferenceRecord
from gripmon.monitor.tracker import USUAL_SHARE
from gripmon.teach.inset import finger_side
from gripmon.teach.lines import EdgePoints
from gripmon.teach.visibility import Rig
from gripmon.track.edges import FingertipMeter, Measurement, Patience
from gripmon.track.edges.prediction import EdgeLayout, Prediction, lay_out, predict
from gripmon.track.edges.profiles import (
    Candidates,
    estimate_noise,
    find_candidates,
    full_scale,
    profile_offsets_px,
    quantum,
    read_profiles,
)
from gripmon.track.edges.taught import TaughtEdge, TaughtEdges, sight_axes

_CLEAR_SHARE = 0.9  # inlier ratio where the gripper was expected; below it it is searched for elsewhere
_DENSE = 4096  # search lines: as many as there are pixels along the edges
REMEDIES = "images at the reference; or correct gripper file or jaw opening; or calibrate again"
TAKE_MEASURED = f"{REMEDIES}, or take the measured pose"
MOST_BEND_RAD = math.radians(30.0)
"""Largest angle of an edge from the straight line between its ends with which it is taught: offsets across that line
are taught, linear along the edge, of which cos 30 degrees, 87 %, is across the edge where it bends most."""
EVERYWHERE = Patience(when_doubtful=True, when_lost=True)
NARROW = Patience(when_doubtful=False, when_lost=False)


class TeachingRefused(ValueError):
    """These images can't be taught from; the text is ``what is wrong; what would be right``, ``notes`` the rest."""

    def __init__(self, text: str, notes: Sequence[str] = ()):
        super().__init__(text)
        self.notes = tuple(notes)


class ImageRefused(TeachingRefused):
    """This image can't be taught from; others may be."""

    def __init__(self, image: TeachingImage, why: str, notes: Sequence[str] = ()):
        super().__init__(f"{image.name}: {why}", notes)
        self.image = image


@dataclass(frozen=True, slots=True)
class TeachingImage:
    """An image at the reference, and the jaw opening reported for it (the nominal one without a jaw); ``play`` (6,):
    the motion from there to where it shows the gripper, m and rad, None for none.
    """

    image: Image
    jaw_opening_m: float
    name: str
    play: Array | None = None


@dataclass(frozen=True, slots=True)
class View:
    """One image, sampled along all edges in view, with their predictions at the reference.

    ``prediction``: from the pose at which it was sampled, with its edge ``candidates``; ``at_reference`` predicts the
    same samples at the reference, but for the image's play, and the reported opening; ``offset_m`` (k,): offset of each
    candidate from there across the line of sight; ``expected_m`` (n,): that of the samples;
    ``per_m`` (n,): px per metre.
    """

    image: TeachingImage
    prediction: Prediction
    candidates: Candidates
    at_reference: Prediction
    offset_m: Array
    expected_m: Array
    per_m: Array


class Viewer:
    """Measures teaching images with one camera, gripper and reference.

    ``crease`` (e,): which edges lie between two visible faces at the reference; ``bent`` (e,): which are too curved to
    be taught; ``inside`` (e,): the side of an edge on which its finger lies (1: to the right when going along it, -1:
    to the left); ``turned`` (i, e): angle (rad) by which the line of sight to an edge differs between an image and the
    mean jaw opening, for which the others hold.
    """

    def __init__(self, rig: Rig, reference: ReferenceRecord, images: Sequence[TeachingImage]):
        self.rig, self.gripper, gripper = rig, rig.gripper, rig.gripper
        sampling, self._jaw_sigma_m = rig.settings.corners.sampling, rig.settings.jaw_sigma_m
        self._reference, self.ref_cam_T_grip = reference, from_record(reference.cam_T_grip)
        self.reference_covariance = np.reshape(reference.covariance, (6, 6))
        self.reach_px = sampling.reach_px
        self._dense = msgspec.structs.replace(sampling, samples=_DENSE, creases=True)
        self.jaw_opening_m = float(np.mean([image.jaw_opening_m for image in images]))
        self.points_grip_m = gripper.points_grip_m(self.jaw_opening_m)
        edges = gripper.edge_view(self.points_grip_m, invert(self.ref_cam_T_grip)[:3, 3])
        self.crease = edges.crease
        self.bent: NDArray[np.bool_] = gripper.edge_bend_rad > MOST_BEND_RAD
        self.inside = finger_side(gripper, self.points_grip_m, self.ref_cam_T_grip, edges)
        _, depth = sight_axes(gripper, self.points_grip_m, self.ref_cam_T_grip)
        openings = [gripper.points_grip_m(image.jaw_opening_m) for image in images]
        across = [sight_axes(gripper, points_grip_m, self.ref_cam_T_grip)[0] for points_grip_m in openings]
        self.turned = np.einsum("nei,ei->ne", across, depth)

    def arrays(self, edges: Mapping[str, TaughtEdge]) -> TaughtEdges:
        """Taught edges as arrays for the measurement."""
        return TaughtEdges.of(edges, self.gripper, self.ref_cam_T_grip, self.jaw_opening_m)

    def measured(
        self,
        image: TeachingImage,
        taught: TaughtEdges | None,
        cam_T_grip: Array | None = None,
        share: float = USUAL_SHARE,
        patience: Patience = NARROW,
    ) -> Measurement:
        """Measure the image as in operation, starting from a pose, where the gripper stands in it if None."""
        rig = self.rig
        meter = FingertipMeter(rig.camera, rig.gripper, rig.settings.corners, rig.settings.jaw_sigma_m, taught)
        here = self.stands(image) if cam_T_grip is None else cam_T_grip
        return meter.measure(image.image, here, image.jaw_opening_m, share, patience)

    def stands(self, image: TeachingImage) -> Array:
        """Where the gripper stands in an image (4, 4): at the reference, but for its play."""
        return self.ref_cam_T_grip if image.play is None else perturb(self.ref_cam_T_grip, image.play)

    def off_reference_px(self, found: Measurement) -> float:
        """Distance in the image between the measured gripper and the reference."""
        return found.prediction.moved_px(perturbation_between(self.ref_cam_T_grip, found.cam_T_grip))

    def fitted(self, image: TeachingImage) -> Measurement | None:
        """Fit the sharp model to the image from the reference; None where it doesn't fit, as with wide bevels."""
        found = self.measured(image, None)
        return found if found.trusted and self.off_reference_px(found) <= self.reach_px else None

    def elsewhere(self, image: TeachingImage) -> Measurement | None:
        """The gripper where the sharp model finds it, if that is clearly farther from the reference than the search
        lines reach; else None.
        """
        found = self.measured(image, None, None, _CLEAR_SHARE, EVERYWHERE)
        if found.trusted:
            # Repeat from there: the first search uses predictions at the reference, where clutter may mislead it.
            found = self.measured(image, None, found.cam_T_grip, _CLEAR_SHARE, EVERYWHERE)
        return found if found.trusted and self.off_reference_px(found) > self.reach_px else None

    def at(self, cam_T_grip: Array, image: TeachingImage) -> Viewer:
        """The same for one image with the reference at another pose (4, 4)."""
        return Viewer(self.rig, msgspec.structs.replace(self._reference, cam_T_grip=to_record(cam_T_grip)), [image])

    def view(
        self, image: TeachingImage, found: Measurement | None, taught: TaughtEdges | None = None, zoom: int = 1
    ) -> View:
        """Sample all edges in view, or those ``taught``, at the density of pixels: at the pose of the fitted sharp
        model, or else where the gripper stands with a ``zoom``.
        """
        cam_T_grip, jaw_opening_m = self.stands(image), image.jaw_opening_m
        if found is not None:
            cam_T_grip, jaw_opening_m, zoom = found.cam_T_grip, found.jaw_opening_m, found.candidates.zoom
        rig, sampling, grey = self.rig, self._dense, image.image
        margins = {"reach_px": zoom * sampling.reach_px, "end_margin_px": zoom * sampling.end_margin_px}
        sampling = msgspec.structs.replace(sampling, **margins)
        layout = lay_out(rig.camera, rig.gripper, cam_T_grip, jaw_opening_m, sampling, taught)
        # Both use the same samples: those that the lens maps from both poses.
        here = self._predict(layout, self.stands(image), image.jaw_opening_m, None, zoom)
        there = self._predict(here.layout, cam_T_grip, jaw_opening_m, taught, zoom)
        if there.layout is not here.layout:
            here = self._predict(there.layout, self.stands(image), image.jaw_opening_m, None, zoom)
        edges = rig.settings.corners.edges
        profiles = read_profiles(grey, there.map_x, there.map_y, edges.response)
        noise = estimate_noise(profiles, quantum(grey))
        candidates = find_candidates(profiles, there.ok, noise, full_scale(grey), edges, zoom)
        per_m = np.sqrt(np.einsum("ni,ni->n", here.jacobian[:, :3], here.jacobian[:, :3]))
        # Edges are nearly straight: a sample's motion along its edge doesn't matter.
        expected_px = np.einsum("ni,ni->n", there.uv_px - here.uv_px, here.normal)
        sample = candidates.sample
        across = np.einsum("ni,ni->n", there.normal, here.normal)
        offset_px = expected_px[sample] + candidates.offset_px * across[sample]
        return View(image, there, candidates, here, offset_px / per_m[sample], expected_px / per_m, per_m)

    def _predict(
        self, layout: EdgeLayout, cam_T_grip: Array, jaw_opening_m: float, taught: TaughtEdges | None, zoom: int
    ) -> Prediction:
        offsets_px = zoom * profile_offsets_px(self.reach_px)
        return predict(self.rig.camera, self.gripper, layout, cam_T_grip, jaw_opening_m, offsets_px, True, taught)

    def allowed_px(self, view: View, edge: int, shape_m: float, sigmas: float) -> float:
        """Largest allowed distance of an edge from the reference: a bevel's offset plus a number of standard deviations
        of the reference and the reported opening; at most the reach of the search lines.
        """
        here = view.at_reference
        mine = here.layout.edge == edge
        rows = here.jacobian[mine, :6]
        variance = np.einsum("ni,ij,nj->n", rows, self.reference_covariance, rows).max()
        variance += np.square(self._jaw_sigma_m * here.jacobian[mine, 6]).max()
        bevel_m = max(shape_m, float(self.gripper.edge_bevel_m[edge]))
        return min(bevel_m * view.per_m[mine].max() + sigmas * math.sqrt(variance), self.reach_px)

    @property
    def prior_covariance(self) -> Array:
        """Covariance (7, 7) of the reference and the reported opening, the latter at least 1 µm, for "exact"."""
        out = np.zeros((7, 7))
        out[:6, :6] = self.reference_covariance
        out[6, 6] = max(self._jaw_sigma_m, 1e-6) ** 2
        return out

    def distance(self, motion: Array) -> str:
        """A motion (6 or 7,) of the reference, as a text."""
        x, y, z = (1e3 * motion[:3]).tolist()
        return f"by ({x:.3f}, {y:.3f}, {z:.3f}) mm and {np.degrees(np.linalg.norm(motion[3:6])):.3f}°"

    def pose(self, motion: Array, covariance: Array) -> str:
        """The reference after a motion (6,) with the covariance (6, 6), as written in a configuration."""
        there = to_record(perturb(self.ref_cam_T_grip, motion))
        translation_m = [round(v, 7) for v in there.translation_m]
        rotation_xyzw = [round(v, 8) for v in there.rotation_xyzw]
        sigma = np.sqrt(covariance.diagonal())
        return (
            f"reference: {{cam_T_grip: {{translation_m: {translation_m}, rotation_xyzw: {rotation_xyzw}}}, "
            f"position_sigma_m: {sigma[:3].max():.2g}, rotation_sigma_rad: {sigma[3:].max():.2g}}}"
        )

    def measured_note(self, motion: Array, covariance: Array) -> str:
        """The note with the pose to take for a reference with an error of a motion (6,), known with the covariance
        (6, 6), which bevels have to be part of.
        """
        return f"note: the measured pose with its standard deviations: {self.pose(motion, covariance)}"


class SampledEdge(NamedTuple):
    """One edge in all images: its edge points, the fractions of the edge between which it was sampled (medians over all
    images), px per metre, the expected line (2,), px, and ``rows`` (2, 7), derivatives at both ends by the unknowns, m.
    """

    points: EdgePoints
    share: tuple[float, float]
    per_m: float
    expected_px: Array
    rows: Array


def sampled(views: Sequence[View], edge: int) -> SampledEdge | None:
    """Everything seen of one edge; None if no image samples it."""
    spans, scales, expected, rows, profiles = [], [], [], [], []
    parts: list[tuple[Any, ...]] = []
    before = 0
    for number, view in enumerate(views):
        layout, candidates = view.prediction.layout, view.candidates
        mine = np.flatnonzero((layout.edge == edge) & view.prediction.ok)
        profiles.append(len(mine))
        if len(mine) > 1:
            ends = mine[[0, -1]]
            spans.append(layout.fraction[ends])
            scales.append(view.per_m[mine].mean())
            expected.append(view.expected_m[ends])
            rows.append(view.at_reference.jacobian[ends] / view.per_m[ends, None])
        own = np.flatnonzero(layout.edge[candidates.sample] == edge)
        sample = candidates.sample[own]
        image = np.full(len(own), number)
        parts.append((layout.fraction[sample], view.offset_m[own], candidates.step[own], before + sample, image))
        before += len(layout.edge)
    if not spans:
        return None
    low, high = np.median(spans, axis=0).tolist()
    per_m = float(np.mean(scales))
    fraction, offset_m, step, profile, image = (np.concatenate(part) for part in zip(*parts, strict=True))
    way = (fraction - low) / (high - low)
    points = EdgePoints(way, per_m * offset_m, step, profile, image, np.array(profiles))
    return SampledEdge(points, (low, high), per_m, per_m * np.mean(expected, axis=0), np.mean(rows, axis=0))
