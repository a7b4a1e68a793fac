# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The verdict of a method as it is shown: no better than that of the data it was fed with."""

from odocal_ros.calib.result import LegResult, MethodResult
from odocal_ros.pipeline.combination import driven_twice
from odocal_ros.reasons import Verdict, verdict_of


def shown_verdict(method: MethodResult, legs: tuple[LegResult, ...]) -> str:
    """
    Return the verdict of a method's figures, '(leg)' behind it where it is that of the leg.

    What is wrong with a leg's data is no method's reason, but touches each of them: a method that
    found nothing to say of a dead wheel is no way round it.

    legs : those the figures rest on; of several that are good in part, the good ones count.
    """
    twice = driven_twice([leg for leg in legs if verdict_of(leg.reasons) is not Verdict.REJECTED])
    of_data = [verdict_of(leg.reasons) for leg in legs if leg not in twice]
    used = [v for v in of_data if v is not Verdict.REJECTED] or of_data
    worst = Verdict.worst([method.verdict, *used])
    if worst is method.verdict:
        return worst.value
    return f'{worst.value} (leg{"s" * (len(legs) > 1)})'


def leg_verdicts(legs: tuple[LegResult, ...]) -> list[str]:
    """Return the verdict of each leg, 'not used' where it is good and an earlier one is used."""
    twice = driven_twice([leg for leg in legs if leg.verdict is not Verdict.REJECTED])
    return ['not used' if leg in twice else leg.verdict.value for leg in legs]
