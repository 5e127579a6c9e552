"""The manual as its readers meet it: every picture and section is there, and pictures are small."""

import re
from pathlib import Path

import pytest

import build_manual

pytestmark = pytest.mark.any_blender

ROOT = Path(__file__).resolve().parents[3]
MANUAL = ROOT / "docs" / "manual"
PAGES = sorted(MANUAL.glob("*.md"))
LINK = re.compile(r"(!?)\[[^\]]*\]\(([^)\s]+)\)")


def links(page: Path) -> list[str]:
    """Targets within the repository."""
    return [target for _, target in LINK.findall(page.read_text(encoding="utf-8")) if not re.match(r"[a-z]+:", target)]


def headings(page: Path) -> set[str]:
    """As links call them."""
    return {build_manual.slug(h) for h in re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_links_pictures_and_sections_are_there(page):
    for target in links(page):
        name, _, section = target.partition("#")
        path = page.parent / name if name else page
        assert path.exists(), f"{page.name} leads to {target}"
        if section:
            assert section in headings(path), f"{page.name} leads to {target}"


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
