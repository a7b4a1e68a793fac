"""The smoother on one leg: all samples at once, no outside heading."""

from dataclasses import replace
from itertools import count

import numpy as np

from odocal_ros.calib.smoother import smooth, smoother_leg
from odocal_ros.calib.smoother.outcome import refused
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.rotations import quat_at, quat_conjugate, quat_from_matrix, quat_multiply
from odocal_ros.pipeline.delay_note import note_delays
from odocal_ros.pipeline.tracks import as_configured, Paths
from odocal_ros.reasons import Code, Reason

NOT_FELT = Reason(Code.NO_METHOD, 'the smoother needs an accelerometer')
ONWARD = 0.2     # s, whose motion goes on beyond the data, by the delay


def smoother(run):
    """
    Run the smoother on a leg.

    run : LegRun, prepared.

    Returns
    -------
    MethodResult, and the antenna's Paths by the smoother's own attitude, the calibrated one with
    all values found, delays and lever arms too; t is as the fixes stamp it. None where refused.

    """
    if not run.inputs.felt:
        return refused((NOT_FELT,), run.inputs.scale_unit), None
    leg = smoother_leg(run.inputs, run.config, run.origin, run.fixes_n, run.spans, run.rough,
                       run.t_fit)
    passes = count(1)
    method = smooth(leg, run.config, lambda *_: run.passed(next(passes)))
    if method.estimates['scale_factor'].value is None:
        return method, None
    delays = {name: method.estimates[f'{name}_delay'] for name in ('gnss', 'odometer')}
    note_delays(run, {name: (e.value, e.sigma) for name, e in delays.items()
                      if e.value is not None}, method.estimates['scale_factor'].value)
    # the odometer's and the fixes' stamps are mended by the delays found, else by what is set
    late = {name: e.value or 0.0 for name, e in delays.items()}
    travel = run.inputs.travel
    epochs = _attitude(run, method.details)
    track = dead_reckon(*epochs, replace(travel, t=travel.t - late['odometer']))
    lever_b, f = _lever(method.estimates, run.config), method.details['f']
    before = run.path(as_configured(run, f, method.estimates), dead_reckon(*epochs, travel))
    return method, Paths(before, _late_path(track, f, lever_b, late['gnss']))


def _attitude(run, details):
    """
    Return the smoother's attitude at the Imu's rate: t (m,) s, q_nb (m, 4).

    Between keyframes the gyros turn it; where they end, beyond the fixes fitted, by them alone.
    """
    t_key, C_nb = details['key_t'], details['key_C_nb']
    t, q_nb = run.attitude_from(t_key[0], quat_from_matrix(C_nb[0]), details['gyro_bias'])
    off = quat_multiply(quat_from_matrix(C_nb), quat_conjugate(quat_at(t_key, t, q_nb)))
    return t, quat_multiply(quat_at(t, t_key, off), q_nb)


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
