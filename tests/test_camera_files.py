"""Cameras as other programs write them: what each file means, by OpenCV's projection or the program's own formula."""

from __future__ import annotations

import json
import time
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from support.camera_texts import COLMAP, KALIBR, OPENICC, ORB2, ORB3, OST, REALSENSE, STEREO, VINS
from support.foreign_files import read_camera

from gripmon.calibrate.camera_files import LARGEST_TANGENTIAL
from gripmon.calibrate.foreign import InterchangeError
from gripmon.cli import main
from gripmon.daemon.calibrations import camera_in
from gripmon.daemon.config.calibrated import read_camera as read_any_camera
from gripmon.model.camera import BrownConradyLens, FisheyeLens, make_camera
from gripmon.model.errors import InputError

POINTS_M = np.column_stack(
    [np.random.default_rng(3).uniform(-0.25, 0.25, (100, 2)), np.random.default_rng(4).uniform(0.9, 1.4, 100)]
)


def by_opencv(size, matrix, lens, fisheye: bool = False) -> tuple[tuple[int, int], np.ndarray]:
    fx, fy, cx, cy = matrix
    k, zero = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.zeros(3)
    if fisheye:
        return size, cv2.fisheye.projectPoints(POINTS_M[:, None], zero, zero, k, np.array(lens))[0][:, 0]
    return size, cv2.projectPoints(POINTS_M, zero, zero, k, np.array(lens, float))[0][:, 0]


KNOWN = {
    "kalibr cam0": (KALIBR, "cam0", by_opencv(
        (752, 480), (458.654, 457.296, 367.215, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))),
    "kalibr cam1": (KALIBR, "cam1", by_opencv(
        (512, 512), (190.44, 190.44, 252.59, 254.94), (-0.0135, 0.0020, -0.0117, 0.0025), True)),
    "orb-slam left": (ORB2, "LEFT.K", by_opencv(
        (752, 480), (458.654, 457.296, 367.215, 248.375), (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))),
    "orb-slam rectified": (ORB2, "Camera", by_opencv(
        (752, 480), (435.2046959714599, 435.2046959714599, 367.4517211914062, 252.2008514404297), (0.0,) * 4)),
    "orb-slam fisheye": (ORB3, None, by_opencv(
        (512, 512), (190.978477, 190.973307, 254.931706, 256.897442),
        (0.003482389402, 0.000715034845, -0.002053236141, 0.000202936736), True)),
    "vins": (VINS, None, by_opencv(
        (640, 512), (413.326, 413.702, 305.951, 259.444), (-0.0612, -0.0038, 0.0273, -0.0303), True)),
    "openicc": (json.dumps(OPENICC), None, by_opencv(
        (1920, 1080), (420.568, 420.568 * 1.0026, 959.857, 542.815), (-0.0119, -0.0392, 0.0185, -0.005), True)),
    "ost of Windows, the image last": (
        "\n".join([OST[OST.index("[narrow") :], OST[: OST.index("[narrow")]]).replace("\n", "\r\n"), None, by_opencv(
        (640, 480), (511.143797, 509.020589, 311.770522, 247.452470), (0.1989, -0.317682, 0.002252, -0.001667))),
    "ost": (OST, None, by_opencv(
        (640, 480), (511.143797, 509.020589, 311.770522, 247.452470), (0.1989, -0.317682, 0.002252, -0.001667))),
    # COLMAP's first pixel has its centre at 0.5.
    "colmap 1": (COLMAP, "1", by_opencv((3072, 2304), (2559.81, 2559.81, 1535.5, 1151.5), (-0.0205, 0, 0, 0))),
    "colmap 2": (COLMAP, "2", by_opencv((1280, 720), (900.5, 901.25, 640.0, 359.75), (-0.1, 0.05, 0.001, -0.002))),
    "colmap 3": (COLMAP, "3", by_opencv(
        (1280, 720), (1100.5, 1101.25, 640.0, 359.75), (0.31, -0.12, 0.001, -0.002, 0.01, 0.52, 0.03, 0.001))),
    "colmap 4": (COLMAP, "4", by_opencv(
        (1280, 720), (500.5, 501.25, 640.0, 359.75), (0.01, -0.004, 0.0015, -2e-05), True)),
    "colmap 5": (COLMAP, "5", by_opencv((1280, 720), (500.5, 500.5, 640.0, 359.75), (0.01, -0.004, 0.0, 0.0), True)),
    "colmap 6": (COLMAP, "6", by_opencv((1280, 720), (900.5, 901.25, 640.0, 359.75), (0.0,) * 4)),
    "realsense color": (json.dumps(REALSENSE), "color", by_opencv(
        (848, 480), (604.7, 604.5, 421.9, 246.6), (-0.05, 0.06, 5e-4, -3e-4, -0.02))),
    "realsense depth": (json.dumps(REALSENSE, indent="\t"), "depth", by_opencv(
        (848, 480), (422.0, 422.0, 424.1, 238.7), (-0.0022, 0.0376, -0.0364, 0.0059), True)),
}  # fmt: skip


