"""kill -9 at any moment: what a monitor has said or answered is on the disk, and no revision is ever used twice."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
import zenoh
from support.kept_states import configuration, keep, make_pictures
from support.loopback import free_endpoint, plain_session, wait_until

from gripmon.judge.references import state_fault
from gripmon.judge.statefile import unpack
from gripmon.model.records import CommandReply, FrameRecord, MonitorState, ReferenceRecord

HERE = Path(__file__).resolve().parent
PREFIX = "gripmon/demo/wrist"


class Witness:
    """Hears all that monitors say, and asks for an undo as soon as the last one was answered."""

    def __init__(self, session: zenoh.Session) -> None:
        self.faults: list[str] = []
        self.published: dict[int, ReferenceRecord] = {}
        self.named: dict[int, str] = {}
        self.answered = 0
        self.transforms = 0
        self._lock = threading.Lock()
        self._session = session
        self._subscribers = [
            session.declare_subscriber(f"{PREFIX}/reference", self._reference),
            session.declare_subscriber(f"{PREFIX}/transform", self._transform),
        ]

    @property
    def newest(self) -> int:
        with self._lock:
            return max(self.named, default=-1)

    def name(self, revision: int, reference_id: str) -> None:
        with self._lock:
            known = self.named.setdefault(revision, reference_id)
        if known != reference_id:
            self.faults.append(f"revision {revision} is {known}, and {reference_id}")

    def compare(self, path: Path) -> MonitorState:
        """The state in a file, which must hold together and agree with all that was heard so far."""
        kept, said = unpack(path.read_bytes()).state, self.newest
        assert state_fault(kept) == ""
        assert said <= kept.references[-1].revision, "what was said is kept"
        for reference in kept.references:
            self.name(reference.revision, reference.reference_id)
            assert self.published.get(reference.revision, reference) == reference
        assert self.faults == []
        return kept

    def ask_until(self, stop: threading.Event, references: list[str], timeout_s: float = 1.0) -> None:
        """Undo to and fro between the last two references, without a pause.

        An answer that doesn't come in time says nothing of whether it was done: only under the same id may it be asked
        for once more, else what was done already would be refused.
        """
        while not stop.is_set():
            payload = msgspec.json.encode({"argument": references[-2], "id": f"{len(references)}-{references[-1]}"})
            for reply in self._session.get(f"{PREFIX}/cmd/undo", payload=payload, timeout=timeout_s):
                if reply.ok is not None:
                    answer = msgspec.json.decode(reply.ok.payload.to_bytes(), type=CommandReply)
                    if not answer.done:
                        self.faults.append(answer.text)
                    self.name(answer.revision, answer.reference_id)
                    references.append(answer.reference_id)
                    self.answered += 1

    def accept(self) -> bool:
        """Accept whatever is proposed."""
        replies = self._session.get(f"{PREFIX}/cmd/accept", timeout=1.0)
        answers = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        return any(msgspec.json.decode(answer, type=CommandReply).done for answer in answers)

    def _reference(self, sample: zenoh.Sample) -> None:
        record = msgspec.json.decode(sample.payload.to_bytes(), type=ReferenceRecord)
        if self.published.setdefault(record.revision, record) != record:
            self.faults.append(f"two references of revision {record.revision}")
        self.name(record.revision, record.reference_id)

    def _transform(self, sample: zenoh.Sample) -> None:
        record = msgspec.json.decode(sample.payload.to_bytes(), type=FrameRecord)
        self.transforms += 1
        self.name(record.revision, record.reference_id)


class Forks:
    """Processes of ``gripmon run``, one after the other."""

    def __init__(self, config: Path) -> None:
        environment = os.environ | {
            "PYTHONPATH": f"{HERE.parent}:{HERE}",
            "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1",
        }
        self._parent = subprocess.Popen(
            [sys.executable, str(HERE / "support" / "forked_daemons.py"), str(config)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=(config.parent / "log.txt").open("wb"),
            text=True, env=environment,
        )  # fmt: skip

    def start(self) -> int:
        assert self._parent.stdin is not None and self._parent.stdout is not None
        self._parent.stdin.write("\n")
        self._parent.stdin.flush()
        return int(self._parent.stdout.readline())

    def kill(self, pid: int) -> None:
        """And wait until it is gone."""
        os.kill(pid, signal.SIGKILL)
        assert self._parent.stdout is not None and self._parent.stdout.readline() == "ended\n"

    def close(self) -> None:
        self._parent.communicate()


@contextmanager
def forks(config: Path) -> Iterator[Forks]:
    made = Forks(config)
    try:
        yield made
    finally:
        made.close()


@pytest.mark.parametrize(
    "kills",
    [4, pytest.param(50, marks=pytest.mark.slow("two minutes; four kills are in the default run"))],
)
def test_killed_at_any_moment_it_goes_on_from_what_it_said_last(kills: int, tmp_path: Path):
    """Frames as fast as they can be measured, a change of reference with nearly every one of them, and so many
    references that the monitor spends much of its time writing them.
    """
    endpoint = free_endpoint()
    config = configuration(tmp_path, make_pictures(tmp_path / "pictures", 1000), endpoint)
    state = keep(config, *[2e-5, -1e-5] * 400)
    chance = random.Random(5)
    lives: list[int] = []
    with plain_session(listen=endpoint, mode="router") as session, forks(config) as monitors:
        witness = Witness(session)
        for reference in state.references:
            witness.name(reference.revision, reference.reference_id)
        for life in range(kills):
            stop = threading.Event()
            recent = [reference.reference_id for reference in state.references[-2:]]
            # Now and then less time than the monitor needs on a busy machine.
            asker = threading.Thread(target=witness.ask_until, args=(stop, recent, 1.0 if life % 4 else 0.05))
            before = witness.answered
            pid = monitors.start()
            asker.start()
            if life % 2:
                wait_until(lambda before=before: witness.answered > before + 1, "the monitor to answer")
            # Any moment of the start and the first frames, or any moment of the work.
            time.sleep(chance.uniform(0.0, 0.3 if life % 2 else 0.6))
            monitors.kill(pid)
            stop.set()
            asker.join()
            state = witness.compare(tmp_path / "kept.json")
            lives.append(witness.answered - before)
    log = (tmp_path / "log.txt").read_text()
    assert "damaged" not in log and "Traceback" not in log
    assert not list(tmp_path.glob("kept.json.*-*")), "nothing was set aside"
    assert len(list(tmp_path.glob(".kept.json-*.tmp"))) <= 1, "each start clears what the last life left"
    assert sum(answers > 0 for answers in lives) > kills // 3, "many were killed at work"
    assert witness.transforms > kills and witness.answered >= kills
