# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The figures of a leg, from its evidence: track, residuals, scale by section, speed, fixes."""

from collections.abc import Callable
from typing import Any

import numpy as np

from odocal_ros.calib.evidence import Evidence
from odocal_ros.calib.number_text import relative_unit
from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import LOCAL_STATUS
from odocal_ros.output import plot_style as style
from odocal_ros.output.scale_plots import by_speed, by_window

GAP_COLOURS = {'no fix used': style.PINK, 'no IMU': style.RED, 'no odometer': style.GREEN}
# NavSatStatus.status: label, marker, colour
STATUS = {-1: ('no fix (-1)', 'x', style.GREY), 0: ('fix (0)', 'o', style.BLUE),
          1: ('satellite based aid, SBAS (1)', 's', style.GREEN),
          2: ('ground based aid, GBAS or RTK (2)', '^', style.PINK)}


def leg_figures(evidence: Evidence, name: str, scale_sigma: float | None = None,
                before_word: str = 'as configured',
                smoothed: dict[str, Any] | None = None) -> list[style.Drawing]:
    """
    Draw a leg.

    name : prefix of the ids of each figure.   scale_sigma : relative sigma of the leg's scale, a
    band in the figure of sections.   before_word : label of the track before the correction.
    smoothed : details of the smoother: slips, and biases at its keyframes.

    Returns (title, description, svg element) of each figure; to be called under
    ``plot_style.apply_style``.
    """
    if not len(evidence.t):
        return []
    smoothed = smoothed or {}
    figures = [_track(evidence, name, before_word, smoothed.get('slips', ()))]
    if len(evidence.t_fix):
        figures.append(_residuals(evidence, name, before_word))
    if np.isfinite(evidence.sections.ratio).any():
        figures.append(_sections(evidence, name, scale_sigma))
    if len(evidence.by_speed.bins):
        figures.append(by_speed(evidence.by_speed, name))
    if len(evidence.by_window):
        figures.append(by_window(evidence.by_window, name))
    figures.append(_motion(evidence, name))
    if len(evidence.t_fix) or len(evidence.t_excluded):
        figures.append(_fixes(evidence, name))
    if np.any(smoothed.get('key_biases', 0.0)):
        figures.append(_biases(smoothed['key_t'], smoothed['key_biases'], name))
    return figures


def draw_track(ax: Any, evidence: Evidence, before_word: str = 'as configured',
               slips: list[dict[str, float]] | tuple[Any, ...] = ()) -> None:
    """Draw on axes the track as configured and as calibrated over the fixes."""
    start = evidence.track_n[0]
    factor, unit = style.length_unit(np.ptp(evidence.track_n[:, :2], axis=0).max())
    after, before, fixes = (factor * (points - start)[:, :2] for points in (
        evidence.track_n, evidence.track_before_n, evidence.fix_n))
    shown = style.even_rows(len(fixes))
    ax.plot(*fixes[shown].T, 'o', color='0.62', markersize=4.5, markeredgewidth=0, label='fixes')
    ax.plot(*before[style.peak_rows(before)].T, '--', color=style.RED, label=before_word,
            linewidth=1.2)
    ax.plot(*after[style.peak_rows(after)].T, '-', color=style.BLUE, label='as calibrated')
    ax.plot(*after[0], 'o', color='black', markersize=6, markerfacecolor='white', zorder=5)
    ax.plot(*after[-1], 's', color='black', markersize=5, zorder=5)
    middle = after.mean(axis=0)
    for point, label in ((after[0], 'start'), (after[-1], 'stop')):
        right, up = np.where(point < middle, -1, 1)      # away from the middle of the track
        ax.annotate(label, point, xytext=(7 * right, 6 * up), textcoords='offset points',
                    ha='right' if right < 0 else 'left', va='top' if up < 0 else 'bottom')
    _draw_marks(ax, evidence,
                lambda t: np.stack([np.interp(t, evidence.t, axis) for axis in after.T]), slips)
    is_local = (evidence.fix_status == LOCAL_STATUS).any()
    axes = ('x from', 'y from') if is_local else ('east of', 'north of')
    ax.set(xlabel=f'{axes[0]} the start, {unit}', ylabel=f'{axes[1]} the start, {unit}')
    ax.set_aspect('equal', adjustable='datalim')
    ax.margins(0.06)


def _track(evidence: Evidence, name: str, before_word: str,
           slips: list[dict[str, float]] | tuple[Any, ...]) -> style.Drawing:
    figure, (ax,) = style.new_figure_column(5.2)
    draw_track(ax, evidence, before_word, slips)
    style.add_legend(figure, ax)
    text = ('Dead reckoning over the fixes. Both tracks start at the start mark; the calibrated '
            'track should cover the fixes.')
    return style.drawing(figure, f'{name}-track', 'Track', text)


