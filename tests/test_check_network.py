"""``gripmon check`` refuses what ``gripmon run`` would refuse to join the network with, and in the same words."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.configurations import demo_in

from gripmon.cli import main
from gripmon.io.wire.session import endpoint_fault

TLS_FILE = '{listen: {endpoints: ["tls/127.0.0.1:7449"]}, transport: {link: {tls: {listen_certificate: "gone.pem"}}}}'


def refused(path: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of check, which is that of run, too."""
    lines = []
    for command in (["check", path], ["run", path, "--duration", "1"]):
        assert main(command) == 2
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1
        lines.append(err)
    assert lines[0] == lines[1]
    return lines[0]


@pytest.mark.parametrize(
    ("publish", "said"),
    [
        ({"zenoh_config": "nothing.json5"}, "publish.zenoh_config: no file "),
        ({"zenoh_config": "tls.json5"}, "gone.pem"),
        ({"listen": ["tcp/127.0.0.1:99999"]}, "publish.listen: 'tcp/127.0.0.1:99999' is not an endpoint; "),
        ({"connect": ["tcp/10.0.0.5"]}, "publish.connect"),
        ({"mode": "client"}, "publish.connect: a client needs a router; "),
    ],
)
def test_a_session_that_cannot_be_opened(
    publish: dict[str, object], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "tls.json5").write_text(TLS_FILE)
    assert said in refused(str(demo_in(tmp_path, publish=publish)), capsys)


@pytest.mark.parametrize(
    ("endpoint", "right"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.0.0.1:0", True),  # any port that is free
        ("tcp/[::1]:7447#iface=lo", True),
        ("udp/robot.local:65535?rel=0", True),
        ("serial//dev/ttyS0#baudrate=9600", True),
        ("unixsock-stream//tmp/a", True),
        ("nonsense", False),
        ("tcp/[::1]", False),
        ("tcp/:7447", False),
        ("ws/a:x", False),
        ("tcp/a:", False),
        ("tcp/a:65536", False),
        ("tcp/a:123456789012", False),
        ("tcp/a:1\n", False),
    ],
)
def test_endpoints(endpoint: str, right: bool):
    assert endpoint_fault(endpoint) == "" if right else " is not an endpoint; " in endpoint_fault(endpoint)
