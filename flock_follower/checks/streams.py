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

"""Rate, stamps and latency of a topic, and whether it has stopped."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from flock_follower.checks.findings import ERROR, Finding, first, OK, UNMEASURED, WARNING
from flock_follower.checks.observations import Observations, TopicSeen

#: s: stamps that differ by more from the arrival are of another clock.
OTHER_CLOCK: Final = 10.0
#: s: median of stamps in the future from which on there is a warning, and an error: the clocks
#: differ. The nodes accept single stamps up to ``messages.FUTURE_TOLERANCE`` ahead.
CLOCK_AHEAD: Final = (0.003, 0.03)
#: Share of messages with the stamp of the one before, from which on there is an error.
REPEATED: Final = 0.1
#: A topic has stopped if its last message came so long, s, and so many of its longest gaps,
#: before the newest message of any topic.
STOPPED: Final = (1.0, 3.0)
#: A fault of times on a busy computer begins with this.
BUSY: Final = 'not judged, the computer is too busy: '


def check_stream(seen: Observations, name: str, topic: TopicSeen, *, rates: tuple[float, float],
                 latencies: tuple[float, float], faster: str, sooner: str) -> Iterator[Finding]:
    """
    Check rate, stamps and latency of a topic, and whether it has stopped.

    On a busy computer rate and latency are not judged if they are faulty.

    :param rates: a lower rate is a warning, and an error, Hz; ``faster``: the advice.
    :param latencies: a higher latency is a warning, and an error, s; ``sooner``: the advice.
    """
    if not topic.arrivals:
        return
    gap = float(np.max(np.diff(topic.arrivals), initial=0.0))
    newest = max(other.arrivals[-1] for other in seen.topics.values() if other.arrivals)
    silence = newest - topic.arrivals[-1]
    if seen.live and silence > max(STOPPED[0], STOPPED[1] * gap):
        yield Finding(ERROR, name, f'stopped: none in the last {silence:.1f} s',
                      'messages to the end', 'see the log of its driver; is it still running?')
    yield check_rate(seen, name, topic, rates, faster)
    yield check_latency(seen, name, topic, latencies, sooner)


def check_rate(seen: Observations, name: str, topic: TopicSeen, rates: tuple[float, float],
               faster: str) -> Finding:
    """Check the rate of a topic; the arguments are those of ``check_stream``."""
    frequency = seen.rate(topic)
    wanted, rate = f'{rates[0]:g} Hz or more', f'{frequency:.1f} Hz'
    return first(
        f'{name} rate', wanted,
        (len(topic.arrivals) <= 2, UNMEASURED, f'{len(topic.arrivals)} messages are too few', ''),
        (seen.busy and frequency < rates[0], UNMEASURED, BUSY + rate, ''),
        (frequency < rates[1], ERROR, rate, faster),
        (frequency < rates[0], WARNING, rate, faster),
        (True, OK, rate, ''))


def check_latency(seen: Observations, name: str, topic: TopicSeen,
                  latencies: tuple[float, float], sooner: str) -> Finding:
    """Check stamps and latency of a topic with messages, see ``check_stream``."""
    late = np.array(topic.arrivals) - np.array(topic.stamps)
    stamped = np.array(topic.stamps) > 0.0
    unstamped = int(np.count_nonzero(~stamped)) if stamped.any() else 0  # of all, another clock
    judged = late[stamped] if unstamped else late
    middle, most = float(np.median(judged)), float(np.percentile(judged, 95))
    steps = np.diff(late[stamped])
    jumps = np.flatnonzero(np.abs(steps) > OTHER_CLOCK)
    jump, since = ((-steps[jumps[0]], np.array(topic.arrivals)[stamped][jumps[0]]
                    - topic.arrivals[0]) if jumps.size else (0.0, 0.0))
    ahead = f'stamped {-1e3 * middle:.0f} ms in the future'
    synchronize = 'synchronize the clocks (chrony, PTP); have the driver stamp by the clock of ROS'
    measured = f'median {1e3 * middle:.0f} ms, 95 % within {1e3 * most:.0f} ms'
    after = np.diff(np.array(topic.stamps)[stamped])
    no_stamp = (f'{unstamped} of {len(topic.stamps)} have no stamp',
                'have the driver stamp each message when it is measured')
    repeated, older = int(np.count_nonzero(after == 0.0)), int(np.count_nonzero(after < 0.0))
    return first(
        f'{name} latency', f'below {latencies[0]:g} s after its stamp',
        (jumps.size, ERROR,
         f'stamps jump by {jump:+.1f} s against the time they came, after {since:.1f} s',
         'a clock was set meanwhile: synchronize all clocks before the flight (chrony, PTP), and '
         'have the driver stamp by the clock of ROS'),
        (unstamped > REPEATED * len(topic.stamps), ERROR, *no_stamp),
        (older > REPEATED * len(topic.stamps), ERROR,
         f'{older} of {len(topic.stamps)} are older than the message before',
         'if two cameras or sources publish on this topic, keep one; otherwise the clock of the '
         'driver is set back repeatedly'),
        (repeated > REPEATED * len(topic.stamps), ERROR,
         f'{repeated} of {len(topic.stamps)} have the stamp of the message before',
         'have the driver stamp each message when it is measured; if each is published twice, or '
         'two sources share the topic, take one'),
        (abs(middle) > OTHER_CLOCK, ERROR,
         f'stamped {abs(middle):.0f} s {"before" if middle > 0.0 else "after"} it came: no stamp, '
         'or another clock', 'set use_sim_time alike in all nodes, and the clocks of all '
         'computers; have the driver stamp by the clock of ROS (a replayed bag: ros2 bag record '
         '--use-sim-time)'),
        (middle < -CLOCK_AHEAD[1], ERROR, ahead, synchronize),
        (middle < -CLOCK_AHEAD[0], WARNING, ahead, synchronize),
        (seen.busy and (middle > latencies[0] or most > latencies[1]), UNMEASURED,
         BUSY + measured, ''),
        (middle > latencies[1], ERROR, measured, sooner),
        (middle > latencies[0] or most > latencies[1], WARNING, measured, sooner),
        (unstamped, WARNING, *no_stamp),
        (True, OK, measured, ''))
