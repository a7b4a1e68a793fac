# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The allocator of a process that runs for days: what was freed goes back to the system.

Left alone glibc keeps an arena for every thread, and takes arrays of up to 32 MiB out of it once
one was freed: a node held 100 MiB that nobody used after an hour's leg at 1 kHz.
"""

import ctypes

# judgement, of mallopt(3): arenas for all threads together, bytes from which a block is mapped by
# itself
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
