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
The newest messages of a flight with their ages, and the page that shows them.

Times are s on a monotonic clock. If a source is silent for longer than its limit, its last value
is shown as stale, because a latched state remains after its node has ended.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
import math
from typing import Any, Final, NamedTuple

import numpy as np

from flock_follower.geometry import quaternion_to_matrix, Transform
from flock_follower.messages import OdometryState
from flock_follower.messages.bridge_reading import BridgeState, effective_state, parse, SILENCE_MAX
from flock_follower.messages.commands import Command
from flock_follower.odometry.choice import OdometryChoice
from flock_follower.view.scene import (
    band,
    draw,
    ELLIPSOID,
    FORGOTTEN_AFTER,
    Shape,
    TEXT,
    UNSEEN_AFTER,
)

#: s of silence after which a source is stale, by its name on the page.
LIMITS: Final[Mapping[str, float]] = {
    'image': 1.0, 'odometry': 0.5, 'estimate': 0.5, 'distance': 0.5, 'command': 0.5,
    'relative_pose': 2.5, 'planner': 2.5, 'mavlink_bridge': 2.5, 'bridge state': SILENCE_MAX,
    'battery': 10.0}
#: Sources whose silence is no fault by itself: nothing is commanded or seen before a flight.
SPORADIC: Final = ('image', 'estimate', 'distance', 'command', 'battery')
NODES: Final = ('relative_pose', 'planner', 'mavlink_bridge')
#: Rates on the page: the title, the node that measures it, its key on /diagnostics.
RATES: Final = (('images', 'relative_pose', 'image_raw_hz'),
                ('images', 'relative_pose', 'image_raw/compressed_hz'),
                ('odometry', 'relative_pose', 'odom_hz'),
                ('planner', 'planner', 'tick_hz'), ('commands', 'planner', 'command_hz'),
                ('setpoints', 'mavlink_bridge', 'stream_hz'),
                ('estimate, p95 ms', 'relative_pose', 'latency_p95_ms'),
                ('command, p95 ms', 'mavlink_bridge', 'latency_p95_ms'))
HISTORY_LENGTH = 60.0  # s of distance and tracks
TRACK_PERIOD = 0.2  # s between two points of a track
NEIGHBORS_MAX = 16  # more names than a flock has come from a fault
ESTIMATES = 16  # of each neighbor kept: half a second of images
LONGEST_TEXT = 400  # characters
WARNINGS_MAX = 20  # on a page
LEVELS: Final = ('ok', 'warn', 'error', 'error')  # of diagnostic_msgs; the last is STALE
LOST, NEVER = 'PLANNER LOST', 'NO PLANNER'
OUTLINE: Final = 24  # points of an ellipse


class NodeReport(NamedTuple):
    """The newest diagnostics of a node."""

    time: float
    level: int
    message: str
    values: Mapping[str, str]


class ShownBattery(NamedTuple):
    """Share of the charge, and V; NaN if unknown."""

    time: float
    share: float
    voltage: float


