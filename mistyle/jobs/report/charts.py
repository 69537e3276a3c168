"""Line and bar charts for the reports, as inline SVG that follows the page's colours."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 300
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 28, 40
# Distinct for people with any colour vision (Okabe and Ito's palette without yellow).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")


@dataclass(frozen=True)
class Chart:
    """Curves over one axis, or bars with `bars`: `series` maps a name to its values over `x` (0, 1, … where empty).
    `log` plots log10 of the values and leaves out values that are not positive."""

    title: str
    series: Mapping[str, Sequence[float]]
    x: Sequence[float] = ()
    x_label: str = ""
    y_label: str = ""
    log: bool = False
    bars: bool = False


def svg(chart: Chart) -> str:
    """The chart as an <svg> element; every text is escaped."""
    points = {name: _points(chart, values) for name, values in chart.series.items()}
    values = [y for line in points.values() for _, y in line]
    if not values:
        return f'<p class="empty">{escape(chart.title)}: nothing to draw</p>'
    low, high = min(values), max(values)
    if chart.bars and not chart.log:
        low, high = min(low, 0.0), max(high, 0.0)
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    xs = [x for line in points.values() for x, _ in line]
    left, right = min(xs, default=0.0), max(xs, default=1.0)
    pad = 0.5 if chart.bars else 0.0
    left, right = left - pad, max(right + pad, left - pad + 1e-9)

    def px(x: float) -> float:
        return LEFT + (x - left) / (right - left) * (WIDTH - LEFT - RIGHT)

    def py(y: float) -> float:
        return HEIGHT - BOTTOM - (y - low) / (high - low) * (HEIGHT - TOP - BOTTOM)

    parts = [f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(chart.title)}">']
    parts += _axes(chart, low, high, left, right, px, py)
    for k, line in enumerate(points.values()):
        colour = COLOURS[k % len(COLOURS)]
        if chart.bars:
            wide = 0.8 * (px(1) - px(0)) / len(points)
            for x, y in line:
                base = py(max(low, 0.0) if not chart.log else low)
                top, tall = min(py(y), base), abs(base - py(y))
                at = px(x) - 0.4 * (px(1) - px(0)) + k * wide
                parts.append(
                    f'<rect x="{at:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{tall:.1f}" fill="{colour}"/>'
                )
        elif line:
            path = " ".join(f"{px(x):.1f},{py(y):.1f}" for x, y in _thinned(line))
            parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
    if len(points) > 1:
        for k, name in enumerate(points):
            x = LEFT + 120 * k
            parts.append(f'<rect x="{x}" y="8" width="10" height="10" fill="{COLOURS[k % len(COLOURS)]}"/>')
            parts.append(f'<text x="{x + 16}" y="17">{escape(name)}</text>')
    return "".join([*parts, "</svg>"])


def _value(chart: Chart, y: float) -> float:
    return math.log10(y) if chart.log else y


def _points(chart: Chart, values: Sequence[float]) -> list[tuple[float, float]]:
    xs = chart.x or range(len(values))
    usable = [(x, y) for x, y in zip(xs, values, strict=False) if math.isfinite(y) and (y > 0 or not chart.log)]
    return [(float(x), _value(chart, y)) for x, y in usable]


def _thinned(line: list[tuple[float, float]], most: int = 400) -> list[tuple[float, float]]:
    step = max(1, len(line) // most)
    return [*line[:-1:step], line[-1]]


def _axes(chart: Chart, low: float, high: float, left: float, right: float, px, py) -> list[str]:
    parts = []
    for tick in _ticks(low, high):
        label = f"{10**tick:.2g}" if chart.log else f"{tick:.4g}"
        y = py(tick)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{label}</text>')
    for tick in _ticks(left, right):
        if not chart.bars or abs(tick - round(tick)) < 1e-9:
            parts.append(f'<text x="{px(tick):.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{tick:.4g}</text>')
    parts.append(
        f'<text x="{(LEFT + WIDTH) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(chart.x_label)}</text>'
    )
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text x="14" y="{middle:.0f}" text-anchor="middle" transform="rotate(-90 14 {middle:.0f})">'
        f"{escape(chart.y_label)}</text>"
    )
    return parts


def _ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers in the range."""
    raw = (high - low) / count
    power = 10 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]
