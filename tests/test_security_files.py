"""Shipped configurations, certificates and what is refused before anything listens; and that nothing unpickles."""

from __future__ import annotations

import ast
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
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
    for names in ([], ["central", "--host", "127.0.0.1"]):
        assert main(["certificates", *names, "--out", str(made / "certificates")]) == 0
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
        f"no file {tmp_path}/certificates/ca.pem; "
        "copy it from where the certificates were made (by gripmon certificates, once for all machines)"
    )


def test_where_certificates_are_made_a_missing_one_can_be(tmp_path: Path):
    certificates = tmp_path / "certificates"
    assert main(["certificates", "operator", "--out", str(certificates)]) == 0
    for name in ("router", "monitor"):
        (tmp_path / f"{name}.json5").write_bytes((ROOT / "configs" / "zenoh" / f"{name}.json5").read_bytes())
    with pytest.raises(ZenohFileError, match=f"; gripmon certificates monitor-arm1 --out {certificates} makes it$"):
        load_file(tmp_path / "monitor.json5")
    with pytest.raises(ZenohFileError, match=f"certificates router --out {certificates} --host ADDRESS makes it$"):
        load_file(tmp_path / "router.json5")


def test_a_key_that_others_may_read_is_refused(tmp_path: Path):
    assert main(["certificates", "--out", str(tmp_path / "certificates")]) == 0
    path = tmp_path / "monitor.json5"
    path.write_bytes((ROOT / "configs" / "zenoh" / "monitor.json5").read_bytes())
    key = tmp_path / "certificates" / "monitor-arm1-key.pem"
    key.chmod(0o640)
    with pytest.raises(PublishError, match=f"others may read {key}; chmod 600 {key}$"):
        zenoh_config(PublishSettings(zenoh_config=str(path)))


def test_certificates_are_made_once_and_their_keys_are_private(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    os.umask(0)
    try:
        assert main(["certificates", "--out", str(tmp_path), "--host", "10.0.0.5", "--host", "site.example"]) == 0
    finally:
        os.umask(0o022)
    keys = sorted(tmp_path.glob("*-key.pem"))
    assert [key.name.removesuffix("-key.pem") for key in keys] == [
        "ca",
        "controller",
        "monitor-arm1",
        "operator",
        "robot-arm1",
        "router",
    ]
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert main(["certificates", "operator", "arm7", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    hosts = "localhost, 127.0.0.1, ::1, 10.0.0.5, site.example"
    assert f"router-key.pem: made, common name router, for a router (and as a client) at {hosts}\n" in printed
    text = "exists, unchanged: common name operator, for a client only; to change it, delete both files\n"
    assert f"operator-key.pem: {text}" in printed
    assert "arm7-key.pem: made, common name arm7, for a client only (--host makes it a router's)\n" in printed
    assert {file: file.read_bytes() for file in before} == before
    authority = x509.load_pem_x509_certificate(before[tmp_path / "ca.pem"])
    for name in ("router", "arm7"):
        certificate = x509.load_pem_x509_certificate((tmp_path / f"{name}.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)
        assert certificate.subject.rfc4514_string() == f"CN={name}"
        uses = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (x509.ExtendedKeyUsageOID.SERVER_AUTH in uses) is (name == "router")
    alternatives = x509.load_pem_x509_certificate(before[tmp_path / "router.pem"]).extensions
    text = str(alternatives.get_extension_for_class(x509.SubjectAlternativeName).value)
    assert "10.0.0.5" in text and "site.example" in text and "localhost" in text


@pytest.mark.parametrize(
    ("arguments", "spoil", "text"),
    [
        (["../x"], None, "can't be a name"),
        (["ca"], None, "can't be a name"),
        (["x"], "ca.pem", "can't be read"),
        (["x"], "ca-key.pem", "can't be read"),
        (["one"], "one.pem", "one.pem is not a certificate: "),
    ],
)
def test_bad_requests_for_certificates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], spoil: str | None, text: str
):
    assert main(["certificates", "one", "--out", str(tmp_path)]) == 0
    if spoil is not None:
        (tmp_path / spoil).write_text("nonsense")
    try:
        code = main(["certificates", *arguments, "--out", str(tmp_path)])
    except SystemExit as ended:
        code = int(str(ended.code))
    said_text = capsys.readouterr().err
    assert code == 2 and text in said_text.splitlines()[-1] and "Traceback" not in said_text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "line 1, column 2: expected"),
        ("{\n mode: 'router',\n listen: 3 }", "line 3, column 10: invalid type: integer `3`, a mapping was expected"),
        ("{ listen: {endpoints: ['tcp/10.0.0.1:70000']} }", "listen.endpoints: tcp/10.0.0.1:70000: 70000 can't be"),
        ("{ mode: 'router', lisen: {} }", "unknown field `lisen`"),
        ("{ mode: 'peer' }", "mode: peer doesn't route; router"),
        ("{}", 'listen.endpoints: there is none; e.g. ["tcp/127.0.0.1:7447"]'),
        ("{ listen: {endpoints: ['tls/127.0.0.1:1']} }", "needs a certificate; "),
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
    assert not set("{}|") & set(line), "no data structures of Zenoh's"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mode: peer\n\tlisten: 3\n", "line 2, column 1: found a tab"),
        ("mode: sideways\n", "line 1, column 7: mode: unknown variant `sideways`"),
        ((ROOT / "configs" / "demo.yaml").read_text(), "this is gripmon's configuration, not Zenoh's"),
        ((ROOT / "configs" / "network.yaml").read_text(), "this is gripmon's configuration, not Zenoh's"),
    ],
)
def test_bad_yaml_is_said_in_one_line(tmp_path: Path, text: str, expected: str):
    path = tmp_path / "zenoh.yaml"
    path.write_text(text)
    with pytest.raises(ZenohFileError) as caught:
        load_file(path)
    said_text = str(caught.value)
    assert said_text.startswith(f"{path}: {expected}") and "\n" not in said_text and "{" not in said_text


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
        assert second.stderr == (
            f"router: {config}: listen.endpoints: {endpoint} is already in use; "
            "stop the program that has it, or choose another port\n"
        )
        assert router.process is not None and router.process.stderr is not None
        # It listens half a second before Zenoh has opened its session, and only then says so.
        assert router.process.stderr.readline() == f"router: listening on {endpoint}\n"
        assert router.stop() == (0, "router: stopped\n")
        assert not accepts(endpoint)


