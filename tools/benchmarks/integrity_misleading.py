"""Conditions of ``tools/bench integrity`` made to mislead: grasps, and things whose borders run like the fingers'.

What fixes the motion along the fingers are the tips alone; most of these offer another line for them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from benchmarks.drawn import Changes, Draw, with_
from benchmarks.integrity_conditions import MOVED, ORDINARY, bump
from benchmarks.integrity_scenes import Condition, Fingers, SceneDraft, both
from gripmon.simulate.scenario import GraspedObject, JawScript, Light, ObjectLook, Prop, Shadow

_COMES, _GOES = 0.12, 0.88  # shares of the time at which what comes is there, and leaves again


def grasp(draft: SceneDraft) -> Changes:
    """An object of any size comes, the jaws close on it, hold it, open, and it goes; the tips' near edges stay free."""
    return _held(draft, draft.uniform(0.5, 1.05) * draft.thick_m, draft.uniform(0.02, 0.05), _look(draft))


def grasp_lines(draft: SceneDraft) -> Changes:
    """The object has lines along the fingers, or along the tips, or a fold."""
    pattern = draft.one_of("lines_along_fingers", "lines_along_tips", "fold")
    look = with_(_look(draft), pattern=pattern, pitch_m=draft.uniform(0.003, 0.012))
    return _held(draft, draft.uniform(0.5, 1.6) * draft.thick_m, draft.uniform(0.02, 0.05), look)


def long_bar(draft: SceneDraft) -> Changes:
    """A bar that reaches far beyond the fingers on both sides, its borders parallel to the tips' inner edges."""
    return _held(draft, draft.uniform(0.08, 0.2), draft.uniform(0.006, 0.03), _look(draft))


def thin_plate(draft: SceneDraft) -> Changes:
    """A thin plate on edge between the fingers."""
    changes = _held(draft, draft.uniform(0.03, 0.15), draft.uniform(0.02, 0.06), _look(draft))
    width_m = draft.uniform(0.002, 0.005)
    grasped = changes["grasped"]
    return {
        "grasped": with_(grasped, size_m=(width_m, *grasped.size_m[1:])),
        "jaw": _closing(draft, max(width_m, draft.gripper.jaw_min_m)),
    }


def _held(draft: SceneDraft, thick_m: float, long_m: float, look: ObjectLook) -> Changes:
    width_m = max(draft.opening_m - draft.uniform(0.003, 0.014), 0.004, draft.gripper.jaw_min_m)
    grasped = GraspedObject(
        size_m=(width_m, thick_m, long_m),
        depth_m=draft.uniform(-0.004, 0.024),
        side_m=draft.uniform(-0.3, 0.3) * draft.thick_m,
        arrive_s=(draft.at_s(0.0), draft.at_s(_COMES)),
        leave_s=(draft.at_s(_GOES), draft.at_s(1.0)),
        look=look,
    )
    return {"grasped": grasped, "jaw": _closing(draft, width_m)}


def _closing(draft: SceneDraft, width_m: float) -> JawScript:
    """Jaws that close to a width while something is there, and open again."""
    knots = ((0.13, draft.opening_m), (0.24, width_m), (0.76, width_m), (0.87, draft.opening_m))
    return with_(draft.jaw, knots=tuple((draft.at_s(share), opening_m) for share, opening_m in knots))


def _look(draft: SceneDraft) -> ObjectLook:
    return ObjectLook(
        pattern=draft.one_of("printed", "plain", "plain", "lines_along_fingers", "lines_along_tips", "fold"),
        level_dn=draft.uniform(30.0, 220.0),
        contrast=draft.uniform(0.3, 0.8),
        pitch_m=draft.uniform(0.003, 0.015),
    )


def _prop(draft: SceneDraft, **settings: Any) -> Prop:
    """Something that comes from the side or from afar, slowly or at once, and goes again."""
    from_m = draft.one_of((0.15, 0.0, 0.0), (-0.15, 0.0, 0.0), (0.0, 0.0, 0.12))
    move_s = 0.0 if draft.chance(0.2) else _COMES * (draft.end_s - draft.start_s)
    times = {"start_s": draft.at_s(0.0), "end_s": draft.at_s(1.0), "move_s": move_s, "from_m": from_m}
    return Prop(**{**times, "look": _look(draft), **settings})


def _swaying(draft: SceneDraft) -> dict[str, Any]:
    """Half of the things beside the tips move along the fingers or towards the camera."""
    if draft.chance(0.5):
        return {}
    return {
        "sway_m": (0.0, draft.uniform(-0.004, 0.004), draft.uniform(-0.01, 0.01)),
        "sway_hz": draft.uniform(0.1, 0.6),
    }