@pytest.mark.parametrize("name", KNOWN)
def test_each_file_means_what_its_program_means(name: str):
    text, which, (size, expected_px) = KNOWN[name]
    found = read_camera(text.encode(), "their.file", which=which)
    assert found.kind == name.partition(" ")[0] and not found.warnings
    assert (found.camera.width_px, found.camera.height_px) == size
    np.testing.assert_allclose(make_camera(found.camera).project(POINTS_M), expected_px, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("which", ["M1", "M2"])
def test_stereo_of_opencv_is_asked_for_the_camera_and_the_size(which: str):
    with pytest.raises(InterchangeError, match="holds 2 cameras; gripmon calibrate import with --camera M1 or M2"):
        read_camera(STEREO.encode(), "x")
    with pytest.raises(InterchangeError, match=r"doesn't say the image's size; .* with --size"):
        read_camera(STEREO.encode(), "x", which=which)
    found = read_camera(STEREO.encode(), "x", which=which, size_px=(640, 480)).camera
    storage = cv2.FileStorage(STEREO, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    k, d = (storage.getNode(key).mat() for key in (which, which.replace("M", "D")))
    expected = cv2.projectPoints(POINTS_M, np.zeros(3), np.zeros(3), k, d)[0][:, 0]
    np.testing.assert_allclose(make_camera(found).project(POINTS_M), expected, rtol=0.0, atol=1e-8)
    assert len(found.coefficients) == 5  # and no zeros of models that it isn't


ECHO = {
    "height": 480, "width": 640, "distortion_model": "plumb_bob",
    "binning_x": 0, "binning_y": 0, "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
}  # fmt: skip
D, K = [-0.05, 0.06, 5e-4, -3e-4, -0.02], [616.8, 0.0, 321.8, 0.0, 616.6, 239.9, 0.0, 0.0, 1.0]


@pytest.mark.parametrize("capital", [True, False])
def test_a_topic_as_ros_prints_it(capital: bool):
    keys = ("D", "K") if capital else ("d", "k")
    text = json.dumps({**ECHO, **dict(zip(keys, (D, K), strict=True))})
    lines = [f"{key}: {json.dumps(value)}" for key, value in json.loads(text).items()]
    one = "\n".join(["header:", "  stamp: {sec: 1, nanosec: 2}", *lines])
    found = read_camera(f"{one}\n---\n{one}\n---\n".encode(), "x")
    assert found.kind == "ros" and found.camera == read_camera(text.encode(), "x").camera
    _, expected = by_opencv((640, 480), (616.8, 616.6, 321.8, 239.9), D)
    np.testing.assert_allclose(make_camera(found.camera).project(POINTS_M), expected, rtol=0.0, atol=1e-8)


def test_a_topic_s_binning_moves_the_lens_as_it_moves_the_pixels():
    text = json.dumps({**ECHO, "d": D, "k": K, "binning_x": 2, "binning_y": 2})
    camera = read_camera(text.encode(), "x").camera
    assert (camera.width_px, camera.height_px) == (320, 240)
    _, sensor_px = by_opencv((640, 480), (616.8, 616.6, 321.8, 239.9), D)
    # Pixel k of the image is 2 k and 2 k + 1 of the sensor.
    np.testing.assert_allclose(make_camera(camera).project(POINTS_M), (sensor_px - 0.5) / 2, rtol=0.0, atol=1e-8)


def opencv_file(coefficients: list[float], more: str = "") -> bytes:
    return (
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 700., 0., 320., 0., 700., 240., 0., 0., 1. ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: {len(coefficients)}\n   cols: 1\n   dt: d\n"
        f"   data: {coefficients}\nimage_width: 640\nimage_height: 480\n{more}"
    ).encode()


def test_four_numbers_are_no_tangential_terms_when_they_are_too_large():
    near, far = 0.99 * LARGEST_TANGENTIAL, 1.01 * LARGEST_TANGENTIAL
    for p in ((far, 0.0), (0.0, -far)):
        data = opencv_file([-0.03, 0.005, *p])
        with pytest.raises(InterchangeError, match="with --model fisheye, or with --model brown_conrady"):
            read_camera(data, "x")
        assert isinstance(read_camera(data, "x", model="brown_conrady").camera, BrownConradyLens)
        fisheye = read_camera(data, "x", model="fisheye").camera
        assert isinstance(fisheye, FisheyeLens) and fisheye.coefficients == (-0.03, 0.005, *p)
    # A fisheye from a bug report, and a real lens of 2283 px: on either side of the limit.
    with pytest.raises(InterchangeError, match="--model fisheye"):
        read_camera(opencv_file([-0.0349, 0.0054, -0.0157, 0.0066]), "x")
    assert read_camera(opencv_file([0.044, 0.0, -0.002, -0.009, 0.0]), "x").camera.coefficients[3] == -0.009
    doubtful = read_camera(opencv_file([-0.03, 0.005, near, -near]), "x")
    assert isinstance(doubtful.camera, BrownConradyLens) and "cv2.fisheye also writes four" in doubtful.warnings[0]
    assert not read_camera(opencv_file([-0.03, 0.005, near, -near, 0.0]), "x").warnings
    assert not read_camera(opencv_file([-0.03, 0.005, near, -near], "fisheye_model: 0\n"), "x").warnings
    with pytest.raises(InterchangeError, match=r"mentions fisheye; .* --model fisheye"):
        read_camera(opencv_file([-0.03, 0.005, near, -near], 'model: "fisheye"\n'), "x")
    with pytest.raises(InterchangeError, match="says that its lens is a fisheye; without --model"):
        read_camera(opencv_file([-0.03, 0.005, near, far], "fisheye_model: 1\n"), "x", model="brown_conrady")
    with pytest.raises(InterchangeError, match="holds 5 coefficients; a fisheye has 4"):
        read_camera(opencv_file([-0.03, 0.005, near, -near, 0.1]), "x", model="fisheye")


def test_a_fisheye_that_is_called_plumb_bob_is_asked_for():
    message = {**ECHO, "width": 848, "height": 800, "k": [285.6, 0, 424.6, 0, 286.7, 408.2, 0, 0, 1],
               "d": [-0.0022, 0.0376, -0.0364, 0.0059, 0.0]}  # fmt: skip
    with pytest.raises(InterchangeError, match=r"p1 = -0.0364, p2 = 0.0059: more than 0.01;.*--model fisheye"):
        read_camera(json.dumps(message).encode(), "x")
    found = read_camera(json.dumps(message).encode(), "x", model="fisheye").camera
    assert isinstance(found, FisheyeLens) and found.coefficients == (-0.0022, 0.0376, -0.0364, 0.0059)


def test_a_wide_lens_of_mrcal_is_valid_where_it_is_monotonic():
    lens = (0.4800, 0.0267, 0.00004, -0.00001, 0.0001, 0.7680, 0.0964, 0.0014)
    intrinsics = ", ".join(map(str, (690.0, 691.0, 1001.0, 666.0, *lens)))
    text = (
        f"{{\n    'lensmodel':  'LENSMODEL_OPENCV8',\n    'intrinsics': [ {intrinsics},],\n"
        "    'extrinsics': [ 0, 0, 0, 0, 0, 0,],\n    'imagersize': [ 2004, 1338,],\n}\n"
    )
    camera = make_camera(read_camera(text.encode(), "x").camera)
    corners_px = np.array([[0.0, 0.0], [2003.0, 0.0], [2003.0, 1337.0], [0.0, 669.0]])
    xy = camera.undistort(corners_px)
    assert np.degrees(np.arctan(np.hypot(*xy.T))).max() > 80.0
    points = np.column_stack([xy, np.ones(len(xy))])
    matrix = np.array([[690.0, 0, 1001.0], [0, 691.0, 666.0], [0, 0, 1]])
    shown = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0][:, 0]
    np.testing.assert_allclose(shown, corners_px, rtol=0.0, atol=1e-5)
    folding = text.replace("0.48,", "-0.48,")
    assert folding != text
    with pytest.raises(InterchangeError, match="turns back on itself"):
        read_camera(folding.encode(), "x")


REFUSED = [
    (VINS.replace("KANNALA_BRANDT", "MEI"), "model_type: 'MEI' is not a model of gripmon's; PINHOLE or"),
    (VINS.replace("   k3: -0.0038\n", ""), "k3: is missing"),
    (ORB3.replace("Camera1.k4", "Camera1.k5"), "Camera1.k4: is missing"),
    (ORB3.replace("KannalaBrandt8", "DoubleSphere"), "Camera.type: 'doublesphere' is not a model"),
    (COLMAP.split("\n")[3].replace("SIMPLE_RADIAL", "FOV"), "camera 1: model: 'FOV' is not a model of gripmon's"),
    (COLMAP.split("\n")[3] + " 0.1", "camera 1: parameters: holds 5 values; 4 numbers for SIMPLE_RADIAL"),
    (json.dumps(OPENICC).replace("FISHEYE", "DIVISION_UNDISTORTION"), "intrinsic_type: 'DIVISION_UNDISTORTION'"),
    (json.dumps(OPENICC).replace('"skew": 0.0', '"skew": 0.4'), "intrinsics.skew: is 0.4"),
    (json.dumps(REALSENSE["color"]).replace("brown", "inverse_brown"), "inverse_brown_conrady isn't OpenCV's lens"),
    (json.dumps(REALSENSE["color"]).replace("brown", "modified_brown"), "modified_brown_conrady isn't OpenCV's lens"),
    (json.dumps(REALSENSE["color"]).replace("brown_conrady", "ftheta"), "'ftheta' is not a model"),
    (json.dumps(REALSENSE["color"]).replace("coeffs", "others"), "coeffs: is missing; 4 or 5 values; zeros if"),
    (OST.replace("511.143797 0.000000", "511.143797 much"), r"\[narrow_stereo\] camera matrix\[1\]: 'much' is not"),
    (OST.replace("camera matrix\n511.143797", "camera matrix\n"), r"camera matrix: holds 8 values; 3 x 3 numbers"),
    (json.dumps({**ECHO, "d": D, "k": [0.0] * 9}), "k: is all zeros: an uncalibrated camera"),
    (json.dumps({**ECHO, "d": D, "k": K, "roi": {"x_offset": 8, "width": 640, "height": 480}}), "roi: .* isn't part"),
    (KALIBR.partition("cam1")[0].replace("radtan", "[radtan]"), r"distortion_model: \['radtan'\] is not a model"),
    (json.dumps({**ECHO, "d": D, "k": K, "distortion_model": {"a": 1}}), "distortion_model: {'a': 1} is not a model"),
    (json.dumps({**ECHO, "d": D, "k": K}).replace("640", "6" * 5000), "not YAML: Exceeds the limit"),
    (OST.replace("width\n640", "width\n640.7"), r"\[image\] width: '?640.7'? is not a whole number; a num"),
    (OST.replace("width\n640", "width\n640 480"), r"\[image\] width: \['640', '480'\] is not a number"),
    (COLMAP.split("\n")[8].replace("1280", "1" * 5000), "camera 6: width: '11.* is not a number"),
    ("camera_matrix: {rows: 3, cols: 3, data: [1]}\ndistortion_model: equidistant\n", "image_width: is missing"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_what_a_file_misses_is_said_in_its_own_words(text: str, said: str):
    with pytest.raises(InterchangeError, match=said) as refused:
        read_camera(text.encode(), "their.file")
    assert str(refused.value).startswith("their.file: ") and "\n" not in str(refused.value)


def test_realsense_without_distortion_needs_no_model_that_is_opencv_s():
    zeros = {**REALSENSE["color"], "model": "RS2_DISTORTION_INVERSE_BROWN_CONRADY", "coeffs": [0.0] * 5}
    assert not any(read_camera(json.dumps(zeros).encode(), "x").camera.coefficients)
    as_yaml = b"color:\n  fx: 600.5\n  fy: 600.5\n  ppx: 320.0\n  ppy: 240\n  model: none\n  coeffs: [0, 0, 0, 0, 0]\n"
    assert read_camera(as_yaml, "x", size_px=(640, 480)).camera.fx_px == 600.5


STREAMS = """\
Device info:
    Name                          : \tIntel RealSense D435
Intrinsic Parameters:

 Intrinsic of "Depth" / 1280x720 / {Z16}
  Width:      \t1280
  Height:     \t720
  PPX:        \t639.5
  PPY:        \t360.25
  Fx:         \t640.5
  Fy:         \t640.5
  Distortion: \tBrown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0  \n  FOV (deg):  \t89.97 x 58.69

 Intrinsic of "Color" / 1280x720 / {YUYV/RGB8/BGR8}
  Width:      \t1280
  Height:     \t720
  PPX:        \t640.591186523438
  PPY:        \t365.166442871094
  Fx:         \t927.6630859375
  Fy:         \t927.691650390625
  Distortion: \tInverse Brown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0  \n  FOV (deg):  \t69.2 x 42.42

Motion Intrinsic Parameters:
"""


def test_what_rs_enumerate_devices_prints_is_a_camera_s_file():
    again = STREAMS[STREAMS.index(' Intrinsic of "Color"') :].replace("RGB8/BGR8", "Y16")
    for text in (STREAMS, STREAMS + again, STREAMS.replace("\n", "\r\n")):  # a stream stands there once a format
        found = read_camera(text.encode(), "x", which="Color/1280x720")
        assert found.kind == "realsense" and (found.camera.width_px, found.camera.height_px) == (1280, 720)
        assert (found.camera.fx_px, found.camera.cy_px) == (927.6630859375, 365.166442871094)
        assert not any(found.camera.coefficients)
    with pytest.raises(InterchangeError, match=r"holds 2 cameras; .* --camera Depth/1280x720 or Color/1280x720"):
        read_camera(STREAMS.encode(), "x")
    other = read_camera((STREAMS + again.replace("927.66", "900.66")).encode(), "x", which="Color/1280x720/YUYV/Y16")
    assert other.camera.fx_px == 900.6630859375
    with pytest.raises(InterchangeError, match=r"Color/1280x720: model: inverse_brown_conrady isn't OpenCV's lens"):
        read_camera(STREAMS.replace("\t0  \t0", "\t0.1  \t0").encode(), "x", which="Color/1280x720")
    sizes = [STREAMS.replace("1280x720", f"{n}x{n}") for n in (240, 424, 480, 640)]
    with pytest.raises(InterchangeError, match=r"holds 8 cameras; .* Color/240x240 or .*Depth/424x424 or …$"):
        read_camera("".join(sizes).encode(), "x")


def test_every_command_takes_the_file_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The readers behind --camera, --lens, a configuration's camera, verify and export are these two."""
    color = json.dumps(REALSENSE["color"])
    section = json.dumps({"camera": REALSENSE["color"]})  # as gripmon's own section is called
    files = (("cameras.txt", COLMAP.split("\n")[3]), ("a.json", color), ("c.yaml", section), ("b.yaml", VINS))
    for name, text in files:
        path, out = tmp_path / name, tmp_path / f"{name}.xml"
        path.write_text(text)
        found = read_camera(text.encode(), "x").camera
        assert camera_in(path).lens == found and read_any_camera(path).camera == found
        assert main(["calibrate", "verify", str(path), str(path), "--tolerance-px", "0.1"]) == 0
        assert main(["calibrate", "export", str(path), "--format", "opencv", "--out", str(out)]) == 0
        assert read_camera(out.read_bytes(), "x").camera == found
    (tmp_path / "four.yml").write_bytes(opencv_file([-0.03, 0.005, 1e-3, 0.0]))
    capsys.readouterr()
    assert main(["calibrate", "verify", str(tmp_path / "four.yml"), str(tmp_path / "b.yaml")]) == 2
    assert "four coefficients are read as k1 k2 p1 p2" in capsys.readouterr().err
    options = ("--size", "640x480", "--model", "brown_conrady", "--out", str(tmp_path / "four.yaml"))
    assert main(["calibrate", "import", str(tmp_path / "four.yml"), *options]) == 0
    assert msgspec.to_builtins(camera_in(tmp_path / "four.yaml").lens)["coefficients"] == (-0.03, 0.005, 1e-3, 0.0)


def test_a_principal_point_far_from_the_middle_is_doubted(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = tmp_path / "rs.json", tmp_path / "camera.yaml"
    for change in ({"ppx": 0.0, "ppy": 0.0}, {"width": 480, "height": 848}):
        path.write_text(json.dumps({**REALSENSE["color"], "coeffs": [0.0] * 5, **change}))
        with pytest.raises(InputError, match=r"principal point is at \(.*from the middle: .*; gripmon calibrate impor"):
            camera_in(path)
        assert main(["calibrate", "import", str(path), "--out", str(out), "--force"]) == 0
        assert "warning: the principal point is at (" in capsys.readouterr().out
        assert any("principal point" in warning for warning in read_any_camera(out).warnings)


def test_a_file_of_gripmon_s_needs_no_import(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, own = tmp_path / "rs.json", tmp_path / "camera.yaml"
    path.write_text(json.dumps(REALSENSE["color"]))
    assert main(["calibrate", "import", str(path), "--out", str(own)]) == 0
    capsys.readouterr()
    assert main(["calibrate", "import", str(own), "--out", str(tmp_path / "again.yaml")]) == 2
    assert "camera.yaml: is a file of gripmon's" in capsys.readouterr().err


def test_a_lens_with_more_coefficients_than_a_fisheye_has_comes_back_as_it_went_out():
    """Of a camera that leans: p2 is above what a fisheye's fourth coefficient is asked for from."""
    message = {**ECHO, "width": 1280, "height": 720, "k": [900.0, 0, 660.0, 0, 900.0, 389.0, 0, 0, 1],
               "d": [-0.05, 0.03, 0.0040371, 0.011349, -0.02]}  # fmt: skip
    lens = read_camera(json.dumps(message).encode(), "x").camera
    assert lens.coefficients[2:4] == (0.0040371, 0.011349)


def test_a_file_that_may_not_be_read_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "cam.yaml"
    path.write_text(VINS)

    def forbidden(*_args: object, **_kwargs: object) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    for name in ("read_bytes", "read_text"):
        monkeypatch.setattr(Path, name, forbidden)
    with pytest.raises(InputError, match=r"cam.yaml: can't be read \(Permission denied\); the path of a YAML file"):
        read_any_camera(path)


def test_a_size_as_one_list_may_have_the_height_first_and_is_asked_for():
    def listed(size: str) -> bytes:
        text = opencv_file([-0.03, 0.005, 1e-3, 0.0, 0.0]).decode()
        return text.replace("image_width: 640\nimage_height: 480", f"image_size: {size}").encode()

    assert read_camera(listed("[640, 480]"), "x").camera.width_px == 640
    with pytest.raises(InterchangeError, match=r"has the size \[480, 640\], .* middle of 640 x 480 px; .* --size"):
        read_camera(listed("[480, 640]"), "x")
    for size in ((640, 480), (480, 640)):
        camera = read_camera(listed("[480, 640]"), "x", size_px=size).camera
        assert (camera.width_px, camera.height_px) == size
    with pytest.raises(InterchangeError, match="says that images are 480 x 640 px"):
        read_camera(listed("[480, 640]"), "x", size_px=(320, 240))


def test_blank_lines_cost_no_more_than_others():
    """Each was searched to the end of all of them: 20000 took 1 s of processor time, 100000 25 times as much."""
    began = time.process_time()
    with pytest.raises(InterchangeError, match="is in no format"):
        read_camera(b"a: 1\n" + b" \n" * 100_000, "x")
    assert time.process_time() - began < 10.0
