"""Navigation of the base: occupancy map, shortest paths, stances for GoTo.

Obstacles are rectangles on the floor (furniture, walls, closed and opened doors, objects that lie on the floor). The robot is
a disc, so a base position is free when its distance to every rectangle is at least the robot's radius. Paths are shortest on
the grid (Dijkstra of scipy, 8 neighbours), then shortened by cutting every corner that the clearance allows. The paper uses
the engine's navigation mesh; the disc is our reading of the robot's footprint.

World frame: x, y in metres, yaw in radians, z up. Shape letters: R rows (y), C columns (x), N points, B rectangles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

_RESOLUTION_M = 0.05
#: Extra metres of cost per metre of walking close to obstacles: keeps paths off the furniture where there is room.
_HUG_PENALTY = 0.6
_HUG_DISTANCE_M = 0.15


def wrap_angle(angle_rad: float) -> float:
    """The angle in (-pi, pi]."""
    return float(-((-angle_rad + np.pi) % (2.0 * np.pi) - np.pi))


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle on the floor.

    Attributes:
        center: (x, y) metres, world.
        half: half extents (x, y) metres in the rectangle's own axes.
        yaw_rad: rotation of those axes about z.
    """

    center: tuple[float, float]
    half: tuple[float, float]
    yaw_rad: float = 0.0

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) distances in metres from (N, 2) points, 0 inside."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        delta = points - np.asarray(self.center)
        local = np.stack([c * delta[:, 0] + s * delta[:, 1], -s * delta[:, 0] + c * delta[:, 1]], axis=1)
        outside = np.maximum(np.abs(local) - np.asarray(self.half), 0.0)
        return np.hypot(outside[:, 0], outside[:, 1])


@dataclass(frozen=True, slots=True)
class Stance:
    """A base pose: x, y in metres and yaw in radians, world frame."""

    x: float
    y: float
    yaw_rad: float

    @property
    def position(self) -> NDArray[np.float64]:
        """(2,) metres."""
        return np.array([self.x, self.y])


