# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Reason codes: what can be said about a leg or a calibration, how grave it is, what to do."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any


class Verdict(Enum):
    """What a result is good for; ``rejected`` results keep every value they computed."""

    ACCEPTED = 'accepted'
    CAUTION = 'caution'
    REJECTED = 'rejected'

    @staticmethod
    def worst(verdicts: Iterable['Verdict']) -> 'Verdict':
        """Return the gravest of many, accepted if there are none."""
        return max(verdicts, key=GRAVITY.index, default=Verdict.ACCEPTED)


GRAVITY = tuple(Verdict)      # the gravest last
NOTE, CAUTION, REJECT = Verdict.ACCEPTED, Verdict.CAUTION, Verdict.REJECTED


class Code(Enum):
    """A reason code: (gravity, remedy)."""

    # the data that came
    NO_IMU = REJECT, 'Check the Imu topic and its QoS, or name it with --imu-topic.'
    NO_ACCELEROMETER = CAUTION, ('For yaw and pitch take an Imu that sends its acceleration too; '
                                 'drive level ground, hills lengthen the way unseen.')
    NO_ODOMETER = REJECT, 'Check the odometer topic and odometer.type, or use --odometer-topic.'
    NO_FIX = REJECT, 'Drive under open sky and wait for a position before the start mark.'
    FIXES_UNUSABLE = REJECT, ('Wait for a valid position; loosen gnss.min_status or '
                              'gnss.max_sigma if these fixes are good.')
    BAD_ROWS_DROPPED = NOTE, 'Mend the driver that sends them; the other rows were used.'
    ROWS_DAMAGED = CAUTION, ('Copy the recording again from where it was made, or drive again; '
                             'the rows about the damage were left out.')
    STAMPS_NOT_RISING = NOTE, 'Mend the clock of the sender; the rows in order were used.'
    IMU_GAP = REJECT, ('Mend the Imu stream (QoS depth, CPU load, cable), or mark a leg beside '
                       'the gap; leg.max_gap is the limit.')
    LEG_CUT = NOTE, ('Mend the Imu stream (QoS depth, CPU load, cable): a leg without a gap tells '
                     'more; leg.max_gap is the limit.')
    TOPIC_GAP = NOTE, 'Mend the stream; the gap lowers the weight, not the leg.'
    CLOCKS_DIFFER = REJECT, ('Set odometer.time_offset, imu.time_offset or gnss.time_offset, or '
                             'stamp all sensors with one clock.')
    DELAY_SEEN = NOTE, ('Set the time_offset as the sentence says, here and wherever else these '
                        'sensors are used together; the two-point method gains most.')
    ODOMETER_LATE = NOTE, ('Send the counter with a header stamped where it is read, or ease the '
                           'line or machine that holds it up; the late messages were put back.')
    COUNTER_RESET = CAUTION, ('Keep the encoder powered during a leg; the travel across the '
                              'reset was bridged at the speed beside it.')
    COUNTER_ROLLOVER = NOTE, 'Nothing to do: undone by odometer.wrap or the integer type.'
    SPEED_COARSE = NOTE, ('Take wheel pulses or a finer speed signal of the same bus, if there is '
                          'one; the smoother hears when the steps change and can do without.')
    SPEED_ON_CHANGE = NOTE, ('Take wheel pulses or a speed that is sent at a fixed rate, if the '
                             'vehicle has one.')
    SPEED_FILTERED = CAUTION, ('Take wheel pulses or an unfiltered speed signal of the same bus; '
                               'the smoother allows for a delay, not for a filter.')
    COUNTER_COARSE = NOTE, ('Take a counter of more pulses a metre, if there is one; else drive '
                            'farther: a count weighs less the longer the way.')
    REVERSING_UNSIGNED = CAUTION, ('Do not reverse during a leg, or use an odometer that counts '
                                   'backwards (odometer.signed).')
    ODOMETER_REVERSED = REJECT, ('Set odometer.reversed to true (or false if it is); if the Imu '
                                 'faces backwards, set imu.mounting_rpy or imu.nominal_yaw.')
    ODOMETER_STILL = REJECT, 'Check wheel sensor and topic: the fixes move, the counter does not.'
    IMU_UNITS = REJECT, ('Publish m/s^2 and rad/s (REP-145), or set imu.accel_scale / '
                         'imu.gyro_scale.')
    IMU_LOOKS_Z_DOWN = CAUTION, ('Set imu.mounting_rpy to [3.141592653589793, 0.0, 0.0] if the '
                                 'axes are forward-right-down.')
    IMU_AXES = REJECT, ('Set imu.mounting_rpy so that the body frame is forward-left-up; where '
                        'the drive shows how the Imu sits, the values are named.')
    IMU_WORSE_THAN_GRADE = CAUTION, ('Set imu.grade, or imu.gyro_noise and the like, to what '
                                     'the Imu is; a gyro that sends deg/s looks so too: '
                                     'imu.gyro_scale.')
    IMU_AXES_SKEW = NOTE, ('Nothing: the angles are those of the axes that the Imu measures in; '
                           'set imu.misalignment_sigma to what the Imu has.')
    LEVER_ARM_OFF = CAUTION, ('Measure that lever arm again and set it: from base_link, x '
                              'forward, y left, z up; where both are off alike, it is '
                              'imu.lever_arm. A vehicle that slides in turns (skid '
                              'steering, tracks) looks so too: then leave it.')
    GYRO_SIGN = REJECT, 'Check the axes of the Imu: set imu.mounting_rpy, or mend the driver.'
    BAG_TRUNCATED = CAUTION, 'End recordings with Ctrl-C; what the file holds was used.'
    STOP_MARK_MISSING = CAUTION, ('Mark the end with ~/stop_leg, or give --leg; what was driven '
                                  'until the recording broke off was used.')
    FRAME_REPLACED = NOTE, 'Set frames.imu to the frame that the Imu has in TF; mend its driver.'
    COVARIANCE_UNKNOWN = NOTE, 'Set gnss.default_sigma to what the receiver really achieves.'
    FIXES_NOISIER_THAN_SAID = NOTE, ('The sigmas were widened to what the residuals show; check '
                                     'the receiver and the sky.')
    VELOCITY_UNUSABLE = NOTE, ('Send east, north, up in m/s on fix_velocity, or set '
                               'gnss.use_velocity to false; the leg is estimated without it.')
    # the drive
    NO_STANDSTILL = CAUTION, ('Stand still for 10 s or more before the start mark: level, gyro '
                              'bias and heading then come from rest.')
    LEG_TOO_SHORT = REJECT, 'Drive farther between the marks: leg.min_distance is the least.'
    CHORD_TOO_SHORT = REJECT, ('End far from where you start: a straight stretch, or mark part '
                               'of the drive with --leg; the two-point method sees only the line '
                               'between start and end.')
    SPEED_TOO_LOW = CAUTION, 'Drive faster than leg.min_speed for at least part of the leg.'
    LEG_NOT_STRAIGHT = NOTE, 'Prefer a straight stretch for the two-point method.'
    TRACK_MISMATCH = REJECT, ('Look at the check: wheel slip, a wrong gyro axis or unit, or bad '
                              'fixes; drive again on a firm straight road with open sky.')
    CHECK_WORSE = CAUTION, ('Keep what you had; look in the report where the track leaves the '
                            'fixes (slip, gaps, bad fixes), and drive again.')
    WHEEL_SLIP = CAUTION, ('Drive gently on a firm, dry road, or take a wheel that is not driven; '
                           'the sigma was widened by the slip seen.')
    SCALE_VARIES = NOTE, ('Nothing; for one number that holds longer, drive with warm tyres at '
                          'the speeds that matter, and combine legs.')
    FIXES_SMOOTHED = NOTE, ("Switch off the receiver's smoothing (position filter, static hold) "
                            'if you can: accelerations then tell more.')
    FIXES_FOLLOW_ODOMETER = CAUTION, ('Use the fixes of the receiver alone: choose the topic '
                                      'before fusion, or switch off its odometer (dead reckoning '
                                      'mode), and drive again.')
    # the estimate
    YAW_NOT_SEPARABLE = CAUTION, ('Give a heading that knows nothing of the odometer: '
                                  'alignment.heading with its sigma, a dual-antenna heading '
                                  'topic, or a gyro good enough to gyrocompass.')
    GYROCOMPASS_REFUSED = CAUTION, ('Use a gyro with less bias (imu.grade, imu.gyro_bias), a '
                                    'longer standstill, or another heading source.')
    HEADING_UNAVAILABLE = CAUTION, 'Check the heading source, or set alignment.heading_source.'
    PITCH_NOT_DETERMINED = NOTE, 'Use a receiver that gives ellipsoidal height.'
    SCALE_FAR_FROM_NOMINAL = CAUTION, ('Check odometer.nominal_scale and the unit of the '
                                       'odometer; odometer.max_scale_deviation is the limit.')
    YAW_FAR_FROM_NOMINAL = CAUTION, ('Check imu.mounting_rpy, imu.nominal_yaw and the heading '
                                     'source.')
    SCALE_SIGMA_TOO_LARGE = CAUTION, ('Drive a longer leg, use better fixes (RTK, longer stops '
                                      'at both marks), or combine more legs; '
                                      'verdict.max_scale_sigma is the limit.')
    YAW_SIGMA_TOO_LARGE = CAUTION, ('Drive with more stops, starts and turns, give a better '
                                    'heading, or combine legs; verdict.max_yaw_sigma is the '
                                    'limit.')
    PLANES_DISAGREE = CAUTION, 'Check the fixes and heights at the marks.'
    # left and right wheel
    ODOMETER_CHOSEN = NOTE, ('Nothing, if that is right; else name them: odometer.left and '
                             'odometer.right, or one value by odometer.field.')
    WHEELS_NOT_SEPARABLE = CAUTION, ('Use the gyro: give odometer.track_width, or drive straight '
                                     'stretches at speed; the mean of both wheels is not touched.')
    TRACK_WIDTH_NOT_DETERMINED = NOTE, ('Drive turns with a net change of heading (a loop, a '
                                        'round about), or give odometer.track_width.')
    TRACK_WIDTH_FAR_FROM_GIVEN = CAUTION, ('Measure the distance between the wheels again and set '
                                           'odometer.track_width, or leave it 0.')
    WHEELS_SWAPPED = REJECT, 'Exchange odometer.left and odometer.right.'
    WHEEL_DEAD = REJECT, ('Check the sensor and the wiring of that wheel, or calibrate the other '
                          'alone: name one joint or index in odometer.field.')
    WHEEL_REVERSED = REJECT, ('Make that wheel count forwards in its driver; odometer.reversed '
                              'turns both.')
    WHEEL_COUNTERS_DIFFER = CAUTION, ('Set odometer.wrap to the span of the counters, and let '
                                      'both wheels send the same one.')
    SEARCH_WIDENED = NOTE, ('Nothing, if the values are believable; else check '
                            'odometer.nominal_scale and the heading: wheels.radius_range and '
                            'wheels.heading_range set where the search begins.')
    SEARCH_NOT_SETTLED = CAUTION, ('Widen wheels.radius_range and wheels.heading_range, or give '
                                   'better start values.')
    # all the samples at once
    NOT_CONVERGED = REJECT, ('See what the other methods say; check units, axes and clocks with '
                             'odocal inspect, and drive a leg with stops and turns.')
    SCALE_NOT_DETERMINED = REJECT, 'Drive farther, faster, or with better fixes.'
    YAW_NOT_DETERMINED = CAUTION, ('Drive with stops, starts and turns: acceleration is what '
                                   'tells the heading, and so the yaw.')
    PARAMETER_NOT_DETERMINED = NOTE, 'Drive with turns both ways, stops and starts.'
    MODEL_MISMATCH = CAUTION, ('The residuals are not what the noise model says; the sigmas were '
                               'widened. Check slip, lever arms, delays and the sky.')
    METHOD_REJECTED = CAUTION, ('Look up in docs/reasons.md what to do about the code named; the '
                                'values are by another method, which may not see it.')
    METHOD_FAILED = REJECT, 'Report it with the trace file; the other methods are not touched.'
    METHODS_DISAGREE = CAUTION, ('See the values side by side; the likely cause is named. Drive '
                                 'again with stops at both marks and turns in between.')
    # several legs, several calibrations
    LEGS_DISAGREE = CAUTION, ('Look for the odd leg: tyre pressure, load, slip or bad fixes; '
                              'the combined sigma was widened.')
    SCALE_CHANGED = CAUTION, ('Look at tyre pressure, load and tyres; the scale given is that '
                              'since the change.')
    LEGS_UNLIKE = REJECT, ('Combine legs of one vehicle, one mounting and one set of topics and '
                           'settings; calibrate the others by themselves.')
    LEGS_OVERLAP = CAUTION, 'Give each drive once; legs that share time are no second opinion.'
    LEG_REJECTED = CAUTION, 'See the reasons of that leg; drive it again or leave it out.'
    MORE_LEGS_NEEDED = CAUTION, 'Drive more legs: verdict.min_legs.'
    NO_METHOD = REJECT, 'See the reasons of the legs.'

    def __init__(self, gravity: Verdict, remedy: str) -> None:
        self.gravity = gravity
        self.remedy = remedy

    def __new__(cls, *args: object) -> 'Code':
        """Give each code a value of its own, so that equal pairs do not become aliases."""
        member = object.__new__(cls)
        member._value_ = len(cls.__members__)
        return member


@dataclass(frozen=True)
class Reason:
    """A code with what was seen: one sentence with the figures; ``do`` where that tells more."""

    code: Code
    text: str
    do: str = ''

    @property
    def remedy(self) -> str:
        """Return what the reader can do about it."""
        return self.do or self.code.remedy

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of calibration.json."""
        return {'code': self.code.name, 'text': self.text, 'remedy': self.remedy}


def verdict_of(reasons: Iterable['Reason']) -> Verdict:
    """Return the gravest verdict that the reasons ask for."""
    return Verdict.worst(r.code.gravity for r in reasons)
