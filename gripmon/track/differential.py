"""The differential update: equation (17) of the self-viewing method, weighted and re-linearised on the manifold.

With a corner predicted at ``(x, y, z)`` in the camera frame and measured at ``(X, Y)`` (undistorted), ``X z' = f x'``
and ``Y z' = f y'`` are linear in the motion ``(delta, d)`` of equations (11)-(13).  Here f = 1: image points are
normalised.  The paper stops at the matrix ``I + Delta``, which is a rotation to first order only; the motion is
applied as a rotation here and the equations set up again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gripmon.model.geometry import exp_rotation, log_rotation, skew
from gripmon.model.gripper import on_a_line
from gripmon.model.least_squares import joint_weight
from gripmon.model.records import Array


@dataclass(frozen=True, slots=True)
class Update:
    """``xi`` (6,) = (rho, omega) of the transform; ``covariance`` (6, 6) of its error from the corners' covariances."""

    xi: Array
    covariance: Array


class DegenerateGeometry(ValueError):
    """The corners don't determine all six parameters."""


def equation_17(points_cam_m: Array, measured_xy: Array) -> tuple[Array, Array]:
    """Rows (n, 2, 6) and right sides (n, 2) for unknowns ``delta_x delta_y delta_z d_x d_y d_z`` (f = 1).

    ``points_cam_m`` (n, 3): predicted corners in the camera frame; ``measured_xy`` (n, 2): measured ideal coordinates.
    """
    x, y, z = points_cam_m.T
    image_x, image_y = measured_xy.T
    rows = np.zeros((len(points_cam_m), 2, 6))
    rows[:, 0, 0], rows[:, 0, 1], rows[:, 0, 2] = image_x * y, -(image_x * x + z), y
    rows[:, 0, 3], rows[:, 0, 5] = -1.0, image_x
    rows[:, 1, 0], rows[:, 1, 1], rows[:, 1, 2] = image_y * y + z, -image_y * x, -x
    rows[:, 1, 4], rows[:, 1, 5] = -1.0, image_y
    return rows, np.column_stack([x - image_x * z, y - image_y * z])


def differential_update(
    points_cam_m: Array, measured_xy: Array, covariance_xy: Array, tcp_cam_m: Array, iterations: int = 2
) -> Update:
    """Motion of the gripper in the camera frame from n >= 3 corners that are not collinear.

    ``points_cam_m`` (n, 3): corners predicted by the present transform; ``measured_xy`` (n, 2): where they were
    measured, ideal coordinates; ``covariance_xy`` of each (n, 2, 2), or of all together (2n, 2n), since corners on one
    edge err together; ``tcp_cam_m`` (3,): the transform's translation.  Raises :class:`DegenerateGeometry` for fewer
    than three corners, for corners that lie nearly on a line (about which any turn would fit, were it ever so large)
    or a singular system.
    """
    if len(points_cam_m) < 3:
        raise DegenerateGeometry(f"{len(points_cam_m)} corners; the update needs at least 3")
    if on_a_line(points_cam_m):
        raise DegenerateGeometry("the corners lie on a line, or nearly so")
    rotation, tcp = np.eye(3), tcp_cam_m.copy()
    weight_xy = joint_weight(covariance_xy)
    for _ in range(iterations):
        points = (points_cam_m - tcp_cam_m) @ rotation.T + tcp
        rows, sides = equation_17(points, measured_xy)
        # A row is the image error times the depth: divided by it, it has the image's covariance.
        rows, sides = _about_tcp(rows, tcp) / points[:, 2, None, None], sides / points[:, 2, None]
        jacobian = rows.reshape(-1, 6)
        weighted = weight_xy @ jacobian
        covariance = _inverse(jacobian.T @ weighted)
        xi = covariance @ (sides.ravel() @ weighted)
        tcp = tcp + xi[:3]
        rotation = exp_rotation(xi[3:]) @ rotation
    return Update(np.concatenate([tcp - tcp_cam_m, log_rotation(rotation)]), covariance)


def _about_tcp(rows: Array, tcp_cam_m: Array) -> Array:
    """Rows for (delta, d), a motion about the camera's origin, as rows for (rho, omega) at the TCP: d = rho - omega x
    tcp.
    """
    out = np.empty_like(rows)
    out[..., :3] = rows[..., 3:]
    out[..., 3:] = rows[..., :3] + rows[..., 3:] @ skew(tcp_cam_m)
    return out


def _inverse(normal: Array) -> Array:
    """Inverse of a normal matrix whose unknowns have different units; :class:`DegenerateGeometry` if a direction is
    undetermined.
    """
    scale = np.sqrt(np.diag(normal))
    if not (scale > 0.0).all():
        raise DegenerateGeometry("the corners don't determine all six parameters")
    scaled = normal / np.outer(scale, scale)
    if np.linalg.matrix_rank(scaled, hermitian=True) < len(scaled):
        raise DegenerateGeometry("the corners lie on a line, or so nearly that a direction is undetermined")
    return np.linalg.inv(scaled) / np.outer(scale, scale)
