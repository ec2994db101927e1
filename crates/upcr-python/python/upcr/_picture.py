"""What a notebook shows of a result: its figures, and the clouds before and after as a small drawing."""

from __future__ import annotations

from html import escape

import numpy as np

from ._cloud import FloatArray

_SIZE = 240
_MARGIN = 12
# As in the reports: --cloud-0, --cloud-1, --quiet-text.
_SOURCE, _TARGET, _QUIET = "#cf5f0c", "#11678f", "#5a656e"


def page(lines: list[tuple[str, str]], clouds: tuple[FloatArray, FloatArray], pose: FloatArray) -> str:
    """A result as HTML; ``clouds`` are points of source and target, shape (N, 3), ``pose`` is the one found, (4, 4)."""
    rows = "".join(
        f'<tr><td style="text-align:left;padding-right:1em">{escape(name)}</td><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in lines
    )
    return f"<div>{drawing(clouds, pose)}<table>{rows}</table></div>"


def drawing(clouds: tuple[FloatArray, FloatArray], pose: FloatArray) -> str:
    """Source and target side by side, as they are given and with the source moved, both seen from the same side."""
    source, target = clouds
    moved = source @ pose[:3, :3].T + pose[:3, 3]
    # Seen along the direction in which the target is thinnest.
    center = target.mean(axis=0)
    _, _, axes = np.linalg.svd(target - center, full_matrices=False)
    panels = [
        _panel(title, [(cloud - center) @ axes[:2].T for cloud in shown], x)
        for title, shown, x in (("before", (target, source), 0), ("after", (target, moved), _SIZE))
    ]
    width, height = 2 * _SIZE, _SIZE + 16
    legend = (
        f'<text x="{width - 4}" y="{height - 4}" text-anchor="end">'
        f'<tspan fill="{_SOURCE}">source</tspan> <tspan fill="{_TARGET}">target</tspan></text>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'font-family="system-ui, sans-serif" font-size="11" fill="{_QUIET}">{"".join(panels)}{legend}</svg>'
    )


def _frame(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of what is drawn: all, but for the few far points that a lidar sees, beside which the rest would be a dot."""
    low, high = np.percentile(points, (3, 97), axis=0)
    beyond = (high - low) / 4
    return np.maximum(points.min(axis=0), low - beyond), np.minimum(points.max(axis=0), high + beyond)


def _panel(title: str, clouds: list[FloatArray], x: int) -> str:
    both = np.concatenate(clouds)
    low, high = _frame(both)
    length = float((high - low).max()) or 1.0
    scale = (_SIZE - 2 * _MARGIN) / length
    paths = []
    for cloud, color in zip(clouds, (_TARGET, _SOURCE), strict=True):
        cloud = cloud[((cloud >= low) & (cloud <= high)).all(axis=1)]
        at = np.rint((cloud - (low + high) / 2) * (scale, -scale) + (x + _SIZE / 2, _SIZE / 2)).astype(int)
        dots = "".join(f"M{column} {row}h0" for column, row in np.unique(at, axis=0).tolist())
        paths.append(f'<path d="{dots}" stroke="{color}" stroke-width="2" stroke-linecap="round" stroke-opacity=".7"/>')
    return f'{"".join(paths)}<text x="{x + 4}" y="{_SIZE + 12}">{title}</text>'
