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

"""What all parts of a scenario have in common: they are checked as they are made."""

from __future__ import annotations

from dataclasses import fields

from flock_follower.ranges import Checked

Interval = tuple[float, float]
Vector = tuple[float, float, float]


class Part(Checked):
    """A part of a scenario, checked as it is made; one number is an interval of that number."""

    def __post_init__(self) -> None:
        intervals = [f.name for f in fields(self)  # type: ignore[arg-type]
                     if f.type == 'Interval']
        for name in intervals:
            value = getattr(self, name)
            if not isinstance(value, tuple):
                object.__setattr__(self, name, (value, value))
        super().__post_init__()
        for name in intervals:
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f'{name} = {[low, high]}: must be [lowest, highest]')
