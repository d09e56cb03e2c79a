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
Fuzz for longer than the test suite does: ``python test/fuzz.py --bytes 10000000``.

Prints what came through, and exits with 1 and the way to see it again where something did not.
"""

from __future__ import annotations

import argparse
import sys
import time

import conftest  # noqa: F401  keeps DDS on this machine; before anything imports rclpy
from fuzz_mavlink import fuzz_autopilot, fuzz_bridge, FuzzError
from fuzz_nodes import fuzz_node, NODES
import numpy as np
import rclpy

PERSONALITIES = ('px4', 'arducopter')


def main(args: list[str] | None = None) -> int:
    """Run the fuzzing and return the exit code."""
    parser = argparse.ArgumentParser(description='Fuzz the bridge and the nodes.')
    parser.add_argument('--bytes', type=int, default=1_000_000,
                        help='of MAVLink, for each personality (%(default)s)')
    parser.add_argument('--messages', type=int, default=100_000,
                        help='of ROS, for each node (%(default)s)')
    parser.add_argument('--seed', type=int, default=1,
                        help='another one, other input (%(default)s)')
    parser.add_argument('--nodes', nargs='*', choices=NODES, default=NODES, help='only these')
    options = parser.parse_args(args)
    rclpy.init()
    np.seterr(all='ignore')  # no error where the result is thrown away
    try:
        for personality in PERSONALITIES:
            _say(personality, options.bytes, 'bytes')
            under_fire = fuzz_bridge(options.bytes, options.seed, personality)
            _say(f'  sent {dict(under_fire.sent)}; setpoints {dict(under_fire.kinds)}; '
                 f'ignored {dict(under_fire.link.ignored)}')
            under_fire = fuzz_bridge(options.bytes, options.seed, personality, b'k' * 32)
            _say(f'  signed: sent {dict(under_fire.sent)}; setpoints {dict(under_fire.kinds)}')
            fuzz_autopilot(options.bytes, options.seed, personality)
        for kind in options.nodes:
            _say(kind, options.messages, 'messages')
            under_fire = fuzz_node(kind, options.messages, options.seed)
            _say(f'  published {dict(under_fire.published)}; '
                 f'rejected {dict(under_fire.node.diagnostics.counters)}')
    except FuzzError as failure:
        print(f'FAILED: {failure}', file=sys.stderr)
        return 1
    _say('nothing found')
    return 0


def _say(*words: object) -> None:
    print(time.strftime('%H:%M:%S'), *words, flush=True)


if __name__ == '__main__':
    sys.exit(main())
