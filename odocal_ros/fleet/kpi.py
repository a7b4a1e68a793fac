# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rates of wrong decisions on single legs, against all legs of a vehicle: odocal fleet --kpi.

The result of all legs of a vehicle since its last change is the reference. Its sigma is increased
by the scatter of these legs beyond their own sigmas, since tyres warm and wear between drives. The
vehicle is good if the 2-sigma interval is within all limits, and bad if it is outside one of them;
other vehicles are left out. Each leg is tested against the same limits.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
import json
import math
from pathlib import Path
from statistics import median
from typing import Any

from odocal_ros.calib.result import Estimate
from odocal_ros.fleet.tables import LEGS, VALUES
from odocal_ros.output.files import plain
from odocal_ros.output.value_text import table_row
from odocal_ros.pipeline.acceptance import decide_value, Decision
from odocal_ros.reasons import Verdict
from odocal_ros.safe_io.atomic_files import locked, write_text

KPI = 'kpi.json'
SIGMA_PER_MEDIAN = 1.4826        # statistical: sigma over the median of normal absolute errors
MIN_LEGS = 3                  # judgement: legs of a reference; a tested leg is one of them
MINUTES = (2.0, 5.0, 10.0, 30.0)      # judgement: upper ends of the rows of the table
# rates of a row; recall and false reject refer to good vehicles, false accept to bad ones
SHARES = ('precision', 'recall', 'false_accept', 'false_reject', 'undecided')
KPI_WIDTHS = 10, 7, 11, 9, 14, 14, 11     # definition: widths of the columns of the table
Limits = dict[str, tuple[float, float]]      # lowest and highest accepted value, by name


def _rates(counts: Counter[tuple[bool, Decision]]) -> dict[str, Any]:
    """
    Return counts and rates of legs; a rate without legs is None.

    counts : number of legs by whether their vehicle is good, and the decision on the leg.
    """
    good, bad = ({decision: counts[is_good, decision] for decision in Decision}
                 for is_good in (True, False))
    all_good, all_bad = sum(good.values()), sum(bad.values())
    passed = good[Decision.PASS]
    return {
        'legs': all_good + all_bad, 'legs_of_good': all_good, 'legs_of_bad': all_bad,
        'precision': _ratio(passed, passed + bad[Decision.PASS]),
        'recall': _ratio(passed, all_good), 'false_accept': _ratio(bad[Decision.PASS], all_bad),
        'false_reject': _ratio(good[Decision.FAIL], all_good),
        'undecided': _ratio(good[Decision.UNDECIDED] + bad[Decision.UNDECIDED],
                            all_good + all_bad)}


def _ratio(count: int, total: int) -> float | None:
    return count / total if total else None


def kpi(vehicles: Iterable[dict[str, Any]], legs: Iterable[dict[str, Any]],
        limits: Limits) -> dict[str, Any]:
    """Return the rates from rows of vehicles.parquet and legs.parquet, of all and by duration."""
    legs_since_change: dict[str, list[dict[str, Any]]] = {}
    for leg in legs:      # by date
        vehicle_legs = legs_since_change.setdefault(leg['vehicle'], [])
        if vehicle_legs and leg['period'] != vehicle_legs[-1]['period']:
            vehicle_legs.clear()      # a change of the vehicle starts a new reference
        vehicle_legs.append(leg)
    counts = {max_minutes: Counter[tuple[bool, Decision]]()
              for max_minutes in (*MINUTES, math.inf)}
    vehicle_counts = {'good': 0, 'bad': 0, 'on_the_limit': 0}
    for row in vehicles:
        vehicle_legs = legs_since_change.get(row['vehicle'], [])
        decision = _decision(row | _sigmas_with_scatter(row, vehicle_legs, limits), limits)
        if decision is Decision.UNDECIDED or len(vehicle_legs) < MIN_LEGS:
            vehicle_counts['on_the_limit'] += 1
            continue
        good = decision is Decision.PASS
        vehicle_counts['good' if good else 'bad'] += 1
        for leg in vehicle_legs:
            row_end = next(minutes for minutes in counts if leg['duration_s'] / 60 <= minutes)
            counts[row_end][good, _decision(leg, limits)] += 1
    all_counts = sum(counts.values(), Counter[tuple[bool, Decision]]())
    by_minutes = [{'up_to': None if math.isinf(minutes) else minutes} | _rates(count)
                  for minutes, count in counts.items() if count]
    return {'limits': limits, 'vehicles': vehicle_counts, 'all': _rates(all_counts),
            'by_minutes': by_minutes}


def _decision(row: dict[str, Any], limits: Limits) -> Decision:
    """Return the decision on a row of a vehicle or a leg; a rejected one is undecided."""
    if row['verdict'] == Verdict.REJECTED.value:
        return Decision.UNDECIDED
    # the worst of all values: Decision is in the order pass, undecided, fail
    return max((decide_value(name, Estimate(row[name], row[f'{name}_sigma'],
                                            'rad' if 'angle' in name else ''), low, high).decision
                for name, (low, high) in limits.items()), key=list(Decision).index)


def _sigmas_with_scatter(row: dict[str, Any], legs: Sequence[dict[str, Any]],
                         limits: Limits) -> dict[str, float]:
    """Return the sigmas of the limited values of a vehicle, with the scatter of its legs."""
    increased = {}
    for name in limits:
        key = f'{name}_sigma'
        known = [leg for leg in legs if None not in (leg[name], leg[key])]
        if row[name] is not None and row[key] is not None and known:
            # by the median: a wrong leg must not increase the sigma of the reference
            scatter = SIGMA_PER_MEDIAN * median(abs(leg[name] - row[name]) for leg in known)
            unexplained = scatter**2 - median(leg[key] for leg in known)**2
            increased[key] = math.sqrt(row[key]**2 + max(unexplained, 0.0))
    return increased


def write_kpi(vehicles: Sequence[dict[str, Any]], limits: Limits, output: Path) -> str:
    """Write kpi.json; return the table as printed lines."""
    import pyarrow.parquet as pq
    columns = ['vehicle', 'verdict', 'period', 'duration_s', *(
        f'{name}{part}' for name in VALUES for part in ('', '_sigma'))]
    table = pq.ParquetFile(output / LEGS).read(columns=columns, use_threads=False)
    rates = kpi(vehicles, table.to_pylist(), limits)
    with locked(output):
        write_text(output / KPI, json.dumps(plain(rates), indent=2) + '\n')
    return _table_text(rates, output)


def _table_text(rates: dict[str, Any], output: Path) -> str:
    """Return the rates as lines of text: one for each duration of legs, and one for all."""
    counts = rates['vehicles']
    lines = ['', f'decisions on single legs of {counts["good"]} good and {counts["bad"]} bad '
             f'vehicles; excluded: {counts["on_the_limit"]} (undecided, or fewer than {MIN_LEGS} '
             'legs)',
             table_row(('minutes', 'legs', *(name.replace('_', ' ') for name in SHARES)),
                       KPI_WIDTHS)]
    for label, row in [*((f'up to {row["up_to"]:g}' if row['up_to'] else 'longer', row)
                         for row in rates['by_minutes']), ('all', rates['all'])]:
        cells = ('-' if row[k] is None else f'{100 * row[k]:.1f} %' for k in SHARES)
        lines.append(table_row((label, str(row['legs']), *cells), KPI_WIDTHS))
    return '\n'.join([*lines, f'written: {output / KPI}'])
