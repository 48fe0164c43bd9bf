"""Is the camera where it was in training: against SciPy's rotations, both verdicts."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gripmon.client.reading import Reading, Unusable
from gripmon.client.trained import CameraMoved, columns, compared, require_same_camera, usable_poses
from gripmon.model.records import Protection, Transform, Verdict

TURNS = Rotation.from_rotvec([[0.1, 0.2, -0.3], [1.0, 0.0, 2.0]])
TRAINED = np.concatenate([[[0.0, 0.0, 0.12], [0.01, 0.0, 0.12]], TURNS.as_quat()], axis=1)


def reading(shift_m: tuple[float, float, float], turn_rad: float, *, of: int = 0, sign: float = 1.0) -> Reading:
    turn = Rotation.from_rotvec([0.0, turn_rad, 0.0]) * TURNS[of]
    transform = Transform(tuple((TRAINED[of, :3] + shift_m).tolist()), tuple((sign * turn.as_quat()).tolist()))
    bound = Protection(4e-4, 5e-3, 1e-5, "")
    plain = {"monitor": None, "why": None, "reason": "", "age_s": 0.0, "verdict": Verdict.VALID}
    return Reading(usable=True, transform=transform, protection=bound, **plain)


NONE = Reading(
    monitor=None, verdict=Verdict.UNKNOWN, usable=False, why=Unusable.GONE, reason="the monitor is gone", age_s=math.inf
)


@pytest.mark.parametrize("of", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("turn_rad", [0.0, 1e-6, 0.02, 3.0, math.pi])
def test_shift_and_turn_against_the_nearest(of: int, sign: float, turn_rad: float):
    found = compared(reading((3e-4, 0.0, -4e-4), turn_rad, of=of, sign=sign), TRAINED)
    assert found.shift_m == pytest.approx(5e-4, abs=1e-12)
    assert found.turn_rad == pytest.approx(turn_rad, abs=1e-9)


@pytest.mark.parametrize(
    ("shift_m", "turn_rad", "moved"), [(9e-4, 0.009, False), (1.1e-3, 0.0, True), (0.0, 0.011, True)]
)
def test_each_limit_counts(shift_m: float, turn_rad: float, moved: bool):
    limits = {"limit_m": 1e-3, "limit_rad": 0.01}
    now = reading((0.0, shift_m, 0.0), turn_rad)
    if moved:
        with pytest.raises(CameraMoved, match=f"by {1e3 * shift_m:.2f} mm .* within 0.40 mm; at most 1.00 mm"):
            require_same_camera(lambda: now, TRAINED, **limits)
    else:
        assert require_same_camera(lambda: now, TRAINED, **limits).shift_m == pytest.approx(shift_m)


def test_what_is_not_known_is_refused_and_what_comes_late_is_waited_for():
    limits = {"limit_m": 1e-3, "limit_rad": 0.01}
    with pytest.raises(CameraMoved, match=r"nothing shows where the camera is \(the monitor is gone\)"):
        require_same_camera(lambda: NONE, TRAINED, **limits, wait_s=0.05)
    answers = iter([NONE, NONE, reading((0.0, 0.0, 0.0), 0.0)])
    assert require_same_camera(lambda: next(answers), TRAINED, **limits).shift_m == 0.0


@pytest.mark.parametrize("limit", [0.0, -1.0, math.nan, math.inf])
def test_limits_that_are_none(limit: float):
    with pytest.raises(ValueError, match=r"limit_m is .*a number above 0"):
        require_same_camera(lambda: NONE, TRAINED, limit_m=limit, limit_rad=0.1)


def test_only_valid_transforms_of_the_training_count():
    poses = np.concatenate([TRAINED, [columns(None, usable=False)[:7]]])
    np.testing.assert_array_equal(usable_poses(poses, np.array([[1.0], [0.0], [1.0]])), TRAINED[:1])
    with pytest.raises(ValueError, match="of 3 frames of the training none has a valid transform"):
        usable_poses(poses, np.zeros(3))
    assert columns([1.0] * 7, usable=True)[-1] == 1.0 and columns([1.0] * 7, usable=False)[-1] == 0.0
