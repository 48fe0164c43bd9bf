"""The readers in C++ and Rust of ``docs/examples/readers``: compiled, and held against the Python client."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from support import sample_messages
from support.loopback import WAIT_S, frame_record, free_endpoint, plain_session, wait_until
from support.published import Published

from gripmon.client.age import Sent
from gripmon.client.inbox import Inbox
from gripmon.client.network import MonitorName, Start
from gripmon.client.reading import Policy, judge
from gripmon.io.wire import PublishSettings, steady_ns
from gripmon.model.records import ClockReading, MessageRefused, Protection, Verdict, from_json, to_json

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "docs" / "examples" / "readers"
CRATES = Path("/usr/share/cargo/registry")
MONITOR, ID = MonitorName("arm", "wrist"), "arm-pc-4711-1f0c9a2b"
POLICY = Policy(max_age_s=0.2)
MS = 1_000_000


def build_cpp(folder: Path) -> Path:
    compiler = shutil.which("g++")
    if compiler is None or not Path("/usr/include/nlohmann/json.hpp").exists():
        pytest.skip("needs g++ and nlohmann-json3-dev (Debian)")
    options = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-fsanitize=undefined", "-fno-sanitize-recover"]
    subprocess.run([compiler, *options, SOURCE / "reader.cpp", "-o", folder / "reader"], check=True)
    return folder / "reader"


def build_rust(folder: Path) -> Path:
    cargo = shutil.which("cargo")
    if cargo is None or not any(CRATES.glob("serde_json-*")):
        pytest.skip("needs cargo and librust-serde-json-dev (Debian)")
    if not Path(os.devnull).is_char_device():
        pytest.skip(f"{os.devnull} is a file here, which cargo has rustc compile")
    empty, reader = folder / "empty", folder / "reader"
    (empty / "src").mkdir(parents=True)
    shutil.copy(SOURCE / "Cargo.toml", empty)
    (empty / "src" / "main.rs").write_text("fn main() {}\n")
    unusable = cargo_build(cargo, empty)
    if unusable:  # a toolchain or crates that don't fit each other: nothing that this reader could mend
        pytest.skip(f"cargo builds no empty program that depends on serde_json: {unusable}")
    shutil.copytree(SOURCE, reader)  # cargo writes beside the sources
    refused = cargo_build(cargo, reader)
    assert not refused, refused
    return reader / "target" / "debug" / "reader"


def cargo_build(cargo: str, folder: Path) -> str:
    """What cargo says against building ``folder`` from Debian's crates: nothing where it is built."""
    (folder / ".cargo").mkdir()
    crates = f'[source.crates-io]\nreplace-with = "debian"\n[source.debian]\ndirectory = "{CRATES}"\n'
    (folder / ".cargo" / "config.toml").write_text(crates)
    environment = os.environ | {"CARGO_HOME": str(folder / "home")}  # the user's own may not be writable
    # Debug: an overflow ends it.  No input: rustc would compile what it finds there.
    options: dict[str, Any] = {"input": "", "capture_output": True, "text": True}
    told = subprocess.run([cargo, "build", "--quiet", "--offline"], cwd=folder, env=environment, **options)
    return "" if told.returncode == 0 else told.stderr.strip() or f"exit status {told.returncode}"


@pytest.fixture(scope="module", params=[build_cpp, build_rust], ids=["C++", "Rust"])
def program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    build: Callable[[Path], Path] = request.param
    return build(tmp_path_factory.mktemp("reader"))


def answers(program: Path, lines: list[str]) -> list[str]:
    done = subprocess.run([program], input="\n".join(lines), capture_output=True, text=True, timeout=WAIT_S)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def sample(name: str = "transform") -> dict[str, Any]:
    found: dict[str, Any] = json.loads(to_json(sample_messages.SAMPLES[name]))
    return found


def transform(arrived_ns: int, message: object, sent: object) -> str:
    texts = [each if isinstance(each, str) else json.dumps(each) for each in (message, sent)]
    return f"transform {arrived_ns} {texts[0]}\t{texts[1]}"


def at(now_ns: int, clock: str = "c") -> dict[str, Any]:
    return {"schema": "gripmon.clock/1", "clock": clock, "now_ns": now_ns}


def known() -> list[str]:
    """The monitor is there, and its clock is ahead by 5 s at most."""
    return [f"there {ID}", f"clock 0 {2 * MS} {json.dumps(at(5_000 * MS))}"]


def one(program: Path, message: object, sent: object = None, *, now_ms: int = 20) -> str:
    """What becomes of a message that was sent at 5.010 s by the monitor's clock, and arrived at 0.012 s by ours."""
    line = transform(12 * MS, message, at(5_010 * MS) if sent is None else sent)
    return answers(program, [*known(), line, f"now {now_ms * MS}"])[0]


