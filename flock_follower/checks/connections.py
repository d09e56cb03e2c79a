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

"""Who talks to whom: topics, their types and QoS, nodes, namespaces, files of parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from flock_follower.checks.findings import error, Finding, ok, unmeasured, warning
from flock_follower.checks.observations import Observations, OURS
from flock_follower.checks.topic_names import (
    COMPRESSED_IMAGES,
    elsewhere,
    INFO,
    offer,
    RAW_IMAGES,
    TYPES,
)

#: What has to come for anything to fly, and for ``evaluate`` to run.
NEEDED: Final = (RAW_IMAGES, 'camera_info', 'odom')
#: On these only one may publish.
ONE_VOICE: Final = (RAW_IMAGES, COMPRESSED_IMAGES, 'camera_info', 'odom', 'command/trajectory',
                    'mavlink_bridge/state', 'neighbors')
START: Final = 'ros2 launch flock_follower follower.launch.py'


def check_connections(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of nodes and topics, and, of a bag, of what it holds."""
    if seen.nothing_there:
        yield error('ROS', f'no node is seen on domain {seen.machine.domain}'
                    f'{" within " + seen.machine.reach if seen.machine.reach else ""}',
                    'camera, odometry and our nodes',
                    'start them; set ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE alike here '
                    'and there')
        return
    if seen.live:
        yield from _nodes(seen)
    for name in NEEDED:
        yield _needed(seen, seen.image_name if name == RAW_IMAGES else name)
    if seen.live:
        yield from _voices(seen)
        yield from _misfits(seen)
        yield from _wiring(seen)
        yield from _files(seen)
        yield from _strangers(seen)
    else:
        yield from _recording(seen)


def _nodes(seen: Observations) -> Iterator[Finding]:
    wanted = 'each of our three, once'
    inside = '/' + seen.namespace.strip('/')
    here = {name: [full for full in seen.nodes if full == f'{inside.rstrip("/")}/{name}']
            for name in OURS}
    missing = [name for name, found in here.items() if not found]
    twice = [name for name, found in here.items() if len(found) > 1]
    if missing:
        away = [full for full in seen.nodes if full.rsplit('/', 1)[-1] in missing]
        if away:
            namespace = away[0].rsplit('/', 1)[0].strip('/')
            yield error('nodes', f'{", ".join(missing)} not in {inside}, but {", ".join(away)}',
                        wanted, f'check --namespace {namespace}; or start all in one namespace'
                        if namespace else 'check without --namespace')
        else:
            yield error('nodes', f'not running: {", ".join(missing)}', wanted, f'start: {START}')
    if twice:
        yield error('nodes', f'twice: {", ".join(twice)}', wanted,
                    'end one of each: both command the vehicle')
    if not missing and not twice:
        yield ok('nodes', 'all three are running', wanted)


def _needed(seen: Observations, name: str) -> Finding:
    """Return whether a topic that is needed is there, and comes."""
    topic, full, msgtype = seen.topic(name), seen.names[name], TYPES[name]
    wanted = msgtype.replace('/msg/', '/')
    what = _plainly(name)
    published = {other: found.types[0] for other, found in seen.topics.items() if found.types}
    taken = [other for ours, other in seen.names.items() if ours not in (name, RAW_IMAGES)]
    if full in seen.unreadable:
        return error(what, f'{full} cannot be read: {seen.unreadable[full]}', wanted,
                     'record it anew')
    if topic.publishers and msgtype not in topic.types:
        return error(what, f'{full} holds {", ".join(topic.types)}', wanted,
                     _connect(name, published, taken) or f'have its source send {msgtype}')
    if not topic.publishers:
        far = elsewhere(full, (n for n, t in published.items() if t == msgtype),
                        seen.names.values())
        advice = _connect(name, published, taken)
        if far and not advice:
            advice = f'{far[0]} is published: start all in one namespace'
        own = seen.names['mavlink/odom']
        if name == 'odom' and not advice and own in published:
            advice = f"start its source; or fly by the autopilot's own estimate: -r odom:={own}"
        where = 'nobody publishes' if seen.live else 'the bag lacks'
        return error(what, f'{where} {full}', wanted, advice or (
            'start its driver' if seen.live else 'record it; evaluate needs it'))
    if not topic.arrivals:
        who = ', '.join(sorted({end.node for end in topic.publishers}))
        return error(what, f'{who} publishes {full}, and sends nothing', wanted,
                     'look at its log; is the sensor plugged in, is it initialised?'
                     if msgtype != INFO else 'calibrate the camera; give its driver the file')
    return ok(what, f'{full}, {len(topic.arrivals)} messages', wanted)


def _plainly(name: str) -> str:
    return 'images' if name in (RAW_IMAGES, COMPRESSED_IMAGES) else name


def _connect(name: str, published: dict[str, str], taken: list[str]) -> str:
    return offer(RAW_IMAGES if name == COMPRESSED_IMAGES else name, published, taken)


