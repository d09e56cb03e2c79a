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

"""One node without an executor: a test calls its callbacks, and keeps what it publishes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
import time
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock

from flock_follower.messages import stamp_to_nanoseconds
from flock_follower.messages.state_writer import odometry
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp

START = 1_700_000_000 * 10**9  # ns: where a real bag's clock begins
DEADLINE = 40.0  # s for anything awaited: a busy machine takes its time


def overrides(**values: Any) -> list[Parameter]:
    """Return parameters for the constructor of a node."""
    return [Parameter(name, value=value) for name, value in values.items()]


def as_taken(subscription: Subscription, message: Any) -> Any:
    """Return a message as a subscription passes it to its callback."""
    return serialize_message(message) if subscription.raw else message


def to_odometry(stamp: Time, *fields: Any) -> Any:
    """Return an Odometry message of rclpy; for the fields see ``state_writer.odometry``."""
    return odometry(make, stamp_to_nanoseconds(stamp), *fields)


class Driven:
    """
    Drives a node; ``sent`` holds the messages that it published, by topic.

    :param node: the node, made with its parameters.
    """

    def __init__(self, node: Any) -> None:
        self.node = node
        self.now = START
        self.sent: dict[str, list[Any]] = defaultdict(list)
        self.diagnostics = node.diagnostics
        self.counters = node.diagnostics.counters
        space = node.get_namespace().rstrip('/')
        for publisher in node.publishers:
            name = publisher.topic_name.removeprefix(f'{space}/').lstrip('/')
            publisher.publish = self.sent[name].append

    @property
    def values(self) -> dict[str, Any]:
        """Return the values of /diagnostics."""
        return dict(self.diagnostics.shown(time.monotonic()))

    def give(self, topic: str, message: Any, number: int | None = None,
             received: int | None = 0) -> None:
        """Pass a message to the callbacks of a topic, some with its number and its arrival, ns."""
        name = self.node.resolve_topic_name(topic)
        subscriptions = [s for s in self.node.subscriptions if s.topic_name == name]
        assert subscriptions, f'{topic} is not subscribed'
        info = {'publication_sequence_number': number, 'received_timestamp': received}
        for each in subscriptions:
            informed = each._callback_type is Subscription.CallbackType.WithMessageInfo
            each.callback(as_taken(each, message), *([info] if informed else []))

    def turn(self) -> None:
        """Call the timers that are due."""
        for timer in self.node.timers:
            if timer.is_ready():
                timer.handle.call_timer()
                timer.callback()

    def pass_time(self, now: int) -> None:
        """Set /clock to a time, ns, and call the timers that are due then."""
        self.now = now
        self.give('/clock', Clock(clock=nanoseconds_to_stamp(now)))
        self.turn()

    def wait(self, condition: Callable[[], object]) -> None:
        """Turn until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not condition():
            assert time.monotonic() < end, ('waited in vain', self.problems(), self.counters)
            self.turn()
            time.sleep(0.001)

    def call(self, name: str, **fields: Any) -> Any:
        """Call a service; return its response."""
        service = next(
            s for s in self.node.services if f'/{s.srv_name}'.endswith(f'/{name}'))
        return service.callback(service.srv_type.Request(**fields), service.srv_type.Response())

    def problems(self, ahead: float = 0.0) -> str:
        """Return the problems of /diagnostics, now or after some seconds of the same."""
        return '; '.join(text for _, text in self.diagnostics.problems(time.monotonic() + ahead))

    def set(self, **values: Any) -> str:
        """Set parameters at once; return why they were refused, or ''."""
        result = self.node.set_parameters_atomically(overrides(**values))
        assert result.successful or result.reason
        return str(result.reason)

    def close(self) -> None:
        """Destroy the node."""
        self.node.destroy_node()
