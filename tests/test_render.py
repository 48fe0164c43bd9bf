"""Results as text: units by the keys, aligned tables, long values in lines of their own."""

from __future__ import annotations

import pytest

from gripmon.cli.render import columns, lines, table


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ({"shift_m": 0.00123456}, ["shift  1.235 mm"]),
        ({"turn_rad": [0.0174532925, None]}, ["turn  1 -°"]),
        ({"rms_px": 0.5, "wait_s": 3}, ["RMS   0.5 px", "wait  3 s"]),
        ({"frames_per_s": 60.0, "metres_per_px": 1e-4}, ["frames per s   60", "metres per px  0.0001"]),
        ({"same": True, "why": None, "names": []}, ["same   yes", "why    -", "names  -"]),
        ({"limit_m": None}, ["limit  -"]),
        ({"drift_m": -0.0}, ["drift  0 mm"]),
        ({"covariance": [0.5] * 36}, ["covariance  36 numbers, in --json"]),
        ({"shift_m": {"x": [0.001, 0.002], "y": 0.003}}, ["shift  x 1 2 mm, y 3 mm"]),
        ({"pose": {"tcp_m": [0.001], "rotation_rad": [0.0]}}, ["pose  TCP 1 mm, rotation 0°"]),
        ({"notes": ["two words", None]}, ["notes", "  two words", "  -"]),
        ({"a": {"b": {"c_m": 1.0}}}, ["a", "  b  c 1000 mm"]),
        ({"limit_m": 0.001, "limit_rad": None}, ["limit of position  1 mm", "limit of rotation  -"]),
        ({"spot": {"px": 0.5, "m": 0.0002}}, ["spot  0.5 px, 0.2 mm"]),
        ({"far_m": -20.951, "wide": 0.3e8}, ["far   -20951 mm", "wide  3e+07"]),
    ],
)  # fmt: skip
def test_a_value_has_its_unit(values: dict[str, object], shown: list[str]):
    assert lines(values) == shown


def test_a_mapping_that_is_too_long_for_a_line_has_one_for_each_value():
    said = lines({"found": {"first": "x" * 60, "other": "y" * 60}, "after": 1})
    assert said == ["found", f"  first  {'x' * 60}", f"  other  {'y' * 60}", "after  1"]


def test_a_table_has_the_units_in_its_head_and_numbers_to_the_right():
    rows = [{"id": "L", "off_m": 0.001, "why": None}, {"id": "R_long", "off_m": 0.0123, "why": "hidden"}]
    assert table(rows) == ["id      off mm  why", "L            1  -", "R_long    12.3  hidden"]
    assert lines({"corners": rows})[1] == "  id      off mm  why"
    assert table([]) == []


def test_a_row_that_lacks_a_column_is_refused():
    with pytest.raises(ValueError, match="zip"):
        columns([["a", "b"], ["c"]])
