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

"""The link: who is heard and answered, over real sockets on loopback."""

import math
import os
import select
import socket

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pymavlink.dialects.v20 import all as mavlink
import pytest

from flock_follower.geometry import quaternion_from_rpy
from flock_follower.mavlink.link import Link, Signing
from flock_follower.mavlink.setpoint_rules import encode_setpoint
from flock_follower.mavlink.telemetry import Telemetry
from flock_follower.mavlink.transport import open_transport

KEY = bytes(range(32))


class Vehicle:
    """The other end: a socket and a pymavlink codec."""

    def __init__(self, address, system=1, component=1, signing=None):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(('127.0.0.1', 0))
        self.socket.settimeout(2.0)
        self.address = address
        self.codec = mavlink.MAVLink(None, system, component)
        self.codec.robust_parsing = True
        if signing:
            self.codec.signing = signing.state

    def send(self, message):
        self.socket.sendto(message.pack(self.codec), self.address)

    def heartbeat(self, autopilot=mavlink.MAV_AUTOPILOT_PX4):
        self.send(mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, autopilot, 1, 6 << 16, mavlink.MAV_STATE_ACTIVE, 3))

    def receive(self):
        return self.codec.parse_buffer(self.socket.recv(4096))[0]

    def silent(self):
        return not select.select([self.socket], [], [], 0.05)[0]

    def close(self):
        self.socket.close()


class Bench:
    """A link listening on a free port, and the vehicles that talk to it."""

    def __init__(self, **options):
        self.link = Link(open_transport('udpin:127.0.0.1:0'), **options)
        self.vehicles = []

    def vehicle(self, **options):
        self.vehicles.append(Vehicle(self.link.transport.address, **options))
        return self.vehicles[-1]

    def receive(self, now):
        assert select.select([self.link.transport], [], [], 2.0)[0]
        return [message.get_type() for message in self.link.receive(now)]

    def close(self):
        for end in (self.link, *self.vehicles):
            end.close()


@pytest.fixture
def make_bench():
    benches = []

    def make(**options):
        benches.append(Bench(**options))
        return benches[-1]
    yield make
    for bench in benches:
        bench.close()


def test_nothing_is_sent_before_the_autopilot_is_heard_then_it_is_answered(make_bench):
    bench = make_bench()
    vehicle = bench.vehicle()
    assert not bench.link.send_heartbeat()
    vehicle.heartbeat()
    assert bench.receive(1.0) == ['HEARTBEAT']
    assert bench.link.telemetry.status == (False, 'OFFBOARD', 'active', True)
    assert bench.link.send_heartbeat()
    answer = vehicle.receive()
    assert (answer.type, answer.autopilot) == (
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID)
    assert (answer.get_srcSystem(), answer.get_srcComponent()) == (1, 191)


def test_setpoints_reach_the_vehicle_as_encoded(make_bench):
    bench = make_bench()
    vehicle = bench.vehicle()
    vehicle.heartbeat()
    bench.receive(1.0)
    bench.link.send(encode_setpoint([1.0, 2.0, 3.0], 0.0, 1234))
    message = vehicle.receive()
    assert message.get_msgbuf()[0] == 0xFD  # MAVLink 2
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.time_boot_ms, message.coordinate_frame, message.type_mask) == (1234, 1, 0x83F)
    assert (message.afx, message.afy, message.afz) == (2.0, 1.0, -3.0)


def test_another_vehicle_is_counted_and_never_answered(make_bench):
    bench = make_bench()
    other = bench.vehicle(system=7)
    other.heartbeat()
    assert bench.receive(1.0) == []
    assert not bench.link.send_heartbeat()
    assert bench.link.silence() == 'heard system id 7, not target_system 1'
    assert other.silent()


def test_a_gimbal_of_the_same_vehicle_is_not_its_autopilot(make_bench):
    bench = make_bench()
    bench.vehicle(component=mavlink.MAV_COMP_ID_GIMBAL).heartbeat()
    assert bench.receive(1.0) == []
    assert 'no autopilot with system id 1' in bench.link.silence()


