"""Edges and look in one estimate: the edges know where the gripper is, the look by how much it has moved.

What the look has too much, its bias, is where the edges had the gripper on average while it was learnt, and what its
model of the fingers has wrong.  Against the edges it so begins at zero, as uncertain as that average.  The edges show
it a little in every frame, and their own errors are others before every background.  A motion is seen by both, so that
it never becomes bias, however slow it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gripmon.model.geometry import from_record
from gripmon.model.least_squares import CONTRADICTION_SQUARE
from gripmon.model.poses import perturb, perturbation_between, to_record
from gripmon.model.records import Array, LookBias
from gripmon.track.jaw import AlikeErrors
from gripmon.track.look.agreement import LookRefused
from gripmon.track.look.alignment import LookMotion

BIAS_BACKGROUNDS = 64
"""Backgrounds over which the bias is averaged: the edges' share of its error is an eighth then, minutes of work."""

PER_MOTION, PER_OPENING = 0.02, 2e-3
"""How wrong a motion or an opening of the jaw comes out at most (no unit): rendered sequences showed 0.006 after 4.5 mm
of the camera and 0.002 after 17 mm of the jaw, where depths are interpolated between edges.
"""


class Fused(NamedTuple):
    """Edges and look in one: ``cam_T_grip`` (4, 4).  ``of_change`` (6, 6): covariance by which it changes while nothing
    moves; ``of_bias`` (6, 6): of the part of its error that lasts, the look's bias, of whose variance each background
    changes the share ``renewed``.
    """

    cam_T_grip: Array
    of_change: Array
    of_bias: Array
    renewed: float


