"""What may be promised of a view: the foreseen bound against the alert limits."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml
from support.configurations import shipped

from gripmon.cli import main
from gripmon.daemon.config import builtin_config, load_config
from gripmon.daemon.config.checks import reference_doubt
from gripmon.daemon.forecast import limits_warning
from gripmon.judge.policy import PolicySettings
from gripmon.model.gripper import Gripper
from gripmon.model.records import Protection, ValidBy
from gripmon.teach.accuracy import forecast_frame
from gripmon.teach.kept import Kept, Sizes
from gripmon.teach.visibility import Rig

DEMO = builtin_config("demo.yaml")


def with_setting(tmp_path: Path, setting: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(shipped("demo.yaml", ("\nmonitor:\n", f"\nmonitor:\n  {setting}\n")))
    return path


def promised(position_m: float, rotation_rad: float, **policy: float) -> Kept:
    sizes, limits = Sizes.of(np.array([(position_m, rotation_rad)])), PolicySettings(**policy)
    limits_of = limits.alert_limit_m, limits.alert_limit_rad
    return Kept(0, 0, 0, 0, ValidBy.ABSOLUTE, sizes, sizes, "", 0, None, *limits_of, forecast=True)


def test_what_is_needed_is_enough_and_is_said_of_either_limit():
    found = promised(8.31e-3, 1e-4)
    assert not found.reachable and found.needed() == "alert_limit_m of at least 0.0084 (8.4 mm)"
    assert "no transform can be valid: valid needs alert_limit_m of at least 0.0084" in found.promise()
    assert promised(8.31e-3, 1e-4, alert_limit_m=0.0084).reachable
    assert not promised(8.31e-3, 1e-4, alert_limit_m=0.0082).reachable
    assert promised(5e-5, 0.0445).needed() == "alert_limit_rad of at least 0.045 (2.6 degrees)"
    both = promised(8.31e-3, 0.0445).needed()
    assert "alert_limit_m" in both and "alert_limit_rad" in both
    nothing = promised(math.inf, 0.1)
    assert not nothing.reachable and "no limit would do" in nothing.promise()


def rig() -> tuple[Rig, np.ndarray]:
    config = load_config(DEMO)
    return Rig(config.camera, config.gripper, config.settings.monitor, None), config.cam_T_grip


def bound_of(usual: Rig, cam_T_grip: np.ndarray) -> Protection:
    return forecast_frame(usual, cam_T_grip, None).absolute


def test_a_view_promises_less_than_its_covariance_alone_and_less_at_a_larger_risk():
    """Of every edge one has to reckon with its being something else, so that no normal quantile of the covariance of
    the whole fit is enough.
    """
    usual, cam_T_grip = rig()
    foreseen = forecast_frame(usual, cam_T_grip, None)
    assert foreseen.absolute.position_m > 4.42 * foreseen.tcp_sigma_m
    settings = usual.settings
    bold = msgspec.structs.replace(settings, policy=msgspec.structs.replace(settings.policy, integrity_risk=1e-2))
    risky = bound_of(usual._replace(settings=bold), cam_T_grip)
    assert 0.2 < risky.position_m / foreseen.absolute.position_m < 0.9


def test_a_gripper_file_that_is_known_less_well_promises_less():
    usual, cam_T_grip = rig()
    bounds_m = []
    for sigma_m in (0.0, 1e-4, 5e-4):
        rough = usual._replace(settings=msgspec.structs.replace(usual.settings, model_sigma_m=sigma_m))
        bounds_m.append(bound_of(rough, cam_T_grip).position_m)
    assert bounds_m[0] <= bounds_m[1] < bounds_m[2] and bounds_m[2] > 2.0 * bounds_m[1]


def test_check_says_what_is_promised(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(DEMO), "--verbose"]) == 0
    text = capsys.readouterr().out
    assert main(["check", str(DEMO), "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    found = values["protection"]
    assert values["reachable"] and (values["alert_limit_m"], values["alert_limit_rad"]) == (1e-3, 0.035)
    assert set(found) == {"position_m", "rotation_rad", "risk", "hypothesis"} and found["risk"] == 1e-5
    (line,) = re.findall(r"^promise +(.*)$", text, re.MULTILINE)
    assert line.startswith(f"forecast: a transform of this view is good to {1e3 * found['position_m']:.2g} mm and ")
    assert line.endswith(", alert limit 1 mm and 2°")


@pytest.mark.parametrize(
    ("setting", "doubts"),
    [
        ("policy: {}", True),
        ("policy: {alert_limit_m: 0.0005}", True),
        ("policy: {alert_limit_m: 0.005}", False),
        ("model_sigma_m: 0", False),
    ],
    ids=["as shipped", "close to the limit", "the task bears more", "the file is exact"],
)
def test_check_says_what_bevels_would_do_that_no_one_has_stated(
    setting: str, doubts: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """With 0.2 mm of them the demo's transforms are a millimetre off (:mod:`tests.test_trust_shapes`)."""
    path = with_setting(tmp_path, setting)
    assert main(["check", str(path)]) == 0
    (line,) = re.findall(r"^.* promise .*$", capsys.readouterr().out, re.MULTILINE)
    assert main(["check", str(path), "--json"]) == 0
    worn = json.loads(capsys.readouterr().out)["protection_if_bevelled"]
    assert ("bevels of 0.2 mm" in line, line.split()[0]) == (doubts, "WARN" if doubts else "OK")
    assert (worn is None) == (setting == "model_sigma_m: 0")
    if doubts:
        assert worn["position_m"] > 1e-3 and f"to {1e3 * worn['position_m']:.2g} mm and" in line