def _voices(seen: Observations) -> Iterator[Finding]:
    """Yield topics on which several publish where only one may."""
    for name in ONE_VOICE:
        ends = seen.topic(name).publishers
        if len(ends) > 1:
            who = ', '.join(sorted(end.node for end in ends))
            yield error(name, f'{len(ends)} publishers on {seen.names[name]}: {who}', 'one',
                        'end all but one, or remap them')


def _misfits(seen: Observations) -> Iterator[Finding]:
    """Yield pairs of publisher and subscriber that hear nothing of one another."""
    for name in TYPES:
        topic = seen.topic(name)
        for sender in topic.publishers:
            for taker in topic.subscribers:
                if taker.node.rsplit('/', 1)[-1] not in OURS and (
                        sender.node.rsplit('/', 1)[-1] not in OURS):
                    continue
                if sender.type != taker.type:
                    continue  # told as a wrong type
                why = ('best effort, and it wants reliable' if taker.reliable and (
                    not sender.reliable) else 'volatile, and it wants transient local (latched)'
                    if taker.latched and not sender.latched else '')
                if why:
                    yield error(f'{name} QoS', f'{taker.node} hears nothing: {sender.node} '
                                f'sends {why}', 'QoS that fit',
                                f'change the QoS of {sender.node}, by its parameters '
                                'qos_overrides where it has them')


def _wiring(seen: Observations) -> Iterator[Finding]:
    """Yield our running nodes that listen where nobody speaks, or to different odometries."""
    prefix = ('/' + seen.namespace.strip('/')).rstrip('/')
    taken: dict[str, list[str]] = {}
    for node in OURS:
        full = f'{prefix}/{node}'
        if full not in seen.nodes:
            continue
        heard = {name for name, topic in seen.topics.items()
                 if any(end.node == full for end in topic.subscribers)}
        for name in ('odom', seen.image_name, 'camera_info'):
            needs = node == 'relative_pose' or name == 'odom'
            if needs and seen.names[name] not in heard and seen.topic(name).publishers:
                taken.setdefault(name, []).append(node)
    for name, nodes in taken.items():
        yield error(f'{_plainly(name)} wiring',
                    f'{", ".join(nodes)} does not listen to {seen.names[name]}',
                    'each node listens to it', _wiring_advice(seen, name))


def _wiring_advice(seen: Observations, name: str) -> str:
    if name in (RAW_IMAGES, COMPRESSED_IMAGES):
        other = 'compressed' if name == COMPRESSED_IMAGES else 'raw'
        return f'start relative_pose with image_transport:={other}, or -r {name}:=...'
    return f'start it with --ros-args -r {name}:={seen.names[name]}'


def _files(seen: Observations) -> Iterator[Finding]:
    """Yield files of parameters that match nobody, or were not taken."""
    for problem in seen.file_problems:
        yield error('parameter file', problem, 'one section for each node, by its full name',
                    'name the sections /**/planner, or as the nodes are called')
    for node, wanted in seen.file_parameters.items():
        running = seen.parameters.get(node, {})
        other = [f'{name} is {running[name]!r}, the file says {value!r}'
                 for name, value in sorted(wanted.items())
                 if name in running and not _same(running[name], value)]
        if other:
            yield error('parameter file', f'{node} has not taken it: {other[0]}'
                        f'{f" and {len(other) - 1} more" if other[1:] else ""}',
                        'the nodes run with the file', 'start the node with --params-file; is the '
                        'section named as the node is, namespace and all?')


def _same(running: object, wanted: object) -> bool:
    if isinstance(running, list) and isinstance(wanted, list):
        return len(running) == len(wanted) and all(map(_same, running, wanted))
    return running == wanted


def _strangers(seen: Observations) -> Iterator[Finding]:
    """Yield who commands that is no planner, and whether others on the network could."""
    ends = seen.topic('command/trajectory').publishers
    if len(ends) == 1 and ends[0].node.rsplit('/', 1)[-1] != 'planner':
        yield warning('command/trajectory', f'{ends[0].node} commands', 'planner',
                      'end it, if it is not yours: the bridge flies what it says')
    wanted = 'the network does not reach the nodes'
    if seen.machine.open_nodes:
        yield warning('network', f'everybody on it can command: '
                      f'{", ".join(seen.machine.open_nodes)} started without '
                      'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST', wanted,
                      'start every node with it, see docs/deploy.md')
    else:
        yield ok('network', 'ROS stays on this computer, or with named peers', wanted)


def _recording(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of a bag as a whole."""
    if seen.incomplete:
        yield warning('bag', f'incomplete: {seen.incomplete}', 'finished',
                      'what is there can be used; record anew for the rest')
    truths = [name for name in ('truth/odom', 'truth/neighbors') if not seen.topic(name).arrivals]
    if truths:
        yield unmeasured('truth', f'no {" and no ".join(truths)}: evaluate reports no errors',
                         'truth/odom and truth/neighbors, if known')
    else:
        yield ok('truth', 'there: evaluate reports errors', 'truth/odom and truth/neighbors')
