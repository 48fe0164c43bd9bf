"""Conditions of ``tools/bench integrity`` after cameras and grippers as they are found: colour cameras, their automatic
exposure, a lamp that changes its side, fingers of which little is seen, tapered ones with pads.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks import padded
from benchmarks.drawn import Changes, change, with_
from benchmarks.integrity_conditions import MOVED, ORDINARY
from benchmarks.integrity_misleading import MISLEADING, OTHER_FINGERS
from benchmarks.integrity_scenes import Condition, Fingers, SceneDraft
from gripmon.simulate.scenario import Bump, GraspedObject, JawScript, LampChange, Light, LightStep, ObjectLook

KNOCK_M, KNOCK_DEG, GRASPED_M = 2e-3, 0.55, 0.026
_JAW_NOISE_M = 2e-5


def lamp(draft: SceneDraft) -> Changes:
    """The lamp moves to the other side, within up to a second, and back; the light's strength changes with it."""
    return _lamp(draft, (0.1, 0.6))


def _lamp(draft: SceneDraft, shares: tuple[float, ...], factors: tuple[float, ...] = ()) -> Changes:
    changes, steps = [], []
    side = -float(np.sign(draft.fingers.lamp_cam[0]))
    for k, share in enumerate(shares):
        at_s, time_s = draft.between_frames_s(share), draft.one_of(0.0, draft.uniform(0.2, 1.0))
        lamp_cam = (side * draft.uniform(0.4, 1.2), draft.uniform(-0.8, 0.3), -0.6)
        changes.append(LampChange(at_s=at_s, lamp_cam=lamp_cam, time_s=time_s))
        factor = factors[k] if factors else draft.uniform(0.5, 1.0) if k % 2 == 0 else draft.uniform(1.0, 1.5)
        steps.append(LightStep(at_s=at_s, factor=factor))
        side = -side
    fingers = with_(draft.fingers, lamp_changes=tuple(changes))
    return {"fingers": fingers, "light": Light(steps=tuple(steps))}


def auto_exposure(draft: SceneDraft) -> Changes:
    """The camera follows steps of the light by up to four times within some frames to a second, and hunts."""
    steps = tuple(
        LightStep(at_s=draft.between_frames_s(share), factor=float(np.exp(draft.sign() * draft.uniform(0.5, 1.4))))
        for share in (0.05, 0.35, 0.65)
    )
    return {
        "sensor": with_(draft.sensor, response="srgb"),
        "light": Light(
            steps=steps,
            auto_exposure_s=draft.uniform(0.1, 1.0),
            flicker=draft.uniform(0.03, 0.12),
            flicker_hz=draft.uniform(0.5, 2.0),
        ),
    }


def short(draft: SceneDraft) -> Changes:
    """The image's border leaves some 25 px of the fingers; under automatic exposure."""
    return auto_exposure(draft) | {"fingers": with_(draft.fingers, carriers=False)}


def pads(draft: SceneDraft) -> Changes:
    """Aluminium with black pads before a colour camera."""
    return {
        "fingers": with_(
            draft.fingers, level_dn=draft.uniform(80.0, 130.0), marks=padded.PADS, carriers=False, highlights=0.0
        ),
        "sensor": with_(draft.sensor, response="srgb"),
        "jaw": with_(draft.jaw, reported_noise_m=_JAW_NOISE_M),
    }


def pads_at_work(draft: SceneDraft) -> Changes:
    """The light drops to 45 % and comes from the side, a box is grasped, a knock of 2 mm and 0.55 degrees, more light:
    at the times of 180 frames at 15 a second.
    """
    changes = pads(draft)
    changes |= _lamp(replace(draft, fingers=changes["fingers"]), (0.0,), (0.45,))
    knots = ((0.18, draft.opening_m), (0.28, GRASPED_M), (0.5, GRASPED_M), (0.58, draft.opening_m))
    box = GraspedObject(
        size_m=(GRASPED_M, draft.uniform(0.012, 0.03), draft.uniform(0.02, 0.04)),
        depth_m=draft.uniform(0.0, 0.02),
        arrive_s=(draft.at_s(0.05), draft.at_s(0.17)),
        leave_s=(draft.at_s(0.59), draft.at_s(0.68)),
        look=ObjectLook(pattern=draft.one_of("printed", "plain"), level_dn=draft.uniform(40.0, 200.0)),
    )
    shift_m = draft.rng.normal(size=3)
    shift_m *= KNOCK_M / np.linalg.norm(shift_m)
    x_m, y_m, z_m = shift_m.tolist()
    # About the line from the camera's bracket to the TCP, so that the TCP moves by what was asked for.
    knock = Bump(
        at_s=draft.between_frames_s(0.72),
        ring_fraction=0.0,
        translation_m=(x_m, y_m, z_m),
        roll_deg=draft.sign() * KNOCK_DEG,
    )
    light = changes["light"]
    more = LightStep(at_s=draft.between_frames_s(0.9), factor=3.0)
    return {
        **changes,
        "jaw": JawScript(knots=tuple((draft.at_s(share), m) for share, m in knots), reported_noise_m=_JAW_NOISE_M),
        "grasped": box,
        "mount": (knock,),
        "light": with_(light, steps=(*light.steps, more)),
    }


PRACTICE: tuple[Condition, ...] = (
    Condition("lamp", "the lamp changes its side", lamp),
    Condition("srgb", "a colour camera's grey levels, declared", {"sensor": change("sensor", response="srgb")}),
    Condition("auto exposure", "a colour camera's exposure follows steps of the light, and hunts", auto_exposure),
    Condition("25 px", "25 px of the fingers are seen, automatic exposure", short, fingers=Fingers.SHORT),
    Condition("pads", "tapered fingers with black pads, a colour camera", pads, fingers=Fingers.PADDED),
    Condition(
        "pads at work",
        "the same through lamp, grasp, a knock of 2 mm, and more light",
        pads_at_work,
        wrong=MOVED,
        inside=False,
        fingers=Fingers.PADDED,
    ),
)
CONDITIONS = (*ORDINARY, *MISLEADING, *OTHER_FINGERS, *PRACTICE)
