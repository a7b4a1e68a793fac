"""The figure that holds legs and methods side by side."""

import math

from odocal_ros.calib.result import Calibration
from odocal_ros.output.plots_svg import BAND, BLUE, GREEN, GREY, PINK, RED, relative, sheet, svg
from odocal_ros.output.summary import DEG, known

STYLES = (('o', BLUE), ('s', RED), ('^', GREEN), ('D', PINK), ('v', 'black'), ('P', GREY))
MOST_LEGS = 40
YAW = 'yaw_mounting_angle'


def compared(calibration: Calibration, name: str) -> list[tuple]:
    """Draw scale and yaw by method and leg; empty where there is but one to show."""
    rows = [(f'all legs, {m.replace("_", " ")}', m, found.estimates)
            for m, found in calibration.methods.items()] if len(calibration.legs) > 1 else []
    for number, leg in enumerate(calibration.legs[:MOST_LEGS], 1):
        rows += [(f'leg {number}, {m.replace("_", " ")}', m, found.estimates)
                 for m, found in leg.methods.items()]
    panels = [(title, points, band) for title, points, band in (
        _scale(calibration, rows), _yaw(calibration, rows)) if len(points) > 1]
    return [_draw(rows, panels, name)] if panels else []


def _scale(calibration, rows):
    result = known(calibration.estimates, 'scale_factor')
    found = [(place, method, known(estimates, 'scale_factor'))
             for place, (_, method, estimates) in enumerate(rows)]
    found = [(place, method, e.value / result.value - 1, (e.sigma or 0.0) / abs(result.value))
             for place, method, e in found if e.value is not None and result.value]
    times, word = relative(max((abs(off) + sigma for _, _, off, sigma in found), default=0.0))
    band = (0.0, (result.sigma or 0.0) / abs(result.value) * times) if result.value else None
    return f'scale less result, {word}', [
        (place, method, off * times, sigma * times) for place, method, off, sigma in found], band


def _yaw(calibration, rows):
    result = known(calibration.estimates, YAW)
    points = []
    for place, (_, method, estimates) in enumerate(rows):
        e = known(estimates, YAW)
        if e.value is not None:
            points.append((place, method, e.value * DEG, (e.sigma or 0.0) * DEG))
    band = None if result.value is None else (result.value * DEG, (result.sigma or 0.0) * DEG)
    return 'yaw mounting angle, deg', points, band


def _draw(rows, panels, name):
    height = 0.75 + 0.24 * len(rows)
    figure, axes = sheet(len(panels) * height, len(panels), sharex=False)
    figure.subplots_adjust(left=0.27, hspace=0.75 / height, top=1 - 0.1 / (height * len(panels)))
    shapes = {m: STYLES[i % len(STYLES)]
              for i, m in enumerate(dict.fromkeys(m for _, m, _ in rows))}
    for ax, (title, points, band) in zip(axes, panels, strict=True):
        if band is not None and all(map(math.isfinite, band)):
            ax.axvspan(band[0] - band[1], band[0] + band[1], color=BAND, linewidth=0)
            ax.axvline(band[0], color=GREY, linewidth=0.8)
        for place, method, value, sigma in points:
            shape, colour = shapes[method]
            ax.errorbar(value, place, xerr=sigma, fmt=shape, color=colour, markersize=5,
                        capsize=3, linewidth=1.1)
        ax.set_yticks(range(len(rows)), [text for text, _, _ in rows])
        ax.set_ylim(len(rows) - 0.5, -0.5)
        ax.set_xlabel(title)
    says = ('Each bar is one sigma to either side; the grey band is the result. Legs share some '
            'errors (heading source, lever arms), so bars may overlap more than chance would have '
            'it.')
    return 'Side by side', says, svg(figure, f'{name}-compared', says)
