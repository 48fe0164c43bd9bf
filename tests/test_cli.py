"""The command line as its users meet it: exit codes, one-line faults, help, files on disk, Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.configurations import shipped
from support.gripmon_process import GRIPMON, ROOT, start
from support.loopback import free_port
from support.small_disks import fill, small_disk

from gripmon.cli import build_parser, main
from gripmon.daemon.config import builtin_config, load_config

COMMANDS = (
    "demo",
    "run",
    "watch",
    "router",
    "send",
    "schema",
    "feed",
    "replay",
    "dataset",
    "simulate",
    "check",
    "teach",
)


def options_below(parser: argparse.ArgumentParser, *called: str) -> Iterator[tuple[str, argparse.Action]]:
    """Every argument of every command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield from options_below(below, *called, name)
        else:
            yield " ".join([*called, action.dest]), action


def test_a_projects_folder_stands_for_its_files_in_every_command(tmp_path: Path):
    """Whatever reads a camera, a gripper, a hand/eye calibration or a configuration from a file; other paths stay."""
    usual = {"camera": "camera", "lens": "camera", "gripper": "gripper", "reference": "hand_eye", "config": "config"}
    found = {}
    for name, action in options_below(build_parser()):
        if callable(action.type) and isinstance(path := _converted(action.type, str(tmp_path)), Path):
            found[name] = path.relative_to(tmp_path)
            assert action.type(str(tmp_path / "own.yaml")) == tmp_path / "own.yaml"
    for name, file in found.items():
        of_project = usual.get(name.split()[-1])
        assert file == Path("" if of_project is None else f"{of_project}.yaml"), name
    assert {
        "run config", "check config", "check lens", "replay config", "teach camera", "teach gripper", "teach reference",
        "calibrate plane gripper", "calibrate laser camera", "calibrate robot-world camera", "calibrate verify config",
        "gripper from-cad reference", "gripper from-images camera",
    } <= found.keys()  # fmt: skip


