"""A gripper file from images at several jaw openings that no table says: fingers told apart, and placed, by motion."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from support.changing_backgrounds import CAMERA, beside_truth_px, images_of, made_of, moving_robot
from support.grippers import gripper_from_dict
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip

from gripmon.judge.policy import PolicySettings
from gripmon.model.errors import NoResultError
from gripmon.model.geometry import from_record, invert, to_record
from gripmon.model.gripper import Gripper
from gripmon.model.poses import perturbation_between
from gripmon.model.records import Array, Frame, Image, ReferenceRecord
from gripmon.monitor import Monitor
from gripmon.monitor.settings import MonitorSettings
from gripmon.teach.fingers import UnclearPartsError
from gripmon.teach.from_images import GripperFromImages, _groups, _see_openings, gripper_from_images
from gripmon.teach.matte import grey_levels, image_sets

DISTANCE = (0.115, 5e-5)
GAP_M, LENGTH_M = 0.034, 0.06
POSE = nominal_cam_T_grip()

pytestmark = pytest.mark.usefixtures("tools_importable")


def tapered() -> list[Any]:
    """Two fingers 6 x 6 mm at their tips and 16 x 12 mm where they are hidden by the image's border."""
    import trimesh

    out = []
    for side in (-1.0, 1.0):
        at = [
            [side * 0.5 * (GAP_M + 0.006) + x * width, y * thick, z]
            for z, width, thick in ((0.0, 0.006, 0.006), (-LENGTH_M, 0.016, 0.012))
            for x in (-0.5, 0.5)
            for y in (-0.5, 0.5)
        ]
        out.append(trimesh.convex.convex_hull(np.array(at)))
    return out


def offsets_m(gap_m: float) -> list[Array]:
    """Of both fingers at a gap between them."""
    return [np.array([0.5 * side * (gap_m - GAP_M), 0.0, 0.0]) for side in (-1.0, 1.0)]


def chains_of(found: GripperFromImages) -> list:
    return [chain for finger in found.seen.fingers for chain in finger.chains]


@lru_cache(maxsize=1)
def tapered_found() -> GripperFromImages:
    from benchmarks.meshes import MeshCamera

    pictures = MeshCamera(CAMERA, tapered(), 7)
    gaps_m = [GAP_M] * 20 + [0.022] * 10
    order = np.random.default_rng(3).permutation(len(gaps_m))
    images = [pictures.picture(POSE, offsets_m(gaps_m[k])) for k in order]
    return gripper_from_images(images, PAPER_LENS, distance_m=DISTANCE)


def test_tapered_fingers_are_placed_by_how_they_move() -> None:
    """Their long edges don't meet in one point, so that perspective doesn't tell."""
    import trimesh
    from benchmarks.meshes import MeshCamera

    found, meshes = tapered_found(), tapered()
    away = beside_truth_px(chains_of(found), MeshCamera(CAMERA, meshes).coverage(POSE))
    assert len(away) > 300 and np.quantile(away, 0.95) <= 0.2
    assert found.seen.matte.images.shape[0] == 20
    # Given was the distance of the tips' middle, which lies between the corners that face each other.
    scale = DISTANCE[0] / found.cam_T_grip[2, 3]
    points = found.gripper.points_grip_m() @ found.cam_T_grip[:3, :3].T + found.cam_T_grip[:3, 3]
    for finger, mesh in enumerate(meshes):
        own = points[found.gripper.point_finger == finger] * scale
        true = trimesh.Trimesh(mesh.vertices @ POSE[:3, :3].T + POSE[:3, 3], mesh.faces)
        depth = depth_of_outline(true, own)
        assert np.abs(own[:, 2] / depth - 1.0).max() < 0.08
    # Two corners of a tip lie 3 % of the distance behind each other; whichever of them the outline shows counts.
    assert abs(found.gripper.jaw_nominal_m / GAP_M - 1.0) < 0.05
    # The images show 12 mm of travel, and as much to either side isn't excluded.
    moved_m = found.gripper.jaw_max_m - found.gripper.jaw_min_m
    assert abs(moved_m / 0.036 - 1.0) < 0.05
    assert any("move equally far" in note for note in found.notes) and not any("flat" in note for note in found.notes)


