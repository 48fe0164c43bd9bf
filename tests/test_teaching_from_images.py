"""What teaching is for: a gripper file made of images is known no worse once its edges are taught from these."""

from __future__ import annotations

import numpy as np
import pytest
from support.changing_backgrounds import CAMERA, images_of, moving_robot
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.judge.policy import PolicySettings
from gripmon.model.provenance import Provenance
from gripmon.model.records import ReferenceRecord, ValidBy
from gripmon.model.response import Response
from gripmon.monitor import MonitorSettings
from gripmon.teach.from_images import gripper_from_images
from gripmon.teach.kept import as_frames, kept
from gripmon.teach.measure import teach
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig
from gripmon.track.edges.taught import TaughtEdges, own_covariance

IMAGES = 12


def monitor_settings(response: Response) -> MonitorSettings:
    policy = PolicySettings(valid_by=ValidBy.REFERENCE, alert_limit_m=3e-3, alert_limit_rad=0.1)
    return MonitorSettings(policy=policy).with_response(response)


@pytest.mark.parametrize("response", ["linear", "unknown"])
def test_bounds_of_the_images_taught_from_are_no_larger_than_before(response: Response):
    images = images_of(moving_robot(4))[:IMAGES]
    distance_m = float(nominal_cam_T_grip()[2, 3]), 0.005
    made = gripper_from_images(images, PAPER_LENS, distance_m=distance_m, response=response)
    file = made.reference(Provenance(gripmon="", time="", command=""))
    assert file.with_gripper and file.response == response
    # Each edge says how well it is known: that of the outline's median vertex, 0.06 px, is 8 µm here.
    widths_m = [edge.bevel_m for edge in made.model.edges.values() if edge.kind == "contour"]
    assert 2e-6 < np.median(widths_m) / 12.0**0.5 < 2e-5
    reference = ReferenceRecord("own", 0, 0, "configuration", file.cam_T_grip, file.covariance, with_gripper=True)
    rig = Rig(CAMERA, made.gripper, monitor_settings(response))
    frames = [TeachingImage(image, made.gripper.jaw_nominal_m, f"{k}.png") for k, image in enumerate(images)]
    found = teach(rig, reference, frames)
    shown = found.reference_offset, found.reference_covariance
    own = own_covariance(reference, made.gripper)
    taught = TaughtEdges.of(found.edges, made.gripper, made.cam_T_grip, None, own, *shown)
    before, after = (kept(each, reference, as_frames(frames)).sizes for each in (rig, rig._replace(taught=taught)))
    assert before.median_m is not None and after.median_m is not None
    assert after.median_m <= before.median_m and after.median_rad <= before.median_rad
