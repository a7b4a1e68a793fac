# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
