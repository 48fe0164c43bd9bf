"""The cases that ``gripmon teach`` must manage: one finger, curves, three corners, corners on a line with a rough
distance, several images at once, images of several robot poses.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.changing_backgrounds import CAMERA, images_of, moving_robot
from support.meters import box_gripper
from support.simulated import nominal_cam_T_grip, simulator
from support.taught_by_hand import SCENARIO, Rig, make_rig
from support.taught_scenes import OPENING_M, image_of, reference, scene

from gripmon.cli import main
from gripmon.daemon.config import load_config
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.provenance import InputFile, Provenance
from gripmon.monitor import MonitorSettings
from gripmon.simulate import Scenario
from gripmon.teach.estimate import found_off
from gripmon.teach.measure import _lines, teach
from gripmon.teach.session import Setup
from gripmon.teach.views import TeachingImage, TeachingRefused, Viewer
from gripmon.teach.visibility import Rig as Measured

INNER = ("L_in_near", "L_in_far", "R_in_near", "R_in_far")
ON_A_LINE = ("L_in_near", "L_out_near", "R_in_near", "R_out_near")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return make_rig(tmp_path_factory.mktemp("cases"))


def off(found: Setup, image: np.ndarray, put: dict[str, list[float]], pose: np.ndarray) -> tuple[float, str | None]:
    """Distance (m) of the pose found from the true one, infinite if none is found; why."""
    seen = found.evaluate(image, {name: np.array(at) for name, at in put.items()}, (), OPENING_M)
    if seen.reference is None:
        return np.inf, seen.snapped.refused
    return float(np.linalg.norm(perturbation_between(from_record(seen.reference.cam_T_grip), pose)[:3])), None


def one_finger() -> Gripper:
    """The left one of two boxes, which stands."""
    values = msgspec.to_builtins(box_gripper().model)
    values.pop("jaw")
    left = next(iter(values["fingers"]))
    values["fingers"] = {left: {}}
    values["points"] = {name: point for name, point in values["points"].items() if point["finger"] == left}
    values["edges"] = {name: edge for name, edge in values["edges"].items() if edge["from"] in values["points"]}
    values["faces"] = [face for face in values["faces"] if face["finger"] == left]
    return Gripper(msgspec.convert(values, GripperModel))


def test_one_finger():
    gripper, pose = one_finger(), nominal_cam_T_grip()
    images = images_of(moving_robot(31, "blobs", gripper=gripper), 5)
    shown_px = CAMERA.project(gripper.points_grip_m(None)[gripper.corner_points] @ pose[:3, :3].T + pose[:3, 3])
    rough_px = shown_px + np.random.default_rng(1).normal(0.0, 3.0, shown_px.shape)
    put = dict(zip(gripper.corner_ids, rough_px, strict=True))
    setup = Setup(CAMERA, gripper, MonitorSettings(), None)
    found = setup.evaluate(images[0], put, (), None)
    assert found.reference is not None, found.no_reference
    xi = perturbation_between(from_record(found.reference.cam_T_grip), pose)
    assert xi @ np.linalg.solve(np.reshape(found.reference.covariance, (6, 6)), xi) < 22.5
    taught, _ = setup.taught(found.reference, [TeachingImage(image, 0.0, f"{k}.png") for k, image in enumerate(images)])
    assert len(taught.edges) >= 4 and not taught.left_out


def curved(*also: str, bulge: float = 0.0, beside_m: float = 0.0) -> tuple[Gripper, list[np.ndarray]]:
    """Round tips of 8 mm radius, of which the file gives these sides as curves, too, too far across the jaws by
    ``bulge`` of their lengths in their middles, and throughout by ``beside_m``; and five pictures of them.
    """
    from benchmarks.rounded import rounded_model, rounded_solids

    values = msgspec.to_builtins(rounded_model(0.02, 0.008).model)
    for name in also:
        ends = [np.array(values["points"][values["edges"][name][key]]["xyz_m"]) for key in ("from", "to")]
        length_m, x = float(np.linalg.norm(ends[1] - ends[0])), np.array([1.0, 0.0, 0.0])
        places = {s: ends[0] + s * (ends[1] - ends[0]) for s in (0.25, 0.5, 0.75)}
        out = {s: at + (4.0 * s * (1.0 - s) * bulge * length_m + beside_m) * x for s, at in places.items()}
        values["edges"][name]["via"] = [at.tolist() for at in out.values()]
    gripper = Gripper(msgspec.convert(values, GripperModel))
    return gripper, images_of(moving_robot(21, "blobs", gripper=rounded_solids(0.02, 0.008)), 5)


SIDES = "left_side_a", "left_side_b", "right_side_a", "right_side_b"


def rig_of(gripper: Gripper) -> Measured:
    return Measured(CAMERA, gripper, MonitorSettings())


@pytest.mark.usefixtures("tools_importable")
@pytest.mark.parametrize("also", [(), ("left_side_a", "right_side_b")], ids=["round tips", "mostly curved"])
def test_curves(also: tuple[str, ...]):
    """What is nearly straight is taught; the tips turn by a half circle."""
    gripper, images = curved(*also)
    frames = [TeachingImage(image, gripper.jaw_nominal_m, f"{k}.png") for k, image in enumerate(images)]
    taught = teach(rig_of(gripper), reference(), frames)
    assert set(taught.edges) == set(SIDES) and set(taught.untaught.values()) == {"it is curved"}
    assert max(abs(v) for edge in taught.edges.values() for v in edge.offset_m) < 2e-5, "they are where the file says"


@pytest.mark.usefixtures("tools_importable")
def test_a_slight_curve_is_taught_where_it_shows():
    """Its middle half beside its place by 60 µm, bent by less than a degree: by its whole, and by a line through it."""
    gripper, images = curved("left_side_a", beside_m=6e-5)
    frames = [TeachingImage(image, gripper.jaw_nominal_m, f"{k}.png") for k, image in enumerate(images)]
    found = {name: np.mean(edge.offset_m) for name, edge in teach(rig_of(gripper), reference(), frames).edges.items()}
    off_m = abs(found.pop("left_side_a"))
    assert 3e-5 < off_m < 7e-5 and max(abs(v) for v in found.values()) < 2e-5


def test_outlines_of_a_file_of_images_have_no_inset_in_common():
    """They lie where they show; all those of another file may lie inside of it, which looks like a distance."""
    made = Provenance(gripmon="", time="", command="", inputs=(InputFile(file="0.png", sha256="0" * 64),))
    frame, inset_m = TeachingImage(image_of(4e-4), OPENING_M, "0.png"), []
    for provenance in (None, made):
        gripper = Gripper(msgspec.structs.replace(box_gripper().model, provenance=provenance))
        viewer = Viewer(rig_of(gripper), reference(), [frame])
        lines, _ = _lines(viewer, [viewer.view(frame, viewer.fitted(frame))], search=True)
        inset_m.append(float(found_off(viewer, lines).common[-1]))
    assert inset_m[0] > 5e-5 and abs(inset_m[1]) < 0.1 * inset_m[0]


@pytest.mark.usefixtures("tools_importable")
def test_a_gripper_without_straight_outlines_is_told_so():
    gripper, images = curved(*SIDES, bulge=0.3)
    frames = [TeachingImage(images[0], gripper.jaw_nominal_m, "0.png")]
    with pytest.raises(TeachingRefused, match=r"^no outline in view is nearly straight"):
        teach(rig_of(gripper), reference(), frames)


def test_three_corners(rig: Rig, tmp_path: Path):
    setup = Setup(rig.camera, rig.gripper, MonitorSettings(), None)
    for seed, left_out in enumerate(INNER):
        put = rig.rough(*(name for name in INNER if name != left_out), seed=seed)
        assert off(setup, rig.image, put, nominal_cam_T_grip())[0] < 2e-4
    (tmp_path / "rough.yaml").write_text(yaml.safe_dump({"corners": put}))
    command = ["teach", rig.image_path, "--corners", tmp_path / "rough.yaml", *rig.options, "--out", tmp_path / "mine"]
    assert main([*map(str, command)]) == 0
    assert load_config(tmp_path / "mine" / "config.yaml").taught is not None


def test_corners_on_a_line_with_a_rough_distance(rig: Rig):
    """Far away, where nobody expects a wrist camera."""
    pose = nominal_cam_T_grip().copy()
    pose[:3, 3] *= 3.5
    image = simulator(msgspec.convert({**SCENARIO, "duration_s": 0.2}, Scenario), cam_T_grip=pose).render(0)
    points_m = rig.gripper.points_grip_m(OPENING_M)[rig.gripper.corner_points]
    shown = dict(zip(rig.gripper.corner_ids, rig.camera.project(points_m @ pose[:3, :3].T + pose[:3, 3]), strict=True))
    put = {name: (shown[name] + (1.0, -1.0)).tolist() for name in ON_A_LINE}
    distance_m = (float(pose[2, 3]) * 1.04, 0.02)
    alone, said = (Setup(rig.camera, rig.gripper, MonitorSettings(), None, None, d) for d in (None, distance_m))
    assert off(said, image, put, pose)[0] < 2e-3
    assert off(alone, image, put, pose)[0] > 5e-3


def test_several_images_at_once_and_their_picture(rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for k, level in enumerate((120.0, 180.0, 230.0)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image_of(0.0, scene(level)))
    (tmp_path / "rough.yaml").write_text(yaml.safe_dump({"corners": rig.rough(*INNER)}))
    images = [tmp_path / f"{k}.png" for k in range(3)]
    given = ["--corners", tmp_path / "rough.yaml", *rig.options, "--jaw-opening", OPENING_M, "--response", "srgb"]
    command = ["teach", *images, *given, "--out", tmp_path / "mine", "--picture", tmp_path / "taught.png"]
    assert main([*map(str, command)]) == 0
    config = load_config(tmp_path / "mine" / "config.yaml")
    assert config.taught is not None and len(config.taught.provenance.images) == 3
    picture = cv2.imread(str(tmp_path / "taught.png"))
    assert picture is not None and picture.shape == (1152, 1536, 3)
    # What was said of the grey levels is in the configuration, and in what it was taught with.
    assert config.says_response and config.settings.monitor.corners.edges.response == "srgb"
    assert config.taught.edge_settings.response == "srgb"


def test_images_of_several_robot_poses():
    """The camera moves with the robot: the background changes, the gripper stays, but for some play of the mount."""
    images, rng = images_of(moving_robot(41, "printed"), 6), np.random.default_rng(2)
    shifts_px = rng.uniform(-0.7, 0.7, (6, 2))
    moved = [
        cv2.warpAffine(image, np.array([[1.0, 0.0, u], [0.0, 1.0, v]]), image.shape[::-1], flags=cv2.INTER_CUBIC)
        for image, (u, v) in zip(images, shifts_px, strict=True)
    ]
    frames = [TeachingImage(image, OPENING_M, f"{k}.png") for k, image in enumerate(moved)]
    taught = teach(Measured(CAMERA, box_gripper(), MonitorSettings()), reference(None, 5e-4, 5e-3), frames)
    assert not taught.left_out and len(taught.edges) >= 8 and taught.closure_px < 0.3
