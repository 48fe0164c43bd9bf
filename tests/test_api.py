"""What ``import gripmon`` gives: names that are loaded late, values in and values out, the same as the command line."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

import gripmon
from gripmon.cli import main
from gripmon.model.records import to_json

ROOT = Path(__file__).resolve().parent.parent
HEAVY = ("numpy", "scipy", "cv2", "zenoh", "rerun", "msgspec", "yaml", "pyarrow", "plotly", "rosbags")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a camera that a cable pulls aside."""
    out = tmp_path_factory.mktemp("simulated") / "creep"
    made = gripmon.simulate_images("creep", out, duration_s=2.0, fps=10.0, seed=2)
    assert made == (out, out / "config.yaml", 20)
    return out


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)


@pytest.mark.parametrize("name", gripmon.__all__)
def test_every_public_name_is_there_and_documented(name: str):
    found = getattr(gripmon, name)
    if name == "__version__":
        return
    assert inspect.isclass(found) or inspect.isfunction(found)
    assert found.__doc__
    assert found is getattr(gripmon, name), "the same each time"


def test_the_tables_of_names_agree():
    """Where a name is, what is exported, and what a type checker sees, are written down in three places."""
    assert set(gripmon.__all__) == {*gripmon._WHERE, "__version__"}
    source = (ROOT / "gripmon" / "__init__.py").read_text()
    typed = source[source.index("if TYPE_CHECKING:") : source.index("__version__ =")]
    shown = set(re.findall(r"\b\w+\b", " ".join(re.findall(r" import (.*)", typed))))
    assert shown - {"as", "teach"} == set(gripmon.__all__) - {"__version__"}
    assert dir(gripmon) == sorted(gripmon.__all__)
    with pytest.raises(AttributeError, match="no attribute 'calibrate_toaster'"):
        _ = gripmon.calibrate_toaster


def test_import_loads_nothing_heavy():
    done = run_python(f"import sys, gripmon; print(sorted(set({HEAVY!r}) & set(sys.modules)))")
    assert done.stdout == "[]\n", done.stderr
    times = run_python("import time; t = time.perf_counter(); import gripmon; print(time.process_time())")
    assert times.returncode == 0
    modules = run_python("import sys; n = len(sys.modules); import gripmon; print(len(sys.modules) - n)")
    assert int(modules.stdout) < 40, "of which each costs a millisecond or less"


def test_a_configuration_is_read_without_network_and_recording_packages():
    """Also where they are not installed: their import fails."""
    code = (
        "import sys\n"
        "for name in ('zenoh', 'rerun', 'rosbags', 'prometheus_client'): sys.modules[name] = None\n"
        "import gripmon\n"
        "from gripmon.daemon.config import builtin_config\n"
        "config = gripmon.load_config(builtin_config('network.yaml'))\n"
        "print(config.settings.robot, type(config.settings.source).__name__)\n"
        "monitor = gripmon.Monitor(config)\n"
        "print(monitor.reference.reference_id)"
    )
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0] == "arm1 NetworkSettings"


def test_a_monitor_takes_frames_and_replay_is_what_the_command_writes(sequence: Path, tmp_path: Path):
    config = gripmon.load_config(sequence / "config.yaml")
    monitor = gripmon.Monitor(config)
    with gripmon.open_source(sequence) as source:
        one_by_one = [monitor.process(frame) for frame in source]
    replayed = [msgspec.structs.replace(each, latency_ns=0) for each in gripmon.replay(sequence, config)]
    out = tmp_path / "replayed.jsonl"
    assert main(["replay", str(sequence), "--config", str(sequence / "config.yaml"), "--out", str(out)]) == 0
    written = re.sub(rb'"latency_ns":\d+', b'"latency_ns":0', out.read_bytes()).splitlines()
    assert [to_json(record) for record in replayed] == written
    # Without what the daemon asks between two frames, causes may differ; the measurement doesn't.
    assert [record.cam_T_grip for record in one_by_one] == [record.cam_T_grip for record in replayed]
    truth = [json.loads(line) for line in (sequence / "truth.jsonl").read_text().splitlines()]
    last = one_by_one[-1]
    assert last.verdict == "valid" and last.drift is not None
    assert np.allclose(last.drift.tcp_shift_m, truth[-1]["tcp_shift_m"], atol=1e-4)


def test_a_fixed_opening_is_the_configurations(sequence: Path, tmp_path: Path):
    """The frames bring an opening of their own, which ``jaw.source: fixed`` overrules."""
    text = (sequence / "config.yaml").read_text().replace("source: frames", "source: fixed\n  opening_m: 0.02")
    (tmp_path / "gripper.yaml").write_bytes((sequence / "gripper.yaml").read_bytes())
    (tmp_path / "config.yaml").write_text(text.replace("path: .", f"path: {sequence}"))
    config = gripmon.load_config(tmp_path / "config.yaml")
    said: list[str] = []
    records = list(gripmon.replay(sequence, config, warn=said.append))
    assert said == ["the frames have jaw openings, but jaw.source is fixed: they are not used"]
    monitor = gripmon.Monitor(config)
    frames = list(gripmon.open_source(config))
    assert {monitor.with_opening(frame).jaw_opening_m for frame in frames} == {0.02}
    assert [monitor.process(frame).cam_T_grip for frame in frames] == [record.cam_T_grip for record in records]


def test_the_forecast_is_what_check_prints(sequence: Path, capsys: pytest.CaptureFixture[str]):
    path = sequence / "config.yaml"
    found = gripmon.forecast(gripmon.load_config(path))
    assert main(["check", str(path), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert {key: printed[key] for key in found.__struct_fields__} == json.loads(msgspec.json.encode(found))
    assert set(printed) - set(found.__struct_fields__) == {
        "findings", "kept", "kept_over", "keys", "recording", "metrics", "zenoh", "source",
    }  # fmt: skip
    assert found.reachable and found.in_view.enough and found.accuracy.expected is not None
    assert 0.0 < max(found.accuracy.expected.tcp_m) < 1e-4


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: gripmon.load_config("nowhere.yaml"), "nowhere.yaml"),
        (lambda: gripmon.open_source("nowhere.mp4"), "nowhere.mp4"),
        (lambda: gripmon.simulate_images("nothing", "never"), "nothing"),
    ],
)
def test_wrong_input_is_one_error_of_one_line(call: object, text: str):
    with pytest.raises(gripmon.InputError, match=text) as caught:
        call()  # type: ignore[operator]
    assert str(caught.value).count("\n") == 0
    assert not Path("never").exists()


def test_the_example_runs(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "examples" / "monitor_a_folder.py", tmp_path / "images"],
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    moved = [re.search(r"moved by \(([-+.\d]+), ([-+.\d]+), ([-+.\d]+)\) mm", line) for line in lines]
    shifts = [[float(value) for value in found.groups()] for found in moved if found]
    truth = [json.loads(line) for line in (tmp_path / "images" / "truth.jsonl").read_text().splitlines()]
    assert lines[0].startswith("6 corners in view; ") and len(shifts) >= 25
    assert shifts[-1] == pytest.approx([1e3 * value for value in truth[-1]["tcp_shift_m"]], abs=0.1)
