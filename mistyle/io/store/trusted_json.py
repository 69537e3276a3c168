"""JSON that mistyle wrote itself: markers of finished stages, lists of files, records, locks, plans.

This process reads it with a size limit, since disk errors or other users of a shared folder may have changed it. User
inputs go through io/read.py and io/read_mesh.py instead.
"""

import json
from pathlib import Path
from typing import Any

from mistyle.io.sandbox.bounds import MAX_JSON_BYTES


def read_own(path: Path, limit: int = MAX_JSON_BYTES) -> Any:
    """The JSON value in a file of at most `limit` bytes. Raises OSError or ValueError, however it is damaged."""
    with open(path, "rb") as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"more than {limit >> 20} MiB")
    try:
        return json.loads(data)
    except RecursionError as error:
        raise ValueError("JSON nested without end") from error
