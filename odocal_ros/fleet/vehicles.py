# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The result of a vehicle of a fleet from the stored legs of its bags.

Its values over all legs show changes, such as new tyres. The legs since the last change give the
calibration and the decision on the limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.combine import DIFFERING_SOURCES
from odocal_ros.calib.result import Calibration, Estimate, LegResult
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.rows import DONE, read_rows, Row
from odocal_ros.fleet.statistics import covariance, History, history
from odocal_ros.fleet.tables import leg_row, utc, value_cells
from odocal_ros.library.calibrate_bag import unique_names
from odocal_ros.nav.rotations import wrap
from odocal_ros.output.stored import known_imu
from odocal_ros.output.value_text import accept_line, iso, MAIN_VALUES, UNKNOWN
from odocal_ros.pipeline.acceptance import accept, Decision
from odocal_ros.pipeline.calibrate import combine
from odocal_ros.reasons import Reason, rejecting, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.levels import DAY_NS

MIN_REJECTED_LEGS = 2           # judgement: last legs, all rejected; one alone may be a bad drive
FAILED_REMEDY = 'See the column failures of vehicles.parquet for the reason of each bag.'


class DrivenLeg(NamedTuple):
    """A leg with its values, and the odometer reading of its bag, km."""

    leg: LegResult
    estimates: dict[str, Estimate]      # each from the method that gives it
    odometer_km: float | None


def legs_by_time(rows: Sequence[Row], bags: dict[str, FleetBag]) -> list[DrivenLeg]:
    """Return the legs of rows by time, with unique bag names as in replay; bags : by path."""
    legs_by_row = [row.leg_results() for row in rows]
    inputs = [{'bag': next((leg.bag for leg in legs), row.bag)}
              for row, legs in zip(rows, legs_by_row, strict=True)]
    named_legs, _ = unique_names([Path(row.bag) for row in rows], legs_by_row, inputs)
    odometer_km = [bags[row.bag].odometer_km if row.bag in bags else row.odometer_km
                   for row, legs in zip(rows, legs_by_row, strict=True) for _ in legs]
    driven_legs = map(DrivenLeg, named_legs, map(leg_estimates, named_legs), odometer_km)
    return sorted(driven_legs, key=lambda driven: driven.leg.start_ns)


@dataclass(frozen=True)
class ValueHistory:
    """Changes, outliers and drift of a value over the legs of a vehicle."""

    legs: tuple[int, ...] = ()            # indices of the legs that determine the value
    by_date: History = History()          # drift per year
    by_distance: History = History()      # drift per 1000 km, of the scale only

    @property
    def outlier_legs(self) -> list[int]:
        """Return the indices of the single outlier legs."""
        return [self.legs[k] for k in self.by_date.outliers]


def history_of(name: str, legs: Sequence[DrivenLeg], config: Config) -> ValueHistory:
    """Return the history of a value, of a scale that of its logarithm."""
    estimates = [driven.estimates.get(name, UNKNOWN) for driven in legs]
    indices = [k for k, driven in enumerate(legs) if driven.leg.verdict is not Verdict.REJECTED
               and estimates[k].value is not None]
    if not indices:
        return ValueHistory()
    is_scale = name == 'scale_factor'
    value = np.array([estimates[k].value for k in indices])
    # change of the value since the first leg
    y = np.log(value / value[0]) if is_scale else np.asarray(wrap(value - value[0]))
    independent, shared = _errors(name, [legs[k].leg.methods[estimates[k].method]
                                         for k in indices])
    days = np.array([legs[k].leg.drive_start_ns for k in indices]) / DAY_NS
    days -= days[0]
    V = covariance(independent, shared, days,
                   config.verdict.scale_drift_per_day if is_scale else 0.0)
    km = [legs[k].odometer_km for k in indices]
    by_distance = History() if not is_scale or None in km else history(y, V, np.array(km) / 1000)
    year = 365.25    # days
    return ValueHistory(tuple(indices), history(y, V, days / year), by_distance)


