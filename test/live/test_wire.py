# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
