# Copyright 2026 The koopman_ros Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
