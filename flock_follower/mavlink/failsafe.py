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

"""Whether the autopilot ends by itself what it was told last, soon after the bridge has died."""

from __future__ import annotations

from typing import Final

from flock_follower.mavlink.dialect import Dialect
from flock_follower.mavlink.parameter_check import ParameterCheck

#: An autopilot may fly the last setpoint for this long, s. ArduPilot's default is 3 s, in which it
#: gained 8.5 m/s, at 2.5 m/s^2, and flew 36 m.
LONGEST: Final[float] = 1.0


def obstacle(dialect: Dialect, parameters: ParameterCheck | None) -> str:
    """Return why the vehicle may not be flown by setpoints, by a parameter of its own, or ''."""
    name = dialect.silence_parameter
    value = None if parameters is None else parameters.values.get(name)
    if value is None or value <= LONGEST:
        return ''
    return (f'{name} = {value:g} s: {dialect.title} would fly the last acceleration for so long '
            f'if the bridge died; set it to {LONGEST:g} s at most (or require_failsafe:=false)')


def unread(dialect: Dialect, parameters: ParameterCheck | None) -> str:
    """Return that the parameter has not been read, having it asked for once more, or ''."""
    name = dialect.silence_parameter
    if parameters is not None and name in parameters.values:
        return ''
    if parameters is not None:
        parameters.again(name)
    return (f'{name} could not be read: for how long would {dialect.title} fly the last '
            'acceleration if the bridge died? (require_failsafe:=false flies all the same)')
