"""Tables as a page: what of the little Markdown becomes what."""

from cap4d.evaluate.protocols.layout import table
from cap4d.evaluate.protocols.markup import as_html


def test_lines_become_blocks():
    page = as_html(
        ["# A & B", "", "One sentence", "on two lines.", "", "- first", "- <second>", "", "## More"]
    )
    assert "<title>A &amp; B</title>" in page and "<h1>A &amp; B</h1>" in page and "<h2>More</h2>" in page
    assert "<p>One sentence on two lines.</p>" in page
    assert "<ul><li>first</li>\n<li>&lt;second&gt;</li></ul>" in page


def test_a_table_keeps_its_cells_whatever_they_say():
    page = as_html(table(["avatar", "driven by"], ["gaze"], [(["a|b", "<c>"], {"gaze": 1.0}, 3)], "frames"))
    assert "<tr><td>a|b</td><td>&lt;c&gt;</td>" in page
    assert "<td class='number'>1.00</td><td class='number'>3</td></tr>" in page
    assert page.count("<tr>") == 2
