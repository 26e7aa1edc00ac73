"""Pages of a report without the files beside them."""

from __future__ import annotations

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
