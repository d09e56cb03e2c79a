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
One command to follow: check, then arm, take off, offboard, engage; a key confirms each step.

Run ``ros2 run flock_follower follow`` while the nodes run. If findings of ``check`` prevent a
flight, the command prints the findings and ends; if the vehicle is in the air already, the command
only lands or hands over. A line shows state, distance, reason and battery. If a step is refused,
the reason is printed, and the same step is requested again with its key. The key l lands. Ctrl-C,
SIGTERM and a closed terminal brake and hand over: the planner is disengaged, and the autopilot
holds.

Exit code 0 after a landing, 130 after Ctrl-C, 1 if a node is missing or ``check`` finds a fault.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import re
import sys

from flock_follower.check import LISTENING_TIME, table
from flock_follower.checks.findings import ready
from flock_follower.checks.recorded_system import judge_all
from flock_follower.messages.bridge_diagnostics import FLYING, read_flag
from flock_follower.signals import show_error


def main(args: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code."""
    parser = argparse.ArgumentParser(
        prog='follow', description='Check; then arm, take off, request offboard, engage: each '
        'step by its key. l lands; Ctrl-C, SIGTERM and a closed terminal brake and hand over.')
    parser.add_argument('--namespace', default='', help='of the nodes')
    parser.add_argument('--yes', action='store_true', help='no keys, for a simulator: refused '
                        'unless the bridge has a loopback connection. A router on this machine '
                        'looks the same: never with a real vehicle')
    options = parser.parse_args(args)
    if not re.fullmatch(r'[\w/]*', options.namespace):
        parser.error(f'--namespace {options.namespace}: must be letters, digits, _ and /')
    try:
        from flock_follower.nodes.observer import observe
        from flock_follower.nodes.pilot import fly
    except ModuleNotFoundError as error:
        show_error(ModuleNotFoundError, error, None)
        return 2
    try:
        seen = observe(LISTENING_TIME, options.namespace, {}, '')
    except KeyboardInterrupt:
        return 130
    findings = judge_all(seen)
    print(table(seen, findings))
    flyable = ready(findings)
    bridge = seen.status('mavlink_bridge')
    flying = bridge is not None and read_flag(bridge.values, FLYING) is True
    if not flyable and (options.yes or not flying):
        return 1
    return fly(options.namespace, not options.yes, flyable)


if __name__ == '__main__':
    sys.exit(main())
