"""The camera together with the shape of a target that isn't exact, and which way up such a target is in each image.

An unmarked target looks the same after half a turn, a square one after a quarter, so that whole views of it number its
points in different ways.  For an exact target that doesn't matter; the shape of another one is turned with it, and in
the right numbering the views agree about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import block_diag, csr_array, kron
from scipy.special import fdtrc

from gripmon.calibrate.bundle import Bundle, BundleProblem, check_fit
from gripmon.calibrate.lens_models import LensModel
from gripmon.calibrate.sighting import CalibrationError, Sighting
from gripmon.calibrate.target_shape import CHANCE, UNEVEN_TARGET, TargetPoints
from gripmon.model.camera import make_camera
from gripmon.model.geometry import invert
from gripmon.model.least_squares import Equations
from gripmon.model.records import Array

Shaped = tuple[TargetPoints, Sequence[Sighting], Bundle]
_SWEEPS = 2
"""Through all views: the first ones are numbered by few others."""


def with_shape(
    lens_model: LensModel, sightings: Sequence[Sighting], free: Array, bundle: Bundle, *, tested: bool
) -> tuple[Shaped | None, tuple[str, ...]]:
    """The target's points, the sightings numbered alike and the fit with the displacements of the points as unknowns,
    if the residuals of the exact target's fit, ``bundle``, are so alike in all images that an exact one wouldn't show
    it (or it isn't to be ``tested``); else None.  Where the shape can't be estimated, a line that says so: an image
    that doesn't tell its points would hold them flat.
    """
    target = TargetPoints.of(sightings)
    if target is None or bundle.degrees_of_freedom <= target.unknowns:
        return None, ()
    alike, flat = _numbered_alike(lens_model, sightings, free, bundle, target)
    target = TargetPoints.numbered(alike, target.places_m)
    problem = BundleProblem(lens_model, alike, free, target=target)
    if tested:
        ratio = problem.gain(flat) / target.unknowns
        # The numbering is the best of so many; of a thousand views their number is beyond floats.
        tried = 2.0 ** min(sum(math.log2(view.turns) for view in sightings if view.turns), 1000.0)
        if fdtrc(target.unknowns, bundle.degrees_of_freedom, ratio) * tried > CHANCE:
            return None, ()
    whole = sum(view.turns > 0 for view in sightings)
    if whole < len(sightings):
        right = f"images that all show it whole, as {whole} of these {len(sightings)} do"
        return None, (f"{UNEVEN_TARGET}; the ± leaves that out, its shape could be estimated from {right}",)
    try:
        found = problem.solve(flat.parameters, flat.cam_T_plate)
        check_fit(lens_model, found, free)
        make_camera(lens_model.settings(found.parameters))
    except (CalibrationError, ValueError):
        right = "a print on glass or metal is flat"
        return None, (f"{UNEVEN_TARGET}, and its shape couldn't be estimated; the ± leaves that out; {right}",)
    return (target, [replace(view, turns=1) for view in alike], found), ()


def _numbered_alike(
    lens_model: LensModel, sightings: Sequence[Sighting], free: Array, bundle: Bundle, target: TargetPoints
) -> tuple[list[Sighting], Bundle]:
    """The views of a target that looks the same when it is turned, each turned as the shape that the others show
    explains it best, with the poses of the fit to them.
    """
    views, flat = list(sightings), bundle
    open_ones = [k for k, view in enumerate(views) if view.turns > 1]
    certain = [k for k, view in enumerate(views) if view.turns == 1]
    if not open_ones or len(open_ones) + len(certain) < 2:
        return views, flat
    parts, ways, p = {}, {}, free.shape[1]
    for k in (*certain, *open_ones):
        alone = BundleProblem(lens_model, [views[k]], free, target=replace(target, index=(target.index[k],)))
        parts[k] = alone.of_shape(bundle.parameters, bundle.cam_T_plate[k], bundle.used[k])
        ways[k] = [_renumbered(target, target.turned(views[k].turns, n), p) for n in range(views[k].turns)]
    size = p + 3 * len(target.places_m)
    total, chosen = (np.zeros((size, size)), np.zeros(size)), dict.fromkeys(certain or open_ones[:1], 0)
    for k, n in chosen.items():
        total = _sum(total, parts[k], ways[k][n])
    for _ in range(_SWEEPS):
        for k in open_ones if certain else open_ones[1:]:
            if k in chosen:
                total = _sum(total, parts[k], ways[k][chosen[k]], -1.0)
            shape = _solution(total, p, target.information)
            chosen[k] = int(np.argmax([_gain(parts[k], way.T @ shape) for way in ways[k]]))
            total = _sum(total, parts[k], ways[k][chosen[k]])
    poses = list(flat.cam_T_plate)
    for k in open_ones:
        turn = target.turned(views[k].turns, chosen[k])
        views[k] = replace(views[k], plate_m=views[k].plate_m @ turn[:3, :3].T + turn[:3, 3])
        poses[k] = poses[k] @ invert(turn)
    return views, replace(flat, cam_T_plate=tuple(poses))


def _renumbered(target: TargetPoints, turn: Array, p: int) -> csr_array:
    """(p + 3m, p + 3m): from the unknowns in a view's own numbering to those after the turn; a displacement turns, too.
    A point that comes to lie where none was seen is lost.
    """
    numbers = target.numbers(target.places_m @ turn[:3, :3].T + turn[:3, 3])
    moves = csr_array(
        (np.ones(int((numbers >= 0).sum())), (numbers[numbers >= 0], np.flatnonzero(numbers >= 0))),
        shape=(len(numbers), len(numbers)),
    )
    return csr_array(block_diag([np.eye(p), kron(moves, turn[:3, :3])]))


def _sum(total: Equations, part: Equations, way: csr_array, sign: float = 1.0) -> Equations:
    """With a view's normal equations, turned."""
    return total[0] + sign * (way @ (way @ part[0]).T), total[1] + sign * (way @ part[1])


def _solution(equations: Equations, p: int, information: Array) -> Array:
    """Change of the parameters and displacements of the points by some views' equations and the prior."""
    normal, side = equations
    # Of few views the lens may be free: its own small prior keeps the equations regular.
    prior = np.concatenate([1e-9 * normal.diagonal()[:p], information.ravel()])
    normal = normal + np.diag(prior)
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    out: Array = np.linalg.solve(normal / np.outer(size, size), side / size) / size
    return out


def _gain(equations: Equations, change: Array) -> float:
    """By how much the change lowers a view's cost."""
    normal, side = equations
    return float(2.0 * side @ change - change @ normal @ change)
