# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The picture of odocal patent: mean distances of 441 combinations, and of each line."""

from pathlib import Path
from typing import Any

import numpy as np

from odocal_reproductions.patent.embodiment import Embodiment, LEVELS, RADIUS_STEP
from odocal_ros.output.plot_style import new_figure, save_figure

# marker and colour (Okabe and Ito) by the first words of a line's name
MARKS = {'printed as best': ('*', '#D55E00'), 'printed': ('x', 'black'),
         'best of all': ('s', '#009E73'), 'response surface': ('o', '#E69F00'),
         'least squares': ('+', '#CC79A7'), 'truth': ('D', 'none')}


def draw(table: Embodiment, path: Path) -> None:
    """Draw a table into a file; BadUsage if it cannot be written."""
    figure = new_figure(12.0, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.1))
    _draw_grid(figure, left, table)
    _draw_lines(right, table)
    save_figure(figure, path)


def _draw_grid(figure: Any, axes: Any, table: Embodiment) -> None:
    """Draw the mean distance over the errors of both radii, each with its best heading."""
    mm = 1000.0
    levels = (np.arange(LEVELS[0]) - LEVELS[0] // 2) * RADIUS_STEP * mm
    mesh = axes.pcolormesh(levels, levels, table.mean_distance.T, shading='nearest',
                           cmap='viridis', norm='log')
    figure.colorbar(mesh, ax=axes, label='mean distance between track and fixes, m')
    edge, outside = 1.2 * levels[-1], []
    for name, (marker, colour) in MARKS.items():
        rows = [row for row in table.rows if row.name.startswith(name) and (
            name != 'printed' or 'best' not in row.name)]
        x, y = (mm * np.array([getattr(row, side) for row in rows]) for side in ('left', 'right'))
        if (np.abs([x, y]) > edge).any():
            outside.append(name)
        hollow = colour == 'none'
        axes.scatter(x, y, marker=marker, c=colour, s=200 if hollow else 70, label=name, zorder=3,
                     **({} if marker in 'x+' else {'edgecolors': 'white' if hollow else 'black'}))
    axes.set(title='All 441 combinations', xlabel='left radius error, mm', aspect='equal',
             ylabel='right radius error, mm', xlim=(-edge, edge), ylim=(-edge, edge))
    if outside:
        axes.text(0.02, 0.02, f'outside the plot: {", ".join(outside)}', fontsize=8,
                  transform=axes.transAxes)
    figure.legend(*axes.get_legend_handles_labels(), loc='outside lower left', ncols=6,
                  facecolor='0.75', fontsize=9)


def _draw_lines(axes: Any, table: Embodiment) -> None:
    """Draw mean and largest distance of each line of the table."""
    names = [f'{table.rows[k - 1].name}, {row.name.strip()}' if row.name.startswith(' ')
             else row.name for k, row in enumerate(table.rows)]
    positions = np.arange(len(names))
    for criterion, colour in (('max', '#56B4E9'), ('mean', '#0072B2')):
        axes.barh(positions, [row.criteria[criterion] for row in table.rows], color=colour,
                  height=0.8 if criterion == 'max' else 0.45, label=criterion)
    axes.set(xscale='log', xlabel='distance between track and fixes, m',
             title='Each line of the table')
    axes.set_yticks(positions, names, fontsize=9)
    axes.invert_yaxis()
    axes.grid(axis='x', color='0.88', linewidth=0.6)
    axes.legend(frameon=False, fontsize=9)