def depth_of_outline(mesh: Any, points: Array) -> Array:
    """Depth (n,) of the mesh's edge that shows nearest to each point, camera frame."""
    ends = mesh.vertices[mesh.edges_unique]
    share = np.linspace(0.0, 1.0, 400)[:, None, None]
    along = (ends[:, 0] + share * (ends[:, 1] - ends[:, 0])).reshape(-1, 3)
    shown, wanted = along[:, :2] / along[:, 2:], points[:, :2] / points[:, 2:]
    at = np.linalg.norm(shown[None] - wanted[:, None], axis=2).argmin(axis=1)
    return np.asarray(along[at, 2])


def test_tapered_fingers_are_tracked_before_other_backgrounds() -> None:
    from benchmarks.meshes import MeshCamera, wandering

    found, pictures = tapered_found(), MeshCamera(CAMERA, tapered(), 99)
    flat = tuple(found.covariance.ravel().tolist())
    reference = ReferenceRecord("made", 1, 0, "configuration", to_record(found.cam_T_grip), flat)
    # Their tilt is known to three degrees only, so that a bound on the absolute rotation is 16.
    settings = MonitorSettings(policy=PolicySettings(alert_limit_rad=0.3))
    monitor = Monitor(CAMERA, found.gripper, settings, reference)
    true_T_made = invert(POSE) @ found.cam_T_grip
    errors, frames = [], 40
    for k in range(frames):
        truth = wandering(POSE, k / frames, 0.001, 0.005)
        image = pictures.picture(truth, offsets_m(GAP_M))
        record = monitor.process(Frame(k, k * 33_000_000, image, found.opening_m, ""))
        monitor.run_pending()
        if record.verdict.value == "valid":
            errors.append(perturbation_between(truth @ true_T_made, from_record(record.cam_T_grip)))
            assert record.protection is not None
            assert np.linalg.norm(errors[-1][:3]) <= record.protection.position_m
    assert len(errors) >= 0.75 * (frames - 1)
    assert np.quantile(np.abs(np.array(errors)[:, :2]), 0.95) < 8e-5
    assert np.quantile(np.abs(np.array(errors)[:, 2]), 0.95) < 1.5e-4


def test_a_refusal_names_an_image_of_the_opening_that_it_is_about() -> None:
    def see(images: Any) -> Any:
        if images[0].min() > 0:
            raise UnclearPartsError("unclear", [], np.zeros((4, 4), bool))
        return SimpleNamespace(left_out={})

    grey, groups = [np.full((4, 4), k, np.float32) for k in (0, 0, 1, 1)], {0.03: [0, 1], 0.02: [2, 3]}
    with pytest.raises(UnclearPartsError, match="from c to d; of them unclear") as caught:
        _see_openings(see, grey, {opening: own * 3 for opening, own in groups.items()}, "abcd", [], {}, "")
    assert caught.value.image == 2


def test_of_fingers_whose_tips_end_differently_the_outline_lies_right_at_every_opening() -> None:
    """Perspective takes both tips to end equally far out: one that is 12 mm shorter would be 9 % too near."""
    from benchmarks.meshes import MeshCamera, box_fingers
    from benchmarks.outlines import points_on, projected_outline

    meshes = box_fingers()
    meshes[1].apply_translation([0.0, 0.0, -0.012])
    pictures = MeshCamera(CAMERA, meshes, 5)
    gaps_m = [GAP_M] * 8 + [0.024] * 8
    images = [pictures.picture(POSE, offsets_m(gap)) for gap in gaps_m]
    found = gripper_from_images(images, PAPER_LENS, openings_m=gaps_m)
    for gap in set(gaps_m):
        lines = projected_outline(found.gripper, CAMERA, found.cam_T_grip, gap)
        written = points_on(lines, (CAMERA.width_px, CAMERA.height_px))
        true = silhouette_px(pictures.coverage(POSE, offsets_m(gap)))
        away = [np.linalg.norm(true - point, axis=1).min() for point in written]
        assert len(away) > 800 and np.quantile(away, 0.95) < 0.2
    # How the jaws move is where x points: what one camera can't tell of that is in the reference's covariance.
    off = perturbation_between(POSE, found.cam_T_grip)[3:]
    assert (np.abs(off) < 2.0 * np.sqrt(np.diag(found.covariance)[3:])).all()


