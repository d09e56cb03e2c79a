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
Work in other processes: children that are always stopped, and tasks for a Dask cluster.

Dask is an extra, ``pip install 'flock_follower[cluster]'``, imported only on request;
its workers need this package in the same version, and the files that tasks name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
import contextlib
from functools import cache
import multiprocessing
import os
from pathlib import Path
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from types import FrameType, TracebackType
from typing import TypeVar

from flock_follower.checks.dead_segments import dead_segments
from flock_follower.checks.processor import (
    Load,
    LOAD_PERIOD,
    LoadMeter,
    longest_wait,
    ran_for,
    stopped,
    waits_of,
)
from flock_follower.checks.reach import PORTS_FROM, PORTS_PER_DOMAIN
from flock_follower.signals import ending
from flock_follower.system.fast_dds import profile_variables

TOO_BUSY_EXIT_CODE = 3
LONGEST_STOP = 60.0  # s until a process is killed, however long it waits for a processor
PORTS = 61_000, 65_400  # Linux gives 32768 to 60999 by itself
#: Where PX4's SIH sends the truth: on the domain of this port the first node would take it.
SIH_TRUTH_PORT = 19_410
#: Valid on every platform, without the one that has this port.
DOMAINS = [i for i in range(1, 101) if i != (SIH_TRUTH_PORT - PORTS_FROM) // PORTS_PER_DOMAIN]
FIND_TIMEOUT = 3.0  # s in which a service that exists is found, on a busy machine too
SCHEDULER_TIMEOUT = 10.0  # s to find the scheduler of a cluster
Given = TypeVar('Given')
Result = TypeVar('Result')

#: Sockets whose names claim domains. Their names end with the process, however it ends.
_CLAIMS: list[socket.socket] = []


def claim_domain() -> int:
    """
    Return a ROS domain id that no other process of this package on this machine uses.

    :raises RuntimeError: if all of ``DOMAINS`` are in use.
    """
    for domain_id in random.SystemRandom().sample(DOMAINS, len(DOMAINS)):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        with contextlib.suppress(OSError):
            claim.bind(f'\0flock_follower domain {domain_id}')  # a name without a file
            _CLAIMS.append(claim)
            return domain_id
    raise RuntimeError('all ROS domains from 1 to 100 are in use on this machine')


_own_domain = cache(claim_domain)


def private_environment(domain_id: int | None = None) -> dict[str, str]:
    """
    Return an environment whose ROS traffic stays on this machine, in a domain of its own.

    :param domain_id: by default one that this process has claimed.
    """
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(_own_domain() if domain_id is None else domain_id),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        **profile_variables('config/dds/fastdds.xml'),
        'PYTHONUNBUFFERED': '1',
    }


def free_udp_port() -> int:
    """
    Return a UDP port of the loopback interface that is free now.

    The port is above the ephemeral ports: otherwise another process, such as DDS, could receive
    the same port before it is used.
    """
    while True:
        port = random.SystemRandom().randrange(*PORTS)
        with contextlib.suppress(OSError), socket.socket(
                socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(('127.0.0.1', port))
            return port


def wait_until(condition: Callable[[], bool], timeout: float, event: str) -> None:
    """
    Wait until the condition holds, looking every 20 ms.

    :raises TimeoutError: naming the ``event`` that did not come within ``timeout`` seconds.
    """
    deadline = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f'waited {timeout:g} s in vain for {event}')
        time.sleep(0.02)


def _end(number: int, frame: FrameType | None) -> None:
    """End this process by an exception, so that ``with`` blocks stop their processes."""
    raise SystemExit(128 + number)


class LateError(RuntimeError):
    """An event did not happen in time; a busy machine can be the cause."""


class TooBusyError(Exception):
    """The machine gave the processes too little processor time to judge them."""


@contextlib.contextmanager
def explained(load: Load | None) -> Iterator[None]:
    """Turn a LateError or TimeoutError of the block into TooBusyError if the load was too high."""
    try:
        yield
    except (LateError, TimeoutError) as error:
        if load is not None and load.busy:
            raise TooBusyError(f'{error}: {load}; close other programs') from error
        raise


def failed(exit_codes: Mapping[str, int | None]) -> list[str]:
    """Return the processes that failed, except those that were ended while they waited."""
    return [name for name, code in exit_codes.items() if code not in (0, TOO_BUSY_EXIT_CODE)]


