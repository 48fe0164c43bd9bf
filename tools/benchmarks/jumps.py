"""Scenes for ``tools/bench recovery``: cameras with grippers of several shapes that are knocked about before several
backgrounds.

Each scene is one simulated sequence; in each of its trials the camera stands at its nominal pose for some frames, then
jumps between two frames and stays, while the background moves on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from benchmarks.machine import ROOT
from gripmon.daemon.config import read_gripper
from gripmon.model.camera import BrownConradyLens, FisheyeLens, LensSettings, PaperLens, make_camera
from gripmon.model.geometry import perturb
from gripmon.model.gripper import Gripper, GripperModel
from gripmon.model.records import Frame
from gripmon.simulate import Scenario, Simulator
from gripmon.simulate.disturbance import full_motion
from gripmon.simulate.scenario import Background, JawScript, MountMotion, Tilt

FPS = 30.0
LARGEST_M, LARGEST_RAD = 0.01, math.radians(4.0)
"""Jumps from which the monitor is to recover."""

TRIAL_S = 4.0
"""From one trial of a scene to the next: the background is elsewhere by then."""

_BACKGROUNDS = {
    "plain": Background(kind="plain", boxes=0, cables=0),
    "blobs": Background(),
    "speckle": Background(kind="speckle"),
    "stripes": Background(kind="stripes"),
    "chequer": Background(kind="chequer", contrast=0.8),
    "clutter": Background(kind="printed", boxes=45, cables=14, contrast=0.9, motion="stop_and_go", speed_m_per_s=0.12),
}
BACKGROUNDS = tuple(_BACKGROUNDS)

FloatArray = NDArray[np.floating]


@dataclass(frozen=True)
class Rig:
    """A camera, what it looks at, and about where: distance of the TCP (m) and tilt of the gripper (degrees)."""

    lens: LensSettings
    gripper: Gripper
    distance_m: float
    tilt_deg: float
    jaw_range_m: tuple[float, float]


@dataclass(frozen=True)
class Trial:
    """Frames before and after a jump, with the true poses; absent grippers are expected at ``before_cam_T_grip``."""

    before: list[Frame]
    after: list[Frame]
    before_cam_T_grip: FloatArray
    after_cam_T_grip: FloatArray


def wedge_fingers() -> Gripper:
    """Slim fingers of five-sided outline: the outer side slopes towards the tip."""
    outline = ((0.0, 0.0), (0.004, 0.0), (0.011, -0.016), (0.011, -0.045), (0.0, -0.045))  # x outward, z
    hidden = "34"  # the back end lies in the body that carries the finger
    points, edges, faces, fingers = {}, {}, [], {}
    for name, sign in (("left", -1.0), ("right", 1.0)):
        fingers[name] = {"motion": {"axis": [0.5 * sign, 0.0, 0.0]}}
        for side, y in (("near", -0.006), ("far", 0.006)):
            for k, (x, z) in enumerate(outline):
                points[f"{name}_{side}_{k}"] = {
                    "finger": name, "xyz_m": [sign * (0.014 + x), y, z], "corner": k < 3,
                }  # fmt: skip
        count = len(outline)
        for k in range(count):
            after = (k + 1) % count
            near, far = (f"{name}_near_{k}", f"{name}_near_{after}"), (f"{name}_far_{k}", f"{name}_far_{after}")
            for start, end in (near, far, (near[0], far[0])):
                if start[-1] not in hidden or end[-1] not in hidden:
                    edges[f"{start}-{end}"] = {"from": start, "to": end}
            loop = [near[0], far[0], far[1], near[1]]
            faces.append({"finger": name, "points": loop if sign < 0.0 else loop[::-1]})
        for side in ("near", "far"):
            loop = [f"{name}_{side}_{k}" for k in range(count)]
            faces.append({"finger": name, "points": loop if (side == "far") == (sign > 0.0) else loop[::-1]})
    jaw = {"nominal_m": 0.028, "min_m": 0.0, "max_m": 0.05}
    model = {"name": "wedge_fingers", "jaw": jaw, "fingers": fingers, "points": points, "edges": edges, "faces": faces}
    return Gripper(msgspec.convert(model, GripperModel))


@cache
def rigs() -> dict[str, Rig]:
    """Grippers of three shapes before three cameras."""
    folder = ROOT / "configs" / "grippers"
    paper = PaperLens(
        width_px=768, height_px=576, fx_px=962.0, fy_px=962.0, cx_px=383.5, cy_px=287.5, kappa_per_px2=1.9e-7
    )
    brown = BrownConradyLens(
        width_px=640,
        height_px=480,
        fx_px=655.0,
        fy_px=653.0,
        cx_px=322.0,
        cy_px=236.0,
        coefficients=(-0.31, 0.11, 0.0012, -0.0008),
    )
    fisheye = FisheyeLens(
        width_px=1280,
        height_px=720,
        fx_px=790.0,
        fy_px=790.0,
        cx_px=641.0,
        cy_px=357.0,
        coefficients=(0.03, -0.02, 0.004, 0.0),
    )
    return {
        "boxes": Rig(paper, read_gripper(folder / "two_box_fingers.yaml"), 0.118, 32.0, (0.016, 0.044)),
        "tapered": Rig(brown, read_gripper(folder / "adaptive_arc_fingers.yaml"), 0.125, 36.0, (0.02, 0.055)),
        "wedges": Rig(fisheye, wedge_fingers(), 0.095, 38.0, (0.012, 0.044)),
    }


def combination(place: int) -> tuple[str, str]:
    """Names of the rig and the background of a scene: all pairs in turn."""
    rig = tuple(rigs())[place % len(rigs())]
    return rig, BACKGROUNDS[place // len(rigs()) % len(BACKGROUNDS)]


def draw(rng: np.random.Generator, count: int, size: tuple[float, float] = (0.0, 1.0)) -> FloatArray:
    """Jumps (count, 6) in random directions: lengths up to 10 mm and turns up to 4 degrees, each uniform in its ball;
    or between two multiples of that.
    """
    low, high = size
    ways = rng.normal(size=(count, 2, 3))
    ways /= np.linalg.norm(ways, axis=2)[..., None]
    lengths = np.cbrt(rng.uniform(low**3, high**3, (count, 2)))
    return np.concatenate([LARGEST_M * lengths[:, :1] * ways[:, 0], LARGEST_RAD * lengths[:, 1:] * ways[:, 1]], axis=1)


def scene(rig: str, background: str, seed: list[int], count: int, kind: str) -> Scene:
    """A scene with the given number of jumps: within what is promised (kind ""), "beyond", or with the gripper
    "absent".
    """
    rng = np.random.default_rng(seed)
    xis = draw(rng, count, (1.0, 2.0) if kind == "beyond" else (0.0, 1.0))
    return Scene(rigs()[rig], background, xis, rng, absent=kind == "absent")


def restamped(frame: Frame, index: int) -> Frame:
    """The frame as the ``index``-th of its own sequence."""
    return Frame(index, round(index * 1e9 / FPS), frame.image, frame.jaw_opening_m, frame.name)


class Scene:
    """A rig at a random pose and jaw opening before a random piece of background; ``xis`` (n, 6) are its jumps.

    A jump moves the TCP by ``xi[:3]`` (m, camera axes) and turns the gripper about it by ``xi[3:]`` (rad).
    """

    def __init__(
        self, rig: Rig, background: str, xis: FloatArray, rng: np.random.Generator, *, absent: bool = False
    ) -> None:
        self.rig, self.camera = rig, make_camera(rig.lens)
        self._xis, self._absent = xis, absent
        turn = np.deg2rad(np.array([rig.tilt_deg, 0.0, 0.0]) + rng.uniform(-6.0, 6.0, 3))
        nominal = np.eye(4)
        nominal[:3, :3] = (
            Rotation.from_rotvec([0.0, turn[1], turn[2]]).as_matrix()
            @ Rotation.from_rotvec([turn[0], 0.0, 0.0]).as_matrix()
        )
        nominal[:3, 3] = [*rng.uniform(-0.004, 0.004, 2), rig.distance_m + rng.uniform(-0.006, 0.006)]
        self.cam_T_grip = nominal
        opening_m = float(rng.uniform(*rig.jaw_range_m))
        shown = nominal.copy()
        if absent:  # beside the view; what it looks at stays
            shown[0, 3] += 0.3
        pivot_m = shown[:3, 3] - [0.0, 0.0, 0.1]
        scenario = Scenario(
            name="recovery",
            fps=FPS,
            pivot_cam_m=tuple(pivot_m.tolist()),
            mount=tuple(_scripts(xis, pivot_m, shown[:3, 3])),
            jaw=JawScript(knots=((0.0, opening_m),)),
            background=_BACKGROUNDS[background],
        )
        self._simulator = Simulator(self.camera, rig.gripper, shown, scenario, int(rng.integers(2**31)))

    def trial(self, index: int, before: int, after: int) -> Trial:
        """The frames about jump ``index``."""
        jump = _jump_frame(index)
        frames = [self._simulator.frame(k) for k in range(jump - before, jump + after)]
        poses = [self._simulator.truth(k).cam_T_grip for k in (jump - 1, jump)]
        if self._absent:
            poses[0] = perturb(self.cam_T_grip, self._xis[index])
        return Trial(frames[:before], frames[before:], poses[0], poses[1])


def _jump_frame(index: int) -> int:
    """First frame after a scene's jump."""
    return round((index + 0.5) * TRIAL_S * FPS)


