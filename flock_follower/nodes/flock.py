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
The flock node: followers exchange their own states and the states of the neighbors they see.

The node subscribes ``odom``, ``neighbors`` and ``/neighbors/shared``, which all vehicles share. It
publishes at 10 Hz: on ``/neighbors/shared`` the ego state and the neighbors in sight; on
``neighbors/heard`` the neighbors that are out of sight and that others reported, in the ego
odometry frame. The mathematics is in ``flock_follower.flock``.
"""

from __future__ import annotations

import sys
import time
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile

from flock_follower.flock.exchange import Sharing
from flock_follower.flock.peers import checked_name
from flock_follower.messages import OdometryState
from flock_follower.messages.state_reader import from_odometry
from flock_follower.messages.state_writer import from_state
from flock_follower.nodes.support.conversions import make
from flock_follower.nodes.support.diagnostics import Problem, WARN
from flock_follower.nodes.support.inputs import best_effort, OwnOdometry
from flock_follower.nodes.support.process import run
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.support.sole_publisher import SolePublisher
from flock_follower.odometry.reader import SourceParams
from flock_follower.parameters.spec import Spec, specs_of

# Shared by all vehicles: outside their namespaces.
SHARED_TOPIC = '/neighbors/shared'
RECEIVED_TOPIC = 'neighbors/heard'
# Best effort: the next message follows in 0.1 s, so that radio links repeat none.
SHARED_QOS = best_effort(50)
PERIOD = 0.1  # s

SPECS = [
    Spec('vehicle_name', '',
         'name of this vehicle, unique in the flock, as in the neighbors_file of others; empty: '
         'the namespace'),
    *specs_of(SourceParams(), 'odom_'),
]


class SharingNode(FlockNode):
    """Passes messages to and from the core, and reports messages that are not used."""

    def __init__(self, name: str = 'flock', **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        namespace = self.get_namespace().strip('/').replace('/', '_')
        parameters = self.declare(
            SPECS, lambda values: checked_name(values['vehicle_name'] or namespace))
        self._sharing = Sharing(parameters.current)
        self._own = OwnOdometry(self, parameters.values, self._take_odom, depth=1)
        self._sent = self.create_publisher(Odometry, SHARED_TOPIC, SHARED_QOS)
        self._received = self.create_publisher(Odometry, RECEIVED_TOPIC, QoSProfile(depth=10))
        self.subscribe(Odometry, 'neighbors', self._take_neighbor, best_effort(10), required=False)
        self.subscribe(Odometry, SHARED_TOPIC, self._take_message, SHARED_QOS, required=False)
        self.diagnostics.checks += [self._silence_problem, self._sender_problem,
                                    SolePublisher(self, RECEIVED_TOPIC).problem]
        self.diagnostics.sources.append(self._senders)
        self.get_logger().info(f'this is {parameters.current}')
        self._timer = self.create_timer(PERIOD, self._tick)

    def _now(self) -> int:
        nanoseconds: int = self.get_clock().now().nanoseconds
        return nanoseconds

    def _take_odom(self, state: OdometryState, _: int) -> None:
        self._sharing.take_own(state)

    def _take_neighbor(self, message: Odometry) -> None:
        self._own.poll()
        self._sharing.take_seen(from_odometry(message))

    def _take_message(self, message: Odometry) -> None:
        self._own.poll()
        self._sharing.take_message(from_odometry(message), self._now())

    def _tick(self) -> None:
        self._own.poll()
        now = self._now()
        for state in self._sharing.neighbors(now):
            self._received.publish(from_state(make, state))
            self.diagnostics.rate('heard').tick(time.monotonic())
        for state in self._sharing.messages(now):
            self._sent.publish(from_state(make, state))
        for event in self._sharing.new_events():
            self.diagnostics.reject(*event)

    def _silence_problem(self, now: float) -> Problem | None:
        why = self._sharing.why_silent(self._now())
        return (WARN, f'nothing received from others: {why}') if why else None

    def _sender_problem(self, now: float) -> Problem | None:
        """Return a problem if clocks of senders are implausible."""
        odd = [f'{name}: {each.slow}' for name, each in self._sharing.senders.items()
               if each.slow]
        return (WARN, '; '.join(odd)) if odd else None

    def _senders(self, now: float) -> dict[str, str]:
        """Return the frame of every sender for /diagnostics."""
        current = self._now()
        return {f'frame of {name}': each.unusable_reason(current) or (
            'known to {:.3f} m, {:.3f} rad'.format(*each.frame.stds) if each.frame else '')
            for name, each in self._sharing.senders.items()}


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(SharingNode, args)


if __name__ == '__main__':
    sys.exit(main())
