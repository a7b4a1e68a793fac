# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figures of the scale against speed, with a fit, and against the length of the window."""

from typing import Any

import numpy as np

from odocal_ros.calib.speed_scale import SpeedScale
from odocal_ros.data.arrays import Floats
from odocal_ros.output.drawing import BLUE, Drawing, GREY, key, RED, sheet, svg
from odocal_ros.output.figures import with_sigma


def draw_by_speed(ax: Any, found: SpeedScale) -> None:
    """Draw on axes the ratio of fixes to odometer by speed, and the fit."""
    speed, ratio, sigma, _ = found.bins.T
    ax.errorbar(3.6 * speed, ratio, sigma, fmt='o', color=BLUE, markersize=4.5, capsize=3,
                linewidth=1.1, label='fixes / odometer as sent, ± sigma')
    if found.factor and found.offset:
        v = np.linspace(speed.min(), speed.max(), 100)
        # reference = factor * sent + offset, over what is sent
        fit = found.factor[0] * v / (v - found.offset[0])
        ax.plot(3.6 * v, fit, '-', color=RED, linewidth=1.2, label='fit')
        ax.axhline(found.factor[0], color=GREY, linewidth=0.8, linestyle='--', label='factor')
    ax.set(xlabel='speed, km/h', ylabel='path by fixes / odometer')
    ax.ticklabel_format(axis='y', useOffset=False)


def fit_text(found: SpeedScale) -> str:
    """Return the fit in words; '' if the speeds of the leg do not determine it."""
    if not (found.factor and found.offset and found.lag):
        return ''
    offset, lag = found.offset, found.lag
    low = 'low' if offset[0] > 0 else 'high'
    late = 'later' if lag[0] > 0 else 'earlier'
    return (f'Fit: factor {with_sigma(*found.factor)}; the odometer reads '
            f'{with_sigma(abs(offset[0]), offset[1])} m/s {low} and is '
            f'{with_sigma(abs(lag[0]), lag[1])} s {late} than the fixes')


def by_speed(found: SpeedScale, name: str) -> Drawing:
    """Return the figure of a leg: title, what it shows, svg element."""
    figure, (ax,) = sheet(2.7)
    draw_by_speed(ax, found)
    key(figure, ax)
    fit = fit_text(found) or 'No fit: the speed varies too little'
    says = ('Path length by the fixes over the odometer as sent, each point a group of sections '
            f'of a few seconds. A constant factor is a level line. {fit}.')
    return 'Scale against speed', says, svg(figure, f'{name}-by-speed', says)


def by_window(found: Floats, name: str) -> Drawing:
    """Return the figure of the scale by windows of a leg, as ``by_speed``; found : (w, 4)."""
    length, excess, sigma, _ = found.T
    figure, (ax,) = sheet(2.7)
    ax.axhline(0.0, color=GREY, linewidth=0.8, linestyle='--')
    ax.errorbar(length, 100 * excess, 100 * sigma, fmt='o-', color=BLUE, markersize=4.5,
                capsize=3, linewidth=1.1)
    ax.set(xscale='log', xlabel='length of the window, s', ylabel='fixes / track - 1, %')
    ax.set_xticks(length, [f'{x:g}' for x in length], minor=False)
    ax.set_xticks([], minor=True)
    says = ('Displacement by the fixes over that of the calibrated track, in windows of seconds '
            'to minutes, ± their scatter over eight parts of the leg. A level line at 0: errors '
            'of the fixes do not depend on the motion. Short windows that differ: the fixes '
            'contain an odometer, the receiver filters, or the fixes are late.')
    return 'Scale against the length of the window', says, svg(figure, f'{name}-by-window', says)
