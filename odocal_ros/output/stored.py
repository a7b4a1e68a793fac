# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading of calibration.json, untrusted, and the test whether a result is worse than another."""

from dataclasses import dataclass, field
import json
import math
from pathlib import Path
import sys
from typing import Any, TypeVar

from odocal_ros.calib.marginal_information import CarriedInformation, read_carried
from odocal_ros.calib.result import Estimate, NOT_ESTIMATES, wheel_factors
from odocal_ros.errors import BadUsage
from odocal_ros.output.files import MAIN, plain, SCHEMA
from odocal_ros.output.value_text import angle_text, with_unit
from odocal_ros.reasons import Code, Verdict
from odocal_ros.safe_io.limits import read_bytes
from odocal_ros.settings.config import Config, flat

T = TypeVar('T')
# settings that identify the IMU of the constants
SAME_IMU = ('imu.mounting_rpy', 'imu.gyro_scale', 'imu.accel_scale', 'imu.grade')


@dataclass(frozen=True, eq=False)
class Stored:
    """A calibration read from its file."""

    name: str                           # path of the file or folder
    created: str                        # ISO 8601
    verdict: Verdict
    reasons: tuple[str, ...]            # codes
    estimates: dict[str, Estimate]
    legs: frozenset[tuple[int, int]]    # (start, stop) ns
    bags: frozenset[str]                # sha256 of the bags, as far as known
    config: dict[str, Any]              # settings by dotted name
    # parameter -> source -> one-sigma effect in the unit of the parameter, True if all legs share
    # the error
    budget: dict[str, dict[str, tuple[float, bool]]] = field(default_factory=dict)
    vehicle: str = ''
    carried: CarriedInformation | None = None      # information for later legs, with leg.automatic
    imu: CarriedInformation | None = None          # information on the constants of the IMU

    @property
    def usable(self) -> bool:
        return self.verdict is not Verdict.REJECTED

    def value(self, name: str) -> float | None:
        """Return a value by name, None if it is unknown."""
        estimate = self.estimates.get(name)
        return None if estimate is None else estimate.value


def read_stored(path: Path) -> Stored:
    """Return the calibration in a file or folder; BadUsage: missing, unreadable, other schema."""
    name = str(path)
    try:
        path = path / MAIN if path.is_dir() else path
        max_bytes = 2**28    # a day of legs is a thousandth of it
        content = json.loads(read_bytes(path, max_bytes).decode(), parse_constant=_no_constant)
        return stored_from(content, name)
    except OSError as error:
        in_folder = isinstance(error, FileNotFoundError) and path != Path(name)
        cause = f'there is no {MAIN} in it' if in_folder else error.strerror
        raise BadUsage(f'{name}: {cause}; give a calibration.json or its folder') from None
    except (ValueError, RecursionError) as error:      # of json, utf-8, or a value below
        cause = (str(error).splitlines() or ['nested too deep'])[0]
        raise BadUsage(f'{name}: not a calibration.json of odocal ({cause})') from None


def _no_constant(text: str) -> None:
    raise ValueError(f'{text} is not a number')


def stored_from(content: dict[str, Any], name: str) -> Stored:
    """Return the calibration in the content of a calibration.json, or raise ValueError."""
    if not isinstance(content, dict):
        raise ValueError('the top level is not an object')
    schema = content.get('schema')
    if schema != SCHEMA or isinstance(schema, bool):
        raise ValueError(f'schema is {str(schema)[:20]}, this version reads {SCHEMA}')
    verdict = _entry(content, 'verdict', str)
    if verdict not in [known.value for known in Verdict]:
        raise ValueError(f'verdict is {verdict[:20]!r}')
    result = _entry(content, 'result', dict)
    legs = [leg for leg in _entry(content, 'legs', list) if isinstance(leg, dict)]
    inputs = [bag for bag in _entry(content, 'inputs', list) if isinstance(bag, dict)]
    methods = _entry(content, 'methods', dict)
    result = {key: entry for key, entry in result.items() if key not in NOT_ESTIMATES}
    carried, imu = (read_carried(content[part]) if isinstance(content.get(part), dict) else None
                    for part in ('carried', 'imu'))
    return Stored(
        name=name, created=_entry(content, 'created', str), verdict=Verdict(verdict),
        reasons=tuple(str(reason.get('code')) for reason in _entry(content, 'reasons', list)
                      if isinstance(reason, dict)),
        estimates={key: _estimate(entry, key) for key, entry in result.items()},
        legs=frozenset((leg['start_ns'], leg['stop_ns']) for leg in legs
                       if all(type(leg.get(key)) is int for key in ('start_ns', 'stop_ns'))),
        bags=frozenset(bag['sha256'] for bag in inputs if isinstance(bag.get('sha256'), str)),
        config=_entry(content, 'config', dict),
        budget={key: _budget(methods, entry.get('method'), key) for key, entry in result.items()},
        vehicle=str(content.get('vehicle') or ''), carried=carried, imu=imu)


