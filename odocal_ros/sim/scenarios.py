# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulate a drive: a named route, its sensors, and the truth."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.data import samples
from odocal_ros.data.arrays import Floats
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import Leg
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import local_fixes
from odocal_ros.nav.rotations import heading_from_yaw, matrix_from_rpy, yaw_from_heading
from odocal_ros.settings.config import HOLONOMIC
from odocal_ros.sim import body, sensors
from odocal_ros.sim.motion import attitude, Motion, NO_SWAY, Start
from odocal_ros.sim.noise import make_rng, stamps
from odocal_ros.sim.options import DEFAULTS, Reference, REFERENCES, resolve, SimOptions
from odocal_ros.sim.profile import hermite, Hills, Profile
from odocal_ros.sim.real_sensors import mounting_angles, velocity
from odocal_ros.sim.routes import Route, ROUTES, with_sideways_moves
from odocal_ros.sim.wheels import leg_factor, wheels_of

__all__ = ['Drive', 'SCENARIOS', 'SimOptions', 'Truth', 'motion_of', 'simulate']

SCENARIOS = tuple(DEFAULTS)
FORMS = {'counts': samples.OdometerForm('cumulative', 2**64, 'm/pulse'),
         'speed': samples.OdometerForm('rate', 0, '1'),
         'angle': samples.OdometerForm('cumulative', 0, 'm/rad')}


@dataclass(frozen=True, eq=False)
class Truth:
    """
    True values of the drive, which a calibration should estimate.

    The scale of tyres that grow or slip is the mean of the leg by travel: the true path between
    the marks divided by the change of the count, before quantisation; likewise its ratio and the
    scales of the wheels. Yaw and pitch are those of the sensor axes of the IMU (``sensor_axes`` of
    real_sensors.py), which equal those of its housing if its axes are perpendicular.
    """

    scale: float                 # m/pulse, 1 or m/rad; two wheels: that of their mean count
    scale_ratio: float           # K / K0
    wheel_scales: tuple[float, ...]
    yaw: float                   # rad, mounting
    pitch: float                 # rad, mounting
    heading: float               # rad from north, clockwise, of b's x axis at the start mark
    distance: float              # path length of the odometer's point, m
    start_ns: int                # start mark: the last IMU sample before the vehicle first moves
    stop_ns: int                 # stop mark: the last IMU sample
    gyro_bias: np.ndarray        # (3,) rad/s at turn-on, frame i
    accel_bias: np.ndarray       # (3,) m/s^2 at turn-on, frame i
    yaw_housing: float           # rad, mounting of the IMU's housing
    pitch_housing: float         # rad


@dataclass(frozen=True, eq=False)
class Drive:
    """Samples of all sensors in a drive, its options and the truth."""

    options: SimOptions
    motion: Motion
    truth: Truth
    form: samples.OdometerForm      # meaning of the odometer's values
    imu: samples.ImuSamples
    wheels: tuple[samples.OdometerSamples, ...]     # in the order of ``wheels_of``
    fix: samples.FixSamples
    heading: samples.HeadingSamples
    velocity: samples.VelocitySamples
    pressure: samples.ScalarSamples

    @property
    def joints(self) -> tuple[str, ...]:
        """Return the names of the wheels in a JointState."""
        return tuple(wheel.name for wheel in wheels_of(self.options))

    @property
    def odometer(self) -> samples.OdometerSamples:
        """Return the samples of the only or the left wheel."""
        return self.wheels[0]

    @property
    def odometer_right(self) -> samples.OdometerSamples:
        """Return the samples of the right wheel, no rows without one."""
        return self.wheels[1] if len(self.wheels) > 1 else samples.OdometerSamples.empty()

    @property
    def reference(self) -> Reference:
        """Return the kind of the position reference."""
        return REFERENCES[self.options.reference]

    def leg(self) -> Leg:
        """Return the drive as one leg between its marks, with all earlier samples."""
        fix = self.fix
        if self.options.reference != 'fix':
            covariance = [fix.covariance_n] if self.reference.has_covariance else []
            make_fixes = local_fixes(latitude_deg=np.nan)
            fix = make_fixes(fix.stamp_ns, fix.received_ns, self.positions(), *covariance)
        wheels: dict[str, Any] = dict(zip(WHEELS, self.wheels, strict=False))
        return Leg(self.truth.start_ns, self.truth.stop_ns, form=self.form).with_rows(
            imu=self.imu, fix=fix, heading=self.heading, fix_velocity=self.velocity,
            pressure=self.pressure, **wheels)

    def positions(self) -> Floats:
        """Return the fixes in a local frame at the start, x forward there: (n, 3) m."""
        start = self.options
        position_n = Origin(start.latitude, start.longitude, start.height).to_n(
            np.stack([self.fix.latitude, self.fix.longitude, self.fix.height], -1))
        position = position_n @ matrix_from_rpy([0.0, 0.0, float(yaw_from_heading(start.heading))])
        if self.reference.is_planar:
            position[:, 2] = 0.0
        return position


