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
Who flies, and when, by the real nodes: as test/desk/test_handover.py has it in lock step.

Each personality of the embedded autopilot flies once, both at the same time; the tests judge what
really happened, by the autopilot's own log, and what bridge and planner said meanwhile.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import itertools
from typing import Any

from handover_flight import CLIMB, HandoverFlight, HEIGHT, HOLDING, PERSONALITIES, Record, Said
import numpy as np
import pytest

from flock_desk.vehicles.mavlink_vehicle import STEP

pytestmark = pytest.mark.slow

LAG = 0.3  # s between what is done and what of it is logged elsewhere, on a busy machine
HEARTBEAT = 1.0  # s between those of PX4, by which the bridge hears of the pilot's switch
SILENCE = 1.0  # s after which the planner takes the bridge for dead
TICK = 0.1  # s, the planner's


@pytest.fixture(scope='module')
def flights(ros: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Future[Record]]:
    """Fly both personalities at the same time, and return what happened."""
    folders = {name: tmp_path_factory.mktemp(name) for name in PERSONALITIES}
    with ThreadPoolExecutor(len(folders)) as pool:
        return {name: pool.submit(HandoverFlight(name, folder).fly)
                for name, folder in folders.items()}


@pytest.fixture(params=PERSONALITIES)
def record(request: pytest.FixtureRequest, flights: dict[str, Future[Record]]) -> Record:
    found = flights[request.param].result()
    print(found.transcript())
    return found


def taken_over(record: Record) -> float:
    """Return when the pilot took over, s, by the autopilot."""
    return float(record.log['state_time'][record.log['mode'] == record.personality.manual][0])


def ends(record: Record) -> list[float]:
    """Return until when each of the three permissions held, s."""
    return [taken_over(record), record.killed, record.ended]


def handovers(record: Record) -> list[tuple[Any, Any, Any]]:
    """Return times (n,), positions and velocities (n, 3) of each stretch flown by setpoints."""
    log, found = record.log, []
    modes = log['mode'][np.searchsorted(log['state_time'], log['setpoint_time']) - 1]
    obeyed = log['setpoint_time'][modes == record.personality.offboard]
    for asked, end in zip(record.asked, ends(record)):
        first = obeyed[obeyed >= asked][0]
        flown = (log['state_time'] >= first) & (log['state_time'] < end)
        found.append((log['state_time'][flown], log['position'][flown], log['velocity'][flown]))
    return found


def word(said: Said) -> str:
    return said.text.partition(':')[0]


def stretches(said: list[Said], words: set[str]) -> list[tuple[float, float]]:
    """Return from when to when, s, one of these words was the last said; inf: to the end."""
    begins = [(wanted, next(group).time) for wanted, group in itertools.groupby(
        said, lambda s: word(s) in words)]
    return [(time, end) for (wanted, time), (_, end) in itertools.pairwise(
        [*begins, (False, np.inf)]) if wanted]


def test_a_handover_keeps_the_altitude(record: Record) -> None:
    for times, position, velocity in handovers(record):
        assert times[-1] - times[0] > 3.0
        first = times < times[0] + 1.0
        altitude = position[:, 2]
        assert np.abs(altitude[first] - altitude[0]).max() < 0.3
        assert np.abs(velocity[~first, 2]).max() <= 0.5
        assert altitude[-50:] == pytest.approx(altitude[0], abs=0.3)  # the last second


def test_what_is_held_after_the_pilots_climb_is_the_new_altitude(record: Record) -> None:
    first, second, third = (position[-50:, 2].mean() for _, position, _ in handovers(record))
    assert first == pytest.approx(HEIGHT, abs=0.3)
    assert second == pytest.approx(first + CLIMB, abs=0.3)
    assert third == pytest.approx(second, abs=0.3)


def test_no_setpoint_comes_while_not_permitted(record: Record) -> None:
    times = record.log['setpoint_time']
    (heard, _), = stretches(record.of('mavlink_bridge/state'), {'TAKEN_OVER'})
    assert heard - taken_over(record) < HEARTBEAT + LAG
    permitted = np.zeros(len(times), bool)
    for asked, end in zip(record.asked, [heard, record.killed, record.ended]):
        permitted |= (times >= asked) & (times < end + LAG)
        assert np.any((times >= asked) & (times < end))
    unasked = times[~permitted] - record.said[0].time
    assert len(unasked) == 0, f'{len(unasked)} setpoints from {unasked[0]:.2f} s on'


def test_the_pilots_switch_alone_never_gives_the_vehicle_back(record: Record) -> None:
    log, (_, again, _) = record.log, record.asked
    left = (log['state_time'] > taken_over(record)) & (log['state_time'] < again)
    modes = [mode for mode, _ in itertools.groupby(log['mode'][left])]
    assert modes == [record.personality.manual, record.personality.given_back]
    # ArduCopter tells a mode at once; the log has it at the end of the step.
    assert log['state_time'][left & (log['mode'] == modes[-1])][0] < again - HOLDING + 2 * STEP
    assert np.abs(log['velocity'][left][-50:]).max() < 0.1  # it stands where the pilot left it


def test_the_planner_is_idle_unless_the_bridge_says_that_it_flies(record: Record) -> None:
    """
    Engaged on the ground it begins when the bridge says so, and never before.

    After the pilot's takeover it begins once it is engaged again, too.
    """
    active = stretches(record.of('mavlink_bridge/state'), {'ACTIVE'})
    busy = stretches(record.of('planner/state'), {'SEARCH', 'TRACK', 'COAST', 'HOLD'})
    assert len(active) == len(busy) == 3
    over = [active[0][1], record.killed + SILENCE, np.inf]
    again = [-np.inf, record.engaged[1], -np.inf]
    for (begun, _), ended, (first, last), engaged in zip(active, over, busy, again):
        assert begun - LAG < first < max(begun, engaged) + TICK + LAG
        assert last <= ended + TICK + LAG


def test_it_follows_after_each_handover(record: Record) -> None:
    for asked, (_, position, _) in zip(record.asked, handovers(record)):
        states = [s.text for s in record.of('planner/state') if s.time > asked]
        assert states[0] == 'TRACK'
        east, north, _ = position[-1] - position[0]
        assert east > 0.1 and abs(north) < 0.1  # after the leader, which flies east


def test_the_bridge_says_what_becomes_of_it(record: Record) -> None:
    words = [said for said, _ in itertools.groupby(map(word, record.of('mavlink_bridge/state')))]
    # The second bridge hears the autopilot before anybody hears the bridge; what was said for less
    # than it takes to be heard, READY, may have been replaced by what came then.
    assert [w for w in words if w not in ('NO_AUTOPILOT', 'READY')] == [
        'INACTIVE', 'ACTIVE', 'TAKEN_OVER', 'ACTIVE', 'INACTIVE', 'ACTIVE']
    assert 'READY' in words
    assert 'Traceback' not in record.logs
