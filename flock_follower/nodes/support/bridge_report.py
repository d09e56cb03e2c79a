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

"""What the MAVLink bridge tells in /diagnostics: link, mode, setpoints, latency, and problems."""

from __future__ import annotations

from collections import Counter, deque
import math
import time
from typing import Any

from rclpy.node import Node

from flock_follower.checks.words_of_nodes import NOT_READY, PARAMETER, REFUSED
from flock_follower.mavlink import aiding
from flock_follower.mavlink import requests as takeoff
from flock_follower.mavlink.bridge import Bridge, Cycle
from flock_follower.mavlink.commands import Request
from flock_follower.mavlink.odometry_forwarding import LONGEST_GAP
from flock_follower.mavlink.parameter_check import ParameterCheck
from flock_follower.mavlink.permission import FELL_SILENT, Phase, TWO_COMMAND
from flock_follower.mavlink.setpoint_rules import COMMAND, LEVEL, NONE
from flock_follower.mavlink.setpoint_thread import SetpointThread
from flock_follower.nodes.support.diagnostics import Diagnostics, ERROR, Problem, rivals, WARN
from flock_follower.nodes.support.teller import Teller
from flock_follower.parameters.planner_table import SPECS

SILENCE = 3.0  # s without an autopilot after which the node says so
CLOCK_MISMATCH = 10.0  # s; stamps off by more come from another clock, not from delay
SHOWN = 5.0  # s for which a clock mismatch is shown
#: Bounds of the planner, those of the bridge that they lie in, and the direction that is wider.
PLANNER_BOUNDS = {'altitude_min': ('height_min', -1.0), 'altitude_max': ('height_max', 1.0),
                  'range_max': ('radius_max', 1.0)}
HEIGHTS_DIFFER = 1.0  # m, of barometer and estimate, above which it is a warning
STUCK = 0.2  # s without a setpoint that was to leave


