"""The simulator's pictures against independent measurements: outlines to 0.01 px, noise, blur, occlusion."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq, curve_fit
from scipy.special import erf
from support.simulated import (
    IDEAL_SENSOR,
    PAPER_LENS,
    STRONG_LENS,
    nominal_cam_T_grip,
    plain_scenario,
    simulator,
)

from gripmon.daemon.config import builtin_config, load_config
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.simulate import SCENARIO_NAMES, Simulator, make_scenario
from gripmon.simulate.background import _smear_kernel
from gripmon.simulate.coverage import CoverageRaster
from gripmon.simulate.disturbance import blur, srgb_dn
from gripmon.simulate.scenario import (
    Background,
    Creep,
    Defocus,
    FingerLook,
    FingerMark,
    LampChange,
    Light,
    LightStep,
    Sensor,
    Shadow,
)

FISHEYE_LENS = FisheyeLens(
    width_px=768,
    height_px=576,
    fx_px=640.0,
    fy_px=640.0,
    cx_px=380.0,
    cy_px=290.0,
    coefficients=(0.03, -0.02, 0.004, 0.0),
)
# Its model ends just outside the image, where a finger's sides still go on.
FOLDING_LENS = msgspec.structs.replace(PAPER_LENS, kappa_per_px2=-1.2e-6)
CONTOURS = ("L_tip_near", "L_tip_in", "L_in_far_along", "L_out_near_along", "R_tip_near", "R_tip_in", "R_in_far_along")
MARGIN_PX = 8.0
REACH_PX = 6
DITHER = Sensor(read_noise_dn=1.0, shot_noise_dn=0.0, vignetting=0.0, exposure_time_s=0.0)


def project(lens: LensSettings, points_cam_m: np.ndarray) -> np.ndarray:
    """Camera points (n, 3) -> pixels, without the project's camera: OpenCV, or a root of the paper's equation (4)."""
    if isinstance(lens, BrownConradyLens):
        matrix = np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])
        return cv2.projectPoints(points_cam_m, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0][:, 0]
    if isinstance(lens, FisheyeLens):
        radius = np.hypot(*points_cam_m[:, :2].T)
        theta = np.arctan2(radius, points_cam_m[:, 2])
        bent = theta * (1.0 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(lens.coefficients)))
        return points_cam_m[:, :2] * (bent / radius)[:, None] * (lens.fx_px, lens.fy_px) + (lens.cx_px, lens.cy_px)
    assert isinstance(lens, PaperLens)
    ideal = points_cam_m[:, :2] / points_cam_m[:, 2:] * lens.fx_px
    radius = np.linalg.norm(ideal, axis=1)
    distorted = [brentq(lambda d, r=r: d * (1.0 + lens.kappa_per_px2 * d * d) - r, 0.0, 2.0 * r) for r in radius]
    return ideal * (np.array(distorted) / radius)[:, None] + np.array([lens.cx_px, lens.cy_px])


def line_curve(sim: Simulator, lens: LensSettings, points: frozenset[str], index: int) -> np.ndarray:
    """Dense points (n, 2) in the image of the line between two points of the gripper."""
    start, end = (np.array(sim.gripper.model.points[p].xyz_m) for p in sorted(points))
    share = np.linspace(0.0, 1.0, 500)[:, None]
    cam_T_grip = sim.truth(index).cam_T_grip
    return project(lens, (start + share * (end - start)) @ cam_T_grip[:3, :3].T + cam_T_grip[:3, 3])


def edge_curve(sim: Simulator, lens: LensSettings, edge: str, index: int) -> np.ndarray:
    """Dense points (n, 2) of a gripper edge in the image."""
    model = sim.gripper.model.edges[edge]
    return line_curve(sim, lens, frozenset((model.start, model.end)), index)


def other_curves(sim: Simulator, lens: LensSettings, edge: str, index: int) -> list[np.ndarray]:
    """Those of all other sides of all faces."""
    loops = [face.points for face in sim.gripper.model.faces]
    sides = {frozenset(side) for loop in loops for side in zip(loop, (*loop[1:], loop[0]), strict=True)}
    model = sim.gripper.model.edges[edge]
    return [line_curve(sim, lens, side, index) for side in sides - {frozenset((model.start, model.end))}]


def position_errors(image: np.ndarray, curve: np.ndarray, others: list[np.ndarray]) -> np.ndarray:
    """Measured minus true edge position, px along the normal, one a row (or column) that the edge crosses.

    The measurement is the area moment: the share of light that the row lost to the darker side.  It needs no
    interpolation and is exact for any symmetric blur of a straight edge.  Rows near other edges don't count.
    """
    extent = np.abs(curve[-1] - curve[0])
    if extent[1] < extent[0]:  # a flat edge: transpose
        image, curve, others = image.T, curve[:, ::-1], [other[:, ::-1] for other in others]
    near = np.concatenate(others)
    if curve[0, 1] > curve[-1, 1]:
        curve = curve[::-1]
    errors = []
    first, last = max(np.ceil(curve[0, 1]) + MARGIN_PX, 2), min(curve[-1, 1] - MARGIN_PX, image.shape[0] - 3)
    for row in np.arange(first, last + 1).astype(int):
        true = np.interp(row, curve[:, 1], curve[:, 0])
        slope = np.interp(row + 0.5, curve[:, 1], curve[:, 0]) - np.interp(row - 0.5, curve[:, 1], curve[:, 0])
        left, right = int(true) - REACH_PX, int(true) + REACH_PX + 1
        beside = (np.abs(near[:, 1] - row) < 4.0) & (near[:, 0] > left - 4.0) & (near[:, 0] < right + 4.0)
        if left < 0 or right >= image.shape[1] or beside.any():
            continue
        profile = image[row, left : right + 1].astype(float)
        a, b = profile[:2].mean(), profile[-2:].mean()
        measured = left - 0.5 + ((profile - b) / (a - b)).sum()
        errors.append((measured - true) / np.hypot(1.0, slope))
    return np.array(errors)


# --- outlines


@pytest.mark.parametrize("lens", [PAPER_LENS, STRONG_LENS, FISHEYE_LENS], ids=["paper", "strong", "fisheye"])
def test_outlines_are_at_their_true_place_to_a_hundredth_of_a_pixel(lens: LensSettings) -> None:
    rng = np.random.default_rng(0)
    turn = cv2.Rodrigues(rng.normal(0.0, 0.05, 3))[0]
    cam_T_grip = nominal_cam_T_grip(tcp_m=tuple(np.array([0.0004, 0.0013, 0.115]) + rng.normal(0.0, 0.002, 3)))
    cam_T_grip[:3, :3] = turn @ cam_T_grip[:3, :3]
    sim = simulator(plain_scenario(), lens=lens, cam_T_grip=cam_T_grip)
    noisy = simulator(plain_scenario(sensor=DITHER), lens=lens, cam_T_grip=cam_T_grip)
    light, image = sim.light(0), np.mean([noisy.render(i) for i in range(25)], axis=0)
    of_light = []
    for edge in CONTOURS:
        curve, others = edge_curve(sim, lens, edge, 0), other_curves(sim, lens, edge, 0)
        of_light.append(position_errors(light, curve, others))
        of_image = position_errors(image, curve, others)
        assert len(of_image) > 8
        assert abs(of_image.mean()) < 0.005 and of_image.std() < 0.02
    assert np.abs(np.concatenate(of_light)).max() < 0.002


def test_fingers_that_leave_the_lens_model_are_drawn_up_to_the_image_border() -> None:
    sim = simulator(plain_scenario(), lens=FOLDING_LENS)
    assert not np.isfinite(sim.camera.project(np.array([[0.06, 0.05, 0.1]]))).any()
    light = sim.light(0)
    assert np.isfinite(light).all() and light.min() > 20.0 and light.max() < 181.0
    errors = position_errors(light, edge_curve(sim, FOLDING_LENS, "R_tip_in", 0), [np.zeros((1, 2))])
    assert np.median(np.abs(errors)) < 0.002


def test_an_outline_is_as_blurred_as_the_lens_and_the_pixel() -> None:
    sim = simulator(plain_scenario())
    light = sim.light(0)
    curve = edge_curve(sim, PAPER_LENS, "R_in_far_along", 0)
    rows = np.arange(400, 520)
    true = np.interp(rows, curve[:, 1], curve[:, 0])
    cosine = 1.0 / np.hypot(1.0, np.gradient(true, rows).mean())
    u = np.concatenate([np.arange(int(t) - 5, int(t) + 7) - t for t in true]) * cosine
    v = np.concatenate([light[row, int(t) - 5 : int(t) + 7] for row, t in zip(rows, true, strict=True)])
    model = lambda x, low, step, at, sigma: low + step * 0.5 * (1.0 + erf((x - at) / (sigma * np.sqrt(2.0))))  # noqa: E731
    (_, _, at, sigma), _ = curve_fit(model, u, v, p0=(60.0, 120.0, 0.0, 0.7))
    assert sigma == pytest.approx(np.sqrt(0.6**2 + 1.0 / 12.0), rel=0.01)
    assert abs(at) < 0.002


@pytest.mark.parametrize("psf_px", [0.3, 1.0])
def test_masks_are_what_supersampling_gives_corners_and_borders_included(psf_px: float) -> None:
    lens = BrownConradyLens(
        width_px=72,
        height_px=60,
        fx_px=70.0,
        fy_px=69.0,
        cx_px=35.3,
        cy_px=30.1,
        coefficients=(-0.3, 0.08, 0.001, -0.002),
    )
    camera = make_camera(lens)
    corners = np.array([[-0.25, -0.3, 1.0], [-0.8, 0.25, 1.1], [0.2, 0.6, 1.05], [0.3, -0.1, 0.9]])  # leaves the view
    coverage = CoverageRaster(camera, psf_px).masks([corners])[0]
    assert coverage is not None
    mask = np.zeros((60, 72))
    height, width = coverage.mask.shape
    mask[coverage.top : coverage.top + height, coverage.left : coverage.left + width] = coverage.mask
    fine, border = 24, 8
    matrix = np.array([[lens.fx_px, 0.0, lens.cx_px], [0.0, lens.fy_px, lens.cy_px], [0.0, 0.0, 1.0]])
    share = np.linspace(0.0, 1.0, 400)[:, None]
    outline = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    uv = cv2.projectPoints(outline, np.zeros(3), np.zeros(3), matrix, np.array(lens.coefficients))[0][:, 0]
    shape = (60 + 2 * border) * fine, (72 + 2 * border) * fine
    inside = np.zeros(shape, dtype=bool)
    columns = (np.arange(shape[1]) + 0.5) / fine - 0.5 - border
    begin, end = uv, np.roll(uv, -1, axis=0)
    for k in range(shape[0]):  # even-odd rule
        row = (k + 0.5) / fine - 0.5 - border
        crossing = (begin[:, 1] <= row) != (end[:, 1] <= row)
        a, b = begin[crossing], end[crossing]
        at = np.sort(a[:, 0] + (row - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))
        inside[k] = np.searchsorted(at, columns) % 2 == 1
    blurred = gaussian_filter(inside.astype(float), psf_px * fine, mode="nearest")
    pixels = blurred.reshape(60 + 2 * border, fine, 72 + 2 * border, fine).mean(axis=(1, 3))[
        border:-border, border:-border
    ]
    assert np.abs(mask - pixels).max() < 0.008


# --- sensor


def noise_by_level(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Mean grey values and variances of a still chequered view, from differences of frames."""
    table = Background(kind="chequer", level_dn=110.0, contrast=0.9, motion="still")
    sim = simulator(plain_scenario(background=table, sensor=sensor))
    stack = np.stack([sim.render(i).astype(np.float32) for i in range(24)])
    mean, variance = stack.mean(axis=0), stack.var(axis=0, ddof=1)
    bins = np.digitize(mean, np.arange(20, 220, 20))
    chosen = [k for k in range(1, 10) if (bins == k).sum() > 2000]
    return np.array([mean[bins == k].mean() for k in chosen]), np.array([variance[bins == k].mean() for k in chosen])


