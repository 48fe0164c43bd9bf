"""What the gripper file and the reference are off by in every frame alike, so that no frame tells.

Edges are taught where they show if the gripper stands at the reference.  Let that be off by e, the file exact: the
offsets have e in them.  Every pose is off by e then, and after a motion so are the offsets by e's part of the motion.

A file made of the same images as the reference has errors s of its size and t of its tilt, and the reference has them,
too: together they show the fingers where the images have them, whatever s and t are.  So nothing of these is in the
offsets, and the images at the reference don't tell them.  What they do is what the file's own do, taught or not: the
pose is farther by s and turned by t, and of a motion the size is wrong by s, and what :class:`Tilt` has of t.  Counted
from the reference's covariance, too, they would count twice, so that it counts without them
(:func:`~gripmon.track.edges.taught.own_covariance`): its e is the scatter of the outline, across the line of sight.  A
reference from elsewhere, a plate or hand-placed corners, has an e of its own, independent of s and t: both count.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gripmon.model.geometry import log_rotation
from gripmon.model.gripper import SIZE_UNKNOWN, Gripper
from gripmon.model.records import Array

ACROSS_EDGE = 9
"""Points of each edge at which an error of its depth is added up; more change nothing in the first three digits."""


class Tilt(NamedTuple):
    """The plane of a file's points isn't that of the fingers, by one standard deviation along each of k directions:
    ``axes_grip`` (k, 3), by which it is rotated, and ``of_motion`` (k, 6, 3), the error of a fit by the motion of a
    point at the camera's origin.
    """

    axes_grip: Array
    of_motion: Array

    @classmethod
    def of(cls, gripper: Gripper, cam_T_grip: Array) -> Tilt:
        """About two directions in the plane, for motions from a pose (4, 4).

        In the images that the file was made of its points have their right places, so that a wrong plane is a wrong
        depth, by a part k of it.  A motion moves a point's image by J (v + w x P), J its projection's Jacobian, w the
        rotation and v the translation at the camera's origin: the part of w is the same at any depth, that of v isn't,
        so that the image contradicts the file by -k J v.  The fit distributes that, across the edges, among its six
        unknowns: of a plane it can explain nearly all of it, as another rotation.
        """
        if not gripper.model.tilt_sigma_rad:
            return EXACT_PLANE
        rotation, tcp = cam_T_grip[:3, :3], cam_T_grip[:3, 3]
        points = gripper.points_grip_m() @ rotation.T + tcp
        places = gripper.outlines_m(points, np.arange(len(gripper.edge_ids)), ACROSS_EDGE, rotation)
        ways = np.diff(places[..., :2] / places[..., 2:], axis=1)
        place, way = 0.5 * (places[:, 1:] + places[:, :-1]).reshape(-1, 3), ways.reshape(-1, 2)
        # Weighted by their lengths: a motion across each piece of an edge, times it.
        farther = (way[:, 1] * place[:, 0] - way[:, 0] * place[:, 1]) / place[:, 2]
        moved = np.column_stack([-way[:, 1], way[:, 0], farther])
        moved /= (place[:, 2] * np.sqrt(np.linalg.norm(way, axis=1)))[:, None]
        lever = place - tcp
        *along, normal = np.linalg.svd(lever, full_matrices=False)[2]
        jacobian = np.column_stack([moved, np.cross(lever, moved)])
        axes = gripper.model.tilt_sigma_rad * np.array(along)
        deeper = -(np.cross(axes, normal) @ lever.T) / (place @ normal)
        of_motion = [np.linalg.lstsq(jacobian, -each[:, None] * moved, rcond=None)[0] for each in deeper]
        return cls(axes @ rotation, np.array(of_motion))


EXACT_PLANE = Tilt(np.zeros((0, 3)), np.zeros((0, 6, 3)))


class CommonError(NamedTuple):
    """What no frame tells, since all are off by it alike: ``scale_sigma``, the standard deviation of a factor on all
    lengths of the gripper file (a larger gripper farther away gives the same image); ``taught`` (k, 6), the error of
    the reference at which edges were taught, by one standard deviation along each of k directions; ``offset`` (6,), how
    far off that reference the teaching images showed the gripper; ``tilt`` of the file's plane.
    """

    scale_sigma: float
    taught: Array
    offset: Array
    tilt: Tilt = EXACT_PLANE

    def alike(self, cam_T_grip: Array) -> Array:
        """(p, 6) what all fits near a pose (4, 4) are off by, by standard deviations."""
        farther = np.concatenate([self.scale_sigma * cam_T_grip[:3, 3], np.zeros(3)])
        turned = self.tilt.axes_grip @ cam_T_grip[:3, :3].T
        return np.vstack([self.taught, farther, np.column_stack([np.zeros_like(turned), turned])])

    @property
    def farther(self) -> Array:
        """(2,) lengths of the offset, m and rad: it is measured, so it counts once, not as a deviation."""
        return np.asarray(np.linalg.norm(self.offset.reshape(2, 3), axis=1))

    def of_motion(self, motion: Array, at_T: Array) -> Array:
        """(6, 6) covariance of what taught edges are off by after a ``motion`` (4, 4) from where they were taught, at_T
        (4, 4): the motion times the reference's error, which is an angle, or a length over the distance.
        """
        rows = np.vstack([self.taught, self.offset])
        if self.scale_sigma >= SIZE_UNKNOWN:
            # Along the line of sight it is the size, of which the motion is a part.
            sight = at_T[:3, 3] / np.linalg.norm(at_T[:3, 3])
            rows[:, :3] -= np.outer(rows[:, :3] @ sight, sight)
        share = np.square(rows[:, :3]).sum() / np.square(at_T[:3, 3]).sum() + np.square(rows[:, 3:]).sum()
        moved, turned = np.square(motion[:3, 3]).sum(), np.square(log_rotation(motion[:3, :3])).sum()
        return np.diag(share * np.repeat([moved, turned], 3))
