"""Arena specification: the parameters of the environment generator."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from airl_mav.core.fields import Each, ProfileModel, later_field, quantity, section
from airl_mav.core.plugins import GENERATORS, part_name
from airl_mav.profiles.assets import ASSETS, Asset
from airl_mav.profiles.walls import HEADROOM_M, Gates, Rooms, check_gates, check_rooms

if TYPE_CHECKING:
    Appearance: TypeAlias = Any
else:
    Appearance = section("arena.appearance")

DEFAULT_APPEARANCE = Appearance()
"""Appearance of an arena whose profile does not define one."""

LEAST_RELIEF_M = 0.2
"""Minimum height of the highest hill [m]."""

MOST_CELLS = 16_384
"""Maximum cells of the ground's grid: two triangles each."""

FINEST_M = 0.25
"""Minimum side of a cell [m]."""

CELLS_A_HILL = 12
"""Cells across a hill, where the floor is small enough."""

LEAST_CELLS_A_HILL = 5
"""Minimum cells across a hill."""


class Terrain(ProfileModel):
    """Hills on the floor. The ground is never below the floor."""

    relief_m: Annotated[tuple[float, float], Each(0, 50, ascending=True)] = quantity(
        "height of the highest hill above the floor, drawn from [least, greatest]; [0, 0]: there"
        " are none",
        "m",
        default=(0.0, 0.0),
    )
    scale_m: float = quantity("width of a hill, on average", "m", ge=2, le=250, default=15)
    flat_m: float = quantity(
        "radius around the start in which the ground is level; beyond it hills begin to rise",
        "m",
        ge=1,
        le=250,
        default=4,
    )

    @property
    def drawn(self) -> bool:
        """True if the arena has hills."""
        return self.relief_m[1] > 0.0

    def pitch_m(self, north_m: float, east_m: float) -> float:
        """Return the side of the ground's cells on a floor of these sides [m]."""
        coarse = math.sqrt(north_m * east_m / MOST_CELLS)
        return max(FINEST_M, self.scale_m / CELLS_A_HILL, coarse)


def check_terrain(
    terrain: Terrain,
    *,
    north_m: float,
    east_m: float,
    height_m: float,
    start_m: tuple[float, float],
) -> None:
    """Raise ValueError for hills that do not fit an arena's size.

    The floor is `north_m` x `east_m`; `start_m` is the start's distance from the south and the west
    wall.
    """
    least, greatest = terrain.relief_m
    # Obstacles need some height between the highest hill and the top of the walls.
    if least < LEAST_RELIEF_M or greatest > height_m - LEAST_RELIEF_M:
        raise ValueError(
            f"terrain.relief_m = {list(terrain.relief_m)}: accepted: {LEAST_RELIEF_M:g} <= value <="
            f" {height_m - LEAST_RELIEF_M:g} m ({LEAST_RELIEF_M:g} m less than size.height_m, the"
            " walls), or [0, 0] for a flat floor"
        )
    finest = LEAST_CELLS_A_HILL * terrain.pitch_m(north_m, east_m)
    if terrain.scale_m < finest:
        raise ValueError(
            f"terrain.scale_m = {terrain.scale_m:g}: accepted: value >= {finest:.3g} m on a floor "
            f"of {north_m:g} x {east_m:g} m (the ground has {MOST_CELLS} cells at most, "
            f"{LEAST_CELLS_A_HILL} across a hill)"
        )
    # Hills reach their full height one scale beyond the level area.
    south, west = start_m
    farthest = math.hypot(max(south, north_m - south), max(west, east_m - west))
    most = farthest - terrain.scale_m
    if terrain.flat_m > most:
        raise ValueError(
            f"terrain.flat_m = {terrain.flat_m:g}: accepted: value <= {most:.3g} m, "
            f"terrain.scale_m {terrain.scale_m:g} less than it is from the start to the farthest "
            "corner"
        )


ShapeName = Literal["box", "cylinder", "sphere"]
SHAPES: tuple[ShapeName, ...] = get_args(ShapeName)
OBSTACLES = "obstacles"
"""The built-in generator: `arena.generate`."""
GeneratorName = Annotated[str, part_name(GENERATORS, (OBSTACLES,))]
Option = bool | int | float | str | list[int | float | str]