def rim_beside(draft: SceneDraft) -> Changes:
    """A bar or rim beyond the tips, parallel to them, that hides nothing."""
    size = (draft.uniform(0.1, 0.25), draft.uniform(0.002, 0.015), draft.uniform(0.002, 0.02))
    z_m = float(draft.tip_high_m[2]) + 0.5 * size[2] + draft.uniform(0.001, 0.02)
    sway = _swaying(draft)
    centre = (0.0, draft.uniform(-0.6, 1.0) * draft.thick_m, z_m + abs(sway.get("sway_m", (0.0, 0.0, 0.0))[2]))
    return {"props": (_prop(draft, size_m=size, centre_m=centre, **sway),)}


def rim_over_tips(draft: SceneDraft) -> Changes:
    """A bar between camera and tips, parallel to them: it hides both, and its borders stand in for them."""
    size = (draft.uniform(0.15, 0.25), draft.uniform(0.003, 0.015), draft.uniform(0.012, 0.04))
    gap_m = draft.uniform(0.001, 0.01)
    y_m = float(draft.tip_low_m[1]) - 0.5 * size[1] - gap_m
    centre = (0.0, y_m, float(draft.tip_high_m[2]) - draft.uniform(0.0, 0.6) * size[2])
    from_m = draft.one_of((0.2, 0.0, 0.0), (0.0, 0.0, 0.12))
    sway = {"sway_m": (0.0, 0.0, draft.uniform(-0.004, 0.004)), "sway_hz": 0.3} if draft.chance(0.4) else {}
    return {"props": (_prop(draft, size_m=size, centre_m=centre, from_m=from_m, **sway),)}


def box_over_one(draft: SceneDraft) -> Changes:
    """A box or plate between camera and one of the fingers' tips, its borders parallel to the finger's."""
    side = draft.sign()
    outer_m = float(draft.tip_high_m[0])
    width_m = outer_m + draft.uniform(0.004, 0.03)
    size = (width_m, draft.uniform(0.002, 0.02), draft.uniform(0.03, 0.06))
    centre = (
        side * (0.5 * width_m + draft.uniform(0.0, 0.3) * draft.opening_m),
        float(draft.tip_low_m[1]) - 0.5 * size[1] - draft.uniform(0.001, 0.008),
        float(draft.tip_high_m[2]) - draft.uniform(0.2, 0.7) * size[2],
    )
    return {"props": (_prop(draft, size_m=size, centre_m=centre, from_m=(side * 0.15, 0.0, 0.0)),)}


def big_grasp(draft: SceneDraft) -> Changes:
    """What is held reaches around the tips: its front hides both of them."""
    held = grasp(draft)
    width_m = 2.0 * float(draft.tip_high_m[0]) + draft.uniform(0.0, 0.04)
    size = (width_m, draft.uniform(0.004, 0.02), draft.uniform(0.02, 0.05))
    y_m = float(draft.tip_low_m[1]) - 0.5 * size[1] - 1e-3
    centre = (0.0, y_m, float(draft.tip_high_m[2]) - draft.uniform(0.2, 0.6) * size[2])
    front = _prop(draft, size_m=size, centre_m=centre, from_m=(0.0, 0.0, 0.15), look=held["grasped"].look)
    return {**held, "props": (with_(front, move_s=_COMES * (draft.end_s - draft.start_s)),)}


def plate_behind(draft: SceneDraft) -> Changes:
    """A plate with lines along the fingers, or along the tips, fills the background."""
    pattern = draft.one_of("lines_along_fingers", "lines_along_tips")
    look = with_(_look(draft), pattern=pattern)
    centre = (0.0, 0.0, float(draft.tip_high_m[2]) + draft.uniform(0.02, 0.06))
    turn = (-draft.uniform(40.0, 70.0), 0.0, 0.0)
    sway = _swaying(draft)
    plate = _prop(draft, size_m=(0.3, 0.3, 0.002), centre_m=centre, turn_deg=turn, look=look, **sway)
    return {"props": (with_(plate, from_m=(0.0, 0.0, 0.3)),)}


def copies(draft: SceneDraft) -> Changes:
    """Copies of the fingers' outlines beside them or beyond, that move or stand still."""
    outer_m = 2.0 * float(draft.tip_high_m[0])
    shift = (
        draft.sign() * draft.uniform(0.2, 0.55) * outer_m,
        draft.uniform(0.3, 1.2) * draft.thick_m,
        draft.uniform(-0.004, 0.015),
    )
    return {"props": (_prop(draft, shape="fingers", centre_m=shift, **_swaying(draft)),)}


def mirror(draft: SceneDraft) -> Changes:
    """A glossy table beyond the tips shows the fingers upside down."""
    z_m = float(draft.tip_high_m[2]) + draft.uniform(0.001, 0.02)
    return {"props": (_prop(draft, shape="mirrored_fingers", centre_m=(0.0, 0.0, z_m), from_m=(0.0, 0.0, 0.1)),)}


