"""Which bodies are fingers, how they move, and along which axes: small URDFs and meshes whose numbers are plain."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.simulated import PAPER_LENS, nominal_cam_T_grip

from gripmon.cli import main
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import make_camera
from gripmon.model.errors import InputError
from gripmon.teach.cad import CadGripper, gripper_from_cad
from tools.benchmarks.meshes import rounded_fingers, write_meshes

CASES = Path(__file__).resolve().parents[2] / "shared" / "findings" / "2026-11-27" / "public_cases"
VIEW = {"camera": make_camera(PAPER_LENS), "cam_T_grip": nominal_cam_T_grip()}


def box(name: str, size: str, at: str = "0 0 0") -> str:
    shape = f'<origin xyz="{at}"/><geometry><box size="{size}"/></geometry>'
    return f'<link name="{name}"><visual>{shape}</visual></link>'


def joint(name: str, kind: str, ends: str, axis: str, limits: str, origin: str = "", mimic: str = "") -> str:
    parent, child = ends.split()
    low, high = limits.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{origin}'
        f'<axis xyz="{axis}"/><limit effort="1"/><limit lower="{low}" upper="{high}"/>{mimic}</joint>'
    )


BASE = box("base", "0.12 0.05 0.06", "0 0 -0.03")
JAWS = box("left", "0.010 0.016 0.05", "-0.005 0 0.025") + box("right", "0.010 0.016 0.05", "0.005 0 0.025")
LEFT = joint("a", "prismatic", "base left", "1 0 0", "-0.050 -0.002")
TURNED = '<origin rpy="0 0 3.14159"/>'
RIGHT = {
    "limits mirrored": joint("b", "prismatic", "base right", "1 0 0", "0.002 0.050"),
    "axis mirrored": joint("b", "prismatic", "base right", "-1 0 0", "-0.050 -0.002"),
    "mimic": joint("b", "prismatic", "base right", "1 0 0", "0 0", mimic='<mimic joint="a" multiplier="-1"/>'),
    "frame turned": joint("b", "prismatic", "base right", "-1 0 0", "0.002 0.050", TURNED),
}


def write(folder: Path, *parts: str) -> Path:
    path = folder / "hand.urdf"
    path.write_text(f'<robot name="hand">{"".join(parts)}</robot>')
    return path


def parallel(folder: Path, how: str = "limits mirrored", *more: str) -> Path:
    jaws = JAWS.replace('xyz="0.005', 'xyz="-0.005') if how == "frame turned" else JAWS
    return write(folder, BASE, jaws, LEFT, RIGHT[how], *more)


def inner_sides_m(made: CadGripper, opening_m: float) -> list[float]:
    """The largest x of the left finger and the smallest of the right one."""
    x, finger = made.gripper.points_grip_m(opening_m)[:, 0], made.gripper.point_finger
    return [float(x[finger == 0].max()), float(x[finger == 1].min())]


def says(made: CadGripper, words: str) -> bool:
    return any(words in note for note in made.notes)


@pytest.mark.parametrize("how", RIGHT)
@pytest.mark.parametrize("chosen", [None, "a"])
def test_sibling_jaws_are_a_pair_however_the_urdf_mirrors_them(tmp_path: Path, how: str, chosen: str | None):
    made = gripper_from_cad([parallel(tmp_path, how)], joint=chosen)
    assert made.gripper.finger_ids == ("left", "right") and made.origins == ("left", "right")
    assert (made.gripper.jaw_min_m, made.gripper.jaw_max_m) == pytest.approx((0.004, 0.100), abs=1e-6)
    assert says(made, "z points along +z of the CAD frame, x along +x, from finger left to right")
    assert says(made, "between the fingertips is (0, 0, 0.05) m of the CAD frame: the TCP")
    for opening_m in (0.004, 0.052, 0.100):
        assert inner_sides_m(made, opening_m) == pytest.approx([-opening_m / 2, opening_m / 2], abs=1e-6)
    assert says(made, "joint 'b' opens the jaws together with 'a'") == (chosen == "a" and how != "mimic")


def test_a_joint_that_leaves_a_finger_out_is_refused_and_what_it_names_helps(tmp_path: Path):
    shorter = RIGHT["limits mirrored"].replace("0.050", "0.030")
    path = write(tmp_path, BASE, JAWS, LEFT, shorter)
    with pytest.raises(InputError, match=r"joint: is missing: .* has 2 joints that move by themselves; one of a, b"):
        gripper_from_cad([path])
    with pytest.raises(
        InputError, match=r"leaves out link 'right', which joint 'b' moves; a,b if both .*, or a,b=POSI"
    ):
        gripper_from_cad([path], joint="a")
    both = gripper_from_cad([path], joint="a,b").gripper
    assert (both.jaw_min_m, both.jaw_max_m) == pytest.approx((0.004, 0.080), abs=1e-6)
    one = gripper_from_cad([path], joint="a,b=0.01")
    assert one.gripper.finger_ids == ("left", "right")
    assert (one.gripper.jaw_min_m, one.gripper.jaw_max_m) == pytest.approx((0.012, 0.060), abs=1e-6)
    right = one.gripper.point_finger == 1
    still = [one.gripper.points_grip_m(opening_m)[right] for opening_m in (0.012, 0.060)]
    np.testing.assert_allclose(still[0], still[1], atol=1e-9)
    for wrong, said in (("a,b=x", "'b=x' isn't NAME=POSITION"), ("c", "no such joint that drives others; one of a, b")):
        with pytest.raises(InputError, match=re.escape(said)):
            gripper_from_cad([path], joint=wrong)


def test_an_arm_asks_for_the_joint_at_once_and_isnt_read(tmp_path: Path):
    """Its meshes aren't even there; the frame is that of the link that carries the hand."""
    arm = '<link name="arm"><visual><geometry><mesh filename="none.stl"/></geometry></visual></link>'
    turn = joint("turn", "revolute", "arm flange", "0 0 1", "-3 3", '<origin xyz="1 2 3" rpy="1 0 0"/>')
    fix = '<joint name="f" type="fixed"><parent link="flange"/><child link="base"/></joint>'
    path = parallel(tmp_path, "mimic", arm, '<link name="flange"/>', turn, fix)
    with pytest.raises(InputError, match=r"has 2 joints that move by themselves; one of .* \(a also leads others\)"):
        gripper_from_cad([path])
    made = gripper_from_cad([path], joint="a")
    assert made.gripper.jaw_max_m == pytest.approx(0.1) and says(made, "the CAD frame is that of link 'flange'")
    np.testing.assert_allclose(made.grip_T_cad[:3, :3], np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('mimic joint="a"', 'mimic joint="c"', "joint 'b': follows 'c'; a joint that follows no other"),
        ('<child link="left"/>', "", "joint 'a': has no parent or no child; a link each"),
        ('"prismatic"', '"planar"', "joint 'a': is of type 'planar'; fixed, prismatic"),
        ('upper="-0.002"', 'upper="-0.060"', "joint 'a': moves from -0.05 to -0.06; limit lower < upper"),
    ],
)
def test_a_urdf_with_a_wrong_joint_is_refused(tmp_path: Path, old: str, new: str, said: str):
    path = parallel(tmp_path, "mimic")
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=re.escape(said)):
        gripper_from_cad([path])


