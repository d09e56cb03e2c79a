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

"""Diagnostics of the MAVLink bridge: link, mode, setpoints, latency and problems."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from functools import partial
import math
import time

from rclpy.node import Node

from flock_follower.checks.system import NOT_READY, PARAMETER, REFUSED
from flock_follower.mavlink import estimator_health
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.commands import Request
from flock_follower.mavlink.odometry_forwarding import LONGEST_GAP
from flock_follower.mavlink.parameter_check import ParameterCheck
from flock_follower.mavlink.permission import FELL_SILENT, Phase, TWO_COMMAND
from flock_follower.mavlink.setpoint_rules import COMMAND, LEVEL, NONE
from flock_follower.nodes.support.diagnostics import Diagnostics, ERROR, Problem, rivals, WARN
from flock_follower.nodes.support.parameters import RemoteParameters
from flock_follower.nodes.support.publisher_thread import PublisherThread
from flock_follower.parameters.planner_table import SPECS

PLANNER_PERIOD = 5.0  # s between two requests for the planner's bounds
SILENCE = 3.0  # s without an autopilot after which the node reports it
CLOCK_MISMATCH = 10.0  # s; stamps off by more come from another clock, not from delay
SHOWN = 5.0  # s for which a clock mismatch is shown
#: Bounds of the planner, those of the bridge that they lie in, and the direction that is wider.
PLANNER_BOUNDS = {'altitude_min': ('height_min', -1.0), 'altitude_max': ('height_max', 1.0),
                  'range_max': ('radius_max', 1.0)}
#: Limits that planner and bridge are to have alike.
LIMITS = ('a_max', 'v_max')
HEIGHTS_DIFFER = 1.0  # m, between barometer and estimate, above which it is a warning
STUCK = 0.2  # s without a setpoint that was due


class BridgeReport:
    """Collects events of the setpoint thread and reports them from the executor's thread."""

    def __init__(self, node: Node, diagnostics: Diagnostics, bridge: Bridge,
                 publisher: PublisherThread) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._bridge = bridge
        self._publisher = publisher
        self._start = time.monotonic()
        self._events: deque[Callable[[], None]] = deque(maxlen=10_000)
        self._brakes: Counter[str] = Counter()
        self._last: Cycle | None = None
        self._stuck_since = math.inf
        self._mismatch = (-math.inf, '')
        self._was_alive = False
        self._fault = ''
        self._reboots = 0
        self._reported_check: ParameterCheck | None = None
        self.planner = RemoteParameters(node, 'planner')
        node.create_timer(PLANNER_PERIOD, lambda: self.planner.ask([*PLANNER_BOUNDS, *LIMITS]))
        self._logged: dict[Request, bool] = {}  # whether its result is logged, too
        self._bytes = (self._start, 0, 0)
        alive = self._while_alive
        diagnostics.checks += [
            self._collect,
            partial(_problem, ERROR, self._link_fault),
            partial(_problem, WARN, alive(self._estimate_fault)),
            partial(_problem, WARN, bridge.gate.misaligned),
            self._envelope_problem,
            partial(_problem, ERROR, self._clock_fault),
            self._setpoint_problem,
            partial(_problem, ERROR, alive(self._forwarding_fault)),
            self._publisher_problem]

    # From any thread.

    def cycle(self, cycle: Cycle, now: float) -> None:
        """Record a cycle; called from the setpoint thread."""
        shown = self._diagnostics
        if cycle.sent:
            self._events.append(lambda: shown.rate('stream').tick(now))
        due = cycle.setpoint.kind != NONE and not cycle.sent
        self._stuck_since = min(self._stuck_since, now) if due else math.inf
        if (first := cycle.first) is not None:
            self._events.append(lambda: shown.latency('latency').add(now - first.source_time))
            self._events.append(lambda: shown.latency('tick_latency').add(now - first.time))
        before = self._last.setpoint.kind if self._last else ''
        if before == COMMAND and cycle.setpoint.kind != COMMAND:
            self._brakes[cycle.setpoint.reason] += 1
        self._last = cycle

    def fault(self, where: str, error: Exception) -> None:
        """Record an exception."""
        self._events.append(lambda: self._diagnostics.internal_error(where, error))

    def refused(self, reason: str, detail: str) -> None:
        """Record a dropped input."""
        self._events.append(lambda: self._diagnostics.reject(reason, detail))

    def stamped(self, name: str, age: float) -> None:
        """Note stamps of another clock, by their age, s."""
        if abs(age) > CLOCK_MISMATCH:
            self._mismatch = (time.monotonic(), f'{name} is stamped {abs(age):.0f} s in the '
                              f'{"past" if age > 0 else "future"}: does use_sim_time differ '
                              'between the nodes, or the clock between the machines?')

    # The executor's thread.

    def _planner_differs(self) -> str:
        """Return which limits of the planner are others, which bounds of it set wider, or ''."""
        values, limits = self.planner.values or {}, self._bridge.gate.limits
        usual = {spec.name: spec.default for spec in SPECS}
        found = [f'{name} = {values[name]:g} of the planner, but {getattr(limits, name):g} of '
                 'mavlink_bridge: the lower one acts' for name in LIMITS
                 if values.get(name) not in (None, getattr(limits, name))]
        found += [f'{name} = {values[name]:g} m of the planner is wider than {bound} = '
                  f'{getattr(limits, bound):g} m, which acts'
                  for name, (bound, sign) in PLANNER_BOUNDS.items()
                  if values.get(name) not in (None, usual[name])
                  and sign * (values[name] - getattr(limits, bound)) > 0.0]
        return '; '.join(found)

    def _collect(self, now: float) -> Problem | None:
        """Drain the events, write the log lines that are due, and update all values."""
        while self._events:
            self._events.popleft()()
        self._log_link(now)
        self._log_parameters()
        self._log_own_requests()
        self._diagnostics.parts['bridge'] = {
            **self._vehicle_values(now), **self._gate_values(now), **self._link_values(now)}
        return None

    def _vehicle_values(self, now: float) -> dict[str, object]:
        """Return the state of autopilot and flight; why offboard, and arming, would be refused."""
        bridge, telemetry = self._bridge, self._bridge.telemetry
        status, flying = bridge.status(now), telemetry.flying(now)
        lost = 'lost' if telemetry.status else 'never received'
        unready = bridge.unready(now)
        return {
            'link': 'alive' if status else lost,
            'autopilot': telemetry.dialect.title if telemetry.dialect else '',
            'mode': status.mode if status else '',
            'armed': status.armed if status else '',
            'system_status': status.system_status if status else '',
            'flying': '' if flying is None else flying,
            'state': bridge.state(now),
            'withheld': bridge.withheld(),
            'reboots': self._reboots,
            'handed_over': bridge.end.why,
            REFUSED: bridge.refusal(now) if bridge.alive(now) else '',
            **({} if unready is None else {NOT_READY: unready})}

    def _gate_values(self, now: float) -> dict[str, object]:
        """Return the newest setpoint, and the checks and estimates of the gate."""
        gate, setpoint = self._bridge.gate, self._last.setpoint if self._last else None
        place, altitude = gate.place(now), self._bridge.telemetry.sensor_altitude
        difference, alone = gate.yaw_difference(now), gate.relative.lasts(now)
        return {
            'setpoint': setpoint.kind if setpoint else 'none',
            'reason': setpoint.reason if setpoint else '',
            'limited_by': setpoint.limited if setpoint else '',
            'without_odometry_s': '' if math.isnan(alone) else f'{alone:.1f}',
            'setpoints_sent': self._diagnostics.rate('stream').count,
            'yaw_difference_deg': '' if difference is None else f'{math.degrees(difference):.1f}',
            'wind_m_s2': f'{gate.wind:.2f}',
            'height_m': 'unknown' if place.height is None else f'{place.height:.2f}',
            'height_source': 'unknown' if altitude is None else altitude.source,
            'distance_from_start_m': 'unknown' if place.offset is None else (
                f'{math.hypot(*place.offset.tolist()):.2f}'),
            'jumps': gate.jumps,
            'displacement_check': (
                'height only: the autopilot fuses the odometry, which proves nothing'
                if gate.fused else 'odometry against the autopilot, and height'),
            **{f'braked: {reason}': n for reason, n in self._brakes.copy().items()}}

    def _link_values(self, now: float) -> dict[str, object]:
        """Return rates, bytes per second and their share of a serial line, clock, counters."""
        bridge, link = self._bridge, self._bridge.link
        before, came, went = self._bytes
        self._bytes = now, link.bytes_received, link.bytes_sent
        values: dict[str, object] = {
            'dropped: publishing took too long': self._publisher.dropped,
            'longest_pause_s': f'{bridge.telemetry.arrivals.longest_pause(now):.2f}'}
        for way, count in (('in', link.bytes_received - came), ('out', link.bytes_sent - went)):
            rate = count / max(now - before, 1e-3)
            values[f'bytes_per_s_{way}'] = round(rate)
            if link.transport.capacity:
                values[f'line_{way}_percent'] = f'{100.0 * rate / link.transport.capacity:.0f}'
        for name, hertz in bridge.housekeeping.rates(now).items():
            values[f'{name}_hz'] = f'{hertz:.1f}'
        if (forwarder := bridge.forwarder) is not None:
            values.update({f'odometry: {k}': n for k, n in forwarder.counters.copy().items()})
        values.update({f'ignored: {k}': n for k, n in link.ignored.copy().items()})
        return values

    def _log_link(self, now: float) -> None:
        """Log losses and recoveries."""
        transport, log = self._bridge.link.transport, self._node.get_logger()
        alive, fault, reboots = self._bridge.alive(now), transport.fault, self._reboots
        if fault and not self._fault:
            log.warning(f'{transport.url}: {fault}; trying again until it is back')
        elif self._fault and not fault:
            log.info(f'{transport.url}: open')
        if alive and not self._was_alive:
            log.info(f'HEARTBEAT received on {transport.url}')
        self._reboots = self._bridge.telemetry.reboots
        if self._reboots > reboots:
            log.warning('the autopilot has rebooted: offboard must be requested again')
        self._was_alive, self._fault = alive, fault

    def _log_parameters(self) -> None:
        """Log once which parameters differ from the recommended ones, and why it matters."""
        check = self._bridge.housekeeping.parameters
        result = check.result()
        if result is None:
            return
        lines = {name: rest for name, _, rest in (line.partition(' ') for line in result.lines)}
        self._diagnostics.parts['parameters'] = {
            'parameters': f'{result.differing} of {result.answered} differ, '
                          f'{result.unanswered} unanswered',
            **{f'{PARAMETER}{name}': rest for name, rest in lines.items()}}
        if check is self._reported_check:
            return
        self._reported_check = check
        for line in result.lines:
            self._node.get_logger().warning(f'parameter {line}')
        if result.answered and not result.lines:
            self._node.get_logger().info(
                f'{result.answered} parameters of the autopilot are as recommended')

    def _log_own_requests(self) -> None:
        """Log the bridge's own requests and their results."""
        log = self._node.get_logger()
        for request, why in ((self._bridge.blind_landing, 'no valid velocity'),
                             (self._bridge.handover, self._bridge.end.why)):
            if request is not None and request not in self._logged:
                self._logged[request] = False
                log.error(f'the bridge requests {request.goal.name}: {why}')
            if request is not None and request.outcome is not None and not self._logged[request]:
                self._logged[request] = True
                write = log.warning if request.outcome.success else log.error
                write(request.outcome.message)

    # Problems; '' or None without one.

    def _while_alive(self, reason: Callable[[float], str]) -> Callable[[float], str]:
        return lambda now: reason(now) if self._bridge.alive(now) else ''

    def _link_fault(self, now: float) -> str:
        if self._bridge.alive(now):
            return ''
        transport, received = self._bridge.link.transport, self._bridge.telemetry.message_time
        if transport.fault:
            return f'no autopilot on {transport.url}: {transport.fault}'
        if math.isfinite(received):
            return f'autopilot lost on {transport.url}, silent for {now - received:.1f} s'
        if now - self._start < SILENCE:
            return ''
        return f'no autopilot on {transport.url}: {self._bridge.link.silence()}'

    def _estimate_fault(self, now: float) -> str:
        telemetry = self._bridge.telemetry
        if now - self._start < SILENCE:
            return ''
        missing = [name for name, newest in (('LOCAL_POSITION_NED', telemetry.local_position),
                                             ('ATTITUDE_QUATERNION', telemetry.attitude))
                   if newest is None or now - newest.time > SILENCE]
        if missing:
            return f'the autopilot sends no {" and no ".join(missing)}: is its estimator ready?'
        distrusted = self._bridge.distrusted(now)
        return distrusted and estimator_health.explained(
            f"the autopilot's velocity {distrusted}", telemetry.estimator, now)

    def _clock_fault(self, now: float) -> str:
        seen, what = self._mismatch
        return what if now - seen < SHOWN else ''

    def _forwarding_fault(self, now: float) -> str:
        forwarder = self._bridge.forwarder
        silence = 0.0 if forwarder is None else forwarder.silence(now)
        if silence <= LONGEST_GAP:
            return ''
        return ('forward_odometry: none sent yet' if math.isinf(silence) else
                f'forward_odometry: none sent for {silence:.1f} s')

    def _envelope_problem(self, now: float) -> Problem | None:
        """Return what ends the flight, and which of these checks cannot act."""
        bridge, gate = self._bridge, self._bridge.gate
        if bridge.end.why:
            return ERROR, f'handed over to the autopilot: {bridge.end.why}'
        if warning := gate.thrust_error(now) or self._planner_differs():
            return WARN, warning
        status = bridge.status(now)
        if status is None or not status.armed:
            return None
        height, estimate = gate.heights.height(now), bridge.telemetry.height_above_home(now)
        if height is not None and estimate is not None and (
                abs(height - estimate) > HEIGHTS_DIFFER):
            return WARN, (f'the autopilot estimates its height above home as {estimate:.1f} m, '
                          f'the barometer says {height:.1f} m')
        if bridge.end.battery_unknown(now):
            return WARN, 'the autopilot does not know its battery: battery_low cannot act'
        return None

    def _setpoint_problem(self, now: float) -> Problem | None:
        if self._last is None:
            return None
        bridge, setpoint = self._bridge, self._last.setpoint
        if now - self._stuck_since > STUCK:
            return ERROR, (f'no setpoint was sent for {now - self._stuck_since:.1f} s: '
                           f'{bridge.link.transport.url} is blocked')
        permission, status = bridge.gate.permission, bridge.status(now)
        unserved = status is not None and status.offboard
        silent = permission.reason.startswith(FELL_SILENT)
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

    def _publisher_problem(self, now: float) -> Problem | None:
        reason = self._bridge.gate.permission.reason
        if reason.startswith(TWO_COMMAND):
            return ERROR, f'{reason}; the bridge brakes until mavlink_bridge/offboard true'
        # A warning: a planner that was killed and has started again is seen twice for a while.
        return rivals(self._node, 'command/trajectory', 'command on {}', WARN)


def _problem(level: bytes, reason: Callable[[float], str], now: float) -> Problem | None:
    """Return the reason as a problem, None if it is ''."""
    text = reason(now)
    return (level, text) if text else None