def test_noise_variance_grows_with_the_grey_value() -> None:
    level, variance = noise_by_level(Sensor(read_noise_dn=1.5, shot_noise_dn=0.03, vignetting=0.0))
    assert len(level) >= 6
    slope, at_zero = np.polyfit(level, variance, 1)
    assert slope == pytest.approx(0.03, rel=0.05)
    assert at_zero == pytest.approx(1.5**2 + 1.0 / 12.0, rel=0.1)


def test_noise_is_new_in_every_frame_and_white() -> None:
    sensor = Sensor(read_noise_dn=3.0, shot_noise_dn=0.0, vignetting=0.0)
    sim = simulator(plain_scenario(sensor=sensor))
    clean = simulator(plain_scenario()).render(0).astype(float)
    noise = np.stack([sim.render(i) - clean for i in range(12)]).reshape(12, 576, 768)
    between = np.corrcoef(noise.reshape(12, -1)) - np.eye(12)
    assert np.abs(between).max() < 0.02
    neighbours = (noise[:, :, 1:] * noise[:, :, :-1]).mean() / noise.var()
    assert abs(neighbours) < 0.01
    assert noise.mean(axis=0).std() == pytest.approx(noise.std() / np.sqrt(12), rel=0.05)


def test_exposure_scales_and_saturates() -> None:
    light = Light(steps=(LightStep(at_s=0.5, factor=0.5), LightStep(at_s=1.5, factor=4.0)))
    sim = simulator(plain_scenario(light=light, fps=1.0))
    before, darker, brighter = (sim.render(i)[50, 50] for i in range(3))
    assert (before, darker, brighter) == (180, 90, 255)
    assert sim.truth(1).exposure == 0.5


