# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A terminal panel of ``~/status``: state, next action, and progress bars towards the limits."""

from math import degrees, isfinite, nan

from rich.console import Group
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from odocal_ros.forecast.forecast import REST_FORESEEN_S, three_digits
from odocal_ros.output.figures import with_sigma

COLOURS = {b'\x00': 'green', b'\x01': 'yellow', b'\x02': 'red', b'\x03': 'dim'}


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


def shares(status: dict[str, str]) -> dict[str, tuple[float, str]]:
    """Return the progress towards each limit: label -> (0 to 1, text)."""
    if status.get('state') == 'computing':
        return {}      # passes are in the hint, since their total is unknown
    driven, lacks = number(status, 'distance_m'), number(status, 'metres_to_least')
    stand = number(status, 'seconds_to_stand')
    found = {}
    if driven + lacks > 0:      # a leg
        found['path'] = driven / (driven + lacks), f'{lacks:.0f} m to go'
    found['standstill'] = 1 - stand / REST_FORESEEN_S, f'{stand:.0f} s to go'
    for name, unit in (('scale', 'ppm'), ('yaw', 'deg')):
        asked = number(status, f'asked_{name}_sigma_{unit}')
        sigma = number(status, f'predicted_{name}_sigma_{unit}') or _of_result(status)[name]
        # a sigma falls with the path length or its root: the ratio to the limit is a rough measure
        share = min(asked / sigma, 1.0) if sigma > 0 else 0.0
        known = f'{three_digits(sigma)} {unit}' if sigma > 0 else 'not known'
        found[name] = share, f'{known}, limit {three_digits(asked)} {unit}'
    return found


def _of_result(status: dict[str, str]) -> dict[str, float]:
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
    for label, (share, words) in shares(status).items():
        full = share >= 1.0
        grid.add_row(label, ProgressBar(1.0, max(share, 0.0), width=40, complete_style=(
            'green' if full else 'yellow'), finished_style='green'), 'OK' if full else words)
    return grid


def _values(status: dict[str, str]) -> str:
    state = status.get('state')
    prefix = 'estimate_' if state in ('recording', 'computing') else ''
    keys = (('scale factor', 'scale_factor', 'scale_factor_sigma', 1.0, ''),
            ('yaw', 'yaw_mounting_angle_rad', 'yaw_mounting_angle_sigma_rad', degrees(1), ' deg'))
    said = [f'{label} {with_sigma(found, number(status, prefix + sigma) or None, factor)}{unit}'
            for label, value, sigma, factor, unit in keys
            if (found := number(status, prefix + value))]
    provisional = 'provisional: ' if state == 'computing' and said else ''
    return provisional + ('   '.join(said) or 'no value yet')
