"""The episodes of a dataset: all recordings below a folder or URL."""

from __future__ import annotations

import contextlib
import hashlib
import posixpath
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from gripmon.io.sources.bags import BagSettings
from gripmon.io.sources.base import SourceError
from gripmon.io.sources.files import FolderSettings, VideoSettings
from gripmon.io.sources.lerobot import INFO, LeRobotSettings, open_dataset
from gripmon.io.sources.stored import file_system
from gripmon.model.errors import one_line
from gripmon.model.images import IMAGE_SUFFIXES, VIDEO_SUFFIXES, natural_key

_BAGS = (".mcap", ".bag")
_ANNOTATION = ".gripmon.mcap"
"""Ending of files that an earlier ``gripmon dataset`` wrote beside recordings; these are not episodes."""

Settings = BagSettings | LeRobotSettings | FolderSettings | VideoSettings


class Episode(msgspec.Struct, frozen=True):
    """One recording of one camera."""

    name: str
    """Its path below the dataset; in a LeRobot dataset with the episode's number after ``#``."""
    source: Settings
    version: str
    """Changes with its files: their sizes and the store's modification times."""

    @property
    def key(self) -> str:
        """The episode and the camera."""
        return f"{self.name}|{getattr(self.source, 'camera', None) or ''}"


def find_episodes(root: str, cameras: Sequence[str] = ()) -> list[Episode]:
    """All episodes below a folder or URL, in natural order: LeRobot datasets, MCAP files, rosbags, folders of
    images (``timestamps.csv`` beside them), videos; nothing in hidden folders.

    ``cameras``: topics or features, one episode for each; none: the only one.  Opens only the files that describe a
    LeRobot dataset.  Raises :class:`SourceError` if the folder can't be listed, and for a LeRobot dataset with several
    cameras if none is named.
    """
    system, inside = file_system(root)
    try:
        found: dict[str, dict[str, Any]] = system.find(inside, detail=True)
    except Exception as error:  # noqa: BLE001  each store has its own
        raise SourceError(f"path: {root} can't be listed ({one_line(error):.200})") from None
    files = {
        path: about
        for path, about in sorted(found.items())
        if not path.endswith(_ANNOTATION) and not any(p.startswith(".") for p in path[len(inside) :].split("/"))
    }
    if not files:
        raise SourceError(f"path: there is nothing in {root}; a folder or a URL with episodes")
    remote = "://" in root
    episodes: list[Episode] = []
    for kind, path, parts in _recordings(list(files)):
        name = path[len(inside) :].strip("/")
        at, version = system.unstrip_protocol(path) if remote else path, _version([files[part] for part in parts])
        if kind is LeRobotSettings:
            episodes += _of_lerobot(at, name, cameras, {file[len(path) + 1 :]: found[file] for file in parts})
        elif kind is BagSettings:
            name = name or posixpath.basename(path)
            episodes += [Episode(name, BagSettings(path=at, camera=camera), version) for camera in cameras or (None,)]
        elif not remote:
            episodes.append(Episode(name or posixpath.basename(path), kind(path=at), version))
    if not episodes:
        right = "LeRobot datasets, .mcap or .bag files, rosbag2 folders, folders of images or videos"
        if any(path.endswith(".rrd") for path in files):
            right += "; for gripmon's own recordings there are gripmon report, correct and export"
        raise SourceError(f"path: there is no episode in {root}; {right}")
    if cameras and not any(getattr(one.source, "camera", None) for one in episodes):
        raise SourceError(f"camera: {root} holds plain images or videos, of one camera each; leave it out")
    return sorted(episodes, key=lambda one: natural_key(one.key))


def _recordings(files: Sequence[str]) -> Iterator[tuple[type[Any], str, list[str]]]:
    """Kind, path and files of each recording among ``files``; nothing inside of another one."""
    folders: dict[str, list[str]] = {}
    for path in files:
        folders.setdefault(posixpath.dirname(path), []).append(path)
    taken: set[str] = set()
    for path in files:
        folder, name = posixpath.split(path)
        if path.endswith(f"/{INFO}"):
            taken.add(dataset := path[: -len(INFO) - 1])
            yield LeRobotSettings, dataset, [each for each in files if each.startswith(f"{dataset}/")]
        elif name == "metadata.yaml" and any(each.endswith((".db3", ".mcap")) for each in folders[folder]):
            taken.add(folder)
            yield BagSettings, folder, folders[folder]
    for folder, inner in folders.items():
        ancestors = [folder[:end] for end, letter in enumerate(folder) if letter == "/"]
        if not taken.isdisjoint([folder, *ancestors]):
            continue
        suffixes = {path: posixpath.splitext(path)[1].lower() for path in inner}
        if any(suffix in IMAGE_SUFFIXES for suffix in suffixes.values()):
            yield FolderSettings, folder, inner
        for path, suffix in suffixes.items():
            if suffix in _BAGS or suffix in VIDEO_SUFFIXES:
                yield BagSettings if suffix in _BAGS else VideoSettings, path, [path]


def _of_lerobot(path: str, name: str, cameras: Sequence[str], files: dict[str, dict[str, Any]]) -> list[Episode]:
    """``files``: the dataset's, by their paths in it."""
    open_dataset.cache_clear()  # it may have changed since
    dataset = open_dataset(path)
    named = ", ".join(dataset.cameras) or "none"
    if not cameras and len(dataset.cameras) != 1:
        raise SourceError(f"camera: {path} has {len(dataset.cameras)}; name those at the wrist: {named}")
    if absent := [camera for camera in cameras if camera not in dataset.cameras]:
        raise SourceError(f"camera: {path} has no {absent[0]}; of: {named}")

    def version(number: int, camera: str) -> str:
        """Of what the episode is made of: others may come to the dataset meanwhile."""
        own = dataset.files(number, camera)
        found = [files.get(file[len(path) + 1 :], {"name": file, "islink": True}) for file in own]
        return hash_of([dataset.description, dataset.episodes[number], _version(found)])

    return [
        Episode(
            f"{name}#{number:06d}", LeRobotSettings(path=path, camera=camera, episode=number), version(number, camera)
        )
        for number in sorted(dataset.episodes)
        for camera in cameras or dataset.cameras
    ]


def _version(files: Sequence[dict[str, Any]]) -> str:
    return hash_of([_facts(one) for one in files])


def _facts(file: dict[str, Any]) -> list[Any]:
    """What tells that a file changed, as its store lists it; a link to one, or what is behind a link to a folder, isn't
    listed by what it leads to.
    """
    if file.get("islink"):
        with contextlib.suppress(OSError):
            there = Path(file["name"]).stat()
            return [there.st_size, there.st_mtime_ns]
    return [file.get(key) for key in ("size", "mtime", "ETag", "LastModified", "created")]


def hash_of(value: Any) -> str:
    """Digest of plain values, sixteen hexadecimal digits."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:16]
