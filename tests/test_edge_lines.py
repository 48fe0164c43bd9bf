"""Lines through edge points and the corners where they meet, against least squares by NumPy's own solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_robust_fit import (
    EDGES,
    GRIPPER,
    PREDICTION,
    REPORTED,
    SETTINGS,
    true_candidates,
    votes_for,
    with_clutter,
)

from gripmon.model.records import CornerFault
from gripmon.track.edges.lines import CornerGeometry, intersect_edges
from gripmon.track.edges.profiles import Edgels
from gripmon.track.edges.robust_fit import RobustFit, fit_irls
from gripmon.track.edges.settings import CornerSettings

GEOMETRY = CornerGeometry.of(GRIPPER, PREDICTION, CornerSettings())


def fitted(seed: int) -> tuple[Edgels, RobustFit]:
    """Edge points with clutter, and edges that err as wholes; some may be cut off."""
    rng = np.random.default_rng(seed)
    found = with_clutter(rng, 0.2, 0.5) if seed % 2 else true_candidates(rng)
    edgels = votes_for(found, edge_spread_px=rng.uniform(0.01, 0.1, EDGES))
    edgels = replace(edgels, cut_off_px=rng.uniform(0.0, 0.1, EDGES))
    return edgels, fit_irls(edgels, REPORTED, np.zeros(7), SETTINGS)


def line_of(edgels: Edgels, weight: np.ndarray, edge: int) -> tuple[np.ndarray, np.ndarray]:
    """Offset and slope (2,) of an edge against its predicted line, and their covariance (2, 2)."""
    own = (weight > 0.0) & (PREDICTION.layout.edge[edgels.candidates.sample] == edge)
    sample = edgels.candidates.sample[own]
    gain = PREDICTION.gain[sample]
    root = np.sqrt(weight[own]) / np.abs(gain)
    design = np.column_stack([np.ones(len(sample)), PREDICTION.along[sample]]) * root[:, None]
    solution = np.linalg.lstsq(design, root * gain * edgels.candidates.offset_px[own], rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design)
    shared_px = np.hypot(edgels.edge_spread_px[edge], edgels.cut_off_px[edge])
    covariance[0, 0] += (shared_px * PREDICTION.gain[np.flatnonzero(PREDICTION.layout.edge == edge)[0]]) ** 2
    return solution, covariance


@pytest.mark.parametrize("seed", range(6))
def test_corners_are_where_least_squares_puts_them(seed: int):
    """Each line through its own points; each corner where its lines, weighted by their variance there, meet best."""
    edgels, consensus = fitted(seed)
    corners = intersect_edges(edgels, consensus, consensus.weight, GEOMETRY, CornerSettings())
    assert corners.usable.sum() >= 2
    for i in np.flatnonzero(corners.usable):
        rows, wanted = [], []
        for edge in GRIPPER.edges_at_corner(i):
            if not consensus.edge_seen[edge]:
                continue
            (offset, slope), covariance = line_of(edgels, consensus.weight, edge)
            direction, origin = PREDICTION.line_direction[edge], PREDICTION.line_origin[edge]
            along = (PREDICTION.corners.xy[i] - origin) @ direction
            at = np.array([1.0, along])
            right = np.array([-direction[1], direction[0]])
            root = 1.0 / np.sqrt(at @ covariance @ at)
            rows.append(root * (right - slope * direction))
            wanted.append(root * (offset + slope * along))
        shift = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
        covariance = np.linalg.inv(np.array(rows).T @ np.array(rows))
        lens = PREDICTION.corners.d_uv_d_xy[i]
        np.testing.assert_allclose(corners.xy[i], PREDICTION.corners.xy[i] + shift, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(corners.uv_px[i], PREDICTION.corners.uv_px[i] + lens @ shift, rtol=0.0, atol=1e-8)
        np.testing.assert_allclose(corners.covariance_xy[i], covariance, rtol=1e-8, atol=1e-8 * covariance.max())
        largest_px2 = np.linalg.eigvalsh(lens @ covariance @ lens.T)[-1]
        assert corners.sigma_px[i] == pytest.approx(np.sqrt(largest_px2), rel=1e-8)


def test_limits_refuse_what_is_uncertain_or_meets_at_a_small_angle():
    edgels, consensus = fitted(0)
    usual = intersect_edges(edgels, consensus, consensus.weight, GEOMETRY, CornerSettings())
    middle = float(np.median(usual.sigma_px[usual.usable]))
    fewer = intersect_edges(edgels, consensus, consensus.weight, GEOMETRY, CornerSettings(largest_sigma_px=middle))
    np.testing.assert_array_equal(fewer.usable, usual.usable & (usual.sigma_px <= middle))
    refused = usual.usable & ~fewer.usable
    assert refused.any() and {fewer.fault[i] for i in np.flatnonzero(refused)} == {CornerFault.UNCERTAIN}
    steep = intersect_edges(edgels, consensus, consensus.weight, GEOMETRY, CornerSettings(smallest_angle_rad=1.5))
    assert CornerFault.PARALLEL in steep.fault
    for corners in (fewer, steep):
        assert np.isnan(corners.xy[~corners.usable]).all() and np.isfinite(corners.xy[corners.usable]).all()
        assert [fault is None for fault in corners.fault] == corners.usable.tolist()


def test_a_corner_is_hidden_where_its_edges_stop_beside_it():
    """An edge shows next to a corner at least half as well as elsewhere, on two edges of it."""
    edgels, consensus = fitted(0)
    usual = intersect_edges(edgels, consensus, consensus.weight, GEOMETRY, CornerSettings())
    corner = int(np.flatnonzero(usual.usable)[0])
    supported = consensus.supported.copy()
    for spoke in np.flatnonzero(GEOMETRY.corner == corner):
        begin, end, _, _ = GEOMETRY.part[spoke]
        supported[begin:end] = False
    covered = replace(consensus, supported=supported)
    found = intersect_edges(edgels, covered, consensus.weight, GEOMETRY, CornerSettings())
    assert found.fault[corner] is CornerFault.HIDDEN
    nothing = intersect_edges(edgels, covered, np.zeros_like(consensus.weight), GEOMETRY, CornerSettings())
    assert not nothing.usable.any() and np.isnan(nothing.lines).all()
