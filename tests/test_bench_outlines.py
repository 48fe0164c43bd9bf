"""How far outlines lie beside drawn ones: known distances, a gripper by its equations, and what was drawn."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.simulated import PAPER_LENS, nominal_cam_T_grip

import gripmon
from gripmon.model.camera import make_camera
from gripmon.model.geometry import from_record
from gripmon.model.gripper import Gripper, GripperModel

TESTS = Path(__file__).resolve().parent
DRAWN = TESTS / "data" / "real_outlines.json"
REAL = TESTS.parents[1] / "shared" / "data" / "real"
FINGER = np.array([(100.0, 300.0), (100.0, 100.0), (150.0, 100.0), (150.0, 300.0)])

pytestmark = pytest.mark.usefixtures("tools_importable")


def drawn(*outline, may=()):
    from benchmarks.outlines import Drawn

    return Drawn(list(outline), list(may), (640, 480))


def test_an_outline_that_is_moved_by_two_pixels_lies_two_pixels_off_on_its_sides_and_not_on_its_tip():
    from benchmarks.outlines import beside

    same = beside(drawn(FINGER), [FINGER])
    np.testing.assert_allclose(np.ravel(same[:2]), 0.0, atol=1e-9)
    assert same.covered == 1.0
    off = beside(drawn(FINGER), [FINGER + np.array((2.0, 0.0))])
    np.testing.assert_allclose((*off.written, *off.drawn), 2.0, atol=1e-9)
    # Of 451 points 49 on the other one's tip, one before it, and one on the side that it crosses.
    assert off.covered == pytest.approx(51.0 / 451.0, abs=1e-9)


def test_each_pixel_of_a_line_counts_and_not_each_vertex():
    from benchmarks.outlines import beside

    crowded = np.vstack([FINGER[:1], np.linspace(FINGER[0], FINGER[0] + (0.0, -10.0), 1000), FINGER[1:]])
    moved = np.where(crowded[:, 1:] < 250.0, crowded + np.array((0.0, 5.0)), crowded)
    assert beside(drawn(FINGER), [moved]).written[0] < 0.1
    assert beside(drawn(FINGER), [moved]).written[1] == pytest.approx(5.0)


def test_what_is_written_beside_nothing_drawn_is_far_off_and_what_is_not_written_is_not_covered():
    from benchmarks.outlines import beside

    table = np.array([(300.0, 200.0), (600.0, 200.0)])
    both = beside(drawn(FINGER), [FINGER, table])
    assert both.written[1] > 400.0 and both.drawn == pytest.approx((0.0, 0.0), abs=1e-9)
    half = beside(drawn(FINGER, table), [FINGER])
    assert half.written == pytest.approx((0.0, 0.0), abs=1e-9) and half.covered == pytest.approx(0.6, abs=0.01)
    assert beside(drawn(FINGER), [])[:2] == ((math.inf, math.inf),) * 2
    assert beside(drawn(FINGER), []).covered == 0.0


def test_lines_that_a_file_may_have_are_no_fault_and_needn_t_be_there():
    from benchmarks.outlines import beside

    mount = np.array([(150.0, 300.0), (250.0, 300.0)])
    allowed = drawn(FINGER, may=[mount])
    np.testing.assert_allclose(np.ravel(beside(allowed, [FINGER, mount])[:2]), 0.0, atol=1e-9)
    assert beside(allowed, [FINGER]).covered == 1.0


def test_what_leaves_the_image_is_not_compared():
    from benchmarks.outlines import beside

    out = [np.array([(100.0, 700.0), (100.0, 100.0), (150.0, 100.0), (150.0, 700.0)])]
    ends = FINGER.copy()
    ends[[0, 3], 1] = 469.0
    np.testing.assert_allclose(np.ravel(beside(drawn(ends), out)[:2]), 0.0, atol=1e-9)


def test_the_outline_of_a_gripper_file_lies_where_its_points_project_and_leaves_out_what_is_within_it():
    from benchmarks.outlines import projected_outline

    xyz_m = {"a": (-0.01, 0.0, -0.03), "b": (-0.01, 0.002, 0.0), "c": (0.004, 0.0, 0.0), "d": (0.0, 0.0, -0.03)}
    values = {
        "name": "one",
        "fingers": {"finger": {}},
        "points": {name: {"finger": "finger", "xyz_m": place} for name, place in xyz_m.items()},
        "edges": {
            "ab": {"from": "a", "to": "b"},
            "bc": {"from": "b", "to": "c"},
            "cd": {"from": "c", "to": "d"},
            "bd": {"from": "b", "to": "d", "kind": "crease"},
        },
    }
    gripper, pose = Gripper(msgspec.convert(values, GripperModel)), nominal_cam_T_grip()
    lines = projected_outline(gripper, make_camera(msgspec.structs.replace(PAPER_LENS, kappa_per_px2=0.0)), pose)
    cam = np.array(list(xyz_m.values())) @ pose[:3, :3].T + pose[:3, 3]
    uv = cam[:, :2] / cam[:, 2:] * (PAPER_LENS.fx_px, PAPER_LENS.fy_px) + (PAPER_LENS.cx_px, PAPER_LENS.cy_px)
    ends = [(line[0], line[-1]) for line in lines]
    np.testing.assert_allclose(ends, [(uv[0], uv[1]), (uv[1], uv[2]), (uv[2], uv[3])], atol=1e-6)


@pytest.mark.parametrize("name", ["xarm", "piper", "umi_left"])
def test_what_was_drawn_lies_in_its_image_and_ends_before_the_border(name: str):
    from benchmarks.outlines import BORDER_PX, drawn_outlines

    lines = drawn_outlines(DRAWN, name)
    assert lines is not None and lines.outline
    points = np.vstack([*lines.outline, *lines.may])
    last = np.array(lines.size_px) - 1.0 - BORDER_PX
    assert ((points >= BORDER_PX) & (points <= last)).all()
    assert drawn_outlines(DRAWN, "another") is None


@pytest.mark.skipif(not (REAL / "piper").is_dir(), reason="../shared/data/real is not there")
def test_two_who_drew_the_same_finger_agree():
    """The set's own file is a polyline that somebody else drew, known to 0.6 px."""
    from benchmarks.outlines import beside, drawn_outlines, projected_outline

    config = gripmon.load_config(REAL / "piper" / "config.yaml", check_source=False)
    lines = drawn_outlines(DRAWN, "piper")
    assert lines is not None
    off = beside(lines, projected_outline(config.gripper, config.camera, from_record(config.reference.cam_T_grip)))
    assert off.written[1] < 1.2 and off.drawn[1] < 1.2 and off.covered > 0.95


@pytest.mark.parametrize("name", ["xarm", "piper"])
@pytest.mark.skipif(not (REAL / "piper").is_dir(), reason="../shared/data/real is not there")
def test_a_real_gripper_is_made_from_its_images_as_it_was_drawn_by_hand(name: str, tmp_path: Path):
    from benchmarks.real import LIMITS, PLAY_M
    from benchmarks.real_images import LEAST_COVERED, WITHIN_PX, made_from_images, tasks

    made = made_from_images(name, REAL / name, tmp_path, tasks(LIMITS, PLAY_M)[name])
    assert made.code == 0, made.words
    assert made.off is not None
    assert made.off.written[1] < WITHIN_PX and made.off.covered > LEAST_COVERED
