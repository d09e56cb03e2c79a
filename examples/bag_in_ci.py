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
Judge a bag in your own CI by what ``evaluate`` wrote of it; bag_in_ci.yaml is the workflow.

    python -m flock_desk.evaluate BAG --output OUT
    python examples/bag_in_ci.py OUT/summary.json      # exit code 1 if a bound is broken

Bounds on single figures need no Python: ``evaluate --expect bounds.yaml``. Here are also figures
made of several, and this needs nothing but Python.
"""

import json
from pathlib import Path
import sys

if len(sys.argv) != 2:
    sys.exit('usage: bag_in_ci.py OUT/summary.json, as evaluate wrote it')
summary = json.loads(Path(sys.argv[1]).read_text(encoding='utf-8'))
planner, setpoints = summary['planner'], summary['setpoints']

# Name, figure, least, greatest. A figure is None if the bag lacks its data: errors need truth/odom
# and truth/neighbors.
BOUNDS = [
    ('share of images in which the leader was found', summary['recall'], 0.95, None),
    ('share of ticks that followed', planner['states']['TRACK'] / planner['ticks'], 0.9, None),
    ('nearest estimated distance, m', summary['distance_m']['min'], 1.0, None),
    ('share of setpoints that only braked',
     setpoints['brake'] / max(setpoints['brake'] + setpoints['command'], 1), None, 0.05),
    ('error of the distance, RMS, m', summary['distance_rms_m'], None, 0.02),
    ('error of the velocity, RMS of the vector, m/s', summary['velocity_rms_m_s'], None, 0.15),
]

broken = 0
for what, figure, least, greatest in BOUNDS:
    if figure is None:
        print(f'unknown            {what}')
        continue
    ok = (least is None or figure >= least) and (greatest is None or figure <= greatest)
    bound = f'at least {least:g}' if greatest is None else f'at most {greatest:g}'
    print(f'{"ok" if ok else "BROKEN":7}  {figure:8.4g}  {what}: {bound}')
    broken += not ok
sys.exit(1 if broken else 0)