def test_given_axes_that_contradict_the_jaws_are_refused(tmp_path: Path):
    path = parallel(tmp_path)
    for axes, said in (
        ("+x", "the jaws move along it"),
        ("+z,+y", "the jaws don't move along +y"),
        ("+z,-x", "points from the right finger to the left one"),
    ):
        with pytest.raises(InputError, match=re.escape(f"approach: {axes}: {said}" if "," in axes else said)):
            gripper_from_cad([path], approach=axes)


def test_one_jaw_that_slides_towards_a_finger_that_stands(tmp_path: Path):
    made = gripper_from_cad([write(tmp_path, BASE, JAWS, LEFT, joint("f", "fixed", "base right", "1 0 0", "0 0"))])
    assert made.origins == ("left", "right")
    assert (made.gripper.jaw_min_m, made.gripper.jaw_max_m) == pytest.approx((0.002, 0.050), abs=1e-6)
    assert made.model.fingers["right"].motion is None
    palm_only = write(tmp_path, BASE, JAWS.split("</link>")[0] + "</link>", LEFT)
    alone = gripper_from_cad([palm_only])
    assert alone.gripper.finger_ids == ("finger",) and says(alone, "no link that stands reaches as far")


PIVOT = (
    box("hand", "0.010 0.016 0.09", "-0.020 0 0.045"),
    box("jaw", "0.010 0.016 0.06", "0.005 0 0.03"),
    joint("swing", "revolute", "hand jaw", "0 1 0", "0 1.7", '<origin xyz="-0.01 0 0.03"/>'),
)


