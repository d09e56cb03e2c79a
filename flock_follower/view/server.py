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

"""
The server of the live page: aiohttp in a thread of its own.

For each page at most one state and one image wait, so a slow browser gets fewer of them, and
neither a slow browser nor ten pages delay other work. Every connection that is not an open page is
closed after a time, because clients could use up the sockets of the process. The methods of
:class:`PageServer` may be called from any thread.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
import contextlib
import errno
import json
from pathlib import Path
import threading
from typing import Any, Final

from aiohttp import hdrs, web, WSCloseCode, WSMsgType

from flock_follower.view.access import Access, HOST, OFF, ORIGIN, TOKEN

STATIC: Final = Path(__file__).parent / 'static'
#: Files of the page by their addresses, with their types.
FILES: Final = {
    '/': ('index.html', 'text/html'), '/app.js': ('app.js', 'text/javascript'),
    '/draw.js': ('draw.js', 'text/javascript'),
    '/style.css': ('style.css', 'text/css'),
    '/uPlot.iife.min.js': ('uPlot.iife.min.js', 'text/javascript'),
    '/uPlot.min.css': ('uPlot.min.css', 'text/css'),
    '/uPlot.LICENSE': ('uPlot.LICENSE', 'text/plain')}
#: No script, style or connection but ours, and no page of others around this one.
HEADERS: Final = {
    'Content-Security-Policy': (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"),
    'X-Content-Type-Options': 'nosniff', 'X-Frame-Options': 'DENY',
    'Referrer-Policy': 'no-referrer', 'Cross-Origin-Resource-Policy': 'same-origin',
    'Cross-Origin-Opener-Policy': 'same-origin', 'Cache-Control': 'no-store'}
PAGES_MAX = 24
CONNECTIONS_MAX = 64  # a further one ends the oldest that is no open page
LISTEN_BACKLOG = 16  # connections that wait to be accepted
CONNECTION_TIME = 30.0  # s for which a connection may last that is no open page
ANSWERS_MAX = 8  # that wait for a slow page
LONGEST_REQUEST = 1024  # bytes of a message from a page
HEARTBEAT = 5.0  # s: a page that answers no ping within half of it is gone
START_TIMEOUT = 5.0  # s until the address is bound
STOP_TIMEOUT = 0.5  # s for open pages to be closed
BUTTONS: Final = ('brake', 'land')
REFUSALS: Final = {
    HOST: 'This page does not answer to the host name in the address. Open the address that the '
          'node prints, or that of a tunnel: ssh -L {port}:127.0.0.1:{port} '
          'USER@COMPUTER, then http://127.0.0.1:{port}.',
    ORIGIN: 'Refused: the request comes from another page.',
    TOKEN: 'The token is missing or wrong. Open the address that the node printed when it '
           'started: each start has another token.',
    OFF: 'The page has no buttons: start the node with control:=true.'}


class _Page:
    """One open page: what waits to be sent to it."""

    def __init__(self, token: str, socket: web.WebSocketResponse,
                 connection: asyncio.BaseProtocol) -> None:
        self.token, self.socket, self.connection = token, socket, connection
        self.greeted = False
        """Whether the page has received the history."""
        self.state: str | None = None
        self.image: bytes | None = None
        self.answers: deque[str] = deque(maxlen=ANSWERS_MAX)
        self.waiting = asyncio.Event()


class PageServer:
    """
    Serves the page.

    :param viewers: called in the server's thread when the number of pages has changed.
    :param button: called in the server's thread with the button that was pressed.
    :param about: data that each page gets once, such as the computer's name.
    """

    def __init__(self, access: Access, port: int, viewers: Callable[[], None],
                 button: Callable[[str], None], about: dict[str, Any] | None = None) -> None:
        self.access, self.port = access, port
        self._viewers, self._button, self._about = viewers, button, about or {}
        self._pages: set[_Page] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._runner: web.AppRunner | None = None
        self._listener: asyncio.Server | None = None

    @property
    def pages(self) -> int:
        """Return how many pages are open."""
        return len(self._pages)

    @property
    def greets(self) -> bool:
        """Return whether a page waits for the history."""
        return not all(page.greeted for page in tuple(self._pages))

    def start(self) -> None:
        """
        Begin to serve; ``port`` is then the one in use.

        :raises OSError: naming the address that is not free, and the remedy.
        """
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._start(), self._loop).result(START_TIMEOUT)
        except OSError as error:
            self.stop()
            remedy = 'set port:=' + str(self.port + 1) if error.errno == errno.EADDRINUSE else (
                'host must be an address of this computer')
            reason = 'in use' if error.errno == errno.EADDRINUSE else error.strerror
            raise OSError(f'view: {self.access.host} port {self.port}: {reason}: '
                          f'{remedy}') from None

    def stop(self) -> None:
        """End all pages and the thread."""
        if self._thread.is_alive():
            with contextlib.suppress(Exception):
                asyncio.run_coroutine_threadsafe(
                    self._stop(), self._loop).result(2.0 * STOP_TIMEOUT)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(STOP_TIMEOUT)

    def send_state(self, state: dict[str, Any]) -> None:
        """Send a state to every page; it replaces a state that still waits."""
        text = _message('state', state)
        self._call(lambda page: setattr(page, 'state', text))

    def send_image(self, image: bytes) -> None:
        """Send a JPEG to every page; it replaces a JPEG that still waits."""
        self._call(lambda page: setattr(page, 'image', image))

    def send_history(self, history: dict[str, Any]) -> None:
        """Send the history to the pages that have none yet."""
        text = _message('history', history)

        def greet(page: _Page) -> None:
            if not page.greeted:
                page.greeted = True
                page.answers.append(text)
        self._call(greet)

    def send_answer(self, button: str, success: bool, text: str) -> None:
        """Send the answer to a button to every page, so that other people see it, too."""
        answer = _message('answer', {'button': button, 'success': success, 'text': text[:400]})
        self._call(lambda page: page.answers.append(answer))

    def _call(self, change: Callable[[_Page], None]) -> None:
        """Change what waits for every page, in the server's thread."""
        def change_all() -> None:
            for page in self._pages:
                change(page)
                page.waiting.set()
        if self._pages:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(change_all)

    # In the server's thread.

    async def _start(self) -> None:
        self._runner = web.AppRunner(
            self.application(), access_log=None, shutdown_timeout=STOP_TIMEOUT)
        await self._runner.setup()
        self._listener = await self._loop.create_server(
            self._accept, self.access.host, self.port, backlog=LISTEN_BACKLOG)
        self.port = self._listener.sockets[0].getsockname()[1]

    def _accept(self) -> asyncio.BaseProtocol:
        """Return the protocol of a new connection."""
        assert self._runner is not None and self._runner.server is not None
        connection = self._runner.server()
        self._loop.call_later(0.0, self._end_surplus)  # when it is one of the connections
        self._loop.call_later(CONNECTION_TIME, self._end_unless_page, connection)
        return connection

    def _end_surplus(self) -> None:
        """End the oldest connections that are no open page, if there are too many."""
        server = self._runner and self._runner.server  # None once it has stopped
        every = server.connections if server else []
        others = [each for each in every if not self._is_page(each)]
        for oldest in others[:max(len(every) - CONNECTIONS_MAX, 0)]:
            _end(oldest)

    def _is_page(self, connection: asyncio.BaseProtocol) -> bool:
        return any(page.connection is connection for page in self._pages)

    def _end_unless_page(self, connection: asyncio.BaseProtocol) -> None:
        if not self._is_page(connection):
            _end(connection)

    async def _stop(self) -> None:
        if self._listener is not None:
            self._listener.close()
        if self._runner is not None:
            await self._runner.cleanup()

    def application(self) -> web.Application:
        """Return the application, which is this server without its address."""
        application = web.Application(middlewares=[self._check_access])
        for path in FILES:
            application.router.add_get(path, self._serve_file)
        application.router.add_get('/ws', self._serve_page)
        application.on_response_prepare.append(_add_headers)
        application.on_shutdown.append(self._close_pages)
        return application

    @property
    def _cookie(self) -> str:
        return f'flock_follower_{self.port}'  # browsers do not tell ports apart

    def _read_token(self, request: web.Request) -> str:
        """
        Return the token from the query or from the cookie, else ''.

        A cookie from an earlier run of the server is ignored.
        """
        given = request.query.get('token', '')
        cookie = request.cookies.get(self._cookie, '')
        return given or (cookie if self.access.matches(cookie) else '')

    @web.middleware
    async def _check_access(self, request: web.Request, handler: Callable[
            [web.Request], Awaitable[web.StreamResponse]]) -> web.StreamResponse:
        """Refuse what the rules of access refuse; turn a token in the address into a cookie."""
        host, offered = request.headers.get(hdrs.HOST, ''), self._read_token(request)
        if request.path == '/ws':
            refused = self.access.refuse_socket(
                host, request.headers.get(hdrs.ORIGIN, ''), offered)
        else:
            refused = self.access.refuse_reader(host, offered)
        if refused:
            text = REFUSALS[refused].format(port=self.port)
            return web.Response(status=403, text=f'{refused}: {text}\n')
        if request.path == '/' and 'token' in request.query:
            response = web.Response(status=303, headers={hdrs.LOCATION: '/'})
            response.set_cookie(self._cookie, offered, httponly=True, samesite='Strict')
            return response
        return await handler(request)

    async def _serve_file(self, request: web.Request) -> web.StreamResponse:
        name, kind = FILES[request.path]
        return web.Response(body=(STATIC / name).read_bytes(), content_type=kind, charset='utf-8')

    async def _serve_page(self, request: web.Request) -> web.StreamResponse:
        if len(self._pages) >= PAGES_MAX:
            return web.Response(status=503, text=f'{PAGES_MAX} pages are open already\n')
        socket = web.WebSocketResponse(
            heartbeat=HEARTBEAT, max_msg_size=LONGEST_REQUEST, compress=False)
        page = _Page(self._read_token(request), socket, request.protocol)
        page.answers.append(_message('about', {
            **self._about, 'control': self.access.refuse_button(page.token)}))
        self._pages.add(page)
        sender: asyncio.Task[None] | None = None
        try:
            await socket.prepare(request)
            page.waiting.set()
            sender = asyncio.ensure_future(self._send(page))
            self._viewers()
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    self._press(page, message.data)
        finally:
            self._pages.discard(page)
            self._loop.call_later(CONNECTION_TIME, self._end_unless_page, page.connection)
            if sender is not None:
                sender.cancel()
            self._viewers()
        return socket

    async def _send(self, page: _Page) -> None:
        """Send what waits, the newest of each kind, as fast as the page takes it."""
        socket = page.socket
        with contextlib.suppress(ConnectionError, RuntimeError):
            while not socket.closed:
                await page.waiting.wait()
                page.waiting.clear()
                while page.answers:
                    await socket.send_str(page.answers.popleft())
                state, page.state = page.state, None
                if state is not None and page.greeted:
                    await socket.send_str(state)
                image, page.image = page.image, None
                if image is not None:
                    await socket.send_bytes(image)

    def _press(self, page: _Page, text: str) -> None:
        """Pass on a button; whatever else a page sends is ignored."""
        try:
            button = json.loads(text)['button']
        except (ValueError, KeyError, TypeError, RecursionError):
            return
        if button not in BUTTONS:
            return
        if refused := self.access.refuse_button(page.token):
            page.answers.append(_message('answer', {
                'button': button, 'success': False, 'code': refused, 'text': REFUSALS[refused]}))
            page.waiting.set()
        else:
            self._button(button)

    async def _close_pages(self, _: web.Application) -> None:
        for page in tuple(self._pages):
            await page.socket.close(code=WSCloseCode.GOING_AWAY)


async def _add_headers(_: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(HEADERS)


def _end(connection: Any) -> None:
    """End a connection at once: unread data would keep it open."""
    if connection.transport is not None:  # else it has ended
        connection.transport.abort()


def _message(kind: str, value: dict[str, Any]) -> str:
    return json.dumps({kind: value}, allow_nan=False, separators=(',', ':'))
