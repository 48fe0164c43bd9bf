"""The configuration that a recording brings: the same to the last digit, without secrets, and written nowhere else."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from support.configurations import shipped

from gripmon.daemon.config import ConfigError, builtin_config, load_config
from gripmon.daemon.config.recorded import from_recorded, to_recorded
from gripmon.model.records import RecordedConfiguration, RecordedFile

SHIPPED = sorted(path for path in builtin_config("demo.yaml").parent.glob("*.yaml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_recorded_configuration_is_the_configuration(path: Path, tmp_path: Path):
    """All settings but those that decisions don't rest on, to the last digit."""
    config = load_config(path, check_source=False, with_taught=False)
    again = from_recorded(
        msgspec.json.decode(msgspec.json.encode(to_recorded(config)), type=RecordedConfiguration), tmp_path
    )
    for name in config.settings.__struct_fields__:
        if name not in ("source", "publish", "ros2", "state", "view", "gripper"):
            assert getattr(again.settings, name) == getattr(config.settings, name), name
    assert again.gripper.model == config.gripper.model and again.reference == config.reference
    assert again.state_owner == config.state_owner


def test_no_password_is_recorded(tmp_path: Path):
    secrets = (
        ("device: 0 ", "device: 'rtsp://operator:sesame1@camera/1' # or sesame2"),
        ("connect: [] ", "connect: ['tls/host:7447#password=sesame3'] "),
    )
    path = tmp_path / "live.yaml"
    path.write_text(shipped("live_camera.yaml", *secrets))
    recorded = msgspec.json.encode(to_recorded(load_config(path, check_source=False)))
    assert b"sesame" not in recorded and b"coefficients" in recorded


@pytest.mark.parametrize("name", ["../outside.yaml", "/tmp/outside.yaml", "..", "a/b.yaml", ""])
def test_a_recording_writes_nowhere_else(tmp_path: Path, name: str):
    inside = tmp_path / "inside"
    inside.mkdir()
    recorded = RecordedConfiguration("monitor.yaml", {name: RecordedFile("robot: x")})
    with pytest.raises(ConfigError, match="a plain name"):
        from_recorded(recorded, inside)
    assert [path.name for path in tmp_path.iterdir()] == ["inside"] and not list(inside.iterdir())
