"""How grey levels follow the light, as images show it, and what it means for a measurement when nobody knows."""

from __future__ import annotations

from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from support.changing_backgrounds import crossing_px, images_of, moving_robot

from gripmon.model.camera import BrownConradyLens, make_camera
from gripmon.model.errors import InputError
from gripmon.model.response import (
    TAUGHT_SIGMA_PX,
    UNKNOWN_SIGMA_PX,
    find_response,
    in_light,
    likely_linear,
    response_of,
)
from gripmon.simulate.disturbance import srgb_dn
from gripmon.simulate.scenario import Sensor
from gripmon.teach.from_images import gripper_from_images
from gripmon.track.edges import MeasurementSettings
from gripmon.track.edges.settings import EdgeSettings

TEACH = Path(__file__).resolve().parents[2] / "shared" / "data" / "mesh_aloha" / "teach"
GAMMA = {"linear": 1.0, "srgb": 2.2}


def test_light_is_what_srgb_encodes():
    light = np.linspace(0.0, 255.0, 1001, dtype=np.float32)
    encoded = srgb_dn(light)[None]
    np.testing.assert_allclose(in_light(encoded / 255.0, "srgb")[0], light / 255.0, atol=2e-6)
    eight = np.rint(encoded).astype(np.uint8)
    assert np.abs(in_light(eight, "srgb")[0] / 65535.0 - light / 255.0).max() < 0.5 * 2.4 / 255.0
    assert in_light(eight, "linear") is eight and in_light(eight, "unknown") is eight


@pytest.mark.parametrize("response", ["linear", "srgb"])
@pytest.mark.parametrize(("kind", "seed"), [("chequer", 305), ("stripes", 304), ("blobs", 301)])
def test_borders_before_changing_backgrounds_show_the_response(kind: str, seed: int, response: str):
    sensor = Sensor(response=response)  # type: ignore[arg-type]
    seen = find_response(images_of(moving_robot(seed, kind, sensor=sensor), 12))
    assert seen.response == response and seen.low < seen.gamma < seen.high
    assert seen.gamma == pytest.approx(GAMMA[response], abs=0.4)


@pytest.mark.skipif(not TEACH.is_dir(), reason="../shared/data/mesh_aloha is not there")
@pytest.mark.parametrize("numbers", [range(12), range(12, 24), range(5), range(24)], ids=str)
def test_pictures_by_another_ray_caster_tell_theirs(numbers: range):
    """sRGB in colour; and the same made linear, in 16 bits."""
    images = [cv2.imread(str(TEACH / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED) for k in numbers]
    openings_m = [0.055 if k < 12 else 0.035 for k in numbers]
    for response in ("srgb", "linear"):
        seen = find_response(images, openings_m)
        assert seen.response == response and seen.gamma == pytest.approx(GAMMA[response], abs=0.35)
        images = [in_light(image, "srgb") for image in images]


@pytest.mark.skipif(not TEACH.is_dir(), reason="../shared/data/mesh_aloha is not there")
def test_the_outline_of_dark_fingers_is_where_it_is_though_their_pictures_are_srgb():
    """Taken as linear, all but one edge are 0.23 to 0.30 px inside."""
    kept = yaml.safe_load((TEACH.parent / "hand_eye.yaml").read_text())
    lens = msgspec.convert(kept["camera"], BrownConradyLens)
    images = [cv2.imread(str(TEACH / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED) for k in range(24)]
    openings_m = [0.055 if k < 12 else 0.035 for k in range(24)]
    found = gripper_from_images(images, lens, openings_m=openings_m)
    assert any(note.startswith("response: srgb") for note in found.notes)
    file = "coverage_low.png" if found.opening_m == 0.035 else "coverage_high.png"
    covered = cv2.imread(str(TEACH.parent / "truth" / file), cv2.IMREAD_UNCHANGED).astype(np.float32) / 65535.0
    camera, away_px = make_camera(lens), []
    for chain in (chain for finger in found.seen.fingers for chain in finger.chains):
        for a, b in chain.pieces:
            length = float(np.linalg.norm(chain.uv_px[b] - chain.uv_px[a]))
            if length < 25.0:
                continue
            ends, share = camera.undistort(chain.uv_px[[a, b]]), np.linspace(3.0, length - 3.0, int(length)) / length
            away_px.append(crossing_px(camera.distort(ends[0] + share[:, None] * (ends[1] - ends[0])), covered))
    assert len(away_px) >= 6 and max(map(np.median, away_px)) < 0.1
    assert np.quantile(np.concatenate(away_px), 0.95) < 0.3


def test_what_does_not_tell_is_unknown_of_colour_cameras_and_linear_of_others():
    images = images_of(moving_robot(301, "blobs"), 3)
    assert find_response(images).response == "linear"
    coloured = [np.dstack([image // 2, image, image]) for image in images]
    assert likely_linear(images) and not likely_linear(coloured)
    seen = find_response(coloured)
    assert seen.response == "unknown" and "3 images" in seen.text() and f"{UNKNOWN_SIGMA_PX:g} px" in seen.text()
    # One picture again and again, with other noise: nothing changes behind the gripper.
    rng = np.random.default_rng(0)
    again = [np.clip(coloured[0] + rng.normal(0.0, 2.0, coloured[0].shape), 0, 255).astype(np.uint8) for _ in range(6)]
    assert find_response(again).response == "unknown"
    assert response_of(coloured, "srgb").response == "srgb"
    with pytest.raises(InputError, match="response: 'gamma' is no response; auto, linear or srgb"):
        response_of(coloured, "gamma")


def test_play_of_the_mount_is_not_taken_for_a_response():
    """A pixel to either side, as real mounts have."""
    rng = np.random.default_rng(3)
    images = images_of(moving_robot(305, "chequer", sensor=Sensor(response="srgb")), 12)
    shifts = rng.uniform(-1.0, 1.0, (12, 2))
    moved = [
        cv2.warpAffine(image, np.array([[1.0, 0.0, u], [0.0, 1.0, v]]), image.shape[::-1], flags=cv2.INTER_CUBIC)
        for image, (u, v) in zip(images, shifts, strict=True)
    ]
    assert find_response(moved).response == "srgb"


def test_an_unknown_response_is_in_the_standard_deviation_of_every_edge():
    settings = MeasurementSettings()
    assert settings.with_response(False) is settings
    unknown = msgspec.structs.replace(settings, edges=EdgeSettings(response="unknown"))
    for taught, sigma_px in ((False, UNKNOWN_SIGMA_PX), (True, TAUGHT_SIGMA_PX)):
        floor_px = unknown.with_response(taught).consensus.edge_floor_px
        assert floor_px == pytest.approx(np.hypot(0.02, sigma_px))
