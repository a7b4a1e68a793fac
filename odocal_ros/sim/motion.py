# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
True motion of a vehicle on the WGS 84 ellipsoid, from a speed and a turn-rate profile.

The rear axle's centre moves along the vehicle's x axis, except for an optional sway to the side
and up. Speed, turn rate and sway are piecewise polynomials, so travel and yaw are exact; position
is their integral by four-point Gauss rule between breaks, with errors of 1e-8 m over tens of km.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats, running_sum
from odocal_ros.nav import geodesy
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, rotate_back
from odocal_ros.sim.profile import Hills, Profile

NO_SWAY = Profile([0.0, 1.0], [[0.0]])     # definition: no sway
GAUSS = tuple(zip(*np.polynomial.legendre.leggauss(4), strict=True))     # definition: on -1 to 1


@dataclass(frozen=True)
class Start:
    """Position and direction at the start of the drive."""

    latitude: float     # rad
    longitude: float    # rad
    height: float       # m above the ellipsoid
    yaw: float          # rad from east, counter-clockwise


@dataclass(frozen=True, eq=False)
class State:
    """True state of the vehicle at (n,) times; its frame is v, at the rear axle."""

    t: np.ndarray                # s
    travel: np.ndarray           # m, rolled by the axle's centre
    speed: np.ndarray            # m/s
    acceleration: np.ndarray     # m/s^2, of the speed
    yaw: np.ndarray              # rad, ENU, not wrapped
    yaw_rate: np.ndarray         # rad/s, relative to the local level
    yaw_acceleration: np.ndarray     # rad/s^2
    slope: np.ndarray            # rad, nose up
    slope_rate: np.ndarray           # rad/s
    slope_acceleration: np.ndarray   # rad/s^2
    latitude: np.ndarray         # rad
    longitude: np.ndarray        # rad
    height: np.ndarray           # m
    turn_angle: np.ndarray           # rad, integral of the turn rate about v's z relative to Earth
    sway: np.ndarray             # (n, 2) m/s, along v's y and z axes: not measured by wheels
    sway_acceleration: np.ndarray   # (n, 2) m/s^2


