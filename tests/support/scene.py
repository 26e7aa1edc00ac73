"""Checks of screenshots of the view's page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from tests.support.browser import Page

SCENE_PX = 540
"""Width of the scene on a page of 900 px; the panel is beside it."""


def has_drawn(page: Page, shot: Path) -> bool:
    """Return whether the scene has the colours of trail, commanded velocity and depth image."""
    page.screenshot(shot)
    with Image.open(shot) as image:
        scene = np.asarray(image.convert("RGB"))[:, :SCENE_PX].astype(int)
    red, green, blue = scene[..., 0], scene[..., 1], scene[..., 2]
    trail = (blue > 150) & (red < 110) & (blue - red > 80)
    command = (red > 200) & (green > 120) & (blue < 140)
    depth = (green > 120) & (red < 90) & (blue < 160)
    return bool(trail.sum() > 200 and command.sum() > 20 and depth.sum() > 50)
