"""Files from public bug reports, where they lie beside the project; each has its right value in its README."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.dataset as ds
import pytest

from gripmon.cli import main
from gripmon.daemon.calibrations import camera_in, read_calibrated
from gripmon.model.camera import FisheyeLens
from gripmon.model.geometry import from_record

CASES = next(
    (here for up in Path(__file__).resolve().parents for here in up.glob("shared/findings/*/public_cases")), None
)


def case(number: int) -> Path:
    """A case's folder; the test is left out where there is none."""
    found = [] if CASES is None else sorted(CASES.glob(f"{number:02}-*"))
    if not found:
        pytest.skip(f"public case {number} isn't here: shared/findings/…/public_cases")
    return found[0]


CAMERAS = [
    (6, "17_camchain_yaml10.yaml", (), (752, 480, 458.6, 457.3, 367.2, 248.4), (-0.28, 0.07, 0.0002, 0.00002)),
    (7, "wide.cameramodel", (), (2004, 1338, 690.0, 691.0, 1001.0, 666.0),
     (0.48, 0.0267, 4e-5, -1e-5, 1e-4, 0.768, 0.0964, 0.0014)),
    (9, "18_fisheye4.yaml", ("--model", "fisheye"), (1280, 720, 420.5, 420.7, 639.5, 359.5),
     (-0.0349, 0.0054, -0.0157, 0.0066)),
    (10, "08_echo_ros1.yaml", (), (640, 480, 616.8, 616.6, 321.8, 239.9), (0.0,) * 5),
    (10, "09_echo_ros2.yaml", (), (320, 240, 308.4, 308.3, 160.65, 119.7), (0.0,) * 5),
    (11, "01_pb8zero.yaml", (), (1280, 720, 900.5, 901.25, 639.5, 359.5), (-0.03, 0.035, -1e-4, -1e-4, -0.012)),
    (11, "03_eq5.yaml", (), (1280, 720, 900.5, 901.25, 639.5, 359.5), (-0.003, 0.054, -0.051, 0.0107)),
    (18, "13_rs.json", (), (640, 480, 616.8, 616.6, 321.8, 239.9), (0.0,) * 5),
    (18, "14_cameras.txt", (), (1280, 720, 900.5, 901.25, 639.5, 359.5), (-0.1, 0.05, 0.001, -0.002)),
    (18, "15_orb.yaml", (), (752, 480, 458.654, 457.296, 367.215, 248.375), (-0.28, 0.07, 0.0002, 0.00002)),
    (18, "16_vins.yaml", (), (752, 480, 461.6, 460.3, 363.0, 248.1), (-0.29, 0.082, 9.9e-5, 1.5e-4)),
    (18, "22_openicc.json", (), (2704, 2028, 796.85, 796.85 * 1.003, 1354.4, 1011.5),
     (-0.022, -0.019, 0.0017, -0.00017)),
    (18, "28_ost.txt", (), (1280, 720, 900.5, 901.25, 639.5, 359.5), (-0.1, 0.05, 0.001, -0.002, 0.0)),
    (19, "camera_info.yaml", ("--model", "fisheye"), (848, 800, 285.6, 286.7, 424.6, 408.2),
     (-0.0022, 0.0376, -0.0364, 0.0059)),
]  # fmt: skip


