"""odocal paper: tables 1 to 4 of Shi et al. 2015, computed beside printed."""

from pathlib import Path

from odocal_ros.errors import BadUsage
from odocal_ros.offline.say import say

HELP = 'reproduce tables 1-4 of the two-point paper'
PICTURES = ('.png', '.svg', '.pdf')


def add_arguments(parser) -> None:
    """Declare the options."""
    parser.add_argument('--json', action='store_true', help='print one JSON object instead')
    parser.add_argument('--plot', metavar='FILE', help='draw the track and the growth of each '
                        'error over time: .png, .svg or .pdf')


def run(args) -> int:
    """Compute, print, draw; return 0."""
    picture = None if args.plot is None else Path(args.plot)
    if picture is not None:
        check_picture(picture)
    from odocal_ros.paper.tables import compute
    tables = compute()
    if picture is not None:
        from odocal_ros.output.paper_plot import draw
        draw(tables, picture)
    if args.json:
        import json
        say(json.dumps(tables.as_dict(), indent=2, allow_nan=False))
    else:
        from odocal_ros.paper.text import text_of
        say(text_of(tables), end='')
        if picture is not None:
            say(f'\n{picture}: the track and the growth of each error')
    return 0


def check_picture(path: Path) -> None:
    """Refuse before computing what could not be drawn after it."""
    if path.suffix.lower() not in PICTURES:
        raise BadUsage(f'--plot {path}: want a name that ends in {", ".join(PICTURES)}')
    if not path.parent.is_dir():
        raise BadUsage(f'--plot {path}: there is no folder {path.parent}; make it first')
    if path.is_dir():
        raise BadUsage(f'--plot {path}: is a folder, want a file')
    from importlib.util import find_spec
    if find_spec('matplotlib') is None:
        raise BadUsage('--plot needs matplotlib: pip install matplotlib (or apt install '
                       'python3-matplotlib)')
