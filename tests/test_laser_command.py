"""``gripmon calibrate laser``: from tables and rendered images to the file, and bad input in one line each."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from support.laser_scenes import PAPER_LENS, paper_setup, sampled, write_csv

from gripmon.calibrate.documents import CameraCalibration, CameraResiduals
from gripmon.cli import main
from gripmon.laser.documents import NAMES
from gripmon.model.geometry import inverse_jacobian, invert, perturb, perturbation_between
from gripmon.model.provenance import provenance_of
from gripmon.model.yaml_text import as_yaml
from gripmon.simulate.laser import spot_image


@pytest.fixture
def camera(tmp_path):
    import msgspec

    path = tmp_path / "camera.yaml"
    calibration = CameraCalibration(
        camera=PAPER_LENS,
        parameters=("fx_px", "fy_px", "cx_px", "cy_px"),
        covariance=tuple(np.diag([0.25, 0.25, 0.25, 0.25]).ravel().tolist()),
        residuals=CameraResiduals(rms_px=0.1, views=10, points=500, outliers=0),
        target="chequerboard:9x6:0.025",
        provenance=provenance_of("test"),
    )
    path.write_text(as_yaml(msgspec.to_builtins(calibration)))
    return path


def scene(seed=1, noise_px=0.3, **options):
    rng = np.random.default_rng(seed)
    data = sampled(paper_setup(rng), rng, **{"orientations": 6, **options})
    return data, data.uv_px + rng.normal(0.0, noise_px, data.uv_px.shape)


def rows_of(data, uv):
    quaternions = Rotation.from_matrix(data.base_T_ee[:, :3, :3]).as_quat()
    return [
        dict(zip(("u_px", "v_px", "tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), map(float, values), strict=True))
        for values in np.concatenate([uv, data.base_T_ee[:, :3, 3], quaternions], axis=1)
    ]


def calibrate(*arguments):
    return main(["calibrate", "laser", *map(str, arguments)])


def assert_near(written, truth, tolerance_m=0.01):
    """Within five standard deviations of the truth, and these small."""
    found = np.array(written["base_T_cam"]["translation_m"])
    sigmas = np.array([written["sigmas"][f"base_T_cam.{axis}_m"] for axis in "xyz"])
    error = found - truth.base_T_cam[:3, 3]
    assert (np.abs(error) < 5.0 * sigmas).all()
    assert sigmas.max() < tolerance_m
    assert abs(written["plane"]["distance_cam_m"] - truth.distance_cam_m) < 5.0 * written["sigmas"]["plane.distance_m"]
    assert np.abs(np.array(written["laser"]["direction_ee"]) - truth.direction_ee).max() < 0.01


def test_a_table_becomes_a_file_with_everything(tmp_path, camera, capsys):
    data, uv = scene()
    uv[[7, 33]] += [[40.0, -25.0], [-30.0, 30.0]]
    table = write_csv(tmp_path / "spots.csv", rows_of(data, uv))
    out, picture, recording = (tmp_path / name for name in ("laser.yaml", "laser.png", "laser.rrd"))
    assert calibrate(table, "--camera", camera, "--out", out, "--picture", picture, "--recording", recording) == 0
    written = yaml.safe_load(out.read_text())
    assert written["schema"] == "gripmon.laser_calibration/1"
    assert_near(written, data.truth)
    assert written["parameters"] == list(NAMES)
    covariance = np.array(written["covariance"]).reshape(13, 13)
    assert np.allclose(np.sqrt(covariance.diagonal()), [written["sigmas"][name] for name in NAMES])
    assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(covariance.diagonal(), covariance.diagonal()))).min() > 0.0
    assert written["residuals"]["outliers"] == ["line 9", "line 35"]
    assert 0.2 < written["residuals"]["sigma_px"] < 0.4
    assert written["residuals"]["orientations"] == 6
    assert {entry["file"] for entry in written["provenance"]["inputs"]} == {str(table), str(camera)}
    assert written["provenance"]["seed"] == 0
    assert cv2.imread(str(picture)).shape == (640, 1600, 3)
    paths = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
    assert {"/base/spots", "/base/beams", "/base/plane", "/base/camera/image"} <= paths
    said = capsys.readouterr().out
    assert "58 of 60 spots at 6 orientations" in said and "left out: line 9" in said and "seed 0" in said


def test_every_way_to_give_poses_says_the_same(tmp_path, camera):
    data, uv = scene()
    rows = rows_of(data, uv)
    vectors = Rotation.from_matrix(data.base_T_ee[:, :3, :3]).as_rotvec()
    spots = [{"u_px": r["u_px"], "v_px": r["v_px"]} for r in rows]
    places = [{k: r[k] for k in ("tx_m", "ty_m", "tz_m")} for r in rows]
    tables = {
        "quaternion.csv": rows,
        "vector.csv": [
            {**s, **p, "rx_rad": v[0], "ry_rad": v[1], "rz_rad": v[2]}
            for s, p, v in zip(spots, places, vectors.tolist(), strict=True)
        ],
        "matrix.csv": [
            {**s, **{f"m{i}{j}": float(T[i, j]) for i in range(4) for j in range(4)}}
            for s, T in zip(spots, data.base_T_ee, strict=True)
        ],
        "nested.yaml": [{**s, "base_T_ee": T.tolist()} for s, T in zip(spots, data.base_T_ee, strict=True)],
        "records.json": [
            {**s, "group": int(g), "base_T_ee": {"translation_m": T[:3, 3].tolist(), "rotation_xyzw": q.tolist()}}
            for s, g, T, q in zip(spots, data.group, data.base_T_ee,
                                  Rotation.from_matrix(data.base_T_ee[:, :3, :3]).as_quat(), strict=True)
        ],
    }  # fmt: skip
    found = []
    for name, table in tables.items():
        path, out = tmp_path / name, tmp_path / f"{name}.out.yaml"
        if name.endswith(".csv"):
            write_csv(path, table)
        else:
            path.write_text(json.dumps(table if name.endswith(".json") else {"samples": table}))
        assert calibrate(path, "--camera", camera, "--out", out) == 0
        found.append(yaml.safe_load(out.read_text())["base_T_cam"]["translation_m"])
    assert np.ptp(np.array(found), axis=0).max() < 1e-6
    halves = [write_csv(tmp_path / f"half{k}.csv", rows[k::2]) for k in range(2)]
    assert calibrate(*halves, "--camera", camera, "--out", tmp_path / "both.yaml") == 0
    both = yaml.safe_load((tmp_path / "both.yaml").read_text())["base_T_cam"]["translation_m"]
    assert np.abs(np.array(both) - found[0]).max() < 1e-6


def test_lens_and_arm_take_part(tmp_path, camera):
    data, uv = scene()
    table = write_csv(tmp_path / "spots.csv", rows_of(data, uv))
    sigmas = []
    for name, options in (("plain", []), ("both", ["--refine-lens", "--arm-noise", "0.0005:0.001"])):
        out = tmp_path / f"{name}.yaml"
        assert calibrate(table, "--camera", camera, "--out", out, *options) == 0
        written = yaml.safe_load(out.read_text())
        assert_near(written, data.truth, 0.02)
        sigmas.append(np.array(list(written["sigmas"].values())))
    assert written["camera"]["fx_px"] != 543.0
    assert sigmas[1].mean() < sigmas[0].mean()  # held, the lens's uncertainty is in it in full


def test_from_rendered_images_with_reflections_to_the_file(tmp_path, camera, capsys):
    data, _ = scene(3, orientations=4)
    rng = np.random.default_rng(9)
    rows = rows_of(data, data.uv_px)
    for k, (row, uv) in enumerate(zip(rows, data.uv_px, strict=True)):
        lamp = ((320.0, 60.0, 2000.0),) if k in (5, 18) else ()
        height = 0.0 if k == 11 else 400.0
        image = spot_image(uv, rng, height=height, speckle=0.2, colour=True, reflections=lamp)
        del row["u_px"], row["v_px"]
        row["image"] = f"{k:02d}.png"
        cv2.imwrite(str(tmp_path / row["image"]), image)
    table = write_csv(tmp_path / "spots.csv", rows)
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "laser.yaml") == 0
    written = yaml.safe_load((tmp_path / "laser.yaml").read_text())
    assert_near(written, data.truth, 0.03)
    assert written["residuals"]["spots"] == 39
    assert any(line.startswith("11.png: no spot") for line in written["warnings"])
    assert any("05.png" in line and "18.png" in line for line in written["warnings"])
    assert len(written["provenance"]["inputs"]) == 42
    assert "11.png: no spot" in capsys.readouterr().err


def test_the_covariance_of_base_T_cam_is_that_of_the_inverse():
    data, _ = scene()
    step = 1e-6
    numeric = np.stack(
        [
            (
                perturbation_between(invert(data.truth.cam_T_base), invert(perturb(data.truth.cam_T_base, step * e)))
                - perturbation_between(invert(data.truth.cam_T_base), invert(perturb(data.truth.cam_T_base, -step * e)))
            )
            / (2.0 * step)
            for e in np.eye(6)
        ],
        axis=1,
    )
    assert np.abs(inverse_jacobian(data.truth.cam_T_base) - numeric).max() < 1e-7


# ---- bad input


def changed(rows, k, **values):
    rows[k] = {**rows[k], **values}
    return rows


def without(rows, *keys):
    return [{k: v for k, v in row.items() if k not in keys} for row in rows]


def as_matrices(data, rows, change):
    return [
        {"u_px": r["u_px"], "v_px": r["v_px"], **{f"m{i}{j}": M[i, j] for i in range(4) for j in range(4)}}
        for r, M in zip(rows, change(data.base_T_ee.copy()), strict=True)
    ]


def left_handed(poses):
    poses[4, :3, 2] *= -1.0
    return poses


def sheared(poses):
    poses[4, :3, 0] *= 1.05
    return poses


BAD_USAGE = {
    "no spot column": (lambda d, r: without(r, "u_px"), "line 2: has neither u_px and v_px nor image"),
    "no pose column": (lambda d, r: without(r, "ty_m"), "line 2: has no column ty_m"),
    "no rotation": (lambda d, r: without(r, "qx", "qy", "qz", "qw"), "line 2: has no rotation"),
    "no w": (lambda d, r: without(r, "qw"), "line 2: qw: is missing"),
    "text": (lambda d, r: changed(r, 3, tx_m="near"), "line 5: tx_m: 'near' is not a number"),
    "nan": (lambda d, r: changed(r, 3, tx_m="nan"), "line 5: tx_m: 'nan' is not a number"),
    "no unit quaternion": (lambda d, r: changed(r, 2, qx=90.0), "line 4: its quaternion has length 90 (degrees?)"),
    "degrees": (
        lambda d, r: [{**dict(list(row.items())[:5]), "rx_rad": 90.0, "ry_rad": 0.0, "rz_rad": 45.0} for row in r],
        "line 2: turns by 100.6 rad, more than once around (degrees?); radians",
    ),
    "millimetres": (
        lambda d, r: [{**row, **{k: 1000.0 * row[k] for k in ("tx_m", "ty_m", "tz_m")}} for row in r],
        "which no arm reaches: millimetres? metres",
    ),
    "left-handed": (lambda d, r: as_matrices(d, r, left_handed), "line 6: the rotation is left-handed"),
    "not orthonormal": (lambda d, r: as_matrices(d, r, sheared), "line 6: the rotation is not orthonormal"),
    "transposed": (
        lambda d, r: as_matrices(d, r, lambda T: T.transpose(0, 2, 1)), "line 2: the last row of the 4 x 4"
    ),
    "outside": (lambda d, r: changed(r, 1, u_px=900.0), "line 3: the spot (900"),
    "twice": (lambda d, r: [*r, r[3]], "line 62: is the same sample as line 5"),
    "half a group": (lambda d, r: changed([{**row, "group": ""} for row in r], 0, group="a"), "line 3: has no group"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_USAGE)
def test_bad_tables_end_with_one_line_and_nothing_is_written(name, tmp_path, camera, capsys):
    change, text = BAD_USAGE[name]
    data, uv = scene()
    table = write_csv(tmp_path / "spots.csv", change(data, rows_of(data, uv)))
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "laser.yaml") == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and text in said[0] and "spots.csv" in said[0]
    assert not (tmp_path / "laser.yaml").exists()


def test_several_tables_count_each_sample_once_and_say_which_is_left_out(tmp_path, camera, capsys):
    data, uv = scene()
    uv[33] += [-30.0, 30.0]
    rows = rows_of(data, uv)
    first, second = write_csv(tmp_path / "first.csv", rows[:30]), write_csv(tmp_path / "second.csv", rows[30:])
    assert calibrate(first, second, "--camera", camera.parent, "--out", tmp_path / "laser.yaml") == 0
    assert "left out: second.csv, line 5" in capsys.readouterr().out
    inputs = yaml.safe_load((tmp_path / "laser.yaml").read_text())["provenance"]["inputs"]
    assert str(camera) in [each["file"] for each in inputs], "of a project's folder the file is named"
    copy = write_csv(tmp_path / "copy.csv", rows[10:12])
    assert calibrate(first, second, copy, "--camera", camera, "--out", tmp_path / "no.yaml") == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "copy.csv: copy.csv, line 2" not in said
    assert "copy.csv: line 2: is the same sample as" in said and "first.csv: line 12; each sample once" in said
    assert not (tmp_path / "no.yaml").exists()


def test_a_table_of_another_separator_is_named(tmp_path, camera, capsys):
    table = write_csv(tmp_path / "spots.csv", rows_of(*scene()))
    for sign, name in ((";", "semicolons"), ("\t", "tabs")):
        other = tmp_path / "other.csv"
        other.write_text(table.read_text().replace(",", sign))
        assert calibrate(other, "--camera", camera, "--out", tmp_path / "no.yaml") == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and f"other.csv: columns are separated by {name}; commas" in said


def test_a_reach_in_millimetres_is_refused(tmp_path, camera, capsys):
    table = write_csv(tmp_path / "spots.csv", rows_of(*scene()))
    plan = ("--plan", tmp_path / "next.csv", "--reach", "850")
    with pytest.raises(SystemExit) as stopped:
        calibrate(table, "--camera", camera, "--out", tmp_path / "no.yaml", *plan)
    assert stopped.value.code == 2 and "850 m isn't an arm's reach (millimetres?)" in capsys.readouterr().err


def out_of_step(data, uv):
    return data.base_T_ee, np.roll(uv, 1, axis=0)


def one_orientation(data, uv):
    return data.base_T_ee[:10], uv[:10]


def on_a_line(data, uv):
    along = np.random.default_rng(1).uniform(50.0, 600.0, len(uv))
    return data.base_T_ee, np.stack([along, 100.0 + 0.3 * along], axis=1)


def nonsense(data, uv):
    return data.base_T_ee, np.random.default_rng(1).uniform([0.0, 0.0], [640.0, 480.0], uv.shape)


def far_laser(data, uv):
    rng = np.random.default_rng(2)
    data = sampled(replace(paper_setup(rng), point_ee_m=np.array([0.0, 1.6, 0.03])), rng, orientations=6)
    return data.base_T_ee, data.uv_px


def thousandth(data, uv):
    poses = data.base_T_ee.copy()
    poses[:, :3, 3] *= 0.001
    return poses, uv


def inverted(data, uv):
    return np.stack([invert(pose) for pose in data.base_T_ee]), uv


def with_rotations(data, rotations):
    poses = data.base_T_ee.copy()
    poses[:, :3, :3] = rotations
    return poses


def w_first(data, uv):
    quaternions = Rotation.from_matrix(data.base_T_ee[:, :3, :3]).as_quat()
    return with_rotations(data, Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix()), uv


def turned_back(data, uv):
    return with_rotations(data, data.base_T_ee[:, :3, :3].transpose(0, 2, 1)), uv


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (inverted, "the poses are ee_T_base: inverted, the spots fit"),
        (w_first, "the quaternions have w first: read so, the spots fit"),
        (turned_back, "the rotations are the other way round"),
        (thousandth, "mm from the camera: were metres divided once too often"),
        (far_laser, "pass the end-effector's origin at"),
        (out_of_step, "poses and images are out of step: spots fit the poses 1 row(s)"),
        (one_orientation, "1 orientation(s) with at least"),
        (on_a_line, "all spots lie on one line in the image"),
        (nonsense, ";"),
    ],
)
def test_data_that_cannot_be_calibrated_from_end_with_why_and_nothing_is_written(
    change, text, tmp_path, camera, capsys
):
    data, uv = scene()
    poses, uv = change(data, uv)
    table = write_csv(tmp_path / "spots.csv", rows_of(replace(data, base_T_ee=poses), uv))
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "laser.yaml") == 3
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and text in said[0]
    assert not (tmp_path / "laser.yaml").exists()


def test_an_orientation_that_contradicts_the_others_is_named_in_output_and_file(tmp_path, camera, capsys):
    data, uv = scene(orientations=7)
    uv = uv.copy()
    uv[10:20] += 25.0  # e.g. all on a box that stands on the plane
    table = write_csv(tmp_path / "spots.csv", rows_of(data, uv))
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "laser.yaml") == 0
    line = "an orientation contradicts the others: 10 of its 10 spots left out, spots 11 to 20"
    assert line in capsys.readouterr().out
    written = yaml.safe_load((tmp_path / "laser.yaml").read_text())
    assert any(line in warning for warning in written["warnings"])
    assert_near(written, data.truth)


def test_residuals_that_no_spot_has_are_doubted(tmp_path, camera, capsys):
    data, uv = scene(orientations=4)
    poses = data.base_T_ee.copy()
    poses[:10, :3, 3] += [0.05, 0.0, 0.0]
    table = write_csv(tmp_path / "spots.csv", rows_of(replace(data, base_T_ee=poses), uv))
    assert calibrate(table, "--camera", camera, "--out", tmp_path / "laser.yaml") == 0
    line = "px are larger than a spot's: an orientation or a pose that was misread"
    assert line in capsys.readouterr().out
    assert any(line in warning for warning in yaml.safe_load((tmp_path / "laser.yaml").read_text())["warnings"])


def test_files_that_are_none(tmp_path, camera, capsys):
    data, uv = scene()
    table = write_csv(tmp_path / "spots.csv", rows_of(data, uv))
    (tmp_path / "empty.csv").write_text("u_px,v_px\n")
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "list.yaml").write_text("samples: 3\n")
    (tmp_path / "ragged.csv").write_text("u_px,v_px\n1,2,3\n")
    out = tmp_path / "laser.yaml"
    for arguments in (
        [tmp_path / "none.csv", "--camera", camera],
        [tmp_path / "empty.csv", "--camera", camera],
        [tmp_path / "broken.json", "--camera", camera],
        [tmp_path / "list.yaml", "--camera", camera],
        [tmp_path / "ragged.csv", "--camera", camera],
        [tmp_path / "notes.txt", "--camera", camera],
        [table, "--camera", tmp_path / "none.yaml"],
        [table, "--camera", camera, "--picture", tmp_path / "laser.gif"],
    ):
        assert calibrate(*arguments, "--out", out) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and ";" in said[0]
        assert not out.exists()
    out.write_text("mine")
    assert calibrate(table, "--camera", camera, "--out", out) == 2
    assert out.read_text() == "mine"
    with pytest.raises(SystemExit):
        calibrate(table, "--camera", camera, "--out", out, "--arm-noise", "1")
