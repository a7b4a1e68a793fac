# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Quantities within their limits: yes, no or unknown, while a leg is recorded and after it."""

from collections.abc import Set
from dataclasses import dataclass
import math

from odocal_ros.calib.choice import ABOUT, PLANAR
from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.forecast.forecast import Forecast
from odocal_ros.reasons import Verdict
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import TRACK_WIDTH

YES, NO, UNKNOWN = 'yes', 'no', 'unknown'


@dataclass(frozen=True)
class Quantity:
    """A quantity and its estimates; ``relative``: its limit is relative to the value."""

    label: str
    estimates: tuple[str, ...]
    relative: bool
    of_two_wheels: bool = False
    of_imu: bool = False      # the planar estimator has none

    def limit(self, config: Config) -> float:
        """Return the limit of the sigma, relative to the value or rad."""
        if self.estimates[0] == 'track_width':
            # no setting verdict.*: the limit of the method
            return TRACK_WIDTH.determined_share
        return config.verdict.max_scale_sigma if self.relative else config.verdict.max_yaw_sigma


QUANTITIES = {
    'scale': Quantity('scale', ('scale_factor',), True),
    'yaw': Quantity('yaw', ('yaw_mounting_angle',), False, of_imu=True),
    'pitch': Quantity('pitch', ('pitch_mounting_angle',), False, of_imu=True),
    'left_right': Quantity('left and right wheel', ('scale_factor_left', 'scale_factor_right'),
                           True, True),
    'track_width': Quantity('track width', ('track_width',), True, True),
}


def nothing_known() -> dict[str, str]:
    return dict.fromkeys(QUANTITIES, UNKNOWN)


def of_forecast(forecast: Forecast | None, config: Config, two_wheels: bool,
                lost: bool = False) -> dict[str, str]:
    """
    Return yes, no or unknown for each quantity of a leg that ends now.

    Unknown before the first update; a configured track width need not be determined.
    ``lost``: the leg would be rejected: no value is within its limit.
    """
    if forecast is None:
        return nothing_known() | dict.fromkeys(('scale', 'yaw', 'pitch'), NO) if lost else \
            nothing_known()
    known = {name: forecast.sigma(name) for name, quantity in QUANTITIES.items()
             if not (quantity.of_two_wheels and (not two_wheels or forecast.wheels is None)
                     or quantity.of_imu and PLANAR in forecast.methods)}
    return _judged({name: None if lost else sigma for name, sigma in known.items()}, config)


def of_calibration(calibration: Calibration, config: Config, two_wheels: bool) -> dict[str, str]:
    """Return yes, no or unknown for each quantity of a result; no yes for a rejected one."""
    doubted = {ABOUT[r.code] for r in calibration.reasons
               if r.code in ABOUT and r.code.severity is not Verdict.ACCEPTED}
    return of_estimates(calibration.estimates, config, two_wheels,
                        calibration.verdict is not Verdict.REJECTED, doubted)


def of_estimates(estimates: dict[str, Estimate], config: Config, two_wheels: bool, valid: bool,
                 doubted: Set[str] = frozenset()) -> dict[str, str]:
    """
    Return yes, no or unknown for each quantity: within its limit.

    valid : False: no value is usable.   doubted : names of estimates with a reason against
    their use.
    """
    planar = any(e.method == PLANAR for e in estimates.values())
    known: dict[str, float | None] = {}
    bad = set()
    for name, quantity in QUANTITIES.items():
        found = [estimates.get(part) for part in quantity.estimates]
        if quantity.of_imu and planar:
            continue
        if quantity.of_two_wheels and not two_wheels and not any(
                e is not None and e.value is not None for e in found):
            continue
        known[name] = max(_share(e, quantity.relative) for e in found)
        if not valid or doubted & set(quantity.estimates):
            bad.add(name)
    return _judged(known, config) | dict.fromkeys(bad, NO)


def as_keys(ok: dict[str, str]) -> dict[str, str]:
    """Return the keys of ``~/status``."""
    return {f'{name}_ok': value for name, value in ok.items()}


def words(ok: dict[str, str]) -> str:
    """Return the quantities as text, empty if all are unknown."""
    parts = []
    for value, text in ((YES, 'OK'), (NO, 'not OK')):
        labels = [QUANTITIES[name].label for name, v in ok.items() if v == value]
        if labels:
            parts.append(f'{text}: {", ".join(labels)}')
    return '; '.join(parts)


def _judged(sigmas: dict[str, float | None], config: Config) -> dict[str, str]:
    """Return yes or no for known sigmas; a configured track width may stay unknown."""
    ok = nothing_known()
    for name, sigma in sigmas.items():
        if sigma is not None and sigma <= QUANTITIES[name].limit(config):
            ok[name] = YES
        elif name != 'track_width' or not config.odometer.track_width > 0:
            ok[name] = NO
    return ok


def _share(estimate: Estimate | None, relative: bool) -> float:
    """Return the sigma of an estimate, relative to its value or not; infinite without one."""
    if estimate is None or estimate.value is None or estimate.sigma is None:
        return math.inf
    if relative:
        return estimate.sigma / abs(estimate.value) if estimate.value else math.inf
    return estimate.sigma

