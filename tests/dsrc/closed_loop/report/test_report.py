"""Report of a campaign, as files and in a document."""

import dataclasses
from pathlib import Path

import pytest

from dsrc.closed_loop.campaign.run import CampaignResult, results_csv
from dsrc.closed_loop.report.report import check_publication, markdown, publish_report, sections, write_report
from sim.errors import DataError, UserError
from sim.files import write_file
from tests.dsrc.closed_loop.results import PLAN, RESULTS

RESULT = CampaignResult(PLAN, tuple(RESULTS), (), (), 0, 0.0)


def test_a_document_gets_the_sections_that_it_has_markers_for(tmp_path: Path) -> None:
    out, document = tmp_path / "out", tmp_path / "docs" / "page.md"
    write_file(out / "results.csv", results_csv(RESULT.results))
    write_report(RESULT, out)
    markers = "\n".join(
        f"<!-- {word} campaign/{name} -->" for name in ("arrived", "collisions") for word in ("begin", "end")
    )
    write_file(document, f"# Page\n\nBefore.\n\n{markers}\n\nAfter.\n")
    folder = publish_report(RESULT, out, document)
    text = document.read_text(encoding="utf-8")
    assert "| together | 2 of 2 | 2 of 2 | 2 of 2 | 4 of 4 |" in text and "Hardest" not in text
    assert "](page/campaign/collisions.png)" in text and text.endswith("After.\n")
    assert folder == document.parent / "page" / "campaign"
    # The report beside the document shows all its plots.
    there = {path.name for path in folder.iterdir()}
    assert there == {"report.md", "results.csv", "collisions.png", "corruptions.png"}
    publish_report(RESULT, out, document)
    assert document.read_text(encoding="utf-8") == text


def test_the_report_has_a_heading_for_each_table_and_every_plot() -> None:
    text = markdown(RESULT)
    for section in sections(RESULT):
        assert (f"]({section.picture})" if section.picture else f"## {section.about}\n") in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        pytest.param("<!-- begin campaign/arival -->\n<!-- end campaign/arival -->\n", "arival", id="no such section"),
        pytest.param("<!-- begin campaign/arrived -->\n", "a line <!-- end campaign/arrived --> after it", id="no end"),
        pytest.param("\udcff", "UTF-8", id="bytes"),
    ],
)
def test_a_page_that_cannot_be_written_is_told_before_the_campaign(tmp_path: Path, text: str, expected: str) -> None:
    document = tmp_path / "page.md"
    document.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(DataError, match=expected):
        check_publication(PLAN, document)


@pytest.mark.parametrize("name", ["README", "page.txt", "folder.md"])
def test_a_document_is_a_markdown_file(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.md").mkdir()
    with pytest.raises(UserError, match=name):
        check_publication(PLAN, tmp_path / name)


def test_what_a_run_has_nothing_for_does_not_stay(tmp_path: Path) -> None:
    out, document = tmp_path / "out", tmp_path / "page.md"
    markers = "".join(
        f"<!-- begin campaign/{name} -->\nof a run before\n<!-- end campaign/{name} -->\n"
        for name in ("apart", "crashed")
    )
    clean = dataclasses.replace(RESULT, results=tuple(one for one in RESULTS if one.corruption == "clean"))
    for result in (RESULT, clean):
        write_file(document, markers, edited=True)
        write_file(out / "results.csv", results_csv(result.results))
        write_report(result, out)
        folder = publish_report(result, out, document)
    assert "of a run before" not in document.read_text() and "| together | 0 % [" in document.read_text()
    assert not (out / "corruptions.png").exists()
    assert "seeds 0 to 2 clean." in (folder / "report.md").read_text()


def test_a_document_without_a_place_gets_all_sections_with_titles(tmp_path: Path) -> None:
    out, document = tmp_path / "out", tmp_path / "page.md"
    write_file(out / "results.csv", results_csv(RESULT.results))
    write_report(RESULT, out)
    publish_report(RESULT, out, document)
    text = document.read_text()
    assert text.startswith("# Page\n") and "## By scenario, clean\n\n<!-- begin campaign/scenarios -->\n|" in text
    publish_report(RESULT, out, document)
    assert document.read_text() == text
