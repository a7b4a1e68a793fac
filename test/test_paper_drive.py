# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The paper's drive (method.md 1.6), free of sensor errors, and with the errors the paper puts in.

Signs: computed attitude = (I - [phi x]) true attitude, phi in ENU; errors are estimate - truth.
"""

from dataclasses import replace

from drives import drive, settings, two_point
import numpy as np
import pytest

from odocal_ros.nav.rotations import exp_so3, matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.sim.motion import attitude

ARC_MINUTE = float(np.deg2rad(1 / 60))
DRIFT = np.deg2rad(0.01) / 3600


@pytest.fixture(scope='module')
def paper():
    return drive(scenario='paper', imu_grade='perfect', fix_sigma=0.0, yaw=np.deg2rad(1.0),
                 pitch=0.0, odometer='angle', scale=0.3, odometer_rate=50.0)


@pytest.fixture(scope='module')
def config(paper):
    return settings(paper, heading_sigma=1e-5)


@pytest.fixture(scope='module')
def own(paper, config):
    """Return the alignment that the leg itself gives, with the true attitude in it."""
    from odocal_ros.pipeline import prepare
    kept = []
    align = prepare.align
    prepare.align = lambda *args: kept.append(align(*args)) or kept[-1]
    try:
        calibrate(paper.leg(), config)
    finally:
        prepare.align = align
    alignment = kept[0][0]
    o = paper.options
    t = np.array([alignment.t + (paper.truth.start_ns - o.start_ns) * 1e-9])
    C_nb = attitude(paper.motion.at(t))[0] @ matrix_from_rpy([o.roll, o.pitch, o.yaw])
    return replace(alignment, C_nb=C_nb, gyro_bias=np.zeros(3))


def yaw_error_deg(paper, config, alignment=None):
    estimates = two_point(paper.leg(), config, alignment=alignment).estimates
    return np.rad2deg(estimates['yaw_mounting_angle'].value - paper.truth.yaw)


def tilted(alignment, phi_n):
    """Return the alignment with a misalignment phi: computed = (I - [phi x]) true."""
    return replace(alignment, C_nb=exp_so3(-np.asarray(phi_n)) @ alignment.C_nb)


@pytest.mark.parametrize('odometer', ['counts', 'angle', 'speed'])
def test_error_free_sensors_give_the_truth(odometer):
    """K0 wrong by 20 %, mounting 1 deg: scale within 1e-6, yaw within 0.001 deg."""
    made = drive(scenario='paper', imu_grade='perfect', fix_sigma=0.0, yaw=np.deg2rad(1.0),
                 odometer=odometer, imu_rate=100.0)
    assert made.options.nominal_scale == pytest.approx(1.2 * made.truth.scale)
    result = calibrate(made.leg(), settings(made, heading_sigma=1e-5))
    e = result.methods['two_point'].estimates
    assert result.verdict.value == 'accepted'
    assert e['scale_factor'].value == pytest.approx(made.truth.scale, rel=1e-6)
    assert e['scale_ratio'].value == pytest.approx(1 / 1.2, rel=1e-6)
    assert np.rad2deg(e['yaw_mounting_angle'].value) == pytest.approx(1.0, abs=1e-3)
    assert np.rad2deg(e['pitch_mounting_angle'].value) == pytest.approx(
        np.rad2deg(made.truth.pitch), abs=1e-3)


def test_the_alignment_of_the_leg_is_the_truth(paper, config, own):
    """Without errors the row `none` is what plane and interpolation leave: under 1e-5 deg."""
    assert abs(yaw_error_deg(paper, config)) < 1e-5
    assert abs(yaw_error_deg(paper, config, own)) < 1e-5


def test_an_initial_heading_error_goes_into_the_yaw_with_the_sign_of_the_table(paper, config,
                                                                               own):
    none = yaw_error_deg(paper, config, own)
    error = yaw_error_deg(paper, config, tilted(own, [0.0, 0.0, 3.6 * ARC_MINUTE])) - none
    assert error == pytest.approx(-0.05998, rel=0.05)
    assert error == pytest.approx(-0.06, rel=1e-3)           # minus phiU itself


def test_a_drift_about_the_vertical_goes_into_the_yaw_by_the_table(paper, config, own):
    """The drift acts from the moment of moving, as it is a bias taken wrong: bias - drift."""
    none = yaw_error_deg(paper, config, own)
    # a gyro that reads eps too much, its bias not known: as if the bias taken were eps too small
    error = yaw_error_deg(paper, config, replace(own, gyro_bias=np.array([0.0, 0.0, -DRIFT])))
    assert error - none == pytest.approx(8.40e-4, rel=0.05)
    # 1.5: eps times the distance-weighted mean time, 300 s of the symmetric drive
    assert error - none == pytest.approx(np.rad2deg(DRIFT * 300.0), rel=0.01)


def test_an_initial_level_error_east_goes_into_the_yaw_by_the_earths_turn(paper, config, own):
    """
    The row phiE0 less the row none, -1.379e-4 - 0.70e-5 deg; closed form -phiE w cosL t / 2.

    The tilt is carried into the heading by the Earth's turn over the drive; 5 % holds the end
    ramps that the closed form's constant speed leaves out. phiN0 has next to none.
    """
    none = yaw_error_deg(paper, config, own)
    east = yaw_error_deg(paper, config, tilted(own, [0.5 * ARC_MINUTE, 0.0, 0.0])) - none
    assert east == pytest.approx(-1.379e-4 - 0.70e-5, rel=0.05)
    north = yaw_error_deg(paper, config, tilted(own, [0.0, 0.5 * ARC_MINUTE, 0.0])) - none
    assert abs(north) < 0.15 * abs(east)


def test_the_scale_error_of_a_heading_error_is_of_second_order(paper, config, own):
    """A turned track is as long: 3.6' leaves the scale alone to the cosine of nothing."""
    estimates = two_point(paper.leg(), config,
                          alignment=tilted(own, [0.0, 0.0, 3.6 * ARC_MINUTE])).estimates
    assert estimates['scale_factor'].value == pytest.approx(paper.truth.scale, rel=1e-7)


def test_the_yaw_sigma_holds_the_heading_that_was_given(paper):
    sigma = 3.6 * ARC_MINUTE
    e = two_point(paper.leg(), settings(paper, heading_sigma=sigma)).estimates
    # nothing else comes near: gyro and fixes of this drive are below 5e-4 deg
    assert e['yaw_mounting_angle'].sigma == pytest.approx(sigma, rel=1e-3)
