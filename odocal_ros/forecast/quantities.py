# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Quantities of a leg: which are observable with the settings, and which are within limits."""

from collections.abc import Sequence, Set
from dataclasses import dataclass
import math

import numpy as np

from odocal_ros.calib.choice import deciding_methods, PLANAR, REASON_ESTIMATES
from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.forecast.forecast import Forecast, sigma_or_infinity
from odocal_ros.forecast.planned_drive import drive_from_rates
from odocal_ros.forecast.predict import plan_alignment
from odocal_ros.nav.alignment import Alignment, HEADING_LIMIT
from odocal_ros.pipeline.methods import METHODS
from odocal_ros.reasons import Verdict
from odocal_ros.screening.glitches import Oriented, without_invalid_orientations
from odocal_ros.settings.config import Config, DIFFERENTIAL, MECANUM, OMNI, SKID, with_settings
from odocal_ros.settings.levels import TRACK_WIDTH

EXACT_HEADING = 1e-6      # rad; judgement: sigma of a heading whose configured sigma is 0
COURSE_FIX_SIGMA = 1.5    # m; physical: sigma of a fix of a single receiver
SOURCES = {'fixed': 'the configured heading', 'heading_topic': 'the heading topic',
           'imu_orientation': 'the IMU orientation', 'gyrocompass': 'the gyrocompass'}
# values of the planar estimator
PLANAR_QUANTITIES = {
    DIFFERENTIAL: ('the scale', 'left and right wheel', 'the track width (needs turns)'),
    SKID: ('the scale', 'left and right wheel', 'the track width (needs turns on the spot)',
           'the track width arc (needs arcs)'),
    MECANUM: ('the scale', 'the rotation lever (needs turns)',
              'the lateral scale factor (needs sideways motion)'),
    OMNI: ('the scale', 'the rotation lever (needs turns)',
           'the factor of each wheel (needs sideways motion)')}
METHOD_WITHOUT_HEADING = 'smoother'   # the method that needs no external heading
YES, NO, UNKNOWN = 'yes', 'no', 'unknown'    # whether a sigma is within its limit


@dataclass(frozen=True)
class Received:
    """What the samples before the start mark contain."""

    variances: dict[str, float]     # heading source -> stated yaw variance, rad^2; inf: none
    rest_s: float = 0.0             # duration of the current or last standstill, s
    latitude: float = 0.7           # rad, default: 40 deg
    has_height: bool = True         # the fixes have a height
    two_wheels: bool = False        # the odometer has two wheels
    has_accelerometer: bool = True
    has_imu: bool = True


@dataclass(frozen=True)
class Observability:
    """Quantities of a leg as texts for the operator."""

    observable: tuple[str, ...]
    not_observable: tuple[str, ...]     # with the cause
    limitation: str = ''                # of the accuracy of all quantities

    def as_text(self) -> str:
        """Return all as one text."""
        *first, last = self.observable
        values = f'{", ".join(first)} and {last}' if first else last
        text = f'observable: {values}'
        if self.not_observable:
            text += f'; not observable: {"; ".join(self.not_observable)}'
        return text + (f'; {self.limitation}' if self.limitation else '')


def find_observable(config: Config, received: Received) -> Observability:
    """Return the quantities that a leg determines with these settings, and those it does not."""
    drive = config.odometer.drive
    if not received.has_imu or drive != DIFFERENTIAL:
        return Observability(PLANAR_QUANTITIES[drive], (
            'yaw and pitch of the IMU' if received.has_imu else 'yaw and pitch (no IMU)',))
    methods = [name for name in METHODS if name in deciding_methods(config.method)
               and (received.has_accelerometer or name != METHOD_WITHOUT_HEADING)]
    values = [(True, 'the scale'), _yaw_quantity(config, received, methods),
              (True, 'the pitch') if received.has_height else
              (False, 'the pitch (fixes without height)')]
    if not received.has_accelerometer:
        values[-1] = False, 'the pitch (IMU without acceleration)'
    if received.two_wheels:
        values += _wheel_quantities(config)
    limitation = '' if received.rest_s >= config.leg.standstill else (
        'level and gyro bias are estimated from the drive, because it starts without a standstill')
    return Observability(tuple(text for is_observable, text in values if is_observable),
                         tuple(text for is_observable, text in values if not is_observable),
                         limitation)


