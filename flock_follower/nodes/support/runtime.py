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

"""The base class of all nodes: validated parameters, diagnostics and guarded callbacks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import functools
import inspect
import time
from typing import Any, ClassVar, TypeVar

from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from flock_follower.nodes.support.diagnostics import Diagnostics, internal_error, STEADY
from flock_follower.nodes.support.parameters import Parameters
from flock_follower.odometry.reader import read_odometry
from flock_follower.parameters.sections import (
    ignored_sections,
    names_for_any_node,
    PARAMETER_FILES,
)
from flock_follower.parameters.spec import Spec

Message = TypeVar('Message')
T = TypeVar('T')
#: Functions that read a type from its bytes faster than rclpy; the results have the same fields.
READERS: dict[Any, Callable[[bytes], Any]] = {Odometry: read_odometry}
#: Bytes of the largest small message. rclpy takes 13 s to deserialize one of 17 MB, and no other
#: thread of the process runs meanwhile.
SMALL_MESSAGE = 4096
LONGEST_WAIT = 1_000_000_000  # ns: every node polls more often


class Waiting(CallbackGroup):
    """
    A group of subscriptions that the executor serves only while ``awaited`` returns True.

    Otherwise their messages wait until the node takes them. Only the executor's thread may change
    the result of ``awaited``: the executor calls it each time before it waits.
    """

    def __init__(self, awaited: Callable[[], bool] = lambda: False) -> None:
        super().__init__()
        self._awaited = awaited

    def can_execute(self, entity: Any) -> bool:
        """Return whether messages are awaited."""
        return self._awaited()

    def beginning_execution(self, entity: Any) -> bool:
        """Return True: only the executor's own thread executes."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


