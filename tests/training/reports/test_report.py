"""Reports: what a reader meets is what the blocks hold, whole, harmless, and found again from where the file lies."""

import base64
import hashlib
import re
import struct
import zlib
from pathlib import Path
from urllib.parse import unquote

import pytest

from datagen.common.errors import StorageError
from tests.support.reports.pages import Elements
from training.evaluation.document import markdown as markdown_of
from training.reports.markup import markup_html
from training.reports.report import (
    Cell,
    Code,
    EmbeddedPage,
    Facts,
    Picture,
    ReportError,
    Section,
    Table,
    Text,
    plain,
    with_best,
    write_report,
)

HOSTILE = "</script><img src=x onerror=alert(1)> | `*_[a](javascript:b) ${title} &amp; <!-- \u2028 '\""


def read(path: Path) -> Elements:
    reader = Elements(path.read_text(encoding="utf-8"))
    assert not reader.open, f"never closed: {reader.open}"
    return reader


def png(path: Path, *, width: int = 3, height: int = 2) -> Path:
    """A black picture."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    lines = zlib.compress(height * (b"\0" + bytes(width)))
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", lines) + chunk(b"IEND", b""))
    return path


def written(folder: Path, *blocks: object, title: str = "A title", lead: str = "A lead.") -> tuple[Elements, str]:
    html, markdown = write_report(folder, title=title, lead=lead, sections=[Section("Results", blocks)])  # type: ignore[arg-type]
    return read(html), markdown.read_text(encoding="utf-8")


def test_the_page_holds_its_pictures_and_loads_nothing(tmp_path: Path) -> None:
    picture, page = png(tmp_path / "deep/a curve.png"), tmp_path / "deep/viewer.html"
    page.write_text("<p>turn me</p>")
    reader, _ = written(tmp_path, Picture(picture, "The **curve**"), EmbeddedPage(page, "To be turned"))
    (image,) = reader.all("img")
    kind, content = (image["src"] or "").split(",")
    assert kind == "data:image/png;base64" and base64.b64decode(content) == picture.read_bytes()
    assert (image["alt"], image["width"], image["height"]) == ("The curve", "3", "2")
    assert not any(name in attributes for name in ("src", "srcset", "data") for _, attributes in reader.elements
                   if attributes is not image)  # fmt: skip
    assert not reader.all("link") and "@import" not in (tmp_path / "report.html").read_text()


def test_links_of_both_files_lead_to_what_lies_beside_them(tmp_path: Path) -> None:
    picture, page = png(tmp_path / "reports/deep/a curve (1).png"), tmp_path / "reports/deep/viewer.html"
    page.write_text("<p>turn me</p>")
    reader, markdown = written(tmp_path / "reports", Picture(picture, "The curve"), EmbeddedPage(page, "To be turned"))
    found = [*re.findall(r"\]\(([^)\s]+)\)", markdown), reader.all("iframe")[0]["data-src"]]
    targets = {(tmp_path / "reports" / unquote(link or "")).resolve() for link in found}
    assert targets == {picture.resolve(), page.resolve()} and len(found) == 3
    assert reader.all("iframe")[0]["loading"] == "lazy"
    assert "deep/viewer.html" in reader.text, "who sees the page without its folder is told where to look"


@pytest.mark.parametrize("where", ["title", "section", "cell", "fact", "code", "alt", "text"])
def test_words_of_users_are_shown_as_they_are_and_do_nothing(tmp_path: Path, where: str) -> None:
    word = {each: HOSTILE if each == where else "x" for each in ("title", "section", "cell", "fact", "code", "alt")}
    section = Section(
        word["section"],
        (
            Table([["a", word["cell"]], [word["cell"], "1"]], plain(word["cell"])),
            Facts({word["fact"]: word["fact"], "hash": Code(word["code"])}),
            Code(word["code"], folded=word["code"]),
            Picture(png(tmp_path / "a.png"), plain(word["alt"])),
            Text(f"Of {HOSTILE if where == 'text' else 'x'}"),
        ),
    )
    html, markdown = write_report(tmp_path, title=word["title"], lead="A lead.", sections=[section])
    reader = read(html)
    assert len(reader.all("img")) == 1 and len(reader.all("script")) == 1
    assert not any(name.startswith("on") for _, attributes in reader.elements for name in attributes)
    assert not any((link["href"] or "").startswith("javascript") for link in reader.all("a"))
    if where not in ("alt", "text"):
        assert " ".join(HOSTILE.split()) in " ".join(reader.text.split())
    outside = re.sub(r"```.*?```|`[^`\n]*`", "", markdown.read_text(), flags=re.DOTALL)
    assert not re.search(r"<(?!/?(details|summary)>)", outside.replace("\\`", ""))


def test_markup_of_callers_is_bold_italic_code_links_lists_and_headings() -> None:
    text = "## Head\nOne **bold**, *it*, `a_b < c`\ngoes on.\n\n- first\n  goes on\n- [two](docs/x.md)\n\n1. three"
    assert markup_html(text).splitlines() == [
        "<h3>Head</h3>",
        "<p>One <strong>bold</strong>, <em>it</em>, <code>a_b &lt; c</code>",
        "goes on.</p>",
        *("<ul>", "<li>first", "goes on</li>", '<li><a href="docs/x.md">two</a></li>', "</ul>"),
        *("<ol>", "<li>three</li>", "</ol>"),
    ]
    assert markdown_of("a < b, `a < b` & **c**") == "a &lt; b, `a < b` &amp; **c**"
    assert markup_html("5 * 3 * 2 and a_b_c, [x](javascript:y)") == "<p>5 * 3 * 2 and a_b_c, [x](javascript:y)</p>"


def test_columns_of_numbers_stand_at_the_right_and_marked_cells_are_bold(tmp_path: Path) -> None:
    lines = [
        ["method", "PMD", "time", "of both", "note", "none"],
        ["ours", Cell("1,024.5", bold=True), "0.3 s", "2.39 / 10.61", "3 of 4", "-"],
        ["theirs", "--", "±12 %", "8.60 ± 0.1", "12", ""],
    ]
    table = Table(lines, "Main results")
    assert table.numeric == [False, True, True, True, False, False]
    reader, markdown = written(tmp_path, table)
    assert [cell.get("class") == "number" for cell in reader.all("th")[:6]] == table.numeric
    assert len(reader.all("strong")) == 1 and "| **1,024.5** |" in markdown
    rule = next(line for line in markdown.splitlines() if line.startswith("|-"))
    assert [column.endswith(":") for column in rule.strip("|").split("|")] == table.numeric


def test_intervals_and_differences_are_numbers_and_a_papers_own_stand_in_italics(tmp_path: Path) -> None:
    lines = [
        ["method", "PMD", "95 %"],
        ["ours", "1.20", "1.1 to 1.3"],
        [Cell("ours", italic=True), Cell(".57", italic=True), "+3.4 (+1.2 to +5.6)"],
    ]
    table = Table(with_best(lines, columns=[1]))
    assert table.numeric == [False, True, True] and table.cells[2][1] == Cell(".57", bold=True, italic=True)
    reader, markdown = written(tmp_path, table)
    assert "<strong><em>.57</em></strong>" in (tmp_path / "report.html").read_text()
    assert "***.57***" in markdown and len(reader.all("em")) == 2


def test_an_interval_stands_below_its_number_and_words_in_brackets_stay_in_their_line(tmp_path: Path) -> None:
    written(tmp_path, Table([["method", "PMD, 95 %"], ["NPT (ours)", "+1.00 (+0.50 to +1.50)"]], "A caption"))
    page = (tmp_path / "report.html").read_text()
    assert "+1.00<br>(+0.50 to +1.50)</td>" in page and "NPT (ours)" in page and "PMD, 95&nbsp;%" in page


def test_lines_of_other_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="line 1 has 1 cells, its heading 2"):
        Table([["a", "b"], ["1"]])


def test_the_best_of_each_group_are_marked_ties_too() -> None:
    lines = [
        ["poses", "method", "PMD", "hits"],
        ["seen", "a", "2.0", "1"],
        ["seen", "b", "1,000.0", "7"],
        ["unseen", "a", "3.0", "-"],
        ["unseen", "b", "3.0", "nothing"],
        ["unseen", "c", "nan", "nothing"],
        ["unseen", "d", "4.0", "4"],
        ["other", "a", "1.0", "4"],
        ["other", "b", "1.0", "4"],
    ]
    lowest = with_best(lines, columns=[2], group=0)
    assert [line[2].bold for line in lowest[1:]] == [True, False, True, True, False, False, False, False]
    assert [line[3].text for line in with_best(lines, columns=[3]) if line[3].bold] == ["1"]
    some = with_best(lines, columns=[2], group=lambda line: None if line[0] == Cell("seen") else "all")
    assert [line[1].text for line in some if line[2].bold] == ["a", "b"], (
        "seen takes no part; the ones of other are least"
    )
    assert lines[1][2] == "2.0", "what was given stays"


def test_contents_list_every_section_and_no_two_share_a_place(tmp_path: Path) -> None:
    titles = ["Results", "Results", "Größe & <b>", "!!"]
    html, _ = write_report(tmp_path, title="T", lead="L", sections=[Section(title, ()) for title in titles])
    reader = read(html)
    places = [heading["id"] for heading in reader.all("h2")]
    links = [link["href"] for link in reader.all("a") if link["href"] != "#content"]
    assert len(set(places)) == 4 and links == [f"#{place}" for place in places]


def test_the_only_script_is_the_one_that_the_page_vouches_for(tmp_path: Path) -> None:
    written(tmp_path)
    page = (tmp_path / "report.html").read_text()
    (script,) = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page and "unsafe-eval" not in page


@pytest.mark.parametrize(("name", "says"), [("missing.png", "cannot be read"), ("mesh.glb", "formats are .png")])
def test_a_picture_that_cannot_be_shown_is_named_and_the_earlier_report_stays(
    tmp_path: Path, name: str, says: str
) -> None:
    written(tmp_path, Text("As it was."))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ReportError, match=f"{name}.*{says}"):
        written(tmp_path, Picture(tmp_path / name, "A picture"))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(StorageError, match="could not write"):
        written(tmp_path / "file")


def test_fences_are_longer_than_those_inside(tmp_path: Path) -> None:
    _, markdown = written(tmp_path, Code("```\ninside\n```"))
    assert "````\n```\ninside\n```\n````" in markdown