def _yaw_quantity(config: Config, received: Received, methods: Sequence[str]) -> tuple[bool, str]:
    """Return (is observable, text) of the yaw with some methods."""
    if METHOD_WITHOUT_HEADING in methods:
        return True, 'the yaw (from stops, starts and turns)'
    alignment = _expected_alignment(config, received)
    if not alignment.heading_separable:
        return False, ('the yaw (the only heading is the course over ground, which includes it: '
                       'set alignment.heading_source)')
    source, sigma = SOURCES[alignment.heading_source], math.degrees(alignment.heading_sigma)
    limit = math.degrees(config.verdict.max_yaw_sigma)
    if sigma >= limit:
        return False, (f'the yaw to {limit:.2g} deg ({source} has an uncertainty of {sigma:.2g} '
                       'deg)')
    return True, f'the yaw (from {source}, {sigma:.2g} deg)'


def _wheel_quantities(config: Config) -> list[tuple[bool, str]]:
    """Return (is observable, text) of each quantity of two wheels."""
    if METHOD_WITHOUT_HEADING not in deciding_methods(config.method):
        return [(False, f'left and right wheel separately (method {config.method} uses their '
                 'mean)')]
    width = config.odometer.track_width
    return [(True, 'left and right wheel')] + [
        (True, 'the track width (needs turns)')] * (not width)


def _expected_alignment(config: Config, received: Received) -> Alignment:
    """Return the alignment of a planned straight drive that starts from this standstill."""
    rest_s = received.rest_s if received.rest_s >= config.leg.standstill else 0.0
    t = np.arange(-min(rest_s, config.leg.preroll), 60.0, 0.5)
    drive = drive_from_rates(t, np.where(t >= 0.0, 10.0, 0.0), np.zeros_like(t),
                             latitude=received.latitude)
    return plan_alignment(drive, with_heading(config, received.variances), COURSE_FIX_SIGMA,
                          drive.standstills(config.leg.standstill))[0]


def stated_variance(samples: Oriented) -> float:
    """Return the median yaw variance in orientation messages, rad^2; inf if none is sent."""
    variance = without_invalid_orientations(samples).yaw_variance
    stated = variance[~np.isnan(variance)]
    return float(np.median(stated)) if len(stated) else math.inf


def with_heading(config: Config, variances: dict[str, float]) -> Config:
    """
    Return config with the heading source and sigma that the alignment will use.

    variances : stated variance of the yaw by source, rad^2; inf if none is sent.
    """
    alignment = config.alignment
    source, sigma = alignment.source, max(alignment.heading_sigma, EXACT_HEADING)
    if source == 'fixed' and math.isnan(alignment.heading):
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


@dataclass(frozen=True)
class Quantity:
    """A quantity whose limit is shown to the operator."""

    label: str                           # for people
    estimates: tuple[str, ...]           # names of its estimates in a result
    is_relative: bool                    # its sigma and limit are relative to the value
    needs_two_wheels: bool = False
    is_mounting_angle: bool = False      # not estimated by the planar estimator

    def limit(self, config: Config) -> float:
        """Return the limit of the sigma, relative to the value or rad."""
        if self.estimates[0] == 'track_width':
            # it has no setting verdict.*, only the limit of the estimator
            return TRACK_WIDTH.max_sigma_share
        return config.verdict.max_scale_sigma if self.is_relative else config.verdict.max_yaw_sigma


