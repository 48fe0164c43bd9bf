"""Gripper files from CAD against the models that the CAD was made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.simulated import PAPER_LENS, nominal_cam_T_grip, sharp_gripper

import gripmon
from gripmon.cli import main
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.errors import InputError
from gripmon.model.geometry import invert
from gripmon.model.gripper import Gripper
from gripmon.teach.cad import gripper_from_cad
from tools.benchmarks.meshes import box_fingers, curved_fingers, finger_mesh, rounded_fingers, write_meshes

MICROMETRE = 1e-6
CUBE = Path(__file__).resolve().parents[2] / "shared" / "data" / "visp_cube" / "cube.cao"
ARC_FINGERS = Path(__file__).resolve().parents[1] / "configs" / "grippers" / "adaptive_arc_fingers.yaml"


def box_meshes(gripper: Gripper) -> list[trimesh.Trimesh]:
    """The fingers of a gripper file with faces, as they are drawn."""
    points = gripper.points_grip_m()
    return [trimesh.convex.convex_hull(points[gripper.point_finger == k]) for k in range(len(gripper.finger_ids))]


def ends_of(gripper: Gripper, jaw_opening_m: float | None = None) -> np.ndarray:
    """Edges (e, 2, 3) in an order of their own."""
    ends = gripper.points_grip_m(jaw_opening_m)[gripper.edge_points]
    turned = np.array([sorted(pair.round(5).tolist()) != pair.round(5).tolist() for pair in ends])
    ends[turned] = ends[turned][:, ::-1]
    return ends[np.lexsort(ends.round(5).reshape(-1, 6).T)]


def seen(**settings: object) -> dict[str, object]:
    return {"camera": make_camera(PAPER_LENS), "cam_T_grip": nominal_cam_T_grip(), **settings}


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_boxes_come_back_within_micrometres(tmp_path: Path, ending: str):
    known = sharp_gripper()
    # Elsewhere in the CAD's frame, which leaves no trace.
    meshes = [m.apply_translation([0.1, -0.05, 0.2]) for m in box_meshes(known)]
    made = gripper_from_cad(
        write_meshes(meshes, tmp_path, ending=ending), unit="mm", jaw_range_m=(0.0, 0.06), length_m=0.04
    ).gripper
    assert made.jaw_nominal_m == pytest.approx(known.jaw_nominal_m, abs=MICROMETRE)
    for opening_m in (0.0, 0.034, 0.06):
        np.testing.assert_allclose(ends_of(made, opening_m), ends_of(known, opening_m), atol=2 * MICROMETRE)
    for eye in ([0.0, -0.08, -0.1], [0.05, 0.02, -0.1], [0.0, 0.01, 0.2]):
        views = [g.edge_view(g.points_grip_m(), np.array(eye)) for g in (made, known)]
        assert np.count_nonzero(views[0].visible) == np.count_nonzero(views[1].visible)
        assert np.count_nonzero(views[0].crease) == np.count_nonzero(views[1].crease)


def test_both_fingers_in_one_file_are_told_apart(tmp_path: Path):
    known = sharp_gripper()
    path = tmp_path / "both.stl"
    trimesh.util.concatenate(box_meshes(known)).apply_scale(1e3).export(path)
    made = gripper_from_cad([path], unit="mm", body="1,2", jaw_range_m=(0.0, 0.06))
    assert made.gripper.finger_ids == ("left", "right")
    np.testing.assert_allclose(ends_of(made.gripper), ends_of(known), atol=2 * MICROMETRE)


@pytest.mark.skipif(not CUBE.is_file(), reason="../shared/data/visp_cube is not there")
def test_visps_cube_is_the_one_that_was_written_by_hand():
    by_hand = read_gripper(ARC_FINGERS.with_name("visp_cube.yaml"))
    made = gripper_from_cad([CUBE], frame="cad").gripper
    np.testing.assert_allclose(ends_of(made), ends_of(by_hand), atol=1e-9)
    assert len(made.corner_ids) == 8 and len(made.faces) == 6


URDF = """<robot name="arc"><link name="base"><visual><origin xyz="0 0 -0.08"/>
<geometry><box size="0.08 0.05 0.02"/></geometry></visual></link>
{parts}</robot>"""
PART = """<link name="{side}_bar"><visual><origin xyz="0 0.03 0.02"/>
<geometry><box size="0.004 0.004 0.05"/></geometry></visual></link>
<joint name="{side}_bar_joint" type="revolute"><parent link="base"/><child link="{side}_bar"/>
<origin xyz="{x} 0 -0.07"/><axis xyz="0 {s} 0"/><limit lower="0.0" upper="0.7"/>{mimic}</joint>
<link name="{side}_tip"><visual><origin xyz="{out} 0 0.01"/>
<geometry><box size="0.008 0.02 0.03"/></geometry></visual></link>
<joint name="{side}_tip_joint" type="revolute"><parent link="{side}_bar"/><child link="{side}_tip"/>
<origin xyz="0 0 0.05"/><axis xyz="0 {s} 0"/><mimic joint="left_bar_joint" multiplier="-1"/></joint>"""


def arc_urdf(folder: Path) -> Path:
    """Fingertips 8 x 20 x 30 mm that a bar of 50 mm swings outwards without turning them."""
    sides = (("left", -0.015, -1, -0.004, ""), ("right", 0.015, 1, 0.004, '<mimic joint="left_bar_joint"/>'))
    parts = [PART.format(side=n, x=x, s=s, out=out, mimic=m) for n, x, s, out, m in sides]
    path = folder / "arc.urdf"
    path.write_text(URDF.format(parts="\n".join(parts)))
    return path


def test_an_arc_of_a_urdf_is_the_jaws_motion(tmp_path: Path):
    made = gripper_from_cad([arc_urdf(tmp_path)]).gripper
    # x = 15 mm + 50 mm sin q, z = 50 mm cos q, and the tips are drawn at q = 0.35.
    assert (made.jaw_min_m, made.jaw_max_m) == pytest.approx((0.03, 0.03 + 0.1 * np.sin(0.7)), abs=MICROMETRE)
    inner = made.points_grip_m()[:, 0][made.point_finger == 1].min()
    assert inner == pytest.approx(0.015 + 0.05 * np.sin(0.35), abs=MICROMETRE)
    for q in np.linspace(0.0, 0.7, 29):
        moved = made.points_grip_m(min(max(0.03 + 0.1 * np.sin(q), made.jaw_min_m), made.jaw_max_m))
        way = moved - made.points_grip_m()
        x, z = 0.05 * (np.sin(q) - np.sin(0.35)), 0.05 * (np.cos(q) - np.cos(0.35))
        np.testing.assert_allclose(way[made.point_finger == 0], np.tile([-x, 0, z], (8, 1)), atol=5 * MICROMETRE)
        np.testing.assert_allclose(way[made.point_finger == 1], np.tile([x, 0, z], (8, 1)), atol=5 * MICROMETRE)
    assert np.ptp(made.points_grip_m()[made.point_finger == 0], axis=0) == pytest.approx([0.008, 0.02, 0.03], abs=1e-7)


def test_fingers_that_turn_are_refused(tmp_path: Path):
    path = arc_urdf(tmp_path)
    path.write_text(path.read_text().replace('multiplier="-1"', 'multiplier="0.5"'))
    with pytest.raises(InputError, match=r"finger 'left_bar' turns by .* while joint 'left_bar_joint' moves"):
        gripper_from_cad([path])


def tangent_line_z(radius_m: float, eye: np.ndarray, near: bool) -> tuple[float, float]:
    """y and z where the eye's sight touches a tip's rounding on its near (-y) or far side, by numbers."""
    turn = np.linspace(0.0, 0.5 * np.pi, 200_001)
    side = -1.0 if near else 1.0
    y = side * (0.008 - radius_m + radius_m * np.cos(turn))
    z = -radius_m + radius_m * np.sin(turn)
    above = side * np.cos(turn) * (eye[1] - y) + np.sin(turn) * (eye[2] - z)
    k = int(np.argmin(np.abs(above)))
    return float(y[k]), float(z[k])


@pytest.mark.parametrize("radius_m", [0.002, 0.004, 0.008])
def test_a_rounded_tip_shows_the_line_that_sight_touches_and_it_wanders(tmp_path: Path, radius_m: float):
    made = gripper_from_cad(write_meshes(rounded_fingers(radius_m), tmp_path), unit="mm", **seen())
    gripper = made.gripper
    for tcp_m in ((0.0004, 0.0013, 0.115), (0.0004, 0.02, 0.1)):  # the second 10 degrees to the side
        eye = invert(nominal_cam_T_grip(tcp_m=tcp_m))[:3, 3]
        points = gripper.points_grip_m(None, eye)
        y, z = tangent_line_z(radius_m, eye, near=True)
        for finger in (0, 1):
            ends = points[gripper.edge_points[gripper.edge_finger == finger]]
            across = np.abs(ends[:, 1, 0] - ends[:, 0, 0]) > 0.009
            (line,) = ends[across & (np.abs(ends[:, :, 1].mean(axis=1) - y) < 0.002)]
            # Mesh and view both are exact to some micrometres; a line that stood would be off by up to 0.3 mm.
            np.testing.assert_allclose(line[:, 1:], [[y, z], [y, z]], atol=25 * MICROMETRE)


@pytest.mark.parametrize("radius_m", [0.004, 0.008])
def test_the_rim_of_a_rounded_tip_stays_where_the_outline_wanders(tmp_path: Path, radius_m: float):
    """Its curves lie on the profile that the fingers were drawn with, also from 10 degrees aside."""
    gripper = gripper_from_cad(write_meshes(rounded_fingers(radius_m), tmp_path), unit="mm", **seen()).gripper
    curved = np.flatnonzero(gripper.edge_curved & ~gripper.edge_crease)
    assert len(curved)
    for tcp_m in ((0.0004, 0.0013, 0.115), (0.0004, 0.02, 0.1)):
        points = gripper.points_grip_m(None, invert(nominal_cam_T_grip(tcp_m=tcp_m))[:3, 3])
        on_rim = gripper.outlines_m(points, curved, 101).reshape(-1, 3)
        y, z = np.abs(on_rim[:, 1]), on_rim[:, 2]
        beside, above = np.maximum(y - (0.008 - radius_m), 0.0), np.maximum(z + radius_m, 0.0)
        np.testing.assert_allclose(np.hypot(beside, above), radius_m, atol=10 * MICROMETRE)


@pytest.mark.parametrize("bevel_m", [2e-4, 0.0])
def test_what_the_cad_draws_sharp_has_a_bevel_and_what_it_draws_round_its_shade(tmp_path: Path, bevel_m: float):
    """Only the line across a rounded tip is an outline of something round: 0.1 px of 8 to a millimetre."""
    settings = seen() if bevel_m else seen(bevel_m=0.0)
    gripper = gripper_from_cad(write_meshes(rounded_fingers(0.004), tmp_path), unit="mm", **settings).gripper
    ends = gripper.points_grip_m()[gripper.edge_points]
    round_ = (np.abs(ends[:, 1, 0] - ends[:, 0, 0]) > 0.009) & (ends[:, :, 2].max(axis=1) < 1e-3) & ~gripper.edge_crease
    assert np.count_nonzero(round_) == 2, "one a finger"
    np.testing.assert_allclose(gripper.edge_bevel_m[round_] / np.sqrt(12.0), 0.1 * 0.115 / 962.0, rtol=0.1)
    assert (gripper.edge_bevel_m[~round_] == bevel_m).all()


def test_what_is_too_short_to_be_measured_joins_the_edges_beside_it(tmp_path: Path):
    """Round a finger's outline each edge goes on in the next one, from side to side."""
    for radius_m in (0.002, 0.004, 0.008):
        gripper = gripper_from_cad(write_meshes(rounded_fingers(radius_m), tmp_path), unit="mm", **seen()).gripper
        places, same = np.unique(gripper.points_grip_m(), axis=0, return_inverse=True)
        ends = same.ravel()[gripper.edge_points[~gripper.edge_crease]]
        meeting = np.bincount(ends.ravel(), minlength=len(places))
        assert np.count_nonzero(meeting == 1) == 4, "the rear ends of two sides of each finger"
        assert meeting.max() == 2


