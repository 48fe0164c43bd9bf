"""All episodes of a dataset into one table; episodes that were measured before are not measured again."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from gripmon import __version__
from gripmon.analyse.dataset import REPORT, TABLE, Results, write_table
from gripmon.analyse.dataset_page import write_page
from gripmon.analyse.stretches import POSE_COLUMNS
from gripmon.daemon.config import Config, load_config
from gripmon.daemon.dataset.engines import ENGINES, local, on_ray
from gripmon.daemon.replaying import as_configured
from gripmon.io.sources import BagSettings, LeRobotSettings
from gripmon.io.sources.episodes import Episode, find_episodes, hash_of
from gripmon.model.atomic import writable_folder
from gripmon.model.errors import InputError
from gripmon.model.records import to_json


@dataclass(frozen=True)
class Survey:
    """The files written, the number of episodes, how many were ``measured`` now, and how many have no transform."""

    table: Path
    report: Path
    episodes: int
    measured: int
    failed: int


def measure_dataset(
    dataset: str | Path,
    out: str | Path,
    config: Config | str | Path,
    *,
    cameras: Sequence[str] = (),
    lens: str = "file",
    engine: str = "local",
    workers: int | None = None,
    address: str | None = None,
    level: float = 0.01,
    tolerance_m: float = 0.0,
    tolerance_rad: float = 0.0,
    step: Callable[[int], None] = lambda _total: None,
) -> Survey:
    """Measure every episode of a folder or URL with each of its ``cameras`` (topics, features), and write the table and
    the report to the folder ``out``.  The dataset is only read.

    ``config``: the gripper, a camera, a rough reference, and in its source how the jaw opening follows from the state.
    ``level`` and the tolerances: see :func:`gripmon.analyse.dataset.mountings_of`.  ``workers``: number of processes
    (None: one per core).  ``step`` is called with the number of episodes after each one.
    Called again with the same ``out``, it measures what is new, has changed or was interrupted.

    Raises :class:`InputError`: nothing to measure, several cameras without a choice, an ``out`` that can't be written
    or has results of another configuration, an engine that isn't available.
    """
    if engine not in ENGINES:
        raise InputError(f"{engine!r} is none; {' or '.join(ENGINES)}", "engine")
    if workers is not None and workers < 1:
        raise InputError(f"{workers} isn't a number of processes; 1 or more", "workers")
    config = config if isinstance(config, Config) else load_config(config, check_source=False)
    episodes = [_configured(episode, config) for episode in find_episodes(str(dataset), cameras)]
    folder = writable_folder(Path(out))
    with Results(folder, _fingerprint(config, lens)) as results:
        left = [episode for episode in episodes if episode not in results]
        for _ in range(len(episodes) - len(left)):
            step(len(episodes))
        if engine == "ray":
            measured = on_ray(config, left, lens, address)
        else:
            measured = local(config, left, lens, workers or len(os.sched_getaffinity(0)))
        with contextlib.closing(measured):
            for episode, rows in measured:
                results.add(episode, rows)
                step(len(episodes))
        table = write_table(results, episodes, folder, level, tolerance_m, tolerance_rad)
        write_page(folder / REPORT, table, results, episodes, str(dataset))
    known = table.filter(table[POSE_COLUMNS[0]].is_valid()).group_by(["episode", "camera"]).aggregate([])
    failed = len(episodes) - len(known)
    return Survey(folder / TABLE, folder / REPORT, len(episodes), len(left), failed)


def _configured(episode: Episode, config: Config) -> Episode:
    source = episode.source
    if not isinstance(source, BagSettings | LeRobotSettings):
        return episode
    number = source.episode if isinstance(source, LeRobotSettings) else None
    settings = as_configured(source, config, source.camera, number)
    return msgspec.structs.replace(episode, source=settings)


def _fingerprint(config: Config, lens: str) -> str:
    """A hash of everything on which a result depends besides the episode."""
    settings = config.settings
    opening = getattr(settings.source, "opening", None)
    parts = [settings.camera, settings.monitor, settings.jaw, opening, config.reference, config.gripper.model]
    taught = "" if config.taught is None else to_json(config.taught)
    return hash_of([__version__, lens, taught, *(msgspec.json.encode(part) for part in parts)])
