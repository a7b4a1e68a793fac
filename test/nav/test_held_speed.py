# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speeds that a sender holds until they have changed by a step."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav.held_speed import held_speed
from odocal_ros.nav.odometer import travel
from odocal_ros.sim.real import Real
from odocal_ros.sim.wheels import coarse, held

STEP = 0.5 / 3.6
RATE = OdometerForm('rate', 0, '1')
T = np.arange(0.0, 400.0, 0.05)


def town(t):
    """Return a speed of stops, ramps and cruises that are not alike, m/s."""
    stops = np.clip(20 * np.sin(2 * np.pi * t / 97.0), 0.0, 9.0 + 2 * np.sin(t / 61.0))
    return np.where(stops < 0.05, 0.0, stops)


@pytest.mark.parametrize('scale', [1.0, 37.0])
def test_a_held_speed_is_known_by_its_step(scale):
    found = held_speed(T, scale * held(town(T), STEP))
    # the least change of many is a step and what the speed gains in a row at its slowest
    assert STEP <= found.step / scale < 1.05 * STEP
    assert not found.truncation


@pytest.mark.parametrize('value', [
    town(T), town(T) + 0.01 * np.random.default_rng(1).standard_normal(len(T)),
    np.repeat(town(T[::5]), 5), coarse(town(T), Real(speed_step=1 / 3.6)), np.zeros(len(T)),
    np.full(len(T), 5.0)], ids=['plain', 'noisy', 'repeated', 'whole km/h', 'standing', 'even'])
def test_other_speeds_are_not_taken_for_held(value):
    way = travel(T, value, RATE)[0]
    assert way.coarse is None or way.coarse.truncation


def test_its_changes_are_right_and_its_middle_is_within_half_a_step():
    true = town(T)
    found = held_speed(T, held(true, STEP))
    assert_allclose(found.instants.value, np.interp(found.instants.t, T, true), atol=1e-9)
    off = np.abs(found.value - true)[true > 0]
    # a row beyond it where the vehicle turns about within a step
    assert np.percentile(off, 90) < 0.55 * STEP
    assert off.max() < 1.6 * STEP


def test_the_path_has_no_more_than_the_error_of_its_cruises():
    true = town(T)
    middle = travel(T, held(true, STEP), RATE)[0].s[-1]
    whole, sent = (((x[1:] + x[:-1]) / 2 * np.diff(T)).sum() for x in (true, held(true, STEP)))
    # four cruises of 20 s, each uniform within a step: 3 sigmas
    assert abs(middle - whole) < 3 * np.sqrt(4) * 20 * STEP / np.sqrt(12)
    assert abs(middle - whole) < abs(sent - whole)


def test_reversed_counts_are_held_on_the_other_side():
    value = held(town(T), STEP)
    way, back = travel(T, value, RATE)[0], travel(T, -value, RATE, reversed_counts=True)[0]
    assert_allclose(back.s, way.s)
    assert_allclose(back.coarse.value, way.coarse.value)
    assert_allclose(back.coarse.instants.value, way.coarse.instants.value)
