"""What is compiled of a measurement: the same as Python runs it, and nothing is compiled while frames come."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.box_models import cube_model
from support.grippers import gripper_from_dict
from support.meters import measure, meter, moved, picture
from support.simulated import plain_scenario
from test_robust_fit import (
    CAMERA,
    EDGES,
    GRIPPER,
    PRIOR,
    SETTINGS,
    XI,
    candidates,
    votes_for,
)

from gripmon.track.edges import (
    FingertipMeter,
    MeasurementSettings,
    agreeing_fingers,
    edge_residuals_px,
    evidence,
    kernel,
    lines,
    prediction,
    prediction_kernel,
    profile_kernel,
    settling,
    warm_up_fit,
    warm_up_geometry,
    warm_up_profiles,
)
from gripmon.track.edges.robust_fit import Prior, assess, contradictions_without, fit_irls

CLOSE = 1e-9


NOTHING = votes_for(candidates(np.arange(0), np.zeros(0)))


def prior(unknowns: int, jaw_sigma_m: float = 1e-4, opened_m: float = 0.0) -> Prior:
    information = PRIOR[:unknowns].copy()
    information[6:] = jaw_sigma_m**-2
    return Prior(np.array([0.0] * 6 + [opened_m])[:unknowns], information)


def test_what_can_not_be_solved_is_an_error():
    """No candidates and a prior that holds nothing: all of these have a normal matrix of zeros."""
    nothing = Prior(np.zeros(7), np.zeros(7))
    with pytest.raises(FloatingPointError, match="not positive definite"):
        fit_irls(NOTHING, nothing, np.zeros(7), SETTINGS)
    empty = fit_irls(NOTHING, prior(7), np.zeros(7), SETTINGS)
    with pytest.raises(FloatingPointError, match="not positive definite"):
        assess(NOTHING, empty, np.zeros(7))
    with pytest.raises(FloatingPointError, match="not positive definite"):
        contradictions_without(NOTHING, nothing, np.zeros(7), SETTINGS)


def test_what_is_read_off_a_measurement_is_what_numpy_reads():
    """Motion of the edges, blur, shares of the fingers, residuals of the edges and of the corners."""
    image = picture(plain_scenario()).copy()
    image[:, :250] = 90
    using = meter()
    found = measure(image, using=using)
    consensus, candidates, sampled = found.consensus, found.candidates, found.prediction
    for xi in (XI, XI[:6], -XI):
        assert sampled.moved_px(xi) == pytest.approx(np.abs(sampled.jacobian[:, : len(xi)] @ xi).max(), rel=CLOSE)
    widths_px = np.sort(candidates.width_px[consensus.weight > 0.0])
    kernel_px = candidates.zoom * MeasurementSettings().edges.blur_px
    assert found.blur_px == pytest.approx(np.sqrt(widths_px[len(widths_px) // 2] ** 2 - kernel_px**2), rel=CLOSE)
    finger = GRIPPER.edge_finger[sampled.layout.edge]
    shares = [consensus.supported[finger == f].sum() / sampled.ok[finger == f].sum() for f in (0, 1)]
    assert agreeing_fingers(found, GRIPPER) == pytest.approx(shares, rel=CLOSE) and min(shares) < 0.8 < max(shares)
    residual_px, edge = edge_residuals_px(found, GRIPPER), sampled.layout.edge[candidates.sample]
    for e in range(EDGES):
        own = (edge == e) & (consensus.weight > 0.0)
        mean = np.average(consensus.residual_px[own], weights=consensus.weight[own]) if own.any() else np.nan
        assert residual_px[e] == pytest.approx(mean, abs=CLOSE, nan_ok=True)
    pose = moved(found.cam_T_grip, np.array([1e-4, 2e-4, -1e-4, 1e-3, 2e-3, 3e-3]))
    points_grip_m = GRIPPER.points_grip_m(found.jaw_opening_m)[GRIPPER.corner_points]
    points = points_grip_m @ pose[:3, :3].T + pose[:3, 3]
    miss_px = np.einsum("cij,cj->ci", sampled.corners.d_uv_d_xy, found.corners.xy - points[:, :2] / points[:, 2:])
    rms_px = np.sqrt((miss_px[found.corners.usable] ** 2).sum(axis=1).mean())
    assert found.corner_rms_px(pose) == pytest.approx(rms_px, rel=1e-3)  # the jaw's motion is linear there


ENTRIES = {
    "fit", "assess", "contradictions_without", "read_profiles", "low_third_difference", "find_candidates", "worth",
    "_fit_lines", "_intersect", "largest_motion", "usual_width", "corner_rms", "agreeing_shares", "edge_means",
    "sampled_ranges", "levers", "across_edges", "maps", "ideal_lines", "gains",
}  # fmt: skip


def signatures() -> dict[str, int]:
    """For how many combinations of types each function that Python calls is compiled."""
    rooms = (kernel, profile_kernel, lines, prediction, prediction_kernel, settling, evidence)
    functions = {name: f for room in rooms for name, f in vars(room).items() if hasattr(f, "signatures")}
    return {name: len(functions[name].signatures) for name in ENTRIES}


def test_after_warming_up_no_frame_waits_for_the_compiler():
    """Whatever the gripper and the image: with a jaw and without, in colour, that may not be written to."""
    warm_up_profiles()
    warm_up_fit()
    warm_up_geometry()
    before = signatures()
    assert min(before.values()) >= 1
    clear = picture(plain_scenario())
    covered = clear.copy()
    covered[:, :300] = 90
    for image in (clear, covered, np.dstack([clear] * 3)[:, :, ::-1]):
        found = measure(image)
        found.corner_rms_px(found.cam_T_grip)
        agreeing_fingers(found, GRIPPER)
        edge_residuals_px(found, GRIPPER)
        measure(image, using=FingertipMeter(CAMERA, gripper_from_dict(cube_model()), MeasurementSettings(), 0.0))
    assert signatures() == before


MEASURE = """
import numba
import numpy as np
from test_golden import measured
found, _ = measured("clutter")
corners_px = np.nan_to_num(found.corners.uv_px)
print(int(numba.config.DISABLE_JIT), *found.cam_T_grip.ravel(), *found.covariance.ravel(), *corners_px.ravel())
"""


def test_what_is_compiled_measures_as_it_is_written():
    """A whole measurement in a cluttered image, to the last bits; with NUMBA_DISABLE_JIT the same functions run as
    Python, for a debugger.
    """
    found = []
    for disabled in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disabled, "PYTHONPATH": str(Path(__file__).parent)}
        said = subprocess.run(
            [sys.executable, "-c", MEASURE], env=environment, capture_output=True, text=True, timeout=600, check=True
        )
        was_disabled, *numbers = said.stdout.split()
        assert was_disabled == disabled
        found.append(np.array(numbers, dtype=float))
    one, other = found
    assert len(one) > 60
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-24)
