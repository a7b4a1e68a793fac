# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The result of a planar fit: estimates with sigmas, and reasons for those not determined."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.budget import budget_details
from odocal_ros.calib.choice import PLANAR
from odocal_ros.calib.planar.run import Fit
from odocal_ros.calib.result import Estimate, MethodResult, Source, unknown_values
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, SIDES

# largest relative sigmas of a stated value. Judgement, by measurement on 24 simulated runs: in the
# two without a straight after their only turn, widths are wrong by 3 to 570 sigma, with a
# sigma of 6 to 70 % of the width, or of 2.5 % of the scale
SCALE_SIGMA_LIMIT, SIGMA_LIMIT = 0.02, 0.03
ARC = 0.75      # definition: ``Wheels.straightness`` on a radius of twice the track width
# 1 sigma of the width there, since its dependence on the radius is an assumed law: share of its
# change from turns on the spot to that radius. Judgement, measured: docs/decisions/0024
WIDTH_LAW_SHARE, ARC_SIGMA_LIMIT = 0.15, 0.05
LAW_SOURCE, FIT_SOURCE, SLOPES = 'width_by_radius', 'positions_and_wheel_noise', 'slopes'
NOISE_LIMIT = 0.1     # m/sqrt(m), judgement: of slip
# definition: levels of ``fit.LEVELS`` that are wheel noise, and their names in texts
WHEEL_NOISE = {'along': 'along the path', 'turn': 'in turns', 'spin': 'in turns on the spot'}
REQUIRED_TURNS = ('turns on the spot in both directions, each followed by a straight of a metre '
                  'or more')
Constants = dict[str, float]


class Quantity(NamedTuple):
    """Definition of an estimate by the constants of a fit."""

    constant: str           # constant of the fit without which the quantity does not exist
    value: Callable[[Constants], float]
    max_sigma: float        # relative
    code: Code              # of the reason, if the sigma is larger
    required_motion: str    # motion that determines the quantity, for the remedy


QUANTITIES = {
    'scale_factor': Quantity('inverse_track_width', lambda c: _mean_scale(c), SCALE_SIGMA_LIMIT,
                             Code.SCALE_NOT_DETERMINED, 'straights'),
    'scale_factor_left': Quantity('left', lambda c: c['left'], SCALE_SIGMA_LIMIT,
                                  Code.WHEELS_NOT_SEPARABLE, 'straights'),
    'scale_factor_right': Quantity('right', lambda c: c['right'], SCALE_SIGMA_LIMIT,
                                   Code.WHEELS_NOT_SEPARABLE, 'straights'),
    'track_width': Quantity('inverse_track_width', lambda c: 1 / c['inverse_track_width'],
                            SIGMA_LIMIT, Code.TRACK_WIDTH_NOT_DETERMINED, REQUIRED_TURNS),
    'track_width_arc': Quantity('arc', lambda c: 1 / (c['inverse_track_width'] + ARC * c['arc']),
                                ARC_SIGMA_LIMIT, Code.PARAMETER_NOT_DETERMINED,
                                'arcs with radii of two to four track widths, to both sides'),
    'rotation_lever': Quantity('wheel_1', lambda c: 1 / (2 * c['inverse_track_width']),
                               SIGMA_LIMIT, Code.TRACK_WIDTH_NOT_DETERMINED, REQUIRED_TURNS),
    'lateral_scale_factor': Quantity('lateral', lambda c: c['lateral'] * _mean_scale(c),
                                     SIGMA_LIMIT, Code.PARAMETER_NOT_DETERMINED,
                                     'sideways motion of a metre or more'),
}


def _mean_scale(c: Constants) -> float:
    """Return the scale factor of the mean count of the wheels."""
    scales = [value for name, value in c.items() if name in SIDES or name.startswith('wheel_')]
    return len(scales) / sum(1 / value for value in scales)


def _select_quantities(constants: tuple[str, ...], config: Config) -> dict[str, Quantity]:
    """Return the quantities that the constants of a fit give, with one for each wheel."""
    # omni and mecanum wheels have half of the width: the lever
    other_width = 'track_width' if 'wheel_1' in constants else 'rotation_lever'
    quantities = {name: quantity for name, quantity in QUANTITIES.items()
                  if quantity.constant in constants and name != other_width}
    wheels = [name for name in constants if name.startswith('wheel_')]
    for constant, wheel in zip(wheels, config.odometer.names(len(wheels)), strict=False):
        quantities[f'scale_factor_{wheel}'] = Quantity(
            constant, lambda c, constant=constant: c[constant],  # type: ignore[misc]
            SCALE_SIGMA_LIMIT, Code.PARAMETER_NOT_DETERMINED,
            'straights, turns and sideways motion')
    return quantities


class Value(NamedTuple):
    """The value of a quantity with its errors, in the unit of the value."""

    value: float
    effects: Floats      # (m,) of independent unit errors of the constants
    law: float           # 1 sigma by the assumed dependence of the width on the radius
    slopes: float        # 1 sigma by slopes, which shorten all lengths

    @property
    def sigma(self) -> float:
        """Return the sigma of the value."""
        return float(np.linalg.norm([*self.effects, self.law, self.slopes]))


