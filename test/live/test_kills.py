# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
