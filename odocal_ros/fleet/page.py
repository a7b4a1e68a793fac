# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fleet.html: one page that needs no network, for the owner of the fleet."""

from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from odocal_ros import __version__
from odocal_ros.fleet.population import LEAST, Population, population
from odocal_ros.fleet.second_stage import COMPARED, file_name
from odocal_ros.fleet.tables import LEGS
from odocal_ros.output.figures import with_sigma
from odocal_ros.output.summary import DEG
from odocal_ros.settings.levels import TYRE_SPREAD


def fleet_page(vehicles: Sequence[dict[str, Any]], output: Path) -> str:
    """Return the page of a fleet whose rows stand in ``output``, the worst vehicle first."""
    from jinja2 import Environment, StrictUndefined

    from odocal_ros.fleet.figures import fleet_figures
    template = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                           lstrip_blocks=True).from_string(
        (files('odocal_ros.fleet') / 'templates' / 'fleet.html').read_text(encoding='utf-8'))
    style = (files('odocal_ros.output') / 'templates' / 'report.css').read_text(encoding='utf-8')
    counts = Counter(row['decision'] or row['verdict'] for row in vehicles)
    most_rows = 2000    # vehicles in the table
    return template.render(
        style=style, title=output.resolve().name, facts=_facts(vehicles),
        counts=sorted(counts.items()), models=[_model(*one) for one in _models(vehicles)],
        figures=fleet_figures(vehicles, output / LEGS),
        vehicles=[_row(row) for row in vehicles[:most_rows]],
        left=max(0, len(vehicles) - most_rows)) + '\n'


def _facts(vehicles: Sequence[dict[str, Any]]) -> str:
    dates = [row[key] for row in vehicles for key in ('first', 'last') if row[key]]
    when = f', {min(dates):%Y-%m-%d} to {max(dates):%Y-%m-%d}' if dates else ''
    bags, failed, legs = (sum(row[key] for row in vehicles)
                          for key in ('bags', 'bags_failed', 'legs'))
    return (f'{len(vehicles)} vehicles, {bags} bags ({failed} failed), {legs} legs, '
            f'{sum(row["distance_km"] for row in vehicles):.0f} km in '
            f'{sum(row["driven_h"] for row in vehicles):.1f} h{when}; odocal_ros {__version__}')


def _models(vehicles: Sequence[dict[str, Any]]) -> list[tuple[str, str, list[dict[str, Any]]]]:
    """Return (model, unit of the scale, vehicles), what was rejected left out."""
    kinds: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in vehicles:
        if row['legs'] and row['verdict'] != 'rejected':
            kinds.setdefault((row['model'], row['unit']), []).append(row)
    return [(model, unit, rows) for (model, unit), rows in sorted(kinds.items())]


def _model(model: str, unit: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    cells = []
    for name in COMPARED:
        have = [row for row in rows if row[name] is not None]
        if not have:
            cells += ['-', '-']
            continue
        found = population(*(np.array([row[key] for row in have], float)
                             for key in (name, f'{name}_sigma')))
        few = len(have) < LEAST
        if name == 'scale_factor':
            cells += [f'{_mean(found, few)} {unit}',
                      '-' if few else f'{100 * found.spread / found.mean:.2f} %']
        else:
            cells += [_mean(found, few, DEG, signed=True),
                      '-' if few else f'{DEG * found.spread:.2f}']
    far = sorted(row['vehicle'] for row in rows if row['outlier'])
    return {'model': model, 'vehicles': len(rows), 'cells': cells, 'far': ', '.join(far[:20])
            + (f' and {len(far) - 20} more' if len(far) > 20 else '')}


def _mean(found: Population, few: bool, factor: float = 1.0, signed: bool = False) -> str:
    """Return the mean of a model, without its sigma if there are too few vehicles for one."""
    text = with_sigma(found.mean, found.sigma, factor, signed)
    return text.partition(' ±')[0] if few else text


def _row(row: dict[str, Any]) -> dict[str, Any]:
    values = [_cell(row, 'scale_factor', 1.0), _cell(row, 'yaw_mounting_angle', DEG),
              _cell(row, 'pitch_mounting_angle', DEG), _cell(row, 'drift_per_year', 100.0)]
    drawn = row['report'] == ''
    said = remarks(row)[1:]
    return {'vehicle': row['vehicle'], 'model': row['model'], 'cells': values,
            'judged': row['decision'] or row['verdict'],
            'legs': f'{row["legs_good"]} of {row["legs"]}', 'km': f'{row["distance_km"]:.1f}',
            'since': f'{row["since"]:%Y-%m-%d}' if row['since'] else '',
            'remarks': '; '.join(said + ([f'no report: {row["report"]}'] if row['report'] else
                                         [])),
            'link': f'reports/{quote(file_name(row["vehicle"]))}/report.html' if drawn else ''}


def _cell(row: dict[str, Any], name: str, factor: float) -> str:
    if row[name] is None:
        return '-'
    return with_sigma(row[name], row[f'{name}_sigma'], factor, signed=factor != 1.0)


def remarks(row: dict[str, Any]) -> list[str]:
    """Return the remarks on a vehicle."""
    out = [row['decision'] or row['verdict']]
    for change in json.loads(row['changes']):
        size = (f'{100 * change["size"]:+.2f} %' if change['value'] == 'scale_factor' else
                f'{DEG * change["size"]:+.2f} deg')
        odometer = change['value'] == 'scale_factor' and abs(change['size']) > TYRE_SPREAD
        out.append(f'{change["value"].replace("_", " ")} changed by {size} between '
                   f'{change["after"][:10]} and {change["by"][:10]}'
                   + ', too large for tyres: check the odometer' * odometer)
    if row['outlier']:
        out.append(f'{" and ".join(row["outlier"].split())} outlier of its model')
    if row['odd_legs']:
        out.append(f'outlier leg {", ".join(row["odd_legs"].split())}')
    if row['rejected_for']:
        since = f', all since {row["rejected_since"]:%Y-%m-%d}' if row['rejected_since'] else ''
        out.append(f'{row["legs"] - row["legs_good"]} of {row["legs"]} legs rejected '
                   f'({", ".join(row["rejected_for"].split())}){since}')
    if row['bags_failed']:
        out.append(f'{row["bags_failed"]} of {row["bags"]} bags failed ({row["failures"]})')
    return [*out, row['why']] if row['why'] else out
