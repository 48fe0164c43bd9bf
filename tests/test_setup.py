"""Setting up without a browser: views of a plate held against the truth, images taken by themselves, the project folder
and its commands.
"""

from __future__ import annotations

import csv
import json
import math
import shutil
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support import new_user
from support.loopback import frame_record, free_endpoint, wait_until
from support.sightings import CAMERAS, poses, seen

from gripmon.calibrate.sighting import Sighting
from gripmon.cli import main
from gripmon.daemon.config import Config, load_config
from gripmon.daemon.config.robot_file import reference_text
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.daemon.overlay import outlines_of, overlay
from gripmon.daemon.setup import STEPS, Project, SetupSite
from gripmon.daemon.setup.capture import Capture
from gripmon.daemon.setup.entries import other_target, target_in
from gripmon.daemon.setup.lines import Line
from gripmon.daemon.setup.site import CaptureOrder, StepRequest
from gripmon.daemon.setup.steps import defaults, in_fields
from gripmon.daemon.setup.views import FEWEST_VIEWS, STILL_PX, Viewer, coverage, moved, tilts_of
from gripmon.daemon.teaching.source import named_source
from gripmon.io.sources import (
    FolderSettings,
    FolderSource,
    LiveSettings,
    NetworkSettings,
    Ros2CameraSettings,
    SourceError,
    Waiting,
)
from gripmon.model.errors import InputError, NoResultError
from gripmon.model.images import read_image
from gripmon.model.records import Frame, Image, Transform, Verdict
from gripmon.model.targets import parse_target
from gripmon.teach.messages import BadRequest, CornersRequest, EmptyRequest, SaveOrder
from gripmon.teach.page_server import Sandboxed

TARGET = parse_target(new_user.TARGET)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("setup")
    for kind in ("plate", "standing"):
        new_user.simulate(folder, kind)
    return folder


def pictures(folder: Path) -> list[Image]:
    out = [read_image(path)[0] for path in sorted(folder.glob("*.png"))]
    assert all(image is not None for image in out)
    return [image for image in out if image is not None]


@cache
def sightings(folder: Path) -> list[Sighting]:
    seen = [Viewer(TARGET).look(image).sighting for image in pictures(folder)]
    return [each for each in seen if isinstance(each, Sighting)]


def test_tilts_are_those_of_the_simulated_plate(images: Path):
    truth = json.loads((images / "plate" / "truth.json").read_text())
    seen = sightings(images / "plate")
    size_px = truth["camera"]["width_px"], truth["camera"]["height_px"]
    found = np.array(coverage(seen, size_px).tilts)
    assert len(found) == len(truth["images"])
    for (x, y), image in zip(found, truth["images"], strict=True):
        normal = np.array(image["cam_T_plate"])[:3, 2]  # into the plate, away from the camera
        # The depth of its plane grows against what the normal has in the image.
        tilt = math.acos(normal[2])
        assert math.hypot(x, y) == pytest.approx(tilt, abs=math.radians(3.0))
        across = -normal[:2] / np.linalg.norm(normal[:2])
        assert np.array([x, y]) / math.hypot(x, y) @ across > math.cos(math.radians(6.0))


def test_coverage_says_what_is_missing(images: Path):
    seen = sightings(images / "plate")
    size_px = seen[0].size_px
    assert coverage(seen, size_px).wants == ()
    few = coverage(seen[:1], size_px).wants
    assert f"{FEWEST_VIEWS - 1} more images" in few and any("tilted" in want for want in few)
    # All tilted alike: more of them don't help.
    alike = coverage([seen[0]] * 12, size_px)
    assert [want for want in alike.wants if "tilted" in want] and not any("more images" in w for w in alike.wants)
    shown = np.array(alike.cells, bool)
    columns, rows = (seen[0].uv_px / size_px * shown.shape[::-1]).astype(int).T
    expected = np.zeros_like(shown)
    expected[rows, columns] = True
    assert (shown == expected).all()


