# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decoding of messages to samples: CDR, message types, selection of the counter's field."""
