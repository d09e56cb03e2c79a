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

"""Parts of the sample bag, changed on the way, for tests that need a bag with something amiss."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from flock_follower.bags.bag import BagMessage, deserialize, open_bag, serialize
from flock_follower.bags.writer import BagWriter
from flock_follower.system.files import resource

SAMPLE = resource('bags/sample')
Change = Callable[[BagMessage], BagMessage | None]


def excerpt(path: Path, seconds: float = 1.2, change: Change = lambda message: message) -> Path:
    """Write the beginning of the sample bag, each message as ``change`` returns it, if it does."""
    with open_bag(SAMPLE) as bag, BagWriter(path) as writer:
        end = bag.start_ns + round(seconds * 1e9)
        changed = [change(message) for message in bag.messages(stop_ns=end)]
        for message in sorted(filter(None, changed), key=lambda message: message.stamp_ns):
            writer.write(*message)
    return path


def without(*topics: str) -> Change:
    """Return a change that leaves topics out."""
    return lambda message: None if message.topic in topics else message


def edited(message: BagMessage, edit: Callable[[Any], None]) -> BagMessage:
    """Return a message after its fields have been edited."""
    fields = deserialize(message.data, message.msgtype)
    edit(fields)
    return message._replace(data=serialize(fields, message.msgtype))
