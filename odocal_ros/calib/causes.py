"""What makes a scale change, in words: for the comparison of results and for legs on their own."""

ANOTHER = 0.1    # relative change of a scale beyond what tyres do
FINE = 1e-3      # relative change below which it is said in ppm
TYRES = 'tyre pressure, wear, load or another tyre'
OTHER = 'another vehicle, gear, counter or unit: no tyre changes so much'


def cause_of_change(relative: float) -> str:
    """Return the likely cause of a relative change of the scale."""
    return OTHER if abs(relative) > ANOTHER else TYRES


def change_in_words(relative: float) -> str:
    """Return a relative change as people read it."""
    return f'{1e6 * relative:+.0f} ppm' if abs(relative) < FINE else f'{100 * relative:+.3g} %'
