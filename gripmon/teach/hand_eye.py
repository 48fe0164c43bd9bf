"""Hand/eye calibration from images of the gripper, for programs and notebooks: on a plate, or as the monitor sees it.

``gripmon calibrate plane`` and ``verify`` call these functions.  Images are arrays (as OpenCV reads them) or paths.
Wrong input raises :class:`~gripmon.model.errors.InputError`, images from which nothing can be measured
:class:`~gripmon.calibrate.sighting.CalibrationError`; both are one line of text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gripmon.calibrate.bundle import GivenCamera
from gripmon.calibrate.detection import detect
from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.plane import Coincidence, KnownCorners
from gripmon.calibrate.plane import calibrate_plane as calibrate_image
from gripmon.calibrate.plane_average import NOT_IN_COVARIANCE, PlaneCalibration, against, average
from gripmon.calibrate.plate_pose import plate_pose
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.verify import Calibrated, agreeing, mean_of_one_scene
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import from_record, to_record
from gripmon.model.gripper import Gripper, GripperError
from gripmon.model.images import images_of_one_camera
from gripmon.model.progress import Progress, quiet
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Frame, Image, Origin, ReferenceRecord
from gripmon.model.response import in_light, response_of
from gripmon.model.targets import Target, TargetError, parse_target, refuse_other_size, refuse_squares
from gripmon.monitor import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.teach.drawing import draw_on_plate
from gripmon.teach.outline_edges import measure_outlines
from gripmon.teach.outlines import (
    Outline,
    inferred_model,
    measure_known,
    outlines_of,
    points_in_gripper,
    rough_pose,
)
from gripmon.teach.result import GripperResult
from gripmon.track.edges.taught import TaughtEdges

Rough = Mapping[str, tuple[float, float]]
Pose = tuple[Array, Array]
"""``cam_T_grip`` (4, 4) and the covariance (6, 6) of its error."""


@dataclass(frozen=True, slots=True)
class ImageOnPlate:
    """The result of one image.  ``missing``: wanted corners that weren't measured, and why; ``outline`` of an inferred
    gripper, with its points as measured.
    """

    coincidence: Coincidence
    missing: dict[str, str] = field(default_factory=dict)
    outline: Outline | None = None


@dataclass(frozen=True, slots=True)
class KnownGripper:
    """Calibrates with a gripper file, at one jaw opening (nominal if None); ``expected_cam_T_grip`` (4, 4) is a rough
    calibration, if there is one.
    """

    camera: GivenCamera
    gripper: Gripper
    jaw_opening_m: float | None = None
    expected_cam_T_grip: Array | None = None

    def measure(self, image: Image, sighting: Sighting, rough: Rough | None) -> ImageOnPlate:
        """``rough`` corners select the ones to measure; without them all are measured, where the rough calibration
        predicts them.  Raises :class:`CalibrationError`.
        """
        gripper, opening_m, camera = self.gripper, self.jaw_opening_m, make_camera(self.camera.lens)
        points_m = gripper.points_grip_m(opening_m)
        contact_m = float(points_m[:, 2].max())  # it stands on its outermost point along z
        expected = self.expected_cam_T_grip
        if rough is not None:
            cam_T_plate = plate_pose(self.camera.lens, sighting)[0]
            expected = rough_pose(camera, gripper, cam_T_plate, rough, opening_m, contact_m)
        if expected is None:
            raise CalibrationError("the gripper's place in the image is unknown; rough corners, or a calibration")
        corners, missing = measure_known(camera, gripper, image, expected, opening_m, rough)
        places = [gripper.point_ids.index(name) for name in corners.names]
        found = calibrate_image(self.camera, sighting, corners, KnownCorners(points_m[places], contact_m))
        if self.expected_cam_T_grip is not None:
            turned = against(found.cam_T_grip, self.expected_cam_T_grip)
            if turned is not None:
                raise CalibrationError(turned)
        return ImageOnPlate(found, missing)


@dataclass(frozen=True, slots=True)
class UnknownGripper:
    """Calibrates with rough outlines alone, and infers the gripper, too."""

    camera: GivenCamera

    def measure(self, image: Image, sighting: Sighting, rough: Rough | None) -> ImageOnPlate:
        """Raises :class:`CalibrationError`."""
        if rough is None:
            raise InputError("an unknown gripper needs rough corners")
        outline, camera = outlines_of(rough), make_camera(self.camera.lens)
        corners, points = measure_outlines(camera, image, outline)
        found = calibrate_image(self.camera, sighting, corners, None)
        return ImageOnPlate(found, {}, replace(outline, points=points))


@dataclass(frozen=True, slots=True)
class HandEyeOnPlate:
    """``fit`` of all images together; ``images``: the result of each; ``not_used``: images without a result, and why;
    ``notes``: what was assumed; ``shown``: the first image used.
    """

    fit: PlaneCalibration
    method: KnownGripper | UnknownGripper
    images: tuple[ImageOnPlate, ...]
    not_used: tuple[str, ...]
    notes: tuple[str, ...]
    shown: Image

    @property
    def cam_T_grip(self) -> Array:
        """The calibrated pose (4, 4)."""
        return self.fit.cam_T_grip

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of its error by noise, camera and print, not by bevels: position of the TCP, then rotation,
        camera axes.
        """
        return self.fit.covariance

    @property
    def inferred(self) -> bool:
        """Whether the gripper is inferred from the same images."""
        return isinstance(self.method, UnknownGripper)

    def result(
        self,
        name: str = "gripper",
        jaw_range_m: tuple[float, float] | None = None,
        jaw_opening_m: float | None = None,
        provenance: Provenance | None = None,
    ) -> GripperResult:
        """The known gripper, or the one inferred from the images (``jaw_range_m``: the range of its jaw), where it
        stands.
        """
        known = self.method.gripper if isinstance(self.method, KnownGripper) else None
        gripper = known or self._inferred(self.method.camera, name, jaw_range_m, jaw_opening_m, provenance)
        opening_m = self.method.jaw_opening_m if isinstance(self.method, KnownGripper) else None
        if opening_m is None and gripper.has_jaw:
            opening_m = gripper.jaw_nominal_m
        return GripperResult(
            gripper=gripper, notes=self.fit.warnings, lens=self.method.camera.lens, cam_T_grip=self.fit.cam_T_grip,
            covariance=self.fit.covariance, opening_m=opening_m, rms_m=self.fit.rms_m, rms_px=self.fit.rms_px,
            corners=sum(len(image.corners.names) for image in self.fit.images), images=len(self.fit.images),
        )  # fmt: skip

    def _inferred(
        self,
        given: GivenCamera,
        name: str,
        jaw_range_m: tuple[float, float] | None,
        jaw_opening_m: float | None,
        provenance: Provenance | None,
    ) -> Gripper:
        outlines = [image.outline for image in self.images if image.outline is not None]
        outline, camera = outlines[0], make_camera(given.lens)
        # Corners from all images jointly, ends of edges as their mean.
        alike = [one.points for one in outlines if one.names == outline.names]
        points_m = np.mean([points_in_gripper(camera, outline, uv_px, self.cam_T_grip) for uv_px in alike], axis=0)
        points_m[list(outline.corners)] = self.fit.corners_m
        try:
            return Gripper(inferred_model(name, outline, points_m, jaw_range_m, jaw_opening_m, provenance))
        except GripperError as error:
            raise CalibrationError(f"the corners don't form a gripper: {error}") from None

    def values(self) -> dict[str, Any]:
        """The result as plain values: m, rad, px."""
        fit, transform = self.fit, to_record(self.cam_T_grip)
        out: dict[str, Any] = {
            "cam_T_grip": {"translation_m": transform.translation_m, "rotation_xyzw": transform.rotation_xyzw},
            "covariance": fit.covariance.ravel().tolist(),
            "not_in_covariance": NOT_IN_COVARIANCE,
            "rms_m": fit.rms_m,
            "rms_px": fit.rms_px,
            "consistency_p": fit.consistency_p,
            "warnings": fit.warnings,
            "images": [_image_values(image) for image in self.images],
        }
        if self.inferred:
            out["sides_m"] = (2.0 * fit.corners_m[3, :2]).tolist()
            out["sides_sigma_m"] = (fit.lengths_covariance.diagonal()[:2] ** 0.5).tolist()
        return out

    def calibrated(self, name: str = "images") -> Calibrated:
        """What :func:`gripmon.calibrate.api.verify` compares."""
        flat = tuple(self.covariance.ravel().tolist())
        transform = to_record(self.cam_T_grip)
        return Calibrated(name, "images", self.method.camera.lens, cam_T_grip=transform, covariance=flat)

    def picture(self) -> Image:
        """The first image with its residuals, enlarged; BGR."""
        return draw_on_plate(self.shown, self.method.camera.lens, self.images[0].coincidence)


