# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Common parts of all figures: style, thinning of lines, units of axes, output as SVG or file."""

from contextlib import AbstractContextManager
import io
from itertools import pairwise
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.errors import BadUsage
from odocal_ros.safe_io.atomic_files import whole_file

# Okabe and Ito's colours, distinguishable with colour blindness
BLUE, RED, GREEN, PINK = '#0072B2', '#D55E00', '#009E73', '#CC79A7'
GREY, BAND = '0.45', '0.90'
MAX_POINTS = 1200   # judgement: points of a line; a figure has fewer pixels
MAX_MARKS = 400     # judgement: number of single marks
STYLE: dict[Any, Any] = {
    'svg.fonttype': 'none', 'svg.hashsalt': 'odocal', 'font.family': ['DejaVu Sans'],
    'font.size': 9.0, 'axes.labelsize': 9.0, 'legend.fontsize': 8.5, 'axes.axisbelow': True,
    'xtick.labelsize': 8.5, 'ytick.labelsize': 8.5, 'axes.spines.top': False,
    'axes.spines.right': False, 'axes.unicode_minus': True, 'path.simplify': True,
    'legend.frameon': False, 'lines.linewidth': 1.4, 'mathtext.default': 'regular'}
PICTURES = ('.png', '.svg', '.pdf')


class Drawing(NamedTuple):
    """A figure of a page."""

    title: str
    description: str
    svg: str      # element for HTML


def apply_style() -> AbstractContextManager[None]:
    """Return a context with the style, in which figures are made and written."""
    from matplotlib import rc_context
    return rc_context(STYLE)


def new_figure_column(height: float, rows: int = 1, sharex: bool = True,
                      heights: list[float] | None = None) -> tuple[Any, NDArray[Any]]:
    """Return a figure of ``height`` inch and its axes in a column, of relative ``heights``."""
    from matplotlib.figure import Figure
    width = 5.6    # inch
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, 1, sharex=sharex, squeeze=False, height_ratios=heights)[:, 0]
    figure.subplots_adjust(left=0.135, right=0.975, top=1 - 0.32 / height,
                           bottom=0.48 / height, hspace=0.16)
    for ax in axes:
        ax.grid(color='0.90', linewidth=0.6)
    return figure, axes


def add_legend(figure: Any, axes: Any) -> None:
    """Add a legend of axes above the figure."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc='upper center', ncols=3, borderpad=0.1,
                      handlelength=2.2, columnspacing=1.4, borderaxespad=0.2)


def drawing(figure: Any, name: str, title: str, description: str) -> Drawing:
    """
    Return a figure made under ``apply_style`` as an svg element with its texts.

    name : prefix of the ids in the element, since a page has many figures.
    """
    from html import escape

    from matplotlib.backends.backend_svg import FigureCanvasSVG
    output = io.StringIO()
    FigureCanvasSVG(figure).print_svg(output, metadata={
        'Creator': None, 'Date': None, 'Format': None, 'Type': None})
    text = output.getvalue()
    text = text[text.index('<svg'):].strip()
    text = re.sub(r'<defs>\s*<style.*?</style>\s*</defs>\s*', '', text, count=1, flags=re.DOTALL)
    text = re.sub(r'<!--.*?-->\s*', '', text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'((?:xlink:)?href="|url\()#', rf'\1#{name}-', text)
    head, _, rest = text.partition('>')
    box = re.findall(r'viewBox="[^"]*"', head)[0]      # without width and height: it scales
    return Drawing(title, description, f'<svg {box} role="img" aria-label="'
                   f'{escape(f"{title}. {description}", quote=True)}">{rest}')


def peak_rows(y: Floats) -> Ints:
    """
    Return rows of a line y, (n,) or (n, columns), that draw it like all rows: (m,) int.

    They are both ends, and the smallest and the largest value in each of many equal blocks.
    """
    y = np.asarray(y, float)
    n = len(y)
    if n <= MAX_POINTS:
        return np.arange(n)
    columns = np.nan_to_num(y.reshape(n, -1).T)
    edges = np.linspace(0, n, MAX_POINTS // (2 * len(columns)) + 1).astype(int)
    kept_rows = {0, n - 1}
    for begin, end in pairwise(edges.tolist()):
        for block in columns[:, begin:end]:
            kept_rows |= {begin + int(block.argmin()), begin + int(block.argmax())}
    return np.array(sorted(kept_rows))


def even_rows(n: int, limit: int = MAX_MARKS) -> Ints:
    """Return at most ``limit`` evenly spaced rows of n, both ends included: (m,) int."""
    return np.unique(np.linspace(0, max(n - 1, 0), min(n, limit)).round().astype(int))


def length_unit(metres: float) -> tuple[float, str]:
    """Return the unit for lengths up to ``metres``, and the factor from m to it."""
    return (1e-3, 'km') if metres > 3000 else (1.0, 'm')


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, inches, without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure; raise BadUsage if that fails."""
    ending = path.suffix[1:].lower()
    data = io.BytesIO()
    # without a date, the same result gives the same file
    figure.savefig(data, format=ending, dpi=150,
                   metadata={'Date': None} if ending == 'svg' else None)
    try:
        with whole_file(path) as file:
            file.write(data.getvalue())
    except OSError as error:
        raise BadUsage(f'{path}: cannot be written ({error.strerror or error})') from None