@pytest.mark.parametrize(("number", "name", "options", "pinhole", "lens"), CAMERAS)
def test_cameras(number: int, name: str, options, pinhole, lens, tmp_path: Path):
    path, out = case(number) / name, tmp_path / "camera.yaml"
    assert main(["calibrate", "import", str(path), *options, "--out", str(out)]) == 0
    camera = camera_in(out).lens
    found = (camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    assert found == pytest.approx(pinhole, rel=1e-12) and camera.coefficients == pytest.approx(lens, abs=0.0)
    fisheye = "--model" in options or name in ("03_eq5.yaml", "22_openicc.json")
    assert isinstance(camera, FisheyeLens) is fisheye
    if not options:
        assert camera_in(path).lens == camera  # as every command takes it


@pytest.mark.parametrize(
    ("number", "name", "options", "said"),
    [
        (8, "19_stereo.yml", ("--size", "640x480"), "holds 2 cameras; gripmon calibrate import with --camera M1 or M2"),
        # D1 was rounded in the report: with k1 = -0.26, k2 = -0.12 the lens folds before the corner.
        (8, "19_stereo.yml", ("--size", "640x480", "--camera", "M1"), "turns back on itself 342 px"),
        (9, "18_fisheye4.yaml", (), "p1 = -0.0157, p2 = 0.0066: more than 0.01; the third and fourth coefficient"),
        (19, "camera_info.yaml", (), "p1 = -0.0364, p2 = 0.0059: more than 0.01; the third and fourth coefficient"),
    ],
)
def test_what_is_asked(number: int, name: str, options, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["calibrate", "import", str(case(number) / name), *options, "--out", str(tmp_path / "a.yaml")]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "a.yaml").exists()


@pytest.mark.parametrize("name", ["easy1.yaml", "easy2.calib", "moveit.launch.py"])
def test_15_hand_eye_files(name: str, tmp_path: Path):
    path, out = case(15) / name, tmp_path / "reference.yaml"
    assert main(["calibrate", "import", str(path), "--out", str(out)]) == 0
    for file in (path, out):
        found = read_calibrated(file)
        cam_T_grip = from_record(found.cam_T_grip)
        assert found.frame == "tool0"
        np.testing.assert_allclose(cam_T_grip[:3, 3], [0.0, -0.0049, 0.1346], atol=1e-4)
        turn = np.radians(30.0)  # rotation_xyzw 0.2588, 0, 0, 0.9659
        expected = [[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]
        np.testing.assert_allclose(cam_T_grip[:3, :3], expected, atol=1e-4)
    assert main(["calibrate", "verify", str(path), str(out)]) == 0


def test_20_a_reference_in_camera_link(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from gripmon.daemon.config import builtin_config

    text = (case(20) / "bodyframe.yaml").read_text()
    grippers = builtin_config("demo.yaml").parent / "grippers"
    (tmp_path / "config.yaml").write_text(text.replace("grippers/", f"{grippers}/"))
    assert main(["check", str(tmp_path / "config.yaml")]) == 2
    said = capsys.readouterr().err
    assert "puts the TCP along the camera's x: the axes of a ROS body such as camera_link (x forward" in said


def test_16_asymmetric_circles(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, out = str(case(16)), tmp_path / "camera.yaml"
    assert main(["calibrate", "intrinsics", folder, "--target", "circles:4x11:0.02:0.007", "--out", str(out)]) == 3
    assert "the discs are staggered (asymmetric circles); --target acircles:4x11:0.02:0.007" in capsys.readouterr().err
    assert main(["calibrate", "intrinsics", folder, "--target", "acircles:4x11:0.02:0.007", "--out", str(out)]) == 0
    camera = camera_in(out).lens
    found = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    assert found == pytest.approx((900.0, 900.0, 639.5, 359.5), abs=1.0)


def test_17_a_board_of_another_dictionary(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder, out = str(case(17)), tmp_path / "camera.yaml"
    wrong, right = (f"charuco:8x6:0.035:0.024:{name}" for name in ("DICT_5X5_50", "DICT_4X4_50"))
    assert main(["calibrate", "intrinsics", folder, "--target", wrong, "--out", str(out)]) == 2
    assert f"markers of DICT_4X4_50 are in the images, not of DICT_5X5_50; {right}" in capsys.readouterr().err
    assert main(["calibrate", "intrinsics", folder, "--target", right, "--out", str(out)]) == 0
    assert camera_in(out).lens.fx_px == pytest.approx(900.0, abs=0.5)


TRUE_M = [0.0004, 0.0014, 0.1188]
"""Where the TCP is in all recordings of cases 1 to 5."""


def in_own_folder(number: int, to: Path) -> list[str]:
    """A recording and its configuration as a command's arguments, its results in a folder of the test's own."""
    folder = case(number)
    return [str(folder / "bag"), "--config", str(folder / "config.yaml"), "--out", str(to)]


def replayed(number: int, tmp_path: Path) -> list[dict]:
    """The records of a replay."""
    assert main(["replay", *in_own_folder(number, tmp_path / "replay.jsonl")]) == 0
    return [json.loads(line) for line in (tmp_path / "replay.jsonl").read_text().splitlines()]


def extrinsics(number: int, to: Path, *options: str) -> dict:
    """The one row of a dataset of one recording."""
    assert main(["dataset", *in_own_folder(number, to), "--workers", "1", *options]) in (0, 3)
    (row,) = ds.dataset(to / "stretches", partitioning="hive").to_table().to_pylist()
    return row


def is_right(row: dict) -> bool:
    """Whether a valid row is where the gripper is, and within its bound."""
    away_m = np.linalg.norm([row[f"cam_T_grip_t{axis}_m"] - true for axis, true in zip("xyz", TRUE_M, strict=True)])
    return row["verdict"] == "valid" and away_m < 5e-5 < row["protection_m"]


def test_1_a_region_of_interest_is_never_a_lens_that_is_off(tmp_path: Path):
    row = extrinsics(1, tmp_path / "theirs")
    assert row["verdict"] == "unknown" and row["cam_T_grip_tx_m"] is None
    assert "camera_info: roi: 768 x 576 px at 8, 6 isn't part of the 768 x 576 px that K is of" in row["reason"]
    own = extrinsics(1, tmp_path / "own", "--own-lens")
    assert is_right(own) and own["lens"] == "configuration"


def test_2_eight_coefficients_of_plumb_bob(tmp_path: Path):
    row = extrinsics(2, tmp_path / "theirs")
    assert is_right(row) and row["lens"] == "file"
    assert is_right(extrinsics(2, tmp_path / "own", "--own-lens"))


def test_3_one_stamp_of_the_future_costs_one_frame(tmp_path: Path):
    records = replayed(3, tmp_path)
    assert [record["verdict"] for record in records] == ["suspect", *["valid"] * 4, "suspect", *["valid"] * 10]
    assert records[5]["reason"].endswith("its time stamp is wrong: 86400 s later than the log's times say")


@pytest.mark.parametrize("number", [4, 5])
def test_4_and_5_pixels_are_as_the_sensor_has_them(number: int, tmp_path: Path):
    """JPEG with EXIF's orientation; 16 bits in the other byte order."""
    records = replayed(number, tmp_path)
    assert [record["verdict"] for record in records] == ["suspect", *["valid"] * (len(records) - 1)]
    places_m = [record["cam_T_grip"]["translation_m"] for record in records]
    np.testing.assert_allclose(places_m, [TRUE_M] * len(records), atol=1e-4)
