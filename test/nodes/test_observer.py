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

"""The observer of ``check`` beside running nodes; the rules are tested in test/checks."""

from __future__ import annotations

import time
from typing import Any

from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from flock_follower.nodes.observer import DISCOVERY, Observer


def test_no_arrival_is_counted_before_the_clock_is_known(ros: None, monkeypatch: Any) -> None:
    observer, now = Observer(1.0, '', {}, ''), time.monotonic()
    for at, clock in ((0.1, None), (DISCOVERY + 0.1, 100), (DISCOVERY + 0.2, 101)):
        monkeypatch.setattr(time, 'monotonic', lambda at=at: now + at)
        if clock is not None:
            observer._take_clock(Clock(clock=Time(sec=clock)))
        observer._take('odom', '/odom', serialize_message(Odometry()),
                       {'received_timestamp': time.time_ns()})
    assert observer.seen.topics['/odom'].arrivals == [100.0, 101.0]
    observer.destroy_node()
