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

"""An exit without a deadline, of nodes that write files."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib

from flock_follower import nodes


@contextlib.contextmanager
def no_exit_deadline() -> Iterator[None]:
    """Set no deadline inside the block: it may need a long time to finish its files."""
    nodes.without_deadline = True
    try:
        yield
    finally:
        nodes.without_deadline = False