class ShownFlight:
    """Takes messages, and returns pages; only one thread may use it."""

    def __init__(self) -> None:
        self.own: OdometryState | None = None
        self.command: Command | None = None
        self._choice = OdometryChoice()
        self._times: dict[str, float] = {}
        self._neighbors: dict[str, deque[tuple[OdometryState, float]]] = {}
        self._state = ''
        self._bridge: BridgeState | None = None
        self._reports: dict[str, NodeReport] = {}
        self._battery = ShownBattery(-math.inf, math.nan, math.nan)
        self._distance: tuple[str, float] = '', math.nan
        self._distances: deque[tuple[float, float]] = deque()
        self._tracks: dict[str, deque[tuple[float, float, float]]] = {}

    # Messages.

    def note(self, source: str, now: float) -> None:
        """Record that a source, a key of ``LIMITS``, has sent a message."""
        self._times[source] = now

    def take_odometry(self, state: OdometryState, now: float) -> bool:
        """Take the ego state; return whether it is in the frame that is used."""
        if not self._choice.takes(state):
            return False
        if self.own is not None and self.own.frame != state.frame:
            self._tracks.clear()  # places in another frame
            self._neighbors.clear()
        self.own = state
        self.note('odometry', now)
        self._follow('', state, now)
        return True

    def take_neighbor(self, state: OdometryState, now: float, seen: bool = True) -> None:
        """Take the state of a neighbor, seen by the camera or received from others."""
        if seen:
            self.note('estimate', now)
        name = state.child
        if name not in self._neighbors and len(self._neighbors) >= NEIGHBORS_MAX:
            return
        self._neighbors.setdefault(name, deque(maxlen=ESTIMATES)).append((state, now))
        self._follow(name, state, now)

    def take_command(self, command: Command, now: float) -> None:
        """Take a command of the planner."""
        self.command = command
        self.note('command', now)

    def take_state(self, word: str) -> None:
        """Take the latched state of the planner; it does not show that the planner still runs."""
        self._state = word

    def take_bridge(self, text: str, now: float) -> None:
        """Take ``mavlink_bridge/state``."""
        self._bridge = parse(text)
        self.note('bridge state', now)

    def take_report(self, node: str, report: NodeReport) -> None:
        """Take the diagnostics of a node."""
        self._reports[node] = report
        if node in LIMITS:
            self.note(node, report.time)

    def take_battery(self, battery: ShownBattery) -> None:
        """Take the state of the battery."""
        self._battery = battery
        self.note('battery', battery.time)

    def take_distance(self, name: str, distance: float, now: float) -> None:
        """Take the distance to the neighbor that the planner faces, m, sent at ``now``."""
        if not math.isfinite(distance):
            return
        self._distance = name, distance
        self.note('distance', now)
        self._distances.append((now, distance))
        while now - self._distances[0][0] > HISTORY_LENGTH:
            self._distances.popleft()

    def _follow(self, name: str, state: OdometryState, now: float) -> None:
        track = self._tracks.setdefault(name, deque())
        if not track or now - track[-1][0] >= TRACK_PERIOD:
            track.append((now, *state.position[:2].tolist()))
            while now - track[0][0] > HISTORY_LENGTH:
                track.popleft()

    # What a page shows.

    def age(self, source: str, now: float) -> float:
        """Return for how long a source has been silent, s; infinity before its first message."""
        return now - self._times.get(source, -math.inf)

    def stale(self, source: str, now: float) -> bool:
        """Return whether a source is silent."""
        return not self.age(source, now) <= LIMITS[source]

    def planner_values(self, now: float) -> Mapping[str, str]:
        """Return the planner's values on /diagnostics; empty if the planner is silent."""
        return {} if self.stale('planner', now) else self._reports['planner'].values

    def planner_state(self, now: float) -> tuple[str, str]:
        """Return the state of the planner, or ``LOST`` or ``NEVER``, and the reason."""
        age = self.age('planner', now)
        if math.isinf(age):
            return NEVER, 'no diagnostics of the planner received: is it started?'
        if self.stale('planner', now):
            return LOST, f'silent for {age:.1f} s; its last state was {self._state or "unknown"}'
        values = self.planner_values(now)
        state = self._state or values.get('state', '')
        return state, values.get('reason', '') if values.get('state') == state else ''

    def neighbors(self, now: float) -> list[tuple[OdometryState, float]]:
        """Return the newest state of each neighbor with its age, s."""
        return [(states[-1][0], now - states[-1][1]) for states in self._neighbors.values()
                if now - states[-1][1] <= FORGOTTEN_AFTER]

    def neighbors_at(self, stamp: int) -> list[tuple[OdometryState, float]]:
        """
        Return the neighbors as they were estimated at the stamp of an image, ns.

        An estimate of another image is extrapolated with its velocity; the age is the time between
        both.
        """
        found = []
        for states in self._neighbors.values():
            state = min((s for s, _ in states), key=lambda s: abs(s.stamp - stamp))
            ahead = (stamp - state.stamp) * 1e-9
            if abs(ahead) <= UNSEEN_AFTER:
                state = state._replace(position=state.position + ahead * state.velocity)
            if abs(ahead) <= FORGOTTEN_AFTER:
                found.append((state, max(0.0, ahead)))
        return found

    def scene(self, now: float) -> list[Shape]:
        """Return the shapes of the newest states."""
        command = None if self.command is None else (self.command, self.age('command', now))
        own = None if self.age('odometry', now) > FORGOTTEN_AFTER else self.own
        state, reason = self.planner_state(now)
        return draw(own, self.neighbors(now), command, {
            **self.planner_values(now), 'state': state, 'reason': reason})

    def picture_scene(self, stamp: int) -> list[Shape]:
        """Return the shapes to draw into the image of a stamp, ns."""
        return draw(None, self.neighbors_at(stamp), None, {})

    def page(self, now: float) -> dict[str, Any]:
        """Return the content of the page; unknown numbers are None."""
        self._forget(now)
        planner, bridge = self.planner_values(now), self._reports.get('mavlink_bridge')
        state, reason = self.planner_state(now)
        bridge_values = {} if bridge is None or self.stale('mavlink_bridge', now) else (
            bridge.values)
        permission = effective_state(self._bridge, self.age('bridge state', now))
        return clean({
            't': now, 'state': state, 'reason': reason,
            'engaged': planner.get('engaged', ''), 'limits': planner.get('limits', ''),
            'limited_by': bridge_values.get('limited_by', ''),
            'setpoint': bridge_values.get('setpoint', ''),
            'distance': {'name': self._distance[0], 'm': self._distance[1],
                         'age': self.age('distance', now), 'stale': self.stale('distance', now)},
            'band': band(planner),
            'bridge': {'state': permission.name, 'reason': permission.reason,
                       'lost': self.stale('bridge state', now),
                       **{key: bridge_values.get(key, '') for key in (
                           'autopilot', 'firmware', 'mode', 'armed', 'flying', 'height_m')}},
            'battery': {'share': self._battery.share, 'voltage': self._battery.voltage,
                        'stale': self.stale('battery', now)},
            'rates': self._rates(now), 'warnings': self._warnings(now),
            'ages': [[source, self.age(source, now), self.stale(source, now),
                      source in SPORADIC] for source in LIMITS],
            'own': self._place('', now),
            'neighbors': {state.child: self._place(state.child, now)
                          for state, _ in self.neighbors(now)},
            'scene': [from_above(shape) for shape in self.scene(now)]})

    def history(self, now: float) -> dict[str, Any]:
        """Return the distances and tracks of the last ``HISTORY_LENGTH`` s."""
        self._forget(now)
        return clean({'t': now, 'distances': list(self._distances),
                      'tracks': {name: list(track) for name, track in self._tracks.items()}})

    def _forget(self, now: float) -> None:
        """Forget neighbors and tracks that are too old to be shown."""
        for name, states in list(self._neighbors.items()):
            if now - states[-1][1] > HISTORY_LENGTH:
                del self._neighbors[name]
                self._tracks.pop(name, None)
        for track in self._tracks.values():
            while track and now - track[0][0] > HISTORY_LENGTH:
                track.popleft()
        while self._distances and now - self._distances[0][0] > HISTORY_LENGTH:
            self._distances.popleft()

    def _place(self, name: str, now: float) -> list[float] | None:
        """Return (2,), m, if it is fresh."""
        state, age = (self.own, self.age('odometry', now)) if not name else (
            self._neighbors[name][-1][0], now - self._neighbors[name][-1][1])
        return None if state is None or age > LIMITS['odometry'] else state.position[:2].tolist()

    def _rates(self, now: float) -> list[tuple[str, str, bool]]:
        """Return title, value and staleness of each rate that its node has measured."""
        return [(title, self._reports[node].values[key], self.stale(node, now))
                for title, node, key in RATES
                if node in self._reports and key in self._reports[node].values
                and (title != 'images' or self._reports[node].values[key] != '0.00')]

    def _warnings(self, now: float) -> list[dict[str, Any]]:
        """Return the problems that nodes report, the worst first; a silent node is one."""
        found = []
        for node, report in self._reports.items():
            if node in NODES and self.stale(node, now):
                found.append({'level': 'error', 'node': node, 'text': (
                    f'silent for {now - report.time:.0f} s: it has ended, or is blocked; '
                    'its last values are old')})
            elif report.level and now - report.time <= LIMITS['planner']:
                found.append({'level': LEVELS[min(report.level, 3)], 'node': node,
                              'text': report.message})
        found.sort(key=lambda one: (one['level'] != 'error', one['node']))
        return found[:WARNINGS_MAX]


