"""The smoother on one leg: all samples at once, no outside heading."""

from odocal_ros.calib.smoother import smooth, smoother_leg
from odocal_ros.delay_note import note_delays
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.rotations import quat_from_matrix


def smoother(run):
    """
    Run the smoother on a leg.

    run : LegRun, prepared.

    Returns
    -------
    MethodResult, and the antenna's path (t to (n, 3), but for a constant) that dead reckoning
    makes from the attitude at the start with the values found; None where refused.

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
    track = dead_reckon(*run.attitude_from(start['t'], quat_from_matrix(start['C_nb']),
                                           start['gyro_bias']), run.inputs.travel)
    return method, run.path(method.details['f'], track)
