"""A dataset's extrinsics in its own format: an MCAP beside each recording, or a copy of a LeRobot dataset with
additional columns.  The recordings themselves are never written to.

The columns and their metadata are as LeRobot's ``dataset_tools.add_features`` writes them; MCAP messages are JSON with
a schema.
"""

from __future__ import annotations

import io
import json
import posixpath
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gripmon import __version__
from gripmon.analyse.dataset import SCHEMA, Rows
from gripmon.io.sources.episodes import ANNOTATION_SUFFIX, Episode
from gripmon.io.sources.lerobot import INFO, LeRobotDataset, LeRobotSettings, open_dataset
from gripmon.io.sources.stored import file_system, joined, needed, opened
from gripmon.model.atomic import write_atomically
from gripmon.model.errors import InputError, one_line
from gripmon.model.lerobot_columns import POSE_NAMES, extrinsics_features, extrinsics_names
from gripmon.model.records import Verdict

_MARK = "meta/gripmon.json"
"""Marks a copy as made by gripmon; only such copies are replaced."""
_JSON_TYPES = {pa.string(): "string", pa.int32(): "integer", pa.int64(): "integer", pa.bool_(): "boolean"}


class Annotations:
    """Writes the results of ``episodes`` below the folder or URL ``to``, in the tree of the dataset: for a LeRobot
    dataset a copy with additional columns (on this machine only), otherwise ``NAME.gripmon.mcap``, which is beside the
    recording if ``to`` is the dataset itself.  Only files made by gripmon are replaced.

    Raises :class:`InputError` for a copy that would overwrite something else, before anything is measured.
    """

    def __init__(self, episodes: Sequence[Episode], to: str) -> None:
        self._to = to
        self._recordings: dict[str, list[Episode]] = {}
        self._datasets: dict[str, list[Episode]] = {}
        for episode in episodes:
            if isinstance(episode.source, LeRobotSettings):
                self._datasets.setdefault(episode.source.path, []).append(episode)
            else:
                self._recordings.setdefault(episode.name, []).append(episode)
        self._targets = {
            path: _target(open_dataset(path), _cameras(each), joined(to, each[0].name.partition("#")[0]))
            for path, each in self._datasets.items()
        }

    def write(self, rows: Rows) -> int:
        """Returns how many files and copies were written.  Raises :class:`InputError` if one can't be."""
        for path, episodes in self._datasets.items():
            _copy_with_columns(open_dataset(path), rows, episodes, self._targets[path])
        for name, episodes in self._recordings.items():
            _put(joined(self._to, f"{name}{ANNOTATION_SUFFIX}"), _mcap(name, rows, episodes))
        return len(self._datasets) + len(self._recordings)


def _cameras(episodes: Sequence[Episode]) -> list[str]:
    return sorted({str(each.source.camera) for each in episodes if isinstance(each.source, LeRobotSettings)})


def _put(path: str, data: bytes) -> None:
    try:
        if "://" in path:
            system, inside = file_system(path)
            system.pipe_file(inside, data)
        else:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            write_atomically(Path(path), data)
    except Exception as error:  # noqa: BLE001  each store has its own
        raise InputError(f"{path} can't be written ({one_line(error):.200})", "annotate") from None


def _mcap(name: str, rows: Rows, episodes: Sequence[Episode]) -> bytes:
    """One message per stretch, stamped with its first frame; the reason for a missing one is in the metadata."""
    buffer = io.BytesIO()
    writer = needed("mcap.writer").Writer(buffer)
    writer.start("", library=f"gripmon {__version__}")
    schema = writer.register_schema("gripmon.Stretch", "jsonschema", json.dumps(_json_schema()).encode())
    about = {"episode": name, "version": __version__}
    for episode in episodes:
        measured, made = rows.of(episode.key)
        channel = None
        for row in made:
            if row["start_ns"] is None:
                about[f"reason:{measured.camera}"] = str(row["reason"])
                continue
            if channel is None:
                channel = writer.register_channel(f"/gripmon/{measured.camera.strip('/')}", "json", schema)
            row = {name: value for name, value in row.items() if name != "picture"} | {"camera": measured.camera}
            writer.add_message(channel, row["start_ns"], json.dumps(row).encode(), row["start_ns"])
    writer.add_metadata("gripmon", about)
    writer.finish()
    return buffer.getvalue()


def _json_schema() -> dict[str, Any]:
    """The schema of a table row, without its picture."""
    properties: dict[str, Any] = {"camera": {"type": "string", "description": "topic of the images"}}
    for field in SCHEMA:
        if field.name == "picture":
            continue
        kind = _json_type(field.type)
        text = field.metadata[b"description"].decode()
        properties[field.name] = kind | {"type": [kind["type"], "null"], "description": text}
    return {"title": "gripmon.Stretch", "type": "object", "properties": properties}


def _json_type(kind: pa.DataType) -> dict[str, Any]:
    if pa.types.is_list(kind):
        return {"type": "array", "items": _json_type(kind.value_type)}
    return {"type": _JSON_TYPES.get(kind, "number")}


