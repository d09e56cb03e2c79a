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
In which frame a source gives its velocity: found by comparing it with how the position moves.

REP-105 says the child frame. Some sources use the header's, others give none, or nonsense. Over
windows of ``WINDOW`` seconds the mean of the velocity, read in each way, is compared with the way
covered. The evidence for one reading against the other adds up, window by window, where they
differ (with yaw 0 they do not), until it is sure. Where neither agrees in ``AGREEING`` windows in
a row, now or after one was found, the velocity is dropped. It is used again as soon as it was
dropped, once it agrees at speed in as many windows; where nothing moves, after ``EXPIRES``.

As long as the frame is not known the velocity comes from the positions; but where the two readings
are the same, and have been seen to agree with the positions at speed, which it is does not matter.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flock_follower.geometry import Array

CHILD: Final = 'child'
ODOM: Final = 'odom'
NONE: Final = 'none'
EITHER: Final = 'either'
AUTO: Final = 'auto'
CHOICES: Final = (AUTO, CHILD, ODOM, NONE)

#: s over which velocities and positions are compared.
WINDOW: Final[float] = 0.5
#: A window has pieces of so many s, at least this many. A filter that corrects itself makes steps
#: in single pieces (0.29 m in a real flight), a velocity read wrongly is wrong in all.
PIECE: Final[float] = 0.095
FEWEST: Final[int] = 3
#: Windows in a row in which no reading agrees, after which none is believed.
AGREEING: Final[int] = 2
#: Windows in a row that agree, at whatever speed, after which a reading that was found once is
#: believed again: 4 s.
EXPIRES: Final[int] = 8
#: Log of the likelihood ratio from which on one reading is believed: readings that differ by three
#: deviations give 4.5. One window counts for less, so that one alone decides nothing.
SURE: Final[float] = 6.0
MOST_OF_ONE: Final[float] = 4.0
#: Readings that differ by less, m/s along any axis, are as good as the same: their mean is used.
SAME: Final[float] = 0.1
#: By how much a sound velocity differs from the way covered in a window, standard deviation: m/s,
#: and as a share of the speed (real sources: 0.02 to 0.05 m/s).
DEVIATION: Final[float] = 0.05
SHARE: Final[float] = 0.03

#: A piece: time, s, then m: way (3,), and how much longer it is by either reading (2, 3). In plain
#: numbers: arrays so small would take several times as long, for every message.
_NOTHING: Final = (0.0,) * 10
_Numbers = tuple[float, ...]


