"""``tools/bench real --from-images``: a gripper that is found, one that is refused, a video, and what is missed."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.changing_backgrounds import coverage, images_of, moving_robot
from support.simulated import PAPER_LENS

from gripmon.model.errors import InputError

STILLS, OPENING_M, FINER = 12, 0.034, 8
DISTANCE = ("--distance", "0.115:0.001")
LIMIT = (5e-3, math.radians(5.0))

pytestmark = pytest.mark.usefixtures("tools_importable")


def task(**fields):
    from benchmarks.real_images import Task

    return Task(**{"options": DISTANCE, "limit": LIMIT, "least": 0.5, "play": 1e-3, **fields})


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "simulated"
    folder.mkdir()
    for n, image in enumerate(images_of(moving_robot(4, opening_m=OPENING_M), STILLS)):
        cv2.imwrite(str(folder / f"{n:02d}.png"), image)
    values = {
        "robot": "robot",
        "camera_name": "wrist",
        "camera": {**msgspec.to_builtins(PAPER_LENS), "model": "paper"},
        "source": {"kind": "folder", "path": "."},
        "jaw": {"source": "fixed", "opening_m": OPENING_M},
        "publish": {"enabled": False},
        "recording": {"enabled": False},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    return folder


@pytest.fixture(scope="module")
def made(stills: Path, tmp_path_factory: pytest.TempPathFactory):
    """Made of them, beside the simulator's own outline: where pixels show half of a finger."""
    covered = coverage(moving_robot(4, opening_m=OPENING_M))
    finer = cv2.resize(covered, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    edges, _ = cv2.findContours((finer > 0.5).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edges = [cv2.approxPolyDP(line, 1.0, True)[:, 0] for line in edges]
    closed = [((np.vstack([line, line[:1]]) + 0.5) / FINER - 0.5).tolist() for line in edges]
    chains = [{"what": "", "role": "outline", "sigma_px": 0.5, "uv_px": line} for line in closed]
    path = tmp_path_factory.mktemp("drawn") / "drawn.json"
    path.write_text(json.dumps({"simulated": {"size_px": covered.shape[::-1], "chains": chains}}))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).resolve().parent.parent / "tools"))
        from benchmarks import real_images

        patch.setattr(real_images, "DRAWN", path)
        place = tmp_path_factory.mktemp("place") / "simulated"
        return real_images.made_from_images("simulated", stills, place, task())


def test_a_gripper_is_made_and_its_outline_lies_on_the_true_one(made):
    assert made.code == 0 and made.folder is not None, made.words
    assert any("outline known to" in line for line in made.words)
    assert made.distance_m == pytest.approx(0.115, abs=1e-4)
    # The simulator's fingers have backs, whose outline isn't in the file.
    assert made.off.written[1] < 0.5 and made.off.drawn[0] < 0.3 and made.off.covered > 0.5
    assert not (made.folder / "gripper.yaml").is_symlink()


def test_it_is_taught_and_replayed_like_a_file_made_by_hand(made):
    from benchmarks.real_figures import figures_of
    from benchmarks.real_images import missed_from_images, runs_of_made
    from benchmarks.real_runs import runs_of

    runs, play_m, refused = runs_of_made(made, task(), runs_of)
    assert (play_m, refused) == (1e-3, None)
    found = [(run, figures_of(run)) for run in runs]
    assert [(run.taught, run.bound) for run, _ in found] == [
        (taught, bound) for bound in ("reference", "absolute", "belief") for taught in (False, True)
    ]
    for _, figures in found:
        assert (figures.stills, figures.valid) == (STILLS - 2, STILLS - 2), figures.reasons
    assert missed_from_images(made, task(least=1.0), found, play_m) == []
    (fault,) = missed_from_images(made, task(least=1.0), [(r, dataclasses.replace(f, valid=9)) for r, f in found], 1e-3)
    assert "taught, reference bound: 9 of 10 valid; at least 10" in fault


def test_limits_and_play_of_a_gripper_of_unknown_size_are_parts_of_its_distance(made):
    from benchmarks.real_images import runs_of_made

    asked = []
    unknown = task(limit=(0.025, 0.1), play=0.004, of_distance=True)
    far = dataclasses.replace(made, distance_m=2.0)
    runs, play, _ = runs_of_made(far, unknown, lambda name, folder, limit: asked.append(limit) or [])
    assert (runs, play) == ([], 0.008) and asked == [(0.05, 0.1)]


def test_a_file_that_cannot_be_used_is_said_and_no_crash(made):
    from benchmarks.real_images import runs_of_made

    def refuse(name, folder, limit):
        raise InputError(f"{folder}/gripper.yaml: too few points")

    assert runs_of_made(made, task(), refuse) == ([], 0.0, "gripper.yaml: too few points")


def test_an_outline_that_is_off_or_isn_t_there_is_missed(made):
    from benchmarks.outlines import Beside
    from benchmarks.real_images import missed_from_images

    off = dataclasses.replace(made, off=Beside((0.4, 1.3), (0.5, 40.0), 0.4))
    assert missed_from_images(off, task(), [], 0.0) == [
        "simulated, from images: outline: 95 % within 1.30 px of what was drawn; 1 px",
        "simulated, from images: outline: 40 % of what was drawn is there; at least half",
    ]


def test_a_refusal_is_a_row_and_the_next_set_goes_on(
    stills: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    from benchmarks.__main__ import main

    few = tmp_path / "few"
    few.mkdir()
    for path in [*sorted(stills.glob("*.png"))[:2], stills / "config.yaml"]:
        (few / path.name).write_bytes(path.read_bytes())
    blind = tmp_path / "blind"
    blind.mkdir()
    (blind / "config.yaml").write_bytes((few / "config.yaml").read_bytes())
    (blind / "0.png").write_bytes(b"no image")
    words = ["bench", "real", "--from-images", str(few), str(blind)]
    monkeypatch.setattr("sys.argv", words)
    assert main() == 2
    assert "few: no alert limit is fixed for it; --limit MM DEGREES" in capsys.readouterr().err
    monkeypatch.setattr("sys.argv", [*words, "--limit", "5", "5", "--distance", "0.115:0.001"])
    assert main() == 1
    said = capsys.readouterr().out
    for name in ("few", "blind"):
        assert f"MISSED: {name}, from images: exit code " in said
        rows = [[cell.strip() for cell in line.split("|")] for line in said.splitlines()]
        (row,) = [row for row in rows if row[1:2] == [name]]
        assert row[2] in ("2", "3") and "nothing usable" in row
    title, *rest = said.splitlines()
    assert str(few) in title and not [line for line in rest if "Traceback" in line or str(tmp_path) in line]


def test_a_video_s_frames_are_laid_out_as_files_in_turn(tmp_path: Path):
    from benchmarks.real_images import _lay_out

    video, place = tmp_path / "a.mp4", tmp_path / "place"
    place.mkdir()
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 48))
    for level in range(20, 240, 20):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    _lay_out(tmp_path, [video], place)
    means = [cv2.imread(str(path)).mean() for path in sorted(place.iterdir())]
    np.testing.assert_allclose(means, range(20, 240, 20), atol=4.0)
