"""What is common to files of several scans."""

from __future__ import annotations

from typing import Protocol

from amvnet.data.formats.cloud import Cloud


class Recording(Protocol):
    """The scans of one file, in order of time."""

    def __len__(self) -> int:
        """Return the number of scans."""

    def read(self, index: int) -> Cloud:
        """Read the scan at this index, from 0.

        Raises:
            InputError: if it is broken.
        """
