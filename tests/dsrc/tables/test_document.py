"""A document gets a text between its markers, and stays what it is elsewhere."""

from pathlib import Path

import pytest

from dsrc.tables.document import replace_block
from sim.errors import DataError


@pytest.mark.parametrize("text", ["", "<!-- begin toy/drives -->", "<!-- end toy/drives --><!-- begin toy/drives -->"])
def test_a_document_without_markers_is_left_as_it_is(text: str, tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text(text)
    with pytest.raises(DataError, match=r"page\.md: .*toy/drives.*: expected (the lines|a line)"):
        replace_block(document, "toy/drives", "table")
    assert document.read_text() == text
