# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Values that a planned drive can determine, by the code that processes recorded drives."""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from odocal_ros.calib.choice import deciding
from odocal_ros.forecast.planned_drive import from_rates
from odocal_ros.forecast.predict import plan_alignment
from odocal_ros.nav.alignment import Alignment, HEADING_LIMIT
from odocal_ros.pipeline.methods import METHODS
from odocal_ros.screening.glitches import Oriented, without_invalid_orientations
from odocal_ros.settings.config import Config, DIFFERENTIAL, MECANUM, OMNI, SKID, with_settings

EXACT_HEADING = 1e-6      # rad; judgement: sigma of a heading whose configured sigma is 0
COURSE_FIX_SIGMA = 1.5    # m; physical: sigma of a fix of a single receiver
SOURCES = {'fixed': 'the configured heading', 'heading_topic': 'the heading topic',
           'imu_orientation': 'the IMU orientation', 'gyrocompass': 'the gyrocompass'}
# values of the planar estimator
OF_DRIVE = {
    DIFFERENTIAL: ('the scale', 'left and right wheel', 'the track width (in turns)'),
    SKID: ('the scale', 'left and right wheel', 'the track width (on the spot)',
           'the track width arc (on arcs)'),
    MECANUM: ('the scale', 'the rotation lever (in turns)',
              'the lateral scale factor (in sideways motion)'),
    OMNI: ('the scale', 'the rotation lever (in turns)',
           'the factor of each wheel (in sideways motion)')}
ALL_SAMPLES = 'smoother'   # the method that needs no external heading


@dataclass(frozen=True)
class Received:
    """Samples received before the start mark."""

    variances: dict[str, float]     # of the yaw by its source, rad^2; inf if none is sent
    rested_s: float = 0.0           # length of the current or last standstill
    latitude: float = 0.7           # rad
    height: bool = True             # the fixes have a height
    two_wheels: bool = False
    has_accelerometer: bool = True
    imu: bool = True                # an IMU is present


@dataclass(frozen=True)
class Ability:
    """Observable quantities, unobservable ones with the cause, and a limitation of all values."""

    can: tuple[str, ...]
    cannot: tuple[str, ...]
    weak: str = ''

    def words(self) -> str:
        *first, last = self.can
        values = f'{", ".join(first)} and {last}' if first else last
        text = f'observable: {values}'
        if self.cannot:
            text += f'; not observable: {"; ".join(self.cannot)}'
        return text + (f'; {self.weak}' if self.weak else '')


def ability(config: Config, received: Received) -> Ability:
    """Return the values that a leg can estimate with these settings, and those it cannot."""
    drive = config.odometer.drive
    if not received.imu or drive != DIFFERENTIAL:
        return Ability(OF_DRIVE[drive], (
            'yaw and pitch of the IMU' if received.imu else 'yaw and pitch (no IMU)',))
    methods = [name for name in METHODS if name in deciding(config.method)
               and (received.has_accelerometer or name != ALL_SAMPLES)]
    values = [(True, 'the scale'), _yaw(config, received, methods),
            (True, 'the pitch') if received.height else
            (False, 'the pitch (fixes without height)')]
    if not received.has_accelerometer:
        values[-1] = False, 'the pitch (IMU without acceleration)'
    if received.two_wheels:
        values += _of_two_wheels(config)
    weak = '' if received.rested_s >= config.leg.standstill else (
        'level and gyro bias are estimated from the drive, because it starts without a standstill')
    return Ability(tuple(text for can, text in values if can),
                   tuple(text for can, text in values if not can), weak)


def _yaw(config: Config, received: Received, methods: Sequence[str]) -> tuple[bool, str]:
    if ALL_SAMPLES in methods:
        return True, 'the yaw (from stops, starts and turns)'
    alignment = _alignment(config, received)
    if not alignment.heading_separable:
        return False, ('the yaw (the only heading is the course over ground, which includes it: '
                       'set alignment.heading_source)')
    source, sigma = SOURCES[alignment.heading_source], math.degrees(alignment.heading_sigma)
    asked = math.degrees(config.verdict.max_yaw_sigma)
    if sigma >= asked:
        return False, (f'the yaw to {asked:.2g} deg ({source} has an uncertainty of {sigma:.2g} '
                       'deg)')
    return True, f'the yaw (from {source}, {sigma:.2g} deg)'


def _of_two_wheels(config: Config) -> list[tuple[bool, str]]:
    if ALL_SAMPLES not in deciding(config.method):
        return [(False, f'left and right wheel separately (method {config.method} uses their '
                 'mean)')]
    width = config.odometer.track_width
    return [(True, 'left and right wheel')] + [(True, 'the track width (in turns)')] * (not width)


def _alignment(config: Config, received: Received) -> Alignment:
    """Return the alignment of a straight drive from the current position."""
    rest = received.rested_s if received.rested_s >= config.leg.standstill else 0.0
    t = np.arange(-min(rest, config.leg.preroll), 60.0, 0.5)
    drive = from_rates(t, np.where(t >= 0.0, 10.0, 0.0), np.zeros_like(t),
                       latitude=received.latitude)
    return plan_alignment(drive, with_heading(config, received.variances), COURSE_FIX_SIGMA,
                          drive.standstills(config.leg.standstill))[0]


def stated_variance(sent: Oriented) -> float:
    """Return the median yaw variance in orientation messages, rad^2; inf if none is sent."""
    variance = without_invalid_orientations(sent).yaw_variance
    stated = variance[~np.isnan(variance)]
    return float(np.median(stated)) if len(stated) else math.inf


def with_heading(config: Config, variances: dict[str, float]) -> Config:
    """Return config with the heading source and sigma that the alignment will find."""
    asked = config.alignment
    source, sigma = asked.source, max(asked.heading_sigma, EXACT_HEADING)
    if source == 'fixed' and math.isnan(asked.heading):
        source = 'course'
    for name, stated in variances.items():
        if source not in ('auto', name):
            continue
        if stated <= HEADING_LIMIT**2:
            source, sigma = name, math.sqrt(stated) if stated > 0 else sigma
        elif source == name:
            source = 'course'
    return with_settings(config, {'alignment.heading_source': source,
                                  'alignment.heading_sigma': sigma})
