# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Planar legs of two wheels for the wheel search: simulated drives, and a lawn."""

from drives import cached, drive
import numpy as np

from odocal_ros.calib.wheel_search.planar import course_pieces, planar_leg, PlanarLeg
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings

RTK = {'fix_noise': 'rtk', 'imu_grade': 'tactical', 'two_wheels': True}
DRIVES = {
    'town': RTK | {'scenario': 'town', 'duration': 300.0},
    'another town': RTK | {'scenario': 'town', 'duration': 400.0, 'seed': 3},
    'noisy town': {'scenario': 'town', 'two_wheels': True, 'duration': 300.0, 'outliers': 0.02},
    'out and back': RTK | {'scenario': 'out_and_back', 'duration': 400.0},
    'straight': {'scenario': 'straight', 'two_wheels': True, 'duration': 400.0},
    'paper': {'scenario': 'paper', 'two_wheels': True, 'odometer': 'angle'}}
TRUE = np.array([0.99, 1.015, 0.03])       # K_L, K_R and yaw of the simulated planar drives


@cached
def simulated(heading_error=0.0, **options):
    """Return a simulated drive and its planar leg with an error of the heading from north."""
    made = drive(**options)
    scale, pitch = made.options.nominal_scale, made.options.pitch
    grade = made.options.imu_grade
    config = with_settings(Config(), {
        'imu.grade': 'navigation' if grade == 'perfect' else grade,
        'alignment.heading_source': 'fixed',
        'alignment.heading': float(made.truth.heading + heading_error)})
    inputs, _ = screen(made.leg(), config)
    found, _ = prepare(made.leg(), inputs, config)
    left, right = (dead_reckon(*found.epochs, s) for s in inputs.travels)
    start = found.fixes_n[inputs.t_fix < 0.0].mean(axis=0)
    lever_v = np.subtract(made.options.antenna_lever_arm, made.options.odometer_lever_arm)
    return made, planar_leg(left, right, inputs.t_fix, found.fixes_n, inputs.covariance_n,
                            (0.0, start), (scale, scale), pitch, lever_v)


def on_a_plane(lanes=8, sigma=0.02, seed=0, length=15.0, k=600):
    """
    Return a robot's leg on parallel lanes: (K_L L + K_R R) / 2 rotated by heading, with noise.

    Not in circles: on a circle, left minus right is proportional to the position itself.
    """
    path = np.linspace(0.0, lanes * (length + 3.0), 20 * k + 1)
    lane, along = np.divmod(path, length + 3.0)
    turned = np.pi * np.clip((along - length) / 3.0, 0.0, 1.0)       # half turns, left and right
    yaw = np.where(lane % 2 == 0, turned, np.pi - turned)
    ds, dyaw = np.diff(path), np.diff(yaw)
    direction = np.exp(1j * (yaw[1:] + yaw[:-1]) / 2)
    left = np.cumsum((ds - 0.5 * dyaw) / TRUE[0] * direction)[::20]
    right = np.cumsum((ds + 0.5 * dyaw) / TRUE[1] * direction)[::20]
    fixes = np.exp(1j * TRUE[2]) * (TRUE[0] * left + TRUE[1] * right) / 2
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(fixes), 2))
    p = plane(fixes) + noise
    sigmas = np.full(len(fixes), max(sigma, 1e-3))
    return PlanarLeg(np.arange(len(fixes)) / 5.0, plane(left), plane(right), p, np.zeros(2),
                     sigmas, 1.0, 1.0, pieces=course_pieces(p, sigmas))


def plane(p):
    return np.stack([p.real, p.imag], -1)
