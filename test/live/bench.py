# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Test bench of the node: its process, a client, and functions that wait for an event."""

import contextlib
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import threading
import time

ROOT = Path(__file__).resolve().parents[2]
START = 'import sys; from odocal_ros.live.{} import main; sys.exit(main(sys.argv))'
NODE = [sys.executable, '-c', START.format('node')]
PATIENCE = 60.0   # s, for one event; only a failing test waits so long


class NodeProcess:
    """
    The node in its own process; its output is kept. The calibrator draws no report.

    before : Python code that runs before the node.   module : module of live/ with the node.
    """

    def __init__(self, *args: str, env: dict | None = None, before: str = '',
                 module: str = 'node') -> None:
        if module == 'node' and args:
            args = ('-p', 'output.formats:=[params]', *args)
        paths = os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH')]))
        self.process = subprocess.Popen(
            [sys.executable, '-c', before + START.format(module),
             *(('--ros-args', *args) if args else ())], text=True,
            bufsize=1, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=os.environ | {'PYTHONPATH': paths} | (env or {}))
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    @property
    def text(self) -> str:
        return '\n'.join(self.lines)

    def end(self, how: int = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        return self.wait()

    def wait(self) -> int:
        try:
            code = self.process.wait(PATIENCE)
        finally:
            if self.process.poll() is None:
                self.process.kill()
        self._reader.join(PATIENCE)
        return code


def wait_for(condition, what: str, patience: float = PATIENCE):
    """Return the result of ``condition`` as soon as it is true; fail after the timeout."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        result = condition()
        if result:
            return result
        time.sleep(0.005)
    raise AssertionError(f'{what} did not come within {patience:g} s')


def given(settings: dict[str, object]) -> list[str]:
    return [x for name, value in settings.items() for x in (
        '-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}')]


def as_dict(status) -> dict:
    """Return a DiagnosticStatus as a dict with its values by key."""
    return {'level': status.level, 'name': status.name, 'message': status.message,
            **{kv.key: kv.value for kv in status.values}}


class Client:
    """A node in the process of the test that calls the calibrator and keeps its messages."""

    def __init__(self, name: str = 'calibrator') -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(f'bench_{random.randint(0, 10**9)}', context=self.context)
        self.name = name
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.statuses: list[dict] = []
        self.arrays: list = []       # the same, as messages
        self.health: dict[str, dict] = {}
        self.paths: dict[str, object] = {}
        self.events: list = []
        self._clients: dict = {}
        self._subscribe()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException
        with contextlib.suppress(ExternalShutdownException):
            self.executor.spin()

    def _subscribe(self) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from nav_msgs.msg import Path as PathMessage
        from rcl_interfaces.msg import ParameterEvent
        from rclpy.qos import DurabilityPolicy, QoSProfile
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        deep = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        subscribe = self.node.create_subscription
        subscribe(DiagnosticArray, f'{self.name}/status', self._on_status, deep)
        subscribe(DiagnosticArray, '/diagnostics', self._on_health, 10)
        for path in ('dead_reckoning', 'reference'):
            subscribe(PathMessage, f'{self.name}/path/{path}',
                      lambda message, path=path: self.paths.update({path: message}), latched)
        subscribe(ParameterEvent, '/parameter_events', self.events.append, 100)

    def _on_status(self, array) -> None:
        self.arrays.append(array)
        self.statuses += map(as_dict, array.status)

    def _on_health(self, array) -> None:
        self.health |= {status.name: as_dict(status) for status in array.status}

    @property
    def status(self) -> dict:
        """Return the newest status, empty before the first."""
        return self.statuses[-1] if self.statuses else {}

    def until(self, **required) -> dict:
        """Return the first status from now on (the newest included) that has these values."""
        first = max(0, len(self.statuses) - 1)

        def found():     # in all received: a state may end before it is tested
            return next((status for status in self.statuses[first:] if all(
                status.get(k) == v for k, v in required.items())), None)
        try:
            return wait_for(found, f'status with {required}')
        except AssertionError as error:
            raise AssertionError(f'{error}; last: {self.status}') from None

    def send(self, kind, name: str, request):
        """Call a service and return the future of its answer."""
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self.node.create_client(kind, f'{self.name}/{name}')
        assert client.wait_for_service(PATIENCE), f'no service {client.srv_name}'
        return client.call_async(request)

    def ask(self, name: str):
        """Call one of the node's Trigger services and return the future of its answer."""
        from std_srvs.srv import Trigger
        return self.send(Trigger, name, Trigger.Request())

    def call(self, name: str):
        """Call one of the node's Trigger services and return its answer."""
        return answer_of(self.ask(name))

    def result(self, stopping):
        """Return the answer with the result, called again while it is provisional."""
        answer = answer_of(stopping)
        while answer.message.startswith('provisional'):     # the fit takes long on a busy machine
            answer = self.call('stop_leg')
        return answer

    def start(self):
        """Start a leg as soon as the node has received the sent messages; return the answer."""
        def begun():
            answer = self.call('start_leg')
            return answer if answer.success else None
        return wait_for(begun, 'a leg that starts')

    def get(self, *names: str) -> list:
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python
        answer = answer_of(self.send(GetParameters, 'get_parameters',
                                     GetParameters.Request(names=list(names))))
        return [parameter_value_to_python(value) for value in answer.values]

    def set(self, **values):  # noqa: A003
        """Set one parameter (dots as two underscores) and return the result."""
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter
        messages = [Parameter(k.replace('__', '.'), value=v).to_parameter_msg()
                    for k, v in values.items()]
        result, = answer_of(self.send(SetParameters, 'set_parameters', SetParameters.Request(
            parameters=messages))).results
        return result

    def close(self) -> None:
        self.executor.shutdown()
        self._thread.join(PATIENCE)
        self.node.destroy_node()
        self.context.try_shutdown()


def answer_of(future):
    """Wait for the answer of a service call and return it."""
    wait_for(future.done, 'the answer of the service')
    return future.result()
