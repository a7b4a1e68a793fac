# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Check of the noise model against the residuals of a fit.

``find_mismatch`` returns the factor on all sigmas, f of docs/method.md (S31), and the reasons.
``find_noise_cause`` finds out whether IMU noise above its grade is quantisation, vibration or
noise of the sensor itself.
"""

from collections.abc import Collection

import numpy as np

from odocal_ros.calib.number_text import differing
from odocal_ros.data.arrays import Array, Floats, map_rows, thinned
from odocal_ros.estimator.convergence import CONVERGENCE
from odocal_ros.estimator.factors.factor import ACCEL_NOISE, PARAMETER_COUNT
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.heading import Heading
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.imu import sample_noise, sensor_noise
from odocal_ros.estimator.leg import ExternalSamples, SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.residuals import fix_distance_text, SLIP_VARIANCE
from odocal_ros.estimator.state import HEADING
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import REMARK_SIGMAS
from odocal_ros.settings.nominal import grade_of, turn_on_bias

MAX_RATIO_TO_GRADE = 3.0      # judgement: limit of noise or bias over that of its grade
# limits of accelerometer outliers: size, m/s per second, share and number of seconds. Judgement:
# aliased vibration makes 0.05 to 0.13 in 1.3 % or more, kerbs under a robot at most 0.01, ordinary
# drives have outliers in 0.5 %; one or two shocks of a short drive are no vibration
MIN_ACCEL_OUTLIER, ACCEL_OUTLIER_SHARE, MIN_ACCEL_OUTLIERS = 0.01, 0.01, 3
MIN_QUANTISATION = 1e-5    # rad/s and m/s^2, physical: finer steps have no effect
QUANTISATION_SAMPLES = 20_000    # judgement: samples in which a quantisation step is sought
SAMPLES_PER_VALUE = 20  # judgement: a signal with more samples for each value is quantised
MIN_EXPLAINED_SHARE = 0.4  # judgement: share of the noise variance if quantisation causes it
# judgement: limit of the noise of single samples in motion over that at rest. Real drives:
# vibrating accelerometers 26 and 3.6, gyros 1.3 and 2.0
MAX_MOTION_RATIO = 3.0
MAX_NOISE_SAMPLES = 2**18    # judgement: their median has a sigma of 0.2 %; more only take memory
MIN_NOISE_SAMPLES = 100    # judgement: their median has a sigma of 15 %
# judgement: share of outliers among the fixes, and of intervals with slip
OUTLIER_SHARE_LIMIT = 0.15
SIDESLIP_LIMIT = 0.2    # m/sqrt(s), judgement
NAMES = {'gyro': 'gyro', 'accel': 'accelerometer'}
UNITS = {'gyro': 'rad/s/sqrt(Hz)', 'accel': 'm/s^2/sqrt(Hz)'}    # of white noise
REMEDIES = {
    'fixes': 'Check the fixes: sky view and antenna, or the localisation.',
    'slip': 'Drive gently on a firm, dry road, or use a wheel that is not driven.',
    'sideslip': 'Check odometer.lever_arm. Wheels that slide in turns also look like this: then '
                'drive wider turns.',
    'heights': 'Check the unit of heights in the fix driver.',
    'distances': 'Check unit and scale of the positions, such as of a map or a single camera.',
    'configured_heading': (
        "Check alignment.heading: it is the heading of the IMU's x axis, clockwise from true "
        'north.'),
    'published_heading': 'Check that this heading is an ENU yaw relative to true north. Magnetic '
                         'headings err by several degrees near steel: then use another source.'}


def find_mismatch(problem: Problem, fit: Fit, config: Config) -> tuple[float, list[Reason]]:
    """Return the factor on all sigmas, at least 1, and reasons."""
    level = fit.levels.sigmas()
    noise_ratio, noise_texts, remedy = _noise_over_grade(problem, level, config)
    # vibration is not white, and its spectrum is unknown
    is_noisy = noise_ratio > MAX_RATIO_TO_GRADE
    texts = noise_texts + _biases_over_grade(problem, fit, config)
    reasons = [Reason(
        Code.IMU_WORSE_THAN_GRADE, f'{" and ".join(texts)} times that of the {config.imu.grade} '
        f'grade (limit {MAX_RATIO_TO_GRADE:g}); the size estimated on this drive is used'
        + '. The noise may not be white; uncertainties were increased' * is_noisy,
        remedy)] if texts else []
    reasons += _accelerometer_outlier_reasons(fit)
    contradictions, step = _convergence_texts(fit)
    if is_noisy and not texts:
        contradictions[f'IMU noise is {differing(noise_ratio, MAX_RATIO_TO_GRADE)} times that of '
                       f'its grade (limit {MAX_RATIO_TO_GRADE:g}) and may not be white'] = remedy
    contradictions |= _level_texts(problem, fit, level)
    reasons += _heading_reasons(problem.external.get('heading'),
                                float(fit.state.constants[HEADING]))
    if contradictions:
        reasons.append(Reason(Code.MODEL_MISMATCH, '; '.join(contradictions),
                              ' '.join(contradictions.values())))
    # judgement: the size of a model error is unknown; a fit that has not converged may be off by
    # several times its last step
    return max(1.0, 2.0 * bool(contradictions or is_noisy), 4.0 * step), reasons


def _noise_over_grade(problem: Problem, level: dict[str, float],
                      config: Config) -> tuple[float, list[str], str]:
    """Return the largest ratio of IMU noise to the grade in use, texts, and the remedy or ''."""
    # the texts are on noises above the configured grade
    configured, used = (sensor_noise(grade) for grade in (grade_of(config.imu), problem.grade))
    # no reasons about an accelerometer that does not exist
    sensors = _sensors(problem)
    texts = [f'{NAMES[name]} noise is '
             f'{differing(level[name] / configured[name], MAX_RATIO_TO_GRADE)}'
             for name in sensors if level[name] > MAX_RATIO_TO_GRADE * configured[name]]
    remedy = find_noise_cause(problem, level, [
        name for name in sensors
        if level[name] > MAX_RATIO_TO_GRADE * min(used[name], configured[name])])
    return max(level[name] / used[name] for name in sensors), texts, remedy


def _sensors(problem: Problem) -> list[str]:
    """Return the sensors of the IMU, as in NAMES."""
    return ['gyro', 'accel'] if problem.leg.has_accelerometer else ['gyro']


def _biases_over_grade(problem: Problem, fit: Fit, config: Config) -> list[str]:
    """Return texts of the biases that exceed the grade."""
    gyro_stated, accel_stated = turn_on_bias(config.imu)
    biases = {'gyro': (fit.state.gyro_bias[0], problem.priors.gyro_bias_sigma, gyro_stated),
              'accel': (fit.state.accel_bias[0], problem.priors.accel_bias_sigma, accel_stated)}
    texts = []
    for name in _sensors(problem):
        bias, sigma, stated = biases[name]
        if np.max(np.abs(bias) / np.maximum(2 * sigma, stated)) > MAX_RATIO_TO_GRADE:
            texts.append(f'{NAMES[name]} bias is '
                         f'{differing(np.max(np.abs(bias) / sigma), MAX_RATIO_TO_GRADE)}')
    return texts


def _convergence_texts(fit: Fit) -> tuple[dict[str, str], float]:
    """Return text and remedy of a fit that has not converged, and its last step in sigmas."""
    if not fit.slowly_converging and fit.converged:
        return {}, 0.0
    steps = fit.solution.step_constants / np.sqrt(np.diag(fit.solution.covariance))
    step = float(np.abs(steps[:PARAMETER_COUNT]).max())      # of scale, yaw and pitch
    return {f'after {fit.iterations} iterations ' + (
        f'the estimates still changed by {step:.2g} sigma '
        f'(limit {CONVERGENCE.max_final_step:g})'
        if step > CONVERGENCE.max_final_step else 'the noise levels still changed'):
        'Check lever arms, time offsets and units, and drive with stops, starts and turns.'}, step


def _level_texts(problem: Problem, fit: Fit, level: dict[str, float]) -> dict[str, str]:
    """Return texts and remedies of outliers, slip, sideslip and height errors beyond limits."""
    texts = {}
    for subject, mask, remedy in (
            ('fixes that are outliers', fit.weighted[Fixes].weight[:, 0] < 0.5, 'fixes'),
            ('time with wheel slip', fit.variance_factors[:, 0] > SLIP_VARIANCE, 'slip')):
        share = float(mask.mean())
        if share > OUTLIER_SHARE_LIMIT:
            texts[f'{subject}: {100 * share:.0f} % (limit {100 * OUTLIER_SHARE_LIMIT:.0f} %)'
                  ] = REMEDIES[remedy]
    sideslip = max(level['side'], level['side_turn'])
    if sideslip > SIDESLIP_LIMIT:
        texts[f'sideslip at the odometer is {sideslip:.2f} m/√s (limit '
              f'{SIDESLIP_LIMIT:g})'] = REMEDIES['sideslip']
    if text := fix_distance_text(problem, fit):
        texts[text] = REMEDIES['distances']
    # m, judgement: receivers err by up to 10 m; with heights in cm slopes of 0.5 % make it 80 m
    limit = max(50.0, 4 * problem.height_sigma)
    if level['slow_up'] > limit:
        texts[f'the time-correlated height error of the fixes is {level["slow_up"]:.0f} m '
              f'(limit {limit:.0f} m)'] = REMEDIES['heights']
    return texts


def _accelerometer_outlier_reasons(fit: Fit) -> list[Reason]:
    """Return the reason for an accelerometer with many outliers."""
    factor = fit.variance_factors[:, ACCEL_NOISE]
    size = np.sqrt(factor * fit.levels['accel'])
    outlier = (factor > SLIP_VARIANCE) & (size > MIN_ACCEL_OUTLIER)
    share = float(outlier.mean())
    if share < ACCEL_OUTLIER_SHARE or outlier.sum() < MIN_ACCEL_OUTLIERS:
        return []
    return [Reason(
        Code.IMU_WORSE_THAN_GRADE, f'the accelerometer has outliers in {100 * share:.0f} % of the '
        f'time: velocity errors of up to {size.max():.2f} m/s per second; these seconds were '
        'down-weighted',
        'Likely cause: vibration above half the rate of the IMU (aliasing), or shocks. Use the '
        'low-pass filter of the IMU or a higher rate, and mount it firmly.')]


def _heading_reasons(heading: ExternalSamples | None, error: float) -> list[Reason]:
    """Return the reason for an external heading that contradicts the drive; error : rad."""
    if not isinstance(heading, Heading) or abs(error) < REMARK_SIGMAS * heading.constant_sigma:
        return []
    sigmas = abs(error) / heading.constant_sigma
    return [Reason(Code.MODEL_MISMATCH, f'the heading ({heading.source_name}) differs by '
                   f'{np.rad2deg(error):+z.2f} deg ({sigmas:.1f} sigma; limit '
                   f'{REMARK_SIGMAS:g}) from the heading estimated on this drive; it was '
                   'down-weighted',
                   REMEDIES['configured_heading' if heading.source_name == 'fixed' else
                            'published_heading'])]


def find_noise_cause(problem: Problem, level: dict[str, float], noisy: list[str]) -> str:
    """
    Return the cause of a noise that exceeds its grade, with the evidence, and the action.

    level : white noise of 'gyro' and 'accel', SI per sqrt(Hz).   noisy : which of them exceed
    their grade; empty: no text.
    """
    if not noisy:
        return ''
    quantised = {name: step for name, step in find_quantisation_steps(problem.leg, level).items()
                 if name in noisy}
    vibrating, texts = dict[str, str](), list[str]()
    in_motion, at_rest = sample_noise_by_motion(problem)
    for name in (name for name in noisy if name not in quantised):
        rest, motion, sensor = at_rest.get(name, 0.0), in_motion.get(name, 0.0), NAMES[name]
        if_normal = (f'If this is normal for this {sensor}, set imu.{name}_noise to '
                     f'{level[name]:.2g} ({UNITS[name]}).')
        if rest and motion > MAX_MOTION_RATIO * rest:
            vibrating[name] = (f'{sensor} samples vary {motion / rest:.0f} times as much '
                               'in motion as at rest')
        elif not rest and motion > MAX_MOTION_RATIO * level[name]:
            vibrating[name] = (f'{sensor} samples vary {motion / level[name]:.0f} times as '
                               'much as their means over seconds')
        elif MAX_MOTION_RATIO * rest > level[name]:
            texts.append(f'The {sensor} noise does not come from vibration: at rest it is '
                         f'similar. {if_normal}')
        else:
            reason = ('single samples vary less than their means over seconds' if at_rest else
                      'there is no standstill to compare with')
            texts.append(f'The cause of the {sensor} noise is unknown: {reason}. Mount the IMU '
                         f'firmly. {if_normal}')
    if vibrating:
        texts.insert(0, f'{_cause_of(vibrating, noisy)} is vibration: '
                     f'{", ".join(vibrating.values())}. Mount the IMU firmly and away from '
                     'engine and motors.')
    if quantised:
        steps = ' and '.join(f'the {NAMES[name]} has steps of ' + (
            f'{np.rad2deg(step):.3g} deg/s' if name == 'gyro' else f'{step:.3g} m/s^2')
            for name, step in quantised.items())
        texts.insert(0, f'{_cause_of(quantised, noisy)} is quantisation: {steps}. Set a finer '
                     'resolution or a smaller range in the IMU or its driver, if there is one.')
    return ' '.join(texts)


def _cause_of(names: Collection[str], noisy: Collection[str]) -> str:
    """Return the subject of a cause, with the sensors if others have another cause."""
    sensors = ' and '.join(NAMES[name] for name in names)
    return 'The cause' + f' of the {sensors} noise' * (len(names) < len(noisy))


def sample_noise_by_motion(problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
    """Return the white noise of samples in motion and at rest, by sensor; {}: too few samples."""
    leg, t_keyframes = problem.leg, problem.imu.t_keyframes
    intervals_at_rest = problem.at_rest[:-1] & problem.at_rest[1:]

    def kind_of_motion(t: Floats) -> Array:
        """Return 0 in motion, 1 at rest, 2 outside the keyframes."""
        interval = np.searchsorted(t_keyframes, t, side='right') - 1
        inside = (t >= t_keyframes[0]) & (t < t_keyframes[-1])
        interval = np.clip(interval, 0, len(intervals_at_rest) - 1)
        return np.where(inside, intervals_at_rest[interval], 2).astype(np.uint8)

    kinds = map_rows(kind_of_motion, leg.t_imu)
    in_motion, at_rest = (np.flatnonzero(kinds == kind)[:MAX_NOISE_SAMPLES] for kind in (0, 1))
    return (sample_noise(leg, in_motion) if len(in_motion) >= MIN_NOISE_SAMPLES else {},
            sample_noise(leg, at_rest) if len(at_rest) >= MIN_NOISE_SAMPLES else {})


def find_quantisation_steps(leg: SmootherLeg, level: dict[str, float]) -> dict[str, float]:
    """Return quantisation steps, rad/s, m/s^2, that explain white noise, SI per sqrt(Hz)."""
    T = float(np.median(np.diff(leg.t_imu[:QUANTISATION_SAMPLES])))
    steps = {'gyro': _step(leg.w_b), 'accel': _step(leg.f_b)}
    return {name: step for name, step in steps.items()
            if step**2 / 12 * T > MIN_EXPLAINED_SHARE * level[name]**2}


def _step(x: Floats) -> float:
    """Return the largest quantisation step of the columns of a signal, 0 if there is none."""
    rows = thinned(x, QUANTISATION_SAMPLES)
    largest = 0.0
    for column in rows.T:
        values = np.unique(np.round(column / MIN_QUANTISATION))
        if 2 < len(values) < len(rows) / SAMPLES_PER_VALUE:
            largest = max(largest, float(np.median(np.diff(values))) * MIN_QUANTISATION)
    return largest
