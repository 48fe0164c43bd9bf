"""``tools/bench look`` in small."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.usefixtures("tools_importable")


def lines(capsys: pytest.CaptureFixture[str], name: str, frames: int) -> list[str]:
    from benchmarks.__main__ import main

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["bench", "look", "--only", name, "--scenes", "1", "--frames", str(frames)])
        assert main() == 0
    return capsys.readouterr().out.splitlines()


def test_a_row_says_what_changed(capsys: pytest.CaptureFixture[str]):
    head, _, row = lines(capsys, "ordinary", 40)
    cells = row.strip("| ").split(" | ")
    assert len(cells) == len(head.strip("| ").split(" | "))
    assert cells[0] == "ordinary, 0" and 0 < int(cells[1]) < 40
    assert cells[-2] == "0 → 0"


def test_a_scene_in_which_nothing_is_learnt_says_so(capsys: pytest.CaptureFixture[str]):
    assert lines(capsys, "ordinary", 5)[-1] == "| ordinary, 0 | 0 | the look was never used |"


def test_a_row_of_motions_counts_frames_from_the_motion_on_and_alerts_before_it(capsys: pytest.CaptureFixture[str]):
    """A drift of which nothing can be noticed before it begins, and whose end nobody can miss."""
    from benchmarks.look import _monitors
    from benchmarks.look_motions import Motion, motion_row

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.look_motions.BEGINS_S", 1.0)
        line = motion_row(Motion("far", 20.0, 15, (3e-3, 0.0, 0.0), time_s=0.2), 5, 1, _monitors)
    name, without, with_look, *early = line.strip("| ").split(" | ")
    assert name == "far" and 1 <= int(without) <= 10 and 1 <= int(with_look) <= 10 and early == ["0 of 1"] * 2