@pytest.mark.parametrize("shift_px", [0.0, 0.3, 0.8, 12.0])
def test_motion_is_what_the_image_was_shifted_by(images: Path, shift_px: float):
    image = pictures(images / "plate")[0]
    matrix = np.array([[1.0, 0.0, shift_px], [0.0, 1.0, 0.0]])
    after = cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    found = moved(image, np.asarray(after))
    assert found == pytest.approx(shift_px, abs=0.1)
    assert (found <= STILL_PX) == (shift_px <= STILL_PX)


class Script:
    """A live camera that shows these images, each when it is asked for."""

    live, connected, dropped = True, True, 0

    def __init__(self, shown: Sequence[Image]) -> None:
        self._shown, self._next, self._closed = list(shown), 0, threading.Event()

    def read(self) -> Frame | Waiting | None:
        if self._closed.is_set() or self._next >= len(self._shown):
            return None
        self._next += 1
        return Frame(self._next, 1000 * self._next, self._shown[self._next - 1], 0.03)

    def close(self) -> None:
        self._closed.set()


def taken(folder: Path, shown: Sequence[Image]) -> tuple[str, ...]:
    capture, source = Capture(folder, TARGET), Script(shown)
    ready = threading.Event()
    plain = source.read
    source.read = lambda: (ready.wait(30.0), plain())[1]  # type: ignore[method-assign]
    capture.start(source)
    capture.by_itself(True)
    ready.set()
    wait_until(lambda: capture.state().ended, "the end")
    capture.stop()
    return capture.images()


def test_a_live_camera_takes_what_is_still_sharp_and_new(images: Path, tmp_path: Path):
    first, second, third = pictures(images / "plate")[:3]
    again = np.asarray(np.minimum(first, 250) + 1, np.uint8)
    blurred = np.asarray(cv2.GaussianBlur(third, (0, 0), 5.0))
    nothing = np.random.default_rng(2).integers(90, 110, first.shape, np.uint8)
    shown = [first, first, first, second, second, blurred, blurred, nothing, nothing, again, again]
    # One for each pose that is held: neither while it moves, nor twice, nor what is blurred or shows no target.
    names = taken(tmp_path / "plate", shown)
    assert names == ("000.png", "001.png", "002.png")
    kept = [read_image(tmp_path / "plate" / name)[0] for name in names]
    assert all(np.array_equal(a, b) for a, b in zip(kept, (first, second, again), strict=True))
    rows = list(csv.DictReader((tmp_path / "plate" / "timestamps.csv").read_text().splitlines()))
    found = [(row["stamp_ns"], row["jaw_opening_m"]) for row in rows]
    assert found == [("2000", "0.03"), ("5000", "0.03"), ("11000", "0.03")]
    assert len(FolderSource(FolderSettings(path=str(tmp_path / "plate")), Path())) == 3


def test_nothing_is_taken_of_a_camera_that_moves(images: Path, tmp_path: Path):
    shown = pictures(images / "plate")
    assert taken(tmp_path / "plate", shown) == ()


def test_a_folder_is_taken_as_it_stands_and_once(images: Path, tmp_path: Path):
    capture = Capture(tmp_path / "standing", TARGET)
    for _ in range(2):
        capture.start(FolderSource(FolderSettings(path=str(images / "standing")), Path()))
        capture.by_itself(True)
        wait_until(lambda: capture.state().ended, "the end")
        capture.stop()
        assert capture.images() == ("000.png", "001.png", "002.png")
    with pytest.raises(BadRequest, match="there is no image x"):
        capture.drop("x")
    capture.drop("001.png")
    assert capture.images() == ("000.png", "002.png")


