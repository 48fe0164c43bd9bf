"""The configuration of a second camera: faults in one line, and what ``gripmon check`` says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.pulsed_scenes import PULSE_NS, Cell, cell, write_config, write_folder, write_table

from gripmon.cli import main
from gripmon.daemon.config import ConfigError, builtin_config, load_config, load_second


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("second")
    write_folder(cell(), out, 2)
    return out


def changed(path: Path, **sections: object) -> Path:
    """Beside it, with other sections; None leaves one out."""
    values = {**yaml.safe_load(path.read_text()), **sections}
    out = path.with_name("changed.yaml")
    out.write_text(yaml.safe_dump({key: value for key, value in values.items() if value is not None}))
    return out


def laser(**more: object) -> dict[str, object]:
    return {"calibration": str(cell().folder / "laser.yaml"), "pulses": "pulses.csv", **more}


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"laser": {}}, "laser.calibration: is missing; text: file of gripmon calibrate laser"),
        ({"laser": {"calibration": "none.yaml"}}, "laser.calibration: there is no file"),
        ({"laser": {"calibration": "images"}}, "laser.calibration: there is no file"),
        ({"laser": {"calibration": "second.yaml"}}, "second.yaml: schema: is missing; schema: gripmon.laser_cal"),
        ({"gripper": "fingers.yaml"}, "gripper: stands beside laser; laser for a second camera, or gripper for a"),
        ({"camera": {"model": "paper"}}, "camera: stands beside laser"),
        ({"laser": laser(pulse="a")}, "laser.pulse: unknown key, did you mean 'pulses'?"),
        ({"laser": laser(frames={"margin_s": -1})}, "laser.frames.margin_s: is -1; a number >= 0"),
        ({"laser": laser(watch={"warn_m": "far"})}, "laser.watch.warn_m: is 'far'"),
        ({"laser": laser(pulses=None)}, "laser.pulses: is missing; a table of the recorded pulses"),
        ({"laser": laser(pulses="none.csv")}, "none.csv: there is no such file; a table stamp_ns,until_ns"),
        ({"source": {"kind": "folder", "path": "nowhere"}}, "source.path: there is no folder"),
        ({"source": {"kind": "simulator"}}, "source.kind: is simulator, which shows a gripper and no laser"),
        ({"source": {"kind": "live", "device": 0}}, "laser.pulses: has no effect with a live camera"),
        (
            {"source": {"kind": "live", "device": 0}, "laser": {"calibration": "L"}},
            "publish.enabled: is false, and the source is a live camera",
        ),
        ({"source": {"kind": "zenoh"}, "laser": {"calibration": "L"}}, "publish.enabled: is false"),
        ({"robot": "a/b"}, "robot: is 'a/b'"),
    ],
)  # fmt: skip
def test_a_fault_is_one_line(folder: Path, sections: dict[str, object], said: str, capsys: pytest.CaptureFixture[str]):
    wanted = sections.get("laser")
    if isinstance(wanted, dict) and wanted.get("calibration") == "L":
        sections = {**sections, "laser": {"calibration": str(cell().folder / "laser.yaml")}}
    if isinstance(wanted, dict):
        sections = {**sections, "laser": {k: v for k, v in sections["laser"].items() if v is not None}}  # type: ignore[attr-defined]
    path = changed(write_config(cell(), folder, None), **sections)
    for command in ("check", "run"):
        assert main([command, str(path)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line and ".yaml" in line


def bad_table(folder: Path, change: str) -> Path:
    """``pulses.csv`` with one fault, under another name."""
    lines = (folder / "pulses.csv").read_text().splitlines()
    first = lines[1].split(",")
    if change == "empty":
        lines = lines[:1]
    elif change == "ragged":
        lines[1] += ",1"
    elif change == "no end":
        lines = [",".join(line.split(",")[:1] + line.split(",")[2:]) for line in lines]
    elif change == "text":
        lines[1] = ",".join(["soon", *first[1:]])
    elif change == "backwards":
        lines[1] = ",".join([first[1], first[0], *first[2:]])
    elif change == "overlapping":
        lines.append(",".join([str(int(first[0]) + 1000), *first[1:]]))
    elif change == "millimetres":
        lines[1] = ",".join([*first[:2], *(str(1000.0 * float(v)) for v in first[2:5]), *first[5:]])
    elif change == "degrees":
        lines[1] = ",".join([*first[:5], "90", *first[6:]])
    elif change == "seconds":
        lines[1] = ",".join([first[0], str(int(first[0]) + 1000 * PULSE_NS), *first[2:]])
    (folder / "bad.csv").write_text("\n".join(lines) + "\n")
    return folder / "bad.csv"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("empty", "bad.csv: holds no row"),
        ("ragged", "bad.csv: line 2 has another number of fields than the header; 9"),
        ("no end", "bad.csv: line 2: has no until_ns; a whole number of nanoseconds"),
        ("text", "bad.csv: line 2: stamp_ns is 'soon'"),
        ("backwards", "bad.csv: line 2: until_ns is not after stamp_ns"),
        ("overlapping", "bad.csv: line 4: begins before the pulse of line 2 ends"),
        ("millimetres", "which no arm reaches: millimetres? metres"),
        ("degrees", "bad.csv: line 2: the quaternion 90"),
        ("seconds", "bad.csv: line 2: lasts 200 s; 60 s at most"),
    ],
)
def test_a_table_of_pulses_with_a_fault(
    folder: Path, change: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bad_table(folder, change)
    path = changed(write_config(cell(), folder, None), laser=laser(pulses="bad.csv"))
    assert main(["run", str(path)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith(f"{path}: laser.pulses: ") and said in line and ";" in line


def test_a_table_may_stand_in_any_order_with_any_pose(tmp_path: Path):
    found: Cell = cell()
    write_folder(found, tmp_path, 1)
    begins = np.array([3_000_000_000, 1_000_000_000])
    write_table(tmp_path / "pulses.csv", found.data.base_T_ee[:2], {"stamp_ns": begins, "until_ns": begins + PULSE_NS})
    pulses = load_second(write_config(found, tmp_path, None)).pulses
    assert [pulse.stamp_ns for pulse in pulses] == [1_000_000_000, 3_000_000_000]
    np.testing.assert_allclose(pulses[0].base_T_ee, found.data.base_T_ee[1], atol=1e-9)


def test_images_of_another_size_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]):
    calibration = yaml.safe_load((cell().folder / "laser.yaml").read_text())
    calibration["camera"]["width_px"] = 800
    (folder / "wide.yaml").write_text(yaml.safe_dump(calibration))
    path = changed(write_config(cell(), folder, None), laser=laser(calibration="wide.yaml"))
    assert main(["check", str(path)]) == 2
    assert "laser.calibration: 800 x 480 px; 0000.png is 640 x 480" in capsys.readouterr().err


def test_check_says_what_it_comes_to(folder: Path, capsys: pytest.CaptureFixture[str]):
    path = write_config(cell(), folder, None)
    assert main(["check", str(path), "--verbose"]) == 0
    said = capsys.readouterr().out
    assert f"{path}: sound" in said and "cell/second, watched by a pulsed laser" in said
    assert "90 of 90 spots" in said and "6 frames, first one 0000.png, 640 x 480 px" in said
    assert main(["check", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [row["pulses"] for row in report["foreseen"]["noticed"]] == sorted(
        row["pulses"] for row in report["foreseen"]["noticed"]
    )
    assert "detects    with 0.1 false alarms in 1000 pulses" in said
    assert report["pulses"]["count"] == 2 and report["pulses"]["key"] is None
    assert report["calibration"]["sigmas"]["base_T_cam.x_m"] == pytest.approx(8.6e-4, rel=0.3)


def test_the_shipped_example_says_where_pulses_come_from(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(builtin_config("second_camera.yaml")), "--verbose"]) in (0, 3)  # is there a camera here?
    assert "by the robot's program on gripmon/arm1/second/pulse" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["teach", "sweep"])
def test_other_commands_refuse_it_in_words(folder: Path, command: str, capsys: pytest.CaptureFixture[str]):
    path = write_config(cell(), folder, None)
    with pytest.raises(ConfigError, match="laser: makes this the configuration of a second camera; a wrist camera's"):
        load_config(path)
    arguments = {
        "teach": ["teach", str(folder / "images" / "0000.png"), "--config", str(path), "--out", str(folder / "t.yaml")],
        "sweep": ["check", str(path), "--sweep"],
    }[command]
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "makes this the configuration of a second camera" in line


def test_options_of_a_wrist_camera_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(write_config(cell(), folder, None)), "--fresh-state"]) == 2
    assert "--fresh-state: is for wrist cameras" in capsys.readouterr().err
