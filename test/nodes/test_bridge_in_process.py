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

"""The bridge node in this process: its threads, what it publishes, and what it reports."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
import math
from pathlib import Path
import socket
import threading
import time
from types import SimpleNamespace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from driven import DEADLINE, Driven, overrides, to_odometry
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest
from recorded_situation import read_situation
from std_srvs.srv import SetBool, Trigger

from flock_follower.gate.setpoint_rules import COMMAND
from flock_follower.geometry import quaternion_from_yaw
from flock_follower.mavlink.bridge import Cycle
from flock_follower.mavlink.commands import Outcome
from flock_follower.mavlink.dialects import Version
from flock_follower.mavlink.parameter_check import CheckResult
from flock_follower.messages import to_array
from flock_follower.messages.bridge_diagnostics import REFUSED
from flock_follower.messages.command_writer import trajectory
from flock_follower.messages.commands import Command
from flock_follower.nodes.mavlink_bridge import MavlinkBridge
from flock_follower.nodes.support.conversions import make, nanoseconds_to_stamp
from flock_follower.nodes.support.sole_publisher import SEVERAL
from flock_follower.parameters.sections import PARAMETER_FILES

OWNED = ('arm', 'offboard', 'takeoff', 'land', 'take_command', 'take_motion', 'forward',
         'receive', 'cycle', 'stop')
POSCTL, OFFBOARD = 3 << 16, 6 << 16
SERVICES = {'offboard': SetBool, 'arm': SetBool, 'takeoff': Trigger, 'land': Trigger}


class Bench(Driven):
    """The node, an autopilot, and the threads in which its bridge was called."""

    def __init__(self, **parameters: Any) -> None:
        super().__init__(MavlinkBridge(parameter_overrides=overrides(
            connection='udpin:127.0.0.1:0', **parameters)))
        self.bridge = self.node._bridge
        self.node._report._odometry.get_subscription_count = lambda: 1
        self.log: list[str] = []
        self.node.get_logger = lambda: SimpleNamespace(
            info=self.log.append, warning=self.log.append, error=self.log.append)
        self.calls: list[tuple[str, str]] = []
        owners = self.bridge, self.bridge.requests, self.bridge.gate
        for name in OWNED:
            owner = next(owner for owner in owners if hasattr(owner, name))
            setattr(owner, name, partial(self._note, name, getattr(owner, name)))
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.closed = False

    def _note(self, name: str, function: Callable[..., Any], *arguments: Any,
              **options: Any) -> Any:
        self.calls.append((name, threading.current_thread().name))
        return function(*arguments, **options)

    def count(self, name: str) -> int:
        return sum(called == name for called, _ in self.calls)

    def send(self, *messages: Any) -> None:
        for message in messages:
            self.wire.sendto(message.pack(self.codec), self.bridge.link.transport.address)

    def beat(self, mode: int = OFFBOARD, armed: bool = True) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 129 if armed else 1, mode,
            mavlink.MAV_STATE_ACTIVE, 3))

    def receive(self) -> None:
        """Have the autopilot send what makes the node publish and log; it faces north."""
        self.beat()
        self.send(mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 15200, 1850, 81, *[0] * 6),
                  mavlink.MAVLink_statustext_message(
                      mavlink.MAV_SEVERITY_WARNING, b'words', 0, 0),
                  mavlink.MAVLink_attitude_quaternion_message(0, 1.0, *[0.0] * 5, 0.1),
                  mavlink.MAVLink_local_position_ned_message(
                      0, 1.0, 2.0, -3.0, 0.4, 0.1, -0.2))

    def odometry(self, yaw: float = 0.0, late: int = 0, height: float = 2.0) -> None:
        """Give odometry that has waited for some ns."""
        now = self.node.get_clock().now().nanoseconds - late
        self.node._own._take(to_odometry(
            nanoseconds_to_stamp(now), 'odom', 'base_link', (0.0, 0.0, height),
            quaternion_from_yaw(yaw), (0.0, 0.0, 0.0)), now)
        self.node._hand_over_odom()

    def command(self, east: float = 0.3, age: float = 0.0, number: int | None = 1) -> None:
        now = self.node.get_clock().now().nanoseconds
        self.give('command/trajectory', trajectory(make, Command(
            (east, 0.0, 0.0), 0.0, frame='odom', stamp=now - round(age * 1e9))), number)

    def fly(self) -> None:
        """Permit setpoints to a vehicle that reports that it flies them."""
        self.beat()
        self.send(mavlink.MAVLink_extended_sys_state_message(
            0, mavlink.MAV_LANDED_STATE_IN_AIR))
        self.wait(lambda: self.bridge.telemetry.is_flying(time.monotonic()))
        gate = self.bridge.gate
        self.node._stream.submit(lambda: gate.permit(gate.permission.request(time.monotonic())))
        self.wait(lambda: gate.permission.streams)
        self.beat()
        self.wait(self.node._flying)

    def setpoint(self) -> Any:
        """Return the next setpoint on the wire."""
        end = time.monotonic() + DEADLINE
        self.wire.settimeout(DEADLINE)
        while True:
            assert time.monotonic() < end, 'no setpoint is sent'
            for message in self.codec.parse_buffer(self.wire.recv(4096)) or []:
                if message.get_type() == 'SET_POSITION_TARGET_LOCAL_NED':
                    return message

    def serve(self, name: str, data: bool = False) -> Any:
        kind = SERVICES[name]
        request = kind.Request(data=data) if kind is SetBool else kind.Request()
        return self.node._serve(name, request, kind.Response())

    def ask(self, name: str, data: bool = False) -> Any:
        """Await a service as an executor does; return its answer."""
        answer, ended = self.serve(name, data), []

        def done() -> bool:
            try:
                answer.send(None)
            except StopIteration as stopped:
                ended.append(stopped.value)
            return bool(ended)
        self.wait(done)
        return ended[0]

    def close(self) -> None:
        if not self.closed:
            self.closed = True
            self.node.destroy_node()
            self.wire.close()


@pytest.fixture
def make_bench(ros: None) -> Iterator[Callable[..., Bench]]:
    benches: list[Bench] = []

    def make(**parameters: Any) -> Bench:
        benches.append(Bench(**parameters))
        return benches[-1]
    yield make
    for bench in benches:
        bench.close()


def test_only_the_setpoint_thread_calls_what_changes_the_bridge(make_bench):
    bench = make_bench(forward_odometry=True)
    bench.receive()
    bench.wait(lambda: bench.bridge.telemetry.local_position is not None)
    bench.odometry()
    bench.command()
    for name in SERVICES:
        with suppress(StopIteration):  # refused already
            bench.serve(name).send(None)
    bench.wait(lambda: all(bench.count(name) for name in SERVICES))
    assert bench.set(a_max=1.5) == ''
    bench.wait(lambda: bench.bridge.gate.limits.a_max == 1.5)
    bench.close()
    assert {name for name, _ in bench.calls} == set(OWNED)
    assert {thread for _, thread in bench.calls} == {'stream'}


def test_command_leaves_in_ned_and_refused_one_is_counted(make_bench):
    bench = make_bench()
    bench.fly()
    bench.odometry()
    bench.command(number=1)
    end = time.monotonic() + DEADLINE
    while (sent := bench.setpoint()).afy != pytest.approx(0.3):
        assert time.monotonic() < end, f'no command is sent, but {sent}'
    assert (sent.type_mask, sent.coordinate_frame, sent.afx, sent.yaw) == (
        0x83F, mavlink.MAV_FRAME_LOCAL_NED, 0.0, pytest.approx(math.pi / 2))
    bench.command(east=math.nan, number=2)
    bench.command(age=0.5, number=3)
    counters = bench.counters
    bench.wait(lambda: bench.problems() and counters['command too old'])
    assert counters['command not finite'] == 1


def test_limits_only_fall_in_flight_second_commander_brakes(make_bench):
    bench = make_bench()
    bench.fly()
    assert bench.set(a_max=1.5) == '' and 'can only be lowered' in bench.set(a_max=2.0)
    for number in (None, None, 5, 1):
        assert bench.node._flying()
        bench.command(number=number)
    bench.wait(lambda: not bench.node._flying())
    reason = bench.bridge.gate.permission.reason
    assert reason == 'two nodes command:  on /command/trajectory' and reason in bench.problems()
    assert sum('does not number messages' in text for text in bench.log) == 1
    # What ended the flight can be decided again.
    begin = 'situation of the last decision: '
    bench.wait(lambda: any(text.startswith(begin) for text in bench.log))
    line = next(text for text in bench.log if text.startswith(begin)).removeprefix(begin)
    assert read_situation(line).report.armed


def test_two_commanding_nodes_refuse_offboard_files_are_named(make_bench):
    bench, ends = make_bench(), []
    bench.node.get_publishers_info_by_topic = (
        lambda topic: ends if topic == '/command/trajectory' else [])
    bench.beat()
    bench.wait(lambda: bench.bridge.alive(time.monotonic()))
    for name, named in (('planner', False), ('planner', True), ('mine', True)):
        ends.append(SimpleNamespace(node_name=name, node_namespace='/'))
        for answer in (bench.ask('offboard', True).message, bench.values[REFUSED],
                       bench.problems()):
            assert (SEVERAL in answer) == named
    assert len([s for s in bench.node.subscriptions if s.topic_name == '/diagnostics']) == 1
    for node, file in (('planner', 'a.yaml'), ('planner', ''), ('planner', 'a.yaml'),
                       ('drone2/planner', 'b.yaml')):
        bench.give('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(name=node, values=[
            KeyValue(key='state', value='IDLE'), KeyValue(key=PARAMETER_FILES, value=file)])]))
    nodes = '/mine, /planner (2 times) with a.yaml and with no file on /command/trajectory'
    assert nodes in bench.ask('offboard', True).message
    del ends[1:]  # all but one are ended
    assert SEVERAL not in bench.values[REFUSED] and SEVERAL not in bench.problems()
    assert not [s for s in bench.node.subscriptions if s.topic_name == '/diagnostics']
    assert nodes.split()[0] not in bench.ask('offboard', True).message


def test_it_publishes_estimate_battery_and_place_of_arming(make_bench):
    bench = make_bench()
    bench.beat(armed=False)
    bench.wait(lambda: bench.bridge.telemetry.status)
    bench.odometry()
    bench.receive()
    topics = ('mavlink/odom', 'mavlink/battery', 'mavlink_bridge/armed_at')
    bench.wait(lambda: all(bench.sent[topic] for topic in topics))
    odom, battery, place = (bench.sent[topic][-1] for topic in topics)
    assert (odom.header.frame_id, odom.child_frame_id) == ('odom', 'base_link')
    np.testing.assert_allclose(to_array(odom.pose.pose.position), [2, 1, 3])
    assert odom.pose.pose.orientation.z == pytest.approx(math.sqrt(0.5), abs=1e-6)
    # Forward is north, left is west, up is up.
    np.testing.assert_allclose(to_array(odom.twist.twist.linear), [0.4, -0.1, 0.2], atol=1e-6)
    assert odom.twist.twist.angular.z == pytest.approx(-0.1)
    assert (battery.voltage, battery.current, battery.percentage) == pytest.approx(
        (15.2, -18.5, 0.81))
    assert place.point.z == 2.0
    bench.wait(lambda: 'autopilot: words' in bench.log)
    states = bench.sent['mavlink_bridge/state']
    before = len(states)
    bench.wait(lambda: len(states) > before + 2)  # repeated, though nothing changed
    assert 'INACTIVE: offboard was not requested' in {state.data for state in states}


def test_arming_place_is_unknown_without_odometry_or_after_jump(make_bench):
    bench = make_bench()
    places = bench.sent['mavlink_bridge/armed_at']

    def arm():
        for armed in (False, True):
            bench.beat(armed=armed)
            bench.wait(lambda armed=armed: bench.bridge.telemetry.status is not None and (
                bench.bridge.telemetry.status.armed is armed))
    for count, (act, height) in enumerate((
            (arm, math.nan), (lambda: (bench.odometry(), arm()), 2.0),
            (lambda: (bench.odometry(height=0.1), bench.beat()), math.nan),
            (lambda: (bench.odometry(height=0.1), arm()), 0.1)), 1):
        act()
        bench.wait(lambda count=count: len(places) == count)
        assert places[-1].point.z == pytest.approx(height, nan_ok=True)


def test_odometry_keeps_its_age_on_arrival_however_long_queued(make_bench):
    bench = make_bench()
    bench.odometry(late=150_000_000)
    known = bench.bridge.gate.motion.odometry
    bench.wait(lambda: known.velocity_time > 0.0)
    # Both the velocity and the yaw: lost odometry brakes no later for having been polled.
    for age in (known.velocity_time, known.yaw()[1]):
        assert age == pytest.approx(time.monotonic() - 0.15, abs=0.05)


def test_a_publisher_that_waits_does_not_hold_the_setpoints_up(make_bench):
    bench = make_bench(stream_rate=50.0)
    released, stuck = threading.Event(), []

    def wait(_: Any) -> None:
        stuck.append(threading.current_thread().name)
        assert released.wait(2.0 * DEADLINE)
    bench.node._report._odometry.publish = wait
    bench.receive()
    bench.wait(lambda: stuck)
    cycles = bench.count('cycle')
    bench.wait(lambda: bench.count('cycle') >= cycles + 10)
    assert {*stuck} == {'publisher'}
    released.set()
    assert bench.values['dropped: publishing took too long'] == 0


def test_request_that_raises_is_answered_and_stream_goes_on(make_bench):
    bench = make_bench()
    bench.bridge.requests.land = lambda now: 1 / 0
    answer = bench.ask('land')
    assert (answer.success, answer.message) == (
        False, 'internal error: ZeroDivisionError: division by zero')
    bench.problems()
    assert bench.counters['internal error in the stream'] == 1
    assert 'no HEARTBEAT' in bench.ask('offboard').message  # the thread goes on
    bench.node._stream.stop()
    assert bench.ask('land').message == (
        'refused: the setpoint thread has ended or takes no more')


def test_a_service_that_waits_when_the_bridge_stops_is_answered(make_bench):
    bench = make_bench()
    bench.receive()
    bench.wait(lambda: bench.bridge.telemetry.status is not None)
    waiting = [bench.serve('arm') for _ in range(2)]
    waiting[0].send(None)
    bench.wait(lambda: bench.node._calls[0].request)  # the autopilot never acknowledges
    finish = bench.bridge.finish

    def submit_last(now):
        waiting[1].send(None)  # nothing runs after this
        finish(now)
    bench.bridge.finish = submit_last
    bench.close()
    for service in waiting:
        with pytest.raises(StopIteration) as answered:
            service.send(None)
        response = answered.value.value
        assert not response.success and response.message == 'refused: the bridge is stopping'


def test_faults_of_autopilot_and_link_are_reported(make_bench):
    bench = make_bench(forward_odometry=True)
    assert 'nothing arrives' in bench.problems(ahead=4.0)
    bench.codec.srcSystem = 7
    bench.beat()
    bench.wait(lambda: 'of system id 7, not target_system 1' in bench.problems(ahead=4.0))
    bench.codec.srcSystem = 1
    bench.beat()
    bench.wait(lambda: bench.bridge.alive(time.monotonic()))
    bench.node._report.problems._start -= 4.0
    found = bench.problems()
    for part in ('LOCAL_POSITION_NED and no ATTITUDE_QUATERNION',
                 'forward_odometry: no ODOMETRY sent yet',
                 'mavlink_bridge/offboard to request offboard'):
        assert part in found
    bench.receive()
    bench.odometry(yaw=0.0)
    bench.wait(lambda: 'disagree by' in bench.problems())
    assert not bench.ask('offboard', True).success
    bench.node._stream.stop()
    # Neither does anything leave, nor does anything come.
    last = bench.node._report.problems._last.setpoint
    bench.node._report.on_cycle(
        Cycle(last._replace(kind=COMMAND), False, None), time.monotonic())
    assert 'no setpoint was sent for 1.0 s' in bench.problems(ahead=1.0)
    assert 'autopilot lost on' in bench.problems(ahead=60.0)


def test_slow_link_differing_heights_and_landing_are_reported(make_bench):
    bench = make_bench()
    bench.receive()
    bench.wait(lambda: bench.bridge.telemetry.attitude and bench.problems())
    assert 'comes at' not in bench.problems()
    bench.bridge.telemetry.height_above_home = lambda now: 5.0
    bench.bridge.gate.heights.height = lambda now: 2.0
    bench.bridge.blind_landing = SimpleNamespace(goal=SimpleNamespace(name='land'), outcome=None)

    def reported() -> bool:
        bench.beat()  # or a busy machine has the link lost
        bench.bridge.housekeeping._alive_since = 0.0
        found = bench.problems(ahead=0.6)
        return all(part in found for part in (
            'LOCAL_POSITION_NED comes at 0 Hz of 50 requested',
            'nothing came from the autopilot for 0.',
            'height above home as 5.0 m, the barometer measures 2.0 m',
            'the bridge requests land: no valid velocity'))
    bench.wait(reported)
    bench.beat(armed=False)
    bench.wait(lambda: not bench.bridge.telemetry.status.armed)
    assert 'the bridge requests' not in bench.problems()  # a second flight may begin


def test_a_take_off_of_ardupilot_misses_no_setpoint(make_bench):
    bench, warning = make_bench(), 'mavlink_bridge/offboard to request offboard'

    def reported(landed: int) -> bool:
        bench.send(mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 129, 4,
            mavlink.MAV_STATE_ACTIVE, 3), mavlink.MAVLink_extended_sys_state_message(0, landed))
        bench.wait(lambda: bench.bridge.telemetry.landed == landed)
        return warning in bench.problems()
    assert not reported(mavlink.MAV_LANDED_STATE_ON_GROUND)
    assert reported(mavlink.MAV_LANDED_STATE_IN_AIR)
    bench.bridge.requests.newest = SimpleNamespace(
        goal=SimpleNamespace(command=mavlink.MAV_CMD_NAV_TAKEOFF, ends_flight=False),
        outcome=Outcome(True, 'takeoff'))
    assert not reported(mavlink.MAV_LANDED_STATE_IN_AIR)


def test_differing_autopilot_parameters_and_limits_are_reported(
        make_bench):
    bench = make_bench()
    line = 'COM_OF_LOSS_T = 1, recommended 0.5: why'
    results = [CheckResult(0, 0, 3, ()), CheckResult(1, 1, 2, (line,)),
               CheckResult(3, 2, 0, (line, 'COM_ARM = 0, recommended 1: why'),
                           ('COM_RC does not exist in PX4 1.20.0',), 'PX4 1.20.0: known for 1.18')]
    for result in results:  # one by one, over a slow line
        bench.bridge.housekeeping.parameters = SimpleNamespace(
            result=lambda result=result: result, version=Version(1, 20))
        bench.problems()
    said = [text for text in bench.log if 'parameter' in text or 'PX4' in text]
    assert said == [f'parameter {each}' for each in (*results[-1].lines, *results[-1].missing)] + [
        results[-1].unproven]
    for values, said in (
            ({'v_max': 0.5, 'a_max': 2.5}, ''), ({'v_max': None}, ''),
            ({'v_max': 0.7}, 'v_max = 0.7 of the planner, but 0.5 of mavlink_bridge')):
        bench.node._report.problems.planner.values = values
        found = bench.problems()
        assert said in found and bool(said) == ('of the planner' in found)
    assert bench.values['parameters'] == '2 of 3 differ, 0 unanswered'
    assert bench.values['parameter COM_OF_LOSS_T'] == '= 1, recommended 0.5: why'
    assert bench.values['missing parameter COM_RC'] == 'does not exist in PX4 1.20.0'
    assert bench.values['unproven firmware'] == results[-1].unproven
    assert bench.values['firmware'] == '1.20.0'


@pytest.mark.parametrize(('name', 'armed'), [
    ('planner', False), ('planner', True), ('perception', True)])
def test_a_node_with_other_parameters_in_flight_is_named(make_bench, name, armed):
    bench = make_bench()
    bench.beat(armed=armed)
    bench.wait(lambda: bench.bridge.telemetry.status is not None)
    node = getattr(bench.node._report.problems, name)
    node.take({'v_max': 0.5, 'd0': 1.0})
    assert 'changed in flight' not in bench.problems()
    node.take({'v_max': 0.5, 'd0': 2.0})  # it was started with another file
    other = {'planner': 'planner', 'perception': 'relative_pose'}[name]
    assert (f'parameters of {other} changed in flight: d0 1.0 -> 2.0' in
            bench.problems()) == armed
    node.take({'v_max': 0.5, 'd0': 2.0})
    assert ('d0 1.0 -> 2.0' in bench.problems()) == armed


def test_signature_timestamps_follow_clock_set_after_start(
        make_bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'key').write_bytes(bytes(32))
    (tmp_path / 'key').chmod(0o600)
    with monkeypatch.context() as patch:
        patch.setattr(time, 'time', lambda: 1000.0)  # no battery for the clock
        bench = make_bench(signing_key_file=str(tmp_path / 'key'))
        assert bench.bridge.link.signing.state.timestamp < 1e6
    bench.wait(lambda: bench.bridge.link.signing.state.timestamp > 3e13)  # 10 years of 10 us


def test_line_that_cannot_send_is_named_while_it_receives(make_bench):
    bench = make_bench()
    bench.beat()
    bench.wait(lambda: bench.bridge.alive(time.monotonic()))
    bench.bridge.link.transport.write = lambda _: False
    bench.bridge.link.transport.fault = 'Network is unreachable (ENETUNREACH)'
    assert bench.values['link fault'] == 'Network is unreachable (ENETUNREACH)'
    assert 'cannot send on udpin:127.0.0.1:0: Network is unreachable' in bench.problems()