def test_a_jaw_that_pivots_is_refused_and_is_right_at_each_position(tmp_path: Path):
    path = write(tmp_path, *PIVOT)
    said = "finger 'jaw' turns by 49 degrees .*; --joint swing=POSITION .* or --body LINK of a finger that stands"
    with pytest.raises(InputError, match=said):
        gripper_from_cad([path])
    for turned_rad in (0.1, 0.6, 1.2):
        made = gripper_from_cad([path], joint=f"swing={turned_rad}")
        assert made.origins == ("hand", "jaw") and not made.gripper.has_jaw and says(made, "the fingers stand as drawn")
        corners = np.array([[x, y, z] for x in (0.0, 0.01) for y in (-0.008, 0.008) for z in (0.0, 0.06)])
        known = Rotation.from_rotvec([0, turned_rad, 0]).apply(corners) + np.array([-0.01, 0, 0.03])
        found = (made.gripper.points_grip_m() - made.grip_T_cad[:3, 3]) @ made.grip_T_cad[:3, :3]
        away = np.linalg.norm(found[made.gripper.point_finger == 1][:, None] - known, axis=2).min(axis=1)
        assert len(away) == 8 and away.max() < 1e-6
        np.testing.assert_allclose(made.grip_T_cad[:3, :3], np.eye(3), atol=1e-9)
    stands = gripper_from_cad([path], body="hand")
    assert stands.origins == ("hand",) and says(stands, "what moves isn't in the file")
    np.testing.assert_allclose(stands.grip_T_cad[:3, :3], np.eye(3), atol=1e-9)


def test_a_jaw_that_pivots_on_a_palm_tells_no_axis(tmp_path: Path):
    for palm in ("0.06 0.06 0.06", "0.03 0.06 0.06"):
        path = write(tmp_path, box("hand", palm, "-0.01 0 0"), *PIVOT[1:])
        with pytest.raises(InputError, match=r"approach: is missing: .* tells none; .* --approach=[+-][xz] or"):
            gripper_from_cad([path], joint="swing=0.9")


def test_the_range_of_a_joint_is_cut_to_that_of_the_jaws(tmp_path: Path):
    overlapping = LEFT.replace("-0.002", "0.003")
    path = write(tmp_path, BASE, JAWS, overlapping, RIGHT["mimic"])
    with pytest.raises(InputError, match=r"closes the jaws 6.0 mm into each other; .* or --jaw-range 0:0.1000"):
        gripper_from_cad([path])
    made = gripper_from_cad([path], jaw_range_m=(0.0, 0.09))
    assert (made.gripper.jaw_min_m, made.gripper.jaw_max_m) == (0.0, 0.09)
    for opening_m in (0.0, 0.09):
        assert inner_sides_m(made, opening_m) == pytest.approx([-opening_m / 2, opening_m / 2], abs=1e-6)
    with pytest.raises(InputError, match=r"the joint opens the jaws from -0.0060 to 0.1000 m"):
        gripper_from_cad([path], jaw_range_m=(0.0, 0.2))


# --- bodies of one mesh ---


def meshed(
    folder: Path, *boxes: tuple[tuple[float, float, float], tuple[float, float, float]], name: str = "m"
) -> Path:
    """Boxes by size and middle, mm."""
    path = folder / f"{name}.stl"
    parts = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in boxes]
    trimesh.util.concatenate(parts).export(path)
    return path


PADDED = (((12, 20, 45), (0, 0, 22.5)), ((8, 20, 40), (10.3, 0, 29.5)))


def test_bodies_of_one_mesh_are_asked_for_not_guessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = meshed(tmp_path, *PADDED), tmp_path / "g.yaml"
    words = ["gripper", "from-cad", str(path), "--unit", "mm", "--out", str(out)]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "--body: is missing" in said and said.count("\n") == 1 and not out.exists()
    assert "2 bodies (1: 12.0 x 20.0 x 45.0 mm; 2: 8.0 x 20.0 x 40.0 mm)" in said
    for body in ("all", "1+2"):
        one = gripper_from_cad([path], unit="mm", body=body, frame="cad", **VIEW)
        assert one.gripper.finger_ids == ("finger",) and not says(one, "left out")
        assert np.ptp(one.gripper.points_grip_m()[:, 0]) == pytest.approx(0.0203, abs=1e-5)
    assert main([*words, "--body", "1,2"]) == 0
    assert f"left ({path}, body 1)" in capsys.readouterr().out and read_gripper(out).finger_ids == ("left", "right")
    assert says(gripper_from_cad([path], unit="mm", body="2"), "1 of 2 bodies are left out")
    for wrong in ("0", "3", "1,1", "1;2"):
        with pytest.raises(InputError, match=r"^body: "):
            gripper_from_cad([path], unit="mm", body=wrong)


