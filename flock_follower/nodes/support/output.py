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

"""The output of a node to its terminal."""

from __future__ import annotations

import contextlib
import os
import stat


def never_block_output() -> None:
    """
    Make writes to stdout and stderr fail instead of waiting for a reader.

    Otherwise a terminal that is stopped by Ctrl-S, a broken ssh connection or a full pipe would
    stop the process at its next log line. If a write fails, the line is lost. Output to files is
    not changed.
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