def test_the_component_ids_are_parameters_too(make_bench):
    bench = make_bench(target_component=5, source_component=192)
    bench.vehicle().heartbeat()
    assert bench.receive(1.0) == []
    assert 'and component 5' in bench.link.silence()
    vehicle = bench.vehicle(component=5)
    vehicle.heartbeat()
    assert bench.receive(1.0) == ['HEARTBEAT']
    bench.link.send_command(mavlink.MAV_CMD_DO_SET_MODE, (1.0,))
    command = vehicle.receive()
    assert (command.target_component, command.get_srcComponent()) == (5, 192)


def test_commands_of_a_ground_station_are_counted_and_move_nothing(make_bench):
    bench = make_bench()
    vehicle, station = bench.vehicle(), bench.vehicle(system=255, component=190)
    vehicle.heartbeat()
    bench.receive(1.0)
    before = bench.link.telemetry.status
    station.send(mavlink.MAVLink_command_long_message(
        1, 191, mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1, 0, 0, 0, 0, 0, 0))
    station.send(mavlink.MAVLink_set_mode_message(1, 1, 6 << 16))
    station.heartbeat()
    assert bench.receive(1.1) == []
    while bench.link.ignored['other system'] < 3:
        assert bench.receive(1.1) == []
    assert bench.link.telemetry.status == before and station.silent() and vehicle.silent()


def test_firmware_that_is_not_spoken_is_named(make_bench):
    bench = make_bench()
    bench.vehicle().heartbeat(autopilot=mavlink.MAV_AUTOPILOT_GENERIC)
    assert bench.receive(1.0) == []
    assert bench.link.silence() == (
        "heard GENERIC QUADROTOR, which autopilot = 'auto' does not speak")
    assert bench.link.telemetry.dialect is None and not bench.link.send_heartbeat()


def test_a_parameter_is_asked_for_by_its_name(make_bench):
    bench = make_bench()
    vehicle = bench.vehicle()
    vehicle.heartbeat()
    bench.receive(1.0)
    assert bench.link.request_parameter('EKF2_EV_CTRL')
    message = vehicle.receive()
    assert (message.param_id, message.param_index) == ('EKF2_EV_CTRL', -1)
    assert bench.link.bytes_sent == len(message.get_msgbuf())


def test_a_second_vehicle_with_the_same_id_must_wait_until_the_first_is_silent(make_bench):
    bench = make_bench()
    first, second = bench.vehicle(), bench.vehicle()
    first.heartbeat()
    bench.receive(1.0)
    second.heartbeat()
    assert bench.receive(2.0) == []
    assert bench.link.ignored['second sender'] == 1
    bench.link.send_heartbeat()
    assert first.receive().get_type() == 'HEARTBEAT'
    assert second.silent()
    second.heartbeat()
    assert bench.receive(3.5) == ['HEARTBEAT']
    bench.link.send_heartbeat()
    assert second.receive().get_type() == 'HEARTBEAT'


def test_garbage_from_one_sender_does_not_cut_into_the_messages_of_another(make_bench):
    bench = make_bench()
    vehicle, noise = bench.vehicle(), bench.vehicle()
    noise.socket.sendto(b'\xfd\x20\x00\x00half a message', bench.link.transport.address)
    assert bench.receive(1.0) == []
    vehicle.heartbeat()
    assert bench.receive(1.0) == ['HEARTBEAT']


@given(st.binary(min_size=1, max_size=300))
def test_no_bytes_whatsoever_break_the_link(data):
    class Replay:
        url, peer = 'replay', None

        def reopen(self, now):
            pass

        def read(self):
            yield data, 'somewhere'

    link = Link(Replay())
    for now in (1.0, 2.0):
        assert link.receive(now) == []


