"""Pages of a report without the files beside them."""

from __future__ import annotations

import base64
import gzip
import io
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from matplotlib.figure import Figure
from PIL import Image

from airl_mav.report import theme


@contextmanager
def page_alone() -> Iterator[None]:
    """Draw pictures only as the page has them: as PNG they take two thirds of its time."""
    dot = io.BytesIO()
    Image.new("RGB", (1, 1)).save(dot, format="png")

    def settled(figure: Figure) -> bytes:
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine(None)
        return dot.getvalue()

    with patch.object(theme, "render_png", settled):
        yield


def unpacked(data: str) -> str:
    """Return the text that `flight_data.packed` was given."""
    return gzip.decompress(base64.b64decode(data)).decode()
