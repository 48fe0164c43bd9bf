"""``gripmon check --sweep`` as its users meet it: tables, lenses as axes, one-line faults."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from support.configurations import shipped
from support.simulated import STRONG_LENS

from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
from gripmon.cli import main
from gripmon.daemon.config import builtin_config, load_config
from gripmon.daemon.sweeping import sweep
from gripmon.model.camera import make_camera
from gripmon.model.errors import InputError
from gripmon.model.provenance import provenance_of
from gripmon.model.yaml_text import as_yaml

DEMO = builtin_config("demo.yaml")


def swept(capsys: pytest.CaptureFixture[str], *options: str) -> Any:
    assert main(["check", str(DEMO), "--sweep", *options, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def smallest(mount: Any) -> float:
    return max(mount["accuracy"]["drift"]["smallest"]["tcp_m"])


def test_the_best_mount_can_be_put_into_the_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    values = swept(capsys, "--distance", "0.09:0.13:3", "--tilt", "20,50")
    assert len(values["mounts"]) == 6
    best, present = values["mounts"][0], values["present"]
    assert best["works"] and smallest(best) < smallest(present)
    changes = (
        ("[0.0004, 0.0014, 0.1188]", str(best["cam_T_grip"]["translation_m"])),
        ("[0.267184, 0.003984, -0.001105, 0.963637]", str(best["cam_T_grip"]["rotation_xyzw"])),
    )
    (tmp_path / "best.yaml").write_text(shipped("demo.yaml", *changes))
    assert main(["check", str(tmp_path / "best.yaml"), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["reference"]["distance_m"] == pytest.approx(best["distance_m"])
    assert checked["accuracy"]["expected"]["tcp_m"] == pytest.approx(best["accuracy"]["expected"]["tcp_m"], rel=1e-6)
    assert smallest(checked) == pytest.approx(smallest(best), rel=1e-6)
    assert checked["in_view"]["border"]["smallest_px"] == pytest.approx(best["margin_px"], rel=1e-6)


def test_the_present_mount_is_that_of_the_configuration(capsys: pytest.CaptureFixture[str]):
    values = swept(capsys, "--distance", "0.1188", "--tilt", "31")
    assert main(["check", str(DEMO), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    for key in ("expected", "weakest"):
        there, here = (each["accuracy"][key]["tcp_m"] for each in (values["present"], checked))
        assert there == pytest.approx(here, rel=1e-9)
    assert math.degrees(values["present"]["tilt_rad"]) == pytest.approx(31.0, abs=0.01)
    assert values["mounts"][0]["worst_sigma_m"] == pytest.approx(values["present"]["worst_sigma_m"], rel=0.01)
    over_jaw = checked["in_view"]["jaw_travel"]["certainty"]
    there = dict(zip(over_jaw["opening_m"], over_jaw["worst_sigma_m"], strict=True))
    # Two edges have a bevel, which counts as taught.
    assert there[values["present"]["worst_at_m"]] == pytest.approx(values["present"]["worst_sigma_m"], rel=1e-3)
    # Without the part of the jaw's travel that is worst it isn't as bad.
    open_ones = swept(capsys, "--distance", "0.1188", "--tilt", "31", "--jaw", "0.03:0.06")["present"]
    assert open_ones["jaw"]["opening_m"][0] == 0.03 and open_ones["jaw"]["opening_m"][-1] == 0.06
    assert open_ones["worst_sigma_m"] < values["present"]["worst_sigma_m"]


def test_lenses_sides_and_rolls_are_axes_too(capsys: pytest.CaptureFixture[str]):
    options = (
        "--distance",
        "0.12",
        "--tilt",
        "30",
        "--side",
        "0,90",
        "--roll=-90:90:2",
        "--fov",
        "40,60",
        "--at",
        "384,288",
    )
    values = swept(capsys, *options)
    assert len(values["mounts"]) == 8 and values["tcp_at_px"] == [384.0, 288.0]
    assert {round(math.degrees(m["field_of_view_rad"])) for m in values["mounts"]} == {40, 60}
    assert {round(math.degrees(m["side_rad"])) for m in values["mounts"]} == {0, 90}
    assert {round(math.degrees(m["roll_rad"])) for m in values["mounts"]} == {-90, 90}
    ranks = [(not m["works"], -m["jaw"]["share"] * (not m["works"])) for m in values["mounts"]]
    assert ranks == sorted(ranks)


def camera_file(path: Path, lens: Any) -> Path:
    """As gripmon calibrate intrinsics writes it."""
    document = CameraCalibration(
        camera=lens,
        parameters=("fx_px",),
        covariance=(0.01,),
        residuals=CameraResiduals(rms_px=0.1, views=3, points=100, outliers=0),
        target="chequerboard:9x6:0.025",
        provenance=provenance_of("gripmon calibrate intrinsics", [], None),
    )
    path.write_text(as_yaml(msgspec.to_builtins(document)))
    return path


def test_calibrated_lenses_are_swept_with_their_distortion(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    half = msgspec.structs.replace(
        STRONG_LENS, width_px=384, height_px=288, fx_px=380.0, fy_px=378.5, cx_px=189.85, cy_px=145.05
    )
    files = [str(camera_file(tmp_path / f"{k}.yaml", lens)) for k, lens in enumerate((STRONG_LENS, half))]
    values = swept(capsys, "--distance", "0.11", "--tilt", "30", "--lens", files[0], "--lens", files[1])
    whole, small = sorted(values["mounts"], key=lambda m: -m["image_px"][0])
    for lens, mount, (u, v) in (
        (STRONG_LENS, whole, values["tcp_at_px"]),
        (half, small, np.array(values["tcp_at_px"]) / 2),
    ):
        at_px = make_camera(lens).project(np.array([mount["cam_T_grip"]["translation_m"]]))[0]
        np.testing.assert_allclose(at_px, (u, v), atol=0.3)
        assert mount["focal_px"] == lens.fx_px
    assert small["accuracy"]["expected"]["tcp_m"][2] > whole["accuracy"]["expected"]["tcp_m"][2]


def test_what_is_no_calibrated_lens_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = tmp_path / "other.yaml"
    other.write_text("fx_px: 3")
    for path in (other, tmp_path / "nothing.yaml"):
        assert main(["check", str(DEMO), "--sweep", "--lens", str(path)]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"--lens {path}") and said.count("\n") == 1


def test_the_table_names_the_best_and_the_present_mount_and_why_others_fail(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DEMO), "--sweep", "--distance", "0.06:0.3:4", "--tilt", "10:60:3"]) == 0
    text = capsys.readouterr().out
    assert "12 mounts tried" in text and "\nbest " in text and "\npresent " in text
    assert "would not work: too little in view in a part of the jaw's travel" in text
    assert "translation_m: [" in text


def test_a_gripper_without_faces_is_said_to_have_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As one is that was inferred from images."""
    content = yaml.safe_load(DEMO.read_text())
    gripper = yaml.safe_load((DEMO.parent / content["gripper"]).read_text())
    del gripper["faces"]
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(gripper))
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(content | {"gripper": "gripper.yaml"}))
    assert main(["check", str(config), "--sweep", "--distance", "0.115", "--tilt", "32,40"]) == 0
    said = capsys.readouterr().out
    assert "best as" in said and "no faces  The gripper file has none" in said
    assert main(["check", str(config)]) == 0
    assert "the gripper file has no faces, so self-occlusion isn't known" in capsys.readouterr().out


