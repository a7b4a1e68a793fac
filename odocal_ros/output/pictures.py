"""Pictures in files of their own: .png, .svg or .pdf, whole or not at all."""

import os
from pathlib import Path

from odocal_ros.errors import BadUsage

DPI = 150


def new_figure(width: float, height: float):
    """Return an empty figure, inches, that no window will show."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure, path: Path) -> None:
    """
    Write a figure.

    Raises
    ------
    BadUsage
        The file cannot be written.

    """
    part = path.with_name(f'.{path.name}.part')
    try:
        figure.savefig(part, format=path.suffix[1:].lower(), dpi=DPI)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise BadUsage(f'--plot {path}: cannot write it ({error.strerror})') from None
