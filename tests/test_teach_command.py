"""``gripmon teach`` as its users meet it, the file that it writes, and what refuses that file."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from support.changing_backgrounds import images_of, moving_robot
from support.meters import moved
from support.simulated import BOX_FINGERS, box_model, nominal_cam_T_grip
from support.taught_scenes import OPENING_M, image_of, scene

from gripmon.cli import main
from gripmon.cli.teach import written
from gripmon.daemon.config import ConfigError, builtin_config, load_config
from gripmon.daemon.config.typed import to_settings
from gripmon.daemon.config.yaml_file import read_yaml
from gripmon.model.geometry import to_record
from gripmon.simulate.scenario import Sensor
from gripmon.teach.api import to_yaml
from gripmon.teach.drawing import Labels
from gripmon.track.edges import TaughtModel
from gripmon.track.edges.taught import gripper_digest

POSE = nominal_cam_T_grip()
BEVEL_M = 3e-4
LEVELS = (120.0, 180.0, 230.0)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration with sharp fingers, and images of bevelled ones: three to teach from, five of a moved camera."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "gripper.yaml").write_text(yaml.safe_dump(box_model(), sort_keys=False))
    values = yaml.safe_load(builtin_config("demo.yaml").read_text())
    transform = msgspec.to_builtins(to_record(POSE))
    values["reference"]["cam_T_grip"] = {key: list(value) for key, value in transform.items()}
    values.update(gripper="gripper.yaml", source={"kind": "folder", "path": "moved"})
    values["publish"]["enabled"] = values["recording"]["enabled"] = False
    (folder / "untaught.yaml").write_text(yaml.safe_dump(values, sort_keys=False))
    (folder / "config.yaml").write_text(yaml.safe_dump({**values, "taught": "taught.yaml"}, sort_keys=False))
    (folder / "first").mkdir()
    rows = ["file,stamp_ns,jaw_opening_m"]
    for n, level in enumerate(LEVELS):
        cv2.imwrite(str(folder / "first" / f"{n}.png"), image_of(BEVEL_M, scene(level)))
        rows.append(f"{n}.png,{n + 1},{OPENING_M}")
    (folder / "first" / "timestamps.csv").write_text("\n".join(rows) + "\n")
    (folder / "moved").mkdir()
    rows, truth = ["file,stamp_ns,jaw_opening_m"], []
    rng = np.random.default_rng(7)
    for n in range(5):
        pose = moved(POSE, np.concatenate([rng.normal(0.0, 2e-4, 3), np.radians(rng.normal(0.0, 0.1, 3))]))
        opening_m = OPENING_M + rng.uniform(-0.003, 0.003)
        cv2.imwrite(str(folder / "moved" / f"{n}.png"), image_of(BEVEL_M, scene(180.0, opening_m), pose))
        rows.append(f"{n}.png,{(n + 1) * 40_000_000},{opening_m!r}")
        truth.append(pose[:3, 3].tolist())
    (folder / "moved" / "timestamps.csv").write_text("\n".join(rows) + "\n")
    (folder / "truth.json").write_text(json.dumps(truth))
    return folder


@pytest.fixture(scope="module")
def taught(rig: Path) -> Path:
    """The file that a process of its own has written."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "gripmon", "teach", str(rig / "first")),
            *("--config", str(rig / "config.yaml"), "--picture", str(rig / "pictures" / "taught.png")),
        ],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert f"written: {rig / 'taught.yaml'}" in done.stdout and "add the line" not in done.stdout
    assert len([line for line in done.stdout.splitlines() if line.endswith(("outline", "crease"))]) == 10
    return rig / "taught.yaml"


