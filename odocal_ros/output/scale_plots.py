# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the scale: against speed, by window, and legs and methods side by side."""

from typing import Any, NamedTuple

import numpy as np

from odocal_ros.calib.number_text import relative_unit
from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.calib.speed_scale import SpeedScale
from odocal_ros.data.arrays import Floats
from odocal_ros.output import plot_style as style
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import ANGLES, finite_estimate, MAIN_VALUES, with_sigma

STYLES = (('o', style.BLUE), ('s', style.RED), ('^', style.GREEN), ('D', style.PINK),
          ('v', 'black'), ('P', style.GREY))
MAX_LEGS = 40    # judgement: bars that are distinguishable in a picture


class MethodEstimates(NamedTuple):
    """The estimates of a method from one leg or all."""

    label: str
    method: str
    estimates: dict[str, Estimate]


class Point(NamedTuple):
    """A value with its sigma, in the unit of a panel."""

    label: str
    method: str
    value: float
    sigma: float


class Panel(NamedTuple):
    """Values of one quantity side by side."""

    title: str
    points: list[Point]
    band: tuple[float, float] | None      # value and sigma of the result


def draw_by_speed(ax: Any, scale: SpeedScale) -> None:
    """Draw on axes the ratio of fixes to odometer by speed, and the fit."""
    speed, ratio, sigma, _ = scale.bins.T
    ax.errorbar(3.6 * speed, ratio, sigma, fmt='o', color=style.BLUE, markersize=4.5, capsize=3,
                linewidth=1.1, label='fixes / odometer as sent, ± sigma')
    if scale.factor and scale.offset:
        v = np.linspace(speed.min(), speed.max(), 100)
        # v = factor * odometer + offset, so v / odometer = factor v / (v - offset)
        fit = scale.factor[0] * v / (v - scale.offset[0])
        ax.plot(3.6 * v, fit, '-', color=style.RED, linewidth=1.2, label='fit')
        ax.axhline(scale.factor[0], color=style.GREY, linewidth=0.8, linestyle='--',
                   label='factor')
    ax.set(xlabel='speed, km/h', ylabel='path from fixes / odometer')
    ax.ticklabel_format(axis='y', useOffset=False)


def fit_text(scale: SpeedScale) -> str:
    """Return the fit as a sentence, '' if the speeds of the leg do not determine it."""
    if not (scale.factor and scale.offset and scale.lag):
        return ''
    offset, lag = scale.offset, scale.lag
    low = 'low' if offset[0] > 0 else 'high'
    later = 'later' if lag[0] > 0 else 'earlier'
    return (f'Fit: scale factor {with_sigma(*scale.factor)}; the odometer reads '
            f'{with_sigma(abs(offset[0]), offset[1])} m/s {low} and is '
            f'{with_sigma(abs(lag[0]), lag[1])} s {later} than the fixes')


def by_speed(scale: SpeedScale, name: str) -> style.Drawing:
    figure, (ax,) = style.new_figure_column(2.7)
    draw_by_speed(ax, scale)
    style.add_legend(figure, ax)
    fit = fit_text(scale) or 'No fit: the speed varies too little'
    text = ('Path length from the fixes divided by that of the raw odometer. Each point is a '
            'group of sections of a few seconds. A constant factor gives a horizontal line. '
            f'{fit}.')
    return style.drawing(figure, f'{name}-by-speed', 'Scale against speed', text)


def by_window(windows: Floats, name: str) -> style.Drawing:
    """Return the figure of the scale by windows, (w, 4): s, ratio - 1, its sigma, ignored."""
    length, excess, sigma, _ = windows.T
    figure, (ax,) = style.new_figure_column(2.7)
    ax.axhline(0.0, color=style.GREY, linewidth=0.8, linestyle='--')
    ax.errorbar(length, 100 * excess, 100 * sigma, fmt='o-', color=style.BLUE, markersize=4.5,
                capsize=3, linewidth=1.1)
    ax.set(xscale='log', xlabel='length of the window, s', ylabel='fixes / track - 1, %')
    ax.set_xticks(length, [f'{x:g}' for x in length], minor=False)
    ax.set_xticks([], minor=True)
    text = ('Ratio of displacements, fixes to calibrated track, minus 1, in windows of seconds to '
            'minutes. Bars: one sigma, from the scatter over eight parts of the leg. A horizontal '
            'line at 0 shows that fix errors do not depend on the motion. If short windows '
            'differ, the fixes contain an odometer, or are filtered or late.')
    return style.drawing(figure, f'{name}-by-window', 'Scale in time windows of different length',
                         text)


