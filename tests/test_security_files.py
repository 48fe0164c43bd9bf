"""Shipped configurations, certificates and what is refused before anything listens; and that nothing unpickles."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from support.certificates import make_certificates
from support.loopback import accepts, free_endpoint
from support.router_process import ROOT, plain_config, running

from gripmon.cli import main
from gripmon.daemon.config import load_config
from gripmon.io.wire import PublishError, PublishSettings, zenoh_config
from gripmon.io.wire.session import ZenohFileError, load_file, value_of

SHIPPED = sorted((ROOT / "configs" / "zenoh").glob("*.json5"))
LOOPBACK = ("tcp/127.0.0.1:", "tcp/localhost:", "tcp/[::1]:")


def endpoints(value: object) -> list[str]:
    if isinstance(value, dict):
        return [each for values in value.values() for each in endpoints(values)]
    return [str(each) for each in value] if isinstance(value, list) else []


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped files with certificates beside them."""
    made = tmp_path_factory.mktemp("zenoh")
    for file in SHIPPED:
        (made / file.name).write_bytes(file.read_bytes())
    make_certificates(made, "arm1", "issue central serverAuth,clientAuth IP:127.0.0.1")
    return made


@pytest.mark.parametrize("name", [file.name for file in SHIPPED])
def test_shipped_files_stay_on_this_machine_or_speak_tls(folder: Path, name: str):
    config = load_file(folder / name)
    places = endpoints(value_of(config, "listen/endpoints")) + endpoints(value_of(config, "connect/endpoints"))
    assert places
    assert [p for p in places if not (p.startswith("tls/") or p.startswith(LOOPBACK))] == []
    assert all("127.0.0.1" in p for p in places)  # no one else's address is shipped
    assert value_of(config, "scouting/multicast/enabled") is False
    if any(p.startswith("tls/") for p in places):
        assert value_of(config, "transport/link/protocols") == ["tls"]
        assert value_of(config, "transport/link/tls/enable_mtls") is True
        assert value_of(config, "transport/link/tls/verify_name_on_connect") is not False


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda path: path.name)
def test_shipped_configurations_stay_on_this_machine(path: Path):
    config = load_config(path, check_source=False, with_taught=False)
    settings = config.settings.publish
    assert all(place.startswith(LOOPBACK) for place in (*settings.listen, *settings.connect))
    assert not settings.multicast_scouting and settings.zenoh_config is None


def test_what_a_file_does_not_say_is_cautious(tmp_path: Path):
    """Zenoh itself would listen on all interfaces and look for others by multicast."""
    path = tmp_path / "short.json5"
    path.write_text("{ mode: 'peer' }")
    config = zenoh_config(PublishSettings(zenoh_config="short.json5"), tmp_path)
    assert value_of(config, "listen/endpoints") == [] and value_of(config, "scouting/multicast/enabled") is False
    path.write_text("{ listen: {endpoints: ['tcp/127.0.0.1:1']}, scouting: {multicast: {enabled: true}} }")
    config = zenoh_config(PublishSettings(zenoh_config="short.json5"), tmp_path)
    assert value_of(config, "mode") == "peer"
    assert value_of(config, "listen/endpoints") == ["tcp/127.0.0.1:1"]
    assert value_of(config, "scouting/multicast/enabled") is True


def test_certificates_count_from_their_file_and_are_there(folder: Path, tmp_path: Path):
    config = zenoh_config(PublishSettings(zenoh_config="monitor.json5"), folder)
    own = str(folder / "certificates" / "monitor-arm1.pem")
    assert value_of(config, "transport/link/tls/connect_certificate") == own
    (tmp_path / "monitor.json5").write_bytes((folder / "monitor.json5").read_bytes())
    with pytest.raises(PublishError) as caught:
        zenoh_config(PublishSettings(zenoh_config="monitor.json5"), tmp_path)
    assert str(caught.value) == (
        f"publish.zenoh_config: {tmp_path}/monitor.json5: transport/link/tls/root_ca_certificate: "
        f"no file {tmp_path}/certificates/ca.pem; docs/howto/security.md shows how to make it"
    )


