"""Simulate a drive: a named route, its sensors, and the truth."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.leg import Leg
from odocal_ros.nav.angles import heading_from_yaw, yaw_from_heading
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.samples import (
    FixSamples,
    HeadingSamples,
    ImuSamples,
    no_heading,
    no_odometer,
    OdometerForm,
    OdometerSamples,
)
from odocal_ros.sim import sensors
from odocal_ros.sim.motion import attitude, Hills, Motion, Start
from odocal_ros.sim.noise import stream
from odocal_ros.sim.options import DEFAULTS, resolved, SimOptions
from odocal_ros.sim.profile import Profile
from odocal_ros.sim.routes import ROUTES

__all__ = ['Drive', 'SCENARIOS', 'SimOptions', 'Truth', 'motion_of', 'simulate']

SCENARIOS = tuple(DEFAULTS)
SWAY_STEP = 0.1      # s between draws of the sway
FORMS = {'counts': OdometerForm('cumulative', 2**64, 'm/pulse'),
         'speed': OdometerForm('rate', 0, '1'),
         'angle': OdometerForm('cumulative', 0, 'm/rad')}


@dataclass(frozen=True, eq=False)
class Truth:
    """What a calibration of the drive should find."""

    scale: float                 # m/pulse, 1 or m/rad; of two wheels that of their mean count
    scale_ratio: float           # K / K0
    wheel_scales: tuple[float, ...]
    yaw: float                   # rad, mounting
    pitch: float                 # rad, mounting
    heading: float               # rad from north, clockwise, of b's x axis at the start mark
    distance: float              # m rolled at the odometer's point
    start_ns: int                # start mark: the last Imu sample before the vehicle first moves
    stop_ns: int                 # stop mark: the last Imu sample
    gyro_bias: np.ndarray        # (3,) rad/s at turn-on, frame i
    accel_bias: np.ndarray       # (3,) m/s^2 at turn-on, frame i


@dataclass(frozen=True, eq=False)
class Drive:
    """What all sensors sent in a drive, the options in force and the truth."""

    options: SimOptions
    motion: Motion
    truth: Truth
    form: OdometerForm
    imu: ImuSamples
    odometer: OdometerSamples         # the left one of two wheels
    odometer_right: OdometerSamples
    fix: FixSamples
    heading: HeadingSamples

    def leg(self) -> Leg:
        """Return the drive as one leg between its marks, with all that came before."""
        return Leg(start_ns=self.truth.start_ns, stop_ns=self.truth.stop_ns, imu=self.imu,
                   odometer=self.odometer, odometer_right=self.odometer_right, fix=self.fix,
                   heading=self.heading, form=self.form)


def motion_of(options: SimOptions) -> Motion:
    """Return the true motion of resolved options."""
    route = ROUTES[options.scenario](options.duration, stream(options.seed, 'route'))
    start = Start(options.latitude, options.longitude, options.height,
                  float(yaw_from_heading(options.heading)))
    sway = {'sway': _sway(route.speed, options)} if options.sway else {}
    return Motion(route.speed, route.yaw_rate, start, Hills(options.slope), **sway)


def _sway(speed, options):
    """Return velocities to the side and up: straight lines between draws, less below 1 m/s."""
    breaks = np.round(np.arange(0.0, speed.end + SWAY_STEP, SWAY_STEP), 9)
    size = options.sway * np.clip(np.abs(speed(breaks)), 0.0, 1.0)
    draws = size * stream(options.seed, 'sway').standard_normal((2, len(breaks)))
    return tuple(Profile(breaks, np.stack([x[:-1], np.diff(x) / SWAY_STEP], -1)) for x in draws)


def simulate(options: SimOptions | None = None) -> Drive:
    """
    Return a drive; equal options give equal drives, to the last bit.

    Raises
    ------
    BadUsage
        An option is unknown or out of range.

    """
    options = resolved(options or SimOptions())
    motion = motion_of(options)
    wheels = sensors.odometers(motion, options)
    imu = sensors.imu(motion, options)
    return Drive(
        options=options, motion=motion, truth=_truth(motion, options, imu),
        form=FORMS[options.odometer], imu=imu, odometer=wheels[0],
        odometer_right=wheels[1] if len(wheels) > 1 else no_odometer(),
        fix=sensors.fixes(motion, options),
        heading=(no_heading() if options.heading_sigma is None
                 else sensors.heading(motion, options, options.heading_sigma)))


def _truth(motion, options, imu) -> Truth:
    gyro_bias, accel_bias = sensors.turn_on_biases(options)
    t = (imu.stamp_ns - options.start_ns) * 1e-9
    start = int(np.searchsorted(t, _first_move(motion) + 1e-9, side='right')) - 1
    C_vb = matrix_from_rpy([options.roll, options.pitch, options.yaw])
    x_n = (attitude(motion.at(t[start:start + 1])) @ C_vb)[0, :, 0]
    return Truth(
        scale=options.scale, scale_ratio=options.scale / options.nominal_scale,
        wheel_scales=tuple(sensors.wheel_scales(options)), yaw=options.yaw, pitch=options.pitch,
        heading=float(heading_from_yaw(np.arctan2(x_n[1], x_n[0]))), distance=motion.distance,
        start_ns=int(imu.stamp_ns[start]), stop_ns=int(imu.stamp_ns[-1]),
        gyro_bias=gyro_bias, accel_bias=accel_bias)


def _first_move(motion) -> float:
    """Return the time at which the vehicle first moves, s."""
    speed = motion.speed
    moves = np.flatnonzero((speed.powers != 0).any(axis=1))
    return float(speed.breaks[moves[0]])