def test_a_sweep_in_which_nothing_works_says_why(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DEMO), "--sweep", "--distance", "4,5", "--tilt", "30"]) == 0
    text = capsys.readouterr().out
    assert "2 mounts tried, 0 would work" in text and "2 would not work: nowhere enough in view" in text
    assert "best as" not in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--distance", "0.1"], "--distance: applies only to a sweep; add --sweep"),
        (["--sweep", "--distance", "80:200:7"], "80 m is out of bounds; FIRST:LAST:COUNT or values with commas"),
        (["--sweep", "--distance", "0.1:0.2"], "--distance 0.1:0.2: isn't a range"),
        (["--sweep", "--distance", "nan"], "nan m is out of bounds"),
        (["--sweep", "--distance", ""], "--distance : isn't a range"),
        (["--sweep", "--jaw", "0.02"], "--jaw 0.02: isn't a range; MIN:MAX in metres, within 0:0.06"),
        (["--sweep", "--jaw", "0.02:0.2"], "--jaw 0.02:0.2: is not in the jaw's travel"),
        (["--jaw", "0.02:0.03"], "--jaw: applies only to a sweep"),
        (["--sweep", "--tilt", "10:60:0"], "--tilt 10:60:0: isn't a range"),
        (["--sweep", "--tilt", "ten"], "--tilt ten: isn't a range"),
        (["--sweep", "--tilt=-10"], "-10 degrees is out of bounds"),
        (["--sweep", "--fov", "200"], "200 degrees is out of bounds"),
        (["--sweep", "--focal", "4"], "--focal: fx_px: 4 px is not a focal length"),
        (["--sweep", "--at", "384"], "--at 384: isn't a point of the image"),
        (["--sweep", "--at", "384,700"], "--at: lies at (384.0, 700.0) px, outside of the image"),
        (["--sweep", "--at", "nan,3"], "outside of the image"),
        (["--sweep", "--tilt", "0:80:100", "--roll", "0:90:50"], "45000 mounts; at most 20000"),
        (["--sweep", "--picture", "sweep.png"], "--picture: not with --sweep, a table of what is forecast"),
    ],
)  # fmt: skip
def test_bad_input_is_said_in_one_line(options: list[str], said: str, capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DEMO), *options]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize(
    ("ranges", "said"),
    [
        ({"distance": (0.1, 80.0)}, "distance: 80 m is out of bounds; 0.005 to 5 m, at most 100"),
        ({"tilt": (float("nan"),)}, "tilt: nan degrees is out of bounds"),
        ({"roll": tuple(range(101))}, "roll: has 101 values"),
        ({"yaw": (1.0,)}, "ranges: yaw: isn't an axis of a sweep; distance, tilt, side, roll, focal, fov"),
    ],
)
def test_ranges_that_nobody_typed_are_checked_too(ranges: dict[str, tuple[float, ...]], said: str):
    with pytest.raises(InputError) as refused:
        sweep(load_config(DEMO), ranges)
    assert str(refused.value).startswith(said)


def test_a_focal_length_and_a_field_of_view_exclude_each_other(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(["check", str(DEMO), "--sweep", "--focal", "900", "--fov", "60"])
    assert ended.value.code == 2
    assert "not allowed with argument" in capsys.readouterr().err


def test_a_gripper_without_jaw_is_swept_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = builtin_config("visp_cube.yaml")
    assert main(["check", str(path), "--sweep", "--distance", "0.4,0.6", "--tilt", "30", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert all(len(m["jaw"]["opening_m"]) == 1 for m in values["mounts"]) and values["mounts"][0]["works"]
