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

"""Every fault made on purpose gets its line, that says what to do; what is well gets none."""

from __future__ import annotations

import fcntl
from functools import partial
import math
import os
from pathlib import Path
from typing import NamedTuple

from observed import FOCAL, healthy, odometry_rows, shift_rows, sighting_rows
from observed_faults import (
    at_rest,
    bridge,
    CAMERA,
    CAMERA_INFO,
    Change,
    change,
    child_axes,
    columns,
    delayed,
    kept,
    level_flight,
    machine,
    mounted,
    moved,
    moving,
    NO_CALIBRATION,
    OTHER_ODOMETRY,
    parameter,
    pictures,
    positions,
    publisher,
    set_clock,
    stamped,
    stamped_as,
    static_frames,
    together,
    unstamped,
)
import pytest

from flock_follower.bags.message_types import empty
from flock_follower.checks.collector import Collector
from flock_follower.checks.dead_segments import dead_segments
from flock_follower.checks.findings import ERROR, OK, ready, still_needed, UNMEASURED, WARNING
from flock_follower.checks.marker_size import HOW
from flock_follower.checks.observations import NodeStatus, Observations, TopicSeen
from flock_follower.checks.processor import Load
from flock_follower.checks.reach import Reach
from flock_follower.geometry import quaternion_from_rpy, quaternion_to_matrix
from flock_follower.messages.topic_names import OURS, TYPES
from flock_follower.perception.prints import Fault as PrintFault
from flock_follower.perception.prints import WRONG_BORDER

LIVE, BAG, BOTH = (True,), (False,), (True, False)
POSE = 'geometry_msgs/msg/PoseStamped'
OPTICAL = (-math.pi / 2.0, 0.0, -math.pi / 2.0)


class Fault(NamedTuple):
    """Something put amiss, where it can be, and what has to be said of it."""

    name: str
    where: tuple[bool, ...]
    level: str
    what: str
    measured: str
    advice: str
    make: Change


