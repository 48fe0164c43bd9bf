"""Which corners the variants 3P, 4P and 5P take, and what that does to estimates and their covariance."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.box_models import cube_model, two_fingers_model
from support.configurations import shipped
from support.grippers import gripper_from_dict
from support.simulated import BOX_FINGERS
from support.watched import Watched, frames_of, new_monitor, watch

from gripmon.daemon.config import ConfigError, load_config, read_gripper
from gripmon.model.gripper import Gripper
from gripmon.model.records import AlertKind, CornerFault, FrameRecord
from gripmon.monitor import MonitorSettings

ADAPTIVE_FINGERS = BOX_FINGERS.parent / "adaptive_arc_fingers.yaml"


def names(gripper: Gripper, count: int, without: tuple[str, ...] = ()) -> set[str]:
    among = np.array([name not in without for name in gripper.corner_ids])
    chosen = gripper.innermost_corners(among, count)
    assert not (chosen & ~among).any()
    return {name for name, taken in zip(gripper.corner_ids, chosen, strict=True) if taken}


@pytest.mark.parametrize("path", [BOX_FINGERS, ADAPTIVE_FINGERS], ids=lambda path: path.stem)
def test_four_are_the_rectangle_about_the_tcp_and_the_fifth_is_an_outer_one(path: Path):
    gripper = read_gripper(path)
    inner = {"L_in_near", "L_in_far", "R_in_near", "R_in_far"}
    assert names(gripper, 4) == inner
    assert len(names(gripper, 3)) == 3 and names(gripper, 3) < inner
    [outer] = names(gripper, 5) - inner
    assert "_out_" in outer
    assert names(gripper, 99) == set(gripper.corner_ids)
    every = np.ones(len(gripper.corner_ids), dtype=bool)
    assert gripper.innermost_corners(every, None) is every


def test_three_lie_on_two_fingers_and_never_on_a_line():
    gripper = read_gripper(BOX_FINGERS)
    points = gripper.points_grip_m()[gripper.corner_points]
    for hidden in ((), ("L_in_near",), ("R_in_far",), ("L_in_far", "R_in_far"), ("L_in_near", "L_in_far")):
        taken = [gripper.corner_ids.index(name) for name in names(gripper, 3, hidden)]
        assert {gripper.corner_ids[i][0] for i in taken} == {"L", "R"}
        assert np.linalg.svd(points[taken] - points[taken].mean(axis=0), compute_uv=False)[1] > 4e-3


def test_any_gripper_gives_those_nearest_to_its_tcp():
    """Fingertips whose corners lie anywhere, one finger, three fingers: by distances alone, reckoned here."""
    rng = np.random.default_rng(1)
    for model in (two_fingers_model(), cube_model()):
        for point in model["points"].values():
            point["xyz_m"] = (np.array(point["xyz_m"]) * 1.3 + rng.normal(scale=1e-3, size=3)).tolist()
        model.pop("faces")
        gripper = gripper_from_dict(model)
        distance_m = np.linalg.norm(gripper.points_grip_m()[gripper.corner_points], axis=1)
        finger = gripper.point_finger[gripper.corner_points]
        for count in (3, 4, 5):
            among = rng.random(len(distance_m)) < 0.8
            chosen = gripper.innermost_corners(among, count)
            assert np.count_nonzero(chosen) == min(count, np.count_nonzero(among))
            for one in range(len(gripper.finger_ids)):
                mine = among & (finger == one)
                if (chosen & mine).any() and (mine & ~chosen).any():
                    assert distance_m[chosen & mine].max() <= distance_m[mine & ~chosen].min() + 1e-4
            per_finger = np.bincount(finger[chosen], minlength=len(gripper.finger_ids))
            left = np.bincount(finger[among & ~chosen], minlength=len(gripper.finger_ids))
            assert all(b >= a - 1 or not rest for a in per_finger for b, rest in zip(per_finger, left, strict=True))


# --- in the monitor ---


def watched_with(scene: str, frames: int | None = None, **settings: object) -> Watched:
    images, truths = frames_of(scene)
    return watch(images[:frames], truths[:frames], new_monitor(MonitorSettings(**settings)))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def variants() -> dict[str, Watched]:
    return {v: watched_with("static", measurement="corners", update_corners=v) for v in ("3P", "4P", "5P", "all")}


def used(record: FrameRecord) -> set[str]:
    return {corner.id for corner in record.corners if corner.used}


def test_a_variant_uses_no_more_corners_than_its_name_says(variants: dict[str, Watched]):
    for variant, count in (("3P", 3), ("4P", 4), ("5P", 5)):
        for record in variants[variant].records:
            # What is left out was measured all the same.
            measured = {corner.id for corner in record.corners if corner.uv_px is not None}
            left_out = {corner.id for corner in record.corners if corner.reason is CornerFault.LEFT_OUT}
            assert len(used(record)) == min(count, len(measured))
            assert left_out == measured - used(record)
    assert not any(c.reason is CornerFault.LEFT_OUT for r in variants["all"].records for c in r.corners)
    inner = {"L_in_near", "L_in_far", "R_in_near", "R_in_far"}
    assert max(len(used(r) & inner) for r in variants["4P"].records) == 4


def test_every_variant_is_near_the_truth_as_its_covariance_says(variants: dict[str, Watched]):
    for variant, seen in variants.items():
        assert np.nanmean(seen.nees()) < 12.0, variant
        assert np.nanmax(np.abs(seen.errors()[:, :2])) < 1e-3


def test_fewer_corners_are_less_certain(variants: dict[str, Watched]):
    """Three corners determine the six unknowns without anything left over, and badly: the covariance has to say so."""
    sigma_m = {
        variant: np.median([np.reshape(r.covariance, (6, 6)).diagonal()[:3] ** 0.5 for r in seen.records], axis=0)
        for variant, seen in variants.items()
    }
    for few, more in (("3P", "4P"), ("4P", "5P"), ("5P", "all")):
        assert (sigma_m[few] >= 0.97 * sigma_m[more]).all(), (few, more)
    assert sigma_m["3P"].max() > 1.2 * sigma_m["4P"].max()
    spread = {variant: np.nanstd(seen.errors()[:, :3], axis=0).max() for variant, seen in variants.items()}
    assert spread["3P"] > spread["4P"]


@pytest.mark.parametrize("variant", ["4P", "5P"])
def test_a_recalibration_takes_its_own_selection(variant: str):
    seen = watched_with("bump", recalibrate_corners=variant)
    [text] = [alert.text for r in seen.records for alert in r.alerts if alert.kind is AlertKind.RECALIBRATED]
    [corners] = re.findall(r"corners ([\w, ]+):", text)
    assert len(corners.split(", ")) == int(variant[0])
    assert seen.records[-1].revision == 2


def test_a_selection_without_effect_is_refused(tmp_path: Path):
    text, path = shipped(), tmp_path / "config.yaml"
    path.write_text(text.replace("monitor:\n", "monitor:\n  update_corners: 4P\n"))
    with pytest.raises(ConfigError, match=r"monitor.update_corners: is 4P, but without effect"):
        load_config(path)
    path.write_text(text.replace("monitor:\n", "monitor:\n  update_corners: 4P\n  measurement: corners\n"))
    assert load_config(path).settings.monitor.update_corners == "4P"
    path.write_text(text.replace("monitor:\n", "monitor:\n  recalibrate_corners: 3P\n"))
    with pytest.raises(ConfigError, match=r"monitor.recalibrate_corners: is '3P'"):
        load_config(path)
