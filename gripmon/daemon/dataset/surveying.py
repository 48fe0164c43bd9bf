"""All episodes of a dataset into one table; episodes that were measured before are not measured again."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from gripmon import __version__
from gripmon.analyse.dataset import Journal, Rows, Written, write_dataset
from gripmon.analyse.dataset_annotations import Annotations
from gripmon.analyse.dataset_page import write_page
from gripmon.daemon.config import Config, load_config, read_gripper
from gripmon.daemon.dataset.engines import local, ray_cluster
from gripmon.daemon.dataset.measuring import Configs
from gripmon.daemon.replaying import as_configured
from gripmon.io.sources import BagSettings, LeRobotSettings
from gripmon.io.sources.episodes import Episode, find_episodes, hash_of
from gripmon.model.atomic import writable_folder
from gripmon.model.errors import InputError
from gripmon.model.records import to_json


@dataclass(frozen=True)
class Survey:
    """The files ``written``, the number of episodes, how many were ``measured`` now, and how many failed."""

    written: Written
    episodes: int
    measured: int

    @property
    def failed(self) -> int:
        return self.written.failed


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
    annotate: str | Path | None = None,
    grippers: Sequence[str | Path] = (),
    step: Callable[[int], None] = lambda _total: None,
) -> Survey:
    """Measure every episode of a folder or URL with each of its ``cameras`` (topics, features), and write the table and
    the report to the folder ``out``.  The dataset is only read.

    ``config``: the gripper, a camera, a rough reference, and in its source how the jaw opening follows from the state.
    ``level`` and the tolerances: see :func:`gripmon.analyse.stretches.mountings_of`.  ``workers``: number of processes
    (None: one per core).  ``annotate``: a folder or URL for the results in the dataset's own format, see
    :class:`gripmon.analyse.dataset_annotations.Annotations`.  ``grippers``: files in addition to the configuration's;
    each episode is measured with the one that its frames show, and fails if none or several fit
    (:func:`gripmon.daemon.dataset.fitting.chosen`).  ``step`` is called with the number of episodes after each one.
    Called again with the same ``out``, it measures what is new, has changed or was interrupted.

    Raises :class:`InputError`: nothing to measure, several cameras without a choice, an ``out`` with results of another
    configuration, an engine that isn't available.
    """
    config = config if isinstance(config, Config) else load_config(config, check_source=False)
    # The taught model belongs to the configuration's own gripper.
    others = (
        replace(config, gripper=read_gripper(path), gripper_path=path, taught=None) for path in map(Path, grippers)
    )
    configs = (config, *others)
    if len({one.gripper_path.stem for one in configs}) < len(configs):
        raise InputError("two files of one name, or the configuration's own again; each file once", "gripper")
    episodes = [_configured(episode, config) for episode in find_episodes(str(dataset), cameras)]
    annotations = None if annotate is None else Annotations(episodes, str(annotate))
    folder = writable_folder(Path(out))
    with Journal(folder, _fingerprint(configs, lens)) as journal:
        versions = {episode.key: episode.version for episode in episodes}
        journal.keep(versions)
        left = [episode for episode in episodes if episode.key not in journal]
        for _ in range(len(episodes) - len(left)):
            step(len(episodes))
        if engine == "ray":
            results = ray_cluster(configs, left, lens, address)
        else:
            results = local(configs, left, lens, workers or len(os.sched_getaffinity(0)))
        for measured in results if left else ():
            journal.add(measured)
            step(len(episodes))
        order = [episode.key for episode in episodes]
        written = write_dataset(journal, order, folder, level, tolerance_m, tolerance_rad)
        write_page(written, journal, str(dataset))
        if annotations is not None:
            annotations.write(Rows(journal, written))
    return Survey(written, len(episodes), len(left))


def _configured(episode: Episode, config: Config) -> Episode:
    source = episode.source
    if not isinstance(source, BagSettings | LeRobotSettings):
        return episode
    number = source.episode if isinstance(source, LeRobotSettings) else None
    settings = as_configured(source, config, source.camera, number)
    return msgspec.structs.replace(episode, source=settings)


def _fingerprint(configs: Configs, lens: str) -> str:
    """A hash of everything on which a result depends besides the episode."""
    config = configs[0]
    settings = config.settings
    opening = getattr(settings.source, "opening", None)
    parts = [settings.camera, settings.monitor, settings.jaw, opening, config.reference]
    parts += [one.gripper.model for one in configs]
    taught = "" if config.taught is None else to_json(config.taught)
    return hash_of([__version__, lens, taught, *(msgspec.json.encode(part) for part in parts)])
