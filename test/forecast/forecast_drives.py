# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecasts of a drive during the recording, and running estimates of a growing leg."""

from types import SimpleNamespace

from drives import thinned
import numpy as np

from odocal_ros.forecast.leg_forecast import forecast_leg
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.sim.scenarios import SimOptions, simulate

HEADING = 0.003         # rad
LOOKS = (30.0, 47.0, 60.0, 95.0, 108.0, 165.0, 172.0, 240.0)    # s after the start mark


def forecast_at(drive, config, t_stop, begin_s=float('-inf'), **more):
    """Return the forecast after seconds of a drive; begin_s: begin of its recording."""
    leg = drive.leg()
    cells = thinned(leg, t_stop, begin_s)
    return forecast_leg(cells.leg(leg.start_ns), cells.fix_rate(), config, **more)


def drive_of(**options):
    return simulate(SimOptions(**{'scenario': 'town', 'duration': 260.0, 'imu_rate': 50.0,
                                  'imu_grade': 'industrial', 'seed': 7} | options))


def fit_updates(drive, config, looks=LOOKS):
    """Return the running estimates of a growing leg, with the thinned leg of each."""
    whole, cells, so_far, found = drive.leg(), None, SmootherSoFar(), []
    for before, now in zip((-np.inf, *looks), looks, strict=False):
        cells = thinned(whole, now, before, cells)
        leg = cells.leg(whole.start_ns)
        running = so_far.update(leg, config)
        found.append(SimpleNamespace(running=running, cold_start_cpu_s=so_far.cold_start_cpu_s,
                                     leg=leg))
    return found
