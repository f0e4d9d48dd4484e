"""Pages with animations, read."""

import json
from html.parser import HTMLParser

import numpy as np


class Page(HTMLParser):
    """The elements of a page by their id, with what is in them; and every address that it refers to."""

    def __init__(self, path):
        super().__init__()
        self.text, self.references, self._open = {}, [], None
        self.feed(path.read_text(encoding="utf-8"))
        self.data = json.loads(self.text["data"])

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.references += [named[key] for key in ("src", "href") if key in named]
        self._open = named.get("id")
        if self._open:
            self.text[self._open] = ""

    def handle_data(self, data):
        if self._open:
            self.text[self._open] += data

    def handle_endtag(self, tag):
        self._open = None


def world(data, frame, body, points):
    """Body-fixed points in the inertial frame."""
    points = np.asarray(points, float)
    if body < 0:
        return points
    rotation = np.array(data["orientation"][frame][body]).reshape(3, 3)
    return np.array(data["position"][frame][body]) + points @ rotation.T
