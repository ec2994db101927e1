"""What a notebook shows."""

import re
import xml.etree.ElementTree as ET

import numpy as np
from conftest import Points

import upcr
from upcr._picture import drawing


def dots(path: ET.Element) -> Points:
    return np.array(re.findall(r"M(-?\d+) (-?\d+)h0", path.attrib["d"]), float)


def test_a_picture_of_before_and_after(found: upcr.Registration) -> None:
    html = found._repr_html_()
    assert len(html) < 60_000
    page = ET.fromstring(html)
    svg = page.find("{http://www.w3.org/2000/svg}svg")
    assert svg is not None
    target_before, source_before, target_after, source_after = map(
        dots, svg.findall("{http://www.w3.org/2000/svg}path")
    )
    width, height = float(svg.attrib["width"]), float(svg.attrib["height"])
    for points in (target_before, source_before, target_after, source_after):
        assert len(points) > 100 and (points >= 0).all() and (points <= (width, height)).all()

    def apart(a: Points, b: Points) -> float:
        return float(np.median(np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)))

    # Laid on each other, points lie a few pixels from the other cloud's.
    assert apart(source_after, target_after) < 5
    assert target_before[:, 0].max() <= width / 2 <= target_after[:, 0].min()
    text = "".join(page.itertext())
    for words in ("before", "after", "source", "target", "verdict", f"{found.probability:.3f}"):
        assert words in text


def test_odd_clouds_are_drawn() -> None:
    line = np.c_[np.arange(10.0), np.zeros((10, 2))]
    for cloud in (line, line[:1], np.zeros((3, 3)), line + 1e9):
        ET.fromstring(drawing((cloud, cloud), np.eye(4)))


def test_words_are_escaped() -> None:
    from upcr._picture import page

    line = np.c_[np.arange(10.0), np.zeros((10, 2))]
    assert "<b>" not in page([("a", "<b>")], (line, line), np.eye(4))


def test_far_points_leave_the_picture_to_the_others() -> None:
    from upcr._picture import _frame

    cloud = np.random.default_rng(0).uniform(-1, 1, (1000, 2))
    low, high = _frame(cloud)
    assert (low == cloud.min(axis=0)).all() and (high == cloud.max(axis=0)).all()
    low, high = _frame(np.concatenate([cloud, [[90.0, 0.0], [0.0, -90.0]]]))
    assert (low > -2).all() and (high < 2).all()
