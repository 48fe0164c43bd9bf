"""Gripper files that cannot work: each is refused in one line that names the key and what would be right."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from support.box_models import Model, cube_model, two_fingers_model
from support.grippers import gripper_from_dict

from gripmon.daemon.config import ConfigError, read_gripper
from gripmon.model.gripper import GripperError


def _without_corners(model: Model, *kept: str) -> None:
    for name, point in model["points"].items():
        point["corner"] = name in kept


def _on_a_line(model: Model) -> None:
    _without_corners(model)
    for i in range(3):
        model["points"][f"p{i}"] = {"finger": "cube", "xyz_m": [0.001 * i, 0.002 * i, 0.003 * i], "corner": True}
        model["edges"] |= {f"a{i}": {"from": f"p{i}", "to": "cube_000"}, f"b{i}": {"from": f"p{i}", "to": "cube_001"}}


def _in_millimetres(model: Model) -> None:
    for point in model["points"].values():
        point["xyz_m"] = [1000.0 * x for x in point["xyz_m"]]


def _set(*path: str | int, value: object) -> Callable[[Model], None]:
    def change(model: Model) -> None:
        place = model
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


def _drop_edges(model: Model, *kept: str) -> None:
    model["edges"] = {name: edge for name, edge in model["edges"].items() if name in kept}


def _third_face(model: Model) -> None:
    # Another face with the loop of the first one, so that three meet in its edges.
    model["faces"].append(copy.deepcopy(model["faces"][0]))


CUBE_FAULTS: list[tuple[str, Callable[[Model], None], str, str]] = [
    (
        "unknown finger of a point",
        _set("points", "cube_000", "finger", value="thumb"),
        "points.cube_000.finger: ",
        "one of cube",
    ),
    (
        "edge from nowhere",
        _set("edges", "cube_000-cube_001", "from", value="nose"),
        "edges.cube_000-cube_001.from: ",
        "'nose'; one of cube_000",
    ),
    (
        "edge to nowhere",
        _set("edges", "cube_000-cube_001", "to", value="nose"),
        "edges.cube_000-cube_001.to: ",
        "'nose'; one of cube_000",
    ),
    (
        "edge without length",
        _set("edges", "cube_000-cube_001", "to", value="cube_000"),
        "edges.cube_000-cube_001: ",
        "less than 0.1 mm apart; two different points",
    ),
    (
        "face with an unknown point",
        _set("faces", 2, "points", 0, value="nose"),
        "faces[2].points: ",
        "'nose'; one of cube_000",
    ),
    (
        "face of an unknown finger",
        _set("faces", 2, "finger", value="thumb"),
        "faces[2].finger: ",
        "'thumb'; one of cube",
    ),
    (
        "face turned inside out",
        lambda m: m["faces"][3]["points"].reverse(),
        "faces[3].points: ",
        "counter-clockwise seen from outside",
    ),
    ("three faces in one edge", _third_face, "edges.cube_0", "3 faces meet in it; at most two"),
    (
        "motion without a jaw",
        _set("fingers", "cube", "motion", value={"axis": [1.0, 0.0, 0.0]}),
        "fingers.cube.motion: ",
        "a section `jaw` with nominal_m, min_m, max_m",
    ),
    (
        "millimetres",
        _in_millimetres,
        "points.cube_000.xyz_m: 20 m from the TCP; metres (millimetres were meant?)",
        "metres",
    ),
    ("two edges", lambda m: _drop_edges(m, "cube_000-cube_001", "cube_000-cube_010"), "edges: 2; ", "at least 3 edges"),
    (
        "a corner with one edge",
        lambda m: m["edges"].pop("cube_000-cube_001") and m["edges"].pop("cube_000-cube_010"),
        "points.cube_000: ",
        "fewer than two straight edges",
    ),
    (
        "no fingers",
        lambda m: (m.update(fingers={}, points={}, edges={}), m.pop("faces")),
        "fingers: there are none; ",
        "at least one finger",
    ),
]

JAW_FAULTS: list[tuple[str, Callable[[Model], None], str, str]] = [
    (
        "edge between fingers",
        _set("edges", "left_000-left_001", "to", value="right_001"),
        "edges.left_000-left_001: ",
        "an edge belongs to one finger",
    ),
    (
        "face on the other finger",
        _set("faces", 0, "points", 0, value="right_000"),
        "faces[0].points: ",
        "points of that finger",
    ),
    (
        "nominal out of range",
        _set("jaw", "nominal_m", value=0.06),
        "jaw: nominal_m is outside min_m to max_m; ",
        "min_m <= nominal_m <= max_m",
    ),
    (
        "axis and table",
        _set("fingers", "left", "motion", value={"axis": [0.0, 0.0, 0.0], "table": []}),
        "fingers.left.motion: has the keys axis, table; ",
        "either `axis` or `table`",
    ),
    (
        "neither axis nor table",
        _set("fingers", "left", "motion", value={}),
        "fingers.left.motion: has the keys none; ",
        "either `axis` or `table`",
    ),
    (
        "axis of two numbers",
        _set("fingers", "left", "motion", "axis", value=[0.5, 0.0]),
        "fingers.left.motion: ",
        "length 3",
    ),
    (
        "table of one row",
        _set("fingers", "right", "motion", "table", value=[[0.03, 0.0, 0.0, 0.0]]),
        "fingers.right.motion: ",
        "length >= 2",
    ),
    (
        "table not sorted",
        lambda m: m["fingers"]["right"]["motion"]["table"].reverse(),
        "fingers.right.motion.table: openings don't ascend; ",
        "rows sorted by opening_m",
    ),
    (
        "table without the nominal opening",
        lambda m: m["fingers"]["right"]["motion"].update(table=[[0.04, 0.0, 0.0, 0.0], [0.05, 0.001, 0.0, 0.0]]),
        "fingers.right.motion.table: covers 0.04 to 0.05 m; ",
        "jaw.nominal_m within it",
    ),
    (
        "not at rest at nominal",
        _set("fingers", "right", "motion", "table", 1, 1, value=0.001),
        "fingers.right.motion.table: ",
        "an offset of zero there",
    ),
]


@pytest.mark.parametrize(("change", "key", "right"), [f[1:] for f in CUBE_FAULTS], ids=[f[0] for f in CUBE_FAULTS])
def test_a_cube_that_cannot_work_is_refused_with_its_key_and_what_would_be_right(
    change: Callable[[Model], object], key: str, right: str
):
    _assert_refused(cube_model(), change, key, right)


@pytest.mark.parametrize(("change", "key", "right"), [f[1:] for f in JAW_FAULTS], ids=[f[0] for f in JAW_FAULTS])
def test_fingers_that_cannot_work_are_refused_with_their_key_and_what_would_be_right(
    change: Callable[[Model], object], key: str, right: str
):
    _assert_refused(two_fingers_model(), change, key, right)


def _assert_refused(model: Model, change: Callable[[Model], object], key: str, right: str) -> None:
    gripper_from_dict(model)  # Sound before the change.
    change(model)
    with pytest.raises(GripperError) as caught:
        gripper_from_dict(model)
    text = str(caught.value)
    assert text.startswith(key), text
    assert right in text, text
    assert "\n" not in text


@pytest.mark.parametrize("value", [float("nan"), float("inf")], ids=["nan", "inf"])
def test_coordinates_that_are_no_numbers_are_refused(value: float):
    model = cube_model()
    model["points"]["cube_000"]["xyz_m"][1] = value
    with pytest.raises(GripperError, match=r"points\.cube_000\.xyz_m"):
        gripper_from_dict(model)
    for motion, place in (("left", ("axis", 0)), ("right", ("table", 0, 3))):
        model = two_fingers_model()
        _set("fingers", motion, "motion", *place, value=value)(model)
        with pytest.raises(GripperError, match=rf"fingers\.{motion}\.motion\.{place[0]}: holds a value"):
            gripper_from_dict(model)


def test_files_that_cannot_be_read_as_a_gripper_say_so(tmp_path: Path):
    file = tmp_path / "gripper.yaml"
    for text, said in (
        ("name: [", "not YAML"),
        (yaml.safe_dump(cube_model() | {"colour": "red"}), "colour"),
        (yaml.safe_dump({k: v for k, v in cube_model().items() if k != "edges"}), "edges"),
        ("3", "holds a single value 3"),
    ):
        file.write_text(text)
        with pytest.raises(ConfigError, match=said) as caught:
            read_gripper(file)
        assert "\n" not in str(caught.value)
    file.write_bytes(b"name: \xff\xfe")
    with pytest.raises(ConfigError, match="is not text"):
        read_gripper(file)
    with pytest.raises(ConfigError, match="there is no such file"):
        read_gripper(tmp_path / "missing.yaml")
    file.write_text(yaml.safe_dump(cube_model()))
    assert read_gripper(file).name == "cube"


def test_a_face_with_a_point_far_off_is_refused():
    model = cube_model()
    model["points"]["cube_000"]["xyz_m"] = [-0.02, -0.02, 0.01]
    with pytest.raises(
        GripperError, match=r"faces\[\d\]\.points: \d+\.\d mm off a plane, of .* is wrong, or several faces"
    ):
        gripper_from_dict(model)


def test_a_face_of_points_on_a_line_is_refused():
    model = cube_model()
    model["points"]["middle"] = {"finger": "cube", "xyz_m": [-0.02, -0.02, 0.0]}
    model["faces"].append({"finger": "cube", "points": ["cube_000", "middle", "cube_001"]})
    with pytest.raises(GripperError, match=r"faces\[6\]\.points: these points lie on a line"):
        gripper_from_dict(model)