def test_vignetting_darkens_the_corners_as_asked() -> None:
    sensor = msgspec.structs.replace(IDEAL_SENSOR, vignetting=0.3)
    image = simulator(plain_scenario(sensor=sensor)).render(0)
    assert image[0, 0] / image[287, 384] == pytest.approx(0.7, abs=0.01)


def test_a_shadow_takes_its_share_of_the_light_and_travels() -> None:
    shadow = Shadow(start_s=0.0, end_s=4.0, depth=0.4, width=0.3, softness=0.05, angle_deg=0.0)
    sim = simulator(plain_scenario(light=Light(shadows=(shadow,)), fps=10.0))
    plain = simulator(plain_scenario()).render(0).astype(float)
    darkest = []
    for index in (12, 20, 28):
        ratio = (sim.render(index) / plain)[100]
        assert ratio.min() == pytest.approx(0.6, abs=0.01) and ratio.max() == pytest.approx(1.0, abs=0.01)
        darkest.append(float(np.flatnonzero(ratio < 0.7).mean()))
    assert darkest[1] - darkest[0] > 150.0 and darkest[2] - darkest[1] > 150.0
    np.testing.assert_array_equal(sim.render(41), simulator(plain_scenario()).render(0))


@pytest.mark.parametrize("sigma_px", [0.2, 0.79, 0.8, 3.0])
def test_blur_has_the_variance_asked_for(sigma_px: float) -> None:
    point = np.zeros((41, 41), np.float32)
    point[20, 20] = 1.0
    spread = blur(point, sigma_px).astype(float)
    offset = np.arange(41) - 20.0
    assert spread.sum() == pytest.approx(1.0, abs=1e-5)
    for axis in (0, 1):
        assert (spread.sum(axis=axis) * offset**2).sum() == pytest.approx(sigma_px**2, rel=0.02)


