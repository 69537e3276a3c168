"""The comparison's page: one HTML file and the pictures beside it, from disk, with no network.

Every text is escaped (jinja2; the data block has no `<`). The content-security policy allows the page's own script and
style by their hashes, pictures from its own folder, and nothing else.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mistyle.comparison.pictures import GREY, STOPS, WIDE, PairPictures
from mistyle.jobs.report.html import csp_hash, template
from mistyle.measure.pictures.metrics import METRICS
from mistyle.measure.pictures.protocols import PROTOCOL_BETTER


def page(record: Mapping[str, Any], written: Mapping[str, PairPictures]) -> str:
    """The page as text; `record` is compare.json's content, `written` says what pictures each folder has."""
    from markupsafe import Markup

    here = Path(__file__).parent
    style, script = ((here / name).read_text(encoding="utf-8") for name in ("compare.css", "compare.js"))
    names = list(dict.fromkeys(name for row in record["rows"] for name in row["values"]))
    return template(here / "compare.html.j2", figure=figure).render(
        record=record,
        names=names,
        better={n: METRICS[n].better if n in METRICS else PROTOCOL_BETTER[n] for n in names},
        data=Markup(data_block(record, written)),
        # Both files are ours and hold no text of others.
        style=Markup(style),
        script=Markup(script),
        style_hash=csp_hash(style),
        script_hash=csp_hash(script),
    )


def data_block(record: Mapping[str, Any], written: Mapping[str, PairPictures]) -> str:
    """JSON that cannot end the script element it stands in."""
    rows = [{**row, **_pictures(written.get(row["folder"]))} for row in record["rows"]]
    text = json.dumps({"rows": rows, "wide": WIDE, "stops": STOPS, "grey": GREY}, ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _pictures(found: PairPictures | None) -> dict[str, Any]:
    return {} if found is None else {"wide": found.wide, "span": found.span, "maps": list(found.maps)}


def figure(value: Any) -> str:
    """A number of the record as people read it."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value.replace("inf", "∞")
    if value == 0:
        return "0"
    return f"{value:.4g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"
