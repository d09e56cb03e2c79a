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
Diagnostics of the MAVLink bridge: the values and problems in the bridge's state.

The executor's thread calls all but ``take``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import math
import time

from flock_follower.gate.motion_sources import onset
from flock_follower.gate.permission import Cause, MODE_TIMEOUT, Phase
from flock_follower.gate.setpoint_rules import COMMAND, LEVEL, NONE
from flock_follower.mavlink import estimator_health
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.commands import TAKEOFF
from flock_follower.mavlink.odometry_forwarding import FORWARDING_GAP
from flock_follower.messages.bridge_diagnostics import (
    ARMED,
    FLYING,
    LINK_FAULT,
    MISSING,
    NO_ANSWERS,
    NOT_READY,
    PARAMETER,
    REFUSED,
    UNANSWERED,
    UNPROVEN,
    UNREAD,
)
from flock_follower.nodes.support.diagnostics import ERROR, Problem, WARN
from flock_follower.nodes.support.remote_parameters import WatchedParameters
from flock_follower.nodes.support.runtime import FlockNode
from flock_follower.nodes.support.sole_publisher import SolePublisher

REPORTED_SILENCE = 3.0  # s without an autopilot after which the node reports it
STUCK = 0.2  # s without a setpoint that was due
HEIGHTS_DIFFER = 1.0  # m: a larger difference of barometer and estimate is reported
#: Limits that should be equal in planner and bridge.
LIMITS = ('a_max', 'v_max')