def from_above(shape: Shape) -> dict[str, Any]:
    """Return a shape from above: name, kind, paint, points (n, 2), m, yaw, width, text."""
    center = np.asarray(shape.position, float)
    rotation = quaternion_to_matrix(shape.quaternion)
    points = np.asarray(shape.points, float).reshape(-1, 3)[:, :2]
    if shape.kind == ELLIPSOID:
        points = center[:2] + shadow(rotation, shape.size)
    elif not len(points):
        points = center[None, :2]
    seen: dict[str, Any] = {'n': shape.name, 'k': shape.kind, 'c': shape.paint,
                            'p': [[round(x, 3), round(y, 3)] for x, y in points.tolist()]}
    if shape.kind == TEXT:
        seen['t'] = shape.text
    elif shape.kind != ELLIPSOID:
        seen['a'] = round(math.atan2(rotation[1, 0], rotation[0, 0]), 3)
        seen['w'] = shape.size[0]
    return seen


def shadow(rotation: Any, size: Iterable[float]) -> Any:
    """Return the outline (n, 2), m, of an ellipsoid's shadow on the ground, about its center."""
    half = rotation * (0.5 * np.array([*size]))
    values, axes = np.linalg.eigh((half @ half.T)[:2, :2])
    angle = np.linspace(0.0, math.tau, OUTLINE + 1)[:, None]
    circle = np.hstack([np.cos(angle), np.sin(angle)])
    return circle * np.sqrt(np.maximum(values, 0.0)) @ axes.T


def pose(state: Any) -> Transform:
    """Return ``T_odom_body`` of a state or sample with position and quaternion."""
    return Transform.from_quaternion(state.position, state.quaternion)


def clean(value: Any) -> Any:
    """Return a value for JSON: with finite numbers only, and with shortened texts."""
    if isinstance(value, dict):
        return {str(key)[:LONGEST_TEXT]: clean(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [clean(item) for item in value]
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    return value[:LONGEST_TEXT] if isinstance(value, str) else value
