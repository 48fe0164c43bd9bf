"""``tools/bench real``: what it makes of stills whose motion is known, and that it reads what a real set says."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.changing_backgrounds import images_of, moving_robot
from support.simulated import BOX_FINGERS, PAPER_LENS, nominal_cam_T_grip

from gripmon.daemon.api import open_source
from gripmon.daemon.config import builtin_config
from gripmon.model.geometry import to_record
from gripmon.model.records import (
    Frame,
    Origin,
    Protection,
    ReferenceRecord,
    Since,
    SinceReference,
    Transform,
    ValidBy,
    unmeasured_record,
)

ROOT = Path(__file__).resolve().parent.parent
REAL = ROOT.parent / "shared" / "data" / "real"
STILLS = 8
OPENING_M = 0.034
WIDE = (5e-3, math.radians(5.0))

pytestmark = pytest.mark.usefixtures("tools_importable")


def still(motion, bound=(1e-3, 0.01), **fields):
    """A measured still that is off the reference (at 0.2 m, turned by 0.3 rad) by ``motion`` (6,), m and rad."""
    from benchmarks.real_runs import Still

    turned = Rotation.from_rotvec(motion[3:]) * Rotation.from_rotvec((0.3, 0.0, 0.0))
    covariance = np.diag([1e-4**2] * 3 + [1e-3**2] * 3)
    made = Still(
        name="a.png",
        measured=True,
        valid=True,
        translation_m=tuple(np.array((0.0, 0.0, 0.2)) + motion[:3]),
        rotation_xyzw=tuple(turned.as_quat()),
        covariance=tuple(covariance.ravel()),
        bound_m=bound[0],
        bound_rad=bound[1],
        hypothesis="nothing is wrong",
        reason=None,
        alerts=(),
    )
    return msgspec.structs.replace(made, **fields)


def run_of(*stills, uncounted=1, **fields):
    from benchmarks.real_runs import Part, Run

    part = Part(tuple(s.name for s in stills), uncounted, stills=stills, proposed_m=2e-3, proposed_rad=0.02)
    quaternion = tuple(Rotation.from_rotvec((0.3, 0.0, 0.0)).as_quat())
    return Run(
        "a set", False, "absolute", *WIDE, (0.0, 0.0, 0.2), quaternion, (msgspec.structs.replace(part, **fields),)
    )


UNMEASURED = {"measured": False, "valid": False, "translation_m": None, "rotation_xyzw": None, "covariance": None}


def test_figures_of_known_motions():
    from benchmarks.real_figures import figures_of

    rng = np.random.default_rng(5)
    motions = rng.normal(0.0, [1e-4] * 3 + [1e-3] * 3, (21, 6)) + np.array((3e-4, 0.0, 0.0, 0.0, 0.002, 0.0))
    found = figures_of(run_of(*map(still, motions)))
    counted = motions[1:]
    away = counted - np.median(counted, axis=0)
    assert (found.stills, found.measured, found.valid) == (20, 20, 20)
    np.testing.assert_allclose(found.scatter, counted.std(axis=0, ddof=1), rtol=1e-6)
    in_sigmas = np.array([1e-4] * 3 + [1e-3] * 3)
    assert found.chi2_scatter == pytest.approx(np.mean((away / in_sigmas) ** 2), rel=1e-6)
    assert found.chi2_motion == pytest.approx(np.mean((counted / in_sigmas) ** 2), rel=1e-6)
    assert found.chi2_motion > 2.0 > found.chi2_scatter


def test_the_first_still_of_a_half_counts_for_its_alerts_alone():
    from benchmarks.real_figures import figures_of

    far = np.array((0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    found = figures_of(run_of(still(far, alerts=("drift", "occluded")), still(0.0 * far), still(0.0 * far)))
    assert found.stills == found.measured == 2 and found.scatter[0] == 0.0 and not found.beyond
    assert found.alerts == {"drift": 1}


def test_beyond_a_bound_is_by_position_or_by_rotation():
    from benchmarks.real_figures import figures_of

    nowhere = np.zeros(6)
    beside, turned = np.array((0.0, 0.0, 1.5e-3, 0.0, 0.0, 0.0)), np.array((0.0, 0.0, 0.0, 0.0, 0.013, 0.0))
    found = figures_of(run_of(*[still(nowhere)] * 6, still(beside), still(turned), still(0.5 * beside)))
    assert np.allclose(found.beyond, [(5e-4, 0.0), (0.0, 0.003)], atol=1e-12)
    # All of them off the reference: the median doesn't see it, the motion does.
    found = figures_of(run_of(*[still(beside)] * 5))
    assert found.beyond == () and len(found.moved_beyond) == 4


def test_nine_of_ten_bounds_are_within_the_smallest_limit_and_unmeasured_stills_have_none():
    from benchmarks.real_figures import figures_of

    bounds = [(1e-3 * n, 0.01 * n) for n in range(1, 10)]
    stills = [still(np.zeros(6), bound) for bound in bounds]
    gone = still(np.zeros(6), (None, None), **UNMEASURED, hypothesis="", reason="too few edges: 2")
    found = figures_of(run_of(gone, *stills, gone))
    assert (found.stills, found.measured) == (10, 9)
    np.testing.assert_allclose(found.least, (9e-3, 0.09))  # nine of ten
    np.testing.assert_allclose(found.bound, (5e-3, 0.05))
    assert found.reasons == {"too few edges": 1}
    found = figures_of(run_of(gone, *stills[1:], gone, gone))
    assert np.isinf(found.least).all()


def test_a_half_that_nothing_is_taught_for_counts_as_not_measured():
    from benchmarks.real_figures import figures_of
    from benchmarks.real_runs import Part

    run = run_of(*[still(np.zeros(6))] * 5, taught="even")
    refused = Part(("a.png",) * 4, 1, "odd", refused="teach: no edges; and left out before: b.png: 1 px; c.png: 2 px")
    found = figures_of(msgspec.structs.replace(run, parts=(*run.parts, refused)))
    assert (found.stills, found.measured, found.valid) == (7, 4, 4)
    assert found.teaching == ("nothing is taught from the odd stills: no edges (others were left out before)",)
    np.testing.assert_allclose(found.proposed, (2e-3, 0.02))


def test_each_target_that_is_missed_is_named():
    from benchmarks.real import missed
    from benchmarks.real_figures import figures_of

    run = run_of(*[still(np.zeros(6), (2e-3, 0.02))] * 30)
    good = figures_of(run)
    assert missed([(run, good)]) == []
    assert missed([(run, replace(good, beyond=((8e-4, 0.0),)))]) == []  # the fingers' play
    wrong = {
        "beyond their bound": replace(good, beyond=((1e-3, 0.0),)),
        "alerts that the mount moved: step 1": replace(good, alerts=Counter(step=1)),
        "check proposes 0.5": replace(good, proposed=0.5 * good.proposed),
        "check proposes 1.6": replace(good, proposed=1.6 * good.proposed),
    }
    for words, figures in wrong.items():
        (fault,) = missed([(run, figures)])
        assert words in fault
    xarm = msgspec.structs.replace(run, name="xarm")
    (fault,) = missed([(xarm, replace(good, valid=11))])
    assert "at most 11 of 29 stills valid; at least 12" in fault
    assert missed([(xarm, replace(good, valid=11)), (xarm, good)]) == []  # one way of two is enough


def test_rows_of_two_commits_stand_beside_each_other_however_many_bounds_they_have(
    capsys: pytest.CaptureFixture[str],
):
    from benchmarks.kit import Report
    from benchmarks.real import show
    from benchmarks.real_figures import figures_of

    def rows(*bounds):
        runs = [
            msgspec.structs.replace(run_of(*[still(np.zeros(6))] * 3), name=name, taught=taught, bound=bound)
            for name in ("one", "other")
            for bound in bounds
            for taught in (False, True)
        ]
        return [(run, figures_of(run)) for run in runs]

    report = Report("tools/bench real")
    show({"before": rows("absolute"), "now": rows("reference", "absolute")}, [], report)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert [[cell.strip() for cell in line.strip("|").split("|")][:3] for line in lines[2:]] == [
        [f"{name}, {way}", *of]
        for name in ("one", "other")
        for way in ("untaught", "taught")
        for of in (("before", "absolute"), ("now", "reference"), ("now", "absolute"))
    ]


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten stills of a gripper that stands still in a camera that moves over a table."""
    folder = tmp_path_factory.mktemp("sets") / "simulated"
    folder.mkdir()
    for n, image in enumerate(images_of(moving_robot(4, opening_m=OPENING_M), STILLS + 2)):
        cv2.imwrite(str(folder / f"{n}.png"), image)
    values = yaml.safe_load(builtin_config("demo.yaml").read_text())
    pose = msgspec.to_builtins(to_record(nominal_cam_T_grip()))
    values["reference"]["cam_T_grip"] = {key: list(value) for key, value in pose.items()}
    values["camera"] = {**msgspec.to_builtins(PAPER_LENS), "model": "paper"}
    values.update(gripper="gripper.yaml", source={"kind": "folder", "path": "."})
    values["jaw"] = {"source": "fixed", "opening_m": OPENING_M}
    values["publish"]["enabled"] = values["recording"]["enabled"] = False
    (folder / "config.yaml").write_text(yaml.safe_dump(values))
    (folder / "gripper.yaml").write_text(BOX_FINGERS.read_text())
    return folder


