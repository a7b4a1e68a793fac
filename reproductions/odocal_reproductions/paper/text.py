# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The four tables as text for a terminal."""

import textwrap

from odocal_reproductions.paper.cells import Cell
from odocal_reproductions.paper.tables import PaperTables

HEAD = """\
Shi, Ma, Zhang, Zhang 2015, 'The initial calibration of odometer and error analysis':
printed values, values computed by this package, and their ratio.
Errors of this package are estimate - truth. The yaw errors printed in tables 3 and 4 are
truth - estimate; they are shown as printed, and the ratio accounts for the sign."""
TITLE_1 = """\
Table 1: coefficients of the error equations (15)-(23), corrected; sphere of 6378137 m,
latitude 40 deg, 14 m/s east and north. Magnitudes; the sign is that of the equations."""
TITLE_2 = """\
Table 2: the same times dL = 10 m / R, phi_E = phi_N = 0.5', phi_U = 3.6', eps = 0.01 deg/h."""
TITLE_3 = """\
Table 3: calibration errors of the drive of section 3 (11.2 km, K0 = 1.2 K, mounting 1 deg),
simulated and processed by the pipeline; `model` is the linear error model, (11)-(23) corrected."""
TITLE_4 = """\
Table 4: the simulation and the closed forms (32), (33), corrected and evaluated for the speed
profile of the drive."""


def text_of(tables: PaperTables) -> str:
    """Return the page that odocal paper prints."""
    return '\n\n'.join([
        HEAD, _coefficient_text(TITLE_1, tables.table_1),
        _coefficient_text(TITLE_2, tables.table_2), _text_3(tables), _text_4(tables)]) + '\n'


def _coefficient_text(title: str, table: dict[str, dict[str, Cell]]) -> str:
    lines = [title, '  rate of  by       printed        ours   ratio  remark']
    for row, cells in table.items():
        for column, cell in cells.items():
            sign = '-' if cell.sign is not None and cell.sign < 0 else '+'
            lines.append(f'  {row:8s} {column:6s} {cell.printed:9.1e}  {sign}{cell.value:9.3e}  '
                         f'{cell.ratio:6.3f}{_remark(cell)}')
    return '\n'.join(lines)


def _text_3(tables: PaperTables) -> str:
    lines = [TITLE_3, '           yaw error, deg                                   '
             'scale error, K',
             '  source      printed        ours   ratio       model   printed       ours']
    for source, row in tables.table_3.items():
        yaw, scale = row.yaw_deg, row.scale
        mark = ' *' if yaw.remark else ''
        lines.append(f'  {source:7s} {_figure(yaw.printed, ".3e"):>11s} {yaw.value:+11.3e} '
                     f'{_figure(yaw.ratio, ".3f"):>7s} {row.model_deg:+11.3e} '
                     f'{_figure(scale.printed, ".3e"):>9s} {scale.value:+10.2e}{mark}')
    max_sigmas, max_source = max((abs(row.noise_sigmas), source)
                                 for source, row in tables.table_3.items()
                                 if row.noise_sigmas is not None)
    remark = next(row.yaw_deg.remark for row in tables.table_3.values() if row.yaw_deg.remark)
    notes = [
        f'* {remark} (0.001 deg/sqrt(h) alone: {tables.noise_deg:.1e} deg, 1 sigma; printed and '
        f'ours differ by at most {max_sigmas:.1f} sigma, in row {max_source}).',
        'Row none is not in the paper: it is the residual error of the method.',
        f'Printed scale errors: {tables.table_3["all"].scale.remark}.',
        f'The yaw uncertainty stated by the pipeline is {tables.sigma_deg:.4f} deg: that of the '
        'given heading.']
    return '\n'.join(lines + [_note(note) for note in notes])


def _text_4(tables: PaperTables) -> str:
    lines = [TITLE_4, '                     yaw error, deg                     scale error, K0',
             '  source             printed        ours   ratio     printed       ours']
    remarks: dict[str, str] = {}
    for source, block in tables.table_4.items():
        for name, cells in block.items():
            yaw, scale = cells['yaw_deg'], cells['scale']
            marks = ''.join(remarks.setdefault(c.remark, chr(ord('a') + len(remarks)))
                            for c in (yaw, scale) if c.remark)
            lines.append(f'  {source:7s} {name:9s} {yaw.printed:+9.4f} {yaw.value:+11.6f} '
                         f'{yaw.ratio:7.3f}  {scale.printed:10.3e} {scale.value:+10.1e}  {marks}')
    return '\n'.join(lines + [_note(f'{mark}: {text}.') for text, mark in remarks.items()])


def _note(text: str) -> str:
    return textwrap.fill(text, 95, initial_indent='  ', subsequent_indent='    ')


def _figure(value: float | None, form: str) -> str:
    return '-' if value is None else format(value, ('+' if form.endswith('e') else '') + form)


def _remark(cell: Cell) -> str:
    return f'  {cell.remark}' if cell.remark else ''
