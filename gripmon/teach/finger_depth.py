"""Position in space, up to scale, of finger outlines that one camera sees from one side, by perspective.

Long edges along a finger are parallel in space, so their images meet in one point, the vanishing point, which gives the
fingers' direction (Caprile and Torre 1990).  Fingertips end square to it: their outline lies in the contact plane, and
the long edges run back from it.  The outline of a round tip lies in the plane of the finger's sides instead: it leaves
them smoothly, whereas an outline in the contact plane would bend by 90 degrees, which is invisible from only a few
places.  Where edges don't meet in a point, or give a finger that is hardly longer than its tip, the outline is taken as
flat, tilted as fingers before a wrist camera usually are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gripmon.model.records import Array
from gripmon.teach.straight_pieces import LONGEST_CUT_PX
from gripmon.teach.vanishing import PARALLEL_RAD, Outline, finger_direction, missed_rad, sight_of, tip_centre

LEAST_PLANE_COSINE = 0.25
"""Cosine between line of sight and fingers below which the contact plane is too oblique to place corners on it."""
CORNER_TURN_SHARE = 0.75
"""Least part of the turn, within the length of a cut corner, that a corner makes at its first vertex.  On the
tightest curve that isn't a corner, three pieces of 6 px, each vertex makes a third; their scatter may double that."""
LARGE_TIP = 0.3
"""Size of a fingertip over its distance from which it has to be seen together with more of its finger: 30 mm at 100 mm,
a wide tip before a camera that stands near.
"""
_ROUNDS = 4
USUAL_TILT_RAD = math.radians(35.0)
"""Angle between the fingers and the line of sight to their tips, where nothing tells: wrist cameras look along their
fingers at 20 to 50 degrees."""
USUAL_TILT_SIGMA_RAD = math.radians(15.0)
"""Its standard deviation, and that of the plane's tilt to either side."""
FLAT_SIGMA_RAD = math.radians(26.0)
"""Standard deviation of the tilt of a plane where it isn't known: anything up to 45 degrees (45 / sqrt(3))."""


@dataclass(frozen=True)
class PlacedOutlines:
    """Outlines in space, the TCP at unit depth.  ``points`` of each finger (v, 3) in the camera frame, NaN where
    unknown; ``kept`` pieces of each; ``rotation`` (3, 3) of ``cam_T_grip``, ``tcp`` (3,) with z = 1; ``flat``: the
    fingers' direction is unknown; ``sigma_rad`` (3,) of the rotation, camera axes.  ``round_tips``: some tips are taken
    to lie in the plane of their sides; ``by_motion``: depths come from the fingers' motion with the jaws;
    ``tcp_covariance`` (3, 3) then; ``tilt_sigma_rad`` of their plane, as a gripper file has it; ``assumed``: nothing
    tells it.
    """

    points: tuple[Array, ...]
    kept: tuple[tuple[tuple[int, int], ...], ...]
    rotation: Array
    tcp: Array
    flat: bool
    sigma_rad: Array
    round_tips: bool = False
    by_motion: bool = False
    normal: Array | None = None
    tcp_covariance: Array | None = None
    assumed: bool = False
    tilt_sigma_rad: float = 0.0


def place(fingers: Sequence[Outline], rotation: Array | None = None, tcp: Array | None = None) -> PlacedOutlines:
    """The fingers in space, from their perspective; or, with ``rotation`` (3, 3) and ``tcp`` (3,) at unit depth, as a
    calibration has them.
    """
    given = None if rotation is None else rotation[:, 2]
    direction, sigma = (given, 0.0) if given is not None else finger_direction(fingers)
    centre = tip_centre(fingers)
    ray = sight_of(centre)
    if direction is not None and abs(float(direction @ ray) / float(np.linalg.norm(ray))) < LEAST_PLANE_COSINE:
        direction = None
    if direction is None or sigma > FLAT_SIGMA_RAD:
        return _flat(fingers, centre, rotation, tcp)
    runs = [_tip_and_sides(finger, _parallel_to(finger, direction)) for finger in fingers]
    if not all(sides for _, sides in runs):
        return _flat(fingers, centre, rotation, tcp)
    plane_at = ray if tcp is None else tcp
    turns = [_smooth_turns(finger, tip, sides) for finger, (tip, sides) in zip(fingers, runs, strict=True)]
    points = [
        _in_space(finger, tip, sides, direction, plane_at, turn)
        for finger, (tip, sides), turn in zip(fingers, runs, turns, strict=True)
    ]
    tips = [sorted(tip) for tip, _ in runs]
    if not all(_is_plausible(p, tip, direction) for p, tip in zip(points, tips, strict=True)):
        return _flat(fingers, centre, rotation, tcp)
    if rotation is None or tcp is None:
        inner = innermost([p[t] for p, t in zip(points, tips, strict=True)])
        # Between the fingers, at their ends: the innermost parts of round tips lie farther back.
        tcp = np.mean(inner, axis=0)
        tcp = tcp + direction * float(direction @ (plane_at - tcp))
        points, tcp = [p / tcp[2] for p in points], tcp / tcp[2]
        rotation = _axes(inner, direction, across=_across_inner_edges(fingers, points, tips, direction))
    kept = tuple(
        tuple(piece for piece in finger.pieces if np.isfinite(p[list(piece)]).all())
        for finger, p in zip(fingers, points, strict=True)
    )
    placed = tuple(points), kept, rotation, tcp, False, np.full(3, sigma)
    return PlacedOutlines(*placed, any(turns), tilt_sigma_rad=sigma)


