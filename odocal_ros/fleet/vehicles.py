# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A vehicle from the rows of its bags: legs combined as in replay, changes, pass or fail."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.combine import DRAWN_ANEW
from odocal_ros.calib.result import Calibration, Estimate, LegResult
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.rows import DONE, legs_from, Row, rows_of
from odocal_ros.fleet.statistics import covariance, History, history
from odocal_ros.fleet.tables import all_reasons, leg_row, utc, value_cells
from odocal_ros.library.calibrate_bag import unique_names
from odocal_ros.nav.rotations import wrap
from odocal_ros.output.figures import accept_line, iso
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.acceptance import accept, Decision
from odocal_ros.pipeline.calibrate import combine
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.levels import DAY_NS

FEWEST_REJECTED = 2             # judgement: last legs, all rejected; one alone may be a bad drive
LOOK_AT_BAGS = 'See the column failures of vehicles.parquet for the reason of each bag.'


@dataclass(frozen=True, eq=False)
class Driven:
    """A leg with the odometer reading of its bag, km."""

    leg: LegResult
    odometer_km: float | None

    @cached_property
    def estimates(self) -> dict[str, Estimate]:
        """Return the leg's values, each from the method that gives it."""
        return leg_estimates(self.leg)


def driven_legs(rows: Sequence[Row], known: dict[str, FleetBag]) -> list[Driven]:
    """Return the legs of rows by time, with unique bag names as in replay."""
    legs = [legs_from(row.legs) for row in rows]
    entries = [{'bag': next((leg.bag for leg in some), row.bag)}
               for row, some in zip(rows, legs, strict=True)]
    named, _ = unique_names([Path(row.bag) for row in rows], legs, entries)
    km = [known[row.bag].odometer_km if row.bag in known else row.odometer_km
          for row, some in zip(rows, legs, strict=True) for _ in some]
    return sorted((Driven(leg, k) for leg, k in zip(named, km, strict=True)),
                  key=lambda one: one.leg.start_ns)


def history_of(name: str, driven: Sequence[Driven],
               config: Config) -> tuple[list[int], History, History]:
    """Return the legs that determine a value, its history over days, and over kilometres."""
    found = []
    for k, one in enumerate(driven):
        e = one.estimates.get(name)
        if one.leg.verdict is not Verdict.REJECTED and e is not None and e.value is not None:
            found.append((k, e.value, one.leg.methods[e.method]))
    if not found:
        return [], History(), History()
    scale = name == 'scale_factor'
    number, values, methods = (list(column) for column in zip(*found, strict=True))
    value = np.array(values)
    y = np.log(value / value[0]) if scale else np.asarray(wrap(value - value[0]))
    own, shared = _errors(name, methods)
    days = np.array([driven[k].leg.driven_ns for k in number]) / DAY_NS
    days -= days[0]
    V = covariance(own, shared, days, config.verdict.scale_drift_per_day if scale else 0.0)
    km = [driven[k].odometer_km for k in number]
    by_distance = History() if not scale or None in km else history(y, V, np.array(km) / 1000)
    year = 365.25    # days
    return number, history(y, V, days / year), by_distance


