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

"""The base class of all nodes; their start, guarded callbacks, spin, and clean shutdown."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import functools
import gc
import inspect
import itertools
import math
import os
import stat
import sys
import time
from typing import Any, TypeVar

from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.waitable import Waitable

from flock_follower.nodes import ignore_signals, on_signal, set_deadline
from flock_follower.nodes.support.diagnostics import Diagnostics, internal_error, STEADY
from flock_follower.nodes.support.parameters import usage, ValidatedNode
from flock_follower.odometry.cdr import read_odometry
from flock_follower.parameters.files import files_in

Message = TypeVar('Message')
#: Functions that read a type from its bytes faster than rclpy; the results have the same fields.
READERS: dict[Any, Callable[[bytes], Any]] = {Odometry: read_odometry}
#: Bytes of the largest small message. rclpy takes 13 s to deserialise one of 17 MB, and no other
#: thread of the process runs meanwhile.
SMALL_MESSAGE = 4096
EVENTS_TIME = 0.02  # s of each second in which QoS events are served
READING_TIME = 1e-3  # s within which two clocks are read
LONGEST_WAIT = 1_000_000_000  # ns: every node polls more often


class Waiting(CallbackGroup):
    """
    Holds subscriptions that an executor serves only while ``awaited`` returns True.

    Otherwise their messages wait until a node takes them. The result of ``awaited`` may change in
    the executor's thread only: the executor asks each time before it waits.
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


