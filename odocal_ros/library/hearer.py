# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Who hears how the work goes: a command shows it, another program need not."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

# of the share done, 0 to 1 or None where nobody knows it, and what is being done
Progress = Callable[..., None]


class Hearer:
    """Hears sentences and phases of the work; this one keeps to itself."""

    def note(self, text: str) -> None:
        """Take a sentence that the user should know."""

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Return a context for a phase of the work, whose value is told the share done."""
        return nullcontext(lambda share, stage='': None)


class Notes(Hearer):
    """Keeps the sentences, and passes all on."""

    def __init__(self, onward: Hearer) -> None:
        self.said: list[str] = []
        self._onward = onward

    def note(self, text: str) -> None:
        """Keep a sentence."""
        self.said.append(text)
        self._onward.note(text)

    def phase(self, title: str) -> AbstractContextManager[Progress]:
        """Return the phase as the other has it."""
        return self._onward.phase(title)