def _image_values(seen: ImageOnPlate) -> dict[str, Any]:
    image = seen.coincidence
    sigma_px = (image.corners.covariance_px.diagonal() ** 0.5).reshape(-1, 2)
    rows = zip(image.corners.names, image.corners.uv_px, sigma_px, image.residuals_m, strict=True)
    return {
        "image": image.sighting.name,
        "plate_points": int(image.plate.used[0].sum()),
        "plate_points_left_out": int((~image.plate.used[0]).sum()),
        "plate_rms_px": image.plate.rms_px,
        "corners": {
            name: {"uv_px": uv.tolist(), "sigma_px": sigma.tolist(), "residual_m": residual.tolist()}
            for name, uv, sigma, residual in rows
        },
        "missing": seen.missing,
        "residuals_p": image.p_value,
        "tilt_rad": None if image.tilt_rad is None else image.tilt_rad.tolist(),
        "gap_m": image.gap_m,
        "tilt_gap_sigma": None if image.apart_sigma is None else image.apart_sigma.tolist(),
        "tilt_gap_p": image.apart_p,
    }


def calibrate_plane(
    images: Sequence[str | Path | Image],
    camera: GivenCamera | CameraCalibration | LensSettings,
    gripper: Gripper | None,
    target: Target | str,
    *,
    corners: Rough | Sequence[Rough] | None = None,
    jaw_opening_m: float | None = None,
    cam_T_grip: Array | None = None,
    other_target: bool = False,
    response: str = "auto",
    progress: Progress = quiet,
) -> HandEyeOnPlate:
    """``cam_T_grip`` from images of the gripper standing on a calibration plate (the Plane Coincidence Constraint).

    Where to look for the gripper: rough ``corners`` (name: (u, v) in px; for all images or for each), or a rough
    calibration ``cam_T_grip`` (4, 4).  Without a ``gripper`` it is inferred from its innermost corners, named as in
    :func:`gripmon.teach.outlines.outlines_of`.  ``jaw_opening_m`` is that in the images; nominal if None.
    ``response``: how grey levels follow the light, linear or srgb; auto: as the images show it.
    :class:`~gripmon.model.targets.TargetError` for a chequerboard or ChArUco board without a gripper,
    :class:`~gripmon.model.targets.OtherSizeError` for the pattern of the camera's target in another size, unless
    ``other_target`` confirms it.
    """
    target = parse_target(target) if isinstance(target, str) else target
    given = _given(camera)
    if gripper is None:
        refuse_squares(target)
    refuse_other_size(target, None if other_target else given.target)
    method = (
        UnknownGripper(given)
        if gripper is None
        else KnownGripper(given, gripper, checked_opening(gripper, jaw_opening_m), cam_T_grip)
    )
    taken = list(images_of_one_camera(images, (given.lens.width_px, given.lens.height_px)))
    light = response_of([image for _, image in taken], response)
    used: list[ImageOnPlate] = []
    shown: Image | None = None
    not_used = []
    with progress(len(taken), "image") as step:
        for (name, image), rough in zip(taken, _for_each(corners, len(taken)), strict=True):
            try:
                lit = in_light(image, light.response)
                used.append(method.measure(lit, _sighting(image, target, name), rough))
                shown = image if shown is None else shown
            except CalibrationError as error:
                not_used.append(f"{name}: {error}")
            step()
    if shown is None:
        more = f" (and {len(not_used) - 1} more images)" if len(not_used) > 1 else ""
        raise CalibrationError(f"{not_used[0]}{more}")
    fit = average([image.coincidence for image in used], gripper is None)
    sigma_m = light.sigma_px * float(fit.cam_T_grip[2, 3]) / given.lens.fx_px
    fit = replace(fit, covariance=fit.covariance + np.diag([sigma_m**2] * 3 + [0.0] * 3))
    notes = (*_notes(method, jaw_opening_m), *light.notes)
    return HandEyeOnPlate(fit, method, tuple(used), tuple(not_used), notes, shown)


