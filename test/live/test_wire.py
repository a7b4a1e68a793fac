# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A small budget of hostile messages; any number of rounds: ``python benchmarks/wire.py``."""

from kills import drive
import pytest
from wire import Wire

pytestmark = pytest.mark.slow
CLEAN, FEW, HALF = 2, 3, 5      # seeds: how much of a round is hostile


@pytest.fixture(scope='module')
def wire(tmp_path_factory):
    one = Wire(drive(), tmp_path_factory.mktemp('wire'), 15.0)
    yield one
    one.close()


def test_a_drive_without_a_hostile_message_is_accepted(wire):
    """Else the fuzz shows nothing."""
    seen = wire.round(CLEAN)
    assert (seen.hostile, seen.wrong) == (0, [])
    assert seen.accepted


@pytest.mark.parametrize('seed', [FEW, HALF])
def test_the_node_lives_answers_and_accepts_nothing_false(wire, seed):
    seen = wire.round(seed)
    assert seen.hostile
    assert seen.calls >= 2
    assert seen.wrong == []