def _parallel_to(finger: Outline, direction: Array) -> set[tuple[int, int]]:
    """The pieces whose images meet in the vanishing point of a direction (3,)."""
    return {
        piece
        for piece in finger.pieces
        if missed_rad(direction, 0.5 * finger.xy[list(piece)].sum(axis=0)[None], _unit(finger.xy, piece)[None])[0]
        < 2.0 * PARALLEL_RAD
    }


def _more_along(finger: Outline, ahead: Array) -> set[tuple[int, int]]:
    """The pieces that run more along a direction (2,) of the image than across it."""
    least = math.sqrt(0.5) * float(np.linalg.norm(ahead))
    return {piece for piece in finger.pieces if abs(float(_unit(finger.xy, piece) @ ahead)) > least}


def _tip_and_sides(finger: Outline, along: set[tuple[int, int]]) -> tuple[set[int], list[tuple[int, int]]]:
    """Vertices of the tip's outline, and the pieces ``along`` the finger that follow it on both sides, outwards first.
    The rest, e.g. a body that carries the finger, has another depth.
    """
    links: dict[int, list[tuple[int, tuple[int, int]]]] = {}
    for a, b in finger.pieces:
        links.setdefault(a, []).append((b, (a, b)))
        links.setdefault(b, []).append((a, (a, b)))
    first = int((finger.xy @ finger.outwards).argmax())
    tip, sides, work = {first}, [], [(first, False)]
    seen: set[tuple[int, int]] = set()
    while work:
        at, behind = work.pop()
        for other, piece in links.get(at, ()):
            if piece in seen:
                continue
            if piece in along:
                seen.add(piece)
                sides.append((at, other))
                work.append((other, True))
            elif not behind:
                seen.add(piece)
                tip.add(other)
                work.append((other, False))
    return tip, sides


def _unit(xy: Array, piece: tuple[int, int]) -> Array:
    way = xy[piece[1]] - xy[piece[0]]
    return np.asarray(way / np.linalg.norm(way))


def _in_space(
    finger: Outline,
    tip: set[int],
    sides: list[tuple[int, int]],
    direction: Array,
    plane_at: Array,
    turns: Sequence[int],
) -> Array:
    """Vertices (v, 3): the tip's in the contact plane, or in the plane of the sides, which join it at ``turns``."""
    out = np.full((len(finger.xy), 3), np.nan)
    height = float(direction @ plane_at)
    for k in tip:
        ray = sight_of(finger.xy[k])
        out[k] = ray * (height / float(direction @ ray))
    if turns:
        _into_plane_of_sides(out, sorted(tip), turns, direction, height)
    for start, end in sides:
        if np.isfinite(out[end]).all() or not np.isfinite(out[start]).all():
            continue
        out[end] = nearest_on_ray(sight_of(finger.xy[end]), out[start], direction)
    out[out[:, 2] <= 0.0] = np.nan
    return out


def _is_plausible(points: Array, tip: Sequence[int], direction: Array) -> bool:
    """Whether a finger, its vertices (v, 3) at about unit depth, has a tip that is small, or seen back from its tip by
    twice the side of a square as large as that.  A side that tapers doesn't run along the finger: in the contact plane
    it makes a tip about as large as that is long.
    """
    back = points @ direction
    large = float(np.linalg.norm(np.ptp(points[tip], axis=0)))
    return large < LARGE_TIP or bool(math.sqrt(2.0) * large < np.nanmax(back) - np.nanmin(back))


