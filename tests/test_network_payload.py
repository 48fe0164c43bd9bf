"""What a driver may send, as an image; and in which words all else is refused."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from support.sent_frames import HEIGHT, WIDTH, colour, grey, note, raw_note

from gripmon.io.sources.network import PayloadDecoder
from gripmon.io.sources.payload import PayloadError
from gripmon.model.pixels import ENCODINGS, without_mosaic


def decoded(
    payload: bytes, attachment: bytes | None = None, encoding: str = "", frame_format: str = "auto"
) -> np.ndarray:
    return PayloadDecoder(frame_format, (WIDTH, HEIGHT)).decode(payload, encoding, attachment).image


def test_raw_pixels_of_every_encoding_are_what_they_were():
    bgr, mono = colour(), grey()
    bgr16, mono16 = colour(1, np.uint16), grey().astype(np.uint16) * 257
    alpha = grey(7)[:, :, None]
    # White of video, 235, is the end of the range.
    luma = np.where(mono < 20, 235, mono).astype(np.uint8)
    of_luma = np.rint(np.minimum(luma * (255.0 / 235.0), 255.0)).astype(np.uint8)
    expected: dict[str, tuple[np.ndarray, np.ndarray]] = {
        "mono8": (mono, mono),
        "8UC1": (mono, mono),
        "mono16": (mono16.astype("<u2"), mono16),
        "16UC1": (mono16.astype("<u2"), mono16),
        "32FC1": ((mono / 255.0).astype("<f4"), (mono / 255.0).astype(np.float32)),
        "bgr8": (bgr, bgr),
        "bgr16": (bgr16.astype("<u2"), bgr16),
        "rgb8": (bgr[:, :, ::-1], bgr),
        "rgb16": (bgr16[:, :, ::-1].astype("<u2"), bgr16),
        "bgra8": (np.concatenate([bgr, alpha], axis=2), bgr),
        "8UC3": (bgr, bgr),
        "16UC3": (bgr16.astype("<u2"), bgr16),
        "8UC4": (np.concatenate([bgr, alpha], axis=2), bgr),
        "bgra16": (np.concatenate([bgr16, mono16[:, :, None]], axis=2).astype("<u2"), bgr16),
        "16UC4": (np.concatenate([bgr16, mono16[:, :, None]], axis=2).astype("<u2"), bgr16),
        "rgba16": (np.concatenate([bgr16[:, :, ::-1], mono16[:, :, None]], axis=2).astype("<u2"), bgr16),
        "rgba8": (np.concatenate([bgr[:, :, ::-1], alpha], axis=2), bgr),
        "yuv422_yuy2": (np.stack([luma, grey(3)], axis=2), of_luma),
        "yuyv": (np.stack([luma, grey(3)], axis=2), of_luma),
        "yuv422": (np.stack([grey(3), luma], axis=2), of_luma),
        "uyvy": (np.stack([grey(3), luma], axis=2), of_luma),
        "nv12": (np.concatenate([luma, grey(3)[::2]]), of_luma),
        "nv21": (np.concatenate([luma, grey(3)[::2]]), of_luma),
        "nv24": (np.concatenate([luma, grey(3), grey(4)]), of_luma),
    }
    for encoding, (pixels, image) in expected.items():
        out = decoded(pixels.tobytes(), raw_note(encoding))
        np.testing.assert_array_equal(out, image, encoding)
        assert out.dtype == image.dtype and out.flags.c_contiguous
    assert set(ENCODINGS) - set(expected) == {name for name in ENCODINGS if name.startswith("bayer_")}


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_gives_its_colours(pattern: str, bits: int):
    """An even colour, sampled by hand: the first two pixels of the first two rows are as the name says."""
    value = {"b": 200, "g": 120, "r": 40}
    mosaic = np.empty((HEIGHT, WIDTH), np.uint8 if bits == 8 else "<u2")
    for i, name in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = value[name] * (1 if bits == 8 else 256)
    out = decoded(mosaic.tobytes(), raw_note(f"bayer_{pattern}{bits}"))
    scale = 1 if bits == 8 else 256
    expected = np.full((HEIGHT - 8, WIDTH - 8, 3), [200, 120, 40]) * scale
    np.testing.assert_array_equal(out[4:-4, 4:-4], expected)


@pytest.mark.parametrize("bits", [8, 16])
def test_a_compressed_mosaic_gives_its_colours_unless_it_was_converted_before(bits: int):
    """As ``compressed_image_transport`` says what it has compressed; the depth is the file's."""
    mosaic = grey() if bits == 8 else grey().astype(np.uint16) * 257
    shown = decoded(mosaic.tobytes(), raw_note(f"bayer_gbrg{bits}"))
    data = cv2.imencode(".png", mosaic)[1].tobytes()
    for said in ("bayer_gbrg8; png compressed ", "bayer_gbrg16; jpeg compressed"):
        np.testing.assert_array_equal(without_mosaic(mosaic, data, said), shown)
    for said in ("bayer_gbrg8; jpeg compressed bgr8", "mono8; png compressed ", "png", "", "bayer_8; png compressed "):
        assert without_mosaic(mosaic, data, said) is mosaic
    for ending in (".png", ".jpg")[: 2 if bits == 8 else 1]:  # a file in colour that kept the name, read as grey
        colours = cv2.imencode(ending, shown)[1].tobytes()
        assert without_mosaic(mosaic, colours, "bayer_gbrg8; png compressed ") is mosaic


