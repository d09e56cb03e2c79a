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

"""Who a neighbour is, as far as that was told beforehand: whether to follow it, and its size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import ClassVar

from flock_follower.messages import DUPLICATE
from flock_follower.ranges import Checked, Range

ROLES = LEADER, FOLLOWER, AVOID = 'leader', 'follower', 'avoid'
RADIUS = Range(0.0, 5.0, 'm')
PHANTOM = ' before'  # behind the name of one that may still be where another was taken for it


@dataclass(frozen=True)
class Member(Checked):
    """
    What is known of a vehicle beforehand.

    :raises ValueError: naming what is wrong, its value and what is valid.
    """

    role: str = LEADER
    """
    A 'leader' does not obey the law and goes where it wants; a 'follower' runs this package, too;
    one to 'avoid' is only kept clear of.
    """
    radius: float = 0.0
    """Of its hull, m: distances are between hulls."""
    faces: tuple[float, ...] = (math.pi,)
    """Directions in which its markers face, anticlockwise from its own, rad."""

    RANGES: ClassVar[dict[str, Range]] = {
        'radius': RADIUS, 'faces': Range(-math.pi, math.pi, 'rad')}
    CHOICES: ClassVar[dict[str, tuple[str, ...]]] = {'role': ROLES}


SEEN, HEARD = Member(LEADER), Member(FOLLOWER)  # strangers


def member(members: Mapping[str, Member], name: str, heard: bool) -> Member:
    """
    Return what is known of a vehicle; of a stranger, that depends on how it is known.

    What carries the marker of another without being it is avoided, and as large as that one.
    """
    base, duplicate, _ = name.removesuffix(PHANTOM).partition(DUPLICATE)
    known = members.get(base, HEARD if heard else SEEN)
    return Member(AVOID, known.radius) if duplicate else known