def _draw_marks(ax: Any, evidence: Evidence, position_at: Callable[..., Any],
                slips: list[dict[str, float]] | tuple[Any, ...]) -> None:
    """Mark unused fixes, gaps, slips and the end of the fit; position_at: of times, s."""
    unused = evidence.t_excluded[style.even_rows(len(evidence.t_excluded))]
    if len(unused):
        ax.plot(*position_at(unused), '.', color=style.GREY, markersize=3, zorder=4,
                label='fix not used')
    step = np.diff(evidence.t_fix)
    min_gap = 5.0    # median intervals between fixes
    gaps = [('no fix used', evidence.t_fix[k], evidence.t_fix[k + 1]) for k in np.flatnonzero(
        step > max(min_gap * np.median(step), 1.0))] if len(step) else []
    gaps += [(f'no {name}', begin, end) for name, begin, end in evidence.gaps]
    labelled = set()
    for label, begin, end in gaps:
        ends = np.clip((begin, end), evidence.t[0], evidence.t[-1])
        ax.plot(*position_at(np.linspace(ends[0], ends[1], 50)), '-', color=GAP_COLOURS[label],
                linewidth=4, alpha=0.6, zorder=1, solid_capstyle='butt',
                label=None if label in labelled else label)
        if label != 'no fix used':       # marks at the ends make short gaps visible
            ax.plot(*position_at(ends), '|', color=GAP_COLOURS[label], markersize=12,
                    markeredgewidth=2)
        labelled.add(label)
    if evidence.t_fit < evidence.t[-1]:
        ax.plot(*position_at(np.array([evidence.t_fit])), 'D', color='black',
                markersize=6, markerfacecolor=style.PINK, zorder=5, label='fitted to here')
    if len(slips):
        ax.plot(*position_at(np.array([slip['t'] + slip['duration'] / 2 for slip in slips])), '^',
                color='black', markersize=6, markerfacecolor=style.GREEN, zorder=5, label='slip')


def draw_residuals(ax: Any, evidence: Evidence) -> None:
    """Draw on axes dead reckoning minus fix along and across, as calibrated."""
    factor, unit = style.length_unit(evidence.distance[-1])
    path_length = factor * evidence.fix_distance
    _band(ax, path_length, evidence.fix_sigma)
    rows = style.peak_rows(evidence.residual)
    for column, colour, word in zip(evidence.residual.T, (style.BLUE, style.RED),
                                    ('along', 'across'), strict=True):
        ax.plot(path_length[rows], column[rows], '-', color=colour, linewidth=0.9, label=word)
    ax.set(xlabel=f'distance driven, {unit}', ylabel='dead reckoning minus fix, m')


def _band(ax: Any, path_length: Floats, sigma: Floats) -> None:
    band = style.even_rows(len(path_length))
    ax.fill_between(path_length[band], -sigma[band], sigma[band], color=style.BAND, linewidth=0,
                    label='± sigma of a fix')
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    for edge in (-sigma[band], sigma[band]):      # visible through noise in the band
        ax.plot(path_length[band], edge, '--', color='black', linewidth=0.6)


def _residuals(evidence: Evidence, name: str, before_word: str) -> style.Drawing:
    factor, unit = style.length_unit(evidence.distance[-1])
    path_length = factor * evidence.fix_distance
    figure, axes = style.new_figure_column(5.2, 3)
    rows = style.peak_rows(evidence.residual)
    for ax, column, word in zip(axes, evidence.residual.T, ('along', 'across'), strict=False):
        _band(ax, path_length, evidence.fix_sigma)
        ax.plot(path_length[rows], column[rows], '-', color=style.BLUE, linewidth=0.9,
                label='as calibrated')
        ax.set_ylabel(f'{word}, m')
    rows = style.peak_rows(evidence.residual_before)
    for column, dash, word in zip(evidence.residual_before.T, ('--', ':'), ('along', 'across'),
                                  strict=True):
        axes[2].plot(path_length[rows], column[rows], dash, color=style.RED, linewidth=1.3,
                     label=f'{before_word}, {word}')
    axes[2].axhline(0.0, color=style.GREY, linewidth=0.8)
    axes[2].set(xlabel=f'distance driven, {unit}', ylabel=f'{before_word}, m')
    axes[2].legend(loc='lower center', bbox_to_anchor=(0.5, 0.97), ncols=2, borderaxespad=0.0)
    figure.subplots_adjust(hspace=0.24)
    style.add_legend(figure, axes[0])
    figure.align_ylabels(axes)
    text = ('Dead reckoning minus fix. Along > 0: ahead of the fix; across > 0: left of the fix. '
            'A slope along indicates a scale error, a curve across a heading drift.')
    return style.drawing(figure, f'{name}-residuals', 'Residuals', text)


