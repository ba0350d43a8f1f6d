from dsrc.review.texts import html_of, quoted


def test_cards_are_the_same_in_markdown_and_in_html() -> None:
    name = quoted("<b>**x**|y_1</b>")
    html = html_of(f"**missed**, {name} & more\n\n| | points |\n|:--|--:|\n| {name} | 3 → 1 |")
    shown = "&lt;b&gt;**x**|y_1&lt;/b&gt;"
    assert f"<p><b>missed</b>, {shown} &amp; more</p>" in html
    assert f">{shown}</td>" in html and ">3 → 1</td>" in html and html.count("<td") == 2 and html.count("<th") == 2