def fault(arguments: Sequence[object], capsys: pytest.CaptureFixture[str], code: int = 2) -> str:
    """The one line that a command ends with; what was measured before it may be in notes."""
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == code
    text = capsys.readouterr()
    assert text.out == ""
    lines = [line for line in text.err.splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1
    return lines[0]


def changed(path: Path, out: Path, **values: object) -> Path:
    """A copy of a YAML file with other values at dotted keys, ``__`` for the dot."""
    content = yaml.safe_load(path.read_text())
    for dotted, value in values.items():
        *above, last = dotted.split("__")
        section = content
        for key in above:
            section = section[key]
        section[last] = value
    out.write_text(yaml.safe_dump(content, sort_keys=False))
    return out


def test_the_file_says_where_it_comes_from(rig: Path, taught: Path):
    model = to_settings(read_yaml(taught), TaughtModel)
    config = load_config(rig / "config.yaml")
    assert config.taught == model and config.taught_edges is not None
    assert model.provenance.command.startswith("gripmon teach ") and len(model.provenance.images) == len(LEVELS)
    for image in model.provenance.images:
        assert Path(image.file).is_file() and image.jaw_opening_m == OPENING_M
    assert model.camera == config.camera.settings
    assert model.gripper.sha256 == gripper_digest(config.gripper)
    assert model.reference.id == "demo-calibration"
    assert taught.read_text().startswith("# Taught model: written by gripmon teach")
    assert [p.name for p in taught.parent.iterdir() if p.name.startswith(".")] == [], "no temporary file is left"


def test_taught_edges_carry_the_error_of_the_reference_they_were_taught_at(rig: Path, taught: Path):
    """Also where a better one has replaced it, as for an episode of a dataset or in the replay of a recording."""
    config = load_config(rig / "config.yaml")
    sure = msgspec.structs.replace(config.reference, revision=1, covariance=tuple((1e-12 * np.eye(6)).ravel().tolist()))
    for each in (config, dataclasses.replace(config, reference=sure)):
        assert each.taught_edges is not None
        error = each.taught_edges.reference_error
        stated = np.reshape(config.reference.covariance, (6, 6))
        shown = np.reshape(to_settings(read_yaml(taught), TaughtModel).reference.images_covariance, (6, 6))
        # Two independent measurements of one pose: their information adds up.
        expected = np.linalg.inv(np.linalg.inv(stated) + np.linalg.inv(shown))
        np.testing.assert_allclose(error.T @ error, expected, atol=1e-16, rtol=1e-6)
        assert (np.linalg.eigvalsh(shown) > 0.0).all()


def test_an_image_that_is_left_out_is_named_and_not_in_the_file(rig: Path, tmp_path: Path, capsys):
    texture = np.random.default_rng(5).uniform(0.0, 255.0, (576, 768)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "hand.png"), cv2.GaussianBlur(texture, (0, 0), 2.0))
    images = [str(tmp_path / "hand.png"), *map(str, sorted((rig / "first").glob("*.png")))]
    options = ["--jaw-opening", str(OPENING_M), "--out", str(tmp_path / "taught.yaml"), "--picture"]
    command = ["teach", *images, "--config", str(rig / "untaught.yaml"), *options, str(tmp_path / "taught.png")]
    assert main(command) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("left out: ")]
    assert len(said) == 1 and said[0].startswith(f"left out: {images[0]}: ")
    model = to_settings(read_yaml(tmp_path / "taught.yaml"), TaughtModel)
    assert [image.file for image in model.provenance.images] == images[1:]


def test_the_picture_shows_every_taught_edge(rig: Path, taught: Path):
    picture = cv2.imread(str(rig / "pictures" / "taught.png"))
    assert picture is not None and picture.shape == (1152, 1536, 3)
    grey = np.ptp(picture.astype(int), axis=2) == 0
    assert 0.9 < grey.mean() < 0.999, "the image is grey, what is drawn isn't"


def test_replay_with_the_taught_model_is_right_where_it_was_off(rig: Path, taught: Path):
    truth = np.array(json.loads((rig / "truth.json").read_text()))
    rms = {}
    for name in ("untaught", "config"):
        out = rig / f"{name}.jsonl"
        assert main(["replay", str(rig / "moved"), "--config", str(rig / f"{name}.yaml"), "--out", str(out)]) == 0
        lines = [json.loads(line) for line in out.read_text().splitlines()]
        found = np.array([line["cam_T_grip"]["translation_m"] for line in lines])
        assert all(line["source"] != "held" for line in lines)
        rms[name] = float(np.sqrt(np.square(found - truth).sum(axis=1).mean()))
    assert rms["untaught"] > 1.5e-4
    assert rms["config"] < rms["untaught"] / 10.0


