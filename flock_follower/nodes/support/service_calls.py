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

"""The two types of the services of the nodes, by the value that a call sends."""

from __future__ import annotations

from std_srvs.srv import SetBool, Trigger


def service_type(value: bool | None) -> type[SetBool] | type[Trigger]:
    """Return the type of a service that takes a value; Trigger takes None."""
    return Trigger if value is None else SetBool


def make_request(value: bool | None) -> SetBool.Request | Trigger.Request:
    """Return the request that sends a value."""
    return Trigger.Request() if value is None else SetBool.Request(data=value)
