"""Measures episodes in processes of this machine or on a Ray cluster.  Both keep few in flight, so that memory doesn't
grow with the dataset, and return a result for each, also for one that kills its worker.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from gripmon.analyse.dataset import Measured
from gripmon.daemon.dataset.measuring import Configs, failed, measure
from gripmon.io.sources.episodes import Episode
from gripmon.model.errors import InputError, one_line
from gripmon.model.stopping import end_with_parent

AHEAD = 2
"""Episodes in flight per worker: one being measured and one waiting, so that no worker is idle."""
WORKER_EPISODES = 50
"""A worker is replaced after this many: each leaks about 3 MB, 0.15 GB until then, of unknown cause; the 2 s of its
start are one or two per cent of its time.
"""
DIED = "the process that measured it died, also when it was alone (out of memory, or a decoder that crashed)"
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_RAY_TRIES = 3

_given: tuple[Configs, str] | None = None


def _begin(configs: Configs, lens: str) -> None:
    """Initialise a worker."""
    global _given
    import cv2

    cv2.setNumThreads(1)
    _given = configs, lens


def _begin_here(configs: Configs, lens: str) -> None:
    end_with_parent()
    _begin(configs, lens)


def _work(episode: Episode) -> Measured:
    assert _given is not None, "a worker begins with _begin"
    configs, lens = _given
    return measure(configs, episode, lens)


def local(
    configs: Configs,
    episodes: Sequence[Episode],
    lens: str,
    workers: int,
    work: Callable[[Episode], Measured] = _work,
) -> Iterator[Measured]:
    """Measure in ``workers`` processes, each replaced after :data:`WORKER_EPISODES`.  If one dies, the episodes in
    flight are measured again one by one; an episode that kills its worker again is given up.
    """
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    waiting, suspects = deque(episodes), deque[Episode]()
    while waiting or suspects:
        alone = bool(suspects)
        queue, count = (suspects, 1) if alone else (waiting, workers)
        with ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _begin_here, (configs, lens)) as pool:
            flying: dict[Future[Measured], Episode] = {}
            left = count * WORKER_EPISODES
            try:
                while (queue and left) or flying:
                    while queue and left and len(flying) < (1 if alone else AHEAD * count):
                        left -= 1
                        episode = queue.popleft()
                        try:
                            flying[pool.submit(work, episode)] = episode
                        except BrokenProcessPool:
                            queue.appendleft(episode)
                            raise
                    for done in wait(flying, return_when=FIRST_COMPLETED).done:
                        measured = done.result()
                        flying.pop(done)
                        yield measured
            except BrokenProcessPool:
                finished = [future for future in flying if future.done() and future.exception() is None]
                yield from (future.result() for future in finished)
                lost = [episode for future, episode in flying.items() if future not in finished]
                if alone:
                    yield from (failed(configs, episode, DIED) for episode in lost)
                else:
                    suspects.extend(lost)
            except GeneratorExit:
                pool.shutdown(wait=True, cancel_futures=True)
                raise


def ray_cluster(configs: Configs, episodes: Sequence[Episode], lens: str, address: str | None) -> Iterator[Measured]:
    """Measure on the Ray cluster at ``address`` (None: the one that Ray finds, or this machine).  Ray retries an
    episode whose worker died; one that kills three workers is given up.

    Raises :class:`InputError` without Ray, or if no cluster answers.
    """
    try:
        import ray
    except ImportError:
        raise InputError("needs Ray; pip install -e '.[ray]' in gripmon's checkout", "engine") from None
    if not ray.is_initialized():
        try:
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(
                f"no Ray cluster at {address or 'this machine'} ({one_line(error):.200})", "address"
            ) from None
    environment = {"env_vars": dict.fromkeys(_ONE_THREAD, "1")}
    task: Any = ray.remote(num_cpus=1, max_calls=WORKER_EPISODES, max_retries=_RAY_TRIES - 1, runtime_env=environment)(
        _on_ray
    )
    shared = ray.put((configs, lens))
    waiting, flying = deque(episodes), dict[Any, Episode]()
    resources: Any = ray.cluster_resources
    while waiting or flying:
        most = AHEAD * max(int(resources().get("CPU", 1)), 1)
        while waiting and len(flying) < most:
            episode = waiting.popleft()
            flying[task.remote(shared, episode)] = episode
        for done in ray.wait(list(flying), num_returns=1)[0]:
            episode = flying.pop(done)
            try:
                yield ray.get(done)
            except ray.exceptions.RayError:
                yield failed(configs, episode, DIED)


def _on_ray(given: tuple[Configs, str], episode: Episode) -> Measured:
    _begin(*given)
    return _work(episode)
