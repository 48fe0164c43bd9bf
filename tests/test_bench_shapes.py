"""``tools/bench shapes`` in small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


def test_a_row_says_what_was_valid_how_far_it_was_off_and_what_was_missed():
    from benchmarks import shapes

    cells = list(shapes.rows(12, 1, ["rounded by 2 mm"]))
    assert [row[:2] for row in cells] == [
        [name, motion] for name in ("sharp box", "rounded by 2 mm") for motion in shapes.MOTIONS
    ]
    assert cells[0][2] == "100 %" and float(cells[2][2].strip(" %")) > 90.0
    assert all(row[3] == row[4] == "0" for row in cells)
    assert all(float(row[6]) == 1.0 for row in cells[:2])
    ratio = float(cells[2][5]) / float(cells[0][5])
    assert float(cells[2][6]) == pytest.approx(ratio, abs=0.1)
    assert all((row[7] == "met") == (row[2] == "100 %" and float(row[6]) <= 2.0) for row in cells)


def test_fingers_of_two_tones_are_the_same_surface_in_two_parts():
    from benchmarks.meshes import box_fingers, toned

    (mesh, _) = box_fingers()
    (front, gain), (rear, usual) = toned(mesh, -0.012, 0.5)
    assert (gain, usual) == (0.5, 1.0)
    assert front.bounds[0, 2] == pytest.approx(-0.012) and rear.bounds[1, 2] == pytest.approx(-0.012)
    assert front.area + rear.area == pytest.approx(mesh.area)
    for part in (front, rear):
        middles = part.triangles_center - part.bounds.mean(axis=0)
        assert (np.einsum("ti,ti->t", part.face_normals, middles) > 0.0).all(), "turned outwards as before"


def test_the_border_leaves_as_much_of_the_fingers_as_is_said():
    from benchmarks import shapes

    from gripmon.model.camera import PaperLens, make_camera

    camera = make_camera(PaperLens(width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5))
    pose = shapes.pose_of(camera, cut=True)
    tip = pose[:3, :3] @ np.array([0.022, -0.008, 0.0]) + pose[:3, 3]
    assert camera.project(tip[None])[0, 1] == pytest.approx(575.0 - shapes.SHOWN_PX, abs=0.1)


def test_fingers_of_which_forty_pixels_show_are_valid_while_the_camera_stands(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Every pixel up to the border counts for the rotation."""
    from benchmarks import shapes

    monkeypatch.setattr(shapes, "SHOWN_PX", 40.0)
    (cut,) = (shape for shape in shapes.SHAPES if shape.name == "sharp box, cut by the border")
    seen = shapes.track(cut, 0.0, 0.0, 20, 1, tmp_path)
    assert seen.valid >= 0.8 * seen.frames and not seen.misleading and not seen.beyond