def test_a_curved_finger_shows_its_sharp_edges_and_hides_what_is_behind(tmp_path: Path):
    made = gripper_from_cad(write_meshes(curved_fingers(), tmp_path), unit="mm", length_m=0.035, **seen())
    gripper = made.gripper
    assert not gripper.faces and gripper.edge_curved.any()
    points = gripper.outlines_m(gripper.points_grip_m(), np.arange(len(gripper.edge_ids)), 101).reshape(-1, 3)
    # All of them lie on the arcs of radius 60 and 52 mm, or at the tip, or at the rear end.
    radius = np.hypot(np.abs(points[:, 0]) - 0.015 - 0.06, points[:, 2])
    on_arc = np.minimum(np.abs(radius - 0.06), np.abs(radius - 0.052)) < 10 * MICROMETRE
    at_tip, at_back = np.abs(points[:, 2]) < 5 * MICROMETRE, points[:, 2] < -0.027
    assert (on_arc | at_tip | at_back).all()
    # From -y and behind: of the far side (+y) only the inner border shows.
    far = (points[:, 1] > 0.0069) & ~at_back & ~at_tip
    assert far.any() and (np.abs(radius[far] - 0.06) < 10 * MICROMETRE).all()


def test_an_open_surface_is_taken_and_said(tmp_path: Path):
    mesh = box_meshes(sharp_gripper())[0]
    mesh.update_faces(mesh.triangles_center[:, 2] > -0.0399)
    made = gripper_from_cad(write_meshes([mesh], tmp_path), unit="mm", frame="cad", **seen())
    assert any("the surface is open (4 sides of triangles have no neighbour)" in note for note in made.notes)
    box = sharp_gripper().points_grip_m()[sharp_gripper().point_finger == 0]
    away = np.linalg.norm(made.gripper.points_grip_m()[:, None] - box, axis=2).min(axis=1)
    corner = made.gripper.corner_points
    assert away[corner].max() < 2 * MICROMETRE


