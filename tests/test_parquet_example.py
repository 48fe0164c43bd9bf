"""``docs/examples/parquet_of_a_year.py`` on recordings of simulated cameras: it finds the one that moved, and when."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from support.configurations import shipped

from gripmon.daemon.config import load_config
from gripmon.io.sources import make_simulator

ROOT = Path(__file__).resolve().parent.parent
EXAMPLE = ROOT / "docs" / "examples" / "parquet_of_a_year.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("parquet_of_a_year", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run_monitor(folder: Path, robot: str, scenario: str) -> Path:
    """A monitor's recording below ``folder``; its configuration."""
    values = yaml.safe_load(shipped())
    values["robot"] = robot
    # At 21 frames/s stamps are no whole microseconds, as those of most cameras.
    values["source"] |= {"scenario": scenario, "realtime": False, "ends": True, "fps": 21.0, "duration_s": 6.0}
    values["publish"] = {"enabled": False}
    config = folder / f"{robot}.yaml"
    config.write_text(yaml.safe_dump(values))
    command = [sys.executable, "-m", "gripmon", "run", str(config), "--out", str(folder / "recordings" / robot)]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True, timeout=300)
    return config


def test_it_finds_the_camera_that_moved(tmp_path: Path, example: ModuleType, capsys: pytest.CaptureFixture[str]):
    bumped, _ = run_monitor(tmp_path, "arm1", "bump"), run_monitor(tmp_path, "arm2", "static")
    config = load_config(bumped)
    simulator = make_simulator(config.settings.source, config.scene, config.directory)
    truths = [simulator.truth(i) for i in range(simulator.frame_count)]
    shift_m = np.linalg.norm([truth.tcp_shift_m for truth in truths], axis=1)
    moved_ns = truths[int(np.argmax(shift_m > 1e-4))].stamp_ns

    fleet = tmp_path / "fleet"
    example.main(tmp_path / "recordings", fleet)
    table = example.movements(fleet)
    assert set(table["robot"].to_pylist()) == {"arm1"}
    noticed_ns = table["noticed"].cast("int64").to_pylist()[0]
    assert moved_ns <= noticed_ns < moved_ns + 2_000_000_000
    # The camera swings before it rests; what an alert says last is where it rests.
    assert table["shift_m"].to_pylist()[-1] == pytest.approx(shift_m[-1], abs=2e-4)
    days = {(row["robot"], row["frames"]): row["valid_share"] for row in example.days(fleet).to_pylist()}
    assert set(days) == {("arm1", len(truths)), ("arm2", len(truths))}
    assert all(0.9 < share < 1.0 for share in days.values())  # the first frames are never valid
    printed = capsys.readouterr()
    assert "arm1/wrist" in printed.out.partition("how was")[0] and "arm2" not in printed.out.partition("how was")[0]
    assert printed.err == ""