def test_a_colour_cameras_grey_levels_are_found_written_and_contradicted_by_nobody(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Of a configuration that doesn't say how they follow the light."""
    (tmp_path / "stills").mkdir()
    sensor = Sensor(response="srgb")
    for n, image in enumerate(images_of(moving_robot(305, "chequer", opening_m=OPENING_M, sensor=sensor), 6)):
        cv2.imwrite(str(tmp_path / "stills" / f"{n}.png"), np.dstack([image, image, np.minimum(image, 250) + 4]))
    values = yaml.safe_load((rig / "untaught.yaml").read_text())
    values.update(
        gripper=str(BOX_FINGERS),
        source={"kind": "folder", "path": "stills"},
        jaw={"source": "fixed", "opening_m": OPENING_M},
    )
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(values))
    assert main(["check", str(path), "--json"]) == 0
    assert "gripmon teach finds it" in capsys.readouterr().out
    command = ["teach", str(tmp_path / "stills"), "--config", str(path), "--into-config"]
    assert main(command) == 0
    assert "response: srgb (borders before different backgrounds show gamma" in capsys.readouterr().out
    config = load_config(path)
    assert config.taught is not None and config.taught.edge_settings.response == "srgb"
    assert config.settings.monitor.corners.edges.response == "srgb" and not config.says_response
    assert main(["check", str(path), "--json"]) == 0
    assert "response" not in capsys.readouterr().out
    # Said there in another way than it was taught, it is refused; said by an option, too.
    said = changed(path, tmp_path / "said.yaml", monitor__corners={"edges": {"response": "linear"}})
    with pytest.raises(ConfigError, match=r"edge_settings.response: taught with srgb, the configuration has linear"):
        load_config(said)
    again = ["teach", tmp_path / "stills", "--config", said, "--force", "--response", "srgb"]
    assert "--response srgb, and the configuration has monitor.corners.edges.response: linear" in fault(again, capsys)
    assert main([*map(str, again[:-1]), "auto", "--out", str(tmp_path / "other.yaml")]) == 0
    assert "response: linear (as configured, but borders" in capsys.readouterr().out