def motion_of(options: SimOptions) -> Motion:
    """Return the motion of a drive with resolved options."""
    make = with_sideways_moves if options.drive in HOLONOMIC else ROUTES[options.scenario]
    route = make(options.duration, make_rng(options.seed, 'route'))
    start = Start(options.latitude, options.longitude, options.height,
                  float(yaw_from_heading(options.heading)))
    real = options.real
    hills = Hills(options.slope, kerbs=_kerbs(route, options))
    lean = (body.road_lean(route.speed, route.yaw_rate, real)
            if real.alternating_crossfall or real.banking or real.constant_crossfall else None)
    sway = route.side or NO_SWAY, NO_SWAY
    if route.side is None and (options.sway or real.sideslip or lean):
        sway = _sway(route, options, lean)
    has_springs = real.squat or real.body_roll or real.wheelbase or real.kneeling or lean
    tilt = body.tilts(route.speed, route.yaw_rate, real, hills, lean) if has_springs else ()
    return Motion(route.speed, route.yaw_rate, start, hills, sway, tilt, lean)


def _kerbs(route: Route, options: SimOptions) -> tuple[tuple[float, float], ...]:
    """Return the kerbs along the path, alternately up and down: (distance, height) m each."""
    real = options.real
    if not real.kerbs:
        return ()
    travel = route.speed.integral()(np.arange(0.0, route.speed.end, 1.0))
    count = int(np.ptp(travel) / real.kerb_distance)
    gaps = make_rng(options.seed, 'kerbs').uniform(0.5, 1.5, count)
    begins = float(travel.min()) + np.cumsum(gaps * real.kerb_distance)
    return tuple((float(s), real.kerbs * (-1)**k) for k, s in enumerate(begins))


def _sway(route: Route, options: SimOptions, lean: Profile | None) -> tuple[Profile, Profile]:
    """Return velocities to the side and up; on a leaning road the axle turns about its contact."""
    step = 0.1      # s between draws
    breaks = np.round(np.arange(0.0, route.speed.end + step, step), 9)
    size = options.sway * np.clip(np.abs(route.speed(breaks)), 0.0, 1.0)
    draws = size * make_rng(options.seed, 'sway').standard_normal((2, len(breaks)))
    side, up = (Profile(breaks, np.stack([x[:-1], np.diff(x) / step], -1)) for x in draws)
    if options.real.sideslip:
        # to the left, against the force of the tyres
        force = body.side_force(route.speed, route.yaw_rate, lean, breaks)
        side = _add_velocity(side, -options.real.sideslip * force * np.abs(route.speed(breaks)))
    if lean:
        phi, rate = lean(breaks), lean.derivative()(breaks) * options.odometer_lever_arm[2]
        side, up = _add_velocity(side, rate * np.cos(phi)), _add_velocity(up, rate * np.sin(phi))
    return side, up


def _add_velocity(sway: Profile, velocity_at_breaks: Floats) -> Profile:
    """Return the sum of a sway and a velocity, m/s at its breaks, cubic between them."""
    t = sway.breaks
    added = hermite(t, velocity_at_breaks, np.gradient(velocity_at_breaks, t)).powers
    higher_orders = added.shape[1] - sway.powers.shape[1]
    return Profile(t, added + np.pad(sway.powers, ((0, 0), (0, higher_orders))))


def simulate(options: SimOptions | None = None) -> Drive:
    """Return a drive; equal options give equal drives, to the last bit."""
    options = resolve(options or SimOptions())
    motion = motion_of(options)
    imu = sensors.imu(motion, options)
    return Drive(
        options=options, motion=motion, truth=_truth(motion, options, imu),
        form=FORMS[options.odometer], imu=imu if options.imu else samples.ImuSamples.empty(),
        wheels=tuple(sensors.odometers(motion, options)),
        fix=sensors.fixes(motion, options),
        heading=(samples.HeadingSamples.empty() if options.heading_sigma is None
                 else sensors.heading(motion, options, options.heading_sigma)),
        velocity=velocity(motion, options),
        pressure=sensors.pressure(motion, options))


def _truth(motion: Motion, options: SimOptions, imu: samples.ImuSamples) -> Truth:
    """Return the true values of a drive; imu: its samples, for the stamps of the marks."""
    gyro_bias, accel_bias = sensors.turn_on_biases(options)
    _, t = stamps(motion.duration, options.imu_rate)    # true times, not stamps
    first_move = motion.speed.breaks[np.argmax((motion.speed.powers != 0).any(axis=1))]
    start = int(np.searchsorted(t, first_move + 1e-9, side='right')) - 1
    C_vb = matrix_from_rpy([options.roll, options.pitch, options.yaw])
    x_n = (attitude(motion.at(t[start:start + 1])) @ C_vb)[0, :, 0]
    # a sum in steps of 0.02 s is the true scale of tyres that grow, or slip at each start
    state = motion.at(np.arange(0.0, motion.duration, 0.02))
    at_starts = sensors.slip(state, replace(options, slip_walk=0.0, slip_events=0.0))
    factor = leg_factor(state, options.real, at_starts)
    scale = options.scale * factor
    return Truth(
        scale=scale, scale_ratio=scale / options.nominal_scale,
        wheel_scales=tuple(factor * wheel.scale for wheel in wheels_of(options)),
        **mounting_angles(options),
        heading=float(heading_from_yaw(np.arctan2(x_n[1], x_n[0]))), distance=motion.distance,
        start_ns=int(imu.stamp_ns[start]), stop_ns=int(imu.stamp_ns[-1]),
        gyro_bias=gyro_bias, accel_bias=accel_bias)
