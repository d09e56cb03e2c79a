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

"""Checks of the computer, and of what our nodes and the autopilot report on ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from flock_follower.checks.findings import (
    ERROR,
    Finding,
    first,
    grade,
    OK,
    UNMEASURED,
    WARNING,
)
from flock_follower.checks.observations import Machine, Observations
from flock_follower.checks.processor import BUSY_SHARE
from flock_follower.messages.bridge_diagnostics import (
    ARMED,
    LINK_FAULT,
    MISSING,
    NO_ANSWERS,
    NOT_READY,
    PARAMETER,
    read_flag,
    REFUSED,
    UNANSWERED,
    UNPROVEN,
    UNREAD,
)
from flock_follower.messages.topic_names import full_name, OURS
from flock_follower.system.fast_dds import PROFILE_VARIABLES, UNDELIVERED

STARVED_SHARE = 0.5  # share of the load (processor.py) from which on nothing may fly
#: MB free in /dev/shm.
MIN_SHARED_MEMORY = 32.0
#: Segments of killed processes from which on there is a warning: 180 raised the latency of the
#: demonstration from image to setpoint, 95 %, from 90 ms to 239 ms.
DEAD_SEGMENTS = 20
#: The action for a status of a node, by a part of its text.
ADVICE: Final[Mapping[str, str]] = {
    'cannot keep up': 'fly behind a slower leader, or raise v_max',
    'not aligned': 'let the autopilot fuse this odometry (forward_odometry:=true)',
    'cannot send on': 'do as it says',
    'no autopilot': 'check cable, connection and baud rate; is the autopilot on?',
    'autopilot lost': 'check cable and power of the autopilot',
    'no publisher': 'start its publisher, or connect its name (above)',
    UNDELIVERED: 'run publisher and nodes as one user with one /dev/shm; restart the nodes whose '
                 'shared memory was removed (docs/deploy.md)',
    'only one may': 'end all but one, or remap them',
    'none sending': 'look at the log of its publisher',
    'not in sight': 'hold the leader before the camera',
    'QoS mismatch': 'change the QoS of the publisher',
    'another clock': 'set use_sim_time alike everywhere',
    'use_sim_time': 'set use_sim_time alike everywhere',
    'velocity of odom': 'set odom_twist_frame:=auto',
    'internal error': 'a mistake in this package: report it, with the log',
    'no image processed': 'see images, calibration and odometry above'}


def check_machine(seen: Observations) -> Iterator[Finding]:
    """Check the computer."""
    machine = seen.machine
    load, wanted = machine.load, f'at most {BUSY_SHARE:.0%}, never {STARVED_SHARE:.0%}'
    if load is not None:
        yield grade(load.share > STARVED_SHARE, load.busy, 'processor', str(load), wanted,
                    'end programs that are not needed (rviz, recordings), or reduce the load of '
                    'the odometry')
    elif seen.live:
        yield Finding(UNMEASURED, 'processor', 'our nodes do not run on this computer, or its '
                      'kernel does not count for how long they wait', wanted)
    if machine.segment:
        yield _shared_memory(machine, max((p.bytes for p in seen.pictures), default=0))


def _shared_memory(machine: Machine, image: int) -> Finding:
    """
    Check free space in /dev/shm, segments of killed processes, and the room for an image.

    :param image: size of the largest image, bytes.
    """
    free = machine.shared_memory_free
    return first(
        'shared memory',
        f'{MIN_SHARED_MEMORY:.0f} MB, images that fit into {machine.segment // 1024} kB',
        (free is not None and free < MIN_SHARED_MEMORY, ERROR,
         f'{free or 0.0:.0f} MB free in /dev/shm',
         'delete /dev/shm/fastrtps_* and fastdds_* of processes that are gone; in a container, '
         '--shm-size'),
        (machine.dead_segments >= DEAD_SEGMENTS, WARNING,
         f'{machine.dead_segments} segments of processes that were killed slow every node',
         'fastdds shm clean'),
        (image > machine.segment, WARNING,
         f'images of {image / 1024:.0f} kB, of which some may be lost',
         ' and '.join(f'{name}=.../config/dds/fastdds.xml' for name in PROFILE_VARIABLES)
         + ' for every node'),
        (free is None, UNMEASURED, 'the space in /dev/shm is unknown', ''),
        (not image, UNMEASURED, 'no image was seen', ''),
        (True, OK, f'images of {image / 1024:.0f} kB', ''))


def check_diagnostics(seen: Observations) -> Iterator[Finding]:
    """Report the status of our nodes and of the autopilot."""
    for node in OURS:
        status = seen.status(node)
        if status is None:
            if full_name(node, seen.namespace) in seen.nodes:
                yield Finding(UNMEASURED, f'{node} status', 'nothing received on /diagnostics',
                              'running')
            continue
        advice = next((advice for words, advice in ADVICE.items() if words in status.message),
                      "see the node's log")
        found = [grade(status.level > 1, status.level == 1, f'{node} status', status.message,
                       'running', advice)]
        if node == 'mavlink_bridge':
            found += _autopilot(status.values)
        # Faults at the time of a recording do not prevent its use.
        yield from (finding if seen.live or finding.level != ERROR else
                    finding._replace(level=WARNING) for finding in found)


def _autopilot(values: dict[str, str]) -> Iterator[Finding]:
    """Report the state of the autopilot, by the values of the bridge's diagnostics."""
    link, silent = values.get('link', 'not reported'), values.get(NO_ANSWERS)
    fault = values.get(LINK_FAULT, '')
    vehicle = ', '.join(values.get(key) or f'no {key}' for key in ('autopilot', 'mode'))
    yield first(
        'autopilot', 'received, and answers',
        (silent, ERROR, f'{vehicle}: {silent}', fault or 'check the transmit wire and its level, '
         'connection and target_system; set the port of the autopilot to MAVLink both ways'),
        (link != 'alive', ERROR, f'not received ({link})', fault or 'check cable, connection and '
         'baud rate; is the autopilot on, is its MAVLink port set up?'),
        (silent is None, UNMEASURED, f'{vehicle}: whether it answers is not reported', ''),
        (fault, WARNING, vehicle, fault), (True, OK, vehicle, ''))
    if silent or link != 'alive':
        return
    unknown = values.get(UNANSWERED, 'not reported')
    yield first('answers', 'every question is answered',
                (unknown, UNMEASURED, f'none about {unknown}', ''), (True, OK, 'all', ''))
    for key in values:
        if key.startswith(PARAMETER):
            yield Finding(WARNING, 'autopilot parameter',
                          f'{key.removeprefix(PARAMETER)} {values[key]}', 'as config/ recommends',
                          'set it in the ground station, or accept it')
        elif key.startswith(MISSING):
            yield Finding(WARNING, 'autopilot parameter',
                          f'{key.removeprefix(MISSING)} {values[key]}', 'as config/ recommends',
                          'cannot be set: look up in the release notes of this firmware what '
                          'replaces it')
    if UNPROVEN in values:
        yield Finding(WARNING, 'autopilot firmware', values[UNPROVEN], 'known',
                      'compare its parameters with the recommended values by hand')
    unread = values.get(UNREAD, '')
    if unread or 'parameters' not in values:
        yield Finding(UNMEASURED, 'autopilot parameters', f'no answer about {unread}' if unread
                      else 'not compared yet: check again in some seconds',
                      'as config/ recommends')
    wanted = 'no obstacle'
    for what, key, advice in (
            ('ready to arm', NOT_READY, 'fix the reported causes, then check again'),
            ('ready for offboard', REFUSED, 'fix the reported cause: the bridge would refuse '
             'offboard')):
        if key in values:
            yield grade(bool(values[key]), False, what, f'no: {values[key]}' if values[key] else
                        wanted, wanted, advice)
        elif key == REFUSED or not read_flag(values, ARMED):
            yield Finding(UNMEASURED, what, 'not reported yet', wanted)
