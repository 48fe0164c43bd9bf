"""Episodes of LeRobot datasets, of formats 2.1 and 3.0: Parquet tables with MP4 videos, or with images inside.

The formats are those of ``lerobot.datasets`` (its ``utils.py`` and ``v30``): format 2 has one video and one table per
episode, format 3 several episodes in each, and a table of episodes with their places.  A dataset may be a stranger's:
its description is checked, and its paths lead to files inside it.
"""

from __future__ import annotations

import contextlib
import functools
import re
import string
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, Annotated, Any

import msgspec
import numpy as np

from gripmon.io.sources.base import SourceError, Stored
from gripmon.io.sources.stored import file_system, joined, needed, opened, there, video_frames
from gripmon.model.errors import one_line
from gripmon.model.images import grey_image
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


class _Feature(msgspec.Struct, frozen=True):
    dtype: str
    shape: tuple[int, ...] = ()
    names: Any = None


class _Info(msgspec.Struct, frozen=True):
    """What is used of ``meta/info.json``."""

    codebase_version: str
    fps: Annotated[float, msgspec.Meta(gt=0, le=10_000)]
    features: dict[str, _Feature]
    data_path: str
    video_path: str | None = None
    chunks_size: Annotated[int, msgspec.Meta(ge=1)] = 1000


_Number = Annotated[int, msgspec.Meta(ge=0, lt=10**9)]
_Value = Annotated[float, msgspec.Meta(ge=0, lt=1e9)] | None
_MOST_JOINTS = 1000
_LONGEST_S = 1e9


class _Episode(msgspec.Struct, frozen=True):
    episode_index: _Number


