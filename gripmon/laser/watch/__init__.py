"""A fixed camera watched by a pulsed laser pointer on the arm: has the camera, its plane or the pointer moved?"""

from gripmon.laser.pointer.spots import plain_spot
from gripmon.laser.watch.judgement import CameraMotion, Disagreement, SpotFault, SpotJudgement, SpotSeen
from gripmon.laser.watch.settings import SpotWatchSettings
from gripmon.laser.watch.watch import SpotWatch

__all__ = [
    "CameraMotion",
    "Disagreement",
    "SpotFault",
    "SpotJudgement",
    "SpotSeen",
    "SpotWatch",
    "SpotWatchSettings",
    "plain_spot",
]
