"""Printed targets: rendered by another program, they are found, and as large as they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from gripmon.calibrate.detection import detect
from gripmon.calibrate.sighting import Sighting
from gripmon.calibrate.target_print import print_target, size_mm
from gripmon.cli import main
from gripmon.model.errors import InputError
from gripmon.model.records import Array, Image
from gripmon.model.targets import parse_target

DPI = 200.0
PX_PER_MM = DPI / 25.4


def rendered(pdf: bytes) -> tuple[Image, Array]:
    """Grey image, and how many px a mm is across and down: PDFium rounds the page to whole pixels."""
    page = pypdfium2.PdfDocument(pdf)[0]
    image = np.asarray(page.render(scale=DPI / 72.0, grayscale=True).to_numpy())
    image = image if image.ndim == 2 else image[..., 0]
    paper_mm = np.array(page.get_size()) * 25.4 / 72.0
    return image, np.array(image.shape[::-1]) / paper_mm


@pytest.mark.parametrize(
    ("text", "paper"),
    [
        ("circles:12x10:0.008:0.004", "a4"),
        ("circles:8x8:0.008:0.004", "a5"),
        ("acircles:4x11:0.03:0.012", "a4"),
        ("chequerboard:9x6:0.02", "letter"),
        ("charuco:8x6:0.03:0.022:DICT_4X4_250", "a4"),
        ("charuco:7x9:0.02:0.014:DICT_5X5_100", "a3"),
        ("chequerboard:11x8:0.01", "140x160"),
    ],
)
def test_every_point_is_where_the_ruler_has_it(text: str, paper: str):
    target = parse_target(text)
    made = print_target(target, paper)
    image, px_per_mm = rendered(made.pdf)
    found = detect(image, target)
    assert isinstance(found, Sighting), found
    fewer = 1 if text.startswith("charuco") else 0
    assert len(found) == (target.columns - fewer) * (target.rows - fewer)
    # One turn fits all points to a hundredth of a mm; PDFium draws borders of boxes at whole pixels.
    exact_mm = 0.01 if "circles" in text else 0.6 / PX_PER_MM
    seen_mm, plate_mm = found.uv_px / px_per_mm, 1e3 * found.plate_m[:, :2]
    seen_mm, plate_mm = seen_mm - seen_mm.mean(axis=0), plate_mm - plate_mm.mean(axis=0)
    u, scale, vt = np.linalg.svd(seen_mm.T @ plate_mm)
    size = scale.sum() / np.square(plate_mm).sum()
    assert size == pytest.approx(1.0, abs=2e-4 if "circles" in text else 6e-4)
    assert np.abs(seen_mm - plate_mm @ (u @ vt).T).max() < exact_mm


def test_the_bar_is_as_long_as_it_says():
    made = print_target(parse_target("circles:12x10:0.008:0.004"), "a4")
    image, px_per_mm = rendered(made.pdf)
    # The lowest long dark line.
    rows = [row for row in range(image.shape[0]) if (image[row] < 128).sum() > 0.9 * made.bar_mm * px_per_mm[0]]
    dark = np.flatnonzero(image[rows[-1]] < 128)
    length_mm = (dark[-1] - dark[0] + 1) / px_per_mm[0]
    assert length_mm == pytest.approx(made.bar_mm, abs=2.0 / PX_PER_MM)


def test_it_lies_on_the_paper_with_a_margin():
    made = print_target(parse_target("chequerboard:9x6:0.02"), "a4")
    image, px_per_mm = rendered(made.pdf)
    rows, columns = np.nonzero(image < 128)
    assert made.paper_mm == (297.0, 210.0)  # turned: upright it doesn't fit
    for low, high, size, scale in (
        (columns.min(), columns.max(), image.shape[1], px_per_mm[0]),
        (rows.min(), rows.max(), image.shape[0], px_per_mm[1]),
    ):
        assert low / scale >= 6.4 and (size - 1 - high) / scale >= 6.4


@pytest.mark.parametrize(
    ("text", "paper", "words"),
    [
        ("circles:12x10:0.008:0.004", "a9", "'a9' isn't a paper size; a5, a4"),
        ("circles:12x10:0.008:0.004", "20x20", "which has 50 to 5000 mm a side"),
        ("chequerboard:20x14:0.02", "a4", "a4: 210 x 297 mm is too small for chequerboard:20x14:0.02"),
        ("charuco:8x6:0.03:0.022:DICT_NO", "a4", "there is no dictionary DICT_NO"),
        ("charuco:20x20:0.009:0.006:DICT_4X4_50", "a4", "needs more marks than the dictionary's 50"),
    ],
)
def test_what_cant_be_printed_is_one_line(text: str, paper: str, words: str):
    with pytest.raises(InputError) as error:
        print_target(parse_target(text), paper)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_size_is_that_of_the_print():
    assert size_mm(parse_target("circles:12x10:0.008:0.004")) == pytest.approx((92.0, 76.0))
    assert size_mm(parse_target("chequerboard:9x6:0.02")) == pytest.approx((200.0, 140.0))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pdf = tmp_path / "plate.pdf"
    assert main(["target", "--pdf", str(pdf)]) == 0
    assert "the bar has to measure 150 mm" in capsys.readouterr().out
    assert isinstance(detect(rendered(pdf.read_bytes())[0], parse_target("circles:12x10:0.008:0.004")), Sighting)
    assert main(["target", "--pdf", str(pdf)]) == 2
    assert "is there already" in capsys.readouterr().err
    assert main(["target", "checkerboard:9x6:0.02", "--pdf", str(pdf), "--force", "--paper", "letter"]) == 0
    assert main(["target", "--pdf", str(tmp_path / "plate.png")]) == 2
    assert "isn't the name of a PDF" in capsys.readouterr().err
    assert main(["target", "--pdf", str(tmp_path / "x.pdf"), "--paper", "a9"]) == 2
    assert capsys.readouterr().err.startswith("--paper")
