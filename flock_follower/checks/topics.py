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

"""Checks of nodes and topics: publishers, rates, latencies, clocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from flock_follower.bags.schedule import MAX_GAP
from flock_follower.checks.findings import (
    ERROR,
    Finding,
    first,
    OK,
    UNMEASURED,
    WARNING,
)
from flock_follower.checks.observations import Observations
from flock_follower.checks.pose_topics import check_poses
from flock_follower.checks.reach import Reach
from flock_follower.checks.streams import check_stream
from flock_follower.messages.topic_names import (
    COMPRESSED_IMAGES,
    full_name,
    offer,
    OURS,
    RAW_IMAGES,
    TYPES,
)
from flock_follower.parameters.sections import listed_files

#: Only one node may publish these.
ONE_PUBLISHER: Final = (RAW_IMAGES, COMPRESSED_IMAGES, 'camera_info', 'odom',
                        'command/trajectory', 'mavlink_bridge/state', 'neighbors')
START: Final = 'ros2 launch flock_follower follower.launch.py'


def check_topics(seen: Observations) -> Iterator[Finding]:
    """Check nodes and topics; for a bag, check its topics."""
    if seen.live:
        yield check_nodes(seen)
        yield from _clocks(seen)
    elif seen.incomplete:
        yield Finding(WARNING, 'bag', f'incomplete: {seen.incomplete}', 'finished',
                      'the part that exists can be used; record again for the rest')
    if seen.set_back:
        yield Finding(
            ERROR, 'bag clock', f'the clock was set back by {seen.set_back:.1f} s while the bag '
            'was recorded: its messages are mixed', 'one clock',
            'record again, and synchronize the clock before')
    elif seen.gaps:
        yield _gaps(seen)
    for name in (seen.image_name, 'camera_info', 'odom') if seen.has_markers else ('odom',):
        yield _check_published(seen, name)
    yield from check_poses(seen)
    late = float(seen.value('planner', 'odom_timeout', 0.3))
    if seen.has_markers:
        yield from check_stream(
            seen, 'images', seen.topic(seen.image_name), rates=(10.0, 3.0), latencies=(0.2, 0.4),
            faster='raise the frame rate of the camera; reduce the exposure time in the dark',
            sooner='send smaller images, or gray ones; have the camera on this computer')
    yield from check_stream(
        seen, 'odom', seen.topic('odom'), rates=(18.0, 8.0), latencies=(0.5 * late, 0.8 * late),
        faster='raise the output rate of the odometry (IMU rate, if its driver offers that)',
        sooner='give its source more processor time, or smaller images; have it publish per IMU '
        'message if it can')
    if seen.live:
        yield from _publishers(seen)


def check_nodes(seen: Observations) -> Finding:
    """Check that each of our nodes runs once."""
    count = {name: seen.nodes.count(full_name(name, seen.namespace)) for name in OURS}
    missing = ', '.join(name for name, number in count.items() if number == 0)
    twice = ', '.join(f'{name}{_files(seen, name)}' for name, number in count.items()
                      if number > 1)
    other = ', '.join(full for full in seen.nodes if count.get(full.rsplit('/', 1)[-1]) == 0)
    return first(
        'nodes', 'each of our three, once',
        (not seen.nodes, ERROR, f'no node is seen on domain {seen.machine.domain}', 'start them; '
         'check needs their ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE'),
        (twice, ERROR, f'twice: {twice}', 'end one of each: both command the vehicle'),
        (other, ERROR, f'not in /{seen.namespace.strip("/")}: {missing}, but {other}',
         'check --namespace NAME; or start all in one namespace'),
        (missing, ERROR, f'not running: {missing}', f'start: {START}'),
        (True, OK, 'all three are running', ''))


def _files(seen: Observations, node: str) -> str:
    """Return the different parameter files of nodes with one name as text; '' if they agree."""
    files = seen.files.get(full_name(node, seen.namespace).lstrip('/'), [])
    return f' ({listed_files(files)})' if len(files) > 1 else ''


def _clocks(seen: Observations) -> Iterator[Finding]:
    """Check that every node runs on simulated time if there is a /clock, and only then."""
    simulated = {node: bool(own['use_sim_time']) for node, own in seen.parameters.items()
                 if 'use_sim_time' in own}
    clock = '/clock' in seen.topics
    wrong = ', '.join(node for node, value in simulated.items() if value != clock)
    unread = ', '.join(node for node in OURS if node not in simulated
                       and full_name(node, seen.namespace) in seen.nodes)
    if simulated or unread:
        yield first(
            'clock', 'use_sim_time if there is a /clock, and only then',
            (wrong and clock, ERROR,
             f'/clock is published, but use_sim_time is false in {wrong}',
             'start with -p use_sim_time:=true; or end the publisher of /clock'),
            (wrong, ERROR, f'use_sim_time is true in {wrong}, but no node publishes /clock',
             'start without use_sim_time; or replay with /clock'),
            (unread, UNMEASURED, f'no parameters received of {unread}', ''),
            (True, OK, 'the same for all our nodes', ''))


def _gaps(seen: Observations) -> Finding:
    """Report the largest step in the times of a bag."""
    after, step, interrupts = max(seen.gaps, key=lambda gap: (gap[2], abs(gap[1])))
    others = f' (and {len(seen.gaps) - 1} more steps)' if len(seen.gaps) > 1 else ''
    return Finding(
        ERROR if interrupts else WARNING, 'bag clock',
        f'times jump by {step:+.1f} s after {after:.1f} s{others}: the clock was set, or nothing '
        'was recorded', f'one clock, gaps below {MAX_GAP:g} s',
        'cut the bag there (ros2 bag convert) and use each part; synchronize the clock before '
        'recording')


def _check_published(seen: Observations, name: str) -> Finding:
    """Check that a topic is published, and that messages arrive."""
    topic, full, msgtype = seen.topic(name), seen.names[name], TYPES[name]
    what = 'images' if name in (RAW_IMAGES, COMPRESSED_IMAGES) else name
    published = {other: found.types[0] for other, found in seen.topics.items() if found.types}
    connect = offer(RAW_IMAGES if what == 'images' else name, published, [
        other for ours, other in seen.names.items() if ours not in (name, RAW_IMAGES)], seen.live)
    nodes = ', '.join(sorted({end.node for end in topic.publishers}))
    return first(
        what, msgtype.replace('/msg/', '/'),
        (full in seen.unreadable, ERROR, f'{full} cannot be read: {seen.unreadable.get(full)}',
         'record it anew'),
        (not topic.publishers and seen.live, ERROR, f'no node publishes {full}',
         connect or 'start its driver'),
        (not topic.publishers, ERROR, f'the bag lacks {full}',
         connect or 'record it; evaluate needs it'),
        (msgtype not in topic.types, ERROR, f'{full} has type {", ".join(topic.types)}',
         connect or f'have its source send {msgtype}'),
        (not topic.arrivals, ERROR, f'{nodes} publishes {full}, and sends nothing',
         "see the node's log; is the sensor connected, calibrated and initialized?"),
        (True, OK, f'{full}, {len(topic.arrivals)} messages', ''))


def _publishers(seen: Observations) -> Iterator[Finding]:
    """Report topics with several publishers that may have only one; nodes open to the network."""
    for name in ONE_PUBLISHER:
        nodes = sorted(end.node for end in seen.topic(name).publishers)
        if len(nodes) > 1:
            yield Finding(ERROR, name, f'{len(nodes)} publishers on {seen.names[name]}: '
                          f'{", ".join(nodes)}', 'one', 'end all but one, or remap them')
    yield _check_network(seen.machine.reach)


def _check_network(reach: Sequence[tuple[str, Reach | None]]) -> Finding:
    """Check that our nodes are reached from this computer alone."""
    found, addressed, unknown = (
        ', '.join(sorted({node for node, its in reach if its is wanted}))
        for wanted in (Reach.NETWORK, Reach.ADDRESS, None))
    return first(
        'network', 'the network does not reach the nodes',
        (found, WARNING, f'any computer on it can command: it finds {found}',
         'start every node with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST and '
         'config/dds/fastdds.xml, see docs/deploy.md'),
        (addressed, WARNING, 'a computer that names the address of this one as a peer can '
         f'command: it reaches {addressed}', 'start every node with config/dds/fastdds.xml; a '
         'flock with peers needs a firewall: see docs/deploy.md'),
        (unknown or not reach, UNMEASURED, f'no socket of DDS is seen in {unknown or "any node"}',
         ''),
        (True, OK, 'ROS stays on this computer', ''))
