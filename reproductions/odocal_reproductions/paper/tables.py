# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables 3 and 4 of Shi et al. 2015 from the simulated drive, and all four as one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from odocal_reproductions.paper.cells import Cell, CONVENTION, TABLE_3, TABLE_4
from odocal_reproductions.paper.coefficients import GYRO_DRIFT, HEADING_ERROR, table_1, table_2
from odocal_reproductions.paper.drive import Growth, GYRO_NOISE, Outcome, PaperDrive, SOURCES
from odocal_reproductions.paper.error_forms import SpeedProfile

SCALE_REMARK = ('equal within 2e-11 in every printed row, not explained by plane or tilt: an '
                'effect of numerics in the paper, not a reference value')
FORMULA_REMARK = ('printed dK comes from R of a sphere in (30), (31), but C0 and C of an '
                  'ellipsoid in (13), (14): phi_U / 2 times 0.0059')
SIGN_REMARK = '(30)-(33) are printed with the sign reversed against (27), (28)'


@dataclass(frozen=True, eq=False)
class Row:
    """A row of table 3."""

    yaw_deg: Cell
    scale: Cell            # relative to K
    model_deg: float       # yaw error by the linear error model
    # printed minus computed yaw error, in sigmas of the effect of gyro noise; None: not printed
    noise_sigmas: float | None


@dataclass(frozen=True, eq=False)
class PaperTables:
    """The four tables, and the data from which they are computed by source of error."""

    table_1: dict[str, dict[str, Cell]]
    table_2: dict[str, dict[str, Cell]]
    table_3: dict[str, Row]
    table_4: dict[str, dict[str, dict[str, Cell]]]
    outcomes: dict[str, Outcome]
    growths: dict[str, Growth]
    noise_deg: float      # 1 sigma of the yaw error by the paper's gyro noise
    sigma_deg: float      # 1 sigma of the yaw, stated by the pipeline

    def as_dict(self) -> dict[str, Any]:
        """Return the output of --json."""
        table_3 = {source: {
            'yaw_deg': row.yaw_deg.as_dict() | {'model': row.model_deg,
                                                'noise_sigmas': row.noise_sigmas},
            'scale': row.scale.as_dict()} for source, row in self.table_3.items()}
        return {
            'error_convention': CONVENTION,
            'gyro_noise_yaw_sigma_deg': self.noise_deg,
            'stated_yaw_sigma_deg': self.sigma_deg,
            'tables': {'1': _plain(self.table_1), '2': _plain(self.table_2), '3': table_3,
                       '4': _plain(self.table_4)}}


def _plain(table: Any) -> Any:
    """Return the content of nested tables of cells for --json."""
    return table.as_dict() if isinstance(table, Cell) else {k: _plain(v) for k, v in table.items()}


def compute() -> PaperTables:
    """Return the four tables; the pipeline processes the drive of section 3 eight times."""
    drive = PaperDrive()
    outcomes = {source: drive.outcome(source) for source in SOURCES}
    growths = {source: drive.growth(source) for source in SOURCES}
    profile = drive.profile()
    noise_deg = float(np.rad2deg(profile.noise_sigma(GYRO_NOISE)))
    table_3 = {source: _row(source, outcomes[source], growths[source], noise_deg)
               for source in SOURCES}
    return PaperTables(table_1(), table_2(), table_3, _table_4(table_3, profile), outcomes,
                       growths, noise_deg, float(np.rad2deg(outcomes['all'].yaw_sigma)))


def _row(source: str, outcome: Outcome, growth: Growth, noise_deg: float) -> Row:
    printed_scale, printed_yaw = TABLE_3[source]
    yaw = float(np.rad2deg(outcome.yaw))
    sigmas, remark = None, ''
    if printed_yaw is not None:
        sigmas = (printed_yaw + yaw) / noise_deg
        if abs(yaw) < noise_deg:
            remark = 'below the gyro noise of the paper: not significant'
    return Row(Cell(printed_yaw, yaw, printed_sign=-1, remark=remark),
               Cell(printed_scale, outcome.scale, remark=SCALE_REMARK if printed_scale else ''),
               float(np.rad2deg(growth.yaw[-1])), sigmas)


def _table_4(table_3: dict[str, Row],
             profile: SpeedProfile) -> dict[str, dict[str, dict[str, Cell]]]:
    closed_form = {'eps_z': profile.heading_and_drift(0.0, GYRO_DRIFT),
                   'phi_U0': profile.heading_and_drift(HEADING_ERROR, 0.0)}

    def line(source: str, name: str) -> dict[str, Cell]:
        if name == 'simulated':
            yaw_deg, scale = table_3[source].yaw_deg.value, table_3[source].scale.value
            yaw_remark, scale_remark = '', SCALE_REMARK
        else:
            dalpha, scale = closed_form[source]
            scale = round(scale, 20)      # smaller digits are rounding errors of a zero variance
            yaw_deg = float(np.rad2deg(dalpha))
            yaw_remark, scale_remark = SIGN_REMARK, FORMULA_REMARK
        printed_scale, printed_yaw = TABLE_4[source][name]
        return {'yaw_deg': Cell(printed_yaw, yaw_deg, printed_sign=-1, remark=yaw_remark),
                'scale': Cell(printed_scale, scale, remark=scale_remark)}

    return {source: {name: line(source, name) for name in lines}
            for source, lines in TABLE_4.items()}
