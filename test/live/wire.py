# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Hostile messages over DDS and services in any order: the node must survive them."""

from dataclasses import dataclass, field
from pathlib import Path
import random
import struct
import sys

from bench import answer_of, Client, NodeProcess, wait_for
from kills import SCALE
from player import Drive, Sent

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'fuzz'))
import mutations

SERVICES = ('start_leg', 'stop_leg', 'mark', 'cancel_leg', 'undo_leg', 'reset', 'save')
BEFORE_S, START_S, STOP_S, LAST_S = 30.0, 60.0, 170.0, 174.0    # of the drive
SIGMAS = 5.0
BAD_WORDS = ('Traceback', 'RuntimeWarning', 'nternal error', ' broke: ')
SET = {'leg__min_distance': 100.0, 'verdict__min_legs': 1, 'imu__nominal_yaw': float('nan')}
# values of the status that no clock may make negative
SPANS = ('duration_s', 'standstill_s', 'distance_m', 'max_speed_mps', 'distance_to_minimum_m',
         'seconds_to_stand', 'estimate_age_s', 'imu_rate_hz', 'odometer_rate_hz', 'fix_rate_hz')


@dataclass
class Seen:
    """Outcome of a round; ``wrong`` is empty if there is no error."""

    seed: int
    sent: int = 0
    hostile: int = 0
    calls: int = 0
    accepted: int = 0
    wrong: list[str] = field(default_factory=list)


class Wire:
    """A node and a hostile sender, in rounds of one drive with increasing stamps."""

    def __init__(self, driven, folder: Path, speed: float) -> None:
        self._client, self._rounds = Client(), 0
        self._drive = Drive(NodeProcess('-p', f'output.directory:={folder}'), self._client, driven,
                            speed)

    def close(self) -> int:
        code = self._drive.node.end()
        self._client.close()
        return code

    def round(self, seed: int) -> Seen:
        """Drive a leg with hostile messages and calls."""
        rng, seen = random.Random(seed), Seen(seed)
        share = rng.choice([0.0, 0.001, 0.01, 0.1, 0.5])
        self._rounds += 1
        for name, value in SET.items():     # the last round may change them
            self._client.set(**{name: value})
        if rng.random() < 0.5:
            self._ask(seen, 'reset')
        places = sorted([BEFORE_S, START_S, STOP_S, LAST_S,
                         *(rng.uniform(BEFORE_S, LAST_S) for _ in range(rng.randrange(6)))])
        for first, last in zip(places, places[1:], strict=False):
            self._play(rng, seen, first, last, share)
            if last == START_S:
                self._ask(seen, 'start_leg')
            elif last == STOP_S:
                self._ask(seen, 'stop_leg', then=(rng, share))
            elif last != LAST_S:
                self._anything(rng, seen)
        self._look(seen)
        return seen

    def _play(self, rng, seen, first, last, share) -> None:
        messages = []
        for one in self._drive.part(first, last):
            stamp_ns = one.stamp_ns + self._rounds * 200 * 10**9
            raw = one.raw[:4] + struct.pack('<iI', *divmod(stamp_ns, 10**9)) + one.raw[12:]
            if rng.random() < share:
                raw, seen.hostile = self._hostile(rng, raw), seen.hostile + 1
            messages.append(Sent(stamp_ns, one.slot, raw))
        seen.sent += len(messages)
        self._drive.player.play(messages, self._drive.speed)

    @staticmethod
    def _hostile(rng, raw: bytes) -> bytes:
        """Return a message with an odd value, stamp, length or frame, or another altogether."""
        kind = rng.randrange(8)
        if kind == 0:      # a wrong time
            odd = rng.choice([0, 1, 2**31 - 1, -1, -2**31, 1_000_000, 1_900_000_000])
            return raw[:4] + struct.pack('<iI', odd, rng.choice([0, 10**9 - 1, 2**32 - 1])
                                         ) + raw[12:]
        if kind == 1:      # a wrong size
            return raw[:4] + rng.randbytes(rng.choice([0, 1, 4, 100, 1000, 100_000]))
        if kind == 2:      # an odd frame of the same length
            size = struct.unpack_from('<I', raw, 12)[0]
            text = rng.choice([b'$(x)', b'\x1b[2J', b'\n', b'\xff\xfe', b'', b'../x'])
            return raw[:16] + text[:size].ljust(size, b'\0') + raw[16 + size:]
        return mutations.cdr(rng, raw)

    def _ask(self, seen, name, then=None) -> None:
        """Call a service and require an answer."""
        call = self._client.ask(name)
        if then:        # a leg ends when its topics have passed the mark
            rng, share = then
            self._play(rng, seen, STOP_S, LAST_S, share)
        answer = answer_of(call)
        seen.calls += 1
        if not answer.message:
            seen.wrong.append(f'{name} answers nothing')

    def _anything(self, rng, seen) -> None:
        """Call a random service, or set a parameter to an odd value."""
        if rng.random() < 0.6:
            self._ask(seen, rng.choice(SERVICES))
            return
        name, value = rng.choice([
            ('leg__min_distance', rng.choice([-1.0, 1e308, float('nan'), 100.0])),
            ('verdict__min_legs', rng.choice([-1, 0, 1, 10**9])),
            ('result__scale_factor', 2.0), ('output__directory', '\0' * 3), ('no__such', 1),
            ('imu__nominal_yaw', float('inf')), ('use_sim_time', 'abc')])
        self._client.set(**{name: value})
        seen.calls += 1

    def _look(self, seen) -> None:
        """Check that the node is running and has reported neither an error nor a wrong value."""
        client, node, seen_before = self._client, self._drive.node, len(self._client.statuses)
        wait_for(lambda: len(client.statuses) > seen_before, 'a status')
        if node.process.poll() is not None:
            seen.wrong.append(f'the node ended with {node.process.returncode}')
        seen.wrong += [line for line in node.lines if any(word in line for word in BAD_WORDS)]
        for status in client.statuses:
            seen.wrong += [f'{key} {status[key]}' for key in SPANS if float(status[key]) < 0]
            if status['verdict'] == 'accepted':
                seen.accepted += 1
                value, sigma = (float(status[f'scale_factor{end}']) for end in ('', '_sigma'))
                if not abs(value - SCALE) <= SIGMAS * sigma:
                    seen.wrong.append(f'accepted: scale {value} +- {sigma}, {SCALE} is true')
        seen.wrong = list(dict.fromkeys(seen.wrong))
        client.statuses[:] = client.statuses[-1:]
        node.lines.clear()