@pytest.mark.parametrize(("made_of", "doubts"), [("finger.stl", True), ("work/0.PNG", False)])
def test_edges_that_images_have_shown_are_as_they_show(
    made_of: str, doubts: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """CAD doesn't know of bevels that no one has drawn."""
    inputs = f"[{{file: {made_of}, sha256: '{64 * '0'}'}}]"
    provenance = f"provenance: {{gripmon: '1', time: '2026-11-23', command: gripmon gripper, inputs: {inputs}}}"
    file = DEMO.parent / "grippers" / "two_box_fingers.yaml"
    (tmp_path / "gripper.yaml").write_text(f"{file.read_text()}\n{provenance}\n")
    path = tmp_path / "config.yaml"
    path.write_text(DEMO.read_text().replace("gripper: grippers/two_box_fingers.yaml", "gripper: gripper.yaml"))
    assert main(["check", str(path)]) == 0
    assert ("bevels of 0.2 mm" in capsys.readouterr().out) == doubts


def test_a_size_that_is_known_less_well_promises_less(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A larger gripper farther away gives the same image: normal errors of the distance, at the stated risk."""
    usual, cam_T_grip = rig()
    model = msgspec.structs.replace(usual.gripper.model, scale_sigma=0.01)
    foreseen = bound_of(usual._replace(gripper=Gripper(model)), cam_T_grip)
    assert foreseen.position_m == pytest.approx(4.42 * 0.01 * np.linalg.norm(cam_T_grip[:3, 3]), rel=0.1)
    file = DEMO.parent / "grippers" / "two_box_fingers.yaml"
    (tmp_path / "gripper.yaml").write_text(f"{file.read_text()}\nscale_sigma: 0.01\n")
    path = tmp_path / "config.yaml"
    path.write_text(DEMO.read_text().replace("gripper: grippers/two_box_fingers.yaml", "gripper: gripper.yaml"))
    assert main(["check", str(path)]) == 0
    assert "what helps most: its size measured better (a length, a plate: scale_sigma" in capsys.readouterr().out


def test_bevels_that_are_stated_but_not_taught_ask_for_teaching_and_not_for_another_mount(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """As gripmon gripper from-cad states them."""
    model = yaml.safe_load((DEMO.parent / "grippers" / "two_box_fingers.yaml").read_text())
    for edge in model["edges"].values():
        edge["bevel_m"] = 2e-4
    (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(model))
    path = tmp_path / "config.yaml"
    path.write_text(DEMO.read_text().replace("gripper: grippers/two_box_fingers.yaml", "gripper: gripper.yaml"))
    needed = r"valid needs alert_limit_m of at least 0\.00.*; what helps most: its bevels taught \(gripmon teach\)"
    assert main(["check", str(path)]) == 0
    assert re.search(f"WARN  promise .*no transform can be valid: .*{needed}", capsys.readouterr().out)
    assert re.search(needed, limits_warning(load_config(path)) or "")
    assert main(["check", str(path), "--sweep", "--distance", "0.1188", "--tilt", "31", "--jaw", "0.03:0.06"]) == 0
    text = capsys.readouterr().out
    assert "1 mounts tried, 1 would work" in text and "taught   not yet: the gripper file's bevels count" in text


def test_a_limit_that_can_not_be_kept_is_said_by_check_and_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = with_setting(tmp_path, "policy: {alert_limit_m: 2.0e-5}")
    assert main(["check", str(path), "--verbose"]) == 0
    text = capsys.readouterr().out
    found = re.search(
        r"^promise .* is good to ([\d.]+) mm .*: valid needs alert_limit_m of at least ([\d.e-]+) \(",
        text,
        re.M,
    )
    assert found is not None and float(found[2]) == pytest.approx(1e-3 * float(found[1]), rel=0.05)
    assert re.search(r"every transform is suspect from 0.0 to 60.0 mm", text)
    assert main(["check", str(path), "--sweep", "--distance", "0.1188", "--tilt", "31", "--json"]) == 0
    present = json.loads(capsys.readouterr().out)["present"]
    assert not present["works"] and "needs alert_limit_m of at least" in present["faults"][0]["text"]
    assert present["accuracy"]["absolute"]["position_m"] > 2e-5


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
        f"replay: {config}: by the forecast no transform of this view can be valid: valid needs alert_limit_m of at "
    )
    lines = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert {line["verdict"] for line in lines} <= {"suspect", "unknown"} and all(line["reason"] for line in lines)


@pytest.mark.parametrize(
    ("sigmas", "policy", "said"),
    [
        ((None, 0.002), "{}", "reference.position_sigma_m isn't stated, 1 mm are assumed, but transforms are valid by"),
        ((0.0002, None), "{}", "reference.rotation_sigma_rad isn't stated, 0.57 degrees are assumed, but transforms"),
        (
            (0.002, 0.002),
            "{}",
            "alert_limit_m is 0.001, below the reference's own standard deviation of 0.002 m; at least",
        ),
        ((0.0002, 0.05), "{}", "alert_limit_rad is 0.035, below the reference's own standard deviation of 0.05 rad"),
        ((0.002, 0.05), "{valid_by: reference}", None),
        ((None, None), "{valid_by: reference}", None),
        ((0.0002, 0.002), "{}", None),
    ],
)
def test_an_absolute_bound_says_in_a_line_if_the_reference_is_not_known_well_enough(
    tmp_path: Path, sigmas: tuple[float | None, float | None], policy: str, said: str | None
):
    stated = zip(("position_sigma_m", "rotation_sigma_rad"), sigmas, strict=True)
    new = "".join(f"\n  {key}: {sigma}" for key, sigma in stated if sigma is not None)
    text, count = re.subn(r"\n  position_sigma_m: .*\n  rotation_sigma_rad: .*", new, shipped())
    assert count == 1
    path = tmp_path / "config.yaml"
    path.write_text(text.replace("\nmonitor:\n", f"\nmonitor:\n  policy: {policy}\n"))
    line = reference_doubt(load_config(path).settings)
    assert line is None if said is None else (said in (line or "") and "valid_by: reference" in (line or ""))


def test_a_rate_of_zero_is_refused_with_what_would_be_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = with_setting(tmp_path, "policy: {mount_jumps_per_month: 0}")
    assert main(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "monitor.policy.mount_jumps_per_month: is 0; a number >= 0.001 and <= 100000" in line
