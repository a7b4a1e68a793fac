# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A flood of parameters in a leg, and a sender that restarts in it: the node goes on."""

from bench import wait_for
from player import ended, messages_of, part, Player, recording, straight
import pytest
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter

pytestmark = pytest.mark.slow
SPEED = 15.0
REQUESTS = 20


def flood(client):
    """Ask to set all parameters to odd values, again and again; return the futures."""
    asked = client.send(ListParameters, 'list_parameters', ListParameters.Request())
    wait_for(asked.done, 'the names of the parameters')
    names, futures = asked.result().result.names, []
    for k in range(REQUESTS):
        wanted = [Parameter(name, value=value).to_parameter_msg()
                  for name in names for value in (k, 'x' * 50, float('nan'), [True] * 100)]
        futures += [
            client.send(SetParameters, 'set_parameters', SetParameters.Request(parameters=wanted)),
            client.send(SetParametersAtomically, 'set_parameters_atomically',
                        SetParametersAtomically.Request(parameters=wanted))]
    return futures


def test_a_leg_survives_a_flood_of_parameters_and_a_restart_of_the_sender(start, connect):
    types, sent = messages_of(straight())
    node, client = start(), connect()
    player = recording(client, (types, sent), 45, 60, SPEED)
    with player.playing(part(sent, 60, 95), SPEED):
        futures = flood(client)
        wait_for(lambda: all(one.done() for one in futures), 'the answers')
        wait_for(lambda: float(client.status['duration_s']) > 34.0, 'the rest of the drive')
    for one in futures:
        answer = one.result()
        results = answer.results if hasattr(answer, 'results') else [answer.result]
        assert not any(result.successful for result in results)
        assert all(result.reason for result in results)
    assert len(node.lines) < 20
    for publisher in player.publishers.values():
        client.node.destroy_publisher(publisher)
    player = Player.connected(client, types)
    player.play(part(sent, 95, 115), SPEED)
    answer = ended(client, player, part(sent, 115, 117), SPEED)
    assert 'scale factor 1.0' in answer.message
    assert node.process.poll() is None