def test_many_triangles_give_the_same_edges(tmp_path: Path):
    mesh = box_meshes(sharp_gripper())[0]
    for _ in range(5):
        mesh = mesh.subdivide()
    assert len(mesh.faces) == 12 * 4**5
    (path,) = write_meshes([mesh], tmp_path)
    made = gripper_from_cad([path], unit="mm").gripper
    few = gripper_from_cad(write_meshes(box_meshes(sharp_gripper())[:1], tmp_path), unit="mm").gripper
    np.testing.assert_allclose(ends_of(made), ends_of(few), atol=2 * MICROMETRE)


# --- bad input: one line each ---


def from_cad(*words: str | Path) -> int:
    return main(["gripper", "from-cad", *map(str, words)])


def test_a_mesh_without_a_unit_asks_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (path,) = write_meshes(box_meshes(sharp_gripper())[:1], tmp_path)
    assert from_cad(path, "--out", tmp_path / "g.yaml") == 2
    said = capsys.readouterr().err
    assert "--unit: is missing" in said and "in m: 40000 mm long, in cm: 400 mm long, in mm: 40 mm long" in said
    assert from_cad(path, "--unit", "m", "--out", tmp_path / "g.yaml") == 2
    assert "would be 40000 mm long" in capsys.readouterr().err
    assert not (tmp_path / "g.yaml").exists()