def silhouette_px(coverage: Array) -> Array:
    """Points (n, 2) where half of a pixel is covered, to an eighth of it."""
    fine = cv2.resize(coverage, None, fx=8.0, fy=8.0, interpolation=cv2.INTER_LINEAR) > 0.5
    found, _ = cv2.findContours(fine.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray((np.vstack([contour[:, 0] for contour in found]) + 0.5) / 8.0 - 0.5)


def test_one_finger_has_an_outline_and_says_what_is_taken_for_granted() -> None:
    from benchmarks.meshes import MeshCamera

    pictures = MeshCamera(CAMERA, tapered()[:1], 5)
    images = [pictures.picture(POSE) for _ in range(12)]
    with pytest.raises(UnclearPartsError, match="--fingers 1"):
        made_of(images, PAPER_LENS, distance_m=DISTANCE)
    found = made_of(images, PAPER_LENS, distance_m=DISTANCE, fingers=1)
    assert found.gripper.finger_ids == ("finger",) and not found.gripper.has_jaw
    away = beside_truth_px(chains_of(found), pictures.coverage(POSE))
    assert len(away) > 150 and np.quantile(away, 0.95) <= 0.2
    assert any("parallel" in note or "flat" in note for note in found.notes)


def housed() -> Gripper:
    """Two box fingers whose roots a housing hides, across the whole image: what stays is one part."""
    model = yaml.safe_load(BOX_FINGERS.read_text())
    model["fingers"]["housing"] = {"motion": {"axis": [0.0, 0.0, 0.0]}}
    for i, x in enumerate((-0.04, 0.04)):
        for j, y in enumerate((-0.012, -0.0085)):
            for k, z in enumerate((-0.06, -0.03)):
                model["points"][f"H{i}{j}{k}"] = {"finger": "housing", "xyz_m": [x, y, z]}
    for loop in ("000 001 011 010", "100 110 111 101", "000 100 101 001", "010 011 111 110", "000 010 110 100",
                 "001 101 111 011"):  # fmt: skip
        names = [f"H{name}" for name in loop.split()]
        model["faces"].append({"finger": "housing", "points": names})
        for a, b in zip(names, names[1:] + names[:1], strict=True):
            if a < b:
                model["edges"][f"{a}{b}"] = {"from": a, "to": b}
    return gripper_from_dict(model)


def test_fingers_that_hang_together_in_the_image_are_told_apart() -> None:
    gripper = housed()
    images: list[Image] = []
    for seed, opening_m, count in ((501, 0.034, 14), (502, 0.024, 10)):
        images += images_of(moving_robot(seed, "printed", gripper=gripper, opening_m=opening_m), count)
    alone = made_of(images[:14], PAPER_LENS, distance_m=DISTANCE)
    assert alone.gripper.finger_ids == ("left", "right")
    found = made_of(images, PAPER_LENS, distance_m=DISTANCE)
    assert found.gripper.finger_ids == ("left", "right")
    assert any("joins the fingers" in note for note in found.notes)
    assert abs(found.gripper.jaw_nominal_m - 0.034) < 2e-4
    shown_m = [m for m in np.arange(0.014, 0.044, 1e-4).tolist() if found.gripper.beyond_m(m) == 0.0]
    assert abs(min(shown_m) - 0.024) < 3e-4 and abs(max(shown_m) - 0.034) < 3e-4
    apart = perturbation_between(POSE, found.cam_T_grip)
    sigma_rad = np.sqrt(np.diag(found.covariance)[3:])
    # Of the jaws' direction, about the fingers, motion tells less than perspective tells of theirs.
    assert np.abs(apart[:3]).max() < 4e-4 and sigma_rad[0] < np.radians(0.5) and sigma_rad.max() < np.radians(4.0)
    assert (np.abs(apart[3:]) < 3.0 * sigma_rad).all()


def test_openings_are_told_apart_without_a_table() -> None:
    images = [
        grey_levels(image)
        for seed, opening_m, count in ((401, 0.034, 16), (403, 0.030, 10), (405, 0.044, 12))
        for image in images_of(moving_robot(seed, "printed", opening_m=opening_m), count)
    ]
    order = np.random.default_rng(1).permutation(len(images)).tolist()
    wanted = [set(range(16)), set(range(26, 38)), set(range(16, 26))]
    sets = image_sets([images[k] for k in order])
    assert [{order[k] for k in own} for own in sets] == wanted
    assert image_sets(images[:16]) == [list(range(16))]


def test_plain_fingers_before_views_of_one_room_are_told_apart() -> None:
    """Ten images of each opening before parts of three walls, by which two images are more alike than by fingers."""
    rng = np.random.default_rng(0)
    walls = np.full((3, 700, 900), 90.0, np.float32)
    for wall in walls:
        for _ in range(150):
            x, y, width, height = rng.integers((0, 0, 30, 30), (900, 700, 160, 160)).tolist()
            wall[y : y + height, x : x + width] = rng.uniform(20.0, 230.0)
    images = []
    for k in range(20):
        left, top = rng.integers((0, 0), (260, 220)).tolist()
        image = walls[rng.integers(3), top : top + 480, left : left + 640].copy()
        for x in ((200, 400), (230, 370))[k // 10]:
            image[390:, x : x + 30] = 120.0
        images.append(image + rng.normal(0.0, 2.0, image.shape).astype(np.float32))
    order = rng.permutation(20).tolist()
    sets = image_sets([images[k] for k in order])
    assert sorted(sorted(order[k] for k in own) for own in sets) == [list(range(10)), list(range(10, 20))]


def test_a_slow_video_of_one_opening_is_one_set() -> None:
    """Three times a camera stays before about the same view, which then stays in a third of the images."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.normal(size=(700, 900)), (0, 0), 3.0)
    texture = (110.0 + 25.0 * texture / texture.std()).astype(np.float32)
    images = []
    for k in range(36):
        left, top = 200 * (k // 12) + rng.integers(0, 12), 10 + k
        image = texture[top : top + 240, left : left + 320].copy()
        image[140:, 80:120] = image[140:, 200:240] = 230.0
        images.append(image + rng.normal(0.0, 1.0, image.shape).astype(np.float32))
    assert image_sets(images) == [list(range(36))]


def test_a_camera_that_moved_between_sets_of_images_is_refused() -> None:
    moved = nominal_cam_T_grip(tcp_m=(0.006, 0.0013, 0.115))
    images = images_of(moving_robot(601, "printed"), 12) + images_of(moving_robot(602, "printed", cam_T_grip=moved), 11)
    with pytest.raises(NoResultError, match=r"sets of 12 and 11.*the camera moved") as caught:
        made_of(images, PAPER_LENS, distance_m=DISTANCE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("counts", "first"),
    [
        ({0.022: 8, 0.036: 8, 0.05: 8}, 0.05),
        ({0.022: 12, 0.036: 8, 0.05: 6}, 0.05),
        ({0.022: 20, 0.036: 10, 0.05: 9}, 0.036),  # of too few images an outline is known worse
        ({0.022: 7, 0.05: 4}, 0.022),
    ],
)
def test_what_is_seen_begins_with_the_widest_opening_that_has_images_enough(
    counts: dict[float, int], first: float
) -> None:
    """Where fingers touch or overlap, less shows of them."""
    groups = _groups([opening for opening, count in counts.items() for _ in range(count)], ())
    assert next(iter(groups)) == first and {m: len(own) for m, own in groups.items()} == counts
