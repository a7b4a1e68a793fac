# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The odometer's track in a level frame, fitted to the fixes: scale, rotation and its change."""

import numpy as np

from odocal_ros.calib.check import steady
from odocal_ros.calib.reversal import pieces
from odocal_ros.data.arrays import Complexes, Floats
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.sums import Intervals
from odocal_ros.nav.rotations import wrap


class FittedTrack:
    """
    The odometer's track in the level frame, x of b taken as forward, fitted to the fixes.

    X : (N,) travel units, complex.   K : m per unit.   chi : rad, rotation to the fixes at the
    first keyframe.   slope : rad/s, its change, None without fixes.   place : (N,) m, east + i
    north.   height : (N,) m.   spread : m, scatter of the fixes about the track.
    """

    def __init__(self, leg: SmootherLeg, t: Floats, C_Lk: Floats, sums: Intervals) -> None:
        step = (C_Lk[:-1] @ sums.S)[:, :2, 0]
        self.X = np.concatenate([[0.0], np.cumsum(step[:, 0] + 1j * step[:, 1])])
        inside = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
        t_fix, fix = leg.t_fix[inside], leg.fixes_n[inside]
        sigma = float(np.sqrt(np.median(leg.covariance_n[:, 0, 0])))
        z = fix[:, 0] + 1j * fix[:, 1]
        at = np.interp(t_fix, t, self.X)
        self.K, self.slope = leg.rough_scale, None
        # weighted by length of the odometer: a jump of the fixes does not get a larger weight
        moved, gone = np.diff(at), np.diff(z)
        self.chi = float(np.angle((moved.conj() * gone / np.maximum(np.abs(gone), sigma)).sum()))
        for _ in range(2):
            laid = self.K * np.exp(1j * self.chi) * at
            apart = np.stack([(laid - z).real, (laid - z).imag], -1)
            keep, noise = steady(apart, sigma)
            flat = np.stack([at.real, at.imag], -1) * self.K
            found = pieces(flat[keep], fix[keep, :2], t_fix[keep], noise)
            middle, off = found.t, -found.off
            if not len(middle):
                break
            centre = float(np.angle(np.exp(1j * off).sum()))
            off = np.unwrap(centre + wrap(off - centre)) if len(off) > 1 else off
            self.chi, self.slope = _line(middle, off)
            at_mid = np.interp(middle, t_fix, np.arange(len(t_fix)))
            k = np.unique(np.round(at_mid).astype(int))
            run = np.abs(np.diff(at[k]))
            chord = np.abs(np.diff(z[k]))
            if (run > 0).any():
                self.K = float(np.median(chord[run > 0] / run[run > 0]))
        self.bend = 0.0 if self.slope is None else self.slope
        self.chi_at = self.chi + self.bend * (t - t[0])
        self.place = self._place(t, t_fix, z)
        self.height = _smooth(t, t_fix, np.where(np.isnan(fix[:, 2]), 0.0, fix[:, 2]))
        laid = np.interp(t_fix, t, self.place)
        self.spread = max(float(np.median(np.abs(laid - z))) / 1.18, 1e-3)

    def _place(self, t: Floats, t_fix: Floats, z: Complexes) -> Complexes:
        """Return the track plus the smoothed difference from the fixes: (N,) m, east + i north."""
        steps = np.diff(self.X) * np.exp(1j * (self.chi_at[:-1] + self.chi_at[1:]) / 2) * self.K
        path = np.concatenate([[0.0], np.cumsum(steps)])
        off = z - np.interp(t_fix, t, path)
        return path + _smooth(t, t_fix, off.real) + 1j * _smooth(t, t_fix, off.imag)


def _line(t: Floats, y: Floats) -> tuple[float, float]:
    """Return value at the first time and slope of a line through points, by medians."""
    if len(t) < 3:
        return float(np.median(y)), 0.0
    i, j = np.triu_indices(min(len(t), 400), 1)
    pick = np.linspace(0, len(t) - 1, min(len(t), 400)).astype(int)
    dt = t[pick][j] - t[pick][i]
    far = dt > (t[-1] - t[0]) / 4
    slope = float(np.median((y[pick][j] - y[pick][i])[far] / dt[far]))
    return float(np.median(y - slope * (t - t[0]))), slope


def _smooth(t: Floats, t_fix: Floats, y: Floats) -> Floats:
    """Return medians over windows of 20 s, interpolated to t, without the effect of outliers."""
    if not len(y):
        return np.zeros(len(t))
    cells = np.floor((t_fix - t_fix[0]) / 20.0).astype(int)
    at = np.unique(cells)
    middle = [np.median(t_fix[cells == c]) for c in at]
    out: Floats = np.interp(t, middle, [np.median(y[cells == c]) for c in at])
    return out