def test_a_round_finger_without_a_view_asks_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    paths = write_meshes(rounded_fingers(0.004), tmp_path)
    assert from_cad(*paths, "--unit", "mm", "--out", tmp_path / "g.yaml") == 2
    assert "--camera: is missing: finger 'left' is round in parts" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.stl", "nonsense", "cut off"),
        ("a.step", "", "is not a format of CAD that is read here"),
        ("a.urdf", "<robot", "can't be read as URDF"),
        ("a.urdf", "<robot name='x'><link name='a'/></robot>", "no link has a geometry"),
        ("a.urdf", "<robot xmlns:xacro='x'><xacro:macro name='y'/></robot>", "holds xacro macros; expand it first"),
        ("a.cao", "V2\n", "doesn't begin with V1"),
        ("a.cao", "V1\n3\n0 0 0\n1 0\n", "line 4: '1 0' is not a point; 3 ordinary numbers"),
        ("a.cao", "V1\n3\n0 0 0\n.1 0 0\n0 .1 0\n0\n0\n1\n3 0 1 7\n", "line 9: "),
        ("a.cao", "V1\n2\n0 0 0\n0 0 .1\n0\n0\n0\n1\n0 2 .01\n", "line 9: names a point that isn't there"),
        ("a.cao", "V1\n2\n0 0 0\n0 0 .1\n1\n0 1\n", "line 6: has no faces; the surface of a finger"),
    ],
)
def test_files_that_cannot_be_read_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: str, said: str
):
    path = tmp_path / name
    path.write_text(content)
    assert from_cad(path, "--unit", "mm", "--out", tmp_path / "g.yaml") == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "Traceback" not in error