def _converted(convert: Callable[[str], object], text: str) -> object:
    try:
        return convert(text)
    except (argparse.ArgumentTypeError, ValueError):
        return None


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated sequence on disk."""
    out = tmp_path_factory.mktemp("simulated") / "creep"
    assert main(["simulate", "creep", "--out", str(out), "--seconds", "1", "--fps", "8", "--seed", "5"]) == 0
    return out


def test_alone_it_prints_its_help(capsys: pytest.CaptureFixture[str]):
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^\s+{command}(?: |$)", text, re.MULTILINE) for command in COMMANDS)
    assert "exit codes" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_every_argument(command: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "examples:" in text and f"gripmon {command}" in text
    options = re.findall(r"^  (--?[\w-]+(?:, --[\w-]+)?|\w+)\b.*$", text.split("examples:")[0], re.MULTILINE)
    assert options
    assert not re.search(r"^  (--\S+( [A-Z.]+)?|[A-Z]+)\s*\n  (-|\w)", text, re.MULTILINE), (
        "an argument without a help text"
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["nonsense"],
        ["run"],
        ["replay", "x"],
        ["demo", "--seconds", "-3"],
        ["demo", "--seconds", "nan"],
        ["demo", "--fps", "fast"],
        ["demo", "--seed", "-1"],
        ["simulate", "bump", "--out", "x", "--seed", "-1"],
        ["check", "x.yaml", "--jsn"],
        ["send", "explode", "--robot", "arm"],
        ["send", "undo"],
        ["send", "undo", "--robot", "arm", "--timeout", "0"],
    ],
)
def test_wrong_usage_ends_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "gripmon" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["check"], ["run"], ["replay", str(ROOT / "docs"), "--out", "-", "--config"]])
def test_a_fault_in_the_configuration_is_one_line_and_exit_code_2(
    tmp_path: Path, command: list[str], capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "broken.yaml"
    path.write_text(builtin_config("demo.yaml").read_text().replace("fx_px: 962.0", "fx_px: 0.9"))
    assert main([*command, str(path)]) == 2
    said = capsys.readouterr()
    lines = said.err.splitlines()
    assert said.out == "" and len(lines) == 1
    assert lines[0].startswith(f"{path}: camera.fx_px: 0.9 ")
    assert "right would be" in lines[0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["check", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (["run", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (["replay", "nowhere", "--config", "{config}", "--out", "-"], "nowhere: there is no such file or folder"),
        (["replay", "nowhere", "--out", "-"], "nowhere: there is no such file or folder"),
        (["replay", "{folder}", "--config", "{config}", "--out", "-"], "no images in"),
        (["replay", "{config}", "--config", "{config}", "--out", "-"], "can't be opened as a video"),
        (["simulate", "nonsense", "--out", "{folder}/x"], "there is no 'nonsense'; one of demo, "),
        (["simulate", "bump", "--out", "{folder}/.."], "is not empty"),
        (["simulate", "bump"], "--out DIR"),
        (["simulate", "{folder}/s.yaml", "--out", "{folder}/x"], "there is no such file"),
        (["simulate", "series1", "--fps", "3", "--out", "{folder}/x"], "neither duration_s nor fps"),
        (["demo", "--seconds", "1"], "at least"),
        (["demo", "--out", "{config}"], "can't be made"),
        (["demo", "--fps", "1e9"], "$.fps"),
        (["demo", "--seconds", "1e9"], "$.duration_s"),
    ],
)
def test_other_faults_end_with_2_and_one_line(
    tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "empty"
    folder.mkdir()
    filled = [a.format(config=builtin_config("demo.yaml"), folder=folder) for a in arguments]
    assert main(filled) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and said in lines[0]


@pytest.mark.parametrize("arguments", [["static", "--seconds", "0.2"], ["plate"]])
def test_images_that_have_no_room_are_said_in_one_line(
    tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
):
    with small_disk(tmp_path / "disk", 100_000) as disk:
        out = disk / "images"
        out.mkdir()
        fill(disk)
        assert main(["simulate", *arguments, "--out", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"--out {out}: can't be written (") and line.endswith("; what is there isn't whole")


def test_estimates_that_cannot_be_written_are_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    estimates = tmp_path / "estimates.jsonl"
    estimates.mkdir()
    assert main(["run", str(builtin_config("demo.yaml")), "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"--out {estimates}: can't be written (Is a directory); a file\n"


def test_check_says_what_the_calibration_expects(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(builtin_config("demo.yaml")), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert sum(edge["visible"] for edge in report["edges"]) == 10
    hidden = {c["id"] for c in report["corners"] if not c["visible"]}
    assert hidden == {"L_out_far", "R_out_far"}
    assert math.isclose(report["reference"]["distance_m"], math.hypot(0.0004, 0.0014, 0.1188), rel_tol=1e-9)
    assert report["source"] == {"kind": "simulator", "reachable": True, "detail": "made by this program", "odd": None}


def test_check_tells_a_camera_that_is_absent_from_one_that_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    text, path = shipped("live_camera.yaml"), tmp_path / "live.yaml"
    path.write_text(text.replace("device: 0 ", f"device: rtsp://127.0.0.1:{free_port()}/wrist "))
    assert main(["check", str(path)]) == 3
    assert "NOT REACHABLE" in capsys.readouterr().out
    with socket.create_server(("127.0.0.1", 0)) as server:
        path.write_text(text.replace("device: 0 ", f"device: rtsp://127.0.0.1:{server.getsockname()[1]}/wrist "))
        assert main(["check", str(path)]) == 0
    assert "answers" in capsys.readouterr().out


def test_a_simulated_sequence_carries_its_truth_and_a_configuration_that_agrees(sequence: Path):
    truths = [json.loads(line) for line in (sequence / "truth.jsonl").read_text().splitlines()]
    stamps = (sequence / "timestamps.csv").read_text().splitlines()
    images = sorted(path.name for path in sequence.glob("*.png"))
    assert stamps[0] == "file,stamp_ns,jaw_opening_m"
    assert [line.split(",")[0] for line in stamps[1:]] == [t["file"] for t in truths] == images
    assert len(images) == 8
    config = load_config(sequence / "config.yaml")
    assert config.settings.jaw.source == "frames"
    np.testing.assert_allclose(config.cam_T_grip, truths[0]["cam_T_grip"], atol=1e-12)
    corners = {c["id"]: c["uv_px"] for c in truths[0]["corners"]}
    for name, uv in zip(config.gripper.corner_ids, config.view().corners_px, strict=True):
        np.testing.assert_allclose(uv, corners[name], atol=1e-6)
    assert np.linalg.norm(truths[-1]["tcp_shift_m"]) > 1e-3, "the creep has moved the TCP"


def test_the_seed_decides_what_is_simulated(sequence: Path, tmp_path: Path):
    for name, seed in (("same", "5"), ("other", "6")):
        arguments = ["simulate", "creep", "--out", str(tmp_path / name), "--seconds", "1", "--fps", "8", "--seed", seed]
        assert main(arguments) == 0
    image = "000003.png"
    assert (tmp_path / "same" / image).read_bytes() == (sequence / image).read_bytes()
    assert (tmp_path / "other" / image).read_bytes() != (sequence / image).read_bytes()


def test_a_scenario_file_on_an_own_gripper(tmp_path: Path):
    scenario = tmp_path / "s.yaml"
    scenario.write_text("name: mine\nduration_s: 0.2\nfps: 10\n")
    config = tmp_path / "c.yaml"
    config.write_text(shipped("live_camera.yaml"))
    assert main(["simulate", str(scenario), "--config", str(config), "--out", str(tmp_path / "out")]) == 0
    assert load_config(tmp_path / "out" / "config.yaml").gripper.name == "adaptive_arc_fingers"
    assert len(list((tmp_path / "out").glob("*.png"))) == 2


def test_ctrl_c_in_simulate_leaves_no_traceback(tmp_path: Path):
    out = tmp_path / "out"
    with start("simulate", "clutter", "--out", out) as process:
        wait_for(lambda: (out / "000002.png").exists(), process)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert err.strip() == "gripmon: interrupted"


@pytest.mark.parametrize("command", ["replay SEQUENCE --config SEQUENCE/config.yaml --out -", "schema", "check --help"])
def test_a_reader_that_has_seen_enough_is_no_fault(command: str, sequence: Path):
    """``gripmon … | head -0``: the pipe is closed before the first line."""
    arguments = [*GRIPMON, *command.replace("SEQUENCE", str(sequence)).split()]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        err = process.stderr.read()
    assert not re.search("Traceback|BrokenPipe|ignored", err)
    helped = command == "check --help"  # argparse takes no notice
    assert process.returncode == (0 if helped else 141)


def test_a_command_whose_output_was_closed_by_its_caller_says_its_line_all_the_same():
    words = " ".join([*GRIPMON, "check", "nothere.yaml"])
    done = subprocess.run(["bash", "-c", f"{words} >&-"], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2 and "nothere.yaml" in done.stderr and "Traceback" not in done.stderr


def test_a_path_that_cannot_be_looked_at_is_one_line(capsys: pytest.CaptureFixture[str]):
    """As one that nobody may search, which the tests' user may."""
    long = "n" * 300 + ".yaml"
    for words in (f"check {long}", f"calibrate verify {long} {long}", f"calibrate export {long} --format ros"):
        with contextlib.suppress(SystemExit):
            assert main(words.split()) == 2
        assert "File name too long" in capsys.readouterr().err


