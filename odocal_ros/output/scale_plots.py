# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Figures of the scale: against speed, by window, and legs and methods side by side."""

import math
from typing import Any

import numpy as np

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.calib.scale_variation import SpeedScale
from odocal_ros.data.arrays import Floats
from odocal_ros.output import plot_style as style
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import ANGLES, known, with_sigma

STYLES = (('o', style.BLUE), ('s', style.RED), ('^', style.GREEN), ('D', style.PINK),
          ('v', 'black'), ('P', style.GREY))
MOST_LEGS = 40    # judgement: bars that are distinguishable in a picture
# title, (text, method, value, sigma) of each value, band of the result: middle and half width
Panel = tuple[str, list[tuple[str, str, float, float]], tuple[float, float] | None]


def draw_by_speed(ax: Any, found: SpeedScale) -> None:
    """Draw on axes the ratio of fixes to odometer by speed, and the fit."""
    speed, ratio, sigma, _ = found.bins.T
    ax.errorbar(3.6 * speed, ratio, sigma, fmt='o', color=style.BLUE, markersize=4.5, capsize=3,
                linewidth=1.1, label='fixes / odometer as sent, ± sigma')
    if found.factor and found.offset:
        v = np.linspace(speed.min(), speed.max(), 100)
        # reference = factor * odometer + offset, divided by the odometer
        fit = found.factor[0] * v / (v - found.offset[0])
        ax.plot(3.6 * v, fit, '-', color=style.RED, linewidth=1.2, label='fit')
        ax.axhline(found.factor[0], color=style.GREY, linewidth=0.8, linestyle='--',
                   label='factor')
    ax.set(xlabel='speed, km/h', ylabel='path by fixes / odometer')
    ax.ticklabel_format(axis='y', useOffset=False)


def fit_text(found: SpeedScale) -> str:
    """Return the fit in words; '' if the speeds of the leg do not determine it."""
    if not (found.factor and found.offset and found.lag):
        return ''
    offset, lag = found.offset, found.lag
    low = 'low' if offset[0] > 0 else 'high'
    delay = 'later' if lag[0] > 0 else 'earlier'
    return (f'Fit: factor {with_sigma(*found.factor)}; the odometer reads '
            f'{with_sigma(abs(offset[0]), offset[1])} m/s {low} and is '
            f'{with_sigma(abs(lag[0]), lag[1])} s {delay} than the fixes')


def by_speed(found: SpeedScale, name: str) -> style.Drawing:
    """Return the figure of a leg: title, description, svg element."""
    figure, (ax,) = style.new_figure_column(2.7)
    draw_by_speed(ax, found)
    style.add_legend(figure, ax)
    fit = fit_text(found) or 'No fit: the speed varies too little'
    text = ('Path length from the fixes divided by that of the raw odometer. Each point is a '
            'group of sections of a few seconds. A constant factor gives a level line. '
            f'{fit}.')
    return 'Scale against speed', text, style.svg(figure, f'{name}-by-speed', text)


def by_window(found: Floats, name: str) -> style.Drawing:
    """Return the figure of the scale by windows of a leg, as ``by_speed``; found : (w, 4)."""
    length, excess, sigma, _ = found.T
    figure, (ax,) = style.new_figure_column(2.7)
    ax.axhline(0.0, color=style.GREY, linewidth=0.8, linestyle='--')
    ax.errorbar(length, 100 * excess, 100 * sigma, fmt='o-', color=style.BLUE, markersize=4.5,
                capsize=3, linewidth=1.1)
    ax.set(xscale='log', xlabel='length of the window, s', ylabel='fixes / track - 1, %')
    ax.set_xticks(length, [f'{x:g}' for x in length], minor=False)
    ax.set_xticks([], minor=True)
    text = ('Ratio of displacements, fixes to calibrated track, minus 1, in windows of seconds to '
            'minutes. Bars: one sigma, from the scatter over eight parts of the leg. A level line '
            'at 0 shows that fix errors do not depend on the motion. If short windows differ, the '
            'fixes contain an odometer, or are filtered or late.')
    picture = style.svg(figure, f'{name}-by-window', text)
    return 'Scale against the length of the window', text, picture


