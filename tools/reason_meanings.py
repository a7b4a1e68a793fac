# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The explanation of each reason code, for ``docs/reasons.md``."""

from odocal_ros.reasons import Code

# section: code: when it appears and what it means
MEANINGS: dict[str, dict[Code, str]] = {
    'Input data': {
        Code.NO_IMU: 'There is no usable IMU message between the marks, or all turn rates are '
        'zero. Without turn rates there is no track, except with two or more wheels on a level '
        'floor ([indoor.md](indoor.md)).',
        Code.NO_ACCELEROMETER: 'Every acceleration of the IMU is zero, NaN, or marked as missing '
        '(`linear_acceleration_covariance[0]` of -1), as for a yaw rate from a bus; or they '
        'contain no gravity, or a turn rate is always zero, so they cannot be levelled. The scale '
        'is estimated from gyro, odometer and fixes, with 0.05 % in its sigma for unmodelled '
        'slopes. Yaw and pitch mounting angle, slips and reversing are not determined without '
        'accelerations.',
        Code.NO_ODOMETER: 'There is no usable odometer message between the marks: a wrong topic, '
        'a wrong type, or a driver that is not running.',
        Code.NO_FIX: 'There is no position between the marks, or none near one of the two marks.',
        Code.FIXES_UNUSABLE: 'There are fixes, but each one has no position, a status below '
        '`gnss.min_status`, or a sigma above `gnss.max_sigma`. Or the positions of a local frame '
        'are map coordinates, are not in metres, or do not have z up.',
        Code.BAD_ROWS_DROPPED: 'Some messages have no stamp, hold NaN or an impossible value, '
        'are isolated outliers, or are fixes far from all others. They were left out. A leg '
        'counts its messages and those of its pre-roll (`leg.preroll`); odocal inspect counts '
        'those of the time that all topics cover.',
        Code.LOCAL_FRAME: 'Positions are poses or points in a local frame, not GNSS fixes. The '
        'direction of the Earth rate in this frame is not known, and external headings and GNSS '
        'velocities do not refer to it. The estimator treats the Earth rate as gyro bias; the '
        'uncertainties include this. `reference.latitude_deg` gives its vertical part.',
        Code.ROWS_DAMAGED: 'Several messages of a topic hold impossible values, or are outliers '
        'next to such messages: the recording itself is damaged. Other messages may be damaged '
        'without a visible sign, so messages near each group were left out too.',
        Code.STAMPS_NOT_RISING: 'Stamps of one topic repeat or step back. The smallest number of '
        'messages was left out so that the stamps of the others increase. IMU messages of packets '
        'that share a stamp are all used, at even times since the packet before.',
        Code.IMU_GAP: 'The IMU is silent, or repeats one value, for longer than `leg.max_gap`. '
        'The turns of the vehicle in this time are unknown, so the track is lost.',
        Code.LEG_CUT: 'The IMU was silent, or repeated one value, for longer than `leg.max_gap`. '
        'The leg is cut there; its sections are calibrated as legs and combined. A section too '
        'short to calibrate is left out. If no section is long enough, the leg is rejected '
        '(`IMU_GAP`). Or the vehicle was carried, as by a ferry: the fixes move by 100 m or more, '
        'or by 20 m or more in more than 20 s, and the odometer only counts before and after it.',
        Code.TOPIC_GAP: 'Odometer or fixes are silent for more than five of their usual '
        'intervals, or the odometer starts late or ends early. Or IMU, odometer or fixes cover '
        'only a part of a recording without marks (10 s or more are missing): the leg is limited '
        'to the time that all topics have. Travel across the gap is '
        'interpolated; its uncertainty is part of the sigma.',
        Code.CLOCKS_DIFFER: 'The stamps of a topic differ by more than 1 s (a heading: 0.5 s) '
        'from those of IMU messages that arrived at the same time. Positions and travel would '
        'be combined at wrong times. The node does not start a leg from 0.5 s on.',
        Code.CLOCK_SET: 'The stamps of a topic step by 10 ms or more against their arrival times, '
        'and stay so: its clock was set. The stamps on one side of the step were shifted by the '
        'same amount; if the clock is that of the IMU, the marks too.',
        Code.CLOCKS_DRIFT: 'The delay of one sensor changes during the leg by more than three '
        'sigmas and 10 ms: its clock is faster or slower than that of the IMU. Quartz clocks '
        'differ by up to 100 ppm, 0.1 s in 17 minutes. The smoother estimates the rate and '
        'accounts for it.',
        Code.DELAY_SEEN: 'While the vehicle accelerates and brakes, the stamps of one sensor are '
        'late or early relative to the others, by more than three sigmas and by enough to matter '
        'at this speed. The smoother estimates the delay and accounts for it; other software '
        'that combines these sensors does not. An offset of 1 to 90 s (clocks of two computers) '
        'is found by comparing the motion of IMU, odometer and fixes; the stamps are corrected '
        'before the fit. A difference of 0.5 to 1 s to IMU stamps that arrive at the same time is '
        'of the clock or of the transport: the fit decides. Without an estimated delay, this '
        'reason names an odometer that looks like a slipping wheel only because it is late or '
        'low-pass filtered.',
        Code.ODOMETER_LATE: 'Odometer messages stopped for a moment and then arrived in a burst '
        'with the missing travel: they were delayed in transport, and their stamps, taken at '
        "arrival, are late. They were moved to the sender's rhythm, or to the times that match "
        'the travel before and after the burst. This is not wheel slip.',
        Code.COUNTER_RESET: 'The counter has a jump that no rollover explains: it was reset or '
        'lost power. The travel at this moment is interpolated, with a sigma.',
        Code.COUNTER_ROLLOVER: 'The counter reached its largest number and started again. This '
        'is corrected. A counter may have fewer bits than its message type: its span is then '
        'found from the jumps.',
        Code.SPEED_COARSE: 'All published speeds are multiples of one step, such as 1 km/h. If '
        'truncated, they are half a step too low on average; if rounded, they are not. The '
        'values alone do not show which. The smoother uses the times of the step transitions and '
        'estimates which; the sigma of the other methods includes half a step.',
        Code.SPEED_ON_CHANGE: 'The speed repeats one value until it has changed by a step: it '
        'lags while the vehicle accelerates and brakes. Limits: at least 30 % of the moving '
        'messages repeat the one before, and the smallest change exceeds 0.6 of the tenth '
        'percentile of all changes.',
        Code.SPEED_FILTERED: 'The odometer deviates from the vehicle whenever the acceleration '
        'changes, as a low-pass filter of the speed does. Many speed signals of cars are filtered '
        'over 0.2 to 0.5 s. Delay and filter are constants of the fit.',
        Code.COUNTER_COARSE: 'There are few counts per metre, so the distance has the resolution '
        'of one count at each time. Over a long drive this error is small and part of the sigma. '
        'Events within a few metres, such as a short slip, cannot be detected.',
        Code.REVERSING_UNSIGNED: 'The vehicle reversed, but the counter counted up. Where the '
        'IMU shows the reversing, after a stop, this section was counted backwards.',
        Code.ODOMETER_REVERSED: 'The track runs opposite to the fixes: positive counts mean '
        'reverse motion, or the IMU x axis points backwards. Accelerations then point backwards '
        'in the IMU frame.',
        Code.ODOMETER_STILL: 'The fixes move, but the counter does not: from the start, or for '
        '100 m or more of the drive, and 1 % of its path. If it counts again, the leg is cut '
        'there (`LEG_CUT`), also for 20 m or more in more than 20 s.',
        Code.SEVERAL_IMUS: 'Messages on the IMU topic have different frame_ids: only one IMU '
        'was used, the first on the topic. Or they have one frame_id, and every second message is '
        'of another IMU with other axes or biases. Which one is meant cannot be decided from the '
        'data.',
        Code.IMU_UNITS: 'Gravity is not 9.8 m/s^2, or the gyro shows much larger turns than the '
        'vehicle can make: the unit is g, deg/s or another one. Or gravity has another size in a '
        'part of the leg.',
        Code.IMU_LOOKS_Z_DOWN: 'Gravity is on -z, as for an IMU with forward-right-down axes. '
        'For this result the IMU was rotated by 180 deg about x.',
        Code.IMU_AXES: 'Gravity is on another axis than z, or accelerations point sideways in '
        'the IMU frame: the body frame is not forward-left-up. Or a level axis of the '
        'accelerometer has the wrong sign, as the accelerations in turns show, or the IMU was '
        'moved in the vehicle by 45 deg or more.',
        Code.IMU_WORSE_THAN_GRADE: 'IMU errors are larger than its grade (MEMS sold as tactical '
        'have the gyro noise of `industrial`). The smoother uses the noise estimated from the '
        'drive instead. Sigmas that only depend on the grade, such as those of the other methods, '
        'are too small. Or errors are far larger for some seconds: vibration above half the rate '
        'of the IMU is aliased to low frequencies.',
        Code.IMU_SATURATED: 'The largest value of an axis is repeated: the sensor stops at the '
        'limit of its range, 2 g or 16 g for an accelerometer. Potholes and a hard mount cause '
        'this. The noise levels include these samples.',
        Code.GYRO_DEAD_BAND: 'Some IMUs and drivers send 0 for small turn rates, so that a '
        'vehicle at rest does not turn. The small rates of slopes, banks and gentle bends are '
        'then lost, and yaw and pitch can be wrong by several sigma.',
        Code.IMU_BIAS_STEP: 'The bias of the gyro or of the accelerometer changes within a second '
        'or two by more than 10 times its usual change: a knock, a strained board or a change of '
        'the supply. The bias is estimated before and after; values and sigmas hold.',
        Code.IMU_AXES_SKEW: 'The axes of accelerometer and gyro deviate more from perpendicular '
        'than the grade of the IMU. The fit accounts for real ones; mounting angles measured on '
        'the housing differ accordingly. A wrong gyro axis, which flat ground does not show '
        'directly, looks the same.',
        Code.LEVER_ARM_OFF: 'In turns and while leaning, a sensor moves as if it were decimetres '
        'from its configured position. Sliding in turns is not modelled: for a vehicle with skid '
        'steering the estimated point is where it slides least, not the position of the wheel.',
        Code.GYRO_SIGN: 'The gyro turns opposite to the course of the fixes, or the accelerations '
        'in turns are opposite to it. If gyro and accelerations match, the fixes are mirrored, or '
        'the accelerometer is negated.',
        Code.GYRO_AXES: 'One axis of the gyro has the wrong sign, or two are swapped, while the '
        'accelerometer is right. Gravity turns in the frame of the accelerometer when a vehicle '
        'tilts; the gyro must measure that turn. Only slopes, bumps or turns reveal the fault. On '
        'a flat straight road a wrong axis is not detected, and the pitch may be wrong.',
        Code.BAG_TRUNCATED: 'A recording was not closed properly, or some of its files are '
        'missing or unreadable. All readable messages were used.',
        Code.STOP_MARK_MISSING: 'The node marked the start of the leg, but the recording ends '
        'before its stop mark: the node or the computer stopped, or the bag was stopped too '
        'early. The leg ends at the last sample that all topics have; the vehicle may be moving '
        'there.',
        Code.FRAME_REPLACED: 'The frame in the IMU header is not valid in TF (valid: letters, '
        'digits and `_ . / -`, without a leading `/`). The files for TF contain the frame named '
        'in the text.',
        Code.COVARIANCE_UNKNOWN: 'Fixes have no covariance, or zero or NaN in it; '
        '`gnss.default_sigma` is used, in a local frame `reference.default_sigma`.',
        Code.FIXES_NOISIER_THAN_SAID: 'The fixes deviate from the track more than their '
        'covariance states, or are rounded to steps that it does not include (float32, NMEA with '
        '4 decimals of a minute). Their sigma was increased to match.',
        Code.FIX_OUTLIERS: 'At least 2 % of the fixes are more than 4.2 sigmas from the track. '
        'The weight of a fix is one half at this distance, and smaller beyond it.',
        Code.VELOCITY_UNUSABLE: 'Displacements from the GNSS velocity were compared with the '
        'displacements between fixes, 10 s apart. They differ by more than 10 % in size or '
        'direction. Usual causes: north and east swapped, vehicle axes, a speed without '
        'direction, or km/h.',
    },
    'The drive': {
        Code.NO_STANDSTILL: 'There is no standstill before the start mark. Level and gyro bias '
        'are then estimated from the first half minute of driving and from the grade, with '
        'larger sigmas.',
        Code.LEG_TOO_SHORT: 'The distance is below `leg.min_distance`, the fixes do not move, or '
        'the fixes are too coarse for this distance.',
        Code.CHORD_TOO_SHORT: 'The straight line from start to end is less than a fifth of the '
        'path length: a loop, or there and back. The end points then do not constrain the '
        'calibration.',
        Code.SPEED_TOO_LOW: 'The vehicle never reached `leg.min_speed`. At very low speed, '
        'latency and count resolution have the largest effect, and the rolling radius of the '
        'tyre differs.',
        Code.LEG_NOT_STRAIGHT: 'More than a tenth of the path is in turns (`leg.max_yaw_rate`), '
        'where each wheel has its own path length.',
        Code.TRACK_MISMATCH: 'Even with the calibrated values the track deviates from the fixes '
        'by more than noise, drift and 0.2 % of the distance. There is another error. Or the '
        'direction of travel changes by 180 deg between two sections while the fixes move '
        'backwards: the vehicle reversed, and the odometer counted up. Or the scale of the '
        'odometer differs by 5 % or more before and after some point of the drive, and is '
        'constant on either side of it.',
        Code.CHECK_WORSE: 'In sections of 100 m, 500 m or 1 km, each started at a fix, the '
        'calibrated track ends significantly farther from the fixes than the uncalibrated one. '
        'Both use the same attitude, so the calibrated values are wrong: they include slip, bad '
        'fixes or a delay.',
        Code.WHEEL_SLIP: 'Within a few seconds the wheel travelled more or less than the vehicle '
        'accelerated, or the wheel difference does not match the turn.',
        Code.TRAVEL_MISSING: 'Within a few seconds the odometer travelled less than the vehicle, '
        'which did not brake by 0.5 m/s^2. A sliding wheel brakes, a spinning one travels '
        'farther, so no wheel slipped: the odometer lost travel, often at a start from rest. Or, '
        'with a share of the path: at some speeds it counts less than at others, more than its '
        'noise explains.',
        Code.TRAVEL_EXCESS: 'While the vehicle braked to a stop, the odometer counted more travel '
        'than the vehicle moved. Brakes cannot spin a wheel, so this is not slip. Likely, the '
        'speed signal is held or late. Or, with a share of the path: at some speeds it counts '
        'more than at others.',
        Code.SCALE_VARIES: 'Tyres grow with speed and temperature, turns load one wheel and '
        'unload the other, and a wheel that steers travels farther in turns. The stated value is '
        'the mean over the path, for straight travel; `scale_by_speed`, `scale_by_time`, '
        '`scale_by_left_force` and `scale_by_curvature` are the slopes.',
        Code.CHANGE_IN_LEG: 'Scale, yaw or pitch before and after this time differ by more than 5 '
        'sigma and 0.03 % or 0.017 deg: the IMU or its bracket moved, or tyres, load or '
        'odometer changed. The sigma of an angle was increased so that it covers both values; the '
        'scale is the mean over the path.',
        Code.FIXES_SMOOTHED: 'Positions follow accelerations like a filter output: later and '
        'smoother than with a delay alone. Or they overshoot, like a filter of position and '
        'velocity.',
        Code.FIXES_FOLLOW_ODOMETER: 'The scale of the fixes over seconds differs from their '
        'scale over minutes. This happens if the receiver fuses the fixes with a wheel speed of '
        'its own. Limits: 5 sigmas of this difference and 0.05 %. For SLAM and AMCL with wheels '
        'the effective sample size is the duration of the leg divided by the time constant.',
        Code.FIXES_DEAD_RECKONED: 'The fixes of some seconds are smooth, as odometer and gyro '
        'predict them, and a jump follows: the receiver had no satellites, as in a tunnel. '
        'These fixes contain errors of its own odometer and are not used.',
    },
    'The estimate': {
        Code.YAW_NOT_SEPARABLE: 'The end points only constrain the sum of initial heading and '
        'yaw mounting angle. The only heading is the course over ground, or one with an '
        'uncertainty above the yaw limit. The scale is not affected.',
        Code.GYROCOMPASS_REFUSED: 'The heading should come from the Earth rate, but the gyro '
        'bias is too large or the standstill too short for it. Or the turn rate at rest does not '
        'match the Earth rate: the gyro is worse than its grade.',
        Code.HEADING_UNAVAILABLE: 'The configured heading source has no usable data; the course '
        'over ground is used.',
        Code.PITCH_NOT_DETERMINED: 'The fixes have no height, or heights that are too '
        'inaccurate: the pitch is not stated. A z of exactly 0, as from 2D SLAM, is no height.',
        Code.SCALE_FAR_FROM_NOMINAL: 'The scale differs from its nominal value by more than '
        '`odometer.max_scale_deviation`: a unit, a gear or a wheel size is not as configured.',
        Code.YAW_FAR_FROM_NOMINAL: 'The yaw mounting angle differs by more than 20 deg from its '
        'nominal value: the IMU orientation is not as configured, or the heading is wrong.',
        Code.SCALE_SIGMA_TOO_LARGE: 'The uncertainty of the scale is above '
        '`verdict.max_scale_sigma`. The value is correct within its uncertainty. The error '
        'budget lists the largest sources.',
        Code.YAW_SIGMA_TOO_LARGE: 'The uncertainty of the yaw is above `verdict.max_yaw_sigma`. '
        'The value is correct within its uncertainty.',
    },
    'Left and right wheel': {
        Code.ODOMETER_CHOSEN: 'A message holds several values (joints, or an array) and no '
        'setting selects the wheels. Joints were selected by name. For two values with unknown '
        'sides the mean is used, and left and right are not estimated.',
        Code.WHEELS_NOT_SEPARABLE: 'Left and right wheel are not separately observable on this '
        'drive; on a straight line only their mean is observable.',
        Code.TRACK_WIDTH_NOT_DETERMINED: 'The track width is only observable in turns, and the '
        'heading at the end is nearly that at the start.',
        Code.TRACK_WIDTH_FAR_FROM_GIVEN: 'The track width estimated from wheel difference and '
        'gyro differs by more than 6 % from the configured one. One of the two is wrong, and so '
        'are turns that a controller computes from it.',
        Code.WHEELS_SWAPPED: 'The wheel configured as left travels farther in left turns. It is '
        'the outer wheel, the right one.',
        Code.WHEEL_DEAD: 'One wheel does not count, or has no messages, while the other turns.',
        Code.WHEEL_LEFT_OUT: 'One wheel of several axles does not count, or counts down. Its axle '
        'is not used; the scale is that of the others.',
        Code.WHEELS_STEERED: 'These wheels travel farther in turns, as steered wheels do. They '
        'are not in the mean; their factors and positions are estimated.',
        Code.WHEEL_DEPARTS: 'The factor of one wheel differs from the median of the others by '
        'more than 1 %.',
        Code.WHEEL_REVERSED: 'One wheel counts down while the other counts up.',
        Code.WHEEL_COUNTERS_DIFFER: 'The two counters differ in modulus or kind (counter, '
        'angle, speed), or one counts much more than the other.',
        Code.SEARCH_WIDENED: 'The best values were on the edge of the search range, which was '
        'then widened around them.',
        Code.SEARCH_NOT_SETTLED: 'The search ended before its values converged, or away from the '
        'least-squares solution.',
    },
    'Smoother': {
        Code.NOT_CONVERGED: 'The fit gave no usable values; the text of the reason states why. '
        'The data do not determine all unknowns, an estimate became infinite, wheels and '
        'positions contradict each other, or no IMU has the estimated scale error. Usual causes: '
        'invalid samples, two sensors on one topic, wrong units, axes or clocks, or too little '
        'motion.',
        Code.SCALE_NOT_DETERMINED: 'The uncertainty of the scale is too large to state a value.',
        Code.YAW_NOT_DETERMINED: 'The uncertainty of the yaw mounting angle is too large to '
        'state a value.',
        Code.PARAMETER_NOT_DETERMINED: 'A further parameter, such as a lever arm or a delay, is '
        'not observable on this drive; the configured value is used.',
        Code.MODEL_MISMATCH: 'The residuals of the fit are larger, or more correlated, than the '
        'noise model predicts. For the two-point method: between its end points the track '
        'deviates from the fixes by more than the grade of the gyro and time-correlated fix '
        'errors explain.',
        Code.METHOD_REJECTED: 'A method that takes precedence, or the only one that separates '
        'left and right wheel, rejected its own values; its first reason is given. The result '
        'comes from the other methods.',
        Code.METHOD_FAILED: 'A method stopped with an internal error. It has no values; the '
        'other methods are not affected. The command prints the path of a file with the trace.',
        Code.METHODS_DISAGREE: 'Two methods give values for the same leg that differ by more '
        'than three sigmas of their difference.',
    },
    'Several legs': {
        Code.LEGS_DISAGREE: 'The legs differ by more than their uncertainties. The text names '
        'the parameter and, for the smoother, the leg that differs most. If all deviations '
        'together are too large, it states the largest one; below 3 sigma no single parameter is '
        'the cause. The sigma of the combination includes this.',
        Code.SCALE_CHANGED: 'With leg.automatic: the scale of a leg differs from that of the '
        'earlier legs by more than 3 sigma of the difference, including the random walk of '
        'verdict.scale_drift_per_day. A new scale starts at this leg; the other shared '
        'parameters continue.',
        Code.LEGS_UNLIKE: 'Two legs differ by more than 5 % in scale or 5 deg in yaw mounting, '
        'far more than their sigmas, or their odometers have different units (one in counts, one '
        'in speeds). Tyres do not explain this: there are two vehicles, or a setting or the '
        'mounting was changed in between. A mean would be valid for neither.',
        Code.LEGS_OVERLAP: 'Two legs overlap in time, so they are not independent; the later one '
        'is not used.',
        Code.LEG_REJECTED: 'A leg, or a method on it, was rejected and left out of the '
        'combination.',
        Code.MORE_LEGS_NEEDED: 'There are fewer good legs than `verdict.min_legs`.',
        Code.NO_METHOD: 'No method could run on any leg.',
    },
}