def _smooth_turns(finger: Outline, tip: set[int], sides: Sequence[tuple[int, int]]) -> list[int]:
    """The two vertices at which a finger's sides turn smoothly into its tip's curve; none where one is a corner."""
    first = [(start, end) for start, end in sides if start in tip]
    smooth = len(first) == 2 and all(leaves_smoothly(finger, tip, *side) for side in first)
    return [start for start, _ in first] if smooth else []


def leaves_smoothly(finger: Outline, tip: set[int], start: int, behind: int) -> bool:
    """Whether a side that comes from ``behind`` turns smoothly into a curve of the ``tip`` at its ``start``; a corner
    makes the turn all at once.
    """
    way, at, travelled_px, turns = finger.xy[start] - finger.xy[behind], start, 0.0, []
    used = {behind}
    while travelled_px < LONGEST_CUT_PX:
        used.add(at)
        onwards = [
            (next(iter({*piece} - {at})), length)
            for piece, length in zip(finger.pieces, finger.length_px.tolist(), strict=True)
            if at in piece and {*piece} - {at} <= tip - used
        ]
        if not onwards:
            break
        to, length_px = onwards[0]
        ahead = finger.xy[to] - finger.xy[at]
        turns.append(math.atan2(way[0] * ahead[1] - way[1] * ahead[0], float(way @ ahead)))
        way, at, travelled_px = ahead, to, travelled_px + length_px
    return bool(turns) and abs(turns[0]) < CORNER_TURN_SHARE * abs(sum(turns))


def _into_plane_of_sides(points: Array, tip: list[int], turns: Sequence[int], direction: Array, height: float) -> None:
    """Move the tip's vertices from the contact plane along their lines of sight into the plane of the two sides, which
    begin at ``turns`` equally far from the tip; then scale so that the outermost vertex lies in the contact plane.
    """
    normal = np.cross(direction, points[turns[1]] - points[turns[0]])
    rays = points[tip] / points[tip][:, 2:]
    flat = rays * (float(normal @ points[turns[0]]) / (rays @ normal))[:, None]
    points[tip] = flat * (height / float((flat @ direction).max()))


def nearest_on_ray(ray: Array, start: Array, direction: Array) -> Array:
    """The point (3,) of a line of sight that is nearest to the line through ``start`` parallel to the fingers."""
    normal = np.cross(direction, np.cross(ray, direction))
    return np.asarray(ray * (float(normal @ start) / float(normal @ ray)))


def _flat(fingers: Sequence[Outline], centre: Array, rotation: Array | None, tcp: Array | None) -> PlacedOutlines:
    """All fingers in one plane through the TCP: that of a calibration's x and z axes if it is seen well, or one in
    which the fingers point away from the camera as they usually do.
    """
    at = sight_of(centre) if tcp is None else tcp
    sight, across, aside = _usual_axes(fingers, at)
    direction = math.cos(USUAL_TILT_RAD) * sight + math.sin(USUAL_TILT_RAD) * aside
    normal = np.cross(direction, across)
    assumed = rotation is None or abs(float(rotation[:, 1] @ sight)) <= math.sin(math.radians(15.0))
    if rotation is not None and not assumed:
        normal = rotation[:, 1]
    points = [
        np.array([sight_of(xy) * float(normal @ at) / float(normal @ sight_of(xy)) for xy in f.xy]) for f in fingers
    ]
    for own in points:
        own[own[:, 2] <= 0.0] = np.nan
    sigma = np.zeros(3)
    if rotation is None or tcp is None:
        # Of tapered fingers, and of parallel ones, the innermost vertices of all may be those at their roots.
        tips = [sorted(_tip_and_sides(f, _more_along(f, aside[:2]))[0]) for f in fingers]
        foremost = int((fingers[0].xy @ fingers[0].outwards).argmax())
        tips = tips if len(fingers) > 1 else [[foremost]]
        ends = [own[tip] for own, tip in zip(points, tips, strict=True)]
        inner = innermost(ends)
        tcp = np.mean(inner, axis=0)
        points, tcp = [p / tcp[2] for p in points], tcp / tcp[2]
        rotation = _axes(inner, direction, normal)
        sigma = np.array([USUAL_TILT_SIGMA_RAD, USUAL_TILT_SIGMA_RAD, 0.0])
    kept = tuple(
        tuple(piece for piece in f.pieces if np.isfinite(own[list(piece)]).all())
        for f, own in zip(fingers, points, strict=True)
    )
    made = tuple(points), kept, rotation, tcp, True, sigma
    return PlacedOutlines(
        *made, normal=normal, assumed=assumed, tilt_sigma_rad=USUAL_TILT_SIGMA_RAD if assumed else 0.0
    )


