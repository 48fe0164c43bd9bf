"""``gripmon dataset``: mountings, motions, transforms against simulated truth; kills; what is bad becomes rows."""

from __future__ import annotations

import hashlib
import itertools
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from support import dataset_scenes
from support.dataset_scenes import FPS, MOTION_M, OF_BAGS, Truth, make_lerobot, write_config
from support.episode_files import WRIST, Shots, write_lerobot, write_mcap

from gripmon.analyse.dataset import Results, write_table
from gripmon.analyse.stretches import Stretch
from gripmon.cli import main
from gripmon.daemon.dataset import measure_dataset, measuring
from gripmon.daemon.dataset.measuring import measure
from gripmon.io.sources import BagSettings, SourceError
from gripmon.io.sources.episodes import Episode, find_episodes
from gripmon.model.errors import InputError
from gripmon.model.geometry import to_record
from gripmon.model.records import Frame, ReferenceRecord

NS = 1_000_000_000
SMALL = [(0, False), (1, True), (2, False), (0, False)]
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Truth]]:
    """Four episodes and a configuration, then measured into ``out``."""
    folder = tmp_path_factory.mktemp("lerobot")
    config, truths = make_lerobot(folder, SMALL)
    hashes = hashes_of(folder / "set")
    found = measure_dataset(folder / "set", folder / "out", config, workers=2)
    assert (found.episodes, found.measured, found.failed) == (4, 4, 0)
    assert hashes_of(folder / "set") == hashes, "originals are never touched"
    return folder, truths