def _errors(name: str, methods: Sequence[Any]) -> tuple[np.ndarray, list[np.ndarray]]:
    """
    Return the errors of a value in n legs, one method for each, as arguments of ``covariance``.

    (n,) variance of independent errors, and for each shared source its (n, k) one-sigma effects.
    """
    independent = np.zeros(len(methods))
    shared: dict[tuple[Any, ...], np.ndarray] = {}
    for k, method in enumerate(methods):
        i = method.parameters.index(name)      # row of the effects
        for source in method.sources:
            if not source.shared or source.name in DIFFERING_SOURCES:
                independent[k] += source.effects[i] @ source.effects[i]
                continue
            effects = shared.setdefault((method.name, source.name, source.effects.shape[1]),
                                        np.zeros((len(methods), source.effects.shape[1])))
            effects[k] = source.effects[i]
    return independent, list(shared.values())


def rejecting_reasons(leg: LegResult) -> list[Reason]:
    """Return the reasons that reject a leg, empty if it is not rejected."""
    return rejecting(leg.all_reasons) if leg.verdict is Verdict.REJECTED else []


def rejected_state_reason(rejected: Sequence[DrivenLeg]) -> Reason:
    """Return the reason for an unknown current state, if the last legs are all rejected."""
    reason_of_last = rejecting_reasons(rejected[-1].leg)[0]
    since = f'{utc(rejected[0].leg.start_ns):%Y-%m-%d}'
    return replace(reason_of_last, text=f'the last {len(rejected)} legs, since {since}, are all '
                   f'rejected; the last one: {reason_of_last.text}')


@dataclass(frozen=True)
class VehicleJob:
    """The bags of a vehicle."""

    vehicle: str
    bags: tuple[FleetBag, ...]
    row_files: tuple[str, ...]     # of the bags
    settings: dict[str, Any] = field(default_factory=dict)    # of this run, such as the limits


@dataclass(frozen=True, eq=False)
class Vehicle:
    """Result of a vehicle: its rows in the tables, and its calibration for result files."""

    row: dict[str, Any]            # of vehicles.parquet
    legs: list[dict[str, Any]]     # rows of legs.parquet
    calibration: Calibration | None = None     # since its last change; None without legs
    config: Config | None = None
    inputs: tuple[dict[str, Any], ...] = ()    # entries of its bags in calibration.json


def vehicle_of(job: VehicleJob) -> Vehicle:
    """Return the result of a vehicle from the rows of its bags."""
    bag_rows = [row for row in read_rows(job.row_files) if row.vehicle == job.vehicle]
    done = sorted((row for row in bag_rows if row.status == DONE), key=lambda row: row.start_ns)
    row = _bag_columns(job, bag_rows)
    legs = legs_by_time(done, {bag.bag: bag for bag in job.bags})
    if not legs:
        limits = with_settings(Config(), job.settings).accept.limits
        return Vehicle(_row_without_legs(row, Decision.UNDECIDED.value if limits else ''), [])
    config = with_settings(done[-1].config(), job.settings)
    histories = {name: history_of(name, legs, config) for name in MAIN_VALUES}
    # indices of the first legs of the periods without changes
    starts = sorted({0, *(values.legs[change.leg] for values in histories.values()
                          for change in values.by_date.changes)})
    current_legs = legs[starts[-1]:]
    calibration = combine([driven.leg for driven in current_legs], config, imu=known_imu(config))
    last_rejected = legs[1 + max((k for k, driven in enumerate(legs)
                                  if driven.leg.verdict is not Verdict.REJECTED), default=-1):]
    if len(last_rejected) >= MIN_REJECTED_LEGS and calibration.verdict is not Verdict.REJECTED:
        calibration = replace(
            calibration, reasons=(rejected_state_reason(last_rejected), *calibration.reasons))
    since_ns = current_legs[0].leg.start_ns
    outliers = sorted({k for values in histories.values() for k in values.outlier_legs})
    row |= _current_state(calibration, config, legs, since_ns) | _changes(histories, legs) | {
        'odd_legs': ' '.join(str(k + 1) for k in outliers),
        'rejected_for': ' '.join(dict.fromkeys(
            reason.code.name for driven in legs for reason in rejecting_reasons(driven.leg))),
        'rejected_since': utc(last_rejected[0].leg.start_ns) if last_rejected else None,
        'current_bags': [bag_row.bag for bag_row in done
                         if bag_row.start_ns >= since_ns or bag_row is done[-1]],
        'report': None}
    leg_rows = [leg_row(job.vehicle, row['model'], k + 1, driven.odometer_km, driven.leg) | {
        'period': sum(start <= k for start in starts), 'odd': k in outliers}
        for k, driven in enumerate(legs)]
    inputs = tuple({'bag': bag_row.bag, 'sha256': bag_row.sha256,
                    'topics': json.loads(bag_row.topics)} for bag_row in done)
    return Vehicle(row, leg_rows, calibration, config, inputs)