def _usual_axes(fingers: Sequence[Outline], at: Array) -> tuple[Array, Array, Array]:
    """Unit vectors (3,) of the line of sight to a point, as far as it is square to the jaws; across the fingers; and
    square to both, to where the fingers point in the image.  Two fingers' tips are taken to be equally far away: the
    way from one to the other shows the jaws' direction better than a short piece of a finger shows its own.
    """
    outwards, sight = np.sum([f.outwards for f in fingers], axis=0), at / np.linalg.norm(at)
    if len(fingers) == 1:
        aside = np.array([*outwards, 0.0]) - sight * float(sight[:2] @ outwards)
        aside /= np.linalg.norm(aside)
        return sight, np.cross(sight, aside), aside
    tips = [f.xy.mean(axis=0) for f in fingers]
    for _ in range(_ROUNDS):
        way = (tips[-1] - tips[0]) / np.linalg.norm(tips[-1] - tips[0])
        ahead = np.array([way[1], -way[0]])
        ahead *= 1.0 if float(ahead @ outwards) > 0.0 else -1.0
        tips = [f.xy[int((f.xy @ ahead).argmax())] for f in fingers]
    across = np.array([*way, 0.0])
    sight = sight - across * float(across @ sight)
    sight /= np.linalg.norm(sight)
    aside = np.cross(across, sight)
    return sight, across, aside * (1.0 if float(aside[:2] @ ahead) > 0.0 else -1.0)


def innermost(tips: Sequence[Array]) -> list[Array]:
    """Mean (3,) of the vertices of the first and the last finger's tip (v, 3) that are nearest to the other one; of a
    single tip, of all its vertices.
    """
    points = [tip[np.isfinite(tip).all(axis=1)] for tip in (tips[0], tips[-1])]
    if len(tips) == 1:
        return [points[0].mean(axis=0)]
    inner = [p.mean(axis=0) for p in points]
    for _ in range(_ROUNDS):
        across = inner[1] - inner[0]
        far = [p @ across / float(np.linalg.norm(across)) for p in points]
        # Vertices within a tenth of the gap of the innermost one: corners in a rectangle have two on each finger.
        gap = abs(float(far[1].min() - far[0].max()))
        near = far[0] > far[0].max() - 0.1 * gap, far[1] < far[1].min() + 0.1 * gap
        inner = [p[chosen].mean(axis=0) for p, chosen in zip(points, near, strict=True)]
    return inner


def _across_inner_edges(
    fingers: Sequence[Outline], points: Sequence[Array], tips: Sequence[Sequence[int]], direction: Array
) -> Array | None:
    """Direction (3,) square to the edges of two fingertips that face each other, along which the jaws close; None where
    they have no such edge.
    """
    if len(fingers) != 2:
        return None
    middles = [np.nanmean(p[list(t)], axis=0) for p, t in zip(points, tips, strict=True)]
    across = middles[1] - middles[0]
    across = across / np.linalg.norm(across)
    total = np.zeros(3)
    for finger, p, tip, middle, side in zip(fingers, points, tips, middles, (1.0, -1.0), strict=True):
        ways = [
            p[b] - p[a]
            for a, b in finger.pieces
            if a in tip and b in tip and side * float((0.5 * (p[a] + p[b]) - middle) @ across) > 0.0
        ]
        most = math.sin(math.radians(30.0))
        steep = [w for w in ways if max(abs(float(w @ across)), abs(float(w @ direction))) < most * np.linalg.norm(w)]
        if not steep:
            return None
        longest = max(steep, key=lambda way: float(np.linalg.norm(way)))
        total = total + longest * (1.0 if float(longest @ total) >= 0.0 else -1.0)
    square = np.cross(total, direction)
    return np.asarray(square * np.sign(float(square @ across)))


def _axes(tips: Sequence[Array], direction: Array, facing: Array | None = None, across: Array | None = None) -> Array:
    """Rotation (3, 3) of ``cam_T_grip``: x from the first finger to the last, or ``across``, z out of the gripper."""
    if across is not None:
        x = across / np.linalg.norm(across)
        return np.column_stack([x, np.cross(direction, x), direction])
    x = tips[-1] - tips[0] if len(tips) > 1 else np.cross(direction, facing if facing is not None else [0.0, 0.0, 1.0])
    x = x - direction * float(direction @ x)
    if len(tips) == 1 and x[0] < 0.0:
        x = -x
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])
