"""Sightings of a plate without images: exact projections and drawn noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gripmon.calibrate.sighting import Sighting
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import exp_rotation
from gripmon.model.records import Array
from support.discs import blob_centres_px

SIZE = {"width_px": 768, "height_px": 576}
CAMERAS: dict[str, LensSettings] = {
    "paper": PaperLens(**SIZE, fx_px=962.0, fy_px=960.0, cx_px=389.5, cy_px=281.5, kappa_per_px2=1.9e-7),
    "brown_conrady": BrownConradyLens(
        **SIZE, fx_px=700.0, fy_px=705.0, cx_px=390.0, cy_px=280.0, coefficients=(-0.2, 0.08, 0.001, -0.0005)
    ),
    "brown_conrady_5": BrownConradyLens(
        **SIZE, fx_px=600.0, fy_px=600.0, cx_px=380.0, cy_px=290.0, coefficients=(-0.25, 0.12, 0.0005, 0.001, -0.04)
    ),
    "fisheye": FisheyeLens(
        **SIZE, fx_px=400.0, fy_px=402.0, cx_px=380.0, cy_px=290.0, coefficients=(0.02, -0.01, 0.003, -0.0004)
    ),
}
_C, _R = np.meshgrid(np.arange(9) * 0.02, np.arange(7) * 0.02)
PLATE_M: Array = np.stack([_C.ravel(), _R.ravel(), np.zeros(63)], axis=1)


def poses(rng: np.random.Generator, count: int, distance_m: float = 0.2) -> list[Array]:
    """``cam_T_plate`` of a plate held to all sides."""
    out = []
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3] = exp_rotation(np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3)]))
        centre = rng.uniform([-0.05, -0.035, 0.8], [0.05, 0.035, 1.2]) * [1.0, 1.0, distance_m]
        T[:3, 3] = centre - T[:3, :3] @ PLATE_M.mean(axis=0)
        out.append(T)
    return out


def seen(
    settings: LensSettings,
    cam_T_plate: Sequence[Array],
    rng: np.random.Generator,
    *,
    noise_px: float = 0.1,
    radius_m: float = 0.0,
    gross: float = 0.0,
    displacement_m: Array | None = None,
    turns: int = 0,
) -> list[Sighting]:
    """What a camera sees; a part ``gross`` of the points lies up to 30 px off; ``displacement_m`` (63, 3): of the
    plate's points from where they should be.
    """
    true_m = PLATE_M if displacement_m is None else PLATE_M + displacement_m
    camera, out = make_camera(settings), []
    size = (settings.width_px, settings.height_px)
    for k, T in enumerate(cam_T_plate):
        uv = camera.project(true_m @ T[:3, :3].T + T[:3, 3])
        if radius_m:
            uv = blob_centres_px(camera, T, true_m, radius_m)
        ok = np.isfinite(uv).all(axis=1) & (uv > 0).all(axis=1) & (uv < np.array(size) - 1).all(axis=1)
        if ok.sum() < 20:
            continue
        uv = uv[ok] + rng.normal(0.0, noise_px, (ok.sum(), 2))
        wrong = rng.random(len(uv)) < gross
        uv[wrong] += rng.uniform(-30.0, 30.0, (wrong.sum(), 2))
        covariance = np.tile(noise_px**2 * np.eye(2), (len(uv), 1, 1))
        name = f"view {k}"
        out.append(Sighting(uv, PLATE_M[ok], covariance, size, radius_m, name, turns=turns))
    return out


def part_of(view: Sighting, width_m: float, height_m: float) -> Sighting:
    """The view's points up to there along x and y."""
    kept = (view.plate_m[:, 0] < width_m + 1e-6) & (view.plate_m[:, 1] < height_m + 1e-6)
    return replace(
        view, uv_px=view.uv_px[kept], plate_m=view.plate_m[kept], covariance_px=view.covariance_px[kept]
    )
