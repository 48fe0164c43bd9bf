"""What a person may set about the measurement of one frame: the configuration's section ``monitor.corners``."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
from msgspec import Meta

from gripmon.model.response import TAUGHT_SIGMA_PX, UNKNOWN_SIGMA_PX, Response


class SamplingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the image is sampled around the predicted edges."""

    samples: Annotated[int, Meta(ge=24, le=4096, description="number of search lines on all edges together")] = 320
    reach_px: Annotated[
        float,
        Meta(ge=2.0, le=40.0, description="how far each search line extends to either side of the predicted edge (px)"),
    ] = 7.0
    end_margin_px: Annotated[
        float,
        Meta(
            ge=0.0,
            le=40.0,
            description="length left out at each end of an edge, where the neighbouring edge shows; down to "
            "half of it on a short edge (px)",
        ),
    ] = 4.0
    creases: Annotated[
        bool,
        Meta(description="also use edges between two visible faces, which bevels shift (taught edges are always used)"),
    ] = False


class EdgeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as an edgel hypothesis."""

    blur_px: Annotated[float, Meta(ge=0.4, le=5.0, description="sigma of the derivative of Gaussian (px)")] = 0.65
    noise_factor: Annotated[
        float, Meta(ge=2.0, le=50.0, description="smallest edge response in standard deviations of its noise")
    ] = 3.0
    response: Annotated[
        Response,
        Meta(
            description="how grey levels follow the light: linear, as of industrial cameras without gamma; srgb, as of "
            "most colour cameras, JPEG and video, whose blurred edges would appear 0.1 to 0.4 px too far into the "
            "dark; unknown: larger bounds; if left out, as gripmon teach found it"
        ),
    ] = "linear"
    contrast_fraction: Annotated[
        float, Meta(ge=0.0, le=0.5, description="smallest step in grey levels as a fraction of the image's full scale")
    ] = 0.008


class RobustFitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How edgel hypotheses agree on one motion."""

    start_width_px: Annotated[
        float, Meta(ge=0.5, le=10.0, description="width of the robust weight at the prediction (px)")
    ] = 2.5
    point_floor_px: Annotated[
        float,
        Meta(
            ge=0.005, le=1.0, description="standard deviation of an edge point that image noise does not explain (px)"
        ),
    ] = 0.05
    edge_floor_px: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="standard deviation of a whole sharp edge's position that averaging along it does not remove; "
            "grows with the edges' width (px)",
        ),
    ] = 0.02
    support_sigmas: Annotated[
        float,
        Meta(ge=1.0, le=20.0, description="standard deviations above chance from which an edge counts as detected"),
    ] = 4.0
    support_share: Annotated[
        float,
        Meta(
            ge=0.05,
            le=0.95,
            description="fraction of an edge's search lines that must be inliers for it to count as detected",
        ),
    ] = 0.3
    trusted_share: Annotated[
        float,
        Meta(
            ge=0.05,
            le=0.95,
            description="fraction of neighbouring search lines that must be inliers at the predicted pose",
        ),
    ] = 0.3
    found_share: Annotated[
        float,
        Meta(
            ge=0.05,
            le=0.95,
            description="fraction of neighbouring search lines that must be inliers at a pose found by a search",
        ),
    ] = 0.42


class CornerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When an intersection counts as a corner."""

    smallest_angle_rad: Annotated[
        float, Meta(ge=0.02, le=1.5, description="smallest angle between two edges that make a corner (rad)")
    ] = 0.2
    largest_sigma_px: Annotated[
        float, Meta(ge=0.01, le=10.0, description="largest standard deviation of a corner that may be used (px)")
    ] = 1.0
    neighbourhood_px: Annotated[
        float,
        Meta(
            ge=2.0,
            le=100.0,
            description="stretch of each edge next to the corner that must show half as well as its rest (px)",
        ),
    ] = 16.0


class SearchSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far around the prediction a lost gripper is looked for."""

    reach_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.1,
            description="range of the TCP's shift that is searched, across the optical axis and along it (m)",
        ),
    ] = 0.012
    turn_rad: Annotated[
        float, Meta(ge=0.0, le=0.5, description="range of the turn about the optical axis that is searched (rad)")
    ] = 0.08
    tilt_rad: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.5,
            description="range of the turn about the axes across the optical axis that is searched (rad)",
        ),
    ] = 0.08
    coarse_columns: Annotated[
        int,
        Meta(ge=64, le=1024, description="width of the reduced image, as far as the gripper can be in it (columns)"),
    ] = 160
    starts: Annotated[int, Meta(ge=1, le=64, description="candidate poses that are tried on the full image")] = 12
    eager_frames: Annotated[
        int,
        Meta(ge=1, le=1000, description="largest number of successive doubtful frames that may search a wider range"),
    ] = 4
    refill_frames: Annotated[
        int, Meta(ge=1, le=100000, description="good frames after which one more frame may search a wider range")
    ] = 60
    patient_every: Annotated[
        int,
        Meta(
            ge=1,
            le=1000,
            description="once the gripper has been lost for longer than its transform is held, it is searched "
            "for in every n-th frame",
        ),
    ] = 15


class MeasurementSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From the image to edge points and corners."""

    sampling: SamplingSettings = SamplingSettings()
    edges: EdgeSettings = EdgeSettings()
    consensus: RobustFitSettings = RobustFitSettings()
    corners: CornerSettings = CornerSettings()
    search: SearchSettings = SearchSettings()
    relinearise_px: Annotated[
        float,
        Meta(
            ge=0.05,
            le=5.0,
            description="motion away from the prediction beyond which the prediction is computed again (px)",
        ),
    ] = 1.0

    def with_response(self, taught: bool) -> MeasurementSettings:
        """The same with what a response that isn't known adds to the standard deviation of every edge, which was
        ``taught`` or not.
        """
        if self.edges.response != "unknown":
            return self
        floor_px = math.hypot(self.consensus.edge_floor_px, TAUGHT_SIGMA_PX if taught else UNKNOWN_SIGMA_PX)
        return msgspec.structs.replace(self, consensus=msgspec.structs.replace(self.consensus, edge_floor_px=floor_px))
