"""A camera from one view of a flat target, as in the self-viewing method."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from gripmon.calibrate.bundle import DEGENERATE, USELESS_FOCAL, BundleProblem
from gripmon.calibrate.intrinsics import Fixed, IntrinsicsResult, calibrate, doubts_of, free_parameters
from gripmon.calibrate.lens_models import LensModel, ModelName, lens_vector, parameter_names
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.model.geometry import log_rotation
from gripmon.model.records import Array

ASSUMED_CENTRE = 0.01
"""Standard deviation of the principal point about the image's centre, over the image's width, assumed where a single
view can't determine it; and (next) that of the aspect about 1.
"""
ASSUMED_ASPECT = 1e-3


def calibrate_single_view(
    sighting: Sighting, model: ModelName = "paper", *, fixed: Fixed = MappingProxyType({})
) -> IntrinsicsResult:
    """Focal length, lens and the plate's pose from one view of a plane, with the principal point at the image's centre
    and square pixels: the start of the self-viewing method's off-line step (Tsai's single-view coplanar calibration).

    The principal point is assumed to :data:`ASSUMED_CENTRE` and the aspect to :data:`ASSUMED_ASPECT`; the covariances
    contain the effect of both on the rest.  The plate must be tilted against the image by about 30 degrees: if it is
    parallel, focal length and distance can't be separated, and :class:`CalibrationError` is raised.
    """
    names = parameter_names(model)
    # One view determines only one number of a lens.
    fixed = {**dict.fromkeys(("cx_px", "cy_px", "aspect", *names[5:])), **fixed}
    result = calibrate([sighting], model, fixed=fixed)
    changes = _assumed(result, sighting, free_parameters(model, frozenset(fixed))[1], fixed)
    parameters, pose = (np.stack(each, axis=1) for each in zip(*changes, strict=True))
    index = [names.index(name) for name in result.parameters]
    result = replace(
        result,
        covariance=result.covariance + parameters[index] @ parameters[index].T,
        pose_covariance=(result.pose_covariance[0] + pose @ pose.T,),
    )
    if "fx_px" in result.parameters and result.covariance[0, 0] > (USELESS_FOCAL * result.camera.fx_px) ** 2:
        raise CalibrationError(DEGENERATE)
    return replace(result, warnings=doubts_of(result))


def _assumed(result: IntrinsicsResult, sighting: Sighting, free: Array, fixed: Fixed) -> list[tuple[Array, Array]]:
    """Effect of one standard deviation of each assumption: on all parameters (k,) and on the plate's pose (6,); values
    that were given aren't assumptions.
    """
    lens_model = LensModel(result.model, *sighting.size_px)
    problem = BundleProblem(lens_model, [sighting], free)
    at, pose = lens_vector(result.camera), result.cam_T_plate[0]
    centre_px = ASSUMED_CENTRE * lens_model.width_px
    out: list[tuple[Array, Array]] = []
    for name, k, change in (("cx_px", 2, centre_px), ("cy_px", 3, centre_px), ("aspect", 1, ASSUMED_ASPECT * at[1])):
        if fixed.get(name) is not None:
            continue
        moved = at.copy()
        moved[k] += change
        try:
            bundle = problem.solve(moved, [pose])
        except CalibrationError:
            raise CalibrationError(DEGENERATE) from None
        other = bundle.cam_T_plate[0]
        turned = log_rotation(other[:3, :3] @ pose[:3, :3].T)
        out.append((bundle.parameters - at, np.concatenate([other[:3, 3] - pose[:3, 3], turned])))
    return out
