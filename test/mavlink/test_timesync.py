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

"""TIMESYNC: how late telemetry is known to be."""

from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.mavlink.housekeeping import TimeSync

SECOND = 1_000_000_000
BOOT = 1234.5  # s on our clock, when the autopilot booted


class Clocks:
    """A TimeSync and an autopilot; times are s on our clock, delays those of the line."""

    def __init__(self, *asked, speed=1.0, boot=BOOT, **delays):
        self.sync = TimeSync()
        self.speed = speed
        self.boot = boot
        for time in asked:
            self.ask(time, **delays)

    def theirs(self, time):
        return self.speed * (time - self.boot)

    def ask(self, time, up=0.004, down=0.004):
        question = self.sync.request(round(time * 1e9))
        written = round(self.theirs(time + up) * 1e9)
        assert self.sync.take(mavlink.MAVLink_timesync_message(written, question.ts1),
                              round((time + up + down) * 1e9)) is None

    def age(self, time, down=0.004):
        """Return the age of what is received at a time."""
        stamp = round(self.theirs(time - down) * 1e3) % 2**32
        return self.sync.age(stamp, round(time * 1e9))


def test_the_age_is_the_way_down_and_the_quickest_way_up():
    clocks = Clocks()
    for time, up in ((2000.0, 0.08), (2001.0, 0.02), (2002.0, 0.3)):
        clocks.ask(time, up=up, down=0.1)
    for down in (0.0, 0.03, 0.5, 2.0):
        assert clocks.age(2002.5, down) == pytest.approx(down + 0.02, abs=1e-3)


@pytest.mark.parametrize(('clocks', 'now', 'late', 'age'), [
    # A single answer cannot tell the speed of a clock.
    (Clocks(), 2000.2, 0.55, 0.0), (Clocks(2000.3), 2000.4, 0.55, 0.0),
    (Clocks(2000.3, 2001.3), 2001.4, 0.55, 0.554),
    # However late it is, from the start or by now.
    (Clocks(2000.0, 2001.0, down=1.5), 2004.0, 1.5, 1.504),
    *((Clocks(2000.0, 2001.0, boot=-10_000.0), 2001.5, late, late + 0.004)
      for late in (9.0, 11.0, 3600.0)),
    # Answers that have ceased are no longer believed; nor what comes from the future.
    (Clocks(2000.0, 2001.0), 2029.0, 0.2, 0.204), (Clocks(2000.0, 2001.0), 2031.5, 0.2, 0.0),
    (Clocks(2000.0, 2001.0), 2001.5, -3.0, 0.0),
    # Stamps begin again after fifty days: sent before, and just after.
    *((Clocks(1999.0, 2001.0, boot=2000.5 - 2**32 * 1e-3), now, 0.25, 0.254)
      for now in (2000.3, 2000.6, 2002.0))])
def test_the_age_is_known_from_two_recent_answers(clocks, now, late, age):
    assert clocks.age(now, late) == pytest.approx(age, abs=2e-3)
    assert clocks.sync.age(0, round(now * 1e9)) == 0.0  # autopilots that do not stamp


@pytest.mark.parametrize(('speed', 'late', 'most'), [
    # A simulator that is slower or faster than time is not late; a crystal's drift is followed.
    *((speed, 0.004, 0.05) for speed in (0.1, 0.9, 0.98, 1.02, 10.0)), (1.0 - 1e-4, 0.2, 0.206)])
def test_a_clock_of_another_speed_is_not_late(speed, late, most):
    clocks = Clocks(2000.0, speed=speed)
    for second in range(2001, 2100):
        clocks.ask(second)
        assert second < 2003 or clocks.age(second + 0.5, late) < most
    assert clocks.age(2099.5, late) > 0.2 or late < 0.2


def test_a_question_is_answered_with_our_clock():
    answer = TimeSync().take(mavlink.MAVLink_timesync_message(0, 123), 5 * SECOND)
    assert (answer.tc1, answer.ts1) == (5 * SECOND, 123)
