# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The picture of odocal paper: the track of figure 1, and the growth of each error."""

from pathlib import Path
from typing import Any

import numpy as np

from odocal_reproductions.paper.tables import PaperTables
from odocal_ros.output.plot_style import new_figure, save_figure

# Okabe and Ito's colours, distinguishable with colour blindness
STYLES = {'phi_U0': ('#0072B2', '-'), 'all': ('#000000', '--'), 'eps_z': ('#D55E00', '-'),
          'phi_E0': ('#009E73', '-'), 'phi_N0': ('#CC79A7', '-'), 'eps_x': ('#E69F00', '-'),
          'eps_y': ('#56B4E9', '--')}
LABELS = {'phi_U0': r'$\phi_{U0}$ = 3.6′', 'all': 'all errors',
          'eps_z': r'$\varepsilon_z$ = 0.01 °/h', 'phi_E0': r'$\phi_{E0}$ = 0.5′',
          'phi_N0': r'$\phi_{N0}$ = 0.5′', 'eps_x': r'$\varepsilon_x$ = 0.01 °/h',
          'eps_y': r'$\varepsilon_y$ = 0.01 °/h'}
GRID = {'color': '0.88', 'linewidth': 0.6}


def draw(tables: PaperTables, path: Path) -> None:
    """Draw the drive of the tables into a file; BadUsage if it cannot be written."""
    figure = new_figure(12.0, 6.6)
    grid = figure.add_gridspec(1, 2, width_ratios=(0.82, 1.0))
    left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    _track(left.subplots(), tables)
    upper, lower = right.subplots(2, 1, sharex=True)
    _growth(upper, lower, tables)
    figure.legend(*upper.get_legend_handles_labels(), loc='outside lower center', ncols=4,
                  frameon=False, fontsize=9, title='Error source and final yaw error of the '
                  'pipeline (estimate - truth)', title_fontsize=9)
    save_figure(figure, path)


def _track(axes: Any, tables: PaperTables) -> None:
    """Draw figure 1: reference, dead reckoning as configured, and calibrated."""
    result = tables.outcomes['all'].result
    reference, before, after = (p[:, :2] / 1000 for p in (
        result.reference_n, result.track_before_n, result.track_n) if p is not None)
    axes.plot(*reference.T, color='0.75', linewidth=6, solid_capstyle='round',
              label='reference (fixes)')
    axes.plot(*before.T, color='#D55E00', linewidth=1.6, label='dead reckoning as configured')
    axes.plot(*after.T, color='#0072B2', linewidth=1.6, label='dead reckoning, calibrated')
    for name, point, offset in (('O', reference[0], (8, -12)), ('B', reference[-1], (12, -10)),
                                ('B′', before[-1], (-18, 2))):
        axes.plot(*point, 'o', color='black', markersize=4, zorder=5)
        axes.annotate(name, point, xytext=offset, textcoords='offset points', fontsize=12)
    axes.set(title='Track (figure 1 of the paper), all errors on', xlabel='east, km',
             ylabel='north, km', aspect='equal')
    axes.margins(0.07)
    axes.grid(**GRID)
    axes.legend(loc='upper left', frameon=False, fontsize=9)


def _growth(upper: Any, lower: Any, tables: PaperTables) -> None:
    """Draw yaw and position error by time: lines by the error model, dots by the pipeline."""
    for source, (colour, dash) in STYLES.items():
        growth = tables.growths[source]
        yaw_deg = tables.table_3[source].yaw_deg.value
        style = {'color': colour, 'linestyle': dash, 'linewidth': 1.5}
        label = f'{LABELS[source]}: {yaw_deg:+.2e}°'.replace('-', '\N{MINUS SIGN}')
        upper.plot(growth.t, np.abs(np.rad2deg(growth.yaw)), label=label, **style)
        lower.plot(growth.t, np.where(np.abs(growth.across) > 0, np.abs(growth.across), np.nan),
                   **style)
        upper.plot(growth.t[-1] + 8, abs(yaw_deg), marker='o', markersize=4, color=colour,
                   clip_on=False)
    upper.axhline(tables.noise_deg, color='0.5', linewidth=0.8, linestyle=':')
    upper.annotate('gyro noise of the whole drive, 1 σ', (395, tables.noise_deg * 1.15),
                   fontsize=8, color='0.35')
    upper.set(yscale='log', ylabel='yaw error, deg', ylim=(1e-7, 0.3),
              title='Yaw mounting error if the leg ended at this time (lines: error model, dots: '
              'pipeline)')
    lower.set(yscale='log', ylabel='across the track, m', xlabel='time since the standstill, s',
              ylim=(1e-5, 30), title='Position error of dead reckoning', xlim=(0, 640))
    for axes in (upper, lower):
        axes.title.set_fontsize(10)
        axes.grid(**GRID)
