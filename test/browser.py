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

"""A headless Chromium, driven by the DevTools protocol; aiohttp is all that it needs."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Coroutine
import json
from pathlib import Path
import shutil
import subprocess
import time
from typing import Any

import aiohttp

CHROMIUM = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome'))), None)
MISSING = 'needs Chromium: apt install chromium'
START_TIMEOUT = 60.0  # s: a busy machine takes its time
LARGEST = 64 * 1024 * 1024  # bytes of an answer: screenshots


class Browser:
    """One browser with one page. :param folder: an empty one, for its profile."""

    def __init__(self, folder: Path) -> None:
        assert CHROMIUM is not None
        self._loop = asyncio.new_event_loop()
        self._number = 0
        self.process = subprocess.Popen(
            [CHROMIUM, '--headless=new', '--no-sandbox', '--disable-gpu',
             '--disable-dev-shm-usage',
             '--no-first-run', '--disable-background-networking', '--remote-debugging-port=0',
             f'--user-data-dir={folder}', 'about:blank'],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        active = folder / 'DevToolsActivePort'
        end = time.monotonic() + START_TIMEOUT
        while not (active.exists() and active.read_text().count('\n')):
            assert time.monotonic() < end and self.process.poll() is None, 'it does not start'
            time.sleep(0.05)
        self._run(self._attach(int(active.read_text().split()[0])))

    def _run(self, task: Coroutine[Any, Any, Any]) -> Any:
        return self._loop.run_until_complete(task)

    async def _attach(self, port: int) -> None:
        self._session, end = aiohttp.ClientSession(), time.monotonic() + START_TIMEOUT
        while True:
            assert time.monotonic() < end, 'Chromium shows no page'
            async with self._session.get(f'http://127.0.0.1:{port}/json/list') as reply:
                pages = [one for one in json.loads(await reply.text()) if one['type'] == 'page']
            if pages:
                break
            await asyncio.sleep(0.05)
        self._socket = await self._session.ws_connect(
            pages[0]['webSocketDebuggerUrl'], max_msg_size=LARGEST, origin=None)

    async def _call(self, method: str, parameters: dict[str, Any]) -> Any:
        self._number += 1
        await self._socket.send_json(
            {'id': self._number, 'method': method, 'params': parameters})
        end = time.monotonic() + START_TIMEOUT
        while True:
            assert time.monotonic() < end, f'no answer to {method}'
            answer = await self._socket.receive_json(timeout=START_TIMEOUT)
            if answer.get('id') == self._number:
                assert 'error' not in answer, answer
                return answer['result']

    def call(self, method: str, **parameters: Any) -> Any:
        """Call a method of the DevTools protocol."""
        return self._run(self._call(method, parameters))

    def open(self, url: str) -> None:
        """Open a page, and wait until it is loaded."""
        self.call('Page.navigate', url=url)
        self.wait('document.readyState === "complete"')

    def value(self, script: str) -> Any:
        """Return the value of an expression on the page."""
        answer = self.call('Runtime.evaluate', expression=script, returnByValue=True,
                           awaitPromise=True)
        assert 'exceptionDetails' not in answer, answer['exceptionDetails']
        return answer['result'].get('value')

    def text(self, name: str) -> str:
        """Return the text of an element by its id."""
        return str(self.value(f'document.getElementById("{name}").textContent'))

    def wait(self, script: str, timeout: float = 30.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + timeout
        while not self.value(script):
            assert time.monotonic() < end, f'waited in vain for {script}'
            time.sleep(0.05)

    def show(self, width: int, height: int, dark: bool = False) -> None:
        """Set the size of the window, px, and the theme."""
        self.call('Emulation.setDeviceMetricsOverride', width=width, height=height,
                  deviceScaleFactor=1, mobile=width < 600)
        self.call('Emulation.setEmulatedMedia', features=[
            {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'}])

    def mouse(self, kind: str, name: str) -> None:
        """Press ('mousePressed') or release the mouse at the middle of an element by its id."""
        x, y = self.value(f"""(() => {{
            const element = document.getElementById('{name}');
            element.scrollIntoView({{block: 'center'}});
            const box = element.getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2]; }})()""")
        self.call('Input.dispatchMouseEvent', type=kind, x=x, y=y, button='left', clickCount=1)

    def click(self, name: str) -> None:
        """Click on an element by its id."""
        self.mouse('mousePressed', name)
        self.mouse('mouseReleased', name)

    def picture(self, path: Path, whole: bool = True) -> None:
        """Write a screenshot, a PNG."""
        answer = self.call('Page.captureScreenshot', captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(answer['data']))

    def close(self) -> None:
        """End the browser."""
        async def end() -> None:
            await self._socket.send_json({'id': 0, 'method': 'Browser.close'})
            await self._socket.close()
            await self._session.close()
        self._run(end())
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._loop.close()
