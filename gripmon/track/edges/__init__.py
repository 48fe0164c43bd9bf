"""Fingertip corners from images: predicted edges, sub-pixel edgel hypotheses, one joint fit, intersections."""

from gripmon.track.edges.ends import FingerEnds, FingerEndsSeen, edges_at_ends, own_steps
from gripmon.track.edges.evidence import FingerMeter, agreeing_fingers, edge_residuals_px
from gripmon.track.edges.measure import FingertipMeter, Patience, Sought
from gripmon.track.edges.readout import edge_sums, trace_of
from gripmon.track.edges.robust_fit import VAGUE_M, VAGUE_RAD, NormalEquations, prior_information
from gripmon.track.edges.roles import has_lone_end, inner_edges, receding, sides
from gripmon.track.edges.settings import MeasurementSettings, SearchSettings
from gripmon.track.edges.settling import JAW_UNREPORTED_SIGMA_M, Effort, Expected, Measurement
from gripmon.track.edges.taught import TaughtEdges, TaughtModel
from gripmon.track.edges.warming import warm_up_fit, warm_up_geometry, warm_up_profiles

__all__ = [
    "JAW_UNREPORTED_SIGMA_M",
    "VAGUE_M",
    "VAGUE_RAD",
    "Effort",
    "Expected",
    "FingerEnds",
    "FingerEndsSeen",
    "FingerMeter",
    "FingertipMeter",
    "Measurement",
    "MeasurementSettings",
    "NormalEquations",
    "Patience",
    "SearchSettings",
    "Sought",
    "TaughtEdges",
    "TaughtModel",
    "agreeing_fingers",
    "edge_residuals_px",
    "edge_sums",
    "edges_at_ends",
    "has_lone_end",
    "inner_edges",
    "own_steps",
    "prior_information",
    "receding",
    "sides",
    "trace_of",
    "warm_up_fit",
    "warm_up_geometry",
    "warm_up_profiles",
]
