"""What may be promised of a view: bounds of the foreseen covariance against the alert limits."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from gripmon.cli import main
from gripmon.config import builtin_config
from gripmon.outlook import Foreseen, Promise, promise
from gripmon.policy import PolicySettings
from gripmon.records import Protection

DEMO = builtin_config("demo.yaml")


def frame(position_m: tuple[float, float, float], rotation_rad: tuple[float, float, float]) -> Foreseen:
    return Foreseen(np.diag(np.square([*position_m, *rotation_rad])), np.ones(4, bool), 0.03)


def with_policy(tmp_path: Path, policy: str) -> Path:
    text = DEMO.read_text().replace("gripper: grippers", f"gripper: {DEMO.parent}/grippers")
    path = tmp_path / "config.yaml"
    path.write_text(re.sub(r"^monitor:$", f"monitor:\n  policy: {{{policy}}}", text, flags=re.MULTILINE))
    return path


def test_the_bound_is_that_of_the_covariance_at_the_risk():
    """Along one direction alone the bound is a quantile of the normal distribution: 4.417 at 1e-5, 1.96 at 0.05."""
    thin = frame((1e-9, 1e-9, 1e-4), (1e-9, 1e-9, 1e-3))
    for risk, sigmas in ((1e-5, 4.417), (0.05, 1.960)):
        found = promise(thin, PolicySettings(integrity_risk=risk))
        assert found.protection.position_m == pytest.approx(sigmas * 1e-4, rel=2e-3)
        assert found.protection.rotation_rad == pytest.approx(sigmas * 1e-3, rel=2e-3)
        assert found.protection.risk == risk and found.reachable
    ball = promise(frame((1e-4, 1e-4, 1e-4), (1e-3, 1e-3, 1e-3)), PolicySettings())
    assert ball.protection.position_m == pytest.approx(5.089e-4, rel=2e-3)  # Maxwell's distribution at 1e-5
    assert not ball.reachable


def test_what_is_needed_is_enough_and_is_said_of_either_limit():
    wide, turned = frame((1e-9, 1e-9, 1.88e-3), (1e-9, 1e-9, 1e-4)), frame((1e-9, 1e-9, 1e-5), (1e-9, 1e-9, 0.01))
    found = promise(wide, PolicySettings())
    assert not found.reachable and found.needed == "alert_limit_m of at least 0.0084 (8.4 mm)"
    assert (
        "alert limit 0.5 mm, 1.1 degrees: NOT reachable: valid needs alert_limit_m of at least 0.0084" in found.text()
    )
    assert promise(wide, PolicySettings(alert_limit_m=0.0084)).reachable
    assert not promise(wide, PolicySettings(alert_limit_m=0.0082)).reachable
    assert promise(turned, PolicySettings()).needed == "alert_limit_rad of at least 0.045 (2.6 degrees)"
    both = promise(Foreseen(wide.covariance + turned.covariance, wide.usable, 0.03), PolicySettings()).needed
    assert "alert_limit_m" in both and "alert_limit_rad" in both
    nothing = Promise(Protection(math.inf, 0.1, 1e-5), 5e-4, 0.02)
    assert not nothing.reachable and "no limit would do" in nothing.text()


def test_check_says_what_is_promised(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DEMO)]) == 0
    text = capsys.readouterr().out
    assert main(["check", str(DEMO), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    bound = values["protection"]
    assert values["reachable"] and (values["alert_limit_m"], values["alert_limit_rad"]) == (5e-4, 0.02)
    assert set(bound) == {"position_m", "rotation_rad", "risk"} and bound["risk"] == 1e-5
    sigma = np.array(values["accuracy"]["expected"]["tcp_m"])
    assert 4.2 * sigma.max() < bound["position_m"] < 5.1 * np.sqrt((sigma**2).sum())
    (line,) = re.findall(r"^promise    (.*)$", text, re.MULTILINE)
    assert line.startswith(f"a transform of this view is good to {1e3 * bound['position_m']:.2g} mm and ")
    assert line.endswith("(risk 1e-05 a frame); alert limit 0.5 mm, 1.1 degrees: reachable")


def test_a_limit_that_can_not_be_kept_is_said_by_check_and_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = with_policy(tmp_path, "alert_limit_m: 2.0e-5")
    assert main(["check", str(path)]) == 0
    text = capsys.readouterr().out
    assert re.search(
        r"^promise .*NOT reachable: valid needs alert_limit_m of at least 4.6e-05 \(0.046 mm\)$", text, re.MULTILINE
    )
    assert re.search(r"no transform is valid from 0.0 to 60.0 mm: bounds of up to", text)
    assert main(["check", str(path), "--sweep", "--distance", "0.1188", "--tilt", "31", "--json"]) == 0
    present = json.loads(capsys.readouterr().out)["present"]
    assert not present["works"] and "needs alert_limit_m of at least" in present["reasons"][0]
    assert present["protection"]["position_m"] > 2e-5


def test_replay_warns_at_its_start(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    sequence = tmp_path / "quiet"
    assert main(["simulate", "creep", "--out", str(sequence), "--seconds", "0.3", "--fps", "10"]) == 0
    config = sequence / "config.yaml"
    arguments = ["replay", str(sequence), "--config", str(config), "--out", str(tmp_path / "out.jsonl")]
    assert main(arguments) == 0
    assert "no transform of this view" not in capsys.readouterr().err
    text = config.read_text()
    config.write_text(f"{text}\nmonitor: {{policy: {{alert_limit_m: 2.0e-5}}}}\n")
    assert main(arguments) == 0
    first, *_ = capsys.readouterr().err.splitlines()
    assert first.startswith(
        f"replay: {config}: no transform of this view can be valid: valid needs alert_limit_m of at "
    )
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert {line["verdict"] for line in lines} <= {"suspect", "unknown"} and all(line["reason"] for line in lines)
