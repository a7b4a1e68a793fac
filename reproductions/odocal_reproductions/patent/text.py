# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The table of the patent's embodiment as text for a terminal."""

from odocal_reproductions.patent.embodiment import Embodiment

HEAD = """\
CN104359492A, embodiment: errors of both wheel radii and of the heading by a search over
combinations, as printed, and as computed for a simulated town drive of ten minutes.
Nominal radius {radius:g} m (the patent states none); true errors {left:+g} m left,
{right:+g} m right, heading {heading:+g} deg. Distances are between the dead-reckoned
track and the fixes ({fix_noise})."""
COLUMNS = (f'  {"":22} {"left m":>9} {"right m":>9} {"head deg":>9} {"max m":>9} {"mean m":>9} '
           f'{"rms m":>9}')


def text_of(table: Embodiment, fix_noise: str, truth: tuple[float, float, float]) -> str:
    """Return the page that odocal patent prints; truth: (left, right, heading), m and deg."""
    surface, squares = table.response_surface, table.least_squares
    lines = [HEAD.format(radius=table.radius, left=truth[0], right=truth[1], heading=truth[2],
                         fix_noise=fix_noise), '', COLUMNS]
    lines += [f'  {row.name:22} {row.left:+9.5f} {row.right:+9.5f} {row.heading_deg:+9.4f} '
              f'{row.criteria["max"]:9.3f} {row.criteria["mean"]:9.3f} {row.criteria["rms"]:9.3f}'
              for row in table.rows]
    lines += ['', f'array of 81 rows: counts of pairs deviate by at most {table.imbalance:.2f}',
              f'(an orthogonal array has a multiple of {table.orthogonal_rows} rows)',
              f'response surface: {surface.iterations} fits, '
              f'{"" if surface.converged else "not "}converged, '
              f'{"" if surface.on_edge else "not "}on the edge of the range; R^2 '
              f'{surface.first.r_squared:.4f} first, {surface.last.r_squared:.7f} last',
              f'least squares: condition number {squares.condition:.3g}, correlation of left and '
              f'right {squares.correlation[0, 1]:+.7f};\n  right minus left has an uncertainty of '
              f'{table.sigma_radius:.3g} m']
    if not table.separable:
        lines.append('the fixes do not separate the wheels: use the lines "wheels together"')
    return '\n'.join(lines) + '\n'