def test_one_thread_for_linear_algebra_unless_the_user_says_otherwise():
    code = "import os; from gripmon.cli import main; main(['simulate', '--list']); print(os.environ['OMP_NUM_THREADS'])"
    for given, expected in ((None, "1"), ("2", "2")):
        environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"}
        if given is not None:
            environment["OMP_NUM_THREADS"] = given
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment, cwd=ROOT
        )
        assert done.stdout.splitlines()[-1] == expected


def wait_for(condition: Any, process: subprocess.Popen[str], timeout_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline_s, "it never came"
        time.sleep(0.05)


BASH = r"""
source "$1"; shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMP_LINE="$*" COMP_POINT=${#COMP_LINE}
function=$(complete -p gripmon | sed 's/.*-F \([^ ]*\).*/\1/')
$function gripmon "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
echo "${COMPREPLY[@]}"
"""


def test_bash_completes_commands_options_and_choices(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As bash does it: the function that the script registers for ``gripmon`` fills COMPREPLY."""
    with pytest.raises(SystemExit) as ended:
        main(["--print-completion", "bash"])
    assert ended.value.code == 0
    script = tmp_path / "completion.bash"
    script.write_text(capsys.readouterr().out)

    def completed(*words: str) -> set[str]:
        command = ["bash", "-c", BASH, "bash", str(script), "gripmon", *words]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return set(done.stdout.split())

    assert completed("repl") == {"replay"}
    assert {"--config", "--recording", "--fps"} <= completed("replay", "--")
    assert completed("send", "re") == {"recalibrate", "reject", "reset"}
    assert "--print-completion" not in completed("--"), "it is not advertised"
    (tmp_path / "arm1").mkdir()
    (tmp_path / "arm1.yaml").touch()
    for words in (["run"], ["teach", "a.png", "--camera"], ["calibrate", "plane", "a.png", "--target"]):
        assert completed(*words, f"{tmp_path}/arm") == {f"{tmp_path}/arm1", f"{tmp_path}/arm1.yaml"}, words
    with pytest.raises(SystemExit) as refused:
        main(["--print-completion", "tcsh"])
    assert refused.value.code == 2


@pytest.mark.parametrize(
    ("words", "input_option"),
    [
        (["report", "a.jsonl", "kept.yaml", "--out", "kept.yaml"], "RECORDING"),
        (["correct", "kept.yaml", "--out", "./kept.yaml"], "RECORDING"),
        (["replay", "images", "--config", "kept.yaml", "--out", "kept.yaml"], "--config"),
    ],
)
def test_what_a_command_reads_is_not_its_output(
    words: list[str], input_option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("kept.yaml").write_text(shipped())
    Path("images").mkdir()
    cv2.imwrite("images/0.png", np.zeros((576, 768), np.uint8))
    assert main(words) == 2
    assert capsys.readouterr().err.endswith(f"{input_option} and --out: both are {Path(words[-1])}; different files\n")
    assert Path("kept.yaml").read_text() == shipped()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["report", "run", "--out", "run/a.rrd"], "is there already, in a folder that is read; another file"),
        (["report", "run", "--out", "notes.txt"], "has no known ending; .html"),
        (["correct", "run", "--out", "run/a.jsonl"], "is there already, in a folder that is read; another file"),
        (["replay", "images", "--out", "images/0.png"], "is there already, in a folder that is read; another file"),
        (["replay", "images", "--out", "-", "--recording", "notes.txt"], "has no known ending; .rrd"),
    ],
)
def test_what_lies_in_a_folder_that_is_read_is_not_replaced(
    words: list[str], why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    Path("run").mkdir()
    Path("images").mkdir()
    cv2.imwrite("images/0.png", np.zeros((576, 768), np.uint8))
    Path("config.yaml").write_text(shipped())
    for kept in ("run/a.rrd", "run/a.jsonl", "notes.txt"):
        Path(kept).write_text("kept")
    before = Path(words[-1]).read_bytes()
    assert main([*words, *(["--config", "config.yaml"] if words[0] == "replay" else [])]) == 2
    assert capsys.readouterr().err.endswith(f"{words[-2]} {Path(words[-1])}: {why}\n")
    assert Path(words[-1]).read_bytes() == before