class Motion:
    """
    The true drive: ``at(t)`` gives its state at any times between 0 and ``duration``.

    sway : velocities along v's y and z axes (m/s).
    tilt : roll and pitch (rad) of the body on the vehicle; empty: the body is rigid.
    lean : roll (rad) of the road under its wheels, included in ``tilt``.
    """

    def __init__(self, speed: Profile, yaw_rate: Profile, start: Start,
                 hills: Hills | None = None, sway: tuple[Profile, ...] = (NO_SWAY, NO_SWAY),
                 tilt: tuple[Profile, ...] = (), lean: Profile | None = None) -> None:
        self.speed, self.yaw_rate, self.start = speed, yaw_rate, start
        self.hills, self.sway, self.tilt, self.lean = hills or Hills(), sway, tilt, lean
        self._sway_rate = [profile.derivative() for profile in sway]
        self._acceleration, self._travel = speed.derivative(), speed.integral()
        self._yaw_acceleration, self._turn = yaw_rate.derivative(), yaw_rate.integral()
        self.duration = max(speed.end, yaw_rate.end)
        self._integrate()

    @property
    def distance(self) -> float:
        """Return the path length of the whole drive, m; reversing adds to it."""
        step = 0.01     # s, definition: within it the direction of travel does not change
        ends = np.linspace(0.0, self.duration, max(2, round(self.duration / step) + 1))
        return float(np.abs(np.diff(self._travel(ends))).sum())

    def at(self, t: Floats) -> State:
        """Return the state at times t, (n,) s."""
        t = np.asarray(t, dtype=float)
        node = np.clip(np.searchsorted(self._nodes, t, side='right') - 1, 0, None)
        east, north, up, turn = self._motion_from(self._nodes[node], t - self._nodes[node])
        latitude0, height0 = self._latitude[node], self._height[node]
        latitude, longitude = _angles_from(latitude0, height0 + up / 2, east, north)
        travel, speed, acceleration = self._travel(t), self.speed(t), self._acceleration.mean(t)
        slope, by_path, by_path2 = self.hills(travel)      # and its derivatives by path length
        return State(
            t=t, travel=travel, speed=speed, acceleration=acceleration,
            yaw=self.start.yaw + self._turn(t), yaw_rate=self.yaw_rate(t),
            yaw_acceleration=self._yaw_acceleration.mean(t), slope=slope,
            slope_rate=by_path * speed,
            slope_acceleration=by_path2 * speed**2 + by_path * acceleration,
            latitude=latitude0 + latitude, longitude=self._longitude[node] + longitude,
            height=height0 + up,
            turn_angle=(self._turn_angle[node] + turn
                        + longitude * np.sin(latitude0 + latitude / 2)),
            sway=np.stack([profile(t) for profile in self.sway], -1),
            sway_acceleration=np.stack([profile.mean(t) for profile in self._sway_rate], -1))

    def _integrate(self) -> None:
        """Compute latitude, longitude, height and turn at the nodes of the integration."""
        # 0.1 s: at 0.5 rad/s the error of the Gauss rule is then below round-off
        steps = np.arange(0.0, self.duration, 0.1)
        breaks = [p.breaks for p in (self.speed, self.yaw_rate, *self.sway)]
        nodes = np.unique(np.concatenate([steps, [self.duration], *breaks]))
        self._nodes = nodes = nodes[nodes <= self.duration]
        east, north, up, turn = self._motion_from(nodes[:-1], np.diff(nodes))
        self._height = self.start.height + running_sum(up)
        height = (self._height[1:] + self._height[:-1]) / 2
        latitude = np.full(len(nodes), self.start.latitude)
        # each round gains four digits: the radii change by 1 % per rad of latitude
        for _ in range(5):
            middle = (latitude[1:] + latitude[:-1]) / 2
            step, longitude = _angles_about(middle, height, east, north)
            latitude = self.start.latitude + running_sum(step)
        self._latitude = latitude
        self._longitude = self.start.longitude + running_sum(longitude)
        # moving east turns the local level relative to the Earth by dlon * sin(lat)
        middle = (latitude[1:] + latitude[:-1]) / 2
        self._turn_angle = running_sum(turn + longitude * np.sin(middle))

    def _motion_from(self, t: Floats, duration: Floats) -> Floats:
        """Return m east, north, up, and rad of turn relative to the level, from t on: (4, n)."""
        total = np.zeros((4, *np.shape(t)))
        for node, weight in GAUSS:
            t_node, dt = t + (node + 1) / 2 * duration, weight / 2 * duration
            yaw, slope = self.start.yaw + self._turn(t_node), self.hills(self._travel(t_node))[0]
            ahead, side, rise = (dt * velocity(t_node) for velocity in (self.speed, *self.sway))
            level = ahead * np.cos(slope) - rise * np.sin(slope)
            total += [level * np.cos(yaw) - side * np.sin(yaw),
                      level * np.sin(yaw) + side * np.cos(yaw),
                      ahead * np.sin(slope) + rise * np.cos(slope),
                      dt * self.yaw_rate(t_node) * np.cos(slope)]
        return total


def _angles_about(latitude: Floats, height: Floats, east: Floats,
                  north: Floats) -> tuple[Floats, Floats]:
    """Return the changes, rad, of latitude and longitude by steps, m, about a middle latitude."""
    meridian, normal = geodesy.radii(latitude)
    return north / (meridian + height), east / ((normal + height) * np.cos(latitude))


def _angles_from(latitude: Floats, height: Floats, east: Floats,
                 north: Floats) -> tuple[Floats, Floats]:
    """Return the changes, rad, of latitude and longitude by steps, m, that begin at latitude."""
    step, _ = _angles_about(latitude, height, east, north)
    return _angles_about(latitude + step / 2, height, east, north)


def attitude(state: State) -> Floats:
    """Return C_nv, with n the local level at the vehicle: (n, 3, 3)."""
    return matrix_from_rpy(np.stack([np.zeros_like(state.yaw), -state.slope, state.yaw], -1))


def velocity_n(state: State) -> Floats:
    """Return the velocity over ground of v's origin in ENU, m/s: (n, 3)."""
    return rotate(attitude(state), _velocity_v(state))


def _velocity_v(state: State) -> Floats:
    """Return the velocity over ground of v's origin in v, m/s: (n, 3)."""
    return np.concatenate([state.speed[:, None], state.sway], axis=1)