def test_signed_links_hear_only_their_key(make_bench, tmp_path):
    path = tmp_path / 'key'
    path.write_text(KEY.hex() + '\n')
    path.chmod(0o600)
    bench = make_bench(signing=Signing.from_file(str(path), 1.8e9))
    for stranger in (bench.vehicle(), bench.vehicle(signing=Signing(bytes(32), 1.9e9))):
        stranger.heartbeat()
        assert bench.receive(1.0) == []
    assert bench.link.ignored['wrong signature'] == 2
    assert 'signed with another key' in bench.link.silence()
    vehicle = bench.vehicle(signing=Signing(KEY, 1.8e9))
    vehicle.heartbeat()
    assert bench.receive(1.0) == ['HEARTBEAT']
    bench.link.send_heartbeat()
    assert vehicle.receive().get_signed()


@pytest.mark.parametrize('content', [b'', b'short', b'z' * 64, b'a' * 63])
def test_a_bad_key_file_is_named_and_its_content_is_not(content, tmp_path):
    path = tmp_path / 'key'
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(ValueError, match='signing_key_file = .*must hold 32 bytes') as error:
        Signing.from_file(str(path), 0.0)
    assert not content or content.decode() not in str(error.value)


@pytest.mark.parametrize('mode', [0o640, 0o604, 0o620, 0o601])
def test_a_key_file_open_to_others_is_refused(mode, tmp_path):
    path = tmp_path / 'key'
    path.write_bytes(KEY)
    path.chmod(mode)
    with pytest.raises(ValueError, match=(
            f"signing_key_file = .*key': mode {mode:03o} gives others access: chmod 600")):
        Signing.from_file(str(path), 0.0)
    path.chmod(0o400)
    Signing.from_file(str(path), 0.0)


def test_a_missing_key_file_is_named():
    with pytest.raises(ValueError, match="signing_key_file = '/nowhere': No such file"):
        Signing.from_file('/nowhere', 0.0)


@pytest.mark.parametrize(('url', 'reason'), [
    ('14540', 'must be udpin:HOST:PORT'), ('udpin:127.0.0.1', 'must be udpin:HOST:PORT'),
    ('tcp:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:127.0.0.1:70000', r'port = \d+: must be an integer in \[0, 65535\]'),
    ('udpout:127.0.0.1:0', r'port = \d+: must be an integer in \[1, 65535\]'),
    ('udpin:no.such.host.invalid:14540', 'unknown host no.such.host.invalid'),
    ('/dev/ttyACM0,12345', 'baud rate must be one of 9600')])
def test_a_bad_url_is_refused_with_the_valid_forms(url, reason):
    with pytest.raises(ValueError, match=f'connection = .*{reason}'):
        open_transport(url)


def test_a_port_in_use_is_named():
    first = open_transport('udpin:127.0.0.1:0')
    url = f'udpin:127.0.0.1:{first.address[1]}'
    with pytest.raises(OSError, match=f'connection = .{url}.: cannot listen there: Address'):
        open_transport(url)
    first.close()


def test_a_serial_line_carries_the_link_both_ways():
    main, replica = os.openpty()
    link = Link(open_transport(f'{os.ttyname(replica)},57600'))
    codec = mavlink.MAVLink(None, 1, 1)
    message = mavlink.MAVLink_heartbeat_message(2, 12, 1, 6 << 16, 4, 3).pack(codec)
    os.write(main, message[:9])
    assert select.select([link.transport], [], [], 2.0)[0]
    assert link.receive(1.0) == []
    os.write(main, message[9:])
    assert select.select([link.transport], [], [], 2.0)[0]
    assert [m.get_type() for m in link.receive(1.0)] == ['HEARTBEAT']
    assert link.send_heartbeat()
    assert codec.parse_buffer(os.read(main, 100))[0].type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
    link.close()
    os.close(main)
    os.close(replica)


@pytest.mark.parametrize(('name', 'value'), [
    ('target_system', 0), ('source_system', 256), ('target_component', 0),
    ('source_component', 256)])
