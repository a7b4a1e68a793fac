"""Numbers as people read them: digits cut to the sigma, units converted at this rim only."""

import math


def decimals(sigma: float) -> int:
    """Return the decimal places that show a sigma with two digits."""
    if not (math.isfinite(sigma) and sigma > 0):
        return 6
    return max(0, min(12, 1 - math.floor(math.log10(sigma))))


def with_sigma(value: float, sigma: float | None, factor: float = 1.0,
               signed: bool = False) -> str:
    """Return 'value ± sigma', both times ``factor``, with the digits that the sigma leaves."""
    if not math.isfinite(value):
        return 'unknown'
    value *= factor
    if sigma is None or not math.isfinite(sigma):
        return f'{value:+.6g}' if signed else f'{value:.6g}'
    sigma *= factor
    places = decimals(sigma)
    return f'{value:{"+" if signed else ""}.{places}f} ± {sigma:.{places}f}'


def two_digits(x: float) -> str:
    """Return a number with two digits that count, without an exponent where it is readable."""
    if not math.isfinite(x):
        return 'unknown'
    if x == 0 or not 1e-4 <= abs(x) < 1e7:
        return f'{x:.2g}'
    places = 1 - math.floor(math.log10(abs(x)))
    return f'{round(x, places):.{max(0, places)}f}'


def share(relative: float) -> str:
    """Return a relative sigma as people say it: ppm, or per cent from one on."""
    return f'{two_digits(100 * relative)} %' if relative >= 0.01 else (
        f'{two_digits(1e6 * relative)} ppm')


def length(metres: float) -> str:
    """Return a length with a sensible unit and number of digits."""
    if not math.isfinite(metres):
        return 'unknown'
    if abs(metres) >= 1e4:
        return f'{metres / 1000:.2f} km'
    if abs(metres) >= 100:
        return f'{metres:.0f} m'
    if abs(metres) >= 0.1:
        return f'{metres:.2f} m'
    return f'{metres * 1000:.3g} mm' if metres else '0 m'


def time_span(seconds: float) -> str:
    """Return a duration as people say it."""
    if seconds < 120:
        return f'{seconds:.1f} s'
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours} h {minutes:02d} min' if hours else f'{minutes} min {rest:02d} s'