def hashes_of(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def rows_of(out: Path) -> list[dict]:
    return pq.read_table(out / "stretches").to_pylist()


def number_of(row: dict) -> int:
    return int("".join(character for character in row["episode"].rpartition("/")[2] if character.isdigit()) or 0)


def assert_true(rows: list[dict], truths: list[Truth], begins_s: Callable[[dict], float]) -> None:
    """Transforms within what they claim, motions where and as large as they were, mountings told apart."""
    squares, first = [], {}
    for row in rows:
        truth = truths[number_of(row)]
        assert row["verdict"] == "valid" and row["moved"] == (truth.moved_at_s is not None)
        true_T = truth.last_T if row["stretch"] else truth.first_T
        shift_m = true_T[:3, 3] - [row[f"cam_T_grip_t{axis}_m"] for axis in "xyz"]
        rotation = Rotation.from_quat([row[f"cam_T_grip_q{axis}"] for axis in "xyzw"])
        turn = (Rotation.from_matrix(true_T[:3, :3]) * rotation.inv()).as_rotvec()
        # The largest bound of valid frames, at most 1 mm, and how far theirs lie from the pose of all.
        assert np.linalg.norm(shift_m) < row["protection_m"] < 1.5e-3 and np.linalg.norm(shift_m) < 1e-4
        assert np.linalg.norm(turn) < row["protection_rad"]
        error = np.concatenate([shift_m, turn])
        squares.append(error @ np.linalg.solve(np.reshape(row["covariance"], (6, 6)), error))
        if row["stretch"]:
            assert truth.moved_at_s is not None
            assert abs(1e-9 * row["motion_ns"] - begins_s(row) - truth.moved_at_s) <= 1.0 / FPS
            np.testing.assert_allclose([row[f"motion_{axis}_m"] for axis in "xyz"], MOTION_M, atol=6e-5)
            assert row["motion_cause"] == "camera_mount_moved"
        else:
            first.setdefault(truth.mounting, set()).add(row["mounting"])
    assert max(squares) < 22.5  # chi-square with six degrees of freedom: 1 of 1000
    assert all(len(mountings) == 1 for mountings in first.values())
    assert len(set.union(*first.values())) == len(first)
    assert len({row["episode"] for row in rows}) == len(truths)


def test_extrinsics_motions_and_mountings_are_the_true_ones(lerobot: tuple[Path, list[Truth]]):
    folder, truths = lerobot
    rows = rows_of(folder / "out")
    assert [row["stretch"] for row in rows] == [0, 0, 1, 0, 0]
    assert {str(row["camera"]) for row in rows} == {WRIST}
    assert_true(rows, truths, lambda _: 0.0)
    assert all(row["own_reference"] and row["picture"].startswith(b"\xff\xd8") for row in rows)
    page = (folder / "out" / "report.html").read_text()
    assert "4 episodes of 1 camera: 4 with a transform that may be used" in page
    assert "the camera moved in 1 of them" in page and page.index("#000001") < page.index("data:image/jpeg")


def test_again_it_measures_nothing_and_writes_the_same(lerobot: tuple[Path, list[Truth]]):
    folder, _ = lerobot
    before = hashes_of(folder / "out" / "stretches")
    found = measure_dataset(folder / "set", folder / "out", folder / "lerobot.yaml")
    assert (found.episodes, found.measured) == (4, 0)
    assert hashes_of(folder / "out" / "stretches") == before


def test_another_configuration_does_not_mix_in(lerobot: tuple[Path, list[Truth]], tmp_path: Path):
    folder, _ = lerobot
    text = (folder / "lerobot.yaml").read_text().replace("1.0e-4", "2.0e-4")
    (tmp_path / "other.yaml").write_text(text)
    with pytest.raises(InputError, match="another configuration"):
        measure_dataset(folder / "set", folder / "out", tmp_path / "other.yaml")


def test_driver_that_was_killed_goes_on_where_it_was(lerobot: tuple[Path, list[Truth]], tmp_path: Path):
    """kill -9 after the first episode: its workers end, too, and the table is the same to the byte."""
    folder, _ = lerobot
    out = tmp_path / "out"
    command = [sys.executable, "-m", "gripmon", "dataset", str(folder / "set"), "--out", str(out), "--workers", "1"]
    command += ["--config", str(folder / "lerobot.yaml")]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL, cwd=ROOT)
    wait_for(lambda: any(out.glob("episodes-*/*.parquet")))
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    assert len(workers) >= 1 and psutil.wait_procs(workers, 30.0)[1] == []
    (measured,) = out.glob("episodes-*")
    (measured / "0123456789abcdef.tmp").write_bytes(b"PAR1")  # a file that was being written
    found = measure_dataset(folder / "set", out, folder / "lerobot.yaml", workers=1)
    assert 1 <= found.measured <= 3 and found.failed == 0
    assert hashes_of(out / "stretches") == hashes_of(folder / "out" / "stretches")
    assert not list(measured.glob("*.tmp")) and len(list(measured.glob("*.parquet"))) == 4


