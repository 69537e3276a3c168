"""OUT/batch.html: every asset of a batch on one page with a sortable table of figures; opens from disk."""

import base64
from io import BytesIO
from pathlib import Path
from typing import Any

from mistyle.batch.plan import BatchPlan
from mistyle.io.store.output import write_file
from mistyle.jobs.report.html import csp_hash, template

THUMBNAIL = 288  # pixels
COLUMNS = ("seconds", "peak_gb")

STYLE = """
:root{color-scheme:light dark;--line:#8884}
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1500px;padding:0 1rem}
h1{font-size:1.4rem}.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(230px,1fr));gap:1rem}
figure{margin:0;border:1px solid var(--line);border-radius:6px;overflow:hidden}
figure img,figure .none{width:100%;aspect-ratio:1;object-fit:contain;display:block;background:#8881}
figcaption{padding:.5rem .7rem;overflow-wrap:anywhere}figcaption small{opacity:.75}.failed figcaption b{color:#d33}
.wide{overflow-x:auto}table{border-collapse:collapse;width:100%;margin:2rem 0;font-variant-numeric:tabular-nums}
th,td{border-bottom:1px solid var(--line);padding:.35rem .6rem;text-align:right}
th:first-child,td:first-child,td.text{text-align:left}th button{all:unset;cursor:pointer}
th[aria-sort=ascending] button::after{content:" ▲"}th[aria-sort=descending] button::after{content:" ▼"}
pre{white-space:pre-wrap;overflow-wrap:anywhere;background:#8881;padding:.6rem;border-radius:6px}
"""

SCRIPT = """
for (const button of document.querySelectorAll('th button')) button.addEventListener('click', () => {
  const head = button.closest('th'), body = head.closest('table').tBodies[0];
  const up = head.getAttribute('aria-sort') !== 'ascending', k = head.cellIndex;
  for (const other of head.parentNode.children) other.removeAttribute('aria-sort');
  head.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const value = row => row.cells[k].dataset.value ?? row.cells[k].textContent;
  const rows = [...body.rows].sort((a, b) => {
    const x = value(a), y = value(b), order = isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y;
    return up ? order : -order;
  });
  body.append(...rows);
});
"""


def write_page(plan: BatchPlan, summary: dict[str, Any]) -> Path:
    """Write OUT/batch.html from a batch's summary; names and messages are escaped, its policy forbids connections."""
    rows = [_row(plan, row) for row in summary["rows"]]
    names = sorted({name for row in rows for name in row["values"] if name not in COLUMNS})
    text = template(Path(__file__).with_name("batch.html.j2")).render(
        title=f"Batch {plan.out.name}",
        s=summary,
        rows=rows,
        columns=[*COLUMNS, *names],
        style=STYLE,
        script=SCRIPT,
        style_hash=csp_hash(STYLE),
        script_hash=csp_hash(SCRIPT),
    )
    write_file(plan.out, "batch.html", text.encode(), overwrite=plan.overwrite)
    return plan.out / "batch.html"


def _row(plan: BatchPlan, row: dict[str, Any]) -> dict[str, Any]:
    folder = plan.out / row["name"] / "report"
    report = folder / "index.html"
    values = {name: row.get(name) for name in COLUMNS} | row.get("figures", {})
    return {
        "name": row["name"],
        "state": row["state"],
        "mesh": row["mesh"],
        "second": row.get("style") or row.get("references", ""),
        "error": row.get("error", ""),
        "last_lines": row.get("last_lines", ""),
        "report": f"{row['name']}/report/index.html" if report.is_file() else "",
        "picture": _thumbnail(folder / "beauty.png") if row["state"] == "done" else "",
        "values": values,
        "notes": row.get("notes", []),
    }


def _thumbnail(path: Path) -> str:
    """A small WebP of a picture file of ours, base64; "" where the file is missing."""
    from PIL import Image

    if not path.is_file():
        return ""
    with Image.open(path) as picture:
        picture.thumbnail((THUMBNAIL, THUMBNAIL))
        buffer = BytesIO()
        picture.convert("RGB").save(buffer, "webp", quality=80)
    return base64.b64encode(buffer.getvalue()).decode()
