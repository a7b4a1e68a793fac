# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the search of CN104359492A found on each leg, where it was asked for, as lines."""

from odocal_ros.calib.result import LegResult


def search_lines(legs: tuple[LegResult, ...]) -> list[str]:
    """Return a table of each leg's search, empty where there was none."""
    lines = []
    for k, leg in enumerate(legs, 1):
        found = next((m.details['search'] for m in leg.methods.values()
                      if m.details.get('search')), None)
        if not found:
            continue
        best, after = found['best_row'], found['after']
        rows = ((f'best of {found["array"]["rows"]} ({found["array"]["name"]})', best, best),
                ('response surface', found['response_surface'], after),
                ('least squares', found['least_squares'], None))
        lines += ['search by positions alone (CN104359492A), without sigmas'
                  + (f', leg {k}' if len(legs) > 1 else ''),
                  f'  {"":24}  {"left":>10}  {"right":>10}  turn, deg  mean, m   max, m']
        for name, values, fit in rows:
            how = '' if fit is None else f'  {fit["mean"]:7.3f}  {fit["max"]:7.3f}'
            lines.append(f'  {name:24}  {values["scale_left"]:10.6g}  '
                         f'{values["scale_right"]:10.6g}  {values["heading_deg"]:+9.4f}{how}')
        if found['left_and_right_held_together']:
            lines.append('  the fixes do not separate left and right: their ratio is kept')
    return lines