def _given(camera: GivenCamera | CameraCalibration | LensSettings) -> GivenCamera:
    if isinstance(camera, GivenCamera):
        return camera
    if isinstance(camera, CameraCalibration):
        return GivenCamera.calibrated(camera)
    return GivenCamera(camera)


def checked_opening(gripper: Gripper, opening_m: float | None) -> float | None:
    """The jaw opening, None: the nominal one; None for a gripper without jaw.  Raises :class:`InputError`."""
    if not gripper.has_jaw:
        if opening_m is not None:
            raise InputError(f"{gripper.name} has no jaw; leave it out", "jaw_opening_m")
        return None
    if opening_m is None:
        return gripper.jaw_nominal_m
    if not gripper.jaw_min_m <= opening_m <= gripper.jaw_max_m:
        span = f"{gripper.jaw_min_m:g} to {gripper.jaw_max_m:g} m"
        raise InputError(f"{opening_m:g}: the gripper's is {span}", "jaw_opening_m")
    return opening_m


def _notes(method: KnownGripper | UnknownGripper, given_m: float | None) -> tuple[str, ...]:
    notes = []
    if isinstance(method, KnownGripper) and method.gripper.has_jaw and given_m is None:
        notes.append(f"jaw opening assumed to be {method.jaw_opening_m:g} m; --jaw-opening M if it was another")
    if not method.camera.parameters:
        notes.append("the camera's uncertainty is unknown: its errors are not in the covariance")
    return tuple(notes)


