"""``gripmon calibrate plane`` as a user runs it: from image files to a hand/eye file that a configuration names."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy.stats import chi2
from support.plate_fingers import DISCS, OPENING_M, outline_pixels, rough, standing, true_corners
from support.plates import Look
from support.simulated import PAPER_LENS, nominal_cam_T_grip, sharp_gripper

from gripmon.calibrate.documents import CameraCalibration, CameraResiduals, HandEyeCalibration
from gripmon.cli import main
from gripmon.daemon.config import load_config, read_gripper
from gripmon.daemon.config.recorded import from_recorded, to_recorded
from gripmon.daemon.config.typed import to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.gripper import contents_of
from gripmon.model.provenance import provenance_of, sha256_of
from gripmon.model.targets import OtherSizeError, parse_target, refuse_other_size
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.disturbance import srgb_dn
from gripmon.track.edges.taught import gripper_digest

TRUE = nominal_cam_T_grip()
TARGET = "circles:12x10:0.008:0.004"
LOOK = Look(supersampling=3)


def write(path: Path, values: object) -> Path:
    path.write_text(as_yaml(json.loads(msgspec.json.encode(values))))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a user has it: images, camera, gripper, rough corners."""
    folder = tmp_path_factory.mktemp("plate")
    for number, (turn, shift) in enumerate([(0.3, (0.0, 0.0)), (1.5, (0.002, -0.003))]):
        cv2.imwrite(
            str(folder / f"p{number}.png"), standing(DISCS, turn_rad=turn, shift_m=shift, look=LOOK, seed=number)
        )
    cv2.imwrite(str(folder / "flipped.png"), cv2.imread(str(folder / "p0.png"), 0)[:, ::-1])
    cv2.imwrite(str(folder / "small.png"), cv2.imread(str(folder / "p0.png"), 0)[::2, ::2])
    cv2.imwrite(str(folder / "empty.png"), np.full((576, 768), 128, np.uint8))
    residuals = CameraResiduals(rms_px=0.03, views=9, points=500, outliers=0)
    camera = CameraCalibration(
        camera=PAPER_LENS,
        parameters=("fx_px", "kappa_per_px2"),
        covariance=(0.04, 0.0, 0.0, 1e-18),
        residuals=residuals,
        target=TARGET,
        provenance=provenance_of("by hand"),
    )
    write(folder / "camera.yaml", camera)
    write(folder / "gripper.yaml", contents_of(sharp_gripper().model))
    corners = {name: uv for name, uv in true_corners(TRUE).items() if not name.endswith("out_far")}
    write(folder / "rough.yaml", {"corners": rough(corners, 1)})
    write(folder / "outline.yaml", {"corners": rough(outline_pixels(TRUE), 2)})
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of the test's own, with links to the files."""
    for file in made.iterdir():
        (tmp_path / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    return tmp_path


TWICE = "circles:12x10:0.016:0.008"
KNOWN = ["--camera", "camera.yaml", "--target", TARGET, "--gripper", "gripper.yaml", "--jaw-opening", str(OPENING_M)]
INFER = ["--camera", "camera.yaml", "--target", TARGET, "--infer", "--gripper-out", "new.yaml"]


def plane(*arguments: str) -> int:
    return main(["calibrate", "plane", *arguments])


def hand_eye(path: Path) -> HandEyeCalibration:
    return to_settings(read_yaml(path), HandEyeCalibration)


def check_truth(found: HandEyeCalibration) -> None:
    error = perturbation_between(from_record(found.cam_T_grip), TRUE)
    assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all(), 1e6 * error[:3]
    assert error @ np.linalg.solve(np.reshape(found.covariance, (6, 6)), error) < chi2.ppf(1.0 - 1e-5, 6)


def test_a_known_gripper_from_two_images(here: Path, capsys: pytest.CaptureFixture[str]):
    code = plane("p0.png", "p1.png", *KNOWN, "--corners", "rough.yaml", "--out", "he.yaml", "--picture", "he.png")
    said = capsys.readouterr()
    assert code == 0 and said.err == ""
    found = hand_eye(here / "he.yaml")
    check_truth(found)
    assert found.camera == PAPER_LENS and found.jaw_opening_m == OPENING_M
    assert found.gripper.sha256 == gripper_digest(sharp_gripper())
    assert (found.residuals.images, found.residuals.corners) == (2, 12)
    assert 0.0 < found.residuals.rms_m < 2e-5 and 0.0 < found.residuals.rms_px < 0.2
    # The camera's focal length is uncertain by 0.2 px of 962: so is the distance.
    assert np.sqrt(found.covariance[14]) == pytest.approx(0.115 * 0.2 / 962.0, rel=0.15)
    assert "p1.png" in said.out and "the images agree" in said.out and "TCP in the camera frame  0.4" in said.out
    picture = cv2.imread(str(here / "he.png"))
    assert picture.shape[0] > 1152 and picture.shape[1:] == (1536, 3)  # and the caption below
    colours = picture.reshape(-1, 3).astype(int)
    assert np.count_nonzero(np.ptp(colours, axis=1) > 100) > 2000, "points and corners are in colour"


def test_a_colour_cameras_response_is_given_or_its_effect_is_in_the_covariance(
    here: Path, capsys: pytest.CaptureFixture[str]
):
    """Two images don't tell it."""
    for name in ("p0.png", "p1.png"):
        coded = np.rint(srgb_dn(cv2.imread(name, 0).astype(np.float32))).astype(np.uint8)
        cv2.imwrite(f"colour_{name}", np.dstack([coded, coded, np.minimum(coded, 250) + 4]))
    images = ["colour_p0.png", "colour_p1.png", *KNOWN, "--corners", "rough.yaml"]
    assert plane(*images, "--response", "srgb", "--out", "said.yaml") == 0
    assert "response: srgb (as given)" in capsys.readouterr().out
    check_truth(hand_eye(here / "said.yaml"))
    assert plane(*images, "--out", "unknown.yaml") == 0
    assert "response: unknown: read as linear" in capsys.readouterr().out
    said, unknown = (hand_eye(here / name) for name in ("said.yaml", "unknown.yaml"))
    pixel_m = TRUE[2, 3] / PAPER_LENS.fx_px
    assert np.sqrt(unknown.covariance[0]) > 0.2 * pixel_m > 2.0 * np.sqrt(said.covariance[0])
    away = perturbation_between(from_record(unknown.cam_T_grip), TRUE)[:3]
    assert away @ np.linalg.solve(np.reshape(unknown.covariance, (6, 6))[:3, :3], away) < chi2.ppf(0.999, 3)


def test_the_file_says_where_it_comes_from(here: Path):
    assert plane("p0.png", *KNOWN, "--corners", "rough.yaml", "--out", "he.yaml") == 0
    provenance = hand_eye(here / "he.yaml").provenance
    assert provenance.command.startswith("gripmon calibrate plane p0.png --target circles:12x10")
    assert "--corners rough.yaml" in provenance.command
    assert {i.file: i.sha256 for i in provenance.inputs} == {
        name: sha256_of(here / name) for name in ("p0.png", "camera.yaml", "gripper.yaml", "rough.yaml")
    }


def test_a_gripper_that_isnt_known_and_a_configuration_that_needs_no_editing(
    here: Path, capsys: pytest.CaptureFixture[str], tmp_path_factory: pytest.TempPathFactory
):
    arguments = ["--corners", "outline.yaml", "--jaw-range", "0:0.06", "--name", "fingers", "--out", "he.yaml"]
    assert plane("p0.png", "p1.png", *INFER, *arguments) == 0
    assert "fingertips 34.0" in capsys.readouterr().out
    found, gripper = hand_eye(here / "he.yaml"), read_gripper(here / "new.yaml")
    check_truth(found)
    assert found.gripper.name == gripper.name == "fingers" and found.gripper.sha256 == gripper_digest(gripper)
    assert gripper.model.provenance is not None and "--infer" in gripper.model.provenance.command
    settings = {
        "robot": "arm",
        "camera_name": "wrist",
        "camera": "camera.yaml",
        "gripper": "new.yaml",
        "reference": "he.yaml",
        "source": {"kind": "folder", "path": "."},
        "jaw": {"opening_m": OPENING_M},
    }
    config = load_config(write(here / "arm.yaml", settings))
    np.testing.assert_allclose(config.cam_T_grip, from_record(found.cam_T_grip), atol=1e-15)
    assert config.reference.covariance == found.covariance and config.camera.settings == PAPER_LENS
    assert main(["check", "arm.yaml"]) == 0
    # What is recorded holds all of its files.
    recorded = to_recorded(config)
    assert {"arm.yaml", "camera.yaml", "new.yaml", "he.yaml"} == set(recorded.files)
    again = from_recorded(recorded, tmp_path_factory.mktemp("again"))
    assert again.reference == config.reference and again.settings.camera == config.settings.camera
    # With a rough calibration no corners need be given; it may well be some pixels off.
    capsys.readouterr()
    assert plane("p1.png", "--config", "arm.yaml", "--target", TARGET, "--out", "he2.yaml") == 0
    assert "jaw opening assumed to be 0.034 m" in capsys.readouterr().out
    check_truth(hand_eye(here / "he2.yaml"))
    assert plane("p1.png", "--config", "arm.yaml", "--target", TWICE, "--out", "he3.yaml") == 2
    assert f"the camera was calibrated with {TARGET}" in capsys.readouterr().err
    # And the corners that it was inferred from do for the gripper's own file.
    known = ["--camera", "camera.yaml", "--gripper", "new.yaml", "--jaw-opening", str(OPENING_M), "--target", TARGET]
    assert plane("p1.png", *known, "--corners", "outline.yaml", "--out", "he4.yaml") == 0
    check_truth(hand_eye(here / "he4.yaml"))
    # The camera's file counts there, too.
    assert np.sqrt(hand_eye(here / "he2.yaml").covariance[14]) > 0.9 * 0.115 * 0.2 / 962.0


def test_images_that_give_nothing_are_said_and_left_out(here: Path, capsys: pytest.CaptureFixture[str]):
    assert plane("empty.png", "p0.png", *KNOWN, "--corners", "rough.yaml", "--out", "he.yaml") == 0
    assert capsys.readouterr().err.startswith("not used: empty.png: no lattice of discs in the image")
    assert hand_eye(here / "he.yaml").residuals.images == 1


def test_rough_corners_of_their_own_for_each_image(here: Path):
    write(here / "other.yaml", {"corners": rough({n: true_corners(TRUE)[n] for n in ("L_in_near", "R_in_far")}, 4)})
    files = ["--corners", "rough.yaml", "--corners", "other.yaml"]
    assert plane("p0.png", "p1.png", *KNOWN, *files, "--out", "he.yaml") == 0
    found = hand_eye(here / "he.yaml")
    assert found.residuals.corners == 8
    assert found.warnings[0].startswith("p1.png: two corners only (L_in_near, R_in_far)")


@pytest.mark.parametrize("options", [KNOWN, INFER])
def test_the_camera_s_target_in_another_size_is_refused(
    here: Path, capsys: pytest.CaptureFixture[str], options: list[str]
):
    """No image contradicts it: an inferred gripper would silently have twice the size."""
    wrong = [TWICE if word == TARGET else word for word in options]
    corners = ["--corners", "rough.yaml" if options is KNOWN else "outline.yaml"]
    assert plane("p0.png", *wrong, *corners, "--out", "he.yaml") == 2
    said = capsys.readouterr().err
    assert said.startswith(f"--target {TWICE}: the camera was calibrated with {TARGET}, the same pattern in another si")
    assert "--other-target" in said and said.count("\n") == 1
    assert not (here / "he.yaml").exists() and not (here / "new.yaml").exists()


@pytest.mark.parametrize(
    ("recorded", "given", "refused"),
    [
        (TARGET, "circles:10x12:0.016:0.008", True),
        (TARGET, "circles:12x10:0.008:0.003", True),
        (TARGET, "circles:12x10:0.008:0.00400000001", False),
        (TARGET, "circles:8x8:0.016:0.008", False),
        (TARGET, "chequerboard:12x10:0.016", False),
        ("chequerboard:9x6:0.025", "chequerboard:9x6:0.0251", True),
        ("charuco:8x6:0.03:0.022:DICT_4X4_250", "charuco:8x6:0.04:0.03:DICT_4X4_100", True),
        ("the board in the workshop", TARGET, False),
        (None, TARGET, False),
    ],
)
def test_the_same_pattern_in_another_size(recorded: str | None, given: str, refused: bool):
    with pytest.raises(OtherSizeError, match="other_target=True") if refused else contextlib.nullcontext():
        refuse_other_size(parse_target(given), recorded)


def test_another_target_of_the_same_pattern_is_taken_where_it_is_confirmed(here: Path):
    inferred = [TWICE if word == TARGET else word for word in INFER]
    said = ["--other-target", "--corners", "outline.yaml", "--out", "he.yaml"]
    assert plane("p0.png", *inferred, *said) == 0
    found = hand_eye(here / "he.yaml")
    assert np.allclose(found.cam_T_grip.translation_m, 2.0 * TRUE[:3, 3], atol=1e-4)
    assert "--other-target" in found.provenance.command


def test_nothing_is_replaced_without_force(here: Path, capsys: pytest.CaptureFixture[str]):
    (here / "he.yaml").write_text("mine")
    assert plane("p0.png", *KNOWN, "--corners", "rough.yaml", "--out", "he.yaml") == 2
    assert capsys.readouterr().err == "--out he.yaml: is there already; another file, or --force to replace it\n"
    assert (here / "he.yaml").read_text() == "mine"
    (here / "new.yaml").write_text("mine, too")
    assert plane("p0.png", *INFER, "--corners", "outline.yaml", "--out", "other.yaml") == 2
    assert (here / "new.yaml").read_text() == "mine, too" and not (here / "other.yaml").exists()
    assert plane("p0.png", *KNOWN, "--corners", "rough.yaml", "--out", "he.yaml", "--force") == 0
    check_truth(hand_eye(here / "he.yaml"))


def test_the_same_as_json(here: Path, capsys: pytest.CaptureFixture[str]):
    assert plane("p0.png", *INFER, "--corners", "outline.yaml", "--out", "he.yaml", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    found = hand_eye(here / "he.yaml")
    assert said["covariance"] == list(found.covariance) and said["rms_m"] == found.residuals.rms_m
    assert said["sides_m"] == pytest.approx([0.034, 0.016], abs=1e-4) and said["written"] == ["new.yaml", "he.yaml"]
    assert said["not_in_covariance"] == "bevelled edges, and dark ones before dark print"
    (image,) = said["images"]
    assert image["corners"]["left_inner_near"]["uv_px"] == pytest.approx(
        true_corners(TRUE)["L_in_near"].tolist(), abs=0.3
    )


def one(name: str) -> dict[str, object]:
    return {"corners": {name: [241.0, 240.0]}}


@pytest.mark.parametrize(
    ("arguments", "code", "line"),
    [
        (["p0.png", *KNOWN], 2, "the gripper's place in the image is unknown; --corners FILE.yaml, or --config"),
        (["p0.png", *KNOWN, "--corners", "none.yaml"], 2, "none.yaml: there is no such file"),
        (["p0.png", *KNOWN, "--corners", "camera.yaml"], 2, "camera.yaml: is a file of gripmon calibrate intrinsics; "),
        (["p0.png", *KNOWN, "--corners", "outline.yaml"], 2, "corners.left_inner_near: two_box_fingers has no"),
        (["p0.png", *KNOWN, "--corners", "one.yaml"], 2, "one.yaml: 1 corner (L_in_near); at least 2, which lie apart"),
        (["p0.png", "p1.png", "empty.png", *KNOWN, *["--corners", "rough.yaml"] * 2], 2, "--corners: 2 for 3 images"),
        (["p0.png", "p0.png", *KNOWN, "--corners", "rough.yaml"], 2, "p0.png: is the same image as p0.png"),
        (["small.png", *KNOWN, "--corners", "rough.yaml"], 2, "small.png: 384 x 288 px; the camera's 768 x 576 px"),
        (["rough.yaml", *KNOWN, "--corners", "rough.yaml"], 2, "rough.yaml: "),
        (["empty.png", *KNOWN, "--corners", "rough.yaml"], 3, "empty.png: no lattice of discs in the image"),
        (["flipped.png", *KNOWN, "--corners", "flipped.yaml"], 3, "flipped.png: the corners are mirrored"),
        (["flipped.png", *INFER, "--corners", "flipped_outline.yaml"], 3, "the innermost corners are mirrored"),
        (["p0.png", *KNOWN, "--infer", "--corners", "rough.yaml"], 2, "not allowed with argument --gripper"),
        (["p0.png", *INFER], 2, "--infer: needs rough corners"),
        (["p0.png", *INFER[:-2], "--corners", "outline.yaml"], 2, "--gripper-out FILE.yaml"),
        (["p0.png", *INFER[:-1], "he.yaml", "--corners", "outline.yaml"], 2, "--out and --gripper-out: both are"),
        (["p0.png", *INFER, "--corners", "rough.yaml"], 2, "corners.L_in_near: is not a name of a fingertip's"),
        (["p0.png", *INFER, "--corners", "outline.yaml", "--jaw-range", "0.04:0.06"], 3, "jaws are 0.0340 m open"),
        (["p0.png", *INFER, "--corners", "outline.yaml", "--jaw-range", "60"], 2, "'60' isn't a range; MIN:MAX"),
        (["p0.png", *INFER, "--corners", "outline.yaml", "--jaw-range", "0:60"], 2, "millimetres?"),
        (["p0.png", *KNOWN, "--jaw-range", "0:0.06", "--corners", "rough.yaml"], 2, "--jaw-range: has no effect"),
        (["p0.png", *KNOWN[:-1], "0.09", "--corners", "rough.yaml"], 2, "--jaw-opening 0.09: the gripper's is"),
        (["p0.png", *KNOWN[:-1], "0.05", "--corners", "rough.yaml"], 3, "p0.png: the corners don't fit the gripper"),
        (["p0.png", *KNOWN[2:], "--corners", "rough.yaml"], 2, "the camera isn't given; --camera FILE.yaml"),
        (["p0.png", *KNOWN[:4], "--corners", "rough.yaml"], 2, "the gripper isn't given; --gripper FILE.yaml"),
        (["p0.png", "--camera", "gripper.yaml", *KNOWN[2:], "--corners", "rough.yaml"], 2, "is a gripper file; "),
        (["p0.png", *KNOWN[:5], "camera.yaml", "--corners", "rough.yaml"], 2, "camera.yaml: is a file of gripm"),
        (["p0.png", *KNOWN[:2], "--target", "circles:8", *KNOWN[4:], "--corners", "rough.yaml"], 2, "'circles:8' has"),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(
    here: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, line: str
):
    write(here / "one.yaml", one("L_in_near"))
    for name in ("rough", "outline"):
        corners = {n: (767.0 - u, v) for n, (u, v) in read_yaml(here / f"{name}.yaml")["corners"].items()}
        write(here / ("flipped.yaml" if name == "rough" else "flipped_outline.yaml"), {"corners": corners})
    before = {p.name for p in here.iterdir()}
    try:
        ended = plane(*arguments, "--out", "he.yaml")
    except SystemExit as exit_:  # argparse
        ended = int(exit_.code or 0)
    said = capsys.readouterr().err
    assert ended == code, said
    assert line in said and "Traceback" not in said
    if "usage:" not in said:
        assert said.count("\n") == 1
    assert {p.name for p in here.iterdir()} == before, "nothing is written"
