# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A few faulty live legs; any number: ``python benchmarks/live_faults.py --legs N --seed S``."""

from live_legs import DRIVES, leg, SIGMAS
import pytest

pytestmark = pytest.mark.slow
LEGS = 8


def test_a_clean_leg_is_accepted():
    """Else the faulty ones show nothing."""
    one = leg(1, 0)
    assert (one.faults, one.verdict, one.raised) == ((), 'accepted', '')
    assert one.sigmas < SIGMAS


def test_faulty_legs():
    found = [leg(20261126, number) for number in range(DRIVES, DRIVES + LEGS)]
    assert not [one for one in found if one.raised]
    assert not [one for one in found if one.verdict == 'accepted' and not one.sigmas < SIGMAS]
