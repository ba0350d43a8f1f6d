"""Report of a campaign, as files and in a document."""

from pathlib import Path

from dsrc.closed_loop.campaign.run import CampaignResult, results_csv
from dsrc.closed_loop.report.report import markdown, publish_report, sections, write_report
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
