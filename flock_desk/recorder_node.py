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
Record topics to a bag, undecoded: ``recorder BAG TOPIC:TYPE...``.

The recording time of each message is the moment it was received on the system's monotonic clock,
which every process of a machine shares: steps of the time of day or of ``/clock`` cannot bend it.
"""

from __future__ import annotations

import argparse
from functools import partial
import sys
import time

from rclpy.node import Node
from rclpy.qos import QoSProfile

from flock_follower.bags.bag import BagError
from flock_follower.bags.mcap_file import incomplete
from flock_follower.bags.writer import BagWriter
from flock_follower.nodes.support.conversions import message_class
from flock_follower.nodes.support.exit_deadline import no_exit_deadline
from flock_follower.nodes.support.process import run, spin


class Recorder(Node):
    """
    Writes every message received; its QoS is reliable and volatile, so no message is lost.

    :raises ValueError: for a message type that is not there, or a bag that cannot be made.
    """

    def __init__(self, path: str, topics: dict[str, str]) -> None:
        super().__init__('recorder')
        for topic, msgtype in topics.items():
            self.create_subscription(
                message_class(msgtype), topic, partial(self._write, topic, msgtype),
                QoSProfile(depth=100), raw=True)
        self._bag = BagWriter(path)
        self.get_logger().info(f'recording {", ".join(topics)} to {path}')

    def record(self) -> int:
        """Record until asked to end, close the bag, and return the exit code."""
        try:
            # To close a long recording takes longer than the deadline of a shutdown.
            with no_exit_deadline(), self._bag:
                spin(self)
                print(f'closing {self._bag.path}', flush=True)
        except BagError as error:
            kept = ('; the recording so far is kept, marked incomplete'
                    if incomplete(self._bag.path) else '')
            print(f'error: {error}{kept}', file=sys.stderr)
            return 1
        return 0

    def _write(self, topic: str, msgtype: str, data: bytes) -> None:
        self._bag.write(topic, msgtype, time.monotonic_ns(), data)


def main(args: list[str] | None = None) -> int:
    """Record until Ctrl-C and return the exit code."""
    parser = argparse.ArgumentParser(prog='recorder', description='Record topics to a bag.')
    parser.add_argument('bag', help='folder to create')
    parser.add_argument('topics', nargs='+', metavar='TOPIC:TYPE',
                        help='such as neighbors:nav_msgs/msg/Odometry')
    options, ros_args = parser.parse_known_args(args)
    topics = {}
    for item in options.topics:
        topic, colon, msgtype = item.partition(':')
        if not colon:
            parser.error(f'{item}: must be TOPIC:TYPE')
        topics[topic] = msgtype
    return run(lambda: Recorder(options.bag, topics), ros_args, Recorder.record)


if __name__ == '__main__':
    sys.exit(main())
