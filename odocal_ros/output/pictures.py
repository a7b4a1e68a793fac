# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pictures in files of their own: .png, .svg or .pdf, whole or not at all."""

import os
from pathlib import Path
from typing import Any

from odocal_ros.errors import BadUsage

PICTURES = ('.png', '.svg', '.pdf')


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, inches, that no window will show."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """
    Write a figure.

    Raises
    ------
    BadUsage
        The file cannot be written.

    """
    part = path.with_name(f'.{path.name}.part')
    try:
        ending = path.suffix[1:].lower()
        # without a date, the same result gives the same file
        figure.savefig(part, format=ending, dpi=150,
                       metadata={'Date': None} if ending == 'svg' else None)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise BadUsage(f'--plot {path}: cannot write it ({error.strerror})') from None
