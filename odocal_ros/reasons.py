# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reasons of a verdict: findings on a leg or a calibration, with their severity and remedy."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, unique
from typing import Any


class Verdict(Enum):
    """Usability of a result; ``rejected`` results keep every value they computed."""

    ACCEPTED = 'accepted'
    CAUTION = 'caution'
    REJECTED = 'rejected'

    @staticmethod
    def worst(verdicts: Iterable['Verdict']) -> 'Verdict':
        """Return the most severe of many, accepted if there are none."""
        return max(verdicts, key=SEVERITY.index, default=Verdict.ACCEPTED)


SEVERITY = tuple(Verdict)      # the most severe last
NOTE, CAUTION, REJECT = Verdict.ACCEPTED, Verdict.CAUTION, Verdict.REJECTED


@unique
class Code(Enum):
    """A reason code: its severity, and its remedy if the reason has no special one."""

    # topics and messages
    NO_IMU = REJECT, ('Check the IMU topic and its QoS, or name the topic with --imu-topic. For a '
                      'robot without an IMU, set odometer.left and odometer.right, or '
                      'odometer.wheels.')
    NO_ACCELEROMETER = CAUTION, ('For yaw and pitch use an IMU that publishes specific force and '
                                 'three turn rates (REP-145); for the yaw, an external heading is '
                                 'sufficient. Drive on level ground: unmodelled slopes bias the '
                                 'scale.')
    NO_ODOMETER = REJECT, 'Check the odometer topic and odometer.type, or use --odometer-topic.'
    NO_FIX = REJECT, ('Drive under open sky and wait for a position before the start mark. '
                      'Without GNSS: start the localisation first, and name its topic with '
                      '--fix-topic.')
    FIXES_UNUSABLE = REJECT, ('Wait for a valid position. If these fixes are good, lower '
                              'gnss.min_status or raise gnss.max_sigma.')
    BAD_ROWS_DROPPED = NOTE, ('Check the driver that sends these messages. All other messages '
                              'were used.')
    LOCAL_FRAME = NOTE, 'No action needed: the uncertainties include the unknown Earth rate.'
    ROWS_DAMAGED = CAUTION, ('Copy the recording again from its source, or record a new one. '
                             'Messages near the damage were left out.')
    STAMPS_NOT_RISING = NOTE, ('Check the clock of the sender. Messages with increasing stamps '
                               'were used.')
    IMU_GAP = REJECT, ('Fix the IMU stream (QoS depth, CPU load, cable), or mark a leg without '
                       'the gap with --leg. The limit is leg.max_gap.')
    LEG_CUT = NOTE, ('Fix the IMU stream (QoS depth, CPU load, cable). An uninterrupted leg '
                     'gives smaller uncertainties. The limit is leg.max_gap.')
    TOPIC_GAP = NOTE, ('Check the sender, cable and bus load of this topic. The leg stays valid; '
                       'missing data increases the uncertainties.')
    CLOCKS_DIFFER = REJECT, ('Set odometer.time_offset, imu.time_offset or gnss.time_offset, or '
                             'stamp all sensors with one clock.')
    CLOCK_SET = NOTE, ('No action needed for this leg. Synchronise the clock before a drive (PTP, '
                       'chrony), and adjust it gradually.')
    CLOCKS_DRIFT = NOTE, ('Synchronise the clocks (PTP, PPS, chrony), or stamp all sensors with '
                          'one clock. The drift matters to all software that combines them.')
    DELAY_SEEN = NOTE, ('Set the stated time_offset for the two-point method, and in every other '
                        'program that combines these sensors.')
    ODOMETER_LATE = NOTE, ('Publish the counter with a header stamped at the time of reading, or '
                           'reduce bus or CPU load. The late messages were moved back to their '
                           'estimated times.')
    COUNTER_RESET = CAUTION, 'Keep the encoder and its counter powered during a leg.'
    COUNTER_ROLLOVER = NOTE, ('No action needed. The modulus is the setting odometer.wrap, or by '
                              'default that of the integer type.')
    SPEED_COARSE = NOTE, ('If available, use wheel pulses or a finer speed signal from the same '
                          'bus. The smoother reduces this error: it uses the step transitions.')
    SPEED_ON_CHANGE = NOTE, ('If available, use wheel pulses or a speed that is published at a '
                             'fixed rate.')
    SPEED_FILTERED = NOTE, ('No action needed. For dead reckoning, wheel pulses or an unfiltered '
                            'speed signal from the same bus are better.')
    COUNTER_COARSE = NOTE, ('If available, use a counter with more pulses per metre. Otherwise '
                            'drive farther: quantisation averages out with distance.')
    REVERSING_UNSIGNED = CAUTION, ('Do not reverse during a leg, or use an odometer that counts '
                                   'down in reverse and set odometer.signed.')
    ODOMETER_REVERSED = REJECT, ('Set odometer.reversed to true, or to false if it is true. If '
                                 'the IMU x axis points backwards, change the yaw of '
                                 'imu.mounting_rpy by 3.141592654 rad instead, or set '
                                 'imu.nominal_yaw.')
    ODOMETER_STILL = REJECT, ('Check the wheel sensor, its wiring and the odometer topic. '
                              'nav_msgs/Odometry must contain the twist: its pose is not used.')
    SEVERAL_IMUS = REJECT, ('Set imu.frame_id to the IMU to calibrate, or publish each IMU on '
                            'its own topic.')
    IMU_UNITS = REJECT, ('Publish m/s^2 and rad/s (REP-145), or set imu.accel_scale / '
                         'imu.gyro_scale.')
    IMU_LOOKS_Z_DOWN = CAUTION, ('Set imu.mounting_rpy to [3.141592654, 0, 0] if the '
                                 'axes are forward-right-down.')
    IMU_AXES = REJECT, ('Set imu.mounting_rpy so that the body frame is forward-left-up. '
                        'odocal inspect prints the possible values.')
    IMU_WORSE_THAN_GRADE = CAUTION, (
        'Set imu.grade, or imu.gyro_noise and the other noise settings, to the values of this '
        'IMU. A gyro that sends deg/s has the same effect: then set imu.gyro_scale to 0.0174533.')
    IMU_SATURATED = NOTE, ('Set a larger range in the IMU or its driver, or mount the IMU on '
                           'dampers. The mean of a saturated axis is wrong.')
    GYRO_DEAD_BAND = CAUTION, ('Switch off the dead band of the IMU or its driver (a zero-rate '
                               'filter), and drive again.')
    IMU_BIAS_STEP = NOTE, ('No action needed for this leg. Check that the IMU is firmly mounted '
                           'and its supply is stable; if the bias steps in each drive, replace '
                           'the IMU.')
    IMU_AXES_SKEW = CAUTION, ('Check signs and order of the gyro axes in the IMU driver. On flat '
                              'ground a wrong gyro axis causes this, and the pitch is then wrong. '
                              'If the axes are right, set imu.misalignment_sigma to the '
                              'misalignment of this IMU.')
    LEVER_ARM_OFF = CAUTION, ('Measure this lever arm and imu.lever_arm, and set them (from '
                              'base_link: x forward, y left, z up): only their difference is '
                              'estimated. A vehicle that slides in turns (skid steering, '
                              'tracks) also looks like this: then change nothing.')
    GYRO_SIGN = REJECT, ('Correct the signs or the order of the axes in the IMU driver. '
                         'imu.mounting_rpy cannot: it rotates gyro and accelerometer together.')
    GYRO_AXES = REJECT, ('Correct the axes of angular_velocity in the IMU driver. '
                         'imu.mounting_rpy cannot: it rotates gyro and accelerometer together.')
    BAG_TRUNCATED = CAUTION, ('Stop recordings with Ctrl-C. An invalid chunk is an error of '
                              'storage or transfer: copy the file again. All readable messages '
                              'were used.')
    STOP_MARK_MISSING = CAUTION, ('Mark the end with ~/stop_leg, or give --leg. Data up to the '
                                  'end of the recording was used.')
    FRAME_REPLACED = NOTE, ('Set frames.imu to the TF frame of the IMU, or correct frame_id in '
                            'its driver.')
    COVARIANCE_UNKNOWN = NOTE, ('Set gnss.default_sigma to the real horizontal accuracy of the '
                                'receiver.')
    FIXES_NOISIER_THAN_SAID = NOTE, ('Check the receiver and its sky view. Uncertainties were '
                                     'increased to match the residuals.')
    FIX_OUTLIERS = NOTE, ('Check the antenna and its sky view, or the localisation. The '
                          'comparison of track and fixes includes these fixes.')
    VELOCITY_UNUSABLE = NOTE, ('Publish east, north, up in m/s on fix_velocity, or set '
                               'gnss.use_velocity to false. The result does not use it.')
    # the drive
    NO_STANDSTILL = CAUTION, ('Stand still for 10 s or more before the start mark. Level, gyro '
                              'bias and heading are then measured at rest.')
    LEG_TOO_SHORT = REJECT, ('Drive farther between the marks. The limit is leg.min_distance, or '
                              'reference.min_distance without GNSS.')
    CHORD_TOO_SHORT = REJECT, ('End the leg far from its start, or mark a straight section with '
                               '--leg. The two-point method only uses the line from start to end.')
    SPEED_TOO_LOW = CAUTION, ('Drive faster than leg.min_speed in part of the leg. If the vehicle '
                              'is always this slow, set leg.min_speed below its usual speed.')
    LEG_NOT_STRAIGHT = NOTE, ('No action needed for the smoother. For the two-point method, mark '
                              'a straight section with --leg.')
    TRACK_MISMATCH = REJECT, ('Likely causes: wheel slip, a wrong gyro axis or unit, or bad '
                              'fixes. Check them with odocal inspect, then drive again on a firm '
                              'road under open sky.')
    CHECK_WORSE = CAUTION, ('Keep the previous calibration. Find in the report where the track '
                            'deviates from the fixes (slip, gaps, bad fixes), then drive again.')
    WHEEL_SLIP = CAUTION, ('Drive gently on a firm, dry road, or use a wheel that is not driven. '
                           'The uncertainty includes the detected slip.')
    TRAVEL_MISSING = NOTE, ('Check the odometer at low speed: truncated speeds, a dead band, or a '
                            'sensor that misses pulses. The uncertainty was increased.')
    TRAVEL_EXCESS = NOTE, ('Check whether the odometer holds or delays its speed before stops. '
                           'The uncertainty was increased.')
    SCALE_VARIES = NOTE, ('No action needed. For a value that stays valid longer, drive with '
                          'warm tyres at typical speeds, and combine several legs.')
    CHANGE_IN_LEG = CAUTION, ('Check the mounting of the IMU, the tyres, the load and the '
                              'odometer. Then drive again, or use the section before or after '
                              'this time (--leg). The result is a mean of both sections.')
    FIXES_SMOOTHED = NOTE, ('If possible, switch off smoothing in the receiver (position filter, '
                            'static hold) or the localisation: unfiltered fixes contain more '
                            'information.')
    FIXES_FOLLOW_ODOMETER = CAUTION, (
        'Use positions that do not contain the wheel odometry. Receiver: the topic before fusion, '
        'or dead reckoning switched off. SLAM, AMCL, robot_localization: a source without wheels '
        '(scan matching alone, lidar or visual odometry, motion capture). Then drive again.')
    FIXES_DEAD_RECKONED = CAUTION, ('Switch off dead reckoning in the receiver, or drive a leg '
                                    'without tunnels. The other fixes were used.')
    # the estimate
    YAW_NOT_SEPARABLE = CAUTION, ('Provide a heading that is independent of the odometer: '
                                  'alignment.heading with alignment.heading_sigma, a '
                                  'dual-antenna heading topic, or a gyrocompass-grade gyro.')
    GYROCOMPASS_REFUSED = CAUTION, ('Use a longer standstill or another heading source. If the '
                                    'gyro is better than configured, set imu.grade or '
                                    'imu.gyro_bias.')
    HEADING_UNAVAILABLE = CAUTION, ('Check the topic or setting of the heading source, or set '
                                     'alignment.heading_source to auto.')
    PITCH_NOT_DETERMINED = NOTE, ('Use positions with height: ellipsoidal height of a receiver, '
                                  'or z.')
    SCALE_FAR_FROM_NOMINAL = CAUTION, ('Check odometer.nominal_scale and the unit of the '
                                       'odometer. The limit is odometer.max_scale_deviation.')
    YAW_FAR_FROM_NOMINAL = CAUTION, ('Check imu.mounting_rpy, imu.nominal_yaw and the heading '
                                     'source.')
    SCALE_SIGMA_TOO_LARGE = CAUTION, ('Drive a longer leg, or combine legs. Reduce the largest '
                                      'error of the budget: better positions (RTK), a better IMU, '
                                      'a wheel that is not driven. The limit is '
                                      'verdict.max_scale_sigma.')
    YAW_SIGMA_TOO_LARGE = CAUTION, ('Drive with more stops, starts and turns, provide a better '
                                    'heading, or combine legs. The limit is '
                                    'verdict.max_yaw_sigma.')
    # left and right wheel
    ODOMETER_CHOSEN = NOTE, ('If correct, ignore. Otherwise set odometer.left and '
                             'odometer.right, or select one value with odometer.field.')
    WHEELS_NOT_SEPARABLE = CAUTION, ('Set odometer.track_width, or drive straight sections at '
                                     'higher speed. The mean of both wheels is not affected.')
    TRACK_WIDTH_NOT_DETERMINED = NOTE, ('Drive turns with a net change of heading (a loop or a '
                                        'roundabout), or set odometer.track_width.')
    TRACK_WIDTH_FAR_FROM_GIVEN = CAUTION, ('Measure the distance between the wheels again and '
                                           'set odometer.track_width, or set it to 0 (unknown).')
    WHEELS_SWAPPED = REJECT, 'Swap odometer.left and odometer.right.'
    WHEEL_DEAD = REJECT, ('Check the sensor and wiring of this wheel, or calibrate the other '
                          'wheel alone: set odometer.field to its joint or index.')
    WHEEL_LEFT_OUT = CAUTION, ('Check the sensor and wiring of this wheel. The scale factor is '
                               'valid for the mean of the other axles.')
    WHEELS_STEERED = NOTE, ('No action needed. If these wheels do not steer, check the turn rate '
                            'of the gyro and the order of odometer.wheels.')
    WHEEL_DEPARTS = NOTE, ('Check tyre pressure, tyre size and the counts per revolution of '
                           'this wheel.')
    WHEEL_REVERSED = REJECT, ('Invert the sign of this wheel in its driver. odometer.reversed '
                              'inverts both wheels.')
    WHEEL_COUNTERS_DIFFER = CAUTION, ('Set odometer.wrap to the modulus of the counters. Both '
                                      'wheels must use the same modulus.')
    SEARCH_WIDENED = NOTE, ('If the values are plausible, ignore. Otherwise check '
                            'odometer.nominal_scale and the heading; wheels.radius_range and '
                            'wheels.heading_range set the initial search range.')
    SEARCH_NOT_SETTLED = CAUTION, ('Widen wheels.radius_range and wheels.heading_range, or '
                                   'correct the start values: odometer.nominal_scale and the '
                                   'heading.')
    # the smoother, and the choice between methods
    NOT_CONVERGED = REJECT, ('Check units, axes and clocks with odocal inspect, and the number of '
                             'publishers with ros2 topic info. Then drive a leg with stops and '
                             'turns. The other methods may still have a result.')
    SCALE_NOT_DETERMINED = REJECT, 'Drive farther, or use more accurate fixes (such as RTK).'
    YAW_NOT_DETERMINED = CAUTION, ('Drive with stops, starts and turns: the yaw is estimated '
                                   'from accelerations.')
    PARAMETER_NOT_DETERMINED = NOTE, ('No action needed if the configured values were measured. '
                                      'Turns, stops and starts determine more values.')
    MODEL_MISMATCH = CAUTION, ('The printed action depends on the deviation. Likely causes: slip, '
                               'bad fixes, lever arms, delays, the unit of heights, a wrong '
                               'external heading, slopes.')
    METHOD_REJECTED = CAUTION, ('Follow the action of the named reason. The values come from '
                                'another method, which may not detect this problem.')
    METHOD_FAILED = REJECT, ('Please report this with the trace file. The other methods are not '
                             'affected.')
    METHODS_DISAGREE = CAUTION, ('Check the cause that this message names. Drive again with stops '
                                 'at both marks and turns in between.')
    # several legs, several calibrations
    LEGS_DISAGREE = CAUTION, ('Find the leg that differs. Likely causes: tyre pressure, load or '
                              'slip (scale), a moved IMU (angles), driver timing (delays), bad '
                              'fixes. The combined uncertainty was increased.')
    SCALE_CHANGED = CAUTION, ('Check tyre pressure, load and tyres. The stated scale is valid '
                              'from the change on.')
    LEGS_UNLIKE = REJECT, ('Combine only legs of one vehicle, one mounting, and the same topics '
                           'and settings. Calibrate the other legs separately.')
    LEGS_OVERLAP = CAUTION, 'Give each recording once, and legs that do not overlap in time.'
    LEG_REJECTED = CAUTION, ('See the reasons of this leg. Drive it again, or exclude it: --leg, '
                             'or live ~/undo_leg.')
    MORE_LEGS_NEEDED = CAUTION, 'Drive more legs. The required number is verdict.min_legs.'
    NO_METHOD = REJECT, 'See the reasons of the legs.'

    def __init__(self, severity: Verdict, remedy: str) -> None:
        self.severity = severity
        self.remedy = remedy


