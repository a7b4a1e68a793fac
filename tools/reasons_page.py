# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
``docs/reasons.md``: what each reason code means and what to do about it, made from the enum.

Gravity and remedy stand in ``reasons.py``; what a code means at length stands here and nowhere
else. Written by ``python -m tools.settings_page --write`` with the other pages.
"""

import textwrap

from odocal_ros.reasons import Code, Verdict

HEAD = """\
# Reasons

Made from `odocal_ros/reasons.py` by `python -m tools.settings_page --write`.

A result, a leg and the live status name what was seen by a code, a sentence with the figures, and
a remedy. How grave a code is:

* **rejects**: nothing should use the values, though they are shown and kept;
* **caution**: read the sentence, then use the values or drive again;
* **note**: worth knowing, changes nothing.

*odocal inspect* finds many of them before anything is calibrated. Times in the sentences are
seconds since the start mark.
"""
WEIGHTS = {Verdict.REJECTED: 'rejects', Verdict.CAUTION: 'caution', Verdict.ACCEPTED: 'note'}
# section: code: when it appears and what it means
MEANINGS: dict[str, dict[Code, str]] = {
    'The data that came': {
        Code.NO_IMU: 'No usable Imu message lies between the marks, or all its turn rates are '
        'zero. Without them there is no track.',
        Code.NO_ACCELEROMETER: 'Every acceleration of the Imu is zero, NaN, or said to be none '
        '(`linear_acceleration_covariance[0]` of -1), as of a yaw rate on a bus. The scale comes '
        'from gyro, counter and fixes, with 0.05 % in its sigma for slopes, which are not '
        'observed. Accelerations are not measured, so yaw and pitch mounting angle, slips and '
        'reversing are not determined.',
        Code.NO_ODOMETER: 'No usable odometer message lies between the marks: a wrong topic, a '
        'type that is read differently, or a driver that is not running.',
        Code.NO_FIX: 'No position lies between the marks, or none near one of the two marks.',
        Code.FIXES_UNUSABLE: 'There are fixes, but each one is without a position, of a status '
        'below `gnss.min_status`, or worse than `gnss.max_sigma`.',
        Code.BAD_ROWS_DROPPED: 'Some messages have no stamp, hold NaN or a value that no sensor '
        'gives, stand alone far from their neighbours, or are fixes far from all others. They '
        'were left out.',
        Code.ROWS_DAMAGED: 'Several messages of a topic hold values beyond any sensor, or, near '
        'such ones, far from those beside them: the recording itself is damaged. Others there '
        'may be wrong without showing it, so the rows about each clump were left out too.',
        Code.STAMPS_NOT_RISING: 'Stamps of one topic repeat or step back. The fewest messages '
        'were left out that leave the rest in order.',
        Code.IMU_GAP: 'The Imu is silent, or repeats one value, for longer than `leg.max_gap`. '
        'How the vehicle turned meanwhile is lost, and with it the track.',
        Code.LEG_CUT: 'The Imu was silent for longer than `leg.max_gap`: the leg is cut there, '
        'and its parts are calibrated as legs and combined. A part that does not carry, as one of '
        'a few seconds, is left out; where none does, the leg is rejected (`IMU_GAP`).',
        Code.TOPIC_GAP: 'Odometer or fixes are silent for more than five of their usual '
        'intervals, or the odometer begins late or ends early. Travel across the gap is bridged '
        'and its doubt is in the sigma.',
        Code.CLOCKS_DIFFER: 'The stamps of a topic are more than 0.5 s from those of the Imu that '
        'came at the same moment, or a clock was set during the leg. Positions and travel would '
        'be joined at the wrong times.',
        Code.DELAY_SEEN: 'Where the vehicle speeds up and slows down, the stamps of one sensor '
        'were found late or early against the others, by more than three sigmas and by enough to '
        'matter at the speed driven. The smoother estimates the delay and allows for '
        'it; other software that joins these sensors does not. Where no method estimates it, an '
        'odometer is named that would look like a slipping wheel only because it is late, or '
        'because its speed is low-pass filtered.',
        Code.ODOMETER_LATE: 'Odometer messages stopped for a moment and then came in a burst that '
        'made up for it: they were held up on the way, and their stamps, taken on arrival, are '
        'late. They were put where the rhythm of the sender has them, or where the travel before '
        'and after the burst does, and it is no wheel slip.',
        Code.COUNTER_RESET: 'The counter jumps in a way that no rollover explains: it was reset '
        'or lost power. What was driven in that moment is guessed, with a sigma.',
        Code.COUNTER_ROLLOVER: 'The counter reached its largest number and began anew. That is '
        'undone exactly.',
        Code.SPEED_COARSE: 'All speeds sent are multiples of one step, such as 1 km/h. Truncated, '
        'they are half a step too low on the mean, rounded they are not, and the steps do not say '
        'which. The smoother uses the moments at which the speed passes from one step to the '
        'next, and finds which; the sigma of the other methods holds half a step.',
        Code.SPEED_ON_CHANGE: 'The speed repeats one value until it has changed by a step: it '
        'lags while the vehicle speeds up or brakes. At least 30 % of the moving rows repeat the '
        'one before, and the least change is more than 0.6 of the tenth percentile of all.',
        Code.SPEED_FILTERED: 'Over intervals of a second the odometer departs from the vehicle as '
        'its acceleration changes, which a low-pass filter of the speed does and wheel slip does '
        'not. Many speed signals of cars are filtered over 0.2 to 0.5 s. Slip is what is left.',
        Code.COUNTER_COARSE: 'There are few counts a metre, so that the way is known to a count '
        'at each moment. Over a long drive that is little, and the sigma holds it; what happens '
        'within a few metres, such as a short slip, does not show.',
        Code.REVERSING_UNSIGNED: 'The vehicle reversed, but the counter went on counting up. '
        'Where the Imu shows it, off a stop, that stretch was counted backwards.',
        Code.ODOMETER_REVERSED: 'The track runs against the fixes by half a turn: positive counts '
        'mean backwards, or the Imu faces backwards. Or speeding up pushes the Imu backwards.',
        Code.ODOMETER_STILL: 'The fixes move on, the counter stays: from the start, or for 100 m '
        'and more of the drive.',
        Code.IMU_UNITS: 'Gravity is not 9.8 m/s^2, or the gyro turns much farther or faster than '
        'a vehicle does: g, deg/s or another unit.',
        Code.IMU_LOOKS_Z_DOWN: 'Gravity shows on -z, as on an Imu whose axes are '
        'forward-right-down. It was turned over for this result.',
        Code.IMU_AXES: 'Gravity shows on another axis than z, or speeding up pushes the Imu to a '
        'side: the body frame is not forward-left-up.',
        Code.IMU_WORSE_THAN_GRADE: 'The Imu errs more than its grade. The smoother takes what the '
        'drive shows instead; what rests on the grade alone, as the sigmas of the other methods, '
        'is too small.',
        Code.IMU_AXES_SKEW: 'Axes of the Imu are farther from right angles than its grade has '
        'it. The fit holds that; a drawing of the housing is worth the less.',
        Code.LEVER_ARM_OFF: 'Where the vehicle turns and leans, a sensor moves as if it sat '
        'decimetres from where the settings have it. Sliding in turns is not modelled: of a '
        'vehicle that steers by it the point found is where it slides least, not where the wheel '
        'is.',
        Code.GYRO_SIGN: 'Where the fixes turn left the gyro turns right.',
        Code.BAG_TRUNCATED: 'A recording was not ended properly. What the file holds was read.',
        Code.STOP_MARK_MISSING: 'The node marked the start of the leg, but the recording ends '
        'before its stop mark: a node or a computer that was killed, or a bag stopped too early. '
        'The leg was taken to end at the last sample that all topics have, where the vehicle need '
        'not stand.',
        Code.FRAME_REPLACED: 'The header of the Imu names a frame that TF does not take (TF takes '
        'letters, digits and `_ . / -`, and no `/` at the beginning). The files for TF name '
        'another one, as the sentence says.',
        Code.COVARIANCE_UNKNOWN: 'Fixes come without a covariance, or with zero or NaN in it; '
        '`gnss.default_sigma` was taken.',
        Code.FIXES_NOISIER_THAN_SAID: 'The fixes stray from the track farther than the covariance '
        'that they claim. The sigma was made to match what is seen.',
        Code.VELOCITY_UNUSABLE: 'Displacements by the velocity were compared with those between '
        'fixes, 10 s apart. They differ by more than 10 % in size or direction. Usual causes are '
        'north and east swapped, axes of the vehicle, a speed without direction, and km/h.',
    },
    'The drive': {
        Code.NO_STANDSTILL: 'There is no rest before the start mark. Level and gyro bias then '
        'come from the first half minute of driving and from the grade, with larger sigmas.',
        Code.LEG_TOO_SHORT: 'Less than `leg.min_distance` was driven, the fixes stay in one '
        'place, or the fixes are too coarse for so short a way.',
        Code.CHORD_TOO_SHORT: 'The straight line between start and end is less than a fifth of '
        'the way driven: a loop, or there and back. End points say nothing about such a way.',
        Code.SPEED_TOO_LOW: 'The vehicle never reached `leg.min_speed`. At a crawl, latency and '
        'coarse counts weigh most and the tyre rolls otherwise than on the road.',
        Code.LEG_NOT_STRAIGHT: 'More than a tenth of the way was driven in turns '
        '(`leg.max_yaw_rate`), where wheels run ways of their own.',
        Code.TRACK_MISMATCH: 'Even with the calibrated values the track is farther from the fixes '
        'than noise, drift and 0.2 % of the distance explain. Something else is wrong. Or the '
        'direction of travel flips by half a turn from one piece of the drive to the next, and '
        'the fixes stay back: the vehicle reversed, and the odometer counted upwards.',
        Code.CHECK_WORSE: 'Of pieces of 100 m, 500 m or 1 km, each begun anew at a fix, the track '
        'with the calibrated values ends farther from the fixes than the one without, beyond '
        'chance. Both have the same attitude, so the values are to blame: slip, bad fixes or a '
        'delay went into them.',
        Code.WHEEL_SLIP: 'Over a few seconds the wheel turned farther, or less far, than the '
        'vehicle accelerated, or the two wheels do not fit the turn.',
        Code.SCALE_VARIES: 'Tyres grow with speed and as they warm: the scale is not one number '
        'in this leg. What is given is its mean over the way driven; `scale_by_speed` and '
        '`scale_by_time` are its slopes.',
        Code.FIXES_SMOOTHED: 'Positions follow accelerations as a filter does, later and rounder '
        'than a delay alone would have them, or overshoot as a filter of position and velocity '
        'does.',
        Code.FIXES_FOLLOW_ODOMETER: 'Over seconds the fixes travel by another scale than over '
        'minutes, as those of a receiver do that is fused with a wheel speed of its own. Limits: '
        '5 of its sigmas and 0.05 %.',
    },
    'The estimate': {
        Code.YAW_NOT_SEPARABLE: 'End points see the sum of initial heading and yaw mounting '
        'angle. The only heading here is the course over ground, or one less certain than the '
        'yaw is asked to be. The scale is not touched by it.',
        Code.GYROCOMPASS_REFUSED: 'The heading was to come from the turning of the Earth, but the '
        'gyro bias is too large or the rest too short for it, or what the gyro shows at rest is '
        'not that turning: its grade is set too good.',
        Code.HEADING_UNAVAILABLE: 'The heading source that was asked for gave nothing usable; the '
        'course over ground was taken.',
        Code.PITCH_NOT_DETERMINED: 'The fixes give no height, or none good enough: the pitch is '
        'not given.',
        Code.SCALE_FAR_FROM_NOMINAL: 'The scale is farther from the nominal one than '
        '`odometer.max_scale_deviation`: a unit, a gear or a wheel size is not as configured.',
        Code.YAW_FAR_FROM_NOMINAL: 'The yaw mounting angle is more than 20 deg from the nominal '
        'one: the Imu sits otherwise than configured, or the heading is wrong.',
        Code.SCALE_SIGMA_TOO_LARGE: 'The sigma of the scale is larger than '
        '`verdict.max_scale_sigma`. The value is right within it. The error budget names what '
        'makes it so large.',
        Code.YAW_SIGMA_TOO_LARGE: 'The sigma of the yaw is larger than `verdict.max_yaw_sigma`. '
        'The value is right within it.',
        Code.PLANES_DISAGREE: 'The scale by the textbook ratio of chords, in a map plane or on '
        'the ellipsoid, is not the one that was solved for: a check of the computation.',
    },
    'Left and right wheel': {
        Code.ODOMETER_CHOSEN: 'A message holds several values (joints, or an array) and no '
        'setting says which are the wheels. Joints were chosen by their names; of two values '
        'of unknown sides the mean is taken, and left and right are not estimated.',
        Code.WHEELS_NOT_SEPARABLE: 'What was driven does not tell the left wheel from the right; '
        'on a straight line only their mean is seen.',
        Code.TRACK_WIDTH_NOT_DETERMINED: 'The distance between the wheels shows in turns only, '
        'and the heading at the end is about that at the start.',
        Code.TRACK_WIDTH_FAR_FROM_GIVEN: 'The turns of the wheels against the gyro make a track '
        'width that is more than 6 % from the one given: one of the two is wrong, and what a '
        'controller makes of turns with it.',
        Code.WHEELS_SWAPPED: 'In left turns the wheel named left goes farther. It is the outer '
        'one, the right one.',
        Code.WHEEL_DEAD: 'One wheel does not count, or sends nothing, while the other turns.',
        Code.WHEEL_REVERSED: 'One wheel counts down while the other counts up.',
        Code.WHEEL_COUNTERS_DIFFER: 'The two counters are not alike: another span, another kind, '
        'or one counts much more than the other.',
        Code.SEARCH_WIDENED: 'The best values lay on the edge of the range that was searched, '
        'which was then widened about them.',
        Code.SEARCH_NOT_SETTLED: 'The search ended before its values stood still, or away from '
        'what least squares find.',
    },
    'All the samples at once': {
        Code.NOT_CONVERGED: 'The equations of the drive could not be solved, or their solution is '
        'one that no IMU can have. There are no values.',
        Code.SCALE_NOT_DETERMINED: 'The drive says too little about the scale to state one.',
        Code.YAW_NOT_DETERMINED: 'The drive says too little about the yaw to state one.',
        Code.PARAMETER_NOT_DETERMINED: 'A further value, such as a lever arm or a delay, cannot '
        'be told from this drive; it stays as configured.',
        Code.MODEL_MISMATCH: 'What is left over after the fit is larger, or more regular, than '
        'the noise that was assumed. Of the two-point method: between its ends the track bends '
        "away from the fixes, by more than the gyro's grade and slow errors of the fixes would "
        'have it.',
        Code.METHOD_REJECTED: 'A method that goes before another, or alone tells left from right '
        'wheel, found that its values are not to be used; its first reason is given. The result '
        'is by the others.',
        Code.METHOD_FAILED: 'A method came upon something that it was not written for and broke '
        'off. Its values are unknown; the leg and the other methods go on. The command names a '
        'file with the trace.',
        Code.METHODS_DISAGREE: 'Two methods give values for the same leg that differ by more than '
        'three sigmas of their difference.',
    },
    'Several legs': {
        Code.LEGS_DISAGREE: 'The legs scatter more than their sigmas allow; in what, and of the '
        'smoother which leg most, is said. The sigma of the combination holds that.',
        Code.SCALE_CHANGED: 'With leg.automatic: a leg has another scale than those before, by '
        'more than 3 sigma of the difference, the walk by verdict.scale_drift_per_day among it. '
        'From that leg on the scale is another one; what legs share besides goes on.',
        Code.LEGS_UNLIKE: 'Two legs differ by more than 5 % in scale or 5 deg in yaw mounting, '
        'far beyond their sigmas, or their odometers are of different kinds (counts here, speeds '
        'there). No tyre does that: they are of two vehicles, or a setting or the mounting was '
        'changed in between. A mean of them would be of no vehicle.',
        Code.LEGS_OVERLAP: 'Two legs share time, so that they are not two opinions; the later one '
        'was not counted.',
        Code.LEG_REJECTED: 'A leg, or a method on it, was rejected and left out of the '
        'combination.',
        Code.MORE_LEGS_NEEDED: 'There are fewer good legs than `verdict.min_legs`.',
        Code.NO_METHOD: 'No method could be run on any leg.',
    },
}


def reasons_md() -> str:
    """Return the text of docs/reasons.md."""
    lines = [HEAD]
    for section, codes in MEANINGS.items():
        lines.append(f'## {section}\n')
        for code, meaning in codes.items():
            lines += [f'### {code.name}\n', *_wrapped(f'*{WEIGHTS[code.gravity]}.* {meaning}'), '',
                      *_wrapped(f'**Do:** {code.remedy}'), '']
    return '\n'.join(lines).rstrip() + '\n'


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 99, break_on_hyphens=False, break_long_words=False)
