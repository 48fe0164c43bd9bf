"""What ``gripmon dataset --annotate`` writes: read back by ``mcap``, and row by row; originals stay as they were."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from support.episode_files import WRIST, Shots, write_lerobot, write_mcap
from test_dataset import BLANK, hashes_of

from gripmon.analyse.dataset import Journal, Measured, Rows, write_dataset
from gripmon.analyse.dataset_annotations import Annotations
from gripmon.analyse.stretches import Motion, Stretch
from gripmon.io.sources import LeRobotSettings, open_source
from gripmon.io.sources.episodes import find_episodes
from gripmon.model.errors import InputError

FIRST, LAST = (0.001, 0.002, 0.12, 0.0, 0.0, 0.0, 1.0), (0.002, 0.002, 0.12, 0.0, 0.0, 0.6, 0.8)
POSE, FLAG = "observation.extrinsics.wrist", "observation.extrinsics_valid.wrist"
TENTH_NS = 100_000_000
COVARIANCE = tuple((1e-10 * np.eye(6)).ravel().tolist())


def stretches(begin_ns: int, verdict: str = "valid") -> tuple[Stretch, ...]:
    """Six frames, ten a second: it moved between the third and the fifth, most probably before the fourth."""
    plain = {"frames": 3, "measured": 3, "valid": 3, "covariance": COVARIANCE, "protection_m": 5e-4}
    at_ns = [begin_ns + i * TENTH_NS if begin_ns else round(1e9 * float(np.float32(i / 10))) for i in range(6)]
    motion = Motion(at_ns[3], at_ns[2], at_ns[4], (1e-3, 0.0, 0.0), 1e-3, 1.287, 1e-9, "camera_mount_moved")
    return (
        Stretch(
            start_ns=at_ns[0],
            end_ns=at_ns[2],
            verdict="valid",
            cam_T_grip=FIRST,
            not_valid_ns=((at_ns[1], at_ns[1]),),
            **plain,
        ),
        Stretch(start_ns=at_ns[3], end_ns=at_ns[5], verdict=verdict, cam_T_grip=LAST, motion=motion, **plain),
    )


def annotated(dataset: Path, out: Path, to: Path, answers: list[dict]) -> list[Path]:
    """The files below ``to`` that weren't there before, from what was "measured" of each episode."""
    episodes = find_episodes(str(dataset))
    annotations = Annotations(episodes, str(to))
    before = set(to.rglob("*"))
    out.mkdir(exist_ok=True)
    with Journal(out, "f") as journal:
        for episode, answer in zip(episodes, answers, strict=True):
            camera = episode.source.camera or "/wrist/image"
            journal.add(Measured(episode.name, camera, episode.key, episode.version, **answer))
        written = write_dataset(journal, [episode.key for episode in episodes], out, 0.01, 0.0, 0.0)
        annotations.write(Rows(journal, written))
    return sorted(path for path in to.rglob("*") if path not in before and not path.is_dir())


