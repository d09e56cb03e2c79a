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

"""The size of the shared memory of this process, for ``check``."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from flock_follower.system.fast_dds import LOCK_SUFFIX, opened_segment_names

#: Share of a file of shared memory that is for messages (measured with Fast DDS 2.14 and 3.2).
_SEGMENT_SHARE: Final = 64 / 67


def shared_memory_size() -> int:
    """Return the size, bytes, of the largest shared memory that Fast DDS sends through; or 0."""
    sizes = [0]
    for name in opened_segment_names():
        with contextlib.suppress(OSError):  # removed
            sizes.append(Path(name.removesuffix(LOCK_SUFFIX)).stat().st_size)
    return round(max(sizes) * _SEGMENT_SHARE)