def test_a_valid_transform_is_given_with_every_digit(program: Path):
    said = one(program, sample()).split()
    pose = sample()["cam_T_grip"]
    assert said[0] == "use"
    expected = [*pose["translation_m"], *pose["rotation_xyzw"], sample()["protection"]["position_m"]]
    assert [float(word) for word in said[1:9]] == expected
    assert said[9] == "3"


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"verdict": "suspect", "reason": "too few edges"}, "suspect: too few edges"),
        ({"verdict": "unknown", "reason": "black"}, "unknown: black"),
        ({"verdict": "splendid", "reason": None}, "unknown: "),
        ({"schema": "gripmon.transform/3"}, "the last transform can't be read: not gripmon.transform/2"),
        ({"monitor_id": "another-1-2"}, "its monitor is gone"),
        ({"latency_ns": 2**61}, "it is too old"),
    ],
)
def test_what_may_not_be_used_and_why(program: Path, changed: dict[str, Any], reason: str):
    assert one(program, sample() | changed).startswith(f"don't: {reason}")


POSE = sample()["cam_T_grip"]


@pytest.mark.parametrize(
    "message",
    [
        "", "[]", "null", "{", '"valid"', "{}", "NaN",
        json.dumps(sample()).replace("0.1327", "1e999"),
        json.dumps(sample()).replace("0.1327", "NaN"),
        *(sample() | {"cam_T_grip": POSE | changed} for changed in (
            {"rotation_xyzw": [0.5, 0.5, 0.5, 0.6]}, {"rotation_xyzw": [0.5, 0.5, 0.5, 0.5, 0.0]},
            {"rotation_xyzw": [0.5, 0.5, 0.5]}, {"translation_m": [0.0, 0.0, True]},
            {"translation_m": [0.0, "x", 0.0, 0.1]}, {"translation_m": None})),
        *(sample() | changed for changed in (
            {"protection": None}, {"protection": {"position_m": -1.0}}, {"latency_ns": -1}, {"latency_ns": 1.5},
            {"latency_ns": 2**63}, {"revision": None}, {"verdict": 1}, {"cam_T_grip": None})),
    ],
)  # fmt: skip
def test_what_is_no_transform_is_not_used_nor_what_came_before_it(program: Path, message: object):
    good = transform(11 * MS, sample(), at(5_010 * MS))
    bad = transform(12 * MS, message, at(5_010 * MS))
    later = transform(13 * MS, sample(), at(5_011 * MS))
    said = answers(program, [*known(), good, f"now {15 * MS}", bad, f"now {15 * MS}", later, f"now {15 * MS}"])
    assert [line.split(" ")[0] for line in said] == ["use", "don't:", "use"]
    assert said[1].startswith("don't: the last transform can't be read: ")


@pytest.mark.parametrize(
    "sent", ["", "{}", at(5_010 * MS) | {"schema": "gripmon.clock/2"}, at(-1), at(2**63), at(2**64)]
)
def test_without_its_clock_it_is_not_used(program: Path, sent: object):
    assert one(program, sample(), sent).startswith("don't: the last transform can't be read: ")


def test_who_is_there(program: Path):
    line = transform(12 * MS, sample(), at(5_010 * MS))
    now = f"now {20 * MS}"
    said = answers(
        program,
        [now, line, now, *known(), now, "there other-1-2", now, "gone other-1-2", now, f"gone {ID}", now],
    )
    assert [each.removeprefix("don't: ").split()[0] for each in said] == ["no", "its", "use", "two", "use", "its"]


def test_one_that_waited_on_its_way_is_too_old_however_fresh_it_comes(program: Path):
    """The monitor's clock is ahead by 5 s at most: what it sent at 5.010 s may not be used from 0.210 s on, whenever
    it arrives.
    """
    for arrived_ms in (12, 150, 205):
        line = transform(arrived_ms * MS, sample() | {"latency_ns": 0}, at(5_010 * MS))
        said = answers(program, [*known(), line, f"now {208 * MS}", f"now {211 * MS}"])
        assert [each.split()[0] for each in said] == ["use", "don't:"]
        assert said[1] == "don't: it is too old"


