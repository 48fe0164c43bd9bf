"""The controller's client while monitors and routers in other processes are killed, stopped and started again."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from support.loopback import ask, frame_record, free_endpoint, plain_session, wait_until
from support.remote_monitor import remote_monitor, router

from gripmon.client import Policy, Reading, TransformClient, Unusable
from gripmon.model.records import to_json

PATIENT = Policy(max_age_s=3600.0)
"""Nothing grows too old on a slow machine."""


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


def usable(client: TransformClient) -> Reading:
    """The next reading that may be used."""
    wait_until(lambda: client.latest().usable, "a usable transform")
    return client.latest()


def refused(client: TransformClient, why: Unusable) -> Reading:
    """The client's reading once it is refused, and for this reason."""
    wait_until(lambda: client.latest().why is why, f"the reading to be refused: {why}")
    return client.latest()


def test_a_stopped_monitors_transform_is_stale_and_usable_again(endpoint: str):
    """Its session stays, so that only the age tells."""
    with (
        remote_monitor(listen=[endpoint]) as monitor,
        TransformClient("arm", connect=[endpoint], policy=Policy(max_age_s=1.0)) as client,
    ):
        usable(client)
        readings = iter(client)
        monitor.send_signal(signal.SIGSTOP)
        stale = refused(client, Unusable.STALE)
        assert stale.age_s > 1.0 and stale.reason.endswith("s old, at most 1 s is allowed")
        assert next(reading for reading in readings if not reading.usable).why is Unusable.STALE
        monitor.send_signal(signal.SIGCONT)
        assert usable(client).seq > stale.seq
        assert next(reading for reading in readings if reading.usable).seq > stale.seq


def test_a_client_that_comes_first_finds_a_monitor_that_is_killed_and_started_again(endpoint: str):
    with TransformClient("arm", connect=[endpoint], policy=PATIENT) as client:
        assert refused(client, Unusable.NOT_CONNECTED).reason == f"no connection to {endpoint}, trying again"
        with remote_monitor(listen=[endpoint]):
            wait_until(lambda: client.latest().usable and client.latest().seq > 100, "a hundred frames")
        refused(client, Unusable.GONE)
        with remote_monitor(listen=[endpoint], fps=2.0):
            assert usable(client).seq < 100  # its numbers begin again
        assert client.unreadable == 0


def test_a_router_that_is_killed_and_started_again_needs_no_help(endpoint: str, tmp_path: Path):
    config = tmp_path / "client.json5"
    config.write_text(
        f"{{mode: 'client', connect: {{endpoints: ['{endpoint}']}}, scouting: {{multicast: {{enabled: false}}}}}}"
    )
    with (
        remote_monitor(mode="client", connect=[endpoint], retry_first_s=0.02, retry_longest_s=0.1),
        TransformClient("arm", zenoh_config_file=str(config), policy=PATIENT) as client,
        TransformClient("arm", connect=[endpoint], policy=PATIENT) as peer,
    ):
        # Before there is a session, too, a reading is there at once.
        assert client.latest().why is Unusable.NOT_CONNECTED and "no Zenoh session yet" in client.latest().reason
        for _ in range(2):
            with router(endpoint):
                first, second = usable(client), usable(peer)
                assert first.transform == second.transform
            refused(client, Unusable.GONE)
            refused(peer, Unusable.GONE)


_FLOOD = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("scouting/multicast/enabled", "false")
config.insert_json5("connect/endpoints", f'["{sys.argv[1]}"]')
payload = sys.stdin.read()
clock = sys.argv[2]
with zenoh.open(config) as session:
    while True:
        session.put("gripmon/arm/wrist/transform", payload, attachment=clock)
        session.put("gripmon/arm/wrist/transform", "{")
"""


def test_while_messages_pour_in_every_thread_gets_the_newest_at_once(endpoint: str):
    """As fast as another process can write, every other one no message at all."""
    with (
        remote_monitor(listen=[endpoint], fps=2.0),
        TransformClient("arm", connect=[endpoint], policy=PATIENT) as client,
        plain_session(connect=endpoint) as session,
    ):
        usable(client)
        (clock,) = ask(session, "gripmon/arm/wrist/transform?clock")  # sent then, the flood says of all that is in it
        command = [sys.executable, "-c", _FLOOD, endpoint, json.dumps(clock)]
        flood = subprocess.Popen(command, stdin=subprocess.PIPE)
        try:
            assert flood.stdin is not None
            flood.stdin.write(to_json(frame_record(10**6)))
            flood.stdin.close()
            wait_until(lambda: client.unreadable > 1000, "the flood")
            got: list[list[Reading]] = [[] for _ in range(4)]

            def look(mine: list[Reading]) -> None:
                while len(mine) < 500:
                    mine.append(client.latest())

            threads = [threading.Thread(target=look, args=(mine,)) for mine in got]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(60.0)
            assert [len(mine) for mine in got] == [500] * 4
            assert all(reading.usable for mine in got for reading in mine)
            assert next(iter(client)).usable
        finally:
            flood.kill()
            flood.wait()


def test_asyncio_gets_readings_and_the_end_and_a_cancelled_wait_loses_nothing(endpoint: str):
    async def read() -> tuple[list[Reading], Reading]:
        with TransformClient("arm", connect=[endpoint], policy=PATIENT) as client:
            readings = aiter(client)
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.05):
                    await anext(readings)  # no one is there yet
            started: list[Reading] = []
            monitor = remote_monitor(listen=[endpoint])
            process = await asyncio.to_thread(monitor.__enter__)
            try:
                async with asyncio.timeout(20.0):
                    async for reading in readings:
                        if reading.why is not Unusable.NOT_CONNECTED:  # it took its time to start: said once
                            started.append(reading)
                        if len(started) == 10:
                            break
                    process.send_signal(signal.SIGKILL)
                    gone = await anext(reading async for reading in readings if not reading.usable)
            finally:
                await asyncio.to_thread(monitor.__exit__, None, None, None)
            ending = asyncio.create_task(anext(readings, None))
            await asyncio.sleep(0)
            await asyncio.to_thread(client.close)
            assert await ending is None
            return started, gone

    started, gone = asyncio.run(read())
    seqs = [reading.seq for reading in started]
    assert all(reading.usable for reading in started) and seqs == sorted(set(seqs))
    assert gone.why is Unusable.GONE


def test_nothing_heavy_is_loaded():
    code = (
        "import sys; from gripmon.client import TransformClient; c = TransformClient('arm'); c.latest(); c.close();"
        "print(sorted({'numpy', 'scipy', 'cv2', 'rerun', 'yaml'} & set(sys.modules)))"
    )
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout == "[]\n"


def test_a_program_that_forgets_to_close_its_client_ends(endpoint: str):
    code = (
        "import sys; from gripmon.client import TransformClient; c = TransformClient('arm', connect=[sys.argv[1]]);"
        "c.on_transform(print); iter(c); print(c.latest().usable)"
    )
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run(
        [sys.executable, "-c", code, endpoint], capture_output=True, text=True, timeout=60.0, cwd=root
    )
    assert (done.returncode, done.stdout) == (0, "False\n") and "Traceback" not in done.stderr
