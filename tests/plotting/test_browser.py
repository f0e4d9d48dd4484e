"""The quarter-car's page in a real browser: it draws, its controls move what it draws, and nothing is amiss.

Runs where there is a Chromium, the program that the environment variable CHROMIUM names, or `chromium`,
`chromium-browser`, `google-chrome` or `chrome-headless-shell` on the path; and `chromedriver` on the path.
"""

import numpy as np
import pytest
from browser import CHROMIUM, Browser
from matplotlib.colors import rgb_to_hsv, to_rgb
from pages import Page

from lgsens import plotting

if CHROMIUM:

    @pytest.fixture
    def page(rig, tmp_path):
        """The five-link suspension, its wheel from full droop to full bump."""
        return plotting.animate(rig, tmp_path / "car.html", title="Quarter-car")

    @pytest.fixture
    def browser(tmp_path):
        with Browser(CHROMIUM, tmp_path / "profile") as browser:
            yield browser

    def opened(browser, page):
        browser.open(page)
        browser.ask("document.getElementById('legend').style.display = 'none'")  # its colours lie over the canvas
        return Page(page).data

    def box(browser, element):
        """Left, top, width and height of an element in the picture."""
        rectangle = f"document.getElementById('{element}').getBoundingClientRect()"
        return browser.ask(f"(({{x, y, width, height}}) => [x, y, width, height])({rectangle})")

    def canvas(browser):
        left, top, width, height = (round(number) for number in box(browser, "view"))
        return browser.picture()[top : top + height, left : left + width]

    def slide(browser, data, frame):
        """Take the slider by its knob and drag it to a frame; the knob, 16 pixels wide, stays within the slider.

        Paused before: a knob that is dragged to where it is already says nothing, and a page that plays goes on.
        """
        browser.ask("(play => play.textContent === 'Pause' && play.click())(document.getElementById('play'))")
        left, top, width, height = box(browser, "slider")
        last = len(data["clock"]) - 1
        place = lambda at: (left + 8 + (width - 16) * at / last, top + height / 2)
        browser.drag(place(browser.ask("+document.getElementById('slider').value")), place(frame))
        assert browser.ask("+document.getElementById('slider').value") == frame

    def painted(picture, data, role):
        """Which pixels have the hue of a role; faces in front of it make it paler."""
        hue, saturation, _ = np.moveaxis(rgb_to_hsv(picture / 255), -1, 0)
        away = np.abs(hue - rgb_to_hsv(to_rgb(data["colours"][role]))[0])
        return (np.minimum(away, 1 - away) < 0.05) & (saturation > 0.3)

    def top_of_wheel(picture):
        """The highest row of its rim, which is dark grey, as nothing else is but what stands in the corner."""
        rim = (picture.max(axis=2) < 150) & (np.ptp(picture, axis=2) < 30)
        rows, _ = np.nonzero(rim[:-110])
        assert len(rows) > 200
        return rows.min()

    def shown_at(data, frame):
        return f"{data['label']} = {data['values'][frame]:.{data['digits']}f} {data['unit']}"

    def test_the_page_draws_and_the_slider_moves_the_bodies(page, browser):
        data = opened(browser, page)
        time = "document.getElementById('time').textContent"
        first = browser.ask(time)
        assert any(browser.ask(time) != first for _ in range(1000))  # it plays

        slide(browser, data, 0)
        rest = canvas(browser)
        assert browser.ask(time) == shown_at(data, 0)
        assert 0.05 < np.any(rest != 255, axis=2).mean() < 0.95  # neither blank nor full
        for role in ("spring", "damper", "link"):
            assert painted(rest, data, role).sum() > 50, role

        # The wheel is lifted by as many pixels as the data say.
        wheel = next(outline["body"] for outline in data["outlines"] if outline["role"] == "wheel")
        heights = np.array(data["position"])[:, wheel, 2]
        top = int(heights.argmax())
        slide(browser, data, top)
        lifted = canvas(browser)
        assert browser.ask(time) == shown_at(data, top)
        scale = 0.46 * min(rest.shape[:2]) / data["radius"] * np.cos(np.radians(data["view"][0]))
        rise = scale * (heights[top] - heights[0])
        # The edge of the rim is blurred over a pixel or two.
        assert rise > 50 and abs(top_of_wheel(rest) - top_of_wheel(lifted) - rise) < 3

        slide(browser, data, 0)
        assert np.array_equal(canvas(browser), rest)  # the same picture again
        assert not browser.complaints()
        assert browser.requests() == [page.as_uri()]  # nothing from anywhere else

    def test_the_mouse_turns_and_zooms(page, browser):
        data = opened(browser, page)
        slide(browser, data, 0)
        still = canvas(browser)
        left, top, width, height = box(browser, "view")
        middle = (left + width / 2, top + height / 2)
        browser.drag(middle, (middle[0] + 60, middle[1]), (middle[0] + 120, middle[1] + 10))
        turned = canvas(browser)
        browser.mouse("mouseWheel", *middle, deltaX=0, deltaY=-300)
        browser.ask("new Promise(requestAnimationFrame).then(() => 0)")
        zoomed = canvas(browser)
        assert np.any(turned != still, axis=2).mean() > 0.05
        assert np.any(zoomed != turned, axis=2).mean() > 0.05
        assert painted(zoomed, data, "spring").any()
        assert not browser.complaints()
