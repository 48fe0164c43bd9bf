"""The episodes of a dataset: all recordings below a folder or URL."""

from __future__ import annotations

import posixpath
from collections.abc import Sequence
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

ANNOTATION_SUFFIX = ".gripmon.mcap"
"""Ending of the files that ``gripmon dataset --annotate`` writes beside recordings; these are not episodes."""


class Episode(msgspec.Struct, frozen=True):
    """One recording of one camera."""

    name: str
    """Its path below the dataset; in a LeRobot dataset with the episode's number after ``#``."""
    source: BagSettings | LeRobotSettings | FolderSettings | VideoSettings
    version: str
    """Changes with its files: their sizes and the store's modification times."""

    @property
    def key(self) -> str:
        """Digest of the episode and the camera."""
        return f"{self.name}|{getattr(self.source, 'camera', None) or ''}"


def find_episodes(root: str, cameras: Sequence[str] = ()) -> list[Episode]:
    """All episodes below a folder or URL, in natural order: LeRobot datasets, MCAP files, rosbag2 folders, folders of
    images (``timestamps.csv`` beside them), videos; nothing in hidden folders.

    ``cameras``: topics or features, one episode for each; none: the only one.  Opens only the files that describe a
    LeRobot dataset.  Raises :class:`SourceError` if the folder can't be listed, and for a LeRobot dataset with several
    cameras if none is named.
    """
    system, inside = file_system(root)
    try:
        files: dict[str, dict[str, Any]] = system.find(inside, detail=True)
    except Exception as error:  # noqa: BLE001  each store has its own
        raise SourceError(f"path: {root} can't be listed ({one_line(error):.200})") from None
    files = {
        path: one
        for path, one in files.items()
        if not any(part.startswith(".") for part in path[len(inside) :].split("/"))
        and not path.endswith(ANNOTATION_SUFFIX)
    }
    if not files:
        raise SourceError(f"path: there is nothing in {root}; a folder or a URL with episodes")
    remote = "://" in root
    found: list[Episode] = []
    taken: set[str] = set()
    folders: dict[str, list[str]] = {}
    for path in files:
        folders.setdefault(posixpath.dirname(path), []).append(path)

    def add(path: str, kind: type[Any], parts: list[str], **more: Any) -> None:
        named = system.unstrip_protocol(path) if remote else path
        name = path[len(inside) :].strip("/") or posixpath.basename(path)
        found.append(Episode(name, kind(path=named, **more), _version([files[part] for part in parts])))

    for path in sorted(files):
        if path.endswith(f"/{INFO}"):
            dataset = path[: -len(INFO) - 1]
            taken.add(dataset)
            named = system.unstrip_protocol(dataset) if remote else dataset
            found += _of_lerobot(named, dataset[len(inside) :].strip("/"), cameras, _version([files[path]]))
            continue
        folder, name = posixpath.split(path)
        if name == "metadata.yaml" and any(each.endswith((".db3", ".mcap")) for each in folders[folder]):
            taken.add(folder)
            for camera in cameras or (None,):
                add(folder, BagSettings, folders[folder], camera=camera)
    for path in sorted(files):
        if any(path.startswith(f"{folder}/") for folder in taken):
            continue
        suffix = posixpath.splitext(path)[1].lower()
        if suffix == ".mcap":
            for camera in cameras or (None,):
                add(path, BagSettings, [path], camera=camera)
        elif suffix in VIDEO_SUFFIXES and not remote:
            add(path, VideoSettings, [path])
    for folder, inner in folders.items():
        images = any(Path(path).suffix.lower() in IMAGE_SUFFIXES for path in inner)
        if images and not remote and not any(f"{folder}/".startswith(f"{other}/") for other in taken):
            add(folder, FolderSettings, inner)
    if not found:
        right = "LeRobot datasets, .mcap files, rosbag2 folders, folders of images or videos"
        if any(path.endswith(".rrd") for path in files):
            right += "; for gripmon's own recordings there are gripmon report, correct and export"
        raise SourceError(f"path: there is no episode in {root}; {right}")
    if cameras and not any(getattr(one.source, "camera", None) for one in found):
        raise SourceError(f"camera: {root} holds plain images or videos, of one camera each; leave it out")
    return sorted(found, key=lambda one: natural_key(one.key))


def _of_lerobot(path: str, name: str, cameras: Sequence[str], version: str) -> list[Episode]:
    dataset = open_dataset(path)
    if not cameras and len(dataset.cameras) != 1:
        raise SourceError(
            f"camera: {path} has {len(dataset.cameras)}; name those at the wrist: {_list(dataset.cameras)}"
        )
    if absent := [camera for camera in cameras if camera not in dataset.cameras]:
        raise SourceError(f"camera: {path} has no {absent[0]}; of: {_list(dataset.cameras)}")
    return [
        Episode(f"{name}#{number:06d}", LeRobotSettings(path=path, camera=camera, episode=number), version)
        for number in sorted(dataset.episodes)
        for camera in cameras or dataset.cameras
    ]


def _list(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def _version(files: list[dict[str, Any]]) -> str:
    properties = [[one.get(key) for key in ("size", "mtime", "ETag", "LastModified", "created")] for one in files]
    return str(hash_of(properties))


def hash_of(value: Any) -> str:
    """Digest of plain values, sixteen hexadecimal digits."""
    import hashlib

    return hashlib.sha256(repr(value).encode()).hexdigest()[:16]