def test_system_ids_out_of_range_are_refused(name, value, make_bench):
    with pytest.raises(ValueError, match=rf'{name} = {value}: must be an integer in \[1, 255\]'):
        make_bench(**{name: value})


def test_position_and_attitude_arrive_in_enu_and_flu():
    telemetry = Telemetry()
    telemetry.update(mavlink.MAVLink_local_position_ned_message(0, 1, 2, -3, 0.1, 0.2, -0.3), 5.0)
    np.testing.assert_allclose(telemetry.local_position.position, [2, 1, 3])
    np.testing.assert_allclose(telemetry.local_position.velocity, [0.2, 0.1, 0.3])
    # Facing east (NED yaw 90 deg), nose up 0.1 rad, turning right at 0.3 rad/s.
    x, y, z, w = quaternion_from_rpy(0.0, 0.1, math.pi / 2)
    telemetry.update(
        mavlink.MAVLink_attitude_quaternion_message(0, w, x, y, z, 0.1, 0.2, 0.3), 5.0)
    # In FLU a nose-up pitch is negative.
    np.testing.assert_allclose(
        telemetry.attitude.quaternion, quaternion_from_rpy(0.0, -0.1, 0.0), atol=1e-6)
    np.testing.assert_allclose(telemetry.attitude.angular_velocity, [0.1, -0.2, -0.3])
    assert telemetry.attitude.yaw == pytest.approx(0.0, abs=1e-6)


def test_telemetry_that_is_not_finite_is_dropped():
    telemetry = Telemetry()
    telemetry.update(mavlink.MAVLink_local_position_ned_message(0, math.nan, 0, 0, 0, 0, 0), 1.0)
    telemetry.update(
        mavlink.MAVLink_attitude_quaternion_message(0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0), 1.0)
    assert (telemetry.local_position, telemetry.attitude, telemetry.rejected) == (None, None, 2)


def test_the_battery_is_read_in_volts_amperes_and_fractions():
    telemetry = Telemetry()
    telemetry.update(mavlink.MAVLink_sys_status_message(
        0, 0, 0, 0, 15200, 1850, 81, 0, 0, 0, 0, 0, 0), 1.0)
    assert telemetry.battery[1:4] == pytest.approx((15.2, 18.5, 0.81))
    telemetry.update(mavlink.MAVLink_battery_status_message(
        0, 0, 1, 2350, [3800, 3810, 3790, 65535] + [65535] * 6, -1, -1, -1, -1), 2.0)
    battery = telemetry.battery
    assert battery.voltage == pytest.approx(11.4)
    assert battery.cell_voltages == pytest.approx((3.8, 3.81, 3.79))
    assert battery.temperature == 23.5
    assert math.isnan(battery.current) and math.isnan(battery.remaining)


def test_the_link_is_alive_while_heartbeats_come_at_one_hertz():
    telemetry = Telemetry()
    assert not telemetry.alive(0.0, 1.0)
    telemetry.update(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3), 1.0)
    assert telemetry.alive(2.9, 1.0)
    assert not telemetry.alive(3.1, 1.0)


def test_a_streaming_autopilot_that_falls_silent_is_missed_after_the_link_timeout():
    telemetry = Telemetry()
    telemetry.update(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3), 1.0)
    telemetry.update(mavlink.MAVLink_local_position_ned_message(0, 0, 0, 0, 0, 0, 0), 1.1)
    assert telemetry.alive(2.05, 1.0)
    assert not telemetry.alive(2.15, 1.0)


def test_missing_heartbeats_are_noticed_beside_other_messages():
    telemetry = Telemetry()
    telemetry.update(mavlink.MAVLink_heartbeat_message(2, 12, 1, 0, 3, 3), 1.0)
    telemetry.update(mavlink.MAVLink_local_position_ned_message(0, 0, 0, 0, 0, 0, 0), 3.1)
    assert not telemetry.alive(3.1, 1.0)


