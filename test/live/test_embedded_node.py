# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node inside another program: its executor, its context, and a pipeline that fails."""

from contextlib import nullcontext, suppress
import threading
from types import SimpleNamespace

from bench import answer_of, Client, wait_for
from player import Drive, messages_of
import pytest
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from odocal_ros.live import answers, worker
from odocal_ros.live.messages import MessageQueue
from odocal_ros.live.node import AWAITED_TICK_S, TICK_S
from odocal_ros.live.topic_input import Input
from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture
def embedded(tmp_path):
    """Spin the node and another node in one executor of a separate context."""
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.parameter import Parameter

    from odocal_ros.live.node import Calibrator
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Calibrator('second', context=context, cli_args=['--ros-args', '-r', 'fix:=gps/fix'],
                      parameter_overrides=[
                          Parameter('output.directory', value=str(tmp_path)),
                          Parameter('leg.min_distance', value=20.0)])
    executor = SingleThreadedExecutor(context=context)
    for one in (rclpy.create_node('stranger', context=context), node):
        executor.add_node(one)

    def spin():
        with suppress(ExternalShutdownException):
            executor.spin()
    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    client = Client('second')
    client.until(state='waiting')
    yield node, client
    executor.shutdown()
    thread.join(10)
    client.close()
    node.destroy_node()
    context.try_shutdown()


def test_name_overrides_and_remaps_are_passed_to_the_node(embedded):
    _, client = embedded
    assert client.get('leg.min_distance') == [20.0]
    wait_for(lambda: '/gps/fix' in client.status['missing'], 'the remapped topic')
    wait_for(lambda: 'second: imu' in client.health, "diagnostics under the node's name")


def test_messages_wait_in_the_queue_and_have_the_times_of_their_senders(embedded):
    node, client = embedded
    imu = Input(node, 'imu', ('sensor_msgs/msg/Imu',))
    waiting = imu.queue
    assert not waiting.gate.can_execute(imu)   # the executor is not woken for each message
    info = {'received_timestamp': 9, 'publication_sequence_number': 1}
    waiting._receive(b'first', info | {'source_timestamp': 5})
    waiting._receive(b'second', info | {'source_timestamp': 0})  # a middleware without it
    assert imu.take() == ([b'first', b'second'], [5, 9])
    assert imu.take() == ([], [])


def test_without_take_message_the_executor_delivers_all_messages(embedded):
    node, client = embedded
    waiting = MessageQueue(node)
    waiting.subscribe(String, 'words', QoSProfile(depth=10))
    publisher = client.node.create_publisher(
        String, node.resolve_topic_name('words'), QoSProfile(depth=10))
    wait_for(publisher.get_subscription_count, 'the subscription')
    got = []

    def received(words):
        publisher.publish(String(data=words))
        return wait_for(lambda: got.extend(waiting.take()[0]) or (
            got and deserialize_message(got[-1], String).data == words), words)

    assert received('taken')
    assert not waiting.gate.is_open
    kept, waiting._subscription = waiting._subscription, SimpleNamespace(
        handle=nullcontext(), msg_type=String)      # no take_message
    assert received('carried')
    assert waiting.gate.is_open
    waiting.follow_clock()
    assert received('and on')
    assert len(got) == 3
    node.destroy_subscription(kept)


def test_the_timer_period_is_long_unless_a_job_is_waited_for(embedded):
    node, client = embedded
    wait_for(lambda: node._timer.timer_period_ns == round(TICK_S * 1e9), 'long turns')
    gate = threading.Event()
    report_worker = node.operation._saver._report_worker
    report_worker.submit(gate.wait, lambda *_: None)      # a report to be drawn
    wait_for(lambda: node._timer.timer_period_ns == round(AWAITED_TICK_S * 1e9), 'short turns')
    gate.set()
    wait_for(lambda: node._timer.timer_period_ns == round(TICK_S * 1e9), 'long turns again')


def test_an_error_of_the_computation_is_answered_and_the_leg_is_kept(embedded, monkeypatch):
    node, client = embedded
    leg = Drive(node, client, messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=20.0, odometer_rate=10.0, odometer='speed', fix_noise='rtk'))),
        names={'fix': 'gps/fix'})
    leg.record(45, 60, 80)

    def explode(*_):
        raise MemoryError('not enough for this leg')
    monkeypatch.setattr(worker, 'compute', explode)
    stopping = client.ask('stop_leg')
    leg.play(80, 82)
    status, answer = client.until(state='failed'), answer_of(stopping)
    assert not answer.success
    for words in ('MemoryError: not enough for this leg', '~/stop_leg', '~/cancel_leg'):
        assert words in answer.message
    assert status['level'] == b'\x02'
    assert 'not enough for this leg' in status['message']
    assert not client.call('start_leg').success
    monkeypatch.undo()
    # an error after the computation is answered, too, and the node continues
    monkeypatch.setattr(answers, 'result_answer', explode)
    assert 'MemoryError: not enough for this leg' in client.result(client.ask('stop_leg')).message
    client.until(state='calibrated', leg_id='1', legs='1')
    monkeypatch.undo()
    assert 'scale factor' in client.call('stop_leg').message
    # two undo calls remove both legs, although the first is still being combined
    assert client.call('start_leg').success
    leg.play(82, 100)
    leg.ended(100)
    client.until(state='calibrated', leg_id='2', legs='2')
    gate = threading.Event()
    node.operation._worker.submit(gate.wait, lambda *_: None)
    undoing = [client.ask('undo_leg') for _ in range(2)]
    client.until(legs='0')
    gate.set()
    assert all(answer_of(one).success for one in undoing)
    assert (client.call('save').success, client.status['scale_factor']) == (False, 'nan')
