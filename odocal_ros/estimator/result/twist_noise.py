# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Covariance of the twist of calibrated wheels, from noise levels and constants of the legs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from odocal_ros.calib.result import AS_SENT, Calibration, Estimate, LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.interval_noise import TURNING_RATE
from odocal_ros.estimator.state import FAST_SPEED
from odocal_ros.settings.config import SIDES

SWAY_TIME = 0.1      # s; judgement: a body does not change its sideways velocity faster


@dataclass(frozen=True, eq=False)
class TwistNoise:
    """Errors of the twist that calibrated wheels give over a message interval."""

    period: float                     # s
    speed: float                      # m/s, rms of the drive in motion
    turn_rate: float                  # rad/s, rms
    fastest: tuple[float, float]      # highest speed and turn rate
    legs: tuple[dict[str, Any], ...]  # ``odometer``, levels, constants of each leg's fit
    estimates: dict[str, Estimate]    # of the calibration

    @property
    def has_turn_rate(self) -> bool:
        """Return True if two wheels give the turn rate."""
        return all(f'scale_factor_{side}' in self.estimates for side in SIDES) and bool(
            self._known('track_width')[0]) and all('left' in leg['wheels'] for leg in self.legs)

    def variances(self, speed: float, turn_rate: float) -> Floats:
        """
        Return the variances of the velocity forward, left and up and of the turn rate: (4,).

        In (m/s)^2 and (rad/s)^2, mean of the legs; the turn rate is NaN if it is not measured.
        speed, turn_rate : m/s, rad/s.
        """
        found: Floats = np.mean([self._of_leg(leg, abs(speed), abs(turn_rate))
                                 for leg in self.legs], axis=0)
        return found

    def _of_leg(self, leg: dict[str, Any], v: float, w: float) -> Floats:
        noise, odometer, T = leg['noise'], leg['odometer'], self.period
        K = self._known('scale_factor')[0]
        factor = self._known(AS_SENT)[0] or K
        # as in noise.py: the noise of a wheel grows with the time it turns
        turned, hard = min(max(v, 0.02), 1.0) / T, odometer['hard']
        reading = (K * odometer['reading'])**2 / T**2       # of one reading; an interval has two
        along = (1 - hard) * noise['along']**2 + hard * noise['along_hard']**2
        swayed = turned * T / max(T, SWAY_TIME)
        grid = noise.get('steps')
        if grid is not None:      # the fit does not use the integral of such a speed
            along, reading = 0.0, 0.0
        side = noise['side_turn' if w > TURNING_RATE else 'side']**2
        white = leg['widened']**2 * np.array(
            [along * turned + 2 * reading, side * swayed, noise['up']**2 * swayed])
        arm_x, arm_y = (_square(self._known(f'odometer_lever_arm_{axis}')) for axis in 'xy')
        constant = np.array([self._scale_variance(leg, v) + arm_y * w**2,
                             _square(_of(leg['sideslip'])) * (v**2 * w)**2 + arm_x * w**2, 0.0])
        coarse = (K * odometer['speed_step'])**2 / 12 * max(grid or 1.0, 1.0)**2 + (
            (factor - K) / K * v - K * leg['speed_offset']['value'])**2 * (factor != K)
        return np.append(white + constant + [coarse, 0.0, 0.0],
                         self._turn_rate(leg, v, w, turned, reading))

    def _scale_variance(self, leg: dict[str, Any], v: float) -> float:
        """Return the variance of the speed by the scale: its sigma and its change with speed."""
        (scale, sigma), by_speed = self._known('scale_factor'), _of(leg['scale_by_speed'])
        change = (v**2 - leg['odometer']['square_speed']) / (2 * FAST_SPEED)
        return float(v**2 * ((sigma / scale)**2 + _square(by_speed) * change**2))

    def _turn_rate(self, leg: dict[str, Any], v: float, w: float, turned: float,
                   reading: float) -> float:
        """Return the variance of the turn rate from the difference of two wheels."""
        if not self.has_turn_rate:
            return np.nan
        left, right = (leg['wheels'][side] for side in SIDES)
        (width, sigma), hard = self._known('track_width'), leg['odometer']['hard']
        even, pulled, turning = (np.square(left['walk']) + np.square(right['walk'])) / 2
        walk = turning if w > TURNING_RATE else (1 - hard) * even + hard * pulled
        # the mean of two wheels has half the variance of one; their deviations from the mean have
        # opposite signs
        white = leg['widened']**2 * (4 * walk * turned + 8 * reading)
        ratio = left['ratio_sigma'] + right['ratio_sigma']
        return float(white + (sigma * w)**2 + (ratio * v)**2) / width**2

    def _known(self, name: str) -> tuple[float, float]:
        """Return value and sigma of an estimate, 0 if it is not determined."""
        found = self.estimates.get(name)
        return (found.value or 0.0, found.sigma or 0.0) if found else (0.0, 0.0)


def twist_noise(calibration: Calibration) -> TwistNoise | None:
    """Return the errors of the twist, None without a scale factor of the smoother."""
    scale = calibration.estimates.get('scale_factor')
    legs = _fitted(calibration.legs)
    if scale is None or not scale.value or scale.method != 'smoother' or not legs:
        return None
    odometers = [leg['odometer'] for leg in legs]
    speed, turn_rate = (float(np.sqrt(np.mean(np.square([o[name] for o in odometers]))))
                        for name in ('speed', 'turn_rate'))
    return TwistNoise(float(np.median([o['period'] for o in odometers])), speed, turn_rate,
                      (max(o['fastest'] for o in odometers),
                       max(o['fastest_turn'] for o in odometers)), legs, calibration.estimates)


def _fitted(legs: Sequence[LegResult]) -> tuple[dict[str, Any], ...]:
    """Return the details of the legs that the smoother fitted and nothing rejects."""
    found = [leg.methods['smoother'].details for leg in legs
             if 'smoother' in leg.methods and leg.verdict.value != 'rejected']
    return tuple({'wheels': {}, **details} for details in found if 'odometer' in details)


def _of(entry: dict[str, float]) -> tuple[float, float]:
    return entry['value'], entry['sigma']


def _square(effect: tuple[float, float]) -> float:
    """Return the mean square of an effect, value and sigma, that a driver does not correct."""
    return effect[0]**2 + effect[1]**2
