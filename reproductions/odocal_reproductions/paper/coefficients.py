# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables 1 and 2 of Shi et al. 2015: coefficients of the error equations, and their effects."""

import numpy as np

from odocal_reproductions.paper.cells import Cell, TABLE_1, TABLE_2
from odocal_reproductions.paper.error_model import coefficients, PAPER_RADIUS, STATES

# definition: errors in Shi et al. 2015
GYRO_DRIFT = np.deg2rad(0.01) / 3600    # rad/s, 0.01 deg/h
# definition: rad, of phi_E and phi_N, 0.5', and of phi_U, 3.6'
TILT_ERROR, HEADING_ERROR = np.deg2rad(0.5 / 60), np.deg2rad(3.6 / 60)
# factors of table 2: rad, rad/s
ERROR_SIZES = {'dL': 10.0 / PAPER_RADIUS,
               'phi_E': TILT_ERROR, 'phi_N': TILT_ERROR, 'phi_U': HEADING_ERROR,
               'eps_E': GYRO_DRIFT, 'eps_N': GYRO_DRIFT, 'eps_U': GYRO_DRIFT}
DRIFT_BY_STATE = {'phi_E': 'eps_E', 'phi_N': 'eps_N', 'phi_U': 'eps_U'}
# remarks on printed values that differ from the computed ones
REMARKS_1 = {
    ('phi_E', 'phi_N'): 'misprint: (15) has vE/R instead of vE tan L/R',
    ('phi_U', 'phi_U'): 'misprint: tan L of (17) is missing',
    ('dlam', 'dL'): 'misprint: (19), (23) lack vE, the value has it',
}
TAN_L_MISSING = 'as in table 1: tan L is missing'
REMARKS_2 = {
    ('phi_N', 'dL'): 'misprint: wrong by a factor of 10, 7.5e-11',
    ('phi_U', 'phi_U'): TAN_L_MISSING,
    ('phi_E', 'phi_N'): TAN_L_MISSING,
}
INPUTS_ROUNDED = 'inputs rounded to two digits first'
TRUNCATED = 'truncated, not rounded'


def table_1() -> dict[str, dict[str, Cell]]:
    """Return the coefficient of each error in the rate of each state: {rate of: {by: Cell}}."""
    latitude = np.deg2rad(40.0)
    velocity_n = (14.0, 14.0, 0.0)    # m/s, east, north, up
    F = coefficients(latitude, 0.0, velocity_n, PAPER_RADIUS)

    def cell(row: str, column: str, printed: float) -> Cell:
        value = -1.0 if DRIFT_BY_STATE.get(row) == column else float(
            F[STATES.index(row), STATES.index(column)])
        remark = '' if float(f'{abs(value):.1e}') == printed else TRUNCATED
        return _cell(printed, value, REMARKS_1.get((row, column), remark))

    return {row: {column: cell(row, column, printed) for column, printed in cells.items()}
            for row, cells in TABLE_1.items()}


def table_2() -> dict[str, dict[str, Cell]]:
    """Return table 1 times the sizes of the errors, 1/s and rad/s."""
    coefficients_1 = table_1()

    def cell(row: str, column: str, printed: float) -> Cell:
        coefficient = coefficients_1[row][column]
        value = coefficient.value * ERROR_SIZES[column] * coefficient.sign
        remark = REMARKS_2.get((row, column), '')
        if not remark and abs(printed / abs(value) - 1) > 0.02:
            remark = INPUTS_ROUNDED
        return _cell(printed, value, remark)

    return {row: {column: cell(row, column, printed) for column, printed in cells.items()}
            for row, cells in TABLE_2.items()}


def _cell(printed: float, value: float, remark: str) -> Cell:
    return Cell(printed, abs(value), sign=1 if value > 0 else -1, remark=remark)