@dataclass(frozen=True)
class LeRobotDataset:
    """A dataset's description; ``info`` as it is in the file, ``episodes`` by number with their places."""

    path: str
    info: dict[str, Any]
    description: _Info
    episodes: dict[int, dict[str, Any]] = field(repr=False)

    @property
    def cameras(self) -> list[str]:
        """Names of the image features."""
        return sorted(name for name, one in self.description.features.items() if one.dtype in ("video", "image"))

    @property
    def joints(self) -> list[str]:
        """Names of the numbers in the robot's state, in order; if it names none, their indices."""
        state = self.description.features.get(_STATE)
        if state is None:
            return []
        groups = state.names.values() if isinstance(state.names, dict) else [state.names]
        names = [str(name) for group in groups if isinstance(group, list) for name in group]
        return names or [str(i) for i in range(min(sum(state.shape[:1]), _MOST_JOINTS))]

    def table(self, episode: int) -> str:
        """Path of the table that has the episode's rows.  Raises :class:`SourceError`."""
        return self._file("data_path", self._places(episode, "data"))

    def video(self, episode: int, camera: str) -> tuple[str, float]:
        """Path of the video with the episode, and when that begins in it (s).  Raises :class:`SourceError`."""
        places = self._places(episode, f"videos/{camera}")
        begin_s = self._number(episode, f"videos/{camera}/from_timestamp") or 0.0
        return self._file("video_path", places | {"video_key": camera}), begin_s

    def files(self, episode: int, camera: str) -> list[str]:
        """Paths of the table and the video of an episode, as far as the description has them."""
        found = []
        with contextlib.suppress(SourceError):  # who opens the episode is told
            found.append(self.table(episode))
            if self.description.features[camera].dtype == "video":
                found.append(self.video(episode, camera)[0])
        return found

    def _places(self, episode: int, of: str) -> dict[str, int | str]:
        found = {name: self._number(episode, f"{of}/{name}") for name in ("chunk_index", "file_index")}
        places: dict[str, int | str] = {name: int(at) for name, at in found.items() if at is not None}
        return places | {"episode_index": episode, "episode_chunk": episode // self.description.chunks_size}

    def _number(self, episode: int, key: str) -> float | None:
        """A value of the episode's row.  Raises :class:`SourceError`."""
        try:
            return msgspec.convert(self.episodes[episode].get(key), _Value)
        except msgspec.ValidationError as error:
            wrong = f"path: {self.path}: episode {episode}: {key}: {one_line(error):.100}"
            raise SourceError(f"{wrong}; a number") from None

    def _file(self, key: str, fields: dict[str, int | str]) -> str:
        """A path by its template: fields and widths as the formats have them, below the dataset."""
        template = getattr(self.description, key)
        try:
            for _, name, width, conversion in string.Formatter().parse(template or "{}"):
                if name is not None and (name not in fields or conversion or not _WIDTH.fullmatch(width or "")):
                    raise ValueError(f"{{{name}}} of width {width or 'any'}")
            path = template.format(**fields)
        except (ValueError, KeyError, IndexError) as error:
            right = f"a path of {', '.join(fields)}, such as {{episode_index:06d}}"
            raise SourceError(f"path: {self.path}: {INFO}: {key}: {one_line(error):.100}; {right}") from None
        if "\0" in path or "\\" in path or not {"", ".", ".."}.isdisjoint(path.split("/")):
            raise SourceError(f"path: {self.path}: {INFO}: {key}: {path[:100]!r} leads out of it; a path below it")
        return joined(self.path, path)


_WIDTH = re.compile(r"(0?\d\d?d)?")


@functools.lru_cache(maxsize=4)
def open_dataset(path: str) -> LeRobotDataset:
    """Read a dataset's description.  Raises :class:`SourceError` if it isn't a dataset, or of another format."""
    try:
        with opened(joined(path, INFO)) as file:
            content = file.read()
        info = msgspec.json.decode(content, type=dict[str, Any])
        version = str(info.get("codebase_version"))
        if not version.startswith(("v2.1", "v3.")):
            raise SourceError(f"path: {path} is a LeRobot dataset of format {version:.20}; v2.1 or v3.0")
        description = msgspec.json.decode(content, type=_Info)
        if version.startswith("v3."):
            rows = _episodes_of_3(path)
        else:
            with opened(joined(path, "meta/episodes.jsonl")) as file:
                rows = [msgspec.json.decode(line, type=dict[str, Any]) for line in file if line.strip()]
        episodes = {msgspec.convert(row, _Episode).episode_index: row for row in rows}
    except SourceError:
        raise
    except Exception as error:  # noqa: BLE001  a stranger's files, and each library's own errors
        raise SourceError(f"path: {path} isn't a LeRobot dataset ({one_line(error):.200}); a complete one") from None
    return LeRobotDataset(path, info, description, episodes)


def _episodes_of_3(path: str) -> list[dict[str, Any]]:
    from pyarrow import parquet

    system, inside = file_system(path)
    rows: list[dict[str, Any]] = []
    for name in filter(system.isfile, sorted(system.glob(joined(inside, "meta/episodes/*/*.parquet")))):
        table = parquet.ParquetFile(_for_arrow(system.open(name, "rb")))
        # The table has hundreds of further columns of statistics.
        places = ("data/", "video")
        wanted = [c for c in table.schema_arrow.names if c in ("episode_index", "length") or c.startswith(places)]
        rows += table.read(columns=wanted).to_pylist()
    return rows


def _for_arrow(opened_file: IO[bytes]) -> Any:
    """What is in a file, which is closed.  Arrow reads a Python file in threads of its own, and one that lets go of it
    while the process ends aborts this (https://github.com/apache/arrow/issues/34314).
    """
    from pyarrow import BufferReader

    with opened_file:
        return BufferReader(opened_file.read())


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
        video = None if self._files is not None else dataset.video(self._episode, self._camera)
        self._images = self._decoded(video)
        self._seq, self._open = 0, True

    def __len__(self) -> int:
        return len(self._time_s)

    def read(self) -> Frame | None:
        if not self._open or self._seq >= len(self):
            return None
        seq, self._seq = self._seq, self._seq + 1
        image, fault = next(self._images)
        reported_m = np.nan if self._openings_m is None else float(self._openings_m[seq])
        opening_m = reported_m if np.isfinite(reported_m) else None
        return Frame(seq, round(1e9 * float(self._time_s[seq])), image, opening_m, self._camera, fault)

    def close(self) -> None:
        self._open = False

    def _rows(self, opening: JointOpening | None) -> tuple[Array, Array | None, list[Any] | None]:
        """Time stamps (n,), s; openings (n,), m; encoded images, None where there is a video."""
        from pyarrow import parquet

        dataset = self._dataset
        is_video = dataset.description.features[self._camera].dtype == "video"
        columns = ["timestamp", *([] if is_video else [self._camera]), *([] if opening is None else [_STATE])]
        if opening is not None and (missing := [name for name in opening.joints if name not in dataset.joints]):
            named = ", ".join(dataset.joints) or "none"
            raise SourceError(f"opening.joints: {dataset.path} has no {', '.join(missing)}; of its {_STATE}: {named}")
        path = dataset.table(self._episode)
        try:
            table = parquet.read_table(
                _for_arrow(opened(path)), columns=columns, filters=[("episode_index", "==", self._episode)],
            )  # fmt: skip
            time_s = np.array(table["timestamp"].to_pylist(), float).reshape(-1)
            openings_m = None
            if opening is not None:
                state = np.array(table[_STATE].to_pylist(), float).reshape(len(time_s), -1)
                at = [dataset.joints.index(name) for name in opening.joints]
                openings_m = opening.offset_m + opening.scale * state[:, at].sum(axis=1)
        except SourceError:
            raise
        except Exception as error:  # noqa: BLE001  a stranger's table, and Arrow's own errors
            raise SourceError(f"path: {path} can't be read ({one_line(error):.200}); a whole table") from None
        if not len(time_s) or not (np.diff(time_s) > 0.0).all() or not 0.0 <= time_s[0] <= time_s[-1] < _LONGEST_S:
            wrong = f"episode {self._episode} has no rows, or time stamps that don't rise"
            raise SourceError(f"path: {path}: {wrong}; seconds from its beginning")
        return time_s, openings_m, None if is_video else table[self._camera].to_pylist()

    def _decoded(self, video: tuple[str, float] | None) -> Iterator[tuple[Image | None, str | None]]:
        """A value for each row."""
        if video is None:
            for row in self._files or ():
                found = row.get("bytes") if isinstance(row, dict) else None
                yield grey_image(found) if isinstance(found, bytes) and found else (None, "the table has none here")
            return
        path, begin_s = video
        half_s = 0.5 * float(np.median(np.diff(self._time_s))) if len(self) > 1 else 0.5 / self._dataset.description.fps
        row, fault = 0, None
        frames = video_frames(path, begin_s - half_s)
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


def is_lerobot(path: str) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return there(joined(path, INFO))
