"""Conditions of ``tools/bench integrity`` with light, covers, motions and wrong models: what each changes in a scene.

Most scenes begin with the gripper free, as in practice; then something happens, and at the end the view is free again.
Some begin in the midst of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.drawn import Changes, Draw, change, drawn, make, one_of, uniform, whole, with_
from benchmarks.integrity_scenes import Condition, SceneDraft
from gripmon.model.records import Cause
from gripmon.simulate.scenario import (
    BentFinger,
    Bump,
    Cover,
    Creep,
    Defocus,
    FingerShape,
    Light,
    LightStep,
    Shadow,
    Vibration,
)

_BUMPED = (0.3, 0.6)
"""Where in the time in which things happen the mount jumps."""


_CLUTTER = change(
    "background",
    kind=one_of("printed", "chequer", "stripes", "blobs"),
    boxes=45,
    cables=14,
    contrast=0.9,
    motion=one_of("wander", "linear", "stop_and_go"),
    speed_m_per_s=uniform(0.06, 0.15),
)


def light(draft: SceneDraft) -> Changes:
    """Steps, a soft shadow, slow exposure; up to over-exposed or dark."""
    shadow = Shadow(
        start_s=draft.at_s(0.0),
        end_s=draft.at_s(0.9),
        depth=draft.uniform(0.3, 0.6),
        width=draft.uniform(0.3, 0.6),
        softness=draft.uniform(0.02, 0.08),
        angle_deg=draft.uniform(-90.0, 90.0),
    )
    steps = (
        LightStep(at_s=draft.between_frames_s(0.3), factor=draft.uniform(0.4, 0.8)),
        LightStep(at_s=draft.between_frames_s(0.6), factor=draft.uniform(1.3, 2.5)),
    )
    return {"light": Light(exposure=draft.uniform(0.6, 1.4), steps=steps, shadows=(shadow,), auto_exposure_s=0.3)}


def jaw_cycle(draft: SceneDraft) -> Changes:
    low, high = draft.gripper.jaw_min_m + 1e-3, draft.gripper.jaw_max_m - 1e-3
    ends = [min(max(draft.opening_m + way * draft.uniform(3e-3, 9e-3), low), high) for way in (-1.0, 0.3)]
    times = (draft.at_s(0.0), draft.at_s(0.4), draft.at_s(0.95))
    return {"jaw": with_(draft.jaw, knots=tuple(zip(times, (draft.opening_m, *ends), strict=True)))}


_SIDES = one_of("left", "right", "top", "bottom")


def _cover(kind: Any, low: float, high: float, side: Draw = _SIDES) -> Changes:
    """Something of a kind that reaches over a share of the view and stays for most of the time."""

    def cover(draft: SceneDraft) -> Cover:
        shown, reach = drawn(draft, kind), draft.uniform(low, high)
        return Cover(
            kind=shown,
            side=_SIDES(draft),
            start_s=draft.at_s(0.0),
            end_s=draft.at_s(1.0),
            move_s=draft.uniform(0.1, 0.35) * (draft.end_s - draft.start_s),
            reach=reach,
            distance_m=draft.uniform(0.03, 0.06),
        )

    return {"covers": (cover if side is _SIDES else lambda draft: with_(cover(draft), side=side(draft)),)}


def covered_run(draft: SceneDraft) -> Changes:
    """Nothing of the gripper is seen for some frames, then all of it."""
    cover = Cover(
        kind="sheet",
        side=_SIDES(draft),
        start_s=draft.between_frames_s(0.2),
        end_s=draft.between_frames_s(draft.uniform(0.25, 0.6)),
        move_s=1.0 / draft.fps,
        distance_m=0.04,
    )
    return {"covers": (cover,)}


def flash(draft: SceneDraft) -> Changes:
    """The light is far too bright, or nearly gone, for one to five frames, several times."""
    steps = []
    for share in (0.1, 0.45, 0.8):
        factor = draft.uniform(5.0, 12.0) if draft.chance(0.6) else draft.uniform(0.02, 0.08)
        start_s = draft.between_frames_s(share)
        end_s = start_s + int(draft.rng.integers(1, 6)) / draft.fps
        steps += [LightStep(at_s=start_s, factor=factor), LightStep(at_s=end_s, factor=1.0 / factor)]
    return {"light": Light(steps=tuple(steps))}


def low_contrast(draft: SceneDraft) -> Changes:
    """Fingers and table of nearly the same grey, little texture."""
    fingers = with_(draft.fingers, texture=draft.uniform(0.02, 0.06), ambient=0.8, marks=())
    level_dn = 0.85 * fingers.level_dn * draft.uniform(0.9, 1.1)
    table = with_(draft.background, kind="plain", contrast=0.1, level_dn=level_dn, boxes=0, cables=0)
    return {"fingers": fingers, "background": table}


def vibration(draft: SceneDraft) -> Changes:
    shift = (draft.sign() * draft.uniform(1e-4, 3e-4), draft.sign() * draft.uniform(1e-4, 3e-4))
    return {"mount": (Vibration(frequency_hz=draft.uniform(5.0, 17.0), tcp_shift_m=shift, start_s=draft.start_s),)}


def creep(draft: SceneDraft) -> Changes:
    shift = (draft.sign() * draft.uniform(2e-4, 1.5e-3), draft.sign() * draft.uniform(2e-4, 1.5e-3))
    return {
        "mount": (Creep(start_s=draft.start_s, time_s=draft.end_s - draft.start_s, law="linear", tcp_shift_m=shift),)
    }


def bump(draft: SceneDraft) -> Changes:
    """0.3 to 8 mm in any direction; a third of them along the fingers."""
    size_m = float(np.exp(draft.uniform(np.log(3e-4), np.log(8e-3))))
    ring = draft.one_of(0.0, 0.3)
    at_s = draft.between_frames_s(draft.uniform(*_BUMPED))
    if draft.chance(0.33):
        x, y, z = (draft.sign() * size_m * draft.cam_T_grip[:3, 2]).tolist()
        return {"mount": (Bump(at_s=at_s, ring_fraction=ring, translation_m=(x, y, z)),)}
    angle = draft.uniform(0.0, 2.0 * np.pi)
    shift = (size_m * float(np.cos(angle)), size_m * float(np.sin(angle)))
    return {"mount": (Bump(at_s=at_s, ring_fraction=ring, tcp_shift_m=shift),)}


def bump_exposed(draft: SceneDraft) -> Changes:
    """The same during the exposure of an image, which shows the gripper twice; the truth is that of its middle."""
    (knock,) = bump(draft)["mount"]
    middle_s = round(knock.at_s * draft.fps) / draft.fps
    return {"mount": (with_(knock, at_s=middle_s + draft.uniform(-0.5, 0.5) * draft.sensor.exposure_time_s),)}


def bent(draft: SceneDraft, share: float = 0.1, times: float = 1.0) -> Changes:
    shift = [times * draft.sign() * draft.uniform(2e-4, 1.5e-3) for _ in "xy"] + [0.0]
    finger = draft.one_of(*draft.gripper.finger_ids)
    bend = BentFinger(finger=finger, tip_shift_m=tuple(shift), start_s=draft.between_frames_s(share))  # type: ignore[arg-type]
    return {"bent_fingers": (bend,)}


def crash(draft: SceneDraft) -> Changes:
    """What knocks the mount bends a finger in the same moment."""
    share = draft.uniform(*_BUMPED)
    (knock,) = bump(draft)["mount"]
    mount = with_(knock, at_s=draft.between_frames_s(share))
    return bent(draft, share, times=draft.one_of(1.0, 3.0)) | {"mount": (mount,)}


def opening_wrong(draft: SceneDraft) -> Changes:
    offset_m = draft.sign() * draft.uniform(3e-4, 2e-3)
    return {"jaw": with_(jaw_cycle(draft)["jaw"], reported_offset_m=offset_m)}


def mismeasured(rng: np.random.Generator, model: dict[str, Any]) -> dict[str, Any]:
    """One finger's tip, or both, 0.1 to 0.3 mm shorter or longer than the model says."""
    fingers = list(model["fingers"])
    wrong = {str(rng.choice(fingers))} if rng.random() < 0.7 else set(fingers)
    change_m = float(rng.choice((-1.0, 1.0)) * rng.uniform(1e-4, 3e-4))
    points = {}
    for name, point in model["points"].items():
        x, y, z = point["xyz_m"]
        moved = point["finger"] in wrong and point.get("corner", False)
        points[name] = {**point, "xyz_m": [x, y, z + change_m if moved else z]}
    return {**model, "points": points}


