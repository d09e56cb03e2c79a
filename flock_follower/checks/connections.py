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

"""Connections: topics, their types and QoS, nodes, namespaces, parameter files."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Final

from flock_follower.checks.findings import (
    ERROR,
    error,
    Finding,
    first,
    judged,
    OK,
    ok,
    unmeasured,
    warning,
)
from flock_follower.checks.observations import Observations, OURS
from flock_follower.checks.topic_names import (
    COMPRESSED_IMAGES,
    elsewhere,
    full_name,
    INFO,
    offer,
    RAW_IMAGES,
    TYPES,
)

#: Only one node may publish these.
ONE_VOICE: Final = (RAW_IMAGES, COMPRESSED_IMAGES, 'camera_info', 'odom', 'command/trajectory',
                    'mavlink_bridge/state', 'neighbors')
START: Final = 'ros2 launch flock_follower follower.launch.py'


def check_connections(seen: Observations) -> Iterator[Finding]:
    """Check nodes and topics; of a bag, its content."""
    if seen.nothing_there:
        reach = f' within {seen.machine.reach}' if seen.machine.reach else ''
        yield error('ROS', f'no node is seen on domain {seen.machine.domain}{reach}',
                    'camera, odometry and our nodes',
                    'start them; set ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE alike here '
                    'and there')
        return
    if seen.live:
        yield from _nodes(seen)
    for name in (seen.image_name, 'camera_info', 'odom'):
        yield _needed(seen, name)
    for check in (_voices, _misfits, _wiring, _files, _network) if seen.live else (_recording,):
        yield from check(seen)


def _nodes(seen: Observations) -> Iterator[Finding]:
    wanted = 'each of our three, once'
    count = {name: seen.nodes.count(full_name(name, seen.namespace)) for name in OURS}
    missing = [name for name, number in count.items() if number == 0]
    twice = [name for name, number in count.items() if number > 1]
    elsewhere = [full for full in seen.nodes if _plain(full) in missing]
    if missing or not twice:
        namespace = elsewhere[0].rsplit('/', 1)[0].strip('/') if elsewhere else ''
        yield first(
            'nodes', wanted,
            (elsewhere, ERROR, f'{", ".join(missing)} not in /{seen.namespace.strip("/")}, but '
             f'{", ".join(elsewhere)}', f'check --namespace {namespace}; or start all in one '
             'namespace' if namespace else 'check without --namespace'),
            (missing, ERROR, f'not running: {", ".join(missing)}', f'start: {START}'),
            (True, OK, 'all three are running', ''))
    if twice:
        yield error('nodes', f'twice: {", ".join(twice)}', wanted,
                    'end one of each: both command the vehicle')


def _needed(seen: Observations, name: str) -> Finding:
    """Check that a topic is published, and that messages arrive."""
    topic, full, msgtype = seen.topic(name), seen.names[name], TYPES[name]
    published = {other: found.types[0] for other, found in seen.topics.items() if found.types}
    connect = offer(RAW_IMAGES if name == COMPRESSED_IMAGES else name, published, [
        other for ours, other in seen.names.items() if ours not in (name, RAW_IMAGES)])
    far = elsewhere(full, (n for n, t in published.items() if t == msgtype), seen.names.values())
    own = seen.names['mavlink/odom']
    advice = (connect or (f'{far[0]} is published: start all in one namespace' if far else '')
              or (f"start its source; or fly by the autopilot's own estimate: -r odom:={own}"
                  if name == 'odom' and own in published else ''))
    who = ', '.join(sorted({end.node for end in topic.publishers}))
    return first(
        _images(name), msgtype.replace('/msg/', '/'),
        (full in seen.unreadable, ERROR, f'{full} cannot be read: {seen.unreadable.get(full)}',
         'record it anew'),
        (not topic.publishers and seen.live, ERROR, f'nobody publishes {full}',
         advice or 'start its driver'),
        (not topic.publishers, ERROR, f'the bag lacks {full}',
         advice or 'record it; evaluate needs it'),
        (msgtype not in topic.types, ERROR, f'{full} holds {", ".join(topic.types)}',
         connect or f'have its source send {msgtype}'),
        (not topic.arrivals, ERROR, f'{who} publishes {full}, and sends nothing',
         "see the node's log; is the sensor connected and initialised?" if msgtype != INFO else
         'calibrate the camera; give its driver the file'),
        (True, OK, f'{full}, {len(topic.arrivals)} messages', ''))


def _images(name: str) -> str:
    return 'images' if name in (RAW_IMAGES, COMPRESSED_IMAGES) else name


def _plain(full: str) -> str:
    return full.rsplit('/', 1)[-1]


def _voices(seen: Observations) -> Iterator[Finding]:
    """Report topics with several publishers that may have only one, and strange commanders."""
    for name in ONE_VOICE:
        nodes = sorted(end.node for end in seen.topic(name).publishers)
        if len(nodes) > 1:
            yield error(name, f'{len(nodes)} publishers on {seen.names[name]}: '
                        f'{", ".join(nodes)}', 'one', 'end all but one, or remap them')
        elif nodes and name == 'command/trajectory' and _plain(nodes[0]) != 'planner':
            yield warning(name, f'{nodes[0]} commands', 'planner',
                          'end it, if it is not yours: the bridge flies its commands')


def _misfits(seen: Observations) -> Iterator[Finding]:
    """Report pairs of publisher and subscriber whose QoS does not match, if one is ours."""
    for name in TYPES:
        topic = seen.topic(name)
        for sender, taker in product(topic.publishers, topic.subscribers):
            why = ('best effort, and it wants reliable' if taker.reliable and not sender.reliable
                   else 'volatile, and it wants transient local (latched)'
                   if taker.latched and not sender.latched else '')
            if why and sender.type == taker.type and (
                    _plain(taker.node) in OURS or _plain(sender.node) in OURS):
                yield error(f'{name} QoS',
                            f'{taker.node} receives nothing: {sender.node} sends {why}',
                            'QoS that fit', f'change the QoS of {sender.node}, by its parameters '
                            'qos_overrides if it has them')


def _wiring(seen: Observations) -> Iterator[Finding]:
    """Report our running nodes that do not listen to the topics that they need."""
    for name, nodes in (('odom', OURS), (seen.image_name, ('relative_pose',)),
                        ('camera_info', ('relative_pose',))):
        topic, full = seen.topic(name), seen.names[name]
        listening = {end.node for end in topic.subscribers}
        deaf = [node for node in nodes if (at := full_name(node, seen.namespace)) in seen.nodes
                and at not in listening]
        if deaf and topic.publishers:
            yield error(f'{_images(name)} wiring',
                        f'{", ".join(deaf)} does not subscribe to {full}',
                        'each node subscribes to the topic',
                        f'start it with --ros-args -r {name}:={full}' if _images(name) == name else
                        'start relative_pose with image_transport:='
                        f'{"compressed" if name == COMPRESSED_IMAGES else "raw"}, or -r '
                        f'{name}:=...')


def _files(seen: Observations) -> Iterator[Finding]:
    """Report parameter files that match no node, or that were not loaded."""
    for problem in seen.file_problems:
        yield error('parameter file', problem, 'one section for each node, by its full name',
                    'name each section /**/planner, or by the full name of the node')
    for node, values in seen.file_parameters.items():
        running = seen.parameters.get(node, {})
        other = [f'{name} is {running[name]!r}, the file says {value!r}'
                 for name, value in sorted(values.items())
                 if name in running and running[name] != value]
        if other:
            yield error('parameter file', f'{node} has not taken it: {other[0]}'
                        f'{f" and {len(other) - 1} more" if other[1:] else ""}',
                        'the nodes run with the file', 'start the node with --params-file; is the '
                        'section named as the node is, namespace and all?')


def _network(seen: Observations) -> Iterator[Finding]:
    """Report nodes that other computers can command."""
    nodes = ', '.join(seen.machine.open_nodes)
    yield judged(False, bool(nodes), 'network', f'everybody on it can command: {nodes} started '
                 'without ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST' if nodes else
                 'ROS stays on this computer, or with named peers',
                 'the network does not reach the nodes',
                 'start every node with it, see docs/deploy.md')


def _recording(seen: Observations) -> Iterator[Finding]:
    """Check a bag as a whole."""
    if seen.incomplete:
        yield warning('bag', f'incomplete: {seen.incomplete}', 'finished',
                      'the part that exists can be used; record again for the rest')
    missing = [name for name in ('truth/odom', 'truth/neighbors') if not seen.topic(name).arrivals]
    if missing:
        yield unmeasured('truth', f'no {" and no ".join(missing)}: evaluate reports no errors',
                         'truth/odom and truth/neighbors, if known')
    else:
        yield ok('truth', 'there: evaluate reports errors', 'truth/odom and truth/neighbors')
