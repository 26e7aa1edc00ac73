"""Reflection models in addition to Lambert's law: Fresnel's equations and microfacets.

Rough surfaces follow Walter et al., Microfacet models for refraction through rough surfaces, 2007:
facets with GGX-distributed slopes and Smith's shadowing, separately for both directions. Reflected
directions are sampled from the visible facets (Heitz, Sampling the GGX distribution of visible
normals, 2018).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from airl_mav.arena.finishes import LUMINANCE, SURFACES, WALLS, Finish
from airl_mav.camera.projection import dot
from airl_mav.core.kernels import borrowing_kernel, kernel
from airl_mav.vehicle.rotation import Vec

MATT: Final = SURFACES.index("matt")
GLOSSY: Final = SURFACES.index("glossy")
METAL: Final = SURFACES.index("metal")
GLASS: Final = SURFACES.index("glass")

INDEX: Final = 1.5
"""Refractive index of varnish and of glass."""

_SMOOTH: Final = 1e-3
"""Value of `alpha` below which a surface is a mirror."""

VARNISH_ADMITS: Final = 0.908222
"""Share of light from all sides that enters varnish: 1 - 0.091778, the mean of Fresnel's
reflectance at the index 1.5 over the cosine."""

SAMPLES: Final = 8
"""Reflected directions sampled at each point of a rough surface; `spread` provides eight."""


class Gloss(NamedTuple):
    """Properties of non-matt surfaces; a tuple, as kernels require. Rows as in `Finish`."""

    surface: NDArray[np.int8]  # (m,) MATT, GLOSSY, ...
    alpha: NDArray[np.float32]  # (m,) width of the slopes of the facets; 0: a mirror
    lets: NDArray[np.float32]  # (m,) share of the sun's light that passes through a body

    @classmethod
    def of(cls, finish: Finish) -> Gloss | None:
        """Return the surface properties of an arena; None if all surfaces are matt."""
        if not finish.surface.any():
            return None
        mean = finish.albedo.mean(axis=1) @ LUMINANCE
        sheet = (1.0 - pane_reflects(1.0)) * mean
        # Light crosses both sides of a body, but only one sheet of a wall.
        lets = np.where(finish.surface == GLASS, sheet**2, 0.0)
        lets[WALLS] = sheet[WALLS] if finish.surface[WALLS] == GLASS else 0.0
        alpha = finish.roughness**2
        return cls(finish.surface, alpha.astype(np.float32), lets.astype(np.float32))


@borrowing_kernel
def let_through(gloss: Gloss | None, row: int) -> np.float32:
    """Return the share of sunlight that passes through a body; 0 if all surfaces are matt."""
    return np.float32(0.0) if gloss is None else gloss.lets[row]


@kernel
def fresnel(cosine: float) -> float:
    """Return the reflected share of unpolarised light by the cosine of ray and normal, 0 to 1."""
    # Cosine inside the medium by Snell's law, then the reflectance of each polarisation.
    inner = math.sqrt(1.0 - (1.0 - cosine * cosine) / (INDEX * INDEX))
    across = (cosine - INDEX * inner) / (cosine + INDEX * inner)
    along = (INDEX * cosine - inner) / (INDEX * cosine + inner)
    return 0.5 * (across * across + along * along)


@kernel
def pane_reflects(cosine: float) -> float:
    """Return the reflectance of a thin pane, including multiple internal reflections."""
    once = fresnel(cosine)
    # Sum of the series r + (1 - r)² r / (1 - r²).
    return 2.0 * once / (1.0 + once)


@kernel
def is_smooth(alpha: float) -> bool:
    """Return True if a surface is a mirror."""
    return alpha < _SMOOTH


@kernel
def _visible(alpha: float, cosine: float) -> float:
    """Return the share of facets visible from a direction (Smith's G1 for GGX)."""
    tangent2 = 1.0 / max(cosine * cosine, 1e-12) - 1.0
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * tangent2))