def test_mcap_beside_each_recording_holds_its_stretches(tmp_path: Path):
    bags = tmp_path / "bags"
    (bags / "day2").mkdir(parents=True)
    shots = Shots(BLANK.images, [BLANK.stamps_ns[0] + i * TENTH_NS for i in range(6)], BLANK.openings_m)
    write_mcap(bags / "a.mcap", shots)
    write_mcap(bags / "day2" / "b.mcap", shots)
    hashes = hashes_of(bags)
    answers = [{"stretches": stretches(shots.stamps_ns[0], "suspect")}, {"fault": "no gripper in view"}]
    made = annotated(bags, tmp_path / "out", bags, answers)
    assert [str(path.relative_to(bags)) for path in made] == ["a.mcap.gripmon.mcap", "day2/b.mcap.gripmon.mcap"]
    assert {name: hashes_of(bags)[name] for name in hashes} == hashes, "originals are never touched"
    assert [one.name for one in find_episodes(str(bags))] == ["a.mcap", "day2/b.mcap"], "not episodes themselves"
    with made[0].open("rb") as file:
        reader = make_reader(file)
        found = [(channel, message, json.loads(message.data)) for _, channel, message in reader.iter_messages()]
        schema = json.loads(next(iter(reader.get_summary().schemas.values())).data)
    assert [channel.topic for channel, _, _ in found] == ["/gripmon/wrist/image"] * 2
    first, last = (row for _, _, row in found)
    assert [message.log_time for _, message, _ in found] == [shots.stamps_ns[0], shots.stamps_ns[3]]
    assert (first["verdict"], last["verdict"], last["motion_cause"]) == ("valid", "suspect", "camera_mount_moved")
    assert [first["mounting"], last["mounting"]] == [0, None] and first["cam_T_grip_tz_m"] == FIRST[2]
    assert first["not_valid_ns"] == [[shots.stamps_ns[1]] * 2]
    assert set(first) <= set(schema["properties"]) and first["covariance"] == list(COVARIANCE)
    with made[1].open("rb") as file:
        reader = make_reader(file)
        assert not list(reader.iter_messages())
        assert next(reader.iter_metadata()).metadata["reason:/wrist/image"] == "no gripper in view"


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_copy_of_a_lerobot_dataset_has_the_columns(tmp_path: Path, version: str):
    dataset, copy = tmp_path / "set", tmp_path / "copy"
    write_lerobot(dataset, [BLANK, BLANK, BLANK], fps=10, version=version, per_file=2, codec="libx264")
    hashes = hashes_of(dataset)
    answers = [{"stretches": stretches(0)}, {"stretches": stretches(0, "suspect")}, {"fault": "too dark"}]
    for _ in range(2):  # a copy of ours is replaced
        annotated(dataset, tmp_path / "out", copy, answers)
    assert hashes_of(dataset) == hashes, "originals are never touched"
    rows = [row for path in sorted((copy / "data").rglob("*.parquet")) for row in pq.read_table(path).to_pylist()]
    # Not to be used in valid stretches: the second frame, and those in which it may have moved by then or not.
    assert [row[FLAG] for row in rows] == [1, 0, 1, 0, 1, 1] + [1, 0, 1, 0, 0, 0] + [0] * 6
    np.testing.assert_allclose([row[POSE] for row in rows[:6]], [FIRST] * 3 + [LAST] * 3, atol=1e-8)
    assert [row[POSE] for row in rows[12:]] == [[0.0] * 7] * 6
    features = json.loads((copy / "meta" / "info.json").read_text())["features"]
    assert features[POSE]["shape"] == [7] and features[FLAG]["shape"] == [1] and WRIST in features
    original = pq.read_table(sorted((dataset / "data").rglob("*.parquet"))[0])
    copied = pq.read_table(sorted((copy / "data").rglob("*.parquet"))[0])
    assert copied.select(original.column_names).equals(original)
    source = open_source(LeRobotSettings(path=str(copy), episode=2))
    frames = list(iter(source.read, None))
    assert len(frames) == 6 and all(frame.image is not None for frame in frames)


@pytest.mark.parametrize(
    ("to", "words"),
    [
        ("set", "the copy would lie in the original"),
        ("set/copy", "the copy would lie in the original"),
        ("full", "something else is there"),
        ("s3://lab/copy", "written on this machine"),
    ],
)
def test_copy_never_lies_in_what_is_there(tmp_path: Path, to: str, words: str):
    write_lerobot(tmp_path / "set", [BLANK], fps=10, codec="libx264")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match=words):
        Annotations(find_episodes(str(tmp_path / "set")), to if "://" in to else str(tmp_path / to))


def test_columns_that_are_there_are_not_replaced(tmp_path: Path):
    write_lerobot(tmp_path / "set", [BLANK], fps=10, codec="libx264")
    annotated(tmp_path / "set", tmp_path / "out", tmp_path / "copy", [{"stretches": stretches(0)}])
    with pytest.raises(InputError, match=r"has a column observation\.extrinsics\.wrist already"):
        Annotations(find_episodes(str(tmp_path / "copy")), str(tmp_path / "again"))


def test_folder_that_cannot_be_written_is_one_line(tmp_path: Path):
    (tmp_path / "bags").mkdir()
    write_mcap(tmp_path / "bags" / "a.mcap", BLANK)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"a\.mcap\.gripmon\.mcap can't be written"):
        annotated(tmp_path / "bags", tmp_path / "out", tmp_path / "file", [{"fault": "x"}])
