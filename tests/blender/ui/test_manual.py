"""The manual: its links and pictures; made of docs/manual for the zip, opened by panels, without a network."""

import re
import sys
import webbrowser
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest
from support.errors import refused

import build_manual
from blender_primdiffusion.ui import drawing

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
import sidebar

pytestmark = pytest.mark.any_blender


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    urls = []
    monkeypatch.setattr(webbrowser, "open", lambda url, *_, **__: urls.append(url) or True)
    return urls


def button(page: str, anchor: str = "") -> list[str]:
    """Addresses that the question mark of a panel opens."""
    layout = MagicMock()
    drawing.draw_manual_button(layout, page, anchor)
    return [
        layout.operator.return_value.url for call in layout.operator.call_args_list if call.args == ("wm.url_open",)
    ]


def test_the_button_opens_the_page_from_disk_at_its_section(addon, opened):
    (url,) = button("batch", "render")
    assert re.fullmatch(r"file:///.*/docs/manual/batch\.md#render", url)
    assert bpy.ops.wm.url_open(url=url) == {"FINISHED"}
    assert opened == [url]


@pytest.mark.parametrize("page", ["no_such_page", "../captures", ""])
def test_for_a_page_that_is_not_there_the_list_of_pages_is_shown(addon, page):
    assert button(page)[0].endswith("/docs/manual/index.md")


def test_without_the_manual_there_is_no_button(addon, monkeypatch):
    monkeypatch.setattr(drawing, "page_file", lambda _page: None)
    drawing.page_url.cache_clear()
    try:
        assert button("batch") == []
    finally:
        drawing.page_url.cache_clear()


def test_every_panel_and_section_leads_to_a_heading_that_is_there(armature, monkeypatch):
    asked = []
    monkeypatch.setattr(drawing, "draw_manual_button", lambda _layout, page, anchor="": asked.append((page, anchor)))
    for cls in sidebar.panels():
        asked.append((cls.manual_page, cls.manual_section))
        sidebar.draw(cls, bpy.context, opened=True)
    pages = build_manual.manual()
    for page, anchor in filter(lambda pair: pair[0], asked):
        text = pages[f"{page}.html"].decode()
        assert not anchor or f'id="{anchor}"' in text, (page, anchor)
    assert len(asked) > 15


def test_pages_have_tables_anchors_and_no_links_out_of_the_manual(tmp_path):
    (tmp_path / "manual").mkdir()
    (tmp_path / "other.md").write_text("elsewhere")
    (tmp_path / "shot.png").write_bytes(b"picture")
    text = (
        "# A & B\n\n| a | b |\n|---|---|\n| 1 | [c](second.md#deep-down) |\n\n[away](../other.md) ![p](../shot.png) <b>"
    )
    (tmp_path / "manual" / "first.md").write_text(text)
    (tmp_path / "manual" / "second.md").write_text("## Deep Down\n\n[web](https://example.org)")
    files = build_manual.manual(tmp_path / "manual")
    assert set(files) == {"first.html", "second.html", "pictures/shot.png"}
    first = files["first.html"].decode()
    assert "<title>A &amp; B - PrimDiffusion</title>" in first
    assert '<a href="second.html#deep-down">c</a>' in first
    assert '<img src="pictures/shot.png" alt="p"' in first
    assert "other.md" not in first
    assert "away" in first
    assert "&lt;b&gt;" in first
    second = files["second.html"].decode()
    assert '<h2 id="deep-down">' in second
    assert '<a href="https://example.org">' in second


@pytest.mark.parametrize("text", ["[gone](gone.md)", "![gone](gone.png)"])
def test_links_that_lead_nowhere_stop_the_build(tmp_path, text):
    (tmp_path / "page.md").write_text(text)
    with refused(build_manual.ManualError, "page.md"):
        build_manual.manual(tmp_path)


ROOT = Path(__file__).resolve().parents[3]
MANUAL = ROOT / "docs" / "manual"
PAGES = sorted(MANUAL.glob("*.md"))
LINK = re.compile(r"(!?)\[[^\]]*\]\(([^)\s]+)\)")


def links(page: Path) -> list[str]:
    """Targets within the repository."""
    return [target for _, target in LINK.findall(page.read_text(encoding="utf-8")) if not re.match(r"[a-z]+:", target)]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_links_pictures_and_sections_are_there(page):
    for target in links(page):
        name, _, section = target.partition("#")
        path = page.parent / name if name else page
        assert path.exists(), f"{page.name} leads to {target}"
        if section:
            headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            assert section in map(build_manual.slug, headings), f"{page.name} leads to {target}"


def test_the_list_of_pages_names_all_of_them():
    named = {target for target in links(MANUAL / "index.md") if target.endswith(".md")}
    assert named == {page.name for page in PAGES} - {"index.md"}


def test_every_picture_is_shown_somewhere_and_small():
    shown = {(MANUAL / target).resolve() for page in PAGES for target in links(page)}
    shown |= {(ROOT / target).resolve() for target in links(ROOT / "README.md")}
    pictures = list((MANUAL / "pictures").iterdir())
    for picture in pictures:
        assert picture.resolve() in shown, f"no page shows {picture.name}"
        assert picture.stat().st_size <= (1_500_000 if picture.suffix == ".gif" else 120_000), picture.name
    assert sum(picture.stat().st_size for picture in pictures) < 3_000_000
