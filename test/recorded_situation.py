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

"""Reads a situation that ``Situation.to_json`` wrote, as in the log of the bridge."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
import enum
import json
from typing import Any, get_args, get_type_hints

import numpy as np

from flock_follower.gate.situation import Situation


def read_situation(line: str) -> Situation:
    """Return the situation of a line of ``to_json``; equal bit for bit, arrays as arrays."""
    situation: Situation = _read_value(Situation, json.loads(line))
    return situation


def _read_value(hint: Any, plain: Any) -> Any:
    """Return a value of a type, or of one type of a union, from its ``_plain_value``."""
    kinds = get_args(hint) or (hint,)
    if isinstance(plain, Mapping):
        kind = next(kind for kind in kinds if is_dataclass(kind) or hasattr(kind, '_fields'))
        hints = get_type_hints(kind)
        return kind(**{name: _read_value(hints[name], each) for name, each in plain.items()})
    if isinstance(plain, str) and (
            kind := next((k for k in kinds if isinstance(k, enum.EnumMeta)), None)):
        return kind[plain]
    return np.array(plain) if isinstance(plain, list) else plain