def _for_each(corners: Rough | Sequence[Rough] | None, images: int) -> Sequence[Rough | None]:
    if corners is None or isinstance(corners, Mapping):
        return [corners] * images
    if len(corners) not in (1, images):
        raise InputError(f"{len(corners)} for {images} images; one for all, or one for each", "corners")
    return list(corners) * (images if len(corners) == 1 else 1)


def _sighting(image: Image, target: Target, name: str) -> Sighting:
    found = detect(image, target, name)
    if isinstance(found, Sighting):
        return found
    if found.larger:
        raise TargetError(f"{name}: {found.reason}; its full size")
    raise CalibrationError(found.reason)


def measure_tracked(
    images: Sequence[str | Path | Image],
    camera: LensSettings,
    gripper: Gripper,
    expected: Pose,
    settings: MonitorSettings | None = None,
    *,
    jaw_opening_m: float | None = None,
    taught_edges: TaughtEdges | None = None,
) -> tuple[Pose, tuple[str, ...]]:
    """``cam_T_grip`` as the monitor measures it in images of one pose in front of different backgrounds, starting at
    the ``expected`` pose; and what is doubtful about it.  Images that contradict the others are left out;
    :class:`CalibrationError` if none can be measured, or no majority agrees.
    """
    taken = list(images_of_one_camera(images, (camera.width_px, camera.height_px)))
    made = make_camera(camera)
    cam_T_grip, covariance = expected
    # Where the camera has moved, a fit that starts at the calibration may end at a wrong pose.  So a second pass starts
    # where most fits ended.
    for _ in range(2):
        found, reasons = {}, []
        for number, (name, image) in enumerate(taken):
            # Each image by itself: a monitor learns from the last frame only for a camera that stands still.
            flat = tuple(covariance.ravel().tolist())
            reference = ReferenceRecord("verify", 0, 0, "configuration", to_record(cam_T_grip), flat)
            monitor = Monitor(made, gripper, settings or MonitorSettings(), reference, taught_edges)
            record = monitor.process(Frame(number, 1_000_000_000 * (number + 1), image, jaw_opening_m, name))
            if record.cam_T_grip is None or record.covariance is None or record.source is Origin.HELD:
                reasons.append(f"{name}: {record.reason or 'the gripper is not seen'}")
                continue
            found[name] = from_record(record.cam_T_grip), np.reshape(record.covariance, (6, 6))
        if not found:
            raise CalibrationError(f"no image can be measured; {reasons[0]}")
        transforms, covariances = zip(*found.values(), strict=True)
        agree = agreeing(transforms, covariances)
        chosen = np.flatnonzero(agree)
        cam_T_grip, covariance = mean_of_one_scene([transforms[k] for k in chosen], [covariances[k] for k in chosen])
    if 2 * len(chosen) <= len(found) and len(found) > 1:
        share = f"only {len(chosen)}" if len(chosen) > 1 else "no two"
        raise CalibrationError(
            f"{share} of {len(found)} images agree on the gripper's pose; images of one pose, in which the "
            "background doesn't hide its edges"
        )
    doubts = [f"left out: {reason}" for reason in reasons]
    doubts += [
        f"left out: {name}: contradicts the other images" for name, kept in zip(found, agree, strict=True) if not kept
    ]
    if len(found) == 1:
        doubts.insert(0, f"{next(iter(found))} alone: nothing confirms it; three images or more are better")
    return (cam_T_grip, covariance), tuple(doubts)
