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

"""Situations of the gate for tests: a vehicle in the air of which little else is known."""

from flock_follower.gate.envelope import Location
from flock_follower.gate.obstacle import Obstacle, Refusal
from flock_follower.gate.relative_flight import Relative
from flock_follower.gate.setpoint_rules import decide
from flock_follower.gate.situation import AcceptedCommand, Held, Situation, VehicleReport

#: What is not known, and what nothing requests.
UNKNOWN = {'withheld': '', 'place': Location(), 'held': Held(), 'relative': Relative(),
           'offset': (0.0, 0.0, 0.0)}


def situation(limits, known, *, command=None, command_age=0.05, source_age=0.2, armed=True,
              airborne=True, link_age=0.1, mode_age=0.5, unplaced='', full=None, **more):
    """Return a situation at the time 0; ages in s, ``unplaced`` a text."""
    return Situation(
        now=0.0, limits=limits, start_limits=full or limits, known=known,
        report=VehicleReport(armed, airborne, link_age, mode_age),
        command=None if command is None else AcceptedCommand(command, -command_age, -source_age),
        unplaced=Refusal(Obstacle.HEIGHT_STALE, unplaced) if unplaced else None,
        **UNKNOWN | more)


def judge_situation(*args, **more):
    """Return the setpoint of such a situation."""
    return decide(situation(*args, **more))