def _sections(evidence: Evidence, name: str, scale_sigma: float | None) -> style.Drawing:
    sections = evidence.sections
    factor, unit = style.length_unit(evidence.distance[-1])
    middle = factor * (sections.begin + sections.end) / 2
    half = factor * (sections.end - sections.begin) / 2
    largest = max(np.nanmax(np.abs(sections.ratio - 1) + sections.sigma), scale_sigma or 0.0)
    scale, scale_unit = relative_unit(largest)
    difference, sigma = (sections.ratio - 1) * scale, sections.sigma * scale
    figure, (ax,) = style.new_figure_column(2.7)
    if scale_sigma:
        ax.axhspan(-scale_sigma * scale, scale_sigma * scale, color=style.BAND, linewidth=0,
                   label='± sigma of the result')
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    ax.hlines(difference, middle - half, middle + half, color=style.BLUE, linewidth=1.1)
    ax.errorbar(middle, difference, sigma, fmt='o', color=style.BLUE, markersize=4.5, capsize=3,
                linewidth=1.1, label='section, ± its sigma')
    ax.set(xlabel=f'distance driven, {unit}', ylabel=f'scale minus result, {scale_unit}')
    ax.set_xlim(0.0, factor * evidence.distance[-1])
    style.add_legend(figure, ax)
    text = ('Length from the fixes divided by the calibrated dead-reckoned length, in sections '
            'of equal path length. Bars: one sigma of the fixes. Slip, an odometer delay (at '
            'starts and stops) or bad fixes appear as outlier sections. Bars do not include fix '
            'errors that change more slowly than a section.')
    return style.drawing(figure, f'{name}-sections', 'Scale by section', text)


def _motion(evidence: Evidence, name: str) -> style.Drawing:
    figure, (upper, lower) = style.new_figure_column(3.6, 2)
    for ax, signal in ((upper, 3.6 * evidence.speed), (lower, np.rad2deg(evidence.yaw_rate))):
        rows = style.peak_rows(signal)
        ax.plot(evidence.t[rows], signal[rows], '-', color=style.BLUE, linewidth=1.0)
        ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    upper.set_ylabel('speed, km/h')
    lower.set(ylabel='turn rate, deg/s', xlabel='time since the start mark, s')
    figure.align_ylabels([upper, lower])
    text = ('Speed from the calibrated odometer (negative: reversing) and turn rate from the '
            'gyro (positive: left), averaged over one second.')
    return style.drawing(figure, f'{name}-motion', 'Speed and turn rate', text)


def _fixes(evidence: Evidence, name: str) -> style.Drawing:
    figure, (ax,) = style.new_figure_column(2.7)
    for status in np.unique(evidence.fix_status):
        rows = np.flatnonzero(evidence.fix_status == status)
        rows = rows[style.even_rows(len(rows), style.MAX_MARKS // 2)]
        label, marker, colour = STATUS.get(int(status), (f'status {status}', 'D', style.GREY))
        ax.plot(evidence.t_fix[rows], evidence.fix_sigma[rows], marker, color=colour,
                markersize=3.5, markeredgewidth=0 if marker != 'x' else 1, label=label)
    rows = style.even_rows(len(evidence.t_excluded))
    if len(rows):
        ax.plot(evidence.t_excluded[rows], np.zeros(len(rows)), '.', color=style.GREY,
                markersize=3, clip_on=False, zorder=5, label='not used')
    ax.set(xlabel='time since the start mark, s', ylabel='sigma of a fix, m')
    top = float(evidence.fix_sigma.max(initial=0.0))
    ax.set_ylim(0.0, 1.25 * top if top else 1.0)
    style.add_legend(figure, ax)
    text = ('Horizontal sigma of each axis as published (or gnss.default_sigma), by status. '
            'Dots at the bottom: fixes not used.')
    return style.drawing(figure, f'{name}-fixes', 'Fix quality', text)


def _biases(t: Floats, biases: Floats, name: str) -> style.Drawing:
    # without an accelerometer its bias is zero throughout
    shown = [(columns, factor, label) for columns, factor, label in zip(
        biases, (np.rad2deg(3600.0), 1e3), ('gyro bias, deg/h', 'accelerometer bias, mm/s²'),
        strict=True) if np.any(columns)]
    figure, axes = style.new_figure_column(1.8 * len(shown), len(shown))
    for ax, (columns, factor, label) in zip(axes, shown, strict=True):
        for column, colour, dash, axis in zip(
                columns.T, (style.BLUE, style.RED, style.GREEN), ('-', '--', ':'), 'xyz',
                strict=True):
            rows = style.peak_rows(column)
            ax.plot(t[rows], factor * column[rows], dash, color=colour, linewidth=1.2, label=axis)
        ax.set_ylabel(label)
    axes[-1].set_xlabel('time since the start mark, s')
    style.add_legend(figure, axes[0])
    figure.align_ylabels(axes)
    text = ('IMU biases along the drive, estimated by the smoother. They drift with temperature; '
            'a step, or a drift far beyond the grade, indicates a fault.')
    return style.drawing(figure, f'{name}-biases', 'Biases', text)