def comparison_figure(calibration: Calibration, name: str) -> list[style.Drawing]:
    """Draw scale, yaw and pitch by method and leg; empty for single values."""
    rows = [(f'all legs, {m.replace("_", " ")}', m, found.estimates)
            for m, found in calibration.methods.items()] if len(calibration.legs) > 1 else []
    for number, leg in list(enumerate(calibration.legs, 1))[-MOST_LEGS:]:
        rows += [(f'leg {number}, {m.replace("_", " ")}', m, found.estimates)
                 for m, found in leg.methods.items()]
    panels = [(title, points, band) for title, points, band in (
        _scale(calibration, rows), *(_angle(calibration, rows, angle) for angle in ANGLES))
        if len(points) > 1]
    return [_draw(panels, name, len(calibration.legs))] if panels else []


def _scale(calibration: Calibration, rows: list[tuple[str, str, dict[str, Estimate]]]) -> Panel:
    result = known(calibration.estimates, 'scale_factor')
    all_of = [(text, method, known(estimates, 'scale_factor')) for text, method, estimates in rows]
    found = [(text, method, e.value / result.value - 1, (e.sigma or 0.0) / abs(result.value))
             for text, method, e in all_of if e.value is not None and result.value]
    times, word = style.relative_unit(max((abs(off) + sigma for _, _, off, sigma in found),
                                          default=0.0))
    band = (0.0, (result.sigma or 0.0) / abs(result.value) * times) if result.value else None
    return f'scale minus result, {word}', [
        (text, method, off * times, sigma * times) for text, method, off, sigma in found], band


def _angle(calibration: Calibration, rows: list[tuple[str, str, dict[str, Estimate]]],
           name: str) -> Panel:
    result = known(calibration.estimates, name)
    points = []
    for text, method, estimates in rows:
        e = known(estimates, name)
        if e.value is not None:
            points.append((text, method, e.value * DEG, (e.sigma or 0.0) * DEG))
    band = None if result.value is None else (result.value * DEG, (result.sigma or 0.0) * DEG)
    return f'{ANGLES[name]} mounting angle, deg', points, band


def _draw(panels: list[Panel], name: str, legs: int) -> style.Drawing:
    heights = [0.24 * len(points) for _, points, _ in panels]
    whole = sum(heights) + 0.75 * len(panels)
    figure, axes = style.new_figure_column(whole, len(panels), sharex=False, heights=heights)
    figure.subplots_adjust(left=0.27, hspace=0.75 * len(panels) / sum(heights),
                           top=1 - 0.1 / whole)
    methods = dict.fromkeys(m for _, points, _ in panels for _, m, _, _ in points)
    shapes = {m: STYLES[i % len(STYLES)] for i, m in enumerate(methods)}
    for ax, (title, points, band) in zip(axes, panels, strict=True):
        if band is not None and all(map(math.isfinite, band)):
            ax.axvspan(band[0] - band[1], band[0] + band[1], color=style.BAND, linewidth=0)
            ax.axvline(band[0], color=style.GREY, linewidth=0.8)
        for place, (_, method, value, sigma) in enumerate(points):
            shape, colour = shapes[method]
            ax.errorbar(value, place, xerr=sigma, fmt=shape, color=colour, markersize=5,
                        capsize=3, linewidth=1.1)
        ax.set_yticks(range(len(points)), [text for text, *_ in points])
        ax.set_ylim(len(points) - 0.5, -0.5)
        ax.set_xlabel(title)
    text = 'Bars: one sigma to each side; grey band: the result.' + (
        ' Legs share some errors (heading source, lever arms), so bars may overlap more than '
        'random errors would.' if legs > 1 else '') + (
        f' Of {legs} legs, the newest {MOST_LEGS}.' if legs > MOST_LEGS else '')
    return 'Side by side', text, style.svg(figure, f'{name}-compared', text)