def test_a_mesh_that_is_cut_off_and_a_length_in_millimetres_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (whole,) = write_meshes(box_fingers()[:1], tmp_path)
    (tmp_path / "half.stl").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    for words, said in (
        ((tmp_path / "half.stl",), "cut off"),  # by which words depends on the libraries
        ((whole, "--length", "40"), "--length: 40 m: is not a finger's length; metres, such as 0.04"),
    ):
        assert from_cad(*words, "--unit", "mm", "--out", tmp_path / "g.yaml") == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_the_command_writes_a_file_that_loads_and_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    paths = write_meshes(rounded_fingers(0.004), tmp_path)
    camera = tmp_path / "camera.yaml"
    camera.write_text(
        "model: paper\nwidth_px: 768\nheight_px: 576\nfx_px: 962.0\nfy_px: 962.0\ncx_px: 383.5\ncy_px: 287.5\n"
        "kappa_per_px2: 1.9e-7\n"
    )
    out, picture = tmp_path / "g.yaml", tmp_path / "g.png"
    words = ("--unit", "mm", "--jaw-range", "0:0.06", "--camera", camera, "--view", "0.115:32", "--picture", picture)
    assert from_cad(*paths, *words, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "jaw: 0.0 to 60.0 mm, in the file 34.0 mm" in printed and f"written: {out}" in printed
    gripper = read_gripper(out)
    assert any("round" in line for line in out.read_text().splitlines()) and gripper.jaw_max_m == 0.06
    assert picture.stat().st_size > 10_000
    assert from_cad(*paths, *words, "--out", out) == 2
    assert "is there already" in capsys.readouterr().err


def test_the_command_says_what_the_bevels_of_sharp_edges_cost_and_who_takes_it_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    paths, out = write_meshes(box_meshes(sharp_gripper()), tmp_path), tmp_path / "g.yaml"
    for words, width_m, said in (
        ((), 2e-4, "note: sharp edges may be broken by 0.2 mm (bevel_m), which makes bounds wide, mostly too wide"),
        (("--bevel", "5e-5"), 5e-5, "until gripmon teach has measured how the edges really show"),
        (("--bevel", "0"), 0.0, "note: sharp edges are taken as exact: were they broken by 0.1 mm"),
    ):
        assert from_cad(*paths, "--unit", "mm", *words, "--out", out, "--force") == 0
        assert said in capsys.readouterr().out and said.removeprefix("note: ") in out.read_text()
        assert (read_gripper(out).edge_bevel_m == width_m).all()
    for wrong in ("0.2", "-0.0001", "nan"):
        assert from_cad(*paths, "--unit", "mm", f"--bevel={wrong}", "--out", out, "--force") == 2
        assert capsys.readouterr().err.endswith(" m: is not a bevel's width; 0 to 0.02 m\n")
    with pytest.raises(SystemExit, match="2"):
        from_cad(*paths, "--unit", "mm", "--bevel", "wide", "--out", out, "--force")
    assert "'wide' isn't the width of a bevel; metres, e.g. 0.0002" in capsys.readouterr().err


def test_a_mesh_named_twice_and_one_as_small_as_none_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    left, right = write_meshes(box_meshes(sharp_gripper()), tmp_path)
    assert from_cad(left, right, left, "--unit", "mm", "--out", tmp_path / "g.yaml") == 2
    assert f"{left}: is named twice; a mesh for each finger" in capsys.readouterr().err
    for mesh in box_meshes(sharp_gripper()):
        mesh.apply_scale(1.0 / 25.4)  # inches, read as millimetres
        assert from_cad(*write_meshes([mesh], tmp_path), "--unit", "mm", "--out", tmp_path / "g.yaml", "--force") == 0
        assert "a finger of 1.6 mm: is its unit right?" in capsys.readouterr().out
    assert from_cad(*write_meshes([mesh], tmp_path), "--unit", "in", "--out", tmp_path / "g.yaml", "--force") == 0
    assert "unit" not in capsys.readouterr().out
    words = ("--camera", tmp_path / "g.yaml", "--view", "0.12:30")
    assert from_cad(right, "--unit", "mm", *words, "--out", tmp_path / "other.yaml") == 2
    assert "g.yaml: holds no calibration, it is a gripper file; a file of gripmon cal" in capsys.readouterr().err


def test_a_gripper_of_two_meshes_is_not_named_after_one_of_its_fingers(tmp_path: Path):
    paths = write_meshes(box_meshes(sharp_gripper()), tmp_path)
    for words, name in (((), "hand"), (("--name", "mine"), "mine")):
        assert from_cad(*paths, "--unit", "mm", *words, "--out", tmp_path / "hand.yaml", "--force") == 0
        assert read_gripper(tmp_path / "hand.yaml").name == name


def test_without_trimesh_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    (tmp_path / "a.stl").write_text("solid")
    with pytest.raises(InputError, match=r"needs the package trimesh; pip install 'gripmon\[cad\]'"):
        gripmon.gripper_from_cad([tmp_path / "a.stl"], unit="mm")


def test_a_skewed_face_of_a_cao_becomes_triangles(tmp_path: Path):
    path = tmp_path / "a.cao"
    path.write_text(
        "V1\n8\n0 0 0\n.02 0 0\n.02 .02 0\n0 .02 0\n0 0 .03\n.02 0 .03\n.02 .02 .035\n0 .02 .03\n0\n0\n6\n"
        "4 0 3 2 1\n4 0 1 5 4\n4 1 2 6 5\n4 2 3 7 6\n4 3 0 4 7\n4 4 5 6 7\n"
    )
    made = gripper_from_cad([path], frame="cad", **seen(cam_T_grip=nominal_cam_T_grip(150.0, (0.0, 0.0, 0.15))))
    assert len(made.gripper.edge_ids) >= 3
    assert made.gripper.points_grip_m().max() <= 0.0351


def test_a_cylinder_of_a_cao_shows_as_that_of_a_mesh(tmp_path: Path):
    """Round, with a disc of the same size before its end, by ViSP's words."""
    (tmp_path / "a.cao").write_text(
        "V1\n5\n0 0 -.04\n0 0 0\n0 0 .001\n.006 0 .001\n0 .006 .001\n0 # lines\n0\n0\n1 # cylinders\n0 1 .006\n"
        "1 # circles\n.006 2 3 4\n"
    )
    rod = trimesh.creation.cylinder(6.0, segment=[[0, 0, -40], [0, 0, 0]], sections=96)
    disc = trimesh.creation.cylinder(6.0, segment=[[0, 0, 0.999], [0, 0, 1.001]], sections=96)
    trimesh.util.concatenate([rod, disc]).export(tmp_path / "a.stl")
    view = seen(frame="cad", approach="+z")
    made = gripper_from_cad([tmp_path / "a.cao"], body="all", **view).gripper
    known = gripper_from_cad([tmp_path / "a.stl"], unit="mm", body="all", **view).gripper
    for gripper in (made, known):  # both sides of the rod, from end to end
        ends = gripper.points_grip_m()[gripper.edge_points]
        along = ends[np.abs(ends[:, 0, 2] - ends[:, 1, 2]) > 0.03]
        assert len(along) == 2
        np.testing.assert_allclose(np.linalg.norm(along[:, :, :2], axis=2), 0.006, atol=10 * MICROMETRE)


def test_a_finger_mesh_of_another_renderer_profile(tmp_path: Path):
    """A wedge: what isn't square comes back as well."""
    profile = np.array([[0.005, -0.03], [0.003, 0.0], [-0.003, 0.0], [-0.008, -0.03]])
    mesh = finger_mesh(profile, (-0.004, 0.004))
    made = gripper_from_cad(write_meshes([mesh], tmp_path), unit="mm", frame="cad").gripper
    want = np.array([[x, y, z] for x in (-0.004, 0.004) for y, z in profile])
    away = np.linalg.norm(made.points_grip_m()[:, None] - want, axis=2).min(axis=1)
    assert len(made.points_grip_m()) == 8 and away.max() < 2 * MICROMETRE
