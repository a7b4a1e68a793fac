"""The smoother on one leg: all samples at once, no outside heading."""

from odocal_ros.calib.smoother import smooth, smoother_leg
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.rotations import quat_from_matrix
from odocal_ros.nav.strapdown import attitude

EPOCH_RATE = 50.0       # Hz, least rate of attitude epochs


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
    return method, run.path(method.details['f'], _track(run, method.details['start']))


def _track(run, start):
    """Return the track dead reckoned from the smoothed start, its gyro bias taken as constant."""
    inputs = run.inputs
    pick = (inputs.t_imu >= start['t'] - 1e-9) & (inputs.t_imu <= inputs.t_stop + 1.0)
    t, w_b = inputs.t_imu[pick], inputs.w_b[pick]
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
    epochs, q_nb = attitude(t, w_b - start['gyro_bias'], quat_from_matrix(start['C_nb']),
                            earth_rate_n(run.origin.latitude), max(1, int(rate / EPOCH_RATE)))
    return dead_reckon(epochs, q_nb, inputs.travel)