def cables(draft: SceneDraft) -> Changes:
    """One to three cables hang between camera and fingers."""
    props = []
    for _ in range(int(draft.rng.integers(1, 4))):
        thick_m = draft.uniform(0.0015, 0.006)
        centre = (draft.uniform(-0.02, 0.02), float(draft.tip_low_m[1]) - draft.uniform(0.006, 0.03), 0.0)
        centre = (centre[0], centre[1], draft.uniform(-0.02, 0.01))
        turn = (0.0, draft.uniform(-80.0, 80.0), draft.uniform(-30.0, 30.0))
        sway = {"sway_m": (draft.uniform(-0.005, 0.005), 0.0, draft.uniform(-0.005, 0.005))}
        look = ObjectLook(pattern="plain", level_dn=draft.uniform(10.0, 220.0))
        props.append(_prop(draft, size_m=(0.3, thick_m, thick_m), centre_m=centre, turn_deg=turn, look=look, **sway))
    return {"props": tuple(props)}


def shadow_lines(draft: SceneDraft) -> Changes:
    """Shadows whose sharp borders run parallel to the tips pass slowly, or stand still."""
    shadows = tuple(
        Shadow(
            start_s=draft.at_s(0.0),
            end_s=draft.at_s(1.0),
            depth=draft.uniform(0.3, 0.75),
            width=draft.uniform(0.05, 0.5),
            softness=draft.uniform(0.001, 0.006),
            angle_deg=draft.sign() * 90.0 + draft.uniform(-4.0, 4.0),
            still_at=draft.uniform(0.35, 0.65) if draft.chance(0.5) else None,
        )
        for _ in range(int(draft.rng.integers(1, 3)))
    )
    return {"light": Light(shadows=shadows)}


def misleading_run(draft: SceneDraft) -> Changes:
    """Some frames show lines where the tips were, from one frame to the next; then the view is free."""
    shown = draft.one_of(rim_over_tips, box_over_one, _plate_over_all)(draft)["props"][0]
    start_s = draft.between_frames_s(draft.uniform(0.1, 0.3))
    end_s = start_s + int(draft.rng.integers(1, max(draft.frames // 3, 2))) / draft.fps
    return {"props": (with_(shown, start_s=start_s, end_s=end_s, move_s=0.0),)}


def _plate_over_all(draft: SceneDraft) -> Changes:
    """A plate with lines between camera and fingers."""
    pattern = draft.one_of("lines_along_fingers", "lines_along_tips", "fold", "printed")
    look = with_(_look(draft), pattern=pattern)
    centre = (0.0, float(draft.tip_low_m[1]) - draft.uniform(0.012, 0.02), 0.0)
    return {"props": (_prop(draft, size_m=(0.3, 0.002, 0.2), centre_m=centre, look=look),)}


def _together(*choices: Draw) -> Draw:
    """One of several changes."""
    return lambda draft: draft.one_of(*choices)(draft)


MISLEADING: tuple[Condition, ...] = (
    Condition("grasp", "an object between the fingers, held", grasp),
    Condition("grasp lines", "the object has lines along fingers or tips, or a fold", grasp_lines),
    Condition("long bar", "a long bar is held", long_bar),
    Condition("thin plate", "a thin plate is held", thin_plate),
    Condition("big grasp", "what is held hides both tips", big_grasp),
    Condition("box over one", "a box hides one tip", box_over_one),
    Condition("rim over tips", "a bar parallel to the tips hides both", rim_over_tips),
    Condition("rim beside", "a bar parallel to the tips beyond them", rim_beside),
    Condition("plate behind", "lines along fingers or tips behind them", plate_behind),
    Condition("copies", "copies of the fingers beside them", copies),
    Condition("mirror", "a mirror image of the fingers", mirror),
    Condition("cables", "cables before the fingers", cables),
    Condition("misleading run", "some frames show other lines, then the view is free", misleading_run),
    Condition("shadow lines", "sharp shadows parallel to the tips", shadow_lines),
    Condition("bump in grasp", "the mount jumps while an object is held", both(grasp, bump), wrong=MOVED, inside=False),
    Condition(
        "bump, tips hidden",
        "the mount jumps while the tips are hidden",
        both(_together(rim_over_tips, big_grasp, box_over_one), bump),
        wrong=MOVED,
        inside=False,
    ),
    Condition("bump at rim", "the mount jumps beside a bar", both(rim_beside, bump), wrong=MOVED, inside=False),
)
_WITH = {
    Fingers.ROUND_TIPS: (
        "ordinary", "clutter", "light", "blur", "jaw cycle", "cover one", "bump", "vibration", "creep", "opening wrong",
        "grasp", "grasp lines", "long bar", "rim over tips", "rim beside", "shadow lines", "bump in grasp",
        "bump, tips hidden",
    ),
    Fingers.ONE: (
        "ordinary", "clutter", "light", "cover one", "hand", "bump", "vibration", "creep", "tips worn", "long bar",
        "thin plate", "rim over tips", "rim beside", "plate behind", "copies", "shadow lines", "bump, tips hidden",
        "bump at rim",
    ),
}  # fmt: skip

OTHER_FINGERS = tuple(
    replace(condition, name=f"{fingers.value}: {condition.name}", fingers=fingers)
    for fingers, names in _WITH.items()
    for condition in (*ORDINARY, *MISLEADING)
    if condition.name in names
)