def test_sources_by_name(tmp_path: Path):
    assert named_source(str(tmp_path)) == FolderSettings(path=str(tmp_path))
    assert named_source("0", (640, 480)) == LiveSettings(device=0, width_px=640, height_px=480)
    assert named_source("zenoh:640x480") == NetworkSettings()
    assert named_source("zenoh:640x480:a/b", (640, 480)) == NetworkSettings(key="a/b")
    topic = named_source("ros2:640x480:/camera/image_raw/compressed")
    assert topic == Ros2CameraSettings(image="/camera/image_raw/compressed")
    for text, words in (
        ("", "names no camera"),
        ("zenoh:640", "names no camera"),
        ("zenoh:640x480:a/*", "without"),
        ("ros2:640x480", "topic"),
        ("ros2:640x480:camera", "image: is 'camera'"),
        ("cam.avi", "no such folder or file"),
    ):
        with pytest.raises(SourceError, match=words) as error:
            named_source(text)
        assert "\n" not in str(error.value)
    with pytest.raises(SourceError, match="the camera's calibration has 800 x 600 px"):
        named_source("zenoh:640x480", (800, 600))


def test_the_robot_is_named_as_the_folder_where_a_key_can(tmp_path: Path) -> None:
    assert Project(tmp_path / "arm9").values["robot"] == "arm9"
    assert Project(tmp_path / "cell $4").values["robot"] == defaults()["robot"]