def test_a_key_that_others_may_read_is_refused(tmp_path: Path):
    make_certificates(tmp_path, "arm1")
    path = tmp_path / "monitor.json5"
    path.write_bytes((ROOT / "configs" / "zenoh" / "monitor.json5").read_bytes())
    key = tmp_path / "certificates" / "monitor-arm1-key.pem"
    key.chmod(0o640)
    with pytest.raises(PublishError, match=f"others may read {key}; chmod 600 {key}$"):
        zenoh_config(PublishSettings(zenoh_config=str(path)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "expected identifier or string"),
        ("{\n mode: 'router',\n listen: 3 }", "invalid type: integer `3`"),
        ("{ listen: {endpoints: ['tcp/10.0.0.1:70000']} }", "can't route: invalid port value"),
        ("{ mode: 'router', lisen: {} }", "unknown field `lisen`"),
        ("{ mode: 'peer' }", "mode: peer doesn't route; router"),
        ("{}", 'listen.endpoints: there is none; e.g. ["tcp/127.0.0.1:7447"]'),
        ("{ listen: {endpoints: ['tls/127.0.0.1:1']} }", "can't route: Cannot create a new TLS listener"),
        ("{ listen: {endpoints: ['tcp/256.0.0.1:1']} }", "can't route: "),
        ("{ listen: {endpoints: ['xyz']} }", ""),
    ],
)
def test_a_router_refuses_bad_files_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], text: str, expected: str
):
    path = tmp_path / "router.json5"
    path.write_text(text)
    assert main(["router", str(path)]) == 2
    line = capfd.readouterr().err
    assert line.startswith(f"router: {path}: ") and line.count("\n") == 1 and expected in line and ".rs" not in line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mode: peer\n\tlisten: 3\n", "found a tab"),
        ("mode: sideways\n", "unknown variant `sideways`"),
        ((ROOT / "configs" / "demo.yaml").read_text(), "unknown field `robot`"),
    ],
)
def test_bad_yaml_is_said_in_one_line(tmp_path: Path, text: str, expected: str):
    path = tmp_path / "zenoh.yaml"
    path.write_text(text)
    with pytest.raises(ZenohFileError) as caught:
        load_file(path)
    said_text = str(caught.value)
    assert said_text.startswith(f"{path}: YAML error: ") and expected in said_text and "\n" not in said_text


def test_a_router_without_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["router", str(tmp_path / "none.json5")]) == 2
    assert capsys.readouterr().err == f"router: no file {tmp_path}/none.json5; give a json5 or yaml file of Zenoh's\n"


def test_a_router_says_where_it_listens_and_stops_when_told(tmp_path: Path):
    endpoint = free_endpoint()
    config = plain_config(tmp_path, endpoint)
    with running(config, endpoint) as router:
        second = subprocess.run(
            [sys.executable, "-m", "gripmon", "router", str(config)],
            capture_output=True,
            text=True,
            cwd=ROOT,
            timeout=60,
        )
        assert second.returncode == 2
        assert second.stderr.startswith(f"router: {config}: can't route: ") and second.stderr.count("\n") == 1
        assert endpoint in second.stderr and "Address already in use" in second.stderr
        assert router.process is not None and router.process.stderr is not None
        # It listens half a second before Zenoh has opened its session, and only then says so.
        assert router.process.stderr.readline() == f"router: listening on {endpoint}\n"
        assert router.stop() == (0, "router: stopped\n")
        assert not accepts(endpoint)


def test_nothing_unpickles():
    """Bytes from the network or a file must never choose the code that runs."""
    unpicklers = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
    calls = {"eval", "exec"}
    faults = []
    own = ROOT / "gripmon" / "model" / "own_process.py"  # what a process is told by the one that has started it
    for path in sorted({*(ROOT / "gripmon").rglob("*.py")} - {own}):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                used = {alias.name.split(".")[0] for alias in node.names} & unpicklers
            elif isinstance(node, ast.ImportFrom):
                used = {(node.module or "").split(".")[0]} & unpicklers
            elif isinstance(node, ast.Call):
                name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
                used = {name} & (calls if isinstance(node.func, ast.Name) else set())
                used |= {
                    k.arg
                    for k in node.keywords
                    if k.arg == "allow_pickle" and getattr(k.value, "value", 1) is not False
                }
                used |= {name} & {"unsafe_load", "full_load"}
            else:
                continue
            faults += [f"{path.relative_to(ROOT)}:{node.lineno}: {each}" for each in used]
    assert not faults
