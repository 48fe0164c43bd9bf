"""A newcomer without hardware copies commands: those of the tutorial and of the README's section, just as printed, in
an empty folder.  Files are held against the simulator's truth, what is printed against what the page shows.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.loopback import wait_for_default_port

from gripmon.model.geometry import from_record, perturbation_between
from gripmon.model.records import Array, Transform

ROOT = Path(__file__).resolve().parent.parent
SECTION = "## From a new gripper to a running monitor"
CHI2_999 = {5: 20.5, 6: 22.5, 12: 32.9}
PATIENCE_S = 600.0
"""For any command on a busy machine; the monitor of a folder ends with its images."""


@dataclass(frozen=True)
class Block:
    """A block of commands as printed, and what the page shows of their output."""

    commands: list[str]
    shown: list[str]


def blocks_of(text: str) -> list[Block]:
    """Commands with their comments: a line each, continued lines joined."""
    found = []
    for code, shown in re.findall(r"```sh\n(.*?)```(?:\n+```text\n(.*?)```)?", text, re.DOTALL):
        lines = code.replace("\\\n", " ").splitlines()
        commands = [line for line in lines if line.strip() and not line.lstrip().startswith("#")]
        found.append(Block(commands, shown.splitlines()))
    return found


def page(name: str) -> list[Block]:
    text = (ROOT / name).read_text(encoding="utf-8")
    if name == "README.md":
        text = text[text.index(SECTION) + len(SECTION) :]
        text = text[: text.index("\n## ")]
    return blocks_of(text)


def run(command: str, folder: Path) -> tuple[int, str]:
    """Exit code and everything printed, of a shell that finds this environment's ``gripmon``."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=folder, env=os.environ | {"PATH": path}, text=True, timeout=PATIENCE_S,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


def without_measures(text: str) -> str:
    """Digits of what is measured, and times, may differ between machines; words and counts may not."""
    return " ".join(re.sub(r"[-+]?\d+(?:(?:[.:]\d+)+(?:e[-+]?\d+)?|e[-+]?\d+)", "#", text).split())


@dataclass(frozen=True)
class Walked:
    """The folder after all commands of a page, and what each of them printed."""

    folder: Path
    printed: dict[str, str]


def walk(name: str, folder: Path) -> Walked:
    blocks, printed = page(name), {}
    assert sum(len(block.commands) for block in blocks) >= 11
    for block in blocks:
        for command in block.commands:
            if command.startswith("gripmon run"):
                wait_for_default_port()
            code, out = run(command, folder)
            promised = re.search(r"# exit code (\d+)", command)
            assert code == (int(promised[1]) if promised else 0), f"{command}\n{out}"
            assert "Traceback" not in out
            printed[as_typed(command)] = out
        assert_shown(block, printed)
    return Walked(folder, printed)


def as_typed(command: str) -> str:
    """Without the comment and what a continued line indents."""
    return " ".join(command.partition("#")[0].split())