FAULTS: list[Fault] = [
    *(Fault(f'positions {axes}, twist in {"odom" if in_odom else "child"}', BOTH, ERROR,
            'odom positions', f'move as {axes} of', 'REP-103', positions(columns, signs, in_odom))
      for axes, columns, signs in (
          ('y, x, z', [1, 0, 2], [1.0, 1.0, 1.0]), ('x, y, -z', [0, 1, 2], [1.0, 1.0, -1.0]),
          ('x, -y, z', [0, 1, 2], [1.0, -1.0, 1.0]), ('y, x, -z', [1, 0, 2], [1.0, 1.0, -1.0]))
      for in_odom in (False, True)),
    Fault('positions turned', BOTH, ERROR, 'odom positions', 'turned by 40 deg', 'REP-103',
          lambda seen: [row.__setitem__(slice(2, 5), (quaternion_to_matrix(quaternion_from_rpy(
              0.0, 0.0, math.radians(40.0))) @ row[2:5]).tolist()) for row in seen.rows]),
    Fault('a camera at 2 Hz', BOTH, ERROR, 'images rate', '2.0 Hz', 'raise the frame rate',
          kept('image_raw', slice(None, None, 15))),
    Fault('odometry at 2 Hz', BOTH, ERROR, 'odom rate', '2.0 Hz', 'raise the output rate',
          kept('odom', slice(None, None, 25))),
    Fault('odometry 0.4 s late', BOTH, ERROR, 'odom latency', '410 ms', 'processor time',
          delayed('odom', 0.4)),
    Fault('use_sim_time without a clock', LIVE, ERROR, 'clock',
          'use_sim_time is true in planner, but no node publishes /clock',
          'without use_sim_time',
          parameter('planner', 'use_sim_time', True)),
    Fault('stamps ahead', BOTH, ERROR, 'images latency', '80 ms in the future',
          'synchronize the clocks',
          stamped('image_raw', 0.1)),
    Fault('stamps that are zero', BOTH, ERROR, 'odom latency', 'no stamp, or another clock',
          'by the clock of ROS',
          change(lambda seen: seen.topic('odom'), stamps=[0.0] * 250)),
    *(Fault(f'a clock of the {what} set in flight, {share:.0%} of the way', BOTH, ERROR,
            f'{name} latency', f'stamps jump by {step:+.1f} s', 'a clock was set meanwhile',
            set_clock(topic, share, step))
      for what, name, topic in (('camera', 'images', 'image_raw'), ('VIO', 'odom', 'odom'))
      for share, step in ((0.01, 3600.0), (0.5, -3600.0), (0.99, -11.0))),
    *(Fault(f'{what} stamps', BOTH, ERROR, 'images latency',
            'have the stamp of the message before', 'when it is measured', stamped_as(index))
      for what, index in (('frozen', lambda n: 0), ('paired', lambda n: n // 2 * 2))),
    Fault('a bag whose clock was set', (False,), ERROR, 'bag clock', 'jump by +3600.0 s after 2.0',
          'ros2 bag convert', change(gaps=[(0.0, 7e9, False), (2.0, 3600.0, True)])),
    Fault('a bag whose clock was set back', (False,), ERROR, 'bag clock', 'set back by 30.0 s',
          'record again', change(set_back=30.0)),
    Fault('a bag that begins with a message without a time', (False,), WARNING, 'bag clock',
          'jump by +7000000000.0 s after 0.0 s', 'synchronize',
          change(gaps=[(0.0, 7e9, False)])),
    Fault('a calibration of another size', BOTH, ERROR, 'calibration',
          'for 1280x720, images are 640x480', 'calibrate the camera at this size',
          change(lambda seen: seen.calibration, width=1280, height=720, k=[
              2.0 * FOCAL, 0.0, 640.0, 0.0, 2.0 * FOCAL, 360.0, 0.0, 0.0, 1.0])),
    Fault('a size of other images', BOTH, ERROR, 'calibration',
          'K is for another image; images are 640x480', 'calibrate the camera at this size',
          change(lambda seen: seen.calibration, width=1280, height=720)),
    Fault('a matrix for images of twice the size', BOTH, ERROR, 'calibration',
          'optical axis at 100%', 'calibrate the camera',
          change(lambda seen: seen.calibration, k=[
              2.0 * FOCAL, 0.0, 640.0, 0.0, 2.0 * FOCAL, 480.0, 0.0, 0.0, 1.0])),
    Fault('a matrix for images of half the size', BOTH, ERROR, 'calibration',
          'optical axis at 25%', 'calibrate the camera',
          change(lambda seen: seen.calibration, k=[
              FOCAL / 2.0, 0.0, 160.0, 0.0, FOCAL / 2.0, 120.0, 0.0, 0.0, 1.0])),
    Fault('a focal length 20% too long', BOTH, ERROR, 'focal length', '0.83 ', 'this lens',
          moving(1.0 / 1.2)),
    Fault('a focal length 20% too short', BOTH, ERROR, 'focal length', '1.25 ', 'this lens',
          moving(1.0 / 0.8)),
    Fault('focal lengths that differ', BOTH, WARNING, 'calibration', 'not square',
          'are the images stretched? If not, calibrate again',
          change(lambda seen: seen.calibration, k=[
              FOCAL, 0.0, 320.0, 0.0, 1.08 * FOCAL, 240.0, 0.0, 0.0, 1.0])),
    Fault('a calibration without a matrix', BOTH, ERROR, 'calibration', 'K = 0',
          'calibrate the camera',
          change(lambda seen: seen.calibration, k=[0.0] * 9)),
    Fault('an encoding nobody reads', BOTH, ERROR, 'images', "encoding = '16UC1'", 'JPEG',
          pictures(fault="encoding = '16UC1': must be one of mono8, ...")),
    Fault('a cap before the lens', BOTH, ERROR, 'images', 'black', 'take off the cap',
          pictures(brightness=3.0, contrast=1.0, markers={})),
    Fault('a twist that is nonsense', BOTH, WARNING, 'odom velocity', 'in either frame',
          'derived from the positions',
          columns(slice(9, 12), [1.5, 1.5, 0.0])),
    Fault('a velocity that is never valid', BOTH, WARNING, 'odom velocity', 'none (not finite)',
          'derived from the positions', columns(slice(9, 12), [math.nan] * 3)),
    Fault('a velocity that is invalid for moments', BOTH, WARNING, 'odom velocity',
          'invalid 2 times', 'derived from the positions', lambda seen: [
              row.__setitem__(slice(9, 12), [math.nan] * 3)
              for row in (seen.rows[50], *seen.rows[120:125])]),
    Fault('a source that is lost', BOTH, ERROR, 'odom', '250 of 250 are invalid: quaternion = 0',
          'publish_null_when_lost',
          columns(slice(5, 9), [0.0] * 4)),
    Fault('camera stamps 50 ms off', BOTH, ERROR, 'camera time offset', 'ms later',
          'middle of the exposure, by one clock; else set time_offset:=-0.05',
          change(shifts=shift_rows(offset=0.05))),
    Fault('a marker printed larger than configured', BOTH, ERROR, 'marker size',
          'moves 0.80 ± 0.00 times as far', '0.200 m would fit',
          change(sightings=sighting_rows(scale=0.8))),
    Fault('a marker printed a little smaller than configured', BOTH, WARNING, 'marker size',
          'moves 1.07 ± 0.0', '0.150 m would fit',
          change(sightings=sighting_rows(scale=0.16 / 0.15))),
    Fault('a camera that looks lower than configured', BOTH, ERROR, 'camera mounting',
          'looks lower by 1', 'camera_rpy:=[0.0,0.2',
          mounted(0.0, 15.0, 0.0)),
    Fault('a camera that looks a little to the left', BOTH, WARNING, 'camera mounting',
          'looks further left by 7 deg', 'camera_rpy:=[0.0,0.0,0.1',
          mounted(0.0, 0.0, 7.0)),
    Fault('a marker too small', BOTH, ERROR, 'marker', '9 px wide', 'print it larger',
          pictures(markers={0: 9.0})),
    Fault('a print with another id', BOTH, WARNING, 'marker',
          'not in sight in 12 images, but 7', 'set marker_id in neighbors_file',
          pictures(markers={7: 40.0})),
    Fault('a print with a border of two cells', BOTH, ERROR, 'marker',
          'a black border of 2 cells, in 12 of 12 images', 'print it with a border of one cell',
          pictures(markers={}, misprints=[PrintFault(
              WRONG_BORDER, 'marker 0 has a black border of 2 cells',
              'print it with a border of one cell')])),
    Fault('a marker that no pose suits', BOTH, ERROR, 'marker', 'found in 12 of 12 images',
          'white margin', pictures(markers={}, outlines=[0])),
    Fault('no marker in sight', BOTH, WARNING, 'marker', 'not in sight in 12 images',
          'hold the leader before the camera',
          pictures(markers={})),
    Fault('a parameter of the autopilot', LIVE, WARNING, 'autopilot parameter',
          'COM_OBL_RC_ACT = 0, recommended 5', 'ground station',
          bridge('parameter COM_OBL_RC_ACT', '= 0, recommended 5: then Hold')),
    Fault('a parameter that the firmware does not have', LIVE, WARNING, 'autopilot parameter',
          'COM_RC_OVERRIDE does not exist in PX4 1.18.0', 'cannot be set',
          bridge('missing parameter COM_RC_OVERRIDE', 'does not exist in PX4 1.18.0')),
    Fault('a firmware without known values', LIVE, WARNING, 'autopilot firmware',
          'PX4 1.20.0: ', 'by hand',
          bridge('unproven firmware', 'PX4 1.20.0: the recommended values are known for ...')),
    Fault('a dead bridge would be obeyed', LIVE, ERROR, 'ready for offboard', 'GUID_TIMEOUT = 3 s',
          'the bridge would refuse offboard',
          bridge('offboard would be refused', 'GUID_TIMEOUT = 3 s: ...')),
    Fault('not ready to arm', LIVE, ERROR, 'ready to arm', 'no: press the safety button',
          'fix the reported causes',
          bridge('not ready to arm', 'press the safety button')),
    Fault('no autopilot', LIVE, ERROR, 'autopilot', 'not received (never received)', 'check cable',
          bridge('link', 'never received')),
    Fault('a port without permission', LIVE, ERROR, 'autopilot', 'not received', 'group dialout',
          together(bridge('link', 'never received'),
                   bridge('link fault', 'Permission denied (EACCES): the group dialout'))),
    Fault('a link without a route', LIVE, WARNING, 'autopilot', 'PX4', '(ENETUNREACH)',
          bridge('link fault', 'Network is unreachable (ENETUNREACH)')),
    Fault('a line that works one way only', LIVE, ERROR, 'autopilot',
          'answers none of our messages', 'transmit wire',
          bridge('no answers', 'the autopilot answers none of our messages: ...')),
    Fault('an error of a node', LIVE, ERROR, 'relative_pose status', 'no image processed for 4 s',
          'see images',
          lambda seen: seen.statuses.update(relative_pose=NodeStatus(
              2, 'no image processed for 4 s: no usable camera_info'))),
    Fault('odometry as late as the planner allows', BOTH, ERROR, 'odom latency', '310 ms',
          'processor time',
          delayed('odom', 0.3)),
    Fault('little processor time left', LIVE, WARNING, 'processor', 'for 20% of the worst 2 s',
          'end programs', machine(load=Load(0.2, 3.0, 4))),
    Fault('a source without rates and covariances', BOTH, WARNING, 'odom lacks',
          'angular velocity', 'odom_std', columns(slice(12, 27), [0.0] * 15)),
    Fault('no processor time left', LIVE, ERROR, 'processor', '(3.9 of 4 processors)',
          'end programs', machine(load=Load(0.7, 3.9, 4))),
    # What is late meanwhile may be in time on a computer that is not; another clock never is.
    Fault('late on a busy computer', LIVE, UNMEASURED, 'odom latency', '310 ms', '',
          together(delayed('odom', 0.3), machine(load=Load(0.2, 3.0, 4)))),
    Fault('few on a busy computer', LIVE, UNMEASURED, 'odom rate', '10.0 Hz', '',
          together(kept('odom', slice(None, None, 5)), change(rows=odometry_rows(10.0)),
                   machine(load=Load(0.2, 3.0, 4)))),
    Fault('few images on a busy computer', LIVE, UNMEASURED, 'images rate', '2.0 Hz', '',
          together(kept('image_raw', slice(None, None, 15)), machine(load=Load(0.2, 3.0, 4)))),
    Fault('another clock on a busy computer', LIVE, ERROR, 'odom latency', 'or another clock',
          'set use_sim_time', together(delayed('odom', 100.0), machine(load=Load(0.2, 3.0, 4)))),
    Fault('nodes on another computer', LIVE, UNMEASURED, 'processor', 'do not run on this', '',
          machine(load=None)),
    Fault('shared memory full', LIVE, ERROR, 'shared memory', '2 MB free', 'fastrtps_',
          machine(shared_memory_free=2.0)),
    Fault('segments of killed processes', LIVE, WARNING, 'shared memory', '180 segments',
          'fastdds shm clean',
          machine(dead_segments=180)),
    Fault('a node missing', LIVE, ERROR, 'nodes', 'not running: planner', 'ros2 launch',
          lambda seen: seen.nodes.remove('/planner')),
    Fault('a node twice', LIVE, ERROR, 'nodes', 'twice: planner', 'end one of each',
          lambda seen: seen.nodes.append('/planner')),
    Fault('two planners', LIVE, ERROR, 'command/trajectory',
          '2 publishers on /command/trajectory: /joystick, /planner', 'end all but one',
          publisher('command/trajectory', '/joystick')),
    Fault('ROS open to the network', LIVE, WARNING, 'network',
          'it finds mavlink_bridge, planner', 'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST',
          machine(reach=[('planner', Reach.NETWORK), ('mavlink_bridge', Reach.NETWORK),
                         ('relative_pose', Reach.ADDRESS)])),
    Fault('ROS open to those that know the address', LIVE, WARNING, 'network',
          'it reaches relative_pose', 'config/dds/fastdds.xml',
          machine(reach=[('planner', Reach.COMPUTER), ('relative_pose', Reach.ADDRESS),
                         ('mavlink_bridge', None)])),
    Fault('ROS by other means', LIVE, UNMEASURED, 'network', 'seen in planner', '',
          machine(reach=[('mavlink_bridge', Reach.COMPUTER), ('planner', None)])),
    Fault('two odometries', LIVE, ERROR, 'odom', '2 publishers on /odom', 'end all but one',
          publisher('odom', '/wheels')),
    Fault('odometry read differently', LIVE, ERROR, 'odom_child_rpy',
          '[-1.5708, 0.0, -1.5708] in planner', '/**',
          parameter('planner', 'odom_child_rpy', [-1.5708, 0.0, -1.5708])),
    Fault('a recording cut short', BAG, WARNING, 'bag', 'incomplete: the disk is full',
          'record again',
          change(incomplete='the disk is full')),
    Fault('images under the name of their driver', BOTH, ERROR, 'images', '/image_raw',
          f'--remap image_raw:={CAMERA}',
          together(moved('image_raw', CAMERA), change(pictures=[], shifts=[]))),
    Fault('no calibration', BOTH, ERROR, 'camera_info', '/camera_info',
          f'--remap camera_info:={CAMERA_INFO}', NO_CALIBRATION),
    Fault('odometry under the name of its source', BOTH, ERROR, 'odom', '/odom',
          '--remap odom:=/ov_msckf/odomimu', OTHER_ODOMETRY),
    Fault('a source that sends nothing', LIVE, ERROR, 'odom',
          '/vio publishes /odom, and sends nothing', 'initialized?', kept('odom', slice(0))),
    Fault('a topic that cannot be read', BAG, ERROR, 'odom', 'other fields', 'record it anew',
          together(lambda seen: seen.topics.pop('/odom'), change(rows=[], unreadable={
              '/odom': 'type nav_msgs/Odometry has other fields in ROS 2 Jazzy'}))),
    Fault('use_sim_time forgotten', LIVE, ERROR, 'clock',
          '/clock is published, but use_sim_time is false in planner', 'use_sim_time:=true',
          together(lambda seen: seen.topics.update({'/clock': TopicSeen()}),
                   *(parameter(node, 'use_sim_time', node != 'planner') for node in OURS))),
    Fault('twist in odom, told as child', BOTH, ERROR, 'odom velocity',
          'read in child, the positions fit odom', 'odom_twist_frame:=auto',
          together(positions([0, 1, 2], [1.0] * 3, True),
                   *(parameter(node, 'odom_twist_frame', 'child') for node in OURS))),
    Fault('the axes of an IMU', BOTH, ERROR, 'odom up', '-y of base_link is up',
          'odom_child_rpy:=[-1.5708,0.0,-1.5708]', child_axes(*OPTICAL)),
    Fault('ahead is left', BOTH, ERROR, 'odom ahead', 'with other axes',
          'odom_child_rpy:=[0.0,0.0,1.5708]',
          child_axes(0.0, 0.0, math.pi / 2.0)),
    # Position, attitude, velocity, rates: half a turn about x.
    Fault('north, east, down', BOTH, ERROR, 'odom up', 'z of base_link is down',
          'instead of NED and FRD', lambda seen: [
              row.__setitem__(slice(y, y + 2), [-row[y], -row[y + 1]])
              for row in seen.rows for y in (3, 6, 10, 13)]),
    Fault('loop closures', BOTH, WARNING, 'odom jumps', '1 in 250', 'turn off loop closure',
          lambda seen: [row.__setitem__(2, row[2] + 1.0) for row in seen.rows[125:]]),
    Fault('odometry that pauses', BOTH, WARNING, 'odom gaps', '1 in 215', 'why it pauses',
          lambda seen: seen.rows.__delitem__(slice(100, 135))),
    Fault('odometry of two sources', BOTH, WARNING, 'odom order', '1 in 250', 'two sources',
          lambda seen: seen.rows.insert(125, seen.rows.pop(120))),
    Fault('images of which some have no stamp', BOTH, ERROR, 'images latency', 'have no stamp',
          'stamp each message', unstamped(3)),
    Fault('images of which few have no stamp', BOTH, WARNING, 'images latency', 'have no stamp',
          'stamp each message', unstamped(30)),
    Fault('images of two clocks', BOTH, ERROR, 'images latency', 'older than the message before',
          'keep one', stamped_as(lambda n: n - 12 * (n > 12 and n % 2))),
    Fault('images that stop', LIVE, ERROR, 'images', 'stopped: none in the last 3', 'is it still',
          kept('image_raw', slice(60))),
    Fault('images above the shared memory', LIVE, WARNING, 'shared memory',
          'images of 2700 kB, of which some may be lost', 'fastdds.xml',
          pictures(bytes=1280 * 720 * 3)),
    Fault('nodes in another namespace', LIVE, ERROR, 'nodes', '/drone1/planner',
          'check --namespace',
          lambda seen: vars(seen).update(nodes=[f'/drone1{node}' for node in seen.nodes])),
    # Measured as it should be, or not at all.
    Fault('an offset that relative_pose has as a parameter', LIVE, OK, 'camera time offset',
          'corrected by time_offset', '',
          together(change(shifts=shift_rows(offset=0.05)), parameter(
              'relative_pose', 'time_offset', -0.05))),
    Fault('the pose by tf_static is used', LIVE, OK, 'odom up', 'leans', '', together(
        child_axes(*OPTICAL), change(child='imu', static=static_frames(OPTICAL)))),
    Fault('a leader that moves', LIVE, UNMEASURED, 'marker size', 'the leader moves', '',
          lambda seen: [row.__setitem__(2, row[2] + 0.3 * math.sin(0.4 * n))
                        for n, row in enumerate(seen.sightings)]),
    Fault('an axis that does not move', LIVE, UNMEASURED, 'odom positions',
          'z moved too little', '', level_flight(1.5)),
    Fault('a height below the start', BOTH, WARNING, 'odom positions',
          'z moved too little, and is -1.5 m', 'z points down', level_flight(-1.5)),
    Fault('parameters that the bridge has not compared', LIVE, UNMEASURED, 'autopilot parameters',
          'not compared yet', '',
          lambda seen: seen.statuses['mavlink_bridge'].values.pop('parameters')),
    Fault('a node whose parameters do not arrive', LIVE, UNMEASURED, 'settings',
          'no parameters received of mavlink_bridge', '',
          lambda seen: seen.parameters.pop('mavlink_bridge')),
    Fault('a node whose clock is unknown', LIVE, UNMEASURED, 'clock',
          'no parameters received of planner', '', lambda seen: seen.parameters.pop('planner')),
    Fault('an unknown space in shared memory', LIVE, UNMEASURED, 'shared memory',
          'is unknown', '', machine(shared_memory_free=None)),
    Fault('two planners with different files', LIVE, ERROR, 'nodes',
          'twice: planner (with a.yaml and with no file)', 'end one of each',
          lambda seen: vars(seen).update(
              nodes=[*seen.nodes, '/planner'], files={'planner': ['a.yaml', '']})),
    Fault('questions without an answer', LIVE, UNMEASURED, 'answers', 'none about TIMESYNC', '',
          bridge('unanswered questions', 'TIMESYNC, HOME_POSITION')),
    Fault('a parameter that could not be read', LIVE, UNMEASURED, 'autopilot parameters',
          'no answer about COM_OF_LOSS_T', '', bridge('parameters unread', 'COM_OF_LOSS_T')),
    Fault('an older bridge', LIVE, UNMEASURED, 'ready for offboard', 'not reported', '',
          lambda seen: seen.statuses['mavlink_bridge'].values.pop('offboard would be refused')),
    *(Fault(f'rectified false with {topic}', BOTH, ERROR, 'calibration',
            'but the topic is marked as rectified', 'rectified:=true',
            together(moved('image_raw', topic),
                     partial(lambda topic, seen: seen.names.update(image_raw=topic), topic),
                     change(lambda seen: seen.calibration, d=[0.1, 0.0, 0.0, 0.0, 0.0])))
      for topic in ('/image_rect', '/camera/image_rect/compressed', '/camera/image_rect_color',
                    '/zed/left/rect/image/compressed')),
    Fault('a node missing, and one whose name is a part of its name', LIVE, ERROR, 'nodes',
          'not running: relative_pose', 'ros2 launch',
          lambda seen: vars(seen).update(nodes=['/pose', *(
              node for node in seen.nodes if node != '/relative_pose')])),
    *(Fault('a vehicle at rest', LIVE, UNMEASURED, what, measured, '', at_rest)
      for what, measured in (('odom velocity', 'moved too little'), ('marker size', HOW),
                             *((name, 'turned too little') for name in (
                                 'odom ahead', 'camera time offset', 'focal length',
                                 'camera mounting')))),
    Fault('odometry at ten hertz', LIVE, UNMEASURED, 'camera time offset', 'odometry comes only',
          '', together(kept('odom', slice(None, None, 5)), change(rows=odometry_rows(10.0)))),
    Fault('odometry at ten hertz', LIVE, WARNING, 'odom rate', '10.0 Hz', 'raise the output rate',
          together(kept('odom', slice(None, None, 5)), change(rows=odometry_rows(10.0)))),
    Fault('a node without diagnostics', LIVE, UNMEASURED, 'planner status', 'nothing received', '',
          lambda seen: seen.statuses.pop('planner')),
]


CASES = [pytest.param(one, live, id=f'{one.name}: {one.what}, {"live" if live else "bag"}')
         for one in FAULTS for live in one.where]


@pytest.mark.parametrize('live', [True, False])
def test_what_is_well_raises_no_alarm(live: bool) -> None:
    findings = healthy(live).judged()
    assert [finding.line for finding in findings if finding.level != OK] == []
    assert len(findings) > 15 and ready(findings)
    said = {finding.what: finding.measured for finding in findings}
    assert said['odom positions'] == 'agree with the velocity'
    assert said['odom velocity'] == 'in the child frame'
    assert said['odom ahead'] == 'turning explains 100% of it'
    assert said['camera time offset'] in ('about 0 ms', 'about 1 ms')
    assert said['marker size'] == 'moves 1.00 ± 0.00 times as far'
    assert said['camera mounting'] == 'off by 0 deg'


@pytest.mark.parametrize(('one', 'live'), CASES)
def test_a_fault_is_named_in_one_line_that_says_what_to_do(one: Fault, live: bool) -> None:
    seen = healthy(live)
    one.make(seen)
    findings = seen.judged()
    named = [finding for finding in findings if finding.what == one.what
             and one.measured in finding.measured and finding.level == one.level]
    assert len(named) == 1, [finding.line for finding in findings if finding.level != OK]
    assert one.advice in named[0].advice
    assert '\n' not in named[0].line
    assert all(bool(finding.advice) is (finding.level in (WARNING, ERROR)) for finding in findings)
    assert ready(findings) is (not still_needed(findings) and all(
        finding.level != ERROR for finding in findings))
    if one.level in (OK, WARNING, UNMEASURED):
        assert all(finding.level != ERROR for finding in findings)


def test_an_image_without_an_encoding_is_a_fault() -> None:
    seen, message = Observations(), empty(TYPES['image_raw'])
    Collector(seen, 5.0).take('image_raw', '/image_raw', message, 1.0)
    assert 'encoding' in seen.pictures[0].fault


def test_a_segment_is_dead_once_nobody_locks_it(tmp_path: Path) -> None:
    free, locked, young, other = (
        tmp_path / f'{name}_el' for name in ('fastrtps_a', 'fastrtps_b', 'fastrtps_c', 'other'))
    kilted = tmp_path / 'fastdds_a_el'
    for path in (free, locked, young, other, kilted):
        path.touch()
        if path is not young:
            os.utime(path, (1.0, 1.0))
    with open(locked, 'rb') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert sorted(dead_segments(tmp_path)) == [kilted, free]
