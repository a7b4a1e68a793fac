# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Rows of a benchmark that continues after an interruption: one JSON object per line."""

import json


def read_rows(path) -> dict[int, dict]:
    """Return rows by seed; a last line cut short by an interruption is done again."""
    rows = {}
    if path.exists():
        text = path.read_text()
        if text and not text.endswith('\n'):
            text = text[:text.rfind('\n') + 1]
            path.write_text(text)
        rows = {row['seed']: row for row in map(json.loads, text.splitlines())}
    return rows