@pytest.fixture(scope="module")
def replayed(stills: Path):
    """The folder's runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        from benchmarks.real_runs import Limit, runs_of

        return list(runs_of("simulated", stills, Limit(*WIDE)))


def test_simulated_stills_are_judged_once_untaught_and_once_taught(replayed):
    from benchmarks.real_figures import figures_of

    assert [(run.bound, run.taught) for run in replayed] == [
        (bound, taught) for bound in ("reference", "absolute", "belief") for taught in (False, True)
    ]
    untaught, taught = replayed[2:4]
    assert untaught.parts[0].names == tuple(f"{n}.png" for n in range(10))
    assert [part.names for part in taught.parts] == [
        tuple(f"{n}.png" for n in (1, 3, 5, 7, 9)),
        untaught.parts[0].names[::2],
    ]
    assert [part.taught for part in taught.parts] == ["even", "odd"]
    for run in replayed:
        found = figures_of(run)
        assert (found.stills, found.measured) == (STILLS, STILLS), found.reasons
        assert found.valid == STILLS and not found.beyond and not found.alerts
        assert (found.scatter[:3] < 1e-4).all() and found.chi2_scatter < 3.0
        assert (found.least < WIDE).all() and (found.bound <= found.least).all()
        assert np.isfinite(found.proposed).all() == (run.bound != "belief")  # of which check knows nothing


def test_jaw_openings_follow_their_stills_which_are_a_second_apart(stills: Path, tmp_path: Path):
    from benchmarks.real_runs import Limit, _Project

    folder, place = tmp_path / "set", tmp_path / "place"
    place.mkdir()
    shutil.copytree(stills, folder)
    rows = [f"{n}.png,{7 * n},0.03{n}" for n in range(10)]
    (folder / "timestamps.csv").write_text("\n".join(["file,stamp_ns,jaw_opening_m", *rows]) + "\n")
    project = _Project(folder, place, Limit(*WIDE))
    source = open_source(project._stills(project._images[1::2]))
    read = [(frame.name, frame.stamp_ns, frame.jaw_opening_m) for frame in source]
    assert read == [(f"{n}.png", 1_000_000_000 * k, float(f"0.03{n}")) for k, n in enumerate((1, 3, 5, 7, 9))]


def test_a_motion_is_known_from_when_a_frame_proves_where_the_gripper_is():
    from benchmarks.real_runs import bound_of

    at = Transform((0.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
    record = msgspec.structs.replace(
        unmeasured_record(Frame(0, 0, None), ReferenceRecord("", 0, 0, "", at, tuple(np.eye(6).ravel())), ""),
        source=Origin.UPDATE,
        cam_T_grip=at,
        protection=Protection(2e-3, 0.01, 1e-5),
    )
    assert bound_of(record) == record.protection
    by_reference = msgspec.structs.replace(record, valid_by=ValidBy.REFERENCE)
    assert bound_of(by_reference) is None
    since = SinceReference(1e-3, 0.01, Since.FIRST_PROVED, 0)
    assert bound_of(msgspec.structs.replace(by_reference, since_reference=since)) == record.protection
    assert bound_of(msgspec.structs.replace(record, source=Origin.HELD)) is None


def test_limits_decide_what_is_valid(stills: Path):
    from benchmarks.real_figures import figures_of
    from benchmarks.real_runs import Limit, runs_of

    tight = figures_of(next(iter(runs_of("simulated", stills, Limit(1e-5, 1e-4)))))
    assert tight.measured == STILLS and tight.valid == 0


def test_a_set_without_fixed_limits_needs_them(stills: Path, capsys: pytest.CaptureFixture[str]):
    assert bench(str(stills)) == 2
    assert "simulated: no alert limit is fixed for it; --limit MM DEGREES" in capsys.readouterr().err
    assert bench(str(stills.parent)) == 2
    assert "has no config.yaml" in capsys.readouterr().err


def bench(*arguments: str) -> int:
    from benchmarks.__main__ import main

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["bench", "real", *arguments])
        return main()


def test_folders_without_a_configuration_are_named_and_left_out(
    stills: Path, replayed, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    from benchmarks import real

    monkeypatch.setattr(real, "runs_of", lambda name, folder, limit: replayed if folder == stills else [])
    (stills.parent / "video").mkdir(exist_ok=True)
    monkeypatch.setattr(real, "FOLDER", stills.parent)
    monkeypatch.setattr(real, "LIMITS", {"simulated": WIDE})
    code = bench()
    printed = capsys.readouterr()
    assert "video: skipped, it has no config.yaml" in printed.err
    rows = [[cell.strip() for cell in line.split("|")] for line in printed.out.splitlines()]
    assert [row[1] for row in rows if "absolute" in row] == ["simulated, untaught", "simulated, taught"]
    assert code == ("MISSED" in printed.out)


def test_another_commit_is_replayed_with_its_own_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from benchmarks import machine as revision

    if subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, check=False).returncode != 0:
        pytest.skip("this is no git checkout")
    monkeypatch.setattr(revision, "_KEPT", tmp_path)
    with pytest.raises(ValueError, match="nonsense: git knows no such commit here; a hash, a branch or a tag"):
        revision.checkout_of("nonsense")
    checkout = revision.checkout_of("HEAD")
    assert checkout == revision.checkout_of("HEAD") == tmp_path / revision.commit_of("HEAD")
    where = "import benchmarks, gripmon; print(gripmon.__file__, benchmarks.__file__)"
    asked = [sys.executable, "-P", "-c", where]
    env = revision.environment(checkout)
    used = subprocess.run(asked, env=env, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    assert used == [str(checkout / "gripmon" / "__init__.py"), str(ROOT / "tools" / "benchmarks" / "__init__.py")]


@pytest.mark.skipif(not (REAL / "piper").is_dir(), reason="../shared/data/real is not there")
def test_a_real_gripper_is_measured_and_scatters_by_less_than_its_play():
    from benchmarks.real import LIMITS, PLAY_M
    from benchmarks.real_figures import figures_of
    from benchmarks.real_runs import Limit, runs_of

    for run in runs_of("piper", REAL / "piper", Limit(*LIMITS["piper"])):
        found = figures_of(run)
        assert found.stills == 13
        if run.bound == "absolute":
            assert found.measured == 13
        assert (found.scatter[:3] < PLAY_M).all() or not found.measured
        assert not found.alerts
        assert not [m for m, _ in found.beyond if m > PLAY_M]