def _bag_columns(job: VehicleJob, bag_rows: Sequence[Row]) -> dict[str, Any]:
    """Return columns: the vehicle, its numbers of bags, and the reasons of failed ones."""
    failed = [(Path(row.bag).name, row.reason) for row in bag_rows if row.status != DONE]
    return {'vehicle': job.vehicle,
            'model': next((bag.model for bag in job.bags if bag.model), ''),
            'bags': len(bag_rows), 'bags_failed': len(failed), 'failures': '; '.join(
                f'{name}: {reason.removeprefix(f"{name}: ")}' for name, reason in failed[:5])}


def _row_without_legs(row: dict[str, Any], decision: str) -> dict[str, Any]:
    """Return the row of a vehicle whose bags all failed."""
    return row | value_cells({}) | dict.fromkeys((
        'first', 'last', 'since', 'rejected_since', 'drift_per_year', 'drift_per_year_sigma',
        'drift_per_1000_km', 'drift_per_1000_km_sigma', 'report')) | {
        'legs': 0, 'legs_good': 0, 'distance_km': 0.0, 'driven_h': 0.0, 'changes': '[]',
        'verdict': Verdict.REJECTED.value, 'decision': decision, 'remedy': FAILED_REMEDY,
        'why': 'none of its bags could be calibrated', 'reasons': '', 'odd_legs': '',
        'rejected_for': '', 'current_bags': [], 'line': json.dumps(
            {'vehicle': row['vehicle'], 'decision': decision,
             'why': row['failures'], 'remedy': FAILED_REMEDY, 'values': {},
             'verdict': Verdict.REJECTED.value, 'reasons': []})}


def _current_state(calibration: Calibration, config: Config, driven_legs: Sequence[DrivenLeg],
                   since_ns: int) -> dict[str, Any]:
    """Return columns: the calibration since the last change, and sums over all legs."""
    legs = [driven.leg for driven in driven_legs]
    acceptance = accept(calibration, config)
    return value_cells(calibration.estimates) | {
        'legs': len(legs), 'legs_good': sum(leg.verdict is not Verdict.REJECTED for leg in legs),
        'distance_km': sum(leg.distance for leg in legs) / 1000,
        'driven_h': sum(leg.duration for leg in legs) / 3600,
        'first': utc(legs[0].start_ns), 'last': utc(legs[-1].start_ns),
        'since': utc(since_ns),
        'verdict': calibration.verdict.value,
        'decision': acceptance.decision.value if acceptance else '',
        'why': acceptance.why if acceptance else '',
        'remedy': acceptance.remedy if acceptance else '',
        'line': accept_line(calibration, acceptance, config) if acceptance else '',
        'reasons': ' '.join(dict.fromkeys(reason.code.name for reason in calibration.reasons))}


def _changes(histories: dict[str, ValueHistory], legs: Sequence[DrivenLeg]) -> dict[str, Any]:
    """Return columns: the changes of all values by date, and the drift of the scale."""
    changes = []
    for name, values in histories.items():
        for change in values.by_date.changes:
            before, after = (legs[values.legs[k]].leg for k in (change.leg - 1, change.leg))
            changes.append({
                'value': name, 'after': iso(before.start_ns), 'by': iso(after.start_ns),
                'leg': values.legs[change.leg] + 1,
                'size': math.expm1(change.size) if name == 'scale_factor' else change.size,
                'sigma': change.sigma, 'unit': '1' if name == 'scale_factor' else 'rad'})
    by_date, by_distance = histories['scale_factor'].by_date, histories['scale_factor'].by_distance
    return {'changes': json.dumps(sorted(changes, key=lambda change: change['by'])),
            'drift_per_year': by_date.slope, 'drift_per_year_sigma': by_date.slope_sigma,
            'drift_per_1000_km': by_distance.slope,
            'drift_per_1000_km_sigma': by_distance.slope_sigma}