class BridgeProblems:
    """
    Reports the values and problems of the bridge in the diagnostics of its node.

    :param dropped: returns how many publications were dropped.
    """

    def __init__(self, node: FlockNode, bridge: Bridge, dropped: Callable[[], int]) -> None:
        self._node, self._bridge, self._dropped = node, bridge, dropped
        self._start = time.monotonic()
        self._last: Cycle | None = None
        self._stuck_since = math.inf
        self._bytes = (self._start, 0, 0)
        self.commanders = SolePublisher(node, 'command/trajectory')
        self.planner = WatchedParameters(node, 'planner', self._is_armed)
        self.perception = WatchedParameters(node, 'relative_pose', self._is_armed)
        node.diagnostics.sources += [self._vehicle_values, self._gate_values, self._link_values]
        node.diagnostics.checks += [
            self._setpoint_problem, self._publisher_problem,
            *(partial(_problem, level, reason) for level, reason in (
                (ERROR, self._link_fault), (ERROR, bridge.link.identity.conflict),
                (ERROR, self._end_requests), (ERROR, self._forwarding_fault),
                (WARN, self._estimate_fault), (WARN, bridge.housekeeping.too_slow),
                (WARN, lambda _: bridge.housekeeping.watch.obstacle()),
                (WARN, bridge.gate.contradiction), (WARN, bridge.gate.thrust_error),
                (WARN, lambda _: bridge.gate.motion.lateness()),
                (WARN, self._planner_differs), (WARN, self.planner.changed_in_flight),
                (WARN, self.perception.changed_in_flight), (WARN, self._heights_differ),
                (WARN, self._battery_unknown)))]

    def take(self, cycle: Cycle, now: float) -> None:
        """Take the newest cycle, in the setpoint thread."""
        due = cycle.setpoint.kind != NONE and not cycle.sent
        self._stuck_since = onset(self._stuck_since, due, now)
        self._last = cycle

    def _vehicle_values(self, now: float) -> dict[str, object]:
        """Return the state of autopilot and flight, and reasons against offboard and arming."""
        bridge, telemetry = self._bridge, self._bridge.telemetry
        status, flying, unready = bridge.status(now), telemetry.is_flying(now), bridge.unready(now)
        result, unreceived = (
            bridge.housekeeping.parameters.result(), bridge.housekeeping.unreceived_reason(now))
        values: dict[str, object] = {
            'link': ('one way' if unreceived else 'alive') if bridge.alive(now) else (
                'lost' if telemetry.status else 'never received'),
            NO_ANSWERS: unreceived,
            UNANSWERED: ', '.join(bridge.link.questions.unknown(now)),
            'autopilot': telemetry.dialect.title if telemetry.dialect else '',
            'firmware': str(bridge.housekeeping.parameters.version or ''),
            'mode': status.mode if status else '', ARMED: status.armed if status else '',
            FLYING: '' if flying is None else flying, 'state': bridge.state(now),
            'handed_over': bridge.end.why, LINK_FAULT: bridge.link.transport.fault,
            REFUSED: (self.commanders.conflict() or bridge.refusal(now)) if (
                bridge.alive(now)) else ''}
        if unready is not None:
            values[NOT_READY] = unready
        if result is not None:
            values['parameters'] = (f'{result.differing} of {result.answered} differ, '
                                    f'{result.unanswered} unanswered')
            for key, texts in ((PARAMETER, result.lines), (MISSING, result.missing)):
                values |= {key + name: rest for name, _, rest in (
                    text.partition(' ') for text in texts)}
            if result.unread:
                values[UNREAD] = ', '.join(result.unread)
            if result.unproven:
                values[UNPROVEN] = result.unproven
        return values

    def _gate_values(self, now: float) -> dict[str, object]:
        """Return the newest setpoint, and the checks and estimates of the gate."""
        gate, setpoint = self._bridge.gate, self._last.setpoint if self._last else None
        place, difference = gate.place(now), gate.yaw_difference(now)
        return {
            'setpoint': setpoint.kind if setpoint else NONE,
            'limited_by': setpoint.limited if setpoint else '',
            'yaw_difference_deg': '' if difference is None else f'{math.degrees(difference):.1f}',
            'wind_m_s2': f'{gate.wind:.2f}',
            'thrust_offset_m_s2': f'{gate.thrust_offset:.2f}',
            'height_m': 'unknown' if place.height is None else f'{place.height:.2f}',
            'distance_from_start_m': 'unknown' if place.offset is None else (
                f'{math.hypot(*place.offset.tolist()):.2f}'),
            'displacement_check': (
                'height only: the autopilot fuses the odometry, and cannot confirm it'
                if gate.autopilot.fused else 'odometry against the autopilot, and height')}

    def _link_values(self, now: float) -> dict[str, object]:
        """Return rates, the share of a serial line in use, and counters."""
        bridge, link = self._bridge, self._bridge.link
        before, came, went = self._bytes
        self._bytes = now, link.bytes_received, link.bytes_sent
        values: dict[str, object] = {
            'dropped: publishing took too long': self._dropped(),
            'longest_pause_s': f'{bridge.telemetry.arrivals.longest_pause(now):.2f}',
            **{f'{name}_hz': f'{hertz:.1f}'
               for name, hertz in bridge.housekeeping.rates(now).items()},
            **{f'ignored: {kind}': count for kind, count in link.ignored.copy().items()}}
        if link.transport.capacity:
            full = link.transport.capacity * max(now - before, 1e-3)
            values['line_in_percent'] = f'{100.0 * (link.bytes_received - came) / full:.0f}'
            values['line_out_percent'] = f'{100.0 * (link.bytes_sent - went) / full:.0f}'
        if bridge.forwarder is not None:
            values |= {f'odometry: {k}': n for k, n in bridge.forwarder.counters.copy().items()}
        return values

    # Problems; '' or None without one.

    def _link_fault(self, now: float) -> str:
        telemetry, transport = self._bridge.telemetry, self._bridge.link.transport
        if self._bridge.alive(now):
            if transport.fault:
                return f'cannot send on {transport.url}: {transport.fault}'
            age = telemetry.mode_age(now)
            return self._bridge.housekeeping.unreceived_reason(now) or (
                '' if age <= MODE_TIMEOUT else
                f'mode unknown: neither HEARTBEAT nor CURRENT_MODE for {age:.1f} s')
        received = telemetry.message_time
        if transport.fault:
            return f'no autopilot on {transport.url}: {transport.fault}'
        if math.isfinite(received):
            return f'autopilot lost on {transport.url}, silent for {now - received:.1f} s'
        return '' if now - self._start < REPORTED_SILENCE else (
            f'no autopilot on {transport.url}: {self._bridge.link.silence()}')

    def _estimate_fault(self, now: float) -> str:
        telemetry = self._bridge.telemetry
        if now - self._start < REPORTED_SILENCE or not self._bridge.alive(now):
            return ''
        missing = [name for name, newest in (('LOCAL_POSITION_NED', telemetry.local_position),
                                             ('ATTITUDE_QUATERNION', telemetry.attitude))
                   if newest is None or now - newest.time > REPORTED_SILENCE]
        if missing:
            return f'the autopilot sends no {" and no ".join(missing)}: is its estimator ready?'
        distrusted = self._bridge.velocity_fault(now)
        return distrusted and estimator_health.explain_refusal(
            f"the autopilot's velocity {distrusted}", telemetry.estimator, now)

    def _end_requests(self, now: float) -> str:
        """Return the requests by which the bridge itself ends this flight, and their results."""
        status = self._bridge.status(now)
        return '' if status is not None and not status.armed else '; '.join(
            f'the bridge requests {request.goal.name}: {why}'
            + (f' ({request.outcome.message})' if request.outcome else '')
            for request, why in ((self._bridge.blind_landing, 'no valid velocity'),
                                 (self._bridge.handover, self._bridge.end.why))
            if request is not None and why)

    def _heights_differ(self, now: float) -> str:
        status, height = self._bridge.status(now), self._bridge.gate.heights.height(now)
        estimate = self._bridge.telemetry.height_above_home(now)
        if not (status and status.armed) or height is None or estimate is None or (
                abs(height - estimate) <= HEIGHTS_DIFFER):
            return ''
        return (f'the autopilot estimates its height above home as {estimate:.1f} m, the '
                f'barometer measures {height:.1f} m')

    def _battery_unknown(self, now: float) -> str:
        status = self._bridge.status(now)
        return 'the autopilot reports no battery charge: battery_low cannot act' if (
            status and status.armed and self._bridge.end.battery_unknown(now)) else ''

    def _is_armed(self) -> bool:
        status = self._bridge.telemetry.status
        return status is not None and status.armed

    def _planner_differs(self, now: float) -> str:
        """Return the limits that differ from those of the planner as text, or ''."""
        values, limits = self.planner.values or {}, self._bridge.gate.limits
        return '; '.join(
            f'{name} = {values[name]:g} of the planner, but {getattr(limits, name):g} of '
            'mavlink_bridge: the lower one acts' for name in LIMITS
            if values.get(name) not in (None, getattr(limits, name)))

    def _forwarding_fault(self, now: float) -> str:
        forwarder = self._bridge.forwarder
        silence = 0.0 if forwarder is None else forwarder.silence(now)
        return 'forward_odometry: no ODOMETRY sent' + (
            f' for {silence:.1f} s' if math.isfinite(silence) else ' yet') if (
            silence > FORWARDING_GAP and self._bridge.alive(now)) else ''

    def _setpoint_problem(self, now: float) -> Problem | None:
        if self._last is None:
            return None
        bridge, setpoint = self._bridge, self._last.setpoint
        if now - self._stuck_since > STUCK:
            transport = bridge.link.transport
            return ERROR, (f'no setpoint was sent for {now - self._stuck_since:.1f} s: '
                           f'{transport.url}: {transport.fault or "is blocked"}')
        permission, status = bridge.gate.permission, bridge.status(now)
        unserved = status is not None and status.offboard and not self._takes_off(now)
        silent = permission.cause is Cause.SILENT
        if status is not None and status.armed and not permission.streams and (
                unserved or silent or permission.phase is Phase.TAKEN_OVER):
            level = ERROR if silent else WARN
            return level, (f'no setpoints are sent: {permission.reason}; call '
                           'mavlink_bridge/offboard to request offboard')
        if setpoint.kind == NONE and not bridge.withheld():
            return ERROR, f'no setpoints are sent: {setpoint.reason}'
        if setpoint.kind in (COMMAND, NONE) or not bridge.gate.flies:
            return None
        if setpoint.kind == LEVEL:
            return ERROR, f'only level setpoints: {setpoint.reason}, and no other velocity'
        return WARN, f'braking: {setpoint.reason}'

    def _takes_off(self, now: float) -> bool:
        """
        Return whether a take-off explains an offboard mode that misses no setpoint.

        ArduPilot takes off in GUIDED, and stays in GUIDED after the climb.
        """
        telemetry, newest = self._bridge.telemetry, self._bridge.requests.newest
        if telemetry.dialect is None or not telemetry.dialect.setpoints_end_takeoff:
            return False
        requested = newest is not None and newest.goal.command == TAKEOFF and (
            newest.outcome is None or newest.outcome.success)
        return requested or telemetry.is_flying(now) is False

    def _publisher_problem(self, now: float) -> Problem | None:
        permission = self._bridge.gate.permission
        if permission.cause is Cause.CONTESTED:
            return ERROR, (f'{permission.reason}; the bridge brakes until '
                           'mavlink_bridge/offboard true')
        # A warning: a planner that was killed and has started again is seen twice for a while.
        conflict = self.commanders.conflict()
        return (WARN, conflict) if conflict else None


def _problem(level: bytes, reason: Callable[[float], str], now: float) -> Problem | None:
    """Return the reason as a problem, None if it is ''."""
    text = reason(now)
    return (level, text) if text else None