def edge_variance(image: np.ndarray, row: int, left: int, right: int) -> float:
    """Variance (px²) of the slope of one row across an edge: that of everything that blurred it."""
    slope = np.diff(image[row, left:right].astype(float))
    u = np.arange(len(slope))
    share = slope / slope.sum()
    mean = (share * u).sum()
    return float((share * (u - mean) ** 2).sum())


def test_defocus_and_motion_blur_widen_an_outline() -> None:
    row, left, right = 420, 521, 555
    sharp = edge_variance(simulator(plain_scenario()).render(0), row, left, right)
    soft = simulator(plain_scenario(defocus=(Defocus(sigma_px=2.0),), fps=10.0)).render(10)
    assert edge_variance(soft, row, left, right) - sharp == pytest.approx(4.0, rel=0.05)
    # 10 mm/s along x, 20 ms exposure: 0.2 mm are 1.6 px at the fingers, an even smear of variance length²/12.
    creep = Creep(start_s=0.0, law="linear", time_s=1.0, translation_m=(0.01, 0.0, 0.0))
    sensor = msgspec.structs.replace(IDEAL_SENSOR, exposure_time_s=0.02)
    moving = simulator(plain_scenario(mount=(creep,), sensor=sensor, fps=100.0))
    still = simulator(plain_scenario(mount=(creep,), fps=100.0))
    slower = edge_curve(still, PAPER_LENS, "R_in_far_along", 9), edge_curve(still, PAPER_LENS, "R_in_far_along", 11)
    length = np.diff([np.interp(row, c[:, 1], c[:, 0]) for c in slower])[0]
    widths = [edge_variance(s.light(10), row, left, right) for s in (moving, still)]
    assert length > 1.5
    assert widths[0] - widths[1] == pytest.approx(length**2 / 12.0, rel=0.03)
    errors = position_errors(moving.light(10), edge_curve(still, PAPER_LENS, "R_in_far_along", 10), [np.zeros((1, 2))])
    assert len(errors) > 100 and np.abs(errors).max() < 0.01


