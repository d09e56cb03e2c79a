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
Requests beside the flight: telemetry rates, clock offset, version, parameters, reasons.

Every request is repeated after a reboot of the autopilot, and with another vehicle. When a lost
link returns, only the telemetry is requested again; the answers are kept.

``TimeSync`` measures the offset between the autopilot's clock and ours by TIMESYNC, and answers
the autopilot's own requests. A request has ``tc1 = 0`` and the sender's time in ``ts1``; the
answer has the other clock's time in ``tc1`` and the same ``ts1``. PX4 learns our clock from our
answers; after that, ``time_usec`` of ODOMETRY must be on our clock. Both autopilots answer with
the time since boot (PX4 ``hrt_absolute_time``, ArduPilot ``AP_HAL::micros64``), which is also the
clock of ``time_boot_ms``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
import math
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from flock_follower.mavlink.dialects import Dialect
from flock_follower.mavlink.estimator_health import REPORT_WINDOW
from flock_follower.mavlink.global_origin import GlobalOrigin
from flock_follower.mavlink.link import Link
from flock_follower.mavlink.link_questions import NO_ANSWER, REASONS
from flock_follower.mavlink.parameter_check import applicable_rules, ParameterCheck, Recommendation
from flock_follower.mavlink.parameter_watch import ParameterWatch
from flock_follower.mavlink.sticks import needs_stick_handover
from flock_follower.mavlink.telemetry import HEARTBEAT_PERIOD
from flock_follower.messages import to_nanoseconds

#: Time between two requests of TIMESYNC, s.
TIMESYNC_PERIOD: Final[float] = 1.0
#: The answer with the shortest delay among this many gives the offset.
TIMESYNC_SAMPLES: Final[int] = 10
#: Answers older than this, ns, are not used: clocks drift by up to 0.1 ms/s.
MEMORY: Final[int] = 30_000_000_000
#: In that time the samples of two clocks of the same speed may differ by this, ns.
TOLERANCE: Final[int] = 10_000_000
_MILLISECOND = 1_000_000  # ns
_WRAP = 2**32 * _MILLISECOND  # of time_boot_ms, after 50 days


class Sample(NamedTuple):
    """One answer: the bounds of the autopilot's clock minus ours, ns."""

    most: int
    """Upper bound: the answer was written after the request."""
    least: int
    """Lower bound: the answer was written before its arrival."""
    time: int
    """Time of reception, ns."""


