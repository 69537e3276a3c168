"""The page of a comparison: one HTML file and a folder of pictures, usable from disk without a network.

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
    """The page as HTML; `record` is compare.json's content, `written` maps a folder to its pictures."""
    from markupsafe import Markup

    folder = Path(__file__).parent
    style, script = ((folder / name).read_text(encoding="utf-8") for name in ("compare.css", "compare.js"))
    names = list(dict.fromkeys(name for row in record["rows"] for name in row["values"]))
    return template(folder / "compare.html.j2", figure=figure).render(
        record=record,
        names=names,
        better={n: METRICS[n].better if n in METRICS else PROTOCOL_BETTER[n] for n in names},
        data=Markup(data_block(record, written)),
        # Both files belong to mistyle and hold no foreign text.
        style=Markup(style),
        script=Markup(script),
        style_hash=csp_hash(style),
        script_hash=csp_hash(script),
    )


def data_block(record: Mapping[str, Any], written: Mapping[str, PairPictures]) -> str:
    """The page's data as JSON that cannot close its script element."""
    rows = [{**row, **_pictures(written.get(row["folder"]))} for row in record["rows"]]
    text = json.dumps({"rows": rows, "wide": WIDE, "stops": STOPS, "grey": GREY}, ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _pictures(written: PairPictures | None) -> dict[str, Any]:
    return {} if written is None else {"wide": written.wide, "span": written.span, "maps": list(written.maps)}


def figure(value: Any) -> str:
    """A number of the record as text."""
    if value is None:
        return "–"
    if isinstance(value, str):
        return value.replace("inf", "∞")
    if value == 0:
        return "0"
    return f"{value:.4g}" if 1e-3 <= abs(value) < 1e5 else f"{value:.2e}"