def test_a_seam_is_no_second_body(tmp_path: Path):
    """A box whose lid's corners are 1 um off: exports do that."""
    mesh = trimesh.creation.box((10, 16, 40))
    lid = mesh.triangles_center[:, 2] > 19
    parts = [mesh.submesh([np.flatnonzero(own)], append=True) for own in (lid, ~lid)]
    trimesh.util.concatenate([parts[0].apply_translation([0, 0, 1e-3]), parts[1]]).export(tmp_path / "a.stl")
    assert len(gripper_from_cad([tmp_path / "a.stl"], unit="mm").gripper.faces) == 6


# --- axes ---

TALL = ((10, 16, 40), (-20, 0, 20))


def test_which_finger_is_left_is_said_and_x_goes_from_it_to_the_right_one(tmp_path: Path):
    at_plus = meshed(tmp_path, ((10, 16, 40), (20, 0, 20)), name="jaw_left")
    at_minus = meshed(tmp_path, TALL, name="jaw_right")
    made = gripper_from_cad([at_plus, at_minus], unit="mm", jaw_range_m=(0.0, 0.05))
    assert made.origins == ("jaw_left.stl", "jaw_right.stl")
    assert says(made, "x along -x, from finger left to right") and says(made, "the fingers move straight along x")
    assert made.summary()[0].startswith("left (jaw_left.stl): ")
    assert inner_sides_m(made, 0.05) == pytest.approx([-0.025, 0.025], abs=1e-6)


def test_axes_that_make_no_sense_are_refused(tmp_path: Path):
    """Fingers of two shapes, whose middles tell no direction; ends at different heights; lying fingers; a wide end."""
    one, other = meshed(tmp_path, TALL, name="a"), meshed(tmp_path, ((6, 30, 44), (10, 45, 22)), name="b")
    with pytest.raises(
        InputError, match=r"^approach: is missing: the fingers differ in shape, .* is \(0.55, 0.83, 0.00\)"
    ):
        gripper_from_cad([one, other], unit="mm")
    made = gripper_from_cad([one, other], unit="mm", approach="+z,+x")
    np.testing.assert_allclose(made.grip_T_cad[:3, :3], np.eye(3), atol=1e-12)
    alike = meshed(tmp_path, ((10, 16, 40), (10, 45, 20)), name="c")
    across = gripper_from_cad([one, alike], unit="mm").grip_T_cad[0, :3]
    np.testing.assert_allclose(across, [0.5547, 0.83205, 0.0], atol=1e-5)
    higher = meshed(tmp_path, ((10, 16, 40), (20, 0, 45)), name="d")
    with pytest.raises(InputError, match="the fingers end 25 mm from each other along it"):
        gripper_from_cad([one, higher], unit="mm")
    lying = meshed(tmp_path, ((10, 40, 16), (0, 0, 0)), name="e")
    with pytest.raises(InputError, match=r"a finger of 10.0 x 40.0 x 16.0 mm .* isn't longest along z; .* --approach"):
        gripper_from_cad([lying], unit="mm")
    assert says(gripper_from_cad([lying], unit="mm", approach="-y"), "z points along -y")
    points = [[x, y, z] for z, w in ((0, 2), (40, 10)) for x in (-w, w) for y in (-w, w)]
    trimesh.convex.convex_hull(np.array(points, dtype=float)).export(tmp_path / "f.stl")
    with pytest.raises(InputError, match="is wider at its upper end in z; the axis of the CAD frame out"):
        gripper_from_cad([tmp_path / "f.stl"], unit="mm")
    for wrong in ("z", "+z,+z", "+z,-z", "+z,+x,+y"):
        with pytest.raises(InputError, match="is not an axis; one of"):
            gripper_from_cad([lying], unit="mm", approach=wrong)


def test_the_cads_own_frame_keeps_its_axes_cut_and_moving(tmp_path: Path):
    """Fingers along -y that move along z: with a length, in the CAD's axes."""
    sizes = [((16, 40, 10), (5, 20, side * 20)) for side in (-1, 1)]
    paths = [meshed(tmp_path, each, name=f"m{k}") for k, each in enumerate(sizes)]
    made = gripper_from_cad(
        paths, unit="mm", frame="cad", approach="-y", length_m=0.03, jaw_range_m=(0.0, 0.06)
    )  # fmt: skip
    np.testing.assert_allclose(made.grip_T_cad, np.eye(4), atol=1e-12)
    for opening_m in (0.03, 0.05):
        points = made.gripper.points_grip_m(opening_m)[made.gripper.point_finger == 1]
        np.testing.assert_allclose(points.min(axis=0), [-0.003, 0.0, opening_m / 2], atol=1e-6)
        np.testing.assert_allclose(points.max(axis=0), [0.013, 0.03, opening_m / 2 + 0.01], atol=1e-6)