@dataclass(frozen=True)
class Reason:
    """A code, a text with numbers, and a remedy for this case in place of that of the code."""

    code: Code
    text: str
    special_remedy: str = ''

    def __str__(self) -> str:
        return f'{self.code.name}: {self.text}'

    @property
    def remedy(self) -> str:
        return self.special_remedy or self.code.remedy

    def as_dict(self) -> dict[str, Any]:
        return {'code': self.code.name, 'text': self.text, 'remedy': self.remedy}


def most_severe_first(reasons: Iterable['Reason']) -> list['Reason']:
    """Return reasons by their severity; those of the same severity stay in order."""
    return sorted(reasons, key=lambda reason: -SEVERITY.index(reason.code.severity))


def cautions(reasons: Iterable['Reason']) -> list['Reason']:
    """Return the reasons that lower the verdict, the most severe first."""
    return [reason for reason in most_severe_first(reasons) if reason.code.severity is not NOTE]


def rejecting(reasons: Iterable['Reason']) -> list['Reason']:
    """Return the reasons that reject a leg, a method or a calibration."""
    return [reason for reason in reasons if reason.code.severity is REJECT]


def verdict_of(reasons: Iterable['Reason']) -> Verdict:
    """Return the most severe verdict of the reasons."""
    return Verdict.worst(reason.code.severity for reason in reasons)
