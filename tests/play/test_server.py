"""What the page's server answers, to visitors and to others."""

import io
import json
import socket
from typing import Any

import aiohttp
import numpy as np
import pytest
from aiohttp import web
from PIL import Image

from lerobot_wmrl.common.errors import FieldError
from lerobot_wmrl.play.server import ELSEWHERE, MOST_VISITORS
from lerobot_wmrl.play.web import Access
from lerobot_wmrl.play.web import serve as serve_page

VISIT = "visitor01"
STATE = json.dumps([0.0] * 8)


@pytest.fixture
def served(world, saved, serve):
    return serve(world, saved)


async def talk(served: Any, *messages: Any, visit: str = VISIT) -> list[dict[str, Any]]:
    """Send messages as one visitor; return the answers."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{served.address}drive?visit={visit}") as opened,
    ):
        answers = []
        for message in messages:
            await opened.send_str(message if isinstance(message, str) else json.dumps(message))
            answers.append(await opened.receive_json(timeout=60))
        return answers


async def fetch(served: Any, method: str, path: str, **options: Any) -> tuple[int, str, Any]:
    """Return status, text and headers of an answer."""
    async with (
        aiohttp.ClientSession() as session,
        session.request(method, f"{served.address}{path}", **options) as response,
    ):
        return response.status, await response.text(), response.headers


def picture(size: tuple[int, int] = (40, 30), kind: str = "PNG") -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.full((size[1], size[0], 3), 90, np.uint8)).save(buffer, kind)
    return buffer.getvalue()


def form(**fields: Any) -> aiohttp.FormData:
    """A form with these fields; a list is several of one name."""
    data = aiohttp.FormData()
    for name, values in fields.items():
        for value in values if isinstance(values, list) else [values]:
            data.add_field(name, value, **({"filename": f"{name}.png"} if isinstance(value, bytes) else {}))
    return data


BEGIN = {"do": "begin", "episode": 0, "frame": 0}
STEP = {"do": "step", "driver": "you", "action": [0.01] * 7}


def test_the_page_and_what_it_needs(served):
    status, page, headers = served.run(fetch(served, "GET", ""))
    assert status == 200
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    for asset in ("static/play.js", "static/play.css"):
        assert asset in page
        assert served.run(fetch(served, "GET", asset))[0] == 200
    world = json.loads(served.run(fetch(served, "GET", "world"))[1])
    assert world["cameras"] == ["third_view"]
    assert [axis["name"] for axis in world["axes"]][-1] == "gripper"
    assert len(world["episodes"]) == 6
    assert world["drivers"] == ["policy", "planner", "recorded"]


def test_a_drive_from_begin_to_save(served, folder):
    answers = served.run(talk(served, BEGIN, STEP, STEP, {"do": "save", "success": True}))
    assert answers[0]["begun"]["place"] == {"episode": 0, "frame": 0}
    assert answers[0]["views"][0]["images"][0].startswith("data:image/jpeg;base64,")
    assert [answer["view"]["frame"] for answer in answers[1:3]] == [1, 2]
    assert answers[3]["saved"] == 0
    assert folder.is_dir()


def test_a_visitor_who_comes_back_finds_the_drive(served):
    first = served.run(talk(served, BEGIN, STEP, STEP))
    again = served.run(talk(served, {"do": "resume"}, STEP))
    assert [view["frame"] for view in again[0]["views"]] == [0, 1, 2]
    assert again[0]["views"][2] == first[2]["view"]
    assert again[1]["view"]["frame"] == 3


def test_two_visitors_do_not_meet(served):
    served.run(talk(served, BEGIN, STEP, STEP))
    other = served.run(talk(served, {"do": "resume"}, {**BEGIN, "episode": 3}, STEP, visit="visitor02"))
    assert other[0]["begun"] is None
    assert other[2]["view"]["frame"] == 1
    assert served.run(talk(served, STEP))[0]["view"]["frame"] == 3


def test_who_has_been_away_longest_makes_room(served):
    names = [f"visitor{index:02d}" for index in range(MOST_VISITORS + 1)]
    for name in names:
        served.run(talk(served, BEGIN, visit=name))
    assert [*served.server.visits] == names[1:]
    assert served.run(talk(served, {"do": "resume"}, visit=names[0]))[0]["begun"] is None


def test_no_more_visitors_come_than_there_is_room_for(served):
    async def crowd() -> int:
        async with aiohttp.ClientSession() as session:
            here = [
                await session.ws_connect(f"{served.address}drive?visit=visitor{index:02d}")
                for index in range(MOST_VISITORS)
            ]
            assert not any(socket.closed for socket in here)
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await session.ws_connect(f"{served.address}drive?visit=onetoomany")
            return refused.value.status

    assert served.run(crowd()) == 503


def test_a_visit_that_cannot_begin_takes_no_room(served, world, monkeypatch):
    def broken(name: str) -> None:
        raise RuntimeError(f"{name} cannot be loaded")

    async def visit(name: str) -> aiohttp.WSMsgType:
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{served.address}drive?visit={name}") as opened,
        ):
            return (await opened.receive(timeout=60)).type

    monkeypatch.setattr(world, "driver", broken)
    for index in range(MOST_VISITORS):
        assert served.run(visit(f"visitor{index:02d}")) in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)
    monkeypatch.undo()
    assert served.run(talk(served, BEGIN, visit="onemorevisitor"))[0]["begun"]


def test_a_drive_goes_on_in_the_tab_that_opened_it_last(served):
    async def tabs() -> tuple[int, dict[str, Any]]:
        async with aiohttp.ClientSession() as session:
            first = await session.ws_connect(f"{served.address}drive?visit={VISIT}")
            await first.send_json(BEGIN)
            await first.receive_json()
            second = await session.ws_connect(f"{served.address}drive?visit={VISIT}")
            closed = await first.receive()
            await second.send_json(STEP)
            return closed.data, await second.receive_json()

    code, answer = served.run(tabs())
    assert code == ELSEWHERE
    assert answer["view"]["frame"] == 1


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ("{", "Expecting property name"),
        ("[1]", "must be a JSON object"),
        ({"do": "format"}, "do=format: choose one of begin, step, rewind, save, resume"),
        ({"do": "begin"}, "picture=None: is no picture that was uploaded"),
        ({"do": "begin", "picture": "../../etc/passwd"}, "is no picture that was uploaded"),
        ({"do": "begin", "episode": 6, "frame": 0}, "episode=6: must be a whole number from 0 to 5"),
        ({"do": "begin", "episode": "0", "frame": 0}, "episode=0: must be a whole number"),
        ({"do": "begin", "episode": 0, "frame": True}, "frame=True: must be a whole number"),
        ({"do": "begin", "seed": 3}, "seed=3: there is no real environment; give real_env.type"),
        ({**BEGIN, "instruction": 5}, "instruction=5: must be a text"),
        ({"do": "begin", "seed": 1, "instruction": 5}, "instruction=5: must be a text"),
        ({"do": "step", "driver": "nobody"}, "driver=nobody: choose one of you, policy, planner, recorded"),
        ({"do": "step", "driver": "you"}, "action=None: must be a list of finite numbers"),
        ({"do": "step", "driver": "you", "action": [1] * 6}, "must be 7 finite numbers"),
        ('{"do": "step", "driver": "you", "action": [NaN, 0, 0, 0, 0, 0, 0]}', "must be a list of finite"),
        ({"do": "rewind", "frame": 2}, "frame=2: must be a whole number from 0 to 1"),
        ({"do": "save", "success": "yes"}, "success=yes: must be true or false"),
    ],
)
def test_a_message_that_cannot_be_is_refused_and_the_drive_goes_on(served, message, error):
    answers = served.run(talk(served, BEGIN, STEP, message, STEP))
    assert error.replace("real_env.type", "`real_env.type`") in answers[2]["error"]
    assert answers[3]["view"]["frame"] == 2


@pytest.mark.parametrize(
    ("method", "path", "options", "status", "said"),
    [
        ("GET", "nothing", {}, 404, ""),
        ("GET", "static/../server.py", {}, 404, ""),
        ("GET", "static/%2e%2e/server.py", {}, 404, ""),
        ("GET", "drive?visit=visitor01", {}, 400, ""),
        ("GET", "drive?visit=../x", {}, 400, "8 to 64 letters"),
        ("POST", "world", {}, 405, ""),
        ("GET", "", {"headers": {"Host": "evil.example"}}, 403, "evil.example is not this machine"),
        ("GET", "world", {"headers": {"Origin": "http://evil.example"}}, 403, "is another site"),
        ("POST", "picture", {"data": b"abc"}, 415, "multipart"),
        ("POST", "picture", {"data": {"third_view": picture(kind="BMP"), "state": STATE}}, 400, "cannot be"),
        (
            "POST",
            "picture",
            {"data": {"wrist": picture(), "state": STATE}},
            400,
            "sees the cameras third_view",
        ),
        ("POST", "picture", {"data": {"third_view": [picture()] * 2, "state": STATE}}, 400, "one picture"),
        ("POST", "picture", {"data": {"third_view": b"no picture", "state": STATE}}, 400, "cannot be read"),
        ("POST", "picture", {"data": {"third_view": picture((5000, 2))}}, 400, "at most 4096"),
        ("POST", "picture", {"data": {"third_view": picture()[:-40], "state": STATE}}, 400, "picture"),
        ("POST", "picture", {"data": {"third_view": picture(), "state": "[1, 2]"}}, 400, "8 finite numbers"),
        ("POST", "picture", {"data": {"third_view": picture(), "state": "{"}}, 400, "Expecting"),
        ("POST", "picture", {"data": {"third_view": bytes(17 * 1024**2)}}, 413, ""),
    ],
)
def test_a_malformed_request_is_refused_and_nothing_is_lost(served, method, path, options, status, said):
    served.run(talk(served, BEGIN, STEP))
    if isinstance(options.get("data"), dict):
        options = {"data": form(**options["data"])}
    answer = served.run(fetch(served, method, path, **options))
    assert answer[0] == status
    assert said in answer[1]
    assert served.run(talk(served, STEP))[0]["view"]["frame"] == 2


def test_an_uploaded_picture_is_a_place_to_begin(served):
    status, answer, _ = served.run(
        fetch(served, "POST", "picture", data=form(third_view=picture(), state=STATE, instruction="push"))
    )
    assert status == 200
    place = json.loads(answer)
    begun, stepped = served.run(talk(served, {"do": "begin", **place}, STEP))
    assert begun["begun"]["instruction"] == "push"
    assert stepped["view"]["frame"] == 1


def test_beyond_this_machine_a_token_is_needed(world, saved, serve):
    served = serve(world, saved, host="0.0.0.0")
    token = served.server.access.token
    for path in ("", "world", "static/play.js", "drive?visit=visitor01", "world?token=wrong"):
        assert served.run(fetch(served, "GET", path))[0] == 401
    status, _, headers = served.run(fetch(served, "GET", f"?token={token}"))
    assert status == 200
    assert "HttpOnly" in headers["Set-Cookie"]
    assert served.run(fetch(served, "GET", f"world?token={token}"))[0] == 200
    assert served.run(fetch(served, "GET", "world", headers={"Cookie": f"token={token}"}))[0] == 200
    assert served.run(talk(served, BEGIN, visit=f"{VISIT}&token={token}"))[0]["begun"]
    assert token in served.server.access.address(80)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1"])
def test_this_machine_needs_no_token(host):
    assert Access(host).token == ""
    assert "token" not in Access(host).address(8000)


def test_an_address_that_is_taken_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(FieldError, match=rf"^port={port}: cannot be served at 127\.0\.0\.1"):
            serve_page(web.Application(), Access("127.0.0.1"), port, "")
