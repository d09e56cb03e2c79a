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
A scenario of your own, flown ten times in lock step, and its report: no ROS, some seconds.

    python examples/scenario_report.py [OUT]    # OUT/report.html, summary.json (build/climbing)
"""

from pathlib import Path
import signal
import sys

from matplotlib.figure import Figure
import numpy as np

from flock_desk.closed_loop.campaign import fly
from flock_desk.closed_loop.metrics import measure, summary
from flock_desk.runs.judge import judge, parse_bounds
from flock_desk.runs.report import announce, Chapter, Illustration, write_report
from flock_desk.runs.summary import write_summary
from flock_desk.scenarios.scenario_file import parse

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback
SCENARIO = """
summary: the leader climbs as it goes, and hides for a second
duration: 20
flight: {v_max: 1.0}
start: {distance: 2.0}
leader: {motion: stairs, speed: [0.4, 0.6], climb: 0.3, height: 1.5, heading: away}
outages: [{what: marker, at: 10, duration: 1}]
"""  # every key: python -m flock_desk.flights --keys
BOUNDS = {'in_band': {'min': 0.9}, 'min_separation_m': {'min': 0.9}}
out = Path(sys.argv[1] if len(sys.argv) > 1 else 'build/climbing')
out.mkdir(parents=True, exist_ok=True)
scenario = parse(SCENARIO, 'climbing.yaml')
flights = fly(scenario, runs=range(10), guard=True)  # a run's number is its seed
figures = summary(measure(flights))
judgments = judge(parse_bounds(BOUNDS), figures)

figure = Figure(figsize=(9, 3.5), layout='constrained')
axes = figure.subplots()
axes.axhspan(scenario.flight.d0**0.5, scenario.flight.d1**0.5, alpha=0.1)
axes.plot(flights.times, np.linalg.norm(flights.leader - flights.follower, axis=2).T, lw=0.8)
axes.set(title='true distance, every run; shaded: the band', xlabel='time [s]', ylabel='[m]')
figure.savefig(out / 'distances.png')
write_summary(figures, out / 'summary.json')
write_report(out / 'report.html', scenario.name, scenario.summary, figures, judgments, [
    Chapter('Distances', '', [Illustration((out / 'distances.png').read_bytes(), 'distance')])])
sys.exit(announce(figures, judgments, [out / 'report.html']))
