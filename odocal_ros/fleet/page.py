# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fleet.html: the results of a fleet as one page that needs no network."""

from collections import Counter
from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from odocal_ros import __version__
from odocal_ros.fleet import tables
from odocal_ros.fleet.statistics import MIN_VEHICLES, MODEL_OUTLIER_SIGMAS, Population, population
from odocal_ros.output import plot_style as style
from odocal_ros.output.report import render_page
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import counted, MAIN_VALUES, with_sigma
from odocal_ros.settings.levels import TYRE_SPREAD

MAX_POINTS = 3000       # judgement: points of a figure; more are thinned, except outliers


def fleet_figures(vehicles: Sequence[dict[str, Any]], legs: Path) -> list[style.Drawing]:
    """Return each figure that has data."""
    figures = []
    with style.apply_style():
        for name in MAIN_VALUES:
            rows = [row for row in vehicles if row[name] is not None
                    and row[f'{MAIN_VALUES[name]}_deviate'] is not None]
            if rows:
                figures.append(_population_figure(name, rows))
        if history := _history_figure(vehicles, legs):
            figures.append(history)
    return figures


def _population_figure(name: str, rows: list[dict[str, Any]]) -> style.Drawing:
    """Draw each vehicle's deviation from the median of its model, one column for each model."""
    models = sorted({row['model'] for row in rows})
    figure, (ax,) = style.new_figure_column(2.8)
    is_scale, points = name == 'scale_factor', []
    for k, model in enumerate(models):
        same_model = [row for row in rows if row['model'] == model]
        x, sigma = (np.array([row[key] for row in same_model], float)
                    for key in (name, f'{name}_sigma'))
        outlier = np.array([MAIN_VALUES[name] in row['outlier'].split() for row in same_model])
        median = np.median(x)
        deviation, error = ((x / median - 1) * 100, sigma / median * 100) if is_scale else (
            (x - median) * DEG, sigma * DEG)
        keep = np.union1d(style.even_rows(len(x), MAX_POINTS // len(models)),
                          np.flatnonzero(outlier))
        position = k + 0.7 * (np.linspace(-0.5, 0.5, len(x)) if len(x) > 1 else np.zeros(1))
        for mask, colour in ((~outlier, style.BLUE), (outlier, style.RED)):
            shown = keep[mask[keep]]
            ax.errorbar(position[shown], deviation[shown], error[shown], fmt='o', ms=3, lw=0.8,
                        color=colour)
        points += [(position[i], deviation[i]) for i in keep]
    _limit_axis(ax, np.array(points))
    ax.set_xticks(range(len(models)), [model or 'no model' for model in models])
    ax.set_ylabel('deviation from the median, ' + ('%' if is_scale else 'deg'))
    return style.drawing(
        figure, f'population-{MAIN_VALUES[name]}',
        f'{name.replace("_", " ").capitalize()} by model',
        'One point per vehicle with its sigma; red: outlier of its model; arrow: beyond the axis.')


def _limit_axis(ax: Any, points: np.ndarray) -> None:
    """Limit the y axis to most points, (n, 2) x and y; draw others as arrows at the edge."""
    medians_in_half = 6.0    # half the height of the plot, in median distances from 0
    half_height = medians_in_half * float(np.median(np.abs(points[:, 1])))
    outside = np.abs(points[:, 1]) > 2 * half_height
    if not outside.any() or not half_height:
        return
    limit = 1.15 * max(half_height, float(np.abs(points[~outside, 1]).max()))
    ax.set_ylim(-limit, limit)
    for sign, arrow in ((1, '^'), (-1, 'v')):
        x = points[outside & (sign * points[:, 1] > 0), 0]
        ax.plot(x, np.full(len(x), sign * 0.95 * limit), arrow, ms=6, color=style.RED)


def _history_figure(vehicles: Sequence[dict[str, Any]], legs: Path) -> style.Drawing | None:
    """Draw the scale of legs over dates; vehicles that need inspection have a line each."""
    current = {row['vehicle']: row['scale_factor'] for row in vehicles if row['scale_factor']}
    max_lines = 6    # vehicles that are highlighted
    known = [row for row in vehicles if row['vehicle'] in current]
    changed = [row['vehicle'] for row in known if any(
        change['value'] == 'scale_factor' for change in json.loads(row['changes']))]
    highlighted = list(dict.fromkeys([*changed, *(
        row['vehicle'] for row in known if tables.needs_inspection(row))]))[:max_lines]
    points = _read_points(legs, set(current), set(highlighted))
    if not points:
        return None
    figure, (ax,) = style.new_figure_column(3.4)
    others = np.concatenate([np.empty((0, 2)), *(
        legs_of_vehicle[:, :2] / (1.0, current[vehicle])
        for vehicle, legs_of_vehicle in points.items() if vehicle not in highlighted)])
    ax.plot(others[:, 0].astype('datetime64[s]'), (others[:, 1] - 1) * 100, '.', ms=2.5,
            color=style.GREY, label='others')
    styles = [(colour, mark) for mark in 'os'
              for colour in (style.BLUE, style.RED, style.GREEN, style.PINK)]
    for vehicle, (colour, mark) in zip(highlighted, styles, strict=False):
        t, scale, sigma = np.array(sorted(points[vehicle].tolist())).T
        ax.errorbar(t.astype('datetime64[s]'), (scale / current[vehicle] - 1) * 100,
                    sigma / current[vehicle] * 100, fmt=f'{mark}-', ms=3.5, lw=1.0, color=colour,
                    label=vehicle[:18])
    ax.set_ylabel('deviation from the current scale, %')
    figure.autofmt_xdate(rotation=20, ha='right')
    figure.subplots_adjust(bottom=0.2, top=0.82)
    figure.legend(loc='upper center', borderaxespad=0.2, ncols=4, handlelength=1.4,
                  columnspacing=1.0)
    return style.drawing(figure, 'control', 'Scale over time',
                         'Legs relative to the current scale of their vehicle. Lines: vehicles '
                         'that changed or need inspection, the worst first.')


def _read_points(path: Path, known: set[str], highlighted: set[str]) -> dict[str, np.ndarray]:
    """
    Return s since 1970, scale and its sigma of legs, (n, 3), by vehicle.

    known : the vehicles to return; of those that are not highlighted, every n-th leg.
    """
    import pyarrow.parquet as pq
    columns = ['vehicle', 'start_ns', 'scale_factor', 'scale_factor_sigma', 'verdict']
    with pq.ParquetFile(path) as file:
        stride = max(1, file.metadata.num_rows // MAX_POINTS)
        rows = (row for batch in file.iter_batches(columns=columns, batch_size=10_000,
                                                   use_threads=False) for row in batch.to_pylist())
        points: dict[str, list[tuple[float, float, float]]] = {}
        for k, row in enumerate(rows, 1):
            vehicle = row['vehicle']
            if row['scale_factor'] is not None and row['verdict'] != 'rejected' \
                    and vehicle in known and (vehicle in highlighted or k % stride == 0):
                points.setdefault(vehicle, []).append((
                    row['start_ns'] / 1e9, row['scale_factor'], row['scale_factor_sigma'] or 0.0))
    return {vehicle: np.array(legs) for vehicle, legs in points.items()}


def fleet_page(vehicles: Sequence[dict[str, Any]], output: Path) -> str:
    """Return the page of a fleet with its rows in ``output``, the worst vehicle first."""
    counts = Counter(row['decision'] or row['verdict'] for row in vehicles)
    max_rows = 2000    # vehicles in the table
    return render_page(
        'fleet', 'fleet.html', title=output.resolve().name, facts=_facts(vehicles),
        counts=sorted(counts.items()), models=[_model_row(*kind, rows) for kind, rows in sorted(
            tables.group_by_model(row for row in vehicles if row['legs']).items())],
        figures=fleet_figures(vehicles, output / tables.LEGS),
        vehicles=[_vehicle_row(row) for row in vehicles[:max_rows]],
        not_shown=max(0, len(vehicles) - max_rows))


def _facts(vehicles: Sequence[dict[str, Any]]) -> str:
    """Return the line with the size of the fleet."""
    dates = [row[key] for row in vehicles for key in ('first', 'last') if row[key]]
    when = f', {min(dates):%Y-%m-%d} to {max(dates):%Y-%m-%d}' if dates else ''
    bags, failed, legs = (sum(row[key] for row in vehicles)
                          for key in ('bags', 'bags_failed', 'legs'))
    return (f'{counted(len(vehicles), "vehicle")}, {counted(bags, "bag")} ({failed} failed), '
            f'{counted(legs, "leg")}, '
            f'{sum(row["distance_km"] for row in vehicles):.0f} km in '
            f'{sum(row["driven_h"] for row in vehicles):.1f} h{when}; odocal_ros {__version__}')


def _model_row(model: str, unit: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a row of the table of models: mean and spread of each value, outliers."""
    cells = []
    for name in MAIN_VALUES:
        known = [row for row in rows if row[name] is not None]
        if not known:
            cells += ['-', '-']
            continue
        values = population(*(np.array([row[key] for row in known], float)
                              for key in (name, f'{name}_sigma')))
        has_few = len(known) < MIN_VEHICLES
        if name == 'scale_factor':
            cells += [f'{_mean_text(values, has_few)} {unit}',
                      '-' if has_few else f'{100 * values.spread / values.mean:.2f} %']
        else:
            cells += [_mean_text(values, has_few, DEG, signed=True),
                      '-' if has_few else f'{DEG * values.spread:.2f}']
    outliers = sorted(row['vehicle'] for row in rows if row['outlier'])
    others_text = f' and {len(outliers) - 20} more' if len(outliers) > 20 else ''
    return {'model': model, 'vehicles': len(rows), 'cells': cells,
            'outliers': ', '.join(outliers[:20]) + others_text}


def _mean_text(values: Population, has_few: bool, factor: float = 1.0,
               signed: bool = False) -> str:
    """Return the mean of a model as text, without sigma if there are too few vehicles."""
    text = with_sigma(values.mean, values.sigma, factor, signed)
    return text.partition(' ±')[0] if has_few else text


def _vehicle_row(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of the table of vehicles as text."""
    values = [_cell(row, 'scale_factor', 1.0), _cell(row, 'yaw_mounting_angle', DEG),
              _cell(row, 'pitch_mounting_angle', DEG), _cell(row, 'drift_per_year', 100.0)]
    report_error = [f'no report: {row["report"]}'] if row['report'] else []
    return {'vehicle': row['vehicle'], 'model': row['model'], 'cells': values,
            'verdict': row['decision'] or row['verdict'],
            'legs': f'{row["legs_good"]} of {row["legs"]}', 'km': f'{row["distance_km"]:.1f}',
            'since': f'{row["since"]:%Y-%m-%d}' if row['since'] else '',
            'remarks': '; '.join(remarks(row)[1:] + report_error),
            'link': f'reports/{quote(tables.folder_name(row["vehicle"]))}/report.html'
                    if row['report'] == '' else ''}


def _cell(row: dict[str, Any], name: str, factor: float) -> str:
    """Return a value of a row with its sigma, times the factor to the printed unit, as text."""
    if row[name] is None:
        return '-'
    return with_sigma(row[name], row[f'{name}_sigma'], factor, signed=factor != 1.0)


def remarks(row: dict[str, Any]) -> list[str]:
    """Return the verdict on a vehicle, and the findings that need inspection as sentences."""
    texts = [row['decision'] or row['verdict']]
    for change in json.loads(row['changes']):
        size = (f'{100 * change["size"]:+z.2f} %' if change['value'] == 'scale_factor' else
                f'{DEG * change["size"]:+z.2f} deg')
        is_too_large = change['value'] == 'scale_factor' and abs(change['size']) > TYRE_SPREAD
        texts.append(f'{change["value"].replace("_", " ")} changed by {size} between '
                     f'{change["after"][:10]} and {change["by"][:10]}'
                     + (f', more than tyres explain ({100 * TYRE_SPREAD:g} %): check the odometer'
                        * is_too_large))
    if row['outlier']:
        texts.append('outlier among the vehicles of its model (limit '
                     f'{MODEL_OUTLIER_SIGMAS:g} sigma): {", ".join(row["outlier"].split())}')
    if row['odd_legs']:
        texts.append(f'outlier legs: {", ".join(row["odd_legs"].split())}')
    if row['rejected_for'] and not (row['rejected_since'] and row['why']):    # else stated there
        since = f', all since {row["rejected_since"]:%Y-%m-%d}' if row['rejected_since'] else ''
        texts.append(f'{row["legs"] - row["legs_good"]} of {row["legs"]} legs rejected '
                     f'({", ".join(row["rejected_for"].split())}){since}')
    if row['bags_failed']:
        texts.append(f'{row["bags_failed"]} of {row["bags"]} bags failed ({row["failures"]})')
    return [*texts, row['why']] if row['why'] else texts