class FlockNode(ValidatedNode):
    """
    A node with validated parameters, diagnostics, and callbacks that cannot kill it.

    An exception of a callback of a subscription, a timer or a service counts in /diagnostics as
    an internal error and is logged at most once per 5 s; the node lives on. That holds for the
    callbacks of rclpy itself, too: ``/clock`` and the services of the parameters.
    """

    def __init__(self, name: str, **kwargs: Any) -> None:
        self._events = Waiting(lambda: time.monotonic() < self._events_until)
        self._events_until = math.inf
        super().__init__(name, **kwargs)
        self.diagnostics = Diagnostics(self)
        self.diagnostics.checks.append(self._look_at_events)

    def add_waitable(self, waitable: Waitable) -> None:
        """
        Add an entity that the executor waits for, as rclpy does; QoS events once a second.

        Each publisher and subscription has two QoS events, which report incompatible nodes and
        are rare. Waiting for all these events took a third of the time of every wait.
        """
        if isinstance(waitable, EventHandler):
            waitable.callback_group = self._events
        super().add_waitable(waitable)

    def _look_at_events(self, now: float) -> None:
        self._events_until = now + EVENTS_TIME

    def subscribe(self, msg_type: type[Message], topic: str,
                  callback: Callable[[Any], None], qos: QoSProfile, *,
                  timeout: float = 2.0, required: bool = True, of: str = '',
                  informed: bool = False, largest: int | None = SMALL_MESSAGE,
                  **kwargs: Any) -> Subscription:
        """
        Subscribe; a message whose callback raises is dropped, counted and logged.

        A ValueError is an invalid message and counts under its topic; any other exception counts
        as an internal error with its place. A ``required`` topic that is silent for longer than
        ``timeout`` seconds shows in /diagnostics with the reason; ``of``, as ' of camera left',
        qualifies its name there. ``informed``: the callback gets the message and rclpy's message
        info as one pair. A message of more than ``largest`` bytes is refused before it is
        deserialised, and counted; None: any size is taken.
        """
        take = self._watched(
            msg_type, topic, (lambda message, info: callback((message, info))) if informed
            else (lambda message, _: callback(message)), qos, timeout, required, of,
            largest=largest)
        return self.create_subscription(
            msg_type, topic, (lambda message, info: take(message, info)) if informed
            else (lambda message: take(message, None)), qos, raw=largest is not None, **kwargs)

    def poll(self, msg_type: type[Message], topic: str,
             callback: Callable[[Message, int], None], qos: QoSProfile, *,
             timeout: float = 2.0, required: bool = True, of: str = '',
             awaited: Callable[[], bool] = lambda: False,
             largest: int = SMALL_MESSAGE) -> Callable[[], None]:
        """
        Subscribe, as :meth:`subscribe`; messages wait until the function returned takes them.

        ``callback`` gets each message and its time of arrival, ns of this node's clock. At 200 Hz
        an executor that wakes for every message takes 19 % of a core, polling 4 %. While
        ``awaited`` returns True the executor wakes for messages and takes them. With
        ``use_sim_time`` it always does: the rate of that time is unknown, and so is the time of
        arrival of a message that has waited.
        """
        if self.get_parameter('use_sim_time').value:
            self.subscribe(
                msg_type, topic, lambda message: callback(
                    message, self.get_clock().now().nanoseconds), qos, timeout=timeout,
                required=required, of=of, largest=largest)
            return lambda: None

        def taken(message: Any, info: Any) -> None:
            now = time.time_ns()
            age = now - (info['received_timestamp'] or now)
            # Bounded: the clock may have been set meanwhile.
            arrival = self.get_clock().now().nanoseconds - min(max(age, 0), LONGEST_WAIT)
            callback(message, arrival)

        take = _guarded(self._watched(msg_type, topic, taken, qos, timeout, required, of,
                                      largest=largest),
                        lambda error: self._caught(f'on {topic}', error))
        handle = self.create_subscription(
            msg_type, topic, lambda message, info: take(message, info), qos,
            callback_group=Waiting(awaited), raw=True).handle

        def poll() -> None:
            while (received := handle.take_message(msg_type, True)) is not None:
                take(*received)
        return poll

    def _watched(self, msg_type: type[Any], topic: str, callback: Callable[[Any, Any], None],
                 qos: QoSProfile, timeout: float, required: bool, of: str, *,
                 largest: int | None) -> Callable[[Any, Any], None]:
        """Return a function of a message, as bytes if its size is bounded, and its info."""
        watched = self.diagnostics.watch(topic, msg_type, qos, timeout=timeout, required=required,
                                         of=of)
        read = READERS.get(msg_type, functools.partial(_deserialize, msg_type))

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

    def read_clocks(self) -> tuple[int, float]:
        """Return this node's clock, ns, and the monotonic one, s, read at the same time."""
        for _ in range(3):  # a pause between two readings would look like a clock that was set
            before = time.monotonic()
            system: int = self.get_clock().now().nanoseconds
            after = time.monotonic()
            if after - before < READING_TIME:
                break
        return system, 0.5 * (before + after)

    def create_subscription(self, msg_type: Any, topic: str, callback: Callable[..., Any],
                            *args: Any, **kwargs: Any) -> Subscription:
        """Subscribe as rclpy does, guarded."""
        return super().create_subscription(msg_type, topic, _guarded(
            callback, lambda error: self._caught(f'on {topic}', error)), *args, **kwargs)

    def create_timer(self, timer_period_sec: float, callback: Callable[..., Any],
                     *args: Any, **kwargs: Any) -> Timer:
        """
        Create a timer as rclpy does, guarded, on steady time: setting the clock stops none.

        With ``use_sim_time`` it runs on that time, unless ``clock`` is given.
        """
        if kwargs.get('clock') is None and not self.get_parameter('use_sim_time').value:
            kwargs['clock'] = STEADY
        name = getattr(callback, '__name__', repr(callback))
        return super().create_timer(timer_period_sec, _guarded(
            callback, lambda error: self._caught(f'in timer {name}', error)), *args, **kwargs)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[..., Any],
                       *args: Any, **kwargs: Any) -> Service:
        """
        Serve as rclpy does, guarded.

        A request whose callback raises, or returns no response, is answered with ``success``
        false and the error in ``message``, if the type has these fields.
        """
        def answer(error: Exception) -> Any:
            self._caught(f'in service {srv_name}', error)
            response = srv_type.Response()
            if hasattr(response, 'success'):
                response.success = False
            if hasattr(response, 'message'):
                response.message = internal_error(error)
            return response

        return super().create_service(
            srv_type, srv_name, _guarded(callback, answer, srv_type.Response), *args, **kwargs)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set all or none; a callback that raises refuses the change, with the error as reason."""
        try:
            return super().set_parameters_atomically(parameter_list)
        except ParameterException:
            raise  # rclpy answers it: an unknown or an immutable parameter
        except Exception as error:
            self._caught('on parameters', error)
            return SetParametersResult(successful=False, reason=internal_error(error))

    def _caught(self, where: str, error: Exception) -> None:
        if not self.context.ok():
            raise error  # during a shutdown rclpy raises from any place
        self.diagnostics.internal_error(where, error)


def _deserialize(msg_type: Any, data: bytes) -> Any:
    try:
        return deserialize_message(data, msg_type)
    except Exception as error:  # of the middleware, each of which has its own
        raise ValueError(f'not a {msg_type.__name__} message: {error}') from None


def _guarded(callback: Callable[..., Any], caught: Callable[[Exception], Any],
             result: type | None = None) -> Callable[..., Any]:
    """
    Return a callback that never raises; the result of ``caught`` replaces an exception.

    :param result: the type that the callback must return; None: any.
    """
    def checked(returned: Any) -> Any:
        if result is not None and not isinstance(returned, result):
            raise TypeError(f'{type(returned).__name__} returned, not {result.__name__}')
        return returned

    if inspect.iscoroutinefunction(callback):
        @functools.wraps(callback)
        async def waiting(*args: Any) -> Any:
            try:
                return checked(await callback(*args))
            except Exception as error:
                return caught(error)
        return waiting

    @functools.wraps(callback)
    def plain(*args: Any) -> Any:
        try:
            return checked(callback(*args))
        except Exception as error:
            return caught(error)
    return plain


def spin(node: Node) -> None:
    """Spin a node in an executor of its own until it is shut down."""
    if not node.context.ok():
        return
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except ExternalShutdownException:
        pass
    except Exception:
        # During a shutdown rclpy raises from any place.
        if node.context.ok():
            raise
    finally:
        executor.shutdown(timeout_sec=0.5)


def run(factory: Callable[[], Node], args: list[str] | None = None,
        spin: Callable[[Any], int | None] = spin) -> int:
    """
    Run one node until Ctrl-C, SIGTERM or its own end, and return the process's exit code.

    ``factory`` creates the node; a ValueError or OSError it raises (a bad parameter, a missing
    file) becomes one line on stderr and exit code 1. ``spin`` may return an exit code of its own.
    ``args`` None: the arguments of the process. With ``--help`` it prints the help and ends.
    """
    arguments = sys.argv[1:] if args is None else args
    own = list(itertools.takewhile(lambda argument: argument != '--ros-args', arguments))
    if '-h' in own or '--help' in own:
        print(usage(sys.modules[factory.__module__]))
        return 0
    # ROS ignores such an argument: the parameter that it sets would keep its default.
    if stray := next((argument for argument in own
                      if argument.startswith('-') or ':=' in argument), ''):
        print(f'error: {stray}: must come after --ros-args, as --ros-args -p v_max:=1.0',
              file=sys.stderr)
        return 1
    node: Node | None = None
    code: int | None = 0
    try:
        try:
            rclpy.init(args=args)
        except RuntimeError as error:  # malformed --ros-args
            print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
            return 1
        on_signal(rclpy.get_default_context().try_shutdown)
        ValidatedNode.parameter_files = files_in(arguments)
        try:
            node = factory()
        except (ValueError, OSError, NameValidationException) as error:
            if not rclpy.ok():
                return 0  # it failed because it was interrupted
            print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
            return 1
        # The objects made so far stay: to scan them for garbage would be a pause in flight.
        gc.freeze()
        code = spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # During a shutdown rclpy raises from any place.
        if rclpy.ok():
            raise
    finally:
        set_deadline()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return code or 0


def never_block_output() -> None:
    """
    Make writes to stdout and stderr fail instead of waiting for a reader.

    A terminal stopped by Ctrl-S, a hung ssh or a full pipe would otherwise stop the process at its
    next log line. Lines are lost then. Files are left as they are.
    """
    for descriptor in (1, 2):
        with contextlib.suppress(OSError):
            mode = os.fstat(descriptor).st_mode
            if stat.S_ISSOCK(mode):
                os.set_blocking(descriptor, False)
            elif stat.S_ISFIFO(mode) or os.isatty(descriptor):
                # Opened anew: else the flag would also hold for other programs on this terminal.
                own = os.open(f'/proc/self/fd/{descriptor}',
                              os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
                os.dup2(own, descriptor)
                os.close(own)
