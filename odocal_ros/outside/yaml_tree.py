# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""YAML from outside as a tree, with limits of depth and size, without links."""

from functools import cache
from typing import Any

from odocal_ros.errors import BadConfig
from odocal_ros.outside.limits import check

NODES = 30_000      # judgement: mappings, lists and values of a text: some seconds


@cache
def loader(aliases: bool = False) -> Any:
    """Return a safe loader that refuses what is nested too deep, and ``*links`` unless asked."""
    import yaml

    class Plain(yaml.SafeLoader):       # type: ignore[misc]  # PyYAML has no types here
        """Composes nodes within limits."""

        depth = nodes = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            """Compose a node and what is in it."""
            mark = self.peek_event().start_mark
            if not aliases and self.check_event(yaml.AliasEvent):
                raise yaml.composer.ComposerError(
                    None, None, 'aliases (*name) are not supported, as in ROS', mark)
            deepest = 30    # of mappings and lists in each other
            if self.depth >= deepest:
                raise yaml.composer.ComposerError(
                    None, None, f'nested deeper than {deepest} levels', mark)
            self.nodes += 1
            check(self.nodes, NODES, 'the YAML text', 'values')
            self.depth += 1
            try:
                node = super().compose_node(parent, index)
            finally:
                self.depth -= 1
            if isinstance(node, yaml.MappingNode) and not all(
                    isinstance(key, yaml.ScalarNode) for key, _ in node.value):
                raise yaml.composer.ComposerError(None, None, 'a key that is not text', mark)
            return node

        def flatten_mapping(self, node: Any) -> None:
            """Ignore merges (<<): a few nested ones make millions of keys."""
    return Plain


def composed(text: str, where: str) -> Any:
    """Return the root node of a text (None: it is empty), or raise BadConfig with the place."""
    import yaml
    try:
        return yaml.compose(text, Loader=loader())
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, 'problem_mark', None)
        line = f', line {mark.line + 1}' if mark else ''
        problem = getattr(error, 'problem', None) or ' '.join(str(error).split())
        raise BadConfig(f'{where}{line}: not valid YAML: {problem}') from None