def make_planar_result(fit: Fit, unit: str, nominal: float, config: Config,
                       slopes: float = 0.0) -> MethodResult:
    """Return the result of a fit; unit, nominal: of the scale factor."""
    # slopes : relative shortening of the path, by which scales and widths may be wrong
    quantities = _select_quantities(fit.names, config)
    values = _compute_values(fit, quantities, slopes)
    estimates, reasons = unknown_values(unit), _fit_reasons(fit)
    for name, quantity in quantities.items():
        value, sigma = values[name].value, values[name].sigma
        value_unit = unit if 'scale' in name else 'm'
        if value > 0 and sigma < quantity.max_sigma * value:
            estimates[name] = Estimate(value, sigma, value_unit)
        else:
            estimates[name] = Estimate(None, None, value_unit)
            reasons.append(Reason(
                quantity.code, f'{name.replace("_", " ")}: the uncertainty is '
                f'{100 * sigma / abs(value):.1f} %; the limit is {100 * quantity.max_sigma:.0f} %',
                f'Repeat the run with {quantity.required_motion}.'))
    sources = _error_sources(values, estimates)
    scale = estimates['scale_factor']
    if scale.value and slopes > np.linalg.norm(values['scale_factor'].effects / scale.value):
        reasons.append(Reason(
            Code.MODEL_MISMATCH, f'the ground is not level: slopes shorten the path by '
            f'{100 * slopes:.2g} %, which is added to the uncertainties',
            'Drive on level ground, or record an IMU.'))
    if scale.value is not None and scale.sigma is not None and nominal:
        estimates['scale_ratio'] = Estimate(scale.value / nominal, scale.sigma / nominal, '1')
    reasons += check_limits(estimates, nominal, config)
    return MethodResult(PLANAR, tuple(reasons), estimates, tuple(quantities), tuple(sources),
                        _details(fit, estimates, tuple(quantities), sources))


def _compute_values(fit: Fit, quantities: dict[str, Quantity], slopes: float) -> dict[str, Value]:
    """Return the value of each quantity of a fit by name; slopes: as ``make_planar_result``."""
    constants = dict(zip(fit.names, fit.value.tolist(), strict=True))
    # a fit that has not converged has twice the sigma
    root = np.linalg.cholesky(fit.covariance) * (1.0 if fit.converged else 2.0)
    values = {}
    for name, quantity in quantities.items():
        value = quantity.value(constants)
        law = WIDTH_LAW_SHARE * abs(value - 1 / constants['inverse_track_width']) * (
            quantity.constant == 'arc')
        values[name] = Value(value, _gradient(quantity, fit) @ root, law, slopes * value)
    return values


def _error_sources(values: dict[str, Value], estimates: dict[str, Estimate]) -> list[Source]:
    """Return the error sources of the quantities."""
    # errors over the divisor are those of ln K for scale factors, and 0 for unknown quantities
    divisors = {name: np.inf if estimates[name].value is None else
                quantity.value if name.startswith('scale_factor') else 1.0
                for name, quantity in values.items()}
    sources = [Source(FIT_SOURCE, np.array([
        quantity.effects / divisors[name] for name, quantity in values.items()]))]
    for source in (LAW_SOURCE, SLOPES):
        sigmas = [(quantity.law if source == LAW_SOURCE else quantity.slopes) / divisors[name]
                  for name, quantity in values.items()]
        if any(sigmas):
            sources.append(Source(source, np.array(sigmas)[:, None], True))
    return sources


def refused_planar_result(reasons: Iterable[Reason], unit: str) -> MethodResult:
    """Return the result of a leg that the method refuses."""
    return MethodResult(PLANAR, tuple(reasons), unknown_values(unit))


def _fit_reasons(fit: Fit) -> list[Reason]:
    """Return the reasons against a fit as a whole."""
    if fit.swapped:      # the cause of the others
        return [Reason(Code.WHEELS_SWAPPED, 'the mirrored positions fit the wheels better: '
                       'left and right wheels are swapped')]
    reasons = [] if fit.converged else [Reason(
        Code.MODEL_MISMATCH, f'the planar fit has not converged after {fit.passes} iterations; '
        'its uncertainties were doubled',
        'Check odometer.wheels, odometer.drive, odometer.time_offset and gnss.time_offset, and '
        'drive left and right turns.')]
    noisy = max(WHEEL_NOISE, key=lambda name: fit.levels[name])
    if fit.levels[noisy] > NOISE_LIMIT:
        reasons.append(Reason(
            Code.NOT_CONVERGED, f'wheels and positions differ by {1e3 * fit.levels[noisy]:.0f} mm '
            f'over a metre {WHEEL_NOISE[noisy]}; the limit is {1e3 * NOISE_LIMIT:.0f} mm',
            'Check the order of odometer.wheels, odometer.drive, odometer.time_offset and '
            'gnss.time_offset.'))
    return reasons


def _gradient(quantity: Quantity, fit: Fit) -> Floats:
    """Return derivatives of a quantity by the constants: (m,)."""
    gradient, step = np.zeros(len(fit.value)), 1e-6
    for i, value in enumerate(fit.value):
        h = step * max(abs(value), step)
        change = h * np.eye(len(gradient))[i]
        below, above = (quantity.value(dict(zip(fit.names, constants, strict=True)))
                        for constants in (fit.value - change, fit.value + change))
        gradient[i] = (above - below) / (2 * h)
    return gradient


def _details(fit: Fit, estimates: dict[str, Estimate], names: tuple[str, ...],
             sources: list[Source]) -> dict[str, object]:
    """Return budget, correlations, noise levels and nuisance constants, for calibration.json."""
    sigma = np.sqrt(np.diag(fit.covariance))
    constants = {name: {'value': float(v), 'sigma': float(s)}
                 for name, v, s in zip(fit.names, fit.value, sigma, strict=True)}
    details: dict[str, object] = budget_details(sources, names, estimates) | {
        'noise': fit.levels, 'constants': constants, 'passes': fit.passes}
    if 'gyro_scale' in constants:       # the factor on turn rates is 1 minus this error
        gyro = constants['gyro_scale']
        details['gyro_scale_z'] = {'value': -gyro['value'], 'sigma': gyro['sigma']}
    return details
