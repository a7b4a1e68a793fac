"""What a person looks at to believe a leg: tracks, residuals, speed, scale by section, fixes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.rotations import matrix_from_quat

ROWS = 5000          # of each kind kept
WINDOW = 0.5         # s to either side, over which speed, turn rate and direction are taken
CREEP = 0.2          # m in the window, below which the direction of travel is that of before
SECTIONS = 10        # equal parts of the way
FEWEST_FIXES = 8     # of a section, for a scale and the likeness of its errors
SHORTEST = 10.0      # m, of a section
NEAR_MARK = 0.5      # s, fixes so far outside the marks still count as the leg's


@dataclass(frozen=True, eq=False)
class Sections:
    """
    Scale by section of the way: length by the fixes over length dead reckoned, corrected.

    begin, end : (k,) m driven.   ratio, sigma : (k,), NaN where the fixes do not tell.
    """

    begin: NDArray[np.float64]
    end: NDArray[np.float64]
    ratio: NDArray[np.float64]
    sigma: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evidence:
    """
    One leg as it can be drawn; t are seconds since the start mark, positions are in n.

    Residuals are dead-reckoned less fixed, along the vehicle's forward axis and to its left.
    """

    t: NDArray[np.float64]               # (m,)
    distance: NDArray[np.float64]        # (m,) m driven since the start mark
    speed: NDArray[np.float64]           # (m,) m/s, below zero when reversing
    yaw_rate: NDArray[np.float64]        # (m,) rad/s, counter-clockwise
    track_n: NDArray[np.float64]         # (m, 3) of the antenna, as calibrated
    track_before_n: NDArray[np.float64]  # (m, 3) as configured
    t_fix: NDArray[np.float64]           # (k,)
    fix_distance: NDArray[np.float64]    # (k,) m driven
    fix_n: NDArray[np.float64]           # (k, 3) NaN up: none
    fix_sigma: NDArray[np.float64]       # (k,) m, horizontal per axis
    fix_status: NDArray[np.int64]        # (k,) NavSatStatus
    residual: NDArray[np.float64]        # (k, 2) m along, across, as calibrated
    residual_before: NDArray[np.float64]  # (k, 2) as configured
    sections: Sections
    t_excluded: NDArray[np.float64]      # (x,) fixes not used
    excluded_because: tuple[str, ...]    # (x,)
    fixes: int                           # before decimation
    excluded: int


def evidence(leg, inputs, track, fixes_n, kept, pin, paths, config) -> Evidence:
    """
    Collect what the report draws of a leg.

    Parameters
    ----------
    leg : Leg
        For the fixes as sent.
    inputs : Inputs
        The screened leg.
    track : Track
        Epochs and attitude.
    fixes_n : (k, 3) array
        Usable fixes, m, at inputs.t_fix.
    kept : (k,) bool
        Those that are not absurdly far off.
    pin : MarkFix
        Where the paths are pinned.
    paths : (before, after)
        Callables t (n,) to the antenna's path, (n, 3) m but for a constant, as configured and as
        calibrated.
    config : Config
        Settings in force.

    Returns
    -------
    Evidence, at most 5000 rows of a kind.

    """
    inside = (track.t >= 0.0) & (track.t <= inputs.t_stop)
    t = track.t[inside]
    kept = kept & (inputs.t_fix >= -NEAR_MARK) & (inputs.t_fix <= inputs.t_stop + NEAR_MARK)
    t_fix, fix_n, covariance = inputs.t_fix[kept], fixes_n[kept], inputs.covariance_n[kept]
    before, after = (_pinned(path, pin) for path in paths)
    after_n, off_n = after(t), after(t_fix) - fix_n
    C_nb = matrix_from_quat(track.q_nb[inside])
    yaw = np.unwrap(np.arctan2(C_nb[:, 1, 0], C_nb[:, 0, 0]))
    sign = np.where(_over_window(t, track.s[inside]) < 0, -1.0, 1.0)
    distance = np.append(0.0, np.cumsum(np.hypot(*np.diff(after_n[:, :2], axis=0).T)))[:len(t)]
    forward = _forward_at(t_fix, t, after_n, sign)
    fix_distance = np.interp(t_fix, t, distance)
    sigma = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    status, t_out, because = _sent(leg, inputs, kept, config)

    m, k, x = (_few(n) for n in (len(t), len(t_fix), len(because)))
    return Evidence(
        t=t[m], distance=distance[m], speed=(_over_window(t, distance) * sign)[m],
        yaw_rate=_over_window(t, yaw)[m], track_n=after_n[m], track_before_n=before(t[m]),
        t_fix=t_fix[k], fix_distance=fix_distance[k], fix_n=fix_n[k], fix_sigma=sigma[k],
        fix_status=status[k], residual=_split(off_n, forward)[k],
        residual_before=_split(before(t_fix) - fix_n, forward)[k],
        sections=sections(fix_distance, after(t_fix), fix_n, sigma),
        t_excluded=t_out[x], excluded_because=tuple(because[i] for i in x),
        fixes=len(t_fix), excluded=len(because))


def _pinned(path, pin):
    return lambda t: pin.position_n + path(t) - path(np.array(pin.t))


def sections(way, reckoned_n, fix_n, sigma) -> Sections:
    """
    Return the scale of each tenth of the way, relative to the one used in dead reckoning.

    The dead-reckoned piece is turned, stretched and shifted onto its fixes by least squares; the
    stretch is the ratio, so no heading enters. Its sigma is widened where residuals exceed the
    stated sigma and where one fix errs like the next (by their lag-one correlation r as by
    sqrt((1 + r) / (1 - r)), the factor of a first-order process). Errors that last longer than a
    section do not stretch it and are not in the sigma.

    Parameters
    ----------
    way : (k,) array
        m driven at each fix, rising.
    reckoned_n, fix_n : (k, 3) arrays
        Dead-reckoned and fixed positions, m.
    sigma : (k,) array
        Of a fix, m per horizontal axis.

    """
    whole = way[-1] - way[0] if len(way) else 0.0
    count = int(min(SECTIONS, len(way) // FEWEST_FIXES, whole // SHORTEST))
    if count < 1:
        return Sections(*(np.empty(0) for _ in range(4)))
    edges = way[0] + whole * np.linspace(0.0, 1.0, count + 1)
    z, w = reckoned_n[:, 0] + 1j * reckoned_n[:, 1], fix_n[:, 0] + 1j * fix_n[:, 1]
    part = np.clip(np.searchsorted(edges, way, side='right') - 1, 0, count - 1)
    found = [_stretch(z[part == i], w[part == i], sigma[part == i]) for i in range(count)]
    ratio, error = np.array(found).T
    return Sections(edges[:-1], edges[1:], ratio, error)


def _stretch(z, w, sigma):
    """Return the stretch that takes z onto w (complex, m), and its sigma."""
    n = len(z)
    if n < FEWEST_FIXES:
        return np.nan, np.nan
    z, w = z - z.mean(), w - w.mean()
    spread = float(np.vdot(z, z).real)
    if spread <= 0.0:
        return np.nan, np.nan
    c = np.vdot(z, w) / spread
    left = w - c * z
    power = float(np.vdot(left, left).real)
    seen = power / (2 * n - 4)               # per axis; shift, turn and stretch are taken out
    likeness = float(np.vdot(left[:-1], left[1:]).real) / power if power > 0 else 0.0
    likeness = min(max(likeness + 1.0 / n, 0.0), 0.98)      # its bias by the fit, and no more
    wide = np.sqrt(max(seen, float(np.median(sigma))**2) * (1 + likeness) / (1 - likeness))
    error = wide / np.sqrt(spread)
    return (abs(c), error) if error < 1.0 else (np.nan, np.nan)


def _sent(leg, inputs, kept, config):
    """Return the status of the fixes kept, the times of the others, and why they are not."""
    fix, gnss = leg.fix, config.gnss
    t = (fix.stamp_ns - leg.start_ns) * 1e-9 + (gnss.time_offset - config.imu.time_offset)
    near = (t >= -NEAR_MARK) & (t <= inputs.t_stop + NEAR_MARK)
    row = {when: i for i, when in enumerate(t.tolist())}
    rows = np.array([row[when] for when in inputs.t_fix[kept].tolist()], int)
    near[rows] = False
    usable = np.isin(t, inputs.t_fix)
    sigma = np.sqrt(np.maximum(fix.covariance_n[:, 0, 0], fix.covariance_n[:, 1, 1]))
    out = np.flatnonzero(near)
    because = [
        f'status below {gnss.min_status}' if fix.status[i] < gnss.min_status else
        f'sigma above {gnss.max_sigma:g} m' if 0 < gnss.max_sigma < sigma[i] else
        'far off the track' if usable[i] and row[t[i]] == i else
        'stamp or position not believable' for i in out]
    return fix.status[rows], t[out], because


def _over_window(t, x):
    """Return the rate of x by time, over a second about each row: (m,)."""
    if len(t) < 2:
        return np.zeros(len(t))
    a, b = np.clip([t - WINDOW, t + WINDOW], t[0], t[-1])
    return (np.interp(b, t, x) - np.interp(a, t, x)) / np.maximum(b - a, 1e-9)


def _forward_at(t_new, t, track_n, sign):
    """Return the forward direction as complex numbers; at rest that of before: (k,)."""
    if not len(t):
        return np.ones(len(t_new), complex)
    z = (_over_window(t, track_n[:, 0]) + 1j * _over_window(t, track_n[:, 1])) * sign
    moving = np.flatnonzero(np.abs(z) * 2 * WINDOW > CREEP)
    if not len(moving):
        return np.ones(len(t_new), complex)
    before = np.searchsorted(moving, np.arange(len(t)), side='right') - 1
    angle = np.unwrap(np.angle(z[moving[np.maximum(before, 0)]]))
    return np.exp(1j * np.interp(t_new, t, angle))


def _split(off_n, forward):
    """Return horizontal offsets, (k, 3) in n, along and to the left of forward: (k, 2)."""
    z = (off_n[:, 0] + 1j * off_n[:, 1]) * np.conj(forward)
    return np.stack([z.real, z.imag], -1)


def _few(n):
    """Return at most ROWS row numbers, first and last included."""
    return np.unique(np.linspace(0, n - 1, min(n, ROWS)).round().astype(int)) if n else \
        np.empty(0, int)
