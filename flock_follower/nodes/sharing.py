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

"""The node ``flock`` by its former name, for one release; see ``nodes.flock``."""

from __future__ import annotations

import sys

from flock_follower.nodes.flock import SharingNode, SPECS
from flock_follower.nodes.support.process import run

__all__ = ['SPECS', 'main']


def _node() -> SharingNode:
    return SharingNode('sharing')


def main(args: list[str] | None = None) -> int:
    """Run the node under its former name, so that its section in parameter files still counts."""
    return run(_node, args)


if __name__ == '__main__':
    sys.exit(main())
