"""A JPEG's end, found by its markers."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from gripmon.io.sources.payload import PayloadError, file_image
from gripmon.model.images import grey_image, read_image
from gripmon.model.jpeg import jpeg_end, jpeg_fault
from gripmon.record.recordings import decode_image

PICTURE = np.random.default_rng(0).integers(0, 256, (96, 128), dtype=np.uint8)


def jpeg(*flags: int, image: np.ndarray = PICTURE) -> bytes:
    return cv2.imencode(".jpg", image, list(flags))[1].tobytes()


def with_thumbnail() -> bytes:
    """A whole JPEG inside the file's own header."""
    exif = Image.Exif()
    exif[0x010E] = jpeg(image=PICTURE[:16, :16]).decode("latin-1")
    out = io.BytesIO()
    Image.fromarray(PICTURE).save(out, "JPEG", exif=exif, quality=80)
    return out.getvalue()


FILES = {
    "grey": jpeg(),
    "colour": jpeg(image=np.dstack([PICTURE] * 3)),
    "progressive": jpeg(cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": jpeg(cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "thumbnail": with_thumbnail(),
}


@pytest.mark.parametrize("kind", FILES)
def test_only_all_of_it_is_whole(kind: str):
    data = FILES[kind]
    assert jpeg_end(data) == (len(data), True)
    assert jpeg_end(b"--" + data + b"more", 2) == (2 + len(data), True)
    for length in range(0, len(data), 7):
        assert not jpeg_end(data[:length])[1], length
    assert jpeg_fault(data[: len(data) // 3] + data) is not None  # the next one began


def test_damage_raises_nothing():
    rng = np.random.default_rng(1)
    for data in FILES.values():
        for _ in range(200):
            damaged = bytearray(data)
            for at in rng.integers(0, len(data), 3):
                damaged[at] = rng.integers(0, 256)
            end, whole = jpeg_end(damaged)
            assert not whole or bytes(damaged[end - 2 : end]) == b"\xff\xd9"


@pytest.mark.parametrize("share", [0.35, 0.9])
@pytest.mark.parametrize("padding", [b"", bytes(64)])
def test_no_way_into_the_product_takes_a_truncated_one(tmp_path: Path, share: float, padding: bytes):
    data = FILES["grey"]
    truncated = data[: int(share * len(data))] + padding
    (tmp_path / "a.jpg").write_bytes(truncated)
    for image, fault in (read_image(tmp_path / "a.jpg"), grey_image(truncated)):
        assert image is None and fault == "truncated or damaged: a JPEG without its end"
    assert decode_image(truncated) is None
    with pytest.raises(PayloadError, match=r"damaged JPEG file .*without its end"):
        file_image(truncated, (128, 96))
    whole = data + padding
    (tmp_path / "a.jpg").write_bytes(whole)
    assert read_image(tmp_path / "a.jpg")[0] is not None and grey_image(whole)[0] is not None
    assert decode_image(whole) is not None and file_image(whole, (128, 96)).shape == (96, 128)
