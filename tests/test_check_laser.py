"""``gripmon check --laser``: what would be noticed, what fresh spots say, and bad input in one line each."""

from __future__ import annotations

import json
import math
import re

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.fresh_spots import AXES, calibration, fresh, known, pixels, poses, true_setup
from support.laser_scenes import write_csv

from gripmon.cli import main
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.laser import spot_image

POSE = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")


@pytest.fixture
def laser(tmp_path):
    path = tmp_path / "laser.yaml"
    path.write_text(as_yaml(msgspec.to_builtins(calibration())))
    return path


def pose_columns(base_T_ee):
    values = [*base_T_ee[:3, 3], *Rotation.from_matrix(base_T_ee[:3, :3]).as_quat()]
    return dict(zip(POSE, map(float, values), strict=True))


def table(path, setup, count=10, seed=1):
    where = poses()[:count]
    uv_px = fresh(setup, where, np.random.default_rng(seed))
    rows = [{"u_px": u, "v_px": v, **pose_columns(pose)} for (u, v), pose in zip(uv_px.tolist(), where, strict=True)]
    return write_csv(path, rows)


def test_without_spots_it_says_what_would_be_noticed(laser, capsys):
    assert main(["check", "--laser", str(laser), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["spots"] for row in report["noticed"]] == [3, 10, 30, 100]
    for key in ("position_m", "rotation_rad"):
        sizes = np.array([row[key] for row in report["noticed"]])
        assert (np.diff(sizes, axis=0) < 0.0).all(), "more spots tell smaller motions"
    low, high = report["spot_sigma"]["px"]
    assert 0.28 < low < high < 3.0
    assert main(["check", "--laser", str(laser), "--arm-noise", "0.001:0.002", "--json"]) == 0
    noisy = json.loads(capsys.readouterr().out)
    assert noisy["spot_sigma"]["px"][0] > 2.0 * low
    assert noisy["noticed"][0]["position_m"][0] > report["noticed"][0]["position_m"][0]
    assert main(["check", "--laser", str(laser)]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^weakest +spots 100, position .* mm, rotation .*°$", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("change", "code", "verdict", "cause"),
    [
        (None, 0, "same", None),
        (5e-3 * AXES[8], 3, "moved", "plane_moved"),
        (math.radians(1.0) * AXES[3], 3, "moved", "camera_mount_moved"),
        (math.radians(1.0) * AXES[9], 3, "moved", "laser_pointer_moved"),
    ],
)
def test_fresh_spots_are_judged(laser, tmp_path, capsys, change, code, verdict, cause):
    setup = true_setup() if change is None else true_setup().moved(change)
    spots = table(tmp_path / "fresh.csv", setup, 12)
    assert main(["check", "--laser", str(laser), str(spots), "--json"]) == code
    report = json.loads(capsys.readouterr().out)
    assert (report["verdict"], report["cause"]) == (verdict, cause)
    assert len(report["spots_judged"]) == 12
    first = report["spots_judged"][0]
    seen, foreseen = fresh(setup, poses()[:12], np.random.default_rng(1))[0], pixels(known().setup, poses()[:1])[0]
    assert np.allclose(first["off_px"], seen - foreseen) and np.allclose(first["foreseen_px"], foreseen)
    assert [d["ways"] for d in first["disagreements"]][-1] == ["beam", "ray"]
    assert main(["check", "--laser", str(laser), str(spots)]) == code
    text = capsys.readouterr().out
    assert re.search(f"^verdict +{verdict}: ", text, re.MULTILINE) and text.count("line ") == 12


def test_two_spots_that_are_far_off_are_not_enough_to_say_that_something_moved(laser, tmp_path, capsys):
    spots = table(tmp_path / "fresh.csv", true_setup().moved(0.05 * AXES[3]), 2)
    assert main(["check", "--laser", str(laser), str(spots)]) == 3
    assert re.search("^verdict +unclear: only 0 of 2 spots", capsys.readouterr().out, re.MULTILINE)


def test_spots_are_found_in_images_too(laser, tmp_path, capsys):
    rng = np.random.default_rng(4)
    rows = []
    for k, (pose, uv) in enumerate(zip(poses(), pixels(true_setup(), poses()[:5]), strict=False)):
        image = spot_image(uv, rng) if k != 2 else np.full((480, 640), 20, np.uint8)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
        rows.append({"image": f"{k}.png", **pose_columns(pose)})
    spots = write_csv(tmp_path / "fresh.csv", rows)
    assert main(["check", "--laser", str(laser), str(spots), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["used"] for row in report["spots_judged"]] == [True, True, False, True, True]
    assert report["spots_judged"][2]["fault"] == "no_spot" and report["spots_judged"][2]["off_px"] is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--laser", "{nothing}"], "there is no such file; a file of gripmon calibrate laser"),
        (["--laser", "{other}"], "schema: is missing"),
        (["--laser", "{laser}", "{nothing}"], "nothing.csv: there is no such file; a table of samples"),
        (["--laser", "{laser}", "{bad}"], "line 2: has no column tx_m"),
        (["--laser", "{laser}", "{outside}"], "is outside of the camera's image of 640 x 480 px"),
        (["--laser", "{laser}", "--sweep"], "--sweep: not with --laser"),
        (["--laser", "{laser}", "--tilt", "3:4:5"], "--tilt: applies only to a sweep"),
        (["--laser", "{laser}", "--wrong-spots", "0.9"], "--wrong-spots 0.9: too many; at most 0.5"),
        (["{other}", "--wrong-spots", "0.2"], "--wrong-spots: applies only to a laser calibration"),
        ([], "check: 0 configurations; one, or --laser LASER.yaml"),
        (["{other}", "{other}"], "check: 2 configurations"),
    ],
)
def test_bad_input_is_one_line(laser, tmp_path, capsys, arguments, said):
    (tmp_path / "other.yaml").write_text("a: 1\n")
    write_csv(tmp_path / "bad.csv", [{"u_px": 3.0, "v_px": 4.0}])
    write_csv(tmp_path / "outside.csv", [{"u_px": 3.0, "v_px": 4000.0, **pose_columns(poses()[0])}])
    names = {"laser": laser, "nothing": tmp_path / "nothing.csv", "other": tmp_path / "other.yaml"}
    names |= {"bad": tmp_path / "bad.csv", "outside": tmp_path / "outside.csv"}
    assert main(["check", *(word.format(**names) for word in arguments)]) == 2
    out, err = capsys.readouterr()
    assert said in err and len(err.splitlines()) == 1 and not out