@pytest.mark.parametrize("step_px", [(3.0, -1.0), (0.0, 7.3)])
def test_the_background_is_smeared_along_its_motion(step_px: tuple[float, float]) -> None:
    kernel = _smear_kernel(np.array(step_px)).astype(float)
    assert kernel.shape[0] % 2 == 1 and kernel.sum() == pytest.approx(1.0)
    offset = np.arange(len(kernel)) - len(kernel) // 2
    for axis, step in enumerate(step_px):
        shares = kernel.sum(axis=axis)
        assert (shares * offset).sum() == pytest.approx(0.0, abs=1e-6)
        # Sharing points among pixels adds up to 1/4 px².
        assert step**2 / 12.0 - 0.01 <= (shares * offset**2).sum() <= step**2 / 12.0 * 1.2 + 0.25


def test_jpeg_is_that_of_the_uncompressed_frame() -> None:
    scenario = make_scenario("clutter")
    raw = simulator(scenario).render(3)
    packed = simulator(msgspec.structs.replace(scenario, sensor=Sensor(jpeg_quality=60))).render(3)
    expected = cv2.imdecode(cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(packed, expected)
    assert 1.0 < np.abs(packed.astype(float) - raw).mean() < 8.0


@pytest.mark.parametrize("name", SCENARIO_NAMES)
def test_every_scenario_can_be_drawn_at_its_defaults(name: str):
    """Frame 77 of grasp has a fingertip that touches the image with its blur alone."""
    config = load_config(builtin_config("demo.yaml"), check_source=False)
    scenario = make_scenario(name, finger=config.gripper.finger_ids[0])
    drawn = config.scene.simulator(scenario, 0)
    count = drawn.frame_count
    for index in sorted({count // 2, min(77, count - 1), count - 1}):
        assert drawn.render(index).std() > 1.0


def test_a_lamp_that_moves_changes_each_face_by_lambert() -> None:
    """Brightness of faces before and after, against normals and lamps by hand."""
    first, then = np.array([0.4, -0.55, -0.75]), np.array([-0.8, -0.2, -0.5])
    look = FingerLook(
        texture=0.0,
        carriers=False,
        ambient=0.3,
        level_dn=100.0,
        lamp_cam=tuple(first),
        lamp_changes=(LampChange(at_s=0.5, lamp_cam=tuple(then), time_s=0.5),),
    )
    sim = simulator(plain_scenario(fingers=look, fps=10.0))
    # A place on the left finger's near face, whose normal is the gripper's -y.
    inside_m = np.array([-0.022, -0.008, -0.01])
    cam_T_grip = sim.truth(0).cam_T_grip
    u, v = np.round(project(PAPER_LENS, (cam_T_grip[:3, :3] @ inside_m + cam_T_grip[:3, 3])[None])[0]).astype(int)
    normal = cam_T_grip[:3, :3] @ np.array([0.0, -1.0, 0.0])

    def level_dn(lamp: np.ndarray) -> float:
        return 100.0 * (0.3 + 0.7 * max(float(normal @ lamp) / np.linalg.norm(lamp), 0.0))

    half = first / np.linalg.norm(first) + then / np.linalg.norm(then)  # the middle of the half cosine wave
    # Frames at 0, 0.75 (between two frames: 0.7 and 0.8 around it) and 2 s.
    assert sim.light(0)[v, u] == pytest.approx(level_dn(first), rel=1e-3)
    assert sim.light(20)[v, u] == pytest.approx(level_dn(then), rel=1e-3)
    around = [float(sim.light(index)[v, u]) for index in (7, 8)]
    assert min(around) <= level_dn(half) <= max(around)
    assert level_dn(first) != pytest.approx(level_dn(then), rel=0.05)


def test_a_lamp_without_ambient_light_is_refused() -> None:
    look = FingerLook(ambient=0.0, lamp_changes=(LampChange(at_s=1.0, lamp_cam=(0.0, 0.0, -1.0)),))
    with pytest.raises(ValueError, match="ambient above 0"):
        simulator(plain_scenario(fingers=look)).render(0)


def test_srgb_is_the_standards_curve() -> None:
    """Against the values of IEC 61966-2-1 at some levels of light, and with the image of the same light linear."""
    light = np.array([[0.0, 0.0031308, 0.01, 0.2140, 0.5, 1.0, 1.7]], np.float32) * 255.0
    expected = np.array([[0.0, 0.04045, 0.09985, 0.5, 0.73536, 1.0, 1.0]]) * 255.0
    np.testing.assert_allclose(srgb_dn(light), expected, atol=0.02)
    linear, srgb = (
        simulator(plain_scenario(sensor=msgspec.structs.replace(IDEAL_SENSOR, response=response))).render(0)
        for response in ("linear", "srgb")
    )
    share = linear.astype(float) / 255.0
    curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1.0 / 2.4) - 0.055)
    steepest = 255.0 * 12.92 / 255.0  # half a grey level of light is up to this many of the image, in the dark
    assert np.abs(srgb - 255.0 * curve).max() <= 0.5 * steepest + 0.51


def test_a_mark_on_a_whole_finger_darkens_every_face() -> None:
    plain, marked = (
        simulator(plain_scenario(fingers=FingerLook(texture=0.0, carriers=False, marks=marks))).light(0)
        for marks in ((), (FingerMark(shape="whole", gain=0.25, finger="left"),))
    )
    middle = plain.shape[1] // 2
    np.testing.assert_array_equal(plain[:, middle:], marked[:, middle:])  # the right finger and the table
    darker = plain[:, :middle] - marked[:, :middle]
    # Where all of a pixel is finger it keeps a quarter of its light; elsewhere nothing changes.
    inside = darker > 0.74 * plain[:, :middle]
    assert inside.sum() > 5000 and (np.abs(darker[inside] / plain[:, :middle][inside] - 0.75) < 1e-3).mean() > 0.95
