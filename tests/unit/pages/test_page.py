"""The frame that all pages share."""

from __future__ import annotations

from stereotruth.pages.page import PAPER, write_page

TEMPLATE = """{% extends "base.html.jinja" %}
{% from "parts.html.jinja" import cards with context %}
{% block title %}{{ name }}{% endblock %}
{% block main %}{{ cards(headlines) }}{% endblock %}
"""


def write(folder, **values):
    (folder / "own.html.jinja").write_text(TEMPLATE)
    given = {"name": "A <b>", "headlines": [], **values}
    write_page(folder / "page.html", folder / "own.html.jinja", given)
    return (folder / "page.html").read_text()


def test_a_page_leads_to_the_paper_and_to_the_index_if_there_is_one(tmp_path):
    text = write(tmp_path)
    assert "<title>A &lt;b&gt;</title>" in text
    assert PAPER in text and "All pages" not in text
    assert '<a href="../index.html">← All pages</a>' in write(tmp_path, index="../index.html")


def test_six_cards_are_shown_and_the_rest_is_folded(tmp_path):
    cards = [{"title": f"t{k}", "value": f"{k}", "note": "", "bad": False} for k in range(9)]
    for count, folded in ((6, ""), (9, "3 more figures")):
        text = write(tmp_path, headlines=cards[:count])
        first, _, rest = text.partition("<details")
        assert first.count("<dt>") == 6
        assert rest.count("<dt>") == count - 6
        assert folded in text