class BridgeReport:
    """Collects what happens in the setpoint thread and shows it from the executor's."""

    def __init__(self, node: Node, diagnostics: Diagnostics, bridge: Bridge,
                 stream: SetpointThread, teller: Teller) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._bridge = bridge
        self._stream = stream
        self._teller = teller
        self._start = time.monotonic()
        self._events: deque[tuple[str, float]] = deque(maxlen=10_000)
        self._faults: deque[tuple[str, Exception]] = deque(maxlen=100)
        self._refused: deque[tuple[str, str]] = deque(maxlen=10_000)
        self._brakes: Counter[str] = Counter()
        self._last: Cycle | None = None
        self._stuck_since = math.inf
        self._mismatch = (-math.inf, '')
        self._was_alive = False
        self._fault = ''
        self._reboots = 0
        self._told: ParameterCheck | None = None
        self._wider = ''
        self._own: dict[str, tuple[Request, bool]] = {}  # by cause; whether its result is logged
        self._bytes = (self._start, 0, 0)
        diagnostics.checks += [
            self._collect, self._link_problem, self._signing_problem, self._estimate_problem,
            self._rate_problem, self._frame_problem, self._envelope_problem, self._clock_problem,
            self._setpoint_problem, self._odometry_problem, self._publisher_problem]

    def planner_changed(self, values: dict[str, Any]) -> None:
        """Take the bounds of the planner; note those that were set wider than the bridge's."""
        limits = self._bridge.gate.limits
        usual = {spec.name: spec.default for spec in SPECS}
        self._wider = '; '.join(
            f'{name} = {values[name]:g} m of the planner is wider than {bound} = '
            f'{getattr(limits, bound):g} m, which acts'
            for name, (bound, sign) in PLANNER_BOUNDS.items()
            if values[name] is not None and values[name] != usual[name]
            and sign * (values[name] - getattr(limits, bound)) > 0.0)

    def cycle(self, cycle: Cycle, now: float) -> None:
        """Record what a cycle did; called from the setpoint thread."""
        if cycle.sent:
            self._events.append(('sent', now))
        due = cycle.setpoint.kind != NONE and not cycle.sent
        self._stuck_since = min(self._stuck_since, now) if due else math.inf
        if cycle.first is not None:
            self._events.append(('latency', now - cycle.first.source_time))
            self._events.append(('tick_latency', now - cycle.first.time))
        before = self._last.setpoint.kind if self._last else ''
        if before == COMMAND and cycle.setpoint.kind != COMMAND:
            self._brakes[cycle.setpoint.reason] += 1
        self._last = cycle

    def fault(self, where: str, error: Exception) -> None:
        """Record an exception (any thread)."""
        self._faults.append((where, error))

    def refused(self, reason: str, detail: str) -> None:
        """Record something dropped (any thread)."""
        self._refused.append((reason, detail))

    def stamped(self, name: str, age: float) -> None:
        """Notice stamps that come from another clock."""
        if abs(age) > CLOCK_MISMATCH:
            self._mismatch = (time.monotonic(), f'{name} is stamped {abs(age):.0f} s in the '
                              f'{"past" if age > 0 else "future"}: does use_sim_time differ '
                              'between the nodes, or the clock between the machines?')

    def _collect(self, now: float) -> Problem | None:
        stream = self._diagnostics.rate('stream')
        while self._events:
            name, value = self._events.popleft()
            if name == 'sent':
                stream.tick(value)
            else:
                self._diagnostics.latency(name).add(value)
        while self._faults:
            self._diagnostics.internal_error(*self._faults.popleft())
        while self._refused:
            self._diagnostics.reject(*self._refused.popleft())
        self._tell_link(now)
        self._tell_parameters()
        self._tell_own_requests()
        self._tell_readiness(now)
        status, difference = self._bridge.status(now), self._bridge.gate.yaw_difference(now)
        decision = self._last.setpoint if self._last else None
        flying = self._bridge.telemetry.flying(now)
        lost = 'lost' if self._bridge.telemetry.status else 'never heard'
        dialect = self._bridge.telemetry.dialect
        self._diagnostics.values.update({
            'link': 'alive' if status else lost,
            'autopilot': dialect.title if dialect else '',
            'mode': status.mode if status else '',
            'armed': status.armed if status else '',
            'system_status': status.system_status if status else '',
            'flying': '' if flying is None else flying,
            'setpoint': decision.kind if decision else 'none',
            'reason': decision.reason if decision else '',
            'limited_by': decision.limited if decision else '',
            'setpoints_sent': stream.count,
            'late_cycles': self._stream.late,
            'dropped: publishing took too long': self._teller.dropped,
            'yaw_difference_deg': '' if difference is None else f'{math.degrees(difference):.1f}',
            'velocity_difference_m_s': f'{self._bridge.gate.velocity_difference:.2f}',
            'wind_m_s2': f'{self._bridge.gate.wind:.2f}',
            **self._envelope(now),
            'state': self._bridge.state(now),
            'withheld': self._bridge.withheld(),
            'reboots': self._reboots,
            **self._traffic(now), **self._rates(now), **self._clock(), **self._odometry(),
            **{f'braked: {reason}': n for reason, n in self._brakes.copy().items()},
            **{f'ignored: {reason}': n for reason, n in self._bridge.link.ignored.copy().items()}})
        return None

    def _envelope(self, now: float) -> dict[str, object]:
        """Return where the vehicle is in its envelope, and which comparisons prove nothing."""
        gate = self._bridge.gate
        place, altitude = gate.place(now), self._bridge.telemetry.sensor_altitude
        unknown = 'unknown'
        return {
            'height_m': unknown if place.height is None else f'{place.height:.2f}',
            'height_source': altitude.source if altitude is not None else unknown,
            'distance_from_start_m': unknown if place.offset is None else (
                f'{math.hypot(*place.offset.tolist()):.2f}'),
            'jumps': gate.jumps,
            'displacement_check': (
                'height only: the autopilot fuses the odometry, which proves nothing'
                if gate.fused else 'odometry against the autopilot, and height'),
            'handed_over': self._bridge.end.why}

    def _envelope_problem(self, now: float) -> Problem | None:
        """Tell what ends flights, and what of it cannot act."""
        bridge, gate = self._bridge, self._bridge.gate
        if bridge.end.why:
            return ERROR, f'handed over to the autopilot: {bridge.end.why}'
        if thrust := gate.thrust_error(now):
            return WARN, thrust
        if self._wider:
            return WARN, self._wider
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

    def _tell_link(self, now: float) -> None:
        """Log what was lost and came back."""
        transport, log = self._bridge.link.transport, self._node.get_logger()
        alive, fault, reboots = self._bridge.alive(now), transport.fault, self._reboots
        if fault and not self._fault:
            log.warning(f'{transport.url}: {fault}; trying again until it is back')
        elif self._fault and not fault:
            log.info(f'{transport.url}: open')
        if alive and not self._was_alive:
            log.info(f'autopilot heard on {transport.url}')
        self._reboots = self._bridge.telemetry.reboots
        if self._reboots > reboots:
            log.warning('the autopilot has rebooted: offboard must be requested again')
        self._was_alive, self._fault = alive, fault

    def _tell_parameters(self) -> None:
        """Log once which parameters differ from the recommended ones, and why it matters."""
        check = self._bridge.housekeeping.parameters
        result = None if check is None else check.result
        if result is None:
            return
        self._diagnostics.values['parameters'] = (
            f'{result.differing} of {result.answered} differ, {result.unanswered} unanswered')
        if check is self._told:
            return
        self._told = check
        values = self._diagnostics.values
        for key in [key for key in values if key.startswith(PARAMETER)]:
            del values[key]
        for line in result.lines:
            self._node.get_logger().warning(f'parameter {line}')
            name, _, rest = line.partition(' ')
            values[f'{PARAMETER}{name}'] = rest
        if result.answered and not result.lines:
            self._node.get_logger().info(
                f'{result.answered} parameters of the autopilot are as recommended')

    def _tell_own_requests(self) -> None:
        """Log what nobody but the bridge has requested, and the result."""
        log = self._node.get_logger()
        for cause, request, why in (
                ('blind', self._bridge.blind_landing, 'no velocity can be believed'),
                ('handover', self._bridge.handover, self._bridge.end.why)):
            if request is None:
                continue
            known, logged = self._own.get(cause, (None, False))
            if request is not known:
                log.error(f'the bridge requests {request.goal.name}: {why}')
                logged = False
            if request.outcome is not None and not logged:
                tell = log.warning if request.outcome.success else log.error
                tell(request.outcome.message)
            self._own[cause] = request, request.outcome is not None

    def _tell_readiness(self, now: float) -> None:
        """Show why offboard would be refused, and, in the autopilot's own words, arming."""
        status, values = self._bridge.status(now), self._diagnostics.values
        values[REFUSED] = self._bridge.refusal(now) if status is not None else ''
        values.pop(NOT_READY, None)
        if status is not None and not status.armed and self._bridge.housekeeping.has_told_why(now):
            against = self._bridge.texts.unready(now, status.mode)
            values[NOT_READY] = against and aiding.explained(
                against, self._bridge.telemetry.estimator, now)

    def _traffic(self, now: float) -> dict[str, object]:
        """Return bytes per second, and their share of a serial line."""
        link = self._bridge.link
        before, came, went = self._bytes
        self._bytes = now, link.bytes_received, link.bytes_sent
        seconds = max(now - before, 1e-3)
        rates = {'in': (link.bytes_received - came) / seconds,
                 'out': (link.bytes_sent - went) / seconds}
        shown: dict[str, object] = {
            f'bytes_per_s_{way}': round(rate) for way, rate in rates.items()}
        capacity = link.transport.capacity
        if capacity:
            shown.update({f'line_{way}_percent': f'{100.0 * rate / capacity:.0f}'
                          for way, rate in rates.items()})
        return shown

    def _rates(self, now: float) -> dict[str, object]:
        pause = self._bridge.telemetry.arrivals.longest_pause(now)
        return {'longest_pause_s': f'{pause:.2f}', **{
            f'{name}_hz': f'{rate:.1f}'
            for name, (rate, _) in self._bridge.housekeeping.rates(now).items()}}

    def _clock(self) -> dict[str, object]:
        best = self._bridge.housekeeping.timesync.best
        return {} if best is None else {
            'timesync_offset_ms': f'{best.offset * 1e-6:.3f}',
            'timesync_round_trip_ms': f'{best.way * 1e-6:.3f}'}

    def _odometry(self) -> dict[str, object]:
        forwarder = self._bridge.forwarder
        return {} if forwarder is None else {
            'odometry_resets': forwarder.reset_counter,
            **{f'odometry: {name}': n for name, n in forwarder.counters.copy().items()}}

    def _odometry_problem(self, now: float) -> Problem | None:
        forwarder = self._bridge.forwarder
        if forwarder is None or not self._bridge.alive(now):
            return None
        silence = forwarder.silence(now)
        if silence <= LONGEST_GAP:
            return None
        return ERROR, ('forward_odometry: none sent yet' if math.isinf(silence) else
                       f'forward_odometry: none sent for {silence:.1f} s')

    def _link_problem(self, now: float) -> Problem | None:
        if self._bridge.alive(now):
            return None
        transport = self._bridge.link.transport
        url = transport.url
        if transport.fault:
            return ERROR, f'no autopilot on {url}: {transport.fault}'
        heard = self._bridge.telemetry.message_time
        if math.isfinite(heard):
            return ERROR, f'autopilot lost on {url}, silent for {now - heard:.1f} s'
        if now - self._start < SILENCE:
            return None
        return ERROR, f'no autopilot on {url}: {self._bridge.link.silence()}'

    def _signing_problem(self, now: float) -> Problem | None:
        reason = self._bridge.housekeeping.unheard(now) if self._bridge.alive(now) else ''
        return (ERROR, reason) if reason else None

    def _estimate_problem(self, now: float) -> Problem | None:
        telemetry = self._bridge.telemetry
        if not self._bridge.alive(now) or now - self._start < SILENCE:
            return None
        missing = [name for name, newest in (('LOCAL_POSITION_NED', telemetry.local_position),
                                             ('ATTITUDE_QUATERNION', telemetry.attitude))
                   if newest is None or now - newest.time > SILENCE]
        if missing:
            return WARN, f'the autopilot sends no {" and no ".join(missing)}: has it an estimate?'
        distrusted = self._bridge.distrusted(now)
        return (WARN, aiding.explained(f"the autopilot's velocity {distrusted}",
                                       telemetry.estimator, now)) if distrusted else None

    def _rate_problem(self, now: float) -> Problem | None:
        reason = self._bridge.housekeeping.too_slow(now) if self._bridge.alive(now) else ''
        return (WARN, reason) if reason else None

    def _frame_problem(self, now: float) -> Problem | None:
        reason = self._bridge.gate.misaligned(now)
        return (WARN, reason) if reason else None

    def _clock_problem(self, now: float) -> Problem | None:
        seen, what = self._mismatch
        return (ERROR, what) if now - seen < SHOWN else None

    def _setpoint_problem(self, now: float) -> Problem | None:
        if self._last is None:
            return None
        decision = self._last.setpoint
        if now - self._stuck_since > STUCK:
            return ERROR, (f'no setpoint has left for {now - self._stuck_since:.1f} s: '
                           f'{self._bridge.link.transport.url} takes none')
        permission, status = self._bridge.control.permission, self._bridge.status(now)
        unserved = status is not None and status.offboard and not takeoff.explains_mode(
            self._bridge.requests.newest, self._bridge.telemetry, now)
        silent = permission.reason.startswith(FELL_SILENT)
        if status is not None and status.armed and not permission.streams and (
                unserved or silent or permission.phase is Phase.TAKEN_OVER):
            level = ERROR if silent else WARN
            return level, (f'no setpoints are sent: {permission.reason}; the service '
                           'mavlink_bridge/offboard asks for offboard')
        if decision.kind == NONE and not self._bridge.withheld():
            return ERROR, f'no setpoints are sent: {decision.reason}'
        if decision.kind in (COMMAND, NONE) or not self._bridge.control.flies:
            return None
        if decision.kind == LEVEL:
            return ERROR, f'flying blind and level: {decision.reason}, and no other velocity'
        return WARN, f'braking: {decision.reason}'

    def _publisher_problem(self, now: float) -> Problem | None:
        permission = self._bridge.control.permission
        if permission.reason.startswith(TWO_COMMAND):
            return ERROR, f'{permission.reason}; it brakes until mavlink_bridge/offboard true'
        # A warning: a planner that was killed and has started again is seen twice for a while.
        return rivals(self._node, 'command/trajectory', 'command on {}', WARN)
