"""Camera models against the paper's equation (4), OpenCV and central differences."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens, make_camera, same_lens
from gripmon.model.records import Array

PINHOLE = {"width_px": 768, "height_px": 576, "fx_px": 962.0, "fy_px": 955.0, "cx_px": 380.3, "cy_px": 290.8}
WIDE = PINHOLE | {"fx_px": 420.0, "fy_px": 424.0}
LENSES: dict[str, LensSettings] = {
    "paper_cushion": PaperLens(**PINHOLE, kappa_per_px2=1.9e-7),
    "paper_barrel": PaperLens(**PINHOLE, kappa_per_px2=-3e-7),
    "paper_none": PaperLens(**PINHOLE),
    "brown_4": BrownConradyLens(**PINHOLE, coefficients=(-0.25, 0.11, 1.2e-3, -0.8e-3)),
    "brown_5": BrownConradyLens(**PINHOLE, coefficients=(0.1, -0.2, -1e-3, 2e-3, 0.3)),
    "brown_5_strong": BrownConradyLens(**WIDE, coefficients=(-0.28, 0.09, 1e-3, -1e-3, -0.011)),
    "brown_8": BrownConradyLens(**WIDE, coefficients=(0.3, -0.05, 1e-3, -5e-4, 0.01, 0.65, 0.02, 0.004)),
    "brown_12": BrownConradyLens(
        **PINHOLE, coefficients=(-0.2, 0.1, 1e-3, -1e-3, 0.02, 0.05, -0.02, 0.01, 2e-3, -1e-3, -3e-3, 4e-3)
    ),
    "brown_pole": BrownConradyLens(**WIDE, coefficients=(0.0, 0.0, 0.0, 0.0, 0.0, -0.8, 0.0, 0.0)),
    "fisheye": FisheyeLens(**(WIDE | {"fx_px": 330.0, "fy_px": 333.0}), coefficients=(0.03, -0.012, 0.006, -0.0015)),
    "fisheye_equidistant": FisheyeLens(**WIDE),
}
OPENCV = [name for name in LENSES if not name.startswith("paper")]
every_lens = pytest.mark.parametrize("name", LENSES)


def image_grid_px(settings: LensSettings) -> Array:
    columns = np.linspace(0, settings.width_px - 1, 41)
    rows = np.linspace(0, settings.height_px - 1, 31)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def points_in_view_m(settings: LensSettings) -> Array:
    """Points at various depths all over the image, the principal axis among them."""
    rng = np.random.default_rng(4)
    xy = make_camera(settings).undistort(image_grid_px(settings))
    points = np.column_stack((xy, np.ones(len(xy)))) * rng.uniform(0.05, 2.0, (len(xy), 1))
    return np.vstack((points, [[0.0, 0.0, 0.115]]))


def matrix_of(settings: LensSettings) -> Array:
    return np.array([[settings.fx_px, 0, settings.cx_px], [0, settings.fy_px, settings.cy_px], [0, 0, 1]])


def project_by_opencv(settings: BrownConradyLens | FisheyeLens, points_cam_m: Array) -> Array:
    cv2 = pytest.importorskip("cv2")
    zero, coefficients = np.zeros(3), np.array(settings.coefficients)
    if isinstance(settings, FisheyeLens):
        uv, _ = cv2.fisheye.projectPoints(points_cam_m[:, None], zero, zero, matrix_of(settings), coefficients)
    else:
        uv, _ = cv2.projectPoints(points_cam_m[:, None], zero, zero, matrix_of(settings), coefficients)
    return uv.reshape(-1, 2)


def test_paper_lens_is_equation_4() -> None:
    settings = LENSES["paper_cushion"]
    points = points_in_view_m(settings)
    uv = make_camera(settings).project(points)
    aspect = settings.fx_px / settings.fy_px
    distorted = (uv - [settings.cx_px, settings.cy_px]) * [1.0, aspect]  # square pixels of the column's size
    ideal = distorted * (1.0 + 1.9e-7 * (distorted**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(ideal, settings.fx_px * points[:, :2] / points[:, 2:], atol=1e-10)
    # the paper's own figures: at the image corner the lens moves a point by about 21 px
    assert np.abs(ideal - distorted).max() == pytest.approx(1.9e-7 * 480**2 * 384, rel=0.1)


@pytest.mark.parametrize("name", OPENCV)
def test_projection_agrees_with_opencv(name: str) -> None:
    points = points_in_view_m(LENSES[name])
    expected = project_by_opencv(LENSES[name], points)
    np.testing.assert_allclose(make_camera(LENSES[name]).project(points), expected, atol=1e-9)


@every_lens
def test_round_trip_over_the_whole_image(name: str) -> None:
    camera = make_camera(LENSES[name])
    grid = image_grid_px(LENSES[name])
    np.testing.assert_allclose(camera.distort(camera.undistort(grid)), grid, atol=1e-9)


@every_lens
def test_projection_jacobian_by_central_differences(name: str) -> None:
    camera = make_camera(LENSES[name])
    points = points_in_view_m(LENSES[name])
    uv, analytic = camera.project_with_jacobian(points)
    np.testing.assert_array_equal(uv, camera.project(points))
    numeric = np.empty_like(analytic)
    step = 1e-6 * points[:, 2:]
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        numeric[:, :, axis] = (camera.project(points + shift) - camera.project(points - shift)) / (2.0 * step)
    scale = LENSES[name].fx_px / points[:, 2]
    np.testing.assert_allclose(analytic / scale[:, None, None], numeric / scale[:, None, None], atol=2e-8, rtol=2e-7)


@every_lens
def test_undistortion_jacobian_by_central_differences(name: str) -> None:
    camera = make_camera(LENSES[name])
    grid = image_grid_px(LENSES[name])
    xy, analytic = camera.undistort_with_jacobian(grid)
    np.testing.assert_array_equal(xy, camera.undistort(grid))
    for axis in range(2):
        shift = 0.01 * np.eye(2)[axis]
        numeric = (camera.undistort(grid + shift) - camera.undistort(grid - shift)) / 0.02
        largest = np.abs(analytic).max(axis=(1, 2))  # the edge of a fisheye image is steep
        np.testing.assert_allclose(analytic[:, :, axis] / largest[:, None], numeric / largest[:, None], atol=3e-7)


@every_lens
def test_behind_the_camera_is_nan(name: str) -> None:
    points = np.array([[0.01, 0.0, 0.1], [0.01, 0.0, -0.1], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.1]])
    uv, jacobian = make_camera(LENSES[name]).project_with_jacobian(points)
    assert np.isfinite(uv[0]).all() and np.isfinite(jacobian[0]).all()
    assert np.isnan(uv[1:3]).all() and np.isnan(uv[3, 0])
    assert np.isnan(jacobian[1:3]).all()


def test_points_that_the_polynomial_folds_back_into_the_image_are_nan() -> None:
    settings = BrownConradyLens(**PINHOLE, coefficients=(-0.3, 0.0, 0.0, 0.0))
    far_aside = np.array([[1.7, 0.0, 1.0]])  # the fold is at r = 1 / sqrt(0.9)
    folded = project_by_opencv(settings, far_aside)
    assert 0 < folded[0, 0] < settings.width_px  # OpenCV puts it into the image
    camera = make_camera(settings)
    assert np.isnan(camera.project(far_aside)).all()
    assert np.isfinite(camera.project(np.array([[1.05, 0.0, 1.0]]))).all()
    beyond_px = settings.cx_px + settings.fx_px * (1.0 - 0.3 / 0.9) / np.sqrt(0.9) + np.array([-1.0, 1.0])
    answer = camera.undistort(np.column_stack((beyond_px, np.full(2, settings.cy_px))))
    assert np.isfinite(answer[0]).all() and np.isnan(answer[1]).all()


def test_barrel_paper_lens_ends_at_its_fold() -> None:
    camera = make_camera(LENSES["paper_barrel"])
    fold_px = 1.0 / np.sqrt(3.0 * 3e-7)
    uv = np.array([[380.3 + fold_px - 1.0, 290.8], [380.3 + fold_px + 1.0, 290.8]])
    xy = camera.undistort(uv)
    assert np.isfinite(xy[0]).all() and np.isnan(xy[1]).all()
    farthest = fold_px * (2.0 / 3.0) / 962.0
    assert np.isfinite(camera.distort(np.array([[farthest * 0.999, 0.0]]))).all()
    assert np.isnan(camera.distort(np.array([[farthest * 1.001, 0.0]]))).all()


@every_lens
def test_no_points_give_no_pixels(name: str) -> None:
    camera = make_camera(LENSES[name])
    uv, d_uv_d_point = camera.project_with_jacobian(np.empty((0, 3)))
    xy, d_xy_d_uv = camera.undistort_with_jacobian(np.empty((0, 2)))
    assert uv.shape == (0, 2) and d_uv_d_point.shape == (0, 2, 3)
    assert xy.shape == (0, 2) and d_xy_d_uv.shape == (0, 2, 2)
    assert camera.distort(np.empty((0, 2))).shape == (0, 2)


def test_wrong_shapes_are_refused() -> None:
    camera = make_camera(LENSES["brown_5"])
    with pytest.raises(AssertionError, match=r"\(n, 3\)"):
        camera.project(np.zeros((3, 2)))
    with pytest.raises(AssertionError, match=r"\(n, 2\)"):
        camera.undistort(np.zeros(2))


ABSURD: dict[str, tuple[LensSettings, str, str]] = {
    "ratio": (PaperLens(**(PINHOLE | {"fx_px": 0.9})), "fx_px", "ratio"),
    "millimetres": (PaperLens(**(PINHOLE | {"fy_px": 8.0})), "fy_px", "pixel pitch"),
    "metres written as microns": (PaperLens(**(PINHOLE | {"fx_px": 8e6})), "fx_px", "pixel pitch"),
    "not a number": (PaperLens(**(PINHOLE | {"fx_px": float("nan")})), "fx_px", "right would be"),
    "aspect": (PaperLens(**(PINHOLE | {"fy_px": 96.2})), "fx_px and fy_px", "nearly the same"),
    "centre as fraction": (PaperLens(**(PINHOLE | {"cx_px": 0.5, "cy_px": 0.5})), "cx_px", "about 384"),
    "centre far outside": (PaperLens(**(PINHOLE | {"cy_px": 2900.0})), "cy_px", "288"),
    "centre not finite": (PaperLens(**(PINHOLE | {"cx_px": float("inf")})), "cx_px", "384"),
    "image size": (PaperLens(**(PINHOLE | {"width_px": 0})), "width_px", "image size"),
    "kappa in mm": (PaperLens(**PINHOLE, kappa_per_px2=3e-3), "kappa_per_px2", "units"),
    "kappa folds": (PaperLens(**PINHOLE, kappa_per_px2=-3e-6), "kappa_per_px2", "monotonic"),
    "kappa nan": (PaperLens(**PINHOLE, kappa_per_px2=float("nan")), "kappa_per_px2", "finite"),
    "six coefficients": (BrownConradyLens(**PINHOLE, coefficients=(0.0,) * 6), "coefficients", "4, 5, 8 or 12"),
    "brown folds": (BrownConradyLens(**PINHOLE, coefficients=(-3.0, 0.0, 0.0, 0.0)), "coefficients", "monotonic"),
    "tangential": (BrownConradyLens(**PINHOLE, coefficients=(0.0, 0.0, 2.0, 0.0)), "coefficients", "inverted"),
    "brown huge": (BrownConradyLens(**PINHOLE, coefficients=(500.0, 0.0, 0.0, 0.0)), "coefficients", "units"),
    "brown nan": (BrownConradyLens(**PINHOLE, coefficients=(float("nan"),) * 4), "coefficients", "finite"),
    "fisheye count": (FisheyeLens(**PINHOLE, coefficients=(0.0,) * 5), "coefficients", "k1 k2 k3 k4"),
    "fisheye folds": (FisheyeLens(**WIDE, coefficients=(-0.9, 0.0, 0.0, 0.0)), "coefficients", "monotonic"),
}


@pytest.mark.parametrize("name", ABSURD)
def test_absurd_calibrations_are_refused(name: str) -> None:
    settings, key, hint = ABSURD[name]
    with pytest.raises(ValueError, match=rf"(?s)^{key}: .*({hint})") as refused:
        make_camera(settings)
    assert "; " in str(refused.value) and "\n" not in str(refused.value)


def test_unusual_but_real_calibrations_are_accepted() -> None:
    tele = BrownConradyLens(
        width_px=640, height_px=480, fx_px=2283.161, fy_px=2283.039, cx_px=269.910, cy_px=248.321,
        coefficients=(0.044, 3.869, -0.002, -0.009),
    )  # fmt: skip
    circular_fisheye = FisheyeLens(  # its image corners see beyond 90 degrees
        width_px=1280, height_px=1024, fx_px=330.0, fy_px=330.0, cx_px=640.0, cy_px=512.0,
        coefficients=(0.01, -0.002, 0.0, 0.0),
    )  # fmt: skip
    grid = image_grid_px(tele)
    assert np.isfinite(make_camera(tele).undistort(grid)).all()
    xy = make_camera(circular_fisheye).undistort(np.array([[640.0, 512.0], [900.0, 512.0], [0.0, 0.0]]))
    assert np.isfinite(xy[:2]).all() and np.isnan(xy[2]).all()


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_is_the_same_with_zeros_behind_and_another_with_another_number(name: str):
    lens = LENSES[name]
    changes = [{"fx_px": lens.fx_px + 1e-3}, {"cx_px": lens.cx_px - 1e-3}, {"width_px": lens.width_px + 1}]
    if not isinstance(lens, PaperLens):
        padded = msgspec.structs.replace(lens, coefficients=(*lens.coefficients, 0.0))
        assert same_lens(lens, padded) and same_lens(padded, lens)
        changes += [{"coefficients": (*lens.coefficients, 1e-4)}]
    else:
        changes += [{"kappa_per_px2": lens.kappa_per_px2 + 1e-12}]
    assert same_lens(lens, msgspec.structs.replace(lens, fy_px=lens.fy_px * (1.0 + 1e-15)))
    assert not any(same_lens(lens, msgspec.structs.replace(lens, **change)) for change in changes)
    assert not any(same_lens(lens, other) for other in LENSES.values() if type(other) is not type(lens))