def assert_shown(block: Block, printed: dict[str, str]) -> None:
    """What a page shows of a block's output is what its commands printed."""
    said = without_measures("".join(printed[as_typed(command)] for command in block.commands))
    for line in block.shown:
        whole = rf"(?<!\S){re.escape(without_measures(line))}(?!\w)"
        assert re.search(whole, said), f"{line}\nisn't in\n{said}"


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Walked:
    return walk("docs/tutorials/first_run.md", tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def walked(tutorial: Walked) -> Path:
    return tutorial.folder


def test_the_readme_shows_commands_of_the_tutorial_and_what_they_print(tutorial: Walked):
    blocks = page("README.md")
    assert sum(len(block.commands) for block in blocks) >= 11
    for block in blocks:
        assert_shown(block, tutorial.printed)
    commands = [as_typed(command) for block in blocks for command in block.commands]
    images, rest = ([c for c in commands if c.startswith("gripmon simulate") is made] for made in (True, False))
    assert commands == images + rest, "images are there before they are needed"
    assert rest == [command for command in tutorial.printed if command in rest], "and files, too"


def test_the_camera_is_the_true_one(walked: Path):
    found, true = read(walked / "camera.yaml"), read(walked / "plate" / "truth.json")["camera"]
    off = np.array([found["camera"][name] - true[name] for name in found["parameters"]])
    assert len(off) == 5
    assert abs(found["camera"]["fx_px"] - true["fx_px"]) < 0.3
    assert off @ np.linalg.solve(square(found["covariance"]), off) < CHI2_999[5]


def test_gripper_and_hand_eye_are_the_true_ones(walked: Path):
    found, true = read(walked / "hand_eye.yaml"), read(walked / "standing" / "truth.json")
    error = perturbation_between(pose(found["cam_T_grip"]), np.array(true["cam_T_grip"]))
    assert (np.abs(error[:3]) < [2e-5, 2e-5, 5e-5]).all()
    assert error @ np.linalg.solve(square(found["covariance"]), error) < CHI2_999[6]
    points = {name: np.array(at["xyz_m"]) for name, at in read(walked / "gripper.yaml")["points"].items()}
    apart = points["right_inner_near"] - points["left_inner_near"]
    assert np.linalg.norm(apart) == pytest.approx(true["jaw_opening_m"], abs=3e-5)


def test_the_knock_is_noticed_and_measured(walked: Path):
    true = [json.loads(line) for line in (walked / "work" / "truth.jsonl").read_text().splitlines()]
    live = [json.loads(line) for line in (walked / "run" / "estimates.jsonl").read_text().splitlines()]
    again = [json.loads(line) for line in (walked / "replay.jsonl").read_text().splitlines()]
    assert len(live) == len(again) == len(true)
    knock = next(k for k, frame in enumerate(true) if np.linalg.norm(frame["tcp_shift_m"]) > 1e-6)
    assert knock == len(true) // 2
    for records in (live, again):
        alarms = [k for k, record in enumerate(records) if record["alerts"]]
        assert alarms and knock <= alarms[0] <= knock + 25
        assert [r["state"] for r in records][knock - 1] == "tracking" and records[-1]["state"] == "drifting"
        off = [
            perturbation_between(pose(record["cam_T_grip"]), np.array(frame["cam_T_grip"]))
            for record, frame in zip(records, true, strict=True)
        ]
        assert np.median(np.linalg.norm(np.array(off)[-30:, :2], axis=1)) < 3e-5
        assert np.median(np.linalg.norm(np.array(off)[:knock, :2], axis=1)) < 3e-5
        sizes = [e @ np.linalg.solve(square(r["covariance"]), e) for e, r in zip(off, records, strict=True)]
        assert np.median(sizes) < CHI2_999[6]
    assert "moved once" in (walked / "report.html").read_text(encoding="utf-8")


def test_the_arm_and_the_second_camera_are_the_true_ones(walked: Path):
    found, true = read(walked / "robot_world.yaml"), read(walked / "robot_world" / "truth.json")
    error = np.concatenate(
        [
            perturbation_between(pose(found["transforms"][name]), np.array(true[name]))
            for name in ("cam_T_ee", "base_T_target")
        ]
    )
    assert np.abs(error[[0, 1, 2, 6, 7, 8]]).max() < 3e-4
    assert error @ np.linalg.solve(square(found["covariance"]), error) < CHI2_999[12]
    laser, spots = read(walked / "laser.yaml"), read(walked / "spots" / "truth.json")
    off_m = pose(laser["base_T_cam"])[:3, 3] - np.array(spots["base_T_cam"])[:3, 3]
    sigmas_m = np.array([laser["sigmas"][f"base_T_cam.{axis}_m"] for axis in "xyz"])
    assert (np.abs(off_m) < 3.9 * sigmas_m).all() and np.abs(off_m).max() < 3e-3
    assert laser["plane"]["distance_cam_m"] == pytest.approx(spots["plane"]["distance_m"], abs=1e-3)


def test_a_page_is_read_as_a_shell_reads_it():
    text = "```sh\n# first\ngripmon a \\\n    --b  # exit code 3\n```\n\n```text\nseen 3.5 mm\n```\n```sh\nls\n```\n"
    first, second = blocks_of(text)
    assert [" ".join(c.split()) for c in first.commands] == ["gripmon a --b # exit code 3"]
    assert first.shown == ["seen 3.5 mm"] and second == Block(["ls"], [])
    assert without_measures("a +0.5 ± 1e-7 b at 1:02") == without_measures("a -12.0 ±\n 3e4 b at 22:13:21.5")
    assert without_measures("0.5 mm, 12 of 12 images") != without_measures("0.5 mm, 12 of 13 images")


def read(path: Path) -> dict[str, Any]:
    value = yaml.safe_load(path.read_text(encoding="utf-8"))  # JSON is YAML, too
    assert isinstance(value, dict)
    return value


def pose(value: dict[str, Any]) -> Array:
    return from_record(Transform(tuple(value["translation_m"]), tuple(value["rotation_xyzw"])))


def square(values: list[float]) -> Array:
    size = round(len(values) ** 0.5)
    return np.reshape(values, (size, size))
