"""A gripper file from CAD: meshes (STL, OBJ, PLY, DAE), URDF with its joints, ViSP's .cao.

``files`` and ``urdf`` read bodies in metres, ``linkage`` tells which of them move, ``parts`` which are fingers,
``frame`` places the TCP, ``surface`` finds flat faces, sharp edges and roundings, ``solid`` and ``outline`` make points
and edges of them, ``jaw`` their motion, ``build`` the gripper file.
"""

from __future__ import annotations

from gripmon.teach.cad.build import CadGripper, gripper_from_cad

__all__ = ["CadGripper", "gripper_from_cad"]
