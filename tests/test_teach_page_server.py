"""The page's web server as those meet it who have no business there, and what it answers to nonsense."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
import time
import urllib.parse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from support.taught_by_hand import Rig, make_rig

from gripmon.daemon.calibrations import read_rough_corners
from gripmon.io.sources import Waiting
from gripmon.model.records import Frame
from gripmon.monitor import MonitorSettings
from gripmon.teach.api import Picture
from gripmon.teach.messages import BadRequest, EmptyRequest, Evaluation, Saved, SaveOrder, SavingRefused
from gripmon.teach.page_server import Action, PageServer, Sandboxed, Served
from gripmon.teach.session import Labels, Setup, TeachSession
from gripmon.teach.sites import OutlineSite, TeachSite

LABELS = Labels("arm", "wrist", False, "/there", {"config": "c", "taught": "t", "corners": "k"}, None, None)
DEADLINE_S = 30.0


class Told:
    """Saves nothing, and keeps what it was told to."""

    def __init__(self) -> None:
        self.orders: list[SaveOrder] = []
        self.refuse = ""

    def save(self, order: SaveOrder, found: Evaluation, number: int, pictures: Sequence[Picture]) -> Saved:
        if self.refuse:
            raise SavingRefused(self.refuse)
        self.orders.append(order)
        return Saved(written={"c": f"image {number} of {len(pictures)}"})


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return make_rig(tmp_path_factory.mktemp("served"))


@pytest.fixture(scope="module")
def saving() -> Told:
    return Told()


@pytest.fixture(scope="module")
def served(rig: Rig, saving: Told) -> Iterator[PageServer]:
    picture = Picture("000000.png", rig.image, 0.034, str(rig.image_path))
    setup = Setup(rig.camera, rig.gripper, MonitorSettings(), None)
    server = PageServer(TeachSite(TeachSession(setup, [picture], LABELS, saving)))
    yield server
    server.close()


def ask(
    server: PageServer,
    path: str | None = None,
    method: str = "GET",
    body: bytes | None = None,
    headers: dict[str, str] | None = None,
) -> tuple[int, dict[str, str], bytes]:
    """One request; ``path`` below the token, or from the root if it begins with a slash."""
    parts = urllib.parse.urlsplit(server.url)
    whole = parts.path + (path or "") if path is None or not path.startswith("/") else path
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=DEADLINE_S)
    try:
        connection.putrequest(method, whole, skip_host=True)
        given = {"Host": f"127.0.0.1:{server.port}"} | (headers or {})
        if body is not None:
            given = {"Content-Type": "application/json", "Content-Length": str(len(body))} | given
        for name, value in given.items():
            if value:
                connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, dict(answer.headers), answer.read()
    finally:
        connection.close()


def look(server: PageServer, value: object) -> tuple[int, dict[str, Any]]:
    status, _, data = ask(server, "look", "POST", json.dumps(value).encode())
    return status, json.loads(data)


def test_every_file_of_the_page_is_served_and_allows_nobody_else(served: PageServer):
    status, headers, page = ask(served)
    assert status == 200 and headers["Content-Type"].startswith("text/html")
    for name in ("style.css", "main.js", "stage.js", "panel.js", "history.js", "page.js", "icon.svg", "state"):
        status, headers, data = ask(served, name)
        assert status == 200 and data, name
        assert "script-src 'self'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff" and headers["Referrer-Policy"] == "no-referrer"
        assert not [header for header in headers if header.lower().startswith("access-control")]
        assert b"http://" not in data.replace(b"http://www.w3.org/", b"") and b"https://" not in data
    assert b"<script" in page and b"style=" not in page and b"onclick" not in page
    status, headers, data = ask(served, "image/0.png")
    assert status == 200 and data.startswith(b"\x89PNG")


def test_a_page_with_scripts_of_its_own_runs_them_without_the_sites_origin():
    """A file of a project may be anyone's: its scripts could carry out the steps of ``gripmon setup``, nor does the
    token in its address open any of them.
    """

    class Pages:
        def get(self, path: str) -> Served | None:
            return Sandboxed(b"<script>1</script>") if path == "own?3" else b"{}", "text/html"

        def post(self, path: str) -> Action | None:
            return EmptyRequest, lambda _: {}

    server = PageServer(Pages())
    try:
        plain = ask(server, "other")[1]
        status, moved, _ = ask(server, "own?3")
        assert status == 303 and moved["Location"].endswith("/own?3")
        token = urllib.parse.urlsplit(server.url).path
        theirs = moved["Location"].removesuffix("own?3")
        assert theirs != token
        status, own, data = ask(server, path=moved["Location"])
        assert status == 200 and data == b"<script>1</script>"
        for path, method in (("other", "GET"), ("other", "POST"), ("done", "POST")):
            assert ask(server, path=theirs + path, method=method, body=b"{}")[0] == 404
        assert ask(server, "other", "POST", b"{}")[0] == 200 and not server.done.is_set()
    finally:
        server.close()
    assert own["Content-Security-Policy"].startswith("sandbox allow-scripts; default-src 'none'; script-src 'unsafe-in")
    assert "allow-same-origin" not in own["Content-Security-Policy"]
    assert own["Cross-Origin-Opener-Policy"] == "unsafe-none" and own["X-Content-Type-Options"] == "nosniff"
    assert "unsafe" not in plain["Content-Security-Policy"] and plain["Cross-Origin-Opener-Policy"] == "same-origin"


def test_without_the_token_or_under_another_name_nothing_is_told(served: PageServer):
    token = urllib.parse.urlsplit(served.url).path
    for path in (
        "/",
        "/state",
        "/look",
        token[:-2] + "/state",
        token.replace("/", "/x", 1),
        "/../" + token,
        token[:-1],
    ):
        status, _, data = ask(served, path)
        assert status == 403 and len(data) < 200, path
    for host in ("evil.example", f"evil.example:{served.port}", "127.0.0.1", f"127.0.0.1:{served.port + 1}", ""):
        for method, body in (("GET", None), ("POST", b"{}")):
            status, _, data = ask(served, "state" if body is None else "done", method, body, {"Host": host})
            assert status == 403 and b"corners" not in data, host
    status, _, _ = ask(served, "done", "POST", b"{}", {"Origin": "http://evil.example"})
    assert status == 403
    assert not served.done.is_set()
    assert ask(served, "state", headers={"Host": f"localhost:{served.port}"})[0] == 200
    assert len(urllib.parse.urlsplit(served.url).path.strip("/")) >= 32


@pytest.mark.parametrize(
    "path",
    [
        "../server.py", "..%2fserver.py", "%2e%2e/server.py", "....//server.py", "page/index.html", "index.html",
        "image/../state", "image/1.png", "image/-1.png", "image/0.png/..", "image/٣.png", "style.css%00", "main.js/",
        "image/99999999999999999999.png",
    ],
)  # fmt: skip
def test_no_path_leads_anywhere_else(served: PageServer, path: str):
    status, _, data = ask(served, urllib.parse.quote(path, safe="/%"))
    assert status in (400, 404) and b"import" not in data and b"Traceback" not in data


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "not understood"),
        (b"{", "not understood"),
        (b"\xff\xfe", "not understood"),
        (b"[" * 200_000, "not understood"),
        (b'{"corners": {"L_in_near": [1]}}', "corners"),
        (b'{"corners": {"L_in_near": ["a", 2]}}', "corners"),
        (b'{"corners": {"L_in_near": [NaN, 2]}}', "not understood"),
        (b'{"corners": {"L_in_near": [1e300, 2]}}', "corners"),
        (b'{"corners": {"nose": [1, 2]}, "image": 0}', "no such corner; one of L_in_near"),
        (b'{"corners": {}, "image": 7}', "there is no image 7"),
        (b'{"corners": {}}', "no live camera"),
        (b'{"corners": {}, "image": 0, "jaw_opening_m": 0.4}', "jaw opening 400 mm; the gripper's 0 to 60 mm"),
        (b'{"corners": {}, "image": 0, "more": 1}', "more"),
    ],
)
def test_a_corrupted_request_is_told_what_is_wrong(served: PageServer, body: bytes, said: str):
    status, _, data = ask(served, "look", "POST", body)
    assert status == 400 and said in json.loads(data)["error"]
    assert b"Traceback" not in data and b"\n" not in data


def test_a_request_must_be_json_and_short(served: PageServer):
    plain = {"Content-Type": "text/plain"}
    assert ask(served, "look", "POST", b"{}", plain)[0] == 415
    assert ask(served, "look", "POST", b"{}", {"Content-Length": "1000001"})[0] == 413
    assert ask(served, "look", "POST", b"{}", {"Content-Length": "-1"})[0] == 411
    assert ask(served, "nowhere", "POST", b"{}")[0] == 404
    assert ask(served, "look", "DELETE")[0] == 501
    with socket.create_connection(("127.0.0.1", served.port), timeout=DEADLINE_S) as raw:
        raw.sendall(b"\x16\x03\x01 nonsense\r\n\r\n")
        assert b"400" in raw.recv(4096)
    assert ask(served, "state")[0] == 200


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    corners=st.dictionaries(
        st.sampled_from(["L_in_near", "L_in_far", "L_out_near", "R_in_near", "R_in_far", "R_out_far"]),
        st.tuples(st.floats(-2000.0, 2000.0), st.floats(-2000.0, 2000.0)),
        max_size=6,
    ),
    by_hand=st.booleans(),
)
@example(corners={"L_in_near": (685.0, 0.0), "L_out_near": (-740.0, 1.0)}, by_hand=False)  # determines no pose
def test_wherever_corners_are_put_there_is_an_answer(
    served: PageServer, corners: dict[str, tuple[float, float]], by_hand: bool
):
    status, reply = look(served, {"corners": corners, "by_hand": list(corners) if by_hand else [], "image": 0})
    assert status == 200, reply
    seen = reply["snapped"]
    assert seen["refused"] or seen["share"] > 0.3
    assert len(seen["corners"]) == 8
    if seen["refused"]:
        assert not reply["expected"] and all(corner["uv_px"] is None for corner in seen["corners"])


def test_pages_don_t_disturb_each_other(served: PageServer, rig: Rig):
    """Each answer is of its own corners, whoever else asks at the same time."""
    good = rig.rough("L_in_near", "L_in_far", "R_in_near", "R_in_far")
    few = {"L_in_near": good["L_in_near"]}
    answers: dict[int, tuple[int, dict[str, Any]]] = {}

    def visit(number: int) -> None:
        corners = few if number % 2 else good
        answers[number] = look(served, {"corners": corners, "image": 0, "jaw_opening_m": 0.034})

    visitors = [threading.Thread(target=visit, args=(number,)) for number in range(6)]
    for visitor in visitors:
        visitor.start()
    for visitor in visitors:
        visitor.join()
    assert sorted(answers) == list(range(6))
    for number, (status, reply) in answers.items():
        assert status == 200
        seen = reply["snapped"]
        assert (seen["refused"] is not None) == bool(number % 2)
        if not number % 2:
            found = {corner["name"]: corner["uv_px"] for corner in seen["corners"]}
            assert np.linalg.norm(np.array(found["L_in_near"]) - rig.corners_px["L_in_near"]) < 0.2


def test_saving_is_told_as_it_went(served: PageServer, saving: Told, rig: Rig):
    put = {"corners": rig.rough("L_in_near", "L_in_far", "R_in_near", "R_in_far"), "image": 0}
    order = {"put": put, "robot": "arm", "camera_name": "wrist", "taught": False}
    status, _, data = ask(served, "save", "POST", json.dumps(order).encode())
    assert status == 200 and json.loads(data)["written"] == {"c": "image 0 of 1"}
    assert saving.orders[-1].config and not saving.orders[-1].taught and not saving.orders[-1].replace
    saving.refuse = "the disk is full"
    status, _, data = ask(served, "save", "POST", json.dumps(order).encode())
    saving.refuse = ""
    assert status == 200 and json.loads(data)["refused"] == "the disk is full"
    for robot in ("a/b", "", "@arm", "a b"):
        assert ask(served, "save", "POST", json.dumps(order | {"robot": robot}).encode())[0] == 400


def test_done_is_answered_before_it_is_done(rig: Rig, saving: Told):
    picture = Picture("000000.png", rig.image, 0.034, str(rig.image_path))
    setup = Setup(rig.camera, rig.gripper, MonitorSettings(), None)
    server = PageServer(TeachSite(TeachSession(setup, [picture], LABELS, saving)))
    try:
        assert ask(server, "done", "POST", b"{}")[0] == 200
        assert server.done.wait(DEADLINE_S)
    finally:
        server.close()


class Camera:
    """Gives what it is told to, for ever."""

    live, connected, dropped = True, True, 0

    def __init__(self, answer: Frame | Waiting):
        self.answer, self.closed = answer, False

    def read(self) -> Frame | Waiting | None:
        time.sleep(0.01)
        return None if self.closed else self.answer

    def close(self) -> None:
        self.closed = True


def shown(session: TeachSession) -> bytes:
    """The live image; empty while there is none."""
    try:
        return session.live()
    except BadRequest:
        return b""


def test_a_camera_of_another_size_or_none_is_said(rig: Rig, saving: Told):
    labels = Labels("arm", "wrist", False, "/there", {}, None, "cam0")
    camera = Camera(Frame(0, 0, np.full((48, 64), 100, np.uint8), None, "live"))
    session = TeachSession(Setup(rig.camera, rig.gripper, MonitorSettings(), None), [], labels, saving, camera)
    try:
        with pytest.raises(BadRequest, match="64x48 pixels; 768x576"):
            session.live()
        for_s, why = session.dark()
        assert for_s > 0.0 and "64x48 pixels" in why
        camera.answer = Frame(1, 1, rig.image, 0.034, "live")
        deadline = time.monotonic() + DEADLINE_S
        while not (data := shown(session)):
            assert time.monotonic() < deadline
        assert data.startswith(b"\xff\xd8") and session.dark() == (0.0, "")
        assert [one.name for one in session.take()] == ["live-000.png"]
        assert session.still(0).startswith(b"\x89PNG")
    finally:
        session.close()
    assert camera.closed


def test_images_of_more_bits_are_shown_as_pictures(rig: Rig, saving: Told):
    import cv2

    deep = (rig.image.astype(np.uint16) * 16 + 200).astype(np.uint16)
    picture = Picture("deep.png", deep, None, str(Path("deep.png")))
    session = TeachSession(Setup(rig.camera, rig.gripper, MonitorSettings(), None), [picture], LABELS, saving)
    shown = cv2.imdecode(np.frombuffer(session.still(0), np.uint8), cv2.IMREAD_UNCHANGED)
    assert shown.dtype == np.uint8 and shown.shape[:2] == rig.image.shape[:2]
    assert int(shown.max()) - int(shown.min()) > 200
    session.close()


def test_without_a_gripper_rough_corners_are_written_as_infer_reads_them(tmp_path: Path):
    image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    path = tmp_path / "rough.yaml"
    server = PageServer(
        OutlineSite(Picture("a\nb: ü.png", image, None, "a.png"), path, "the next command", "a note")
    )
    names = [
        f"{finger}_{point}_{side}"
        for finger in ("left", "right")
        for point in ("inner", "rise")
        for side in ("near", "far")
    ]
    put = {name: [10.0 * k + 0.25, 2.5 - k] for k, name in enumerate(names)}

    def save(corners: dict[str, list[float]], **more: object) -> tuple[int, dict[str, object]]:
        order = {"put": {"corners": corners}, "robot": "r", "camera_name": "c", **more}
        status, _, data = ask(server, "save", "POST", json.dumps(order).encode())
        return status, json.loads(data)

    try:
        state = json.loads(ask(server, "state")[2])
        assert state["corners_only"] and (state["width_px"], state["height_px"]) == (64, 48)
        assert set(names) < set(state["corners"]) == set(state["places"])
        assert all(0 < u < 64 and 0 < v < 48 for u, v in state["places"].values())
        assert ask(server, "image/0.png")[2].startswith(b"\x89PNG") and ask(server, "image/1.png")[0] == 404
        assert look(server, {"corners": put})[0] == ask(server, "live.jpg")[0] == 404
        for corners, why in (
            ({}, "corners.left_inner_near: is missing"),
            ({n: at for n, at in put.items() if "inner" in n}, "only one edge of its own is given"),
            (put | {"left_end_near": [1.0, 1.0]}, "corners.left_end_near: is there beside left_rise_near"),
            (put | {"nose": [1.0, 1.0]}, "corners.nose: is not a name"),
        ):
            status, answer = save(corners, replace=True)
            assert status == 200 and why in str(answer["refused"]) and not path.exists()
        assert save(put)[1]["next"] == "the next command"
        assert {n: list(at) for n, at in read_rough_corners(path, None).items()} == put
        before = path.read_bytes()
        moved = put | {"left_inner_far": [7.0, 8.0]}
        assert save(moved)[1]["exists"] == [str(path)] and path.read_bytes() == before
        assert save(moved, replace=True)[1]["written"] == {str(path): "rough corners"}
        assert read_rough_corners(path, None)["left_inner_far"] == (7.0, 8.0)
        assert list(tmp_path.iterdir()) == [path]
    finally:
        server.close()


def test_an_answer_says_what_a_transform_may_promise(served: PageServer, rig: Rig):
    """By its corners alone, a gripper whose file doesn't say what its bevels are is known too roughly for 1 mm."""
    corners = rig.rough("L_in_near", "L_in_far", "R_in_near", "R_in_far")
    status, reply = look(served, {"corners": corners, "by_hand": list(corners), "image": 0})
    assert status == 200 and reply["expected"]["reachable"] is False
    assert re.match(
        r"forecast: a transform of this view is good to .* mm .*, alert limit 1 mm and 2°; no transform can be valid: ",
        reply["expected"]["promise"],
    )
    assert b'id="promise"' in ask(served)[2] and b"#promise" in ask(served, "panel.js")[2]
