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

"""Rates, latencies, clocks: whether it comes often enough, soon enough, and on one clock."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from flock_follower.checks.findings import error, Finding, ok, unmeasured, warning
from flock_follower.checks.observations import Observations, OURS, TopicSeen

#: Stamps that differ by more, s, from when they came are of another clock.
OTHER_CLOCK: Final = 10.0
#: Stamps so far in the future, s, are told; so far, and nothing fits any more.
AHEAD: Final = (0.003, 0.03)
#: A topic has stopped if it sent nothing for so long, s, and for so many of its gaps, before the
#: newest message of any topic.
STOPPED: Final = (1.0, 3.0)
#: Share of stamps that are repeated, or step back, from which on it is told.
DISORDER: Final = 0.01


class _Limits(NamedTuple):
    """What a topic has to keep: (told from, too bad from) each; Hz and s."""

    rate: tuple[float, float]
    latency: tuple[float, float]
    gap: float
    faster: str
    sooner: str


class _Heard(NamedTuple):
    """How a topic came; seconds."""

    number: int
    rate: float
    gap: float
    latency: float
    late: float
    """95 % came sooner than this."""


def check_timing(seen: Observations) -> Iterator[Finding]:
    """Yield what is to be said of the times of images and odometry, and of clocks."""
    yield from _clock_source(seen)
    odom_timeout = float(seen.value('planner', 'odom_timeout', 0.3))
    limits = {
        seen.image_name: _Limits(
            (10.0, 3.0), (0.2, 0.4), float(seen.value('planner', 'perception_timeout', 0.2)),
            'raise the frame rate of the camera; less exposure time where it is dark',
            'send smaller images, or grey ones; have the camera on this computer'),
        'odom': _Limits(
            (18.0, 8.0), (0.5 * odom_timeout, 0.8 * odom_timeout),
            float(seen.value('relative_pose', 'max_gap', 0.25)),
            'raise the output rate of the odometry (IMU rate, where its driver offers that)',
            'give its source more processor time, or smaller images; have it publish per IMU '
            'message where it can')}
    newest = max((topic.arrivals[-1] for topic in seen.topics.values() if topic.arrivals),
                 default=0.0)
    for name, limit in limits.items():
        topic = seen.topic(name)
        if topic.arrivals:
            silence = newest - topic.arrivals[-1]
            if seen.live and silence > max(STOPPED[0], STOPPED[1] * _heard(topic).gap):
                yield error('odom' if name == 'odom' else 'images',
                            f'stopped: none in the last {silence:.1f} s', 'messages to the end',
                            'see the log of its driver; is it still running?')
            yield from _judge('odom' if name == 'odom' else 'images', topic, limit, seen.live)
    yield from _one_clock(seen)


def _judge(name: str, topic: TopicSeen, limit: _Limits, live: bool) -> Iterator[Finding]:
    stamps = np.array(topic.stamps)
    heard = _heard(topic)
    wanted = f'{limit.rate[0]:g} Hz or more'
    if heard.number > 2:
        rate = f'{heard.rate:.1f} Hz'
        if heard.rate < limit.rate[1]:
            yield error(f'{name} rate', rate, wanted, limit.faster)
        elif heard.rate < limit.rate[0]:
            yield warning(f'{name} rate', rate, wanted, limit.faster)
        elif heard.gap > max(limit.gap, 2.5 / heard.rate):
            yield warning(f'{name} rate', f'{rate}, but once nothing for {heard.gap:.2f} s',
                          f'{wanted}, no gap above {limit.gap:g} s',
                          'find what stops it: USB, a full disk, too little processor time')
        else:
            yield ok(f'{name} rate', rate, wanted)
    else:
        yield unmeasured(f'{name} rate', f'{heard.number} messages are too few', wanted)
    if not stamps.all():
        yield error(f'{name} stamps', f'{int(np.sum(stamps == 0.0))} of {len(stamps)} are zero',
                    'the time of the measurement', 'have its driver fill header.stamp')
        return
    disorder = float(np.mean(np.diff(stamps) <= 0.0)) if len(stamps) > 1 else 0.0
    if disorder > DISORDER:
        yield warning(f'{name} stamps', f'{disorder:.0%} repeat the one before, or step back',
                      'each later than the one before',
                      'is it published twice, or by two drivers? Repetitions are dropped')
    yield _latency(name, heard, limit, live)


def _heard(topic: TopicSeen) -> _Heard:
    arrivals, stamps = np.array(topic.arrivals), np.array(topic.stamps)
    late = arrivals - stamps
    return _Heard(len(arrivals), topic.rate,
                  float(np.max(np.diff(arrivals), initial=0.0)),
                  float(np.median(late)), float(np.percentile(late, 95)))


def _latency(name: str, heard: _Heard, limit: _Limits, live: bool) -> Finding:
    what, wanted = f'{name} latency', f'below {limit.latency[0]:g} s after its stamp'
    middle = heard.latency
    if abs(middle) > OTHER_CLOCK:
        when = 'before' if middle > 0.0 else 'after'
        advice = ('set use_sim_time alike in all nodes, and the clocks of all computers; have '
                  'the driver stamp by the clock of ROS' if live else
                  'record it anew with stamps of the clock of ROS (a replayed bag: '
                  'ros2 bag record --use-sim-time)')
        return error(what, f'stamped {_span(abs(middle))} {when} it came: another clock', wanted,
                     advice)
    if middle < -AHEAD[0]:
        say = error if middle < -AHEAD[1] else warning
        return say(what, f'stamped {-1e3 * middle:.0f} ms in the future', wanted,
                   'synchronise the clocks (chrony, PTP); have the driver stamp by the clock of '
                   'ROS')
    measured = f'{1e3 * middle:.0f} ms, 95 % within {1e3 * heard.late:.0f} ms'
    if middle > limit.latency[1]:
        return error(what, measured, wanted, limit.sooner)
    if middle > limit.latency[0] or heard.late > limit.latency[1]:
        return warning(what, measured, wanted, limit.sooner)
    return ok(what, measured, wanted)


def _clock_source(seen: Observations) -> Iterator[Finding]:
    """Yield whether every node goes by the clock that there is."""
    if not seen.live:
        return
    simulated = {node: bool(seen.value(node, 'use_sim_time', False)) for node in OURS
                 if 'use_sim_time' in seen.parameters.get(node, {})}
    wanted = 'use_sim_time where /clock is'
    if seen.clock:
        if forgotten := sorted(node for node, value in simulated.items() if not value):
            yield error('clock', f'/clock is published, {", ".join(forgotten)} '
                        f'{"goes" if len(forgotten) == 1 else "go"} by the time of day', wanted,
                        'start with -p use_sim_time:=true; or end what publishes /clock')
        elif simulated:
            yield ok('clock', '/clock, and all our nodes go by it', wanted)
    elif waiting := sorted(node for node, value in simulated.items() if value):
        yield error('clock', f'{", ".join(waiting)}: use_sim_time is true, but nobody publishes '
                    '/clock', wanted, 'start without use_sim_time; or replay with /clock')
    elif simulated:
        yield ok('clock', 'the time of day, in all our nodes', wanted)


def _one_clock(seen: Observations) -> Iterator[Finding]:
    """Yield whether images and odometry are stamped by one clock."""
    images, odometry = ([stamp for stamp in seen.topic(name).stamps if stamp]
                        for name in (seen.image_name, 'odom'))
    if not images or not odometry:
        return
    apart = max(min(images) - max(odometry), min(odometry) - max(images))
    wanted = 'one clock for both'
    if apart > 1.0:
        yield error('camera and odometry', f'their stamps are {_span(apart)} apart', wanted,
                    'have both drivers stamp by the clock of ROS, as unite_imu_method and '
                    'global_time_enabled do for a RealSense')
    else:
        yield ok('camera and odometry', 'stamped over the same time', wanted)


def _span(seconds: float) -> str:
    """Return a time in words, of the unit that suits it."""
    for unit, length in (('years', 365.25 * 86400.0), ('days', 86400.0), ('hours', 3600.0)):
        if seconds > 2.0 * length:
            return f'{seconds / length:.0f} {unit}'
    return f'{seconds:.1f} s'
