# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Inputs and clocks of the node: what it waits for, receives, counts and refuses."""

import signal

from bench import answer_of, wait_for
from player import all_arrived, Drive, light, messages_of, part, with_clock
import pytest

from odocal_ros.bagio import encode
from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture(scope='module')
def sent():
    return light()


def test_the_hint_gives_the_reason_for_waiting(start, connect):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image, Imu
    start()
    client = connect()
    client.until(state='waiting', hint='no IMU on /imu/data: 0 publishers found; start the '
                 'driver or remap imu/data')
    client.node.create_publisher(
        Imu, 'imu/data', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    client.until(hint='/imu/data: 1 publisher found (best effort) but no message yet; check the '
                      'driver')
    client.node.create_publisher(Image, 'odometer', 1)
    wait_for(lambda: 'sensor_msgs/msg/Image' in client.status['missing'], 'the foreign type')
    client.node.create_publisher(Image, 'fix', 1)
    foreign = '/fix carries sensor_msgs/msg/Image, required: sensor_msgs/msg/NavSatFix or '
    wait_for(lambda: foreign in client.status['missing'], 'the foreign type of the fix')


def test_unreadable_messages_are_counted_and_reported(start, connect):
    from std_msgs.msg import Int32MultiArray
    start({'odometer.field': 'data[3]'})
    client = connect()
    publisher = client.node.create_publisher(Int32MultiArray, 'odometer', 10)
    wait_for(publisher.get_subscription_count, 'the subscription')

    def unreadable():
        publisher.publish(Int32MultiArray(data=[1, 2]))
        health = client.health.get('calibrator: odometer', {})
        return health.get('unreadable', '0') != '0' and health
    health = wait_for(unreadable, 'the count')
    assert health['message'].startswith('/odometer: ')
    assert 'data[3]' in client.until(state='waiting')['missing']


def test_an_input_without_messages_is_an_error_in_the_diagnostics(play_to, sent):
    leg = play_to(sent)
    health = leg.client.health

    def imu(**fields):
        return wait_for(lambda: (found := health.get('calibrator: imu', {'level': None}))
                        and found['level'] == fields['level'] and found, f'IMU with {fields}')
    # as in diagnostic_updater; only the aggregator sets STALE
    assert imu(level=b'\x02')['message'].startswith('no IMU on /imu/data')
    with leg.playing(0, 60, 10):
        good = imu(level=b'\x00')
    assert float(good['Actual frequency (Hz)']) == pytest.approx(20, rel=0.05)
    assert good['Events since startup'] == good['messages'] != '0'
    imu(level=b'\x02')         # error: no messages


def test_namespace_and_remaps_are_applied(start, connect, sent):
    node = start({'diagnostic_updater.use_fqn': True}, '-r', '__ns:=/car', '-r',
                 'imu/data:=/front/imu')
    client = connect('/car/calibrator')
    Drive(node, client, sent, names={
        'imu': '/front/imu', 'odometer': '/car/odometer', 'fix': '/car/fix'}).play(0, 3)
    client.until(state='idle')
    wait_for(lambda: '/car/calibrator: imu' in client.health, 'diagnostics with the full name')


def test_a_backward_jump_of_the_simulated_time_cancels_the_leg(play_to, sent):
    leg = play_to(sent, {'use_sim_time': True})
    client, play = leg.client, with_clock(leg)
    play(0, 10)
    client.until(state='idle')
    arrival = wait_for(lambda: client.health.get('calibrator: imu', {}).get('stamp_delay_s'),
                       'diagnostics')
    assert abs(float(arrival)) < 1.0   # on the sim clock; against the wall clock it is a year
    assert client.call('start_leg').success
    play(10, 14)
    play(2, 4)
    assert client.until(leg_event='cancelled')['leg_id'] == '1'
    wait_for(lambda: 'leg 1 is cancelled' in leg.node.text, 'the warning')
    play(4, 6)
    client.until(state='idle')         # the node uses the messages after the jump
    assert client.call('start_leg').success


def test_queued_messages_in_simulated_time_are_not_a_clock_difference(play_to):
    """The node pauses for a moment, as on a busy machine; the simulation does not wait."""
    types, messages = messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=100.0, odometer_rate=10.0, odometer='speed')))
    leg = play_to((types, part(messages, 40, 90)), {'use_sim_time': True, 'publish.rate': 20.0})
    client, play = leg.client, with_clock(leg)
    play(0, 10, 0.001)
    client.until(state='idle')
    for first_s in (10, 20, 30):
        leg.node.process.send_signal(signal.SIGSTOP)
        play(first_s, first_s + 8, 0.0)
        leg.node.process.send_signal(signal.SIGCONT)
        play(first_s + 8, first_s + 10, 0.001)
    client.until(state='idle')
    assert not [s['hint'] for s in client.statuses if 'CLOCKS_DIFFER' in s['hint']]
    assert client.call('start_leg').success


