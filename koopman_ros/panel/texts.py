# SPDX-FileCopyrightText: 2026 The koopman_ros Authors
# SPDX-License-Identifier: Apache-2.0

"""Texts from topics, files and browsers, made fit to be shown."""


def plain(text: str, longest: int) -> str:
    """Return a text on one line, without what cannot be shown, of so many characters at most."""
    # it may be huge: cut first, generously, as blanks go
    line = ' '.join(text[:4 * longest].split())
    if not line.isprintable():
        line = ''.join(one if one.isprintable() else '�' for one in line)
    return line if len(line) <= longest else line[:longest - 1] + '…'