class FlockNode(Node):
    """
    A node with validated parameters, diagnostics, and callbacks that cannot kill it.

    An exception in a callback of a subscription, a timer or a service is counted on /diagnostics
    as an internal error, and logged at most once per 5 s; the node continues. The same holds for
    callbacks of rclpy: ``/clock`` and the services of the parameters. Entities have no QoS events:
    they took a third of the time of every wait, and ``diagnostics.Input`` finds a QoS mismatch.

    ``parameter_files`` are the files of the command line; ``run`` sets them. rclpy does not warn
    if none of their sections is for the node.
    """

    parameter_files: ClassVar[Sequence[str]] = ()

    def __init__(self, name: str, **kwargs: Any) -> None:
        self._table: Parameters[Any] | None = None
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **kwargs)
        self.diagnostics = Diagnostics(self)

    def declare(self, specs: Sequence[Spec], build: Callable[[dict[str, Any]], T],
                flying: Callable[[], bool] = lambda: False) -> Parameters[T]:
        """
        Declare the node's parameters; see :class:`Parameters`.

        :raises ValueError: also if a parameter file has a section that is nearly for this node.
        """
        name = self.get_fully_qualified_name()
        self.diagnostics.values[PARAMETER_FILES] = ', '.join(self.parameter_files)
        for path in self.parameter_files:
            if warning := ignored_sections(path, name):
                self.get_logger().warning(warning)
        self._table = table = Parameters(
            self, specs, build, flying, names_for_any_node(self.parameter_files, name, specs))
        return table

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all or none; the reason of a refusal names parameter, value and range."""
        try:
            if self._table is not None:
                parameter_list = self._table.check(parameter_list)
            return super().set_parameters_atomically(parameter_list)
        except ParameterException:
            raise  # rclpy answers it: an unknown or an immutable parameter
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            self._caught('on parameters', error)
            return SetParametersResult(successful=False, reason=internal_error(error))

    def set_parameters(self, parameter_list: list[Parameter]) -> list[SetParametersResult]:
        """Set one by one; see :meth:`set_parameters_atomically`."""
        return [self.set_parameters_atomically([parameter]) for parameter in parameter_list]

    def subscribe(self, msg_type: type[Message], topic: str, callback: Callable[..., None],
                  qos: QoSProfile, *, required: bool = True, informed: bool = False,
                  largest: int | None = SMALL_MESSAGE) -> Subscription:
        """
        Subscribe; a message whose callback raises is dropped, counted and logged.

        A ValueError is counted as an invalid message of the topic, any other exception as an
        internal error with its place. If a ``required`` topic is silent, /diagnostics has the
        reason. ``informed``: whether the callback also gets rclpy's message info. A message of
        more than ``largest`` bytes is refused before it is deserialized, and counted; None: no
        limit.
        """
        take = self._taker(
            msg_type, topic, callback if informed else lambda message, _: callback(message),
            qos, required, False, largest)
        return self.create_subscription(
            msg_type, topic, lambda message, info: take(message, info), qos,
            raw=largest is not None)

    def poll(self, msg_type: type[Message], topic: str,
             callback: Callable[[Message, int], None], qos: QoSProfile, *,
             required: bool = True, sporadic: bool = False,
             awaited: Callable[[], bool] = lambda: False,
             largest: int = SMALL_MESSAGE) -> Callable[[], None]:
        """
        Subscribe, as :meth:`subscribe`; messages wait until the function returned takes them.

        ``callback`` gets each message and its time of arrival, ns of this node's clock. At 200 Hz
        an executor that wakes for every message takes 19 % of a core, polling 4 %. While
        ``awaited`` returns True, the executor wakes for each message. With ``use_sim_time`` the
        executor always wakes: the rate of the simulated time is unknown, so the time of arrival of
        a waiting message would be unknown.
        """
        simulated = bool(self.get_parameter('use_sim_time').value)

        def taken(message: Any, info: Mapping[str, Any]) -> None:
            callback(message, self.get_clock().now().nanoseconds if simulated
                     else self.arrival(info))

        take = _guarded(self._taker(msg_type, topic, taken, qos, required, sporadic, largest),
                        lambda error: self._caught(f'on {topic}', error))
        handle = self.create_subscription(
            msg_type, topic, lambda message, info: take(message, info), qos,
            callback_group=Waiting((lambda: True) if simulated else awaited), raw=True).handle

        def poll() -> None:
            while (received := handle.take_message(msg_type, True)) is not None:
                take(*received)
        return poll

    def _taker(self, msg_type: type[Any], topic: str, callback: Callable[[Any, Any], None],
               qos: QoSProfile, required: bool, sporadic: bool,
               largest: int | None) -> Callable[[Any, Any], None]:
        """Return a function of a message, as bytes if its size is bounded, and its info."""
        watched = self.diagnostics.watch(topic, msg_type, qos, required, sporadic)
        read = READERS.get(msg_type, functools.partial(deserialize, msg_type))

        def take(message: Any, info: Any) -> None:
            watched.arrived()
            if largest is not None and len(message) > largest:
                self.diagnostics.reject(f'too large {topic}',
                                        f'{len(message)} bytes, at most {largest}')
                return
            try:
                callback(message if largest is None else read(message), info)
            except ValueError as error:
                self.diagnostics.reject(f'invalid {topic}', str(error))
        return take

    def arrival(self, info: Mapping[str, Any]) -> int:
        """Return when the message of an info arrived, ns of this node's clock."""
        now, received = time.time_ns(), info['received_timestamp']
        # Bounded: the clock may have been set meanwhile.
        waited = min(max(now - received, 0), LONGEST_WAIT) if received else 0
        clock: int = self.get_clock().now().nanoseconds
        return clock - waited

    def create_publisher(self, *args: Any, **kwargs: Any) -> Publisher:
        """Create a publisher as rclpy does, without QoS events."""
        return super().create_publisher(*args, **kwargs, event_callbacks=PublisherEventCallbacks(
            use_default_callbacks=False))

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[..., Any],
                            *args: Any, **kwargs: Any) -> Subscription:
        """Subscribe as rclpy does, guarded, and without QoS events."""
        return super().create_subscription(
            msg_type, topic,
            _guarded(callback, lambda error: self._caught(f'on {topic}', error)), *args, **kwargs,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False))

    def create_timer(self, timer_period_sec: float, callback: Callable[..., Any],
                     *args: Any, **kwargs: Any) -> Timer:
        """
        Create a timer as rclpy does, guarded, on steady time: setting the clock does not stop it.

        With ``use_sim_time`` the timer runs on ``/clock``, unless ``clock`` is given.
        """
        if kwargs.get('clock') is None and not self.get_parameter('use_sim_time').value:
            kwargs['clock'] = STEADY
        name = getattr(callback, '__name__', repr(callback))
        return super().create_timer(timer_period_sec, _guarded(
            callback, lambda error: self._caught(f'in timer {name}', error)), *args, **kwargs)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any],
                       *args: Any, **kwargs: Any) -> Service:
        """Serve as rclpy does; a request whose callback raises is answered with the error."""
        def answer(error: Exception) -> Any:
            self._caught(f'in service {srv_name}', error)
            response = srv_type.Response()
            if hasattr(response, 'message'):  # of SetBool and Trigger; success is false
                response.message = internal_error(error)
            return response

        return super().create_service(
            srv_type, srv_name, _guarded(callback, answer), *args, **kwargs)

    def _caught(self, where: str, error: Exception) -> None:
        if not self.context.ok():
            raise error  # during a shutdown rclpy raises from any place
        self.diagnostics.internal_error(where, error)


def deserialize(msg_type: Any, data: bytes) -> Any:
    """
    Return the message of its bytes.

    :raises ValueError: if the bytes are no message of the type.
    """
    try:
        return deserialize_message(data, msg_type)
    except Exception as error:  # of the middleware, each of which has its own
        raise ValueError(f'not a {msg_type.__name__} message: {error}') from None


def _guarded(callback: Callable[..., Any],
             caught: Callable[[Exception], Any]) -> Callable[..., Any]:
    """Return a callback that never raises; the result of ``caught`` replaces an exception."""
    @functools.wraps(callback)
    async def waiting(*args: Any) -> Any:
        try:
            return await callback(*args)
        except Exception as error:
            return caught(error)

    @functools.wraps(callback)
    def plain(*args: Any) -> Any:
        try:
            return callback(*args)
        except Exception as error:
            return caught(error)
    return waiting if inspect.iscoroutinefunction(callback) else plain
