# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The scale against speed of all legs, as a table and as a picture."""

from pathlib import Path
from textwrap import wrap

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.calib.speed_scale import SpeedScale
from odocal_ros.errors import BadUsage
from odocal_ros.library.series import Series

FIT = {'factor': 'm_per_unit', 'offset': 'm_per_s', 'lag': 's'}


def _found(result: Calibration) -> list[tuple[int, SpeedScale]]:
    found = [(number, leg.evidence.by_speed) for number, leg in enumerate(result.legs, 1)
             if leg.evidence is not None and len(leg.evidence.by_speed.bins)]
    if not found:
        raise BadUsage('no leg has enough sections in motion for a scale against speed')
    return found


def scale_by_speed(result: Calibration) -> Series:
    """
    Return the scale against speed, one row per leg and group of sections.

    speed_m_per_s, ratio, ratio_sigma : path by the fixes over the odometer as sent.   sections :
    in the group.   factor, offset, lag with sigma : of the leg's fit; NaN if not determined.

    Raises
    ------
    BadUsage
        No leg has enough sections.

    """
    parts = []
    for number, one in _found(result):
        n = len(one.bins)
        columns = {'leg': np.full(n, number)} | dict(zip(
            ('speed_m_per_s', 'ratio', 'ratio_sigma'), one.bins.T[:3], strict=True))
        columns['sections'] = one.bins[:, 3].astype(int)
        for name, unit in FIT.items():
            value, sigma = getattr(one, name) or (np.nan, np.nan)
            columns |= {f'{name}_{unit}': np.full(n, value),
                        f'{name}_sigma_{unit}': np.full(n, sigma)}
        parts.append(columns)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def draw_scale_by_speed(result: Calibration, path: Path) -> None:
    """Write the picture of each leg's scale against speed, one above the other."""
    from odocal_ros.output.pictures import new_figure, save_figure
    from odocal_ros.output.plots_speed import draw_by_speed, fit_text
    most = 8     # legs in one picture, the newest
    found = _found(result)[-most:]
    figure = new_figure(7.0, 3.2 * len(found))
    for ax, (number, one) in zip(figure.subplots(len(found), 1, squeeze=False)[:, 0], found,
                                 strict=True):
        draw_by_speed(ax, one)
        said = [f'Scale against speed, leg {number}', *wrap(fit_text(one), 90)]
        ax.set_title('\n'.join(said), fontsize=8)
        ax.legend(frameon=False, fontsize=8)
    save_figure(figure, path)
