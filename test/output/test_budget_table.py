# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The budget as people read it: shares of the variance, units, what is hidden."""

import pytest

from odocal_ros.output.tables import budget_lines

TABLE = {'fix_end': {'scale_factor': 4e-5, 'yaw_mounting_angle': 3e-3, 'shared': False},
         'initial_heading': {'scale_factor': 0.0, 'yaw_mounting_angle': 4e-3, 'shared': True},
         'quantisation': {'scale_factor': 1e-9, 'yaw_mounting_angle': 0.0, 'shared': False}}


def test_each_source_has_its_size_and_share_in_the_units_people_use():
    head, fix, heading, small = budget_lines(TABLE, 0.02, 0.01)
    assert head.split() == ['error', 'budget', 'scale,', 'ppm', 'yaw,', 'deg', 'pitch,', 'deg']
    # 4e-5 of 0.02 is 2000 ppm; 3e-3 rad is 0.17 deg and 9 of 25 parts of the variance
    assert fix.split() == ['fix', 'end', '2000', '100%', '0.17', '36%', '-']
    assert heading.split() == ['initial', 'heading', '-', '0.23', '64%', '-', 'shared', 'by',
                               'all', 'legs']
    assert small.split() == ['under', '1', '%:', 'quantisation']


def test_what_is_not_determined_shows_no_figure():
    lines = budget_lines(TABLE, 0.02, 0.01, {'yaw_mounting_angle'})
    assert '0.17' not in ''.join(lines)
    assert 'initial heading' in lines[-1]


@pytest.mark.parametrize('table', [{}, None])
def test_without_a_budget_there_are_no_lines(table):
    assert budget_lines(table, 1.0, 0.01) == []
