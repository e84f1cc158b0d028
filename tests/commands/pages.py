"""What the page of every kind of experiment is to show."""

import re


def assert_says_its_result(folder) -> str:
    """In a sentence with a number before all pictures, and to who cannot see these; at most 3 MB.

    Returns the page.
    """
    page = (folder / "report.html").read_text("utf-8")
    result = re.findall(r'<p class="result">(.*)</p>', page)[0]
    assert re.search(r"\d", result) and result.endswith(".")
    assert page.index(result) < page.index("<img") and len(page) < 3_000_000
    charts = re.findall(r'alt="([^"]*)"', re.sub('<div class="gallery">.*?</div>', "", page))
    assert charts and all(one.endswith(result) for one in charts)
    return page
