# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drawn vehicles: an effect alone is that of the whole vehicle; every draw can be driven."""

from dataclasses import asdict
from itertools import cycle

import numpy as np
import pytest

from odocal_ros.errors import BadUsage
from odocal_ros.sim.draw import draw_vehicle, DRAWN_GRADES, EFFECTS, KINDS, ODOMETER_EFFECTS, RARE
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import simulate
from odocal_ros.sim.truth import operator_settings

pytestmark = pytest.mark.slow


def test_a_clean_vehicle_has_no_imperfections_and_the_true_settings():
    options, there = draw_vehicle(7, 'town', 'industrial', ())
    assert options.real == RealEffects()
    assert there == ()
    configured = operator_settings(
        simulate(draw_vehicle(7, 'town', 'industrial', (), duration=200.0)[0]))
    assert configured['imu']['grade'] == 'industrial'
    for group, name in (('imu', 'imu'), ('gnss', 'antenna'), ('odometer', 'odometer')):
        assert configured[group]['lever_arm'] == list(getattr(options, f'{name}_lever_arm'))


@pytest.mark.parametrize('name', EFFECTS)
def test_an_effect_alone_changes_the_drive_and_is_that_of_the_whole(name):
    seeds = range(100, 140)
    alone = [draw_vehicle(seed, 'town', 'industrial', (name,)) for seed in seeds]
    clean = [draw_vehicle(seed, 'town', 'industrial', ())[0] for seed in seeds]
    assert sum(one != bare for (one, _), bare in zip(alone, clean, strict=True)) >= 10
    if name in (*ODOMETER_EFFECTS, 'fix_stamps', 'multipath', 'outages'):
        return                    # alone they always occur
    for seed, (one, there) in zip(seeds, alone, strict=True):
        whole, names = draw_vehicle(seed, 'town', 'industrial')
        assert not there or name in names
        real, plain = asdict(one.real), asdict(RealEffects())
        changed = {k: v for k, v in real.items() if v != plain[k]}
        assert changed.items() <= asdict(whole.real).items()


@pytest.mark.parametrize('name', RARE)
def test_a_rare_effect_is_drawn_only_if_it_is_named(name):
    one, there = draw_vehicle(7, 'town', 'industrial', (name,))
    assert there == (name,)
    assert one != draw_vehicle(7, 'town', 'industrial', ())[0]
    assert name not in draw_vehicle(7, 'town', 'industrial')[1]


@pytest.mark.parametrize(('kind', 'grade'), zip(KINDS, cycle(DRAWN_GRADES)))
def test_a_drawn_vehicle_can_be_driven(kind, grade):
    duration = 320.0 if kind == 'out_and_back' else 260.0
    options, there = draw_vehicle(11, kind, grade, duration=duration, imu_rate=20.0)
    drive = simulate(options)
    assert len(there) >= 15
    assert len(ODOMETER_EFFECTS) > len(set(there) & set(ODOMETER_EFFECTS))
    for samples in (drive.imu, drive.odometer, drive.fix):
        assert (np.diff(samples.stamp_ns) > 0).all()
    assert abs(drive.truth.scale_ratio - 1) < 0.15
    again = simulate(draw_vehicle(11, kind, grade, duration=duration, imu_rate=20.0)[0])
    assert (again.imu.w_i == drive.imu.w_i).all()
    assert (again.fix.latitude == drive.fix.latitude).all()


def test_settings_contain_zero_lever_arms_and_wrong_grades():
    vehicles = [draw_vehicle(seed, 'town', 'consumer', ('lever_arms', 'grade'))[0]
                for seed in range(60)]
    zero = [o for o in vehicles if np.allclose(np.add(o.antenna_lever_arm,
                                                      o.real.antenna_arm_error), 0)]
    assert len(zero) == pytest.approx(0.3 * 60, abs=5 * np.sqrt(60 * 0.21))
    # consumer is the lowest grade: a third of the draws states industrial
    wrong = [o for o in vehicles if o.real.configured_grade == 'industrial']
    assert len(wrong) == pytest.approx(60 / 3, abs=5 * np.sqrt(60 * 2 / 9))


def test_given_options_determine_the_effects():
    arm = (1.0, 0.2, 1.5)
    seed = next(s for s in range(50) if np.allclose(np.add(
        (o := draw_vehicle(s, 'town', 'consumer')[0]).antenna_lever_arm,
        o.real.antenna_arm_error), 0))
    options, _ = draw_vehicle(seed, 'town', 'consumer', antenna_lever_arm=arm, scale=0.5,
                              real={'squat': 0.0})
    assert options.antenna_lever_arm == arm
    assert options.real.antenna_arm_error == (-1.0, -0.2, -1.5)
    assert options.scale == 0.5
    assert options.real.squat == 0


@pytest.mark.parametrize(('change', 'message'), [
    ({'effects': ODOMETER_EFFECTS}, 'a vehicle has one odometer'),
    ({'effects': ('rust',)}, '--effect rust: required: one of triads'),
    ({'effects': ('coarse_sped',)}, '--effect coarse_sped: did you mean coarse_speed'),
    ({'grade': 'navigation'}, 'required: one of consumer')])
def test_invalid_draws_are_refused_with_a_message(change, message):
    with pytest.raises(BadUsage, match=message):
        draw_vehicle(**{'seed': 1, 'kind': 'town', 'grade': 'consumer'} | change)
