"""Measures episodes in processes of this machine or on a Ray cluster.  Both keep few in flight, so that memory doesn't
grow with the dataset, and return rows for each, also for one that kills its worker.
"""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Generator, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

from gripmon.daemon.config import Config
from gripmon.daemon.dataset.measuring import Rows, failed, measure
from gripmon.io.sources.episodes import Episode
from gripmon.model.errors import InputError, one_line
from gripmon.model.own_process import OwnProcess

ENGINES = ("local", "ray")
WORKER_EPISODES = 200
"""A worker is replaced after this many, lest what a decoder keeps adds up: its memory grew by 55 MB over 30 episodes
and not at all over the next 30, and its start is half a per cent of its time.
"""
TRIES = 2
"""Workers that an episode may cost here: one may have been short of memory because of another one."""
DIED = "the process that measured it died, also when it was tried again (out of memory, or a decoder that crashed)"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_RAY_TRIES, _RAY_AHEAD = 3, 2
"""Workers that an episode may cost there; tasks in flight for each core, so that none waits for the driver."""

Measuring = Callable[[Config, Episode, str], Rows]


class _Worker:
    """A process that measures one episode at a time."""

    def __init__(self, config: Config, lens: str, work: Measuring) -> None:
        self.connection, theirs = Pipe()
        with theirs:  # so that the end of the process is the end of the connection
            self.process = OwnProcess(_serve, theirs.fileno(), config, lens, work, inherits=(theirs.fileno(),))
        self.began, self.measured = False, 0

    def end(self) -> None:
        """End the process, whatever it does, and wait until it has ended."""
        self.process.end()
        self.connection.close()


def _serve(descriptor: int, config: Config, lens: str, work: Measuring) -> None:
    import cv2

    cv2.setNumThreads(1)
    with contextlib.suppress(EOFError, OSError), Connection(descriptor) as connection:  # until the driver ends
        connection.send(None)
        while True:
            connection.send(work(config, connection.recv(), lens))


def local(
    config: Config, episodes: Sequence[Episode], lens: str, workers: int, work: Measuring = measure
) -> Generator[tuple[Episode, Rows], None, None]:
    """Measure in ``workers`` processes, each replaced after :data:`WORKER_EPISODES`; an episode that kills
    :data:`TRIES` of them is given up.  Raises :class:`InputError` if a process can't even begin.
    """
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    waiting, tries = deque(episodes), dict.fromkeys((episode.key for episode in episodes), 0)
    idle: list[_Worker] = []
    busy: dict[Any, tuple[_Worker, Episode]] = {}

    def assign() -> None:
        while waiting and len(busy) < workers:
            worker, episode = idle.pop() if idle else _Worker(config, lens, work), waiting.popleft()
            busy[worker.connection] = worker, episode
            with contextlib.suppress(OSError):  # it has died, which is told when its answer is read
                worker.connection.send(episode)

    try:
        assign()
        while busy:
            for connection in wait(list(busy)):
                worker, episode = busy[connection]
                try:
                    rows: Rows | None = worker.connection.recv()
                except (EOFError, OSError):
                    worker.end()
                    if not worker.began:
                        text = f"a process can't begin (exit code {worker.process.returncode}); what it wrote is above"
                        raise InputError(text, "engine") from None
                    tries[episode.key] += 1
                    rows = failed(config, episode, DIED) if tries[episode.key] >= TRIES else None
                    waiting.extendleft([] if rows else [episode])
                else:
                    if rows is None:
                        worker.began = True
                        continue
                    worker.measured += 1
                    if worker.measured < WORKER_EPISODES:
                        idle.append(worker)
                    else:
                        worker.end()
                del busy[connection]
                assign()
                if rows:
                    yield episode, rows
    finally:
        for worker in (*idle, *(each for each, _ in busy.values())):
            worker.end()


def on_ray(
    config: Config, episodes: Sequence[Episode], lens: str, address: str | None
) -> Generator[tuple[Episode, Rows], None, None]:
    """Measure on the Ray cluster at ``address`` (None: the one that Ray finds, or this machine), on as many nodes as it
    has at a time.  Ray retries an episode whose worker died; one that kills :data:`_RAY_TRIES` is given up.

    Raises :class:`InputError` without Ray, if no cluster answers, and if it is lost or can't run tasks.
    """
    if not episodes:
        return
    try:
        import ray
        from ray.exceptions import OutOfMemoryError, RayError, WorkerCrashedError
    except ImportError:
        raise InputError("needs Ray; pip install -e '.[ray]' in gripmon's checkout", "engine") from None
    if not ray.is_initialized():
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            where = address or "this machine"
            raise InputError(f"no Ray cluster at {where} ({one_line(error):.200})", "address") from None
    environment = {"env_vars": dict.fromkeys(_ONE_THREAD, "1")}
    task: Any = ray.remote(
        num_cpus=1, max_calls=WORKER_EPISODES, max_retries=_RAY_TRIES - 1, runtime_env=environment
    )(_on_ray)
    resources: Any = ray.cluster_resources
    waiting, flying = deque(episodes), dict[Any, Episode]()
    try:
        shared = ray.put(config)
        while waiting or flying:
            most = _RAY_AHEAD * max(int(resources().get("CPU", 1)), 1)
            while waiting and len(flying) < most:
                episode = waiting.popleft()
                flying[task.remote(shared, episode, lens)] = episode
            for done in ray.wait(list(flying), num_returns=1)[0]:
                episode = flying.pop(done)
                try:
                    rows = ray.get(done)
                except (WorkerCrashedError, OutOfMemoryError):
                    rows = failed(config, episode, DIED)
                yield episode, rows
    except RayError as error:
        right = "every node needs the same gripmon; what was measured is kept, call again"
        raise InputError(f"the Ray cluster failed ({one_line(error):.300}); {right}", "engine") from None


def _on_ray(config: Config, episode: Episode, lens: str) -> Rows:
    import cv2

    cv2.setNumThreads(1)
    return measure(config, episode, lens)