def test_gaps_between_rows_are_left_out():
    image = colour()
    rows = np.hstack([image.reshape(HEIGHT, -1), grey(2)[:, :7]])
    np.testing.assert_array_equal(decoded(rows.tobytes(), raw_note("bgr8", step=3 * WIDTH + 7)), image)


@pytest.mark.parametrize("said", ["", "image/jpeg", "image/png;q=1"])
@pytest.mark.parametrize("image", [grey(), colour(), grey().astype(np.uint16) * 257], ids=["grey", "colour", "16 bits"])
def test_files_are_what_another_decoder_makes_of_them(image: np.ndarray, said: str):
    suffix = ".jpg" if said == "image/jpeg" else ".png"
    if suffix == ".jpg" and image.dtype != np.uint8:
        pytest.skip("JPEG has 8 bits")
    data = cv2.imencode(suffix, image)[1].tobytes()
    out = decoded(data, None, said)
    flag = cv2.IMREAD_GRAYSCALE if suffix == ".jpg" else cv2.IMREAD_UNCHANGED
    np.testing.assert_array_equal(out, cv2.imdecode(np.frombuffer(data, np.uint8), flag))
    assert out.dtype == image.dtype


def test_transparency_is_left_out():
    image = colour()
    data = cv2.imencode(".png", np.concatenate([image, grey(7)[:, :, None]], axis=2))[1].tobytes()
    np.testing.assert_array_equal(decoded(data), image)


def png_of(width: int, height: int, *, bits: int = 8, colour_type: int = 0) -> bytes:
    """An all black PNG file, written by hand."""
    packer = zlib.compressobj()
    row = bytes(1 + width * bits // 8 * {0: 1, 2: 3}[colour_type])
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour_type, 0, 0, 0)),
        (b"IDAT", data),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )


