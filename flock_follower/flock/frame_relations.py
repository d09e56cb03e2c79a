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
Whom two vehicles know of at one time, and what that says of how their frames lie.

It may be the teller seen by oneself, oneself seen by the teller, or anybody whom both see or who
tells where it is. Until enough is known of a frame its relations are collected (``first_fit``);
from then on each improves the filter (``frame_alignment``), and what does not fit is refused. One
that goes on not to fit is of a frame that has changed: it is sought anew.
"""

from __future__ import annotations

from collections.abc import Callable
import math

from flock_follower.flock.alignment import FrameAlignment, PairedFrames
from flock_follower.flock.peers import (
    DOUBTED,
    Moment,
    POSITION_STD_MAX,
    TalkingVehicle,
    ToldTrack,
    WRONG,
    YAW_STD_MAX,
)
from flock_follower.geometry import Array

#: One vehicle relates two frames once in this time, ns: errors of sightings last.
RELATING = 200_000_000


class FrameRelations:
    """
    All frames that are talked of, one's own among them, by the names of their vehicles.

    :param report: told what did not fit, as (reason, detail).
    """

    def __init__(self, name: str, report: Callable[[str, str], None]) -> None:
        self.frames = FrameAlignment()
        self.tellers: dict[str, TalkingVehicle] = {}
        self.own_position: Array | None = None
        self._me, self._report = name, report
        self._own_tracks: dict[str, ToldTrack] = {}
        self._pairs: dict[tuple[str, str], PairedFrames] = {}
        self._related: dict[tuple[str, str, str], int] = {}

    def add(self, frame: str, vehicle: str, there: Moment) -> None:
        """Remember where a vehicle is in a frame."""
        tracks = self._own_tracks if frame == self._me else self.tellers[frame].tracks
        tracks.setdefault(vehicle, ToldTrack()).add(there)

    def relate(self, frame: str, vehicle: str, there: Moment) -> bool:
        """
        Remember where a vehicle is in a frame, and relate that to another frame.

        Return whether it fits, as far as can be told.
        """
        self.add(frame, vehicle, there)
        other = self._other_frame(frame, vehicle, there.stamp)
        if other is None or self.own_position is None:
            return True
        name, here = other
        one, two = sorted((frame, name))
        last = self._related.get((one, two, vehicle))
        if last is not None and abs(there.stamp - last) < RELATING:
            return True
        self._related[one, two, vehicle] = there.stamp
        self.frames.drift(there.stamp, self.own_position)
        if self._known(frame) and self._known(name):
            return self._improve(frame, there, name, here)
        self._begin((frame, there), (name, here))
        return True

    def anchor(self, name: str, position: Array) -> None:
        """Take where a teller is in its own frame, (3,), m."""
        if name in self.frames:
            self.frames.anchored(name, position)

    def unusable(self, teller: TalkingVehicle) -> str:
        """Return why a teller's words are not used, or ''."""
        if teller.name not in self.frames:
            paired = [pairs.yaw_std for names, pairs in self._pairs.items()
                      if teller.name in names]
            return ('neither sees the other, nor do both see one vehicle' if not paired else
                    f'its yaw is known to {min(paired):.1f} rad: somebody has to move')
        if teller.refused >= DOUBTED:
            return f'{teller.refused} times in a row it did not fit'
        place, yaw = self.stds(teller.name)
        if place <= POSITION_STD_MAX and yaw <= YAW_STD_MAX:
            return ''
        return (f'its frame is known to {place:.2f} m and {yaw:.2f} rad, limits '
                f'{POSITION_STD_MAX:g} m and {YAW_STD_MAX:g} rad')

    def stds(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of a frame's place, m, and yaw, rad."""
        return self.frames.stds(name) if name in self.frames else (math.inf, math.inf)

    def align_anew(self, teller: TalkingVehicle, why: str) -> None:
        """Forget what was known of a frame, and what was told in it."""
        self._report(f'aligned anew with {teller.name}', why)
        self._forget_frame(teller.name)
        teller.forget()

    def forget(self, teller: TalkingVehicle) -> None:
        """Forget one who does not talk any more."""
        self._forget_frame(teller.name)
        del self.tellers[teller.name]

    def forget_all(self, tellers: bool) -> None:
        """Begin anew, as one's own frame is another; ``tellers``: time is, too."""
        self._own_tracks.clear()
        self.frames.clear()
        self._pairs.clear()
        self._related.clear()
        for teller in self.tellers.values():
            teller.refused = 0
        if tellers:
            self.tellers.clear()

    def _other_frame(self, frame: str, vehicle: str, stamp: int) -> tuple[str, Moment] | None:
        """
        Return another frame in which a vehicle is known at a stamp, the best one, and where.

        One's own first; then that of the vehicle itself; then the surest. One only: sightings by
        three would count for three pairs.
        """
        if frame != self._me and vehicle in self._own_tracks:
            here = self._own_tracks[vehicle].at(stamp)
            if here is not None:
                return self._me, here
        best: tuple[float, str, Moment] | None = None
        for name, teller in self.tellers.items():
            if name == frame or vehicle not in teller.tracks:
                continue
            doubt = self.stds(name)[0] if name != vehicle or not self._known(name) else -1.0
            if best is not None and doubt >= best[0]:
                continue
            here = teller.tracks[vehicle].at(stamp)
            if here is not None:
                best = doubt, name, here
        return None if best is None else best[1:]

    def _improve(self, frame: str, there: Moment, name: str, here: Moment) -> bool:
        """Take in a relation between two frames that are known; return whether it fits."""
        doubt = self.frames.relate((self._filtered(frame), there), (self._filtered(name), here))
        if doubt <= 1.0:
            for known in {frame, name} & self.tellers.keys():
                self.tellers[known].refused = 0
            return True
        blamed = self.tellers.get(frame) or self.tellers[name]
        blamed.refused += 1
        self._report('does not fit the alignment', f'{blamed.name}: {doubt:.1f} times the gate')
        if blamed.refused >= WRONG:
            self.align_anew(blamed, f'{WRONG} times in a row it did not fit')
        return False

    def _begin(self, first: tuple[str, Moment], second: tuple[str, Moment]) -> None:
        """Take in a relation of a frame that is not known yet, and see whether it is now."""
        (one, there), (two, here) = sorted((first, second), key=lambda end: end[0])
        pairs = self._pairs.setdefault((one, two), PairedFrames())
        pairs.add(there, here)
        reference, fresh = (one, two) if self._known(one) else (two, one)
        if not self._known(reference):
            return
        fit = pairs.first_fit(swapped=reference == two)
        if fit is None:
            return
        self.frames.start(fresh, fit, self._filtered(reference))
        state = self.tellers[fresh].states.get(fresh)
        if state is not None:
            self.frames.anchored(fresh, state.position)
        del self._pairs[one, two]

    def _known(self, name: str) -> bool:
        return name == self._me or name in self.frames

    def _filtered(self, name: str) -> str | None:
        """Return a frame's name in the filter, where one's own has none."""
        return None if name == self._me else name

    def _forget_frame(self, name: str) -> None:
        if name in self.frames:
            self.frames.drop(name)
        self._pairs = {names: p for names, p in self._pairs.items() if name not in names}
        self._related = {k: stamp for k, stamp in self._related.items() if name not in k[:2]}