ASSET_NAME = re.compile("[a-z]+(-[a-z]+)*")
"""Valid names of custom assets, used in collision reports."""

SPHERE_OFFSET = 0.5
"""Maximum offset of a sphere's centre from the flight altitude, as a share of its radius."""


class Size(ProfileModel):
    """The floor rectangle and the walls at its edges."""

    north_m: float = quantity("length of the floor, south to north", "m", ge=5, le=500, default=50)
    east_m: float = quantity("width of the floor, west to east", "m", ge=5, le=500, default=50)
    height_m: float = quantity("height of the walls", "m", ge=1, le=50, default=5)
    ceiling: bool = later_field(
        default=False,
        description="whether there is one, at the height of the walls: nothing flies over walls and"
        " gates, the sun does not reach the floor, and the ceiling glows as the sky would",
    )


class Start(ProfileModel):
    """Take-off position; the vehicle heads north."""

    north_m: float = quantity("distance from the south wall", "m", ge=0.5, le=499.5, default=3)
    east_m: float = quantity("distance from the west wall", "m", ge=0.5, le=499.5, default=25)
    clearance_m: float = quantity(
        "free way around the start, for standing and moving obstacles",
        "m",
        ge=0.5,
        le=50,
        default=3,
    )


class Goal(ProfileModel):
    """The goal: drawn for each seed, or fixed by `north_m` and `east_m`."""

    north_m: float | None = quantity(
        "fixed goal: north of the start; left out: drawn", "m", ge=-500, le=500, default=None
    )
    east_m: float | None = quantity(
        "fixed goal: east of the start; left out: drawn", "m", ge=-500, le=500, default=None
    )
    min_distance_m: float = quantity(
        "least distance of a drawn goal from the start", "m", ge=0, le=500, default=7
    )
    clearance_m: float = quantity(
        "free way around the goal, to static obstacles and walls", "m", ge=0.5, le=50, default=2
    )
    height_m: Annotated[tuple[float, float], Each(0.2, 50, ascending=True)] | None = quantity(
        "height of the goal above the ground below it, drawn from [least, greatest]; one number:"
        " always that; left out: it has none, and is reached at any height",
        "m",
        default=None,
        later=True,
    )

    @field_validator("height_m", mode="before")
    @classmethod
    def _one_height(cls, value: object) -> object:
        """Convert a single number to a range."""
        one = isinstance(value, int | float) and not isinstance(value, bool)
        return (value, value) if one else value

    @model_validator(mode="after")
    def _both_or_none(self) -> Goal:
        if (self.north_m is None) != (self.east_m is None):
            missing = "north_m" if self.north_m is None else "east_m"
            raise ValueError(f"{missing}: missing; a fixed goal needs north_m and east_m")
        return self

    @property
    def fixed(self) -> tuple[float, float] | None:
        """North and east [m] from the start; None = the goal is drawn."""
        if self.north_m is None or self.east_m is None:
            return None
        return self.north_m, self.east_m


class StaticObstacles(ProfileModel):
    """Static obstacles. Ranges are [minimum, maximum], drawn uniformly, one by one."""

    count: Annotated[tuple[int, int], Each(0, 200, ascending=True)] = quantity(
        "how many", "1", default=(0, 0)
    )
    shapes: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        default=SHAPES,
        description=f"kinds drawn, with equal odds: {', '.join((*SHAPES, *ASSETS))}, or one of"
        " assets",
    )
    half_width_m: Annotated[tuple[float, float], Each(0.1, 20, ascending=True)] = quantity(
        "half width of a box (each way), radius of a cylinder or sphere", "m", default=(0.5, 1.5)
    )
    height_m: Annotated[tuple[float, float], Each(0.2, 50, ascending=True)] = quantity(
        "height of a box or cylinder; they stand on the ground", "m", default=(3.0, 5.0)
    )


