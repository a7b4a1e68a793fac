# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pictures of a calibration: a map of its legs, drawn offline, and its scale against speed."""

import math
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.calib.speed_scale import LONGEST_CELL, MIN_CELLS, SHORTEST_CELL, SpeedScale
from odocal_ros.errors import BadUsage
from odocal_ros.library.series import Series
from odocal_ros.output.plot_style import apply_style, BLUE, GREY, new_figure, RED, save_figure
from odocal_ros.output.program_files import features

MAX_POINTS = 400     # judgement: points of a line, or fixes, for a small file
NOT_ON_A_MAP = ('the positions are in a local frame, which has no place on a map; use '
                'trajectory.csv or trajectory.tum')
# estimates of SpeedScale and their units in the names of columns
FIT_UNITS = {'factor': 'm_per_unit', 'offset': 'm_per_s', 'lag': 's'}


def draw_map(result: Calibration, path: Path) -> None:
    """Write the features as a picture; BadUsage: the positions are in a local frame."""
    shapes = [feature for number, leg in enumerate(result.legs, 1)
              for feature in features(number, leg, MAX_POINTS)]
    if not shapes:
        raise BadUsage(f'export: {path}: {NOT_ON_A_MAP}')
    with apply_style():
        save_figure(map_figure(shapes), path)


def map_figure(shapes: list[dict[str, Any]]) -> Any:
    """Return the figure of features of GeoJSON, with the same scale in both directions."""
    figure = new_figure(6.0, 4.8)
    ax = figure.add_subplot(facecolor='#eef1ea')
    for shape in shapes:
        _draw_feature(ax, shape)
    _add_map_scale(ax)
    return figure


def _draw_feature(ax: Any, shape: dict[str, Any]) -> None:
    """Draw one feature; each kind is labelled once."""
    kind, geometry = shape['properties']['kind'], shape['geometry']
    style: dict[str, Any] = {
        'corrected': {'color': BLUE, 'linewidth': 1.6, 'zorder': 4},
        'as_configured': {'color': RED, 'linestyle': '--', 'linewidth': 1.1, 'zorder': 3},
        'fixes': {'color': GREY, 'linestyle': '', 'marker': '.', 'markersize': 4, 'zorder': 2},
        'mark': {'color': 'black', 'linestyle': '', 'marker': 'o', 'markersize': 5, 'zorder': 5}}
    lines = geometry['coordinates'] if geometry['type'] == 'MultiLineString' else [
        geometry['coordinates']]
    for line in lines:
        longitude, latitude = np.atleast_2d(np.array(line, float))[:, :2].T
        drawn_labels = ax.get_legend_handles_labels()[1]
        label = {'as_configured': 'as configured', 'mark': 'start and stop'}.get(kind, kind)
        ax.plot(longitude, latitude, label=None if label in drawn_labels else label, **style[kind])


def _add_map_scale(ax: Any) -> None:
    """Add a graticule and a scale bar to axes in degrees, and set their aspect ratio."""
    from pyproj import Geod
    ax.margins(0.08)
    south, north = ax.get_ylim()
    ax.set_aspect(1 / math.cos(math.radians((south + north) / 2)), adjustable='datalim')
    ax.figure.canvas.draw()       # datalim: the final limits
    (west, east), (south, north) = ax.get_xlim(), ax.get_ylim()
    _, _, width = Geod(ellps='WGS84').inv(west, south, east, south)
    lengths = [step * 10.0**power for power in range(-1, 7) for step in (1, 2, 5)]      # m
    bar = max([length for length in lengths if length <= width / 3], default=lengths[0])
    x, y = west + 0.04 * (east - west), south + 0.05 * (north - south)
    ax.plot([x, x + bar / width * (east - west)], [y, y], color='black', linewidth=3,
            solid_capstyle='butt')
    ax.text(x, y + 0.012 * (north - south), f'{bar / 1000:g} km' if bar >= 1000 else f'{bar:g} m')
    ax.grid(color='white', linewidth=1.2)
    ax.ticklabel_format(useOffset=False, style='plain')
    ax.locator_params(nbins=5)
    ax.set(xlabel='longitude, deg', ylabel='latitude, deg')
    ax.figure.legend(loc='outside upper center', ncols=4)


def _legs_with_speed_scale(result: Calibration) -> list[tuple[int, SpeedScale]]:
    """Return (number, scale against speed) of the legs that have one; BadUsage without any."""
    legs = [(number, leg.evidence.by_speed) for number, leg in enumerate(result.legs, 1)
            if leg.evidence is not None and len(leg.evidence.by_speed.bins)]
    if not legs:
        raise BadUsage('cannot plot scale against speed: no leg has enough straight sections '
                       f'in motion (required: {MIN_CELLS}, each of {SHORTEST_CELL:g} to '
                       f'{LONGEST_CELL:g} s)')
    return legs


def scale_by_speed(result: Calibration) -> Series:
    """
    Return the scale against speed, one row per leg and group of sections.

    speed_m_per_s, ratio, ratio_sigma : path by the fixes over the raw odometer.   sections :
    in the group.   factor, offset, lag with sigma : of the leg's fit; NaN if not determined.

    Raises BadUsage: no leg has enough sections.
    """
    parts = []
    for number, speed_scale in _legs_with_speed_scale(result):
        n = len(speed_scale.bins)
        columns = {'leg': np.full(n, number)} | dict(zip(
            ('speed_m_per_s', 'ratio', 'ratio_sigma'), speed_scale.bins.T[:3], strict=True))
        columns['sections'] = speed_scale.bins[:, 3].astype(int)
        for name, unit in FIT_UNITS.items():
            value, sigma = getattr(speed_scale, name) or (np.nan, np.nan)
            columns |= {f'{name}_{unit}': np.full(n, value),
                        f'{name}_sigma_{unit}': np.full(n, sigma)}
        parts.append(columns)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def draw_scale_by_speed(result: Calibration, path: Path) -> None:
    """Write the picture of each leg's scale against speed, one above the other."""
    from odocal_ros.output.scale_plots import draw_by_speed, fit_text
    max_legs = 8     # in one picture, the newest
    legs = _legs_with_speed_scale(result)[-max_legs:]
    figure = new_figure(7.0, 3.2 * len(legs))
    axes = figure.subplots(len(legs), 1, squeeze=False)[:, 0]
    for ax, (number, speed_scale) in zip(axes, legs, strict=True):
        draw_by_speed(ax, speed_scale)
        title = [f'Scale against speed, leg {number}', *wrap(fit_text(speed_scale), 90)]
        ax.set_title('\n'.join(title), fontsize=8)
        ax.legend(frameon=False, fontsize=8)
    save_figure(figure, path)