def wait_for(condition: Callable[[], bool], most_s: float = 240.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def of_name(name: str) -> Episode:
    return Episode(name, BagSettings(path="x"), "")


BLANK = Shots([np.full((288, 384), 90, np.uint8)] * 6, [i * NS for i in range(1, 7)], [0.03] * 6)
OTHER = Shots([np.full((48, 64), 90, np.uint8)] * 6, [i * NS for i in range(1, 7)], [0.03] * 6)
CHANGING = Shots([*BLANK.images[:3], *OTHER.images[:3]], BLANK.stamps_ns, BLANK.openings_m)


@pytest.mark.parametrize(
    ("shots", "options", "words"),
    [
        (BLANK, {}, "no frame was measured|only 0 frames were measured"),
        (OTHER, {}, "only 0 frames were measured.*64"),
        (CHANGING, {}, "only 0 frames were measured"),
        (BLANK, {"camera": "/front"}, "has no images on /front; one of its topics with images: /wrist/image"),
        (None, {}, "can't be read"),
    ],
)
def test_what_is_bad_is_an_answer_with_a_reason(tmp_path: Path, shots: Shots | None, options: dict, words: str):
    config = write_config(tmp_path / "c.yaml", OF_BAGS)
    path = tmp_path / "a.mcap"
    if shots is None:
        path.write_bytes(b"\x89MCAP0\r\n, cut")
    else:
        write_mcap(path, shots)
    (row,) = measure(config, Episode("a", BagSettings(path=str(path), **options), ""))
    assert row.verdict == "unknown" and row.cam_T_grip is None and row.start_ns is None
    assert re.search(words, row.reason or ""), row.reason


def test_failures_are_rows_of_the_table_and_the_report(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags" / "a.mcap").write_bytes(b"nothing")
    write_mcap(tmp_path / "bags" / "b.mcap", BLANK)
    write_config(tmp_path / "c.yaml", OF_BAGS)
    command = ["dataset", str(tmp_path / "bags"), "--config", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "out")]
    assert main([*command, "--workers", "1"]) == 3
    assert "2 episodes, 2 measured now, 2 without a transform" in capfd.readouterr().err
    rows = rows_of(tmp_path / "out")
    assert {row["episode"]: row["camera"] for row in rows} == {"a.mcap": "unknown", "b.mcap": "/wrist/image"}
    assert all(row["verdict"] == "unknown" and row["reason"] and row["mounting"] is None for row in rows)
    assert "can&#39;t be read" in (tmp_path / "out" / "report.html").read_text()


def test_episodes_that_changed_are_measured_again(tmp_path: Path):
    episode = of_name("a")
    with Results(tmp_path, "f") as results:
        results.add(episode, [Stretch(episode="a", reason="x")])
        assert episode in results and msgspec.structs.replace(episode, version="2") not in results
        with pytest.raises(InputError, match="another gripmon dataset writes there"):
            Results(tmp_path, "f")
    with pytest.raises(InputError, match="another configuration"):
        Results(tmp_path, "g")


def test_full_disk_is_one_line_and_leaves_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first, second = of_name("a"), of_name("b")
    with Results(tmp_path, "f") as results:
        results.add(first, [Stretch(episode="a", reason="x")])
        write_table(results, [first], tmp_path, 0.01, 0.0, 0.0)
        before = hashes_of(tmp_path)

        def full(*_: object, **__: object) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr("gripmon.analyse.dataset.pq.write_table", full)
        with pytest.raises(InputError, match=r"out: .* can't be written \(No space left on device\); what"):
            results.add(second, [Stretch(episode="b", reason="y")])
        monkeypatch.setattr("gripmon.analyse.dataset.ds.write_dataset", full)
        with pytest.raises(InputError, match=r"stretches can't be written \(No space left on device\)"):
            write_table(results, [first], tmp_path, 0.01, 0.0, 0.0)
    assert hashes_of(tmp_path) == before


def test_damaged_tables_of_lerobot_are_one_line_or_rows(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """The table of frames costs its episodes, that of episodes the dataset, of which nothing is written then."""
    write_config(tmp_path / "c.yaml", dataset_scenes.OF_LEROBOT)
    for name, damaged in (("frames", "data"), ("episodes", "meta")):
        write_lerobot(tmp_path / name, [BLANK], fps=10, codec="libx264")
        (table,) = (tmp_path / name / damaged).rglob("*.parquet")
        table.write_bytes(table.read_bytes()[:-30])
        command = ["dataset", str(tmp_path / name), "--config", str(tmp_path / "c.yaml"), "--workers", "1"]
        code = main([*command, "--out", str(tmp_path / f"{name}_out")])
        assert code == (3 if damaged == "data" else 2)
    (row,) = rows_of(tmp_path / "frames_out")
    assert re.search(r"file-000\.parquet can't be read .*; a whole table", row["reason"])
    said = capfd.readouterr().err.splitlines()[-1]
    assert "episodes isn't a LeRobot dataset" in said and not (tmp_path / "episodes_out").exists()


def test_damaged_result_is_named(tmp_path: Path):
    with Results(tmp_path, "f") as results:
        results.add(of_name("a"), [Stretch(episode="a", reason="x")])
        path = results.path(of_name("a"))
        whole = path.read_bytes()
        path.write_bytes(whole[:99] + bytes(len(whole) - 107) + whole[-8:])
        with pytest.raises(InputError, match=rf"{path} can't be read .*; delete it, and the next call measures"):
            results.read(of_name("a"))
        assert of_name("a") in results
        for left in (whole[:-9], b""):  # as a power cut leaves it
            path.write_bytes(left)
            assert of_name("a") not in results


def test_every_kind_of_episode_is_found(tmp_path: Path):
    import cv2

    write_lerobot(tmp_path / "b" / "set", [BLANK, BLANK], fps=10, codec="libx264")
    write_mcap(tmp_path / "run10.mcap", BLANK)
    write_mcap(tmp_path / "run9.mcap", BLANK)
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "0.png"), BLANK.images[0])
    (tmp_path / ".hidden").mkdir()
    write_mcap(tmp_path / ".hidden" / "no.mcap", BLANK)
    names = [episode.name for episode in find_episodes(str(tmp_path))]
    assert names == ["b/set#000000", "b/set#000001", "images", "run9.mcap", "run10.mcap"]
    with pytest.raises(SourceError, match=f"has no front; of: {WRIST}"):
        find_episodes(str(tmp_path), ["front"])
    with pytest.raises(SourceError, match="plain images or videos, of one camera each; leave it out"):
        find_episodes(str(tmp_path / "images"), ["front"])
    with pytest.raises(SourceError, match="nothing in"):
        find_episodes(str(tmp_path / "nowhere"))


