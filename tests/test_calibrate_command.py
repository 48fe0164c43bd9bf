"""``gripmon calibrate intrinsics`` on rendered images: what it writes, says and refuses."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.plates import Look, fingers, pose, render

from gripmon.calibrate.documents import CameraCalibration
from gripmon.calibrate.lens_models import lens_vector
from gripmon.cli import main
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.daemon.targets import target_of
from gripmon.model.camera import BrownConradyLens, PaperLens
from gripmon.model.errors import InputError
from gripmon.model.targets import parse_target

LENS = BrownConradyLens(
    width_px=480, height_px=360, fx_px=470.0, fy_px=471.0, cx_px=243.0, cy_px=177.0,
    coefficients=(-0.18, 0.06, 0.0008, -0.0005),
)  # fmt: skip
TEXT = "chequerboard:9x6:0.02"
BOARD = parse_target(TEXT)
LOOK = Look(supersampling=2)


def shown(k: int, tilt: float = 0.5) -> np.ndarray:
    """``cam_T_plate`` of image k."""
    a = 2.0 * np.pi * k / 5.0
    centre = (0.03 * np.cos(3.0 * a + k), 0.02 * np.sin(2.0 * a + k), 0.2 + 0.01 * (k % 4))
    return pose(BOARD, centre, (tilt * np.cos(a), tilt * np.sin(a)), 0.2 * (k - 3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight images of the plate, fingers on two of them, and one without it."""
    out = tmp_path_factory.mktemp("plate")
    for k in range(8):
        covers = fingers(LENS, 0.2) if k % 4 == 3 else ()
        cv2.imwrite(str(out / f"{k}.png"), render(LENS, shown(k), BOARD, LOOK, covers=covers, seed=k))
    rng = np.random.default_rng(0)
    cv2.imwrite(str(out / "9.png"), rng.integers(80, 90, (360, 480)).astype(np.uint8))
    return out


def images(folder: Path, numbers: Sequence[int] = range(8)) -> list[str]:
    return [str(folder / f"{k}.png") for k in numbers]


def calibrate(*words: str) -> int:
    try:
        return main(["calibrate", "intrinsics", *words])
    except SystemExit as stopped:
        return int(stopped.code or 0)


