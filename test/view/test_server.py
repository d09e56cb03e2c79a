# Copyright 2026 The flock_follower developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The server of the page: what it serves, to whom, and what a slow page costs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterator
import contextlib
import json
import re
import socket
import threading
import time
from typing import Any

import aiohttp
import pytest

from flock_follower.view.access import Access
from flock_follower.view.server import CONNECTIONS_MAX, FILES, PAGES_MAX, PageServer, STATIC

DEADLINE = 40.0  # s for anything awaited
TIMEOUT = aiohttp.ClientTimeout(total=20.0)


class Rig:
    """A server on a free port, and the buttons that were pressed."""

    def __init__(self, **access: Any) -> None:
        self.pressed: list[str] = []
        self.changed = threading.Event()
        self.server = PageServer(Access('127.0.0.1', **access), 0, self.changed.set,
                                 self.pressed.append, {'name': 'one'})
        self.server.start()
        self.host = f'127.0.0.1:{self.server.port}'
        self.origin = f'http://{self.host}'

    def run(self, ask: Callable[[aiohttp.ClientSession], Coroutine[Any, Any, Any]]) -> Any:
        """Run a coroutine that gets a session."""
        async def within() -> Any:
            async with aiohttp.ClientSession(timeout=TIMEOUT) as session:
                return await ask(session)
        return asyncio.run(within())

    def get(self, path: str = '/', **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Return status, headers and body of a page."""
        async def ask(session: aiohttp.ClientSession) -> Any:
            async with session.get(f'{self.origin}{path}', headers=headers,
                                   allow_redirects=False) as reply:
                return reply.status, dict(reply.headers), await reply.read()
        found: tuple[int, dict[str, str], bytes] = self.run(ask)
        return found

    def socket(self, query: str = '', say: str = '', count: int = 1,
               **headers: str) -> list[dict[str, Any]] | int:
        """Open a WebSocket, send a text, and return messages; or the status of a refusal."""
        async def ask(session: aiohttp.ClientSession) -> Any:
            try:
                async with session.ws_connect(
                        f'{self.origin}/ws{query}',
                        headers={'Origin': self.origin, **headers}) as opened:
                    if say:
                        await opened.send_str(say)
                    return [await opened.receive_json() for _ in range(count)]
            except aiohttp.WSServerHandshakeError as error:
                return error.status
        found: list[dict[str, Any]] | int = self.run(ask)
        return found


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.server.stop()


@pytest.fixture
def control() -> Iterator[Rig]:
    made = Rig(control=True, token='secret')
    yield made
    made.server.stop()


def test_every_file_is_served_with_policy_against_scripts(rig: Rig) -> None:
    assert {name for name, _ in FILES.values()} == {path.name for path in STATIC.iterdir()}
    for path, (name, kind) in FILES.items():
        status, headers, body = rig.get(path)
        assert (status, headers['Content-Type']) == (200, f'{kind}; charset=utf-8')
        assert body == (STATIC / name).read_bytes()
        policy = headers['Content-Security-Policy']
        assert "default-src 'none'; script-src 'self'" in policy and 'unsafe' not in policy
        assert (headers['X-Frame-Options'], headers['Referrer-Policy']) == ('DENY', 'no-referrer')
    assert rig.get('/../server.py')[0] == rig.get('/config')[0] == 404


def test_page_has_no_own_script_and_never_takes_markup() -> None:
    page = (STATIC / 'index.html').read_text()
    assert '<script>' not in page and ' style=' not in page and not re.search(r'\son\w+=', page)
    for name in ('app.js', 'draw.js'):
        code = (STATIC / name).read_text()
        assert not [word for word in ('innerHTML', 'outerHTML', 'insertAdjacentHTML', 'eval(',
                                      'document.write', 'http://cdn', 'https://')
                    if word in code]


@pytest.mark.parametrize(('headers', 'code'), [
    ({'Host': 'evil.example'}, b'host'), ({'Host': '192.168.1.5:8090'}, b'host')])
def test_another_host_is_refused(rig: Rig, headers: dict[str, str], code: bytes) -> None:
    for path in ('/', '/app.js', '/ws'):
        status, answered, body = rig.get(path, **headers)
        assert status == 403 and body.split(b':')[0] == code
        assert 'Content-Security-Policy' in answered
    assert rig.socket(**headers) == 403


@pytest.mark.parametrize('origin', ['http://evil.example', 'http://127.0.0.1:1', 'null', ''])
def test_a_socket_of_another_origin_is_refused(rig: Rig, origin: str) -> None:
    assert rig.socket(Origin=origin) == 403
    assert rig.server.pages == 0


def test_token_in_address_becomes_cookie_wrong_one_is_refused(
        control: Rig) -> None:
    for path in ('/?token=wrong', '/app.js?token=wrong'):
        status, _, body = control.get(path)
        assert (status, body.split(b':')[0]) == (403, b'token')
    assert control.socket('?token=wrong') == 403
    status, headers, _ = control.get('/?token=secret')
    assert (status, headers['Location']) == (303, '/')
    cookie = headers['Set-Cookie']
    assert 'HttpOnly' in cookie and 'SameSite=Strict' in cookie
    name = cookie.partition('=')[0]
    (about,) = control.socket(Cookie=f'{name}=secret')  # type: ignore[misc]
    assert about['about'] == {'name': 'one', 'control': ''}
    (about,) = control.socket(Cookie=f'{name}=old')  # type: ignore[misc]
    assert about['about']['control'] == 'token'  # it may read


@pytest.mark.parametrize(('query', 'button', 'pressed', 'code'), [
    ('?token=secret', 'brake', ['brake'], None), ('?token=secret', 'land', ['land'], None),
    ('', 'land', [], 'token'), ('?token=secret', 'arm', [], None)])
def test_a_button_acts_with_the_token_alone(
        control: Rig, query: str, button: str, pressed: list[str], code: str | None) -> None:
    say = json.dumps({'button': button})
    if code:
        _, answer = control.socket(query, say, 2)  # type: ignore[misc]
        assert (answer['answer']['code'], answer['answer']['success']) == (code, False)
    else:
        control.socket(query, say)
        control.changed.clear()
        control.changed.wait(5.0)  # the page is closed
    assert control.pressed == pressed


def test_without_control_no_button_acts(rig: Rig) -> None:
    about, answer = rig.socket(say='{"button": "brake"}', count=2)  # type: ignore[misc]
    assert about['about']['control'] == answer['answer']['code'] == 'off'
    assert rig.pressed == []


@pytest.mark.parametrize('say', [
    '[', '[]', '1', 'null', '{"button": []}', '{"button": {"a": 1}}', '[' * 1000, 'x' * 1024])
def test_what_no_page_sends_is_ignored(control: Rig, say: str) -> None:
    about, answer = control.socket(say=say), control.socket(say='{"button": "land"}', count=2)
    assert about and isinstance(answer, list) and answer[1]['answer']['code'] == 'token'
    assert control.pressed == []


def test_a_page_gets_the_history_first_then_states(rig: Rig) -> None:
    async def ask(session: aiohttp.ClientSession) -> list[str]:
        async with session.ws_connect(f'{rig.origin}/ws',
                                      headers={'Origin': rig.origin}) as opened:
            await opened.receive_json()
            assert rig.server.greets
            rig.server.send_history({'n': 2})
            rig.server.send_state({'n': 3})
            rig.server.send_image(b'jpeg')
            rig.server.send_answer('brake', True, '<img onerror=1>' * 100)
            got: list[Any] = []
            while len(got) < 4 or b'jpeg' not in got:
                # A page that receives nothing more raises TimeoutError.
                got.append((await opened.receive(timeout=DEADLINE)).data)
            assert not rig.server.greets
            return [one if one == b'jpeg' else json.loads(one) for one in got]
    history, *rest = rig.run(ask)
    assert history == {'history': {'n': 2}}
    assert {'state': {'n': 3}} in rest and any('answer' in one for one in rest if one != b'jpeg')


def test_page_that_does_not_read_delays_no_other(rig: Rig) -> None:
    big = b'x' * 200_000

    async def ask(session: aiohttp.ClientSession) -> list[int]:
        headers = {'Origin': rig.origin}
        async with session.ws_connect(f'{rig.origin}/ws', headers=headers) as quick:
            # One that shakes hands and reads no more.
            _, writer = await asyncio.open_connection('127.0.0.1', rig.server.port,
                                                      limit=1024)
            writer.transport.pause_reading()  # type: ignore[attr-defined]
            writer.write((f'GET /ws HTTP/1.1\r\nHost: {rig.host}\r\nOrigin: {rig.origin}\r\n'
                          'Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13'
                          '\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n').encode())
            end = time.monotonic() + DEADLINE
            while rig.server.pages < 2:
                assert time.monotonic() < end, 'the second page is not open'
                await asyncio.sleep(0.01)
            await quick.receive()
            for number in range(100):  # 20 MB: more than any buffer on the way
                rig.server.send_image(number.to_bytes(1, 'little') + big)
                got = (await quick.receive()).data
                assert got[0] == number
            waiting = [page.image[0] for page in rig.server._pages if page.image is not None]
            writer.close()
            return waiting
    assert rig.run(ask) == [99]  # one image waits, the newest


def test_no_more_pages_than_the_limit_are_open(rig: Rig) -> None:
    async def ask(session: aiohttp.ClientSession) -> int:
        opened = []
        try:
            while len(opened) <= PAGES_MAX:
                opened.append(await session.ws_connect(
                    f'{rig.origin}/ws', headers={'Origin': rig.origin}))
        except aiohttp.WSServerHandshakeError as error:
            assert len(opened) == PAGES_MAX
            return error.status
        return 0
    assert rig.run(ask) == 503


@pytest.mark.parametrize('said', [b'', b'GET / HTTP/1.1\r\n'])
def test_a_connection_that_opens_no_page_ends(monkeypatch: pytest.MonkeyPatch, rig: Rig,
                                              said: bytes) -> None:
    monkeypatch.setattr('flock_follower.view.server.CONNECTION_TIME', 0.2)

    async def ask(session: aiohttp.ClientSession) -> dict[str, Any]:
        page = await session.ws_connect(f'{rig.origin}/ws', headers={'Origin': rig.origin})
        reader, writer = await asyncio.open_connection('127.0.0.1', rig.server.port)
        writer.write(said)
        with contextlib.suppress(ConnectionResetError):
            assert await asyncio.wait_for(reader.read(), 10.0) == b''
        writer.close()
        await page.receive_json()  # about; the page was open for longer
        rig.server.send_history({})
        shown: dict[str, Any] = await page.receive_json()
        return shown

    assert rig.run(ask) == {'history': {}}


def test_connections_beyond_the_limit_end_the_oldest_one(rig: Rig) -> None:
    async def ask(session: aiohttp.ClientSession) -> tuple[int, bytes]:
        page = await session.ws_connect(f'{rig.origin}/ws', headers={'Origin': rig.origin})
        idle = [await asyncio.open_connection('127.0.0.1', rig.server.port)
                for _ in range(CONNECTIONS_MAX + 1)]
        try:
            ended = await asyncio.wait_for(idle[0][0].read(), 10.0)
        except ConnectionResetError:
            ended = b''
        async with session.get(rig.origin) as reply:  # a page opens beside them
            status = reply.status
        await page.receive_json()
        rig.server.send_history({})
        assert await page.receive_json() == {'history': {}}
        for _, writer in idle:
            writer.close()
        return status, ended

    assert rig.run(ask) == (200, b'')


def test_busy_port_and_foreign_address_are_errors_with_remedy() -> None:
    with socket.socket() as busy:
        busy.bind(('127.0.0.1', 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(OSError, match=rf'port {port}: in use: set port:={port + 1}'):
            PageServer(Access('127.0.0.1'), port, lambda: None, print).start()
    with pytest.raises(OSError, match='host must be an address of this computer'):
        PageServer(Access('203.0.113.1', token='x'), 0, lambda: None, print).start()
