# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Errors raised on purpose; each door catches OdocalError once and shows its one sentence."""


class OdocalError(Exception):
    """Base of all errors raised here on purpose: the text says what, where and what to do."""


class BadConfig(OdocalError):
    """A setting is unknown, of the wrong type or out of range: edit the file or parameter."""


class BadData(OdocalError):
    """Samples break their contract (shape, type): correct the source."""


class BadBag(OdocalError):
    """A recording is missing, unreadable or holds nothing usable."""


class BadUsage(OdocalError):
    """A command was asked for something it cannot do as asked: call it again, corrected."""