class TimeSync:
    """TIMESYNC on our computer; times are integer nanoseconds of one monotonic clock."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=TIMESYNC_SAMPLES)
        self._asked: deque[int] = deque(maxlen=TIMESYNC_SAMPLES)

    def request(self, now: int) -> Any:
        """Return the request for the autopilot's time."""
        self._asked.append(now)
        return mavlink.MAVLink_timesync_message(0, now)

    def take(self, message: Any, now: int) -> Any | None:
        """Take a TIMESYNC; return the answer if it is a request."""
        if message.tc1 == 0:
            return mavlink.MAVLink_timesync_message(now, message.ts1)
        if message.ts1 in self._asked:  # else another system has sent the request
            self._samples.append(Sample(message.tc1 - message.ts1, message.tc1 - now, now))
        return None

    def age(self, time_boot_ms: int, now: int) -> float:
        """
        Return the largest possible age, s, of a message received now and stamped ``time_boot_ms``.

        An answer is written after its request, so the autopilot's clock is ahead of ours by at
        most ``tc1 - ts1``. Therefore the returned age is never too small: it includes the shortest
        delay of the link to the autopilot. The age is 0 (unknown) if the stamp is 0, before the
        second answer, if the autopilot's clock runs faster or slower than ours (simulators), and
        if the stamp is ahead of the clock of the answers. A stamp behind this clock is used,
        however old it is.
        """
        if not time_boot_ms:
            return 0.0
        samples = [sample for sample in self._samples if now - sample.time <= MEMORY]
        if len(samples) < 2:
            return 0.0
        ahead = min(sample.most for sample in samples)
        if max(sample.least for sample in samples) > ahead + TOLERANCE:
            return 0.0  # contradictory samples: age unknown
        late = (now - time_boot_ms * _MILLISECOND + ahead + _WRAP // 2) % _WRAP - _WRAP // 2
        return max(late, 0) * 1e-9


#: Messages whose rate is too low are requested again after this, s: another program on the line
#: may have set other rates (MAVProxy does, every 15 s).
STREAM_REQUEST_PERIOD: Final[float] = 5.0
#: The messages whose rate is reported.
ESTIMATE: Final[Mapping[str, int]] = MappingProxyType({
    'LOCAL_POSITION_NED': mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    'ATTITUDE_QUATERNION': mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION})
#: The requested rates of other messages of any autopilot, Hz.
RATES: Final[Mapping[int, float]] = MappingProxyType({
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 1.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 20.0,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 20.0,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5})
#: The requested rates of the pilot's sticks, Hz.
STICK_RATES: Final[Mapping[int, float]] = MappingProxyType({
    mavlink.MAVLINK_MSG_ID_MANUAL_CONTROL: 10.0, mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 10.0})
#: An estimate at less than this share of the requested rate is reported.
FEW: Final[float] = 0.5
#: A longer pause in all messages is reported, s: the largest age of a velocity for braking.
PAUSE: Final[float] = 0.3
#: Period of requests for the reasons that prevent arming while disarmed, s.
WHY_PERIOD: Final[float] = 30.0
#: The autopilot reports them within this, s; then an unanswered request is repeated.
WHY_WAIT: Final[float] = 3.0
UNSIGNED: Final[str] = (
    'the autopilot signs its messages and answers none of ours: set signing_key_file')


def wanted_rates(dialect: Dialect, estimate_rate: float, sticks: bool = False
                 ) -> dict[int, float]:
    """
    Return the requested messages by id, and their rates, Hz.

    :param sticks: whether the pilot's sticks are watched.
    """
    return {dialect.mode_message: dialect.mode_rate, dialect.estimator_status: 5.0,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0, **(STICK_RATES if sticks else {}),
            **dict.fromkeys(ESTIMATE.values(), estimate_rate), **RATES}


class Housekeeping:
    """
    Sends HEARTBEAT, requests and origins, and takes the answers.

    :param recommendations: the parameters to compare, by the name of the dialect.
    :param estimate_rate: requested rate of the autopilot's position and attitude, Hz.
    :param origin: latitude, longitude, deg, and height, m, sent to an estimator without an origin.
    :param without_gps: whether odometry is forwarded; PX4 then needs an origin for its Hold. If
        ``origin`` is None, PX4 receives ``global_origin.ANY_ORIGIN``.
    """

    def __init__(self, link: Link, recommendations: Mapping[str, Sequence[Recommendation]] | None,
                 estimate_rate: float, origin: tuple[float, float, float] | None,
                 without_gps: bool = False) -> None:
        self.timesync = TimeSync()
        self.parameters = ParameterCheck()
        self.watch = ParameterWatch()
        self._link = link
        self._recommendations = recommendations or {}
        self._estimate_rate = estimate_rate
        self.origin = GlobalOrigin(link, origin, without_gps)
        self.without_gps = without_gps
        self._heartbeat_sent = -math.inf
        self._timesync_sent = self._why_asked = -math.inf
        self._reasons_since = -math.inf  # time of their first answer, s
        self._vehicle = -1, 0  # reboots, and changes of the vehicle; none was connected
        self._alive_since = math.inf  # s; infinite: it is not connected
        self._requested: dict[int, float] = {}  # when each message was requested last, s

    def take_timesync(self, message: Any, now: float) -> None:
        """Take a TIMESYNC, and answer it if it is a request."""
        if (answer := self.timesync.take(message, to_nanoseconds(now))) is not None:
            self._link.send(answer)

    def step(self, now: float, alive: bool) -> None:
        """Send HEARTBEAT and due requests; ``alive``: whether the autopilot is connected."""
        if now - self._heartbeat_sent >= HEARTBEAT_PERIOD - 1e-3 and self._link.send_heartbeat():
            self._heartbeat_sent = now
        if not alive:
            self._alive_since = math.inf
            self._link.questions.pause()
            status = self._link.telemetry.status
            if status is not None and not status.armed:
                self.origin.begin_again()  # it may reboot: odometry waits for its new origin
            return
        telemetry = self._link.telemetry
        vehicle, dialect = (telemetry.reboots, self._link.peer_changes), telemetry.dialect
        if vehicle != self._vehicle or math.isinf(self._alive_since):
            self._requested, self._alive_since = {}, now
        if vehicle != self._vehicle:
            self._vehicle = vehicle
            self._link.questions.begin_again()
            self._why_asked = self._reasons_since = -math.inf
            self.timesync = TimeSync()  # its clock has restarted
            self.parameters, self.watch = self._new_check(), ParameterWatch()
            self.origin.begin_again()
        self._request_streams(now)
        if now - self._timesync_sent >= TIMESYNC_PERIOD:
            self._timesync_sent = now
            self._link.send(self.timesync.request(to_nanoseconds(now)))
        self.origin.step(None if dialect is None else self.parameters.values.get(
            dialect.gps_switch), now)
        if self.parameters.version_due(now):
            self._link.send_command(mavlink.MAV_CMD_REQUEST_MESSAGE,
                                    (mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,))
        if name := self.parameters.step(now):
            self._link.request_parameter(name)
        self._request_reasons_in_time(now)

    def changes(self) -> list[str]:
        """Return the changes in flight of parameters on which a rule depends."""
        status = self._link.telemetry.status
        return self.watch.step(self.parameters.values, self.parameters.watched_names(),
                               status is not None and status.armed)

    def _request_reasons_in_time(self, now: float) -> None:
        status, answered = self._link.telemetry.status, self._link.questions.answer_time(REASONS)
        if math.isinf(self._reasons_since) and math.isfinite(answered):
            self._reasons_since = answered
        period = WHY_PERIOD if answered >= self._why_asked else WHY_WAIT
        if status is not None and not status.armed and now - self._why_asked >= period:
            self._why_asked = now
            self._link.send_command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, ())

    def watches_sticks(self) -> bool:
        """Return whether the bridge hands over if the pilot moves a stick."""
        return needs_stick_handover(self._link.telemetry.dialect, self.parameters)

    def request_reasons(self) -> None:
        """Request the autopilot's reasons for its last refusal."""
        dialect = self._link.telemetry.dialect
        if dialect is not None and dialect.reports_checks:
            self._link.send_command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, ())

    def has_reasons(self, now: float) -> bool:
        """Return whether the autopilot has answered the request for its reasons."""
        return WHY_WAIT <= now - self._reasons_since < math.inf and (
            now - self._link.questions.answer_time(REASONS) <= 2.0 * WHY_PERIOD)

    def _new_check(self) -> ParameterCheck:
        dialect = self._link.telemetry.dialect
        if dialect is None:
            return ParameterCheck()
        switch = dialect.gps_switch if self.without_gps else ''
        return ParameterCheck(
            self._recommendations.get(dialect.name, ()), dialect,
            needed=[*(rule.name for rule in applicable_rules(dialect, self.without_gps)),
                    *filter(None, (dialect.minimum_takeoff, switch))])

    def unreceived_reason(self, now: float) -> str:
        """Return the evidence that the autopilot does not receive our messages, or ''."""
        if not self._link.questions.is_unanswered(now):
            return ''  # also of one that signs: USB needs no signature
        return NO_ANSWER if self._link.signing or not self._link.autopilot_signs else UNSIGNED

    def rates(self, now: float) -> dict[str, float]:
        """Return the rates of the estimate, Hz, by the message's name."""
        return {name: self._link.telemetry.arrivals.rate(message_id, now)
                for name, message_id in ESTIMATE.items()}

    def too_slow(self, now: float) -> str:
        """Return the fault if the rate of the estimate is too low or the link stalls, or ''."""
        if now - self._alive_since < REPORT_WINDOW + TIMESYNC_PERIOD:
            return ''  # the streams were requested too recently
        problems = [f'{name} comes at {rate:.0f} Hz of {self._estimate_rate:g} requested'
                    for name, rate in self.rates(now).items()
                    if 0.0 < rate < FEW * self._estimate_rate]
        pause = self._link.telemetry.arrivals.longest_pause(now)
        if pause > PAUSE:
            problems.append(f'nothing came from the autopilot for {pause:.2f} s in the last '
                            f'{REPORT_WINDOW:g} s')
        return '; '.join(problems)

    def _request_streams(self, now: float) -> None:
        """Request each message once, and again if its rate is too low."""
        arrivals, dialect = self._link.telemetry.arrivals, self._link.telemetry.dialect
        if dialect is None:
            return
        wanted = wanted_rates(dialect, self._estimate_rate, self.watches_sticks())
        # Permission, braking and heights depend on them, and a request may be lost.
        least = {**wanted, dialect.mode_message: dialect.least_mode_rate}
        due = {message_id: wanted[message_id] for message_id in wanted
               if message_id not in self._requested or (
                   now - self._requested[message_id] >= STREAM_REQUEST_PERIOD
                   and arrivals.too_seldom(message_id, least[message_id], now))}
        self._link.request_streams(due)
        self._requested.update(dict.fromkeys(due, now))
