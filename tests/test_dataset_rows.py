"""A dataset's rows by hand: which frames a row holds in, by which bound, and which rows share a mounting."""

from __future__ import annotations

import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support import dataset_scenes
from support.dataset_scenes import OF_BAGS, episode, write_config
from support.episode_files import write_mcap
from support.playback_runs import table_of
from support.reported import records

from gripmon.analyse.dataset import SCHEMA, mountings_of
from gripmon.analyse.stretches import Stretch, stretches_of
from gripmon.daemon.dataset.measuring import measure
from gripmon.io.sources.episodes import Episode
from gripmon.judge.policy import PolicySettings
from gripmon.model.geometry import perturb
from gripmon.model.records import Absolute, Protection, Since, SinceReference, ValidBy, Verdict


def one_stretch(
    x_mm: np.ndarray, bounds_m: np.ndarray, valid: np.ndarray, *, by: ValidBy = ValidBy.ABSOLUTE, off_mm: float = 0.0
) -> tuple[Stretch, np.ndarray]:
    """The stretch of frames in which the TCP is measured at ``x_mm``, all to be valid up to 1 mm, and their stamps
    (n,).  By the motion since the reference its place is published ``off_mm`` away from there.
    """
    made = []
    for one, bound_m, good in zip(
        records(np.outer(1e-3 * x_mm, [1.0, 0.0, 0.0])), bounds_m.tolist(), valid, strict=True
    ):
        at = one.cam_T_grip
        x, y, z = at.translation_m
        absolute = Absolute(
            bound_m if by is ValidBy.ABSOLUTE else 4e-3, 0.01, (x + 1e-3 * off_mm, y, z), at.rotation_xyzw
        )
        since = SinceReference(bound_m if by is ValidBy.REFERENCE else 3e-4, 0.01, Since.FIRST_PROVED, 7)
        made.append(
            msgspec.structs.replace(
                one, protection=Protection(bound_m, 0.01, 1e-7), verdict=Verdict.VALID if good else Verdict.SUSPECT,
                valid_by=by, absolute=absolute, since_reference=since,
            )
        )  # fmt: skip
    policy = PolicySettings(alert_limit_m=1e-3, valid_by=by)
    (stretch,) = stretches_of(table_of(made), [], [None if good else "hidden" for good in valid], policy)
    return stretch, np.array([one.stamp_ns for one in made])


def test_frames_whose_bound_is_past_the_alert_limit_are_not_valid_in_a_row():
    """By hand: of a standing camera two frames' bounds, with the way to the mean, exceed 1 mm; three weren't valid."""
    bounds_m, valid = np.full(100, 5e-4), np.ones(100, bool)
    bounds_m[[0, 50]], valid[60:63] = 0.9999e-3, False
    x_mm = np.where(np.arange(100) % 2, 0.02, -0.02)
    row, stamps_ns = one_stretch(x_mm, bounds_m, valid)
    assert row.verdict == "valid" and row.valid_share == pytest.approx(0.97) and row.crept_m is None
    assert row.protection_m == pytest.approx(5.2e-4, abs=3e-5)
    assert row.not_valid_ns == tuple((stamps_ns[a], stamps_ns[b]) for a, b in ((0, 0), (50, 50), (60, 62)))


def test_row_of_a_camera_that_crept_past_the_alert_limit_is_suspect():
    """Every frame's own transform is valid, but from the one that stands for all some are 0.7 mm away."""
    row, stamps_ns = one_stretch(np.linspace(0.0, 1.4, 200), np.full(200, 5e-4), np.ones(200, bool))
    assert row.crept_m == pytest.approx(0.7e-3, rel=0.1) and row.valid_share == 1.0
    assert row.verdict == "suspect" and row.protection_m == pytest.approx(1.2e-3, rel=0.05)
    assert re.match(r"as one transform the TCP may be 1\.2\d* mm off, alert limit 1 mm", row.reason), row.reason
    assert row.not_valid_ns == ((stamps_ns[0], stamps_ns[-1]),)
    row, _ = one_stretch(np.linspace(0.0, 0.4, 200), np.full(200, 5e-4), np.ones(200, bool))
    assert row.verdict == "valid" and row.not_valid_ns == () and row.protection_m < 1e-3


