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

"""What deploy/ holds: unit, udev rule, settings of the router, recipe of the container."""

from __future__ import annotations

from collections import defaultdict
from configparser import ConfigParser
from pathlib import Path
import re
import shlex
import shutil
import subprocess

from launch_files import launched
import pytest

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / 'deploy'
UNIT = DEPLOY / 'flock_follower@.service'
SCRIPTS = [path for path in sorted(DEPLOY.iterdir()) if path.read_text().startswith('#!')]


def keys(unit: Path) -> dict[str, list[str]]:
    """Return what a unit says: a list for each key, as a key may be given again."""
    said: dict[str, list[str]] = defaultdict(list)
    for line in unit.read_text().splitlines():
        if line and line[0] not in '#[':
            key, _, value = line.partition('=')
            said[key].append(value)
    return said


def example() -> dict[str, str]:
    """Return the variables of the example, read as a shell does; systemd reads these alike."""
    text = (DEPLOY / 'example.env').read_text().replace('\\\n', '')
    return {name: shlex.split(value)[0] for name, value in re.findall(
        r'^([A-Z_]+)=(.*)$', text, re.M)}


@pytest.mark.parametrize('command', [
    ('systemd-analyze', 'verify', '{tmp}/flock_follower@.service'),
    ('udevadm', 'verify', str(DEPLOY / '61-flight-controller.rules')),
    ('shellcheck', *map(str, SCRIPTS))])
def test_the_programs_of_the_system_take_our_files(
        command: tuple[str, ...], tmp_path: Path) -> None:
    if shutil.which(command[0]) is None:
        pytest.skip(f'{command[0]} is not there')
    # Only what the installer puts in place is not there yet.
    (tmp_path / UNIT.name).write_text(UNIT.read_text().replace(
        '/usr/local/lib/flock_follower/start', str(DEPLOY / 'start')))
    ended = subprocess.run([word.format(tmp=tmp_path) for word in command], text=True,
                           capture_output=True, timeout=20.0)
    if 'verify' in ended.stderr and command[0] == 'udevadm':
        pytest.skip('udevadm verify is not there (systemd 254)')
    assert ended.stderr + ended.stdout == ''


def test_unit_starts_in_any_order_and_ends_as_ctrl_c_does() -> None:
    said = keys(UNIT)
    assert not {'Requires', 'BindsTo', 'Requisite', 'After', 'Wants'} & said.keys()
    assert said['Restart'] == ['always'] and said['StartLimitIntervalSec'] == ['0']
    # The bridge brakes before it ends. Were launch killed, mixed or process would kill it, too.
    assert said['KillSignal'] == ['SIGINT'] and float(said['TimeoutStopSec'][0]) > 10.0
    assert not {'KillMode', 'PrivateDevices', 'DevicePolicy', 'DeviceAllow', 'ProtectClock',
                'PrivateNetwork', 'RestrictRealtime', 'CPUAffinity', 'CPUSchedulingPolicy'
                } & said.keys()
    assert 'dialout' in said['SupplementaryGroups'][0].split()
    environment = dict(line.split('=', 1) for line in said['Environment'])
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert not {'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_STATIC_PEERS'} & example().keys()


def test_the_example_gives_arguments_that_the_launch_file_has() -> None:
    said = example()
    given = dict(word.split(':=', 1) for word in shlex.split(said['LAUNCH_ARGUMENTS']))
    nodes, known = launched(said['LAUNCH_FILE'], **given)
    assert given.keys() <= set(known)
    assert nodes['mavlink_bridge'].parameters[-1]['connection'] == given['connection']
    (prefix,) = re.findall(r"bridge_prefix:='(\S+) \d+ \d+'",
                           (DEPLOY / 'example.env').read_text())
    assert prefix == '/usr/local/lib/flock_follower/prefer_realtime'
    assert int(re.findall(r'prefer_realtime \d+ (\d+)', (DEPLOY / 'example.env').read_text())[0]
               ) <= int(keys(UNIT)['LimitRTPRIO'][0])


def test_udev_rule_device_is_the_one_named_elsewhere() -> None:
    rules = (DEPLOY / '61-flight-controller.rules').read_text()
    (link,) = set(re.findall(r'SYMLINK\+="([^"]+)"', rules))
    connection = dict(word.split(':=') for word in example()['LAUNCH_ARGUMENTS'].split())
    assert connection['connection'] == f'/dev/{link},921600'
    assert f'Device = /dev/{link}\n' in (DEPLOY / 'mavlink-router.conf').read_text()
    assert 'ID_MM_DEVICE_IGNORE' in rules and 'GROUP="dialout"' in rules


def test_the_router_sends_to_where_the_bridge_listens() -> None:
    router = ConfigParser()
    router.read(DEPLOY / 'mavlink-router.conf')
    bridge = router['UdpEndpoint bridge']
    assert bridge['Mode'] == 'Normal'
    _, said = launched('follower.launch.py')
    assert said['connection'] == f'udpin:{bridge["Address"]}:{bridge["Port"]}'
    # Nobody is let in who is not named.
    assert router['General']['TcpServerPort'] == '0'
    assert all(section.get('Mode', 'Normal') == 'Normal' for section in router.values())
