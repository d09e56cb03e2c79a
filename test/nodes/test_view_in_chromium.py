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

"""The live page in a headless Chromium, over a real view node that is fed by messages."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from browser import Browser, CHROMIUM, MISSING
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import DEADLINE, to_odometry
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Range
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from flock_follower.geometry import IDENTITY_QUATERNION
from flock_follower.nodes.support.conversions import nanoseconds_to_stamp

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STILL = (0.0, 0.0, 0.0)
EVIL = '<img src=x onerror="document.title=1">'
SOCKET = """new Promise((done) => {{
    const socket = new WebSocket('{}');
    socket.onopen = () => done('open');
    socket.onerror = () => done('refused'); }})"""


class Flight(Node):
    """Publishes what the nodes of a flight publish, at 10 Hz, and serves what buttons call."""

    def __init__(self) -> None:
        super().__init__('flight')
        self.state, self.reason, self.planner_lives, self.bridge_lives = 'TRACK', '', True, True
        self.called: list[Any] = []
        self.turns = 0
        self._publishers_of = {topic: self.create_publisher(kind, topic, qos)
                               for topic, kind, qos in (
            ('planner/state', String, LATCHED), ('mavlink_bridge/state', String, LATCHED),
            ('planner/distance', Range, 10), ('/diagnostics', DiagnosticArray, 10),
            ('odom', Odometry, 10), ('neighbors', Odometry, 10), ('image_raw', Image, 2),
            ('camera_info', CameraInfo, 2))}
        self.create_service(SetBool, 'planner/engage', self._engage)
        self.create_service(Trigger, 'mavlink_bridge/land', self._land)
        self.create_timer(0.1, self.turn)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def _engage(self, request: Any, response: Any) -> Any:
        self.called.append(request.data)
        response.success, response.message = True, f'disengaged {EVIL}'
        return response

    def _land(self, _: Any, response: Any) -> Any:
        self.called.append('land')
        response.success, response.message = False, 'land: refused'
        return response

    def send(self, topic: str, message: Any) -> None:
        self._publishers_of[topic].publish(message)

    def report(self, node: str, message: str = 'running', **values: str) -> None:
        level = DiagnosticStatus.OK if message == 'running' else DiagnosticStatus.WARN
        self.send('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(
            name=node, message=message, level=level,
            values=[KeyValue(key=key, value=value) for key, value in values.items()])]))

    def turn(self) -> None:
        self.turns += 1
        stamp = nanoseconds_to_stamp(self.get_clock().now().nanoseconds)
        for topic, child, place in (('odom', 'base_link', (0.0, 0.0, 1.5)),
                                    ('neighbors', 'leader', (2.1, 0.0, 1.5))):
            self.send(topic, to_odometry(stamp, 'odom', child, place, IDENTITY_QUATERNION, STILL,
                                         STILL, 0.01 * np.eye(6), 0.01 * np.eye(6)))
        image = Image(width=64, height=48, step=64, encoding='mono8',
                      data=bytes([self.turns % 256]) * (64 * 48))
        info = CameraInfo(width=64, height=48, distortion_model='plumb_bob', d=[0.0] * 5,
                          k=[40.0, 0.0, 32.0, 0.0, 40.0, 24.0, 0.0, 0.0, 1.0])
        distance = Range(range=2.0)
        for message in (image, info, distance):
            message.header.stamp = stamp
        distance.header.frame_id = 'leader'
        self.send('camera_info', info)
        self.send('image_raw', image)
        if self.planner_lives:
            self.send('planner/state', String(data=self.state))
            self.send('planner/distance', distance)
            self.report('planner', state=self.state, reason=self.reason, edges='leader',
                        nearest_m='1.0', farthest_m='2.83', engaged='True')
        if self.bridge_lives:
            self.send('mavlink_bridge/state', String(data='ACTIVE'))
        self.report('mavlink_bridge', f'autopilot: {EVIL}', mode=EVIL)


class ViewProcess:
    """The node in a process of its own. :param port: 0: any that is free."""

    def __init__(self, port: int = 0, control: bool = True) -> None:
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'flock_follower.nodes.view', '--ros-args', '-p',
             f'port:={port}', '-p', f'control:={str(control).lower()}'],
            stdout=subprocess.PIPE, text=True, env={**os.environ, 'PYTHONUNBUFFERED': '1'})
        assert self.process.stdout is not None
        found = re.fullmatch(r'view: (http://127.0.0.1:(\d+)(?:/\?token=\S+)?)\n',
                             self.process.stdout.readline())
        assert found
        self.url, self.port = found[1], int(found[2])

    def end(self, number: signal.Signals = signal.SIGINT) -> int:
        """End it by a signal; return the exit code."""
        self.process.send_signal(number)
        return self.process.wait(DEADLINE)


@pytest.fixture(scope='module')
def flight(ros: None) -> Iterator[Flight]:
    made = Flight()
    yield made
    made._executor.shutdown()
    made.destroy_node()


@pytest.fixture(scope='module')
def view(flight: Flight) -> Iterator[ViewProcess]:
    made = ViewProcess()
    yield made
    made.end()


@pytest.fixture(scope='module')
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    made = Browser(tmp_path_factory.mktemp('chromium'))
    made.show(1400, 900)
    yield made
    made.close()


@pytest.fixture
def page(browser: Browser, view: ViewProcess) -> Browser:
    """Return the browser with the page open, alive, and with its buttons."""
    browser.open(view.url)
    browser.wait(ALIVE)
    return browser


ALIVE = '!document.body.classList.contains("dead")'
DEAD = 'document.body.classList.contains("dead")'


def says(name: str, text: str) -> str:
    """Return an expression: whether an element has a text."""
    return f'document.getElementById("{name}").textContent.startsWith({text!r})'


def color(page: Browser) -> str:
    """Return how the state is painted."""
    return str(page.value('(() => { const style = getComputedStyle(document.getElementById('
                          '"state-card")); return style.backgroundColor + '
                          'style.backgroundImage; })()'))


def test_states_bridge_and_planner_are_shown_each_in_its_color(
        page: Browser, flight: Flight) -> None:
    colors = set()
    for state in ('IDLE', 'SEARCH', 'TRACK', 'COAST', 'HOLD', 'RELATIVE'):
        flight.state, flight.reason = state, f'why {state}'
        page.wait(says('state', state))
        page.wait(says('reason', f'why {state}'))
        colors.add(color(page))
    flight.planner_lives = False
    page.wait(says('state', 'PLANNER LOST'))
    page.wait('document.getElementById("distance").classList.contains("stale")')
    colors.add(color(page))
    assert len(colors) == 7
    flight.planner_lives, flight.bridge_lives = True, False
    page.wait(says('state', 'RELATIVE'))
    page.wait(says('bridge', 'BRIDGE LOST'))
    flight.bridge_lives = True
    page.wait(says('bridge', 'ACTIVE'))
    assert not page.value('document.getElementById("distance").classList.contains("stale")')


def test_image_chart_and_top_view_move(page: Browser) -> None:
    page.wait('document.getElementById("image").naturalWidth === 64')
    first = page.value('document.getElementById("image").src')
    page.wait(f'document.getElementById("image").src !== {first!r}')
    pixels = """(() => {{ const canvas = document.querySelector("{}");
        return canvas && canvas.width ? canvas.toDataURL() : ''; }})()"""
    for canvas in ('#top', '#chart canvas'):
        page.wait(f'{pixels.format(canvas)}.length > 2000')
    before = page.value(pixels.format('#chart canvas'))
    page.wait(f'{pixels.format("#chart canvas")} !== {before!r}')
    page.wait(says('distance', '2.00'))


def test_texts_from_the_wire_stay_text(page: Browser) -> None:
    page.wait('document.getElementById("warnings").textContent.includes("<img src=x onerror")')
    page.wait(f'document.getElementById("vehicle").textContent.includes({EVIL!r})')
    assert page.value('document.querySelectorAll("img").length') == 1
    assert page.value('document.title') == 'follower · flock_follower'


@pytest.mark.parametrize('dark', [False, True])
def test_nothing_is_wider_than_the_window(page: Browser, dark: bool) -> None:
    for width in (420, 800, 1400):
        page.show(width, 900, dark)
        assert page.value('document.documentElement.scrollWidth') <= width
        # The plot takes the new width with the next event of the browser.
        page.wait("""![...document.querySelectorAll('.card *')].some((element) => {
            const box = element.getBoundingClientRect();
            return box.width && box.right > innerWidth + 1; })""")
    assert page.value('document.documentElement.hasAttribute("data-dark")') is dark


def test_brake_acts_at_once_and_land_after_a_second(page: Browser, flight: Flight) -> None:
    page.show(1400, 900)
    flight.called.clear()
    page.click('brake')
    page.wait(says('answer', f'Brake: disengaged {EVIL}'))
    assert flight.called == [False]
    page.click('land')
    time.sleep(1.2)  # a press that is too short does nothing, however long one waits
    assert flight.called == [False]
    page.mouse('mousePressed', 'land')
    page.wait(says('answer', 'Land: land: refused'))
    page.mouse('mouseReleased', 'land')
    assert flight.called == [False, 'land']


def test_a_wrong_token_and_another_origin_are_refused(
        browser: Browser, view: ViewProcess, flight: Flight) -> None:
    address = f'127.0.0.1:{view.port}'
    browser.open(f'http://{address}/?token=wrong')
    assert browser.value('document.body.innerText').startswith('token: ')
    browser.call('Network.clearBrowserCookies')
    browser.open(f'http://{address}/')
    browser.wait(ALIVE)
    flight.called.clear()
    assert browser.value('document.getElementById("brake").disabled')
    browser.value("document.getElementById('brake').disabled = false")
    browser.click('brake')
    browser.wait(says('answer', 'Brake: The token is missing'))
    assert flight.called == []
    assert browser.value(SOCKET.format(f'ws://{address}/ws')) == 'open'
    browser.open('data:text/html,other')
    assert browser.value(SOCKET.format(f'ws://{address}/ws')) == 'refused'


def test_page_is_stale_when_node_is_killed_alive_when_back(
        browser: Browser, flight: Flight, tmp_path: Path) -> None:
    view = ViewProcess(control=False)
    browser.open(view.url)
    browser.wait(ALIVE)
    assert browser.value('document.getElementById("controls").hidden')
    view.end(signal.SIGKILL)
    browser.wait(DEAD)
    assert 'Everything below is old' in browser.text('banner')
    again = ViewProcess(view.port, control=False)
    browser.wait(ALIVE)
    assert again.end() == 0
