"""Colours (RGBA, 0..255) that the recording uses, the same meaning everywhere."""

from __future__ import annotations

from gripmon.model.records import State, Verdict

Colour = tuple[int, int, int, int]

GOOD: Colour = (70, 200, 110, 255)
DOUBTFUL: Colour = (245, 175, 50, 255)
BAD: Colour = (235, 75, 75, 255)
IDLE: Colour = (140, 145, 155, 255)
BUSY: Colour = (80, 150, 240, 255)
REPAIR: Colour = (180, 110, 240, 255)

PREDICTED: Colour = (60, 200, 255, 255)
EDGE_USED: Colour = (70, 235, 120, 255)
EDGE_REFUSED: Colour = (255, 70, 70, 255)
CORNER_USED: Colour = (255, 225, 60, 255)
CORNER_REFUSED: Colour = (255, 120, 60, 255)
GRIPPER_FACE: Colour = (150, 160, 175, 110)
REFERENCE: Colour = (255, 255, 255, 255)
BACKGROUND: Colour = (16, 18, 22, 255)  # also where the viewer is set to a light theme: the reference is white
WHOLE: Colour = (225, 228, 235, 255)  # a length or a share, beside its parts along the axes
SHIFT: Colour = (255, 90, 200, 255)

AXES: tuple[Colour, Colour, Colour] = ((240, 90, 90, 255), (90, 205, 105, 255), (95, 150, 255, 255))

STATES: dict[State, Colour] = {
    State.ACQUIRING: BUSY,
    State.TRACKING: GOOD,
    State.DRIFTING: DOUBTFUL,
    State.RECALIBRATING: REPAIR,
    State.OCCLUDED: (240, 130, 60, 255),
    State.LOST: BAD,
    State.STALE: IDLE,
}
VERDICTS: dict[Verdict, Colour] = {Verdict.VALID: GOOD, Verdict.SUSPECT: DOUBTFUL, Verdict.UNKNOWN: IDLE}


def faded(colour: Colour, alpha: int) -> Colour:
    return (*colour[:3], alpha)
