"""Compiling before the first frame what every frame needs."""

from __future__ import annotations

import time

import numpy as np

from gripmon.track.edges import prediction_kernel
from gripmon.track.edges.evidence import agreeing_shares, edge_means
from gripmon.track.edges.lines import CornerGeometry, intersect_edges
from gripmon.track.edges.prediction import EdgeLayout, PredictedCorners, Prediction
from gripmon.track.edges.profiles import (
    blur_px,
    estimate_noise,
    find_candidates,
    profile_offsets_px,
    read_profiles,
    weigh,
)
from gripmon.track.edges.robust_fit import Prior, assess, contradictions_without, fit_irls
from gripmon.track.edges.settings import CornerSettings, EdgeSettings, RobustFitSettings, SamplingSettings
from gripmon.track.edges.settling import corner_rms


def warm_up() -> float:
    """Compile, or load what was compiled before, for grey and colour images of eight bits; the seconds that it took.

    Other images are compiled for, once on a machine, when the first of them comes.
    """
    begin_s = time.perf_counter()
    prediction, settings = _of_one_edge(), RobustFitSettings()
    for shape in ((9, 9), (9, 9, 3)):
        profiles = read_profiles(np.zeros(shape, dtype=np.uint8), prediction.map_x, prediction.map_y)
    noise = estimate_noise(profiles)
    candidates = find_candidates(profiles, prediction.ok, noise, 255.0, EdgeSettings())
    edgels = weigh(candidates, prediction, np.zeros(1, dtype=np.int8), settings)
    prior, start = Prior(np.zeros(6), np.ones(6)), np.zeros(6)
    consensus = fit_irls(edgels, prior, start, settings)
    line_weight = assess(edgels, consensus, prior.information).line_weight
    contradictions_without(edgels, prior, start, settings)
    nothing = np.zeros(0, dtype=np.intp)
    places = nothing.reshape(0, 4)
    geometry = CornerGeometry(nothing, nothing, nothing, np.zeros((0, 3)), places, np.zeros(1, dtype=np.intp))
    corners = intersect_edges(edgels, consensus, line_weight, geometry, CornerSettings())
    prediction.moved_px(consensus.xi)
    blur_px(candidates, consensus.weight, EdgeSettings())
    here, edge, points_m = prediction.cam_T_grip, prediction.layout.edge, prediction.corners.cam_m
    corner_rms(corners.xy, corners.usable, points_m, here, here, prediction.corners.d_uv_d_xy)
    agreeing_shares(np.zeros(1, dtype=np.intp), edge, prediction.ok, consensus.supported, 1)
    edge_means(candidates.sample, consensus.weight, consensus.residual_px, edge, 1)
    _predict(prediction)
    return time.perf_counter() - begin_s


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
