# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""A parameter of another node, as that node describes it."""

from dataclasses import dataclass
import re
from typing import Any

_THOUSANDS = re.compile(r'[-+]?[1-9]\d{0,2},\d{3}')


def parsed_number(text: str) -> float:
    """
    Return the number in a text, which may have a decimal comma.

    >>> parsed_number('45,5')
    45.5

    :raises ValueError: for another text, and where a comma may separate thousands.
    """
    text = text.strip()
    if _THOUSANDS.fullmatch(text) or text.count(',') > 1 or (',' in text and '.' in text):
        raise ValueError(f'{text} can be read in two ways: write a decimal point, and no '
                         'separator of thousands')
    try:
        return float(text.replace(',', '.'))
    except ValueError:
        raise ValueError(f'{text!r} is not a number') from None


@dataclass(frozen=True)
class ParameterDescription:
    """
    Value, unit and range of a parameter.

    >>> width = ParameterDescription('width', 1.5, 'm', 'of the door', '[0, 2] m', 0.0, 2.0, False)
    >>> width.parse('1,75'), width.text
    (1.75, '1.5')
    """

    name: str
    value: Any
    unit: str
    meaning: str
    range: str  #: in words
    lower: float
    upper: float
    read_only: bool
    choices: tuple[str, ...] = ()

    def parse(self, text: str) -> Any:
        """
        Return the value that a text stands for; its node checks the range.

        :raises ValueError: for a text of another type.
        """
        text = text.strip()
        if isinstance(self.value, bool):
            if text.lower() not in ('true', 'false'):
                raise ValueError('write true or false')
            return text.lower() == 'true'
        if isinstance(self.value, int):
            try:
                return int(text)
            except ValueError:
                raise ValueError(f'{text!r} is not a whole number') from None
        if isinstance(self.value, float):
            return parsed_number(text)
        if isinstance(self.value, tuple):
            parts = tuple(part.strip() for part in text.strip('[]').split(','))
            if not self.value or not isinstance(self.value[0], float):
                return parts
            try:
                return tuple(map(float, parts))
            except ValueError:
                raise ValueError('separate numbers by commas') from None
        return text

    @property
    def text(self) -> str:
        """The value as it is written."""
        return _text(self.value)


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ', '.join(map(_text, value))
    if isinstance(value, float):
        return f'{value:.10g}'
    return str(value).lower() if isinstance(value, bool) else str(value)
