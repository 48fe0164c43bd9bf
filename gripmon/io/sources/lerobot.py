"""Episodes of LeRobot datasets, of formats 2.0, 2.1 and 3.0: Parquet tables with MP4 videos, or with images inside.

The formats are those of ``lerobot.datasets`` (its ``utils.py`` and ``v30``): format 2 has one video and one table per
episode, format 3 several episodes in each, and a table of episodes with their places.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np

from gripmon.io.sources.base import SourceError, Stored
from gripmon.io.sources.stored import decoded_file, file_system, joined, needed, opened, there
from gripmon.model.errors import one_line
from gripmon.model.jaw import JointOpening
from gripmon.model.records import Array, Frame, Image

INFO = "meta/info.json"
_STATE = "observation.state"


class LeRobotSettings(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="kind", tag="lerobot"
):
    """One episode of a LeRobot dataset: frames with their time stamps, and openings from the robot's state."""

    path: Annotated[str, msgspec.Meta(min_length=1, description="the dataset's folder, with meta/info.json")]
    camera: (
        Annotated[str, msgspec.Meta(min_length=1, description="feature with the images; absent: the only one")] | None
    ) = None
    episode: Annotated[int, msgspec.Meta(ge=0, description="number of the episode; absent: the only one")] | None = None
    opening: JointOpening | None = None


