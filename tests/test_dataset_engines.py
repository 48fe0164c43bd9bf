"""The engines of ``gripmon dataset``: what dies, what can't begin, and a cluster whose nodes come and go."""

from __future__ import annotations

import itertools
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import psutil
import pytest
from support.dataset_scenes import make_bags, make_lerobot
from test_dataset import assert_true, hashes_of, of_name, rows_of

from gripmon.analyse.stretches import Stretch
from gripmon.daemon.config import Config, builtin_config, load_config
from gripmon.daemon.dataset import engines, measure_dataset
from gripmon.daemon.dataset.engines import DIED, local, on_ray
from gripmon.io.sources.episodes import Episode
from gripmon.model.errors import InputError


def test_arguments_that_are_wrong_are_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="engine: 'dask' is none; local or ray"):
        measure_dataset(tmp_path, tmp_path / "out", "c.yaml", engine="dask")
    with pytest.raises(InputError, match="workers: 0 isn't a number of processes; 1 or more"):
        measure_dataset(tmp_path, tmp_path / "out", "c.yaml", workers=0)
    assert not (tmp_path / "out").exists()


def die_of_the_second(_config: Config, episode: Episode, _lens: str) -> tuple[Stretch, ...]:
    if episode.name == "1":
        os._exit(9)
    return (Stretch(episode=episode.name, camera=str(os.getpid())),)


def test_episode_that_kills_its_worker_is_a_row_and_the_others_are_measured(monkeypatch: pytest.MonkeyPatch):
    """Workers are also replaced, after two episodes here, before what stays with them adds up."""
    monkeypatch.setattr(engines, "WORKER_EPISODES", 2)
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    found = {
        episode.name: rows[0]
        for episode, rows in local(config, [of_name(str(i)) for i in range(5)], "file", 1, die_of_the_second)
    }
    assert {name: row.reason for name, row in found.items()} == dict.fromkeys("0234") | {"1": DIED}
    assert sorted(Counter(row.camera for name, row in found.items() if name != "1").values()) == [1, 1, 2]


class CannotBegin:
    """Work that no other process can read."""

    def __reduce__(self) -> tuple[Callable[[int], None], tuple[int]]:
        return os._exit, (7,)


def test_process_that_cannot_begin_is_one_line_and_no_row():
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    with pytest.raises(InputError, match=r"engine: a process can't begin \(exit code 7\)"):
        list(local(config, [of_name("a")], "file", 1, CannotBegin()))  # type: ignore[arg-type]


class RayError(Exception):
    """As Ray's own."""


class WorkerCrashedError(RayError): ...


@pytest.fixture
def ray_stub(monkeypatch: pytest.MonkeyPatch) -> dict[str, Exception]:
    """Ray as far as it is asked: a task is done at once; the exceptions by episode that its result raises."""
    raised: dict[str, Exception] = {}

    def get(task: tuple[Any, ...]) -> tuple[Stretch, ...]:
        if (error := raised.get(task[1].name)) is not None:
            raise error
        return (Stretch(episode=task[1].name),)

    class Remote:
        def remote(self, *arguments: Any) -> tuple[Any, ...]:
            return arguments

    ray, exceptions = ModuleType("ray"), ModuleType("ray.exceptions")
    ray.is_initialized = lambda: True  # type: ignore[attr-defined]
    ray.put = lambda _config: "config"  # type: ignore[attr-defined]
    ray.remote = lambda **_how: lambda _function: Remote()  # type: ignore[attr-defined]
    ray.cluster_resources = lambda: {"CPU": 1.0}  # type: ignore[attr-defined]
    ray.wait = lambda tasks, num_returns: (tasks[:num_returns], tasks[num_returns:])  # type: ignore[attr-defined]
    ray.get = get  # type: ignore[attr-defined]
    vars(exceptions).update(
        RayError=RayError, WorkerCrashedError=WorkerCrashedError, OutOfMemoryError=type("Memory", (RayError,), {})
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", exceptions)
    return raised


def test_on_ray_what_kills_its_workers_is_a_row_and_a_cluster_that_fails_is_none(ray_stub: dict[str, Exception]):
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    ray_stub["1"] = WorkerCrashedError("it died")
    found = on_ray(config, [of_name(str(i)) for i in range(4)], "file", None)
    assert [(episode.name, rows[0].reason) for episode, rows in found] == [
        ("0", None), ("1", DIED), ("2", None), ("3", None),
    ]  # fmt: skip
    ray_stub["2"] = RayError("the head\nis gone")
    kept: list[Any] = []
    with pytest.raises(InputError, match=r"engine: the Ray cluster failed \(the head is gone\); .* call again"):
        kept.extend(on_ray(config, [of_name(str(i)) for i in range(4)], "file", None))
    assert [episode.name for episode, _ in kept] == ["0", "1"]


PLAN = [(i * 3 // 9, i == 5) for i in range(9)]
PLAN_OF_BAGS = [(i % 3, False) for i in range(4)]


@pytest.mark.slow("two minutes: thirteen episodes, Ray; four episodes and the local engine are tested above")
def test_episodes_here_and_on_a_cluster_with_a_kill_and_a_node_that_joins(tmp_path: Path):
    """A LeRobot dataset and a folder of MCAPs, three mountings, an episode in which the camera moves."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    config, truths = make_lerobot(tmp_path, PLAN)
    config_of_bags, truths_of_bags = make_bags(tmp_path, PLAN_OF_BAGS)
    measure_dataset(tmp_path / "set", tmp_path / "out", config)
    measure_dataset(tmp_path / "bags", tmp_path / "out_of_bags", config_of_bags)
    assert_true(rows_of(tmp_path / "out"), truths, lambda _: 0.0)
    assert_true(rows_of(tmp_path / "out_of_bags"), truths_of_bags, lambda row: 1e-9 * row["start_ns"])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        killer = threading.Thread(target=kill_one_worker, daemon=True)
        killer.start()
        stored = itertools.count(1)

        def join(_total: int) -> None:
            if next(stored) == 3:
                cluster.add_node(num_cpus=1)

        out = tmp_path / "on_ray"
        found = measure_dataset(tmp_path / "set", out, config, engine="ray", address=cluster.address, step=join)
        assert ray.cluster_resources()["CPU"] == 2.0
        killer.join(10.0)
        assert not killer.is_alive(), "a worker was killed"
        assert (found.measured, found.failed) == (9, 0)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert hashes_of(tmp_path / "on_ray" / "stretches") == hashes_of(tmp_path / "out" / "stretches")


def kill_one_worker() -> None:
    """A process of this test's cluster that measures an episode."""
    me = psutil.Process()
    while True:
        for process in me.children(recursive=True):
            try:
                if process.cmdline()[0].startswith("ray::_on_ray"):
                    time.sleep(1.0)
                    process.kill()
                    return
            except (psutil.Error, IndexError):
                continue
        time.sleep(0.1)
