"""The newcomer's gripper of ``tools/bench shapes``: what it is shown at, and what comes of files and of refusals."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml

from gripmon.daemon.calibrations import read_calibrated
from gripmon.model.geometry import from_record
from gripmon.track.edges.taught import gripper_digest

pytestmark = pytest.mark.usefixtures("tools_importable")
FRAMES, STILLS = 24, 2


def test_a_refusal_ends_the_day_with_its_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from benchmarks import newcomer, shapes
    from benchmarks.real_images import Answer

    asked = []

    def refuse(*words, without):
        asked.append(words[0])
        return (
            Answer(3, ("teach: unlike; and left out before: a.png: 2 px",), 0.0)
            if len(asked) > 1
            else Answer(0, (), 0.0)
        )

    monkeypatch.setattr(newcomer, "answered", refuse)
    ended = newcomer.day(1, 0, tmp_path, FRAMES, STILLS)
    assert asked == ["gripper", "teach"]
    assert (ended.frames, ended.valid, ended.why) == (FRAMES - 1, 0, "teach: exit code 3: teach: unlike")
    assert math.isnan(ended.error_m)
    monkeypatch.setattr(newcomer, "day", lambda *given: ended)
    (row,) = shapes.rows(1, 1, [shapes.NEWCOMER])
    assert row[0] == shapes.NEWCOMER and row[-1].startswith("**missed** teach: exit code 3")


def test_it_is_shown_at_both_openings_at_the_place_that_the_plate_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """And with the file of the bodies' own edges, in place of one from images, the day is watched to its end."""
    from benchmarks import newcomer
    from benchmarks.integrity_practice import GRASPED_M
    from benchmarks.padded import padded_model
    from benchmarks.real_images import Answer

    def by_hand(*words, without):
        if words[0] == "gripper":
            model = msgspec.to_builtins(padded_model().model)
            (tmp_path / "gripper.yaml").write_text(yaml.safe_dump(model))
            plate = yaml.safe_load((tmp_path / "plate.yaml").read_text())
            plate["gripper"] = {"name": "padded_fingers", "sha256": gripper_digest(padded_model())}
            (tmp_path / "reference.yaml").write_text(yaml.safe_dump(plate))
        return Answer(0, (), 0.0)

    monkeypatch.setattr(newcomer, "answered", by_hand)
    seen = newcomer.day(1, 0, tmp_path, FRAMES, STILLS)
    rows = list(csv.DictReader((tmp_path / "images" / "timestamps.csv").open()))
    openings_m = [float(row["jaw_opening_m"]) for row in rows]
    assert openings_m[STILLS:] == [GRASPED_M] * STILLS and openings_m[0] == pytest.approx(0.04, abs=2.1e-3)
    pictures = [cv2.imread(str(tmp_path / "images" / row["file"]), cv2.IMREAD_GRAYSCALE).astype(float) for row in rows]
    assert all(np.abs(a - b).mean() > 1.0 for a, b in pairwise(pictures))
    plate = read_calibrated(tmp_path / "plate.yaml").cam_T_grip
    assert plate is not None and from_record(plate)[2, 3] == pytest.approx(0.09, abs=5e-3)
    assert seen.frames == FRAMES - 1 and seen.beyond == 0
    assert seen.error_m < 1e-3 and (seen.valid > 0 or seen.why)