class MovingObstacles(StaticObstacles):
    """Random way-point walkers: a straight leg at constant speed, a stop, the next leg."""

    count: Annotated[tuple[int, int], Each(0, 30, ascending=True)] = quantity(
        "how many", "1", default=(0, 0)
    )
    shapes: Annotated[tuple[ShapeName, ...], Field(min_length=1)] = Field(
        default=SHAPES, description="kinds drawn, with equal odds"
    )
    half_width_m: Annotated[tuple[float, float], Each(0.1, 20, ascending=True)] = quantity(
        "half width of a box (each way), radius of a cylinder or sphere", "m", default=(0.4, 0.8)
    )
    speed_m_s: Annotated[tuple[float, float], Each(0.1, 15, ascending=True)] = quantity(
        "speed, drawn once per obstacle", "m/s", default=(1.0, 2.5)
    )
    leg_max_m: float = quantity("greatest length of a leg", "m", ge=5, le=500, default=30)
    dwell_s: float = quantity("stop at every way-point", "s", ge=0, le=60, default=0.2)
    tour_min_s: float = quantity("least time before a tour repeats", "s", ge=10, le=300, default=60)
    clearance_m: float = quantity(
        "least gap to static obstacles and walls on the way", "m", ge=0.05, le=10, default=0.25
    )