class Processes:
    """
    A group of child processes with a log file each; leaving the ``with`` block stops them all.

    SIGTERM and SIGHUP (a closed terminal, a job past its time) to the process whose main thread is
    in the block stop them, too. SIGKILL of this process leaves them running. Inside the block a
    thread measures the ``load``; what comes too late on a busy machine is a TooBusyError.

    :param environment: the children's environment, see :func:`private_environment`.
    :param log_folder: where ``NAME.log`` holds each child's stdout and stderr.
    """

    def __init__(self, environment: dict[str, str], log_folder: Path) -> None:
        self.environment = environment
        self.log_folder = log_folder
        self.children: dict[str, subprocess.Popen[bytes]] = {}
        self.load = LoadMeter(lambda: [os.getpid(), *(
            child.pid for child in [*self.children.values()])])
        self._ending: set[str] = set()
        self._left = threading.Event()
        log_folder.mkdir(parents=True, exist_ok=True)

    def start(self, name: str, module: str, arguments: Sequence[str] = (), *,
              show: bool = False, ends: bool = False) -> subprocess.Popen[bytes]:
        """
        Start ``python -m MODULE ARGUMENTS``; a module that ends with .py is a file.

        :param show: leave its output on the terminal. :param ends: whether it ends by itself.
        """
        program = [module] if module.endswith('.py') else ['-m', module]
        command = [sys.executable, *program, *arguments]
        with open(self.log_folder / f'{name}.log', 'wb') as log:
            output = {} if show else {'stdout': log, 'stderr': subprocess.STDOUT}
            # A session of its own: Ctrl-C in the terminal reaches us, and we stop the children.
            child = subprocess.Popen(
                command, env=self.environment, start_new_session=True,
                stdin=subprocess.DEVNULL, **output)  # type: ignore[call-overload]
        self.children[name] = child
        self._ending.discard(name)
        if ends:
            self._ending.add(name)
        return child

    def broken(self) -> str:
        """Return the child that has ended or was stopped, '' if none: load is no cause."""
        for name, child in self.children.items():
            if name not in self._ending:
                if (code := child.poll()) is not None:
                    return f'{name} ended early, with exit code {code}'
                if stopped(child.pid):
                    return f'{name} was stopped by a signal'
        return ''

    def log(self, name: str) -> str:
        """Return the output of a child so far."""
        return (self.log_folder / f'{name}.log').read_text(errors='replace')

    def last_line(self, name: str) -> str:
        """Return the last line that a child has printed so far."""
        return (self.log(name).strip().splitlines() or [f'{name} has printed nothing'])[-1]

    def cpu(self) -> dict[str, float]:
        """Return the CPU time, s, that each running child has used; 0 without /proc."""
        return {name: ran_for(child.pid) for name, child in list(self.children.items())
                if child.poll() is None}

    def wait_for_log(self, name: str, text: str, timeout: float = 40.0) -> None:
        """
        Wait until a child has printed a text.

        :raises TimeoutError: if it does not within ``timeout`` seconds.
        :raises RuntimeError: if the child ends before.
        """
        def printed() -> bool:
            ended = self.children[name].poll() is not None
            if ended and text not in self.log(name):
                raise RuntimeError(f'{name} ended early:\n{self.log(name)}')
            return text in self.log(name)

        wait_until(printed, timeout, f'{name} to print {text!r}')

    def ask(self, service: str, timeout: float = 20.0,
            given_up: Callable[[], str] = lambda: '',
            value: Sequence[str] = ('true',)) -> str:
        """
        Call a service, a SetBool with true, until it succeeds, and return its answer.

        For simulated vehicles, which take a while to be ready and have no pilot: a refused request
        is made again. The command ``call`` itself asks once.

        :param given_up: returns why to stop asking, '' to go on.
        :param value: ``('false',)``, or ``()`` for a Trigger.
        :raises LateError: if it has not succeeded after ``timeout`` seconds, with the reason.
        :raises RuntimeError: if it is given up, or a child is broken.
        """
        name = service.rpartition('/')[2]
        deadline = time.monotonic() + timeout
        while True:
            # Time to find the service, or the last answer would hide why it was refused before.
            left = max(deadline - time.monotonic(), FIND_TIMEOUT)
            child = self.start(name, 'flock_follower.nodes.call',
                               [service, *value, '--timeout', f'{left:g}'], ends=True)
            while child.poll() is None:
                if reason := given_up() or self.broken():
                    raise RuntimeError(reason)
                time.sleep(0.02)
            answer = self.last_line(name)
            if child.returncode == 0:
                return answer
            if time.monotonic() > deadline:
                raise LateError(answer.removeprefix('error: '))

    def stop(self, name: str, timeout: float = 2.0) -> int | None:
        """
        Send SIGINT, wait, and return the exit code; None if SIGKILL was needed.

        1 if it ended earlier by itself and should not. The time for which the child waits for a
        processor is added to ``timeout``; TOO_BUSY_EXIT_CODE if it was ended nevertheless.
        """
        child = self.children[name]
        try:
            if child.poll() is not None:
                return child.returncode or int(name not in self._ending)
            return _stop(child, timeout)
        finally:  # until then its processor time is ours
            del self.children[name]

    def stop_all(self, timeout: float = 2.0) -> dict[str, int | None]:
        """Stop every child, the last started first, and return their exit codes."""
        return {name: self.stop(name, timeout) for name in reversed(list(self.children))}

    def __enter__(self) -> Processes:
        """Let the signals that end a program end the block first, and return the group."""
        # Hundreds of them double the latencies of every node.
        for lock in dead_segments():
            name = lock.name.removesuffix('_el')
            for dead in (lock, lock.with_name(name), lock.with_name(f'sem.{name}_mutex')):
                dead.unlink(missing_ok=True)
        threading.Thread(target=self._measure, daemon=True).start()
        # Python lets only the main thread handle signals.
        main = threading.current_thread() is threading.main_thread()
        self._handlers = {number: signal.signal(number, _end)
                          for number in ending() if main and number != signal.SIGINT}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """
        Stop the children that still run.

        :raises TooBusyError: if a child came too late because the machine was too busy.
        :raises RuntimeError: if a child came too late because it was broken.
        """
        self._left.set()
        fault = self.broken()
        self.stop_all()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if isinstance(error, (LateError, TimeoutError)):
            with explained(self.load.worst()):
                if fault:
                    raise RuntimeError(fault) from error
                raise error

    def _measure(self) -> None:
        """Measure the load until the block is left."""
        while not self._left.wait(LOAD_PERIOD):
            self.load.sample(time.monotonic())


