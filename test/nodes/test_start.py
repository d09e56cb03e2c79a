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

"""What a node loads at its start, besides its imports."""

import subprocess
import sys

from flock_desk.runs.processes import private_environment

STARTED = """
import sys
import rclpy
from flock_follower.nodes.support.process import run

def make():
    rclpy.create_node('started')
    print(sorted({'lark', 'tempfile'} & sys.modules.keys()))
    raise SystemExit(0)

run(make, [])
"""


def test_a_node_loads_no_generator_of_messages() -> None:
    done = subprocess.run([sys.executable, '-c', STARTED], env=private_environment(),
                          capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == '[]\n'