class ArenaSpec(ProfileModel):
    """Parameters of an arena; defaults are the paper's where available (arXiv 1906.00421).

    A bounding box is the rectangle around an obstacle's footprint, its sides along north and east.
    """

    description: str = Field(description="one line for people")
    default_seed: int = quantity("seed when none is asked for", "1", ge=0, le=999_999, default=0)
    wall_colour: Annotated[tuple[int, int, int], Each(0, 255)] = quantity(
        "sRGB colour of the walls whose material is wall_colour", "1", default=(153, 0, 0)
    )
    size: Size = Field(default_factory=Size, description="floor and walls")
    start: Start = Field(default_factory=Start, description="where the vehicle takes off")
    goal: Goal = Field(default_factory=Goal, description="where to fly")
    zones_m: Annotated[tuple[float, ...], Each(1, 750, ascending=True)] = quantity(
        "curriculum zones: greatest distance of a drawn goal from the start; inclusive",
        "m",
        default=(16.0, 32.0, 48.0),
    )
    min_clearance_m: float = quantity(
        "least gap between the bounding boxes of obstacles, and to the walls; "
        "of moving ones at time 0",
        "m",
        ge=0,
        le=50,
        default=2,
    )
    count_period: int = quantity(
        "consecutive seeds that share the drawn numbers of obstacles",
        "1",
        ge=1,
        le=10_000,
        default=1,
    )
    flight_altitude_m: float = quantity(
        "height above the floor that every sphere crosses", "m", ge=0.2, le=50, default=2.5
    )
    generator: GeneratorName = Field(
        default=OBSTACLES,
        description="generator of an arena from a seed: obstacles, or a custom function as"
        " MODULE:NAME or FILE.py:NAME",
    )
    options: dict[str, Option] = Field(
        default_factory=dict, description="knobs of a generator of your own"
    )
    static: StaticObstacles = Field(default_factory=StaticObstacles, description="static obstacles")
    moving: MovingObstacles = Field(
        default_factory=MovingObstacles, description="obstacles that move"
    )
    gates: Gates = later_field(Gates, "walls with openings that are on the way to the goal")
    rooms: Rooms = later_field(Rooms, "walls that divide the arena, with doors between rooms")
    terrain: Terrain = later_field(Terrain, "hills on the floor")
    assets: dict[str, Asset] = Field(
        default_factory=dict, description="things of your own, made of parts, by name"
    )
    asset_scale: Annotated[tuple[float, float], Each(0.1, 10, ascending=True)] = quantity(
        "factor of all lengths of an asset, drawn for each", "1", default=(1.0, 1.0)
    )
    appearance: Appearance = later_field(
        Appearance, "what a colour camera sees: materials and light"
    )

    @model_serializer(mode="wrap")
    def _without_unused(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Omit pairs of fields at their defaults, as `later_field` omits single fields."""
        data: dict[str, Any] = dump(self)
        silent: list[str] = []
        if self.generator == OBSTACLES and not self.options:
            silent += ["generator", "options"]
        if not self.assets and self.asset_scale == (1.0, 1.0):
            silent += ["assets", "asset_scale"]
        for name in silent:
            data.pop(name, None)  # may already be omitted as a default
        return data

    @property
    def has_assets(self) -> bool:
        """True if static obstacles may be assets."""
        return not set(self.static.shapes) <= set(SHAPES)

    def asset(self, name: str) -> Asset | None:
        """Return the asset of a name in `static.shapes`, or None for a shape."""
        return self.assets.get(name) or ASSETS.get(name)

    @model_validator(mode="after")
    def _fits_together(self) -> ArenaSpec:
        self._check_start()
        self._check_terrain()
        self._check_goal()
        self._check_assets()
        self._check_gates()
        self._check_rooms()
        self._check_ceiling()
        for name in ("static", "moving"):
            self._check_heights(name, getattr(self, name))
        return self

    def _check_start(self) -> None:
        free = self.start.clearance_m
        for axis in ("north_m", "east_m"):
            value, length = getattr(self.start, axis), getattr(self.size, axis)
            if not free <= value <= length - free:
                raise ValueError(
                    f"start.{axis} = {value:g}: accepted: {free:g} <= value <= {length - free:g} m "
                    f"(size.{axis} {length:g}, start.clearance_m {free:g})"
                )

    @property
    def _most_m(self) -> tuple[float, str]:
        """Maximum height of obstacles on the ground [m], and the reason."""
        walls = self.size.height_m
        if not self.terrain.drawn:
            return walls, "size.height_m, the walls"
        hills = self.terrain.relief_m[1]
        return walls - hills, f"size.height_m {walls:g}, the walls, less terrain.relief_m {hills:g}"

    def _check_goal(self) -> None:
        heights, (most, why) = self.goal.height_m, self._most_m
        if heights is not None and heights[1] > most:
            raise ValueError(
                f"goal.height_m = {list(heights)}: accepted: value <= {most:g} m ({why})"
            )
        if self.goal.fixed is None:
            if self.goal.min_distance_m >= self.zones_m[0]:
                raise ValueError(
                    f"goal.min_distance_m = {self.goal.min_distance_m:g}: accepted: "
                    f"value < {self.zones_m[0]:g} m (the smallest of zones_m)"
                )
            return
        free = self.goal.clearance_m
        for axis, value in zip(("north_m", "east_m"), self.goal.fixed, strict=True):
            start = getattr(self.start, axis)
            low, high = free - start, getattr(self.size, axis) - start - free
            if not low <= value <= high:
                raise ValueError(
                    f"goal.{axis} = {value:g}: accepted: {low:g} <= value <= {high:g} m from the "
                    f"start (inside the walls, goal.clearance_m {free:g})"
                )

    def _check_gates(self) -> None:
        if self.gates.count[1] == 0:
            return
        if self.generator != OBSTACLES:
            raise ValueError(
                f"gates.count = {list(self.gates.count)}: accepted: 0 with a generator of your own"
            )
        check_gates(
            self.gates,
            west_m=self.start.east_m,
            east_m=self.size.east_m - self.start.east_m,
            height_m=self.size.height_m,
            free_m=self.start.clearance_m,
        )
        self._check_behind_gates()

    def _check_rooms(self) -> None:
        rooms = self.rooms
        if not rooms.drawn:
            return
        if self.generator != OBSTACLES or self.gates.count[1] > 0:
            why = "gates" if self.gates.count[1] > 0 else "a generator of your own"
            raise ValueError(f"rooms.count = {list(rooms.count)}: accepted: [0, 0] with {why}")
        check_rooms(
            rooms,
            north_m=self.size.north_m,
            east_m=self.size.east_m,
            height_m=self.size.height_m,
            flight_altitude_m=self.flight_altitude_m,
        )

    def _check_ceiling(self) -> None:
        least = self.flight_altitude_m + HEADROOM_M
        if self.size.ceiling and self.size.height_m < least:
            raise ValueError(
                f"size.height_m = {self.size.height_m:g}: accepted: value >= {least:g} m below a "
                f"ceiling ({HEADROOM_M:g} m above flight_altitude_m {self.flight_altitude_m:g})"
            )

    def _check_terrain(self) -> None:
        terrain = self.terrain
        if not terrain.drawn:
            return
        unfit = {
            "a generator of your own": self.generator != OBSTACLES,
            "gates": self.gates.count[1] > 0,
            "rooms": self.rooms.drawn,
            "a ceiling": self.size.ceiling,
            "moving obstacles": self.moving.count[1] > 0,
        }
        for what, there in unfit.items():
            if there:
                raise ValueError(
                    f"terrain.relief_m = {list(terrain.relief_m)}: accepted: [0, 0] with {what}"
                )
        check_terrain(
            terrain,
            north_m=self.size.north_m,
            east_m=self.size.east_m,
            height_m=self.size.height_m,
            start_m=(self.start.north_m, self.start.east_m),
        )

    def _check_behind_gates(self) -> None:
        """Reject gates that leave no room for the goal behind the last one."""
        last, free = self.gates.last_m, self.goal.clearance_m
        fixed = self.goal.fixed
        if fixed is not None:
            if fixed[0] < last + free:
                raise ValueError(
                    f"goal.north_m = {fixed[0]:g}: accepted: value >= {last + free:g} m, behind the"
                    f" last of the gates (goal.clearance_m {free:g})"
                )
            return
        far = min(self.zones_m[-1], self.size.north_m - self.start.north_m - free)
        if last + free >= far:
            raise ValueError(
                f"gates.count = {list(self.gates.count)}: the last may be {last:g} m from the "
                f"start; accepted: less than {far - free:g} m, so that there is room for the goal "
                f"behind it (zones_m, size.north_m, goal.clearance_m {free:g})"
            )

    def _check_assets(self) -> None:
        for name, asset in self.assets.items():
            if name in SHAPES or ASSET_NAME.fullmatch(name) is None:
                raise ValueError(
                    f"assets.{name}: accepted: a name of small letters, with dashes between words,"
                    f" but {', '.join(SHAPES)}"
                )
            for i, part in enumerate(asset.parts):
                known_materials = self.appearance.known_materials
                if part.material is not None and part.material not in known_materials:
                    raise ValueError(
                        f"assets.{name}.parts.{i}.material = {part.material!r}: accepted: "
                        f"{', '.join(known_materials)}"
                    )
        for i, name in enumerate(self.static.shapes):
            if name in SHAPES:
                continue
            known = self.asset(name)
            if known is None:
                raise ValueError(
                    f"static.shapes.{i} = {name!r}: accepted: "
                    f"{', '.join((*SHAPES, *ASSETS, *self.assets))}"
                )
            top, (most, why) = self.asset_scale[1] * known.top_m, self._most_m
            if self.static.count[1] > 0 and top > most:
                raise ValueError(
                    f"static.shapes.{i} = {name!r}: reaches up to {top:.3g} m (asset_scale "
                    f"{list(self.asset_scale)}); accepted: a top <= {most:g} m ({why})"
                )

    def _check_heights(self, name: str, kind: StaticObstacles) -> None:
        wall, (most, why) = self.size.height_m, self._most_m
        if kind.count[1] == 0:
            return
        if kind.height_m[1] > most and {"box", "cylinder"} & set(kind.shapes):
            raise ValueError(
                f"{name}.height_m = {list(kind.height_m)}: accepted: value <= {most:g} m ({why})"
            )
        radius = kind.half_width_m[1]
        top = radius + max(radius, self.flight_altitude_m + SPHERE_OFFSET * radius)
        if "sphere" in kind.shapes and top > wall:
            raise ValueError(
                f"{name}.half_width_m = {list(kind.half_width_m)}: a sphere across "
                f"flight_altitude_m {self.flight_altitude_m:g} would reach up to {top:g} m; "
                f"accepted: a top <= {wall:g} m (size.height_m, the walls)"
            )
