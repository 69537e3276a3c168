"""Pages as one HTML file: a template with every text escaped, and hashes for a content-security policy."""

import base64
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def template(path: Path, **filters: Callable[[Any], Any]) -> Any:
    """A jinja2 template with `filters`: it escapes every text, and a missing value is an error."""
    import jinja2

    env = jinja2.Environment(
        loader=jinja2.FileSystemLoader(path.parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    env.filters |= filters
    return env.get_template(path.name)


def csp_hash(text: str) -> str:
    """The SHA-256 (base64) by which a content-security policy allows an inline script or style."""
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
