# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""What goes wrong with the bytes of a bag: inside, for one record, and outside, for the bag."""


class BagReadError(ValueError):
    """A bag that is missing, not a bag, damaged or of a kind that is not read here."""

    def __init__(self, sentence: str) -> None:
        # foreign names and the words of other parsers may hold line ends
        super().__init__(' '.join(sentence.split()))


class BagTooLargeError(BagReadError):
    """A bag that would take more memory or time than its size warrants, or than there is."""


class DamageError(Exception):
    """Bytes that do not parse as what they should be."""


def reason(error: BaseException) -> str:
    """Return what another library says of bytes it cannot read, at a bearable length."""
    return f'{type(error).__name__} {error}'.strip()[:200]
