"""The page of the documentation lists the keys and links that there are."""

import re

from dsrc.review.page.commands import keys_table
from dsrc.review.page.link import VIEW
from dsrc.review.page.panels import CONTROLS
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "review.md").read_text(encoding="utf-8")


def test_the_keys_are_those_of_the_table() -> None:
    assert re.search(r"<!-- keys -->\n(.*?)\n<!-- /keys -->", PAGE, re.DOTALL)[1] == keys_table()


def test_every_part_of_the_link_is_explained() -> None:
    section = PAGE.split("## Sessions and links")[1].split("\n## ")[0]
    explained = {name for row in re.findall(r"^\| (`.*?) \|", section, re.M) for name in re.findall(r"`(\w+)`", row)}
    assert explained == {control.link for control in CONTROLS if control.link} | {VIEW}