class LookFusion:
    """The bias of one gripper's look, and what follows from it.  ``reach_m``: from the TCP to what is looked at, m."""

    def __init__(self, reach_m: float):
        self._reach_m = reach_m
        self.forget()

    def forget(self) -> None:
        """The look is learnt again."""
        self.backgrounds = 0
        self.contradicts = False
        """Whether look and edges contradicted each other before the newest background."""
        self._bias: Array = np.zeros(6)
        self._covariance: Array = np.zeros((6, 6))
        self._at: tuple[Array, float] | None = None
        self._alike = AlikeErrors()
        self._share = 1.0  # of the bias that the newest background has changed
        self._before: Array | None = None
        self._pending: tuple[Array, Array, Array, Array, float] | None = None

    def state(self) -> LookBias | None:
        """What survives a restart; None before a bias is known."""
        if self._at is None:
            return None
        x, y, z, about_x, about_y, about_z = self._bias.tolist()
        covariance = tuple(self._covariance.ravel().tolist())
        bias, where = (x, y, z, about_x, about_y, about_z), to_record(self._at[0])
        return LookBias(self.backgrounds, bias, covariance, where, float(self._at[1]), self._alike.correlation)

    def restore(self, record: LookBias) -> None:
        """Go on with a kept bias.  Raises :class:`LookRefused`, and begins again, for one that can't be."""
        self.forget()
        bias, covariance = np.array(record.bias), np.reshape(record.covariance, (6, 6))
        finite = np.isfinite(bias).all() and np.isfinite(covariance).all() and np.isfinite(record.correlation)
        if not finite or not np.isfinite(record.jaw_opening_m) or np.linalg.eigvalsh(covariance).min() <= 0.0:
            raise LookRefused("the kept look's bias can't be; it is learnt again")
        self.backgrounds, self._bias, self._covariance = record.backgrounds, bias, covariance
        self._at = from_record(record.cam_T_grip), record.jaw_opening_m
        self._alike = AlikeErrors(record.correlation)

    def fuse(self, cam_T_grip: Array, covariance: Array, look: LookMotion) -> Fused | None:
        """The edges' pose (4, 4), whose errors have a ``covariance`` (6, 6), and the look's in one; None where they
        contradict each other, and before a bias is known.

        Which errors of the edges outlast all backgrounds is unknown: as a place, the result is to be trusted no more
        than the edges.
        """
        difference = perturbation_between(cam_T_grip, look.cam_T_grip)
        opening_m = 0.0 if look.jaw_opening_m is None else look.jaw_opening_m
        self._pending = difference, covariance, look.covariance, cam_T_grip, opening_m
        if self._at is None:
            return None
        known = self._uncertainty(cam_T_grip, opening_m)
        of_both = covariance + known + look.covariance
        innovation = difference - self._bias
        solved = np.linalg.solve(of_both, np.column_stack([covariance, innovation]))
        if float(innovation @ solved[:, 6]) > CONTRADICTION_SQUARE:
            return None
        # By this share it follows the look; what is left of the edges' error is another one before each background.
        share = solved[:, :6].T
        rest = np.eye(6) - share
        elsewhere = known - self._covariance
        changing = look.covariance + elsewhere + self._share * self._covariance
        of_change = rest @ covariance @ rest.T + share @ changing @ share.T
        of_bias = share @ self._covariance @ share.T
        return Fused(perturb(cam_T_grip, share @ innovation), _symmetric(of_change), _symmetric(of_bias), self._share)

    def place(self, cam_T_grip: Array, covariance: Array, jaw_opening_m: float | None) -> None:
        """A new background's frame is learnt where the edges have the gripper, with errors of a ``covariance`` (6, 6),
        before the look measures: as far as one can tell, it has no bias against them.
        """
        self._follow(np.zeros(6), covariance, np.zeros((6, 6)), cam_T_grip, jaw_opening_m or 0.0)

    def learn(self) -> None:
        """Learn the bias from the newest frame, whose background is a new one."""
        if self._pending is None:
            return
        difference, of_edges, of_look, _, _ = pending = self._pending
        self._pending = None
        self._follow(*pending)
        if self.contradicts:
            return
        if self._before is not None:
            way = difference - self._before
            self._alike.learn(float(way @ np.linalg.solve(2.0 * (of_edges + of_look), way)) / 6.0)
        self._before = difference

    def _follow(self, difference: Array, of_edges: Array, of_look: Array, cam_T_grip: Array, opening_m: float) -> None:
        """A Kalman update of the bias by a ``difference`` (6,) from edges to look."""
        self.backgrounds += 1
        if self._at is None:
            self._bias, self._covariance = difference, of_edges + of_look
            self._at = cam_T_grip, opening_m
            return
        innovation = difference - self._bias
        known = self._uncertainty(cam_T_grip, opening_m)
        square = float(innovation @ np.linalg.solve(known + of_edges + of_look, innovation))
        self.contradicts = square > CONTRADICTION_SQUARE
        if self.contradicts:
            return
        gain = np.linalg.solve(known + self._alike.count * of_edges + of_look, known).T
        self._bias = self._bias + gain @ innovation
        left = known - gain @ known
        self._covariance = _symmetric(left) * (1.0 + 1.0 / BIAS_BACKGROUNDS)
        # The bias is that of where it was learnt: the place follows as the bias does.
        share = self._share = float(np.trace(gain)) / 6.0
        then_T, then_m = self._at
        here_T = perturb(then_T, share * perturbation_between(then_T, cam_T_grip))
        self._at = here_T, then_m + share * (opening_m - then_m)

    def _uncertainty(self, cam_T_grip: Array, opening_m: float) -> Array:
        """(6, 6) of the bias, which is another one elsewhere: depths and lights are not exactly as thought."""
        assert self._at is not None
        way = perturbation_between(self._at[0], cam_T_grip)
        x, y, z, about_x, about_y, about_z = way.tolist()
        moved_m = math.hypot(x, y, z, self._reach_m * math.hypot(about_x, about_y, about_z))
        error_m = math.hypot(PER_MOTION * moved_m, PER_OPENING * (opening_m - self._at[1]))
        known = self._covariance.copy()
        known.ravel()[::7] += np.square([error_m] * 3 + [error_m / self._reach_m] * 3)
        return known


def _symmetric(matrix: Array) -> Array:
    return np.asarray(0.5 * (matrix + matrix.T))