def test_an_autopilot_whose_clock_falls_back_has_rebooted():
    telemetry = Telemetry()
    for boot_ms, reboots in ((5000, 0), (4500, 0), (6000, 0), (300, 0), (320, 1), (900, 1)):
        telemetry.update(
            mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, 0, 0, 0, 0), 1.0)
        assert telemetry.reboots == reboots


def stamped(kind, boot_ms):
    """Return a message of a kind, stamped so and else zero, as it comes from the wire."""
    message_class = next(c for c in mavlink.mavlink_map.values() if c.msgname == kind)
    fields = {name: bytes(10) if name == 'name' else [0.0] * 4 if name == 'quaternion' else 0
              for name in message_class.ordered_fieldnames}
    fields['time_boot_ms'] = boot_ms
    return message_class(**fields)


@pytest.mark.parametrize('kind', [
    'ATTITUDE_QUATERNION', 'GLOBAL_POSITION_INT', 'SYSTEM_TIME', 'ATTITUDE',
    'POSITION_TARGET_LOCAL_NED', 'RC_CHANNELS'])
def test_a_reboot_shows_in_every_kind_of_message_that_is_stamped(kind):
    telemetry = Telemetry()
    for boot_ms, reboots in ((5000, 0), (4500, 0), (6000, 0), (300, 0), (320, 1), (900, 1)):
        telemetry.update(stamped(kind, boot_ms), 1.0)
        assert telemetry.reboots == reboots


def test_a_reboot_counts_once_though_every_kind_falls_back_and_kinds_overtake_one_another():
    telemetry = Telemetry()
    for kind, boot_ms, reboots in (
            ('LOCAL_POSITION_NED', 60_000, 0), ('GLOBAL_POSITION_INT', 57_000, 0),
            ('SYSTEM_TIME', 60_010, 0), ('GLOBAL_POSITION_INT', 58_000, 0),
            ('SYSTEM_TIME', 1500, 0), ('GLOBAL_POSITION_INT', 900, 0),
            ('SYSTEM_TIME', 1510, 1), ('GLOBAL_POSITION_INT', 920, 1),
            ('LOCAL_POSITION_NED', 2000, 1), ('SYSTEM_TIME', 1600, 1),
            ('GLOBAL_POSITION_INT', 5000, 1), ('GLOBAL_POSITION_INT', 100, 1),
            ('GLOBAL_POSITION_INT', 120, 2)):
        telemetry.update(stamped(kind, boot_ms), 1.0)
        assert telemetry.reboots == reboots, (kind, boot_ms)


def test_a_message_that_comes_late_is_no_reboot():
    telemetry = Telemetry()
    for boot_ms in (60_000, 60_020, 58_800, 60_040, 58_820, 60_060):
        for kind in ('LOCAL_POSITION_NED', 'ATTITUDE_QUATERNION'):
            telemetry.update(stamped(kind, boot_ms), 1.0)
    assert telemetry.reboots == 0


def test_stamps_that_are_not_set_or_of_another_clock_are_no_reboot():
    telemetry = Telemetry()
    for kind, boot_ms in (
            ('LOCAL_POSITION_NED', 60_000), ('LOCAL_POSITION_NED', 0),
            ('LOCAL_POSITION_NED', 60_020), ('ATTITUDE_QUATERNION', 0), ('SYSTEM_TIME', 4_000_000),
            ('ATTITUDE_QUATERNION', 60_040), ('NAMED_VALUE_FLOAT', 90_000),
            ('NAMED_VALUE_FLOAT', 3), ('DISTANCE_SENSOR', 50_000), ('DISTANCE_SENSOR', 20),
            ('LOCAL_POSITION_NED', 60_060)):
        telemetry.update(stamped(kind, boot_ms), 1.0)
    assert telemetry.reboots == 0