@pytest.mark.parametrize("by", list(ValidBy))
def test_row_says_which_bound_it_holds(by: ValidBy):
    """By hand: both bounds with the way of 0.02 mm to the mean, and the one that ``valid_by`` names as protection."""
    row, _ = one_stretch(np.where(np.arange(100) % 2, 0.02, -0.02), np.full(100, 5e-4), np.ones(100, bool), by=by)
    absolute_m, since_m = (5e-4, 3e-4) if by is ValidBy.ABSOLUTE else (4e-3, 5e-4)
    assert (row.verdict, row.valid_by, row.since, row.since_ns) == ("valid", by.value, "first_proved", 7)
    for found_m, bound_m in ((row.protection_m, 5e-4), (row.absolute_m, absolute_m), (row.since_reference_m, since_m)):
        assert found_m == pytest.approx(bound_m + 2e-5, abs=3e-5)


def test_motion_since_the_reference_says_nothing_about_where_the_camera_was():
    """Its frames are valid by a bound of 0.5 mm, published where the reference has them; measured 2 mm from there."""
    valid, bounds_m = np.ones(100, bool), np.full(100, 5e-4)
    row, _ = one_stretch(np.zeros(100), bounds_m, valid, by=ValidBy.REFERENCE, off_mm=2.0)
    at_m = np.array(records(np.zeros((1, 3)))[0].cam_T_grip.translation_m)
    np.testing.assert_allclose(row.cam_T_grip[:3] - at_m, [2e-3, 0.0, 0.0], atol=3e-5)
    assert row.verdict == "suspect" and row.protection_m == pytest.approx(2.5e-3, abs=1e-4)
    assert "may be 2.5 mm off, alert limit 1 mm, measured 2 mm from where the reference has it" in row.reason
    near, _ = one_stretch(np.zeros(100), bounds_m, valid, by=ValidBy.REFERENCE, off_mm=0.2)
    assert near.verdict == "valid" and near.protection_m == pytest.approx(7e-4, abs=1e-4)


@pytest.mark.parametrize("own", [True, False])
def test_one_rig_in_two_episodes_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool):
    """By the motion since the reference, 2.2 mm apart.  Without a reference of its own an episode's motion counts from
    its first frames: published is where the configuration has the camera, valid by 0.5 mm and 2.2 mm off.
    """
    text = dataset_scenes.CONFIG.replace("monitor:\n", "monitor:\n  policy:\n    valid_by: reference\n")
    monkeypatch.setattr(dataset_scenes, "CONFIG", text if own else text.replace("1.0e-4", "1.0e-6"))
    config = write_config(tmp_path / "c.yaml", OF_BAGS)
    rows = []
    for mounting in (0, 1):
        shots, truth = episode(config, mounting, mounting)
        write_mcap(tmp_path / "a.mcap", shots)
        source = msgspec.structs.replace(config.settings.source, path=str(tmp_path / "a.mcap"))
        rows += measure(config, Episode("a", source, ""))
        assert np.linalg.norm(np.subtract(rows[-1].cam_T_grip[:3], truth.first_T[:3, 3])) < 1e-4
    assert [row.own_reference for row in rows] == [own, own] and {row.valid_by for row in rows} == {"reference"}
    assert [row.verdict for row in rows] == ["valid", "valid" if own else "suspect"]
    # Each motion counts from frames of its own episode: bounds of two episodes are not about one beginning.
    assert all(row.start_ns <= row.since_ns <= row.end_ns and row.since == "first_proved" for row in rows)


def test_columns_are_described_and_named_once():
    assert len(set(SCHEMA.names)) == len(SCHEMA.names)
    assert all(field.metadata[b"description"] for field in SCHEMA)
    types = {
        "stretch": "int32", "start_ns": "int64", "covariance": "list<item: double>", "moved": "bool",
        "not_valid_ns": "list<item: list<item: int64>>", "picture": "binary",
    }  # fmt: skip
    assert {name: str(SCHEMA.field(name).type) for name in types} == types


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
