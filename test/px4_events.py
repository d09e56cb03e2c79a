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
Make ``flock_follower/mavlink/px4_events.txt`` from the sources of several versions of PX4.

``px4_events.py 1.16=FOLDER 1.18=FOLDER``: each folder holds the sources of a version in which
``make px4_sitl`` was run, which writes the metadata of the events. Change ``TEXTS``, not the file.
"""

import json
from pathlib import Path
import sys

from flock_follower.mavlink.status_texts import (
    ACTION,
    CHECK,
    COMMANDER,
    event_number,
    OTHER,
)

PATH = Path(__file__).resolve().parents[1] / 'flock_follower/mavlink/px4_events.txt'
METADATA = 'build/px4_sitl_default/events/all_events.json'
#: Id in the metadata of the component that sends the events: the autopilot.
AUTOPILOT = '1'
ACTIONS = 'failsafe_action_t'
#: The order of the rows.
KINDS = (CHECK, COMMANDER, ACTION, OTHER)
#: The events of the module `commander`; checks that are part of a report are in these groups.
PREFIXES = ('check_', 'commander_')
CHECK_GROUPS = ('arming_check', 'health')
HEADER = """\
# Events of PX4, by name: written by `make px4-events`, with the texts of test/px4_events.py.
# NAME | VERSIONS of PX4 that send it | KIND | TEXT. A "check" is part of the report of all checks,
# "commander" is an event by itself, "action" an action of the failsafe by its number; the bridge
# reports these. It knows the "other" events, and reports none.
"""
#: Texts that say more than the words of the name.
TEXTS = {
    'check_modes_angular_velocity': 'no angular velocity',
    'check_modes_attitude': 'no attitude estimate',
    'check_modes_local_pos': 'no valid position estimate',
    'check_modes_global_pos': 'no global position (neither GPS nor an origin)',
    'check_modes_local_alt': 'no valid altitude estimate',
    'check_modes_mission': 'no mission',
    'check_modes_offboard_signal': 'no setpoint stream',
    'check_modes_offboard_signal_lost': 'no setpoint stream',
    'check_modes_offboard_no_attitude': 'no attitude estimate for offboard',
    'check_modes_offboard_no_local_position': 'no position estimate for offboard',
    'check_modes_offboard_no_local_velocity': 'no velocity estimate for offboard',
    'check_modes_home_position': 'no home position',
    'check_modes_manual_control': 'no transmitter',
    'check_modes_cannot_takeoff': 'it does not arm in this mode',
    'check_rc_dl_no_dllink': 'no ground station',
    'check_system_arm_auth_failed': 'arm authorization denied',
    'check_system_safety_button': 'press the safety button',
    'check_man_control_kill_engaged': 'the kill switch is on',
    'commander_armed_by': 'armed',
    'commander_arm_denied_calibrating': 'arming denied: calibrating',
    'commander_arm_denied_not_manual': 'arming denied: the mode is not a manual one',
    'commander_arm_denied_resolve_failures': 'arming denied: resolve the failed checks',
    'commander_arm_denied_throttle_center': 'arming denied: throttle above its center',
    'commander_arm_denied_throttle_high': 'arming denied: throttle too high',
    'commander_arm_denied_throttle_unsafe': 'arming denied: throttle not where it is safe',
    'commander_disarm_denied_not_landed': 'disarming denied: not landed',
    'commander_disarmed_by': 'disarmed',
    'commander_dl_regained': 'the ground station is back',
    'commander_failsafe_enter_crit_bat_warn': 'the battery is critical',
    'commander_failsafe_enter_crit_low_bat_warn': 'the battery is almost empty',
    'commander_failsafe_enter_generic_warn': 'failsafe: a warning',
    'commander_failsafe_enter_low_bat': 'the battery is low',
    'commander_failsafe_enter_low_flight_time_warn': 'little flight time remains',
    'commander_failsafe_enter_warn': 'failsafe: a warning',
    'commander_gcs_lost': 'the ground station is lost',
    'commander_kill_sw_disengaged': 'the kill switch is off',
    'commander_kill_sw_engaged': 'the kill switch is on',
    'commander_landing_current_pos': 'landing here',
    'commander_mission_comp_lost': 'this computer is lost',
    'commander_modeswitch_not_avail': 'the mode is not available',
    'commander_onboard_ctrl_regained': 'this computer is back',
    'commander_rc_lost': 'the transmitter is lost',
    'commander_rc_loss_hold_no_failsafe': 'the transmitter is lost, without a failsafe',
    'commander_rc_override': 'the pilot took over by the sticks',
    'commander_rc_regained': 'the transmitter is back',
    'commander_rtl': 'Return'}
ACTION_TEXTS = {
    'none': 'nothing', 'warn': 'a warning', 'fallback_posctrl': 'Position',
    'fallback_altctrl': 'Altitude', 'fallback_stabilized': 'Stabilized', 'hold': 'Hold',
    'rtl': 'Return', 'land': 'Land', 'descend': 'Descend', 'disarm': 'disarming',
    'terminate': 'termination'}


def row_of(name: str, group: str) -> tuple[str, str]:
    """Return kind and text of an event, by its name and its group in the metadata."""
    kind = (CHECK if group in CHECK_GROUPS and name.startswith(PREFIXES[0]) else
            COMMANDER if name.startswith(PREFIXES) else OTHER)
    words = name
    for prefix in PREFIXES:
        words = words.removeprefix(prefix)
    return kind, TEXTS.get(name) or words.replace('_', ' ')


def read_version(folder: Path) -> dict[str, tuple[str, str]]:
    """
    Return kind and text of each event, and of each action of the failsafe, in sources of PX4.

    :raises ValueError: if the number of an event is not the hash of its name.
    """
    metadata = json.loads((folder / METADATA).read_text(encoding='utf-8'))
    autopilot = metadata['components'][AUTOPILOT]
    found = {}
    for group, content in autopilot['event_groups'].items():
        for number, event in content['events'].items():
            if event_number(event['name']) != int(number):
                raise ValueError(f'{event["name"]} has the number {number}, not that of its name')
            found[event['name']] = row_of(event['name'], group)
    for number, entry in autopilot['enums'][ACTIONS]['entries'].items():
        found[f'failsafe_action_{number}'] = ACTION, ACTION_TEXTS.get(
            entry['name'], entry['name'].replace('_', ' '))
    return found


def render(versions: dict[str, dict[str, tuple[str, str]]]) -> str:
    """
    Return the file.

    :param versions: the kinds and texts by name, by version.
    :raises ValueError: if a name has another kind or text in another version.
    """
    rows: dict[str, tuple[list[str], tuple[str, str]]] = {}
    for version, found in versions.items():
        for name, row in found.items():
            known = rows.setdefault(name, ([], row))
            if known[1] != row:
                raise ValueError(f'{name}: {known[1]}, but {row} in {version}')
            known[0].append(version)
    return HEADER + ''.join(
        ' | '.join((name, ' '.join(rows[name][0]), *rows[name][1])) + '\n'
        for name in sorted(rows, key=lambda name: (KINDS.index(rows[name][1][0]), name)))


def main(arguments: list[str]) -> int:
    """Write the file; return the exit code."""
    if not arguments or not all('=' in each for each in arguments):
        print('usage: px4_events.py VERSION=FOLDER ... (the sources of PX4, after make px4_sitl)',
              file=sys.stderr)
        return 2
    pairs = [each.partition('=') for each in arguments]
    PATH.write_text(render({version: read_version(Path(folder)) for version, _, folder in pairs}),
                    encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
