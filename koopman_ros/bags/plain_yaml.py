# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""YAML as rosbag2 writes it: without aliases and merges, by which a few lines name billions."""

from typing import Any

import yaml

_MERGE = 'tag:yaml.org,2002:merge'


def load_plain(text: str) -> Any:
    """Return the content of a YAML document; raise yaml.YAMLError and others for what is none."""
    return yaml.load(text, Loader=_PlainLoader)


class _PlainLoader(yaml.SafeLoader):
    """Refuse what refers to something said before."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError('aliases are not read in the metadata of a bag')
        return super().compose_node(parent, index)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        if any(key.tag == _MERGE for key, _ in node.value):
            raise yaml.YAMLError('merges are not read in the metadata of a bag')
        super().flatten_mapping(node)
