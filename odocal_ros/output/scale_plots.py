# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the scale: against speed, by window, and legs and methods side by side."""

import math
from typing import Any

import numpy as np

from odocal_ros.calib.number_text import relative_unit
from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.calib.scale_variation import SpeedScale
from odocal_ros.data.arrays import Floats
from odocal_ros.output import plot_style as style
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import ANGLES, finite_estimate, with_sigma

STYLES = (('o', style.BLUE), ('s', style.RED), ('^', style.GREEN), ('D', style.PINK),
          ('v', 'black'), ('P', style.GREY))
MAX_LEGS = 40    # judgement: bars that are distinguishable in a picture
# title, (text, method, value, sigma) of each value, band of the result: middle and half width
Panel = tuple[str, list[tuple[str, str, float, float]], tuple[float, float] | None]


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
    ax.set(xlabel='speed, km/h', ylabel='path by fixes / odometer')
    ax.ticklabel_format(axis='y', useOffset=False)


def fit_text(scale: SpeedScale) -> str:
    """Return the fit in words; '' if the speeds of the leg do not determine it."""
    if not (scale.factor and scale.offset and scale.lag):
        return ''
    offset, lag = scale.offset, scale.lag
    low = 'low' if offset[0] > 0 else 'high'
    later = 'later' if lag[0] > 0 else 'earlier'
    return (f'Fit: scale factor {with_sigma(*scale.factor)}; the odometer reads '
            f'{with_sigma(abs(offset[0]), offset[1])} m/s {low} and is '
            f'{with_sigma(abs(lag[0]), lag[1])} s {later} than the fixes')


def by_speed(scale: SpeedScale, name: str) -> style.Drawing:
    """Return the figure of a leg: title, description, svg element."""
    figure, (ax,) = style.new_figure_column(2.7)
    draw_by_speed(ax, scale)
    style.add_legend(figure, ax)
    fit = fit_text(scale) or 'No fit: the speed varies too little'
    text = ('Path length from the fixes divided by that of the raw odometer. Each point is a '
            'group of sections of a few seconds. A constant factor gives a horizontal line. '
            f'{fit}.')
    return 'Scale against speed', text, style.svg(figure, f'{name}-by-speed', text)


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
    picture = style.svg(figure, f'{name}-by-window', text)
    return 'Scale against the length of the window', text, picture


def comparison_figure(calibration: Calibration, name: str) -> list[style.Drawing]:
    """Draw scale, yaw and pitch by method and leg; empty for single values."""
    rows = [(f'all legs, {m.replace("_", " ")}', m, method.estimates)
            for m, method in calibration.methods.items()] if len(calibration.legs) > 1 else []
    for number, leg in list(enumerate(calibration.legs, 1))[-MAX_LEGS:]:
        rows += [(f'leg {number}, {m.replace("_", " ")}', m, method.estimates)
                 for m, method in leg.methods.items()]
    panels = [(title, points, band) for title, points, band in (
        _scale_panel(calibration, rows),
        *(_angle_panel(calibration, rows, angle) for angle in ANGLES)) if len(points) > 1]
    return [_draw_panels(panels, name, len(calibration.legs))] if panels else []


def _scale_panel(calibration: Calibration,
                 rows: list[tuple[str, str, dict[str, Estimate]]]) -> Panel:
    """Return the panel of scales, rows of (text, method, estimates), relative to the result."""
    result = finite_estimate(calibration.estimates, 'scale_factor')
    points = [(text, method, e.value / result.value - 1, (e.sigma or 0.0) / abs(result.value))
              for text, method, e in ((text, method, finite_estimate(estimates, 'scale_factor'))
                                      for text, method, estimates in rows)
              if e.value is not None and result.value]
    factor, unit = relative_unit(max((abs(x) + sigma for _, _, x, sigma in points), default=0.0))
    band = (0.0, (result.sigma or 0.0) / abs(result.value) * factor) if result.value else None
    return f'scale minus result, {unit}', [
        (text, method, x * factor, sigma * factor) for text, method, x, sigma in points], band


def _angle_panel(calibration: Calibration, rows: list[tuple[str, str, dict[str, Estimate]]],
                 name: str) -> Panel:
    """Return the panel of a mounting angle, deg."""
    result = finite_estimate(calibration.estimates, name)
    points = []
    for text, method, estimates in rows:
        e = finite_estimate(estimates, name)
        if e.value is not None:
            points.append((text, method, e.value * DEG, (e.sigma or 0.0) * DEG))
    band = None if result.value is None else (result.value * DEG, (result.sigma or 0.0) * DEG)
    return f'{ANGLES[name]} mounting angle, deg', points, band


def _draw_panels(panels: list[Panel], name: str, legs: int) -> style.Drawing:
    heights = [0.24 * len(points) for _, points, _ in panels]
    height = sum(heights) + 0.75 * len(panels)
    figure, axes = style.new_figure_column(height, len(panels), sharex=False, heights=heights)
    figure.subplots_adjust(left=0.27, hspace=0.75 * len(panels) / sum(heights),
                           top=1 - 0.1 / height)
    methods = dict.fromkeys(m for _, points, _ in panels for _, m, _, _ in points)
    shapes = {m: STYLES[i % len(STYLES)] for i, m in enumerate(methods)}
    for ax, (title, points, band) in zip(axes, panels, strict=True):
        if band is not None and all(map(math.isfinite, band)):
            ax.axvspan(band[0] - band[1], band[0] + band[1], color=style.BAND, linewidth=0)
            ax.axvline(band[0], color=style.GREY, linewidth=0.8)
        for row, (_, method, value, sigma) in enumerate(points):
            shape, colour = shapes[method]
            ax.errorbar(value, row, xerr=sigma, fmt=shape, color=colour, markersize=5,
                        capsize=3, linewidth=1.1)
        ax.set_yticks(range(len(points)), [text for text, *_ in points])
        ax.set_ylim(len(points) - 0.5, -0.5)
        ax.set_xlabel(title)
    text = 'Bars: one sigma to each side; grey band: the result.' + (
        ' Legs share some errors (heading source, lever arms), so bars may overlap more than '
        'random errors would.' if legs > 1 else '') + (
        f' Of {legs} legs, the newest {MAX_LEGS}.' if legs > MAX_LEGS else '')
    return 'Side by side', text, style.svg(figure, f'{name}-compared', text)