def test_a_view_of_the_cads_frame_shows_what_that_of_the_tips_shows(tmp_path: Path):
    paths = write_meshes([m.apply_translation([0.1, 0.2, 0.3]) for m in rounded_fingers(0.004)], tmp_path)
    stated = {"unit": "mm", "length_m": 0.035, "jaw_range_m": (0.0, 0.06)}
    tips = gripper_from_cad(paths, **stated, **VIEW)
    pose = VIEW["cam_T_grip"] @ tips.grip_T_cad
    cad = gripper_from_cad(paths, frame="cad", camera=VIEW["camera"], cam_T_grip=pose, **stated)
    assert cad.model.fingers == tips.model.fingers and list(cad.model.points) == list(tips.model.points)
    for eye in ([0.0, -0.06, -0.1], [0.01, -0.05, -0.11]):
        seen = [made.gripper.points_grip_m(0.02, grip_T_cad[:3, :3].T @ (np.array(eye) - grip_T_cad[:3, 3]))
                for made, grip_T_cad in ((tips, np.eye(4)), (cad, tips.grip_T_cad))]  # fmt: skip
        np.testing.assert_allclose(seen[1] @ tips.grip_T_cad[:3, :3].T + tips.grip_T_cad[:3, 3], seen[0], atol=2e-6)


# --- COLLADA ---

DAE = "<asset><unit meter='0.01'/><up_axis>Y_UP</up_axis></asset>"


def test_a_dae_is_read_in_its_own_unit_or_the_collision_mesh_is_used_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    stl = meshed(tmp_path, ((10, 16, 40), (0, 0, 20)), name="left")
    link = (
        '<link name="left"><visual><geometry><mesh filename="left.dae"/></geometry></visual><collision><geometry>'
        '<mesh filename="left.stl" scale="0.001 0.001 0.001"/></geometry></collision></link>'
    )
    path = write(tmp_path, BASE, link, LEFT)
    missing = gripper_from_cad([path])
    assert says(missing, "link 'left': its collision mesh is used") and says(missing, "its mesh 'left.dae' isn't there")
    if importlib.util.find_spec("collada") is not None:
        # Wider than the collision mesh, in centimetres.
        data = trimesh.creation.box((1.2, 1.6, 4.0)).apply_translation([0, 0, 2.0]).export(file_type="dae")
        (tmp_path / "left.dae").write_text(re.sub(r"(?s)<asset>.*?</asset>", DAE, data.decode()))
        read = gripper_from_cad([path])
        assert not says(read, "collision")
        assert np.ptp(read.gripper.points_grip_m(), axis=0) == pytest.approx([0.012, 0.016, 0.04], abs=1e-6)
        assert gripper_from_cad([tmp_path / "left.dae"]).gripper.finger_ids == ("finger",)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "collada" else find_spec(name))
    (tmp_path / "left.dae").touch()
    assert says(gripper_from_cad([path]), "left.dae: needs the package pycollada; pip install 'gripmon[cad]'")
    stl.unlink()
    with pytest.raises(InputError, match="needs the package pycollada"):
        gripper_from_cad([path])


# --- files of others ---


@pytest.mark.skipif(not CASES.is_dir(), reason="../shared/findings is not there")
def test_the_public_cases_give_their_right_values(tmp_path: Path):
    for chosen in (None, "jaw_left", "jaw_right"):
        made = gripper_from_cad(list(CASES.glob("12-*/gripper.urdf")), joint=chosen)
        assert made.gripper.finger_ids == ("left", "right") and says(
            made, "z points along +z of the CAD frame, x along +x"
        )
        assert (made.gripper.jaw_min_m, made.gripper.jaw_max_m) == pytest.approx((0.004, 0.1), abs=1e-6)
    (finger,) = CASES.glob("13-*/finger_with_pad.stl")
    with pytest.raises(InputError, match=r"^body: is missing"):
        gripper_from_cad([finger], unit="mm")
    one = gripper_from_cad([finger], unit="mm", body="all", **VIEW)
    assert np.ptp(one.gripper.points_grip_m()[:, 0]) == pytest.approx(0.0203, abs=1e-4)
    dae = gripper_from_cad(list(CASES.glob("14-*/gripper.urdf")))
    assert dae.gripper.finger_ids == ("left", "right") and dae.gripper.jaw_max_m == pytest.approx(0.08, abs=1e-6)
