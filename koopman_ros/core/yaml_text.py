# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""YAML that others wrote: metadata of bags, parameter files, messages of a command line."""

from typing import Any


def load_yaml(text: str, deepest: int = 50) -> Any:
    """
    Return the content of a YAML text, in plain types.

    Aliases are rejected: a few hundred bytes of them stand for gigabytes once they are written
    out. So is deep nesting, whose parsing takes time by the square of the depth. Neither rosbag2
    nor the parameter files of ROS have any.

    :raises ValueError: for a text that is not YAML, has an alias, or is nested too deeply.
    """
    # imported here: most programs read no YAML, and the import takes time at their start
    import yaml

    # libyaml is in the wheels and in packages of distributions, and ten times as fast
    loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
    try:
        depth = 0
        for event in yaml.parse(text, loader):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent):
                raise ValueError(f'line {event.start_mark.line + 1} has the alias *{event.anchor}'
                                 ': write its content in its place')
            if depth > deepest:
                raise ValueError(f'more than {deepest} levels of nesting')
        return yaml.load(text, loader)
    # the constructors raise others, on a date with a 13th month for example
    except (yaml.YAMLError, ValueError, TypeError, AttributeError) as error:
        raise ValueError(f'not valid YAML: {" ".join(str(error).split())[:200]}') from error
