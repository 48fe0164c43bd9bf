"""Compiling before the first frame what every frame needs."""

from __future__ import annotations

import numpy as np

from gripmon.track.edges import prediction_kernel
from gripmon.track.edges.evidence import agreeing_shares, edge_means
from gripmon.track.edges.lines import CornerGeometry, intersect_edges, warm_up_joint
from gripmon.track.edges.prediction import EdgeLayout, PredictedCorners, Prediction
from gripmon.track.edges.profiles import (
    Candidates,
    Edgels,
    blur_px,
    estimate_noise,
    find_candidates,
    profile_offsets_px,
    read_profiles,
    weigh,
)
from gripmon.track.edges.robust_fit import Prior, RobustFit, assess, contradictions_without, fit_irls
from gripmon.track.edges.settings import CornerSettings, EdgeSettings, RobustFitSettings, SamplingSettings
from gripmon.track.edges.settling import corner_rms


def warm_up_profiles() -> None:
    """Compile, or load what was compiled before, what reads grey and colour images of eight bits.

    Other images are compiled for, once on a machine, when the first of them comes.
    """
    prediction = _of_one_edge()
    for shape in ((9, 9), (9, 9, 3)):
        profiles = read_profiles(np.zeros(shape, dtype=np.uint8), prediction.map_x, prediction.map_y)
    candidates = find_candidates(profiles, prediction.ok, estimate_noise(profiles), 255.0, EdgeSettings())
    weigh(candidates, prediction, np.zeros(1, dtype=np.int8), RobustFitSettings())
    blur_px(candidates, np.zeros(0), EdgeSettings())
    edge_means(candidates.sample, np.zeros(0), np.zeros(0), prediction.layout.edge, 1)


def warm_up_fit() -> None:
    """The same for the joint fit."""
    edgels, prior, start, settings = _no_edgels(), Prior(np.zeros(6), np.ones(6)), np.zeros(6), RobustFitSettings()
    consensus = fit_irls(edgels, prior, start, settings)
    assess(edgels, consensus, prior.information)
    contradictions_without(edgels, prior, start, settings)


def warm_up_geometry() -> None:
    """The same for the prediction of what will be seen, and for corners where fitted edges meet."""
    edgels, nothing = _no_edgels(), np.zeros(0, dtype=np.intp)
    prediction = edgels.prediction
    places = nothing.reshape(0, 4)
    geometry = CornerGeometry(nothing, nothing, nothing, np.zeros((0, 3)), places, np.zeros(1, dtype=np.intp))
    fitted = RobustFit(
        np.zeros(6), np.zeros(0), np.zeros(0), np.zeros((6, 6)), 1.0, 1.0, np.zeros(4, dtype=np.bool_), np.zeros(1),
        np.zeros(1, dtype=np.bool_), 0.0,
    )  # fmt: skip
    corners = intersect_edges(edgels, fitted, np.zeros(0), geometry, CornerSettings())
    warm_up_joint()
    prediction.moved_px(fitted.xi)
    here, edge, points_m = prediction.cam_T_grip, prediction.layout.edge, prediction.corners.cam_m
    corner_rms(corners.xy, corners.usable, points_m, here, here, prediction.corners.d_uv_d_xy)
    agreeing_shares(np.zeros(1, dtype=np.intp), edge, prediction.ok, fitted.supported, 1)
    _predict(prediction)


def _predict(prediction: Prediction) -> None:
    """The geometry behind such a prediction."""
    by, layout, ends, d_uv = prediction_kernel, prediction.layout, np.ones((4, 3)), np.ones((4, 2, 3))
    translation, places = prediction.cam_T_grip[:3, 3], np.zeros((1, 2, 2))
    by.sampled_ranges(places, np.ones((1, 2)), np.ones(1, dtype=bool), 0.0, 1.0)
    lever, points_cam_m = by.levers(ends, ends, layout.fraction, translation)
    by.across_edges(d_uv, ends, ends, lever, layout.edge, np.zeros((1, 3)), True)
    by.maps(prediction.uv_px, prediction.normal, *np.zeros((2, 3), dtype=np.float32))
    _, way_xy, *_ = by.ideal_lines(points_cam_m, layout.edge, layout.edges, layout.first, 1)
    by.gains(points_cam_m, prediction.normal, d_uv, way_xy)


def _no_edgels() -> Edgels:
    """No edgel hypothesis, of one edge; only its types count."""
    none = np.zeros(0)
    candidates = Candidates(np.zeros(0, dtype=np.intp), none, none, none, none, none, 1.0, 255.0)
    return Edgels(candidates, _of_one_edge(), none, np.zeros(1), np.zeros(1))


def _of_one_edge() -> Prediction:
    """A prediction with four search lines on one edge and one corner; only its types count."""
    one, point = np.ones(1, dtype=bool), np.zeros((1, 2))
    edge, edges = np.zeros(4, dtype=np.intp), np.zeros(1, dtype=np.intp)
    corners = PredictedCorners(np.ones((1, 3)), np.zeros((1, 3)), point, point, np.ones((1, 2, 2)), one, one)
    place = np.tile(profile_offsets_px(SamplingSettings().reach_px), (1, 4, 1)).astype(np.float32)
    return Prediction(
        cam_T_grip=np.eye(4),
        jaw_opening_m=0.0,
        layout=EdgeLayout(edge, np.linspace(0.0, 1.0, 4), edges, edges, one, one),
        uv_px=np.zeros((4, 2)),
        normal=np.ones((4, 2)),
        jacobian=np.ones((4, 6)),
        xy=np.zeros((4, 2)),
        way_xy=np.ones((4, 2)),
        along=np.zeros(4),
        gain=np.ones(4),
        line_origin=point,
        line_direction=point,
        ok=np.ones(4, dtype=bool),
        map_x=place,
        map_y=place,
        corners=corners,
        edge_spread_m=np.zeros(1),
        independence=np.ones(1),
    )
