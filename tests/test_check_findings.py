"""What ``gripmon check`` says first, and that ``gripmon run`` judges a source as it does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from support.configurations import demo_in

from gripmon.cli import main
from gripmon.daemon.config import builtin_config

DEMO = builtin_config("demo.yaml")
WXYZ = [0.963637, 0.267184, 0.003984, -0.001105]  # the demo's quaternion in the other order


def written(folder: Path, **changes: Any) -> Path:
    """The demo's configuration with some of its sections changed key by key."""
    before = yaml.safe_load(DEMO.read_text())
    return demo_in(folder, **{k: v if k == "source" else {**before[k], **v} for k, v in changes.items()})


def checked(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, tuple[str, str]]]:
    """The exit code and, by what they are about, the level and text of what is found."""
    code = main(["check", str(path), "--json"])
    found = json.loads(capsys.readouterr().out)["findings"]
    return code, {each["about"]: (each["level"], each["text"]) for each in found}


def test_lines_are_those_of_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pose = {"translation_m": [0.0004, 0.0014, 0.1188], "rotation_xyzw": WXYZ}
    for path in (DEMO, written(tmp_path, reference={"cam_T_grip": pose})):
        code, found = checked(path, capsys)
        assert main(["check", str(path)]) == code
        headline, *rows = capsys.readouterr().out.splitlines()
        levels = [level for level, _ in found.values()]
        assert ("sound" in headline) == ("FAIL" not in levels) and ("warning" in headline) == ("WARN" in levels)
        for row, (about, (level, text)) in zip(rows, found.items(), strict=True):
            assert row.startswith(f"{level:<4}  {about}") and row.endswith(f"  {text}")


def test_what_the_forecast_leaves_open_is_said_in_words(capsys: pytest.CaptureFixture[str]):
    """Steps with their unit and axes, steps that are never noticed, and motions that end no view."""
    assert main(["check", str(DEMO), "--json"]) == main(["check", str(DEMO), "--verbose"]) == 0
    text, _, shown = capsys.readouterr().out.partition("\n}\n")
    values = json.loads(f"{text}}}")
    rows = [" ".join(line.split()) for line in shown.splitlines()]
    assert "step mm x y z" in rows
    for step_m, frames in values["accuracy"]["drift"]["delay_frames"].items():
        assert f"{1e3 * float(step_m):g} {' '.join('never' if n is None else str(n) for n in frames)}" in rows
    may = values["in_view"]["camera_may_move"]
    assert may["shift_m"]["z"][0] is may["turn_rad"]["z"][1] is None
    assert "shift -z more than 1000 mm -" in rows and "turn +z more than 180° -" in rows
    assert f"shift +x {1e3 * may['shift_m']['x'][1]:.4g} mm {may['shift_reason']['x'][1]}" in rows


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"kind": "live", "device": "wrist.avi"}, "source.device: 'wrist.avi' has no known form; an index (0), "),
        ({"kind": "live", "device": "0"}, "source.device: '0' is text; an index is a number without quotes"),
        ({"kind": "live", "device": -1}, "source.device: -1 is not an index; 0 for the first camera"),
        ({"kind": "folder", "path": "SEQUENCE"}, "camera.width_px: 768 x 576 px; 0.png is 1 x 1; the calibration that"),
        ({"kind": "folder", "path": "NOTHING"}, "source.path: no image in "),
    ],
)
def test_check_and_run_refuse_a_source_with_the_same_line(
    source: dict[str, object], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "SEQUENCE").mkdir()
    (tmp_path / "NOTHING").mkdir()
    assert cv2.imwrite(str(tmp_path / "SEQUENCE" / "0.png"), np.zeros((1, 1), np.uint8))
    path = written(tmp_path, source=source, jaw={"source": "fixed"})
    lines = []
    for command in (["check", str(path)], ["run", str(path), "--out", str(tmp_path / "out")]):
        assert main(command) == 2
        lines.append(capsys.readouterr().err)
    assert lines[0] == lines[1] and lines[0].startswith(f"{path}: {said}") and lines[0].count("\n") == 1
    assert not list((tmp_path / "out").glob("*")), "nothing was begun"


def test_frames_that_cannot_be_read_are_said_and_none_that_can_is_a_fault(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["simulate", "creep", "--out", str(tmp_path / "s"), "--seconds", "0.3", "--fps", "10"]) == 0
    config, images = tmp_path / "s" / "config.yaml", sorted((tmp_path / "s").glob("*.png"))
    images[0].write_bytes(b"")
    capsys.readouterr()
    code, found = checked(config, capsys)
    assert code == 0 and found["source"][0] == "WARN"
    assert found["source"][1].endswith(f"its first frame can't be read ({images[0].name}: the file is empty)")
    for image in images[1:]:
        image.write_bytes(b"")
    for command in (["check", str(config)], ["run", str(config)]):
        assert main(command) == 3
        assert "source.path: no frame of it can be read (" in capsys.readouterr().err


def test_a_quaternion_in_the_other_order_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, found = checked(DEMO, capsys)
    assert code == 0 and found["mount"][0] == "OK" and found["mount"][1].endswith("along the fingers at 31°")
    pose = {"translation_m": [0.0004, 0.0014, 0.1188], "rotation_xyzw": WXYZ}
    code, found = checked(written(tmp_path, reference={"cam_T_grip": pose}), capsys)
    assert code == 3 and found["mount"][0] == "FAIL"
    assert "in front of the fingertips" in found["mount"][1] and "read as w, x, y, z" in found["mount"][1]


