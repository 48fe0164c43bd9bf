"""``gripmon dataset``: mountings, motions, transforms against simulated truth; kills; what is bad becomes rows."""

from __future__ import annotations

import hashlib
import itertools
import os
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from support import dataset_scenes
from support.dataset_scenes import FPS, MOTION_M, OF_BAGS, Truth, make_bags, make_lerobot, write_config
from support.episode_files import WRIST, Shots, write_lerobot, write_mcap
from support.playback_runs import table_of
from support.reported import records

from gripmon.analyse.dataset import Journal, Measured
from gripmon.analyse.stretches import Stretch, mountings_of, stretches_of
from gripmon.cli import main
from gripmon.daemon.config import builtin_config, load_config
from gripmon.daemon.dataset import engines, measure_dataset, measuring
from gripmon.daemon.dataset.engines import DIED, local
from gripmon.daemon.dataset.measuring import measure
from gripmon.io.sources import BagSettings, SourceError
from gripmon.io.sources.episodes import Episode, find_episodes
from gripmon.judge.policy import PolicySettings
from gripmon.model.errors import InputError
from gripmon.model.geometry import perturb, to_record
from gripmon.model.records import Frame, Protection, ReferenceRecord, Verdict

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


def test_results_go_back_into_a_copy_of_the_dataset(lerobot: tuple[Path, list[Truth]]):
    """Each frame's columns against the truth at its time; all that is written: tests/test_dataset_annotations.py."""
    folder, truths = lerobot
    hashes = hashes_of(folder / "set")
    found = measure_dataset(folder / "set", folder / "out", folder / "lerobot.yaml", annotate=folder / "copy")
    assert found.measured == 0 and hashes_of(folder / "set") == hashes, "originals are never touched"
    table = pq.read_table(folder / "copy" / "data")
    numbers, time_s = np.asarray(table["episode_index"]), np.asarray(table["timestamp"])
    poses = np.array(table["observation.extrinsics.wrist"].to_pylist())
    usable = np.asarray(table["observation.extrinsics_valid.wrist"]) == 1.0
    for number, truth in enumerate(truths):
        later = np.zeros(len(numbers), bool) if truth.moved_at_s is None else time_s >= truth.moved_at_s
        for mine, true_T in (
            ((numbers == number) & ~later, truth.first_T),
            ((numbers == number) & later, truth.last_T),
        ):
            assert usable[mine].sum() >= mine.sum() - 2
            off_m = np.linalg.norm(poses[mine & usable, :3] - true_T[:3, 3], axis=1)
            assert off_m.max(initial=0.0) < 1e-4


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
    journal = out / "journal.jsonl"
    wait_for(lambda: journal.exists() and journal.read_bytes().count(b"\n") >= 2)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait()
    assert len(workers) >= 1 and psutil.wait_procs(workers, 30.0)[1] == []
    with journal.open("ab") as file:
        file.write(b'{"episode":"#00')  # a line that was cut
    found = measure_dataset(folder / "set", out, folder / "lerobot.yaml", workers=1)
    assert 1 <= found.measured <= 3 and found.failed == 0
    assert hashes_of(out / "stretches") == hashes_of(folder / "out" / "stretches")


def wait_for(condition: Callable[[], bool], most_s: float = 240.0) -> None:
    end_s = time.monotonic() + most_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def die_of_the_second(episode: Episode) -> Measured:
    if episode.name == "1":
        os._exit(9)
    return Measured(episode.name, "", episode.key, "")


def test_episode_that_kills_its_worker_is_a_row_and_the_others_are_measured(lerobot: tuple[Path, list[Truth]]):
    folder, _ = lerobot
    config = load_config(folder / "lerobot.yaml", check_source=False)
    episodes = [Episode(str(i), BagSettings(path="x"), "") for i in range(3)]
    found = {each.episode: each.fault for each in local((config,), episodes, "file", 1, die_of_the_second)}
    assert found == {"0": None, "1": DIED, "2": None}


