"""The page on what valid promises: its example runs, its settings exist, its numbers are those of the code."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from support.loopback import free_endpoint
from support.remote_monitor import remote_monitor

from gripmon.cli import main
from gripmon.client import Policy, TransformClient
from gripmon.daemon.config import builtin_config
from gripmon.judge.policy import PolicySettings
from gripmon.model.records import Protection

PAGE = Path(__file__).resolve().parent.parent / "docs" / "integrity.md"
TEXT = PAGE.read_text(encoding="utf-8")
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_the_settings_and_their_defaults_are_those_of_the_code():
    known = {field.name for field in msgspec.structs.fields(PolicySettings)}
    assert set(re.findall(r"`monitor\.policy\.(\w+)`", TEXT)) <= known
    policy = PolicySettings()
    assert f"(`monitor.policy.alert_limit_m` ({1e3 * policy.alert_limit_m:g} mm)" in f"({TEXT.split('you set it: ')[1]}"
    assert "(2°)" in TEXT and policy.alert_limit_rad == 0.035 and policy.integrity_risk == 1e-5


def test_the_line_of_check_is_what_check_prints(capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(builtin_config("demo.yaml")), "--verbose"]) == 0
    (line,) = re.findall(r"^promise .*$", capsys.readouterr().out, re.MULTILINE)
    assert line in TEXT


@pytest.mark.parametrize(
    ("verdict", "bound_m", "done"),
    [
        ("valid", 4e-4, "grasp"),
        ("suspect", 3e-3, "approach 0.003"),
        ("suspect", 8e-3, "stop"),
        ("suspect", None, "stop"),
    ],
)
def test_the_example_does_what_the_bound_allows(verdict: str, bound_m: float | None, done: str):
    endpoint, did = free_endpoint(), []
    arm = SimpleNamespace(
        grasp=lambda matrix: did.append("grasp"),
        approach=lambda matrix, keep_away_m: did.append(f"approach {keep_away_m:g}"),
        stop=lambda reason: did.append("stop"),
    )

    class Waiting(TransformClient):
        """Has heard something before it is asked for the first time."""

        def latest(self, policy: Policy | None = None):
            while super().latest(policy).transform is None:
                pass
            return super().latest(policy)

    bound = None if bound_m is None else Protection(bound_m, 0.01, 1e-5)
    names = {"arm": arm}
    with remote_monitor(
        robot="arm1", listen=[endpoint], answer={"verdict": verdict, "protection": bound and msgspec.to_builtins(bound)}
    ):
        code = EXAMPLE.replace("tcp/127.0.0.1:7447", endpoint)
        code = code.replace("from gripmon.client import Policy, TransformClient", "from gripmon.client import Policy")
        exec(code, names | {"TransformClient": Waiting})
    assert did == [done]