def test_a_decompression_bomb_is_not_decoded():
    bomb = png_of(8000, 8000)
    assert len(bomb) < 100_000, "it fits into the bounds of a payload"
    decoder = PayloadDecoder("auto", (WIDTH, HEIGHT))
    with pytest.raises(PayloadError, match="8000x8000 pixels; 40x30 as the camera"):
        decoder.decode(bomb, "", None)
    tracemalloc.start()
    try:
        with pytest.raises(PayloadError, match="8000x8000"):
            decoder.decode(bomb, "", None)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def progressive_bomb() -> bytes:
    """The last scan of a progressive JPEG a thousand times: each repeats the work on the whole image."""
    data = cv2.imencode(".jpg", grey(), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = data.rindex(b"\xff\xda")
    return data[:last] + data[last:-2] * 1000 + data[-2:]


@pytest.mark.parametrize("opening_m", [-0.0005, 0.0, 1.0])
def test_closed_jaws_that_are_said_to_be_open_by_less_than_nothing_spoil_no_image(opening_m: float):
    content = PayloadDecoder("auto", (WIDTH, HEIGHT)).decode(grey().tobytes(), "", raw_note(jaw_opening_m=opening_m))
    assert content.jaw_opening_m == opening_m


MALFORMED: list[tuple[bytes, bytes | None, str, str, str]] = [
    # payload, attachment, Zenoh's encoding, format, what is said
    (b"", None, "", "auto", "raw pixels without width, height, encoding; all three in the attachment"),
    (grey().tobytes(), note(width=WIDTH), "", "auto", "raw pixels without height, encoding"),
    (grey().tobytes(), raw_note("mono9"), "", "auto", "encoding 'mono9'; one of mono8"),
    (grey().tobytes(), note(width=HEIGHT, height=WIDTH, encoding="mono8"), "", "auto", "30x40 pixels; 40x30 as"),
    (grey().tobytes()[:-1], raw_note(), "", "auto", "1199 bytes; 1200 (30 rows of 40)"),
    (grey().tobytes(), raw_note("bgr8"), "", "auto", "1200 bytes; 3600"),
    (grey().tobytes(), raw_note(step=39), "", "auto", "step 39; at least 40 bytes"),
    (bytes(81 * HEIGHT), raw_note("mono16", step=81), "", "auto", "step 81; at least 80 bytes, a multiple of 2"),
    (grey().tobytes(), b"[1]", "", "auto", "attachment: no message gripmon.frame/1: Expected `object`"),
    (grey().tobytes(), raw_note(schema="gripmon.frame/2"), "", "auto", "its schema is 'gripmon.frame/2'"),
    (grey().tobytes(), raw_note(jaw_opening_m=1.5), "", "auto", "<= 1.0 - at `$.jaw_opening_m`"),
    (grey().tobytes(), raw_note(jaw_opening_m=-0.002), "", "auto", ">= -0.001 - at `$.jaw_opening_m`"),
    (grey().tobytes(), raw_note(stamp_ns=-1), "", "auto", ">= 0 - at `$.stamp_ns`"),
    (grey().tobytes(), raw_note(stamp_ns=1.5), "", "auto", "at `$.stamp_ns`"),
    (grey().tobytes(), raw_note(more="x" * 5000), "", "auto", "at most 4096"),
    (grey().tobytes(), None, "image/jpeg", "auto", "no JPEG file: it begins with"),
    (png_of(WIDTH, HEIGHT), None, "", "jpeg", "no JPEG file: it begins with 89504e47"),
    (png_of(WIDTH, HEIGHT), None, "", "raw", "raw pixels without"),
    (png_of(WIDTH, HEIGHT)[:-20], None, "", "auto", "damaged PNG file"),
    (png_of(WIDTH, HEIGHT).replace(b"IEND", b"IENE"), None, "", "auto", "damaged PNG file"),
    (png_of(WIDTH, HEIGHT, bits=16, colour_type=2), None, "", "auto", "colours of 16 bits; 8 bits, or grey"),
    (cv2.imencode(".jpg", grey())[1].tobytes()[:-40], None, "", "auto", "damaged JPEG file"),
    (cv2.imencode(".jpg", colour()[:, 1:])[1].tobytes(), None, "", "auto", "39x30 pixels; 40x30 as the camera"),
    (progressive_bomb(), None, "", "auto", "more than 100 scans"),
    (bytes(2 << 20), None, "", "auto", "2097152 bytes; at most 1058176"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("payload", "attachment", "encoding", "frame_format", "said"), MALFORMED, ids=[m[4][:30] for m in MALFORMED]
)
def test_what_is_malformed_is_said_in_one_line(
    payload: bytes, attachment: bytes | None, encoding: str, frame_format: str, said: str
):
    with pytest.raises(PayloadError) as caught:
        decoded(payload, attachment, encoding, frame_format)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_jpegs_brightness_is_that_of_its_colours():
    """What is measured of an image in BGR: 0.299 R + 0.587 G + 0.114 B."""
    smooth = cv2.GaussianBlur(colour(), (0, 0), 3.0)
    out = decoded(cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes())
    np.testing.assert_allclose(out, smooth @ [0.114, 0.587, 0.299], atol=3.0)