def _scripts(xis: FloatArray, pivot_m: FloatArray, tcp_m: FloatArray) -> Iterator[Tilt]:
    """Each jump, and the way back half a trial later."""
    for index, xi in enumerate(xis):
        for sign, frame in ((1.0, _jump_frame(index)), (-1.0, _jump_frame(index) + round(0.5 * TRIAL_S * FPS))):
            yield tilt(xi, pivot_m, tcp_m, (frame - 0.5) / FPS, sign)


def tilt(xi: FloatArray, pivot_m: FloatArray, tcp_m: FloatArray, start_s: float, sign: float = 1.0) -> Tilt:
    """The scenario's words for a jump ``xi`` (6,) of the gripper whose TCP is at ``tcp_m``; ``sign`` -1 undoes it."""
    lever = tcp_m - pivot_m
    shift = xi[:3] - (Rotation.from_rotvec(xi[3:]).apply(lever) - lever)
    motion = _turn(sign * xi[3:], pivot_m, tcp_m)
    return Tilt(
        start_s=start_s,
        time_s=0.0,
        tcp_shift_m=motion.tcp_shift_m,
        roll_deg=motion.roll_deg,
        translation_m=tuple((sign * shift).tolist()),
    )


def background(name: str) -> Background:
    """One of :data:`BACKGROUNDS`."""
    return _BACKGROUNDS[name]


def _turn(omega: FloatArray, pivot_m: FloatArray, tcp_m: FloatArray) -> MountMotion:
    """The scenario's words for a turn about the pivot by a rotation vector (3,)."""

    def motion(unknowns: FloatArray) -> MountMotion:
        x_m, y_m, roll_deg = unknowns.tolist()
        return MountMotion(tcp_shift_m=(x_m, y_m), roll_deg=roll_deg)

    def miss(unknowns: FloatArray) -> FloatArray:
        return 1e3 * (full_motion(motion(unknowns), pivot_m, tcp_m)[0] - omega)

    lever = tcp_m - pivot_m
    start = [*np.cross(omega, lever)[:2], math.degrees(omega[2])]
    return motion(fsolve(miss, start, xtol=1e-13))
