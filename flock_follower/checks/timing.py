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

"""Timing: rates, latencies and clocks of images and odometry."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from flock_follower.checks.findings import (
    ERROR,
    error,
    Finding,
    first,
    judged,
    OK,
    unmeasured,
    WARNING,
    warning,
)
from flock_follower.checks.observations import Observations, TopicSeen

#: s: stamps that differ by more from the arrival are of another clock.
OTHER_CLOCK: Final = 10.0
#: s: stamps in the future: from which on there is a warning, and an error.
AHEAD: Final = (0.003, 0.03)
#: A topic has stopped if its last message came so long, s, and so many of its longest gaps,
#: before the newest message of any topic.
STOPPED: Final = (1.0, 3.0)
#: Share of stamps that repeat or step back, from which on there is a warning.
DISORDER: Final = 0.01


class _Limits(NamedTuple):
    """Limits of a topic: a warning and an error beyond each pair, Hz and s; longest gap, s."""

    rate: tuple[float, float]
    latency: tuple[float, float]
    gap: float
    faster: str
    sooner: str


def check_timing(seen: Observations) -> Iterator[Finding]:
    """Check rates and latencies of images and odometry, and the clocks."""
    if seen.live:
        yield from _clock_source(seen)
    odom_timeout = float(seen.value('planner', 'odom_timeout', 0.3))
    newest = max((topic.arrivals[-1] for topic in seen.topics.values() if topic.arrivals),
                 default=0.0)
    yield from _stream('images', seen.topic(seen.image_name), newest, seen.live, _Limits(
        (10.0, 3.0), (0.2, 0.4), float(seen.value('planner', 'perception_timeout', 0.2)),
        'raise the frame rate of the camera; less exposure time where it is dark',
        'send smaller images, or grey ones; have the camera on this computer'))
    yield from _stream('odom', seen.topic('odom'), newest, seen.live, _Limits(
        (18.0, 8.0), (0.5 * odom_timeout, 0.8 * odom_timeout),
        float(seen.value('relative_pose', 'max_gap', 0.25)),
        'raise the output rate of the odometry (IMU rate, where its driver offers that)',
        'give its source more processor time, or smaller images; have it publish per IMU '
        'message where it can'))
    yield from _one_clock(seen)


def _stream(name: str, topic: TopicSeen, newest: float, live: bool,
            limits: _Limits) -> Iterator[Finding]:
    """
    Check rate, stamps and latency of a topic.

    :param newest: arrival of the newest message of any topic, s.
    """
    if not topic.arrivals:
        return
    gap = float(np.max(np.diff(topic.arrivals), initial=0.0))
    silence = newest - topic.arrivals[-1]
    if live and silence > max(STOPPED[0], STOPPED[1] * gap):
        yield error(name, f'stopped: none in the last {silence:.1f} s', 'messages to the end',
                    'see the log of its driver; is it still running?')
    wanted, rate = f'{limits.rate[0]:g} Hz or more', f'{topic.rate:.1f} Hz'
    if len(topic.arrivals) <= 2:
        yield unmeasured(f'{name} rate', f'{len(topic.arrivals)} messages are too few', wanted)
    elif topic.rate >= limits.rate[0] and gap > max(limits.gap, 2.5 / topic.rate):
        yield warning(f'{name} rate', f'{rate}, but once nothing for {gap:.2f} s',
                      f'{wanted}, no gap above {limits.gap:g} s',
                      'find the cause of the gap: USB, a full disk, too little processor time')
    else:
        yield judged(topic.rate < limits.rate[1], topic.rate < limits.rate[0], f'{name} rate',
                     rate, wanted, limits.faster)
    if zeros := topic.stamps.count(0.0):
        yield error(f'{name} stamps', f'{zeros} of {len(topic.stamps)} are zero',
                    'the time of the measurement', 'let the driver fill header.stamp')
        return
    disorder = float(np.mean(np.diff(topic.stamps) <= 0.0)) if len(topic.stamps) > 1 else 0.0
    if disorder > DISORDER:
        yield warning(f'{name} stamps', f'{disorder:.0%} repeat the one before, or step back',
                      'each later than the one before',
                      'is the topic published twice, or by two drivers? Repetitions are dropped')
    late = np.array(topic.arrivals) - np.array(topic.stamps)
    middle, most = float(np.median(late)), float(np.percentile(late, 95))
    ahead = f'stamped {-1e3 * middle:.0f} ms in the future'
    synchronise = 'synchronise the clocks (chrony, PTP); have the driver stamp by the clock of ROS'
    measured = f'median {1e3 * middle:.0f} ms, 95 % within {1e3 * most:.0f} ms'
    yield first(
        f'{name} latency', f'below {limits.latency[0]:g} s after its stamp',
        (abs(middle) > OTHER_CLOCK, ERROR,
         f'stamped {_span(abs(middle))} {"before" if middle > 0.0 else "after"} it came: another '
         'clock', 'set use_sim_time alike in all nodes, and the clocks of all computers; have the '
         'driver stamp by the clock of ROS' if live else 'record it anew with stamps of the clock '
         'of ROS (a replayed bag: ros2 bag record --use-sim-time)'),
        (middle < -AHEAD[1], ERROR, ahead, synchronise),
        (middle < -AHEAD[0], WARNING, ahead, synchronise),
        (middle > limits.latency[1], ERROR, measured, limits.sooner),
        (middle > limits.latency[0] or most > limits.latency[1], WARNING, measured,
         limits.sooner),
        (True, OK, measured, ''))


def _clock_source(seen: Observations) -> Iterator[Finding]:
    """Check that every node runs on simulated time if there is a /clock, and only then."""
    simulated = {node: bool(own['use_sim_time']) for node, own in seen.parameters.items()
                 if 'use_sim_time' in own}
    wrong = sorted(node for node, value in simulated.items() if value != seen.clock)
    names = ', '.join(wrong)
    if simulated:
        yield first(
            'clock', 'use_sim_time where /clock is',
            (wrong and seen.clock, ERROR,
             f'/clock is published, but use_sim_time is false in {names}',
             'start with -p use_sim_time:=true; or end the publisher of /clock'),
            (wrong, ERROR, f'{names}: use_sim_time is true, but nobody publishes /clock',
             'start without use_sim_time; or replay with /clock'),
            (True, OK, '/clock, used by all our nodes' if seen.clock else
             'the system time, used by all our nodes', ''))


def _one_clock(seen: Observations) -> Iterator[Finding]:
    """Check that images and odometry are stamped by one clock."""
    images, odometry = ([stamp for stamp in seen.topic(name).stamps if stamp]
                        for name in (seen.image_name, 'odom'))
    if images and odometry:
        apart = max(min(images) - max(odometry), min(odometry) - max(images))
        yield first(
            'camera and odometry', 'one clock for both',
            (apart > 1.0, ERROR, f'their stamps are {_span(apart)} apart',
             'have both drivers stamp by the clock of ROS, as unite_imu_method and '
             'global_time_enabled do for a RealSense'),
            (True, OK, 'stamped over the same time', ''))


def _span(seconds: float) -> str:
    """Return a time in words, in a suitable unit."""
    for unit, length in (('years', 365.25 * 86400.0), ('days', 86400.0), ('hours', 3600.0)):
        if seconds > 2.0 * length:
            return f'{seconds / length:.0f} {unit}'
    return f'{seconds:.1f} s'
