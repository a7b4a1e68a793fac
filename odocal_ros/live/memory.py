"""
The allocator of a process that runs for days: what was freed goes back to the system.

Left alone glibc keeps an arena for every thread, and takes arrays of up to 32 MiB out of it once
one was freed: a node held 100 MiB that nobody used after an hour's leg at 1 kHz.
"""

import ctypes

# of mallopt(3): arenas for all threads together, bytes from which a block is mapped by itself
OPTIONS = {-8: 2, -3: 2**22}
_libc = ctypes.CDLL(None)


def hold_little() -> None:
    """Keep little of what is freed; nothing changes where the C library has no such options."""
    if hasattr(_libc, 'mallopt'):
        for option, value in OPTIONS.items():
            _libc.mallopt(option, value)


def give_back() -> None:
    """Give whole free pages back; nothing where the C library cannot."""
    if hasattr(_libc, 'malloc_trim'):
        _libc.malloc_trim(0)
