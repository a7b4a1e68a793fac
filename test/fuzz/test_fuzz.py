# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A small budget of fuzzing; any number: benchmarks/fuzz.py and benchmarks/live_faults.py."""

import cases
from live_legs import DRIVES, leg, SIGMAS
import pytest
import semantic

pytestmark = pytest.mark.slow
CASES = 80       # the same on any machine: what one of two busy cores did in 15 s
LEGS = 8


@pytest.fixture(scope='module')
def clean(tmp_path_factory):
    return cases.warm_up(cases.bases(tmp_path_factory.mktemp('clean')))


def test_clean_bags_are_fine(clean, tmp_path):
    """Else the fuzz shows nothing: the truth is found in each base."""
    for name in ('mcap', 'rosbag1'):
        place = tmp_path / name
        for folder in ('tmp', 'home'):
            (place / folder).mkdir(parents=True)
        before = cases.tree(place)
        ran = cases.child(['replay', str(clean.bag(name)), '--output', str(place / 'out'), '--set',
                           'output.formats=[params]'], place)
        said = (place / 'stderr').read_text()
        assert cases.judged(place, before, *ran, said, semantic.ranges(clean.truth[name])) == ''
        assert ran[0] == 0, said


def test_a_budget_of_cases(clean, tmp_path):
    ran = [outcome for first in range(0, CASES, 20)
           for outcome in cases.run(20261122, clean, tmp_path, list(range(first, first + 20)))]
    wrong = [f'case {o.number} ({o.what}): {o.wrong}: {o.said}' for o in ran if o.wrong]
    assert not wrong, '\n'.join(wrong)
    assert len(ran) == CASES
    assert {o.code for o in ran} >= {0, 2}


def test_a_clean_leg_is_accepted():
    """Else the faulty ones show nothing."""
    one = leg(1, 0)
    assert (one.faults, one.verdict, one.raised) == ((), 'accepted', '')
    assert one.sigmas < SIGMAS


def test_faulty_legs():
    found = [leg(20261126, number) for number in range(DRIVES, DRIVES + LEGS)]
    assert not [one for one in found if one.raised]
    assert not [one for one in found if one.verdict == 'accepted' and not one.sigmas < SIGMAS]
