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

"""What our nodes and the autopilot say of themselves, repeated in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flock_follower.checks.findings import (
    ERROR,
    error,
    Finding,
    ok,
    unmeasured,
    WARNING,
    warning,
)
from flock_follower.checks.observations import Observations, OURS, Told
from flock_follower.checks.topic_names import full_name

#: Keys of the bridge's diagnostics.
PARAMETER: Final = 'parameter '
NOT_READY: Final = 'not ready to arm'
REFUSED: Final = 'offboard would be refused'


def check_words(seen: Observations) -> Iterator[Finding]:
    """Yield what /diagnostics told."""
    for node in OURS:
        told = _told(seen, node)
        if told is None:
            if full_name(node, seen.namespace) in seen.nodes:
                yield unmeasured(f'{node} says', 'nothing received on /diagnostics', 'running')
            continue
        found = [_status(node, told)]
        if node == 'mavlink_bridge':
            found += _autopilot(told)
        # What was amiss when a bag was recorded does not keep anybody from using it.
        yield from (finding if seen.live or finding.level != ERROR else
                    finding._replace(level=WARNING) for finding in found)


def _told(seen: Observations, node: str) -> Told | None:
    full = '/'.join(filter(None, [seen.namespace.strip('/'), node]))
    return seen.told.get(full)


def _status(node: str, told: Told) -> Finding:
    what, wanted = f'{node} says', 'running'
    advice = _advice(told.message)
    if told.level == 0:
        return ok(what, told.message, wanted)
    return (error if told.level > 1 else warning)(what, told.message, wanted, advice)


def _advice(message: str) -> str:
    for part, advice in (
            ('cannot keep up', 'fly behind a slower leader, or raise v_max'),
            ('not aligned', 'let the autopilot fuse this odometry (forward_odometry:=true)'),
            ('no autopilot', 'check cable, connection and baud rate; is the autopilot on?'),
            ('autopilot lost', 'check cable and power of the autopilot'),
            ('no publisher', 'start what publishes it, or connect its name (above)'),
            ('none sending', 'look at the log of what publishes it'),
            ('not in sight', 'hold the leader before the camera'),
            ('QoS mismatch', 'change the QoS of the publisher'),
            ('another clock', 'set use_sim_time alike everywhere'),
            ('use_sim_time', 'set use_sim_time alike everywhere'),
            ('axes of odom', 'set odom_child_rpy, see odom up above and docs/sensors.md'),
            ('velocity of odom', 'set odom_twist_frame:=auto'),
            ('internal error', 'a mistake in this package: report it, with the log'),
            ('no image processed', 'see images, calibration and odometry above')):
        if part in message:
            return advice
    return "see the node's log"


def _autopilot(told: Told) -> Iterator[Finding]:
    values = told.values
    what = 'autopilot'
    if values.get('link') != 'alive':
        yield error(what, f'not received ({values.get("link", "not reported")})', 'received',
                    'check cable, connection and baud rate; is it on, is its MAVLink port set up?')
        return
    yield ok(what, f'{values.get("autopilot") or "heard"}, {values.get("mode") or "no mode"}, '
             f'{"armed" if values.get("armed") == "True" else "disarmed"}', 'received')
    differing = [(key.removeprefix(PARAMETER), value) for key, value in values.items()
                 if key.startswith(PARAMETER)]
    wanted = 'as config/ recommends'
    for name, value in differing:
        value, _, why = value.partition(': ')
        yield warning('autopilot parameter', f'{name} {value}', wanted,
                      f'set it in the ground station, or know why not. {why}'.strip())
    summary = values.get('parameters', '')
    if not summary:
        yield warning('autopilot parameters', 'not compared yet', wanted,
                      'wait some seconds and check again')
    elif not differing:
        yield ok('autopilot parameters', summary, wanted)
    yield from _readiness(values)


def _readiness(values: dict[str, str]) -> Iterator[Finding]:
    wanted = 'nothing speaks against it'
    against = values.get(NOT_READY, '')
    if against:
        yield error('ready to arm', f'no: {against}', wanted,
                    'these are its own words: settle them, then check again')
    elif NOT_READY in values:
        yield ok('ready to arm', 'nothing speaks against it', wanted)
    elif values.get('armed') != 'True':
        yield unmeasured('ready to arm', 'the autopilot has not reported it yet', wanted)
    if refused := values.get(REFUSED, ''):
        yield error('ready for offboard', f'no: {refused}', wanted,
                    'settle that: the bridge would refuse offboard')
    elif REFUSED in values:
        yield ok('ready for offboard', 'nothing speaks against it', wanted)