def test_a_camera_on_the_network_is_looked_through(images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The driver's frames come on the monitor's own key, as when it runs."""
    from support.loopback import plain_session

    from gripmon.daemon.teaching import source as sources

    endpoint = free_endpoint()
    given = sources.PublishSettings
    monkeypatch.setattr(sources, "PublishSettings", lambda: given(listen=(endpoint,)))
    image = pictures(images / "plate")[0]
    project = Project(tmp_path)
    project.keep({"source": "zenoh:768x576", "robot": "arm7"})
    png = cv2.imencode(".png", image)[1].tobytes()
    stop = threading.Event()

    def drive() -> None:
        with plain_session(connect=endpoint, mode="peer") as session:
            while not stop.wait(0.05):
                session.put("gripmon/arm7/wrist/image", png, encoding="image/png")

    def driven() -> None:
        while not stop.is_set():
            try:
                drive()
            except Exception:  # noqa: BLE001  the camera isn't there yet
                stop.wait(0.1)

    thread = threading.Thread(target=driven)
    thread.start()
    try:
        assert project.do("camera") == [Line("768 x 576 px, 8 bits", "OK")]
    finally:
        stop.set()
        thread.join()


def test_a_robots_own_calibration(tmp_path: Path):
    rng = np.random.default_rng(5)
    flange_T_cam, cam_T_grip = np.eye(4), np.eye(4)
    flange_T_cam[:3, :3] = Rotation.random(random_state=1).as_matrix()
    flange_T_cam[:3, 3] = rng.uniform(-0.1, 0.1, 3)
    cam_T_grip[:3, :3] = Rotation.from_euler("x", 30.0, degrees=True).as_matrix()
    cam_T_grip[:3, 3] = [0.001, 0.002, 0.12]
    written = {
        name: {
            "translation_m": made[:3, 3].tolist(),
            "rotation_xyzw": Rotation.from_matrix(made[:3, :3]).as_quat().tolist(),
        }
        for name, made in (("flange_T_cam", flange_T_cam), ("flange_T_tcp", flange_T_cam @ cam_T_grip))
    }
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(written))
    text, said = reference_text(path)
    found = yaml.safe_load(text)["cam_T_grip"]
    np.testing.assert_allclose(found["translation_m"], cam_T_grip[:3, 3], atol=1e-12)
    turned = Rotation.from_quat(found["rotation_xyzw"]) * Rotation.from_matrix(cam_T_grip[:3, :3]).inv()
    assert turned.magnitude() < 1e-9 and said == "TCP at 1.0, 2.0, 120.0 mm in the camera frame"
    for values, words in (
        ({"a": 1}, "contains no hand/eye calibration"),
        ({"cam_T_grip": {"translation_m": [0.0, 0.0, 120.0], "rotation_xyzw": [0, 0, 0, 1]}}, "120 mm were meant"),
        (written | {"flange_T_cam": {"translation_m": [0, 0, 0], "rotation_xyzw": [1, 1, 0, 0]}}, "flange_T_cam"),
    ):
        path.write_text(yaml.safe_dump(values))
        with pytest.raises(InputError, match=words) as error:
            reference_text(path)
        assert "\n" not in str(error.value)


def test_steps_are_a_chain(tmp_path: Path):
    """What a step needs is written by one before it."""
    written: set[str] = set()
    for step in STEPS:
        plan = step.plan(defaults())
        assert set(plan.needs) <= written | {"setup.yaml"}, step.name
        written |= set(plan.writes)
    names = [field.name for step in STEPS for field in step.fields]
    assert len(names) == len(set(names)) and set(names) == set(defaults())
    assert [state.progress for state in Project(tmp_path).states()][:3] == ["ready", "ready", "waits"]


def test_grippers_from_cad_and_images_are_commands(tmp_path: Path):
    project = Project(tmp_path)
    (tmp_path / "camera.yaml").write_text("")
    project.keep({"gripper": "from CAD", "cad_files": "l.stl 'my r.stl'", "cad_unit": "mm", "cad_view": "0.12:30"})
    project.keep({"jaw_range": "0:0.06", "options": "--length 0.04"})
    words, written = (
        "gripmon gripper from-cad l.stl 'my r.stl' --jaw-range 0:0.06 --unit mm",
        "--out gripper.yaml --force",
    )
    view = "--view 0.12:30 --length 0.04 --camera camera.yaml --picture gripper.png"
    assert project.states()[4].command == f"{words} {view} {written}" and project.states()[4].progress == "ready"
    project.keep({"gripper": "from images", "free_images": "free", "distance": "0.12:0.003", "options": ""})
    words = "gripmon gripper from-images free --camera camera.yaml --distance 0.12:0.003 --picture gripper.png"
    assert project.states()[4].command == f"{words} --reference-out hand_eye.yaml {written}"
    # Images of the camera itself are those of a later step, which then waits for no gripper.
    project.keep({"free_images": "teaching"})
    assert [project.states()[k].note for k in (4, 8)] == ["first: Gripper at work (teaching)", "0 images"]
    assert project.states()[8].progress == "ready"
    project.keep({"options": "'"})
    assert "words as on a command line" in project.states()[4].note
    project.keep({"gripper": "two_box_fingers", "reference_by": "with the gripper's images"})
    with pytest.raises(InputError, match="this gripper wasn't made from images"):
        project.do("standing")


def test_another_target_than_the_lens_s_is_confirmed_for_these_two_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    project, twice = Project(tmp_path), "circles:12x10:0.016:0.008"
    (tmp_path / "standing").mkdir()
    for name in ("standing/000.png", "standing/rough.yaml"):
        (tmp_path / name).write_text("")
    (tmp_path / "camera.yaml").write_text(f"target: {new_user.TARGET}\n")
    assert other_target(project.values) == ""
    project.keep({"target": twice})
    project.keep({"other_target": other_target(project.values)})
    assert project.states()[7].command.endswith(" --other-target --out hand_eye.yaml --picture hand_eye.png --force")
    project.keep({"target": "circles:12x10:0.012:0.006"})
    assert "--other-target" not in project.states()[7].command
    assert main(["setup", ".", "--step", "reference"]) == 2
    said = capsys.readouterr().err
    assert f"{new_user.TARGET}, the same pattern in another size; that one, or cd {tmp_path} && gripmon cal" in said
    assert "--force --other-target if it is really another target" in said and said.count("\n") == 1


def test_options_in_messages_are_called_as_the_fields():
    said = "--unit: is missing; --units, or x--unit; beyond --jaw-range 0:0.06"
    assert in_fields(said) == "“unit of the meshes”: is missing; --units, or x--unit; beyond “jaws move (m)” 0:0.06"


def test_a_lens_from_a_file_needs_no_images_of_the_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    project, other = Project(tmp_path), "gripmon calibrate import given.yaml --out camera.yaml --force"
    project.keep({"intrinsics_by": "a file", "camera_file": "given.yaml"})
    assert [state.progress for state in project.states()][2:4] == ["skipped", "ready"]
    (tmp_path / "given.yaml").write_text("camera_name: of another program\n")
    assert project.states()[3].command == other
    (tmp_path / "given.yaml").write_text("schema: gripmon.camera_calibration/1\n")
    assert project.states()[3].command == "cp given.yaml camera.yaml"


def test_an_inferred_gripper_is_a_step_that_is_said(tmp_path: Path):
    """Its jaw range would be forgotten else."""
    project = Project(tmp_path)
    assert project.states()[4].progress == "ready"
    project.keep({"jaw_range": "0:0.06", "jaw_opening": "0.05"})
    project.do("gripper")
    assert project.states()[4].progress == "done" and "--jaw-range 0:0.06" in project.states()[7].command
    assert "--jaw-opening 0.05" in project.states()[7].command
    project.keep({"jaw_range": "0:0.07"})
    assert project.states()[4].progress == "ready"


def test_a_jaw_range_is_told_where_it_is_said(tmp_path: Path):
    project = Project(tmp_path)
    still, _ = project.do("gripper")
    assert still.level == "WARN" and "the jaws are assumed never to move" in still.text
    for wrong, said in (("60", "isn't a range"), ("0:60", "millimetres"), ("0.06:0", "doesn't ascend")):
        project.keep({"jaw_range": wrong})
        with pytest.raises(InputError, match=f"jaws move: .*{said}"):
            project.do("gripper")
        assert project.states()[4].progress == "ready"
    project.keep({"jaw_range": "0:0.06"})
    assert project.do("gripper")[0] == Line("the jaws move from 0 to 60 mm", "OK")


def test_a_source_given_with_a_step_is_that_steps_alone(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(images / "plate", "my pictures")
    assert main(["setup", "arm", "--source", "my pictures", "--step", "camera"]) == 0  # named from where a person is
    assert main(["setup", "arm", "--source", "my pictures/", "--step", "plate"]) == 0
    for step in ("corners", "gripper", "nose"):
        assert main(["setup", "arm", "--source", str(images), "--step", step]) == 2
        assert f"--source: the step {step} takes no images; one of camera, plate, st" in capsys.readouterr().err
    kept = read_yaml(tmp_path / "arm" / "setup.yaml")["values"]
    assert (kept["source"], kept["plate_source"], kept["standing_source"]) == ("../my pictures", "../my pictures", "")


def test_a_file_that_is_no_camera_is_told_as_a_person_named_it(tmp_path: Path):
    project = Project(tmp_path)
    project.keep({"source": str(tmp_path / "setup.yaml")})
    with pytest.raises(InputError, match=r"^\S+setup.yaml can't be opened as a video; a folder of images, a video f"):
        project.do("camera")


def test_the_command_of_a_page_can_be_typed_where_a_person_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "my arm"
    (folder / "standing").mkdir(parents=True)
    assert main(["setup", str(folder), "--step", "corners"]) == 2
    assert capsys.readouterr().err == "corners: there is no camera.yaml yet; first --step intrinsics\n"
    (folder / "camera.yaml").write_text("")
    (folder / "standing" / "000.png").write_text("")
    assert main(["setup", str(folder), "--step", "corners"]) == 2
    assert f"cd '{folder}' && gripmon teach --page standing/000.png" in capsys.readouterr().err


def test_the_page_of_a_lens_is_shown_without_the_sites_origin(tmp_path: Path):
    (tmp_path / "camera.html").write_text("<script>anyone's</script>")
    site = SetupSite(Project(tmp_path))
    try:
        (shown,) = (card.picture for card in site.state().steps if card.picture)
        data, kind = site.get(shown) or (b"", "")
    finally:
        site.close()
    assert shown.startswith("file/camera.html?") and kind.startswith("text/html")
    assert isinstance(data, Sandboxed) and data == b"<script>anyone's</script>"


def test_what_the_ruler_says_scales_the_target(tmp_path: Path):
    project = Project(tmp_path)
    for said in ("153,0", "153"):
        project.keep({"bar_measured": said})
        lines = project.do("target")
        assert lines[-1].text == "the target is circles:12x10:0.00816:0.00408"  # 2 % larger, as the bar of 150 mm
    assert read_yaml(tmp_path / "setup.yaml")["values"]["bar_measured"] == "153"
    again = Project(tmp_path)
    assert again.states()[1].progress == "done" and target_in(again.values) == target_in(project.values)
    again.keep({"have": "I have one"})
    assert target_in(again.values) == TARGET


def test_files_that_it_did_not_write_are_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name, text in (("camera.yaml", "mine"), ("setup.yaml", "my: notes\n")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text(text)
        assert main(["setup", str(folder), "--step", "target"]) == 2
        assert name in capsys.readouterr().err and (folder / name).read_text() == text
        assert [path.name for path in folder.iterdir()] == [name]


def test_a_project_that_cant_be_read_or_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "setup.yaml").write_text("values: [1, 2]\n")
    assert main(["setup", str(tmp_path), "--step", "camera"]) == 2
    assert "values: isn't a table of texts" in capsys.readouterr().err
    (tmp_path / "setup.yaml").unlink()
    (tmp_path / "file").write_text("")
    assert main(["setup", str(tmp_path / "file"), "--step", "camera"]) == 2
    assert main(["setup", str(tmp_path), "--step", "nose"]) == 2
    assert "is not a step; one of camera, target" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["setup", "--help"])
    names = ", ".join(step.name for step in STEPS[:-1]) + f" or {STEPS[-1].name}"
    assert names in " ".join(capsys.readouterr().out.split())
    (tmp_path / "config.yaml").write_text("")
    assert main(["setup", str(tmp_path), "--step", "run"]) == 2
    assert "gripmon run config.yaml --out run" in capsys.readouterr().err
    assert main(["setup", str(tmp_path), "--step", "intrinsics"]) == 2
    assert capsys.readouterr().err == "intrinsics: there are no images in plate yet; first --step plate\n"


def test_steps_as_commands(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "arm"
    assert main(["setup", str(folder), "--source", str(images / "plate"), "--step", "camera"]) == 0
    assert main(["setup", str(folder), "--step", "target"]) == 0
    assert main(["setup", str(folder), "--step", "plate"]) == 0
    assert "OK    12 images in plate" in capsys.readouterr().out
    assert main(["setup", str(folder), "--step", "intrinsics"]) == 0
    assert "written: camera.yaml" in capsys.readouterr().out
    found = read_yaml(folder / "camera.yaml")
    assert found["target"] == new_user.TARGET
    assert found["provenance"]["command"].startswith("gripmon calibrate intrinsics plate --target circles:")
    assert abs(found["camera"]["fx_px"] - 962.0) < 1.0
    # A folder without the target is no success.
    other, bare = tmp_path / "other", tmp_path / "bare"
    bare.mkdir()
    cv2.imwrite(str(bare / "0.png"), np.full((576, 768), 90, np.uint8))
    assert main(["setup", str(other), "--source", str(bare), "--step", "camera"]) == 0
    assert main(["setup", str(other), "--step", "target"]) == 0
    assert main(["setup", str(other), "--step", "plate"]) == 3
    assert "plate: no image was taken" in capsys.readouterr().err
    # A command that fails says why, and what was there stays.
    project = Project(folder)
    project.keep({"target": "chequerboard:9x6:0.02"})
    for path in sorted((folder / "plate").glob("*.png"))[2:]:  # a target is searched in vain for long
        path.unlink()
    before = (folder / "camera.yaml").read_bytes()
    with pytest.raises(NoResultError, match="none of 2 images shows the target"):
        project.do("intrinsics")
    assert (folder / "camera.yaml").read_bytes() == before


def test_a_gripper_of_the_library_and_every_kind_of_reference(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Corners by name on the teaching page; then a plate, the robot's own file, or these corners alone."""
    monkeypatch.chdir(tmp_path)
    given = f"calibrate intrinsics {images / 'plate'} --target {new_user.TARGET} --model paper --out given.yaml"
    assert main(given.split()) == 0
    project = Project(tmp_path)
    project.keep({"gripper": "two_box_fingers", "source": str(images / "standing"), "have": "I have one"})
    project.keep({"intrinsics_by": "a file", "camera_file": "given.yaml"})
    with pytest.raises(InputError, match=r"first: Lens \(camera.yaml\)"):
        project.do("reference")
    for step in ("camera", "target", "intrinsics", "gripper"):
        project.do(step)
    for folder in ("standing", "teaching"):
        (tmp_path / folder).mkdir()
        shutil.copy(images / "standing" / "0.png", tmp_path / folder / "000.png")
    site, truth = SetupSite(project), json.loads((images / "standing" / "truth.json").read_text())
    opening_m, rng, corners = truth["jaw_opening_m"], np.random.default_rng(7), {}
    for name in ("left_inner_near", "left_inner_far", "right_inner_near", "right_inner_far"):
        u, v = (np.array(truth["corners"][name]) + rng.uniform(-4.0, 4.0, 2)).tolist()
        corners[f"{name[0].upper()}_in_{name.rpartition('_')[2]}"] = u, v
    try:
        assert _sent(site, "open", StepRequest(step="corners")) == {"url": "page/"}
        assert _shown(site)["saves"] == ["corners"]
        put = CornersRequest(corners=corners, image=0, jaw_opening_m=opening_m)
        order = SaveOrder(put=put, robot="arm1", camera_name="wrist", config=False, taught=False)
        assert _sent(site, "page/save", order).written == {"standing/corners.yaml": "the corners"}
        _sent(site, "page/done", EmptyRequest())
        assert site.get("page/state") is None
        project.keep({"jaw_opening": str(opening_m)})
        project.do("reference")
        found, true = read_yaml(tmp_path / "hand_eye.yaml")["cam_T_grip"], np.array(truth["cam_T_grip"])
        np.testing.assert_allclose(found["translation_m"], true[:3, 3], atol=5e-5)
        (tmp_path / "robot.yaml").write_text(yaml.safe_dump({"cam_T_grip": found}))
        project.keep({"reference_by": "a file", "reference_file": "robot.yaml"})
        project.do("reference")
        _sent(site, "open", StepRequest(step="teach"))
        assert _shown(site)["needed"] == 0  # the reference is known
        put = CornersRequest(corners={}, image=0, jaw_opening_m=opening_m)
        saved = _sent(site, "page/save", SaveOrder(put=put, robot="arm1", camera_name="wrist"))
        assert "the configuration" in saved.written.values()
        config = load_config(tmp_path / "config.yaml")
        assert config.reference.covariance[0] == pytest.approx(1e-6)  # (1 mm)²
        _drawn_where_it_is(config, truth, tmp_path / "teaching" / "000.png")
        assert {line.level for line in project.do("check")} <= {"OK", "WARN"} and project.checked()
        project.keep({"reference_by": "from corners alone"})
        states = {state.name: state for state in project.states()}
        assert states["reference"].progress == "skipped" and "--reference" not in states["teach"].command
        _sent(site, "open", StepRequest(step="teach"))
        assert _shown(site)["needed"] == 3
        _started_and_stopped(site, tmp_path)
        with pytest.raises(BadRequest, match="no step nose"):
            _sent(site, "open", StepRequest(step="nose"))
        project.keep({"gripper": "from the plate"})
        with pytest.raises(InputError, match="an inferred gripper needs its images on the target"):
            project.do("standing")
    finally:
        site.close()


def _drawn_where_it_is(config: Config, truth: dict[str, Any], path: Path) -> None:
    """The overlay's colour is at the simulator's corners, and nowhere without a transform."""
    image, true = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.array(truth["cam_T_grip"])
    x, y, z, w = Rotation.from_matrix(true[:3, :3]).as_quat().tolist()
    places = np.rint([truth["corners"][name] for name in truth["corners"] if "inner" in name]).astype(int)
    for verdict, transform in ((Verdict.VALID, true), (Verdict.SUSPECT, true), (Verdict.UNKNOWN, None)):
        pose = None if transform is None else Transform(tuple(transform[:3, 3].tolist()), (x, y, z, w))
        changes = {"verdict": verdict, "cam_T_grip": pose, "corners": (), "jaw_opening_m": truth["jaw_opening_m"]}
        record = frame_record(**changes)
        outlines = outlines_of(config.camera, config.gripper, transform, record.jaw_opening_m)
        jpeg = overlay(np.asarray(image), record, outlines, image.shape[1])
        blue, green, red = np.moveaxis(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int), 2, 0)
        coloured = {"valid": green - red > 60, "suspect": red - blue > 60, "unknown": abs(red - blue) > 60}[
            verdict.value
        ]
        near = [coloured[v - 3 : v + 4, u - 3 : u + 4].any() for u, v in places]
        assert all(near) if transform is not None else not coloured.any(), verdict


