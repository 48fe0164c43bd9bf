"""Cameras in the formats of others, read back by the others' own parsers where there are any, else by formulas."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore
from support.foreign_files import read_camera

from gripmon.calibrate.foreign import InterchangeError
from gripmon.calibrate.interchange import FORMATS, fit_brown_conrady, write_camera
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens, make_camera

SIZE = {"width_px": 1280, "height_px": 962}
PINHOLE = {"fx_px": 1203.0 + 1.0 / 3.0, "fy_px": 1199.5, "cx_px": 641.0000000000001, "cy_px": 470.7, **SIZE}
SHORT = (-0.2812345678901234, 0.0967, 1e-05, -2.5e-4)
LENSES: dict[str, LensSettings] = {
    "none": BrownConradyLens(**PINHOLE),
    "brown4": BrownConradyLens(**PINHOLE, coefficients=SHORT),
    "brown5": BrownConradyLens(**PINHOLE, coefficients=(*SHORT, 0.0123)),
    "brown8": BrownConradyLens(**PINHOLE, coefficients=(0.31, -0.12, 1e-4, 2e-4, 0.01, 0.52, 0.03, 1e-3)),
    "brown12": BrownConradyLens(
        **PINHOLE, coefficients=(0.31, -0.12, 1e-4, 2e-4, 0.01, 0.52, 0.03, 1e-3, 1e-3, -2e-4, 5e-4, 1e-4)
    ),
    "fisheye": FisheyeLens(**PINHOLE, coefficients=(0.0121, -0.004, 1.5e-3, -2e-05)),
}
HAS = {
    "ros": ("none", "brown4", "brown5", "brown8", "brown12", "fisheye"),
    "kalibr": ("none", "brown4", "fisheye"),
    "opencv": ("none", "brown4", "brown5", "brown8", "brown12", "fisheye"),
    "mrcal": ("none", "brown4", "brown5", "brown8", "brown12"),
}
NOTES = ["gripmon calibrate export 'a b.yaml' --format x: # {\"} [", "f ± 0.2 px\nsecond line"]
POINTS_M = np.column_stack(
    [np.random.default_rng(3).uniform(-0.35, 0.35, (200, 2)), np.random.default_rng(4).uniform(0.9, 1.4, 200)]
)


def written(camera: LensSettings, kind: str, suffix: str = "", *, fit: bool = False) -> bytes:
    return write_camera(camera, kind, NOTES, name="wrist", file="camera.yaml", suffix=suffix, fit=fit).data


def by_opencv(matrix: np.ndarray, coefficients: np.ndarray, *, fisheye: bool) -> np.ndarray:
    zero = np.zeros(3)
    if fisheye:
        return cv2.fisheye.projectPoints(POINTS_M[:, None], zero, zero, matrix, coefficients)[0][:, 0]
    return cv2.projectPoints(POINTS_M, zero, zero, matrix, coefficients)[0][:, 0]


def projected(camera: LensSettings) -> np.ndarray:
    return make_camera(camera).project(POINTS_M)


@pytest.mark.parametrize(("kind", "lens"), [(k, lens) for k, lenses in HAS.items() for lens in lenses])
def test_what_is_written_is_read_back_to_the_last_digit(kind: str, lens: str):
    found = read_camera(written(LENSES[lens], kind), "anything")
    back = found.camera
    assert found.kind == kind and not found.warnings
    assert np.array_equal(projected(back), projected(LENSES[lens]))
    if kind == "ros":  # a name that YAML has another meaning for stays a name
        assert yaml.safe_load(write_camera(back, "ros", [], name="on", file="file").data)["camera_name"] == "on"
    else:  # ros writes four coefficients as five
        assert back == LENSES[lens]
    assert read_camera(written(back, kind), "file").camera == back


@pytest.mark.parametrize("lens", HAS["ros"])
def test_ros_takes_it_as_a_camera_info_message(lens: str):
    content = yaml.safe_load(written(LENSES[lens], "ros"))
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "wrist")
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    message = types["sensor_msgs/msg/CameraInfo"](
        header,
        content["image_height"],
        content["image_width"],
        content["distortion_model"],
        *(np.array(content[key]["data"], dtype=np.float64) for key in (
            "distortion_coefficients", "camera_matrix", "rectification_matrix", "projection_matrix"
        )),
        0,
        0,
        region,
    )  # fmt: skip
    sent = store.deserialize_cdr(
        store.serialize_cdr(message, "sensor_msgs/msg/CameraInfo"), "sensor_msgs/msg/CameraInfo"
    )
    for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        assert content[key]["rows"] * content[key]["cols"] == len(content[key]["data"])
    assert (sent.width, sent.height) == (SIZE["width_px"], SIZE["height_px"])
    names = {"brown8": "rational_polynomial", "brown12": "rational_polynomial", "fisheye": "equidistant"}
    assert sent.distortion_model == names.get(lens, "plumb_bob")
    found = by_opencv(sent.k.reshape(3, 3), sent.d, fisheye=sent.distortion_model == "equidistant")
    assert np.abs(found - projected(LENSES[lens])).max() < 1e-8
    assert np.array_equal(sent.p.reshape(3, 4)[:, :3], sent.k.reshape(3, 3))


@pytest.mark.parametrize("lens", HAS["kalibr"])
def test_kalibr_s_formulas_project_as_the_camera_does(lens: str):
    """There is no parser of Kalibr's in the package index; its file is plain YAML, its models are written down here."""
    camera = yaml.safe_load(written(LENSES[lens], "kalibr"))["cam0"]
    assert camera["camera_model"] == "pinhole" and camera["resolution"] == [1280, 962]
    x, y = (POINTS_M[:, :2] / POINTS_M[:, 2:]).T
    k = camera["distortion_coeffs"]
    r2 = x * x + y * y
    if camera["distortion_model"] == "radtan":
        radial = k[0] * r2 + k[1] * r2 * r2
        x, y = (
            x + x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y + y * radial + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y),
        )
    else:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
        x, y = x * bent / r, y * bent / r
    fu, fv, pu, pv = camera["intrinsics"]
    assert np.abs(np.stack([fu * x + pu, fv * y + pv], axis=1) - projected(LENSES[lens])).max() < 1e-8


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".xml", ".json"])
@pytest.mark.parametrize("lens", HAS["opencv"])
def test_opencv_opens_it(lens: str, suffix: str, tmp_path: Path):
    path = tmp_path / f"camera{suffix}"
    path.write_bytes(written(LENSES[lens], "opencv", suffix))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert storage.getNode("image_width").real() == 1280 and storage.getNode("image_height").real() == 962
    assert bool(storage.getNode("fisheye_model").real()) is (lens == "fisheye")
    coefficients = storage.getNode("distortion_coefficients").mat()
    found = by_opencv(storage.getNode("camera_matrix").mat(), coefficients, fisheye=lens == "fisheye")
    assert np.abs(found - projected(LENSES[lens])).max() < 1e-8
    assert read_camera(path.read_bytes(), "any name").camera == LENSES[lens]
    # Those who have no OpenCV read it, too.
    if suffix == ".json":
        assert "--format" in json.loads(path.read_text())["notes"]
    if suffix == ".xml":
        assert ElementTree.parse(path).getroot().find("image_width").text == "1280"


