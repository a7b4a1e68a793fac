# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A small zoo: errors over sigmas of twelve drawn vehicles equal the values stored here."""

from drives import configured
import pytest

from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.sim.draw import draw_vehicle
from odocal_ros.sim.scenarios import simulate

pytestmark = [pytest.mark.core, pytest.mark.slow]
FIRST_SEED = 70_000_000     # as benchmarks/zoo.py, whose drives are longer
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
# a fit ends when a pass changes it by less than 0.03 sigma; numpy versions differ by some passes
TOLERANCE = 0.1
ZOO = [    # kind, grade, verdict, errors of NAMES over their sigmas
    ('town', 'consumer', 'caution', (-0.82, -0.15, 0.75)),
    ('straight', 'industrial', 'caution', (-0.23, 0.21, None)),
    ('out_and_back', 'tactical', 'accepted', (-0.69, 0.2, 0.24)),
    ('motorway', 'consumer', 'accepted', (0.81, -0.17, -0.56)),
    ('yard', 'industrial', 'caution', (-0.62, -1.24, 0.14)),
    ('town', 'tactical', 'caution', (-0.13, -0.62, 1.83)),
    ('straight', 'consumer', 'accepted', (0.96, 1.09, None)),
    ('out_and_back', 'industrial', 'caution', (-1.92, 1.25, 0.92)),
    ('motorway', 'tactical', 'accepted', (1.38, 0.16, -0.07)),
    ('yard', 'consumer', 'caution', (0.67, 0.51, 0.35)),
    ('town', 'industrial', 'caution', (-0.64, -0.88, 0.25)),
    ('straight', 'tactical', 'accepted', (-0.8, -1.17, 0.86))]


def error_in_sigmas(estimate, true):
    if estimate is None or estimate.value is None:
        return None
    return round((estimate.value - true) / estimate.sigma, 2)


@pytest.mark.parametrize(('seed', 'row'), list(enumerate(ZOO, FIRST_SEED)))
def test_a_drawn_vehicle_has_its_verdict_and_errors(seed, row):
    kind, grade, *_ = row
    options, _ = draw_vehicle(seed, kind, grade, imu_rate=50.0,
                              duration=320.0 if kind == 'out_and_back' else 240.0)
    made = simulate(options)
    config, truth = configured(made), made.truth
    whole = combine([calibrate(made.leg(), config)], config)
    found = tuple(error_in_sigmas(whole.estimates.get(name), true) for name, true in zip(
        NAMES, (truth.scale, truth.yaw, truth.pitch), strict=True))
    now = kind, grade, whole.verdict.value, found
    assert now[:3] == row[:3], now
    assert found == pytest.approx(row[3], abs=TOLERANCE), f'now {now}'