@kernel
def highlight(alpha: float, normal: Vec, ray: Vec, to_sun: Vec) -> tuple[float, float]:
    """Return radiance per irradiance of the sun on a rough white surface, and the facets' cosine.

    `alpha` is the width of the slopes. The vectors are unit vectors. The cosine gives Fresnel's
    share.
    """
    sun, eye = dot(normal, to_sun), -dot(normal, ray)
    if sun <= 0.0 or eye <= 0.0:
        return 0.0, 1.0
    h = (to_sun[0] - ray[0], to_sun[1] - ray[1], to_sun[2] - ray[2])
    # GGX distribution at the half vector.
    per = 1.0 / max(math.sqrt(dot(h, h)), 1e-12)
    half = per * dot(normal, h)
    spread = half * half * (alpha * alpha - 1.0) + 1.0
    # The distribution's 1/pi cancels with the radiance of a white matt surface, also 1/pi.
    facets = alpha * alpha / (spread * spread)
    # The cosine of the sun cancels with the irradiance of the surface.
    value = facets * _visible(alpha, sun) * _visible(alpha, eye) / (4.0 * eye)
    return value, -per * dot(h, ray)


@kernel
def mirrored(ray: Vec, normal: Vec) -> Vec:
    """Return the mirrored direction of a ray, normalized against accumulated rounding."""
    twice = 2.0 * dot(ray, normal)
    a, b, c = (
        ray[0] - twice * normal[0],
        ray[1] - twice * normal[1],
        ray[2] - twice * normal[2],
    )
    per = 1.0 / math.sqrt(a * a + b * b + c * c)
    return (per * a, per * b, per * c)


@kernel
def spread(number: int) -> tuple[float, float]:
    """Return one of `SAMPLES` evenly distributed points in the unit square (Hammersley)."""
    # Bit reversal of a number of three bits.
    mirrored_bits = 4 * (number & 1) + (number & 2) + ((number & 4) >> 2)
    return (number + 0.5) / SAMPLES, (mirrored_bits + 0.5) / SAMPLES


@kernel
def facet(alpha: float, normal: Vec, ray: Vec, u: float, v: float) -> Vec:
    """Return the normal of a visible facet, sampled by uniform (u, v) in the unit square."""
    # Axes about the normal (Duff et al., Building an orthonormal basis, revisited, 2017).
    sign = math.copysign(1.0, normal[2])
    a = -1.0 / (sign + normal[2])
    b = normal[0] * normal[1] * a
    first = (1.0 + sign * normal[0] * normal[0] * a, sign * b, -sign * normal[0])
    second = (b, sign + normal[1] * normal[1] * a, -normal[1])
    # Stretched by alpha, the visible facets form a hemisphere (Heitz, 2018).
    x, y, z = -alpha * dot(first, ray), -alpha * dot(second, ray), -dot(normal, ray)
    per = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = per * x, per * y, per * z
    level = math.sqrt(x * x + y * y)
    p0, p1 = (-y / level, x / level) if level > 1e-9 else (1.0, 0.0)
    # Third axis: (x, y, z) times (p0, p1, 0).
    q0, q1, q2 = -z * p1, z * p0, x * p1 - y * p0
    # Sample its projection: a disk, one half compressed by the tilt of the view.
    radius, angle = math.sqrt(u), 2.0 * math.pi * v
    s, t = radius * math.cos(angle), radius * math.sin(angle)
    share = 0.5 * (1.0 + z)
    t = (1.0 - share) * math.sqrt(max(1.0 - s * s, 0.0)) + share * t
    w = math.sqrt(max(1.0 - s * s - t * t, 0.0))
    m0, m1, m2 = s * p0 + t * q0 + w * x, s * p1 + t * q1 + w * y, t * q2 + w * z
    # Undo the stretch.
    m0, m1, m2 = alpha * m0, alpha * m1, max(m2, 0.0)
    per = 1.0 / max(math.sqrt(m0 * m0 + m1 * m1 + m2 * m2), 1e-12)
    return (
        per * (m0 * first[0] + m1 * second[0] + m2 * normal[0]),
        per * (m0 * first[1] + m1 * second[1] + m2 * normal[1]),
        per * (m0 * first[2] + m1 * second[2] + m2 * normal[2]),
    )


@kernel
def facet_gives(alpha: float, normal: Vec, away: Vec) -> float:
    """Return the weight of a direction `away` mirrored by a sampled facet; 0 below the surface."""
    cosine = dot(normal, away)
    return _visible(alpha, cosine) if cosine > 0.0 else 0.0
