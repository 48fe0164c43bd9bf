"""What a person may set about the measurement of one frame: the configuration's section ``monitor.corners``."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta


class SamplingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where the image is sampled around the predicted edges."""

    samples: Annotated[int, Meta(ge=24, le=4096, description="search lines over all edges together")] = 320
    reach_px: Annotated[
        float, Meta(ge=2.0, le=40.0, description="how far each search line reaches to both sides (px)")
    ] = 7.0
    end_margin_px: Annotated[
        float,
        Meta(
            ge=0.0,
            le=40.0,
            description="part of an edge at each end that is left out: the neighbour edge shows there; down to half of "
            "it where the edge is short (px)",
        ),
    ] = 4.0
    creases: Annotated[
        bool,
        Meta(description="use edges between two visible faces too; bevels shift them (taught ones are used anyway)"),
    ] = False


class EdgeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as an edgel hypothesis."""

    blur_px: Annotated[float, Meta(ge=0.4, le=5.0, description="sigma of the derivative of Gaussian (px)")] = 0.65
    noise_factor: Annotated[
        float, Meta(ge=2.0, le=50.0, description="smallest edge response in standard deviations of its noise")
    ] = 3.0
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
        Meta(ge=1.0, le=20.0, description="by how many standard deviations an edge must beat chance to count as seen"),
    ] = 4.0
    support_share: Annotated[
        float,
        Meta(ge=0.05, le=0.95, description="share of an edge's search lines that must agree for it to count as seen"),
    ] = 0.3
    trusted_share: Annotated[
        float,
        Meta(
            ge=0.05,
            le=0.95,
            description="share of neighbouring search lines that must agree where the gripper was expected",
        ),
    ] = 0.3
    found_share: Annotated[
        float,
        Meta(
            ge=0.05, le=0.95, description="share of neighbouring search lines that must agree where it was looked for"
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
            ge=0.0, le=0.1, description="shift of the TCP across the optical axis, and along it, that is searched (m)"
        ),
    ] = 0.012
    turn_rad: Annotated[
        float, Meta(ge=0.0, le=0.5, description="turn about the optical axis that is searched (rad)")
    ] = 0.08
    tilt_rad: Annotated[
        float, Meta(ge=0.0, le=0.5, description="turn about the axes across the optical axis that is searched (rad)")
    ] = 0.08
    coarse_columns: Annotated[
        int,
        Meta(ge=64, le=1024, description="width of the reduced image, as far as the gripper can be in it (columns)"),
    ] = 160
    starts: Annotated[int, Meta(ge=1, le=64, description="places that are tried on the full image")] = 12
    eager_frames: Annotated[int, Meta(ge=1, le=1000, description="doubtful frames in a row that may look further")] = 4
    refill_frames: Annotated[
        int, Meta(ge=1, le=100000, description="good frames after which one more frame may look further")
    ] = 60
    patient_every: Annotated[
        int,
        Meta(
            ge=1,
            le=1000,
            description="a gripper lost for longer than its transform is held is searched for once in N frames",
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
        float, Meta(ge=0.05, le=5.0, description="motion from the prediction after which it is computed again (px)")
    ] = 1.0
