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

"""From where ROS is reached in a process, read from tables of sockets as kernels wrote them."""

from __future__ import annotations

from pathlib import Path

import pytest

from flock_follower.checks.reach import find_reach, Reach

#: Sockets of a node on domain 77, whose ports begin with 0x681A = 26650. Fast DDS 2.14 and 3.2
#: bind the same: by ROS's default, with LOCALHOST, and with config/dds/fastdds.xml. 0x1B58 and the
#: last one, by which it sends, are no ports of the domain.
DEFAULT = ['00000000:1B58', '00000000:681A', '00000000:6824', '00000000:6825', '020200C0:E56C']
LOCALHOST = ['00000000:1B58', '00000000:6824', '00000000:6825', '020200C0:E896']
PROFILE = ['0100007F:1B58', '0100FFEF:681A', '0100007F:681A', '0100007F:6824', '0100007F:6825',
           '020200C0:B6FD']
MAVLINK = ['00000000:38D6']
LOOPBACK_6, ANY_6, MAPPED_LOOPBACK = (f'{address}:6824' for address in (
    '00000000000000000000000001000000', '0' * 32, '0000000000000000FFFF00000100007F'))


def make_process(proc: Path, sockets: list[str]) -> int:
    """Make the folder of process 7 in /proc, with its own sockets and one of another process."""
    descriptors, tables = proc / '7' / 'fd', proc / '7' / 'net'
    for folder in (descriptors, tables):
        folder.mkdir(parents=True)
    lines: dict[str, list[str]] = {
        'udp': ['  99: 00000000:681A 00000000:0000 07 0:0 00:0 0 0 0 99'], 'udp6': []}
    for i, socket in enumerate(sockets, start=100):
        (descriptors / str(i)).symlink_to(f'socket:[{i}]')
        lines['udp' if len(socket) < 32 else 'udp6'].append(
            f'  {i}: {socket} 00000000:0000 07 00000000:00000000 00:00000000 00000000 0 0 {i} 2')
    (descriptors / '3').symlink_to('/dev/null')
    for name, rows in lines.items():
        (tables / name).write_text('\n'.join(['  sl  local_address rem_address ...', *rows]))
    return 7


@pytest.mark.parametrize(('sockets', 'reach'), [
    (DEFAULT, Reach.NETWORK), (LOCALHOST, Reach.ADDRESS), (PROFILE, Reach.COMPUTER),
    ([*PROFILE, *MAVLINK], Reach.COMPUTER), ([*PROFILE, '0107D50A:6826'], Reach.ADDRESS),
    (['0107D50A:681A', '0107D50A:6824'], Reach.NETWORK),
    ([LOOPBACK_6], Reach.COMPUTER), ([MAPPED_LOOPBACK], Reach.COMPUTER), ([ANY_6], Reach.ADDRESS),
    (MAVLINK, None), ([], None), (['00000000:6819', '00000000:6914'], None)])
def test_the_reach_is_that_of_the_sockets_of_the_domain(
        tmp_path: Path, sockets: list[str], reach: Reach | None) -> None:
    assert find_reach(make_process(tmp_path, sockets), 77, tmp_path) == reach


def test_the_reach_of_a_process_that_is_not_readable_is_unknown(tmp_path: Path) -> None:
    assert find_reach(7, 77, tmp_path) is None


def test_a_kernel_without_ipv6_has_one_table(tmp_path: Path) -> None:
    process = make_process(tmp_path, DEFAULT)
    (tmp_path / '7' / 'net' / 'udp6').unlink()
    assert find_reach(process, 77, tmp_path) == Reach.NETWORK
