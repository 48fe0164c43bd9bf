"""Settings from parsed YAML: scalars mean what people mean, and faults deep inside are named by their whole key."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest
from msgspec import Meta

from gripmon.daemon.config.typed import SettingsError, to_settings
from gripmon.daemon.config.yaml_file import read_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3), ("1.5E3", 1500.0), (".5", 0.5), ("5.", 5.0), ("-3", -3), ("010", 10),
        ("on", "on"), ("no", "no"), ("12:30", "12:30"), ("2024-01-02", "2024-01-02"), ("1_000", "1_000"),
        ("true", True), ("null", None), ("~", None), ("", None),
    ],
)  # fmt: skip
def test_scalars_mean_what_people_mean(tmp_path: Path, text: str, value: object):
    path = tmp_path / "x.yaml"
    path.write_text(f"key: {text}\n")
    read = read_yaml(path)["key"]
    assert read == value and type(read) is type(value)


class _Inner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    gain: Annotated[float, Meta(gt=0.0, description="gain (DN)")] = 1.0
    mode: Literal["fast", "slow"] = "fast"


class _Outer(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    rows: tuple[tuple[float, float], ...] = ()
    inner: dict[str, _Inner] = {}
    either: Annotated[int | str | None, Meta(description="index or name")] = None


@pytest.mark.parametrize(
    ("value", "key", "said"),
    [
        ({"rows": [[1, 2], [3]]}, "rows[1]", "has 1 values"),
        ({"rows": [[1, "x"]]}, "rows[0][1]", "a number"),
        ({"inner": {"a": {}, "b": {"gain": 0}}}, "inner.b.gain", "a number > 0: gain (DN)"),
        ({"inner": {"a": {"mode": "fas"}}}, "inner.a.mode", "did you mean 'fast'"),
        ({"inner": {"a": {"gian": 1}}}, "inner.a.gian", "did you mean 'gain'"),
        ({"inner": {"a": None}}, "inner.a", "is empty"),
        ({"either": []}, "either", "a whole number or text: index or name"),
        ({"either": True}, "either", "a whole number or text"),
    ],
)
def test_faults_deep_inside_are_named_by_their_whole_key(value: object, key: str, said: str):
    with pytest.raises(SettingsError) as caught:
        to_settings(value, _Outer)
    assert caught.value.fault.key == key
    assert said in str(caught.value)
