"""Grippers of MuJoCo files as URDFs: visual meshes, slides and hinges, and which joints follow which."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

from scipy.spatial.transform import Rotation


def folder_of(package: str) -> Path | None:
    """Where a package is installed, without importing it; None where it isn't."""
    found = importlib.util.find_spec(package)
    return None if found is None else Path(next(iter(found.submodule_search_locations or ())))


def as_urdf(hand: Path, root: str, follows: Mapping[str, tuple[str, float]], assets: Path, stand_in: str = "") -> str:
    """The body ``root`` of a MuJoCo file; ``follows``: by joint the one that it follows and the factor; ``assets``: the
    file that names the meshes; ``stand_in``: the mesh to take for one that isn't there.
    """
    meshes = {}
    for mesh in ElementTree.parse(assets).getroot().iter("mesh"):
        path = assets.parent / mesh.get("file", "")
        path = path if path.is_file() else assets.parent / stand_in
        meshes[mesh.get("name")] = f'<mesh filename="{path}" scale="{mesh.get("scale", "1 1 1")}"/>'
    body = next(b for b in ElementTree.parse(hand).getroot().iter("body") if b.get("name") == root)
    return f'<robot name="{hand.stem}">{"".join(_body(body, meshes, follows))}</robot>'


def _body(body: ElementTree.Element, meshes: Mapping, follows: Mapping[str, tuple[str, float]]) -> Iterator[str]:
    yield f'<link name="{body.get("name")}">'
    for geom in body.findall("geom"):
        if geom.get("group") == "0" or "pad_box" in geom.get("class", ""):  # for contacts only
            continue
        size = " ".join(str(2.0 * float(v)) for v in geom.get("size", "").split())
        shape = meshes[geom.get("mesh")] if geom.get("mesh") else f'<box size="{size}"/>'
        if geom.get("mesh") or geom.get("type") == "box":
            yield f"<visual>{_origin(geom)}<geometry>{shape}</geometry></visual>"
    yield "</link>"
    for child in body.findall("body"):
        yield from _body(child, meshes, follows)
        yield _joint(body, child, follows)


def _joint(parent: ElementTree.Element, child: ElementTree.Element, follows: Mapping[str, tuple[str, float]]) -> str:
    ends = f'<parent link="{parent.get("name")}"/><child link="{child.get("name")}"/>{_origin(child)}'
    joint = child.find("joint")
    if joint is None:
        return f'<joint name="{child.get("name")}_fixed" type="fixed">{ends}</joint>'
    name, kind = joint.get("name", ""), "prismatic" if joint.get("type") == "slide" else "revolute"
    low, high = joint.get("range", "0 0.85").split()
    leader, factor = follows.get(name, ("", 0.0))
    mimic = f'<mimic joint="{leader}" multiplier="{factor}"/>' if leader else ""
    how = f'<axis xyz="{joint.get("axis")}"/><limit lower="{low}" upper="{high}"/>{mimic}'
    return f'<joint name="{name}" type="{kind}">{ends}{how}</joint>'


def _origin(part: ElementTree.Element) -> str:
    turn = Rotation.identity()
    if quat := part.get("quat"):
        turn = Rotation.from_quat([float(v) for v in quat.split()], scalar_first=True)
    elif euler := part.get("euler"):
        turn = Rotation.from_euler("XYZ", [float(v) for v in euler.split()])
    rpy = " ".join(f"{v:.12g}" for v in turn.as_euler("xyz"))
    return f'<origin xyz="{part.get("pos", "0 0 0")}" rpy="{rpy}"/>'
