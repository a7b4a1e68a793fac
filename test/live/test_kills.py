# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A node killed while it computes, writes its files and draws: whole results or none."""

from kills import drive, killed_at_files, wrong
import numpy as np
import pytest

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def driven():
    return drive()


@pytest.mark.parametrize(('stage', 'moment_s'), [
    *(('stop', m) for m in np.random.default_rng(12).uniform(0.0, 4.0, 2).round(3)),
    *(('save', m) for m in np.random.default_rng(13).uniform(0.0, 0.4, 2).round(3))])
def test_a_node_killed_at_its_files_leaves_whole_ones(driven, tmp_path, stage, moment_s):
    # the quick method: the files are the same
    left = killed_at_files(driven, stage, moment_s, tmp_path, '-p', 'method:=two_point')
    assert left.half == []
    assert left.latest
    code, result, said = left.journal
    assert code in (0, 1), said
    assert result is not None
    assert wrong(left) == []