@pytest.mark.parametrize("lens", HAS["mrcal"])
def test_mrcal_s_readers_take_it(lens: str):
    """mrcal isn't in the package index.  Its reader in Python evaluates a literal, the one in C wants ``lensmodel``
    first and numbers by this expression.
    """
    text = written(LENSES[lens], "mrcal").decode()
    content = ast.literal_eval(text)
    assert set(content) == {"lensmodel", "intrinsics", "extrinsics", "imagersize"}
    assert text.index("'lensmodel'") < text.index("'intrinsics'")
    number = r"-?[0-9]*(\.[0-9]*)?([eE][+-]?[0-9]+)?"
    bare = re.sub(r"#[^\n]*\n", "\n", text)
    for key in ("intrinsics", "extrinsics", "imagersize"):
        inside = re.search(rf"'{key}':\s*\[([^]]*)\]", bare)[1]
        assert all(re.fullmatch(number, part.strip()) for part in inside.rstrip(", ").split(","))
    count = 0 if lens == "none" else int(lens[5:])
    assert content["lensmodel"] == ("LENSMODEL_PINHOLE" if lens == "none" else f"LENSMODEL_OPENCV{count}")
    assert len(content["intrinsics"]) == 4 + count and content["imagersize"] == [1280, 962]
    fx, fy, cx, cy, *rest = content["intrinsics"]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    assert np.abs(by_opencv(matrix, np.array(rest or [0.0] * 4), fisheye=False) - projected(LENSES[lens])).max() < 1e-8