def _errors(name: str, methods: Sequence[Any]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the variance of each leg's own errors, and the effects of shared errors."""
    own = np.zeros(len(methods))
    shared: dict[tuple[Any, ...], np.ndarray] = {}
    for k, method in enumerate(methods):
        i = method.parameters.index(name)
        for source in method.sources:
            if not source.shared or source.name in DRAWN_ANEW:
                own[k] += source.effects[i] @ source.effects[i]
                continue
            effects = shared.setdefault((method.name, source.name, source.effects.shape[1]),
                                        np.zeros((len(methods), source.effects.shape[1])))
            effects[k] = source.effects[i]
    return own, list(shared.values())


def rejecting(leg: LegResult) -> list[Reason]:
    """Return the reasons that reject a leg, empty if it is not rejected."""
    return [r for r in all_reasons(leg)
            if r.code.severity is Verdict.REJECTED and leg.verdict is Verdict.REJECTED]


def all_rejected(lost: Sequence[Driven]) -> Reason:
    """Return the reason why the current state of a vehicle is unknown."""
    last = rejecting(lost[-1].leg)[0]
    since = f'{utc(lost[0].leg.start_ns):%Y-%m-%d}'
    return replace(last, text=f'the last {len(lost)} legs, since {since}, are all rejected: '
                   f'{last.text}')


@dataclass(frozen=True)
class VehicleJob:
    """The bags of a vehicle, the files of their rows, and the settings in force, as ``accept``."""

    vehicle: str
    bags: tuple[FleetBag, ...]
    rows: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Vehicle:
    """Result of a vehicle: its row of vehicles.parquet, those of legs.parquet, and more."""

    row: dict[str, Any]
    legs: list[dict[str, Any]]
    calibration: Calibration | None = None
    config: Config | None = None
    inputs: tuple[dict[str, Any], ...] = ()


def vehicle_of(job: VehicleJob) -> Vehicle:
    rows = [row for row in rows_of(job.rows) if row.vehicle == job.vehicle]
    known = {bag.bag: bag for bag in job.bags}
    done = sorted((row for row in rows if row.status == DONE), key=lambda row: row.start_ns)
    failed = [row for row in rows if row.status != DONE]
    row = {'vehicle': job.vehicle, 'model': next((b.model for b in job.bags if b.model), ''),
           'bags': len(rows), 'bags_failed': len(failed),
           'failures': '; '.join(f'{Path(r.bag).name}: {r.reason}' for r in failed[:5])}
    driven = driven_legs(done, known)
    if not driven:
        limits = with_settings(Config(), job.settings).accept.limits
        return Vehicle(_undriven(row, Decision.UNDECIDED.value if limits else ''), [])
    config = with_settings(done[-1].config(), job.settings)
    histories = {name: history_of(name, driven, config) for name in (
        'scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')}
    # first legs of the periods without changes
    starts = sorted({0} | {number[change.leg] for number, found, _ in histories.values()
                           for change in found.changes})
    now = driven[starts[-1]:]
    calibration = combine([one.leg for one in now], config, imu=known_imu(config))
    lost = driven[1 + max((k for k, one in enumerate(driven)
                           if one.leg.verdict is not Verdict.REJECTED), default=-1):]
    if len(lost) >= FEWEST_REJECTED and calibration.verdict is not Verdict.REJECTED:
        calibration = replace(calibration, reasons=(all_rejected(lost), *calibration.reasons))
    row |= _current(calibration, config, driven, starts) | _changes(histories, driven) \
        | {'rejected_for': ' '.join(dict.fromkeys(
            r.code.name for one in driven for r in rejecting(one.leg))),
           'rejected_since': utc(lost[0].leg.start_ns) if lost else None}
    since = now[0].leg.start_ns
    row |= {'now': [r.bag for r in done if r.start_ns >= since or r is done[-1]], 'report': None}
    legs = [_leg_row(job, k, one, starts, histories) for k, one in enumerate(driven)]
    inputs = tuple({'bag': r.bag, 'sha256': r.sha256, 'topics': json.loads(r.topics)}
                   for r in done)
    return Vehicle(row, legs, calibration, config, inputs)


def _undriven(row: dict[str, Any], decision: str) -> dict[str, Any]:
    return row | value_cells({}) | dict.fromkeys((
        'first', 'last', 'since', 'rejected_since', 'drift_per_year', 'drift_per_year_sigma',
        'drift_per_1000_km', 'drift_per_1000_km_sigma', 'report')) | {
        'legs': 0, 'legs_good': 0, 'distance_km': 0.0, 'driven_h': 0.0, 'changes': '[]',
        'verdict': Verdict.REJECTED.value, 'decision': decision, 'remedy': LOOK_AT_BAGS,
        'why': 'none of its bags could be calibrated', 'reasons': '', 'odd_legs': '',
        'rejected_for': '', 'now': [], 'line': json.dumps(
            {'vehicle': row['vehicle'], 'decision': decision,
             'why': row['failures'], 'remedy': LOOK_AT_BAGS, 'values': {},
             'verdict': Verdict.REJECTED.value, 'reasons': []})}


def _current(calibration: Calibration, config: Config, driven: Sequence[Driven],
          starts: Sequence[int]) -> dict[str, Any]:
    """Return the calibration since the last change."""
    legs = [one.leg for one in driven]
    acceptance = accept(calibration, config)
    return value_cells(calibration.estimates) | {
        'legs': len(legs), 'legs_good': sum(g.verdict is not Verdict.REJECTED for g in legs),
        'distance_km': sum(g.distance for g in legs) / 1000,
        'driven_h': sum(g.duration for g in legs) / 3600,
        'first': utc(legs[0].start_ns), 'last': utc(legs[-1].start_ns),
        'since': utc(legs[starts[-1]].start_ns),
        'verdict': calibration.verdict.value,
        'decision': acceptance.decision.value if acceptance else '',
        'why': acceptance.why if acceptance else '',
        'remedy': acceptance.do if acceptance else '',
        'line': accept_line(calibration, acceptance, config) if acceptance else '',
        'reasons': ' '.join(dict.fromkeys(r.code.name for r in calibration.reasons))}


def _changes(histories: dict[str, Any], driven: Sequence[Driven]) -> dict[str, Any]:
    """Return the changes of all values by date, and the drift of the scale."""
    found = []
    for name, (number, past, _) in histories.items():
        for change in past.changes:
            before, after = (driven[number[k]].leg for k in (change.leg - 1, change.leg))
            found.append({
                'value': name, 'after': iso(before.start_ns), 'by': iso(after.start_ns),
                'leg': number[change.leg] + 1,
                'size': math.expm1(change.size) if name == 'scale_factor' else change.size,
                'sigma': change.sigma, 'unit': '1' if name == 'scale_factor' else 'rad'})
    odd = Counter(number[k] + 1 for number, past, _ in histories.values() for k in past.odd)
    _, by_date, by_distance = histories['scale_factor']
    return {'changes': json.dumps(sorted(found, key=lambda change: change['by'])),
            'odd_legs': ' '.join(map(str, sorted(odd))),
            'drift_per_year': by_date.slope, 'drift_per_year_sigma': by_date.slope_sigma,
            'drift_per_1000_km': by_distance.slope,
            'drift_per_1000_km_sigma': by_distance.slope_sigma}


def _leg_row(job: VehicleJob, k: int, one: Driven, starts: Sequence[int],
             histories: dict[str, Any]) -> dict[str, Any]:
    model = next((b.model for b in job.bags if b.model), '')
    return leg_row(job.vehicle, model, k + 1, one.odometer_km, one.leg) | {
        'period': sum(start <= k for start in starts),
        'odd': any(k in (number[i] for i in history.odd)
                   for number, history, _ in histories.values())}
