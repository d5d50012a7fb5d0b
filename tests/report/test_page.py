# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""The file in a real browser: it needs no network, its scene is drawn, and it fits a narrow screen."""

import pytest

from tests.view.page import drawn, open_page, why_no_browser

pytestmark = pytest.mark.skipif(why_no_browser() is not None, reason=str(why_no_browser()))


@pytest.mark.parametrize("width", [380, 1200])
def test_a_browser_shows_it_without_a_network(written, width):
    path, _ = written
    with open_page(path.as_uri(), width, 700) as page:
        frame = page.tab.frame_locator("iframe")
        canvas = frame.locator("canvas").first
        page.tab.locator("iframe").scroll_into_view_if_needed()  # a frame that is not seen draws nothing
        canvas.wait_for(state="visible")
        page.wait_until(lambda: drawn(page.screenshot_of("iframe")) > 2_000)
        box = canvas.bounding_box()
        assert box["width"] > 0.8 * page.tab.locator("iframe").bounding_box()["width"]

        # The scene fits into its frame: nothing is drawn at its sides and at its bottom.
        seen = page.screenshot_of("iframe")
        for edge in (seen[4:-4, 4:8], seen[4:-4, -8:-4], seen[-8:-4, 4:-4]):
            assert (edge > 235).all()

        assert page.tab.title()
        assert [name for name in page.requests if not name.startswith(("data:", "blob:", "about:"))] == [
            path.as_uri()
        ]
        assert page.errors == []
        for scrolled, seen in ((page.tab, width), (page.tab.frames[1], box["width"])):
            assert scrolled.evaluate("document.documentElement.scrollWidth") <= seen