def comparison_figure(calibration: Calibration, name: str) -> list[style.Drawing]:
    """Draw scale, yaw and pitch by method and leg; empty for single values."""
    legs = [(f'leg {number}', leg.methods) for number, leg in enumerate(calibration.legs, 1)]
    both = [('all legs', calibration.methods)] * (len(legs) > 1) + legs[-MAX_LEGS:]
    rows = [MethodEstimates(f'{label}, {method.replace("_", " ")}', method, values.estimates)
            for label, methods in both for method, values in methods.items()]
    panels = [panel for parameter in MAIN_VALUES
              if len((panel := _panel(calibration, rows, parameter)).points) > 1]
    return [_draw_panels(panels, name, len(calibration.legs))] if panels else []


def _panel(calibration: Calibration, rows: list[MethodEstimates], name: str) -> Panel:
    """Return the panel of a mounting angle, deg, or of the scale relative to the result."""
    result = finite_estimate(calibration.estimates, name)
    known = [(row, estimate) for row in rows
             if (estimate := finite_estimate(row.estimates, name)).value is not None]
    if name in ANGLES:
        title, factor = f'{ANGLES[name]} mounting angle, deg', DEG
        points = [Point(row.label, row.method, angle.value or 0.0, angle.sigma or 0.0)
                  for row, angle in known]
        band = None if result.value is None else (result.value * DEG, (result.sigma or 0.0) * DEG)
    elif result.value:
        points = [Point(row.label, row.method, (scale.value or 0.0) / result.value - 1,
                        (scale.sigma or 0.0) / abs(result.value)) for row, scale in known]
        factor, unit = relative_unit(max((abs(point.value) + point.sigma for point in points),
                                         default=0.0))
        title = f'scale minus result, {unit}'
        band = 0.0, (result.sigma or 0.0) / abs(result.value) * factor
    else:
        return Panel('', [], None)
    return Panel(title, [point._replace(value=point.value * factor, sigma=point.sigma * factor)
                         for point in points], band)


def _draw_panels(panels: list[Panel], name: str, legs: int) -> style.Drawing:
    heights = [0.24 * len(panel.points) for panel in panels]
    height = sum(heights) + 0.75 * len(panels)
    figure, axes = style.new_figure_column(height, len(panels), sharex=False, heights=heights)
    figure.subplots_adjust(left=0.27, hspace=0.75 * len(panels) / sum(heights),
                           top=1 - 0.1 / height)
    methods = dict.fromkeys(point.method for panel in panels for point in panel.points)
    styles = {method: STYLES[i % len(STYLES)] for i, method in enumerate(methods)}
    for ax, panel in zip(axes, panels, strict=True):
        if panel.band is not None:
            value, sigma = panel.band
            ax.axvspan(value - sigma, value + sigma, color=style.BAND, linewidth=0)
            ax.axvline(value, color=style.GREY, linewidth=0.8)
        for row, point in enumerate(panel.points):
            marker, colour = styles[point.method]
            ax.errorbar(point.value, row, xerr=point.sigma, fmt=marker, color=colour, markersize=5,
                        capsize=3, linewidth=1.1)
        ax.set_yticks(range(len(panel.points)), [point.label for point in panel.points])
        ax.set_ylim(len(panel.points) - 0.5, -0.5)
        ax.set_xlabel(panel.title)
    text = 'Bars: one sigma to each side; grey band: the result.' + (
        ' Legs share some errors (heading source, lever arms), so bars may overlap more than '
        'random errors would.' if legs > 1 else '') + (
        f' Of {legs} legs, the newest {MAX_LEGS}.' if legs > MAX_LEGS else '')
    return style.drawing(figure, f'{name}-compared', 'Side by side', text)