def test_random_clocks_and_delays_decide_as_the_python_client_does(program: Path):
    """The client's inbox and judge are the other implementation."""
    rng = random.Random(5)
    inbox, lines, expected, now_ns = Inbox(), [f"there {ID}"], [], 10**12
    inbox.appeared(MONITOR)
    inbox.started(Start(MONITOR, ID))
    offsets_ns = {"a": 3 * 10**12, "b": -4 * 10**11}
    for _ in range(3000):
        now_ns += int(rng.expovariate(1.0 / (20 * MS)))
        clock = rng.choice("aaaaaaaaab")
        if rng.random() < 0.01:  # a clock jumps
            offsets_ns[clock] += rng.choice((-1, 1)) * 10**9
        if rng.random() < 0.3:
            asked_ns = now_ns - int(rng.expovariate(1.0 / (10 * MS)))
            shown_ns = rng.randint(asked_ns, now_ns) + offsets_ns[clock]
            lines.append(f"clock {asked_ns} {now_ns} {json.dumps(at(shown_ns, clock))}")
            inbox.answered(ClockReading(clock, shown_ns), asked_ns, now_ns)
        else:
            sent_ns = now_ns - int(rng.expovariate(1.0 / (60 * MS))) + offsets_ns[clock]
            verdict = rng.choice(("valid",) * 8 + ("suspect", "unknown"))
            message = sample() | {"latency_ns": rng.randrange(60 * MS), "verdict": verdict, "monitor_id": ID}
            message = message if verdict != "unknown" else sample("transform_null") | {"monitor_id": ID}
            lines.append(transform(now_ns, message, at(sent_ns, clock)))
            payload, sent = json.dumps(message).encode(), Sent(ClockReading(clock, sent_ns), now_ns)
            inbox.take(MONITOR, payload, 1e-9 * now_ns, sent)
        asked_ns = now_ns + rng.randrange(100 * MS)
        lines.append(f"now {asked_ns}")
        reading = judge(inbox.heard, inbox.heard.entry, POLICY, 1e-9 * asked_ns, 0, lambda: "")
        expected.append("use" if reading.usable else "don't:")
    assert 600 < expected.count("use") < 2400
    assert [line.split(" ")[0] for line in answers(program, lines)] == expected


@pytest.mark.parametrize("name", sorted(sample_messages.SAMPLES))
def test_every_sample_message_on_the_key_of_transforms(program: Path, name: str):
    content = to_json(sample_messages.SAMPLES[name]).decode()
    assert one(program, content).split()[0] == ("use" if name == "transform" else "don't:")


@pytest.fixture
def monitor() -> Iterator[tuple[Published, zenoh.Session]]:
    endpoint = free_endpoint()
    published = Published(PublishSettings(listen=(endpoint,)), identified=True)
    try:
        with plain_session(connect=endpoint) as session:
            yield published, session
    finally:
        published.close()


def test_a_monitors_own_messages_over_zenoh(program: Path, monitor: tuple[Published, zenoh.Session]):
    """As Zenoh delivers them to a plain session: tokens, a transform with what is attached, the clock."""
    published, session = monitor
    process = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None and process.stdout is not None
    kept: list[tuple[int, zenoh.Sample]] = []
    try:
        key = "gripmon/arm/wrist"
        wait_until(lambda: list(session.liveliness().get(f"{key}/alive/*")), "the token")
        (token,) = session.liveliness().get(f"{key}/alive/*")
        lines = [f"there {str(token.ok.key_expr).rpartition('/')[2]}"]
        with session.declare_subscriber(f"{key}/transform", lambda each: kept.append((steady_ns(), each))):

            def sent() -> bool:
                bound = Protection(0.00025, 0.001, 1e-5, "nothing is wrong")
                published.transform(frame_record(1, verdict=Verdict.VALID, protection=bound, latency_ns=0))
                return bool(kept)

            wait_until(sent, "a transform")
            asked_ns = steady_ns()
            (reply,) = session.get(f"{key}/transform?clock")
            answered_ns = steady_ns()
        arrived_ns, message = kept[-1]
        payload, attached = message.payload.to_string(), message.attachment.to_string()
        lines += [f"clock {asked_ns} {answered_ns} {reply.ok.payload.to_string()}"]
        lines += [f"transform {arrived_ns} {payload}\t{attached}", f"now {arrived_ns + 100 * MS}"]
        lines += [f"now {arrived_ns + 201 * MS}"]
        process.stdin.write("\n".join(lines) + "\n")
        process.stdin.flush()
        first, second = process.stdout.readline().split(), process.stdout.readline()
        record = frame_record(1)
        assert record.cam_T_grip is not None
        assert first[0] == "use" and [float(word) for word in first[1:4]] == list(record.cam_T_grip.translation_m)
        assert float(first[8]) == 0.00025
        assert second == "don't: it is too old\n"
    finally:
        process.kill()
        process.communicate()


def test_the_samples_hold_what_the_client_would_read():
    """Otherwise the tests above would pass for a wrong reason."""
    assert from_json(json.dumps(sample()).encode(), type(frame_record(1))).monitor_id == ID
    with pytest.raises(MessageRefused):
        from_json(b"{}", type(frame_record(1)))
