"""A meter that sees no image but edge points with known noise, as often as is asked: covariances by sampling."""

from __future__ import annotations

import numpy as np

from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.gripper import Gripper
from gripmon.model.records import Image
from gripmon.teach.accuracy import EDGE_POINT_SIGMA_PX, ForecastMeter
from gripmon.track.edges import FingertipMeter, MeasurementSettings
from gripmon.track.edges.prediction import Prediction
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import RobustFit, Uncertainty
from gripmon.track.edges.settings import RobustFitSettings
from support.meters import box_gripper, difference
from support.simulated import PAPER_LENS, nominal_cam_T_grip

# Floors out of the way: edge points have the assumed standard deviation and nothing beside.
INDEPENDENT = MeasurementSettings(consensus=RobustFitSettings(point_floor_px=0.005, edge_floor_px=0.0))
OPENING_M = 0.034
_GROSS_PX = 6.0


class NoisyMeter(ForecastMeter):
    """Edge points with the assumed noise about the place where the nominal pose at the true opening puts them; a share
    of them is anywhere on its profile instead.
    """

    def __init__(
        self,
        jaw_sigma_m: float,
        *,
        gross: float = 0.0,
        lens: LensSettings = PAPER_LENS,
        gripper: Gripper | None = None,
    ) -> None:
        super().__init__(make_camera(lens), gripper or box_gripper(), INDEPENDENT, jaw_sigma_m)
        self.gross, self.rng = gross, np.random.default_rng(1)

    def _look(self, image: Image, prediction: Prediction) -> Edgels:
        edgels = super()._look(image, prediction)
        jacobian = prediction.jacobian[edgels.candidates.sample]
        to_truth = difference(prediction.cam_T_grip, nominal_cam_T_grip())
        to_truth = np.append(to_truth, OPENING_M - prediction.jaw_opening_m)[: jacobian.shape[1]]
        offset_px = jacobian @ to_truth + self.rng.normal(scale=EDGE_POINT_SIGMA_PX, size=len(jacobian))
        lost = self.rng.random(len(offset_px)) < self.gross
        offset_px[lost] = self.rng.uniform(-_GROSS_PX, _GROSS_PX, np.count_nonzero(lost))
        return edgels._replace(candidates=edgels.candidates._replace(offset_px=offset_px))

    def _assess(self, edgels: Edgels, consensus: RobustFit) -> Uncertainty:
        """As for an image: by what the points show."""
        return FingertipMeter._assess(self, edgels, consensus)
