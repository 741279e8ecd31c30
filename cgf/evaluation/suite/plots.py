"""Lines in axes, as an SVG file in the style of the other plots of the documents."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 300, 220
"""Of the axes of a panel."""
_LEFT, _TOP, _BOTTOM, _RIGHT = 44, 34, 44, 76
_LABEL_STEP = 14


@dataclass(frozen=True)
class Series:
    """A line with its label at the end."""

    label: str
    color: str
    points: tuple[tuple[float, float], ...]
    """x, and y in percent, by ascending x."""
    dashed: bool = False


@dataclass(frozen=True)
class Panel:
    """Axes with lines; y goes from 0 to above the highest of them."""

    title: str
    x_label: str
    ticks: tuple[tuple[float, str], ...]
    """Places along x, and what is written there; the first and the last are the ends of the axis."""
    series: tuple[Series, ...]


def figure(panels: Sequence[Panel], *, columns: int = 2) -> str:
    """The panels in rows of so many."""
    columns = max(min(columns, len(panels)), 1)
    width, height = _LEFT + WIDTH + _RIGHT, _TOP + HEIGHT + _BOTTOM
    rows = -(-len(panels) // columns)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {columns * width} {rows * height}" '
        'font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="#fff"/>',
    ]
    for place, panel in enumerate(panels):
        x, y = place % columns * width + _LEFT, place // columns * height + _TOP
        parts += [f'<g transform="translate({x} {y})">', *_panel(panel), "</g>"]
    return "\n".join([*parts, "</svg>", ""])


def _panel(panel: Panel) -> list[str]:
    low, high = panel.ticks[0][0], panel.ticks[-1][0]
    values = [y for series in panel.series for _, y in series.points]
    top = min(10 * math.ceil(max([*values, 1]) / 10), 100)
    step = 20 if top > 50 else 10

    def at(x: float, y: float) -> tuple[float, float]:
        return WIDTH * (x - low) / (high - low), HEIGHT * (1 - y / top)

    parts = [f'<text x="0" y="-14" font-weight="bold">{escape(panel.title)}</text>']
    for percent in range(0, top + 1, step):
        y = at(low, float(percent))[1]
        parts.append(f'<line x1="0" y1="{y:.1f}" x2="{WIDTH}" y2="{y:.1f}" stroke="#000" stroke-opacity="0.12"/>')
        parts.append(f'<text x="-6" y="{y + 4:.1f}" text-anchor="end">{percent} %</text>')
    for value, text in panel.ticks:
        x = at(value, 0.0)[0]
        parts.append(f'<line x1="{x:.1f}" y1="0" x2="{x:.1f}" y2="{HEIGHT}" stroke="#000" stroke-opacity="0.12"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT + 16}" text-anchor="middle">{escape(text)}</text>')
    parts.append(f'<text x="{WIDTH / 2}" y="{HEIGHT + 34}" text-anchor="middle">{escape(panel.x_label)}</text>')
    ends = []
    for series in panel.series:
        places = [at(x, y) for x, y in series.points]
        dash = ' stroke-dasharray="5 3"' if series.dashed else ""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{series.color}" stroke-width="2"{dash}/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{series.color}"/>' for x, y in places]
        ends.append((*places[-1], series))
    for x, y, series in _apart(ends):
        parts.append(f'<text x="{x + 8:.1f}" y="{y + 4:.1f}" fill="{series.color}">{escape(series.label)}</text>')
    return parts


def _apart(ends: Sequence[tuple[float, float, Series]]) -> list[tuple[float, float, Series]]:
    """Labels from the top, moved down where they would overlap, and all up again where they leave the axes."""
    placed: list[tuple[float, float, Series]] = []
    for x, y, series in sorted(ends, key=lambda end: end[1]):
        placed.append((x, max(y, placed[-1][1] + _LABEL_STEP) if placed else y, series))
    lowest = float(HEIGHT)
    for place in range(len(placed) - 1, -1, -1):
        x, y, series = placed[place]
        placed[place] = (x, min(y, lowest), series)
        lowest = placed[place][1] - _LABEL_STEP
    return placed
