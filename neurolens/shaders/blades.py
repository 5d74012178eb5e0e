"""Blades of a stop as inputs of a shader: whether rays go through them, and points drawn together so that most do."""

from __future__ import annotations

from functools import reduce

from neurolens.graph.ir import Graph, Value

MAX_BLADES = 16
_CLOSEST = 0.05  # of the stop's radius: the middle of a pupil to an edge; nearer, or beyond it, points stay apart


class Blades:
    """The opening of `Aperture` of inputs of the call: `count` (below 3 the stop is round), `roundness` of its edges,
    cosine and sine of half a blade's angle and of the first edge's direction (`half_cos`, `edge_cos` and so on).

    Points are in units of the stop's radius. Edges of fewer blades repeat.
    """

    def __init__(self, g: Graph) -> None:
        names = "count", "roundness", "half_cos", "half_sin", "edge_cos", "edge_sin"
        count, roundness, cos, sin, *edge = (g.input(name, per_call=True) for name in names)
        self.none = count <= 2.5
        step_cos, step_sin = cos * cos - sin * sin, cos * sin * 2.0
        self.edges: list[tuple[Value, Value]] = []
        for _ in range(MAX_BLADES):
            self.edges.append((edge[0], edge[1]))
            edge = [edge[0] * step_cos - edge[1] * step_sin, edge[0] * step_sin + edge[1] * step_cos]
        rise = roundness * (1.0 - cos)
        self.curvature, self.middle = rise * 2.0 / (sin * sin + rise * rise), cos + rise
        self.scale = 1.0 - self.curvature * self.middle

    def _excess(self, point: Value) -> Value:
        """With `scale` times the distance of a point along an edge's direction added, above 0 beyond the edge; see
        `Aperture.opening`."""
        return self.curvature * 0.5 * (self.middle * self.middle + point.graph.square(point)) - self.middle

    def opened(self, point: Value) -> Value:
        """Whether a point [2] lies in the opening, 1 or 0."""
        along = reduce(Value.maximum, (point[0] * cos + point[1] * sin for cos, sin in self.edges))
        inside = point.graph.select(along * self.scale + self._excess(point) <= 0.0, 1.0, 0.0)
        return point.graph.select(self.none, 1.0, inside)

    def drawn(self, start: Value, way: Value, margin: float) -> Value:
        """The share of a way [2] from a point [2] on which the opening ends, 1 at most.

        Beyond an edge at the share s is a s^2 + b s > c, with one end 1 / s = (b + sqrt(b^2 + 4 a c)) / 2 c.

        Args:
            margin: by which edges are moved out.
        """
        g = start.graph
        a, turned = self.curvature * 0.5 * g.square(way), self.curvature * g.dot(start, way)
        within, inverse = margin - self._excess(start), g.constant(1.0)
        for cos, sin in self.edges:
            along, ahead = (self.scale * (v[0] * cos + v[1] * sin) for v in (start, way))
            b, c = ahead + turned, (within - along).maximum(_CLOSEST)
            inverse = inverse.maximum((b + (b * b + 4.0 * a * c).sqrt()) * 0.5 / c)
        return g.select(self.none, 1.0, 1.0 / inverse)