@dataclass(frozen=True)
class LeRobotDataset:
    """A dataset's description; ``episodes`` by number."""

    path: str
    info: dict[str, Any]
    episodes: dict[int, dict[str, Any]] = field(repr=False)

    @property
    def cameras(self) -> list[str]:
        """Names of the image features."""
        return sorted(name for name, one in self.info["features"].items() if one["dtype"] in ("video", "image"))

    @property
    def joints(self) -> list[str]:
        """Names of the numbers in the robot's state, in order; if it names none, their indices."""
        state = self.info["features"].get(_STATE)
        if state is None:
            return []
        names = state.get("names")
        if isinstance(names, dict):
            names = [name for group in names.values() for name in group]
        return [str(name) for name in names] if names else [str(i) for i in range(state["shape"][0])]

    def table(self, episode: int) -> str:
        """Path of the table that has the episode's rows."""
        row = self.episodes[episode]
        places = {"chunk_index": row.get("data/chunk_index"), "file_index": row.get("data/file_index")}
        return joined(self.path, self.info["data_path"].format(**places, **self._old(episode)))

    def video(self, episode: int, camera: str) -> tuple[str, float]:
        """Path of the video with the episode, and when that begins in it (s)."""
        row, old = self.episodes[episode], self._old(episode)
        at = {name: row.get(f"videos/{camera}/{name}") for name in ("chunk_index", "file_index")}
        path = joined(self.path, self.info["video_path"].format(**at, **old, video_key=camera))
        return path, float(row.get(f"videos/{camera}/from_timestamp") or 0.0)

    def _old(self, episode: int) -> dict[str, int]:
        return {"episode_index": episode, "episode_chunk": episode // int(self.info.get("chunks_size", 1000))}


@functools.lru_cache(maxsize=4)
def open_dataset(path: str) -> LeRobotDataset:
    """Read a dataset's description.  Raises :class:`SourceError` if it isn't a dataset, or of another format."""
    try:
        with opened(joined(path, INFO)) as file:
            info = json.load(file)
        version = str(info["codebase_version"])
        if version.startswith("v3."):
            episodes = _episodes_of_3(path)
        elif version.startswith("v2."):
            with opened(joined(path, "meta/episodes.jsonl")) as file:
                episodes = [json.loads(line) for line in file if line.strip()]
        else:
            raise SourceError(f"path: {path} is a LeRobot dataset of format {version}; v2.0, v2.1 or v3.0")
        info["features"], info["data_path"]
    except (KeyError, ValueError, TypeError) as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(f"path: {path} isn't a LeRobot dataset ({one_line(error):.200}); a complete one") from None
    return LeRobotDataset(path, info, {int(row["episode_index"]): row for row in episodes})


def _episodes_of_3(path: str) -> list[dict[str, Any]]:
    from pyarrow import parquet

    system, inside = file_system(path)
    rows: list[dict[str, Any]] = []
    for name in sorted(system.glob(joined(inside, "meta/episodes/*/*.parquet"))):
        with system.open(name, "rb") as file:
            table = parquet.ParquetFile(file)
            # The table has hundreds of further columns of statistics.
            wanted = [c for c in table.schema_arrow.names if c in ("episode_index", "length") or c[:5] in _PLACES]
            rows += table.read(columns=wanted).to_pylist()
    return rows


_PLACES = ("data/", "video")


class LeRobotSource(Stored):
    """Every frame of an episode, its stamp counted from the episode's beginning: the dataset has no Unix time.  A frame
    that is missing in its video has no image, but a fault.

    Raises :class:`SourceError` for unreadable files, and for a missing camera, episode or joints, with the names of the
    existing ones.
    """

    camera = None
    """A LeRobot dataset contains no camera calibration."""

    def __init__(self, settings: LeRobotSettings, relative_to: str = "") -> None:
        path = settings.path if "://" in settings.path else joined(relative_to, settings.path)
        self._dataset = dataset = open_dataset(path)
        self._camera = _chosen("camera", settings.camera, dataset.cameras, path)
        self._episode = int(_chosen("episode", settings.episode, sorted(dataset.episodes), path))
        self._time_s, self._openings_m, self._files = self._rows(settings.opening)
        self._images = self._decoded()
        self._seq, self._open = 0, True

    def __len__(self) -> int:
        return len(self._time_s)

    def read(self) -> Frame | None:
        if not self._open or self._seq >= len(self):
            return None
        seq, self._seq = self._seq, self._seq + 1
        image, fault = next(self._images)
        opening_m = None if self._openings_m is None else float(self._openings_m[seq])
        return Frame(seq, round(1e9 * float(self._time_s[seq])), image, opening_m, self._camera, fault)

    def close(self) -> None:
        self._open = False

    def _rows(self, opening: JointOpening | None) -> tuple[Array, Array | None, list[Any] | None]:
        """Time stamps (n,), s; openings (n,), m; encoded images, None where there is a video."""
        from pyarrow import parquet

        dataset = self._dataset
        is_video = dataset.info["features"][self._camera]["dtype"] == "video"
        columns = ["timestamp", *([] if is_video else [self._camera]), *([] if opening is None else [_STATE])]
        if opening is not None and (missing := [name for name in opening.joints if name not in dataset.joints]):
            named = ", ".join(dataset.joints) or "none"
            raise SourceError(f"opening.joints: {dataset.path} has no {', '.join(missing)}; of its {_STATE}: {named}")
        path = dataset.table(self._episode)
        with opened(path) as file:
            try:
                table = parquet.read_table(file, columns=columns, filters=[("episode_index", "==", self._episode)])
                time_s = np.array(table["timestamp"].to_pylist(), float).reshape(-1)
                openings_m = None
                if opening is not None:
                    state = np.array(table[_STATE].to_pylist(), float).reshape(len(time_s), -1)
                    at = [dataset.joints.index(name) for name in opening.joints]
                    openings_m = opening.offset_m + opening.scale * state[:, at].sum(axis=1)
            except (OSError, ValueError, KeyError, IndexError) as error:
                raise SourceError(f"path: {path} can't be read ({one_line(error):.200}); a whole table") from None
        if not len(time_s) or (np.diff(time_s) <= 0.0).any():
            raise SourceError(f"path: {path}: episode {self._episode} has no rows, or time stamps that don't rise")
        return time_s, openings_m, None if is_video else table[self._camera].to_pylist()

    def _decoded(self) -> Iterator[tuple[Image | None, str | None]]:
        """A value for each row."""
        if self._files is not None:
            for row in self._files:
                yield decoded_file(row["bytes"] or b"")
            return
        path, begin_s = self._dataset.video(self._episode, self._camera)
        half_s = 0.5 * float(np.median(np.diff(self._time_s))) if len(self) > 1 else 0.5 / self._dataset.info["fps"]
        row, fault = 0, None
        frames = _video_frames(path, begin_s - half_s)
        grey = needed("av.video.reformatter").VideoReformatter()
        while row < len(self):
            try:
                at_s, frame = next(frames, (np.inf, None))
            except SourceError as error:
                at_s, frame, fault = np.inf, None, str(error)
            while row < len(self) and begin_s + self._time_s[row] < at_s - half_s:
                yield None, fault or f"its video has no frame at {begin_s + self._time_s[row]:.3f} s"
                row += 1
            if row < len(self) and frame is not None and abs(begin_s + self._time_s[row] - at_s) <= half_s:
                yield grey.reformat(frame, format="gray").to_ndarray(), None
                row += 1


def _chosen(key: str, wanted: Any, named: list[Any], path: str) -> Any:
    if wanted in named:
        return wanted
    shown = ", ".join(map(str, named[:20])) + (", …" if len(named) > 20 else "")
    if wanted is not None:
        raise SourceError(f"{key}: {path} has no {key} {wanted}; one of: {shown or 'none'}")
    if len(named) != 1:
        raise SourceError(f"{key}: {path} has {len(named)}; one of: {shown or 'none'}")
    return named[0]


def _video_frames(path: str, begin_s: float) -> Iterator[tuple[float, Any]]:
    """Frames of a video with their times (s), from ``begin_s``.  Raises :class:`SourceError` where it is damaged."""
    av = needed("av")
    with opened(path) as file:
        try:
            with av.open(file) as container:
                stream = container.streams.video[0]
                stream.codec_context.thread_count = 1
                container.seek(max(int(begin_s / stream.time_base), 0), stream=stream)
                for frame in container.decode(stream):
                    if frame.time is not None and frame.time >= begin_s:
                        yield frame.time, frame
        except (av.error.FFmpegError, OSError, IndexError) as error:
            raise SourceError(f"{path} can't be decoded ({one_line(error):.200}); is it truncated?") from None


def is_lerobot(path: str) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return there(joined(path, INFO))
