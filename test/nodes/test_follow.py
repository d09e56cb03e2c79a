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

"""The command ``follow`` on the desk: keys in a terminal, and the ways in which it may end."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import pty
import select
import subprocess
import sys
import time

import pytest

from flock_desk.program import PROGRAMS
from flock_desk.runs.processes import claim_domain, free_udp_port, private_environment, Processes
from flock_follower import follow
from flock_follower.checks.observations import NodeStatus, Observations

pytestmark = pytest.mark.slow
DEADLINE = 60.0  # s for what takes a few
#: The command without its check, whose result depends on how busy this machine is.
FOLLOW = 'import sys; from flock_follower.nodes.pilot import fly; sys.exit(fly(""))'


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Processes]:
    with Processes(private_environment(claim_domain()), tmp_path) as processes:
        yield processes


class Terminal:
    """The command in a terminal of its own."""

    def __init__(self, desk: Processes) -> None:
        self.keyboard, own = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, '-c', FOLLOW], env=desk.environment,
            start_new_session=True, stdin=own, stdout=own, stderr=own)
        os.close(own)
        self.shown = ''

    def until(self, text: str) -> str:
        """Wait until a text is shown; return what was shown before, and forget all of it."""
        end = time.monotonic() + DEADLINE
        while text not in self.shown:
            assert time.monotonic() < end, f'{text!r} was not shown, but {self.shown[-2000:]}'
            if select.select([self.keyboard], [], [], 0.1)[0]:
                self.shown += os.read(self.keyboard, 4096).decode()
        before, _, self.shown = self.shown.partition(text)
        return before

    def press(self, key: str) -> None:
        os.write(self.keyboard, key.encode())


def test_a_flight_by_keys_that_a_closed_terminal_ends(desk: Processes) -> None:
    port = free_udp_port()
    for name, *words in (
            ('simulator', '-p', f'connection:=127.0.0.1:{port}', '-p', 'scenario:=hover_noisy'),
            ('mavlink_bridge', '-p', f'connection:=udpin:127.0.0.1:{port}'),
            ('relative_pose',), ('planner',)):
        desk.start(name, PROGRAMS[name], ['--ros-args', *words])
    flight = Terminal(desk)
    for key, step in (('o', 'offboard'), ('e', 'engage')):
        before = flight.until(f'press {key} for {step}')  # it is armed and in the air already
        assert 'press a' not in before and 'press t' not in before
        flight.press(key)
    flight.until('the follower flies')
    flight.until('ACTIVE   TRACK   leader ')
    os.close(flight.keyboard)  # the terminal is gone
    assert flight.process.wait(DEADLINE) != 0
    desk.wait_for_log('mavlink_bridge', 'state: INACTIVE: given back (hold requested)')
    desk.wait_for_log('planner', 'disengaged: no more commands')


@pytest.mark.parametrize(('flying', 'arguments', 'flown'), [
    ('True', [], [('', True, False)]), ('False', [], []), ('', [], []), ('True', ['--yes'], [])])
def test_findings_end_it_unless_the_vehicle_is_in_the_air(
        monkeypatch: pytest.MonkeyPatch, flying: str, arguments: list[str],
        flown: list[tuple[str, bool, bool]]) -> None:
    from flock_follower.nodes import observer, pilot
    flights: list[tuple[str, bool, bool]] = []
    seen = Observations(statuses={'mavlink_bridge': NodeStatus(0, '', {'flying': flying})})
    monkeypatch.setattr(observer, 'observe', lambda *_: seen)
    monkeypatch.setattr(pilot, 'fly', lambda *given: flights.append(given) or 0)
    assert follow.main(arguments) == (0 if flown else 1)
    assert flights == flown