def _stop(child: subprocess.Popen[bytes], timeout: float) -> int | None:
    """Send SIGINT to a child that runs, wait, and return its exit code as ``Processes.stop``."""
    before, begin = waits_of(child.pid), time.monotonic()
    took = waited = 0.0
    child.send_signal(signal.SIGINT)
    while child.poll() is None:
        if took > LONGEST_STOP or took - waited > timeout:
            child.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(0.05)
        waited = max(waited, longest_wait(before, waits_of(child.pid)))
        took = time.monotonic() - begin
    # A node that does not end in time is ended by an alarm of its own.
    if child.returncode in (-signal.SIGKILL, -signal.SIGALRM) and waited > 0.5 * took:
        return TOO_BUSY_EXIT_CODE
    return None if child.returncode == -signal.SIGKILL else child.returncode


def computed(function: Callable[[Given], Result], tasks: Sequence[Given], jobs: int = 1,
             scheduler: str = '') -> Iterator[Result]:
    """
    Yield the results of a function of each task, in their order.

    :param jobs: processes that compute; 1: this one.
    :param scheduler: of a cluster that computes instead, such as ``tcp://192.168.1.5:8786``.
    :raises RuntimeError: if Dask is not installed here.
    :raises OSError: if no scheduler answers there, or it is lost.
    """
    if scheduler:
        yield from _on_cluster(scheduler, function, tasks)
        return
    if jobs == 1:
        yield from map(function, tasks)
        return
    pool = ProcessPoolExecutor(jobs, multiprocessing.get_context('spawn'))
    # Workers inherit the mask: Ctrl-C in a terminal reaches them, too, even while they start.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    results = pool.map(function, tasks)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield from results
    except BaseException:
        # A task runs for up to a minute: its result is no longer needed.
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _on_cluster(address: str, function: Callable[[Given], Result],
                tasks: Sequence[Given]) -> Iterator[Result]:
    try:
        from distributed import CancelledError, Client
    except ImportError as error:
        raise RuntimeError("--scheduler needs Dask: pip install 'flock_follower[cluster]' "
                           f'({error})') from None
    try:
        client = Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f'--scheduler {address}: no scheduler answers there: {error}') from None
    with client:
        futures = client.map(function, tasks, pure=False)
        try:
            while futures:
                result = futures[0].result()
                del futures[0]  # the cluster may forget it
                yield result
        except CancelledError:
            raise OSError(f'--scheduler {address}: the scheduler is lost') from None
        finally:
            client.cancel(futures)