def test_a_restart_of_the_imu_stamps_cancels_the_leg(play_to, sent):
    leg = play_to(sent)
    leg.record(10, 20)
    waiting = leg.client.ask('stop_leg')
    leg.client.until(state='computing')    # waits for samples beyond the mark, which never come
    leg.play(0, 5)
    leg.client.until(leg_event='cancelled')
    answer = answer_of(waiting)
    assert not answer.success
    assert 'time jumped' in answer.message
    assert 'time jumped' in leg.node.text


def test_a_leg_is_stopped_at_the_maximum_duration(play_to, sent):
    leg = play_to(sent, {'leg.max_duration': 10.0})
    leg.record(0, 5, 20)
    leg.client.until(state='rejected', leg_event='stopped')   # 10 s are too short a leg
    assert 'it reached leg.max_duration, 10 s' in leg.node.text
    answer = leg.client.call('stop_leg')
    assert not answer.success
    assert 'LEG_TOO_SHORT' in answer.message


def test_the_odometer_type_is_taken_from_its_publisher(play_to):
    drive = simulate(SimOptions(duration=180.0, imu_rate=20.0, odometer_rate=10.0))
    types, sent = messages_of(drive, odometer=encode.counter('odometer', drive.odometer))
    leg = play_to((types, part(sent, 60, 120)))
    # header stamps of last year, arrival stamps of today: no leg is possible
    with leg.playing(0, 60, 2):
        assert 'CLOCKS_DIFFER' in leg.client.until(state='idle', level=b'\x01')['hint']
        answer = leg.client.call('start_leg')
    assert 'odometer: std_msgs/msg/Int64 on /odometer, best effort' in leg.node.text
    assert not answer.success
    assert 'CLOCKS_DIFFER' in answer.message
    assert 'days ahead of' in answer.message       # beyond the range of the setting
    assert 'exceeds the range of time_offset' in answer.message
    assert 'use_sim_time' in answer.message


@pytest.mark.parametrize('offer', ['reliable', 'best effort'])
def test_increments_are_subscribed_as_reliable_where_offered(start, connect, offer):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from std_msgs.msg import Int32
    node = start({'odometer.quantity': 'increment'})
    client = connect()
    client.node.create_publisher(Int32, 'odometer', QoSProfile(
        depth=10, reliability=ReliabilityPolicy[offer.upper().replace(' ', '_')]))
    wait_for(lambda: f'Int32 on /odometer, {offer}' in node.text, f'a {offer} subscription')


def test_no_message_is_lost_at_1_khz_and_services_answer(play_to):
    types, messages = messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=1000.0, odometer_rate=250.0, fix_rate=25.0, odometer='speed')))
    leg = play_to((types, part(messages, 60, 63)), speed=1)
    client = leg.client
    leg.play(0, 1)
    assert client.call('start_leg').success
    leg.play(1, 3)
    assert client.get('leg.min_distance') == [100.0]
    all_arrived(client, leg.sent)