def tell_the_process(episode: Episode) -> Measured:
    return Measured(episode.name, str(os.getpid()), episode.key, "")


def test_workers_are_replaced_before_what_stays_with_them_adds_up(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(engines, "WORKER_EPISODES", 2)
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    episodes = [Episode(str(i), BagSettings(path="x"), "") for i in range(3)]
    found = [(each.episode, each.camera) for each in local((config,), episodes, "file", 1, tell_the_process)]
    assert sorted(name for name, _ in found) == ["0", "1", "2"]
    assert sorted(Counter(process for _, process in found).values()) == [1, 2]


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
    found = measure((config,), Episode("a", BagSettings(path=str(path), **options), ""))
    assert found.stretches == ()
    assert re.search(words, found.fault or ""), found.fault


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
    with Journal(tmp_path, "f") as journal:
        journal.add(Measured("a", "", "a|", "1", fault="x"))
        journal.add(Measured("b", "", "b|", "1", fault="y"))
    with Journal(tmp_path, "f") as journal:
        journal.keep({"a|": "2", "b|": "1"})
        assert "a|" not in journal and journal.read("b|").fault == "y"
        with pytest.raises(InputError, match="another gripmon dataset writes there"):
            Journal(tmp_path, "f")


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
    found = measure((config,), Episode("a", source, ""))
    assert [stretch.verdict for stretch in found.stretches] == ["valid", "valid"]
    assert not found.own_reference and found.frames == dataset_scenes.MOVED_FRAMES
    assert found.stretches[0].valid >= 0.9 * found.stretches[0].frames


def test_a_mounting_beyond_the_references_sigma_is_measured_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """By 9 mm, at 1 mm: a monitor would ask a person, which a survey of mountings is there to answer."""
    monkeypatch.setattr(dataset_scenes, "MOUNTINGS", np.array([[0.009, 0.0, 0.0, 0.0, 0.0, 0.01]]))
    config = write_config(tmp_path / "c.yaml", OF_BAGS)
    shots, truth = dataset_scenes.episode(config, 0, 0)
    write_mcap(tmp_path / "a.mcap", shots)
    source = msgspec.structs.replace(config.settings.source, path=str(tmp_path / "a.mcap"))
    found = measure((config,), Episode("a", source, ""))
    [stretch] = found.stretches
    assert found.own_reference and stretch.verdict == "valid" and stretch.cam_T_grip is not None
    assert np.linalg.norm(np.subtract(stretch.cam_T_grip[:3], truth.first_T[:3, 3])) < stretch.protection_m


def one_stretch(x_mm: np.ndarray, bounds_m: np.ndarray, valid: np.ndarray) -> tuple[Stretch, np.ndarray]:
    """The stretch of frames in which the TCP is at ``x_mm``, all to be valid up to 1 mm, and their stamps (n,)."""
    made = [
        msgspec.structs.replace(
            one, protection=Protection(bound_m, 0.01, 1e-7), verdict=Verdict.VALID if good else Verdict.SUSPECT
        )
        for one, bound_m, good in zip(
            records(np.outer(1e-3 * x_mm, [1.0, 0.0, 0.0])), bounds_m.tolist(), valid, strict=True
        )
    ]
    policy = PolicySettings(alert_limit_m=1e-3)
    (stretch,) = stretches_of(table_of(made), [], [None if good else "hidden" for good in valid], policy)
    return stretch, np.array([one.stamp_ns for one in made])


def test_frames_whose_bound_is_past_the_alert_limit_are_not_valid_in_a_row():
    """By hand: of a standing camera two frames' bounds, with the way to the mean, exceed 1 mm; three weren't valid."""
    bounds_m, valid = np.full(100, 5e-4), np.ones(100, bool)
    bounds_m[[0, 50]], valid[60:63] = 0.9999e-3, False
    x_mm = np.where(np.arange(100) % 2, 0.02, -0.02)
    row, stamps_ns = one_stretch(x_mm, bounds_m, valid)
    assert row.verdict == "valid" and row.valid == 97 and row.crept_m is None
    assert row.protection_m == pytest.approx(5.2e-4, abs=3e-5)
    assert row.not_valid_ns == tuple((stamps_ns[a], stamps_ns[b]) for a, b in ((0, 0), (50, 50), (60, 62)))


def test_row_of_a_camera_that_crept_past_the_alert_limit_is_suspect():
    """Every frame's own transform is valid, but from the one that stands for all some are 0.7 mm away."""
    row, stamps_ns = one_stretch(np.linspace(0.0, 1.4, 200), np.full(200, 5e-4), np.ones(200, bool))
    assert row.crept_m == pytest.approx(0.7e-3, rel=0.1) and row.valid == 200
    assert row.verdict == "suspect" and row.protection_m == pytest.approx(1.2e-3, rel=0.05)
    assert re.match(r"as one transform the TCP may be 1\.2\d* mm off, alert limit 1 mm", row.reasons), row.reasons
    assert row.not_valid_ns == ((stamps_ns[0], stamps_ns[-1]),)
    row, _ = one_stretch(np.linspace(0.0, 0.4, 200), np.full(200, 5e-4), np.ones(200, bool))
    assert row.verdict == "valid" and row.not_valid_ns == () and row.protection_m < 1e-3


def test_mountings_are_parted_as_often_by_chance_as_said():
    """Twelve transforms of one mounting, drawn from what they claim: parted in 10 % of the runs at level 0.1."""
    rng = np.random.default_rng(3)
    root = np.diag([1e-5, 2e-5, 5e-5, 1e-3, 5e-4, 5e-4]) + 1e-6 * rng.standard_normal((6, 6))
    covariance = np.broadcast_to(root @ root.T, (12, 6, 6))
    parted = 0
    for _ in range(400):
        errors = rng.standard_normal((12, 6)) @ root.T
        poses = np.stack([perturb(np.eye(4), error) for error in errors])
        parted += mountings_of(poses, covariance, level=0.1).max() > 0
    assert 0.03 * 400 < parted < 0.13 * 400  # eleven tests, each at 0.1 / 12, of one leader: not independent


def test_mountings_by_hand():
    sigma = np.broadcast_to(np.diag([1e-10] * 3 + [1e-6] * 3), (4, 6, 6))
    at_m = [0.0, 1e-3, 1e-6, 1.00001e-3]
    poses = np.stack([perturb(np.eye(4), np.array([x, 0, 0, 0, 0, 0])) for x in at_m])
    assert mountings_of(poses, sigma).tolist() == [0, 1, 0, 1]
    assert mountings_of(poses, sigma, tolerance_m=2e-3, tolerance_rad=0.01).tolist() == [0, 0, 0, 0]
    assert mountings_of(poses[:0], sigma[:0]).tolist() == []


PLAN = [(i * 3 // 24, i in (5, 17)) for i in range(24)]
PLAN_OF_BAGS = [(i % 3, False) for i in range(16)]


@pytest.mark.slow("some five minutes: forty episodes, Ray; four episodes and the local engine are tested above")
def test_forty_episodes_here_and_on_a_cluster_with_a_kill(tmp_path: Path):
    """A LeRobot dataset and a folder of MCAPs, three mountings, two episodes in which the camera moves."""
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
        cluster.add_node(num_cpus=1)
        killer = threading.Thread(target=kill_one_worker, daemon=True)
        killer.start()
        found = measure_dataset(tmp_path / "set", tmp_path / "on_ray", config, engine="ray", address=cluster.address)
        killer.join(10.0)
        assert not killer.is_alive(), "a worker was killed"
        assert (found.measured, found.failed) == (24, 0)
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
