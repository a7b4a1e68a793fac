"""Values no sensor means: beyond any range, or alone against all their neighbours."""

import numpy as np

# far beyond any sensor in any unit in use (deg/s, mm/s^2), so that wrong units stay to be named
BEYOND = {'w_i': 1e3, 'f_i': 1e5, 'value': 1e15}
TURN_STEP = 1.0      # rad/s, least jump of one or two rows that may be a glitch
FORCE_STEP = 50.0    # m/s^2, the same: potholes stay
SPEED_STEP = 0.3     # of the top speed, the same
CLEAR = 20.0         # times the usual wander about the neighbours
CLOSE = 0.5          # s that five rows may span: over a longer time motion itself may jump


def beyond(name, column):
    """Tell which rows hold NaN, Inf or a value beyond any sensor: (n, ...) to (n,) bool."""
    column = np.asarray(column)
    if np.issubdtype(column.dtype, np.integer):
        return np.zeros(len(column), bool)
    with np.errstate(invalid='ignore'):
        usable = np.abs(column) <= BEYOND.get(name, np.inf)
    usable &= np.isfinite(column)
    return ~usable.all(axis=tuple(range(1, column.ndim)))


def alone(t, x, least):
    """
    Tell which rows stand alone, two in a row at most, against the two each side.

    Parameters
    ----------
    t : (n,) array
        Times, s, rising.
    x : (n, k) array
        Values.
    least : float
        Smallest jump that may be a glitch.

    Returns
    -------
    (n,) bool.

    """
    none = np.zeros(len(x), bool)
    if len(x) < 5 or not (np.abs(np.diff(x, axis=0)) > least).any():
        return none
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(x, ((2, 2), (0, 0)), 'edge'), 5, 0)
    off = np.abs(x - np.median(windows, axis=-1))
    usual = 1.4826 * np.median(off, axis=0)
    # rows beside a jump that lasts are near one half of their window, never far from its median
    jump = (off > np.maximum(least, CLEAR * usual)).any(axis=1)
    if not jump.any():
        return none
    span = t[np.minimum(np.arange(len(t)) + 2, len(t) - 1)] - t[np.maximum(np.arange(len(t)) - 2,
                                                                           0)]
    return jump & (span <= CLOSE)


def imu_glitches(t, w_i, f_i, imu):
    """Return which Imu rows hold a spike that no vehicle makes, by the imu settings' factors."""
    return (alone(t, w_i, TURN_STEP / max(imu.gyro_scale, 1e-12))
            | alone(t, f_i, FORCE_STEP / max(imu.accel_scale, 1e-12)))


def speed_glitches(t, speed):
    """Return which rows of an odometer that sends rates hold a spike no wheel makes."""
    if len(speed) < 20:
        return np.zeros(len(speed), bool)
    top = np.percentile(np.abs(speed), 95)
    return alone(t, speed[:, None], max(SPEED_STEP * top, 1e-12))
