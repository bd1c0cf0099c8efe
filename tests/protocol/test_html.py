"""Values as HTML: what is shown of long ones, that text is escaped, and that curves fill their height."""

from __future__ import annotations

import re

import numpy as np
import pytest

from urlab_client.values.html import Markup, bold, curve, fields, picture, table


def cells(shown: str) -> list[str]:
    return re.findall(r"<td[^>]*>(?:<span style=\"white-space: nowrap\">)?(.*?)(?:</span>)?</td>", shown)


def test_a_table_has_a_caption_heads_and_the_first_fifty_rows() -> None:
    assert table([]) == "<table></table>"
    assert "<caption" not in table([["a"]], heads=["x"])
    shown = table([[1, 2.0]], heads=["<x>", "y"], caption="a & b")
    assert shown.index("a &amp; b</caption>") < shown.index("&lt;x&gt;</th>") < shown.index("<td")
    assert cells(shown) == ["1", "2"]
    assert cells(table([[i] for i in range(50)])) == [str(i) for i in range(50)]
    assert cells(table([[i] for i in range(52)]))[49:] == ["49", "… 2 more"]


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, ""),
        ("<b>", "&lt;b&gt;"),
        (Markup("<b>"), "<b>"),
        (0.123456, "0.1235"),
        (np.float32(0.5), "0.5"),
        (b"abc", "3 bytes"),
        (True, "True"),
        ("x" * 300, "x" * 300),
        ("x" * 301, "x" * 300 + "…"),
        ([], "[]"),
        ([1, 2.5, None], "[1, 2.5, ]"),
        (np.arange(7), "[0, 1, 2, 3, 4, 5, 6]"),
        (np.arange(8), "[0, 1, 2, 3, 4, 5, 6, …] (8)"),
        (np.zeros((2, 4)), "[0, 0, 0, 0, 0, 0, 0, …] (2 by 4)"),
    ],
)
def test_what_a_cell_shows(value: object, shown: str) -> None:
    assert cells(table([[value]])) == [shown]


def test_fields_without_a_value_are_left_out() -> None:
    shown = fields("it", {"a": 0, "b": None, "c": "", "d": [], "e": {}, "f": b"", "g": False, "h": "x"})
    assert cells(shown) == [bold("a"), "0", bold("g"), "False", bold("h"), "x"]
    assert bold("<") == '<b style="color: inherit">&lt;</b>'


def test_mappings_of_mappings_are_folded_when_they_are_many() -> None:
    named = table([[{"left": {"x": 1, "y": None}, "right": {"x": 2, "z": 3}}]])
    assert "<details open><summary>2</summary>" in named
    assert re.findall(r"<th[^>]*>(.*?)</th>", named) == ["", "x", "z"]
    assert bold("left") in named
    listed = table([[[{"x": 1}, {"x": 2}]]])
    assert re.findall(r"<th[^>]*>(.*?)</th>", listed) == ["x"]
    assert "<b " not in listed
    assert "<details open>" in table([[[{"x": i} for i in range(12)]]])
    assert "<details><summary>13</summary>" in table([[[{"x": i} for i in range(13)]]])


def test_a_curve_fills_its_height_unless_it_is_noise() -> None:
    assert curve([]) == curve([1.0]) == ""
    heights = [float(y) for y in re.findall(r",([\d.]+)", curve([0.0, 1.0, 0.5, np.nan]).partition("points=")[2])]
    assert heights == [30.0, 2.0, 16.0, 30.0]
    assert 'aria-label="from 0 to 1"' in curve([0.0, 1.0])
    points = re.findall(r"([\d.]+),([\d.]+)", curve([5.0, 5.0 + 1e-12]).partition("points=")[2])
    assert points == [("1.0", "16.0"), ("239.0", "16.0")]


def test_a_picture_needs_no_file() -> None:
    assert picture(b"abc", "png", 'the "arm"') == '<img alt="the &quot;arm&quot;" src="data:image/png;base64,YWJj">'
