"""A gripper file from CAD: meshes (STL, OBJ, PLY), URDF with its joints, ViSP's .cao.

``files`` and ``urdf`` read bodies in metres, ``surface`` finds their flat faces, sharp edges and roundings, ``frame``
places the TCP, ``solid`` and ``outline`` make points and edges of them, ``build`` the gripper file.
"""

from __future__ import annotations

from gripmon.teach.cad.build import CadGripper, gripper_from_cad

__all__ = ["CadGripper", "gripper_from_cad"]