def known_imu(config: Config) -> CarriedInformation | None:
    """
    Return the information on the IMU in the result at ``imu.constants``; None if it is not set.

    Raises BadUsage: the result cannot be read, is of another IMU or contains no IMU constants.
    """
    if not config.imu.constants:
        return None
    try:
        stored = read_stored(Path(config.imu.constants).expanduser())
    except BadUsage as error:
        raise BadUsage(f'imu.constants: {error}') from None
    settings = flat(config)
    different = ['vehicle'] * (stored.vehicle != config.vehicle) + [
        name for name in SAME_IMU if stored.config.get(name) != plain(settings[name])]
    if different:
        raise BadUsage(f'imu.constants: {stored.name} has another {" and ".join(different)}: the '
                       'same IMU with unchanged mounting is required')
    if stored.imu is None:
        raise BadUsage(f'imu.constants: {stored.name} contains no IMU constants: none of its legs '
                       'has a result of the smoother')
    return stored.imu


def _entry(content: dict[str, Any], key: str, kind: type[T]) -> T:
    """Return an entry of a type, or raise ValueError."""
    entry = content.get(key)
    if not isinstance(entry, kind):
        raise ValueError(f'{key!r} is missing or has the wrong type')
    return entry


def _estimate(entry: dict[str, Any], key: str) -> Estimate:
    if not isinstance(entry, dict) or not {'value', 'sigma', 'unit'} <= set(entry):
        raise ValueError(f'result.{key} lacks value, sigma or unit')
    value, sigma = (_number(entry[part], f'result.{key}.{part}') for part in ('value', 'sigma'))
    check_estimate(key, value, sigma)
    if entry['unit'] is not None and not isinstance(entry['unit'], str):
        raise ValueError(f'result.{key}.unit is not text')
    return Estimate(value, sigma, entry['unit'] or '', str(entry.get('method') or ''))


def check_estimate(name: str, value: float | None, sigma: float | None) -> None:
    """Raise ValueError for a value that no calibration gives."""
    for part, number in (('value', value), ('sigma', sigma)):
        if number is not None and not math.isfinite(number):
            raise ValueError(f'result.{name}: its {part} is not finite')
    if sigma is not None and sigma < 0:
        raise ValueError(f'result.{name}: its sigma is negative')
    if name.startswith(('scale_', 'track_width')) and value is not None and value <= 0:
        raise ValueError(f'result.{name}: its value is not positive')


def _number(value: float | None, key: str) -> float | None:
    """Return a finite number or None, or raise ValueError."""
    if value is None:
        return None
    if type(value) not in (int, float) or not abs(value) <= sys.float_info.max:    # False: nan
        raise ValueError(f'{key} is not a finite number')
    return float(value)


def _budget(methods: dict[str, dict[str, Any]], method: str | None,
            parameter: str) -> dict[str, tuple[float, bool]]:
    """Return the budget of a parameter; empty without a readable one."""
    entry = methods.get(method) if isinstance(method, str) else None
    budget = entry.get('budget') if isinstance(entry, dict) else None
    return {source: (row[parameter], row.get('shared') is True)
            for source, row in (budget.items() if isinstance(budget, dict) else ())
            if isinstance(row, dict) and isinstance(row.get(parameter), float)
            and math.isfinite(row[parameter])}


def objection(old: Stored, new: Stored) -> str:
    """
    Return the reason why a new calibration is worse than an old one, empty if it is not.

    Worse than an old one that is not rejected: it is rejected, a value is missing, or a sigma is
    more than twice as large. A result that contains the legs of the old one, or its carried
    information, is never worse: legs that disagree increase a sigma that was too small.
    """
    if not old.usable:
        return ''
    if not new.usable:
        rejecting = [name for name in new.reasons if name in Code.__members__
                     and Code[name].severity is Verdict.REJECTED]
        codes = ', '.join(dict.fromkeys(rejecting[:3] or new.reasons[:3]))
        return f'the new result is rejected ({codes}), the old one is {old.verdict.value}'
    if old.legs and old.legs < new.legs \
            or old.carried and new.carried and new.carried.includes(old.carried):
        return ''
    for name in ('scale_factor', *wheel_factors(old.estimates), 'yaw_mounting_angle'):
        reason = _worse(name.replace('_', ' '), old.estimates.get(name), new.estimates.get(name))
        if reason:
            return reason
    return ''


def _worse(label: str, old: Estimate | None, new: Estimate | None) -> str:
    """Return the reason why a value is missing or has a larger sigma, empty if not."""
    if old is None or old.value is None or not old.sigma:
        return ''
    if new is None or new.value is None:
        return f'the new result has no {label}, the old one has {estimate_text(old)}'
    largest_ratio = 2.0    # of the sigmas: four times as many such legs would be needed
    ratio = (new.sigma or 0.0) / old.sigma
    if old.unit != 'rad' and new.value:      # relative: the vehicles may differ
        ratio *= abs(old.value / new.value)
    if new.unit == old.unit and ratio > largest_ratio:
        return (f'the uncertainty of the {label} is {ratio:.1f} times larger: '
                f'{estimate_text(new)}, the old result has {estimate_text(old)}')
    return ''


def estimate_text(estimate: Estimate) -> str:
    """Return a value with sigma and unit as text; angles in deg."""
    return angle_text(estimate) if estimate.unit == 'rad' else with_unit(estimate)


def stored_in(folder: Path) -> Stored | None:
    """Return the calibration in a result folder, None without a readable one."""
    try:
        return read_stored(folder)
    except BadUsage:
        return None


def objection_to_folder(old: Stored | None, new: Path) -> str:
    """Return ``objection`` of a calibration and a result folder, empty without either."""
    stored = stored_in(new)
    return objection(old, stored) if old and stored else ''