def rigid_imu_output(state: State,
               lever_arm_v: Floats | tuple[float, float, float]) -> tuple[Floats, Floats]:
    """
    Return the output of a perfect IMU at ``lever_arm_v`` (m, in v), in axes v: w_v, f_v.

    w_v : (n, 3) turn rate in inertial space, rad/s.   f_v : (n, 3) specific force, m/s^2: +g
    along z at rest on the level.
    """
    C_nv, v_n = attitude(state), velocity_n(state)
    sine, cosine = np.sin(state.slope), np.cos(state.slope)
    yaw_rate, yaw_acceleration = state.yaw_rate, state.yaw_acceleration
    # turn rate of v relative to n, in v, and its derivative
    w_nv = np.stack([yaw_rate * sine, -state.slope_rate, yaw_rate * cosine], -1)
    dw_nv = np.stack([yaw_acceleration * sine + yaw_rate * cosine * state.slope_rate,
                      -state.slope_acceleration,
                      yaw_acceleration * cosine - yaw_rate * sine * state.slope_rate], -1)
    a_v = np.concatenate([state.acceleration[:, None], state.sway_acceleration], axis=1)
    a_v = a_v + np.cross(w_nv, _velocity_v(state))

    w_ie_n = geodesy.earth_rate_n(state.latitude)
    transport = geodesy.transport_rate_n(state.latitude, state.height, v_n)
    w_in = rotate_back(C_nv, w_ie_n + transport)
    w_v = w_in + w_nv
    gamma = geodesy.gravity(state.latitude, state.height)
    coriolis = np.cross(2 * w_ie_n + transport, v_n)
    coriolis[:, 2] += gamma
    f_v = a_v + rotate_back(C_nv, coriolis)

    arm = np.asarray(lever_arm_v, dtype=float)
    if arm.any():
        a_n = rotate(C_nv, a_v)
        dw_v = dw_nv - np.cross(w_nv, w_in) + rotate_back(
            C_nv, geodesy.transport_rate_n(state.latitude, state.height, a_n))
        w_e = rotate_back(C_nv, w_ie_n)
        # the Earth's own centrifugal part is in gravity already
        f_v = f_v + (np.cross(dw_v, arm) + np.cross(w_v, np.cross(w_v, arm))
                     - np.cross(w_e, np.cross(w_e, arm))
                     - rotate_back(C_nv, _gravity_change(state, C_nv @ arm, gamma)))
    return w_v, f_v


def _gravity_change(state: State, d_n: Floats, gamma: Floats) -> Floats:
    """Return gravity at d_n (m) from the vehicle minus that at the vehicle, in its ENU."""
    meridian, normal = geodesy.radii(state.latitude)
    tilt_e, tilt_n = d_n[:, 0] / (normal + state.height), d_n[:, 1] / (meridian + state.height)
    gravity_at_d = geodesy.gravity(state.latitude + tilt_n, state.height + d_n[:, 2])
    return np.stack([-gravity_at_d * tilt_e, -gravity_at_d * tilt_n, gamma - gravity_at_d], -1)


def point_geodetic(state: State, lever_arm_v: tuple[float, float, float],
          tilt: Floats | None = None) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude, rad, and height, m, of a point of the body; tilt: C_vb."""
    C = geodesy.C_en(state.latitude, state.longitude) @ attitude(state)
    C = C if tilt is None else C @ tilt
    r_e = geodesy.ecef_from_geodetic(state.latitude, state.longitude, state.height)
    return geodesy.geodetic_from_ecef(r_e + C @ np.asarray(lever_arm_v, dtype=float))


def contact_travel(state: State, lever_arm_v: Floats | tuple[float, float, float],
                   lean: Floats | float = 0.0) -> Floats:
    """Return the path of a wheel with contact at lever_arm_v, m; lean: of the road, rad."""
    _, y, z = lever_arm_v
    if not np.any(lean):
        return state.travel - y * state.turn_angle - z * state.slope
    side = y * np.cos(lean) - z * np.sin(lean)
    turns = np.diff(state.turn_angle, prepend=0.0)
    # the arm at a step is the mean of its ends
    by_turn: Floats = np.cumsum((side + np.append(y, side[:-1])) / 2 * turns)
    return state.travel - by_turn - z * state.slope


def contact_speed(state: State, lever_arm_v: Floats | tuple[float, float, float],
                  lean: Floats | float = 0.0) -> Floats:
    """Return the speed of a wheel with its contact point at lever_arm_v, m/s: (n,)."""
    _, y, z = lever_arm_v
    y = y * np.cos(lean) - z * np.sin(lean)
    return state.speed - y * turn_rate(state) - z * state.slope_rate


def turn_rate(state: State) -> Floats:
    """Return the turn rate about the vehicle's up axis relative to the ground, rad/s: (n,)."""
    east = state.speed * np.cos(state.slope) * np.cos(state.yaw)
    level_turn = east * np.tan(state.latitude) / (geodesy.radii(state.latitude)[1] + state.height)
    return np.asarray(state.yaw_rate * np.cos(state.slope) + level_turn)
