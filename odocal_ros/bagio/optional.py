# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The package rosbags is optional: bags of standard message types are read without it."""

from collections.abc import Iterator
from contextlib import contextmanager

from odocal_ros.errors import BadUsage


@contextmanager
def rosbags_for(what: str) -> Iterator[None]:
    """Raise BadUsage if an import of rosbags fails; ``what`` names the feature that needs it."""
    try:
        yield
    except ModuleNotFoundError:
        raise BadUsage(f'{what} needs the Python package rosbags, which is not installed: '
                       'pip install rosbags') from None