def _target(dataset: LeRobotDataset, cameras: Sequence[str], target: str) -> Path:
    """The folder of the copy, which must not be in the original nor replace anything but an earlier copy."""
    right = "a folder elsewhere on this machine"
    names = [name for camera in cameras for name in extrinsics_features(camera)]
    if there := sorted(set(names) & set(dataset.info["features"])):
        raise InputError(f"{dataset.path} has a column {there[0]} already; without --annotate", "annotate")
    if "://" in target:
        raise InputError(
            f"{target}: the copy of a LeRobot dataset is written on this machine only; {right}", "annotate"
        )
    path = Path(target).resolve()
    if "://" not in dataset.path and path.is_relative_to(Path(dataset.path).resolve()):
        raise InputError(f"{target}: the copy would lie in the original, which isn't touched; {right}", "annotate")
    if path.exists() and not (path / _MARK).exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{target}: something else is there; {right}, that is empty", "annotate")
    return path


def _copy_with_columns(dataset: LeRobotDataset, rows: Rows, episodes: Sequence[Episode], target: Path) -> None:
    """Copy with additional columns; videos and images become links if the originals are on this machine."""
    cameras = _cameras(episodes)
    features = {name: one for camera in cameras for name, one in extrinsics_features(camera).items()}
    info = dataset.info | {"features": dataset.info["features"] | features}
    values = {_place(episode): _Steps(rows.of(episode.key)[1]) for episode in episodes}
    fresh = target.with_name(f".{target.name}.tmp")
    shutil.rmtree(fresh, ignore_errors=True)
    try:
        for name in _files(dataset.path):
            original, copy = joined(dataset.path, name), fresh / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            if name == INFO:
                copy.write_text(json.dumps(info, indent=4, ensure_ascii=False))
            elif name.startswith("data/") and name.endswith(".parquet"):
                with opened(original) as file:
                    pq.write_table(_with_columns(pq.read_table(file), cameras, values), copy)
            elif "://" not in original and not name.startswith("meta/"):
                copy.symlink_to(Path(original).resolve())
            else:
                with opened(original) as file, copy.open("wb") as to:
                    shutil.copyfileobj(file, to)
        (fresh / _MARK).write_text(json.dumps({"copy_of": dataset.path, "gripmon": __version__}))
        shutil.rmtree(target, ignore_errors=True)
        fresh.rename(target)
    except (OSError, ValueError) as error:
        shutil.rmtree(fresh, ignore_errors=True)
        raise InputError(f"{target} can't be written ({one_line(error):.200})", "annotate") from None


def _files(path: str) -> list[str]:
    """Relative paths of a dataset's files, without hidden ones."""
    system, inside = file_system(path)
    names = [posixpath.relpath(one, inside) for one in sorted(system.find(inside))]
    return [name for name in names if not any(part.startswith(".") for part in name.split("/"))]


def _place(episode: Episode) -> tuple[int, str]:
    assert isinstance(episode.source, LeRobotSettings) and episode.source.episode is not None
    return episode.source.episode, str(episode.source.camera)


class _Steps:
    """The transform of an episode over time, constant within a stretch."""

    def __init__(self, made: list[dict[str, Any]]) -> None:
        self._rows = [row for row in made if row["start_ns"] is not None and row["cam_T_grip_tx_m"] is not None]

    def at(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transforms (n, 7), all 0 where unknown, and flags (n,), 1 in frames in which a row is valid.  While the
        camera may have moved, the transforms of neither side are usable.
        """
        pose, usable = np.zeros((len(stamps_ns), 7), np.float32), np.zeros(len(stamps_ns), np.float32)
        for row in self._rows:
            inside = (stamps_ns >= row["start_ns"]) & (stamps_ns <= row["end_ns"])
            pose[inside] = [row[f"cam_T_grip_{name}"] for name in POSE_NAMES]
            usable[inside] = row["verdict"] == Verdict.VALID.value
            for first, last in row["not_valid_ns"]:
                usable[(stamps_ns >= first) & (stamps_ns <= last)] = 0.0
        for row in self._rows:
            if row["motion_earliest_ns"] is not None:
                usable[(stamps_ns > row["motion_earliest_ns"]) & (stamps_ns < row["motion_latest_ns"])] = 0.0
        return pose, usable


def _with_columns(table: pa.Table, cameras: Sequence[str], values: dict[tuple[int, str], _Steps]) -> pa.Table:
    numbers = np.asarray(table["episode_index"])
    stamps_ns = np.round(1e9 * np.array(table["timestamp"].to_pylist(), float).reshape(-1)).astype(np.int64)
    for camera in cameras:
        poses, flags = np.zeros((len(table), 7), np.float32), np.zeros(len(table), np.float32)
        for number in np.unique(numbers).tolist():
            if (steps := values.get((number, camera))) is not None:
                rows = numbers == number
                poses[rows], flags[rows] = steps.at(stamps_ns[rows])
        pose_name, flag_name = extrinsics_names(camera)
        table = table.append_column(pose_name, pa.FixedSizeListArray.from_arrays(pa.array(poses.ravel()), 7))
        table = table.append_column(flag_name, pa.array(flags))
    # The datasets library would use its own list of columns, which lacks these.
    return table.replace_schema_metadata(
        {k: v for k, v in (table.schema.metadata or {}).items() if k != b"huggingface"}
    )