def test_a_camera_from_a_folder(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out, report = tmp_path / "new" / "camera.yaml", tmp_path / "camera.html"
    assert calibrate(str(folder), "--target", TEXT, "--out", str(out), "--report", str(report)) == 0
    said = capsys.readouterr()
    assert said.err == f"{folder / '9.png'}: no chequerboard in the image; one that is evenly lit and not too small\n"
    assert "8 of 9 images" in said.out and "in images that had no part in the fit" in said.out
    assert f"written: {out}" in said.out and "fx_px" in said.out

    written = msgspec.convert(read_yaml(out), CameraCalibration)
    n = len(written.parameters)
    assert written.parameters[:4] == ("fx_px", "fy_px", "cx_px", "cy_px") and len(written.covariance) == n * n
    covariance = np.array(written.covariance).reshape(n, n)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
    # A few hundredths of a pixel of what every renderer and every detector does to corners come on top of noise.
    error = (lens_vector(written.camera) - lens_vector(LENS)) / np.sqrt(covariance.diagonal())
    assert np.abs(error).max() < 8.0
    assert written.camera.fx_px == pytest.approx(470.0, abs=0.4) and written.camera.cx_px == pytest.approx(
        243.0, abs=0.4
    )
    assert written.residuals.rms_px < 0.04 and written.residuals.views == 8
    assert written.residuals.cross_validated_rms_px == pytest.approx(written.residuals.rms_px, rel=0.5)
    assert written.target == TEXT

    provenance = written.provenance
    assert provenance.command.startswith("gripmon calibrate intrinsics ") and f"--target {TEXT}" in provenance.command
    assert [i.file for i in provenance.inputs] == [str(folder / f"{k}.png") for k in (*range(8), 9)]
    assert provenance.inputs[3].sha256 == hashlib.sha256((folder / "3.png").read_bytes()).hexdigest()
    assert provenance.versions["opencv"] == cv2.__version__ or provenance.versions["opencv"]
    page = report.read_text()
    assert "<title>camera.yaml</title>" in page and "7.png" in page and "no chequerboard in the image" in page


@pytest.mark.slow("3 s; the criterion itself is in test_calibrate_intrinsics")
def test_the_best_model_by_criterion_as_json(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "camera.yaml"
    assert calibrate(*images(folder), "--target", TEXT, "--model", "auto", "--out", str(out), "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["model"].startswith("brown_conrady") and said["out"] == str(out)
    assert set(said["criterion"]) >= {"paper", "brown_conrady", "brown_conrady_5"}
    assert min(said["criterion"], key=said["criterion"].get) == said["model"]
    assert [v["image"] for v in said["views"]] == images(folder) and said["not_found"] == []
    assert said["views"][3]["points"] < 54 and said["views"][3]["note"]
    assert 0.0 < said["parameters"]["fx_px"]["sigma"] < 0.5


def test_held_parameters_are_shown_as_held(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "camera.yaml"
    words = ["--model", "paper", "--fix", "cx_px", "--fix", "aspect", "--out", str(out)]
    assert calibrate(*images(folder), "--target", TEXT, *words) == 0
    held = {line.split()[0] for line in capsys.readouterr().out.splitlines() if line.endswith(" held")}
    assert held == {"cx_px", "fy_px"}
    written = msgspec.convert(read_yaml(out), CameraCalibration)
    assert isinstance(written.camera, PaperLens) and written.camera.cx_px == 239.5
    assert written.provenance.command.count("--fix") == 2


def test_one_image_is_calibrated_as_in_the_paper(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    lens = PaperLens(
        width_px=480, height_px=360, fx_px=600.0, fy_px=600.0, cx_px=239.5, cy_px=179.5, kappa_per_px2=3e-7
    )
    text = "circles:8x8:0.008:0.004"
    target = parse_target(text)
    image = render(lens, pose(target, (0.0, 0.0, 0.145), (0.5, 0.1), 0.2), target, Look(clutter="plain"))
    cv2.imwrite(str(tmp_path / "one.png"), image)
    out = tmp_path / "camera.yaml"
    assert calibrate(str(tmp_path / "one.png"), "--target", text, "--out", str(out)) == 0
    assert "from a single image: principal point at the image's centre" in capsys.readouterr().out
    written = msgspec.convert(read_yaml(out), CameraCalibration)
    assert written.parameters == ("fx_px", "kappa_per_px2")
    assert written.camera.fx_px == pytest.approx(600.0, rel=0.005)
    assert isinstance(written.camera, PaperLens) and written.camera.kappa_per_px2 == pytest.approx(3e-7, abs=4e-8)


def test_no_file_is_replaced_without_force(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "camera.yaml"
    out.write_text("mine\n")
    words = [*images(folder), "--target", TEXT, "--out", str(out)]
    assert calibrate(*words) == 2
    assert capsys.readouterr().err == f"--out {out}: is there already; another file, or --force to replace it\n"
    assert out.read_text() == "mine\n"
    assert calibrate(*words, "--force") == 0
    assert msgspec.convert(read_yaml(out), CameraCalibration).residuals.views == 8


REFUSALS = {
    "wrong count": (range(8), "chequerboard:7x5:0.02", (), 3, r"should have 7 x 5"),
    "nothing found": ((9,), TEXT, (), 3, "the image doesn't show the target (no chequerboard"),
    "another kind of target": (range(3), "circles:8x8:0.008:0.004", (), 3, "none of 3 images shows the target"),
    "no such file": ((0, 77), TEXT, (), 2, "77.png: the file is missing; an image file"),
    "the same image twice": ((0, 1, 0), TEXT, (), 2, "is the same image as"),
    "target in millimetres": (range(3), "chequerboard:9x6:20", (), 2, "--target: 'chequerboard:9x6:20'"),
    "no such dictionary": (range(3), "charuco:8x6:0.03:0.02:DICT_0", (), 2, "there is no dictionary DICT_0"),
    "no such parameter": (range(3), TEXT, ("--fix", "f"), 2, "--fix f: is not a parameter of the model; fx_px"),
    "no value to hold a focal length at": (range(3), TEXT, ("--fix", "fx_px"), 2, "fx_px=VALUE (px), above 0"),
    "a value that is none": (range(3), TEXT, ("--fix", "cx_px=middle"), 2, "is not a number; cx_px=VALUE"),
    "a page of no kind": (range(3), TEXT, ("--report", "x.png"), 2, "--report x.png: has no known ending; .html"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_cannot_be_is_refused(case: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """One clear last line, and the file that was there is as it was."""
    numbers, target, words, code, reason = REFUSALS[case]
    out = tmp_path / "camera.yaml"
    out.write_text("mine\n")
    assert calibrate(*images(folder, numbers), "--target", target, *words, "--out", str(out), "--force") == code
    said = capsys.readouterr()
    assert reason in said.err.splitlines()[-1] and "Traceback" not in said.err and said.out == ""
    assert out.read_text() == "mine\n" and [p.name for p in tmp_path.iterdir()] == ["camera.yaml"]


def test_images_of_two_sizes_are_refused(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    small = cv2.resize(cv2.imread(str(folder / "1.png"), cv2.IMREAD_UNCHANGED), (240, 180))
    cv2.imwrite(str(tmp_path / "small.png"), small)
    words = [*images(folder, [0]), str(tmp_path / "small.png"), "--target", TEXT, "--out", str(tmp_path / "c.yaml")]
    assert calibrate(*words) == 2
    assert "has 240 x 180 px and" in capsys.readouterr().err


def test_a_target_that_is_described_too_large_is_doubted(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    words = ["--target", "chequerboard:11x8:0.02", "--out", str(tmp_path / "c.yaml")]
    assert calibrate(*images(folder), *words) == 0
    assert "no image shows more than 9 x 6 of the target's 11 x 8 points" in capsys.readouterr().out


def test_a_target_comes_from_a_calibration_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "he.yaml"
    for content, what in (
        ({"target": "circles:8x8:0.008:0.004"}, parse_target("circles:8x8:0.008:0.004")),
        ({"kind": "chequerboard", "columns": 9, "rows": 6, "square_m": 0.025}, parse_target("chequerboard:9x6:0.025")),
        ({"provenance": {"command": f"gripmon calibrate plane 'a b.png' --target {TEXT}"}}, parse_target(TEXT)),
    ):
        path.write_text(yaml.safe_dump(content))
        assert target_of(str(path)) == what
    for content, why in (
        ("schema: x\n", "names no target; a file of gripmon calibrate"),
        ("target: he.yaml\n", "names no target"),
        ("target: 3\n", "names no target"),
        ("kind: discs\n", "Invalid value 'discs'"),
        ("target: {kind: circles, columns: 8}\n", "missing required field `rows`"),
        ("target: circles:8\n", "'circles:8' has 1 part after its kind; circles:COLUMNSxROWS"),
        ('provenance: {command: "--target \'"}\n', "names no target"),
        ("[", "he.yaml"),
    ):
        path.write_text(content)
        with pytest.raises(InputError, match=re.escape(why)):
            target_of(str(path))
    assert calibrate("x.png", "--target", str(tmp_path / "none.yaml"), "--out", str(tmp_path / "c.yaml")) == 2
    assert "none.yaml" in capsys.readouterr().err


def test_a_target_described_too_small_is_refused(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for k in (0, 1, 2, 4, 5, 6):
        image = cv2.imread(str(folder / f"{k}.png"), cv2.IMREAD_UNCHANGED)
        if k > 2:
            image[:, :220] = image.mean()
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    target, out = ("--target", "checkerboard:8x6:0.02"), tmp_path / "camera.yaml"
    assert calibrate(*images(tmp_path, (4, 5, 6)), *target, "--out", str(tmp_path / "part.yaml")) == 0
    capsys.readouterr()
    assert calibrate(*images(tmp_path, (0, 1, 2, 4, 5, 6)), *target, "--out", str(out)) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.fullmatch(r"--target: \d of 6 images show a larger one \(.*9 x 6 .* 8 x 6\); its full size", last)
    assert not out.exists()
