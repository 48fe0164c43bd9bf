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

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from benchmarks.drawn import lenses
from benchmarks.fingers import gripper_of, shipped, wedge_fingers
from gripmon import simulate
from gripmon.model.camera import LensSettings, make_camera
from gripmon.model.geometry import perturb
from gripmon.model.gripper import Gripper
from gripmon.model.records import Frame
from gripmon.simulate import Scenario
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


@cache
def rigs() -> dict[str, Rig]:
    """Grippers of three shapes before three cameras."""
    lens = lenses()
    return {
        "boxes": Rig(lens["paper"], gripper_of(shipped("two_box_fingers")), 0.118, 32.0, (0.016, 0.044)),
        "tapered": Rig(lens["wide"], gripper_of(shipped("adaptive_arc_fingers")), 0.125, 36.0, (0.02, 0.055)),
        "wedges": Rig(lens["fisheye"], gripper_of(wedge_fingers()), 0.095, 38.0, (0.012, 0.044)),
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
        self._simulator = simulate.Rig(self.camera, rig.gripper, shown).simulator(scenario, int(rng.integers(2**31)))

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