QUANTITIES = {
    'scale': Quantity('scale', ('scale_factor',), True),
    'yaw': Quantity('yaw', ('yaw_mounting_angle',), False, is_mounting_angle=True),
    'pitch': Quantity('pitch', ('pitch_mounting_angle',), False, is_mounting_angle=True),
    'left_right': Quantity('left and right wheel', ('scale_factor_left', 'scale_factor_right'),
                           True, True),
    'track_width': Quantity('track width', ('track_width',), True, True),
}


def all_unknown() -> dict[str, str]:
    """Return unknown for each quantity."""
    return dict.fromkeys(QUANTITIES, UNKNOWN)


def check_forecast(forecast: Forecast | None, config: Config, two_wheels: bool,
                   is_rejected: bool = False) -> dict[str, str]:
    """
    Return yes, no or unknown for each quantity, as if the leg ended now.

    forecast : None before its first update: unknown.   two_wheels : the odometer has two wheels.
    is_rejected : the leg would be rejected: no value is within its limit. A configured track width
    that is not determined is unknown, not no.
    """
    if forecast is None:
        return all_unknown() | dict.fromkeys(('scale', 'yaw', 'pitch') if is_rejected else (), NO)
    sigmas = {name: None if is_rejected else forecast.sigma(name)
              for name, quantity in QUANTITIES.items()
              if not (quantity.needs_two_wheels and (not two_wheels or forecast.wheels is None)
                      or quantity.is_mounting_angle and PLANAR in forecast.methods)}
    return _check_sigmas(sigmas, config)


def check_calibration(calibration: Calibration, config: Config,
                      two_wheels: bool) -> dict[str, str]:
    """Return yes, no or unknown for each quantity of a result; no yes for a rejected one."""
    names_with_reason = {
        REASON_ESTIMATES[reason.code] for reason in calibration.reasons
        if reason.code in REASON_ESTIMATES and reason.code.severity is not Verdict.ACCEPTED}
    return check_estimates(calibration.estimates, config, two_wheels,
                           calibration.verdict is not Verdict.REJECTED, names_with_reason)


def check_estimates(estimates: dict[str, Estimate], config: Config, two_wheels: bool,
                    is_valid: bool, names_with_reason: Set[str] = frozenset()) -> dict[str, str]:
    """
    Return yes, no or unknown for each quantity: whether its sigma is within the limit.

    is_valid : False: no value is usable.   names_with_reason : estimates with a reason against
    their use.
    """
    is_planar = any(estimate.method == PLANAR for estimate in estimates.values())
    sigmas: dict[str, float | None] = {}
    unusable = set()
    for name, quantity in QUANTITIES.items():
        values = [estimates.get(estimate_name) for estimate_name in quantity.estimates]
        if quantity.is_mounting_angle and is_planar:
            continue
        if quantity.needs_two_wheels and not two_wheels and not any(
                value is not None and value.value is not None for value in values):
            continue
        sigmas[name] = max(sigma_or_infinity(value, quantity.is_relative) for value in values)
        if not is_valid or names_with_reason & set(quantity.estimates):
            unusable.add(name)
    return _check_sigmas(sigmas, config) | dict.fromkeys(unusable, NO)


def quantities_text(ok: dict[str, str]) -> str:
    """Return the quantities that are OK, and those that are not, as text; empty: all unknown."""
    labels = {text: ', '.join(QUANTITIES[name].label for name, value in ok.items()
                              if value == answer)
              for answer, text in ((YES, 'OK'), (NO, 'not OK'))}
    return '; '.join(f'{text}: {names}' for text, names in labels.items() if names)


def _check_sigmas(sigmas: dict[str, float | None], config: Config) -> dict[str, str]:
    """Return yes or no for known sigmas; a configured track width may stay unknown."""
    ok = all_unknown()
    for name, sigma in sigmas.items():
        if sigma is not None and sigma <= QUANTITIES[name].limit(config):
            ok[name] = YES
        elif name != 'track_width' or not config.odometer.track_width > 0:
            ok[name] = NO
    return ok
