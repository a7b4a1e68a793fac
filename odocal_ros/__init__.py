"""
Calibrate a vehicle's odometer against IMU and GNSS.

Frames   n   local level, east-north-up, Cartesian, fixed to the Earth at the leg's start point
         b   IMU body: the Imu message's frame i after the nominal rotation, forward-left-up
         v   vehicle: x along the travel that positive pulses mean, y left, z up
         i   the Imu message's own frame; in ``w_ib`` and the like: inertial; e: Earth-fixed
Matrices C_nb takes a vector from b to n; letters that touch must match: f_n = C_nb @ f_b
Angles   mounting angles: fixed-axis roll, pitch, yaw of the IMU on the vehicle,
         v_v = C_vb v_b, C_vb = Rz(yaw) Ry(pitch) Rx(roll); yaw > 0: IMU's x axis points left of
         forward; pitch > 0: below it. yaw is from east, counter-clockwise; heading from north,
         clockwise
Units    SI and radians unless the name says otherwise; latitude and longitude in rad inside
Time     stamp_ns is int64 header time; t is float seconds since the start mark
Words    mark: a point the operator names; leg: what lies between two; track: the path dead
         reckoned; chord: straight line between a leg's ends; scale factor: metres of travel per
         pulse; fix: a GNSS position; pre-roll: samples kept before the start mark
Rooms    data       samples and legs         settings   what may be set, grades
         outside    names, YAML, files from and to others
         messages   from bytes to samples    bagio      bags; the only place of rosbags
         screening  what of it is usable     nav        strapdown, odometer, dead reckoning
         calib      methods, budgets, verdict, legs combined
         patent     the search of CN104359492A; paper: the tables of Shi et al. 2015
         pipeline   one pure function from leg to result
         plan       what a drive will tell; foresee: the same while it is driven
         apply      a calibration at work, sample by sample
         sim        drives with known truth  output     files, report, words
         live       the nodes, the only place of rclpy
         offline    the odocal command
Flow     messages -> data.samples -> data.leg -> screening -> pipeline.calibrate -> calib.result
         -> status, YAML, JSON
"""

__version__ = '0.1.0'