@dataclass(slots=True)
class NavigationMap:
    """Free space of one arrangement of obstacles.

    Attributes:
        bounds: (x_min, y_min, x_max, y_max) of the walkable floor, metres.
        obstacles: rectangles to keep clear of.
        radius_m: radius of the robot's footprint.
    """

    bounds: tuple[float, float, float, float]
    obstacles: Sequence[Rectangle]
    radius_m: float
    _clearance: NDArray[np.float64] = field(init=False, repr=False)
    _graph: csr_matrix = field(init=False, repr=False)
    _free: NDArray[np.bool_] = field(init=False, repr=False)
    _boxes: NDArray[np.float64] = field(init=False, repr=False)
    _free_cells: NDArray[np.int64] = field(init=False, repr=False)
    _free_points: NDArray[np.float64] = field(init=False, repr=False)
    _shape: tuple[int, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.bounds
        if not (x1 > x0 and y1 > y0):
            raise ValueError(f"bounds must be (x_min, y_min, x_max, y_max) with max > min, got {self.bounds}")
        if self.radius_m <= 0.0:
            raise ValueError(f"radius_m must be positive, got {self.radius_m}")
        self._boxes = np.array([(*r.center, *r.half, np.cos(r.yaw_rad), np.sin(r.yaw_rad)) for r in self.obstacles]).reshape(
            -1, 6
        )
        columns = int(np.floor((x1 - x0) / _RESOLUTION_M)) + 1
        rows = int(np.floor((y1 - y0) / _RESOLUTION_M)) + 1
        self._shape = (rows, columns)
        xs = x0 + np.arange(columns) * _RESOLUTION_M
        ys = y0 + np.arange(rows) * _RESOLUTION_M
        grid = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)  # (R*C, 2), x fastest
        self._clearance = self.clearance(np.asarray(grid, dtype=np.float64))  # (R*C,)
        self._free = self._clearance >= 0.0
        self._free_cells = np.flatnonzero(self._free)
        self._free_points = self.points(self._free_cells)
        self._graph = self._build_graph()

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) metres between the robot's disc at (N, 2) points and the nearest obstacle or room edge, negative inside."""
        x0, y0, x1, y1 = self.bounds
        x, y = points[:, 0], points[:, 1]
        distance = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y))
        if len(self.obstacles):
            boxes = self._boxes  # (B, 6)
            dx, dy = x[:, None] - boxes[:, 0], y[:, None] - boxes[:, 1]  # (N, B)
            u = np.maximum(np.abs(boxes[:, 4] * dx + boxes[:, 5] * dy) - boxes[:, 2], 0.0)
            v = np.maximum(np.abs(boxes[:, 4] * dy - boxes[:, 5] * dx) - boxes[:, 3], 0.0)
            distance = np.minimum(distance, np.sqrt(np.min(u * u + v * v, axis=1)))
        return distance - self.radius_m

    def is_free(self, position: NDArray[np.float64]) -> bool:
        """Whether the base can stand at (2,) metres."""
        x0, y0, x1, y1 = self.bounds
        if not (x0 <= position[0] <= x1 and y0 <= position[1] <= y1):  # numbers of any size are refused here
            return False
        return bool(self.clearance(np.asarray(position, dtype=np.float64)[None, :])[0] >= 0.0)

    def segment_free(self, start: NDArray[np.float64], end: NDArray[np.float64], slack_m: float = 0.0) -> bool:
        """Whether the straight way between two positions is free, sampled every 2 cm; `slack_m` loosens the test."""
        return self.free_travel(start, end, slack_m) >= float(np.linalg.norm(end - start)) - 1e-6

    def free_travel(self, start: NDArray[np.float64], end: NDArray[np.float64], slack_m: float = 0.0) -> float:
        """Metres of the straight way from start to end that are free, up to its length.

        A start inside an obstacle's margin does not count as blocked while the clearance does not get worse.
        """
        length = float(np.linalg.norm(end - start))
        count = max(int(np.ceil(length / 0.02)), 1) + 1
        fraction = np.linspace(0.0, 1.0, count)[:, None]
        clear = self.clearance(start + fraction * (end - start))
        needed = min(-slack_m, float(clear[0]) - 1e-6)
        blocked = np.flatnonzero(clear < needed)
        return length if len(blocked) == 0 else length * float(max(blocked[0] - 1, 0)) / (count - 1)

    def path(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Shortest collision-free polyline (N >= 2, 2) from start to goal, or None when there is none."""
        goal = np.asarray(goal, dtype=np.float64)
        return self.ways(start).to(goal)

    def ways(self, start: NDArray[np.float64]) -> Ways:
        """Shortest paths from a start to everywhere, by one search."""
        start = np.asarray(start, dtype=np.float64)
        source = self._nearest_free_cell(start)
        if source is None:
            empty = np.full(self._free.shape, np.inf)
            return Ways(self, start, -1, empty, np.full(self._free.shape, -1))
        distance, previous = dijkstra(self._graph, indices=source, return_predecessors=True)
        return Ways(self, start, source, distance, previous)

    def stances(
        self, target: NDArray[np.float64], distances_m: Iterable[float], bearing_rad: float = 0.0, count: int = 48
    ) -> list[Stance]:
        """Free base poses around a target, at given distances, with the target at a bearing of the heading.

        Args:
            target: (2,) metres.
            distances_m: allowed distances between base and target.
            bearing_rad: direction of the target in the heading frame, positive to the left.
            count: number of directions tried around the target.
        """
        angles = np.arange(count) * (2.0 * np.pi / count)
        ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        found: list[Stance] = []
        for distance in distances_m:
            points = np.asarray(target)[None] + distance * ring
            for point, angle, clear in zip(points, angles, self.clearance(points), strict=True):
                if clear >= 0.0:
                    yaw = wrap_angle(float(angle) + np.pi - bearing_rad)
                    found.append(Stance(float(point[0]), float(point[1]), yaw))
        return found

    def free_positions(self) -> NDArray[np.float64]:
        """(N, 2) centres of all free grid cells."""
        return self._free_points.copy()

    def cells_of(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """(N,) grid cells next to positions (N, 2): of the four around each the one with most clearance."""
        rows, columns = self._shape
        exact = (positions - self.bounds[:2]) / _RESOLUTION_M  # (N, 2), column then row
        low = np.floor(exact).astype(np.int64)
        corners = np.stack([low, low + (1, 0), low + (0, 1), low + (1, 1)], axis=1)  # (N, 4, 2)
        index = np.clip(corners[..., 1], 0, rows - 1) * columns + np.clip(corners[..., 0], 0, columns - 1)
        best = np.argmax(self._clearance[index], axis=1)
        return index[np.arange(len(index)), best]

    def points(self, cells: NDArray[np.int64]) -> NDArray[np.float64]:
        rows, columns = np.divmod(cells, self._shape[1])
        return np.stack([self.bounds[0] + columns * _RESOLUTION_M, self.bounds[1] + rows * _RESOLUTION_M], axis=1)

    def _nearest_free_cell(self, position: NDArray[np.float64], limit_m: float = 0.6) -> int | None:
        cells = self._free_cells
        if len(cells) == 0:
            return None
        gaps = np.linalg.norm(self._free_points - position, axis=1)
        best = int(np.argmin(gaps))
        return int(cells[best]) if gaps[best] <= limit_m else None

    def _build_graph(self) -> csr_matrix:
        rows, columns = self._shape
        index = np.arange(rows * columns).reshape(rows, columns)
        cost = 1.0 + _HUG_PENALTY * np.clip(1.0 - self._clearance / _HUG_DISTANCE_M, 0.0, 1.0)
        starts: list[NDArray[np.int64]] = []
        ends: list[NDArray[np.int64]] = []
        weights: list[NDArray[np.float64]] = []
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a = index[: rows - dr, max(0, -dc) : columns - max(0, dc)].ravel()
            b = index[dr:, max(0, dc) : columns - max(0, -dc)].ravel()
            both = self._free[a] & self._free[b]
            a, b = a[both], b[both]
            step = _RESOLUTION_M * float(np.hypot(dr, dc)) * 0.5 * (cost[a] + cost[b])
            starts += [a, b]
            ends += [b, a]
            weights += [step, step]
        size = rows * columns
        return csr_matrix((np.concatenate(weights), (np.concatenate(starts), np.concatenate(ends))), shape=(size, size))

    def shorten(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drops waypoints that a straight way makes superfluous (greedy, farthest first)."""
        kept = [points[0]]
        index = 0
        while index < len(points) - 1:
            reach = len(points) - 1
            while reach > index + 1 and not self.segment_free(points[index], points[reach], slack_m=0.01):
                reach = max(index + 1, reach - max(1, (reach - index) // 6))
            kept.append(points[reach])
            index = reach
        return np.stack(kept)


@dataclass(frozen=True, slots=True)
class Ways:
    """Shortest paths from one start to all free cells.

    Attributes:
        map: the free space.
        start: (2,) metres.
        source: grid cell of the start, -1 when it is nowhere near free space.
        distance: (R * C,) cost of the way to each cell, infinite where there is none.
        previous: (R * C,) cell before each cell on its way.
    """

    map: NavigationMap
    start: NDArray[np.float64]
    source: int
    distance: NDArray[np.float64]
    previous: NDArray[np.int64]

    def costs_m(self, goals: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N,) costs of the ways to free positions (N, 2), infinite where there is none."""
        return self.distance[self.map.cells_of(goals)]

    def to(self, goal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Polyline (N >= 2, 2) to a position, None when there is none."""
        goal = np.asarray(goal, dtype=np.float64)
        cell = int(self.map.cells_of(goal[None])[0])
        if not self.map.is_free(goal) or not np.isfinite(self.distance[cell]):
            return None
        cells = [cell]
        while cells[-1] != self.source:
            cells.append(int(self.previous[cells[-1]]))
        middle = self.map.points(np.array(cells[::-1]))
        return self.map.shorten(np.concatenate([self.start[None], middle, goal[None]]))