def worn(draft: SceneDraft) -> Changes:
    """One finger, or both, shorter than the model by 0.1 to 0.3 mm."""
    finger = "" if draft.chance(0.3) else draft.one_of(*draft.gripper.finger_ids)
    return {"fingers": with_(draft.fingers, shape=FingerShape(wear_m=draft.uniform(1e-4, 3e-4), worn_finger=finger))}


MOVED, BENT = (Cause.CAMERA_MOUNT,), (Cause.FINGER_BENT,)
OTHER = (*BENT, Cause.JAW_OPENING)
"""Of fingers that aren't as the model has them."""

_ROUNDED = make(FingerShape, tip_bevel_m=uniform(2e-4, 6e-4))
ORDINARY: tuple[Condition, ...] = (
    Condition("ordinary", "some clutter moves, usual noise"),
    Condition("clutter", "boxes, cables, print, chequers move", {"background": _CLUTTER}),
    Condition(
        "clutter still", "the same, standing still",
        {"background": lambda draft: with_(_CLUTTER(draft), motion="still")},
    ),
    Condition("light", "steps of the light, a soft shadow", light),
    Condition(
        "blur", "Gaussian blur of 0.7 to 2.5 px added", {"defocus": (make(Defocus, sigma_px=uniform(0.7, 2.5)),)},
        wrong=(Cause.LENS,),
    ),
    Condition(
        "noise", "read noise 3 to 6 DN, strong shot noise",
        {"sensor": change("sensor", read_noise_dn=uniform(3.0, 6.0), shot_noise_dn=uniform(0.1, 0.3))},
    ),
    Condition(
        "flicker", "light flickers by 20 to 40 %",
        {"light": make(Light, flicker=uniform(0.2, 0.4), flicker_hz=uniform(96.0, 104.0))},
    ),
    Condition("jpeg", "quality 55 to 85", {"sensor": change("sensor", jpeg_quality=whole(55, 85))}),
    Condition("jaw cycle", "the jaws close and open", jaw_cycle),
    Condition(
        "cover one", "a hand or sheet hides one finger",
        _cover(one_of("hand", "sheet"), 0.3, 0.46, side=one_of("left", "right")),
    ),
    Condition("hand", "a hand passes, up to all of the view", _cover("hand", 0.35, 1.0)),
    Condition("sheet", "a printed sheet passes, up to all of the view", _cover("sheet", 0.3, 1.0)),
    Condition("covered run", "some frames show nothing of the gripper", covered_run),
    Condition("bump", "the mount jumps by 0.3 to 8 mm", bump, wrong=MOVED, inside=False),
    Condition("bump exposed", "the same within an exposure", bump_exposed, wrong=MOVED, inside=False),
    Condition("flash", "far too bright, or dark, for some frames", flash),
    Condition("low contrast", "fingers and table of nearly the same grey", low_contrast, enough=False),
    Condition("vibration", "the mount vibrates by 0.1 to 0.4 mm", vibration, wrong=MOVED),
    Condition("creep", "the mount creeps by 0.2 to 2 mm", creep, wrong=MOVED, inside=False),
    Condition("bent finger", "a finger's tip moves by 0.3 to 2 mm", bent, enough=False, wrong=BENT),
    Condition("crash", "the mount jumps and bends a finger", crash, enough=False, wrong=(*MOVED, *BENT), inside=False),
    Condition("opening wrong", "report off by 0.3 to 2 mm", opening_wrong, enough=False, wrong=(Cause.JAW_OPENING,)),
    Condition(
        "model off", "tips 0.1 to 0.3 mm other than the model", enough=False, wrong=OTHER, truth=mismeasured
    ),
    Condition("tips worn", "tips 0.1 to 0.3 mm shorter than the model", worn, enough=False, wrong=OTHER),
    Condition(
        "tips rounded", "facets of 0.2 to 0.6 mm on the tips' edges", {"fingers": change("fingers", shape=_ROUNDED)},
        enough=False, wrong=OTHER,
    ),
)  # fmt: skip
