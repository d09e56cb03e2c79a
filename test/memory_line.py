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

"""A transport that ends in memory."""


class MemoryLine:
    """What was put into ``arrived`` comes in, what goes out is in ``written``, as bytes."""

    url, peer, fault, capacity, delivers_late = 'memory', None, '', 0.0, False

    def __init__(self):
        self.arrived, self.written = [], []
        self.source = 'vehicle'
        """The address from which it comes."""

    def fileno(self):
        return -1

    def reopen(self, now):
        pass

    def is_congested(self):
        return False

    def read(self):
        arrived, self.arrived = self.arrived, []
        for data in arrived:
            yield data, self.source

    def write(self, data):
        self.written.append(bytes(data))
        return True

    def close(self):
        pass