def test_rules_for_more_robots_are_added_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "router.json5"
    shipped = (ROOT / "configs" / "zenoh" / "router.json5").read_text()
    path.write_text(shipped)
    command = ["certificates", "--robot", "arm2", "--robot", "cell.7", "--rules", str(path), "--out", str(tmp_path)]
    assert main(command) == 0
    assert "restart the router" in capsys.readouterr().out
    with_three = path.read_text()
    assert set(shipped.splitlines()) < set(with_three.splitlines())
    for robot in ("arm2", "cell.7"):  # the shipped robot's own lines, with another name
        for line in shipped.splitlines():
            if "arm1" in line and not line.lstrip().startswith("//"):
                assert line.replace("arm1", robot) in with_three
    assert main(command) == 0 and path.read_text() == with_three
    assert "already" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said_text"),
    [
        (["--rules", "router.json5"], "--rules without a robot; add --robot NAME"),
        (["--robot", "a/b"], "--robot: 'a/b' can't be a robot's name in a certificate; letters, digits, - _ and ."),
        (["--robot", "a", "--rules", "{folder}/none"], "can't be written (No such file or directory)"),
        (["--robot", "a", "--rules", "{folder}/other"], "has no line '// robots: rules', before which"),
    ],
)
def test_rules_that_cannot_be_added(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said_text: str
):
    (tmp_path / "other").write_text("{}")
    given = [option.format(folder=tmp_path) for option in options]
    assert main(["certificates", *given, "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said_text in line and (tmp_path / "other").read_text() == "{}"


def test_nothing_unpickles():
    """Bytes from the network or a file must never choose the code that runs."""
    unpicklers = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "jsonpickle"}
    calls = {"eval", "exec"}
    faults = []
    for path in sorted((ROOT / "gripmon").rglob("*.py")):
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


@pytest.mark.parametrize("lost", ["ca-key.pem", "ca.pem", "arm1-key.pem", "arm1.pem"])
def test_half_a_pair_of_key_and_certificate_is_said_in_one_line(
    tmp_path: Path, lost: str, capsys: pytest.CaptureFixture[str]
):
    """The authority's key is kept elsewhere, or the disk was full after the first of two files."""
    assert main(["certificates", "arm1", "--out", str(tmp_path)]) == 0
    capsys.readouterr()
    (tmp_path / lost).unlink()
    left = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert main(["certificates", "arm1", "arm2", "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"certificates: {tmp_path / lost} is missing, but ")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == left
