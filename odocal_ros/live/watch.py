# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
odocal watch: shows the status of a calibration node in the terminal.

The status comes from another process: its keys and values are untrusted.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager
import math
from math import degrees, isfinite, nan
import time
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.exceptions import NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.validate_full_topic_name import validate_full_topic_name
from rich.console import Group
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from std_msgs.msg import String

from odocal_ros.calib.number_text import relative_unit
from odocal_ros.errors import BadUsage
from odocal_ros.forecast.forecast import PREDICTED_REST_S, three_digits
from odocal_ros.live.messages import LATCHED
from odocal_ros.output.value_text import with_sigma
from odocal_ros.safe_io.text_formats import brief_line

# by level of a DiagnosticStatus: OK, WARN, ERROR, STALE
COLOURS = {b'\x00': 'green', b'\x01': 'yellow', b'\x02': 'red', b'\x03': 'dim'}
MAX_VALUES = 500      # judgement: keys of a status that are read; a calibrator sends 100
HINT_S = 0.1      # judgement: s in which the hint that is sent with a status arrives


def panel(level: bytes, name: str, status: dict[str, str], hint: str) -> Panel:
    """Return a status (its published keys and values) as one panel."""
    colour = COLOURS.get(level, 'white')
    state = Text(', '.join(filter(None, (status.get('state'), status.get('verdict')))),
                 style=f'bold {colour}')
    for text, key in (('distance', 'distance_m'), ('time', 'duration_s')):
        state.append(f'   {text} {status.get(key, "")} {key[-1]}', style='default')
    rates = '   '.join(f'{slot} {status.get(f"{slot}_rate_hz", "")} Hz'
                       for slot in ('imu', 'odometer', 'fix'))
    return Panel(Group(state, Text(hint, style='bold'), _bars(status), Text(_values(status)),
                       Text(rates, style='dim')), title=name, border_style=colour)


def progress_shares(status: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Return the progress towards each limit: label -> (0 to 1, text)."""
    if status.get('state') == 'computing':
        return {}      # passes are in the hint, since their total is unknown
    driven_m, missing_m = number(status, 'distance_m'), number(status, 'distance_to_minimum_m')
    standstill_s = number(status, 'seconds_to_stand')
    bars = {}
    if driven_m + missing_m > 0:      # a leg
        bars['path'] = driven_m / (driven_m + missing_m), f'{missing_m:.0f} m to go'
    bars['standstill'] = 1 - standstill_s / PREDICTED_REST_S, f'{standstill_s:.0f} s to go'
    for name, unit in (('scale', 'ppm'), ('yaw', 'deg')):
        required = number(status, f'required_{name}_sigma_{unit}')
        sigma = number(status, f'predicted_{name}_sigma_{unit}') or _result_sigmas(status)[name]
        # a sigma falls with the path length or its root: the ratio to the limit is a rough measure
        share = min(required / sigma, 1.0) if sigma > 0 else 0.0
        if unit == 'ppm':
            factor, unit = relative_unit(1e-6 * sigma, 1e-6 * required)
            sigma, required = 1e-6 * factor * sigma, 1e-6 * factor * required
        sigma_text = f'{three_digits(sigma)} {unit}' if sigma > 0 else 'not known'
        bars[name] = share, f'{sigma_text}, limit {three_digits(required)} {unit}'
    return bars


def _result_sigmas(status: dict[str, str]) -> dict[str, float]:
    if status.get('state') == 'recording':
        return {'scale': 0.0, 'yaw': 0.0}
    relative = number(status, 'scale_factor_sigma') / (number(status, 'scale_factor') or nan)
    return {'scale': 1e6 * relative if isfinite(relative) else 0.0,
            'yaw': degrees(number(status, 'yaw_mounting_angle_sigma_rad'))}


def number(status: dict[str, str], key: str) -> float:
    """Return a value of the status, 0 if it is missing."""
    try:
        value = float(status.get(key, ''))
    except ValueError:
        return 0.0
    return value if isfinite(value) else 0.0


def _bars(status: dict[str, str]) -> Table:
    grid = Table.grid(padding=(0, 1))
    for label, (share, text) in progress_shares(status).items():
        is_reached = share >= 1.0
        grid.add_row(label, ProgressBar(1.0, max(share, 0.0), width=40, complete_style=(
            'green' if is_reached else 'yellow'), finished_style='green'), 'OK' if is_reached
            else text)
    return grid


def _values(status: dict[str, str]) -> str:
    state = status.get('state')
    prefix = 'estimate_' if state in ('recording', 'computing') else ''
    # label, key, key of the sigma, factor to the printed unit, this unit
    keys = (('scale factor', 'scale_factor', 'scale_factor_sigma', 1.0, ''),
            ('yaw', 'yaw_mounting_angle_rad', 'yaw_mounting_angle_sigma_rad', degrees(1), ' deg'))
    texts = [f'{label} {with_sigma(value, number(status, prefix + sigma) or None, factor)}{unit}'
             for label, key, sigma, factor, unit in keys
             if (value := number(status, prefix + key))]
    provisional = 'provisional: ' if state == 'computing' and texts else ''
    return provisional + ('   '.join(texts) or 'no value yet')


class Status(NamedTuple):
    """A status as received, with the hint that was sent with it."""

    level: bytes
    values: dict[str, str]
    hint: str


class StatusListener(AbstractContextManager['StatusListener']):
    """A separate node that receives statuses; a context manager and an iterator over them."""

    def __init__(self, node_name: str, wait_s: float = math.inf) -> None:
        """End the iteration if no status has come for ``wait_s`` s."""
        name = f'/{node_name.strip("/")}'
        try:
            validate_full_topic_name(f'{name}/status')
        except NameValidationException:
            raise BadUsage(f"'{node_name}' is not the name of a node; ros2 node list shows the "
                           'names') from None
        self._until = time.monotonic() + wait_s
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node('odocal_watch', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._status: DiagnosticArray | None = None
        self._hint: str | None = None
        self._node.create_subscription(DiagnosticArray, f'{name}/status', self._receive, LATCHED)
        self._node.create_subscription(String, f'{name}/hint', self._receive_hint, LATCHED)

    def _receive(self, array: DiagnosticArray) -> None:
        if array.status:
            self._status = array

    def _receive_hint(self, message: String) -> None:
        self._hint = brief_line(message.data)

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def __iter__(self) -> Iterator[Status]:
        """Yield each status, until the context ends."""
        try:
            while self._context.ok() and time.monotonic() < self._until:
                self._executor.spin_once(timeout_sec=0.5)
                if self._status is not None:      # the hint sent with it may still be in its queue
                    self._executor.spin_once(timeout_sec=HINT_S)
                if self._status is not None and self._hint is not None:
                    status = self._status.status[0]
                    self._status, self._until = None, math.inf
                    yield Status(status.level, {brief_line(kv.key): brief_line(kv.value)
                                                for kv in status.values[:MAX_VALUES]}, self._hint)
        except ExternalShutdownException:
            return