THEIRS = {
    "ros": (
        (b"image_width: 640\nimage_height: 480\ncamera_name: narrow_stereo\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        b"  data: [580.46715,    0.     ,  315.27153,\n            0.     ,  576.62721,  247.47257,\n"
        b"            0.     ,    0.     ,    1.     ]\ndistortion_model: plumb_bob\ndistortion_coefficients:\n"
        b"  rows: 1\n  cols: 5\n  data: [0.134462, -0.311908, 1e-05, 0.003083, 0.000000]\n"
        b"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
        b"projection_matrix:\n  rows: 3\n  cols: 4\n  data: [587, 0, 316, 0, 0, 585, 248, 0, 0, 0, 1, 0]\n"),
        BrownConradyLens(
            width_px=640, height_px=480, fx_px=580.46715, fy_px=576.62721, cx_px=315.27153, cy_px=247.47257,
            coefficients=(0.134462, -0.311908, 1e-05, 0.003083, 0.0),
        ),
    ),
    "kalibr": (
        (b"cam0:\n  cam_overlaps: [1]\n  camera_model: pinhole\n"
        b"  distortion_coeffs: [-0.01316, 0.05008, -0.04506, 0.01241]\n  distortion_model: equidistant\n"
        b"  intrinsics: [461.629, 460.152, 362.680, 246.049]\n  resolution: [752, 480]\n  rostopic: /cam0/image_raw\n"),
        FisheyeLens(
            width_px=752, height_px=480, fx_px=461.629, fy_px=460.152, cx_px=362.68, cy_px=246.049,
            coefficients=(-0.01316, 0.05008, -0.04506, 0.01241),
        ),
    ),
    "opencv": (
        (b'<?xml version="1.0"?>\n<opencv_storage>\n<framesCount>20</framesCount>\n'
        b'<cameraResolution>\n  1280 720</cameraResolution>\n<cameraMatrix type_id="opencv-matrix">\n  <rows>3</rows>\n'
        b"  <cols>3</cols>\n  <dt>d</dt>\n  <data>\n1.2e+03 0. 640.5 0. 1.201e+03 360. 0. 0. 1.</data></cameraMatrix>\n"
        b'<dist_coeffs type_id="opencv-matrix">\n  <rows>1</rows>\n  <cols>5</cols>\n  <dt>d</dt>\n'
        b"  <data>\n    -0.1 0.02 0. 1.0e-03 0.</data></dist_coeffs>\n</opencv_storage>\n"),
        BrownConradyLens(
            width_px=1280, height_px=720, fx_px=1200.0, fy_px=1201.0, cx_px=640.5, cy_px=360.0,
            coefficients=(-0.1, 0.02, 0.0, 1e-3, 0.0),
        ),
    ),
    "mrcal": (
        (b"{\n    'lens_model':  'LENSMODEL_OPENCV4',\n\n    # intrinsics are fx,fy,cx,cy,distortion0,....\n"
        b"    'intrinsics': [ 1761.181055, 1761.250444, 1965.706996, 1087.518797, -0.01266, 0.0359, -2e-4, 5e-4,],\n"
        b"    # extrinsics are rt_fromref\n    'extrinsics': [ 2e-2, -3e-1, -1e-2,  1., 2, -3., ],\n"
        b"    'imagersize': [ 4000, 2200 ]\n}\n"),
        BrownConradyLens(
            width_px=4000, height_px=2200, fx_px=1761.181055, fy_px=1761.250444, cx_px=1965.706996, cy_px=1087.518797,
            coefficients=(-0.01266, 0.0359, -2e-4, 5e-4),
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", FORMATS)
def test_files_as_the_others_write_them(kind: str):
    data, camera = THEIRS[kind]
    found = read_camera(data, "given")
    assert (found.kind, found.camera) == (kind, camera)


def test_a_camchain_of_several_cameras_needs_to_be_told_which():
    one = THEIRS["kalibr"][0].decode()
    data = (one + one.replace("cam0:", "cam1:").replace("461.629", "500.5")).encode()
    with pytest.raises(InterchangeError, match="holds 2 cameras; gripmon calibrate import with --camera cam0 or cam1"):
        read_camera(data, "chain")
    assert read_camera(data, "chain", which="cam1").camera.fx_px == 500.5
    with pytest.raises(InterchangeError, match="cam7: is not a camera of this file; cam0 or cam1"):
        read_camera(data, "chain", which="cam7")


BAD = [
    ("ros", ("plumb_bob", "thin_prism_fisheye"), "distortion_model: 'thin_prism_fisheye' is not a model"),
    ("ros", ("0.000000]", "0.1, 0.2]"), "distortion_coefficients: holds 6 values; of plumb_bob 4 or 5"),
    ("ros", ("image_width: 640\n", ""), "image_width: is missing"),
    ("ros", ("image_width: 640\n", "image_width: 640\nimage_width: 641\n"), "line 2: the key 'image_width' is"),
    ("ros", ("580.46715,    0. ", "580.46715,    2.5 "), "camera_matrix: .* has a skew"),
    ("ros", ("0.134462", "much"), r"distortion_coefficients\[0\]: 'much' is not a number"),
    ("ros", ("0.134462", ".nan"), r"distortion_coefficients\[0\]: nan is not a number"),
    ("ros", ("0.134462", "true"), r"distortion_coefficients\[0\]: True is not a number"),
    ("ros", ("0.134462", "-9.0"), "no camera that can be used: coefficients"),
    ("ros", ("image_width: 640", "image_width: 640.5"), "image_width: 640.5 is not a whole number"),
    ("ros", ("  data: [580.46715", "  date: [580.46715"), "camera_matrix.data: is missing"),
    ("kalibr", ("pinhole", "omni"), "cam0.camera_model: 'omni' is not a model of gripmon's; pinhole"),
    ("kalibr", ("equidistant", "fov"), "cam0.distortion_model: 'fov' is not a model"),
    ("kalibr", ("[752, 480]", "[752]"), "cam0.resolution: holds 1 values"),
    ("kalibr", ("461.629, ", ""), r"cam0.intrinsics: holds 3 values; \[fu, fv, pu, pv\]"),
    ("opencv", ("dist_coeffs", "other"), "distortion_coefficients: is missing"),
    ("opencv", ("<cols>5</cols>", "<cols>5"), "not XML: mismatched tag"),
    ("opencv", ("1280 720", "1280"), "cameraResolution: "),
    ("mrcal", ("OPENCV4", "CAHVOR"), "'LENSMODEL_CAHVOR' is not a model of gripmon's; LENSMODEL_PINHOLE or"),
    ("mrcal", ("OPENCV4", "OPENCV8"), "intrinsics: holds 8 values; 12 numbers for LENSMODEL_OPENCV8"),
    ("mrcal", ("'imagersize'", "'size'"), "imagersize: is missing"),
    ("mrcal", ("2e-2", "__import__('os').getcwd()"), "is not a Python literal"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "change", "said"), BAD)
def test_bad_files_are_refused_in_one_line(kind: str, change: tuple[str, str], said: str):
    good = THEIRS[kind][0].decode()
    assert change[0] in good
    with pytest.raises(InterchangeError, match=said) as caught:
        read_camera(good.replace(*change).encode(), "their.file")
    text = str(caught.value)
    assert text.startswith("their.file: ") and "\n" not in text and len(text) < 500


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files_are_read_or_refused_and_nothing_else(kind: str):
    data, _ = THEIRS[kind]
    rng = np.random.default_rng(11)
    cut = [data[:n] for n in range(0, len(data), 23)]
    for _ in range(60):
        broken = bytearray(data)
        broken[int(rng.integers(len(data)))] = int(rng.integers(256))
        cut.append(bytes(broken))
    refused = 0
    for one in cut:
        said = None
        try:
            make_camera(read_camera(one, "x").camera)
        except InterchangeError as error:
            said = str(error)
            refused += 1
        assert said is None or "\n" not in said
    assert refused > 10


def test_content_that_is_none_of_them_is_said():
    for data in (b"", b"a: 1\n", b"[1, 2]", b"<robot/>", b'{"a": 1}\n{"a": 2}\n', b"%YAML:1.0\n---\na: 1\n"):
        with pytest.raises(InterchangeError, match="is in no format that is recognised; a camera of ROS, Kalibr,"):
            read_camera(data, "x")
    with pytest.raises(InterchangeError, match="is not text"):
        read_camera(b"\xff\x89PNG", "x")


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("kappa", [-3e-7, 1.9e-7])
def test_the_paper_s_lens_is_refused_or_fitted_as_near_as_said(kind: str, kappa: float):
    camera = PaperLens(
        width_px=768, height_px=576, fx_px=962.0, fy_px=950.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=kappa
    )
    with pytest.raises(InterchangeError, match=rf"camera.yaml: camera.model: {kind} has no lens .* --fit .* px off"):
        written(camera, kind)
    exported = write_camera(camera, kind, (), name="wrist", file="camera.yaml", fit=True)
    stated = float(re.search(r"Brown-Conrady, (\S+) px off", exported.warnings[0])[1])
    back = read_camera(exported.data, "x").camera
    # Equation (4), and OpenCV's own projection of the lens that was written.
    uv = np.random.default_rng(5).uniform(0, 1, (4000, 2)) * [767.0, 575.0]
    q = (uv - [383.5, 287.5]) / [962.0, 950.0]
    ideal = q * (1.0 + kappa * 962.0**2 * (q**2).sum(axis=1, keepdims=True))
    matrix = np.array([[back.fx_px, 0, back.cx_px], [0, back.fy_px, back.cy_px], [0, 0, 1]])
    points = np.column_stack([ideal, np.ones(len(ideal))])
    shown = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(back.coefficients))[0][:, 0]
    off = np.linalg.norm(shown - uv, axis=1).max()
    assert off <= 1.01 * stated + 1e-7
    if kind == "kalibr":
        assert 0.5 * stated < off and 0.01 < stated < 0.3
    else:
        assert stated < 1e-3
    assert stated == pytest.approx(fit_brown_conrady(camera, (4,) if kind == "kalibr" else (5, 8)).largest_px, rel=0.06)


def test_a_lens_that_no_fit_comes_near_is_refused_even_when_asked():
    camera = PaperLens(
        width_px=640, height_px=480, fx_px=600.0, fy_px=600.0, cx_px=320.0, cy_px=240.0, kappa_per_px2=2e-6
    )
    with pytest.raises(
        InterchangeError, match=r"the nearest is .* px off at most anywhere in the image; another format"
    ):
        written(camera, "kalibr", fit=True)
    assert read_camera(written(camera, "mrcal", fit=True), "x").camera.fx_px == 600.0


def test_a_fisheye_for_mrcal_and_one_that_sees_too_far():
    found = read_camera(written(LENSES["fisheye"], "mrcal", fit=True), "x").camera
    assert isinstance(found, BrownConradyLens)
    wide = FisheyeLens(width_px=1280, height_px=962, fx_px=420.0, fy_px=420.0, cx_px=640.0, cy_px=480.0)
    with pytest.raises(InterchangeError, match="too far to the side"):
        written(wide, "mrcal", fit=True)
