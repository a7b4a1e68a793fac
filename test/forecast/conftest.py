# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two drives: what is foreseen on the way, and each look of the smoother at a growing leg."""

from types import SimpleNamespace

from drives import thinned
import numpy as np
import pytest

from odocal_ros.forecast.foresight import forecast_of
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

HEADING = 0.003         # rad
LOOKS = (30.0, 47.0, 60.0, 95.0, 108.0, 165.0, 172.0, 240.0)    # s after the start mark


def foreseen(drive, config, t_stop, begin_s=float('-inf'), **more):
    """Return what is foreseen after seconds of a drive; begin_s: of its recording."""
    leg = drive.leg()
    cells = thinned(leg, t_stop, begin_s)
    return forecast_of(cells.leg(leg.start_ns), cells.fix_rate(), config, **more)


@pytest.fixture(scope='session')
def drive():
    return simulate(SimOptions(scenario='straight', duration=300.0, imu_rate=50.0, seed=3,
                               imu_grade='tactical', fix_noise='white', fix_sigma=0.5))


@pytest.fixture(scope='session')
def config(drive):
    return with_settings(Config(), {
        'imu.grade': 'tactical', 'gnss.correlation_time': 0.0, 'alignment.heading_source': 'fixed',
        'alignment.heading': drive.truth.heading, 'alignment.heading_sigma': HEADING})


def drive_of(**options):
    return simulate(SimOptions(**{'scenario': 'town', 'duration': 260.0, 'imu_rate': 50.0,
                                  'imu_grade': 'industrial', 'seed': 7} | options))


def looked(drive, config, looks=LOOKS):
    """Return what each look at a growing leg gave, and the leg as sketched at the last."""
    whole, cells, so_far, found = drive.leg(), None, SmootherSoFar(), []
    for before, now in zip((-np.inf, *looks), looks, strict=False):
        cells = thinned(whole, now, before, cells)
        leg = cells.leg(whole.start_ns)
        running = so_far.look(leg, config)
        found.append(SimpleNamespace(running=running, once_s=so_far.once_s, leg=leg))
    return found


@pytest.fixture(scope='session')
def exact():
    """Return settings of an IMU without errors of scale and axes, as it is simulated."""
    return with_settings(Config(), {'imu.grade': 'industrial', 'method': 'smoother',
                                    'imu.accel_scale_sigma': 0.0, 'imu.misalignment_sigma': 0.0,
                                    'imu.gyro_by_force_sigma': 0.0})


@pytest.fixture(scope='session')
def town_drive():
    return drive_of()


@pytest.fixture(scope='session')
def looks(town_drive, exact):
    return looked(town_drive, exact)