def test_a_limit_that_is_out_of_reach_or_close_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    texts = {}
    for limit_m in (2e-5, 5e-4, 5e-3):
        code, found = checked(written(tmp_path, monitor={"policy": {"alert_limit_m": limit_m}}), capsys)
        assert code == 0
        texts[limit_m] = found["promise"]
    assert texts[2e-5][0] == "WARN" and "no transform can be valid" in texts[2e-5][1]
    assert "valid needs alert_limit_m of at least 0.000" in texts[2e-5][1]
    assert texts[5e-4][0] == "WARN" and "close to the alert limit" in texts[5e-4][1]
    assert texts[5e-3][0] == "OK"


def test_jaw_travel_beyond_the_limit_is_a_warning_unless_the_jaws_stand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert checked(DEMO, capsys)[1]["jaw travel"] == (
        "WARN",
        "of 0 to 60 mm: every transform is suspect at 0.0 mm",
    )
    _, found = checked(written(tmp_path, jaw={"source": "fixed"}), capsys)
    assert found["jaw travel"] == ("OK", "none: the opening is fixed at 34.0 mm")


@pytest.mark.parametrize(("fy_px", "level"), [(965.0, "OK"), (505.0, "WARN")])
def test_pixels_that_are_not_square_are_a_warning(
    fy_px: float, level: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """As where a focal length was mixed up with another number, or an image was squeezed."""
    _, found = checked(written(tmp_path, camera={"fy_px": fy_px}), capsys)
    assert found["camera"][0] == level and ("fy 505 px make pixels" in found["camera"][1]) == (fy_px == 505.0)


@pytest.mark.parametrize(("left", "right", "said"), [(-0.5, 0.5, None), (0.5, 0.5, "0 mm"), (-1.0, 1.0, "2 mm")])
def test_fingers_that_do_not_open_by_what_the_jaw_reports_are_a_warning(
    left: float, right: float, said: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    model = yaml.safe_load((DEMO.parent / "grippers" / "two_box_fingers.yaml").read_text())
    for name, share in zip(model["fingers"], (left, right), strict=True):
        model["fingers"][name]["motion"]["axis"] = [share, 0.0, 0.0]
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(model))
    path = written(tmp_path)
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "gripper": "gripper.yaml"}))
    _, found = checked(path, capsys)
    assert ("jaw" in found) == (said is not None)
    if said is not None:
        assert found["jaw"][0] == "WARN" and f"apart by {said} for each millimetre of opening" in found["jaw"][1]


def test_images_of_a_colour_camera_are_a_warning_until_their_response_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["simulate", "creep", "--out", str(tmp_path / "s"), "--seconds", "0.3", "--fps", "10"]) == 0
    config, (first, *_) = tmp_path / "s" / "config.yaml", sorted((tmp_path / "s").glob("*.png"))
    grey = cv2.imread(str(first), cv2.IMREAD_GRAYSCALE)
    coloured = np.dstack([grey // 2, grey, grey])
    for image, said, level in (
        (np.dstack([grey] * 3), {}, "OK"),
        (coloured, {}, "WARN"),
        (coloured, {"response": "srgb"}, "OK"),
    ):
        cv2.imwrite(str(first), image)
        values = yaml.safe_load(config.read_text())
        values["monitor"] = {"corners": {"edges": said}}
        config.write_text(yaml.safe_dump(values))
        capsys.readouterr()
        _, found = checked(config, capsys)
        assert found["source"][0] == level and ("gripmon teach finds" in found["source"][1]) == (level == "WARN")
        if image is coloured:
            main(["run", str(config)])  # of a live camera, only this tells
            assert ("gripmon teach finds" in capsys.readouterr().err) == (level == "WARN")


def test_openings_that_come_with_the_images_and_are_not_used_are_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["simulate", "creep", "--out", str(tmp_path / "s"), "--seconds", "0.3", "--fps", "10"]) == 0
    config, table = tmp_path / "s" / "config.yaml", tmp_path / "s" / "timestamps.csv"
    values = yaml.safe_load(config.read_text())
    told_m = float(table.read_text().splitlines()[1].split(",")[2])
    for jaw, level in (
        ({"source": "frames"}, "OK"),
        ({"source": "fixed", "opening_m": told_m}, "OK"),
        ({"source": "fixed", "opening_m": told_m + 0.001}, "WARN"),
    ):
        config.write_text(yaml.safe_dump(values | {"jaw": jaw}))
        capsys.readouterr()
        _, found = checked(config, capsys)
        assert found["source"][0] == level and ("jaw.source: frames" in found["source"][1]) == (level == "WARN")


def test_corners_of_which_none_can_be_measured_are_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As the four of a chamfered tip's front face, whose edges are a few pixels long: here it is their angle."""
    for angle_rad, level in ((0.2, "OK"), (1.5, "WARN")):
        angles = {"corners": {"corners": {"smallest_angle_rad": angle_rad}}}
        _, found = checked(written(tmp_path, monitor=angles), capsys)
        assert found["view"][0] == level
    assert "can be measured, but none of the 6 corners in view: the edges at each are too short" in found["view"][1]
