# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Damage of bytes and of the numbers in a message, drawn from a random.Random."""

import struct

INTEGERS = [0, 1, -1, 2, 127, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62,
            2**63 - 1, 2**63, 2**64 - 1]
FLOATS = [0.0, -0.0, 1.0, -1.0, 5e-324, 1e-310, 1e-30, 1e15, 1e200, 1e308, -1e308, float('nan'),
          float('inf'), float('-inf'), 3.14, 1e3, -100.0]


def file_of(bag):
    """Return the file of a bag that holds the messages."""
    return bag if bag.is_file() else next(f for f in sorted(bag.iterdir())
                                          if f.suffix in ('.mcap', '.db3', '.zstd'))


def some_place(rng, size):
    """Return an offset in a file, mostly near its ends."""
    kind = rng.random()
    if kind < 0.25:
        return rng.randrange(min(size, 4096))
    return size - 1 - rng.randrange(min(size, 4096)) if kind < 0.5 else rng.randrange(size)


def spoil(rng, data):
    """Change bytes anywhere: bits, numbers, runs, cuts, repetitions."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        if not data:
            return data
        at = some_place(rng, len(data))
        kind = rng.randrange(7)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            form = rng.choice(['<H', '<I', '<Q', '>H', '>I', '>Q'])
            number = rng.choice(INTEGERS) % 2 ** (8 * struct.calcsize(form))
            if at + 8 <= len(data):
                struct.pack_into(form, data, at, number)
        elif kind == 2 and at + 8 <= len(data):
            struct.pack_into('<d', data, at, rng.choice(FLOATS))
        elif kind == 3:
            run = rng.choice([1, 8, 11, 64, 1000, 20_000])
            data[at:at + run] = rng.randbytes(len(data[at:at + run]))
        elif kind == 4:
            del data[at:at + rng.choice([1, 7, 100, 10_000])]
        elif kind == 5:
            data[at:at] = data[at:at + rng.choice([1, 9, 500, 20_000])]
        elif rng.random() < 0.3:
            del data[at:]
    return data


def cdr(rng, message, head=0):
    """Return a message with one of its numbers odd, or of another length; ``head`` bytes stay."""
    body = bytearray(message)
    if len(body) < head + 12 or rng.random() < 0.1:
        return bytes(body[:head] + spoil(rng, body[head:]))
    at = head + 4 + 4 * rng.randrange((len(body) - head - 8) // 4)
    if rng.random() < 0.7 and at + 8 <= len(body):
        struct.pack_into('<d', body, at, rng.choice(FLOATS))
    else:               # a time, a length of a string or a list, a status
        struct.pack_into('<I', body, rng.choice([at, head + 4, head + 8]),
                         rng.choice(INTEGERS) % 2**32)
    return bytes(body)
