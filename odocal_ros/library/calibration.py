# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration for other programs: values, tables, series, figures, files."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, UTC
from pathlib import Path
from typing import Any

from odocal_ros.calib import result
from odocal_ros.calib.evidence import Evidence
from odocal_ros.calib.result import Estimate
from odocal_ros.errors import BadUsage
from odocal_ros.library.series import residuals, Series, states, trajectory
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config

TABLES_INSTALL = 'pip install pandas pyarrow'


def frame_of(columns: dict[str, Any]) -> Any:
    """Return columns as a pandas.DataFrame."""
    try:
        import pandas
    except ImportError:
        raise BadUsage(f'a table needs pandas: {TABLES_INSTALL}') from None
    return pandas.DataFrame(columns)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration of a vehicle."""

    result: result.Calibration                  # complete result of the pipeline
    config: Config = Config()                   # its settings
    inputs: tuple[dict[str, Any], ...] = ()     # name, sha256 and topics of each bag
    notes: tuple[str, ...] = ()                 # sentences for the user about the computation
    created: str = field(      # ISO 8601
        default_factory=lambda: datetime.now(UTC).isoformat(timespec='seconds'))

    @property
    def verdict(self) -> Verdict:
        """Return accepted, caution or rejected."""
        return self.result.verdict

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Return the findings that lower the verdict or inform: code, text, remedy."""
        return self.result.reasons

    @property
    def values(self) -> dict[str, float | None]:
        """Return each value by name, SI and radians; None: not determined."""
        return {name: estimate.value for name, estimate in self._estimates().items()}

    @property
    def sigmas(self) -> dict[str, float | None]:
        """Return one standard deviation of each value."""
        return {name: estimate.sigma for name, estimate in self._estimates().items()}

    def _estimates(self) -> dict[str, Estimate]:
        """Return the estimates by name; scale, yaw and pitch exist even if no leg was fitted."""
        return result.unknown_values('') | self.result.estimates

    def __str__(self) -> str:
        """Return the result as one screen of text, as ``odocal replay`` prints it."""
        from odocal_ros.output.summary import screen
        return screen(self.result)

    def to_dict(self) -> dict[str, Any]:
        """Return the content of calibration.json: plain dicts and lists, no NaN."""
        from odocal_ros.output.files import as_json
        return as_json(self.result, self.config, list(self.inputs), self.created)

    def to_frame(self) -> Any:
        """Return a pandas.DataFrame, a row for each value: value, sigma, unit, method."""
        estimates = self._estimates()
        columns = {name: [getattr(estimate, name) for estimate in estimates.values()]
                   for name in ('value', 'sigma', 'unit', 'method')}
        return frame_of(columns).set_axis(list(estimates))

    def trajectory(self) -> Series:
        """Return the smoothed drive; see ``series.trajectory``."""
        return trajectory(self.result)

    def states(self) -> Series:
        """Return attitude, biases of the IMU and their sigmas over time; see ``series.states``."""
        return states(self.result)

    def residuals(self) -> Series:
        """Return the residuals of each sensor with their sigmas; see ``series.residuals``."""
        return residuals(self.result)

    def plot_track(self, ax: Any, leg: int = 1) -> Any:
        """Draw a leg's track over its fixes on matplotlib axes; return these."""
        from odocal_ros.output.plots import draw_track
        from odocal_ros.output.tables import before_label
        draw_track(ax, self._drawable(leg), before_label(self.result.legs))
        ax.legend()
        return ax

    def plot_residuals(self, ax: Any, leg: int = 1) -> Any:
        """Draw dead reckoning minus fix over the path on matplotlib axes; return these."""
        from odocal_ros.output.plots import draw_residuals
        draw_residuals(ax, self._drawable(leg))
        ax.legend()
        return ax

    def save(self, folder: Path | str, force: bool = False,
             warn: Callable[[str], None] = lambda note: None) -> list[Path]:
        """
        Write all result files; return their paths, calibration.json first.

        ``warn`` receives a sentence if the report cannot be drawn.

        Raises BadUsage: a calibration.json exists and ``force`` is not set, or the folder is not
        writable.
        """
        from odocal_ros.output.files import write_results
        return write_results(self.result, self.config, Path(folder), list(self.inputs),
                             self.created, force=force, warn=warn)

    def export(self, *files: Path | str) -> list[Path]:
        """
        Write time series for other programs; the names select them: ``export.KNOWN``.

        trajectory.tum (evo), states.csv, residuals.parquet, track.kml, debug.mcap and others.
        """
        from odocal_ros.library.export import export
        return export(self.result, files)

    def _drawable(self, leg: int) -> Evidence:
        """Return the track and fixes of a leg; raise BadUsage without."""
        if not 1 <= leg <= len(self.result.legs):
            raise BadUsage(f'leg {leg} does not exist; there are legs 1 to '
                           f'{len(self.result.legs)}')
        evidence = self.result.legs[leg - 1].evidence
        if evidence is None or not len(evidence.t):
            raise BadUsage(f'leg {leg} has no track to draw; see its reasons')
        return evidence