def test_check_tells_of_the_taught_model(rig: Path, taught: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["check", str(rig / "config.yaml"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["taught"]["edges"]) == 10 and report["taught"]["images"] == 3
    assert report["taught"]["edges"] == [edge["id"] for edge in report["edges"] if edge["visible"]]
    largest = report["taught"]["largest"]
    edges = load_config(rig / "config.yaml").taught.edges  # type: ignore[union-attr]
    assert abs(largest["offset_m"]) == max(abs(v) for edge in edges.values() for v in edge.offset_m)
    assert largest["offset_px"] == pytest.approx(largest["offset_m"] * 962.0 / 0.115)
    assert report["accuracy"]["edges"] == 10, "the creases, too"
    # A sweep looks with the same edges.
    assert main(["check", str(rig / "config.yaml"), "--sweep", "--distance", "0.12", "--tilt", "30", "--json"]) == 0
    present = json.loads(capsys.readouterr().out)["present"]
    assert present["accuracy"]["expected"]["tcp_m"] == pytest.approx(report["accuracy"]["expected"]["tcp_m"], rel=1e-9)
    assert main(["check", str(rig / "untaught.yaml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["taught"] is None


def test_a_second_run_needs_force_and_changes_nothing_without(
    rig: Path, taught: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    before = taught.read_bytes()
    arguments = ["teach", rig / "first" / "0.png", "--config", rig / "config.yaml"]
    assert "is there already" in fault(arguments, capsys) and taught.read_bytes() == before
    out = tmp_path / "again.yaml"
    out.write_text("old")
    assert "names" in fault([*arguments, "--out", out, "--force", "--into-config"], capsys) and out.read_text() == "old"
    assert main([*map(str, arguments), "--out", str(out), "--force"]) == 0
    text = capsys.readouterr().out
    assert f"add the line `taught: {out}` to" in text
    # A configuration that names none gets the line, by the command.
    mine = rig / "mine.yaml"
    mine.write_text(f"# my own words\n{(rig / 'untaught.yaml').read_text()}")
    words = ["teach", rig / "first" / "0.png", "--config", mine, "--out", tmp_path / "third.yaml", "--into-config"]
    assert main([*map(str, words)]) == 0
    assert "add the line" not in capsys.readouterr().out and mine.read_text().startswith("# my own words\n")
    assert load_config(mine).taught is not None and load_config(mine).taught_path.resolve() == tmp_path / "third.yaml"
    mine.unlink()
    assert len(to_settings(read_yaml(out), TaughtModel).provenance.images) == 1


def test_what_makes_the_bound_larger_isnt_advised(rig: Path, taught: Path):
    unnamed, named, only = load_config(rig / "untaught.yaml"), load_config(rig / "config.yaml"), "only if the edges lie"
    assert only not in "".join(written(unnamed, taught, larger=False) + written(named, taught, larger=False))
    assert "add the line `taught:" in written(unnamed, taught, larger=True)[1].split(only)[1]
    assert "otherwise take the line out again" in written(named, taught, larger=True)[1].split(only)[1]


@pytest.mark.parametrize(
    ("what", "code", "said"),
    [
        ("nowhere.png", 2, "nowhere.png: the file is missing; an image file"),
        ("empty.png", 2, "empty.png: the file is empty"),
        ("text.png", 2, "text.png: truncated, damaged or not an image"),
        ("nothing", 2, "nothing: no image in this folder; e.g. *.png, *.jpg"),
        ("small.png", 2, "wrong_size: 384x288 pixels; 768x576"),
        ("black.png", 2, "black: no pixel brighter"),
        ("first/0.png first/../first/0.png", 2, "is the same image as"),
        ("alone.png", 2, "its jaw opening isn't known (jaw.source is frames); --jaw-opening M, or"),
        ("alone.png --jaw-opening 0.9", 2, "alone.png: jaw opening 0.9 m; the gripper's 0 to 0.06 m"),
        ("alone.png --jaw-opening 0.0605", 2, "jaw opening 0.0605 m; the gripper's 0 to 0.06 m"),
        ("grey.png --jaw-opening 0.034", 3, "teach: the gripper isn't found: only 0 % of the straight outlines"),
        ("alone.png --jaw-opening 0.0347", 3, "the image shows a jaw opening of 0.03"),
        ("alone.png --jaw-opening 0.034 --out first", 2, "--out {folder}/first: is a folder; a file"),
        ("alone.png --jaw-opening 0.034 --picture x.tiff", 2, "has no known ending"),
    ],
)
def test_what_can_not_be_taught_from_is_one_line(
    rig: Path, tmp_path: Path, what: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
):
    """Unreadable or foreign files end with 2, images without the gripper at the reference with 3; nothing written."""
    image = image_of(BEVEL_M, scene(120.0))
    (tmp_path / "first").mkdir()
    (tmp_path / "nothing").mkdir()
    for name in ("alone.png", "first/0.png"):
        cv2.imwrite(str(tmp_path / name), image)
    (tmp_path / "first" / "timestamps.csv").write_text(f"file,stamp_ns,jaw_opening_m\n0.png,1,{OPENING_M}\n")
    cv2.imwrite(str(tmp_path / "small.png"), image[::2, ::2])
    cv2.imwrite(str(tmp_path / "black.png"), 0 * image)
    cv2.imwrite(str(tmp_path / "grey.png"), np.tile(np.arange(768, dtype=np.uint8) // 8 + 60, (576, 1)))
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.png").write_text("no image")
    words = [w if w.startswith("-") or w[0] == "0" else str(tmp_path / w) for w in what.split()]
    reference = {"position_sigma_m": 2e-5, "rotation_sigma_rad": 2e-4}
    values = yaml.safe_load((rig / "untaught.yaml").read_text())
    values["reference"].update(reference)
    values.update(gripper=str(rig / "gripper.yaml"))
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values))
    out = [] if "--out" in words else ["--out", str(tmp_path / "t.yaml")]
    line = fault(["teach", *words, "--config", tmp_path / "config.yaml", *out], capsys, code)
    assert said.format(folder=tmp_path) in line
    assert not (tmp_path / "t.yaml").exists()


def test_a_gripper_without_a_jaw_takes_no_opening(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    cv2.imwrite(str(tmp_path / "a.png"), np.tile(np.arange(640, dtype=np.uint8) // 8 + 60, (480, 1)))
    config = builtin_config("visp_cube.yaml")
    arguments = ["teach", tmp_path / "a.png", "--config", config, "--out", tmp_path / "t.yaml"]
    assert "the gripper has no jaw" in fault([*arguments, "--jaw-opening", "0.03"], capsys)
    assert "the gripper isn't found" in fault(arguments, capsys, 3)


# --- a taught model that belongs to something else ---


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"camera__fx_px": 962.5}, "camera.fx_px: taught with 962.0, the configuration has 962.5; teach again"),
        ({"camera__kappa_per_px2": 2e-7}, "camera.kappa_per_px2: taught with 1.9e-07"),
        ({"camera__width_px": 800}, "camera.width_px: taught with 768, the configuration has 800"),
        ({"reference__cam_T_grip__translation_m": [0.0005, 0.0013, 0.115]}, "reference.cam_T_grip: taught at demo-"),
        ({"monitor__corners": {"edges": {"blur_px": 1.0}}}, "edge_settings.blur_px: taught with 0.65"),
        ({"gripper": "other.yaml"}, "gripper: taught with two_box_fingers with other contents"),
        ({"gripper": "named.yaml"}, "gripper: taught with two_box_fingers, the configuration has somebody_elses"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_another_camera_gripper_or_reference_is_refused(
    rig: Path, taught: Path, changes: dict[str, object], said: str, capsys: pytest.CaptureFixture[str]
):
    changed(rig / "gripper.yaml", rig / "other.yaml", points__L_in_near__xyz_m=[-0.017, -0.00801, 0.0])
    changed(rig / "gripper.yaml", rig / "named.yaml", name="somebody_elses")
    path = changed(rig / "config.yaml", rig / "changed.yaml", **changes)
    line = fault(["check", path], capsys)
    assert line.startswith(f"{taught}: {said}")
    assert line.endswith("teach again (gripmon teach), or use what it was taught with")
    assert "taught" in fault(["replay", rig / "moved", "--config", path, "--out", rig / "x.jsonl"], capsys)
    assert load_config(path, with_taught=False).taught is None, "to teach again it is not in the way"


def test_comments_order_and_spelling_of_the_gripper_file_do_not_matter(rig: Path, taught: Path):
    text = (rig / "gripper.yaml").read_text()
    (rig / "same.yaml").write_text("# A comment.\n" + text.replace("-0.017", "-0.0170"))
    assert load_config(changed(rig / "config.yaml", rig / "same_config.yaml", gripper="same.yaml")).taught is not None


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"edges__L_tip_in__offset_m": [0.5, 0.0]}, "edges.L_tip_in.offset_m[0]: is 0.5; "),
        ({"edges__L_tip_in__offset": 1.0}, "edges.L_tip_in.offset: unknown key, did you mean"),
        ({"edges__L_tip_in__share": [0.5, 0.5]}, "edges.L_tip_in.share: is [0.5, 0.5]; two shares, ascending"),
        (
            {"edges__nobody": {"share": [0, 1], "offset_m": [0, 0], "sigma_m": [0, 0], "crease": False}},
            "edges.nobody: ",
        ),
        ({"corners__nobody": {"uv_px": [0, 0], "sigma_px": 1}}, "corners.nobody: the gripper has no such"),
        ({"gripper__sha256": "abc"}, "gripper.sha256: is 'abc'; "),
        ({"edges": {}}, "edges"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_damaged_file_is_refused(rig: Path, taught: Path, changes: dict[str, object], said: str):
    changed(taught, rig / "damaged.yaml", **changes)
    path = changed(rig / "config.yaml", rig / "damaged_config.yaml", taught="damaged.yaml")
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    assert str(refused.value).startswith(f"{rig / 'damaged.yaml'}: {said}")


def test_a_missing_file_is_refused(rig: Path):
    path = changed(rig / "config.yaml", rig / "missing.yaml", taught="nowhere.yaml")
    with pytest.raises(ConfigError, match=r"taught: there is no file .*nowhere\.yaml; a file of gripmon teach"):
        load_config(path)


# --- the file itself ---

METRES = st.floats(-0.02, 0.02)
DEVIATIONS = st.floats(0.0, 0.02)
GREYS: st.SearchStrategy[object] = st.none() | st.builds(dict, level=st.floats(0.0, 1e3), spread=st.floats(0.0, 1e3))
EDGES = st.fixed_dictionaries(
    {
        "share": st.tuples(st.floats(0.0, 0.4), st.floats(0.5, 1.0)),
        "offset_m": st.tuples(METRES, METRES),
        "sigma_m": st.tuples(DEVIATIONS, DEVIATIONS),
        "depth_m": METRES,
        "depth_sigma_m": DEVIATIONS,
        "crease": st.booleans(),
        "brighter": st.sampled_from(["left", "right", "any"]),
        "rms_px": st.floats(0.0, 1e3),
        "seen": st.floats(0.0, 1.0),
        "left": GREYS,  # of earlier versions
        "right": GREYS,
    }
)
NAMES = st.text(
    st.characters(codec="utf-8", exclude_categories=["C"], exclude_characters="\x85\u2028\u2029"), min_size=1
)


@settings(max_examples=60)
@given(edges=st.dictionaries(NAMES | st.sampled_from(["no", "1e5", "~", "0x1", "a: b", " x", "-"]), EDGES, min_size=1))
def test_reading_gives_back_what_was_written(tmp_path_factory: pytest.TempPathFactory, edges: dict[str, object]):
    """Any names and numbers, to the last bit, through the file and the reader of configurations."""
    config = load_config(builtin_config("demo.yaml"))
    plain = {
        "provenance": {
            "gripmon": "1.0",
            "time": "2030-01-01T00:00:00+00:00",
            "command": "gripmon teach 'a b'.png: # no comment",
            "images": [{"file": "é.png", "sha256": "0" * 64}],
            "closure_px": 0.1,
        },
        "camera": msgspec.to_builtins(config.camera.settings),
        "gripper": {"name": "null", "sha256": "9" * 64},
        "reference": {"id": "12", "cam_T_grip": msgspec.to_builtins(config.reference.cam_T_grip)},
        "edge_settings": {},
        "edges": edges,
    }
    model = msgspec.convert(plain, TaughtModel)
    path = tmp_path_factory.getbasetemp() / "round_trip.yaml"
    path.write_text(to_yaml(model), encoding="utf-8")
    assert to_settings(read_yaml(path), TaughtModel) == model


def test_labels_in_the_picture_do_not_lie_over_each_other_nor_leave_it():
    picture = np.full((300, 400, 3), 128, np.uint8)
    labels = Labels(picture)
    labels.title("a_gripper_with_a_long_name: sharp model (blue), taught outlines (orange), creases (green)", "offsets")
    for k, at in enumerate([(200, 150)] * 4 + [(2, 2), (398, 298), (398, 2), (203, 152)]):
        labels.put(f"left_inner_near {k}", at, (0, 200, 255))
    assert len(labels.boxes) == 10
    for k, (left, top, right, bottom) in enumerate(labels.boxes):
        assert left >= 0 and top >= 0 and right <= 400 and bottom <= 300
        for other in labels.boxes[:k]:
            assert left >= other[2] or right <= other[0] or top >= other[3] or bottom <= other[1]