def test_reference_of_after_a_motion_is_not_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The monitor recalibrates only after the camera was knocked by 4.5 mm: its frames before that are valid all the
    same, as of an episode that isn't recalibrated.
    """
    monkeypatch.setattr(dataset_scenes, "MOTION_M", (0.0, 0.0045, 0.0006))
    config = write_config(tmp_path / "c.yaml", OF_BAGS)
    shots, truth = dataset_scenes.episode(config, 0, 0, moves=True)
    write_mcap(tmp_path / "a.mcap", shots)
    covariance = tuple(np.diag([1e-9] * 3 + [1e-6] * 3).ravel().tolist())
    last = to_record(truth.last_T)
    late = msgspec.structs.replace(config.reference, revision=1, cam_T_grip=last, covariance=covariance)

    def until_renewed(run: measuring._Run, frames: Iterator[Frame]) -> ReferenceRecord:
        run.whole(itertools.islice(frames, 70))
        return late

    monkeypatch.setattr(measuring._Run, "until_renewed", until_renewed)
    source = msgspec.structs.replace(config.settings.source, path=str(tmp_path / "a.mcap"))
    first, last = measure(config, Episode("a", source, ""))
    assert first.verdict == last.verdict == "valid" and first.valid_share >= 0.9
    assert not first.own_reference and first.frames + last.frames == dataset_scenes.MOVED_FRAMES


def test_a_mounting_beyond_the_references_sigma_is_measured_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By 9 mm, at 1 mm: a monitor would ask a person, which a survey of mountings is there to answer."""
    monkeypatch.setattr(dataset_scenes, "MOUNTINGS", np.array([[0.009, 0.0, 0.0, 0.0, 0.0, 0.01]]))
    config = write_config(tmp_path / "c.yaml", OF_BAGS)
    shots, truth = dataset_scenes.episode(config, 0, 0)
    write_mcap(tmp_path / "a.mcap", shots)
    source = msgspec.structs.replace(config.settings.source, path=str(tmp_path / "a.mcap"))
    (row,) = measure(config, Episode("a", source, ""))
    assert row.own_reference and row.verdict == "valid" and row.cam_T_grip is not None
    assert np.linalg.norm(np.subtract(row.cam_T_grip[:3], truth.first_T[:3, 3])) < row.protection_m
