"""Several legs to one calibration: which legs count, what is said of the whole."""

from dataclasses import replace

from odocal_ros.calib.combine import combine_method
from odocal_ros.calib.judge import judge, nominal_scale
from odocal_ros.calib.result import Calibration
from odocal_ros.config import Config
from odocal_ros.nav.rotations import matrix_from_rpy, quat_from_matrix, rpy_from_matrix
from odocal_ros.reasons import Code, Reason, Verdict

PER_LEG = {Code.SCALE_SIGMA_TOO_LARGE, Code.YAW_SIGMA_TOO_LARGE, Code.SCALE_FAR_FROM_NOMINAL}


def combine(legs, config: Config) -> Calibration:
    """
    Combine legs of one vehicle.

    Parameters
    ----------
    legs : sequence of LegResult
        At least one. Rejected legs are left out while any other is left, and named.
    config : Config
        Limits, frames.

    Returns
    -------
    Calibration: what is published and written.

    """
    legs = tuple(legs)
    good = [leg for leg in legs if leg.verdict is not Verdict.REJECTED]
    twice = _driven_twice(good)
    good = [leg for leg in good if leg not in twice]
    used = good or legs
    reasons = _leg_reasons(legs, good, twice)
    names = dict.fromkeys(n for leg in used for n in leg.methods)
    methods = {n: combine_method(n, [leg.methods[n] for leg in used if n in leg.methods])
               for n in names}
    chosen = next(iter(methods.values()), None)
    estimates = {} if chosen is None else {
        name: replace(e, method=chosen.name) for name, e in chosen.estimates.items()}
    if chosen is not None:
        known = {(r.code, r.text) for r in reasons}
        nominal = nominal_scale(config, estimates['scale_factor'].unit)
        reasons += [r for r in (*chosen.reasons, *judge(estimates, nominal, config))
                    if (r.code, r.text) not in known and (r.code not in PER_LEG or len(legs) == 1)]
        reasons = list(dict.fromkeys(reasons))
    if len(good) < config.verdict.min_legs and good:
        reasons.append(Reason(Code.MORE_LEGS_NEEDED, f'{len(good)} good leg'
                              f'{"s" * (len(good) > 1)} of {config.verdict.min_legs}'))
    if chosen is None and not any(r.code.gravity is Verdict.REJECTED for r in reasons):
        reasons.append(Reason(Code.NO_METHOD, 'no method could be run'))
    quaternion, rpy = _imu_rotation(estimates, used[0].C_bi)
    return Calibration(tuple(reasons), estimates, methods, legs, quaternion, rpy)


def _driven_twice(legs):
    """Return legs that share more than a tenth of their time with one before: not independent."""
    twice = []
    for i, leg in enumerate(legs):
        for other in legs[:i]:
            shared = min(leg.stop_ns, other.stop_ns) - max(leg.start_ns, other.start_ns)
            if other not in twice and shared > 0.1 * (leg.stop_ns - leg.start_ns):
                twice.append(leg)
                break
    return twice


def _leg_reasons(legs, good, twice):
    """Return the legs' own reasons, numbered where there are several."""
    reasons = []
    for number, leg in enumerate(legs, 1):
        prefix = f'leg {number}: ' if len(legs) > 1 else ''
        own = [*leg.reasons, *(r for m in leg.methods.values() for r in m.reasons
                               if len(legs) == 1 or r.code not in PER_LEG)]
        if leg in twice:
            reasons.append(Reason(Code.LEGS_OVERLAP, f'{prefix}covers time that an earlier leg '
                                  'covers; not used'))
        elif good and leg not in good:
            why = '; '.join(r.text for r in own if r.code.gravity is Verdict.REJECTED)
            reasons.append(Reason(Code.LEG_REJECTED, f'{prefix}rejected and not used: {why}'))
        else:
            reasons += [Reason(r.code, prefix + r.text) for r in own]
    return reasons


def _imu_rotation(estimates, C_bi):
    """Return the static rotation base_link <- imu frame, x y z w and rpy, None without a yaw."""
    yaw = estimates.get('yaw_mounting_angle')
    pitch = estimates.get('pitch_mounting_angle')
    if yaw is None or yaw.value is None:
        return None, None
    small = [0.0, pitch.value if pitch is not None and pitch.value is not None else 0.0,
             yaw.value]
    C_vi = matrix_from_rpy(small) @ C_bi
    return (tuple(float(x) for x in quat_from_matrix(C_vi)),
            tuple(float(x) for x in rpy_from_matrix(C_vi)))

