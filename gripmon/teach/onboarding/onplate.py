"""One image of a gripper that stands on a plate -> ``cam_T_grip``: with a gripper that is known, or one that isn't."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gripmon.calibrate.bundle import GivenCamera, plate_pose
from gripmon.calibrate.plane import Coincidence, KnownCorners, calibrate_plane
from gripmon.calibrate.plane_average import PlaneCalibration, against
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.camera import make_camera
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.provenance import Provenance
from gripmon.model.records import Array, Image
from gripmon.model.targets import Target
from gripmon.teach.onboarding.measuring import (
    check_rough,
    contact_height_m,
    measure_known,
    measure_outlines,
    rough_pose,
)
from gripmon.teach.onboarding.outlines import Outline, inferred_model, outlines_of, points_in_gripper
from gripmon.teach.onboarding.plate_print import plate_print

Rough = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Look:
    """What an image gives.  ``missing``: corners that were wanted and not measured, and why; ``outline_px`` (p, 2) the
    points of an inferred gripper's ``outline`` in the image.
    """

    coincidence: Coincidence
    missing: dict[str, str] = field(default_factory=dict)
    outline: Outline | None = None
    outline_px: Array | None = None


@dataclass(frozen=True, slots=True)
class KnownGripper:
    """Calibrates with a gripper file, at one jaw opening (nominal if None); ``expected_cam_T_grip`` (4, 4) is a rough
    calibration, if there is one.
    """

    camera: GivenCamera
    gripper: Gripper
    jaw_opening_m: float | None = None
    expected_cam_T_grip: Array | None = None

    def check_names(self, rough: Rough) -> None:
        """Raise :class:`CalibrationError` for rough corners that the gripper doesn't have, or too few of them."""
        check_rough(self.gripper, rough)

    def look(self, image: Image, sighting: Sighting, rough: Rough | None) -> Look:
        """``rough`` corners choose which ones are taken; without them all are, and they are expected where the rough
        calibration has them.  Raises :class:`CalibrationError`.
        """
        camera, contact_m = make_camera(self.camera.lens), contact_height_m(self.gripper, self.jaw_opening_m)
        expected = self.expected_cam_T_grip
        if rough is not None:
            cam_T_plate = plate_pose(self.camera.lens, sighting)[0]
            expected = rough_pose(camera, self.gripper, cam_T_plate, rough, self.jaw_opening_m, contact_m)
        if expected is None:
            raise CalibrationError("nothing says where the gripper is in the image; rough corners, or a calibration")
        corners, missing = measure_known(camera, self.gripper, image, expected, self.jaw_opening_m, rough)
        points_m = self.gripper.points_grip_m(self.jaw_opening_m)
        places = [self.gripper.point_ids.index(name) for name in corners.names]
        found = calibrate_plane(self.camera, sighting, corners, KnownCorners(points_m[places], contact_m))
        if self.expected_cam_T_grip is not None:
            turned = against(found.cam_T_grip, self.expected_cam_T_grip)
            if turned is not None:
                raise CalibrationError(turned)
        return Look(found, missing)


@dataclass(frozen=True, slots=True)
class UnknownGripper:
    """Calibrates with rough outlines alone; the gripper comes out, too.  ``target``: the plate, whose print is told
    from the fingers then.
    """

    camera: GivenCamera
    target: Target | None = None

    def look(self, image: Image, sighting: Sighting, rough: Rough) -> Look:
        """Raises :class:`CalibrationError`."""
        outline = outlines_of(rough)
        camera = make_camera(self.camera.lens)
        printed = plate_print(camera, plate_pose(self.camera.lens, sighting)[0], sighting, self.target, image)
        corners, snapped = measure_outlines(camera, image, outline, printed)
        found = calibrate_plane(self.camera, sighting, corners, None)
        return Look(found, {}, outline, snapped.points)

    def model(
        self,
        name: str,
        looks: Sequence[Look],
        result: PlaneCalibration,
        jaw_range_m: tuple[float, float] | None,
        jaw_opening_m: float | None,
        provenance: Provenance | None = None,
    ) -> GripperModel:
        """The gripper file: corners from all images jointly, ends of edges by their mean."""
        camera, outline = make_camera(self.camera.lens), looks[0].outline
        assert outline is not None, "an inferred gripper has outlines"
        places = [
            points_in_gripper(camera, outline, look.outline_px, result.cam_T_grip)
            for look in looks
            if look.outline_px is not None and look.outline is not None and look.outline.names == outline.names
        ]
        points_m = np.mean(places, axis=0)
        points_m[list(outline.corners)] = result.corners_m
        return inferred_model(name, outline, points_m, jaw_range_m, jaw_opening_m, provenance)