class TwistFrame:
    """
    Watches a source; ``frame`` is how to read its velocity: 'child', 'odom', or 'none' at all.

    :param wanted: one of these, which is then obeyed, or 'auto'.
    """

    def __init__(self, wanted: str = AUTO) -> None:
        self.wanted = wanted
        self.found = ''
        """What the positions say: one of these, or '' while they have not said."""
        self.contradiction: float = 0.0
        """By how much, m/s, the reading in use was off in the window that last contradicted it."""
        self._before = ''  # what was found before the velocity was dropped
        self._failing = 0
        self._agreeing = 0  # windows in a row, since it was dropped
        self._moving = 0
        self._evidence = 0.0  # for 'child', against 'odom'
        self.restart()

    @property
    def frame(self) -> str:
        """Return how to read the velocity now; 'none' while it is not known."""
        return (self.found or NONE) if self.wanted == AUTO else self.wanted

    def reading(self, child: Array, odom: Array) -> str:
        """Return how to read a velocity, given both readings (3,), m/s."""
        if self.frame == NONE and self._sound and not self.found and self.wanted == AUTO:
            same = float(np.abs(child - odom).max()) <= SAME
            return EITHER if same else NONE
        return self.frame

    @property
    def describe(self) -> str:
        """Return what is known, in words."""
        if self.wanted == NONE:
            return 'none: the velocity comes from the positions'
        if self.wanted != AUTO:
            doubt = {'': '', self.wanted: ' (the positions agree)'}.get(
                self.found, f' as told, but the positions say {self.found}')
            return self.wanted + doubt
        if not self.found:
            return 'auto: not known yet, the velocity comes from the positions where it matters'
        if self.found == NONE:
            return ('auto: none, the velocity comes from the positions: that of the messages '
                    f'is off by {self.contradiction:.2f} m/s')
        return f'auto: {self.found}, found by the positions'

    @property
    def _sound(self) -> bool:
        """Return whether the velocity agreed with the positions, read either way, at speed."""
        return self._moving >= AGREEING and not self._failing

    def restart(self) -> None:
        """Begin a new window: the position jumped, or there was a gap."""
        self._last: _Numbers | None = None
        self._begin()

    def _begin(self) -> None:
        self._pieces: list[_Numbers] = []
        self._piece: _Numbers = _NOTHING

    def take(self, stamp: float, position: Array, child: Array, odom: Array) -> None:
        """Take a position (3,), m, and the velocity there, m/s, in odom, read in both ways."""
        now = (stamp, *position.tolist(), *child.tolist(), *odom.tolist())
        last, self._last = self._last, now
        if last is None:
            return
        dt = stamp - last[0]
        half = 0.5 * dt  # trapezoids: a slow source has few messages in a window
        _, a, b, c, d, e, f, g, h, i = last
        _, p, q, r, s, t, u, v, w, x = now
        piece = self._piece
        right, ahead, up = p - a, q - b, r - c
        piece = self._piece = (
            piece[0] + dt, piece[1] + right, piece[2] + ahead, piece[3] + up,
            piece[4] + (half * (d + s) - right), piece[5] + (half * (e + t) - ahead),
            piece[6] + (half * (f + u) - up), piece[7] + (half * (g + v) - right),
            piece[8] + (half * (h + w) - ahead), piece[9] + (half * (i + x) - up))
        if piece[0] < PIECE:
            return
        self._pieces.append(piece)
        self._piece = _NOTHING
        if len(self._pieces) >= FEWEST:
            pieces = np.array(self._pieces)
            if pieces[:, 0].sum() > WINDOW - 0.5 * PIECE:
                self._judge(pieces[:, 0], pieces[:, 1:4], pieces[:, 4:].reshape(-1, 2, 3))
                self._begin()

    def _judge(self, times: Array, ways: Array, offs: Array) -> None:
        """
        Take what a window says, by its n pieces.

        :param times: (n,), s.
        :param ways: (n, 3), m, by the positions.
        :param offs: (n, 2, 3), m: how much longer the ways are by the two readings.
        """
        time = float(times.sum())
        speed = float(np.linalg.norm(ways.sum(axis=0))) / time
        tolerance = 3.0 * (DEVIATION + SHARE * speed)
        mean = offs.sum(axis=0) / time
        means = np.linalg.norm(mean, axis=1)
        # Noise of the positions is least in the mean, and single steps do not show in the median.
        medians = np.linalg.norm(np.median(offs / times[:, None, None], axis=0), axis=1)
        off = np.minimum(means, medians)
        fitting = [name for name, by in zip((CHILD, ODOM), off.tolist()) if by <= tolerance]
        if self.found == NONE:
            self._recover(fitting, speed > tolerance)
            return
        fits = self.found in fitting if self.found else bool(fitting)
        self._failing = 0 if fits else self._failing + 1
        self._moving += fits and speed > tolerance
        if self._failing >= AGREEING:
            used = (CHILD, ODOM).index(self.found) if self.found else int(off.argmin())
            self._before, self._agreeing, self._moving = self.found, 0, 0
            self.found, self.contradiction = NONE, float(off[used])
            return
        if float(np.linalg.norm(mean[0] - mean[1])) < DEVIATION:
            return  # errors alone would tell
        likelier = float(means[1]**2 - means[0]**2) / (2.0 * DEVIATION**2)
        self._evidence += min(max(likelier, -MOST_OF_ONE), MOST_OF_ONE)
        if not self.found and abs(self._evidence) >= SURE and fits:
            self.found = CHILD if self._evidence > 0.0 else ODOM

    def _recover(self, fitting: list[str], moving: bool) -> None:
        """Believe a velocity that was dropped again, once it has agreed for long enough."""
        self._agreeing = self._agreeing + 1 if fitting else 0
        self._moving = self._moving + moving if fitting else 0
        known = self._before in fitting
        if self._moving >= AGREEING or (known and self._agreeing >= EXPIRES):
            self.found, self._failing = self._before if known else '', 0
            if not known:
                self._evidence = 0.0  # another frame, or none was known: it is sought anew