def _started_and_stopped(site: SetupSite, folder: Path) -> None:
    """The monitor waits for a camera that isn't there, until it is told to end."""
    values = read_yaml(folder / "config.yaml")
    values["source"], values["publish"] = {"kind": "live", "device": "/dev/video987"}, {"listen": [free_endpoint()]}
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    _sent(site, "start", EmptyRequest())
    wait_until(lambda: any("/dev/video987" in line for line in site.state().monitor.lines), "what the monitor says")
    assert site.state().monitor.running and site.state().monitor.ended is None
    with pytest.raises(BadRequest, match="is already running"):
        _sent(site, "start", EmptyRequest())
    with pytest.raises(BadRequest, match="the monitor uses the camera"):
        _sent(site, "capture", CaptureOrder(step="teaching", action="start"))
    _sent(site, "stop", EmptyRequest())
    assert (site.state().monitor.running, site.state().monitor.ended) == (False, "stopped")
    (folder / "config.yaml").write_text("robot: [\n")
    with pytest.raises(InputError, match=r"config\.yaml"):
        _sent(site, "start", EmptyRequest())


def _shown(site: SetupSite) -> dict[str, Any]:
    found = site.get("page/state")
    assert found is not None
    state: dict[str, Any] = msgspec.json.decode(found[0])
    return state


def _sent(site: SetupSite, path: str, order: Any) -> Any:
    action = site.post(path)
    assert action is not None and isinstance(order, action[0])
    return action[1](order)


def test_one_row_of_a_plate_has_no_tilt():
    """Alone, and among views that show the whole plate: it tells nothing of their camera either."""
    rng = np.random.default_rng(3)
    views = seen(CAMERAS["brown_conrady"], poses(rng, 6), rng)
    row = views[0].plate_m[:, 1] == views[0].plate_m[0, 1]
    line = replace(views[0], uv_px=views[0].uv_px[row], plate_m=views[0].plate_m[row])
    size_px = views[0].size_px
    assert not tilts_of([line], size_px).any()
    among = tilts_of([*views[:3], line], size_px)
    assert not among[3].any() and among[:3] == pytest.approx(tilts_of(views[:3], size_px))
    assert np.linalg.norm(among[:3], axis=1).max() > 0.05
