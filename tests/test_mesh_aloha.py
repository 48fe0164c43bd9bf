"""A gripper from CAD in pictures of its meshes, by another ray caster: knocked, found again, its ends seen.

``support/aloha_from_cad.yaml`` is what ``gripmon gripper from-cad`` made of the meshes of gym-aloha 0.1.5 (Apache 2.0),
closing at 22.5 mm of its joint.  It has edges that other parts hide, and dark ones before dark ones.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.meters import difference

from gripmon.daemon.config import read_gripper
from gripmon.model.camera import BrownConradyLens, Camera, make_camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper
from gripmon.model.records import AlertKind, Frame, FrameRecord, Origin, ReferenceRecord, Transform, Verdict
from gripmon.monitor import Monitor, MonitorSettings
from gripmon.teach.from_images import gripper_from_images
from gripmon.teach.measure import teach
from gripmon.teach.views import TeachingImage
from gripmon.teach.visibility import Rig
from gripmon.track.edges import FingertipMeter, MeasurementSettings, Patience, TaughtEdges
from gripmon.track.edges.settings import EdgeSettings

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "mesh_aloha"
GRIPPER = Path(__file__).parent / "support" / "aloha_from_cad.yaml"
OPENING_M, JUMP, LAST = 0.055, 25, 32
VALID_AGAIN = 5
"""Frames after a knock in which taught fingers are valid again; 20 are demanded."""
SETTINGS = MeasurementSettings(edges=EdgeSettings(response="srgb"))

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data/mesh_aloha is not there")


@cache
def rig() -> tuple[Camera, Gripper, ReferenceRecord]:
    kept = yaml.safe_load((DATA / "hand_eye.yaml").read_text())
    camera = make_camera(msgspec.convert(kept["camera"], BrownConradyLens))
    pose = turned(Rotation.from_quat(kept["cam_T_grip"]["rotation_xyzw"]), kept["cam_T_grip"]["translation_m"])
    transform = Transform(tuple(pose[:3, 3].tolist()), tuple(Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()))
    return camera, read_gripper(GRIPPER), ReferenceRecord("plate", 1, 0, "test", transform, tuple(kept["covariance"]))


def turned(rotation: Rotation, translation_m: list[float]) -> np.ndarray:
    """The file from CAD has x the other way round than the pictures' truth."""
    pose = np.eye(4)
    pose[:3, :3] = (rotation * Rotation.from_euler("z", np.pi)).as_matrix()
    pose[:3, 3] = translation_m
    return pose


@cache
def truth(number: int) -> np.ndarray:
    with (DATA / "bump" / "truth.csv").open() as file:
        row = next(row for row in csv.DictReader(file) if row["file"] == f"{number:06d}.png")
    return turned(Rotation.from_quat([float(row[q]) for q in ("qx", "qy", "qz", "qw")]), [float(row[k]) for k in "xyz"])


def image(number: int) -> np.ndarray:
    return cv2.imread(str(DATA / "bump" / f"{number:06d}.png"), cv2.IMREAD_UNCHANGED)


@cache
def watched() -> dict[int, FrameRecord]:
    camera, gripper, reference = rig()
    monitor = Monitor(camera, gripper, MonitorSettings(corners=SETTINGS), reference)
    return {
        number: monitor.process(Frame(number, 10**18 + number * 33_333_333, image(number), OPENING_M))
        for number in range(15, LAST)
    }


def taught(gripper: Gripper, reference: ReferenceRecord, camera: Camera) -> TaughtEdges:
    """From every third of the stills at the opening that is watched."""
    images = [
        TeachingImage(cv2.imread(str(DATA / "teach" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED), OPENING_M, str(k))
        for k in range(0, 12, 3)
    ]
    found = teach(Rig(camera, gripper, MonitorSettings(corners=SETTINGS)), reference, images)
    return TaughtEdges.of(found.edges, gripper, from_record(reference.cam_T_grip), gripper.jaw_nominal_m)


def error_m(number: int) -> float:
    record = watched()[number]
    assert record.cam_T_grip is not None
    return float(np.linalg.norm(np.array(record.cam_T_grip.translation_m) - truth(number)[:3, 3]))


def test_after_a_knock_it_is_found_in_the_same_frame_though_half_of_its_edges_never_show():
    assert np.linalg.norm(difference(truth(JUMP - 1), truth(JUMP))[:3]) == pytest.approx(2.5e-3, abs=1e-4)
    for number in range(JUMP, LAST):
        assert watched()[number].source is Origin.UPDATE and error_m(number) < 3e-4


def test_no_frame_is_beyond_its_bound():
    for number, record in watched().items():
        assert record.protection is not None
        assert error_m(number) < record.protection.position_m
        assert record.verdict is not Verdict.VALID or error_m(number) < 1e-3


def test_narrow_taught_tips_are_valid_again_soon_after_a_knock():
    """One end of each finger is all that this view has: too few to prove a place elsewhere but for the strips."""
    camera, gripper, reference = rig()
    monitor = Monitor(camera, gripper, MonitorSettings(corners=SETTINGS), reference, taught(gripper, reference, camera))
    before, told = -1, set()
    for number in (*range(15, 20), *range(JUMP, JUMP + VALID_AGAIN + 1)):
        record = monitor.process(Frame(number, 10**18 + number * 33_333_333, image(number), OPENING_M))
        assert record.cam_T_grip is not None and record.protection is not None
        off_m = np.linalg.norm(np.array(record.cam_T_grip.translation_m) - truth(number)[:3, 3])
        assert off_m < record.protection.position_m
        before = number if record.verdict is Verdict.VALID and number < JUMP else before
        told |= {alert.kind for alert in record.alerts}
    assert before == 19 and record.verdict is Verdict.VALID
    assert told & {AlertKind.STEP, AlertKind.DRIFT}, "told within as few frames, though five came before the knock"


@pytest.mark.parametrize("number", [JUMP - 1, JUMP])
def test_a_pointed_tip_beside_a_corner_that_cannot_be_measured_is_an_end(number: int):
    """Of one finger the file has the tip as a crease's corner: its outline there is 7 px long, too short for one."""
    camera, gripper, _ = rig()
    meter = FingertipMeter(camera, gripper, SETTINGS, 5e-5)
    found = meter.measure(image(number), truth(number), OPENING_M, 0.6, Patience(False, False))
    assert found.trusted and meter.ends(image(number), found).at_each


def test_images_at_two_openings_make_the_gripper_with_its_distance():
    """Though at the wider of them a bracket shows that the narrower one hides: outlines of that one don't move."""
    rows = list(csv.DictReader((DATA / "teach" / "timestamps.csv").open()))
    kept = yaml.safe_load((DATA / "hand_eye.yaml").read_text())
    made = gripper_from_images(
        [DATA / "teach" / row["file"] for row in rows],
        msgspec.convert(kept["camera"], BrownConradyLens),
        openings_m=[float(row["jaw_opening_m"]) for row in rows],
    )
    assert made.gripper.has_jaw and made.response == "srgb"
    true_m, sigma_m = kept["cam_T_grip"]["translation_m"][2], float(np.sqrt(made.covariance[2, 2]))
    assert abs(made.cam_T_grip[2, 3] - true_m) < 2.0 * sigma_m < 4e-3