@pytest.mark.parametrize(('state', 'flying'), [
    (mavlink.MAV_LANDED_STATE_UNDEFINED, None), (mavlink.MAV_LANDED_STATE_ON_GROUND, False),
    (mavlink.MAV_LANDED_STATE_IN_AIR, True), (mavlink.MAV_LANDED_STATE_TAKEOFF, False),
    (mavlink.MAV_LANDED_STATE_LANDING, True)])
def test_the_vehicle_says_whether_it_flies(state, flying):
    telemetry = Telemetry()
    assert telemetry.flying(0.0) is None
    telemetry.update(mavlink.MAVLink_extended_sys_state_message(0, state), 1.0)
    assert telemetry.flying(3.9) is flying
    assert telemetry.flying(4.1) is None  # told at 5 Hz otherwise


def test_heights_are_known_above_the_sea_and_the_local_origin():
    telemetry = Telemetry()
    assert telemetry.altitude(1.0) is None
    telemetry.update(mavlink.MAVLink_local_position_ned_message(0, 0, 0, -3, 0, 0, 0), 1.0)
    telemetry.update(
        mavlink.MAVLink_global_position_int_message(0, 0, 0, 491000, 3000, 0, 0, 0, 0), 1.0)
    assert telemetry.altitude(1.9) == 3.0 and telemetry.altitude(2.1) is None
    assert telemetry.sea_level_altitude(1.0) == 491.0


def test_a_flood_from_elsewhere_is_dropped_and_the_vehicle_heard(make_bench):
    bench = make_bench()
    vehicle, stranger = bench.vehicle(), bench.vehicle(system=9)
    vehicle.heartbeat()
    while not bench.link.received:
        bench.link.receive(0.0)
    for _ in range(60):
        stranger.socket.sendto(b'\xfd' * 1400, stranger.address)
    for _ in range(5):
        vehicle.heartbeat()
    while bench.link.received < 6:
        bench.link.receive(0.1)
    assert bench.link.ignored['flood'] > 20
    assert bench.link.ignored['unknown message'] + bench.link.ignored['undecodable'] < 2000


def test_a_clock_of_signing_that_is_behind_is_told_as_that(make_bench, tmp_path):
    bench = make_bench(signing=Signing(KEY, 1.8e9))
    bench.vehicle(signing=Signing(KEY, 1.8e9 - 30.0)).heartbeat()
    while not bench.link.received:
        bench.link.receive(0.0)
    late = make_bench(signing=Signing(KEY, 1.8e9))
    late.vehicle(signing=Signing(KEY, 1.8e9 - 120.0)).heartbeat()
    while not late.link.ignored['older timestamp']:
        assert not late.link.receive(0.0)
    assert not late.link.ignored['wrong signature']
    assert 'older timestamp' in late.link.silence()


def test_a_signed_message_from_the_far_future_does_not_lock_the_vehicle_out(make_bench):
    bench = make_bench(signing=Signing(KEY, 1.8e9))
    vehicle = bench.vehicle(signing=Signing(KEY, 1.8e9))

    def hears(at):
        before = bench.link.received, bench.link.ignored['future timestamp']
        vehicle.heartbeat()
        while (bench.link.received, bench.link.ignored['future timestamp']) == before:
            bench.link.receive(at)
        return bench.link.received > before[0]

    def set_clock(unix_time):
        vehicle.codec.signing.timestamp = Signing(KEY, unix_time).state.timestamp
    assert hears(100.0)
    ours = bench.link._sender.signing.timestamp
    set_clock(1.8e9 + 86400.0)
    assert not hears(101.0)
    assert not bench.link.ignored['wrong signature']
    assert "ahead of this computer's clock" in bench.link.silence()
    assert bench.link._sender.signing.timestamp == ours  # nor is what we send from the future
    set_clock(1.8e9 + 1.0)
    assert hears(101.0)
    # Our clock goes on: what was too far ahead is not any more.
    set_clock(1.8e9 + 59.0)
    assert hears(100.0)
    set_clock(1.8e9 + 100.0)
    assert not hears(139.0) and hears(141.0)
