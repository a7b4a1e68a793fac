# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What is being done to a leg, for those who watch."""

from dataclasses import dataclass
from math import nan

WHOLE_FROM = 10.0     # judgement: sigmas from which their decimals mean nothing


@dataclass(frozen=True)
class Stage:
    """
    A stage of the work on a leg.

    name : the method at work, or ``tracks``; empty before the first.   done : share of the work
    in the stages before it, 0 to 1; when a fit ends cannot be foreseen.   passes : that its fit
    has made.   change : the largest change of a constant in the last of them, in sigmas; NaN
    before the first.
    """

    name: str = ''
    done: float = 0.0
    passes: int = 0
    change: float = nan

    def words(self) -> str:
        """Return it for people."""
        if not self.passes:
            return self.name
        change = f'{self.change:.0f}' if self.change >= WHOLE_FROM else f'{self.change:.2f}'
        return (f'{self.name}, {self.passes} pass{"es" * (self.passes > 1)} done, remaining '
                f'change {change} sigma')
