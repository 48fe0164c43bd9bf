"""The state file: whole or set aside, whoever damages it; and no one else's."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
import yaml
from support.simulated import BOX_FINGERS
from support.state_files import DATA, OWNER, STATE, beside, opened, read_once, write
from test_references import adopt, configured

from gripmon.judge.references import KEPT_REFERENCES, ReferenceBook
from gripmon.judge.statefile import (
    Owner,
    StateFileError,
    calibration_of,
    default_path,
    unpack,
)
from gripmon.model.camera import PaperLens
from gripmon.model.gripper import GripperModel
from gripmon.model.records import (
    MonitorState,
    Transform,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "arm.json"


def test_what_was_written_is_read(path: Path):
    file = opened(path)
    assert (file.state, file.notices, file.failure, file.configured) == (None, (), "", configured())
    for state in (MonitorState((configured(),)), STATE):
        assert file.write(state)
        assert file.failure == ""
    file.close()
    again = read_once(path)
    assert (again.state, again.notices, again.failure) == (STATE, (), "")
    assert beside(path) == ["arm.json"]
    assert oct(path.stat().st_mode & 0o777 & ~_umask()) == oct(0o666 & ~_umask())


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


# --- damage ---


def test_every_cut_and_every_flipped_bit_is_found():
    """What still counts as sound is the whole state: a line feed that became another blank."""
    assert unpack(DATA).state == STATE
    survivors = 0
    for i in range(len(DATA) - 1):
        with pytest.raises(ValueError):
            unpack(DATA[:i])
        for bit in range(8):
            flipped = bytearray(DATA)
            flipped[i] ^= 1 << bit
            try:
                assert unpack(bytes(flipped)) == unpack(DATA)
            except ValueError:
                continue
            survivors += 1
    assert survivors < 5


DAMAGED = {
    "empty": b"",
    "cut off": DATA[:-40],
    "nothing but zeros": bytes(len(DATA)),
    "no text": b"\xff\xfe" + DATA,
    "two of them": DATA + DATA,
    "another JSON file": b'{"robot": "arm"}\n',
    "a list": b"[]",
    "a wrong checksum": DATA.replace(b'"revision":2', b'"revision":7'),
    "more than is known": DATA.replace(b'{"sha256"', b'{"more":1,"sha256"'),
}


@pytest.mark.parametrize("what", DAMAGED)
def test_a_damaged_file_is_set_aside_and_told(path: Path, what: str):
    write(path, DAMAGED[what])
    file = opened(path)
    assert (file.state, file.configured, file.failure) == (None, configured(), "")
    (notice,) = file.notices
    assert f"{path} is damaged" in notice and "set aside as arm.json.damaged-1" in notice
    assert beside(path) == ["arm.json.damaged-1"]
    assert (path.parent / "arm.json.damaged-1").read_bytes() == DAMAGED[what]
    assert file.write(STATE)
    file.close()
    assert read_once(path).state == STATE


@pytest.mark.parametrize("kept", [0, 1, len(DATA) // 3, len(DATA) - 2])
def test_after_a_state_that_was_cut_off_no_revision_is_used_again(path: Path, kept: int):
    """The newest references stand at the file's end: what is left of it doesn't tell how many there were."""
    file = opened(path)
    assert file.write(STATE)
    file.close()
    os.truncate(path, kept)
    file = opened(path)
    assert file.state is None and file.configured == configured(4)
    assert file.notices[0].endswith("started from the configured reference, as revision 4")
    assert file.write(MonitorState((file.configured,)))
    file.close()
    again = read_once(path)
    assert again.state == MonitorState((configured(4),)) and not again.notices


@pytest.mark.parametrize("note", [b"", b"17\n", b"17 x\n", b"17 " + b"9" * 80, b"\0" * 20, b"\xff 3 \xb2\n"])
def test_a_lock_that_tells_no_revision_is_no_fault(path: Path, note: bytes):
    write(path, DATA[:-40])
    path.with_name("arm.json.lock").write_bytes(note)
    file = read_once(path)
    assert file.state is None and not file.failure
    assert file.configured.revision in (0, 4)


def sealed(content: bytes) -> bytes:
    """A file whose checksum is right, reckoned as others can."""
    return b'{"sha256":"%s","content":%s}\n' % (hashlib.sha256(content).hexdigest().encode(), content)


def packed(**changes: object) -> bytes:
    """A file whose checksum is right, whatever it holds."""
    content = json.loads(DATA)["content"]
    for where, value in changes.items():
        *steps, last = [int(step) if step.isdigit() else step for step in where.split("__")]
        place = content
        for step in steps:
            place = place[step]
        place[last] = value
    return sealed(json.dumps(content).encode())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"state__references__2__covariance__0": None}, "Expected `float`, got `null`"),  # NaN, as others write it
        ({"state__references__2__covariance__0": float("nan")}, "damaged"),
        ({"state__references__1__cam_T_grip__rotation_xyzw": [0.5, 0.5, 0.5, 0.6]}, "no pose"),
        ({"state__references__1__cam_T_grip__translation_m": [0.1, 0.2]}, "Expected `array` of length 3"),
        ({"state__references__1__revision": 7}, "revision 2 follows revision 7"),
        ({"state__alerts__0__alert__severity": "magic"}, "Invalid enum value 'magic'"),
        ({"state__references": []}, "no reference at all"),
        ({"state__proposal__revision": 3}, "revision 3 follows revision 3"),
        ({"state__alerts_raised": 0}, "1 open alerts of 0 that were raised"),
        ({"state__hidden": 1}, "unknown field `hidden`"),
        ({"format": 2}, "it has format 2, and this version of gripmon reads format 1"),
        ({"owner": {"robot": "arm"}}, "missing required field"),
    ],
)
def test_a_right_checksum_over_what_can_not_be_is_damage_too(path: Path, changes: dict[str, object], reason: str):
    write(path, packed(**changes))
    file = read_once(path)
    assert file.state is None and reason in file.notices[0]
    assert beside(path) == ["arm.json.damaged-1"]


def test_a_state_of_before_messages_said_their_schema_still_counts(path: Path):
    old = packed().replace(b'"schema": "gripmon.reference/1", ', b"")
    assert b"schema" not in old
    content = old[old.index(b'"content":') + len(b'"content":') : -2]
    assert unpack(sealed(content)).state == STATE


def test_what_is_packed_here_is_sound_unless_changed():
    assert unpack(packed()).state == STATE


def test_what_was_set_aside_is_never_overwritten(path: Path):
    for i in range(1, 4):
        write(path, b"damage %d" % i)
        read_once(path)
    assert beside(path) == [f"arm.json.damaged-{i}" for i in (1, 2, 3)]
    (path.parent / "arm.json.damaged-4").symlink_to("nowhere")
    write(path, b"damage 5")
    read_once(path)
    contents = [(path.parent / f"arm.json.damaged-{i}").read_bytes() for i in (1, 2, 3, 5)]
    assert contents == [b"damage 1", b"damage 2", b"damage 3", b"damage 5"]


# --- whose it is ---


@pytest.mark.parametrize("field", ["robot", "camera"])
def test_the_state_of_another_robot_is_refused_and_left_alone(path: Path, field: str):
    write(path, DATA)
    other = msgspec.structs.replace(OWNER, **{field: "other"})
    with pytest.raises(StateFileError) as caught:
        opened(path, other)
    assert str(caught.value) == (
        f"{path} is the state of arm/wrist, not of {other.robot}/{other.camera}; a file of its own for each monitor"
    )
    assert path.read_bytes() == DATA and beside(path) == ["arm.json"]
    assert read_once(path).state == STATE, "and the lock is free again"


@pytest.mark.parametrize(
    ("part", "said"),
    [("camera", "the camera model"), ("gripper", "the gripper file"), ("reference", "the configured reference")],
)
def test_the_state_of_another_calibration_is_set_aside_and_revisions_go_on(path: Path, part: str, said: str):
    write(path, DATA)
    calibration = msgspec.structs.replace(OWNER.calibration, **{part: "new"})
    file = read_once(path, Owner("arm", "wrist", calibration))
    assert file.state is None and beside(path) == ["arm.json", "arm.json.replaced-1"]
    assert f"of another calibration ({said} changed since); set aside as arm.json.replaced-1" in file.notices[0]
    assert file.configured == configured(4), "no revision names two references"


def test_a_fresh_start_sets_aside_what_could_be_used(path: Path):
    write(path, DATA)
    file = opened(path, fresh=True)
    file.close()
    assert file.state is None and file.configured == configured(4)
    assert (
        "not wanted; set aside as arm.json.replaced-1; started from the configured reference as revision 4"
        in (file.notices[0])
    )
    assert (path.parent / "arm.json.replaced-1").read_bytes() == DATA
    again = opened(path, fresh=True)
    assert again.configured == configured(4), "nothing was written since: what knows the revisions is still there"
    assert again.write(MonitorState((again.configured,)))
    again.close()
    assert opened(path, fresh=True).configured == configured(5)
    assert [(path.parent / f"arm.json.replaced-{i}").read_bytes() for i in (1, 2)] == [DATA] * 2


@pytest.mark.parametrize("nested", [b"[" * 100_000, b'{"format":' * 100_000])
def test_a_file_nested_by_the_thousand_is_set_aside(path: Path, nested: bytes):
    for data in (b'{"sha256":"x","content":' + nested, sealed(b'{"format":1,"owner":' + nested)):
        write(path, data)
        file = read_once(path)
        assert file.state is None and file.configured == configured()
        assert "is damaged: it is cut off, or no state file at all; set aside" in file.notices[0]


def test_the_calibration_is_that_of_the_values():
    lens = PaperLens(width_px=8, height_px=6, fx_px=9.0, fy_px=9.0, cx_px=3.5, cy_px=2.5, kappa_per_px2=0.0)
    model = msgspec.convert(yaml.safe_load(BOX_FINGERS.read_text()), GripperModel)
    first = calibration_of(lens, model, configured())
    assert calibration_of(lens, model, configured(7)) == first, "whatever its revision"
    focus = calibration_of(msgspec.structs.replace(lens, fx_px=9.1), model, configured())
    assert focus.camera != first.camera and (focus.gripper, focus.reference) == (first.gripper, first.reference)
    moved = msgspec.structs.replace(configured(), cam_T_grip=Transform((0.0, 0.002, 0.121), (0.0, 0.0, 0.0, 1.0)))
    assert calibration_of(lens, model, moved).reference != first.reference
    renamed = msgspec.structs.replace(model, faces=())
    assert calibration_of(lens, renamed, configured()).gripper != first.gripper
    plain = msgspec.json.encode(msgspec.structs.asdict(configured()) | {"revision": 0, "stamp_ns": 0})
    assert b"schema" not in plain
    assert first.reference == hashlib.sha256(plain).hexdigest()[:16], "whatever the version of the message"


def test_a_lock_file_that_somebody_deletes_is_made_again(path: Path):
    file = opened(path)
    assert file.write(STATE)
    lock = path.with_name(path.name + ".lock")
    note = lock.read_bytes()
    path.unlink()
    lock.unlink()
    assert file.write(STATE) and lock.read_bytes() == note
    with pytest.raises(StateFileError, match="is in use by process"):
        opened(path)
    lock.unlink()
    other = opened(path)  # while there was none
    assert not file.write(STATE) and "is in use by process" in file.failure
    file.close()
    other.close()


def test_the_lock_goes_with_its_process(path: Path):
    code = (
        "import sys; from pathlib import Path; sys.path[:0] = sys.argv[2:]\n"
        "from support.state_files import opened\n"
        "file = opened(Path(sys.argv[1])); print('locked', flush=True); sys.stdin.read()"
    )
    tests = Path(__file__).resolve().parent
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(path), str(tests), str(tests.parent)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "locked\n"
        with pytest.raises(StateFileError, match=f"in use by process {holder.pid}"):
            opened(path)
    finally:
        holder.kill()
        holder.communicate()
    read_once(path)


def test_thousands_of_references_are_kept_whole(path: Path):
    book = ReferenceBook(configured())
    for i in range(KEPT_REFERENCES + 5):
        adopt(book, i % 7)
    file = opened(path)
    assert file.write(MonitorState(book.history))
    file.close()
    assert path.stat().st_size < 3_000_000
    again = read_once(path).state
    assert again is not None
    assert ReferenceBook.restored(again.references).current == book.current


def test_the_default_place_follows_the_standard(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_STATE_HOME", "/var/state")
    assert default_path("arm1", "wrist") == Path("/var/state/gripmon/arm1-wrist.json")
    monkeypatch.setenv("HOME", "/home/robot")
    for unusable in ("", "relative/path"):
        monkeypatch.setenv("XDG_STATE_HOME", unusable)
        assert default_path("arm1", "wrist") == Path("/home/robot/.local/state/gripmon/arm1-wrist.json")


def test_a_user_without_a_home_has_to_name_a_file(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_STATE_HOME", "")

    def homeless(self: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", homeless)
    with pytest.raises(StateFileError, match="auto, but this user has no home folder; the path of a file, or null"):
        default_path("arm1", "wrist")
