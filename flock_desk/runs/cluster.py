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
Work for a Dask cluster: the same results in the same order as here, whatever its workers.

Dask is an extra, ``pip install 'flock_follower[cluster]'``, imported only where it is asked for;
its workers need this package in the same version, and the same files where tasks name some.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Given = TypeVar('Given')
Result = TypeVar('Result')
TIMEOUT = 10.0  # s to find the scheduler


def mapped(address: str, function: Callable[[Given], Result],
           tasks: Sequence[Given]) -> Iterator[Result]:
    """
    Yield what a function makes of each task, in their order, computed by a cluster's workers.

    :param address: of its scheduler, such as ``tcp://192.168.1.5:8786``.
    :raises RuntimeError: if Dask is not installed here.
    :raises OSError: if no scheduler answers there, or it is lost.
    """
    try:
        from distributed import CancelledError, Client
    except ImportError as error:
        raise RuntimeError("--scheduler needs Dask: pip install 'flock_follower[cluster]' "
                           f'({error})') from None
    try:
        client = Client(address, timeout=TIMEOUT, set_as_default=False)
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
