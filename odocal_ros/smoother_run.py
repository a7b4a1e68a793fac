"""The smoother on one leg: all samples at once, no outside heading."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.smoother import smooth, smoother_leg
from odocal_ros.delay_note import note_delays
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.rotations import quat_from_matrix

ONWARD = 0.2     # s, whose motion goes on beyond the data, by the delay


def smoother(run):
    """
    Run the smoother on a leg.

    run : LegRun, prepared.

    Returns
    -------
    MethodResult, and the antenna's path (t to (n, 3), but for a constant) that dead reckoning
    makes from the attitude at the start with all values found, delays and lever arms too; t is as
    the fixes stamp it. None where refused.

    """
    leg = smoother_leg(run.inputs, run.config, run.origin, run.fixes_n, run.spans, run.rough,
                       run.t_fit)
    method = smooth(leg, run.config)
    if method.estimates['scale_factor'].value is None:
        return method, None
    delays = {name: method.estimates[f'{name}_delay'] for name in ('gnss', 'odometer')}
    note_delays(run, {name: (e.value, e.sigma) for name, e in delays.items()
                      if e.value is not None})
    start = method.details['start']      # its gyro bias is taken as constant
    # the odometer's and the fixes' stamps are mended by the delays found, else by what is set
    late = {name: e.value or 0.0 for name, e in delays.items()}
    travel = run.inputs.travel
    track = dead_reckon(*run.attitude_from(start['t'], quat_from_matrix(start['C_nb']),
                                           start['gyro_bias']),
                        replace(travel, t=travel.t - late['odometer']))
    lever_b, f = _lever(method.estimates, run.config), method.details['f']

    return method, _late_path(track, f, lever_b, late['gnss'])


def _late_path(track, f, lever_b, late):
    """Return the path by stamps that are so many s late; beyond the track's ends it runs on."""
    def path(t):
        t = t - late
        inside = np.clip(t, track.t[0], track.t[-1])
        beyond = np.clip(t - inside, -abs(late), abs(late))
        P = track.at(inside)
        before = track.at(inside - np.copysign(ONWARD, beyond))
        P = P + (P - before) * (np.abs(beyond) / ONWARD)[..., None, None]
        return P @ f + track.C_nb_at(inside) @ lever_b
    return path


def _lever(estimates, config):
    """Return the antenna from the odometer's point as found, else as set: (3,) m, in b."""
    antenna, odometer = (
        np.array([given if (e := estimates[f'{name}_lever_arm_{axis}']).value is None else e.value
                  for axis, given in zip('xyz', section.lever_arm, strict=True)])
        for name, section in (('antenna', config.gnss), ('odometer', config.odometer)))
    return antenna - odometer
