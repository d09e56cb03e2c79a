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

"""The outcomes of one follower, and the listener that receives them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flock_follower.gate.setpoint_rules import Setpoint
from flock_follower.messages import OdometryState
from flock_follower.perception.tracker import Sighting
from flock_follower.planner.inputs import OwnState
from flock_follower.planner.step import Decision


@dataclass
class ImageOutcome:
    """
    The outcome of one image: its stamp, ns, the sighting, and the CPU time, s.

    ``sighting`` is None if the image was never processed; ``camera`` is the name of its
    camera, '' if there is only one.
    """

    stamp: int
    sighting: Sighting | None = None
    decoding: float = 0.0
    perception: float = 0.0
    camera: str = ''


@dataclass
class Tick:
    """One tick of the planner, at a time in ns, with the ego state it acted on."""

    time: int
    decision: Decision
    own: OwnState | None
    cpu: float


@dataclass
class ControlCycle:
    """One cycle of the control, at a time in ns; nothing is sent if the kind is 'none'."""

    time: int
    setpoint: Setpoint
    cpu: float


class Listener:
    """Receives the outcomes of ``Follower``, in the order of the events; each method is empty."""

    def publish(self, topic: str, msgtype: str, time: int, message: Any) -> None:
        """Take a message that a node would publish, at a time in ns."""

    def odometry(self, state: OdometryState) -> None:
        """Take the ego state."""

    def image(self, outcome: ImageOutcome) -> None:
        """Take the outcome of an image."""

    def tick(self, tick: Tick) -> None:
        """Take the outcome of a tick of the planner."""

    def cycle(self, cycle: ControlCycle) -> None:
        """Take the outcome of a cycle of the control."""

    def send(self, time: int, messages: list[OdometryState]) -> None:
        """Take messages to other followers, at a time in ns."""

    def reject(self, reason: str, detail: str) -> None:
        """Take the reason for which an input was dropped."""
