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

"""The process of one node: its start, spin, end by a signal, and exit code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import gc
from importlib import import_module
import itertools
import os
from pathlib import Path
import sys
from typing import Any

import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node

from flock_follower.nodes import ignore_signals, on_signal, set_deadline
from flock_follower.nodes.support.parameters import usage
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.parameters.sections import files_in
from flock_follower.system.files import read_text

LOGGER = 'flock_follower'  # of lines before a node has its name
_GENERATOR = 'rosidl_generator_py.generate_py_impl'


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
    Run one node until Ctrl-C, SIGTERM, SIGHUP or its own end; return the process's exit code.

    ``factory`` creates the node. If it raises a ValueError or OSError (a bad parameter, a missing
    file), the function prints one line on stderr and returns 1. ``spin`` may return another exit
    code. ``args`` None: the arguments of the process. ``--help`` prints the help.
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
    try:  # rclpy names neither the cause nor, for a folder, the file
        for path in files_in(arguments):
            read_text(path)
    except (OSError, ValueError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    node: Node | None = None
    code: int | None = 0
    try:
        try:
            _start_ros(sys.argv if args is None else args)
        except RuntimeError as error:  # malformed --ros-args
            print(f'error: {" ".join(str(error).split())}', file=sys.stderr)
            return 1
        FlockNode.parameter_files = files_in(arguments)
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


def _start_ros(arguments: Sequence[str]) -> None:
    """
    Start ROS, and install the signal handlers that shut ROS down.

    :raises RuntimeError: malformed ``--ros-args``.
    """
    _skip_message_generator()
    # A node without a log flies better than none.
    reason = unwritable_logs(os.environ)
    silent = ['--ros-args', '--disable-external-lib-logs', '--'] if reason else []
    rclpy.init(args=[*silent, *arguments])
    context = rclpy.get_default_context()
    # From Kilted on a shutdown destroys the tracked nodes: in the handler of a signal, while the
    # same thread may hold their locks, and nodes whose constructor raised. `run` destroys its own.
    context.track_node = lambda node: None
    on_signal(context.try_shutdown)
    if reason:
        get_logger(LOGGER).warning(f'logs go to the terminal alone: {reason}')


def _skip_message_generator() -> None:
    """
    Load the type support of messages without the generator of their Python code.

    The generator comes with a parser of grammars: 7 MB and 0.1 s for each node. The type support
    works without the generator if its import fails; setting the module to None lets the import
    fail.
    """
    if _GENERATOR in sys.modules:
        return
    modules: Any = sys.modules
    modules[_GENERATOR] = None
    with suppress(ImportError):  # a middleware without it loads nothing
        import_module(_GENERATOR.partition('.')[0])
    del modules[_GENERATOR]


def unwritable_logs(environment: Mapping[str, str]) -> str:
    """Return why ROS with this environment cannot write a log file; '' if it can."""
    get, home = environment.get, environment.get('HOME', '')
    name = get('ROS_LOG_DIR') or f'{get("ROS_HOME") or "~/.ros"}/log'
    if name.startswith('~') and not home:
        return f'{name}: HOME is not set'
    folder = Path(home + name[1:] if name.startswith('~') else name)
    # Not by tempfile, which loads 14 modules.
    probe = folder / f'.flock_follower_{os.getpid()}'
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            probe.write_bytes(b'.')
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        return f'{folder}: {error.strerror}'
    return ''
